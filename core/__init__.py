"""What every layer needs: errors, units, random streams, YAML, files, memory, threads, Warp, progress, plotting."""
