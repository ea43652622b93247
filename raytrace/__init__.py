"""Where rays go: launching, tracing, landing on CCDs and meshes."""
