"""Seidel diagram: third-order and chromatic wavefront aberrations of each surface, as bars."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.plotting import plain_text, symlog_scale
from ...core.units import angle as one_angle
from ...models.first_order import chromatic_sums, seidel_sums
from ...models.telescope import Telescope
from ...wavefront.pupil_sampling import CHIEF_RAY
from ...wavefront.request import Request
from .analysis import Analysis, Columns

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Names of the aberrations, symbols of their coefficients, and factors from Seidel or chromatic sums to wavefront.
ABERRATIONS = ("spherical", "coma", "astigmatism", "Petzval", "distortion", "axial colour", "lateral colour")
SYMBOLS = ("W040", "W131", "W222", "W220P", "W311", "W020λ", "W111λ")
_FACTORS = np.array([1 / 8, 1 / 2, 1 / 2, 1 / 4, 1 / 2, 1 / 2, 1.0])
_COLORS = ("#1f6fbf", "#c8322b", "#e08a00", "#2a9d6f", "#7a4fb5", "#8c8c8c", "#d7b400")
#: Surfaces beyond which their names stand upright.
_CROWDED = 18


@dataclass(frozen=True)
class SeidelDiagram(Analysis):
    """Third-order and chromatic wavefront aberrations at the rims of pupil and field, surface by surface.

    Attributes
    ----------
    names : tuple of str
        Mirrors and lens surfaces.
    coefficients : ndarray, shape [n_surface, 7]
        Wavefront [m] in the order of :data:`ABERRATIONS`: S1/8, S2/2, S3/2, S4/4, S5/2, C_L/2, C_T; positive where the
        path of the ray at the rim is longer. The colours are between the edges of the band.
    """

    names: tuple[str, ...]
    coefficients: np.ndarray

    @property
    def waves(self) -> np.ndarray:
        """Wavefront in waves, shape [n_surface, 7]."""
        return self.coefficients / self.wavelength

    @property
    def total(self) -> np.ndarray:
        """Sums over the surfaces [waves], shape [7]."""
        return self.waves.sum(axis=0)

    @property
    def _title(self) -> str:
        return f"Seidel diagram, field {self.field_labels()[0]}, {self._nanometres()}"

    @property
    def _panels(self) -> tuple[int, int, float, float]:
        return 1, 1, min(max(6.5, 1.2 + 0.75 * (len(self.names) + 1)), 14.0), 4.4

    def _table_columns(self) -> Columns:
        columns: Columns = {"surface": (np.array(self.names), "", "mirror or lens surface")}
        return columns | {
            s.replace("λ", "_color"): (self.waves[:, i], "", f"{name} [waves]")
            for i, (s, name) in enumerate(zip(SYMBOLS, ABERRATIONS, strict=True))
        }

    def _values(self) -> dict[str, Any]:
        return {
            "surfaces": list(self.names),
            "aberrations": list(ABERRATIONS),
            "coefficients": list(SYMBOLS),
            "waves": self.waves,
            "total_waves": self.total,
        }

    def _draw(self, panels: Sequence[Axes]) -> None:
        (axes,) = panels
        bars = np.vstack([self.waves, self.total])
        place, width = np.arange(len(bars)), 0.85 / len(ABERRATIONS)
        for i, (name, color) in enumerate(zip(ABERRATIONS, _COLORS, strict=True)):
            label = f"{SYMBOLS[i]} {name}"
            axes.bar(place + (i - 3) * width, bars[:, i], width, color=color, label=label)
        axes.axhline(0.0, color="0.3", linewidth=0.7)
        axes.axvline(len(self.names) - 0.5, color="0.3", linewidth=0.9)
        largest = float(np.abs(bars).max())
        if largest > 100.0 * float(np.abs(self.total).max()):
            # The sums would be too small to be visible.
            symlog_scale(axes, max(largest / 1000.0, 1e-9))
        names = [*map(plain_text, self.names), "sum"]
        crowded = len(names) > _CROWDED
        axes.set_xticks(
            place,
            names,
            rotation=90 if crowded else 40,
            ha="right",
            va="center" if crowded else "top",
            rotation_mode="anchor",
            fontsize=7.5,
        )
        axes.set(ylabel="wavefront [waves]", xlim=(-0.5, len(bars) - 0.5))
        axes.grid(True, axis="y", color="0.92", linewidth=0.6)
        axes.set_axisbelow(True)
        # Above the bars, which fill the diagram in no order.
        axes.legend(fontsize=7, ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)


@check_arguments
def seidel_diagram(
    telescope: Telescope | Request, wavelength: ArrayLike | None = None, *, field: ArrayLike | None = None
) -> SeidelDiagram:
    """Compute third-order and chromatic aberrations of each surface of a centred telescope.

    Parameters
    ----------
    telescope : Telescope or Request
        Prescription; its surfaces must share one axis. A request has the wavelength too; its fields are not used.
    wavelength : float or Quantity, optional
        Vacuum wavelength of the rays and of the waves [m]; the telescope's default where not given.
    field : float or Quantity, optional
        Angle of the chief ray from the axis [rad]; the radius of the field of view where not given.

    Raises
    ------
    DomainError
        If no surface acts, one is decentred or tilted, or the wavelength or field is not covered.
    """
    if isinstance(telescope, Request):
        stated = Request.of(telescope, None, wavelength, one_wavelength=True)
        telescope, wavelength = stated.telescope, stated.wavelength
    angle = telescope.field_radius if field is None else one_angle(field, "field")
    request = Request.of(telescope, (0.0, angle), wavelength, sampling=CHIEF_RAY, one_wavelength=True)
    sums = seidel_sums(telescope, request.wavelength, angle)
    colors = chromatic_sums(telescope, telescope.band, angle)
    contributions = np.hstack([sums.contributions, colors.contributions])
    return SeidelDiagram(request, sums.names, contributions * _FACTORS)
