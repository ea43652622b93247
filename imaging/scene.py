"""Noise-free scenes of CCDs: galaxies, stars and their table, ready to be exposed."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from ..core.arguments import check_arguments, removed_arguments
from ..core.errors import ConfigError, DomainError, shown
from ..core.products import Card, Stamp, card_text
from ..core.units import ARCSEC
from ..pipeline.experiment import Experiment
from ..pipeline.listed_visit import nominal_dates, observation_cards
from ..pipeline.simulate.ccd_exposure import ccd_stars, expose_positions
from ..pipeline.simulate.photometry import effective_fwhm
from ..reconstruction.psf_model.interpolation import Interpolation
from ..reconstruction.psf_model.recipe import InterpolationKey
from .draw import SIZES, DrawingWay, SkyPixels, Sources, Window, add_stamps, draw_galaxies
from .exposure import Exposure, expose
from .image_file import CcdImage
from .lit_fraction import LitFraction
from .psf_field import PsfField, to_pixel
from .wcs import CcdWcs, ccd_wcs

#: Pixels by which stamps of stars are larger than those of the PSF: in sums of hundreds of exposures the wings of a
#: star just below saturation stay above the noise that far out. Those of brighter stars do so further out.
STAR_ROOMS = (64, 256, 1024)
STAR_ROOM = STAR_ROOMS[0]
#: Largest light of a star at the rim of its stamp, in rms of the noise of a pixel.
_WING = 0.5
#: Distance that light of galaxies of a population reaches at most [pixel]; those of a catalogue may be larger.
REACH = 256
#: Side of the cutouts [arcsec], as in Jee & Tyson 2011, fig. 10.
CUTOUT = 100.0
#: Long exposure beside that of the run [s], as there.
DEEP = 6000.0

#: Function that gives the galaxies with xi and eta in two ranges [rad].
GalaxiesIn = Callable[[tuple[float, float], tuple[float, float]], Sources]


@dataclass(frozen=True, eq=False)
class CcdScene:
    """Noise-free scene of a CCD, or of a part of it."""

    name: str  #: of the CCD
    electrons: np.ndarray  #: expected electrons of the sources in all exposures, float32 [ny, nx]
    objects: dict[str, np.ndarray]  #: columns of the table of objects
    wcs: CcdWcs
    window: Window  #: part of the CCD
    exposure: Exposure
    telescope: str
    seed: int
    epoch: int
    light: LitFraction  #: that arrives at the pixels, over that on the axis
    cards: tuple[Card, ...] = ()  #: of instrument and time

    @property
    def lit_fraction(self) -> float:
        """Light that arrives in the middle, over that on the axis."""
        window = self.window
        return float(self.light.at(np.array([[window.x, window.y]]) + 0.5 * (np.array(window.shape[::-1]) - 1.0))[0])

    @check_arguments
    def exposed(self, exposure: Exposure | None = None, *, threads: int | None = None) -> CcdImage:
        """Expose the scene, by other settings than its own if they are given; `threads` change no byte."""
        settings = self.exposure if exposure is None else exposure
        ratio = float(settings.electrons(0.0) / self.exposure.electrons(0.0))
        scene = self.electrons if ratio == 1.0 else (self.electrons * ratio).astype(np.float32)
        on_rows = partial(self.light.on_rows, (self.window.x, self.window.y), self.window.shape)
        random_key = self.seed, self.name, self.epoch
        ccd_image = expose(scene, settings, *random_key, lit_fraction=on_rows, threads=threads)
        header = self.wcs.to_header((self.window.x, self.window.y))
        # Where no light is in the middle, the zero point is that of the axis.
        lit = self.lit_fraction or 1.0
        zero_point = settings.zero_point + 2.5 * math.log10(lit)
        sky = float(settings.background_of(lit)) / settings.gain
        for key, value, comment in (
            ("BUNIT", "adu", ""),
            ("TELESCOP", card_text(self.telescope), "prescription"),
            ("FILTER", settings.band, "band"),
            ("EXPTIME", settings.total_time, "[s] all exposures together"),
            ("NEXP", settings.exposures, "number of exposures"),
            ("GAIN", settings.gain, "[electron/adu]"),
            ("ZEROPNT", round(zero_point, 6), "[mag] AB, of 1 adu in EXPTIME, in the middle"),
            ("SKY", round(sky, 6), "[adu] sky and dark current in the middle"),
            ("SKYSUB", settings.subtract_background, "whether the background is subtracted"),
            ("RDNOISE", settings.read_noise, "[electron] rms of one exposure"),
            ("SATURATE", settings.saturation_level, "[adu] least value of saturated pixels"),
            ("NOISE", settings.noise, "whether there is noise"),
            ("SEED", self.seed, "seed of all random numbers"),
            ("EPOCH", self.epoch, "number of the visit"),
            ("CCDX0", self.window.x, "CCD column of the first pixel, from 0"),
            ("CCDY0", self.window.y, "CCD row of the first pixel, from 0"),
        ):
            header[key] = (value, comment)
        header.extend(self.cards, update=True)
        if "VISIT" not in header and self.cards:
            header.extend(nominal_dates(settings.total_time), update=True)
        objects = self.objects if ratio == 1.0 else self.objects | {"FLUX": self.objects["FLUX"] * ratio}
        return CcdImage(self.name, ccd_image.image, ccd_image.variance, ccd_image.mask, header, objects)


@removed_arguments(position_angle="pointing=Pointing(ra, dec, position_angle=...)")
@check_arguments
def draw_ccd(
    experiment: Experiment,
    ccd: str,
    galaxies: Sources | GalaxiesIn,
    *,
    exposure: Exposure | None = None,
    pointing: Any = (0.0, 0.0),
    window: Window | None = None,
    way: DrawingWay = "direct",
    interpolation: InterpolationKey | Interpolation | None = None,
    threads: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> CcdScene:
    """Draw galaxies and the stars of a run on a CCD.

    The PSF of galaxies is that of the run's noise-free PSFs (``stars.truth``), interpolated. Stars are those that the
    run observes (``stars.observed``), each with its own noise-free PSF.

    Parameters
    ----------
    experiment : Experiment
        Experiment with an atmosphere, its screens made (:meth:`~pachon.Experiment.screens`).
    ccd : str
        Name of the CCD.
    galaxies : Galaxies or callable
        Galaxies about the pointing, wherever they are; or a function that gives those with xi and eta in two ranges
        [rad].
    exposure : Exposure, optional
        Band, depth and noise; by default those of the run, in one exposure. Light that the grids of galaxies do not
        hold is far below this noise, and in the middle 100 arcsec below that of 6000 s.
    pointing : Pointing, (float, float), Quantity or SkyCoord
        Direction of the optical axis [rad]; :class:`~pachon.Pointing` has the position angle of the telescope too.
    window : Window, optional
        Part of the CCD; all of it by default.
    way : {"direct", "eigen"}
        How galaxies are convolved, as in :func:`~pachon.imaging.draw.draw_galaxies`.
    interpolation : str or Interpolation, optional
        Of the PSF between the noise-free ones: polynomial or kriging; by default as of :meth:`.PsfField.fit`.
    threads : int, optional
        Number of threads; all processors by default. No byte depends on it.
    progress : callable, optional
        Called with the number of PSFs and galaxies made since the last call.

    Raises
    ------
    ConfigError
        If the run has no atmosphere, without which PSFs are finer than pixels, or its pixels are not those of the
        camera.
    DomainError
        If no light reaches the CCD, or the galaxies outshine the sky.
    """
    if not callable(galaxies) and not hasattr(galaxies, "transform"):
        raise DomainError(f"galaxies = {shown(galaxies)}: expected Galaxies or a function that gives them")
    config, camera = experiment.config, experiment.camera
    if not np.isclose(experiment.pixel_size, camera.pixel_size) or not config.atmosphere.enabled:
        enabled = str(config.atmosphere.enabled).lower()
        raise ConfigError(
            f"psf.pixel_um = {experiment.pixel_size * 1e6:g}, atmosphere.enabled = {enabled}: images expect pixels of "
            f"{camera.pixel_size * 1e6:g} um and an atmosphere"
        )
    if exposure is None:
        exposure = Exposure.of_run(experiment)
    wcs = ccd_wcs(
        experiment.telescope,
        camera,
        ccd,
        pointing=pointing,
        wavelength=experiment.wavelengths[len(experiment.wavelengths) // 2],
        threads=threads,
    )
    area = Window(0, 0, *camera.pixels[camera.ccd_index(ccd)].tolist()) if window is None else window
    psf = PsfField.of_run(experiment, ccd, interpolation=interpolation, threads=threads, progress=progress)
    galaxies = galaxies_near(galaxies, wcs, area)
    pixels = wcs.to_pixel(np.stack([galaxies.xi, galaxies.eta], axis=1))
    electrons = exposure.electrons(galaxies.magnitude) * psf.lit_fraction(pixels)
    noise = np.full(len(galaxies), exposure.noise_rms)
    middle = middle_window(area, exposure).contains(pixels, REACH)
    noise[middle] /= np.sqrt(max(deep_exposures(exposure) / exposure.exposures, 1.0))
    in_area = area.contains(pixels)
    check_density(float(electrons[in_area].sum()) / (area.width * area.height), exposure)
    image = draw_galaxies(
        galaxies,
        electrons,
        psf,
        wcs,
        window=area,
        noise=noise,
        way=way,
        threads=threads,
        progress=progress,
    )
    stars = _add_stars(image, experiment, ccd, psf, exposure, area, threads, progress)
    tables = [
        {
            "PIXEL": stars["PIXEL"],
            "SKY": wcs.to_sky(stars["PIXEL"]),
            "MAG": stars["MAG"],
            "FLUX": stars["FLUX"],
            "STAR": np.ones(len(stars["MAG"]), dtype=bool),
            **{key: np.zeros(len(stars["MAG"])) for key in ("RADIUS", "E1", "E2")},
        },
        {
            "PIXEL": pixels[in_area],
            "SKY": np.stack([galaxies.xi, galaxies.eta], axis=1)[in_area],
            "MAG": galaxies.magnitude[in_area],
            "FLUX": electrons[in_area],
            "STAR": np.zeros(int(in_area.sum()), dtype=bool),
            "RADIUS": galaxies.radius[in_area] / ARCSEC,
            **{key: values[in_area] for key, values in zip(("E1", "E2"), ellipticities(galaxies), strict=True)},
        },
    ]
    return CcdScene(
        ccd,
        image,
        object_columns({key: np.concatenate([table[key] for table in tables]) for key in tables[0]}, wcs),
        wcs,
        area,
        exposure,
        experiment.telescope.name,
        config.seed,
        config.atmosphere.epoch,
        psf.light,
        tuple(observation_cards(experiment, ccd, exposure.total_time)),
    )


def deep_exposures(exposure: Exposure) -> int:
    """Return how many exposures the deep cutouts have."""
    return max(1, round(DEEP / exposure.time))


def middle_window(window: Window, exposure: Exposure) -> Window:
    """Return the middle of a window, as large as a cutout or the window."""
    side = round(CUTOUT * ARCSEC / exposure.pixel_scale)
    width, height = min(side, window.width), min(side, window.height)
    x, y = window.x + (window.width - width) // 2, window.y + (window.height - height) // 2
    return replace(window, x=x, y=y, width=width, height=height)


def ellipticities(galaxies: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return e1 and e2 of whole galaxies, from the second moments of their components' half-light ellipses.

    Of a galaxy of one component they are its own; NaN of stamps, which have no components.
    """
    if not hasattr(galaxies, "component_radius"):
        nothing = np.full(len(galaxies), np.nan)
        return nothing, nothing
    e, d = galaxies.e1 + 1j * galaxies.e2, galaxies.dx + 1j * galaxies.dy
    size = galaxies.component_radius**2 / (1.0 - np.abs(e) ** 2)
    trace = galaxies.fraction * (2.0 * size * (1.0 + np.abs(e) ** 2) + np.abs(d) ** 2)
    spin = galaxies.fraction * (4.0 * size * e + d**2)
    if not len(galaxies):
        return np.zeros(0), np.zeros(0)
    trace, spin = (np.add.reduceat(v, galaxies.first[:-1]) for v in (trace, spin))
    # (Q11 - Q22 + 2i Q12) / (Q11 + Q22 + 2 sqrt(det Q)), where 4 det Q = trace^2 - |spin|^2.
    ellipticity = spin / (trace + np.sqrt(np.maximum(trace**2 - np.abs(spin) ** 2, 0.0)))
    return ellipticity.real, ellipticity.imag


def _add_stars(
    image: np.ndarray,
    experiment: Experiment,
    ccd: str,
    psf: PsfField,
    exposure: Exposure,
    window: Window,
    threads: int | None,
    progress: Callable[[int], None] | None,
) -> dict[str, np.ndarray]:
    """Add the observed stars of the run; return pixel, magnitude and electrons of those in the window."""
    scale = exposure.pixel_scale
    # Places do not depend on the magnitude limits, which follow from the width of the PSF and the vignetting.
    width = effective_fwhm(psf.mean[None], scale)
    provisional = ccd_stars(experiment, ccd, width)
    pixels = to_pixel(experiment, ccd, provisional.observed)
    if not len(pixels):
        return {"PIXEL": pixels, "MAG": provisional.magnitude, "FLUX": provisional.magnitude}
    lit = float(psf.lit_fraction(pixels).min())
    if not lit > 0.0:
        raise DomainError("no light reaches some stars: expected a CCD within the field of the telescope")
    magnitude = ccd_stars(experiment, ccd, width, least_light=lit).magnitude
    expected = exposure.electrons(magnitude) * psf.lit_fraction(pixels)
    room = _star_rooms(psf, expected, exposure)
    near = window.contains(pixels, 0.5 * (psf.stamp + room[:, None]))
    pixels, magnitude, room = pixels[near], magnitude[near], room[near]
    if not len(pixels):
        return {"PIXEL": pixels, "MAG": magnitude, "FLUX": magnitude}
    nearest = np.rint(pixels).astype(np.int64)
    kelvin = None if provisional.temperature is None else provisional.temperature[near]
    electrons = np.empty(len(pixels))
    for size in np.unique(room):
        rows = np.flatnonzero(room == size)
        stars = expose_positions(
            experiment,
            provisional.observed[near][rows],
            threads,
            progress,
            room=int(size),
            offsets=(pixels - nearest)[rows],
            along=ccd,
            temperatures=None if kelvin is None else kelvin[rows],
        )
        electrons[rows] = exposure.electrons(magnitude[rows]) * stars.lit_fraction
        corners = nearest[rows] - stars.image.shape[1] // 2 - (window.x, window.y)
        add_stamps(image, stars.image * electrons[rows, None, None].astype(np.float32), corners)
    in_window = window.contains(pixels)
    return {"PIXEL": pixels[in_window], "MAG": magnitude[in_window], "FLUX": electrons[in_window]}


def _star_rooms(psf: PsfField, electrons: np.ndarray, exposure: Exposure) -> np.ndarray:
    """Return the pixels by which the stamp of each star of so many electrons is larger than those of the PSF, [n]."""
    profile = psf.profile()
    rooms = np.full(len(electrons), STAR_ROOMS[-1])
    for room in reversed(STAR_ROOMS[:-1]):
        # Wings by diffraction fall with the third power of the distance, those by turbulence a little faster.
        rim = profile[-1] * (psf.stamp / (psf.stamp + room)) ** 3
        rooms[electrons * rim < _WING * exposure.noise_rms] = room
    return rooms


def check_density(electrons: float, exposure: Exposure, start: str = "") -> None:
    """Raise DomainError if galaxies, of so many electrons in a pixel on average, are brighter than the sky."""
    if electrons > exposure.background:
        raise DomainError(
            f"{start}galaxies of {electrons:.3g} electrons a pixel bury the sky of {exposure.background:.3g}; expected "
            "a lower density or fainter galaxies"
        )


def galaxies_near(galaxies: Sources | GalaxiesIn, wcs: SkyPixels, window: Window) -> Sources:
    """Return the galaxies on a window and so near that their light may reach it."""
    reach = getattr(galaxies, "reach", REACH) if callable(galaxies) else SIZES[-1] // 2
    xi, eta = sky_ranges(wcs, window.grown(reach))
    if callable(galaxies):
        return galaxies(xi, eta)
    near = (xi[0] <= galaxies.xi) & (galaxies.xi <= xi[1]) & (eta[0] <= galaxies.eta) & (galaxies.eta <= eta[1])
    return galaxies.take(np.flatnonzero(near))


def sky_ranges(wcs: SkyPixels, window: Window) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the ranges of xi and eta of a window."""
    x, y = np.linspace(0.0, window.width, 9) + window.x, np.linspace(0.0, window.height, 9) + window.y
    sky = wcs.to_sky(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
    (xi0, eta0), (xi1, eta1) = sky.min(axis=0), sky.max(axis=0)
    return (float(xi0), float(xi1)), (float(eta0), float(eta1))


def object_columns(table: dict[str, np.ndarray], wcs: CcdWcs) -> dict[str, np.ndarray]:
    """Return the columns of the table of objects."""
    celestial = np.rad2deg(wcs.to_celestial(table["SKY"]))
    return {
        "ID": np.arange(len(table["MAG"]), dtype=np.int32),
        "X": table["PIXEL"][:, 0],
        "Y": table["PIXEL"][:, 1],
        "XI": table["SKY"][:, 0],
        "ETA": table["SKY"][:, 1],
        "RA": celestial[:, 0],
        "DEC": celestial[:, 1],
        **{key: table[key] for key in ("MAG", "FLUX", "STAR", "RADIUS", "E1", "E2")},
    }


def stamped(image: CcdImage, stamp: Stamp) -> CcdImage:
    """Return an image with the stamp of its configuration."""
    return replace(image, stamp=stamp)
