"""Sensitivity matrix: derivatives of Zernike coefficients of the wavefront to parameters, field by field."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ...core.number_text import counted
from ...core.plotting import BLUE, figure_at, plain_text, styled
from ...core.threads import one_blas_thread
from ...core.units import field_label, require_count
from ...models.parameters.degrees_of_freedom import DegreesOfFreedom
from ...models.parameters.parameters import Parameter, ParameterVector, Variables, parse_parameters
from ...models.paraxial import following_stop
from ...models.telescope import Telescope
from ...models.zernike_polynomials import MOST_TERMS, annular_zernikes, noll_to_nm
from ...raytrace.rays import Projection, RayStatus
from ...wavefront.pupil_sampling import PupilSampling, SamplingName
from ...wavefront.request import Request
from ..metrics.field_zernikes import require_separated
from ..result import FieldResult
from .jacobian import ParameterColumns
from .wavefront_derivatives import FieldWavefronts, WavefrontBlock

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Default points along the radius of the pupil, or the highest degree of the terms where that is more; the fit is exact
#: up to degree 47 of wavefront times term.
_RINGS = 12
#: Least over greatest singular value of terms that lit points tell apart, less than of wavefronts, as derivatives are
#: smoother: with 5e-6 those of HSC's edge are 0.2 % wrong, with 1.5e-7 they are 8 %.
_SEPARATED = 1e-6
#: Fraction of the terms of a derivative below which their sum is rounding.
_ROUNDING = 1e-13


@dataclass(frozen=True)
class Sensitivity(FieldResult):
    """Derivatives of annular Zernike coefficients of the wavefront to parameters.

    Attributes
    ----------
    parameters : ParameterVector or DegreesOfFreedom
        Last axis of the matrix, with ``names``, ``units`` and ``apply(telescope, values)``.
    obscuration : float
        Inner over outer radius of the annulus of the Zernike terms.
    matrix : ndarray, shape [n_field, n_zernike, n_parameter]
        Derivatives of the coefficients, Noll order from j = 1, in metres of wavefront per unit of the parameter.
    zernikes : ndarray, shape [n_field, n_zernike]
        Coefficients of the unchanged telescope [m].
    """

    _table = ("parameters", "units", "rms", "matrix")

    parameters: Variables
    obscuration: float
    matrix: np.ndarray
    zernikes: np.ndarray

    @property
    def units(self) -> Sequence[str]:
        """Unit of each parameter."""
        return self.parameters.units

    @property
    def rms(self) -> np.ndarray:
        """Rms wavefront over the field without piston and tilt, in metres per unit of each parameter, [n_parameter]."""
        return np.sqrt((self.matrix[:, 3:] ** 2).sum(axis=1).mean(axis=0))

    @check_arguments
    def modes(self, first: int = 4) -> tuple[np.ndarray, np.ndarray]:
        """Return singular values and modes of the matrix, each parameter in units of 1 m rms wavefront.

        Parameters
        ----------
        first : int
            Lowest Noll index.

        Returns
        -------
        values : ndarray, shape [n_mode]
            Singular values, falling; those near zero belong to combinations without effect on the wavefront.
        modes : ndarray, shape [n_mode, n_parameter]
            Combinations of parameters.
        """
        flat = self.matrix[:, first - 1 :].reshape(-1, self.matrix.shape[-1]) / np.sqrt(len(self.fields))
        norm = np.linalg.norm(flat, axis=0)
        _, values, modes = np.linalg.svd(flat / np.where(norm > 0, norm, 1.0), full_matrices=False)
        return values, modes

    def _columns(self) -> dict[str, Any]:
        named = {"parameters": self.parameters.names, "units": self.units}
        return named | {"rms": self.rms, "matrix": np.moveaxis(self.matrix, -1, 0)}

    def _summary(self) -> dict[str, Any]:
        """Return the results by name and unit; the matrix is [field][zernike][parameter]."""
        values, _ = self.modes()
        return {
            "telescope": self.telescope,
            "wavelength_nm": self.wavelength * 1e9,
            "obscuration": self.obscuration,
            "field_deg": np.rad2deg(self.fields),
            "parameters": list(self.parameters.names),
            "units": list(self.units),
            "wavefront_rms_m_per_unit": self.rms,
            "singular_values": values,
            "zernike_m": self.zernikes,
            "matrix_m_per_unit": self.matrix,
        }

    def plot(self, ax: Axes | Figure | None = None) -> Figure:
        """Draw the matrix, and the singular values of the degrees of freedom."""
        from matplotlib.ticker import MaxNLocator

        first = min(4, self.matrix.shape[1])
        size = np.sqrt((self.matrix[:, first - 1 :] ** 2).mean(axis=0))
        largest = size.max(axis=0)
        with styled():
            names = [plain_text(name) for name in self.parameters.names]
            figure = figure_at(ax, min(14.0, 4.5 + 0.22 * len(names)), 4.6)
            axes, modes = figure.subplots(1, 2, width_ratios=[2.2, 1.0])
            shown = np.log10(np.maximum(size / np.where(largest > 0, largest, 1.0), 1e-4))
            last = self.matrix.shape[1]
            box = (-0.5, len(names) - 0.5, first - 0.5, last + 0.5)
            image = axes.imshow(shown, extent=box, cmap="viridis", aspect="auto", vmin=-4.0, vmax=0.0)
            bar = figure.colorbar(image, ax=axes, label="of the largest term of each", ticks=range(-4, 1))
            bar.ax.set_yticklabels([f"$10^{{{k}}}$" if k else "1" for k in range(-4, 1)])
            axes.set_xticks(
                range(len(names)),
                [plain_text(name) for name in names],
                rotation=90,
                fontsize=8 if len(names) <= 24 else 5,
            )
            axes.yaxis.set_major_locator(MaxNLocator(integer=True))
            axes.set_ylabel("Noll index")
            fields = counted(len(self.fields), "field")
            axes.set_title(f"{plain_text(self.telescope)}, {self.wavelength * 1e9:g} nm: rms over {fields}")
            values, _ = self.modes()
            modes.plot(np.arange(1, len(values) + 1), values, "o-", color=BLUE, markersize=3.5, linewidth=0.9)
            # Of parameters without effect, such as motions of a plane for the stop, all are zero.
            modes.set_yscale("log" if (values > 0).any() else "linear")
            modes.xaxis.set_major_locator(MaxNLocator(integer=True))
            modes.grid(True, which="major", linewidth=0.3)
            label = "singular value, each parameter scaled to 1"
            modes.set(xlabel="mode", ylabel=label, title="combinations")
            return figure


def field_rings(telescope: Telescope) -> np.ndarray:
    """Return 31 field points [rad], shape [31, 2]: the axis, 10 half-way to the edge, 20 near the edge."""
    rings = [np.zeros((1, 2))]
    for count, fraction in ((10, 0.5), (20, 0.98)):
        angle = 2.0 * np.pi * np.arange(count) / count
        rings.append(fraction * telescope.field_radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1))
    return np.concatenate(rings)


@check_arguments
def sensitivity(
    telescope: Telescope,
    parameters: DegreesOfFreedom | Iterable[str | Parameter],
    fields: ArrayLike | None = None,
    wavelength: ArrayLike | None = None,
    *,
    n_zernike: int = 28,
    sampling: SamplingName | PupilSampling = "gauss",
    n_pupil: int | None = None,
    projection: Projection = "zemax",
    threads: int | None = None,
) -> Sensitivity:
    """Return exact derivatives of Zernike coefficients at every field point.

    Each ray takes one forward and one backward pass, whatever the number of parameters. The wavefront is that of
    :func:`~pachon.wavefront.opd.wavefront_opd`, to a sphere about the landing point of the chief ray, which moves with
    the parameters. The set of lit rays is fixed: derivatives leave out the motion of rims. Rays fill a stop that has
    mirrors or lenses in front of it, aimed as `aiming` "real" where the design data state none.

    Parameters
    ----------
    telescope, fields, wavelength, sampling, n_pupil, projection, threads
        As in :meth:`pachon.Request.of`, but for the defaults: 31 field points (:func:`field_rings`), and 12 rings, or
        as many as the highest degree of the terms.
    parameters : DegreesOfFreedom, or iterable of str or Parameter
        What changes: degrees of freedom, each in its own unit, or parameters (:mod:`~.models.parameters.parameters`).
    n_zernike : int
        Highest Noll index.

    Raises
    ------
    DomainError
        If a chief ray does not reach the image, or lit rays are fewer than terms or cannot tell them apart.
    UnknownNameError, ConfigError
        If an address is unknown.
    """
    telescope = following_stop(telescope)
    variables: Variables
    if isinstance(parameters, DegreesOfFreedom):
        variables = parameters
        prepared, addresses, of_parameters = parameters.parameter_matrix(telescope)
    else:
        prepared, addresses, of_parameters = telescope, parse_parameters(parameters, telescope), None
        variables = ParameterVector(addresses)
    n_zernike = require_count(n_zernike, "n_zernike", 1, MOST_TERMS)
    request = Request.of(
        prepared,
        field_rings(telescope) if fields is None else fields,
        wavelength,
        sampling=sampling,
        n_pupil=max(_RINGS, noll_to_nm(n_zernike)[0]) if n_pupil is None and sampling == "gauss" else n_pupil,
        projection=projection,
        threads=threads,
        one_wavelength=True,
    )
    points, pupil, (x, y) = request.fields, request.pupil, request.unit_pupil.T
    terms = annular_zernikes(n_zernike, x, y, telescope.pupil_obscuration)
    columns = ParameterColumns.at(prepared, addresses)
    weights = columns.weights_at(request.wavelength)
    zernikes = np.empty((len(points), n_zernike))
    matrix = np.empty((len(points), n_zernike, len(addresses)))
    weighted, by_ray = pupil.weights * terms, np.ascontiguousarray(terms.T)

    def products(rays: np.ndarray) -> np.ndarray:
        """Return the products of the terms, summed over some rays, shape [n_zernike, n_zernike]."""
        ray_terms = by_ray[rays]
        return (ray_terms.T * pupil.weights[rays]) @ ray_terms

    def fit(block: WavefrontBlock) -> np.ndarray:
        block_fields, lit = block.fields, block.status == RayStatus.OK
        too_dark = lit.sum(axis=1) < n_zernike
        if too_dark.any():
            raise DomainError(
                f"{field_label(points[block_fields][too_dark][0])}: only {int(lit[too_dark][0].sum())} pupil points "
                f"are lit; expected at least n_zernike = {n_zernike}"
            )
        # Normal equations of the fit of each field: those of the whole pupil, less the few rays that are not lit.
        normal = full_normal - np.stack([products(dark) for dark in ~lit])
        squares = np.linalg.eigvalsh(normal)
        ratios = np.sqrt(np.maximum(squares[:, 0], 0.0) / squares[:, -1])
        fractions = lit @ pupil.weights / pupil.weights.sum()
        for ratio, field, fraction in zip(ratios, points[block_fields], fractions, strict=True):
            require_separated(ratio, f"n_zernike = {n_zernike}", field, fraction, least=_SEPARATED)
        value, change = block.project(weighted, weights)
        solved = np.linalg.solve(normal, np.concatenate([change, value[..., None]], axis=2))
        matrix[block_fields], zernikes[block_fields] = solved[..., :-1], solved[..., -1]
        matrix[block_fields, 0] += block.piston
        # Size of the terms that cancel where a parameter has no effect, from some of the rays.
        return np.abs(block.table[4:, -1, ::8]).max(axis=1)

    with one_blas_thread():
        full_normal = products(np.arange(len(pupil)))
        wavefronts = FieldWavefronts(columns, request, request.wavelength, lit_only=True)
        terms_size = np.max(wavefronts.map(fit), axis=0) @ np.abs(weights)
    # Rotation about the axis has no effect; its rounding errors become zero.
    matrix[:, :, np.abs(matrix).max(axis=(0, 1)) < _ROUNDING * terms_size] = 0.0
    if of_parameters is not None:
        matrix = matrix @ of_parameters
    return Sensitivity(request, variables, telescope.pupil_obscuration, matrix, zernikes)
