"""Where rays go: sources of rays, trace kernels, launching, detector surfaces, meshes."""
