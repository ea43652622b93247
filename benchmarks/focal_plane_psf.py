"""The focal-plane PSF model beside the CCDs' own models: errors, uncertainties, correlations, time and memory.

Run: python benchmarks/focal_plane_psf.py RUN [--heights STATIC.fits]

RUN is the folder of `pachon run --all`: its observed stars and its noise-free PSFs at holdout positions. Errors are
those of e1, e2 and ln size at the holdout positions:

- the models of the CCDs in the products (the paper's cubic by default), and linear polynomials of all pixels with
  softened weights, the best of docs/evidence/psf_study.md;
- pachon without telescope, and with the telescope but without heights; with those of other exposures if they are given.

With the times of the fits, which run one after the other on all threads.
"""

import argparse
import json
import resource
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import treecorr
from astropy.io import fits

import pachon
from pachon.core.units import ARCMIN
from pachon.measure.shapes import measure_shapes
from pachon.pipeline.config import configuration_of
from pachon.pipeline.experiment import Experiment
from pachon.pipeline.focal_plane_stage import fit_focal_plane_model
from pachon.pipeline.run_folder import SUMMARY_NAME
from pachon.reconstruction.ccd_product import CcdProduct, read_product
from pachon.reconstruction.focal_plane_psf.stars import FocalPlaneStars
from pachon.reconstruction.psf_model.checks import snr_weights
from pachon.reconstruction.psf_model.model import PsfModel


@dataclass(frozen=True, eq=False)
class RunStars:
    """Stars and holdout positions of a run."""

    experiment: Experiment
    products: list[CcdProduct]
    stars: FocalPlaneStars
    names: list[str]  #: CCD of each holdout position
    x: np.ndarray  #: holdout positions on the detector [m]
    y: np.ndarray
    truth: np.ndarray  #: e1, e2 and ln size of the noise-free PSFs there, [n, 3]

    @classmethod
    def read(cls, folder: Path) -> "RunStars":
        """Read the products of a run."""
        summary = json.loads((folder / SUMMARY_NAME).read_text())
        experiment = Experiment.from_config(configuration_of(summary["configuration"], str(folder)))
        products = [read_product(path, holdout_images=False) for path in sorted(folder.glob("ccd_*.fits"))]
        stars = FocalPlaneStars.from_products(products, experiment.weight_fwhm)
        x, y, e1, e2, size = (
            np.concatenate([getattr(p.holdout, key) for p in products]) for key in ("x", "y", "e1", "e2", "size")
        )
        names = [p.name for p in products for _ in range(len(p.holdout))]
        return cls(experiment, products, stars, names, x, y, np.stack([e1, e2, np.log(size)], axis=1))


def linear(products, experiment) -> np.ndarray:
    """Return e1, e2 and ln size at holdout positions by linear polynomials of all pixels."""
    result = []
    for product in products:
        stars = product.observed
        used, xy = stars.used, np.stack([stars.x, stars.y], axis=1)
        weights = snr_weights("softened", stars.snr[used])
        stamps = product.observed_images[used]
        model = PsfModel.fit(stamps, xy[used], recipe="paper", basis="pixels", order=1, weights=weights)
        images = model.at(np.stack([product.holdout.x, product.holdout.y], axis=1))
        shapes = measure_shapes(images, product.pixel_scale, experiment.weight_fwhm)
        result.append(np.stack([shapes.e1, shapes.e2, np.log(shapes.size)], axis=1))
    return np.concatenate(result)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--heights", type=Path, help="heights learnt from other exposures, of StaticHeights.write")
    options = parser.parse_args()
    run = RunStars.read(options.run)
    experiment, products, stars, names, truth = run.experiment, run.products, run.stars, run.names, run.truth
    field = np.concatenate([np.stack([p.holdout.field_x, p.holdout.field_y]) for p in products], axis=1)
    patch = np.repeat(np.arange(len(products)), [len(p.holdout) for p in products])
    print(f"pachon {pachon.__version__}, {len(products)} CCDs, {len(stars)} stars, {len(names)} holdout positions")
    print(
        f"{'':44s} {'e1':>8s} {'e2':>8s} {'ln size':>8s}  chi2 e1, e2, ln size     xi+ 5.5', 10'-20', 30'-180'      fit"
    )

    def show(label: str, values: np.ndarray, seconds: float = np.nan, sigma: np.ndarray | None = None) -> None:
        left = truth - values
        good = np.isfinite(left).all(axis=1)
        rms = np.sqrt((left[good] ** 2).mean(axis=0))
        chi2 = "" if sigma is None else " ".join(f"{v:5.2f}" for v in ((left / sigma)[good] ** 2).mean(axis=0))
        xi = []
        catalogue = treecorr.Catalog(
            x=field[0][good], y=field[1][good], g1=left[good, 0], g2=left[good, 1], patch=patch[good]
        )
        for low, high in ((4.5, 6.5), (10.0, 20.0), (30.0, 180.0)):
            pairs = treecorr.GGCorrelation(
                min_sep=low * ARCMIN, max_sep=high * ARCMIN, nbins=1, var_method="jackknife", cross_patch_weight="match"
            )
            pairs.process(catalogue)
            xi.append(f"{pairs.xip[0]:8.1e}+-{np.sqrt(pairs.varxip[0]):.0e}")
        print(
            f"{label:44s} "
            + " ".join(f"{1e3 * v:7.3f}m" for v in rms)
            + f"  {chi2:24s} {' '.join(xi)} {seconds:7.1f} s"
        )

    own = "ccd" if fits.getheader(next(options.run.glob("ccd_*.fits"))).get("PSFMODEL", "ccd") == "ccd" else "focal"
    prefix = "model" if own == "ccd" else "ccd"
    parts = [np.stack([getattr(p.holdout, f"{prefix}_{k}") for k in ("e1", "e2", "size")], axis=1) for p in products]
    values = np.concatenate(parts)
    show("each CCD, as in the run", np.column_stack([values[:, :2], np.log(values[:, 2])]))
    start = time.perf_counter()
    show("each CCD, linear, all pixels, softened", linear(products, experiment), time.perf_counter() - start)
    cases: list[tuple[str, bool, Any]] = [
        ("without telescope", False, None),
        ("telescope, heights unknown", True, None),
    ]
    if options.heights:
        known = pachon.reconstruction.StaticHeights.read(options.heights)
        cases.append((f"heights from {known.exposures} exposures", True, known))
    cases.append(("heights as drawn (the limit)", True, experiment.focal_plane))
    for label, telescope, heights in cases:
        start = time.perf_counter()
        model = fit_focal_plane_model(experiment, stars, heights, telescope=telescope, components=0)
        seconds = time.perf_counter() - start
        shapes, sigma = model.predict(names, run.x, run.y)
        found = np.stack([shapes.e1, shapes.e2, np.log(shapes.size)], axis=1)
        show(f"pachon, {label}", found, seconds, np.stack([sigma.e1, sigma.e2, sigma.size / shapes.size], axis=1))
        for remark in model.warnings:
            print(f"    {remark}")
    print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.1f} GiB")


if __name__ == "__main__":
    main()
