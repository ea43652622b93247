"""The PSF over the whole focal plane from one exposure: optics, CCD heights and turbulence together."""
