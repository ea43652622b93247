"""What one PSF's ellipticity is called: the paper's weighted e, the adaptive g of DES, the e of HSC and the LSST's SRD.

Run: python benchmarks/ellipticity_conventions.py RUN

RUN is the folder of `pachon run`, whose noise-free PSFs at holdout positions are measured twice: (a - b)/(a + b) of
moments under a round Gaussian weight of 0.7" (`measure_shapes`), and of moments under an elliptical Gaussian that
adapts to the image (`adaptive_moments`, and GalSim's HSM as a check: those of Jarvis et al. 2016). Ratios of e and of
ln(size) are slopes of least squares over all PSFs, through the origin for e and about the mean for ln(size); xi+ is
that of TreeCorr. The second table is of the residuals of the run's PSF models, noise-free less model.

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


def hsm_shapes(images: np.ndarray) -> np.ndarray:
    """Return g1, g2 and sigma [pixel] of GalSim's adaptive moments, [n, 3]."""
    rows = []
    for image in images:
        moments = galsim.hsm.FindAdaptiveMom(galsim.ImageD(image.astype(np.float64), scale=1.0))
        rows.append((moments.observed_shape.g1, moments.observed_shape.g2, moments.moments_sigma))
    return np.array(rows)


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
    adaptive = pachon.adaptive_moments(images.astype(np.float64), scale)
    theirs = hsm_shapes(images)
    e = np.stack([weighted.e1, weighted.e2])
    g = np.stack([adaptive.g1, adaptive.g2])
    distortion = np.stack([adaptive.e1, adaptive.e2])  # (a^2 - b^2)/(a^2 + b^2)
    size, sigma = np.log(weighted.size), np.log(adaptive.sigma)
    size, sigma = size - size.mean(), sigma - sigma.mean()
    width = np.median(np.concatenate([product.holdout.fwhm for product in products]))
    expected = 1.0 + (np.median(adaptive.sigma) / (WEIGHT / np.sqrt(8.0 * np.log(2.0)))) ** 2
    print(f"pachon {pachon.__version__}, GalSim {galsim.__version__}, TreeCorr {treecorr.__version__}")
    worst = max(np.abs(g - theirs[:, :2].T).max(), np.abs(adaptive.sigma / scale / theirs[:, 2] - 1.0).max())
    print(f"adaptive moments: largest difference from HSM's g and ln(sigma) {worst:.1e}")
    print(f"{len(images)} PSFs on {len(products)} CCDs, median FWHM {width / ARCSEC:.3f} arcsec")
    names = ("weighted e", "g of adaptive moments (DES)", "(a^2 - b^2)/(a^2 + b^2) (SRD, HSC)")
    print_table(names, (e, g, distortion), x, y, (1.0, expected, 2.0 * expected))
    print(f"d ln sigma of adaptive moments / d ln size of weighted ones: {(sigma * size).sum() / (size**2).sum():.3f}")
    residual_e, residual_g = (
        np.concatenate([product.ellipticity("away", moments) for product in products], axis=1) for moments in "eg"
    )
    print("\nresiduals of the PSF models where no star is")
    print_table(names, (residual_e, residual_g, 2.0 * residual_g), x, y, (1.0, expected, 2.0 * expected))


def print_table(
    names: tuple[str, ...],
    ellipticities: tuple[np.ndarray, ...],
    x: np.ndarray,
    y: np.ndarray,
    gaussian: tuple[float, ...],
) -> None:
    """Print median and rms of ellipticities [2, n], slopes against the first, and xi+ beside the first's."""
    ranges = "".join(f"{f'xi+ {low:g} to {high:g} arcmin':>26s}" for low, high in SEPARATIONS)
    print(f"{'':36s}{'median |e|':>11s}{'rms':>9s}{'e / first':>10s}{ranges}{'of a Gaussian':>16s}")
    first = ellipticities[0]
    for name, values, ratio in zip(names, ellipticities, gaussian, strict=True):
        text = ""
        for low, high in SEPARATIONS:
            xi, weighted_xi = (xi_plus(x, y, e, low, high) for e in (values, first))
            text += f"{f'{xi:.3g}, {xi / weighted_xi:.2f} times':>26s}"
        slope, rms = (values * first).sum() / (first**2).sum(), np.sqrt(np.mean(values**2))
        print(f"{name:36s}{np.median(np.hypot(*values)):11.4f}{rms:9.5f}{slope:10.3f}{text}{ratio:16.2f}")


if __name__ == "__main__":
    main()
