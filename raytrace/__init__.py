"""Ray tracing: launching, tracing, landing on CCDs and meshes."""
