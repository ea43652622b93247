"""World coordinates of a CCD: pixels, tangent plane and celestial coordinates, fitted to traced chief rays.

The tangent plane (xi, eta) is that of a :class:`~pachon.Pointing`, whose module has the formulas.
Headers are TAN, or TAN-SIP (Shupe et al. 2005, ASP Conf. 347, 491), about the middle of each CCD. About the pointing,
the polynomials of a distant CCD of a camera with much distortion, such as Hyper Suprime-Cam, would have no inverse.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import comb
from typing import Any

import numpy as np
from astropy.io import fits
from astropy.wcs import WCS
from numpy.polynomial.polynomial import polyder, polyval2d
from numpy.typing import ArrayLike

from ..core.arguments import check_arguments
from ..core.errors import ConfigError, DomainError, error_context
from ..core.units import ARCSEC, angle
from ..models.camera.camera import Camera
from ..models.camera.cameras import load_camera
from ..models.telescope import Telescope
from ..sky.pointing import Pointing
from ..wavefront.chief_rays import fields_at

#: Largest error of the fit at pixels between those of the fit [rad]. Catalogues are good to a few milliarcseconds.
TOLERANCE = 3e-4 * ARCSEC
#: Largest order that is tried, that of SIP.
_MOST = 9
#: Largest error that is left by that order [rad]: at corners of HSC, 0.87 deg from the axis, 5e-4 arcsec in blue light.
_LARGEST_ERROR = 1e-3 * ARCSEC
#: Points along a side of the CCD at which chief rays are traced for the fit.
_FIT_POINTS = 12
#: Points along a side of the CCD at which the fit is checked, between those of the fit.
_CHECK_POINTS = 15
#: Steps of Newton's method from the inverse polynomial, which is good to a thousandth of a pixel.
_NEWTON_STEPS = 3


@dataclass(frozen=True, eq=False)
class CcdWcs:
    """World coordinates of a CCD.

    Pixels (x, y) are those of arrays, ``image[y, x]``, the first pixel's centre at (0, 0); FITS headers count from 1.
    With u = pixel - reference_pixel, ``cd (u + distortion(u))`` is the place on the tangent plane about the reference
    point; (xi, eta) is that about the pointing.

    Attributes
    ----------
    pointing : tuple of float
        Right ascension and declination of the optical axis [rad].
    reference : tuple of float
        Right ascension and declination of the reference point, in the middle of the CCD [rad].
    shape : tuple of int
        Rows and columns of the CCD.
    reference_pixel : ndarray, shape [2]
        Pixel of the reference point.
    cd : ndarray, shape [2, 2]
        d(place on its tangent plane)/d(pixel) there [rad/pixel].
    distortion, inverse : ndarray, shape [2, order + 1, order + 1]
        SIP polynomials A, B and AP, BP; [axis, i, j] is the coefficient of u^i v^j.
    error : float
        Largest distance from traced chief rays, at pixels that are not those of the fit [rad].
    """

    pointing: tuple[float, float]
    reference: tuple[float, float]
    shape: tuple[int, int]
    reference_pixel: np.ndarray
    cd: np.ndarray
    distortion: np.ndarray
    inverse: np.ndarray
    error: float

    def __repr__(self) -> str:
        ra, dec = np.rad2deg(self.pointing)
        ny, nx = self.shape
        where = f"pointing ({ra:g}, {dec:g}) deg, error {self.error:.2g} rad"
        return f"<CcdWcs: {nx} x {ny} pixels, order {self.order}, {where}>"

    @property
    def order(self) -> int:
        """Order of the polynomials: 1 is TAN without SIP."""
        return self.distortion.shape[1] - 1

    @check_arguments
    def to_sky(self, pixels: ArrayLike) -> np.ndarray:
        """Return (xi, eta) [rad], shape [n, 2], of pixels (x, y), shape [n, 2]."""
        return _reproject(self._to_tangent_plane(pixels), self._pointing_rotation)[0]

    @check_arguments
    def to_pixel(self, sky: ArrayLike) -> np.ndarray:
        """Return pixels (x, y), shape [n, 2], of (xi, eta) [rad], shape [n, 2]."""
        plane = np.atleast_2d(np.asarray(sky, dtype=np.float64))
        target = _reproject(plane, self._pointing_rotation.T)[0] @ np.linalg.inv(self.cd).T
        u = target + _evaluate_polynomials(self.inverse, target)
        for _ in range(_NEWTON_STEPS):
            miss = target - u - _evaluate_polynomials(self.distortion, u)
            u = u + np.linalg.solve(self._distortion_jacobian(u), miss[..., None])[..., 0]
        return u + self.reference_pixel

    @check_arguments
    def jacobians(self, pixels: ArrayLike) -> np.ndarray:
        """Return d(x, y)/d(xi, eta) [pixel/rad] at pixels, shape [n, 2, 2]."""
        u = np.atleast_2d(np.asarray(pixels, dtype=np.float64)) - self.reference_pixel
        return np.linalg.inv(
            _reproject(self._to_tangent_plane(pixels), self._pointing_rotation)[1]
            @ self.cd
            @ self._distortion_jacobian(u)
        )

    @check_arguments
    def to_celestial(self, sky: ArrayLike) -> np.ndarray:
        """Return right ascension and declination [rad], shape [n, 2], of (xi, eta) [rad], shape [n, 2]."""
        return Pointing(*self.pointing).to_celestial(sky)

    @check_arguments
    def to_header(self, corner: tuple[int, int] = (0, 0)) -> fits.Header:
        """Return the cards of a FITS image whose first pixel is the pixel (x, y) = `corner` of the CCD."""
        header = fits.Header()
        kind = "TAN" if self.order == 1 else "TAN-SIP"
        header["WCSAXES"] = 2
        header["CTYPE1"], header["CTYPE2"] = f"RA---{kind}", f"DEC--{kind}"
        header["CUNIT1"] = header["CUNIT2"] = "deg"
        header["RADESYS"] = "ICRS"
        # The default at a declination of exactly 90 deg is 0: the image would be rotated by half a turn.
        header["LONPOLE"] = 180.0
        for i, key in enumerate("12"):
            header[f"CRVAL{key}"] = float(np.rad2deg(self.reference[i]))
            header[f"CRPIX{key}"] = float(self.reference_pixel[i] - corner[i] + 1.0)
            for j in range(2):
                header[f"CD{key}_{j + 1}"] = float(np.rad2deg(self.cd[i, j]))
        if self.order > 1:
            for names, tables in ((("A", "B"), self.distortion), (("AP", "BP"), self.inverse)):
                for name, table in zip(names, tables, strict=True):
                    header[f"{name}_ORDER"] = self.order
                    for i, j in _exponents(self.order):
                        if table[i, j]:
                            header[f"{name}_{i}_{j}"] = float(table[i, j])
        return header

    @check_arguments
    def astropy(self, corner: tuple[int, int] = (0, 0)) -> WCS:
        """Return the WCS of astropy, with the number of pixels of the CCD less those before `corner`."""
        wcs = WCS(self.to_header(corner))
        wcs.pixel_shape = (self.shape[1] - corner[0], self.shape[0] - corner[1])
        return wcs

    def _to_tangent_plane(self, pixels: ArrayLike) -> np.ndarray:
        """Return the places of pixels on the tangent plane about the reference point, shape [n, 2]."""
        u = np.atleast_2d(np.asarray(pixels, dtype=np.float64)) - self.reference_pixel
        return (u + _evaluate_polynomials(self.distortion, u)) @ self.cd.T

    @property
    def _pointing_rotation(self) -> np.ndarray:
        """Rotation of vectors (east, north, outwards) at the reference point into those at the pointing, [3, 3]."""
        return Pointing(*self.pointing).axes @ Pointing(*self.reference).axes.T

    def _distortion_jacobian(self, u: np.ndarray) -> np.ndarray:
        """Return d(u + distortion)/du, shape [n, 2, 2]."""
        derivative = np.empty((len(u), 2, 2))
        for axis in range(2):
            derivative[:, :, axis] = _evaluate_polynomials(
                np.stack([polyder(t, axis=axis) for t in self.distortion]), u
            )
        return derivative + np.eye(2)


@check_arguments
def ccd_wcs(
    telescope: Telescope,
    camera: Camera,
    ccd: str,
    *,
    pointing: Any = (0.0, 0.0),
    position_angle: ArrayLike = 0.0,
    wavelength: ArrayLike | None = None,
    threads: int | None = None,
) -> CcdWcs:
    """Fit the world coordinates of a CCD to chief rays traced to its pixels.

    The chief rays end on the nominal flat detector: heights of CCDs move stars of the LSST by 0.008 arcsec rms, 0.03 at
    most, and turbulence by more. The order is the lowest one that leaves less than :data:`TOLERANCE`, or 9 where that
    leaves less than a milliarcsecond.

    Parameters
    ----------
    telescope : Telescope
        The telescope, its rotator included (:meth:`~pachon.Telescope.with_rotator`).
    camera : Camera
        The camera.
    ccd : str
        Name of the CCD.
    pointing : (float, float), Quantity, SkyCoord or Pointing
        Right ascension and declination of the optical axis [rad]; :class:`~pachon.Pointing` has the position angle too.
    position_angle : float or Quantity
        Angle of the telescope's +y from north through east [rad].
    wavelength : float or Quantity, optional
        Vacuum wavelength [m]; the telescope's default if not given.
    threads : int, optional
        Number of threads; all processors by default.

    Raises
    ------
    UnknownNameError
        If the camera has no such CCD.
    DomainError
        If the pointing is no pair of finite angles with a declination up to 90 deg, or no polynomial is good enough.
    """
    aim = Pointing.of(pointing, position_angle)
    index = camera.ccd_index(ccd)
    pixels = camera.pixels[index]
    middle, half = 0.5 * (pixels - 1), 0.5 * pixels

    def to_sky(places: np.ndarray) -> np.ndarray:
        """Return (xi, eta) of places on the CCD, from -1 to 1 along both axes of its pixels, shape [n, 2]."""
        with error_context(subject=f"CCD {ccd}"):
            slopes = fields_at(
                telescope,
                camera.from_pixel(index, middle + half * places),
                wavelength,
                projection="gnomonic",
                threads=threads,
            )
            telescope.check_field(*np.arctan(slopes.T))
        return aim.to_sky(slopes)

    # Equal skies have equal headers: angles are taken modulo a turn.
    center = (aim.ra % (2.0 * np.pi), aim.dec)
    ra, dec = aim.to_celestial(to_sky(np.zeros((1, 2))))[0].tolist()
    to_reference = Pointing(ra, dec).axes @ Pointing(*center).axes.T

    def traced(points: int) -> tuple[np.ndarray, np.ndarray]:
        """Return places on the CCD, from -1 to 1 along both axes, and on the tangent plane about its middle."""
        # Chebyshev points: a polynomial through them errs about equally everywhere.
        line = np.cos(np.pi * (np.arange(points) + 0.5) / points) / np.cos(0.5 * np.pi / points)
        places = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
        return places, _reproject(to_sky(places), to_reference)[0]

    fit, check = traced(_FIT_POINTS), traced(_CHECK_POINTS)
    for order in range(1, _MOST + 1):
        linear, reference, distortion = _sip_polynomials(*fit, order, half)
        u = half * check[0] - reference
        error = float(np.abs((u + _evaluate_polynomials(distortion, u)) @ linear.T - check[1]).max())
        if error < TOLERANCE:
            break
    if not error < _LARGEST_ERROR:
        raise DomainError(
            f"polynomials of order {_MOST} leave {error / ARCSEC:.2g} arcsec between pixels and sky; expected a "
            "telescope whose images move smoothly with the field angle",
            subject=f"CCD {ccd}",
        )
    target = fit[1] @ np.linalg.inv(linear).T
    offset = half * fit[0] - reference - target
    inverse = _fit_polynomials(target, offset, order)
    return CcdWcs(
        pointing=center,
        reference=(ra, dec),
        shape=(int(pixels[1]), int(pixels[0])),
        reference_pixel=reference + middle,
        cd=linear,
        distortion=distortion,
        inverse=inverse,
        error=error,
    )


@check_arguments
def wcs(
    telescope: Telescope,
    ccd: str,
    pointing: Any,
    rotation: ArrayLike = 0.0,
    *,
    camera: str | Camera | None = None,
    wavelength: ArrayLike | None = None,
    threads: int | None = None,
) -> WCS:
    """Return the world coordinates of a CCD as the WCS of astropy, TAN or TAN-SIP, without refraction by the air.

    It is :meth:`CcdWcs.astropy` of :func:`ccd_wcs`, whose directions agree with traced chief rays to
    :data:`TOLERANCE`, far from the axis to a milliarcsecond. Arrays of the LSST and ComCam show the sky as it is seen:
    the determinant of the CD matrix is negative. Those of cameras that are not transposed are mirror images, of a
    positive determinant.

    Parameters
    ----------
    telescope : Telescope
        The telescope, its rotator included (:meth:`~pachon.Telescope.with_rotator`).
    ccd : str
        Name of the CCD.
    pointing : (float, float), Quantity or SkyCoord
        Right ascension and declination of the optical axis [rad].
    rotation : float or Quantity
        Position angle of the telescope's +y, from north through east [rad]; that of the camera's +y is less than it by
        the angle of the rotator.
    camera : str or Camera, optional
        The camera; that of the telescope if not given.
    wavelength, threads
        As in :func:`ccd_wcs`.

    Raises
    ------
    ConfigError
        If the telescope has no camera and none is given.
    UnknownNameError
        If the camera has no such CCD.
    DomainError
        If the pointing is none, a corner of the CCD lies outside the field, or no polynomial is good enough.
    """
    camera_name = telescope.camera if camera is None else camera
    if camera_name is None:
        raise ConfigError(f"camera = None: expected a camera for {telescope.name}, which has none of its own")
    fitted = ccd_wcs(
        telescope,
        load_camera(camera_name),
        ccd,
        pointing=pointing,
        position_angle=angle(rotation, "rotation"),
        wavelength=wavelength,
        threads=threads,
    )
    return fitted.astropy()


def _sip_polynomials(
    places: np.ndarray, sky: np.ndarray, order: int, half: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fit polynomials of an order; return linear part, reference pixel from the middle of the CCD, and distortion."""
    tables = _fit_polynomials(half * places, sky, order)
    # The reference pixel is the root of the polynomial.
    reference = np.zeros(2)
    for _ in range(20):
        at = _shift_origin(tables, reference)
        reference = reference - np.linalg.solve(_linear_part(at), at[:, 0, 0])
    tables = _shift_origin(tables, reference)
    linear = _linear_part(tables)
    distortion = np.einsum("ab,bij->aij", np.linalg.inv(linear), tables)
    distortion[:, [0, 0, 1], [0, 1, 0]] = 0.0
    return linear, reference, distortion


def _reproject(plane: np.ndarray, turn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Reproject points [n, 2] onto another tangent plane, by the rotation of its axes; with derivatives [n, 2, 2]."""
    vectors = np.column_stack([plane, np.ones(len(plane))]) @ turn.T
    tangent_points, ahead = vectors[:, :2] / vectors[:, 2:], vectors[:, 2, None, None]
    return tangent_points, (turn[:2, :2] - tangent_points[:, :, None] * turn[2, :2]) / ahead


def _linear_part(tables: np.ndarray) -> np.ndarray:
    """Return the matrix of the linear terms of two polynomials."""
    return np.stack([tables[:, 1, 0], tables[:, 0, 1]], axis=1)


def _fit_polynomials(points: np.ndarray, values: np.ndarray, order: int) -> np.ndarray:
    """Return the coefficients [2, order + 1, order + 1] of polynomials through values [n, 2] at points [n, 2]."""
    # Scaled to [-1, 1] for the fit, and then expanded about the origin of the points.
    middle = 0.5 * (points.max(axis=0) + points.min(axis=0))
    scale = 0.5 * np.ptp(points, axis=0).max()
    s, t = ((points - middle) / scale).T
    terms = _exponents(order)
    coefficients = np.linalg.lstsq(np.stack([s**i * t**j for i, j in terms], axis=1), values, rcond=None)[0]
    tables = np.zeros((2, order + 1, order + 1))
    for (i, j), coefficient in zip(terms, coefficients, strict=True):
        tables[:, i, j] = coefficient / scale ** (i + j)
    return _shift_origin(tables, -middle)


def _shift_origin(tables: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Return the coefficients of polynomials p(u + shift), by the binomial theorem."""
    n = tables.shape[1]
    x, y = (np.array([[comb(i, m) * d ** max(i - m, 0) for m in range(n)] for i in range(n)]) for d in shift)
    return np.einsum("aij,im,jn->amn", tables, x, y)


def _evaluate_polynomials(tables: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return the values of two polynomials at points, shape [n, 2]."""
    return np.stack([polyval2d(u[:, 0], u[:, 1], table) for table in tables], axis=1)


def _exponents(order: int) -> list[tuple[int, int]]:
    """Return the exponents (i, j) of the terms up to a total order."""
    return [(i, j) for i in range(order + 1) for j in range(order + 1 - i)]
