"""Stack of the images of many visits: the loop over visits and CCDs, and its products."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ....core.errors import ConfigError, DomainError, PachonError, ProductError
from ....core.files import claim_folder
from ....core.memory import readable, require_bytes
from ....core.products import Stamp
from ....core.progress import Reporter
from ....core.units import ARCSEC
from ....imaging.exposure import Exposure
from ....imaging.image_file import CcdImage, is_whole
from ....imaging.scene import ellipticities, object_columns, sky_ranges
from ....imaging.simulate import BYTES_PER_PIXEL
from ....imaging.wcs import CcdWcs, ccd_wcs
from ....models.camera.camera import Camera
from ....pipeline.config import differences
from ....pipeline.defaults import given
from ....pipeline.experiment import Experiment
from ....pipeline.memory import needed_bytes
from ....pipeline.run_folder import CONFIG_NAME
from ....pipeline.simulate.star_field import magnitudes_at
from ..config import STACK_STAMP, VisitsConfig, load_visits_configuration
from ..plan import Visit
from ..psf_visit import (
    StackFrame,
    check_rotators,
    magnitude_limits,
    middle_wavelength,
    stack_limit,
    visit_experiment,
    visit_telescope,
)
from ..visits import pixel_scale_of, sky_points_of
from .config import ImageStackConfig, load_image_stack_configuration
from .resample import add_resampled
from .tiles import BYTES, STACK_MASK_BITS, Tile, TileSums, choose_tiles, window_on
from .visit_image import Sky, visit_image
from .visit_wcs import VisitWcs

#: Folder of the products in that of the visits, and file of the settings in it.
FOLDER_NAME, SETTINGS_NAME = "images", "images.yaml"
#: S/N of a star as faint as the faintest galaxies in the stack of all visits, and its FWHM: fainter ones are not
#: detected, and all of those below together are 3 % of its noise in a pixel.
_FAINTEST_SNR = 4.0


@dataclass(frozen=True, eq=False)
class ImageStack:
    """Stack of images that a folder of visits holds, or will.

    Attributes
    ----------
    folder : Path
        Of the images.
    visits : VisitsConfig
        Configuration of the visits.
    settings : ImageStackConfig
        Of the images, without open values.
    experiment : Experiment
        Experiment of the visits.
    frame : StackFrame
        Common frame.
    tiles : list of Tile
        Tiles of the sky.
    sky : Sky
        Stars and galaxies.
    stamp : Stamp
        Origin of the products.
    """

    folder: Path
    visits: VisitsConfig
    settings: ImageStackConfig
    experiment: Experiment
    frame: StackFrame
    tiles: list[Tile]
    sky: Sky
    stamp: Stamp

    @classmethod
    def of(cls, visits_folder: Path, settings: ImageStackConfig | None = None) -> ImageStack:
        """Return the stack of a folder of visits, by default with the settings that its images were made with.

        Raises
        ------
        PachonError
            If the folder holds no visits or no images, or the settings do not fit.
        """
        if not (visits_folder / CONFIG_NAME).exists():
            raise ProductError(f"{visits_folder}: no visits (no {CONFIG_NAME}); expected the folder of pachon visits")
        visits = load_visits_configuration(visits_folder / CONFIG_NAME)
        experiment, folder = visits.experiment(), visits_folder / FOLDER_NAME
        before = _settings_before(folder)
        if settings is None and before is None:
            raise ProductError(f"{visits_folder}: no images; expected the folder of pachon stack-images")
        settings = _resolved(settings or ImageStackConfig(), before, visits, experiment)
        frame = StackFrame.of(experiment, STACK_STAMP)
        source = visits.galaxy_source(experiment, _exposure(experiment, frame))
        galaxies_in = source.down_to(given(settings.faintest))
        return cls(
            folder,
            visits,
            settings,
            experiment,
            frame,
            choose_tiles(experiment, frame, given(settings.side), settings.tiles, visits),
            Sky(sky_points_of(experiment, visits, frame), galaxies_in),
            Stamp(visits.galaxies_digest(experiment, images=settings.model_dump(mode="json")), experiment.config.seed),
        )

    def exposure(self, visits: int = 1) -> Exposure:
        """Return depth and noise of the stack of a number of visits."""
        return _exposure(self.experiment, self.frame, visits, noise=self.settings.noise)

    @property
    def plan(self) -> tuple[Visit, ...]:
        """The visits."""
        return self.visits.plan(self.experiment.config.seed)

    def wcs(self, visits: Sequence[Visit], threads: int | None = None) -> Iterator[tuple[Visit, dict[str, VisitWcs]]]:
        """Yield visits with the world coordinates of their CCDs."""
        camera, wavelength = self.experiment.camera, middle_wavelength(self.experiment)
        known: dict[float | None, dict[str, CcdWcs]] = {}
        for visit in visits:
            # About the visit's own pointing, at a position angle of 0, all visits of a rotator angle have the same.
            if visit.rotator_deg not in known:
                telescope = visit_telescope(self.experiment, visit)
                own = {
                    name: ccd_wcs(telescope, camera, name, wavelength=wavelength, threads=threads)
                    for name in given(self.experiment.config.ccds)
                }
                known = {visit.rotator_deg: own}
            yield visit, {name: VisitWcs(ccd, visit) for name, ccd in known[visit.rotator_deg].items()}

    def path(self, visits: int, tile: Tile) -> Path:
        """Return the path of the image of a tile in the stack of a number of visits."""
        return self.folder / f"stack_{visits:04d}_tile_{tile.name}.fits"

    def sums_path(self, tile: Tile) -> Path:
        """Return the path of the sums of a tile."""
        return self.folder / f"sums_tile_{tile.name}.fits"

    def image(self, visits: int, tile: Tile) -> CcdImage:
        """Read the image of a tile; ProductError where there is none of these settings, or it is damaged."""
        path = self.path(visits, tile)
        image = CcdImage.read(path)
        if image.stamp != self.stamp:
            raise ProductError("was made with another version, configuration or seed", file=path)
        return image


def stack_images(
    folder: Path,
    settings: ImageStackConfig,
    *,
    resume: bool = False,
    threads: int | None = None,
    reporter: Reporter | None = None,
) -> ImageStack:
    """Draw the images of the visits of a folder, and stack them on tiles of the common frame.

    The sums of each tile are written after every visit, whole or not at all. Every product has the same bytes on any
    number of threads, and after any number of interruptions.

    Parameters
    ----------
    folder : Path
        Folder of :func:`~..visits.stack_visits`; its configuration suffices.
    settings : ImageStackConfig
        What is drawn and stacked.
    resume : bool
        Go on after the visits whose images are stacked.
    threads : int, optional
        Number of threads; all processors by default.
    reporter : Reporter, optional
        Progress display; silent by default.

    Raises
    ------
    PachonError
        If the folder holds no visits, or images of other settings; if memory or disk will not hold the tiles; or a
        visit fails.
    """
    reporter = Reporter(quiet=True) if reporter is None else reporter
    stack = ImageStack.of(folder, settings)
    check_rotators(stack.experiment, stack.plan)
    _claim(stack, resume)
    _check_room(stack, threads)
    plan = stack.plan
    sums = {tile: _sums_so_far(stack, tile, resume) for tile in stack.tiles}
    done = min(s.visits for s in sums.values())
    if max(s.visits for s in sums.values()) > len(plan):
        raise ProductError(f"{stack.folder} holds more than the {len(plan)} visits of {folder}; remove one of them")
    for tile, own in sums.items():
        gone = [n for n in stack.visits.kept if n <= own.visits and not is_whole(stack.path(n, tile), stack.stamp)]
        if gone:
            text = f"has no image of {gone[0]} visits of tile {tile.name}, and has gone on; remove it"
            raise ProductError(f"{stack.folder} {text}")
    if done:
        reporter.line(f"images of {done} of {len(plan)} visits are stacked already")
    for visit, wcs in stack.wcs(plan[done:], threads):
        # Tiles written before an interruption may be ahead by a visit.
        due = {tile: s for tile, s in sums.items() if s.visits == visit.number}
        reporter.line(f"visit {visit.number + 1} of {len(plan)}, {visit}")
        _add_visit(stack, visit, due, wcs, threads, reporter)
        for tile, own in due.items():
            own.visits += 1
            if own.visits in stack.visits.kept:
                _write_image(stack, tile, own)
            # Written last: visits that it counts have left their image.
            own.write(stack.sums_path(tile), stack.stamp)
    return stack


def _add_visit(
    stack: ImageStack,
    visit: Visit,
    due: dict[Tile, TileSums],
    wcs: dict[str, VisitWcs],
    threads: int | None,
    reporter: Reporter,
) -> None:
    """Draw the CCDs of a visit that touch tiles, and add them to the sums."""
    exposure, windows = stack.exposure(), {}
    for name, own in wcs.items():
        window = window_on(list(due), stack.frame, own)
        if window is not None:
            windows[name] = window
    experiment = visit_experiment(stack.experiment, visit)
    bar = reporter.stage(f"images of {len(windows)} CCDs", total=len(windows))
    with experiment.screens(threads, reporter), bar as stage:
        for i, (name, window) in enumerate(windows.items(), start=1):
            seen = wcs[name]
            try:
                exposed = visit_image(
                    experiment,
                    visit,
                    name,
                    seen,
                    stack.sky,
                    exposure,
                    window,
                    depth=stack.visits.visits.count,
                    threads=threads,
                )
            except PachonError as error:
                raise error.within(subject=f"visit {visit.number}, CCD {name}") from None
            for tile, sums in due.items():
                add_resampled(sums, tile, stack.frame, exposed, window, seen, threads=threads)
            stage.advance()
            stage.step(name, i, len(windows))


def _write_image(stack: ImageStack, tile: Tile, sums: TileSums) -> None:
    """Write the image of a tile with the table of its stars and galaxies."""
    wcs, exposure = tile.wcs(stack.frame), stack.exposure(sums.visits)
    header = wcs.to_header()
    for key, value, comment in (
        ("BUNIT", "adu", "electrons of all visits together"),
        ("TELESCOP", stack.experiment.telescope.name, "prescription"),
        ("FILTER", exposure.band, "band"),
        ("EXPTIME", exposure.total_time, "[s] all visits together"),
        ("NEXP", sums.visits, "number of visits"),
        ("GAIN", exposure.gain, "[electron/adu]"),
        ("ZEROPNT", round(exposure.zero_point, 6), "[mag] AB magnitude of 1 adu in EXPTIME"),
        ("SKY", round(exposure.background, 6), "[adu] background: sky and dark current"),
        ("SKYSUB", True, "whether the background is subtracted"),
        ("NOISE", exposure.noise, "whether there is noise"),
        ("SEED", stack.stamp.seed, "seed of all random numbers"),
    ):
        header[key] = (value, comment)
    image, variance, mask = sums.stacked()
    objects = _truth(stack, tile, wcs, exposure)
    name = f"tile {tile.name}"
    found = CcdImage(name, image, variance, mask, header, objects, stack.stamp, STACK_MASK_BITS)
    found.write(stack.path(sums.visits, tile))


def galaxies_on(sky: Sky, tile: Tile, wcs: CcdWcs) -> Any:
    """Return the galaxies whose centres lie on a tile."""
    galaxies = sky.galaxies(*sky_ranges(wcs, tile.inside))
    pixels = wcs.to_pixel(np.stack([galaxies.xi, galaxies.eta], axis=1))
    return galaxies.take(np.flatnonzero(tile.inside.contains(pixels)))


def _truth(stack: ImageStack, tile: Tile, wcs: CcdWcs, exposure: Exposure) -> dict[str, np.ndarray]:
    """Return the table of the stars and galaxies of a tile; electrons are those of an unvignetted telescope."""
    points = stack.sky.points
    galaxies = galaxies_on(stack.sky, tile, wcs)
    stars = points.sky[points.star]
    magnitude = magnitudes_at(points.quantile[points.star], *magnitude_limits(stack.experiment))
    nothing = np.zeros(len(stars))
    tables = []
    for sky, mag, star, radius, e1, e2 in (
        (stars, magnitude, True, nothing, nothing, nothing),
        (
            np.stack([galaxies.xi, galaxies.eta], axis=1),
            galaxies.magnitude,
            False,
            galaxies.radius / ARCSEC,
            *ellipticities(galaxies),
        ),
    ):
        pixels = wcs.to_pixel(sky)
        own = tile.inside.contains(pixels)
        columns = {"PIXEL": pixels, "SKY": sky, "MAG": mag, "FLUX": exposure.electrons(mag)}
        columns |= {"STAR": np.full(len(sky), star), "RADIUS": radius, "E1": e1, "E2": e2}
        tables.append({key: values[own] for key, values in columns.items()})
    return object_columns({key: np.concatenate([table[key] for table in tables]) for key in tables[0]}, wcs)


def _exposure(experiment: Experiment, frame: StackFrame, visits: int = 1, *, noise: bool = True) -> Exposure:
    # Stacks are in electrons.
    return Exposure.of_run(experiment, visits, gain=1.0, pixel_scale=pixel_scale_of(frame), noise=noise)


def _settings_before(folder: Path) -> ImageStackConfig | None:
    path = folder / SETTINGS_NAME
    return load_image_stack_configuration(path) if path.exists() else None


def _resolved(
    settings: ImageStackConfig, before: ImageStackConfig | None, visits: VisitsConfig, experiment: Experiment
) -> ImageStackConfig:
    """Return settings without open values, which are first those of the images that there are."""
    side, faintest = settings.side, settings.faintest
    if before is not None:
        side, faintest = side or before.side, faintest or before.faintest
    if side is None:
        side = _side(experiment.camera)
    if faintest is None:
        faintest = round(stack_limit(experiment, _FAINTEST_SNR, visits.visits.count), 2)
    camera, config = experiment.camera, experiment.config
    if not np.isclose(experiment.pixel_size, camera.pixel_size) or not config.atmosphere.enabled:
        raise ConfigError(
            f"psf.pixel_um = {experiment.pixel_size * 1e6:g}, atmosphere.enabled = {config.atmosphere.enabled}: images "
            f"expect pixels of {camera.pixel_size * 1e6:g} um and an atmosphere"
        )
    return settings.model_copy(update={"side": side, "faintest": float(faintest)})


def _side(camera: Camera) -> int:
    """Return the pixels along a side of a square as large as the largest CCD."""
    return int(np.ceil(np.sqrt(camera.pixels.prod(axis=1).max())))


def _claim(stack: ImageStack, resume: bool) -> None:
    """Make the folder, or check that its images are of the same settings."""
    path = stack.folder / SETTINGS_NAME

    def check() -> None:
        if not resume:
            raise ProductError(f"{stack.folder} holds images already; go on with --resume, or remove it")
        settings = (load_image_stack_configuration(path), stack.settings)
        found = differences(*(s.model_dump(mode="json") for s in settings))
        if found:
            raise ProductError(f"{stack.folder} holds images of other settings ({'; '.join(found[:3])})")

    claim_folder(path, stack.settings.to_yaml().encode(), products="*.fits", check=check)


def _sums_so_far(stack: ImageStack, tile: Tile, resume: bool) -> TileSums:
    path = stack.sums_path(tile)
    if resume and path.exists():
        return TileSums.read(path, stack.stamp)
    return TileSums.empty(tile.side)


def _check_room(stack: ImageStack, threads: int | None) -> None:
    """Raise DomainError where memory or disk cannot hold the tiles."""
    tile, tiles = BYTES * stack.tiles[0].side ** 2, len(stack.tiles)
    # Beside the sums: a CCD that is drawn, and a tile that is stacked and written.
    largest = max(_side(stack.experiment.camera), stack.tiles[0].side)
    ccd = BYTES_PER_PIXEL * largest**2
    require_bytes(needed_bytes(stack.experiment, threads) + ccd + tiles * tile, "images")
    # Sums, one of them twice while it is replaced, and the stacks that are kept.
    needed = tile * (tiles + 1 + tiles * len(stack.visits.kept))
    free = shutil.disk_usage(stack.folder).free
    there = sum(path.stat().st_size for path in stack.folder.glob("*.fits"))
    if needed - there > free:
        raise DomainError(f"{stack.folder}: the stacks need {readable(needed)} of disk, {readable(free)} are free")
