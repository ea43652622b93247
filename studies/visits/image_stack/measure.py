"""Galaxies measured on stacked images, beside the same galaxies each on a stamp of its own."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from ....core.errors import DomainError
from ....core.files import write_bytes, write_json
from ....core.long_work import Execution
from ....core.number_text import counted
from ....core.products import Stamp
from ....core.random_streams import natural_number, stream
from ....core.units import ARCMIN
from ....imaging.image_file import CcdImage
from ....measure.catalogue.detect import DetectedObjects, detect_objects
from ....measure.catalogue.fit_galaxies import fit_galaxies
from ....measure.catalogue.galaxy_fits import usable_galaxies
from ....measure.catalogue.matching import match_positions
from ....measure.catalogue.star_locus import LocusSearch, StarSelection, select_stars
from ....measure.shapes import half_light_radii, measure_shapes
from ....measure.shear.detection import detect_shear
from ....measure.shear.noise import CorrelatedNoise
from ....measure.shear.weight import weight_sigma
from ..galaxy_shapes import SHEAR_MIN_SNR, SOLVER, GalaxyShapes, measure_galaxies
from ..null_result import NullTest, null_metrics
from ..null_test import FAINTEST_SNR, REACH, write_pictures, write_shapes
from ..psf_visit import stack_limit
from ..stack import PsfStack
from ..visits import cell_of, stack_path
from .image_stack import ImageStack
from .picture import stacks_png
from .stack_images import galaxies_on
from .tiles import Tile
from .transfer import broadened, mean_noise_correlation, mean_transfer

#: Largest distance of a detected object from a true one [pixel].
MATCH_RADIUS = 3.0

#: Of the pixels of an object [standard deviations]: at 3, one in six of the galaxies that are usable on stamps of their
#: own has no five pixels above it. Detected noise has no ellipticity that is known well enough to be used.
_THRESHOLD = 1.5
#: S/N in one visit of the objects that determine the locus of stars.
_BRIGHT_SNR = 45.0
#: The fewest objects that determine the locus of stars.
_FEWEST_STARS = 5
#: Range of the half-light radii of stars over those of the PSFs of the models.
_RADII = (0.9, 1.1)


@dataclass(frozen=True, eq=False)
class MeasuredTile:
    """Objects of one tile.

    Attributes
    ----------
    galaxies : GalaxyShapes
        Detected objects that are not selected stars; their index is that of the true galaxy, -1 where there is none.
    stamps : GalaxyShapes
        True galaxies, each on a stamp of its own, with the noise of the stack.
    noise_free : GalaxyShapes
        Those without noise that are usable on the image and on their stamp.
    area : float
        Pixels with data [arcmin^2].
    stars : dict of str to float
        Selected stars against the true PSFs of the stack.
    """

    galaxies: GalaxyShapes
    stamps: GalaxyShapes
    noise_free: GalaxyShapes
    area: float
    stars: dict[str, float]


def measure_stack(
    folder: Path,
    *,
    execution: Execution | None = None,
) -> dict[int, dict[str, Any]]:
    """Detect objects on the stacked images of visits, select stars, and fit galaxies.

    Every galaxy is fitted with the PSF of the models of the visits, and with the true one, of the nearest place without
    a star. Products are tables of galaxies, ``images.json``, ``images.png``, and pictures of the correlations of the
    ellipticities, which no shear has touched.

    Parameters
    ----------
    folder : Path
        Folder of :func:`~..visits.stack_visits` and of :func:`.stack_images`.
    execution : Execution, optional
        Workers that measure the tiles, threads, and progress display.

    Returns
    -------
    dict of int to dict
        Figures by number of visits, as in ``images.json``.

    Raises
    ------
    PachonError
        If the folder holds no stacks of PSFs or images, or no tile has stars enough; others without are left out.
    """
    execution = execution or Execution()
    stack = ImageStack.of(folder)
    origin = Stamp(stack.visits.digest(stack.experiment), stack.experiment.config.seed)
    images = {visits: stack.image(visits, stack.tiles[0]) for visits in stack.visits.kept}
    write_bytes(stack.folder / "images.png", stacks_png(images))
    numbered = [(visits, tile) for visits in stack.visits.kept for tile in stack.tiles]

    def jobs() -> Iterator[tuple[Tile, CcdImage, PsfStack]]:
        for visits in stack.visits.kept:
            psfs = PsfStack.read(stack_path(folder, visits), origin)
            for tile in stack.tiles:
                yield tile, stack.image(visits, tile), psfs

    tiles: dict[int, list[MeasuredTile]] = {visits: [] for visits in stack.visits.kept}
    left_out: dict[int, dict[str, str]] = {visits: {} for visits in stack.visits.kept}
    labels = [f"{counted(visits, 'visit')}, tile {tile.name}" for visits, tile in numbered]
    with execution.results(
        partial(measured_or_reason, stack), labels, jobs(), title="galaxies in the stacked images"
    ) as results:
        for (visits, tile), label, measured in zip(numbered, labels, results, strict=True):
            if isinstance(measured, str):
                left_out[visits][tile.name] = measured
                if len(left_out[visits]) == len(stack.tiles):
                    raise DomainError(measured, subject=label)
                execution.reporter.line(f"{label} is left out: {measured}")
                continue
            path = stack.folder / f"galaxies_{visits:04d}_tile_{tile.name}.fits"
            write_shapes(path, measured.galaxies, stack.stamp)
            tiles[visits].append(measured)
    metrics_by_visits = {
        visits: tile_metrics(measured_tiles) | {"left_out": left_out[visits]}
        for visits, measured_tiles in tiles.items()
    }
    tests = null_tests(tiles)
    for visits, result in tests.items():
        metrics_by_visits[visits]["null_test"] = null_metrics(result)
    if tests:
        write_pictures(stack.folder, tests)
    write_json(stack.folder / "images.json", {"stacks": {str(n): metrics for n, metrics in metrics_by_visits.items()}})
    return metrics_by_visits


def null_tests(tiles: dict[int, list[MeasuredTile]]) -> dict[int, NullTest]:
    """Return the null test of the galaxies on the images, by number of visits, of stacks with pairs of galaxies."""
    return {
        visits: NullTest.of(
            visits, [tile.galaxies for tile in measured_tiles], sum(tile.area for tile in measured_tiles)
        )
        for visits, measured_tiles in tiles.items()
        if sum(int(tile.galaxies.usable_twice.sum()) for tile in measured_tiles) >= 2
    }


def measured_or_reason(stack: ImageStack, job: tuple[Tile, CcdImage, PsfStack], threads: int) -> MeasuredTile | str:
    """Measure one tile as the job of a worker, or return why it cannot be measured."""
    try:
        return measure_tile(stack, *job, threads=threads)
    except DomainError as error:
        return str(error)


def measure_tile(
    stack: ImageStack, tile: Tile, image: CcdImage, psfs: PsfStack, *, threads: int | None = None
) -> MeasuredTile:
    """Measure the objects of a tile, and its true galaxies on stamps of their own.

    Raises
    ------
    DomainError
        If nothing is detected, or there is no locus of stars.
    """
    exposure = stack.exposure(psfs.visits)
    # White noise that is as strong in averages over several pixels as the correlated noise of the stack.
    variance = image.variance * np.float32(exposure.noise_rms**2 / np.median(image.variance[image.mask == 0]))
    objects = detect_objects(image.image, variance, image.mask, threshold=_THRESHOLD, background_size=None)
    truth = image.objects
    key: tuple[str | int, ...] = ("images", psfs.visits, natural_number(tile.column), natural_number(tile.row))
    scale = stack.frame.pixel_scale
    reach = REACH * cell_of(stack.experiment, stack.frame) / float(np.sqrt(stack.visits.visits.places))
    places = np.flatnonzero(~psfs.star)
    at = np.stack([objects.x, objects.y], axis=1) + tile.first
    images = [ccd for _, wcs in stack.wcs(stack.plan[: psfs.visits], threads) for ccd in wcs.values()]
    transfer = mean_transfer(tile, stack.frame, images)
    noise = CorrelatedNoise(
        float(np.sqrt(np.median(image.variance[image.mask == 0]))), mean_noise_correlation(tile, stack.frame, images)
    )
    known_at = np.stack([psfs.x, psfs.y], axis=1)[places]
    near = places[tile.inside.contains(known_at / scale - tile.first)]
    modelled = broadened(psfs.model[near if len(near) else places], transfer)
    stars = selected_stars(objects, image, modelled, stack.experiment.config.stars.snr_min, psfs.visits)
    distance, nearest = cKDTree(known_at).query(at * scale, distance_upper_bound=reach)
    ours = np.isfinite(distance)
    ours[stars.index] = False
    rows = np.flatnonzero(ours)
    fits = [
        fit_galaxies(
            image.image,
            np.where(image.mask == 0, variance, 1.0),
            objects.x[rows],
            objects.y[rows],
            broadened(psf_images[places], transfer),
            psf_index=nearest[rows],
            half_light_radius=objects.half_light_radius[rows],
            mask=image.mask,
            segmentation=objects.segmentation,
            solver=SOLVER,
            threads=threads,
        )
        for psf_images in (psfs.model, psfs.true)
    ]
    usable = [usable_galaxies(fit, objects.half_light_radius[rows], stars.half_light_radius) for fit in fits]
    shears = [
        detect_shear(
            image.image,
            psf_images / psf_images.sum(axis=(1, 2), keepdims=True),
            scale,
            noise,
            psf_positions=known_at / scale - tile.first,
            mask=image.mask,
            sigma=weight_sigma(None, broadened(psfs.true[places], transfer), scale),
            seed=int(stream(stack.stamp.seed, *key, "peaks").integers(2**32)),
            min_snr=SHEAR_MIN_SNR,
            threads=threads,
        )
        .at_objects(objects.x, objects.y)
        .take(rows)
        for psf_images in (broadened(psfs.model[places], transfer), broadened(psfs.true[places], transfer))
    ]
    match = match_positions(objects.x, objects.y, truth["X"], truth["Y"], MATCH_RADIUS)[rows]
    # True galaxies follow the stars of the table, in the order of the galaxies on the tile.
    index = np.where(match >= 0, match - int(truth["STAR"].sum()), -1)
    x, y = (at[rows] * scale).T
    galaxies = GalaxyShapes(
        index=np.maximum(index, -1),
        x=x,
        y=y,
        magnitude=objects.magnitude(image.header["ZEROPNT"])[rows],
        e1=fits[0].e1,
        e2=fits[0].e2,
        error=fits[0].ellipticity_error,
        usable=usable[0],
        true_e1=fits[1].e1,
        true_e2=fits[1].e2,
        true_usable=usable[1],
        shear=shears[0],
        true_shear=shears[1],
    )
    true, axes = galaxies_on(stack.sky, tile, tile.wcs(stack.frame)), stack.frame.matrix
    options: dict[str, Any] = {"reach": reach, "threads": threads}
    drawn = np.flatnonzero(true.magnitude <= stack_limit(stack.experiment, FAINTEST_SNR, psfs.visits))
    stamps = measure_galaxies(psfs, axes, true.take(drawn), exposure, stack.stamp.seed, *key, **options)
    stamps = replace(stamps, index=drawn[stamps.index])
    usable_on_both = np.intersect1d(galaxies.index[galaxies.usable], stamps.index[stamps.usable])
    silent = replace(exposure, noise=False)
    noise_free = measure_galaxies(psfs, axes, true.take(usable_on_both), silent, stack.stamp.seed, *key, **options)
    noise_free = replace(noise_free, index=usable_on_both[noise_free.index])
    area = float((image.mask == 0).sum()) * (scale / ARCMIN) ** 2
    return MeasuredTile(galaxies, stamps, noise_free, area, _star_metrics(stars, psfs, transfer, stack, tile))


def selected_stars(
    objects: DetectedObjects, image: CcdImage, psfs: np.ndarray, least: float, visits: int
) -> StarSelection:
    """Return the stars of a stack, as wide as the PSFs of the models and of at least an S/N in one visit.

    Few stars of one visit are among many galaxies of a deep stack: their locus is looked for where the PSFs say.
    """
    depth, radius = float(np.sqrt(visits)), float(np.median(half_light_radii(psfs)))
    return select_stars(
        objects,
        image.image,
        mask=image.mask,
        min_snr=least * depth,
        locus=LocusSearch(_BRIGHT_SNR * depth, _FEWEST_STARS, (_RADII[0] * radius, _RADII[1] * radius)),
    )


def _star_metrics(
    stars: StarSelection, psfs: PsfStack, transfer: np.ndarray, stack: ImageStack, tile: Tile
) -> dict[str, float]:
    """Return how the selected stars differ from the true PSFs of the stack at them."""
    scale = stack.frame.pixel_scale
    star_rows = np.flatnonzero(psfs.star)
    places = np.stack([psfs.x, psfs.y], axis=1)[star_rows] / scale - tile.first
    match = match_positions(stars.positions[:, 0], stars.positions[:, 1], places[:, 0], places[:, 1], MATCH_RADIUS)
    real = match >= 0
    rows = star_rows[match[real]]
    shapes, true = (
        measure_shapes(stamps, scale, stack.experiment.weight_fwhm)
        for stamps in (stars.stamps[real], broadened(psfs.true[rows], transfer))
    )
    changes = {"e1": shapes.e1 - true.e1, "e2": shapes.e2 - true.e2, "size": shapes.size / true.size - 1.0}
    figures = {f"{key}_difference": float(np.nanmean(v)) for key, v in changes.items()} if len(rows) else {}
    return {"selected": float(len(stars)), "true": float(real.sum()), **figures}


def tile_metrics(tiles: list[MeasuredTile]) -> dict[str, Any]:
    """Return the figures of the tiles of one stack.

    Densities are usable galaxies per square arcminute. Responses are slopes of measured against noise-free
    ellipticities, of galaxies usable on the image and on the stamp; differences are image minus stamp.
    """
    area = sum(tile.area for tile in tiles)
    pairs = [_paired_ellipticities(tile) for tile in tiles]
    image, stamp, reference = (np.concatenate([pair[k] for pair in pairs]) for k in range(3))
    difference = image - stamp
    slopes = [_response_slope(e, reference) for e in (image, stamp, difference)]
    lost, faint = (sum(int(_loss_counts(tile)[k]) for tile in tiles) for k in range(2))

    def density(name: str, flag: str) -> float:
        return sum(int(getattr(getattr(tile, name), flag).sum()) for tile in tiles) / area

    count = max(len(image), 1)
    return {
        "area_arcmin2": area,
        "detected_per_arcmin2": sum(len(tile.galaxies) for tile in tiles) / area,
        "usable_per_arcmin2": density("galaxies", "usable"),
        "usable_per_arcmin2_true_psf": density("galaxies", "true_usable"),
        "usable_per_arcmin2_stamps": density("stamps", "usable"),
        "usable_without_match": sum(int((t.galaxies.usable & (t.galaxies.index < 0)).sum()) for t in tiles) / area,
        "stamps_not_detected": lost / area,
        "stamps_detected_not_usable": faint / area,
        "pairs": len(image),
        "mean_difference_e1": float(difference.real.mean()) if len(image) else None,
        "mean_difference_e2": float(difference.imag.mean()) if len(image) else None,
        "mean_difference_error": float(np.sqrt(0.5 * (abs(difference - difference.mean()) ** 2).mean() / count))
        if len(image)
        else None,
        "response_images": slopes[0][0],
        "response_stamps": slopes[1][0],
        "response_difference": slopes[2][0],
        "response_difference_error": slopes[2][1],
        "stars": [tile.stars for tile in tiles],
    }


def _paired_ellipticities(tile: MeasuredTile) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return complex ellipticities on image and stamp, and without noise, of galaxies that are usable on all."""
    n = 1 + max((int(s.index.max(initial=-1)) for s in (tile.stamps, tile.noise_free, tile.galaxies)), default=-1)
    ellipticities = []
    for shapes, prefix in ((tile.galaxies, ""), (tile.stamps, ""), (tile.noise_free, "true_")):
        e = np.full(n, np.nan + 0j)
        rows = getattr(shapes, f"{prefix}usable") & (shapes.index >= 0)
        e[shapes.index[rows]] = (getattr(shapes, f"{prefix}e1") + 1j * getattr(shapes, f"{prefix}e2"))[rows]
        ellipticities.append(e)
    measured_thrice = np.isfinite(np.sum(ellipticities, axis=0))
    image, stamp, reference = (e[measured_thrice] for e in ellipticities)
    return image, stamp, reference


def _loss_counts(tile: MeasuredTile) -> tuple[int, int]:
    """Count the galaxies usable on stamps that are not detected, or not usable, on the image."""
    usable_on_stamps = tile.stamps.index[tile.stamps.usable]
    detected = np.isin(usable_on_stamps, tile.galaxies.index)
    good = np.isin(usable_on_stamps, tile.galaxies.index[tile.galaxies.usable])
    return int((~detected).sum()), int((detected & ~good).sum())


def _response_slope(e: np.ndarray, reference: np.ndarray) -> tuple[float | None, float | None]:
    """Return the slope of ellipticities against reference ones, both components together, and its standard error."""
    if len(e) < 2:
        return None, None
    x, y = (np.concatenate([v.real, v.imag]) for v in (reference, e))
    slope = float((x * y).sum() / (x * x).sum())
    return slope, float(np.sqrt((x**2 * (y - slope * x) ** 2).sum()) / (x * x).sum())
