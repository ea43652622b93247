"""Shapes of surfaces: conics, aspheres, freeforms, grids and meshes."""
