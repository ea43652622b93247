"""Tables of metrics: names, units, tolerances, and the functions that compute them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

from ...core.units import angular
from .scene import Scene

#: Reasons of the tolerances.
REASONS = {
    "path": "Float64 path from the sky to the detector, 1e-13 of its length: each surface rounds at 1e-16 of it, and "
    "fused multiply-adds, vector width and the order of sums differ between machines.",
    "curve": "Curve of 300 points over an image of 96 x 96 pixels: sums of 1e5 terms round at 1e-12, on a slope.",
    "edge": "1.5 of 4096 rays: one that grazes an edge may fall to either side by rounding.",
    "height": "Sums of sines of some 10 um in float64 would round at 1e-15 um; 1 pm is what an optical path sees. The "
    "seed is fixed: a NumPy that drew other numbers from it would move heights by micrometres.",
    "image": "Stamps and Fourier sums of the long-exposure engine are float32 (6e-8), thousands of terms each.",
    "model": "Singular vectors of float32 stamps: those of the smallest singular values are theirs to rounding.",
    "given": "Given when the baseline was saved.",
}
S = TypeVar("S")  #: kind of scene from which a table computes its metrics
_PER_METRE = {"m": 1.0, "mm": 1e3, "um": 1e6, "nm": 1e9}
#: Units of what is an angle where the image is at infinity; wavefronts stay in nanometres.
_ANGULAR = {"m": "", "mm": "mrad", "um": "urad", "1/mm": "1/mrad"}


@dataclass(frozen=True)
class Metric:
    """One metric, of one or several places; a tolerance is the change that another machine may cause."""

    name: str  #: start of the names of its values
    unit: str = ""  #: empty for pure numbers
    reason: str = ""  #: of the tolerance, a key of :data:`REASONS`; empty for metrics without a tolerance
    #: In the unit, or a function of scene and value; for lengths by default ``Scene.length_tolerance``.
    tolerance: float | Callable[[Scene, float], float] | None = None
    meaning: str = ""  #: definition, as reports and tables state it; a clause without a full stop

    @property
    def in_angles(self) -> Metric:
        """The same of afocal telescopes, whose images are at infinity: radians in place of metres."""
        return replace(self, name=angular(self.name), unit=_ANGULAR.get(self.unit, self.unit))

    def tolerance_of(self, scene: Scene, value: float) -> float:
        """Return the tolerance of a value, in its unit."""
        if self.tolerance is None:
            return scene.length_tolerance * _PER_METRE[self.unit]
        return self.tolerance if isinstance(self.tolerance, float) else self.tolerance(scene, value)


@dataclass(frozen=True)
class MetricGroup(Generic[S]):
    """Metrics that are computed together, from a scene to values by name."""

    compute: Callable[[S], dict[str, float]]
    metrics: tuple[Metric, ...]

    def metric(self, name: str) -> Metric:
        """Return the metric of a value."""
        return next(m for m in self.metrics if name.startswith(m.name))


class MetricTable(dict[str, MetricGroup[S]], Generic[S]):
    """Groups of metrics by name."""

    def group(
        self, name: str, *metrics: Metric
    ) -> Callable[[Callable[[S], dict[str, float]]], Callable[[S], dict[str, float]]]:
        """Return a decorator that adds a function of a scene as a group of metrics."""

        def add(compute: Callable[[S], dict[str, float]]) -> Callable[[S], dict[str, float]]:
            self[name] = MetricGroup(compute, metrics)
            return compute

        return add

    def metric(self, name: str) -> Metric | None:
        """Return the metric of a value: of those whose names start its own, the longest; None where there is none."""
        metrics = [m for group in self.values() for m in group.metrics]
        matching_metrics = [m for m in (*metrics, *(m.in_angles for m in metrics)) if name.startswith(m.name)]
        return max(matching_metrics, key=lambda m: len(m.name), default=None)


#: Metrics of the light that reaches the detector, of stars and of bare telescopes.
THROUGHPUT = (
    Metric("throughput_mean", meaning="lit fraction of the pupil, mean over stars or fields"),
    Metric("throughput_min", meaning="lit fraction of the pupil, least of stars or fields"),
)
