"""Sum of shapes, such as a conic and its measured errors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import PrescriptionError
from .shape import Pair, Shape, Triple


@check_arguments
@dataclass(frozen=True)
class Sum(Shape):
    """Sum of the sags of several shapes.

    Parameters keep their names; where two parts have the same, that of a later one is ``part2.Z4``, parts counted
    from 1.

    Parameters
    ----------
    parts : tuple of Shape
        At least one shape.
    """

    parts: tuple[Shape, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "parts", tuple(self.parts))
        if not self.parts:
            raise PrescriptionError("sum = []: expected at least one shape")

    @property
    def curvature(self) -> float:  # noqa: D102
        return sum(component.curvature for component in self.parts)

    @property
    def curvatures(self) -> tuple[float, float]:  # noqa: D102
        along_x, along_y = zip(*(component.curvatures for component in self.parts), strict=True)
        return sum(along_x), sum(along_y)

    @property
    def fourth_order(self) -> float:  # noqa: D102
        # The coefficients of r^4 add, those of the spheres (c^3 / 8) do not add to that of the sum's sphere.
        return sum(p.fourth_order + p.curvature**3 / 8 for p in self.parts) - self.curvature**3 / 8

    def _sag(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.sum([component.sag(x, y) for component in self.parts], axis=0)

    def _gradient(self, x: np.ndarray, y: np.ndarray) -> Pair:
        along_x, along_y = np.sum([component.gradient(x, y) for component in self.parts], axis=0)
        return along_x, along_y

    def _hessian(self, x: np.ndarray, y: np.ndarray) -> Triple:
        xx, xy, yy = np.sum([component.hessian(x, y) for component in self.parts], axis=0)
        return xx, xy, yy

    @property
    def parameters(self) -> dict[str, float]:  # noqa: D102
        values = [component.parameters for component in self.parts]
        return {name: values[i][inner] for name, (i, inner) in self._places.items()}

    @cached_property
    def _places(self) -> dict[str, tuple[int, str]]:
        """Index of the part, and name within it, of each parameter."""
        places: dict[str, tuple[int, str]] = {}
        for i, component in enumerate(self.parts):
            for name in component.parameters:
                places[f"part{i + 1}.{name}" if name in places else name] = (i, name)
        return places

    def place(self, name: str) -> tuple[Shape, str]:
        """Return the part that a parameter belongs to, and its name there."""
        self._check_parameter(name)
        i, inner = self._places[name]
        return self.parts[i], inner

    def with_parameters(self, values: Mapping[str, float]) -> Shape:  # noqa: D102
        inner: dict[int, dict[str, float]] = {}
        for name, value in values.items():
            self._check_parameter(name)
            i, inner_name = self._places[name]
            inner.setdefault(i, {})[inner_name] = value
        parts = (p.with_parameters(inner[i]) if i in inner else p for i, p in enumerate(self.parts))
        return replace(self, parts=tuple(parts))

    def _check_parameter(self, name: str) -> None:
        if name not in self._places:
            super()._check_parameter(name)

    def sag_derivative(self, name: str, x: ArrayLike, y: ArrayLike) -> Triple:  # noqa: D102
        component, inner = self.place(name)
        return component.sag_derivative(inner, x, y)

    def _changed(self, name: str, value: float) -> Shape:
        i, inner = self._places[name]
        changed = self.parts[i].with_parameter(inner, value)
        return replace(self, parts=(*self.parts[:i], changed, *self.parts[i + 1 :]))
