"""A pair of real AuxTel donuts, M2 moved by 0.8 mm to one side and the other: by pachon and by danish.

Run: python benchmarks/auxtel_pair.py FOLDER [--no-danish]

FOLDER is that of danish's tests (``danish-1.3.0/tests`` of the source distribution); ``data/AuxTelTestDonuts.pkl`` has
two images of 243 x 243 pixels and two numbers, without field, filter or time: the star is taken to be on the axis, at
750 nm, and the first image to be that of M2 moved towards the sky. The telescope is batoid's AuxTel.yaml for danish,
and the bundled ``auxtel``, which is made from it, for pachon. The sky is the median of each image's border. Printed for
Z4 to Z11 and to Z22: each image's wavefront [nm], by how much the two sides differ beside Z4, which is focus, what
pachon claims of that, chi-square a pixel and processor time.
"""

from __future__ import annotations

import argparse
import os
import pickle
import time
from importlib.metadata import version
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

import pachon

WAVELENGTH, PIXEL, SHIFT = 750e-9, 10e-6, 0.8e-3
OUTER, INNER, FOCAL_LENGTH = 0.6, 0.2115, 20.8
SHIFTS = SHIFT * np.array([1.0, -1.0])
#: Electrons that the variance of sky and readout is taken to have, next to nothing beside 3.6e8 of the star.
VARIANCE = 1000.0


def read(folder: Path) -> np.ndarray:
    """Return the two images, sky subtracted."""
    with (folder / "data" / "AuxTelTestDonuts.pkl").open("rb") as file:
        images = np.array(pickle.load(file)[0], dtype=np.float64)
    border = np.ones(images.shape[1:], dtype=bool)
    border[4:-4, 4:-4] = False
    return images - np.median(images[:, border], axis=1)[:, None, None]


def fit_pachon(images: np.ndarray, last: int) -> pachon.sensing.DonutFit:
    """Fit each image by pachon."""
    detector = pachon.DonutDetector(PIXEL, defocus=SHIFTS, moved="M2")
    return pachon.fit_donuts(
        pachon.load_telescope("auxtel"),
        images,
        np.zeros((2, 2)),
        WAVELENGTH,
        sky_variance=VARIANCE,
        model=pachon.DonutModel(detector=detector, neighbours=False),
        fit=pachon.sensing.SingleDonuts(range(4, last + 1), higher_order=10e-9),
        threads=1,
    )


def fit_danish(image: np.ndarray, shift: float, last: int) -> tuple[np.ndarray, float]:
    """Return Zernikes [m] of an image by danish, as its tests fit AuxTel's, and chi-square a pixel."""
    import batoid
    import danish
    import yaml
    from scipy.optimize import least_squares

    optic = batoid.Optic.fromYaml("AuxTel.yaml").withLocallyShiftedOptic("M2", [0.0, 0.0, shift])
    common = {"nrad": 20, "naz": 120, "reference": "chief", "eps": INNER / OUTER}
    reference = WAVELENGTH * batoid.zernikeTA(optic, 0.0, 0.0, WAVELENGTH, jmax=max(last, 11), **common)
    mask = yaml.safe_load((Path(danish.datadir) / "AuxTelObsc.yaml").read_text())
    factory = danish.DonutFactory(
        R_outer=OUTER, R_inner=INNER, mask_params=mask, focal_length=FOCAL_LENGTH, pixel_scale=PIXEL
    )
    terms = np.arange(4, last + 1)
    model = danish.SingleDonutModel(
        factory, z_ref=reference, z_terms=terms, thx=0.0, thy=0.0, npix=image.shape[0], bkg_order=0
    )
    start = [image.sum(), 0.0, 0.0, 0.7, *[0.0] * len(terms), 0.0]
    end = {"ftol": 1e-3, "xtol": 1e-3, "gtol": 1e-3, "max_nfev": 20, "x_scale": "jac"}
    best = least_squares(model.chi, start, jac=model.jac, args=(image, VARIANCE), **end)
    return np.array(model.unpack_params(best.x)["z_fit"]), float((best.fun**2).mean())


def report(label: str, zernikes: np.ndarray, chi2: np.ndarray, seconds: float) -> None:
    """Print Z4 to Z11 of both sides, and their difference."""
    nm = 1e9 * zernikes
    low, every = (float(np.linalg.norm((nm[0] - nm[1])[1:count])) for count in (8, None))
    print(f"  {label:8} sides differ by {low:.0f} nm (Z5 to Z11), {every:.0f} nm (from Z5 on); {seconds:.1f} s")
    print(f"    chi-square a pixel {', '.join(f'{value:.0f}' for value in chi2)}")
    for side, values in zip(("+", "-"), nm, strict=True):
        print(f"    {side} Z4 to Z11: {', '.join(f'{value:.0f}' for value in values[:8])}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="danish's tests, with data/AuxTelTestDonuts.pkl")
    parser.add_argument("--no-danish", action="store_true")
    options = parser.parse_args()
    peer_text = "" if options.no_danish else f", danish {version('danish')}"
    print(f"pachon {pachon.__version__}{peer_text}")
    images = read(options.folder)
    fit_pachon(images[:, 60:-60, 60:-60], 4)  # compiles
    for last in (11, 22):
        print(f"Z4 to Z{last}")
        start = time.process_time()
        fit = fit_pachon(images, last)
        report("pachon", fit.zernikes, fit.chi2 / fit.n_pixels, time.process_time() - start)
        seeing = ", ".join(f"{width:.2f}" for width in np.rad2deg(fit.fwhm) * 3600.0)
        claim = 1e9 * np.sqrt(np.trace(fit.covariance.sum(axis=0)[1:, 1:]))
        print(f"    claimed {claim:.0f} nm (from Z5 on); seeing {seeing} arcsec; {'; '.join(fit.reasons)}")
        if not options.no_danish:
            start = time.process_time()
            fits = [fit_danish(image, shift, last) for image, shift in zip(images, SHIFTS, strict=True)]
            zernikes, chi2 = (np.array(values) for values in zip(*fits, strict=True))
            report("danish", zernikes, chi2, time.process_time() - start)


if __name__ == "__main__":
    main()
