"""CCD heights in the residuals of PSF models: the test of Rubin's RTN-108, on simulated visits.

Run: python benchmarks/heights_in_residuals.py RUN... [--plot heights_in_residuals.png]

Each RUN is the folder of `pachon run --all`, best with `focal_plane: {heights: lsstcam}`, 60 noise-free and 140
observed stars a CCD, at best focus or off it (`focal_plane: {moved: {R22: {dz_um: 10}, ...}}` for every raft). A plane
or a simulated budget shows what heights cost each model.
Residuals are those of the noise-free PSFs at holdout positions, where no star is, of

- polynomials of order 2 and 4 of e1, e2 and ln size, fitted to the stars of each CCD, weighted by their noise;
- order 2 with terms in the measured height: dz, dz^2, x dz, y dz;
- pachon's model of the whole focal plane, with the heights unknown to it (prior of hardly any strength), and with them.

Heights are those within a CCD, less its mean. Ellipticity is taken along the direction in which the height changes it
at its place, so that the sign is the same over the field. Slopes are of straight lines, with jackknife errors over
rafts; a bin is a tenth of the positions.
"""

import argparse
import json
import time
from pathlib import Path

import matplotlib
import numpy as np

import pachon
from pachon import Experiment, FocalPlaneStars
from pachon.pipeline.config import configuration_of
from pachon.pipeline.focal_plane_stage import fit_focal_plane_model, instrument_of
from pachon.pipeline.run_folder import SUMMARY_NAME
from pachon.reconstruction.ccd_product import read_product
from pachon.reconstruction.focal_plane_psf.response import height_response

matplotlib.use("Agg")
_BINS = 10


def polynomial(x, y, order, dz=None):
    """Return the terms of a polynomial at places of a CCD [half sides], with those in the height [um]."""
    terms = [x**i * y**j for i in range(order + 1) for j in range(order + 1 - i)]
    if dz is not None:
        terms += [dz, dz**2, x * dz, y * dz]
    return np.stack(terms, axis=1)


def by_ccd(stars, holdout, ccds, order, heights=None):
    """Return e1, e2 and ln size at holdout positions by polynomials of each CCD."""
    found = np.full((len(holdout["x"]), 3), np.nan)
    for ccd in np.unique(ccds["holdout"]):
        s, h = ccds["stars"] == ccd, ccds["holdout"] == ccd
        at = {}
        for key, of, rows in (("stars", stars, s), ("holdout", holdout, h)):
            dz = None if heights is None else heights[key][rows]
            at[key] = polynomial(of["u"][rows], of["v"][rows], order, dz)
        for shape in range(3):
            weight = 1.0 / np.hypot(stars["noise"][s, shape], 2e-3)
            solution = np.linalg.lstsq(at["stars"] * weight[:, None], stars["values"][s, shape] * weight, rcond=None)[0]
            found[h, shape] = at["holdout"] @ solution
    return found


def slope(dz, left, patch):
    """Return the slope of a straight line, and its jackknife error over patches; NaN where there are no heights."""
    if np.ptp(dz) == 0.0:
        return np.nan, np.nan

    def of(rows):
        return np.polyfit(dz[rows], left[rows], 1)[0]

    patches = np.unique(patch)
    if len(patches) < 2:
        return of(slice(None)), np.nan
    without = np.array([of(patch != p) for p in patches])
    return of(slice(None)), np.sqrt((len(patches) - 1) * without.var())


def by_raft(left, patch):
    """Return the mean of residuals, and its error from the scatter of the rafts."""
    means = np.array([left[patch == p].mean() for p in np.unique(patch)])
    return left.mean(), means.std() / np.sqrt(max(len(means) - 1, 1))


def one_run(folder):
    """Return the residuals of each model, the heights [um] and the rafts of the holdout positions of a run."""
    summary = json.loads((folder / SUMMARY_NAME).read_text())
    experiment = Experiment.from_config(configuration_of(summary["configuration"], str(folder)))
    camera, plane = experiment.camera, experiment.focal_plane
    products = [read_product(path, holdout_images=False) for path in sorted(folder.glob("ccd_*.fits"))]
    table = FocalPlaneStars.from_products(products, experiment.weight_fwhm)
    table = table.chosen(table.usable)
    index = np.array([camera.ccd_index(p.name) for p in products])
    truth = {k: np.concatenate([getattr(p.holdout, k) for p in products]) for k in ("x", "y", "e1", "e2", "size")}
    ccds = {
        "stars": np.array([camera.ccd_index(name) for name in table.ccd]),
        "holdout": np.repeat(index, [len(p.holdout) for p in products]),
    }
    stars = {"x": table.x, "y": table.y, "values": table.values, "noise": table.noise}
    dz = {}
    for key, of in (("stars", stars), ("holdout", truth)):
        of["u"], of["v"] = camera.to_uv(ccds[key], np.stack([of["x"], of["y"]], axis=1)).T
        dz[key] = 1e6 * plane.height(of["x"], of["y"])
    count = np.bincount(ccds["holdout"], minlength=len(camera))
    mean = np.bincount(ccds["holdout"], dz["holdout"], len(camera)) / np.maximum(count, 1)
    dz = {key: values - mean[ccds[key]] for key, values in dz.items()}
    values = np.stack([truth["e1"], truth["e2"], np.log(truth["size"])], axis=1)
    instrument = instrument_of(experiment)
    fields = instrument.fields(np.stack([truth["x"], truth["y"]], axis=1))
    change = height_response(instrument, fields, plane, None).slope(plane.height(truth["x"], truth["y"]))[:, :2]
    along = change / np.hypot(*change.T)[:, None]
    models = {
        "order 2": by_ccd(stars, truth, ccds, 2),
        "order 4": by_ccd(stars, truth, ccds, 4),
        "order 2 and dz": by_ccd(stars, truth, ccds, 2, dz),
    }
    names = [camera.ccd_names[c] for c in ccds["holdout"]]
    for label, heights in (("focal plane", None), ("focal plane, heights known", plane)):
        start = time.perf_counter()
        model = fit_focal_plane_model(experiment, table, heights, components=0)
        shapes = model.shapes(names, truth["x"], truth["y"])
        models[label] = np.stack([shapes.e1, shapes.e2, np.log(shapes.size)], axis=1)
        print(f"  {label}: {len(table)} stars, {time.perf_counter() - start:.0f} s {' '.join(model.warnings)}")
    left = {label: values - found for label, found in models.items()}
    left = {
        label: np.column_stack([100.0 * r[:, 2], 1e3 * (r[:, :2] * along).sum(axis=1), r]) for label, r in left.items()
    }
    return left, dz["holdout"], camera.raft_index[ccds["holdout"]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--plot", type=Path, default=Path("heights_in_residuals.png"))
    options = parser.parse_args()
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, len(options.runs), figsize=(5.0 * len(options.runs), 7.0), squeeze=False)
    for column, folder in enumerate(options.runs):
        print(f"{folder}: pachon {pachon.__version__}")
        left, dz, rafts = one_run(folder)
        print(f"  {'':28s} {'ln size [% / um]':>22s} {'e [1e-3 / um]':>22s} {'rms e1, e2, ln size':>30s}")
        edges = np.quantile(dz, np.linspace(0.0, 1.0, _BINS + 1))
        bins = np.clip(np.searchsorted(edges, dz, side="right") - 1, 0, _BINS - 1)
        filled = np.unique(bins)
        centers = [dz[bins == b].mean() for b in filled]
        for label, values in left.items():
            found = [slope(dz, values[:, i], rafts) for i in range(2)]
            rms = np.sqrt((values[:, 2:] ** 2).mean(axis=0))
            print(
                f"  {label:28s} "
                + " ".join(f"{s:11.4f} +- {e:7.4f}" for s, e in found)
                + " ".join(f"{1e3 * v:9.3f}e-3" for v in rms)
            )
            for row in range(2):
                mean, error = np.transpose([by_raft(values[bins == b, row], rafts[bins == b]) for b in filled])
                axes[row, column].errorbar(centers, mean, error, marker="o", markersize=4, capsize=2, label=label)
        axes[0, column].set(title=folder.name, ylabel="residual of the size [%]")
        axes[1, column].set(xlabel="height within the CCD [um]", ylabel="residual of e along its change [1e-3]")
        for row in range(2):
            axes[row, column].axhline(0.0, color="0.6", linewidth=0.8)
    axes[0, 0].legend(fontsize="small")
    figure.tight_layout()
    figure.savefig(options.plot, dpi=150)
    print(f"picture: {options.plot}")


if __name__ == "__main__":
    main()
