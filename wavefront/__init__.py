"""Phase: optical path differences, Zernikes, reference spheres."""
