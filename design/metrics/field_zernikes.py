"""Annular Zernikes of the wavefront over the field of view, and double Zernikes.

A double Zernike expansion has terms in the pupil times terms in the field, ``W(p, f) = sum a_kj Z_k(f) Z_j(p)``:
annular Zernikes of the pupil and Zernikes of the full disc of the field, both in Noll's order and of mean square one.
So ``a_kj`` is in metres, and the squares of all sum up to the mean square wavefront over pupil and field.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments, removed_arguments
from ...core.errors import DomainError
from ...core.plotting import BLUE, ORANGE, figure_at, figure_of, styled
from ...core.result import Result
from ...core.units import angle, field_label, require_count
from ...models.fringe_indices import FRINGE_NAMES, FRINGE_TERMS, fringe_zernikes
from ...models.telescope import Telescope
from ...models.zernike_polynomials import NOLL_NAMES, annular_zernikes
from ...raytrace.rays import Projection
from ...wavefront.pupil_optics import trace_pupils
from ...wavefront.pupil_sampling import PupilSampling, SamplingName, gauss_annulus
from ...wavefront.reference_sphere import require_met
from ...wavefront.request import Request, field_points
from ...wavefront.zernike import SEPARATED
from ..drawing import FEW, draw_field_map, field_colors, panels_of, spread_in_field
from ..result import FieldResult

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Fitted points: the whole annulus, or where light passes.
FittedPupil = Literal["full", "lit"]
#: The same, or whichever has a smooth wavefront.
PupilToFit = Literal["auto", "full", "lit"]
ZernikeOrdering = Literal["noll", "fringe"]
#: Maps of single terms in one plot.
_MAPS = 8
#: Terms by which it is found whether the wavefront of the whole annulus is one of Zernikes.
_SMOOTH_TERMS = 28
#: Lit part of the annulus from which on it is.
_MOSTLY_LIT = 0.95
#: Largest rms residual of these terms over the wavelength, that of a diffraction-limited image. Aspheres bend rays far
#: outside their apertures by many waves: 34 are left at 0.64 degrees of HSC, two thirds lit; 0.014 at 1.83 of the LSST.
_SMOOTH_RESIDUAL = 1.0 / 14.0


@dataclass(frozen=True)
class FieldZernikes(FieldResult):
    """Annular Zernike coefficients of the wavefront at several field points.

    Attributes
    ----------
    coefficients : ndarray, shape [n_field, jmax]
        From j = 1 [m], in entrance-pupil coordinates. Noll's terms are orthonormal over the annulus, so that each
        coefficient is its own rms; Fringe terms have amplitude one at the rim.
    residual_rms : ndarray, shape [n_field]
        Root mean square of the wavefront minus the terms, over the fitted points [m].
    obscuration : float
        Inner over outer radius of the annulus.
    pupil : {"full", "lit"}
        Fitted points: the whole annulus, vignetted or not, or only where light passes.
    ordering : {"noll", "fringe"}
        Terms: annular ones in Noll's order, or those of the full disc in Fringe order.
    """

    _table = ("fields", "rms", "residual_rms", "coefficients")

    coefficients: np.ndarray
    residual_rms: np.ndarray
    obscuration: float
    pupil: FittedPupil
    ordering: ZernikeOrdering = "noll"

    @property
    def rms(self) -> np.ndarray:
        """Root mean square over the annulus of the terms without piston and tilt [m], shape [n_field]."""
        if self.ordering == "noll":
            return np.sqrt((self.coefficients[:, 3:] ** 2).sum(axis=1))
        sample = gauss_annulus(1.0, self.obscuration, 16, 64)
        terms = fringe_zernikes(max(self.coefficients.shape[1], 4), *sample.points.T)[3:]
        value = self.coefficients[:, 3:] @ terms[: self.coefficients.shape[1] - 3]
        return np.sqrt(value**2 @ sample.weights - (value @ sample.weights) ** 2)

    def _summary(self) -> dict[str, Any]:
        """Return the results by name and unit; rows are fields, columns indices of the terms from 1."""
        return {
            "telescope": self.telescope,
            "wavelength_nm": self.wavelength * 1e9,
            "obscuration": self.obscuration,
            "pupil": self.pupil,
            "ordering": self.ordering,
            **self.field_items(),
            "rms_without_tilt_nm": self.rms * 1e9,
            "residual_rms_nm": self.residual_rms * 1e9,
            "zernike_nm": self.coefficients * 1e9,
        }

    def plot(self, ax: Axes | Figure | None = None) -> Figure:
        """Draw the terms of each field as bars; for many fields their rms over the field, and maps of the largest."""
        j = np.arange(4, self.coefficients.shape[1] + 1)
        values = self.coefficients[:, 3:] * 1e9
        with_maps = spread_in_field(self.fields) and len(j) > 0
        with styled():
            figure = figure_at(ax, 11.0, 8.6 if with_maps else 4.8)
            annulus = f"the {self.pupil} pupil, obscuration {self.obscuration:g}"
            kind = "annular" if self.ordering == "noll" else "Fringe"
            self._titled(figure, f"{kind} Zernikes over {annulus}, {self._nanometres()}")
            if with_maps:
                parts: Any = figure.subfigures(2, 1, height_ratios=(1.0, 1.35))
                bars = parts[0].subplots()
                _draw_maps(parts[1], self, j)
            else:
                bars = figure.subplots()
            if len(self.fields) <= FEW:
                width = 0.85 / len(self.fields)
                colors = field_colors(len(self.fields))
                for i, (row, label, color) in enumerate(zip(values, self.field_labels(), colors, strict=True)):
                    offset = (i - 0.5 * (len(self.fields) - 1)) * width
                    bars.bar(j + offset, row, width, color=color, label=label)
                measure = "rms over the annulus" if self.ordering == "noll" else "amplitude at the rim"
                bars.set_ylabel(f"coefficient = {measure} [nm]")
                bars.legend(loc="best", ncols=2)
            else:
                bars.bar(j, np.sqrt((values**2).mean(axis=0)), 0.75, color=BLUE)
                bars.set_ylabel("rms over the fields [nm]")
            name_terms(bars, j, self.ordering)
            return figure


@dataclass(frozen=True)
class DoubleZernikes(Result):
    """Double Zernike coefficients: Zernikes of the field times annular Zernikes of the pupil.

    Attributes
    ----------
    coefficients : ndarray, shape [kmax, jmax]
        Coefficients [m]; rows are Noll indices of the field from k = 1, columns those of the pupil from j = 1.
    field_radius : float
        Radius of the disc of the field [rad].
    at_nodes : FieldZernikes
        Pupil coefficients at the nodes of the field quadrature.
    residual_rms : ndarray, shape [jmax]
        Root mean square over the field of each pupil coefficient minus the field terms [m].
    """

    _table = ("coefficients",)

    coefficients: np.ndarray
    field_radius: float
    at_nodes: FieldZernikes
    residual_rms: np.ndarray

    @check_arguments
    def at(self, fields: ArrayLike) -> np.ndarray:
        """Return the pupil coefficients [m] of the expansion at field angles [rad], shape [n_field, jmax]."""
        x, y = np.atleast_2d(np.asarray(fields, dtype=np.float64)).T / self.field_radius
        return annular_zernikes(len(self.coefficients), x, y).T @ self.coefficients

    def _summary(self) -> dict[str, Any]:
        """Return the results by name and unit; rows are field terms, columns pupil terms, both from 1."""
        nodes = self.at_nodes
        return {
            "telescope": nodes.telescope,
            "wavelength_nm": nodes.wavelength * 1e9,
            "obscuration": nodes.obscuration,
            "pupil": nodes.pupil,
            "field_radius_deg": float(np.rad2deg(self.field_radius)),
            "rms_without_tilt_nm": float(np.sqrt((self.coefficients[:, 3:] ** 2).sum())) * 1e9,
            "residual_rms_nm": self.residual_rms * 1e9,
            "double_zernike_nm": self.coefficients * 1e9,
        }

    def plot(self, ax: Axes | Figure | None = None) -> Figure:
        """Draw the matrix of coefficients and the sizes of the pupil terms."""
        from matplotlib.colors import SymLogNorm

        nm = self.coefficients[:, 3:] * 1e9
        j, k = np.arange(4, nm.shape[1] + 4), np.arange(1, nm.shape[0] + 1)
        nodes = self.at_nodes
        with styled():
            figure = figure_at(ax, 11.0, 8.8)
            table, bars = figure.subplots(2, 1, height_ratios=(1.7, 1.0), sharex=True)
            largest = max(float(np.abs(nm).max(initial=0.0)), 1e-6)
            norm = SymLogNorm(largest / 100.0, vmin=-largest, vmax=largest)
            image = table.imshow(
                nm, cmap="RdBu_r", norm=norm, aspect="auto", extent=(3.5, j[-1] + 0.5, 0.5, k[-1] + 0.5)
            )
            table.set_yticks(k, [term_label(int(n)) for n in k], fontsize=7)
            table.set_ylabel("Noll index in the field")
            figure_of(table).colorbar(image, ax=table, fraction=0.03, pad=0.01).set_label("coefficient [nm]")
            bars.bar(j, np.sqrt((nm**2).sum(axis=0)), 0.75, color=BLUE, label="rms over the field")
            bars.plot(j, self.residual_rms[3:] * 1e9, "_", color=ORANGE, markersize=9, label="left by the field terms")
            bars.set_ylabel("size of the term [nm]")
            bars.legend(loc="upper right")
            name_terms(bars, j)
            bars.set_xlabel("Noll index in the pupil")
            figure.suptitle(
                f"{nodes.telescope}: double Zernikes, pupil ({nodes.pupil}, obscuration {nodes.obscuration:g}) times "
                f"field (radius {np.rad2deg(self.field_radius):.4g}°), {nodes.wavelength * 1e9:.4g} nm",
                fontsize=11,
            )
            return figure


@check_arguments
def wavefront_zernikes(
    telescope: Telescope | Request,
    fields: ArrayLike | None = None,
    wavelength: ArrayLike | None = None,
    *,
    jmax: int = 28,
    pupil: PupilToFit = "auto",
    ordering: ZernikeOrdering = "noll",
    sampling: SamplingName | PupilSampling | None = None,
    n_pupil: int | None = None,
    projection: Projection | None = None,
    threads: int | None = None,
) -> FieldZernikes:
    """Fit annular Zernikes to the wavefronts of several field points.

    The wavefront is that of :func:`~pachon.wavefront.opd.wavefront_opd`, against the chief ray.

    Parameters
    ----------
    telescope, fields, wavelength, sampling, n_pupil, projection, threads
        As in :meth:`pachon.Request.of`.
    jmax : int
        Highest index; at most 37 in Fringe order.
    pupil : {"auto", "full", "lit"}
        "full": project on the whole annulus, clear apertures ignored. The terms stay orthogonal, so a coefficient does
        not depend on `jmax`, and it varies smoothly over the field. "lit": fit where light passes, as for a measured
        wavefront. "auto": "full", but "lit" at all fields where, at one of them, the rays that apertures stop miss the
        detector or have no smooth wavefront. The result says which.
    ordering : {"noll", "fringe"}
        Noll's order of annular terms of rms one, or the Fringe order of terms of the full disc of amplitude one. Fringe
        terms are not orthogonal over an annulus: there they are fitted by least squares, as in Zemax.

    Raises
    ------
    ConfigError
        If pupil or ordering is unknown.
    DomainError
        If there are fewer points than terms, rays of the full annulus do not reach the detector, or where light passes
        the terms cannot be told apart.
    """
    request = Request.of(
        telescope,
        fields,
        wavelength,
        sampling=sampling,
        n_pupil=n_pupil,
        projection=projection,
        threads=threads,
        one_wavelength=True,
    )
    telescope = request.telescope
    points, sample = request.fields, request.pupil
    largest_jmax = len(sample) if ordering == "noll" else min(len(sample), FRINGE_TERMS)
    jmax = require_count(jmax, "jmax", 1, largest_jmax)
    x, y = request.unit_pupil.T
    noll = ordering == "noll"
    terms = (annular_zernikes(jmax, x, y, telescope.pupil_obscuration) if noll else fringe_zernikes(jmax, x, y)).T
    coefficients, residual = np.empty((len(points), jmax)), np.empty(len(points))
    fitted: FittedPupil = "lit" if pupil == "lit" else "full"
    for rows, batch in request.parts():
        value, lit = _wavefronts(batch)
        require_met(value, lit, telescope.sphere_radius)
        if pupil == "auto" and not _smooth(value, lit, batch):
            return wavefront_zernikes(request, jmax=jmax, pupil="lit", ordering=ordering)
        used = np.isfinite(value) & (lit | (fitted == "full"))
        coefficients[rows], residual[rows] = _fit(terms, value, used, sample.weights, batch.fields, fitted)
    return FieldZernikes(request, coefficients, residual, telescope.pupil_obscuration, fitted, ordering)


def _smooth(value: np.ndarray, lit: np.ndarray, request: Request) -> bool:
    """Return whether wavefronts [n_field, n_pupil] are smooth beyond the apertures that cut their light."""
    if not np.isfinite(value).all():
        return False
    weights = request.pupil.weights
    stopped = lit @ weights < _MOSTLY_LIT * weights.sum()
    if not stopped.any():
        return True
    x, y = request.unit_pupil.T
    terms = annular_zernikes(min(_SMOOTH_TERMS, len(weights)), x, y, request.telescope.pupil_obscuration).T
    used = np.ones_like(lit[stopped])
    _, residual = _fit(terms, value[stopped], used, weights, request.fields[stopped], "full")
    return bool(residual.max() <= _SMOOTH_RESIDUAL * request.wavelength)


def _wavefronts(request: Request) -> tuple[np.ndarray, np.ndarray]:
    """Return the OPD [m] of the pupil points of a request, and which are lit, [n_field, n_pupil] each."""
    telescope, w = request.telescope, request.wavelength
    if telescope.design_data.afocal or np.isfinite(telescope.object_distance):
        bundles = request.bundles(w)
        return bundles.opd(telescope.sphere_radius), bundles.lit
    optics = trace_pupils(
        telescope,
        request.fields,
        w,
        request.pupil.points,
        focal_plane=request.focal_plane,
        vignetting=request.vignetting,
        projection=request.projection,
        threads=request.threads,
    )
    return -optics.path[:, 0], optics.lit[:, 0]


#: Most rings of field points.
_MOST_RINGS = 100


@removed_arguments(projection="telescope=Request.of(telescope, projection=...)")
@check_arguments
def double_zernikes(
    telescope: Telescope | Request,
    wavelength: ArrayLike | None = None,
    *,
    jmax: int = 28,
    kmax: int = 22,
    rings: int = 8,
    field_radius: ArrayLike | None = None,
    pupil: PupilToFit = "auto",
    sampling: SamplingName | PupilSampling | None = None,
    n_pupil: int | None = None,
    threads: int | None = None,
) -> DoubleZernikes:
    """Expand the wavefront in Zernikes of pupil and field.

    Parameters
    ----------
    telescope, wavelength, jmax, pupil, sampling, n_pupil, threads
        As in :func:`wavefront_zernikes`; the field points of a request are not used.
    kmax : int
        Highest Noll index in the field.
    rings : int
        Rings of the Gauss quadrature over the field, each of ``4 rings`` points: variations over the field up to degree
        ``2 rings`` come out exactly.
    field_radius : float or Quantity, optional
        Radius of the disc of the field [rad]; that of the field of view by default.

    Raises
    ------
    DomainError
        If the disc is out of range, or there are too few points for the terms.
    """
    axis = None if isinstance(telescope, Request) else np.zeros((1, 2))
    request = Request.of(
        telescope, axis, wavelength, sampling=sampling, n_pupil=n_pupil, threads=threads, one_wavelength=True
    )
    telescope = request.telescope
    radius = telescope.field_radius if field_radius is None else angle(field_radius, "field_radius")
    if not (np.isfinite(radius) and radius > 0):
        raise DomainError(f"field_radius = {field_radius!r}: expected a positive angle")
    rings = require_count(rings, "rings", 1, _MOST_RINGS)
    nodes = gauss_annulus(radius, 0.0, rings, 4 * rings)
    kmax = require_count(kmax, "kmax", 1, len(nodes))
    points = field_points(telescope, nodes.points, request.projection)
    at_nodes = wavefront_zernikes(request.at_fields(points), jmax=jmax, pupil=pupil)
    terms = annular_zernikes(kmax, *(nodes.points.T / radius)).T
    root = np.sqrt(nodes.weights)[:, None]
    coefficients, *_ = np.linalg.lstsq(terms * root, at_nodes.coefficients * root, rcond=None)
    residual = at_nodes.coefficients - terms @ coefficients
    return DoubleZernikes(coefficients, radius, at_nodes, np.sqrt(nodes.weights @ residual**2))


def _fit(
    terms: np.ndarray, value: np.ndarray, used: np.ndarray, weights: np.ndarray, fields: np.ndarray, pupil: FittedPupil
) -> tuple[np.ndarray, np.ndarray]:
    """Fit terms [n_pupil, jmax] to wavefronts [n_field, n_pupil] by weighted least squares over the points used."""
    root = np.sqrt(weights)
    jmax = terms.shape[1]
    short = used.sum(axis=1) < (len(weights) if pupil == "full" else jmax)
    if short.any():
        field_name = field_label(fields[short][0])
        if pupil == "full":
            raise DomainError(f"{field_name}: rays of the annulus miss the detector; pupil = lit leaves them out")
        raise DomainError(f"{field_name}: {int(used[short][0].sum())} pupil points are lit; expected at least {jmax}")
    coefficients = np.empty((len(value), jmax))
    complete = used.all(axis=1)
    if complete.any():
        # One factorisation serves all fields whose points are the same.
        orthogonal, triangle = np.linalg.qr(terms * root[:, None])
        size = np.abs(np.diag(triangle))
        if size.min() < 1e-9 * size.max():
            raise DomainError(f"jmax = {jmax}: the {len(weights)} points of the pupil cannot separate so many terms")
        coefficients[complete] = np.linalg.solve(triangle, (value[complete] * root @ orthogonal).T).T
    for i in np.flatnonzero(~complete):
        lit = used[i]
        coefficients[i], _, _, size = np.linalg.lstsq(
            terms[lit] * root[lit, None], value[i, lit] * root[lit], rcond=None
        )
        require_separated(size[-1] / size[0], f"jmax = {jmax}", fields[i], weights[lit].sum() / weights.sum())
    residual = np.where(used, value - coefficients @ terms.T, 0.0)
    return coefficients, np.sqrt((residual**2 @ weights) / (used @ weights))


def require_separated(ratio: float, terms: str, field: np.ndarray, lit: float, *, least: float = SEPARATED) -> None:
    """Raise DomainError where the lit pupil cannot tell terms apart.

    Parameters
    ----------
    ratio : float
        Least over greatest singular value of the terms at the lit points.
    terms : str
        Key and number of the terms.
    field : ndarray, shape [2]
        Field angles [rad].
    lit : float
        Fraction of the pupil where light passes.
    least : float
        Least ratio of terms that are told apart.
    """
    if not ratio >= least:
        raise DomainError(
            f"{field_label(field)}: light passes at {100.0 * lit:.2g} % of the pupil, where {terms} terms cannot be "
            "told apart; expected fewer"
        )


def term_label(j: int, ordering: ZernikeOrdering = "noll") -> str:
    """Return index and name of a term."""
    names = NOLL_NAMES if ordering == "noll" else FRINGE_NAMES
    return f"{j} {names.get(j, '')}".strip()


def name_terms(axes: Axes, j: np.ndarray, ordering: ZernikeOrdering = "noll") -> None:
    """Label an axis of indices of terms."""
    axes.axhline(0.0, color="0.3", linewidth=0.7)
    if len(j) <= 45:
        labels = [term_label(int(n), ordering) for n in j]
        axes.set_xticks(j, labels, rotation=60, ha="right", rotation_mode="anchor")
    axes.set_xlabel(f"{ordering.capitalize()} index")
    axes.grid(True, axis="y", color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)


def _draw_maps(figure: Any, result: FieldZernikes, j: np.ndarray) -> None:
    sizes = np.sqrt((result.coefficients[:, 3:] ** 2).mean(axis=0))
    largest = np.sort(j[np.argsort(-sizes, kind="stable")[:_MAPS]])
    panels = panels_of(figure, len(largest), 2, _MAPS // 2, sharex=True, sharey=True)
    places, name, unit = result.field_places()
    for axes, n in zip(panels, largest, strict=True):
        nm = result.coefficients[:, n - 1] * 1e9
        edge = max(float(np.abs(nm).max()), 1e-6)
        image = draw_field_map(axes, places, nm, cmap="RdBu_r", vmin=-edge, vmax=edge)
        figure.colorbar(image, ax=axes, fraction=0.046, pad=0.02).ax.tick_params(labelsize=7)
        axes.set_title(f"{term_label(int(n), result.ordering)} [nm]", fontsize=9)
    figure.supxlabel(f"{name} x [{unit}]", fontsize=9)
    figure.supylabel(f"{name} y [{unit}]", fontsize=9)
