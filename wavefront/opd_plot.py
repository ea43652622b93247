"""The picture of one wavefront: its map over the pupil, and its Zernike terms."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..core.errors import DomainError
from ..core.plotting import BLUE, figure_of, new_figure, styled
from ..models.zernike_polynomials import NOLL_NAMES
from .opd import OpdMap
from .zernike import ZernikeFit


def opd_figure(opd: OpdMap, zernikes: ZernikeFit | None, name: str) -> Figure:
    """Draw an OPD map in nanometres and waves, with and without piston and tilt, over the bars of its Zernike terms.

    Parameters
    ----------
    opd : OpdMap
        Map on a square grid.
    zernikes : ZernikeFit, optional
        Its annular Zernike terms.
    name : str
        Name of the telescope.

    Raises
    ------
    DomainError
        If the map is not on a square grid, or no light passes.
    """
    if opd.value.ndim != 2 or opd.value.shape[0] != opd.value.shape[1]:
        raise DomainError(f"opd of shape {opd.value.shape}: expected one on a square grid to draw")
    tx, ty = np.rad2deg(opd.field)
    with styled():
        figure = new_figure(11.0, 5.6 if zernikes is None else 9.0)
        rows = [["map", "rest"]] if zernikes is None else [["map", "rest"], ["bars", "bars"]]
        panels: dict[str, Axes] = figure.subplot_mosaic(rows, height_ratios=(1.0, 0.55)[: len(rows)])
        _draw_map(panels["map"], opd, opd.value, "as it is: against the reference ray")
        _draw_map(panels["rest"], opd, opd.without_tilt, "piston and tilt taken off")
        if zernikes is not None:
            _draw_bars(panels["bars"], zernikes)
        what = f"{name}: optical" if name else "Optical"
        figure.suptitle(
            f"{what} path difference at field ({tx:g}, {ty:g}) deg, {opd.wavelength * 1e9:g} nm", fontsize=11
        )
        return figure


def _draw_map(axes: Axes, opd: OpdMap, value: np.ndarray, title: str) -> None:
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
        f"annular Zernikes, obscuration {zernikes.obscuration:g}; left over {zernikes.residual_rms * 1e9:.3g} nm rms",
        loc="left",
    )
