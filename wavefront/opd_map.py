"""Optical path differences over the entrance pupil, their Zernike terms, and the plot of both."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ..core.errors import DomainError
from ..models.zernike_polynomials import NOLL_NAMES

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class _PupilMaps:
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
    wavelength : float
        Vacuum wavelength [m].
    radius : float
        Radius of the reference sphere [m].
    lit : ndarray of bool
        Where light passes, same shape.
    field : tuple of float
        Field angles [rad].
    center : ndarray, shape [3]
        Centre of the reference sphere, telescope frame [m].
    exit_direction : ndarray, shape [..., 3]
        Directions of the rays at the image, telescope frame; the first two components are the exit-pupil coordinates
        of diffraction integrals.
    landing : ndarray, shape [..., 3]
        Where the rays meet the image surface, telescope frame [m].
    """

    lit: np.ndarray
    field: tuple[float, float]
    center: np.ndarray
    exit_direction: np.ndarray
    landing: np.ndarray

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

    def plot(self, zernikes: ZernikeFit | None = None, name: str = "") -> Figure:
        """Draw the map in nanometres and waves, with and without piston and tilt.

        Parameters
        ----------
        zernikes : ZernikeFit, optional
            Zernike terms, drawn as bars below the maps.
        name : str
            Name of the telescope, for the title.

        Returns
        -------
        matplotlib.figure.Figure

        Raises
        ------
        DomainError
            If the map is not on a square grid, or no light passes.
        """
        from ..core.plotting import new_figure, styled

        if self.value.ndim != 2 or self.value.shape[0] != self.value.shape[1]:
            raise DomainError(f"opd of shape {self.value.shape}: expected one on a square grid to draw")
        tx, ty = np.rad2deg(self.field)
        with styled():
            figure = new_figure(11.0, 5.6 if zernikes is None else 9.0)
            rows = [["map", "rest"]] if zernikes is None else [["map", "rest"], ["bars", "bars"]]
            panels: dict[str, Axes] = figure.subplot_mosaic(rows, height_ratios=(1.0, 0.55)[: len(rows)])
            _draw_map(panels["map"], self, self.value, "as traced: against the reference ray")
            _draw_map(panels["rest"], self, self.without_tilt, "piston and tilt removed")
            if zernikes is not None:
                _draw_bars(panels["bars"], zernikes)
            what = f"{name}: optical" if name else "Optical"
            figure.suptitle(
                f"{what} path difference at field ({tx:g}, {ty:g}) deg, {self.wavelength * 1e9:g} nm", fontsize=11
            )
            return figure


@dataclass(frozen=True, kw_only=True)
class OpdMaps(_PupilMaps):
    """Optical path differences over the entrance pupil, one map for each field point.

    Attributes
    ----------
    value : ndarray, shape [n_field, ...]
        Path of the chief ray minus path of the ray [m], to the reference sphere; positive where the wavefront leads.
        NaN where no light passes. The axes after the first are those of the pupil coordinates.
    x, y : ndarray, shape [...]
        Entrance-pupil coordinates [m].
    wavelength : float
        Vacuum wavelength [m].
    radius : float
        Radius of the reference spheres [m].
    fields : ndarray, shape [n_field, 2]
        Field angles [rad].
    centers : ndarray, shape [n_field, 3]
        Centres of the reference spheres, telescope frame [m].
    """

    fields: np.ndarray
    centers: np.ndarray

    def __len__(self) -> int:
        return len(self.fields)

    @cached_property
    def lit(self) -> np.ndarray:
        """Where light passes, shape [n_field, ...] bool."""
        return np.isfinite(self.value)

    @property
    def rms(self) -> np.ndarray:
        """Root mean square of each map over its lit points, piston removed [m], shape [n_field]; NaN where dark."""
        return np.array([_rms(value, lit) for value, lit in zip(self.value, self.lit, strict=True)])


@dataclass(frozen=True)
class ZernikeFit:
    """Annular Zernike coefficients of an OPD map.

    Attributes
    ----------
    coefficients : ndarray, shape [jmax]
        Noll order from j = 1 [m]; orthonormal terms, so each is its own rms over the unvignetted annulus.
    obscuration : float
        Inner over outer radius of the annulus.
    residual_rms : float
        Root mean square of the residuals [m].
    """

    coefficients: np.ndarray
    obscuration: float
    residual_rms: float


def _rms(value: np.ndarray, lit: np.ndarray) -> float:
    return float(np.std(value[lit])) if lit.any() else float("nan")


def _draw_map(axes: Axes, opd: OpdMap, value: np.ndarray, title: str) -> None:
    from ..core.plotting import figure_of

    nm, wavelength = value * 1e9, opd.wavelength * 1e9
    edge = max(float(np.nanmax(np.abs(nm))), 1e-6)
    half = float(np.abs(opd.x).max()) + 0.5 * abs(float(opd.x[0, 1] - opd.x[0, 0]))
    image = axes.imshow(nm, extent=(-half, half, -half, half), cmap="RdBu_r", vmin=-edge, vmax=edge)
    axes.set_facecolor("0.93")
    axes.set_aspect("equal")
    axes.set_xlabel("entrance pupil x [m]")
    axes.set_ylabel("entrance pupil y [m]")
    rms, span = float(np.nanstd(nm)), float(np.nanmax(nm) - np.nanmin(nm))
    axes.set_title(
        f"{title}\nrms {rms:.4g} nm = {rms / wavelength:.4f} waves; peak to valley {span:.4g} nm", loc="left"
    )
    bar = figure_of(axes).colorbar(image, ax=axes, location="right", fraction=0.046, pad=0.02)
    bar.set_label("OPD [nm]: positive where the wavefront leads")
    waves = bar.ax.secondary_yaxis(
        "left", functions=(lambda v: np.divide(v, wavelength), lambda v: np.multiply(v, wavelength))
    )
    waves.tick_params(labelsize=7)
    waves.set_ylabel(f"waves at {wavelength:g} nm", fontsize=8, labelpad=2)


def _draw_bars(axes: Axes, zernikes: ZernikeFit) -> None:
    from ..core.plotting import BLUE

    j = np.arange(2, len(zernikes.coefficients) + 1)
    axes.bar(j, zernikes.coefficients[1:] * 1e9, color=BLUE, width=0.75)
    axes.axhline(0.0, color="0.3", linewidth=0.7)
    if len(j) <= 45:
        axes.set_xticks(
            j, [f"{n} {NOLL_NAMES.get(int(n), '')}".strip() for n in j], rotation=60, ha="right", rotation_mode="anchor"
        )
    axes.set_xlim(1.3, j[-1] + 0.7)
    # Tilt is often far larger than all else; a scale that is linear about zero shows both.
    largest = float(np.abs(zernikes.coefficients[1:]).max()) * 1e9
    axes.set_yscale("symlog", linthresh=max(largest / 100.0, 1e-3))
    axes.grid(True, axis="y", color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.set_ylabel("coefficient = rms over the annulus [nm]")
    axes.set_xlabel("Noll index")
    axes.set_title(
        f"annular Zernikes, obscuration {zernikes.obscuration:g}; residual {zernikes.residual_rms * 1e9:.3g} nm rms",
        loc="left",
    )
