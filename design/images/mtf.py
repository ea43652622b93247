r"""Modulation transfer function: contrast of a sinusoidal pattern in the image against spatial frequency.

The optical transfer function is the autocorrelation of the pupil in direction cosines: at the frequency f it is the
overlap of the wave in the pupil with itself, shifted by the wavelength times f. The lattices of all wavelengths
(:mod:`~pachon.design.images.wavelets`) have spacings in proportion to the wavelength, so the frequencies are the same
and the complex transfer functions add up to that of all the light.

Tangential modulation is along the direction in which the image of a star moves with its distance from the axis;
sagittal modulation is across it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.fft
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...core.plotting import BLUE, RED, figure_at, styled
from ...core.threads import one_blas_thread
from ...core.units import MOST, arcseconds, require_count
from ...models.central_obscuration import central_obscuration
from ...models.telescope import Telescope
from ...raytrace.rays import Projection
from ...wavefront.request import Request
from ..drawing import finish_axes, grid_shape, legend_below, panels_of, second_scale
from ..metrics.principal_rays import PrincipalRays, principal_rays_of
from ..metrics.spots import spot_diagram
from ..result import FieldResult
from .wavelets import lattice_wavelets, range_of_cosines, require_light, spot_reach

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Panels in a row.
_MOST = 3
#: Smallest default number of lattice points across the pupil.
_FEWEST = 256
#: Largest default number of lattice points across the pupil.
_MOST_ACROSS = 2048
#: Rays that are summed at a time, which bounds the memory.
_RAYS = 4096


@dataclass(frozen=True)
class Mtf(FieldResult):
    """Modulation transfer of several field points, all wavelengths together.

    Attributes
    ----------
    frequency : ndarray, shape [n_frequency]
        Spatial frequencies on the detector, from zero [cycles/m].
    tangential, sagittal : ndarray, shape [n_field, n_frequency]
        Modulation transfer, 1 at zero.
    tangential_limit, sagittal_limit : ndarray, shape [n_field, n_frequency]
        Modulation transfer of the same pupils, vignetting included, with perfect wavefronts.
    geometric_tangential, geometric_sagittal : ndarray, shape [n_field, n_frequency]
        Modulation transfer of the rays alone, without diffraction.
    f_number : ndarray, shape [n_field, 2]
        Focal ratios, tangential and sagittal; the cut-off is 1 / (wavelength f_number). Of an afocal telescope that
        of an ideal lens of 1 m.
    plate_scale : ndarray, shape [n_field, 2]
        Angle on the sky over length on the detector [rad/m], tangential and sagittal.
    obscuration : float
        Inner over outer diameter of the entrance pupil.
    """

    _on_image = ("frequency", "plate_scale")

    frequency: np.ndarray
    tangential: np.ndarray
    sagittal: np.ndarray
    tangential_limit: np.ndarray
    sagittal_limit: np.ndarray
    geometric_tangential: np.ndarray
    geometric_sagittal: np.ndarray
    f_number: np.ndarray
    plate_scale: np.ndarray
    obscuration: float

    @property
    def cutoff(self) -> np.ndarray:
        """Cut-off frequencies of the shortest wavelength [cycles/m], tangential and sagittal, shape [n_field, 2]."""
        return 1.0 / (self.wavelengths.min() * self.f_number)

    @check_arguments
    def frequency_at(self, contrast: float) -> np.ndarray:
        """Return the lowest frequency at which the contrast falls to a value [cycles/m], shape [n_field, 2].

        Tangential and sagittal; NaN where the contrast stays above it.
        """
        if not 0 < contrast < 1:
            raise DomainError(f"contrast = {contrast!r}: expected a number between 0 and 1")
        return np.stack(
            [[_falls_to(row, self.frequency, contrast) for row in m] for m in (self.tangential, self.sagittal)], axis=-1
        )

    def _columns(self) -> dict[str, Any]:
        return self._along(
            "frequency",
            "tangential",
            "sagittal",
            "tangential_limit",
            "sagittal_limit",
            "geometric_tangential",
            "geometric_sagittal",
        )

    def _summary(self) -> dict[str, Any]:
        """Return the results by name and unit; pairs are tangential, sagittal; lists run over the fields."""
        arcsec = arcseconds(self.plate_scale)
        half = self.frequency_at(0.5)
        return {
            "telescope": self.telescope,
            "wavelength_nm": self.wavelengths * 1e9,
            **self.field_items(),
            "obscuration": self.obscuration,
            # That of the ideal lens, where the image is at infinity.
            **({} if self.in_angles else {"f_number": self.f_number}),
            **self.on_image({"cutoff_cycles_per_mm": self.cutoff * 1e-3}),
            **self.of_sky({"cutoff_cycles_per_arcsec": self.cutoff / arcsec}),
            **self.on_image({"half_contrast_cycles_per_mm": half * 1e-3}),
            **self.of_sky({"half_contrast_cycles_per_arcsec": half / arcsec}),
            **self.on_image(self.of_sky({"plate_scale_arcsec_per_um": arcsec * 1e-6})),
            **self.on_image({"frequency_cycles_per_mm": self.frequency * 1e-3}),
            "tangential": self.tangential,
            "sagittal": self.sagittal,
            "tangential_limit": self.tangential_limit,
            "sagittal_limit": self.sagittal_limit,
            "geometric_tangential": self.geometric_tangential,
            "geometric_sagittal": self.geometric_sagittal,
        }

    def plot(self, ax: Axes | Figure | None = None) -> Figure:
        """Draw the contrast against the frequency, with the limit that diffraction sets."""
        count = len(self.fields)
        rows, columns = grid_shape(count, _MOST)
        with styled():
            figure = figure_at(ax, max(3.5 * columns, 5.5), 2.6 * rows + 1.0)
            panels = panels_of(figure, count, rows, columns, sharex=True, sharey=True)
            for i, axes in enumerate(panels):
                _draw_field(axes, self, i)
            for i, axes in enumerate(panels):
                if i % columns == 0:
                    axes.set_ylabel("contrast")
                if i + columns >= count:
                    axes.set_xlabel(self.image_text("spatial frequency [cycles/mm]"))
                    axes.tick_params(labelbottom=True)
            legend_below(figure, panels[0], 3 if columns > 1 else 2)
            return self._titled(figure, f"modulation transfer, {self._nanometres()}")


@check_arguments
@one_blas_thread()
def mtf(
    telescope: Telescope | Request,
    fields: ArrayLike | None = None,
    wavelengths: ArrayLike | None = None,
    *,
    wavelength_weights: ArrayLike | None = None,
    n_pupil: int | None = None,
    projection: Projection | None = None,
    threads: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> Mtf:
    """Return the modulation transfer of the telescope over the field.

    Parameters
    ----------
    telescope, fields, wavelengths, wavelength_weights, projection, threads
        As in :meth:`pachon.Request.of`.
    n_pupil : int, optional
        Lattice points across the pupil at the shortest wavelength, and so about the number of frequencies; by default
        256, or more where the spots need them.
    progress : callable, optional
        Called with the number of pairs of field and wavelength done since the last call.

    Raises
    ------
    DomainError
        If no light passes, or the lattice is too coarse for the spots.
    """
    request = Request.of(
        telescope, fields, wavelengths, wavelength_weights=wavelength_weights, projection=projection, threads=threads
    )
    telescope = request.telescope
    principal, diagram = principal_rays_of(request), spot_diagram(request)
    require_light(diagram)
    period = range_of_cosines(principal) / float(request.wavelengths.min())
    reach = spot_reach(diagram)
    needed = int(np.ceil(2.0 * reach * period))
    across = max(_FEWEST, needed) if n_pupil is None else require_count(n_pupil, "n_pupil", 16, math.isqrt(MOST))
    if across < needed or (n_pupil is None and across > _MOST_ACROSS):
        reason = f"n_pupil = {across}: too few" if n_pupil else f"more than {_MOST_ACROSS} points are needed"
        raise DomainError(
            f"{reason} for spots of {2e6 * reach:.4g} um; expected at least {needed}, or smaller spots", key="n_pupil"
        )
    step = period / across
    frequency = np.arange(across + 1) * step
    angles = tangential_angle(telescope, principal)
    shape = (2, len(request.fields), len(frequency))
    transfer, perfect, rays = np.zeros(shape, complex), np.zeros(shape, complex), np.zeros(shape, complex)
    for i, (center, angle) in enumerate(zip(diagram.reference_point, angles, strict=True)):
        field_request = request.at_fields(slice(i, i + 1))
        for wavelength, weight in zip(request.wavelengths, request.weights, strict=True):
            lattice = lattice_wavelets(field_request, float(wavelength), center, float(wavelength) * step, float(angle))
            for total, pupil in ((transfer, lattice.wavelets.field), (perfect, np.abs(lattice.wavelets.field))):
                for axis in (0, 1):
                    overlap = _overlap(pupil if axis == 0 else pupil.T, len(frequency))
                    # The square of the lit fraction of a cell on the rim is too little light.
                    overlap[0] = lattice.wavelets.lit_fraction * (lattice.spacing / wavelength) ** 2
                    total[axis, i] += weight * overlap
            if progress is not None:
                progress(1)
        directions = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        offset = np.where(diagram.weight[i][..., None] > 0, diagram.displacement[i], 0.0) @ directions.T
        for axis in (0, 1):
            rays[axis, i] = _transfer_of_rays(frequency, offset[..., axis].ravel(), diagram.weight[i].ravel())
    contrast, limit, geometric = (np.abs(v) / np.abs(v[..., :1]) for v in (transfer, perfect, rays))
    return Mtf(
        request=request,
        frequency=frequency,
        tangential=contrast[0],
        sagittal=contrast[1],
        tangential_limit=limit[0],
        sagittal_limit=limit[1],
        geometric_tangential=geometric[0],
        geometric_sagittal=geometric[1],
        f_number=principal.f_number,
        plate_scale=principal.plate_scale,
        obscuration=central_obscuration(telescope),
    )


def tangential_angle(telescope: Telescope, principal: PrincipalRays) -> np.ndarray:
    """Return the angle from the x axis of the detector to the tangential direction [rad], shape [n_field]."""
    # An ideal lens takes parallel light from places on it to directions opposite to them.
    ends = -principal.marginal_position if telescope.design_data.afocal else principal.marginal_direction
    across = telescope.surfaces[-1].along(ends[:, 0] - ends[:, 1])
    return np.arctan2(across[:, 1], across[:, 0])


def _transfer_of_rays(frequency: np.ndarray, place: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Return the transform of light at places [m] at frequencies [cycles/m]."""
    total = np.zeros(len(frequency), dtype=np.complex128)
    for first in range(0, len(place), _RAYS):
        batch = slice(first, first + _RAYS)
        total += np.exp(-2j * np.pi * np.multiply.outer(frequency, place[batch])) @ light[batch]
    return total


def _overlap(pupil: np.ndarray, count: int) -> np.ndarray:
    """Return the overlap of a pupil with itself shifted along its last axis, by 0, 1... points."""
    length = scipy.fft.next_fast_len(pupil.shape[-1] + count)
    power = np.abs(scipy.fft.fft(pupil, length, axis=-1)) ** 2
    return scipy.fft.ifft(power.sum(axis=0))[:count]


def _falls_to(row: np.ndarray, frequency: np.ndarray, contrast: float) -> float:
    below = np.flatnonzero(row <= contrast)
    if not len(below):
        return float("nan")
    k = int(below[0])
    return float(np.interp(contrast, row[[k, k - 1]], frequency[[k, k - 1]]))


def _draw_field(axes: Axes, result: Mtf, i: int) -> None:
    frequency = result.frequency * 1e-3
    for name, color, solid, limit, rays in (
        ("tangential", BLUE, result.tangential, result.tangential_limit, result.geometric_tangential),
        ("sagittal", RED, result.sagittal, result.sagittal_limit, result.geometric_sagittal),
    ):
        axes.plot(frequency, limit[i], color=color, linewidth=0.8, alpha=0.55, label=f"{name}, perfect wavefront")
        axes.plot(frequency, rays[i], color=color, linewidth=0.8, linestyle=(0, (1, 1.5)), label=f"{name}, rays alone")
        axes.plot(frequency, solid[i], color=color, linewidth=1.5, label=name)
    finish_axes(axes, xlim=(0.0, frequency[-1]), ylim=(0.0, 1.0))
    half = result.frequency_at(0.5)[i] * 1e-3
    text = f"{result.field_labels()[i]}\n50 % at {half[0]:.3g} (t), {half[1]:.3g} (s)"
    axes.text(0.97, 0.95, text, transform=axes.transAxes, ha="right", va="top", fontsize=8)
    if i < _MOST and result.on_sky:
        arcsec_per_mm = float(np.rad2deg(result.plate_scale[i].mean())) * 3600e-3
        second_scale(axes, 1.0 / arcsec_per_mm, "cycles per arc second")
