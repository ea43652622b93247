"""Foundations of every layer: errors, units, random streams, YAML, files, memory, threads, Warp, progress, plots."""
