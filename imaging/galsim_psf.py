"""PSFs and world coordinates as objects of GalSim; needs GalSim."""

from __future__ import annotations

from typing import Any

import galsim
import numpy as np

from ..core.errors import DomainError, shown
from ..core.units import ARCSEC
from ..models.camera.camera import Camera
from ..models.camera.cameras import load_camera
from ..reconstruction.focal_plane_psf.model import FocalPlanePsf
from ..reconstruction.psf_model.model import PsfModel
from ..wavefront.psf.psf import Psfs
from .wcs import CcdWcs


def galsim_wcs(wcs: CcdWcs) -> galsim.GSFitsWCS:
    """Return the world coordinates of a CCD for images of GalSim, whose first pixel has its centre at (1, 1)."""
    return galsim.GSFitsWCS(header=galsim.FitsHeader(dict(wcs.to_header())))


def psf_object(
    psf: Psfs | PsfModel | FocalPlanePsf,
    *,
    star: int = 0,
    camera: str | Camera | None = None,
    ccd: str | None = None,
    x: float | None = None,
    y: float | None = None,
    colour: float | None = None,
    wcs: galsim.BaseWCS | float | None = None,
    flux: float = 1.0,
    **options: Any,
) -> galsim.InterpolatedImage:
    """Return a PSF as an object of GalSim, to convolve galaxies with.

    The pixels have collected their light: it is to be drawn with ``method="no_pixel"``. Its centre is where the chief
    ray lands for images of :func:`~pachon.make_psfs`, else the middle pixel of the stamps, ``[size // 2, size // 2]``.

    Parameters
    ----------
    psf : Psfs, PsfModel or FocalPlanePsf
        Images of stars, or a model of them.
    star : int
        Index of the star, for images of stars.
    camera : str or Camera, optional
        Camera of the CCD that `wcs` is of. Stamps along the axes of the focal plane, as of :func:`~pachon.make_psfs`
        and runs, are turned onto the CCD's pixels, whose x runs along y of the focal plane in the LSST. Without a
        camera stamps are along the pixels, as those of stars of images are.
    ccd : str, optional
        Name of the CCD, with a camera or for a model of the focal plane.
    x, y : float, optional
        Position, for a model: in the unit of its fit, or [m] for one of the focal plane.
    colour : float, optional
        Colour, for a model of a CCD that depends on it; the mean of its stars by default.
    wcs : galsim.LocalWCS, galsim.JacobianWCS or float, optional
        World coordinates of a pixel of the stamp: local WCS of the image at the star, or the side of a pixel [arcsec],
        along the axes of the detector then; by default that of the images.
    flux : float
        Flux of the object.
    **options
        Options of :class:`galsim.InterpolatedImage`, such as ``x_interpolant``.

    Raises
    ------
    DomainError
        If there is no such star, a position or the WCS is missing, there is a camera without CCD or local WCS, or no
        light on the stamp.
    UnknownNameError
        If the camera has no such CCD.
    """
    offset, scale = np.zeros(2), None
    if isinstance(psf, Psfs):
        if not 0 <= star < len(psf.image):
            raise DomainError(f"star = {star!r}: expected 0 to {len(psf.image) - 1}")
        stamp, offset, scale = psf.image[star], psf.offset[star], psf.pixel_scale / ARCSEC
        if psf.flags[star]:
            raise DomainError(f"star = {star!r}: expected one with light on its stamp")
    elif x is None or y is None or (ccd is None and isinstance(psf, FocalPlanePsf)):
        needed = "ccd, x and y" if isinstance(psf, FocalPlanePsf) else "x and y"
        raise DomainError(f"{needed}: expected the place of the PSF")
    elif isinstance(psf, PsfModel):
        stamp = psf.draw(x, y, colour=colour)
    else:
        assert ccd is not None
        stamp, scale = psf.draw(ccd, x, y)[0], psf.pixel_scale and psf.pixel_scale / ARCSEC
    pixel = scale if wcs is None else wcs
    if pixel is None:
        raise DomainError(
            "wcs = None: expected a local WCS or the side of a pixel [arcsec], which the model does not have"
        )
    local = galsim.PixelScale(pixel) if isinstance(pixel, (int, float)) else pixel
    if camera is not None:
        if ccd is None or isinstance(wcs, (int, float, type(None))):
            raise DomainError(f"camera = {shown(camera)}: expected ccd and the local WCS of its pixels beside it")
        mosaic = load_camera(camera)
        along_pixels = mosaic.along_pixels(mosaic.ccd_index(ccd), np.eye(2)).T
        local = galsim.JacobianWCS(*(local.jacobian().getMatrix() @ along_pixels).ravel())
    # The middle of the stamp is pixel [size // 2]; GalSim counts from the centre of the image.
    size = np.array(stamp.shape[::-1])
    centre = size // 2 - 0.5 * (size - 1) + offset
    image = galsim.Image(np.ascontiguousarray(stamp, dtype=np.float64))
    return galsim.InterpolatedImage(image, wcs=local, flux=flux, offset=tuple(centre), **options)
