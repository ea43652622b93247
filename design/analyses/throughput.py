"""Throughput: light that reaches the detector, with losses at surfaces, in glass and by vignetting.

A lens surface without a coating transmits after :mod:`.fresnel`, at the angle of each ray. Light is taken as
unpolarised before each surface, so transmissions are the means of both polarisations. A mirror or detector without a
coating loses nothing. Light that is reflected twice within a lens is not added (see `ghosts`).
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import ConfigError, DomainError, unknown_name
from ...core.plotting import BLUE, plain_text
from ...models.layer_stack import LayerStack
from ...models.surface import Interaction, Surface
from ...models.telescope import Telescope
from ...raytrace.pack.surfaces import refractive_indices
from ...raytrace.rays import Projection, RayStatus
from ...raytrace.trace import TraceResult, trace
from ...wavefront.pupil_sampling import PupilSampling, SamplingName
from ...wavefront.request import Request
from ..drawing import field_colors, finish_axes
from .analysis import Analysis, Columns, band_wavelengths
from .coatings import Coatings
from .fresnel import fresnel_transmission

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Wavelengths across the band where none are given.
_WAVELENGTHS = 21
#: Points of the pupil. Rims are across the rays: 20 rings of Gauss quadrature are wrong by 0.02 of DECam's light, these
#: by 0.001.
_POINTS = 4000


@dataclass(frozen=True)
class Throughput(Analysis):
    """Light that reaches the detector over light that falls on the entrance pupil.

    Attributes
    ----------
    value : ndarray, shape [n_field, n_wave]
        Fraction of the light of the annular entrance pupil, losses and vignetting included.
    lit_fraction : ndarray, shape [n_field, n_wave]
        Fraction of the entrance pupil that is lit.
    surfaces : tuple of str
        Surfaces with a loss, and glasses with absorption, in the order of the light.
    efficiency : ndarray, shape [n_surface, n_field, n_wave]
        Mean efficiency of each over the lit rays; NaN without light.
    """

    value: np.ndarray
    lit_fraction: np.ndarray
    surfaces: tuple[str, ...]
    efficiency: np.ndarray

    @property
    def _title(self) -> str:
        return "throughput, unpolarised light"

    @property
    def _panels(self) -> tuple[int, int, float, float]:
        return 1, 2, 10.0, 0.8 + max(4.0, 0.19 * len(self.surfaces))

    def _table_columns(self) -> Columns:
        return {
            **self._field_columns(1),
            "wavelength": (self.wavelengths * 1e9, "nm", "vacuum wavelength"),
            "throughput": (self.value, "", "light that arrives over that in the entrance pupil"),
            "lit_fraction": (self.lit_fraction, "", "lit fraction of the entrance pupil"),
        }

    def _values(self) -> dict[str, Any]:
        return {
            "throughput": self.value,
            "lit_fraction": self.lit_fraction,
            "surfaces": list(self.surfaces),
            "efficiency": self.efficiency,
        }

    def _draw(self, panels: Sequence[Axes]) -> None:
        curves, bars = panels
        nm = self.wavelengths * 1e9
        for i, (field, color) in enumerate(zip(self.field_labels(), field_colors(len(self.fields)), strict=True)):
            marker = "." if len(nm) == 1 else ""
            curves.plot(nm, 100 * self.value[i], color=color, marker=marker, label=field)
        finish_axes(curves, ylim=(0, 100), xlabel="wavelength [nm]", ylabel="throughput [%]")
        curves.legend(fontsize=7.5, loc="lower right")
        loss = 100 * (1.0 - np.nanmean(self.efficiency, axis=(1, 2))) if self.surfaces else np.zeros(0)
        bars.barh(np.arange(len(loss)), loss, color=BLUE, height=0.7)
        bars.set_yticks(np.arange(len(loss)), [plain_text(n) for n in self.surfaces], fontsize=7)
        bars.invert_yaxis()
        finish_axes(bars, xlabel="mean loss [%]", xlim=(0, None))
        bars.set_axisbelow(True)


@check_arguments
def throughput(
    telescope: Telescope | Request,
    fields: ArrayLike | None = None,
    wavelengths: ArrayLike | None = None,
    *,
    coatings: Coatings | str | os.PathLike[str] | None = None,
    sampling: SamplingName | PupilSampling = "spiral",
    n_pupil: int | None = None,
    projection: Projection | None = None,
    threads: int | None = None,
) -> Throughput:
    """Trace the throughput with reflection losses, coatings and absorption.

    Parameters
    ----------
    telescope, fields, sampling, n_pupil, projection, threads
        As in :meth:`pachon.Request.of`, but for a spiral of 4000 points by default, beside a request too.
    wavelengths : array_like or Quantity, shape [n_wave], optional
        Vacuum wavelengths [m]; those of the telescope's file, or 21 across its band, by default.
    coatings : Coatings or path, optional
        Coatings of surfaces and absorption of glasses, or their file (:mod:`~pachon.design.analyses.coatings`). Lens
        surfaces without one reflect as bare glass; mirrors without one are perfect.

    Raises
    ------
    ConfigError
        If the file is malformed, or layers stand on what is not a lens surface.
    UnknownNameError
        If a coating belongs to no surface, or absorption to no glass.
    DomainError
        If a table does not cover a wavelength, or the angle of a ray that is lit.
    """
    if n_pupil is None and sampling == "spiral":
        n_pupil = _POINTS
    request = Request.of(
        telescope,
        fields,
        band_wavelengths(telescope, wavelengths, _WAVELENGTHS),
        sampling=sampling,
        n_pupil=n_pupil,
        projection=projection,
        threads=threads,
    )
    telescope_coatings = coatings_of(request.telescope, coatings)
    value, lit, factors = [], [], []
    for _, batch in request.parts():
        by_wavelength = [_passed(batch, telescope_coatings, float(w)) for w in request.wavelengths]
        value.append(np.stack([f[0] for f in by_wavelength], axis=-1))
        lit.append(np.stack([f[1] for f in by_wavelength], axis=-1))
        factors.append([f[2] for f in by_wavelength])
    steps = list(factors[0][0])
    efficiency = [np.concatenate([np.stack([f[name] for f in p], axis=-1) for p in factors]) for name in steps]
    shape = (len(request.fields), len(request.wavelengths))
    stacked = np.array(efficiency).reshape(len(steps), *shape)
    return Throughput(request, np.concatenate(value), np.concatenate(lit), tuple(steps), stacked)


def coatings_of(telescope: Telescope, coatings: Coatings | str | os.PathLike[str] | None) -> Coatings:
    """Return coatings, or those of a file, that belong to a telescope; errors are those of :func:`throughput`."""
    telescope_coatings = Coatings.of(telescope, coatings)
    names = telescope.surface_names
    glasses = [s.medium_after.name for s in telescope.surfaces if s.medium_after.name]
    for name in telescope_coatings.surfaces:
        if name not in names:
            raise unknown_name(f"surface of {telescope.name}", name, names)
        surface = telescope.surface(name)
        if isinstance(telescope_coatings.surfaces[name], LayerStack) and surface.interaction != Interaction.REFRACT:
            raise ConfigError(f"coating of {name}: layers are those of lens surfaces; expected a table")
    for name in telescope_coatings.glasses:
        if name not in glasses:
            raise unknown_name(f"glass of {telescope.name}", name, dict.fromkeys(glasses) or ("none",))
    return telescope_coatings


def _passed(
    request: Request, coatings: Coatings, wavelength: float
) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Return throughput and lit fraction [n_field], and the mean efficiency of each step [n_field] by its name."""
    lit, step_efficiency = efficiencies(request, coatings, wavelength)
    weight = np.where(lit, request.pupil.weights, 0.0)
    fraction = weight.sum(axis=1)
    transmission, steps = np.ones(lit.shape), {}
    for name, efficiency in step_efficiency.items():
        transmission = transmission * efficiency
        with np.errstate(invalid="ignore"):
            steps[name] = (weight * efficiency).sum(axis=1) / fraction
    areas = request.pupil_areas
    return areas * (weight * transmission).sum(axis=1), areas * fraction, steps


def efficiencies(request: Request, coatings: Coatings, wavelength: float) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return which rays are lit [n_field, n_pupil], and the efficiency of each step for them by its name, else 0."""
    telescope = request.telescope
    rays = request.launch(wavelength)
    results = trace(telescope, rays, "all", focal_plane=request.focal_plane, threads=request.threads)
    index = refractive_indices(telescope, wavelength)
    lit = (results[-1].status == RayStatus.OK).reshape(len(request.fields), -1)
    steps: dict[str, np.ndarray] = {}
    before: TraceResult | None = None
    for k, (surface, result) in enumerate(zip(telescope.surfaces, results, strict=True)):
        surface_steps: dict[str, np.ndarray] = {}
        glass = telescope.surfaces[k - 1].medium_after.name if k else ""
        if before is not None and glass in coatings.glasses:
            path = np.linalg.norm(result.position - before.position, axis=-1)
            surface_steps[f"in {glass} before {surface.name}"] = coatings.glasses[glass].through(path, wavelength)
        direction = rays.direction if before is None else before.direction
        if surface.name in coatings.surfaces:
            incidence = _incidence(surface, result, direction)
            coating = coatings.surfaces[surface.name]
            surface_steps[surface.name] = coating.efficiency(
                wavelength, incidence, float(index[k]), float(index[k + 1])
            )
            _check_angles(surface.name, surface_steps[surface.name], incidence, lit.ravel())
        elif surface.interaction == Interaction.REFRACT and index[k] != index[k + 1]:
            surface_steps[surface.name] = fresnel_transmission(
                _incidence(surface, result, direction), index[k], index[k + 1]
            )
        for name, efficiency in surface_steps.items():
            steps[name] = np.where(lit, efficiency.reshape(lit.shape), 0.0)
        before = result
    return lit, steps


def _check_angles(name: str, efficiency: np.ndarray, cosine: np.ndarray, lit: np.ndarray) -> None:
    """Raise a DomainError where the coating of a surface has no efficiency for a ray that is lit."""
    beyond = lit & np.isnan(efficiency)
    if beyond.any():
        steepest = np.rad2deg(np.arccos(cosine[beyond].min()))
        raise DomainError(f"coating of {name}: rays of {steepest:.4g} deg: expected a table that reaches them")


def _incidence(surface: Surface, result: TraceResult, direction: np.ndarray) -> np.ndarray:
    """Return the cosine of the angle of incidence of rays on a surface, shape [n]."""
    x, y, _ = surface.to_local(result.position).T
    slope_x, slope_y = surface.shape.gradient(x, y)
    normal = np.stack([-slope_x, -slope_y, np.ones_like(x)], axis=-1) / np.sqrt(1.0 + slope_x**2 + slope_y**2)[:, None]
    return np.abs(np.einsum("ni,ni->n", surface.along(direction), normal))
