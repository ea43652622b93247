"""Simulated donuts: images of stars far from focus, with noise, second stars and cosmic rays, in electrons."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import DomainError, shown
from ...core.plotting import draw_stamps
from ...core.random_streams import stream
from ...core.result import Result
from ...core.units import ARCSEC, for_each, length, pure_numbers, radians, require_seed
from ...measure.stamps import observe_stamps
from ...models.camera.photometry import READ_NOISE
from ...models.telescope import Telescope
from ...sensing.model import DonutModel
from ...wavefront.psf.light import Light
from ...wavefront.psf.psf import Psfs, make_psfs
from ...wavefront.psf.stamps import Stamps
from ...wavefront.request import wavelength_points
from .star_defects import StarDefects, add_defects

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Pixels on a side of a stamp: a donut of 1.2 mm in pixels of 10 um, and room for the seeing.
STAMP_SIZE = 181
# More do not fit into the counts of the noise.
_MOST_ELECTRONS = 1e15


@dataclass(frozen=True, eq=False)
class Donuts(Result):
    """Images of stars far from focus.

    Attributes
    ----------
    images : ndarray, shape [n_star, ny, nx]
        Electrons, expected sky subtracted; ``[y, x]`` along the axes of the detector.
    sky_variance : float
        Variance of sky and read noise in a pixel [electron^2].
    psf : Psfs
        Noise-free stars, of unit sum, with their fields and places.
    electrons : ndarray, shape [n_star]
        Electrons of each star, those beside the stamp included.
    defects : ndarray of int, shape [n_star]
        :class:`~pachon.StarFlag` bits of second stars and cosmic rays.
    """

    _table = ("fields", "electrons", "defects")
    _images = ("images",)

    images: np.ndarray
    sky_variance: float
    psf: Psfs
    electrons: np.ndarray
    defects: np.ndarray

    @property
    def fields(self) -> np.ndarray:
        """Field angles [rad], shape [n_star, 2]."""
        return self.psf.fields

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw the first six donuts."""
        titles = [f"({x:.3g}, {y:.3g})°" for x, y in np.rad2deg(self.fields)]
        return draw_stamps(ax, self.images, self.psf.pixel_scale / ARCSEC, titles)


@check_arguments
def draw_donuts(
    telescope: Telescope,
    fields: ArrayLike,
    wavelengths: ArrayLike | Light | None = None,
    *,
    model: DonutModel | None = None,
    electrons: ArrayLike = 1e6,
    sky: float = 0.0,
    read_noise: float = READ_NOISE,
    defects: StarDefects | None = None,
    seed: int = 0,
    stamps: Stamps | None = None,
    **psf: Any,
) -> Donuts:
    """Expose stars far from focus.

    Parameters
    ----------
    telescope : Telescope
        The telescope, defocus included: ``telescope.perturbed("Detector", shift=(0, 0, 1.5e-3))``; or in focus, with
        a ``focal_plane`` that carries the heights, such as that of :func:`~pachon.corner_stars`.
    fields, wavelengths
        As in :func:`~pachon.make_psfs`; wavelengths may be those of the model.
    model : DonutModel, optional
        What the images are made of, as :func:`~pachon.fit_donuts` takes it: light, heights, one defocus and the body
        that it moves, pixels, diffusion and saturation of the detector; air of a known seeing, or its exposure, unless
        ``atmosphere`` is given.
    stamps : Stamps, optional
        Size of the stamps, jitter and places; by default 181 x 181 pixels. Where it has no ``offsets``, stars stand
        anywhere within a pixel of the middle one. With a model, pixels and charge diffusion are those of its detector.
    electrons : float or array_like, shape [n_star]
        Electrons of each star.
    sky, read_noise : float
        Expected electrons of the sky in a pixel, which are subtracted, and rms noise without light [electrons].
    defects : StarDefects, optional
        Fractions of the stars with a second star and with a cosmic ray; none by default.
    seed : int
        Seed of places within the pixel, noise and defects, not negative. More stars leave the first as they are.
    **psf
        Further arguments of :func:`~pachon.make_psfs`. By default the ``engine`` is the mean of all turbulence, which
        needs an ``atmosphere``.

    Returns
    -------
    Donuts

    Raises
    ------
    ConfigError, DomainError
        As :func:`~pachon.make_psfs`, of a stamp that is too small for the donuts too; or if a number of electrons is
        negative, or a model has more than one defocus or seeing.
    """
    seed = require_seed(seed)
    angles = np.atleast_2d(radians(fields, "fields"))
    stamps = Stamps(STAMP_SIZE) if stamps is None else stamps
    if stamps.offsets is None:
        stamps = replace(stamps, offsets=stream(seed, "donuts", "places").uniform(-0.5, 0.5, angles.shape))
    modelled = (model or DonutModel()).with_light(wavelengths)
    light = modelled.light or Light(telescope.default_wavelength)
    psf = {"engine": "long_exposure", **psf}
    if model is not None:
        stamps = replace(stamps, pixel_size=modelled.detector.pixel(), diffusion=modelled.detector.blur())
        telescope, psf = _modelled(telescope, modelled, psf)
    stars = make_psfs(telescope, fields, light, stamps=stamps, **psf)
    flux = for_each(pure_numbers(electrons, "electrons"), len(stars.image), "electrons")
    for name, value in (("electrons", flux), ("sky", sky), ("read_noise", read_noise)):
        if not np.all((np.asarray(value) >= 0.0) & (np.asarray(value) <= _MOST_ELECTRONS)):
            raise DomainError(f"{name} = {shown(value)}: expected 0 to {_MOST_ELECTRONS:g} electrons", key=name)
    caught = flux * np.minimum(stars.inside, 1.0)
    observed = observe_stamps(stars.image, caught, sky, read_noise, stream(seed, "donuts", "noise"))
    fractions = StarDefects() if defects is None else defects
    images, flags = add_defects(
        observed,
        stars.image,
        stream(seed, "donuts", "defects"),
        neighbours=fractions.second_stars,
        cosmic_rays=fractions.cosmic_rays,
    )
    if modelled.detector.saturation is not None:
        images = np.minimum(images, modelled.detector.saturation)
    return Donuts(images, float(sky + read_noise**2), stars, flux.copy(), flags)


def _modelled(telescope: Telescope, model: DonutModel, psf: dict[str, Any]) -> tuple[Telescope, dict[str, Any]]:
    """Return the telescope with the defocus of a model, and the arguments of its images where none are given."""
    detector = model.detector
    telescope = detector.defocused(telescope, length(detector.defocus, "defocus"))
    waves = wavelength_points(telescope, None if model.light is None else model.light.wavelengths)
    arguments = {"focal_plane": detector.focal_plane, "atmosphere": model.air.exposure(float(waves[len(waves) // 2]))}
    return telescope, {**arguments, **psf}
