"""PSF model of own stars: the stars, the model, its prediction of each star held out, and their picture."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from astropy.table import QTable, Table
from numpy.typing import NDArray

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...core.number_text import counted
from ...core.plotting import BLUE, ORANGE, RED, figure_at, label_log_axis, plain_text, styled
from ...core.products import Columns, described_table
from ...core.result import Result
from ...core.statistics import rms
from ...core.units import ARCMIN, ARCSEC, require_count
from ...measure.adaptive_moments import AdaptiveMoments, adaptive_moments
from ...measure.correlation import LARGEST_SEPARATION, LEAST_SEPARATION, MOST_BINS, SeparationBins
from ...measure.focal_plane_axes import draw_key_whisker, draw_whiskers, key_ellipticity, whiskers
from ...measure.rho_statistics import RhoStatistics, rho_statistics
from ...measure.shapes import ShapeFlag, Shapes, fwhm, measure_shapes
from ...measure.star_selection import StarFlag
from ..psf_model.kriging import shape_numbers, star_noise
from ..psf_model.model import PsfModel
from ..stamp_gallery import StampGallery, stretched
from .masked_stars import weight_sigma

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Stars that the picture shows: twice as many.
_SHOWN = 5
#: Largest over least separation of the rho statistics.
_LONGEST_OVER_SHORTEST = 100.0


@check_arguments
@dataclass(frozen=True, eq=False)
class OwnStars(Result):
    """Stars of an image, the PSF model made from the good ones, and its prediction of each star held out.

    Attributes
    ----------
    model : PsfModel
        Of all stars that are used; positions in the unit of the stars'.
    positions : ndarray
        Of all stars, [n, 2].
    snr : ndarray
        Signal-to-noise ratio, [n].
    flags : ndarray
        :class:`~.StarFlag` bits, [n]. Stars of enough S/N are used that have none, or neighbours and cosmic rays that
        leave enough of their core.
    used : ndarray
        [n] bool.
    shapes : Shapes
        Of the stars, angles in rad.
    stamps : ndarray
        Used stars of unit flux, [n_used, ny, nx].
    masks : ndarray
        Pixels of `stamps` without weight, which hold the model in place of the star, bool [n_used, ny, nx].
    electrons : ndarray
        Of the used stars, [n_used].
    parts : list of ndarray
        Indices of the used stars that are held out together.
    refitted : ndarray or None
        Predictions of the used stars by models that were fitted without them, [n_used, ny, nx], where that is needed.
    pixel_scale, weight_fwhm : float
        Of the stamps [rad], and of the weight of the moments [rad].
    kind : str
        ``kriging of pixels``, the default, or ``given`` where there were options of the model.
    """

    _images = ("stamps", "predicted")

    model: PsfModel
    positions: np.ndarray
    snr: np.ndarray
    flags: np.ndarray
    used: NDArray[np.bool_]
    shapes: Shapes
    stamps: np.ndarray
    masks: NDArray[np.bool_]
    electrons: np.ndarray
    parts: list[np.ndarray]
    refitted: np.ndarray | None
    pixel_scale: float
    weight_fwhm: float
    kind: str

    def table(self) -> Table:
        """Return all stars with their shapes and residuals."""
        star_shapes, model_shapes = self.shapes, self.held_out
        star_moments, model_moments = self.adaptive
        columns: Columns = {
            "x": (self.positions[:, 0], "", "place, in the unit of the positions"),
            "y": (self.positions[:, 1], "", "place, in the unit of the positions"),
            "snr": (self.snr, "", "signal-to-noise ratio"),
            "flags": (self.flags, "", "bits of StarFlag"),
            "used": (self.used, "", "whether the model is made of it"),
            "masked": (self._of_all(self.masks.sum(axis=(1, 2))), "", "pixels without weight; -1 if not used"),
            "e1": (star_shapes.e1, "", "(a - b)/(a + b) along x, moments under a round weight"),
            "e2": (star_shapes.e2, "", "the same along the diagonal x = y"),
            "size": (star_shapes.size / ARCSEC, "arcsec", "weighted rms size"),
            "held_out_e1": (model_shapes.e1, "", "e1 of the model made without the star"),
            "held_out_e2": (model_shapes.e2, "", "e2 of the model made without the star"),
            "held_out_size": (model_shapes.size / ARCSEC, "arcsec", "size of the model made without the star"),
        }
        for name, unit, meaning in (
            ("g1", "", "(a - b)/(a + b) along x, adaptive moments"),
            ("g2", "", "the same along the diagonal x = y"),
            ("sigma", "arcsec", "size sqrt(a b) of adaptive moments"),
        ):
            scale = ARCSEC if unit else 1.0
            columns[name] = (self._of_all(getattr(star_moments, name) / scale), unit, meaning)
            held_out_values = self._of_all(getattr(model_moments, name) / scale)
            columns[f"held_out_{name}"] = (held_out_values, unit, f"{name} of the model made without the star")
        return described_table(columns, {})

    @cached_property
    def predicted(self) -> np.ndarray:
        """Models made without the used star and others of its part, of unit sum, [n_used, ny, nx]."""
        if self.refitted is not None:
            return self.refitted
        return self.model.basis.at(self.model.interpolation.left_out(self.parts, self.model.coefficients))

    @cached_property
    def held_out(self) -> Shapes:
        """Shapes of the model made without the star and others of its part; NaN for stars that are not used."""
        values = vars(measure_shapes(self.predicted, self.pixel_scale, self.weight_fwhm))
        return Shapes(**{name: self._of_all(value) for name, value in values.items()})

    @cached_property
    def adaptive(self) -> tuple[AdaptiveMoments, AdaptiveMoments]:
        """Adaptive moments, as GalSim's HSM, of the used stars and of the models made without them."""
        stars, models = (adaptive_moments(images, self.pixel_scale) for images in (self.stamps, self.predicted))
        return stars, models

    @property
    def sigma_e(self) -> np.ndarray:
        """Noise of a component of the ellipticity of the used stars, [n_used]."""
        return np.sqrt((self._noise[:, :2] ** 2).mean(axis=1))

    @property
    def sigma_size(self) -> np.ndarray:
        """Noise of the relative size of the used stars, [n_used]."""
        return self._noise[:, 2]

    @cached_property
    def _noise(self) -> np.ndarray:
        """Noise of e1, e2 and of the relative size, [n_used, 3]."""
        psf = self.predicted.mean(axis=0)
        deviations = (self.stamps - psf).reshape(len(self.stamps), -1)
        filters = shape_numbers(psf, deviations, weight_sigma(self.pixel_scale, self.weight_fwhm) ** 2)[1]
        # Shape numbers are twice the changes of e and of the logarithm of the size.
        masked = self.masks if self.masks.any() else None
        return 0.5 * np.sqrt(star_noise(self.electrons, deviations, psf, filters, masked))

    def residuals(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return e1, e2 and relative size of the used stars less those predicted without them, [n_used] each."""
        star_shapes, model_shapes, used = self.shapes, self.held_out, self.used
        return (
            (star_shapes.e1 - model_shapes.e1)[used],
            (star_shapes.e2 - model_shapes.e2)[used],
            (star_shapes.size / model_shapes.size - 1.0)[used],
        )

    def _of_all(self, values: np.ndarray) -> np.ndarray:
        """Return values of the used stars as those of all; NaN, or -1 of whole numbers, for the others."""
        all_stars = np.full(len(self.used), -1 if values.dtype.kind in "iu" else np.nan, dtype=values.dtype)
        all_stars[self.used] = values
        return all_stars

    def plot(self, title: str = "own stars", *, ax: Axes | Figure | None = None) -> Figure:
        """Draw whiskers, residuals of held-out stars against S/N, rho statistics and stamps."""
        return _draw(self, title, ax)

    def _label(self) -> str:
        return f"{counted(len(self.used), 'star')}, {int(self.used.sum())} used, {self.model!r}"

    def to_table(self) -> QTable:
        """Return the stars of :meth:`table`."""
        return QTable(self.table())

    def _summary(self) -> dict[str, Any]:
        """Return numbers of stars, FWHM, and rms residuals at stars that were held out, beside their noise."""
        d1, d2, size = self.residuals()
        counts = {str(f.name).lower(): int(((self.flags & f) > 0).sum()) for f in StarFlag if f}
        return {
            "kind": self.kind,
            "stars": len(self.used),
            "used": int(self.used.sum()),
            "flagged": counts,
            "median_snr": float(np.median(self.snr[self.used])),
            "fwhm_arcsec": float(np.median(fwhm(self.predicted, self.pixel_scale))) / ARCSEC,
            "rms_e": rms(np.stack([self.shapes.e1[self.used], self.shapes.e2[self.used]])),
            "rms_e_held_out": rms(np.stack([d1, d2])),
            "rms_e_noise": rms(self.sigma_e),
            "rms_size_held_out": rms(size),
            "rms_size_noise": rms(self.sigma_size),
            **self._adaptive_summary(),
            **self._colour_summary(),
        }

    def _adaptive_summary(self) -> dict[str, float]:
        """Return rms of g, and of the residuals of g and T, at stars that were held out."""
        stars, models = self.adaptive
        return {
            "rms_g": rms(np.stack([stars.g1, stars.g2])),
            "rms_g_held_out": rms(np.stack([stars.g1 - models.g1, stars.g2 - models.g2])),
            "rms_dt_g_held_out": rms((stars.T - models.T) / stars.T),
        }

    def _colour_summary(self) -> dict[str, Any]:
        """Return what the stars say of a dependence on their colours; nothing where they have none that differ."""
        colour = self.model.colour
        if colour is None:
            return {}
        return {"colour_probability": colour.probability, "without_colour": colour.stars.n_unknown}

    def rho_statistics(self, bins: int = 8) -> RhoStatistics:
        """Return the rho statistics of the held-out residuals; positions must be in pixels of the stamps."""
        used = self.used
        star_shapes, model_shapes = part_of(self.shapes, used), part_of(self.held_out, used)
        return star_rho_statistics(self.positions[used] * self.pixel_scale, star_shapes, model_shapes, bins)


def part_of(shapes: Shapes, chosen: np.ndarray) -> Shapes:
    """Return the shapes of some stars, those of a mask [n] or of indices."""
    return Shapes(**{name: value[chosen] for name, value in vars(shapes).items()})


def with_left_out(own: OwnStars, positions: np.ndarray, kept: NDArray[np.bool_]) -> OwnStars:
    """Return the result of the stars kept of a catalogue, a mask [n], with rows for all, whose positions are [n, 2]."""

    def of_all(values: np.ndarray, others: float) -> np.ndarray:
        all_stars = np.full(len(kept), others, dtype=values.dtype)
        all_stars[kept] = values
        return all_stars

    shapes = {
        name: of_all(value, ShapeFlag.NOT_CONVERGED if name == "flags" else np.nan)
        for name, value in vars(own.shapes).items()
    }
    return replace(
        own,
        positions=positions,
        snr=of_all(own.snr, np.nan),
        flags=of_all(own.flags, StarFlag.FLAGGED_IN_CATALOGUE),
        used=of_all(own.used, False),
        shapes=Shapes(**shapes),
    )


def star_rho_statistics(places: np.ndarray, stars: Shapes, model: Shapes, bins: int) -> RhoStatistics:
    """Return the rho statistics of a model at stars, whose places on the sky [rad] are [n, 2]."""
    x, y = (places - places.mean(axis=0)).T
    star_values, model_values = ([getattr(s, name) for name in ("e1", "e2", "size")] for s in (stars, model))
    bins = require_count(bins, "bins", 1, MOST_BINS)
    longest = float(np.hypot(np.ptp(x), np.ptp(y)))
    least = LEAST_SEPARATION * _LONGEST_OVER_SHORTEST
    if not least <= longest <= LARGEST_SEPARATION:
        limits = f"{least:g} to {LARGEST_SEPARATION:.4g} rad, with positions in pixels"
        raise DomainError(f"positions: the stars lie within {longest:g} rad; expected {limits}", key="positions")
    separation_bins = SeparationBins(longest / _LONGEST_OVER_SHORTEST, longest, bins)
    return rho_statistics(x, y, *star_values, *model_values, bins=separation_bins)


def _draw(own: OwnStars, title: str, ax: Axes | Figure | None) -> Figure:
    used = own.used
    d1, d2, size = own.residuals()
    x, y = own.positions[used].T
    panels = (
        ("stars", own.shapes.e1[used], own.shapes.e2[used], BLUE),
        ("model without the star", own.held_out.e1[used], own.held_out.e2[used], "0.3"),
        ("difference", d1, d2, RED),
    )
    with styled():
        figure = figure_at(ax, 13.0, 12.0)
        grid = figure.add_gridspec(3, 3, height_ratios=(1.0, 0.9, 1.1))
        key = key_ellipticity(np.hypot(panels[0][1], panels[0][2]))
        scale = 0.12 * max(np.ptp(x), np.ptp(y)) / key
        for column, (name, e1, e2, color) in enumerate(panels):
            axes = figure.add_subplot(grid[0, column])
            draw_whiskers(axes, whiskers(x, y, e1, e2, scale), color, 1.2)
            axes.set(xlabel="x", ylabel="y" if column == 0 else "", aspect="equal")
            margin = 0.05 * max(np.ptp(x), np.ptp(y))
            axes.set(xlim=(x.min() - margin, x.max() + margin), ylim=(y.min() - margin, y.max() + margin))
            axes.set_title(name, loc="left")
            if column == 0:  # one scale for all; on narrow CCDs a longer title would reach the key
                draw_key_whisker(axes, key, scale, 1.2)
        snr = own.snr[used]
        rising = np.argsort(snr)
        for column, (label, values, noise) in enumerate(
            (
                ("weighted e, star - model", np.stack([d1, d2]), own.sigma_e),
                ("size, (star - model)/model", size[None], own.sigma_size),
            )
        ):
            axes = figure.add_subplot(grid[1, column])
            for row, (panel_values, color) in enumerate(zip(values, (BLUE, ORANGE), strict=False)):
                axes.plot(snr, panel_values, ".", color=color, label=f"e{row + 1}" if len(values) > 1 else None)
            for sign in (1.0, -1.0):
                noise_label = "noise of the stars, 1 sigma" if sign > 0.0 else None
                axes.plot(snr[rising], sign * noise[rising], "-", color="0.4", linewidth=1.0, label=noise_label)
            limit = 4.0 * float(np.nanstd(values))
            axes.set(xscale="log", xlabel="S/N", ylim=(-limit, limit))
            label_log_axis(axes.xaxis)
            axes.axhline(0.0, color="0.7", linewidth=0.6)
            axes.set_title(f"{label}; stars held out", loc="left")
            axes.legend()
        axes = figure.add_subplot(grid[1, 2])
        rho = dict(own.rho_statistics().items())
        for name, color in (("rho1", RED), ("rho2", BLUE)):
            correlation = rho[name]
            theta = correlation.r / ARCMIN
            axes.errorbar(theta, correlation.xi_plus, correlation.error_plus, fmt=".-", color=color, label=name)
        axes.axhline(0.0, color="0.7", linewidth=0.6)
        axes.set(xscale="log", xlabel="separation [arcmin]")
        label_log_axis(axes.xaxis)
        axes.ticklabel_format(axis="y", style="sci", scilimits=(0, 0))
        axes.set_title("rho statistics of the held-out stars", loc="left")
        axes.legend()
        _stamps(own, figure.add_subplot(grid[2, :]))
        metrics = own.summary()
        figure.suptitle(
            f"{plain_text(title)}: {metrics['used']} of {counted(metrics['stars'], 'star')}, "
            f"FWHM {metrics['fwhm_arcsec']:.3g} arcsec; "
            f"rms of weighted e held out {100 * metrics['rms_e_held_out']:.2g} %, "
            f"noise of the stars {100 * metrics['rms_e_noise']:.2g} %",
            fontsize=10,
        )
        return figure


def _stamps(own: OwnStars, axes: Axes) -> None:
    """Draw used stars from the brightest to the faintest, the models made without them, and the difference."""
    order = np.argsort(-own.snr[own.used], kind="stable")
    ranks = np.unique(np.linspace(0, len(order) - 1, 2 * _SHOWN).round().astype(int))
    gallery = StampGallery(axes, own.stamps.shape[1], own.pixel_scale)
    for column, star in enumerate(order[ranks]):
        top = own.predicted[star].max()
        stamp = np.where(own.masks[star], np.nan, own.stamps[star])  # blank where there is no weight
        images = (stamp, own.predicted[star], stamp - own.predicted[star])
        for row, image in enumerate(images):
            colours: dict[str, Any] = {"cmap": "viridis", "vmin": float(stretched(np.array(-0.02))), "vmax": 1.0}
            shown = stretched(image / top)
            if row == 2:
                colours, shown = {"cmap": "RdBu_r", "vmin": -0.1, "vmax": 0.1}, image / top
            title = f"S/N {own.snr[own.used][star]:.0f}" if row == 0 else ""
            gallery.show(shown, row, column, title, **colours)
    gallery.finish(3, len(ranks), ("star (asinh)", "model without it", "difference, ±10 %"))
