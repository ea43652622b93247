"""Error of CCD heights learnt from the stars of 1, 3, 10, 30 and 100 exposures.

Run: python benchmarks/heights_from_exposures.py FOLDER [--heights budget|lsstcam] [--exposures 1,3,10,30,100]

The LSST at 622 nm, 27 CCDs in three neighbouring rafts, 40 observed stars of S/N 30 and more on each; every exposure
has turbulence, wind, noise and alignment (0.2 um rms) of its own. Exposures that FOLDER lacks are made, and what is
there is kept, so that the benchmark can be stopped and goes on. True heights are drawn from the height budget, which is
then the prior; or those of LSSTCam as built, with a prior that hardly holds them.

Errors are rms over the area of the CCDs, less a plane and a mean height, which are the focus and the tilt of the
exposures; those of the means of CCDs likewise. The predicted error is that of the fit's own covariance.
"""

import argparse
import resource
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from astropy.table import Table

import pachon
from pachon.core.units import ARCSEC
from pachon.models.camera.camera import Camera
from pachon.pipeline.config import Configuration
from pachon.pipeline.experiment import Experiment
from pachon.pipeline.focal_plane_stage import instrument_of
from pachon.pipeline.simulate.ccd_exposure import ccd_stars, expose_positions
from pachon.pipeline.simulate.ccd_observation import observe_ccd
from pachon.reconstruction.focal_plane_psf.covariance import Places
from pachon.reconstruction.focal_plane_psf.heights import STATIC_DEGREE, HeightPrior
from pachon.reconstruction.focal_plane_psf.stars import CcdStars, FocalPlaneStars

matplotlib.use("Agg")
RAFTS = ("R22", "R23", "R33")
STARS, SEED, ALIGNMENT_UM = 40, 1, 0.2
# Light to three rafts crosses 690 m of the highest layer in 15 s; samples are those of a whole run, 0.16 m.
SCREEN_M, SCREEN_SAMPLES = 691.2, 4320
# Numbers of exposures for which the error is predicted from those that are there.
BEYOND = (30, 100)
# Nodes along a side of a CCD at which errors are taken, and the goal.
NODES, GOAL_UM = 10, 0.3


def experiment_of(heights: str, epoch: int) -> Experiment:
    """Return the experiment of one exposure."""
    names = [n for n in pachon.load_camera("lsst").ccd_names if n.startswith(RAFTS)]
    config = Configuration.model_validate(
        {
            "ccds": names,
            "seed": SEED,
            "stars": {"observed": STARS},
            "wavelengths_nm": [622.0],
            "focal_plane": {} if heights == "budget" else {"heights": heights},
            "active_optics": {"residual_um": ALIGNMENT_UM},
            "atmosphere": {"epoch": epoch, "screen_length_m": SCREEN_M, "screen_size": SCREEN_SAMPLES},
        }
    )
    return Experiment.from_config(config)


def observed_stars(experiment: Experiment, threads: int | None) -> FocalPlaneStars:
    """Return the observed stars of an exposure."""
    names = experiment.config.ccds or ()
    with experiment.screens(threads):
        fields = [ccd_stars(experiment, name, 0.6 * ARCSEC) for name in names]
        pixels = [f.observed_pixel * (f.ccd.pixel_size / experiment.pixel_size) for f in fields]
        offsets = np.concatenate([p - np.rint(p) for p in pixels])
        xy = np.concatenate([f.observed for f in fields])
        images = expose_positions(experiment, xy, threads, room=10, offsets=offsets)
    found = []
    for i, (name, field) in enumerate(zip(names, fields, strict=True)):
        rows = slice(i * STARS, (i + 1) * STARS)
        electrons = field.electrons * images.lit_fraction[rows]
        seen = observe_ccd(experiment, name, images.image[rows], images.pixel_scale, electrons, noisy=True)
        x, y = field.observed.T
        found.append(CcdStars(name, x, y, seen.shapes, electrons, seen.noise, seen.images, seen.used))
    return FocalPlaneStars.of_ccds(found, images.pixel_scale, experiment.weight_fwhm)


def exposure_files(folder: Path, heights: str, count: int, threads: int | None) -> list[Path]:
    """Return tables of the stars of exposures, of which those that are missing are made."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"exposure_{epoch:03d}.fits" for epoch in range(count)]
    for epoch, path in enumerate(paths):
        if path.exists():
            continue
        start = time.process_time()
        stars = observed_stars(experiment_of(heights, epoch), threads)
        table = Table({"ccd": np.array(stars.ccd), "x": stars.x, "y": stars.y})
        for i, name in enumerate(("e1", "e2", "size")):
            table[name] = stars.values[:, i] if i < 2 else np.exp(stars.values[:, i])
            table[f"{name}_noise"] = stars.noise[:, i]
        temporary = path.with_suffix(".part")
        table.write(temporary, format="fits", overwrite=True)
        temporary.rename(path)
        print(f"{path.name}: {len(stars)} stars, {time.process_time() - start:.1f} s", flush=True)
    return paths


def three_rafts() -> Camera:
    """Return the camera of the chosen rafts alone, so that no CCD without stars costs time."""
    whole = pachon.load_camera("lsst")
    keep = [i for i, name in enumerate(whole.ccd_names) if name.startswith(RAFTS)]
    rafts = np.array([RAFTS.index(whole.raft_of[i]) for i in keep])
    names = tuple(whole.ccd_names[i] for i in keep)
    pixels = whole.pixels[keep]
    return Camera("three rafts", names, RAFTS, rafts, whole.centers[keep], pixels, whole.pixel_size, transposed=True)


def nodes_of(camera: Camera) -> Places:
    """Return the middles of the cells of a grid over each CCD."""
    axis = (np.arange(NODES) + 0.5) / (0.5 * NODES) - 1.0
    v, u = (a.ravel() for a in np.meshgrid(axis, axis, indexing="ij"))
    uv = np.tile(np.stack([u, v], axis=1), (len(camera), 1))
    ccd = np.repeat(np.arange(len(camera)), NODES**2)
    return Places(camera.from_uv(ccd, uv), ccd, uv)


def without_plane(values: np.ndarray, places: Places) -> np.ndarray:
    """Return values at places [n, ...] less the plane that fits them best."""
    terms = np.linalg.qr(np.column_stack([np.ones(len(places)), places.xy]))[0]
    return values - terms @ (terms.T @ values)


def of_ccds(values: np.ndarray) -> np.ndarray:
    """Return the means over CCDs of values at the nodes [n, ...]."""
    return values.reshape(-1, NODES**2, *values.shape[1:]).mean(axis=1)


def rms(values: np.ndarray) -> float:
    """Return the root of the mean square, in um."""
    return 1e6 * float(np.sqrt((values**2).mean()))


class Kept:
    """A map, over processes, that keeps the normal equations of the last step."""

    def __init__(self, over: Callable[..., Iterable[Any]]) -> None:
        self.map = over

    def __call__(self, job: Callable[..., Any], jobs: Sequence[Any]) -> Iterator[Any]:
        self.parts: list[Any] = []
        for part in self.map(job, jobs):
            self.parts.append(part)
            yield part

    def predicted(self, prior: HeightPrior, places: Places, times: float = 1.0) -> np.ndarray:
        """Return a root of the covariance of heights at places less a plane, [n, n_parameter], of `times` as many."""
        matrix = np.zeros((prior.n_parameter, prior.n_parameter))
        for part in self.parts:
            part.add_to(matrix, np.zeros(prior.n_parameter))
        matrix *= times
        prior.add_to(matrix)
        scale = 1.0 / np.sqrt(np.diagonal(matrix))
        root = np.linalg.cholesky(matrix * scale[:, None] * scale)
        own = (
            np.repeat(np.eye(len(prior.camera)), NODES**2, axis=0)[:, :, None] * prior.ccd_polynomials(places)[:, None]
        )
        terms = np.concatenate([prior.common_terms(places), own.reshape(len(places), -1)], axis=1)
        return without_plane(np.linalg.solve(root, (terms * scale).T).T, places)


def one_row(
    paths: list[Path], heights: str, folder: Path, steps: int, threads: int | None, kept: Kept
) -> dict[str, float]:
    """Return errors of the heights from some exposures."""
    experiment, camera = experiment_of(heights, 0), three_rafts()
    budget = "simulated" if heights == "budget" else None
    start = time.perf_counter()
    found = pachon.reconstruction.fit_static_heights(
        paths,
        instrument_of(experiment),
        camera=camera,
        # The mean of the air near the ground over an exposure is a wavefront as well.
        prior=pachon.reconstruction.OpticsPrior(budget, float(np.hypot(ALIGNMENT_UM, 0.1)) * 1e-6),
        folder=folder,
        steps=steps,
        threads=threads,
        map_jobs=kept,
    )
    seconds = time.perf_counter() - start
    if budget is None:
        prior = HeightPrior.uninformative(camera, degree=STATIC_DEGREE)
    else:
        prior = HeightPrior.from_budget(camera, budget, STATIC_DEGREE)
    places = nodes_of(camera)
    truth = without_plane(experiment.focal_plane.height(*places.xy.T), places)
    left = without_plane(found.focal_plane.height(*places.xy.T), places) - truth
    root = kept.predicted(prior, places)
    found.write(folder.parent / f"heights_{len(paths):03d}.fits")
    return {
        "exposures": len(paths),
        "heights": rms(truth),
        "error": rms(left),
        "predicted": rms(root) * np.sqrt(root.shape[1]),
        "means": rms(of_ccds(left)),
        "predicted_means": rms(of_ccds(root)) * np.sqrt(root.shape[1]),
        "slope": float((left + truth) @ truth / (truth @ truth)),
        "median": 1e6 * float(np.median(np.sqrt((left.reshape(len(camera), -1) ** 2).mean(axis=1)))),
        "seconds": seconds,
        **{f"predicted_{n}": predicted_of(kept, prior, places, n / len(paths)) for n in BEYOND},
    }


def predicted_of(kept: Kept, prior: HeightPrior, places: Places, times: float) -> float:
    """Return the predicted error of `times` as many exposures that say as much each [um]."""
    root = kept.predicted(prior, places, times)
    return rms(root) * float(np.sqrt(root.shape[1]))


def draw(table: Table, path: Path) -> None:
    """Draw the errors against the number of exposures."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6.0, 4.2))
    count = np.asarray(table["exposures"])
    for column, label, style in (
        ("error", "error, less a plane", "C0o-"),
        ("predicted", "predicted", "C0--"),
        ("means", "error of the means of CCDs", "C1s-"),
        ("predicted_means", "predicted", "C1--"),
    ):
        axes.loglog(count, table[column], style, label=label)
    further = {n: table[f"predicted_{n}"][-1] for n in BEYOND if n > count[-1]}
    last = [count[-1], *further], [table["predicted"][-1], *further.values()]
    if further:
        axes.loglog(*last, "C0:", label="predicted for more exposures like these")
    count = np.concatenate([count, list(further)])
    axes.axhline(GOAL_UM, color="0.5", linewidth=0.8, label="goal after 100 exposures")
    axes.axhline(table["heights"][0], color="0.5", linewidth=0.8, linestyle="-.", label="heights themselves")
    axes.set(xlabel="exposures", ylabel="rms [um]", xticks=count, xticklabels=[f"{c:g}" for c in count])
    ticks = [0.1, 0.2, 0.3, 0.5, 1.0, 2.0, 3.0, 5.0]
    axes.set(ylim=(0.04, 6.0), yticks=ticks, yticklabels=[f"{v:g}" for v in ticks])
    axes.minorticks_off()
    axes.legend(fontsize="x-small", loc="lower left")
    figure.tight_layout()
    figure.savefig(path, dpi=150)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--heights", choices=("budget", "lsstcam"), default="budget")
    parser.add_argument("--exposures", default="1,3,10,30,100")
    parser.add_argument("--steps", type=int, default=2, help="Gauss-Newton steps")
    parser.add_argument("--threads", type=int, help="of each process")
    parser.add_argument("--workers", type=int, default=1, help="processes of the fit")
    parser.add_argument("--plot", type=Path, help="picture; by default in FOLDER")
    options = parser.parse_args()
    counts = [int(n) for n in options.exposures.split(",")]
    folder = options.folder / options.heights
    paths = exposure_files(folder / "stars", options.heights, max(counts), options.threads)
    rows: list[dict[str, float]] = []
    columns = ("exposures", "heights", "error", "predicted", "means", "predicted_means", "slope", "median", "seconds")
    print(" ".join(f"{name:>15s}" for name in columns))
    with ProcessPoolExecutor(options.workers, get_context("spawn")) as pool:
        kept = Kept(pool.map if options.workers > 1 else map)
        for count in counts:
            rows.append(one_row(paths[:count], options.heights, folder / "fits", options.steps, options.threads, kept))
            print(" ".join(f"{rows[-1][name]:15.3f}" for name in columns), flush=True)
    table = Table(rows)
    table.write(folder / "errors.ecsv", overwrite=True)
    draw(table, options.plot or folder / "errors.png")
    print(f"pachon {pachon.__version__}, peak {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.1f} GiB")


if __name__ == "__main__":
    main()
