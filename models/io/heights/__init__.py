"""Heights of CCDs in files: tables of points, tables of Zernike coefficients, and images."""
