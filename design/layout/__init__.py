"""Layout of a telescope: sections, rays and meshes."""
