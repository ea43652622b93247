r"""Modulation transfer: how much contrast of a sine pattern the telescope keeps, against its spatial frequency.

The optical transfer function is the autocorrelation of the pupil in direction cosines: at the frequency f it is the
overlap of the wave in the pupil with itself, shifted by the wavelength times f. The lattices of all wavelengths
(:mod:`~pachon.design.images.wavelets`) have spacings in proportion to the wavelength, so that they all give the same
frequencies, and their transfer functions, which are complex, add up to that of all the light.

Tangential is modulation along the direction in which the image moves as the star goes away from the axis; sagittal is
across it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.fft

from ...core.errors import DomainError
from ...core.plotting import BLUE, RED, new_figure, styled
from ...models.telescope import Telescope
from ...wavefront.request import field_points, relative_weights, wavelength_points
from ..drawing import field_text, second_scale
from ..metrics.principal_rays import PrincipalRays, principal_rays
from ..metrics.spots import spots
from .wavelets import lattice_wavelets, range_of_cosines, spot_reach

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_ACROSS = 256
#: Panels in a row.
_MOST = 3


@dataclass(frozen=True)
class Mtf:
    """Modulation transfer of several field points, all wavelengths together.

    Attributes
    ----------
    telescope : str
        Name of the telescope.
    fields : ndarray, shape [n_field, 2]
        Field angles [rad].
    wavelengths : ndarray, shape [n_wave]
        Vacuum wavelengths [m].
    frequency : ndarray, shape [n_frequency]
        Spatial frequencies on the detector, from zero [cycles/m].
    tangential, sagittal : ndarray, shape [n_field, n_frequency]
        Modulation transfer, 1 at zero.
    tangential_limit, sagittal_limit : ndarray, shape [n_field, n_frequency]
        The same of the same pupils, vignetting included, with perfect wavefronts.
    geometric_tangential, geometric_sagittal : ndarray, shape [n_field, n_frequency]
        The same of the rays alone, without diffraction.
    f_number : ndarray, shape [n_field, 2]
        Focal ratios, tangential and sagittal; the cut-off is 1 / (wavelength f_number).
    plate_scale : ndarray, shape [n_field, 2]
        Angle on the sky over length on the detector [rad/m], tangential and sagittal.
    obscuration : float
        Inner over outer diameter of the entrance pupil.
    """

    telescope: str
    fields: np.ndarray
    wavelengths: np.ndarray
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
        """Frequencies beyond which the shortest wavelength leaves nothing [cycles/m], tangential and sagittal."""
        return 1.0 / (self.wavelengths.min() * self.f_number)

    def frequency_at(self, contrast: float) -> np.ndarray:
        """Return the lowest frequency at which the contrast falls to a value [cycles/m], shape [n_field, 2].

        Tangential and sagittal; NaN where the contrast never falls so far.
        """
        if not 0 < contrast < 1:
            raise DomainError(f"contrast = {contrast!r}: expected a number between 0 and 1")
        return np.stack([[_falls_to(row, self.frequency, contrast) for row in m] for m in self._both], axis=-1)

    @property
    def _both(self) -> tuple[np.ndarray, np.ndarray]:
        return self.tangential, self.sagittal

    def summary(self) -> dict[str, Any]:
        """Return the figures by name, units in the names; pairs are tangential, sagittal; lists run over the fields."""
        arcsec = np.rad2deg(self.plate_scale) * 3600.0
        half = self.frequency_at(0.5)
        return {
            "telescope": self.telescope,
            "wavelength_nm": self.wavelengths * 1e9,
            "field_deg": np.rad2deg(self.fields),
            "obscuration": self.obscuration,
            "f_number": self.f_number,
            "cutoff_cycles_per_mm": self.cutoff * 1e-3,
            "cutoff_cycles_per_arcsec": self.cutoff / arcsec,
            "half_contrast_cycles_per_mm": half * 1e-3,
            "half_contrast_cycles_per_arcsec": half / arcsec,
            "plate_scale_arcsec_per_um": arcsec * 1e-6,
            "frequency_cycles_per_mm": self.frequency * 1e-3,
            "tangential": self.tangential,
            "sagittal": self.sagittal,
            "tangential_limit": self.tangential_limit,
            "sagittal_limit": self.sagittal_limit,
            "geometric_tangential": self.geometric_tangential,
            "geometric_sagittal": self.geometric_sagittal,
        }

    def plot(self) -> Figure:
        """Draw the contrast against the frequency, with the limit that diffraction sets."""
        count = len(self.fields)
        rows = -(-count // _MOST)
        columns = -(-count // rows)
        with styled():
            figure = new_figure(max(3.5 * columns, 5.5), 2.6 * rows + 1.0)
            panels = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
            for axes in panels[count:]:
                axes.set_axis_off()
            for i, axes in enumerate(panels[:count]):
                _draw_field(axes, self, i)
            for i, axes in enumerate(panels[:count]):
                if i % columns == 0:
                    axes.set_ylabel("contrast")
                if i + columns >= count:
                    axes.set_xlabel("spatial frequency [cycles/mm]")
                    axes.tick_params(labelbottom=True)
            handles, labels = panels[0].get_legend_handles_labels()
            figure.legend(handles, labels, loc="outside lower center", ncols=3 if columns > 1 else 2)
            waves = ", ".join(f"{w * 1e9:.4g}" for w in self.wavelengths)
            figure.suptitle(f"{self.telescope}: modulation transfer, {waves} nm", fontsize=11)
            return figure


def mtf(
    telescope: Telescope,
    fields: Any = None,
    wavelengths: Any = None,
    *,
    wavelength_weights: Any = None,
    pupil_points: int = _ACROSS,
    projection: str = "zemax",
    threads: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> Mtf:
    """Return the modulation transfer of the telescope over the field.

    Parameters
    ----------
    telescope : Telescope
        The telescope.
    fields : array_like or Quantity, shape [n_field, 2], optional
        Field angles [rad]; five from the axis to the edge by default.
    wavelengths : array_like or Quantity, shape [n_wave], optional
        Vacuum wavelengths [m]; the telescope's own by default.
    wavelength_weights : array_like, shape [n_wave], optional
        Relative amounts of light in front of the telescope; equal by default.
    pupil_points : int
        Lattice points across the pupil at the shortest wavelength, and so about the number of frequencies.
    projection : {"zemax", "gnomonic", "postel"}
        Meaning of the field angles.
    threads : int, optional
        Number of threads for tracing; all processors by default.
    progress : callable, optional
        Called with the number of images finished since the last call.

    Raises
    ------
    ConfigError
        If the projection is unknown.
    DomainError
        If something is out of range, no light passes, or the lattice is too coarse for the spots.
    """
    if int(pupil_points) != pupil_points or pupil_points < 16:
        raise DomainError(f"pupil_points = {pupil_points!r}: expected a whole number of at least 16")
    points, waves = field_points(telescope, fields), wavelength_points(telescope, wavelengths)
    shares = relative_weights(wavelength_weights, len(waves))
    middle = waves[len(waves) // 2]
    principal = principal_rays(telescope, points, middle, projection=projection, threads=threads)
    diagram = spots(
        telescope, points, waves, wavelength_weights=wavelength_weights, projection=projection, threads=threads
    )
    step = range_of_cosines(telescope, principal) / float(waves.min()) / int(pupil_points)
    reach = spot_reach(diagram)
    if 2.0 * reach * step > 1.0:
        raise DomainError(
            f"pupil_points = {pupil_points}: too few for spots of {2e6 * reach:.4g} um; "
            f"expected at least {int(np.ceil(2.0 * reach * step * pupil_points))}"
        )
    frequency = np.arange(int(pupil_points) + 1) * step
    angles = tangential_angle(telescope, principal)
    shape = (2, len(points), len(frequency))
    transfer, perfect, rays = np.zeros(shape, complex), np.zeros(shape, complex), np.zeros(shape, complex)
    for i, (field, center, angle) in enumerate(zip(points, diagram.reference, angles, strict=True)):
        for wavelength, share in zip(waves, shares, strict=True):
            found = lattice_wavelets(
                telescope,
                field,
                float(wavelength),
                center,
                float(wavelength) * step,
                angle=float(angle),
                projection=projection,
                threads=threads,
            )
            for total, pupil in ((transfer, found.wavelets.field), (perfect, np.abs(found.wavelets.field))):
                for axis in (0, 1):
                    overlap = _overlap(pupil if axis == 0 else pupil.T, len(frequency))
                    # Where a rim leaves part of a cell, the square of the part is too little light.
                    overlap[0] = found.wavelets.light * (found.spacing / wavelength) ** 2
                    total[axis, i] += share * overlap
            if progress is not None:
                progress(1)
        directions = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        place = np.where(diagram.weight[i][..., None] > 0, diagram.displacement[i], 0.0) @ directions.T
        for axis in (0, 1):
            phase = np.exp(-2j * np.pi * np.multiply.outer(frequency, place[..., axis].ravel()))
            rays[axis, i] = phase @ diagram.weight[i].ravel()
    contrast, limit, geometric = (np.abs(v) / np.abs(v[..., :1]) for v in (transfer, perfect, rays))
    return Mtf(
        telescope=telescope.name,
        fields=points,
        wavelengths=waves,
        frequency=frequency,
        tangential=contrast[0],
        sagittal=contrast[1],
        tangential_limit=limit[0],
        sagittal_limit=limit[1],
        geometric_tangential=geometric[0],
        geometric_sagittal=geometric[1],
        f_number=principal.f_number,
        plate_scale=principal.plate_scale,
        obscuration=telescope.pupil_obscuration,
    )


def tangential_angle(telescope: Telescope, principal: PrincipalRays) -> np.ndarray:
    """Return the angle from the x axis of the detector to the tangential direction [rad], shape [n_field]."""
    ends = principal.marginal_direction @ telescope.surfaces[-1].matrix
    across = ends[:, 0, :2] - ends[:, 1, :2]
    return np.arctan2(across[:, 1], across[:, 0])


def annulus_mtf(frequency: np.ndarray, obscuration: float) -> np.ndarray:
    """Return the modulation transfer of a perfect annular pupil (O'Neill 1956, J. Opt. Soc. Am. 46, 285).

    Parameters
    ----------
    frequency : ndarray
        Frequencies over the cut-off, 1 / (wavelength times focal ratio).
    obscuration : float
        Inner over outer diameter.
    """
    shift = np.asarray(frequency, dtype=np.float64)
    whole = _discs(shift, 1.0, 1.0)
    if obscuration > 0:
        whole = whole + _discs(shift, obscuration, obscuration) - 2.0 * _discs(shift, 1.0, obscuration)
    return whole / (np.pi * (1.0 - obscuration**2))


def _discs(shift: np.ndarray, large: float, small: float) -> np.ndarray:
    """Return the area that two discs share whose centres are twice a shift apart."""
    d = 2.0 * np.abs(shift)
    part = np.clip(d, max(large - small, 1e-300), large + small)
    a = np.arccos(np.clip((part**2 + large**2 - small**2) / (2.0 * part * large), -1.0, 1.0))
    b = np.arccos(np.clip((part**2 + small**2 - large**2) / (2.0 * part * small), -1.0, 1.0))
    kite = (large + small + part) * (small + large - part) * (part + large - small) * (part + small - large)
    area = large**2 * a + small**2 * b - 0.5 * np.sqrt(np.maximum(kite, 0.0))
    return np.where(d <= large - small, np.pi * small**2, np.where(d >= large + small, 0.0, area))


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
    axes.set(xlim=(0.0, frequency[-1]), ylim=(0.0, 1.0))
    axes.grid(True, color="0.92", linewidth=0.6)
    half = result.frequency_at(0.5)[i] * 1e-3
    axes.text(
        0.97,
        0.95,
        f"{field_text(result.fields[i])}\n50 % at {half[0]:.3g} (t), {half[1]:.3g} (s)",
        transform=axes.transAxes,
        ha="right",
        va="top",
        fontsize=8,
    )
    if i < _MOST:
        arcsec_per_mm = float(np.rad2deg(result.plate_scale[i].mean())) * 3600e-3
        second_scale(axes, 1.0 / arcsec_per_mm, "cycles per arc second")
