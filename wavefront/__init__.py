"""Phase: optical path differences, Zernikes, phase screens, the atmosphere, PSF engines."""
