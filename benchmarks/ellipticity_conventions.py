"""What one PSF's ellipticity is called: pachon's weighted e, GalSim's adaptive g, the e of the LSST's SRD.

Run: python benchmarks/ellipticity_conventions.py RUN

RUN is the folder of `pachon run`, whose noise-free PSFs at holdout positions are measured twice: by pachon, (a - b)/(a
+ b) of moments under a round Gaussian weight of 0.7", and by GalSim's HSM, moments under an elliptical Gaussian that
adapts to the image (those of Jarvis et al. 2016). Ratios of e and of ln(size) are slopes of least squares over all
PSFs, through the origin for e and about the mean for ln(size); xi+ is that of TreeCorr.

For a Gaussian PSF of rms width s under a weight of rms width w, moments are those of 1/(1/s^2 + 1/w^2): changes of e
and of ln(size) are seen w^2/(s^2 + w^2) times as large. The ratio 1 + s^2/w^2 stands in the last column.
"""

import argparse
from pathlib import Path

import galsim
import numpy as np
import treecorr

import pachon
from pachon.core.units import ARCMIN, ARCSEC
from pachon.reconstruction.ccd_product import read_product

WEIGHT = 0.7 * ARCSEC
# Ranges of separations in which xi+ is compared [arcmin].
SEPARATIONS = ((0.5, 10.0), (10.0, 180.0))


def adaptive_shapes(images: np.ndarray) -> np.ndarray:
    """Return g1, g2 and sigma [pixel] of GalSim's adaptive moments, [n, 3]."""
    found = []
    for image in images:
        moments = galsim.hsm.FindAdaptiveMom(galsim.ImageD(image.astype(np.float64), scale=1.0))
        found.append((moments.observed_shape.g1, moments.observed_shape.g2, moments.moments_sigma))
    return np.array(found)


def xi_plus(x: np.ndarray, y: np.ndarray, e: np.ndarray, lowest: float, highest: float) -> float:
    """Return xi+ of ellipticities [2, n] over pairs between two separations [arcmin]."""
    pairs = treecorr.GGCorrelation(min_sep=lowest * ARCMIN, max_sep=highest * ARCMIN, nbins=1)
    pairs.process(treecorr.Catalog(x=x, y=y, g1=e[0], g2=e[1]))
    return float(pairs.xip[0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    products = [read_product(path) for path in sorted(parser.parse_args().run.glob("ccd_*.fits"))]
    images = np.concatenate([product.holdout_images for product in products])
    x, y = np.concatenate([product.sky_positions("truth") for product in products], axis=1)
    scale = products[0].pixel_scale
    weighted = pachon.measure_shapes(images.astype(np.float64), scale, WEIGHT)
    adaptive = adaptive_shapes(images)
    e = np.stack([weighted.e1, weighted.e2])
    g = adaptive[:, :2].T
    distortion = 2.0 * g / (1.0 + (g**2).sum(axis=0))  # (a^2 - b^2)/(a^2 + b^2)
    size, sigma = np.log(weighted.size), np.log(adaptive[:, 2])
    size, sigma = size - size.mean(), sigma - sigma.mean()
    width = np.median(np.concatenate([product.holdout.fwhm for product in products]))
    expected = 1.0 + (np.median(adaptive[:, 2]) * scale / (WEIGHT / np.sqrt(8.0 * np.log(2.0)))) ** 2
    print(f"pachon {pachon.__version__}, GalSim {galsim.__version__}, TreeCorr {treecorr.__version__}")
    print(f"{len(images)} PSFs on {len(products)} CCDs, median FWHM {width / ARCSEC:.3f} arcsec")
    ranges = "".join(f"{f'xi+ {low:g} to {high:g} arcmin':>26s}" for low, high in SEPARATIONS)
    print(f"{'':34s}{'median |e|':>11s}{'e / ours':>10s}{ranges}{'of a Gaussian':>16s}")
    for name, values, ratio in (
        ("pachon, e of the weighted moments", e, 1.0),
        ("GalSim, g of adaptive moments", g, expected),
        ("SRD, (a^2 - b^2)/(a^2 + b^2)", distortion, 2.0 * expected),
    ):
        text = ""
        for low, high in SEPARATIONS:
            xi, ours = (xi_plus(x, y, each, low, high) for each in (values, e))
            text += f"{f'{xi:.3g}, {xi / ours:.2f} times':>26s}"
        slope = (values * e).sum() / (e**2).sum()
        print(f"{name:34s}{np.median(np.hypot(*values)):11.4f}{slope:10.3f}{text}{ratio:16.2f}")
    print(f"d ln sigma of GalSim / d ln size of pachon: {(sigma * size).sum() / (size**2).sum():.3f}")


if __name__ == "__main__":
    main()
