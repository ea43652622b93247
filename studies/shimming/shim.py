"""Motions of rafts or CCDs that make the images of a focal plane sharpest, roundest or least correlated.

At Gauss-Legendre nodes of each CCD the long-exposure engine gives FWHM, g and T of adaptive moments, and the weighted e
of the PSF as functions of the height. Piston, tip and tilt of each part then follow from a minimum of the mean over its
nodes, with exact derivatives; parts do not influence each other, but for the correlation of ellipticities, of which all
are found together. First the focal plane as a whole is focused, which the camera's hexapod does without any shim: gains
are counted from there. Results are checked with the engine at other places, and correlated there by TreeCorr.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
import scipy.optimize

from ...core.arguments import check_arguments
from ...core.errors import ConfigError, DomainError
from ...core.plotting import figure_at, styled
from ...core.progress import Reporter
from ...core.result import Result
from ...measure.correlation import Correlation, SeparationBins, shear_correlation
from ...measure.focal_plane_axes import draw_outlines, frame_axes
from ...models.camera.focal_plane import FocalPlane
from ...pipeline.config import Configuration, MotionConfig
from ...pipeline.experiment import Experiment
from ...pipeline.report.focal_plane_plots import draw_heights
from ...reconstruction.ccd_product import to_detector_axes
from ...reconstruction.focal_plane_psf.height_series import HeightSeries
from ...wavefront.chief_rays import fields_at
from .curves import E, G, Places, T, focus_curves, measured
from .pairs import PairSum, separation_edges

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ShimMerit = Literal["fwhm", "ellipticity", "xi"]
MERITS: tuple[ShimMerit, ...] = get_args(ShimMerit)
ShimmedParts = Literal["rafts", "ccds"]
PARTS: tuple[ShimmedParts, ...] = get_args(ShimmedParts)
#: States of the focal plane: as it is, focused as a whole, shimmed, and an ideal plane in focus.
STATES = ("as built", "focused", "shimmed", "plane")
# Nodes along the side of a CCD in the fit, by merit. Pairs of 3 x 3 nodes have too few separations: what they leave
# uncorrelated is correlated elsewhere.
_FIT = {"fwhm": 3, "ellipticity": 3, "xi": 5}
# Nodes along the side of a CCD in the check, which are other places than those of the fit.
_CHECK = 4
# Room for motions beyond the largest height [m].
_ROOM = 10e-6
# Factor by which the range of heights is widened until the sharpest images lie within.
_WIDER = 3.0
# Motions that end within this fraction of the range of heights are minima, not its ends.
_INSIDE = 1.0 - 1e-4
#: Merit at each place and its derivative with respect to the height there, of values and slopes [n, 6].
Value = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
# Lengths of which motions are multiples in the fit [m]: of the piston, and of a tilt at the rim of a part.
_UNIT = 1e-6


@dataclass(frozen=True)
class Motion:
    """Motion of a part as a rigid body, as :meth:`~pachon.FocalPlane.with_moved` takes it.

    Attributes
    ----------
    dz : float
        Along +z [m].
    rx, ry : float
        About x and y [rad].
    """

    dz: float = 0.0
    rx: float = 0.0
    ry: float = 0.0


@dataclass(frozen=True)
class StateMetrics:
    """Means over the area of the CCDs."""

    fwhm: float  #: mean FWHM [arcsec]
    rms_g: float  #: rms of g of adaptive moments, both components together
    rms_xi_g: float  #: rms over logarithmic bins of separation of xi+ of g; 0 where there are no pairs
    size: float  #: mean T of adaptive moments [arcsec^2]
    rms_e: float  #: rms of the weighted e, both components together
    rms_xi: float  #: of xi+ of the weighted e, as `rms_xi_g`


@dataclass(frozen=True, eq=False)
class Shims(Result):
    """Motions of the parts of a focal plane, and their gains.

    Attributes
    ----------
    merit, parts : str
        What was minimised, and what was moved.
    focus : Motion
        Of the whole focal plane, about the origin.
    motions : dict of str to Motion
        Of each part, beside the focus.
    fitted, checked : dict of str to StateMetrics
        By state, from the curves at the nodes of the fit, and from the engine at other places.
    correlations : dict of str to Correlation
        By state, of g at these other places, weighted by their shares of the area.
    focused, focal_plane : FocalPlane
        Focused as a whole, and shimmed.
    """

    _row_type = Motion

    merit: ShimMerit
    parts: ShimmedParts
    focus: Motion
    motions: dict[str, Motion]
    fitted: dict[str, StateMetrics]
    checked: dict[str, StateMetrics]
    correlations: dict[str, Correlation]
    focused: FocalPlane
    focal_plane: FocalPlane

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw the heights focused as a whole, the motions, and the heights with them, on one scale."""
        flat = FocalPlane.flat(self.focal_plane.camera)
        for name, motion in self.motions.items():
            flat = flat.with_moved(name, dz=motion.dz, rx=motion.rx, ry=motion.ry)
        planes = {"focused as a whole": self.focused, f"motions of {self.parts}": flat, "shimmed": self.focal_plane}
        return draw_shims(ax, planes)

    def _columns(self) -> dict[str, Any]:
        moved = self.motions.values()
        return {"motions": list(self.motions), **{k: [getattr(m, k) for m in moved] for k in ("dz", "rx", "ry")}}


@check_arguments
def shim(
    experiment: Experiment,
    *,
    merit: ShimMerit = "fwhm",
    parts: ShimmedParts = "rafts",
    threads: int | None = None,
    reporter: Reporter | None = None,
) -> Shims:
    """Find motions of rafts or CCDs that minimise FWHM, ellipticity or xi+.

    Parameters
    ----------
    experiment : Experiment
        Telescope, atmosphere and heights, with the long_exposure engine; the CCDs of its configuration are used.
    merit : str
        "fwhm" (mean FWHM over the area), "ellipticity" (rms of g of adaptive moments) or "xi" (rms over logarithmic
        bins of separation of xi+ of g; from the motions of the smallest rms of g to the next minimum).
    parts : str
        "rafts" or "ccds".
    threads : int, optional
        Number of threads; all processors by default. No byte depends on it.
    reporter : Reporter, optional
        Progress display; silent by default.

    Raises
    ------
    ConfigError
        If merit or parts are unknown, or the engine is another one.
    DomainError
        If a PSF has no width within the range of the heights, or places are too many for the pairs of "xi".
    """
    if experiment.config.psf.engine != "long_exposure":
        raise ConfigError(
            f"psf.engine = {experiment.config.psf.engine}: expected long_exposure, whose PSFs have no noise"
        )
    reporter = Reporter(quiet=True) if reporter is None else reporter
    plane, names = experiment.focal_plane, experiment.config.ccds or ()
    fit, check = (Places.gauss(plane, names, order) for order in (_FIT[merit], _CHECK))
    named_parts = _parts_with_places(plane, fit, parts)
    rows_of_parts = [(center, rows) for _, center, rows in named_parts]
    heights = fit.heights(plane)
    with reporter.stage("widths and ellipticities against height"):
        curves = _curves_around_focus(experiment, fit, rows_of_parts, threads)
    sky, sky_checked = (_field_angles(experiment, places, threads) for places in (fit, check))
    edges = _separation_bins(plane, np.concatenate([fit.position, check.position]), np.concatenate([sky, sky_checked]))
    pairs = PairSum.of(sky, fit.weight, edges) if merit == "xi" else None
    whole_plane = _whole_plane(fit)
    with reporter.stage("motions"):
        (focus,) = _best_motions(curves, fit, heights, whole_plane, merit, pairs)
        (level,) = _best_motions(curves, fit, np.zeros_like(heights), whole_plane, merit, pairs)
        focused = _moved_heights(heights, fit, whole_plane, [focus])
        best = _best_motions(curves, fit, focused, rows_of_parts, merit, pairs)
    motions = {name: motion for (name, *_), motion in zip(named_parts, best, strict=True)}
    shimmed = _moved_heights(focused, fit, rows_of_parts, best)
    planes = {
        "as built": plane,
        "focused": moved_whole(plane, focus),
        "shimmed": moved_parts(moved_whole(plane, focus), motions),
        "plane": moved_whole(FocalPlane.flat(plane.camera), level),
    }
    by_state = (heights, focused, shimmed, _moved_heights(np.zeros_like(heights), fit, whole_plane, [level]))
    fitted, checked, correlations = {}, {}, {}
    with reporter.stage("check with the engine at other places"):
        for state, at in zip(STATES, by_state, strict=True):
            fitted[state], _ = _state_metrics(fit, curves.at(at), sky, edges)
            values = measured(experiment, planes[state], check, threads)
            checked[state], correlations[state] = _state_metrics(check, values, sky_checked, edges)
    return Shims(merit, parts, focus, motions, fitted, checked, correlations, planes["focused"], planes["shimmed"])


def _curves_around_focus(
    experiment: Experiment, fit: Places, parts: Sequence[tuple[np.ndarray, np.ndarray]], threads: int | None
) -> HeightSeries:
    """Return the curves over a range of heights in which the whole, a flat plane and the parts are sharpest.

    Bands other than that of the prescription are in focus tens of um away, slow telescopes hundreds.
    """
    plane = experiment.focal_plane
    heights = fit.heights(plane)
    reach = float(np.abs(heights).max()) + _ROOM
    while True:
        curves = focus_curves(experiment, fit, reach, threads)
        lost = ~np.isfinite(curves.coefficients).all(axis=(0, 2))
        if lost.any():
            lost_ccd = plane.names[fit.ccd[np.flatnonzero(lost)[0]]]
            raise DomainError(f"{lost_ccd}: the PSF has no width or shape within {1e6 * reach:.0f} um of focus")
        if _farthest_sharpest(curves, fit, heights, parts) < _INSIDE * reach:
            return curves
        reach *= _WIDER


def _farthest_sharpest(
    curves: HeightSeries, fit: Places, heights: np.ndarray, parts: Sequence[tuple[np.ndarray, np.ndarray]]
) -> float:
    """Return the largest height [m], of either sign, where whole, flat plane or parts are sharpest."""

    def sharpest(before: np.ndarray, moved: Sequence[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
        return _moved_heights(before, fit, moved, _best_motions(curves, fit, before, moved, "fwhm", None))

    whole_plane = _whole_plane(fit)
    focused = sharpest(heights, whole_plane)
    level = sharpest(np.zeros_like(heights), whole_plane)
    return float(np.abs([focused, level, sharpest(focused, parts)]).max())


def _whole_plane(places: Places) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return centre and rows of the places of the whole focal plane, as of one part."""
    return [(np.zeros(2), np.arange(len(places.ccd)))]


def _moved_heights(
    heights: np.ndarray,
    places: Places,
    parts: Sequence[tuple[np.ndarray, np.ndarray]],
    motions: Sequence[Motion],
) -> np.ndarray:
    """Return heights [m] at places with parts moved, those of centres [m] and rows."""
    moved = heights.copy()
    for (center, rows), motion in zip(parts, motions, strict=True):
        moved[rows] += _height_change(motion, places.position[rows] - center)
    return moved


def _field_angles(experiment: Experiment, places: Places, threads: int | None) -> np.ndarray:
    """Return the field angles of places [rad], shape [n, 2], along the axes of the detector, as ellipticities are."""
    middle = experiment.wavelengths[len(experiment.wavelengths) // 2]
    fields = fields_at(experiment.telescope, places.position, middle, threads=threads)
    return to_detector_axes(fields.T, experiment.rotator).T


def _separation_bins(plane: FocalPlane, positions: np.ndarray, sky: np.ndarray) -> np.ndarray:
    """Return the edges of the bins of separation of places at positions [m] and field angles [rad]."""
    longest = float(np.hypot(*np.ptp(sky, axis=0)))
    scale = longest / float(np.hypot(*np.ptp(positions, axis=0)))
    return separation_edges(0.25 * plane.camera.shortest_side * scale, longest)


def moved_whole(plane: FocalPlane, motion: Motion) -> FocalPlane:
    """Return the focal plane moved as a whole, about its origin."""
    return moved_parts(plane, whole_as_rafts(plane, motion))


def whole_as_rafts(plane: FocalPlane, motion: Motion) -> dict[str, Motion]:
    """Return the motions of rafts, and of CCDs without one, that move the focal plane as a whole, about its origin."""
    camera = plane.camera
    centers = {name: camera.centers[list(members)].mean(axis=0) for name, members in camera.parts.items()}
    return {raft: Motion(float(_height_change(motion, at)), motion.rx, motion.ry) for raft, at in centers.items()}


def moved_parts(plane: FocalPlane, motions: Mapping[str, Motion]) -> FocalPlane:
    """Return the focal plane with parts moved."""
    for name, motion in motions.items():
        plane = plane.with_moved(name, dz=motion.dz, rx=motion.rx, ry=motion.ry)
    return plane


def shimmed_configuration(config: Configuration, shims: Shims) -> Configuration:
    """Return the configuration of a run with the focus and the shims among its moved rafts and CCDs."""
    total = {name: (m.dz_um, m.rx_urad, m.ry_urad) for name, m in config.focal_plane.moved.items()}
    for motions in (whole_as_rafts(shims.focal_plane, shims.focus), shims.motions):
        for name, motion in motions.items():
            dz, rx, ry = total.get(name, (0.0, 0.0, 0.0))
            total[name] = (dz + motion.dz * 1e6, rx + motion.rx * 1e6, ry + motion.ry * 1e6)
    moved = {name: MotionConfig(dz_um=dz, rx_urad=rx, ry_urad=ry) for name, (dz, rx, ry) in total.items()}
    return config.model_copy(update={"focal_plane": config.focal_plane.model_copy(update={"moved": moved})})


def _parts_with_places(
    plane: FocalPlane, places: Places, parts: ShimmedParts
) -> Sequence[tuple[str, np.ndarray, np.ndarray]]:
    """Return name, centre [m] and rows of the places of each part that has some."""
    camera = plane.camera
    if parts == "ccds":
        return [
            (camera.ccd_names[i], camera.centers[i], np.flatnonzero(places.ccd == i)) for i in np.unique(places.ccd)
        ]
    raft = camera.raft_index[places.ccd]
    if (raft < 0).any():
        name = camera.ccd_names[places.ccd[raft < 0][0]]
        raise ConfigError(f"parts = rafts: expected ccds, as {name} of {camera.name} is on no raft", key="parts")
    centers = {i: camera.centers[camera.raft_index == i].mean(axis=0) for i in np.unique(raft)}
    return [(camera.raft_names[i], center, np.flatnonzero(raft == i)) for i, center in centers.items()]


def _height_change(motion: Motion, position: np.ndarray) -> np.ndarray:
    """Return the change of height [m] at positions about the centre of a motion [m], shape [..., 2]."""
    return motion.dz + position[..., 1] * np.tan(motion.rx) - position[..., 0] * np.tan(motion.ry)


def _best_motions(
    curves: HeightSeries,
    places: Places,
    heights: np.ndarray,
    parts: Sequence[tuple[np.ndarray, np.ndarray]],
    merit: ShimMerit,
    pairs: PairSum | None,
) -> list[Motion]:
    """Return the motions of parts, given by centre and rows of their places, that minimise the merit function."""
    separate = merit if pairs is None else "ellipticity"
    terms = np.concatenate(
        [
            _minimise_merit(curves, places, heights, [(center, rows)], _VALUES[separate], np.zeros(3))
            for center, rows in parts
        ]
    )
    if pairs is not None:

        def value(values: np.ndarray, slopes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            # All places in the order of the pairs; in units of 1e-6, of order one for the minimiser.
            total, change = pairs.mean_square(1e3 * values[order, G])
            slope = np.einsum("nk,nk->n", change[rows], 1e3 * slopes[:, G]) / places.weight[rows]
            return np.full(len(rows), total), slope

        rows = np.concatenate([rows for _, rows in parts])
        order = np.argsort(rows)
        terms = _minimise_merit(curves, places, heights, parts, value, terms)
    return [_motion_of_terms(x, places.position[rows] - center) for x, (center, rows) in zip(terms, parts, strict=True)]


def _minimise_merit(
    curves: HeightSeries,
    places: Places,
    heights: np.ndarray,
    parts: Sequence[tuple[np.ndarray, np.ndarray]],
    value: Value,
    start: np.ndarray,
) -> np.ndarray:
    """Return piston and tilts of parts [n_part, 3], in units of 1 um of lift, at the minimum next to a start."""
    rows = np.concatenate([rows for _, rows in parts])
    part_index = np.repeat(np.arange(len(parts)), [len(rows) for _, rows in parts])
    row_curves, weight, before = curves.chosen(rows), places.weight[rows], heights[rows]
    design = np.concatenate([_motion_terms(places.position[rows] - center) for center, rows in parts]) * _UNIT

    within = np.clip(before, -row_curves.reach, row_curves.reach)
    penalty = max(1.0, float(value(row_curves.at(within), row_curves.slope(within))[0].max()))

    def merit_function(motion: np.ndarray) -> tuple[float, np.ndarray]:
        moved_heights = before + np.einsum("nk,nk->n", design, motion.reshape(-1, 3)[part_index])
        # Heights beyond the curves are penalised: the minimum lies within, whatever the size of the merit.
        inside = np.clip(moved_heights, -row_curves.reach, row_curves.reach)
        merits, slope = value(row_curves.at(inside), row_curves.slope(inside))
        beyond = (moved_heights - inside) / _UNIT
        total = merits + penalty * beyond**2
        slope = weight * (np.where(beyond == 0.0, slope, 0.0) + 2.0 * penalty * beyond / _UNIT)
        change = np.stack([np.bincount(part_index, slope * along) for along in design.T], axis=1)
        return float(np.einsum("n,n->", weight, total)), change.ravel()

    minimum = scipy.optimize.minimize(merit_function, start.ravel(), jac=True, method="BFGS", options={"gtol": 1e-9})
    return np.asarray(minimum.x).reshape(-1, 3)


def _motion_terms(position: np.ndarray) -> np.ndarray:
    """Return the lift of places at positions about the centre of a part [n, 2] by piston and two tilts, [n, 3]."""
    x, y = position.T / np.abs(position).max()
    return np.stack([np.ones_like(x), y, -x], axis=1)


def _motion_of_terms(lifts: np.ndarray, position: np.ndarray) -> Motion:
    """Return the motion of a part with places at these positions, from its piston and tilts in units of `_UNIT`."""
    dz, rx, ry = lifts * _UNIT
    arm = np.abs(position).max()
    return Motion(float(dz), float(np.arctan(rx / arm)), float(np.arctan(ry / arm)))


def _width_merit(values: np.ndarray, slopes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return values[:, 0], slopes[:, 0]


def _ellipticity_merit(values: np.ndarray, slopes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    # In units of 1e-3, so that the minimiser has numbers of order one.
    g, change = 1e3 * values[:, G], 1e3 * slopes[:, G]
    return (g**2).sum(axis=1), 2.0 * (g * change).sum(axis=1)


#: Merits that are means over places.
_VALUES: dict[str, Value] = {"fwhm": _width_merit, "ellipticity": _ellipticity_merit}


def _state_metrics(
    places: Places, values: np.ndarray, sky: np.ndarray, edges: np.ndarray
) -> tuple[StateMetrics, Correlation]:
    """Return means of values [n, 6] at places, and the correlation of their g."""
    bins = SeparationBins(edges[0], edges[-1], len(edges) - 1)
    of_g, of_e = (shear_correlation(*sky.T, *values[:, c].T, bins=bins, weight=places.weight) for c in (G, E))
    rms_g, rms_e = (places.mean((values[:, c] ** 2).sum(axis=1)) ** 0.5 for c in (G, E))
    rms_xi_g, rms_xi = (float(np.sqrt(np.nanmean(c.xi_plus**2))) for c in (of_g, of_e))
    metrics = StateMetrics(
        fwhm=places.mean(values[:, 0]),
        rms_g=rms_g,
        rms_xi_g=rms_xi_g,
        size=places.mean(values[:, T]),
        rms_e=rms_e,
        rms_xi=rms_xi,
    )
    return metrics, of_g


def draw_shims(ax: Axes | Figure | None, planes: Mapping[str, FocalPlane]) -> Figure:
    """Draw focal planes of one camera by name, on one scale."""
    first = next(iter(planes.values()))
    camera = first.camera
    edge = 1.04e3 * camera.reach
    limits = (-edge, edge, -edge, edge)
    # The focus of the whole, too: beside it the heights of a flat focal plane are rounding.
    heights = np.array([1e6 * plane.height(*camera.centers.T) for plane in planes.values()])
    bounds = float((np.abs(heights.mean(axis=1)) + 3.0 * heights.std(axis=1)).max()) or 1.0
    with styled():
        figure = figure_at(ax, 13.0, 4.6)
        panels = figure.subplots(1, len(planes))
        for i, (axes, (title, plane)) in enumerate(zip(panels, planes.items(), strict=True)):
            image = draw_heights(axes, plane, limits, 350, bounds=bounds)
            draw_outlines(axes, camera, range(len(camera)), "0.55", 0.3)
            frame_axes(axes, limits, y_label=i == 0)
            axes.set_title(title)
        figure.colorbar(image, ax=list(panels), fraction=0.02, pad=0.01, extend="both", label="height [µm]")
        return figure
