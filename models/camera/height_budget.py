"""The focal-plane height budget of Jee & Tyson (2011), Table 1, and random heights drawn from it.

Every term has its own random streams, one for each raft or CCD, so leaving a term out leaves the others as they were
to the last bit. Heights are positive along +z of the telescope frame.

- ``global``: one random quadratic over the whole focal plane (tip, tilt, defocus-like and two astigmatism-like terms
  with normal weights), scaled to exactly the peak to valley over the CCDs, centred on zero.
- ``raft``: a piston for each raft, uniform within half the peak to valley on either side of zero.
- ``ccd``: the same for each CCD.
- ``tilt``: each CCD tilted about x and about y, each angle uniform within half the peak to valley on either side.
- ``potato_chip``: two crossed cosine waves of equal amplitude on each CCD, of random orientation and phase, each with
  1 to 2 cycles along a CCD's longer side, scaled to exactly the peak to valley over the CCD, with zero mean.

The paper gives the peak-to-valley sizes and the 1 to 2 cycles; the distributions are ours.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np

from ...core.arguments import check_arguments
from ...core.errors import DomainError, unknown_name
from ...core.random_streams import stream
from .camera import Camera
from .ccd_surfaces import CcdSurfaces

# Points a side at which the potato chip's peak and valley are searched: 64 a cycle or more, good to 0.1 %.
_POTATO_POINTS = 129


@check_arguments
@dataclass(frozen=True)
class HeightBudget:
    """Peak-to-valley size of each term of the focal-plane height.

    Parameters
    ----------
    global_height : float
        Surface of the whole focal plane [m].
    raft_height : float
        Height of rafts [m].
    ccd_height : float
        Height of CCDs on their raft [m].
    ccd_tilt : float
        Tilt of CCDs about either axis [rad].
    potato_chip : float
        Ripple within a CCD [m].
    potato_chip_cycles : tuple of float
        Fewest and most cycles of the ripple along a CCD's side.
    """

    global_height: float
    raft_height: float
    ccd_height: float
    ccd_tilt: float
    potato_chip: float
    potato_chip_cycles: tuple[float, float] = (1.0, 2.0)

    def __post_init__(self) -> None:
        for key in ("global_height", "raft_height", "ccd_height", "ccd_tilt", "potato_chip"):
            value = getattr(self, key)
            if not (np.isfinite(value) and value >= 0):
                raise DomainError(f"{key} = {value!r}: expected a peak to valley of zero or more")
        low, high = self.potato_chip_cycles
        if not 0 < low <= high < np.inf:
            raise DomainError(f"potato_chip_cycles = {self.potato_chip_cycles!r}: expected 0 < fewest <= most")


SPECIFICATION = HeightBudget(10e-6, 4.8e-6, 4e-6, 2.5e-4, 4e-6)
SIMULATED = HeightBudget(10e-6, 6.5e-6, 10e-6, 2.5e-4, 5e-6)
BudgetName = Literal["specification", "simulated"]
BUDGETS: dict[BudgetName, HeightBudget] = {"specification": SPECIFICATION, "simulated": SIMULATED}


def load_budget(name: BudgetName) -> HeightBudget:
    """Return a column of Table 1, "specification" or "simulated"; another name is an UnknownNameError."""
    if name not in BUDGETS:
        raise unknown_name("height budget", name, BUDGETS)
    return BUDGETS[name]


def chosen_terms(terms: str | Iterable[str] | None) -> tuple[str, ...]:
    """Return terms in the order of :data:`TERMS`, all by default; UnknownNameError for another name."""
    names = TERMS if terms is None else (terms,) if isinstance(terms, str) else tuple(terms)
    for term in names:
        if term not in TERMS:
            raise unknown_name("height term", term, TERMS)
    return tuple(term for term in TERMS if term in names)


@lru_cache(maxsize=16)
def draw_heights(camera: Camera, budget: HeightBudget, seed: int, terms: tuple[str, ...]) -> CcdSurfaces:
    """Draw the heights of every CCD: the sum of the given terms, of `TERMS`. Visits of a night share them."""
    polynomial = np.zeros((len(camera), 10))
    waves = np.zeros((len(camera), 2, 4))
    for term, draw in _DRAWS.items():
        if term in terms:
            # Added in the order of the table, whatever that of the terms: sums must not depend on it.
            polynomial += draw(camera, budget, seed)
    if "potato_chip" in terms:
        offset, waves = _potato_chip(camera, budget, seed)
        polynomial[:, 0] += offset
    return CcdSurfaces(camera.half_sizes, polynomial, waves)


def _global(camera: Camera, budget: HeightBudget, seed: int) -> np.ndarray:
    scale = camera.radius
    x, y = camera.centers.T / scale
    a, b = camera.half_sizes.T / scale
    px, py, power, astigmatism, oblique = stream(seed, "focal plane", "global").standard_normal(5)
    xx, yy, xy = power + astigmatism, power - astigmatism, oblique
    # px X + py Y + xx X^2 + yy Y^2 + xy X Y with (X, Y) = (x, y) + a u (c, s) + b v (-s, c), in powers of u and v.
    frame = camera.frame(np.arange(len(camera)))
    c, s = frame.along_focal_plane(np.ones(len(camera)), np.zeros(len(camera)))
    slope_u, slope_v = frame.along_ccd(px + 2 * xx * x + xy * y, py + 2 * yy * y + xy * x)
    polynomial = np.zeros((len(camera), 10))
    polynomial[:, 0] = px * x + py * y + xx * x**2 + yy * y**2 + xy * x * y
    polynomial[:, 1], polynomial[:, 2] = a * slope_u, b * slope_v
    polynomial[:, 3] = a**2 * (c**2 * xx + c * s * xy + s**2 * yy)
    polynomial[:, 4] = a * b * ((c**2 - s**2) * xy + 2 * c * s * (yy - xx))
    polynomial[:, 5] = b**2 * (s**2 * xx - c * s * xy + c**2 * yy)
    low, high = _quadratic_range(polynomial)
    polynomial[:, 0] -= 0.5 * (low + high)
    return polynomial * (budget.global_height / (high - low))


def _quadratic_range(polynomial: np.ndarray) -> tuple[float, float]:
    """Return the least and greatest value of quadratics over the tiles -1 <= u, v <= 1."""
    c0, cu, cv, uu, uv, vv = polynomial[:, :6].T
    ends = np.array([-1.0, 1.0])
    points = [(np.full_like(c0, u), np.full_like(c0, v)) for u in ends for v in ends]
    with np.errstate(divide="ignore", invalid="ignore"):
        points += [(-(cu + uv * v) / (2 * uu), np.full_like(c0, v)) for v in ends]
        points += [(np.full_like(c0, u), -(cv + uv * u) / (2 * vv)) for u in ends]
        determinant = 4 * uu * vv - uv**2
        points.append(((uv * cv - 2 * vv * cu) / determinant, (uv * cu - 2 * uu * cv) / determinant))
    values = []
    for u, v in points:
        inside = (np.abs(u) <= 1) & (np.abs(v) <= 1)
        values.append((c0 + cu * u + cv * v + uu * u**2 + uv * u * v + vv * v**2)[inside])
    extremes = np.concatenate(values)
    return float(extremes.min()), float(extremes.max())


def _raft(camera: Camera, budget: HeightBudget, seed: int) -> np.ndarray:
    half = abs(0.5 * budget.raft_height)
    pistons = np.array([stream(seed, "focal plane", "raft", name).uniform(-half, half) for name in camera.raft_names])
    polynomial = np.zeros((len(camera), 10))
    # Index -1, of CCDs without a raft, is that of the zero at the end.
    polynomial[:, 0] = np.append(pistons, 0.0)[camera.raft_index]
    return polynomial


def _ccd(camera: Camera, budget: HeightBudget, seed: int) -> np.ndarray:
    half = abs(0.5 * budget.ccd_height)
    polynomial = np.zeros((len(camera), 10))
    polynomial[:, 0] = [stream(seed, "focal plane", "ccd", name).uniform(-half, half) for name in camera.ccd_names]
    return polynomial


def _tilt(camera: Camera, budget: HeightBudget, seed: int) -> np.ndarray:
    half = abs(0.5 * budget.ccd_tilt)
    angles = [stream(seed, "focal plane", "tilt", name).uniform(-half, half, 2) for name in camera.ccd_names]
    polynomial = np.zeros((len(camera), 10))
    polynomial[:, 1:3] = camera.half_sizes * np.tan(angles)
    return polynomial


@lru_cache(maxsize=16)
def _potato_axis(half: float) -> np.ndarray:
    """Return the places along a side of a CCD [m] at which its peak and valley are searched."""
    return np.linspace(-half, half, _POTATO_POINTS)


def _potato_chip(camera: Camera, budget: HeightBudget, seed: int) -> tuple[np.ndarray, np.ndarray]:
    offset = np.zeros(len(camera))
    waves = np.zeros((len(camera), 2, 4))
    for i, (name, (a, b)) in enumerate(zip(camera.ccd_names, camera.half_sizes.tolist(), strict=True)):
        axis_x, axis_y = _potato_axis(a), _potato_axis(b)
        rng = stream(seed, "focal plane", "potato_chip", name)
        angle = rng.uniform(0.0, np.pi) + np.array([0.0, 0.5 * np.pi])
        k = 2 * np.pi * rng.uniform(*budget.potato_chip_cycles, 2) / (2.0 * max(a, b))
        phase = rng.uniform(0.0, 2 * np.pi, 2)
        kx, ky = k * np.cos(angle), k * np.sin(angle)
        along_y, along_x = np.exp(1j * (np.outer(ky, axis_y) + phase[:, None])), np.exp(1j * np.outer(kx, axis_x))
        ripple = np.real(along_y[:, :, None] * along_x[:, None, :]).sum(axis=0)
        amplitude = budget.potato_chip / (ripple.max() - ripple.min())
        waves[i] = np.stack([np.full(2, amplitude), kx, ky, phase], axis=-1)
        # Mean of a cosine over the rectangle: each axis contributes sin(k a) / (k a).
        offset[i] = -amplitude * np.sum(np.cos(phase) * np.sinc(kx * a / np.pi) * np.sinc(ky * b / np.pi))
    return offset, waves


_DRAWS = {"global": _global, "raft": _raft, "ccd": _ccd, "tilt": _tilt}
TERMS = (*_DRAWS, "potato_chip")
#: Size of each term among the fields of the budget.
BUDGET_KEYS = {
    "global": "global_height",
    "raft": "raft_height",
    "ccd": "ccd_height",
    "tilt": "ccd_tilt",
    "potato_chip": "potato_chip",
}
