"""Plots of PSFs: eigen-PSFs and their eigenvalues, and stamps of stars, their models and residuals."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.colors import SymLogNorm

from ...core.plotting import new_figure, png_bytes, styled
from ...measure.focal_plane_axes import AWAY, OBSERVED, TRUTH
from ...reconstruction.ccd_product import CcdProduct
from ...reconstruction.stamp_gallery import StampGallery, stretched
from .tables import percent

#: Eigen-PSFs in a row.
_COLUMNS = 7


def eigen_psf_plot(product: CcdProduct, noise_free: bool) -> bytes:
    """Draw mean and eigen-PSFs of one CCD, of the noise-free PSFs or the observed stars (Jee & Tyson 2011, Fig. 9)."""
    model = product.noise_free_model if noise_free else product.model
    count = min(model.n_components, 20)
    rows = -(-(count + 1) // _COLUMNS)
    # Beyond three times the FWHM there is no structure.
    shown = 3.0 * float(np.nanmedian(product.holdout.fwhm))
    with styled():
        figure = new_figure(1.75 * _COLUMNS + 0.6, 1.95 * rows + 0.7)
        axes = figure.subplots()
        gallery = StampGallery(axes, model.mean.shape[0], product.pixel_scale, shown, room=0.12)
        gallery.show(
            np.sqrt(np.maximum(model.mean, 0.0)), 0, 0, "mean (square root)", cmap="viridis", vmin=0.0, vmax=None
        )
        for k in range(count):
            component = model.components[k]
            image = gallery.show(
                component / float(np.abs(component).max()),
                *divmod(k + 1, _COLUMNS),
                f"n = {k + 1}: {percent(model.explained_variance[k])}",
                cmap="RdBu_r",
                vmin=-1.0,
                vmax=1.0,
            )
        gallery.finish(rows, min(count + 1, _COLUMNS))
        label = "eigen-PSF, each over its largest magnitude"
        figure.colorbar(image, ax=axes, fraction=0.015, pad=0.01, aspect=40, label=label)
        kind = "noise-free PSFs" if noise_free else "observed stars"
        figure.suptitle(
            f"{product.name}: mean and eigen-PSFs of {model.n_stars} {kind}; "
            f"{model.n_components} components hold {percent(model.explained)} of the variance",
            fontsize=10,
        )
        return png_bytes(figure)


def spectrum_plot(products: Sequence[CcdProduct]) -> bytes:
    """Draw the eigenvalues of all CCDs, of observed stars and of noise-free PSFs, and the number kept."""
    with styled():
        figure = new_figure(10.0, 4.2)
        spectrum_axes, fraction_axes = figure.subplots(1, 2)
        for product in products:
            for model, color in ((product.model, OBSERVED), (product.noise_free_model, TRUTH)):
                n = np.arange(1, len(model.eigenvalues) + 1)
                total = model.eigenvalues.sum()
                spectrum_axes.plot(n, model.eigenvalues, "-", color=color, linewidth=0.8, alpha=0.7)
                if 0 < model.elbow <= len(n):
                    spectrum_axes.plot(
                        model.elbow, model.eigenvalues[model.elbow - 1], "o", color=color, markersize=3.5
                    )
                if total > 0:
                    unexplained = 1.0 - np.cumsum(model.eigenvalues) / total
                    fraction_axes.plot(
                        n[unexplained > 1e-15],
                        unexplained[unexplained > 1e-15],
                        "-",
                        color=color,
                        linewidth=0.8,
                        alpha=0.7,
                    )
        described = products[0].model.basis.kind.has_components
        count = (products[0].model if described else products[0].noise_free_model).n_components
        for axes in (spectrum_axes, fraction_axes):
            axes.axvline(count + 0.5, color="0.5", linewidth=0.8, linestyle=(0, (4, 3)))
            axes.set(yscale="log", xlabel="component n", xlim=(0, 2.2 * count))
        fraction_axes.axhline(0.01, color=AWAY, linewidth=0.8)
        fraction_axes.annotate(
            "1 %", (0.99, 0.01), xycoords=("axes fraction", "data"), ha="right", va="bottom", fontsize=8
        )
        values = [m.eigenvalues[: 2 * count] for p in products for m in (p.model, p.noise_free_model)]
        positive = np.concatenate(values)
        positive = positive[positive > 1e-12 * positive.max()]
        spectrum_axes.set_ylim(0.5 * positive.min(), 2.0 * positive.max())
        fraction_axes.set_ylim(1e-6, 1.0)
        spectrum_axes.plot([], [], "-o", color=OBSERVED, markersize=3.5, label="observed stars, dot: elbow")
        spectrum_axes.plot([], [], "-o", color=TRUTH, markersize=3.5, label="noise-free PSFs, dot: elbow")
        spectrum_axes.legend(loc="upper right")
        cutoff_label = "components kept" if described else "noise-free components kept"
        spectrum_axes.set_title(f"eigenvalues, a line a CCD; dashed: {cutoff_label}", loc="left")
        spectrum_axes.set_ylabel("variance of unit-sum stamps along n")
        fraction_axes.set_title("part of the variance beyond n", loc="left")
        fraction_axes.set_ylabel("1 - cumulative fraction")
        return png_bytes(figure)


def stamps_plot(products: Sequence[CcdProduct], per_ccd: int = 3) -> bytes:
    """Draw observed stars, the model at their positions, and the residuals in units of the noise.

    Columns are `per_ccd` stars of each CCD, from the brightest to the faintest.
    """
    shown_stars = [(p, i) for p in products for i in _bright_to_faint(p, per_ccd)]
    with styled():
        figure = new_figure(1.45 * len(shown_stars) + 1.3, 5.3)
        axes = figure.subplots()
        gallery = StampGallery(axes, products[0].observed_images.shape[1], products[0].pixel_scale)
        for column, (product, i) in enumerate(shown_stars):
            stars, position = product.observed, np.array([[product.observed.x[i], product.observed.y[i]]])
            model = product.model.at(position, colour=None if stars.colour is None else stars.colour[i])[0]
            observed = np.asarray(product.observed_images[i], dtype=np.float64)
            sky, rms = product.noise
            sigma = np.sqrt(np.maximum(stars.electrons[i] * model, 0.0) + sky + rms**2)
            left_over = (observed - model) * stars.electrons[i] / sigma
            top = model.max()
            title = f"{product.name}\n{stars.magnitude[i]:.1f} mag, S/N {stars.snr[i]:.0f}"
            for row, (image, text) in enumerate(((observed, title), (model, ""))):
                light = gallery.show(stretched(image / top), row, column, text, cmap="viridis", vmin=_LOW, vmax=1.0)
            residual = SymLogNorm(3.0, vmin=-100.0, vmax=100.0)
            noise = gallery.show(left_over, 2, column, cmap="RdBu_r", norm=residual)
        gallery.finish(3, len(shown_stars), ("observed", "model", "observed - model"))
        # Beside the two rows, and the one, that they belong to.
        places = [axes.inset_axes((1.005, low, 0.012, high)) for low, high in ((0.42, 0.58), (0.09, 0.28))]
        bar = figure.colorbar(light, cax=places[0], label="over the model's peak (asinh)")
        ticks = np.array([0.0, 0.01, 0.1, 0.5, 1.0])
        bar.set_ticks(stretched(ticks).tolist(), labels=[f"{t:g}" for t in ticks])
        bar = figure.colorbar(noise, cax=places[1], label="pixel noise σ")
        steps = (-100, -30, -10, -3, 0, 3, 10, 30, 100)
        bar.set_ticks(steps, labels=[f"{t}" for t in steps], minor=False)
        bar.ax.minorticks_off()
        return png_bytes(figure)


_LOW = float(stretched(np.array(-0.02)))


def _bright_to_faint(product: CcdProduct, count: int) -> list[int]:
    """Return used stars spread evenly over the magnitudes, brightest first."""
    used = np.flatnonzero(product.observed.used)
    ordered = used[np.argsort(product.observed.magnitude[used], kind="stable")]
    ranks = np.unique(np.linspace(0, len(ordered) - 1, min(count, len(ordered))).round().astype(int))
    return [int(i) for i in ordered[ranks]]
