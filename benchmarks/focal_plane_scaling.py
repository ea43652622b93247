"""Processor time and memory of the focal-plane PSF model against the number of stars.

Run: python benchmarks/focal_plane_scaling.py [--stars 1000,3000,7560,26460] [--results FILE] [--plot PICTURE]

Stars lie at random over the 189 CCDs of the LSST, with the shapes that its r-band optics have at heights drawn from the
budget, a random field of two anisotropic exponentials (3 by 1 and 40 by 6 arcmin, 2e-3 each) and the noise of stars of
S/N 30 to 300. The model is fitted without a telescope and with it, heights and alignment unknown, and predicts shapes
and uncertainties at ten places on each CCD. Each fit has a process of its own; what the file of results (JSON) has is
not measured again.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from pathlib import Path

import matplotlib
import numpy as np

import pachon
from pachon.core.units import ARCMIN
from pachon.reconstruction import Instrument

matplotlib.use("Agg")
# Noise of e and of ln size times the signal-to-noise ratio.
NOISE_PER_SNR = 0.5
# Random waves that stand for the field.
WAVES = 3000


def field_of(xy: np.ndarray, rms: float, along: float, across: float, angle: float, rng: np.random.Generator):
    """Return a random field of covariance rms^2 e^-r at places [m], r in units of an ellipse of lengths [m]."""
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    scale = turn / np.array([[along], [across]])
    # The spectrum of e^-r in two dimensions is that of Student's distribution of one degree of freedom.
    waves = rng.standard_normal((WAVES, 2)) / np.abs(rng.standard_normal((WAVES, 1))) @ scale
    phase = rng.uniform(0.0, 2.0 * np.pi, WAVES)
    total = np.zeros(len(xy))
    for k, p in zip(waves, phase, strict=True):
        total += np.cos(xy @ k + p)
    return rms * np.sqrt(2.0 / WAVES) * total


def stars_of(n: int, telescope: pachon.Telescope) -> pachon.FocalPlaneStars:
    """Return n synthetic stars."""
    rng, camera = np.random.default_rng(n), pachon.load_camera("lsst")
    ccd = rng.integers(0, len(camera), n)
    xy = camera.from_uv(ccd, rng.uniform(-0.98, 0.98, (n, 2)))
    plane = pachon.FocalPlane.from_budget(camera, seed=1)
    instrument = Instrument.of(telescope, [622e-9])
    values = instrument.shapes(instrument.fields(xy), plane, None)
    arcmin = 10.3 * ARCMIN  # [m]
    for shape in range(3):
        for along, across in ((3.0, 1.0), (40.0, 6.0)):
            values[:, shape] += field_of(xy, 2e-3, along * arcmin, across * arcmin, rng.uniform(0.0, np.pi), rng)
    noise = NOISE_PER_SNR / (30.0 * 10.0 ** rng.uniform(0.0, 1.0, n))
    values += noise[:, None] * rng.standard_normal(values.shape)
    names = tuple(camera.ccd_names[c] for c in ccd)
    return pachon.FocalPlaneStars(names, *xy.T, values, np.repeat(noise[:, None], 3, axis=1))


def one(n: int, with_telescope: bool, threads: int | None) -> dict[str, float]:
    """Return processor times [s], peak memory [GB] and chi-square of a fit to n stars."""
    telescope, camera = pachon.load_telescope("lsst_v3.3_r"), pachon.load_camera("lsst")
    stars = stars_of(n, telescope)
    start = time.process_time()
    model = pachon.FocalPlanePsf.fit(stars, telescope if with_telescope else None, camera=camera, threads=threads)
    fit = time.process_time() - start
    ccd = np.repeat(np.arange(len(camera)), 10)
    places = camera.from_uv(ccd, np.random.default_rng(0).uniform(-0.9, 0.9, (len(ccd), 2)))
    start = time.process_time()
    model.predict([camera.ccd_names[c] for c in ccd], *places.T, threads=threads)
    return {
        "stars": n,
        "fit": fit,
        "place": 1e3 * (time.process_time() - start) / len(ccd),
        "memory": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
        "chi2": float(np.mean(list(model.chi2.values()))),
    }


def draw(rows: dict[str, list[dict[str, float]]], path: Path) -> None:
    """Draw times and memory against the number of stars."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(9.0, 3.8))
    for label, found in rows.items():
        count = [row["stars"] for row in found]
        axes[0].loglog(count, [row["fit"] for row in found], "o-", label=label)
        axes[1].semilogx(count, [row["memory"] for row in found], "o-", label=label)
    last = rows["with the telescope"][-1]
    axes[0].loglog(count, [last["fit"] * n / count[-1] for n in count], ":", color="0.5", label="in proportion")
    axes[0].set(xlabel="stars", ylabel="processor time of the fit [s]")
    axes[1].set(xlabel="stars", ylabel="peak memory [GB]", ylim=(0.0, None))
    for each in axes:
        each.set_xticks(count, [f"{n}" for n in count])
        each.minorticks_off()
    axes[0].legend(fontsize="small")
    figure.tight_layout()
    figure.savefig(path, dpi=150)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--stars", default="1000,3000,7560,26460")
    parser.add_argument("--threads", type=int)
    parser.add_argument("--results", type=Path, default=Path("focal_plane_scaling.json"))
    parser.add_argument("--plot", type=Path, default=Path("focal_plane_scaling.png"))
    parser.add_argument("--one", choices=("0", "1"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    counts = [int(n) for n in options.stars.split(",")]
    if options.one:
        print(json.dumps(one(counts[0], options.one == "1", options.threads)))
        return
    print(f"pachon {pachon.__version__}, {os.cpu_count()} processors; processor time, predictions a place")
    print(f"{'':22s} {'stars':>8s} {'fit [s]':>9s} {'place [ms]':>11s} {'memory [GB]':>12s} {'chi2':>6s}")
    rows: dict[str, list[dict[str, float]]] = {"without a telescope": [], "with the telescope": []}
    known = json.loads(options.results.read_text()) if options.results.exists() else {}
    for n in counts:
        for which, (label, found) in enumerate(rows.items()):
            key = f"{n} {label}"
            if key not in known:
                command = [sys.executable, __file__, "--stars", str(n), "--one", str(which)]
                command += [] if options.threads is None else ["--threads", str(options.threads)]
                known[key] = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
                options.results.write_text(json.dumps(known, indent=1))
            row = known[key]
            found.append(row)
            print(
                f"{label:22s} {n:8d} {row['fit']:9.1f} {row['place']:11.2f} {row['memory']:12.2f} {row['chi2']:6.2f}",
                flush=True,
            )
    draw(rows, options.plot)
    print(f"picture: {options.plot}")


if __name__ == "__main__":
    main()
