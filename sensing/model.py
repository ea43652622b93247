"""Model of images of donuts: light, air, detector, diffraction and second stars."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from ..core.arguments import check_arguments
from ..core.errors import ConfigError, DomainError, UnknownNameError, shown
from ..core.units import ARCSEC, angle, metres, radians, require_count, require_positive, require_within
from ..models.camera.focal_plane import FocalPlane
from ..models.io.site_file import load_site
from ..models.site import Site
from ..models.telescope import Telescope
from ..wavefront.atmosphere.atmosphere import Atmosphere
from ..wavefront.psf.light import Light
from .inputs import one_for_each, outer_scale_of, small_length
from .seeing import Seeing

#: Site of telescopes that state none; of its layers a mean image depends on nothing but the seeing.
_SITE = "cerro_pachon"
#: Largest seeing [rad]: no image of a star is as wide.
_MOST_FWHM = 60.0 * ARCSEC
#: Parts of the air that donuts may share.
_SHARED = (0.01, 0.99)
#: Sides of pixels of detectors [m].
_PIXEL_SIDES = (1e-6, 1e-2)
#: Largest defocus of an image [m].
_MOST_DEFOCUS = 0.1
#: Largest standard deviation of the slope of the response, relative, a pixel.
_MOST_SLOPE = 1e-2
#: Largest relative standard deviation of the radii of rims.
_MOST_SIZE = 0.1
#: Least number of cells across the pupil that make an image of it.
_FEWEST_CELLS = 8
#: Largest number of cells across the pupil: 4 million of them.
_MOST_CELLS = 2000
#: Body that a defocus moves by default: the last surface of a telescope, whatever it is called there.
DETECTOR = "Detector"


@check_arguments
@dataclass(frozen=True, eq=False)
class DonutAir:
    """Air in front of the telescope, of a :class:`DonutModel`.

    Attributes
    ----------
    fwhm : float, array [n] or Quantity, optional
        Seeing [rad], if it is known; fitted by default, with a prior of 0.36 to 1.8 arcsec. 0 is no atmosphere,
        and none in the errors of a donut.
    outer_scale : float
        Outer scale of the turbulence [m]; infinite for Kolmogorov's.
    atmosphere : Atmosphere, optional
        Turbulence of the exposure, its winds and length. The terms up to Z78 that its mean wavefront has beside those
        asked for are fitted too, with the prior of the closed form, and not returned; its own of the terms asked for,
        which no single donut tells from the telescope's, are added to ``covariance``. Three times the time; no joint
        fits.
    site : str or Site, optional
        Site whose layers and winds say which part of the air all donuts of an exposure of unknown length share, about
        which that of the exposure is fitted; that of the telescope by default, else ``"cerro_pachon"``.
    shared : float, optional
        That part of its variance, between 0.01 and 0.99, where it is known.

    Raises
    ------
    DomainError
        If a number is outside its range.
    UnknownNameError
        If there is no such site.
    """

    fwhm: ArrayLike | None = None
    outer_scale: float = 25.0
    atmosphere: Atmosphere | None = None
    site: str | Site | None = None
    shared: float | None = None

    def __post_init__(self) -> None:
        if self.shared is not None:
            require_within(self.shared, "shared", *_SHARED)
        if isinstance(self.site, str):
            object.__setattr__(self, "site", load_site(self.site))
        outer_scale_of(self.outer_scale)
        widths = np.zeros(1) if self.fwhm is None else radians(self.fwhm, "fwhm")
        if not ((widths >= 0.0) & (widths < _MOST_FWHM)).all():
            raise DomainError(f"fwhm = {shown(self.fwhm)}: expected angles from 0 to {_MOST_FWHM:g} rad")

    def layers(self, telescope: Telescope) -> Site:
        """Return the site, or that of a telescope."""
        return self.site if isinstance(self.site, Site) else load_site(telescope.site or _SITE)

    def seeing(self, wavelength: float) -> Seeing:
        """Return the long exposure at a wavelength [m]."""
        return Seeing(wavelength, outer_scale_of(self.outer_scale))

    def exposure(self, wavelength: float) -> Atmosphere | None:
        """Return the atmosphere, or one of the known seeing at a wavelength [m]; None without any."""
        if self.atmosphere is not None or self.fwhm is None:
            return self.atmosphere
        strength = self.seeing(wavelength).strength(angle(self.fwhm, "fwhm"))
        return Atmosphere.from_site(_SITE, 0, r0=1.0 / strength, outer_scale=self.outer_scale) if strength else None

    def strengths(self, seeing: Seeing, count: int) -> list[float]:
        """Return the strength of the turbulence of each of so many stars [1/m]: known, or a start of its search."""
        if self.fwhm is None:
            return [seeing.usual_strength] * count
        return [seeing.strength(float(v)) for v in one_for_each(radians(self.fwhm, "fwhm"), count, "fwhm")]


@check_arguments
@dataclass(frozen=True, eq=False)
class DonutDetector:
    """Detector of a :class:`DonutModel`.

    Attributes
    ----------
    pixel_size : float or Quantity
        Side of a pixel [m].
    diffusion : float or Quantity
        Rms of the charge diffusion along each axis [m], which a fitted seeing takes up by default.
    focal_plane : FocalPlane, optional
        Heights of the CCDs; the nominal flat plane by default.
    defocus : float or array, shape [n]
        Shift of the body that `moved` names, of each image, along its z, beside that of the telescope [m]: 0 for all in
        one plane, or 1.5 mm and 0 for donuts and in-focus stars, which then share one likelihood.
    moved : str
        Surface or group of the telescope that `defocus` moves, in one piece: ``"Detector"`` (the last surface, as focus
        chips and corner rafts stand out of focus), ``"Camera"`` (full-array mode of the LSST), ``"M2"`` (AuxTel). Its z
        is that of the surface, or of the first one of a group; of a group with the detector, that of the detector.
        Heights of `focal_plane` are the detector's, whatever moves.
    saturation : float, optional
        Level from which on pixels are saturated [electrons]. Many pixels of the same greatest value are taken to be
        saturated without it.
    response_slope : float
        Standard deviation of a slope of the detector's response along each axis, which flat fields have not taken out,
        relative, a pixel: 5e-5 is 1 % across 200 pixels. It is fitted, by fits of field terms or degrees of freedom for
        all donuts together: one alone hardly tells it from coma.

    Raises
    ------
    DomainError
        If a number is outside its range.
    """

    pixel_size: ArrayLike = 10e-6
    diffusion: ArrayLike = 0.0
    focal_plane: FocalPlane | None = None
    defocus: ArrayLike = 0.0
    moved: str = DETECTOR
    saturation: float | None = None
    response_slope: float = 0.0

    def __post_init__(self) -> None:
        self.pixel()
        self.blur()
        if not (np.abs(metres(self.defocus, "defocus")) <= _MOST_DEFOCUS).all():
            raise DomainError(f"defocus: expected at most {_MOST_DEFOCUS:g} m on either side")
        if self.saturation is not None:
            require_positive(self.saturation, "saturation", "electrons")
        if not 0.0 <= self.response_slope <= _MOST_SLOPE:
            raise DomainError(f"response_slope = {shown(self.response_slope)}: expected 0 to {_MOST_SLOPE:g} a pixel")

    def pixel(self) -> float:
        """Return the side of a pixel [m]."""
        return require_within(metres(self.pixel_size, "pixel_size"), "pixel_size", *_PIXEL_SIDES, "m")

    def blur(self) -> float:
        """Return the rms of the charge diffusion [m]."""
        return small_length(self.diffusion, "diffusion")

    def shifts(self, count: int) -> np.ndarray:
        """Return the shift of each of so many images along z [m]."""
        return one_for_each(metres(self.defocus, "defocus"), count, "defocus")

    def body(self, telescope: Telescope) -> tuple[str, np.ndarray]:
        """Return the name of what a defocus moves and its z axis, or raise UnknownNameError."""
        detector = telescope.surfaces[-1]
        if self.moved in telescope.groups:
            with_detector = detector.name in telescope.groups[self.moved]
            axes = detector.matrix if with_detector else np.asarray(telescope.group_frames[self.moved][1])
            return self.moved, axes[:, 2]
        name = detector.name if self.moved == DETECTOR else self.moved
        if name not in telescope.surface_names:
            groups = ", ".join(telescope.groups) or "it has none"
            raise UnknownNameError(
                f"moved = {shown(self.moved)}: expected a group of {telescope.name} ({groups}) or one of its surfaces "
                f"({', '.join(telescope.surface_names)})"
            )
        return name, telescope.surface(name).matrix[:, 2]

    def defocused(self, telescope: Telescope, shift: float) -> Telescope:
        """Return the telescope with what a defocus moves shifted along its z [m]."""
        name, axis = self.body(telescope)
        return telescope.perturbed(name, shift=shift * axis) if shift else telescope


@check_arguments
@dataclass(frozen=True, eq=False)
class DonutRims:
    """How far rims and spiders are trusted, of a :class:`DonutModel`.

    Attributes
    ----------
    search : bool
        Whether rims and spiders that the residuals say stand elsewhere than the prescription has them are fitted too;
        not where terms of Z4 to Z22 are neither asked for nor expected.
    size : float
        Relative standard deviation of the radii of the rims that bound the light: 0.01 where a mirror's hole is known
        to a hundredth. One donut hardly tells a radius from its wavefront; errors have what is not known of it.

    Raises
    ------
    DomainError
        If the size is negative or above 0.1.
    """

    search: bool = True
    size: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.size <= _MOST_SIZE:
            raise DomainError(f"size = {shown(self.size)}: expected 0 to {_MOST_SIZE:g}", key="size")


@check_arguments
@dataclass(frozen=True, eq=False)
class DonutModel:
    """What images of donuts are made of, for :func:`~pachon.fit_donuts` and :func:`~pachon.draw_donuts`.

    Attributes
    ----------
    light : Light, optional
        Wavelengths and their relative amounts of light; the telescope's own wavelength by default.
    air : DonutAir
        Seeing and turbulence.
    detector : DonutDetector
        Pixels, charge diffusion, heights, defocus and saturation.
    rims : DonutRims
        How far rims and spiders are trusted.
    neighbours : bool
        Whether up to five neighbours may stand on a stamp or beside it. They are searched for, and fitted too.
    diffraction : bool, optional
        Whether light is diffracted at the rims of the pupil, as that of real stars is: it takes light from strips along
        the rims of the image. A fit of rays takes their lack for 35 to 45 nm of wavefront, most of it Z11 (LSST, 1.5
        mm, 620 nm, 0.8"), and a wider seeing. Images made of rays alone have none. By default it is on
        unless rays fit the first donuts better; ``fit.diffraction`` says so. Images are drawn as their engine has it.
    n_pupil : int, optional
        Cells across the pupil of a fit; by default as many as an image needs.
    """

    light: Light | None = None
    air: DonutAir = field(default_factory=DonutAir)
    detector: DonutDetector = field(default_factory=DonutDetector)
    rims: DonutRims = field(default_factory=DonutRims)
    neighbours: bool = True
    diffraction: bool | None = None
    n_pupil: int | None = None

    def __post_init__(self) -> None:
        if self.n_pupil is not None:
            require_count(self.n_pupil, "n_pupil", _FEWEST_CELLS, _MOST_CELLS)

    def with_light(self, wavelengths: ArrayLike | Light | None) -> DonutModel:
        """Return the model with wavelengths [m] that it does not have itself; the same one without any."""
        if wavelengths is None:
            return self
        if self.light is not None:
            raise ConfigError("wavelength and the light of the model are both given: expected one of them")
        return replace(self, light=wavelengths if isinstance(wavelengths, Light) else Light(wavelengths))

    def with_pixel_size(self, pixel_size: ArrayLike | None) -> DonutModel:
        """Return the model with pixels of another side [m]; the same one without."""
        if pixel_size is None:
            return self
        return replace(self, detector=replace(self.detector, pixel_size=pixel_size))

    def with_moved(self, moved: str | None) -> DonutModel:
        """Return the model with another body that a defocus moves; the same one without."""
        return self if moved is None else replace(self, detector=replace(self.detector, moved=moved))
