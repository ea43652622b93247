"""Stack of the images of many visits: the loop over visits and CCDs, and its products."""

from __future__ import annotations

import math
import shutil
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ....core.errors import DomainError, ProductError, error_context
from ....core.long_work import Execution, claim_folder
from ....core.memory import readable, require_bytes
from ....core.number_text import counted
from ....core.products import is_whole
from ....core.progress import Reporter
from ....core.units import ARCSEC
from ....core.workers import JOBS_AHEAD
from ....imaging.exposure import Exposure
from ....imaging.image_file import CcdImage
from ....imaging.scene import ellipticities, object_columns, sky_ranges
from ....imaging.simulate import BYTES_PER_PIXEL
from ....imaging.wcs import CcdWcs
from ....pipeline.experiment import Experiment
from ....pipeline.memory import needed_bytes
from ....pipeline.simulate.star_field import magnitudes_at
from ..plan import Visit
from ..psf_visit import (
    check_rotators,
    magnitude_limits,
    visit_experiment,
)
from .config import ImageStackConfig, load_image_stack_configuration
from .image_stack import SETTINGS_NAME, ImageStack, tile_side
from .resample import add_resampled
from .tile_light import TileLight
from .tiles import BYTES, STACK_MASK_BITS, Tile, TileSums, window_on
from .visit_image import Sky, visit_image
from .visit_wcs import VisitWcs


def stack_images(
    folder: Path,
    settings: ImageStackConfig,
    *,
    execution: Execution | None = None,
) -> ImageStack:
    """Draw the images of the visits of a folder, and stack them on tiles of the common frame.

    The sums of each tile are written after every visit, whole or not at all. Every product has the same bytes on any
    number of threads, by whatever workers, and after any number of interruptions.

    Parameters
    ----------
    folder : Path
        Folder of :func:`~..visits.stack_visits`; its configuration suffices.
    settings : ImageStackConfig
        What is drawn and stacked.
    execution : Execution, optional
        Workers that draw the visits, threads, whether to go on after those that are stacked, and progress display.

    Raises
    ------
    PachonError
        If the folder holds no visits, or images of other settings; if memory or disk will not hold the tiles; or a
        visit fails.
    """
    execution = execution or Execution()
    threads, reporter = execution.threads, execution.reporter
    stack = ImageStack.of(folder, settings)
    check_rotators(stack.experiment, stack.plan)
    # Before the settings are written, so that others can be tried.
    _check_memory(stack, threads, 1)
    _check_room(stack)
    claim_stack(stack.folder, stack.settings, resume=execution.resume)
    plan = stack.plan
    sums = {tile: _sums_so_far(stack, tile, execution.resume) for tile in stack.tiles}
    done = min(s.visits for s in sums.values())
    if max(s.visits for s in sums.values()) > len(plan):
        most = counted(len(plan), "visit")
        raise ProductError(f"{stack.folder} holds more than the {most} of {folder}; remove one of them")
    for tile, sums_of_tile in sums.items():
        gone = [
            n for n in stack.visits.kept if n <= sums_of_tile.visits and not is_whole(stack.path(n, tile), stack.stamp)
        ]
        if gone:
            text = f"has no image of {counted(gone[0], 'visit')} of tile {tile.name}, and has gone on; remove it"
            raise ProductError(f"{stack.folder} {text}")
    if done:
        reporter.line(f"images of {done} of {counted(len(plan), 'visit is', 'visits are')} stacked already")
    alone, due = execution.alone, plan[done:]
    before = {tile: sums_of_tile.visits for tile, sums_of_tile in sums.items()}
    with execution.results(
        partial(draw_visit, stack, reporter if alone else None),
        [visit.label for visit in due],
        (
            # Tiles written before an interruption may be ahead by a visit.
            (visit, visit_experiment(stack.experiment, visit), wcs, [t for t in sums if before[t] <= visit.number])
            for visit, wcs in stack.wcs(due, threads)
        ),
        title=None if alone else f"images of {counted(len(due), 'visit')}",
        check=lambda processes: _check_memory(stack, threads, processes),
    ) as results:
        for visit_sums in results:
            for tile, tile_sums in visit_sums.items():
                total = sums[tile]
                total.add(tile_sums)
                if total.visits in stack.visits.kept:
                    _write_image(stack, tile, total, threads)
                # Written last, so that all visits that it counts are in the image.
                total.write(stack.sums_path(tile), stack.stamp)
    return stack


def draw_visit(
    stack: ImageStack,
    reporter: Reporter | None,
    job: tuple[Visit, Experiment, dict[str, VisitWcs], list[Tile]],
    threads: int,
) -> dict[Tile, TileSums]:
    """Draw the CCDs of a visit that touch tiles, and resample them onto the tiles; workers have no reporter."""
    visit, experiment, wcs, tiles = job
    reporter = reporter or Reporter(quiet=True)
    reporter.line(f"{visit.label}, {visit}")
    # Noise depends on the part of a CCD that is drawn: it is that of all tiles, whichever are due.
    windows = {
        name: window
        for name, ccd_wcs in wcs.items()
        if window_on(tiles, stack.frame, ccd_wcs) and (window := window_on(stack.tiles, stack.frame, ccd_wcs))
    }
    exposure, sums = stack.exposure(), {tile: TileSums.empty(tile.side) for tile in tiles}
    bar = reporter.stage(f"images of {counted(len(windows), 'CCD')}", total=len(windows))
    with experiment.screens(threads, reporter), bar as stage:
        for i, (name, window) in enumerate(windows.items(), start=1):
            visit_wcs, depth = wcs[name], stack.visits.visits.count
            with error_context(subject=f"CCD {name}"):
                exposed = visit_image(
                    experiment, visit, name, visit_wcs, stack.sky, exposure, window, depth=depth, threads=threads
                )
            for tile in tiles:
                add_resampled(sums[tile], tile, stack.frame, exposed, window, visit_wcs, threads=threads)
            stage.advance()
            stage.step(name, i, len(windows))
    return sums


def _write_image(stack: ImageStack, tile: Tile, sums: TileSums, threads: int | None) -> None:
    """Write the image of a tile with the table of its stars and galaxies."""
    wcs, exposure = tile.wcs(stack.frame), stack.exposure(sums.visits)
    light = TileLight.of(stack.experiment, stack.frame, tile, stack.plan[: sums.visits], threads)
    zero_point = exposure.zero_point + 2.5 * math.log10(light.in_middle)
    header = wcs.to_header()
    for key, value, comment in (
        ("BUNIT", "adu", "electrons of all visits together"),
        ("TELESCOP", stack.experiment.telescope.name, "prescription"),
        ("FILTER", exposure.band, "band"),
        ("EXPTIME", exposure.total_time, "[s] all visits together"),
        ("NEXP", sums.visits, "number of visits"),
        ("GAIN", exposure.gain, "[electron/adu]"),
        ("ZEROPNT", round(zero_point, 6), "[mag] AB, of 1 adu in EXPTIME, in the middle"),
        ("SKY", round(exposure.background, 6), "[adu] background: sky and dark current"),
        ("SKYSUB", True, "whether the background is subtracted"),
        ("NOISE", exposure.noise, "whether there is noise"),
        ("SEED", stack.stamp.seed, "seed of all random numbers"),
    ):
        header[key] = (value, comment)
    image, variance, mask = sums.stacked()
    objects = _truth_table(stack, tile, wcs, exposure, light)
    name = f"tile {tile.name}"
    stacked_image = CcdImage(name, image, variance, mask, header, objects, stack.stamp, STACK_MASK_BITS)
    stacked_image.write(stack.path(sums.visits, tile))


def galaxies_on(sky: Sky, tile: Tile, wcs: CcdWcs) -> Any:
    """Return the galaxies whose centres lie on a tile."""
    galaxies = sky.galaxies(*sky_ranges(wcs, tile.inside))
    pixels = wcs.to_pixel(np.stack([galaxies.xi, galaxies.eta], axis=1))
    return galaxies.take(np.flatnonzero(tile.inside.contains(pixels)))


def _truth_table(
    stack: ImageStack, tile: Tile, wcs: CcdWcs, exposure: Exposure, light: TileLight
) -> dict[str, np.ndarray]:
    """Return the table of the stars and galaxies of a tile."""
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
        in_tile = tile.inside.contains(pixels)
        columns = {"PIXEL": pixels, "SKY": sky, "MAG": mag, "FLUX": exposure.electrons(mag) * light.at(pixels)}
        columns |= {"STAR": np.full(len(sky), star), "RADIUS": radius, "E1": e1, "E2": e2}
        tables.append({key: values[in_tile] for key, values in columns.items()})
    return object_columns({key: np.concatenate([table[key] for table in tables]) for key in tables[0]}, wcs)


def claim_stack(folder: Path, settings: ImageStackConfig, *, resume: bool) -> None:
    """Make the folder, or check that its images are of the same settings."""
    claim_folder(
        folder / SETTINGS_NAME,
        settings.to_yaml().encode(),
        products="*.fits",
        noun="images",
        now=settings.model_dump(mode="json"),
        read=lambda path: load_image_stack_configuration(path).model_dump(mode="json"),
        wanted=resume,
        remedy="remove it",
    )


def _sums_so_far(stack: ImageStack, tile: Tile, resume: bool) -> TileSums:
    path = stack.sums_path(tile)
    if resume and path.exists():
        return TileSums.read(path, stack.stamp)
    return TileSums.empty(tile.side)


def _check_room(stack: ImageStack) -> None:
    """Raise DomainError where the disk cannot hold the tiles."""
    tile, tiles = _tile_bytes(stack), len(stack.tiles)
    # Sums, one of them twice while it is replaced, and the stacks that are kept.
    needed = tile * (tiles + 1 + tiles * len(stack.visits.kept))
    free = shutil.disk_usage(stack.folder.parent).free
    bytes_on_disk = sum(path.stat().st_size for path in stack.folder.glob("*.fits"))
    if needed - bytes_on_disk > free:
        raise DomainError(f"{stack.folder}: the stacks need {readable(needed)} of disk, {readable(free)} are free")


def _check_memory(stack: ImageStack, threads: int | None, processes: int) -> None:
    """Raise ConfigError where memory cannot hold the tiles and the images of so many processes."""
    sums = _tile_bytes(stack) * len(stack.tiles)
    # In each process a CCD that is drawn, or a tile that is written, and the sums of a visit. Here the sums, and those
    # of visits that workers have sent.
    largest = max(tile_side(stack.experiment.camera), stack.tiles[0].side)
    bytes_per_process = needed_bytes(stack.experiment, threads) + BYTES_PER_PIXEL * largest**2 + sums
    require_bytes(processes * bytes_per_process + sums * (1 + JOBS_AHEAD * processes * (processes != 1)), "images")


def _tile_bytes(stack: ImageStack) -> int:
    return BYTES * stack.tiles[0].side ** 2
