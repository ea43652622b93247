"""Maps of the optical path difference over the entrance pupil, their Zernike terms, and the plot of both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from ..core.arguments import check_arguments
from ..core.docstrings import Description, described
from ..core.errors import DomainError
from ..core.plotting import BLUE, axes_at, figure_at, figure_of, length_unit_of, plain_text, styled, symlog_scale
from ..core.result import Result
from ..models.zernike_polynomials import NOLL_NAMES

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..core.products import Card


@dataclass(frozen=True)
class _PupilMaps(Result):
    """Maps over the entrance pupil, of one field point or of many."""

    value: np.ndarray
    x: np.ndarray
    y: np.ndarray
    wavelength: float
    radius: float

    @property
    def waves(self) -> np.ndarray:
        """OPD in waves."""
        return self.value / self.wavelength

    def _image_cards(self) -> Sequence[Card]:
        """Return the distance of the points of a square grid as poppy reads it, and the wavelength."""
        wavelength = ("WAVELEN", self.wavelength, "[m] vacuum wavelength")
        if self.x.ndim != 2 or min(self.x.shape) < 2:
            return (wavelength,)
        step = float((self.x[0, -1] - self.x[0, 0]) / (self.x.shape[1] - 1))
        if not (np.allclose(np.diff(self.x, axis=1), step) and np.allclose(np.diff(self.y, axis=0), step)):
            return (wavelength,)
        comment = "[m/pixel] entrance pupil"
        return (
            wavelength,
            ("PUPLSCAL", step, comment),
            ("PIXELSCL", step, comment),
            ("PIXUNIT", "meter", "of PIXELSCL"),
        )


@dataclass(frozen=True, kw_only=True)
class OpdMap(_PupilMaps):
    """Optical path difference over the entrance pupil.

    Attributes
    ----------
    value : ndarray
        Path of the reference ray minus path of the ray [m], to the reference sphere; positive where the wavefront
        leads. NaN where no light passes. Shape of the pupil coordinates.
    x, y : ndarray
        Entrance-pupil coordinates [m], same shape.
    wavelength, radius : float
        Vacuum wavelength, and radius of the reference sphere [m].
    lit : ndarray of bool
        Mask of the points where light passes, same shape.
    field : tuple of float
        Field angles [rad].
    center : ndarray, shape [3]
        Centre of the reference sphere, telescope frame [m].
    exit_direction, landing : ndarray, shape [..., 3]
        Unit directions of the rays at the image surface and their landing points on it [m], telescope frame. The first
        two components of the directions are the exit-pupil coordinates of diffraction integrals.
    """

    _images = ("value", "lit")

    lit: np.ndarray
    field: tuple[float, float]
    center: np.ndarray
    exit_direction: np.ndarray
    landing: np.ndarray

    def _label(self) -> str:
        field = ", ".join(f"{angle:.4g}" for angle in np.rad2deg(self.field))
        return f"{list(self.value.shape)} points at ({field}) deg, {self.wavelength * 1e9:.5g} nm, rms {self.rms:.3g} m"

    def _columns(self) -> dict[str, Any]:
        # astropy cannot write a column of the name "value" as ECSV.
        columns = {"x": self.x, "y": self.y, "opd": self.value, "lit": self.lit}
        return {name: np.ravel(values) for name, values in columns.items()}

    def _described(self, name: str) -> Description:
        return described(type(self), "value" if name == "opd" else name)

    @property
    def rms(self) -> float:
        """Root mean square over the lit points, piston removed [m]; NaN where no light passes."""
        return _rms(self.value, self.lit)

    @property
    def peak_to_valley(self) -> float:
        """Highest minus lowest value over the lit points [m]."""
        return float(np.ptp(self.value[self.lit]))

    @property
    def without_tilt(self) -> np.ndarray:
        """The map [m] less the piston and tilts that fit its lit points best."""
        if not self.lit.any():
            raise DomainError(f"field = {self.field}: no light passes; expected a lit pupil")
        plane = np.stack([np.ones_like(self.x), self.x, self.y], axis=-1)
        terms, *_ = np.linalg.lstsq(plane[self.lit], self.value[self.lit], rcond=None)
        return self.value - plane @ terms

    @check_arguments
    def plot(self, zernikes: ZernikeFit | None = None, name: str = "", *, ax: Axes | Figure | None = None) -> Figure:
        """Draw the map in nanometres and waves, with and without piston and tilt, and Zernike terms as bars.

        The title contains the ``name`` of the telescope. A map that is not on a square grid or has no lit point raises
        :class:`~pachon.errors.DomainError`.
        """
        if self.value.ndim != 2 or self.value.shape[0] != self.value.shape[1]:
            raise DomainError(f"opd of shape {self.value.shape}: expected one on a square grid to draw")
        tx, ty = np.rad2deg(self.field)
        with styled():
            figure = figure_at(ax, 11.0, 5.6 if zernikes is None else 9.0)
            rows = [["map", "rest"]] if zernikes is None else [["map", "rest"], ["bars", "bars"]]
            panels: dict[str, Axes] = figure.subplot_mosaic(rows, height_ratios=(1.0, 0.55)[: len(rows)])
            _draw_map(panels["map"], self, self.value, "as traced: against the reference ray")
            _draw_map(panels["rest"], self, self.without_tilt, "piston and tilt removed")
            if zernikes is not None:
                _draw_bars(panels["bars"], zernikes)
            subject = f"{plain_text(name)}: optical" if name else "Optical"
            title = f"{subject} path difference at field ({tx:g}, {ty:g}) deg, {self.wavelength * 1e9:g} nm"
            figure.suptitle(title, fontsize=11)
            return figure


@dataclass(frozen=True, kw_only=True)
class OpdMaps(_PupilMaps):
    """Optical path differences over the entrance pupil, one map for each field point.

    Attributes
    ----------
    value : ndarray, shape [n_field, ...]
        As in :class:`OpdMap`, against the chief rays; the axes after the first are those of the pupil coordinates.
    x, y, wavelength, radius
        As in :class:`OpdMap`, the same for all field points.
    fields : ndarray, shape [n_field, 2]
        Field angles [rad].
    centers : ndarray, shape [n_field, 3]
        Centres of the reference spheres, telescope frame [m].
    """

    _table = ("fields", "rms", "centers")
    _images = ("value",)

    fields: np.ndarray
    centers: np.ndarray

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw the maps of the first six field points on one scale."""
        count = min(len(self), 6)
        edge = max(float(np.nanmax(np.abs(self.value[:count]), initial=0.0)) * 1e9, 1e-6)
        with styled():
            figure = figure_at(ax, 2.4 * count + 1.0, 3.0)
            panels = figure.subplots(1, count, squeeze=False)[0]
            for axes, value, field in zip(panels, self.value, np.rad2deg(self.fields), strict=False):
                points = (np.ravel(v) for v in np.broadcast_arrays(self.x, self.y, 1e9 * value))
                x, y, nm = (v[np.isfinite(np.ravel(value))] for v in points)
                shown = axes.scatter(x, y, c=nm, s=4, cmap="RdBu_r", vmin=-edge, vmax=edge, linewidths=0)
                axes.set(aspect="equal", xlabel="pupil x [m]", title=f"({field[0]:.3g}, {field[1]:.3g})°")
            panels[0].set_ylabel("pupil y [m]")
            figure.colorbar(shown, ax=list(panels), label="OPD [nm]")
            return figure

    def __len__(self) -> int:
        return len(self.fields)

    @cached_property
    def lit(self) -> np.ndarray:
        """Mask of the points where light passes, shape [n_field, ...]."""
        return np.isfinite(self.value)

    @property
    def rms(self) -> np.ndarray:
        """Values of :attr:`OpdMap.rms` [m], shape [n_field]."""
        return np.array([_rms(value, lit) for value, lit in zip(self.value, self.lit, strict=True)])


@dataclass(frozen=True)
class ZernikeFit(Result):
    """Annular Zernike coefficients of an OPD map.

    Attributes
    ----------
    coefficients : ndarray, shape [jmax]
        Noll order from j = 1 [m]; orthonormal terms, so each is its own rms over the unvignetted annulus.
    obscuration, residual_rms : float
        Inner over outer radius of the annulus, and root mean square of the residuals [m].
    """

    _table = ("noll", "coefficients")

    coefficients: np.ndarray
    obscuration: float
    residual_rms: float

    @property
    def noll(self) -> np.ndarray:
        """Noll indices, shape [jmax]."""
        return np.arange(1, len(self.coefficients) + 1)

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw the terms from tilt on as bars."""
        with styled():
            figure, axes = axes_at(ax, 9.0, 3.6)
            _draw_bars(axes, self)
            return figure


def _rms(value: np.ndarray, lit: np.ndarray) -> float:
    return float(np.std(value[lit])) if lit.any() else float("nan")


def _draw_map(axes: Axes, opd: OpdMap, value: np.ndarray, title: str) -> None:
    nm, wavelength = value * 1e9, opd.wavelength * 1e9
    edge = max(float(np.nanmax(np.abs(nm))), 1e-6)
    half = float(np.abs(opd.x).max()) + 0.5 * abs(float(opd.x[0, 1] - opd.x[0, 0]))
    unit, size = length_unit_of(half)
    frame = np.array([-half, half, -half, half]) * size
    image = axes.imshow(nm, extent=tuple(frame.tolist()), cmap="RdBu_r", vmin=-edge, vmax=edge)
    axes.set(facecolor="0.93", aspect="equal", xlabel=f"entrance pupil x [{unit}]", ylabel=f"entrance pupil y [{unit}]")
    rms, span = float(np.nanstd(nm)), float(np.nanmax(nm) - np.nanmin(nm))
    title += f"\nrms {rms:.4g} nm = {rms / wavelength:.4f} waves; peak to valley {span:.4g} nm"
    axes.set_title(title, loc="left")
    bar = figure_of(axes).colorbar(image, ax=axes, location="right", fraction=0.046, pad=0.02)
    bar.set_label("OPD [nm]: positive where the wavefront leads")
    scales = (lambda v: np.divide(v, wavelength), lambda v: np.multiply(v, wavelength))
    waves = bar.ax.secondary_yaxis("left", functions=scales)
    waves.tick_params(labelsize=7)
    waves.set_ylabel(f"waves at {wavelength:g} nm", fontsize=8, labelpad=2)


def _draw_bars(axes: Axes, zernikes: ZernikeFit) -> None:
    j = np.arange(2, len(zernikes.coefficients) + 1)
    axes.bar(j, zernikes.coefficients[1:] * 1e9, color=BLUE, width=0.75)
    axes.axhline(0.0, color="0.3", linewidth=0.7)
    if len(j) <= 45:
        names = [f"{n} {NOLL_NAMES.get(int(n), '')}".strip() for n in j]
        axes.set_xticks(j, names, rotation=60, ha="right", rotation_mode="anchor")
    axes.set_xlim(1.3, j[-1] + 0.7)
    largest = float(np.abs(zernikes.coefficients[1:]).max()) * 1e9
    # Tilt is often far larger than all other terms; a scale that is linear about zero shows them too.
    symlog_scale(axes, max(largest / 100.0, 1e-3))
    axes.grid(True, axis="y", color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.set(xlabel="Noll index", ylabel="coefficient = rms over the annulus [nm]")
    residual = f"residual {zernikes.residual_rms * 1e9:.3g} nm rms"
    axes.set_title(f"annular Zernikes, obscuration {zernikes.obscuration:g}; {residual}", loc="left")
