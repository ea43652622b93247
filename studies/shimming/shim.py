"""Motions of rafts or CCDs that make the images of a focal plane sharpest or roundest.

At Gauss-Legendre nodes of each CCD the long-exposure engine gives the width and the ellipticity of the PSF as functions
of the height. Piston, tip and tilt of each part then follow from a minimum of the mean over its nodes, with exact
derivatives; parts do not influence each other. First the focal plane as a whole is focused, which the camera's hexapod
does without any shim: gains are counted from there. Results are checked with the engine at other places.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.optimize

from ...core.arguments import check_arguments
from ...core.errors import ConfigError, DomainError, check_choice
from ...core.progress import Reporter
from ...core.result import Result
from ...models.camera.focal_plane import FocalPlane
from ...pipeline.config import Configuration, MotionConfig
from ...pipeline.experiment import Experiment
from ...pipeline.focal_plane_psf.height_series import HeightSeries
from .curves import Places, focus_curves, measured

MERITS = ("fwhm", "ellipticity")
PARTS = ("rafts", "ccds")
#: States of the focal plane: as it is, focused as a whole, shimmed, and an ideal plane in focus.
STATES = ("as built", "focused", "shimmed", "plane")
# Nodes along the side of a CCD: of the fit, and of the check, which shares none with it.
_FIT, _CHECK = 3, 4
# Room for motions beyond the largest height [m].
_ROOM = 10e-6
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
    rms_e: float  #: rms of the ellipticity, both components together


@dataclass(frozen=True, eq=False)
class Shims(Result):
    """Motions of the parts of a focal plane, and what they gain.

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
    focused, focal_plane : FocalPlane
        Focused as a whole, and shimmed.
    """

    _row_type = Motion

    merit: str
    parts: str
    focus: Motion
    motions: dict[str, Motion]
    fitted: dict[str, StateMetrics]
    checked: dict[str, StateMetrics]
    focused: FocalPlane
    focal_plane: FocalPlane

    def _columns(self) -> dict[str, Any]:
        moved = self.motions.values()
        return {"motions": list(self.motions), **{k: [getattr(m, k) for m in moved] for k in ("dz", "rx", "ry")}}


@check_arguments
def shim(
    experiment: Experiment,
    *,
    merit: str = "fwhm",
    parts: str = "rafts",
    threads: int | None = None,
    reporter: Reporter | None = None,
) -> Shims:
    """Find the motions of rafts or CCDs that minimise the mean FWHM or the rms ellipticity.

    Parameters
    ----------
    experiment : Experiment
        Telescope, atmosphere and heights, with the long_exposure engine; the CCDs of its configuration are used.
    merit : str
        "fwhm" (mean FWHM over the area) or "ellipticity" (rms).
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
        If a PSF has no width within the range of the heights.
    """
    check_choice("merit", merit, MERITS)
    check_choice("parts", parts, PARTS)
    if experiment.config.psf.engine != "long_exposure":
        raise ConfigError(
            f"psf.engine = {experiment.config.psf.engine}: expected long_exposure, whose PSFs have no noise"
        )
    reporter = Reporter(quiet=True) if reporter is None else reporter
    plane, names = experiment.focal_plane, experiment.config.ccds or ()
    fit, check = (Places.gauss(plane, names, order) for order in (_FIT, _CHECK))
    heights = fit.heights(plane)
    with reporter.stage("widths and ellipticities against height"):
        curves = focus_curves(experiment, fit, float(np.abs(heights).max()) + _ROOM, threads)
        if not np.isfinite(curves.coefficients).all():
            lost = ~np.isfinite(curves.coefficients).all(axis=(0, 2))
            some = plane.names[fit.ccd[np.flatnonzero(lost)[0]]]
            raise DomainError(f"{some}: the PSF has no width or shape within {1e6 * curves.reach:.0f} um of focus")
    whole = np.zeros(2), np.arange(len(fit.ccd))
    focus = _best(curves, fit, heights, *whole, merit)
    level = _best(curves, fit, np.zeros_like(heights), *whole, merit)
    focused = heights + _lift(focus, fit.position)
    motions: dict[str, Motion] = {}
    shimmed = focused.copy()
    for part, center, rows in _parts(plane, fit, parts):
        motions[part] = _best(curves, fit, focused, center, rows, merit)
        shimmed[rows] += _lift(motions[part], fit.position[rows] - center)
    planes = {
        "as built": plane,
        "focused": moved_whole(plane, focus),
        "shimmed": moved_parts(moved_whole(plane, focus), motions),
        "plane": moved_whole(FocalPlane.flat(plane.camera), level),
    }
    by_state = (heights, focused, shimmed, _lift(level, fit.position))
    fitted = {state: _metrics(fit, curves.at(h)) for state, h in zip(STATES, by_state, strict=True)}
    with reporter.stage("check with the engine at other places"):
        checked = {state: _metrics(check, measured(experiment, planes[state], check, threads)) for state in STATES}
    return Shims(merit, parts, focus, motions, fitted, checked, planes["focused"], planes["shimmed"])


def moved_whole(plane: FocalPlane, motion: Motion) -> FocalPlane:
    """Return the focal plane moved as a whole, about its origin."""
    return moved_parts(plane, whole_as_rafts(plane, motion))


def whole_as_rafts(plane: FocalPlane, motion: Motion) -> dict[str, Motion]:
    """Return the motions of rafts, and of CCDs without one, that move the focal plane as a whole, about its origin."""
    camera = plane.camera
    centers = {name: camera.centers[list(members)].mean(axis=0) for name, members in camera.parts.items()}
    return {raft: Motion(float(_lift(motion, at)), motion.rx, motion.ry) for raft, at in centers.items()}


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
            old = total.get(name, (0.0, 0.0, 0.0))
            new = motion.dz * 1e6, motion.rx * 1e6, motion.ry * 1e6
            total[name] = (old[0] + new[0], old[1] + new[1], old[2] + new[2])
    moved = {name: MotionConfig(dz_um=dz, rx_urad=rx, ry_urad=ry) for name, (dz, rx, ry) in total.items()}
    return config.model_copy(update={"focal_plane": config.focal_plane.model_copy(update={"moved": moved})})


def _parts(plane: FocalPlane, places: Places, parts: str) -> Sequence[tuple[str, np.ndarray, np.ndarray]]:
    """Return name, centre [m] and rows of the places of each part that has some."""
    camera = plane.camera
    if parts == "ccds":
        return [
            (camera.ccd_names[i], camera.centers[i], np.flatnonzero(places.ccd == i)) for i in np.unique(places.ccd)
        ]
    raft = camera.raft_index[places.ccd]
    if (raft < 0).any():
        name = camera.ccd_names[places.ccd[raft < 0][0]]
        raise ConfigError(f"parts = rafts: expected ccds, as {name} of {camera.name} is on no raft")
    centers = {i: camera.centers[camera.raft_index == i].mean(axis=0) for i in np.unique(raft)}
    return [(camera.raft_names[i], center, np.flatnonzero(raft == i)) for i, center in centers.items()]


def _lift(motion: Motion, position: np.ndarray) -> np.ndarray:
    """Return the change of height [m] at positions about the centre of a motion [m], shape [..., 2]."""
    return motion.dz + position[..., 1] * np.tan(motion.rx) - position[..., 0] * np.tan(motion.ry)


def _best(
    curves: HeightSeries, places: Places, heights: np.ndarray, center: np.ndarray, rows: np.ndarray, merit: str
) -> Motion:
    """Return the motion of a part, given by its places, that minimises the merit function."""
    some, weight, start = curves.chosen(rows), places.weight[rows], heights[rows]
    x, y = (places.position[rows] - center).T
    arm = float(np.abs([x, y]).max())
    design = np.stack([np.ones_like(x), y / arm, -x / arm], axis=1) * _UNIT
    value = _VALUES[merit]

    def merit_function(motion: np.ndarray) -> tuple[float, np.ndarray]:
        new = start + np.einsum("nk,k->n", design, motion)
        # Heights beyond the curves are penalised: the minimum lies within.
        inside = np.clip(new, -some.reach, some.reach)
        merits, slope = value(some.at(inside), some.slope(inside))
        beyond = (new - inside) / _UNIT
        total = merits + beyond**2
        slope = np.where(beyond == 0.0, slope, 0.0) + 2.0 * beyond / _UNIT
        return float(np.einsum("n,n->", weight, total)), np.einsum("n,nk->k", weight * slope, design)

    found = scipy.optimize.minimize(merit_function, np.zeros(3), jac=True, method="BFGS", options={"gtol": 1e-9})
    dz, rx, ry = found.x * _UNIT
    return Motion(float(dz), float(np.arctan(rx / arm)), float(np.arctan(ry / arm)))


def _width(values: np.ndarray, slopes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return values[:, 0], slopes[:, 0]


def _square_ellipticity(values: np.ndarray, slopes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    # In units of 1e-3, so that the minimiser has numbers of order one.
    e, change = 1e3 * values[:, 1:], 1e3 * slopes[:, 1:]
    return (e**2).sum(axis=1), 2.0 * (e * change).sum(axis=1)


#: Merit of a place and its derivative with respect to the height, of values and slopes [n, 3].
_VALUES: dict[str, Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]] = {
    "fwhm": _width,
    "ellipticity": _square_ellipticity,
}


def _metrics(places: Places, values: np.ndarray) -> StateMetrics:
    return StateMetrics(places.mean(values[:, 0]), places.mean((values[:, 1:] ** 2).sum(axis=1)) ** 0.5)
