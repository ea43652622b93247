"""Plots of PSFs: eigen-PSFs and their eigenvalues, and stamps of stars, their models and residuals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.colors import SymLogNorm

from ...core.plotting import new_figure, png_bytes, styled
from ...core.units import ARCSEC
from ..ccd_product import CcdProduct
from .focal_plane_axes import AWAY, OBSERVED, TRUTH
from .tables import percent

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.image import AxesImage

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
        left, right = figure.subplots(1, 2)
        for product in products:
            for model, color in ((product.model, OBSERVED), (product.noise_free_model, TRUTH)):
                n = np.arange(1, len(model.eigenvalues) + 1)
                total = model.eigenvalues.sum()
                left.plot(n, model.eigenvalues, "-", color=color, linewidth=0.8, alpha=0.7)
                if 0 < model.elbow <= len(n):
                    left.plot(model.elbow, model.eigenvalues[model.elbow - 1], "o", color=color, markersize=3.5)
                if total > 0:
                    missing = 1.0 - np.cumsum(model.eigenvalues) / total
                    right.plot(n[missing > 1e-15], missing[missing > 1e-15], "-", color=color, linewidth=0.8, alpha=0.7)
        # Models of pixels have all components.
        pixels = products[0].model.basis == "pixels"
        count = (products[0].noise_free_model if pixels else products[0].model).n_components
        for axes in (left, right):
            axes.axvline(count + 0.5, color="0.5", linewidth=0.8, linestyle=(0, (4, 3)))
            axes.set(yscale="log", xlabel="component n", xlim=(0, 2.2 * count))
        right.axhline(0.01, color=AWAY, linewidth=0.8)
        right.annotate("1 %", (0.99, 0.01), xycoords=("axes fraction", "data"), ha="right", va="bottom", fontsize=8)
        values = [m.eigenvalues[: 2 * count] for p in products for m in (p.model, p.noise_free_model)]
        positive = np.concatenate(values)
        positive = positive[positive > 1e-12 * positive.max()]
        left.set_ylim(0.5 * positive.min(), 2.0 * positive.max())
        right.set_ylim(1e-6, 1.0)
        left.plot([], [], "-o", color=OBSERVED, markersize=3.5, label="observed stars, dot: elbow")
        left.plot([], [], "-o", color=TRUTH, markersize=3.5, label="noise-free PSFs, dot: elbow")
        left.legend(loc="upper right")
        kept = "noise-free components kept" if pixels else "components kept"
        left.set_title(f"eigenvalues, a line a CCD; dashed: {kept}", loc="left")
        left.set_ylabel("variance of unit-sum stamps along n")
        right.set_title("part of the variance beyond n", loc="left")
        right.set_ylabel("1 - cumulative fraction")
        return png_bytes(figure)


def stamps_plot(products: Sequence[CcdProduct], per_ccd: int = 3) -> bytes:
    """Draw observed stars, the model at their positions, and the residuals in units of the noise.

    Columns are `per_ccd` stars of each CCD, from the brightest to the faintest.
    """
    chosen = [(p, i) for p in products for i in _bright_to_faint(p, per_ccd)]
    with styled():
        figure = new_figure(1.45 * len(chosen) + 1.3, 5.3)
        axes = figure.subplots()
        gallery = StampGallery(axes, products[0].observed_images.shape[1], products[0].pixel_scale)
        for column, (product, i) in enumerate(chosen):
            stars, position = product.observed, np.array([[product.observed.x[i], product.observed.y[i]]])
            model = product.model.at(position)[0]
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
        gallery.finish(3, len(chosen), ("observed", "model", "observed - model"))
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


_SOFTENING = 0.02


def stretched(values: np.ndarray) -> np.ndarray:
    """Return values over the peak on the asinh scale of pictures, 1 at 1."""
    return np.arcsinh(np.asarray(values) / _SOFTENING) / np.arcsinh(1.0 / _SOFTENING)


_LOW = float(stretched(np.array(-0.02)))


def _bright_to_faint(product: CcdProduct, count: int) -> list[int]:
    """Return used stars spread evenly over the magnitudes, brightest first."""
    used = np.flatnonzero(product.observed.used)
    ordered = used[np.argsort(product.observed.magnitude[used], kind="stable")]
    ranks = np.unique(np.linspace(0, len(ordered) - 1, min(count, len(ordered))).round().astype(int))
    return [int(i) for i in ordered[ranks]]


class StampGallery:
    """Stamps in rows and columns within one pair of axes: axes of their own would take most of the time of a report."""

    def __init__(self, axes: Axes, size: int, pixel_scale: float, shown: float = math.inf, room: float = 0.0) -> None:
        """Show the middle of stamps of a size [pixel], out to an angle [rad] from their centres.

        Between rows there is room for a title, in sides of a stamp.
        """
        self._axes = axes
        self._rim = max(0, round(0.5 * size - shown / pixel_scale)) if math.isfinite(shown) else 0
        self._side = (size - 2 * self._rim) * pixel_scale / ARCSEC
        self._step, self._down = 1.06 * self._side, -(1.06 + room) * self._side

    def show(self, image: np.ndarray, row: int, column: int, title: str = "", **colours: Any) -> AxesImage:
        """Draw a stamp, with a title above it."""
        side, rim, left, bottom = self._side, self._rim, self._step * column, self._down * row
        self._axes.text(left + 0.5 * side, bottom + 1.02 * side, title, ha="center", va="bottom", fontsize=8)
        middle = image[rim : len(image) - rim, rim : len(image) - rim]
        return self._axes.imshow(middle, extent=(left, left + side, bottom, bottom + side), **colours)

    def finish(self, rows: int, columns: int, names: Sequence[str] = ()) -> None:
        """Set limits, names of rows at the left, and a bar of a round number of arcseconds under the first stamp."""
        side, axes, bottom = self._side, self._axes, self._down * (rows - 1)
        for row, name in enumerate(names):
            y = self._down * row + 0.5 * side
            axes.text(-0.06 * side, y, name, rotation=90, ha="right", va="center")
        length = next(n for n in (5.0, 2.0, 1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01) if n < 0.6 * side)
        axes.plot([0.0, length], [bottom - 0.06 * side] * 2, "-", color="0.2", linewidth=1.5)
        axes.text(0.5 * length, bottom - 0.1 * side, f"{length:g} arcsec", ha="center", va="top", fontsize=8)
        axes.set_xlim(-(0.2 if names else 0.02) * side, self._step * columns)
        axes.set_ylim(bottom - 0.25 * side, 1.02 * side)
        axes.set_aspect("equal")
        axes.set_axis_off()
