"""Null test: shear correlation of unsheared galaxies in stacks of visits."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ...core.arguments import check_arguments
from ...core.errors import DomainError, ProductError, error_context
from ...core.files import make_folder, write_bytes, write_json
from ...core.long_work import Execution
from ...core.number_text import counted
from ...core.products import Stamp, column, read_fits, table_hdu, write_fits
from ...core.random_streams import natural_number
from ...core.units import ARCMIN
from ...imaging.exposure import Exposure
from ...imaging.galaxies import SkyGalaxies
from ...measure.catalogue.shear_calibration import ShearCalibration
from ...measure.shear.shear_shapes import ShearBias, ShearShapes
from ...measure.shear.shear_shapes import shear_bias as functional_shear_bias
from ...measure.shear.weight import weight_sigma
from ...pipeline.run_folder import CONFIG_NAME
from ...sky.galaxies import Galaxies
from ...sky.mosaic import PlantedGalaxies
from .config import STACK_STAMP, load_visits_configuration
from .galaxy_shapes import GalaxyShapes, measure_galaxies
from .null_result import AdditiveBias, NullTest, ShearBiases, null_metrics, shear_bias
from .plots import density_picture, null_test_picture
from .psf_errors import PsfAtGalaxies, PsfErrorResponse
from .psf_visit import StackFrame
from .stack import PsfStack
from .stack_exposure import faintest_galaxies, stack_exposure
from .visits import cell_of, stack_path

#: S/N of a star as faint as the faintest galaxies that are drawn: fainter ones have no useful ellipticity.
FAINTEST_SNR = 8.0
#: Largest distance of galaxies from the nearest position with a known PSF, over the mean distance of these.
REACH = 2.0
#: Patches of the jackknife over the rings.
_RING_PATCHES = 200
#: Galaxies of the response to errors of the PSF: of four hundred, most too faint for a weight, it is 10 % off.
_RESPONSE_GALAXIES = 10_000
#: Shear of the calibration.
SHEAR = 0.02
# Orientations of a ring.
_ORIENTATIONS = 4
# Rings are measured at each orientation under a shear and its opposite.
_RING_JOBS = tuple((k, sign) for k in range(_ORIENTATIONS) for sign in (1.0, -1.0))


@check_arguments
def null_test(
    folder: Path,
    *,
    tiles: int | None = None,
    rings: int = 2000,
    execution: Execution | None = None,
) -> dict[int, NullTest]:
    """Measure galaxies in the stacks of a folder of visits, and correlate their ellipticities.

    Galaxies are those of the configuration of the visits, down to the depth of each stack. The sky is cut into tiles of
    the size of a CCD; each leaves a table of its galaxies. Products are these tables,
    ``null_test.json`` and two pictures; they have the same bytes on any number of threads and by whatever workers.

    Parameters
    ----------
    folder : Path
        Folder of :func:`.stack_visits`.
    tiles : int, optional
        Most tiles, those nearest to the pointing; all by default.
    rings : int
        Rings of galaxies for the calibration of the shear.
    execution : Execution, optional
        Workers that measure the tiles, threads, whether to keep finished tiles, and progress display.

    Raises
    ------
    PachonError
        If the folder holds no stacks, galaxies cannot be read, fewer than two are usable, or a product cannot be
        written.
    """
    execution = execution or Execution()
    if not (folder / CONFIG_NAME).exists():
        raise ProductError(f"{folder}: no visits (no {CONFIG_NAME}); expected the folder of pachon visits")
    config = load_visits_configuration(folder / CONFIG_NAME)
    with error_context(file=folder / CONFIG_NAME):
        experiment = config.experiment()
    frame = StackFrame.of(experiment, STACK_STAMP)
    cell, scale = cell_of(experiment, frame), frame.pixel_scale
    seed = experiment.config.seed
    reach = REACH * float(cell / np.sqrt(config.visits.places))
    source = config.galaxy_source(experiment, Exposure.of_run(experiment, gain=1.0, pixel_scale=scale))
    make_folder(folder / "galaxies")
    tests = {}
    for visits in config.kept:
        of_list = {} if config.visits.from_list is None else {"noise": "of the list"}
        stamp = Stamp(config.galaxies_digest(experiment, stack=visits, **of_list), seed)
        stack = PsfStack.read(stack_path(folder, visits), Stamp(config.digest(experiment), seed))
        plan = config.plan_of(visits, seed)
        exposure = stack_exposure(experiment, plan, scale)
        galaxies_in = source.down_to(faintest := faintest_galaxies(experiment, plan, exposure, FAINTEST_SNR))
        covered_tiles = _covered_tiles(stack, cell, config.visits.places)[:tiles]
        if not covered_tiles:
            seen_by = counted(visits, "visit")
            raise DomainError(f"{folder}: no part of the sky as large as a CCD was seen by half of {seen_by}")
        paths = {
            (i, j): folder / "galaxies" / f"visits_{visits:04d}_tile_{i:+03d}_{j:+03d}.fits" for i, j in covered_tiles
        }
        finished = execution.finished(paths, stamp)
        todo = [tile for tile in covered_tiles if tile not in finished]
        depth = _StackMeasurement(stack, frame.matrix, exposure, galaxies_in, seed, cell, reach)
        # Of the tile of the pointing, to which those of others are alike.
        tile_size = max(1, len(depth.galaxies_of(covered_tiles[0])))
        ring_count = len(depth.first_galaxies(covered_tiles, rings))
        execution.reporter.line(
            f"{counted(visits, 'visit')}: {counted(len(todo), 'tile')} of about {tile_size} galaxies, "
            f"{len(_RING_JOBS)} times {counted(ring_count, 'ring galaxy', 'ring galaxies')}"
        )
        with execution.results(
            measure_job,
            [*(paths[tile].stem for tile in todo), *(f"ring {k}, shear {sign:+.0f}" for k, sign in _RING_JOBS)],
            depth.jobs(todo, covered_tiles, rings),
            title=f"galaxies in {counted(visits, 'visit')}",
            sizes=[tile_size] * len(todo) + [max(1, ring_count)] * len(_RING_JOBS),
        ) as results:
            for tile in todo:
                write_shapes(paths[tile], next(results), stamp)
            measured_rings = list(results)
        # Read from the files, as by a resumed test, so that both have the same numbers.
        parts = [read_shapes(path, stamp) for path in paths.values()]
        if (n := sum(int(shapes.usable_twice.sum()) for shapes in parts)) < 2:
            galaxies = counted(sum(map(len, parts)), "galaxy", "galaxies")
            text = f"{n} of {galaxies} to magnitude {faintest:.2f} usable in {counted(visits, 'visit')}"
            raise DomainError(f"{folder}: {text}; expected two or more, of the galaxies of {CONFIG_NAME}")
        with execution.reporter.stage(f"correlations in {counted(visits, 'visit')}"):
            psfs = PsfAtGalaxies.of(stack, GalaxyShapes.joined(parts), depth.psf_error_response(covered_tiles))
            biases = ShearBiases(
                _calibration(frame.matrix, ring_count, measured_rings),
                _shear_calibration(frame.matrix, ring_count, measured_rings),
                AdditiveBias.of(psfs, parts),
            )
            area = len(covered_tiles) * (cell / ARCMIN) ** 2
            tests[visits] = NullTest.of(visits, parts, area, biases, psfs)
    write_json(folder / "null_test.json", {"stacks": {str(n): null_metrics(r) for n, r in tests.items()}})
    write_pictures(folder, tests)
    return tests


def write_pictures(folder: Path, results: dict[int, NullTest]) -> None:
    """Write the pictures of null tests: correlations (Fig. 17), and their amplitude against density (Fig. 18)."""
    write_bytes(folder / "null_test.png", null_test_picture(results))
    write_bytes(folder / "null_test_density.png", density_picture(results))


def _covered_tiles(stack: PsfStack, cell: float, places: int) -> list[tuple[int, int]]:
    """Return the tiles in which at least three quarters of the places are known, from the pointing outwards."""
    is_place = ~stack.star
    corner = np.floor(np.stack([stack.xi, stack.eta], axis=1)[is_place] / cell + 0.5).astype(int)
    tiles, count = np.unique(corner, axis=0, return_counts=True)
    covered_tiles = [(int(i), int(j)) for (i, j), n in zip(tiles, count, strict=True) if n >= 0.75 * places]
    return sorted(covered_tiles, key=lambda tile: (tile[0] ** 2 + tile[1] ** 2, tile))


def _tile_ranges(tile: tuple[int, int], cell: float) -> list[tuple[float, float]]:
    """Return the ranges of xi and eta of a tile [rad]."""
    return [(cell * (k - 0.5), cell * (k + 0.5)) for k in tile]


@dataclass(frozen=True, eq=False)
class _StackMeasurement:
    """Stack of a number of visits, and the galaxies that are measured in it."""

    stack: PsfStack
    axes: np.ndarray
    exposure: Exposure
    galaxies_in: SkyGalaxies
    seed: int
    cell: float
    reach: float

    @cached_property
    def sigma(self) -> float:
        """Rms width of the weight of the shear [rad], that of the whole stack on each of its tiles."""
        return weight_sigma(None, self.stack.true[~self.stack.star], self.exposure.pixel_scale)

    def jobs(self, todo: list[tuple[int, int]], tiles: list[tuple[int, int]], rings: int) -> Iterator[dict[str, Any]]:
        """Yield the arguments of :func:`measure_galaxies` for tiles, and then for the rings of all tiles."""
        for tile in todo:
            key: tuple[str | int, ...] = ("null test", self.stack.visits, *map(natural_number, tile))
            yield self._job(self.galaxies_of(tile), key)
        galaxies = self.first_galaxies(tiles, rings)
        shear = SHEAR * _shear_along_diagonal(len(galaxies))
        for k, sign in _RING_JOBS:
            rotated = galaxies.rotated(np.pi * k / _ORIENTATIONS)
            sheared = rotated.sheared(sign * shear.real, sign * shear.imag)
            yield self._job(sheared, ("shear", self.stack.visits, k))

    def galaxies_of(self, tile: tuple[int, int]) -> Galaxies | PlantedGalaxies:
        """Return the galaxies of a tile."""
        return self.galaxies_in(*_tile_ranges(tile, self.cell))

    def first_galaxies(self, tiles: list[tuple[int, int]], count: int) -> Galaxies | PlantedGalaxies:
        """Return so many galaxies, those of the first tiles that have them."""
        parts = [self.galaxies_of(tiles[0])]
        for tile in tiles[1:]:
            if sum(map(len, parts)) >= count:
                break
            parts.append(self.galaxies_of(tile))
        kind: Any = type(parts[0])
        galaxies = kind.concatenate(parts)
        return galaxies.take(np.arange(min(count, len(galaxies))))

    def psf_error_response(self, tiles: list[tuple[int, int]]) -> PsfErrorResponse:
        """Return the response of the shear of galaxies, each beside itself at 90 degrees, to errors of the PSF."""
        galaxies = self.first_galaxies(tiles, _RESPONSE_GALAXIES)
        kind: Any = type(galaxies)
        pairs = kind.concatenate([galaxies, galaxies.rotated(0.5 * np.pi)])
        return PsfErrorResponse.of(
            self.stack, pairs, self.axes, self.exposure, self.seed, "PSF errors", self.stack.visits
        )

    def _job(self, galaxies: Any, key: tuple[str | int, ...]) -> dict[str, Any]:
        at = np.stack([galaxies.xi, galaxies.eta], axis=1) @ self.axes.T * self.exposure.pixel_scale
        return {
            "stack": self.stack.around(at, 1.001 * self.reach) if len(at) else self.stack,
            "axes": self.axes,
            "galaxies": galaxies,
            "exposure": self.exposure,
            "seed": self.seed,
            "key": key,
            "reach": self.reach,
            "sigma": self.sigma,
        }


def measure_job(job: dict[str, Any], threads: int) -> GalaxyShapes:
    """Measure galaxies as the job of a worker."""
    return measure_galaxies(
        job["stack"],
        job["axes"],
        job["galaxies"],
        job["exposure"],
        job["seed"],
        *job["key"],
        reach=job["reach"],
        sigma=job["sigma"],
        threads=threads,
    )


def _shear_along_diagonal(n: int) -> np.ndarray:
    """Return the directions of the shear of n galaxies: every other one along x = y."""
    return np.where(np.arange(n) % 2 == 0, 1.0, 1j)


def _calibration(axes: np.ndarray, n: int, measured: list[GalaxyShapes]) -> dict[str, ShearCalibration]:
    """Return the biases of the shear from n rings of galaxies, each under a shear and its opposite, with one noise."""
    along = {kind: np.full((2, n, _ORIENTATIONS), np.nan + 0j) for kind in ("model", "true")}
    for (k, sign), shapes in zip(_RING_JOBS, measured, strict=True):
        for kind, prefix in (("model", ""), ("true", "true_")):
            e1, e2, usable = (getattr(shapes, prefix + name) for name in ("e1", "e2", "usable"))
            along[kind][int(sign < 0.0), shapes.index[usable], k] = (e1 + 1j * e2)[usable]
    # Ellipticities are along the axes of the stack, the shear along those of the sky.
    return {kind: shear_bias(e, ellipticity_along(axes, SHEAR * _shear_along_diagonal(n))) for kind, e in along.items()}


def _shear_calibration(axes: np.ndarray, n: int, measured: list[GalaxyShapes]) -> dict[str, ShearBias]:
    """Return the biases of the shear of the functionals from the same rings, along the axes of the stack.

    Rings are joined in patches of one direction of the shear.
    """
    pairs = max(1, min(_RING_PATCHES, n) // 2)
    patch = 2 * (np.arange(n) * pairs // n) + np.arange(n) % 2
    if n < 2 * pairs or len(np.unique(patch)) < 2:
        return {}
    shear = ellipticity_along(axes, SHEAR * _shear_along_diagonal(2)[np.unique(patch) % 2])
    biases = {}
    for kind, name in (("model", "shear"), ("true", "true_shear")):
        sides = [
            [shapes for (_, sign), shapes in zip(_RING_JOBS, measured, strict=True) if sign == side]
            for side in (1.0, -1.0)
        ]
        plus, minus = (ShearShapes.joined([getattr(shapes, name) for shapes in side]) for side in sides)
        labels, minus_labels = (patch[np.concatenate([shapes.index for shapes in side])] for side in sides)
        biases[kind] = functional_shear_bias(
            plus, minus, shear.real, shear.imag, patch=labels, minus_patch=minus_labels
        )
    return biases


def ellipticity_along(axes: np.ndarray, e: np.ndarray) -> np.ndarray:
    """Return ellipticities e1 + i e2 along xi, eta in the axes of the stack, rotated or mirrored by a matrix."""
    along_sky = e if np.linalg.det(axes) > 0.0 else np.conj(e)
    return np.asarray(along_sky * np.exp(2j * np.arctan2(axes[1, 0], axes[0, 0])))


_COLUMNS = {
    "index": (1.0, "", "among the galaxies of the tile"),
    "x": (ARCMIN, "arcmin", "along x of the stack"),
    "y": (ARCMIN, "arcmin", "along y of the stack"),
    "magnitude": (1.0, "mag", "AB magnitude"),
    "e1": (1.0, "", "(a-b)/(a+b) along x, PSF of models"),
    "e2": (1.0, "", "along x = y, PSF of the models"),
    "error": (1.0, "", "standard error of a component"),
    "usable": (1.0, "", "whether it is fit for shear"),
    "true_e1": (1.0, "", "ellipticity with the true PSF"),
    "true_e2": (1.0, "", "ellipticity with the true PSF"),
    "true_usable": (1.0, "", "whether it is fit for shear with it"),
}


_SHEAR_COLUMNS = {
    "e1": "weighted M1/(M0 + C) along x",
    "e2": "weighted M2/(M0 + C) along x = y",
    "r11": "response of e1 to g1",
    "r12": "mean response of e1 to g2, e2 to g1",
    "r22": "response of e2 to g2",
    "weight": "of the selection by S/N",
    "snr": "S/N of M0",
}


def write_shapes(path: Path, galaxies: GalaxyShapes, stamp: Stamp) -> None:
    """Write galaxies as a FITS table."""
    columns = {
        name.upper(): (getattr(galaxies, name) / unit if unit != 1.0 else getattr(galaxies, name), text, description)
        for name, (unit, text, description) in _COLUMNS.items()
    }
    for kind in ("shear", "true_shear"):
        for name, description in _SHEAR_COLUMNS.items():
            columns[f"{kind}_{name}".upper()] = getattr(getattr(galaxies, kind), name), "", description
    write_fits(path, [table_hdu("GALAXIES", columns)], stamp, [])


def read_shapes(path: Path, stamp: Stamp) -> GalaxyShapes:
    """Return the galaxies of a finished tile; ProductError for a damaged one or one of another configuration."""
    table = read_fits(path, stamp)["GALAXIES"]
    columns = {name: column(table, name.upper()) for name in _COLUMNS}
    shears = {
        kind: ShearShapes(*(column(table, f"{kind}_{name}".upper()) for name in _SHEAR_COLUMNS))
        for kind in ("shear", "true_shear")
    }
    scaled: dict[str, Any] = {n: v * _COLUMNS[n][0] if _COLUMNS[n][0] != 1.0 else v for n, v in columns.items()}
    shapes = GalaxyShapes(**scaled, shear=shears["shear"], true_shear=shears["true_shear"])
    for name in ("x", "y", "magnitude", "e1", "e2", "error", "true_e1", "true_e2"):
        if not np.isfinite(getattr(shapes, name)[shapes.usable_twice]).all():
            raise ProductError(f"{name.upper()} of usable galaxies is not finite; delete it, and go on", file=path)
    return shapes
