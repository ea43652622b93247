"""The sensitivity matrix: how the Zernike terms of the wavefront, field by field, answer to each degree of freedom."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ...core.errors import DomainError
from ...core.plotting import BLUE, new_figure, styled
from ...core.threads import one_blas_thread
from ...models.telescope import Telescope
from ...models.zernike_polynomials import annular_zernikes
from ...raytrace.rays import RayStatus
from ...wavefront.pupil_sampling import pupil_sampling
from ...wavefront.request import field_points, wavelength_points
from ..parameters.parameters import Parameter, parse_parameters
from .jacobian import ParameterColumns
from .wavefront_derivatives import FieldWavefronts, WavefrontBlock

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Points along the radius of the pupil by default; the fit is then exact up to degree 47 of wavefront times term.
_RINGS = 12
#: What is below this fraction of the terms that a derivative sums up is rounding.
_ROUNDING = 1e-13


@dataclass(frozen=True)
class Sensitivity:
    """How annular Zernike coefficients answer to parameters.

    Attributes
    ----------
    telescope : str
        Name of the telescope.
    parameters : tuple of Parameter
        The degrees of freedom, last axis of the matrix.
    fields : ndarray, shape [n_field, 2]
        Field angles [rad], first axis of the matrix.
    wavelength : float
        Vacuum wavelength [m].
    obscuration : float
        Inner over outer radius of the annulus of the Zernike terms.
    matrix : ndarray, shape [n_field, n_zernike, n_parameter]
        Derivatives of the coefficients, Noll order from j = 1, in metres of wavefront per unit of the parameter.
    zernikes : ndarray, shape [n_field, n_zernike]
        The coefficients of the telescope as it is [m].
    """

    telescope: str
    parameters: tuple[Parameter, ...]
    fields: np.ndarray
    wavelength: float
    obscuration: float
    matrix: np.ndarray
    zernikes: np.ndarray

    @property
    def rms(self) -> np.ndarray:
        """Wavefront rms over the field without piston and tilt, per unit of each parameter [m], shape [n_parameter]."""
        return np.sqrt((self.matrix[:, 3:] ** 2).sum(axis=1).mean(axis=0))

    def modes(self, first: int = 4) -> tuple[np.ndarray, np.ndarray]:
        """Return the singular values and modes of the matrix, parameters in units of 1 m wavefront rms each.

        Parameters
        ----------
        first : int
            Lowest Noll index that counts.

        Returns
        -------
        values : ndarray, shape [n_mode]
            Singular values, falling; those near zero are combinations that nothing in the wavefront tells of.
        modes : ndarray, shape [n_mode, n_parameter]
            The combinations.
        """
        flat = self.matrix[:, first - 1 :].reshape(-1, len(self.parameters)) / np.sqrt(len(self.fields))
        norm = np.linalg.norm(flat, axis=0)
        _, values, modes = np.linalg.svd(flat / np.where(norm > 0, norm, 1.0), full_matrices=False)
        return values, modes

    def summary(self) -> dict[str, Any]:
        """Return the figures by name, units in the names; the matrix is [field][zernike][parameter]."""
        values, _ = self.modes()
        return {
            "telescope": self.telescope,
            "wavelength_nm": self.wavelength * 1e9,
            "obscuration": self.obscuration,
            "field_deg": np.rad2deg(self.fields),
            "parameters": [p.address for p in self.parameters],
            "units": [p.unit or "1" for p in self.parameters],
            "wavefront_rms_m_per_unit": self.rms,
            "singular_values": values,
            "zernike_m": self.zernikes,
            "matrix_m_per_unit": self.matrix,
        }

    def plot(self) -> Figure:
        """Draw the matrix, and the singular values of the degrees of freedom."""
        from matplotlib.ticker import MaxNLocator

        first = min(4, self.matrix.shape[1])
        size = np.sqrt((self.matrix[:, first - 1 :] ** 2).mean(axis=0))
        largest = size.max(axis=0)
        with styled():
            names = [p.address for p in self.parameters]
            figure = new_figure(min(14.0, 4.5 + 0.22 * len(names)), 4.6)
            axes, modes = figure.subplots(1, 2, width_ratios=[2.2, 1.0])
            shown = np.log10(np.maximum(size / np.where(largest > 0, largest, 1.0), 1e-4))
            last = self.matrix.shape[1]
            box = (-0.5, len(names) - 0.5, first - 0.5, last + 0.5)
            image = axes.imshow(shown, extent=box, cmap="viridis", aspect="auto", vmin=-4.0, vmax=0.0)
            bar = figure.colorbar(image, ax=axes, label="of the largest term of each", ticks=range(-4, 1))
            bar.ax.set_yticklabels([f"$10^{{{k}}}$" if k else "1" for k in range(-4, 1)])
            axes.set_xticks(range(len(names)), names, rotation=90, fontsize=8 if len(names) <= 24 else 5)
            axes.yaxis.set_major_locator(MaxNLocator(integer=True))
            axes.set_ylabel("Noll index")
            axes.set_title(f"{self.telescope}, {self.wavelength * 1e9:g} nm: rms over {len(self.fields)} fields")
            values, _ = self.modes()
            modes.semilogy(np.arange(1, len(values) + 1), values, "o-", color=BLUE, markersize=3.5, linewidth=0.9)
            modes.xaxis.set_major_locator(MaxNLocator(integer=True))
            modes.grid(True, which="major", linewidth=0.3)
            modes.set_xlabel("mode")
            modes.set_ylabel("singular value, each parameter scaled to 1")
            modes.set_title("what can be told apart")
            return figure


def field_rings(telescope: Telescope) -> np.ndarray:
    """Return 31 field points [rad], shape [31, 2]: the axis, 10 half-way to the edge of the field, 20 near it."""
    rings = [np.zeros((1, 2))]
    for count, part in ((10, 0.5), (20, 0.98)):
        angle = 2.0 * np.pi * np.arange(count) / count
        rings.append(part * telescope.field_radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1))
    return np.concatenate(rings)


def sensitivity(
    telescope: Telescope,
    parameters: Iterable[str | Parameter],
    fields: Any = None,
    wavelength: Any = None,
    *,
    n_zernike: int = 28,
    sampling: Any = "gauss",
    count: int | None = None,
    projection: str = "zemax",
    threads: int | None = None,
) -> Sensitivity:
    """Return the derivatives of the wavefront's Zernike coefficients, exact, at every field point.

    Each ray is traced once and swept back once, whatever the number of parameters. The wavefront is that of
    :func:`~pachon.wavefront.opd.wavefront_opd`: path of the chief ray less that of the ray, to a sphere about where the
    chief ray lands, which moves with the parameters. The rays that are lit stay the same: a derivative knows nothing of
    the rims of apertures.

    Parameters
    ----------
    telescope : Telescope
        The telescope.
    parameters : iterable of str or Parameter
        Degrees of freedom, see :mod:`~pachon.design.parameters.parameters`.
    fields : array_like or Quantity, shape [n_field, 2], optional
        Field angles [rad]; 31 by default, see :func:`field_rings`.
    wavelength : float or Quantity, optional
        Vacuum wavelength [m]; the telescope's own by default.
    n_zernike : int
        Highest Noll index.
    sampling : {"gauss", "rings", "square"} or PupilSampling
        Points of the pupil and their weights in the fit.
    count : int, optional
        Points along the radius (gauss, rings) or the diameter (square) of the pupil.
    projection : {"zemax", "gnomonic", "postel"}
        Meaning of the field angles.
    threads : int, optional
        Number of threads; all processors by default.

    Returns
    -------
    Sensitivity

    Raises
    ------
    DomainError
        If a field or the wavelength lies outside what the telescope covers, a chief ray does not reach the image, or
        fewer rays are lit than there are terms.
    UnknownNameError, ConfigError
        If an address names nothing.
    """
    chosen = parse_parameters(parameters, telescope)
    points = field_points(telescope, field_rings(telescope) if fields is None else fields)
    (w,) = wavelength_points(telescope, wavelength)
    if int(n_zernike) != n_zernike or n_zernike < 1:
        raise DomainError(f"n_zernike = {n_zernike!r}: expected a whole number of at least 1")
    pupil = pupil_sampling(telescope, sampling, _RINGS if count is None and sampling == "gauss" else count)
    x, y = pupil.points.T / (0.5 * telescope.pupil_diameter)
    terms = annular_zernikes(n_zernike, x, y, telescope.pupil_obscuration)
    columns = ParameterColumns.at(telescope, chosen)
    zernikes = np.empty((len(points), n_zernike))
    matrix = np.empty((len(points), n_zernike, len(chosen)))
    weighted, by_ray = pupil.weights * terms, np.ascontiguousarray(terms.T)

    def products(rays: np.ndarray) -> np.ndarray:
        """Return the products of the terms, summed over some rays, shape [n_zernike, n_zernike]."""
        some = by_ray[rays]
        return (some.T * pupil.weights[rays]) @ some

    def fit(block: WavefrontBlock) -> np.ndarray:
        part, lit = block.fields, block.status == RayStatus.OK
        _check_lit(lit, n_zernike, points[part])
        # The normal equations of each field's fit: all that the pupil gives, less the few rays that are not lit.
        normal = whole - np.stack([products(dark) for dark in ~lit])
        value, change = block.project(weighted, columns.weights)
        solved = np.linalg.solve(normal, np.concatenate([change, value[..., None]], axis=2))
        matrix[part], zernikes[part] = solved[..., :-1], solved[..., -1]
        matrix[part, 0] += block.piston
        # How large the terms are that cancel where a parameter has no effect; some rays will do.
        return np.abs(block.table[4:, -1, ::8]).max(axis=1)

    with one_blas_thread():
        whole = products(np.arange(len(pupil)))
        wavefronts = FieldWavefronts(columns, points, w, pupil.points, projection, threads, lit_only=True)
        terms_size = np.max(wavefronts.map(fit), axis=0) @ np.abs(columns.weights)
    # A turn about the axis does nothing: what is left of it is rounding, and shown as zero.
    matrix[:, :, np.abs(matrix).max(axis=(0, 1)) < _ROUNDING * terms_size] = 0.0
    return Sensitivity(telescope.name, chosen, points, float(w), telescope.pupil_obscuration, matrix, zernikes)


def _check_lit(lit: np.ndarray, n_zernike: int, points: np.ndarray) -> None:
    few = lit.sum(axis=1) < n_zernike
    if few.any():
        x, y = np.rad2deg(points[few][0])
        raise DomainError(
            f"field = ({x:.6g}, {y:.6g}) deg: only {int(lit[few][0].sum())} pupil points are lit; "
            f"expected at least n_zernike = {n_zernike}"
        )
