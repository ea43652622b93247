"""Wavefronts from donuts by pachon and by danish, on images of batoid rays and GalSim photons that neither has made.

Run: python benchmarks/donuts_vs_danish.py [donuts] [--field DEG] [--second] [--photons N] [--seed N] [--no-danish]

Each donut is a perturbed LSST (r band, 620 nm): M2 and camera shifted and tilted, and Zernike terms Z4 to Z22 added to
the figure of the primary. Rays of random pupil points, each turned by the angle of a photon of a Kolmogorov profile of
0.8 arcsec, are traced by batoid to a detector 1.5 mm behind or in front of the focus and counted in pixels of 10 um,
with a sky of 300 electrons a pixel, read noise of 9 and a place within the pixel. Both fit Z4 to Z22 of what is beyond
the unperturbed, defocused telescope, on the same stamps, in turns, each on one thread; times are processor time. Errors
are the root of the sum of squares over Z4 to Z22 against batoid's Zernikes of the wavefront; for danish, whose pupil
maps are those of transverse aberrations, against batoid's Zernikes of these if they are nearer. The limit is that of
Cramer and Rao, from the photons' part of pachon's covariance. Fields are at random within 1.75 degrees, or all at
--field. With --second each stamp has a second star through the same telescope, with a hundredth to half of the light,
within 75 pixels along each axis. A donut of 5e6 photons takes some 20 s.
"""

from __future__ import annotations

import argparse
import os
import time
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import batoid
import danish
import galsim
import numpy as np
import yaml
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

import pachon

WAVELENGTH, PIXEL, SIDE = 620e-9, 10e-6, 181
DEFOCUS = 1.5e-3
OUTER, OBSCURATION = 4.18, 0.61
NOLL = np.arange(4, 23)
SEEING = 0.8  # arcsec
SKY, READ_NOISE = 300.0, 9.0
ARCSEC = np.pi / 648000.0
# Rms of the perturbations: hexapods [m], [rad], and each Zernike term of the primary's figure [m].
SHIFT, PISTON, TILT, FIGURE = 200e-6, 15e-6, 8.0 * ARCSEC, 40e-9


def perturbed(optic: batoid.Optic, rng: np.random.Generator) -> batoid.Optic:
    """Return the telescope with errors of M2, camera and the figure of M1."""
    for name in ("M2", "LSSTCamera"):
        shift = rng.normal(0.0, (SHIFT, SHIFT, PISTON))
        rx, ry = rng.normal(0.0, TILT, 2)
        optic = optic.withGloballyShiftedOptic(name, shift)
        optic = optic.withLocallyRotatedOptic(name, batoid.RotX(rx) @ batoid.RotY(ry))
    terms = np.zeros(NOLL[-1] + 1)
    terms[NOLL] = rng.normal(0.0, FIGURE, len(NOLL))
    figure = batoid.Zernike(terms, R_outer=OUTER, R_inner=OBSCURATION * OUTER)
    return optic.withSurface("M1", batoid.Sum([optic["M1"].surface, figure]))


def donut(
    optic: batoid.Optic, field: np.ndarray, electrons: int, rng: np.random.Generator, offset: ArrayLike = (0.0, 0.0)
) -> np.ndarray:
    """Return the photons of a star counted in pixels about the chief ray, on the detector of the telescope.

    The star stands aside by an offset (x, y) [pixels]; light beside the stamp is lost.
    """
    radius = OUTER * np.sqrt(rng.uniform(OBSCURATION**2, 1.0, electrons))
    angle = rng.uniform(0.0, 2.0 * np.pi, electrons)
    deviate = galsim.BaseDeviate(int(rng.integers(1, 2**31)))
    air = galsim.Kolmogorov(fwhm=SEEING).shoot(electrons, rng=deviate)
    rays = landed(optic, field, radius * np.cos(angle), radius * np.sin(angle), ARCSEC * np.stack([air.x, air.y]))
    lit = ~rays.failed & ~rays.vignetted
    chief = landed(optic, field, np.zeros(1), np.zeros(1), np.zeros((2, 1)))
    place = PIXEL * (rng.uniform(-0.5, 0.5, 2) + offset)
    edges = (np.arange(SIDE + 1) - 0.5 * SIDE) * PIXEL
    bins = [edges + chief.y[0] - place[1], edges + chief.x[0] - place[0]]
    return np.histogram2d(rays.y[lit], rays.x[lit], bins=bins)[0]


def landed(
    optic: batoid.Optic, field: np.ndarray, x: np.ndarray, y: np.ndarray, turned: np.ndarray
) -> batoid.RayVector:
    """Trace light through points of the entrance pupil [m] that the air has turned by angles [2, n] [rad]."""
    vx, vy, _ = batoid.utils.fieldToDirCos(*field, projection="zemax")
    vx, vy = vx + turned[0], vy + turned[1]
    vz = -np.sqrt(1.0 - vx**2 - vy**2)
    # From above the telescope, against the light.
    back = 15.0
    stop = optic.stopSurface.coordSys.origin[2]
    rays = batoid.RayVector(x - back * vx, y - back * vy, stop - back * vz, vx, vy, vz, 0.0, WAVELENGTH)
    return optic.trace(rays)


def zernikes(optic: batoid.Optic, field: np.ndarray, kind: str, jmax: int = 66) -> np.ndarray:
    """Return batoid's annular Zernikes of the wavefront ("opd") or of transverse aberrations ("ta") [m]."""
    common = {"projection": "zemax", "jmax": jmax, "eps": OBSCURATION}
    if kind == "opd":
        return WAVELENGTH * batoid.zernike(optic, *field, WAVELENGTH, nx=128, **common)
    return WAVELENGTH * batoid.zernikeTA(optic, *field, WAVELENGTH, nrad=20, naz=120, focal_length=10.31, **common)


@dataclass(frozen=True)
class Case:
    """A donut, and what was wrong with its telescope."""

    image: np.ndarray  #: electrons, sky subtracted
    field: np.ndarray  #: [rad]
    height: float  #: of the detector [m]
    wavefront: np.ndarray  #: Zernikes beyond the unperturbed telescope's, of the wavefront [m]
    aberrations: np.ndarray  #: the same of transverse aberrations [m]
    reference: np.ndarray  #: Zernikes of transverse aberrations of the unperturbed telescope, defocused [m]


def make_case(number: int, options: argparse.Namespace) -> Case:
    """Simulate one donut."""
    rng = np.random.default_rng([options.seed, number])
    height = DEFOCUS if number % 2 == 0 else -DEFOCUS
    nominal = batoid.Optic.fromYaml("LSST_r.yaml")
    true = perturbed(nominal, rng)
    radius = np.deg2rad(1.75 * np.sqrt(rng.uniform()) if options.field is None else options.field)
    angle = rng.uniform(0.0, 2.0 * np.pi)
    field = radius * np.array([np.cos(angle), np.sin(angle)])
    behind, far = (optic.withGloballyShiftedOptic("Detector", (0.0, 0.0, height)) for optic in (true, nominal))
    image = donut(behind, field, options.photons, rng)
    if options.second:
        ratio, offset = rng.uniform(0.01, 0.5), rng.uniform(-75.0, 75.0, 2)
        image += donut(behind, field, int(ratio * options.photons), rng, offset)
    image += rng.poisson(SKY, image.shape) - SKY + rng.normal(0.0, READ_NOISE, image.shape)
    reference = zernikes(far, field, "ta")
    wavefront = zernikes(true, field, "opd") - zernikes(nominal, field, "opd")
    return Case(image, field, height, wavefront[NOLL], (zernikes(behind, field, "ta") - reference)[NOLL], reference)


def fit_pachon(case: Case) -> pachon.sensing.DonutFit:
    """Fit a donut by pachon on one thread."""
    telescope = pachon.load_telescope("lsst_v3.3_r").perturbed("Detector", shift=(0.0, 0.0, case.height))
    variance = SKY + READ_NOISE**2
    return pachon.fit_donuts(
        telescope, case.image[None], case.field[None], WAVELENGTH, pixel_size=PIXEL, sky_variance=variance, threads=1
    )


def fit_danish(case: Case) -> np.ndarray:
    """Return the Zernikes [m] that danish fits, with the settings of its own tests."""
    mask = yaml.safe_load((Path(danish.datadir) / "RubinObsc.yaml").read_text())
    factory = danish.DonutFactory(
        R_outer=OUTER, R_inner=OBSCURATION * OUTER, mask_params=mask, focal_length=10.31, pixel_scale=PIXEL
    )
    model = danish.SingleDonutModel(
        factory,
        z_ref=case.reference,
        z_terms=tuple(NOLL),
        thx=case.field[0],
        thy=case.field[1],
        npix=SIDE,
        bkg_order=0,
    )
    nothing = [0.0] * len(NOLL)
    start = model.pack_params(flux=case.image.sum(), dx=0.0, dy=0.0, fwhm=0.7, z_fit=nothing, bkg=(0.0,))
    end = {"ftol": 1e-3, "xtol": 1e-3, "gtol": 1e-3, "max_nfev": 20}
    found = least_squares(model.chi, start, jac=model.jac, args=(case.image, SKY + READ_NOISE**2), **end)
    return np.array(model.unpack_params(found.x)["z_fit"])


def rss(values: np.ndarray) -> float:
    """Return the root of the sum of squares [nm]."""
    return 1e9 * float(np.sqrt(np.sum(np.square(values))))


def parsed() -> argparse.Namespace:
    """Return the options of the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("donuts", nargs="?", type=int, default=10)
    parser.add_argument("--field", type=float)
    parser.add_argument("--second", action="store_true")
    parser.add_argument("--photons", type=int, default=5_000_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--no-danish", action="store_true")
    return parser.parse_args()


def main() -> None:
    options = parsed()
    print(f"pachon {pachon.__version__}, danish {danish.__version__}, batoid {batoid.__version__}", end="")
    print(f", galsim {galsim.__version__}; {options.photons:g} photons, seed {options.seed}")
    fit_pachon(make_case(0, argparse.Namespace(**{**vars(options), "photons": 100_000})))  # compiles
    print(f"{'field':>6} {'height':>7} {'injected':>9} {'pachon':>7} {'limit':>6} {'chi2':>5} {'s':>6}   danish      s")
    table = []
    for number in range(options.donuts):
        case = make_case(number, options)
        start = time.process_time()
        fit = fit_pachon(case)
        row = [rss(fit.zernikes[0] - case.wavefront), rss(np.sqrt(np.diag(fit.error_parts.photons[0])))]
        row.append(time.process_time() - start)
        line = f"{np.rad2deg(np.hypot(*case.field)):6.2f} {1e3 * case.height:4.1f} mm {rss(case.wavefront):6.0f} nm"
        line += f" {row[0]:7.1f} {row[1]:6.1f} {fit.chi2[0] / case.image.size:5.3f} {row[2]:6.2f}"
        if not options.no_danish:
            start = time.process_time()
            found = fit_danish(case)
            row += [min(rss(found - truth) for truth in (case.wavefront, case.aberrations))]
            row += [time.process_time() - start]
            line += f"  {row[3]:7.1f} {row[4]:6.2f}"
        print(f"{line}  {fit.reasons[0]}", flush=True)
        table.append(row)
    columns = np.array(table).T
    print(f"\npachon: median {np.nanmedian(columns[0]):.1f}, worst {np.nanmax(columns[0]):.1f} nm", end="")
    print(f", {np.median(columns[2]):.2f} s a donut; limit {np.nanmedian(columns[1]):.1f} nm (medians)")
    if not options.no_danish:
        print(f"danish: median {np.median(columns[3]):.1f}, worst {columns[3].max():.1f} nm", end="")
        print(f", {np.median(columns[4]):.2f} s a donut: {np.median(columns[4] / columns[2]):.0f} times pachon's")


if __name__ == "__main__":
    main()
