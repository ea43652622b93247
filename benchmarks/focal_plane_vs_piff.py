"""The focal-plane PSF model beside Piff's interpolations, on the same stars, at positions without stars.

Run: python benchmarks/focal_plane_vs_piff.py RUN [--limit SECONDS] [--threads N] [--only TEXT]

RUN is the folder of `pachon run`, best of neighbouring CCDs. Errors are those of e1, e2 and ln size at its holdout
positions; times are of the processor. Piff's Gaussian process is dense: its anisotropic fit bootstraps two-point
functions of all pairs, and what takes longer than the limit is stopped and said so. Piff interpolates

- the measured e1, e2 and ln size, as pachon does, with the same noise: polynomials (BasisPolynomial) of each CCD and of
  the whole field; Gaussian processes (GPInterp) over the field with each of its optimizers: isotropic and anisotropic
  two-point functions and maximum likelihood, squared exponential, von Karman and exponential kernels, and sums;
- parameters of a Kolmogorov profile fitted to the pixels by Piff itself (GSObjectModel), drawn and measured;
- pixels of each CCD (PixelGrid) by polynomials.

Of all these settings the best *at the holdout positions* counts as Piff's, more than a user of Piff could know.
"""

import argparse
import signal
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import galsim
import numpy as np
import piff
from focal_plane_psf import RunStars
from psf_model_vs_piff import draw_piff, fit_piff, piff_stars, residuals

import pachon
from pachon import measure_shapes
from pachon.pipeline.focal_plane_stage import fit_focal_plane_model

# Angle on the sky of a metre of the detector, nearly: Piff's coordinates are arcsec.
ARCSEC_PER_METRE = 0.2 / 10e-6
KERNELS = (
    ("isotropic", "RBF(300.)"),
    ("isotropic", "VonKarman(300.)"),
    ("anisotropic", "AnisotropicRBF(scale_length=[300., 300.])"),
    ("anisotropic", "AnisotropicVonKarman(scale_length=[300., 300.])"),
    ("likelihood", "RBF(300.)"),
    ("likelihood", "VonKarman(300.)"),
    ("likelihood", "AnisotropicVonKarman(scale_length=[300., 300.])"),
    ("likelihood", "Matern(300., nu=0.5)"),
    ("likelihood", "Matern(180., nu=0.5) + {v} * Matern(1000., nu=0.5)"),
)


class OverLimitError(Exception):
    """A fit takes longer than it may."""


def timed(job: Callable[[], np.ndarray], limit: float) -> tuple[np.ndarray | None, float]:
    """Return what a job finds and its processor time [s]; None where it is stopped."""

    def stop(*_):
        raise OverLimitError

    signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, limit)
    start = time.process_time()
    try:
        return job(), time.process_time() - start
    except (OverLimitError, np.linalg.LinAlgError, ValueError, RuntimeError) as error:
        if not isinstance(error, OverLimitError):
            print(f"    {type(error).__name__}: {' '.join(str(error).split())[:150]}")
        return None, time.process_time() - start
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)


def target(u: float, v: float) -> piff.Star:
    return piff.Star.makeTarget(u=u, v=v, x=u, y=v, stamp_size=8, scale=1.0)


def interpolated(interp, places, values, noise, at) -> np.ndarray:
    """Return values at places by one of Piff's interpolations."""
    stars = []
    for (u, v), p, n in zip(places, values, noise, strict=True):
        fit = piff.StarFit(params=p, params_var=n**2)
        if isinstance(interp, piff.BasisInterp):
            # Its linear equations are of what is to be added to the parameters.
            fit = piff.StarFit(params=np.zeros(len(p)), params_var=n**2, A=np.diag(1.0 / n), b=p / n)
        stars.append(piff.Star(target(u, v).data, fit))
    stars = interp.initialize(stars)
    interp.solve(stars)
    return np.array([s.fit.params for s in interp.interpolateList([target(u, v) for u, v in at])])


def by_ccd(run: RunStars, order: int) -> np.ndarray:
    """Return shapes at holdout positions by Piff's polynomials of each CCD."""
    found = np.full(run.truth.shape, np.nan)
    for ccd in dict.fromkeys(run.names):
        s, h = np.array(run.stars.ccd) == ccd, np.array(run.names) == ccd
        here, there = (np.stack([o.x[k], o.y[k]], axis=1) for o, k in ((run.stars, s), (run, h)))
        middle = here.mean(axis=0)
        places = (here - middle) / 0.02, (there - middle) / 0.02
        interp = piff.BasisPolynomial(order)
        found[h] = interpolated(interp, places[0], run.stars.values[s], run.stars.noise[s], places[1])
    return found


def by_gp(run: RunStars, optimizer: str, kernel: str) -> np.ndarray:
    """Return shapes at holdout positions by a Gaussian process over the field."""
    here, there = (np.stack([o.x, o.y], axis=1) * ARCSEC_PER_METRE for o in (run.stars, run))
    kernels = [kernel_of(kernel, v) for v in run.stars.values.var(axis=0)]
    return interpolated(gp(optimizer, kernels), here, run.stars.values, run.stars.noise, there)


def kernel_of(kernel: str, variance: float) -> str:
    """Return a kernel of some amplitude."""
    first, *others = kernel.split(" + ")
    return " + ".join([f"{0.5 * variance:.3e} * {first}", *(o.format(v=f"{0.5 * variance:.3e}") for o in others)])


def gp(optimizer: str, kernels: list[str]) -> piff.GPInterp:
    """Return Piff's Gaussian process; pairs up to 20 arcmin, where turbulence has most of its correlation."""
    least = 0.0 if optimizer == "anisotropic" else 30.0
    return piff.GPInterp(
        kernel=kernels, optimizer=optimizer, normalize=True, max_sep=1200.0, min_sep=least, nbins=21, l0=600.0
    )


def by_profile(run: RunStars, optimizer: str, kernel: str) -> np.ndarray:
    """Return shapes at holdout positions of Kolmogorov profiles that Piff fits to the pixels of the stars."""
    wcs = galsim.PixelScale(0.2)
    fitted = []
    for product in run.products:
        offset = np.rint(np.array(product.center) / 10e-6).astype(int)
        for star in piff_stars(product):
            image, weight = star.image.copy(), star.weight.copy()
            for each in (image, weight):
                each.shift(galsim.PositionI(*offset))
                each.wcs = wcs
            data = piff.StarData(image, image.true_center, weight)
            fitted.append(piff.Star(data, None))
    model = piff.Kolmogorov(centered=True)
    fitted = [model.fit(model.initialize(star)) for star in fitted]
    params = np.array([s.fit.params for s in fitted])
    noise = np.sqrt(np.array([s.fit.params_var for s in fitted]))
    here = np.array([[s.data["u"], s.data["v"]] for s in fitted])
    there = np.stack([run.x, run.y], axis=1) * ARCSEC_PER_METRE
    kernels = [kernel_of(kernel, v) for v in params.var(axis=0)]
    at = interpolated(gp(optimizer, kernels), here, params, noise, there)
    images = []
    for scale, g1, g2 in at:
        profile = galsim.Kolmogorov(half_light_radius=1.0).dilate(scale).shear(g1=g1, g2=g2)
        images.append(profile.drawImage(nx=31, ny=31, scale=0.2, method="auto").array)
    shapes = measure_shapes(np.array(images), run.products[0].pixel_scale, run.experiment.weight_fwhm)
    return np.stack([shapes.e1, shapes.e2, np.log(shapes.size)], axis=1)


def by_pixels(run: RunStars, order: int) -> np.ndarray:
    """Return shapes at holdout positions of Piff's pixel grids, interpolated by polynomials of each CCD."""
    left = []
    for product in run.products:
        model = fit_piff(piff_stars(product), 25, order)
        left.append(residuals(draw_piff(model, product, product.observed_images.shape[1]), product))
    e1, e2, size = np.concatenate(left, axis=1)
    return run.truth + np.stack([e1, e2, np.log1p(size)], axis=1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--limit", type=float, default=600.0, help="processor time that each fit may take [s]")
    parser.add_argument("--threads", type=int, help="threads of pachon")
    parser.add_argument("--only", default="", help="cases whose name has this text")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    run = RunStars.read(options.run)
    print(f"pachon {pachon.__version__}, Piff {piff.__version__}, {len(run.products)} CCDs, {len(run.stars)} stars")
    print(f"{'rms [1e-3]':64s} {'e1':>7s} {'e2':>7s} {'ln size':>8s} {'time':>8s}")
    best = np.full(3, np.inf)
    fastest = np.inf

    def show(label: str, job: Callable[[], np.ndarray]) -> tuple[np.ndarray, float]:
        found, seconds = timed(job, options.limit)
        if found is None:
            print(f"{label:64s} {'no result':>24s} {seconds:6.1f} s", flush=True)
            return np.full(3, np.inf), seconds
        error = 1e3 * np.sqrt(((found - run.truth) ** 2).mean(axis=0))
        print(f"{label:64s} " + " ".join(f"{v:7.3f}" for v in error) + f" {seconds:8.1f} s", flush=True)
        return error, seconds

    cases: list[tuple[str, Callable[[], np.ndarray]]] = []
    for order in range(4):
        cases.append((f"shapes, polynomial of order {order} of each CCD", lambda o=order: by_ccd(run, o)))
    for optimizer, kernel in KERNELS:
        name = kernel.split("(")[0] + (" (2)" if "+" in kernel else "")
        cases.append((f"shapes, GP, {name}, {optimizer}", lambda o=optimizer, k=kernel: by_gp(run, o, k)))
    optimizer, kernel = "likelihood", "Matern(300., nu=0.5)"
    cases.append(("Kolmogorov profile, GP, Matern, likelihood", lambda: by_profile(run, optimizer, kernel)))
    for order in (1, 2):
        cases.append((f"pixels, polynomial of order {order} of each CCD", lambda o=order: by_pixels(run, o)))
    for label, job in cases:
        if options.only not in label:
            continue
        error, seconds = show(f"Piff, {label}", job)
        if error.sum() < best.sum():
            best, fastest = error, seconds
    for label, telescope, heights in (
        ("without telescope", False, None),
        ("heights unknown", True, None),
        ("heights known", True, run.experiment.focal_plane),
    ):

        def ours(telescope=telescope, heights=heights) -> np.ndarray:
            model = fit_focal_plane_model(
                run.experiment, run.stars, heights, telescope=telescope, components=0, threads=options.threads
            )
            shapes = model.shapes(run.names, run.x, run.y)
            return np.stack([shapes.e1, shapes.e2, np.log(shapes.size)], axis=1)

        error, seconds = show(f"pachon, {label}", ours)
        ratio = " ".join(f"{v:7.2f}" for v in best / error)
        print(f"{'    the best of Piff over pachon':64s} {ratio} {fastest / seconds:8.2f}", flush=True)


if __name__ == "__main__":
    main()
