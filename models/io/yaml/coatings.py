"""Coatings of surfaces in prescription files, by name: tables against wavelength and angle, or thin films.

::

    coatings:
      silver: {wavelength_nm: [400, 600, 1000], efficiency: [0.93, 0.97, 0.98]}
      dichroic: {wavelength_nm: [400, 700], angle_deg: [0, 30, 60], efficiency: [[0.99, 0.98, 0.9], [0.98, 0.97, 0.9]]}
      mgf2: {layers: [{index: 1.38, thickness_nm: 99.6}]}
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import count
from typing import Any

import numpy as np

from ....core.errors import ConfigError, PachonError, PrescriptionError
from ....core.schema import Section, expected
from ...coating import AnyCoating, Coating
from ...layer_stack import CoatingTable, LayerStack
from ...surface import Surface
from .values import Numbers, PositiveNumber


class LayerSection(Section):
    """One thin film."""

    index: PositiveNumber
    thickness_nm: PositiveNumber


class CoatingSection(Section):
    """Efficiency against the wavelength, and the angle; or thin films."""

    wavelength_nm: Numbers = ()
    efficiency: Numbers | tuple[Numbers, ...] = ()
    angle_deg: Numbers = ()
    layers: tuple[LayerSection, ...] = ()

    @classmethod
    def check(cls, content: dict[str, Any]) -> None:  # noqa: D102
        if "layers" in content:
            for sibling in content:
                if sibling != "layers":
                    raise expected("layers alone", sibling)
            return
        for key in ("wavelength_nm", "efficiency"):
            if key not in content:
                raise expected("a list of numbers", key)

    def coating(self, name: str) -> AnyCoating:
        """Return the coating; ConfigError if its numbers make none."""
        if self.layers:
            indices, sizes = zip(*((layer.index, 1e-9 * layer.thickness_nm) for layer in self.layers), strict=True)
            return LayerStack(indices, sizes, name)
        waves = tuple(1e-9 * v for v in self.wavelength_nm)
        if self.angle_deg:
            rows = tuple(row if isinstance(row, tuple) else (row,) for row in self.efficiency)
            return CoatingTable(waves, tuple(map(float, np.deg2rad(self.angle_deg))), rows, name)
        plain = tuple(v for v in self.efficiency if not isinstance(v, tuple))
        if len(plain) < len(self.efficiency):
            raise ConfigError(f"efficiency of {name}: expected numbers; rows of them go with angle_deg")
        return Coating(waves, plain, name)

    def made(self, name: str) -> AnyCoating:
        """Return :meth:`coating` of a prescription; PrescriptionError if its numbers make none."""
        try:
            return self.coating(name)
        except PachonError as error:
            raise PrescriptionError(f"coatings.{name}: {error}", key=f"coatings.{name}") from None


def coating_items(coating: AnyCoating) -> dict[str, Any]:
    """Return the section of a coating."""
    if isinstance(coating, LayerStack):
        pairs = zip(coating.indices, coating.thicknesses, strict=True)
        return {"layers": [{"index": n, "thickness_nm": _in_nm(d)} for n, d in pairs]}
    section: dict[str, Any] = {"wavelength_nm": [_in_nm(w) for w in coating.wavelengths]}
    if isinstance(coating, CoatingTable):
        section["angle_deg"] = [_back(a, np.rad2deg, np.deg2rad) for a in coating.angles]
        return section | {"efficiency": [list(row) for row in coating.efficiencies]}
    return section | {"efficiency": list(coating.efficiencies)}


def coating_names(surfaces: Iterable[Surface]) -> dict[AnyCoating, str]:
    """Return a name for each coating: its own that no other coating has, else a number."""
    names: dict[AnyCoating, str] = {}
    numbered: Iterator[str] = (f"coating_{i}" for i in count(1))
    coatings = list(dict.fromkeys(s.coating for s in surfaces if s.coating is not None))
    for coating in coatings:
        is_free = coating.name and coating.name not in names.values()
        names[coating] = coating.name if is_free else next(n for n in numbered if n not in {c.name for c in coatings})
    return names


def _in_nm(value: float) -> float:
    return _back(value, lambda v: v / 1e-9, lambda v: 1e-9 * v)


def _back(value: float, there: Any, back: Any) -> float:
    """Return the shortest number that is converted back to a value, or the nearest one."""
    near = float(there(value))
    short = (float(f"{near:.{digits}g}") for digits in range(1, 18))
    beside = (float(np.nextafter(near, side)) for side in (-np.inf, np.inf))
    return next((v for v in (*short, *beside) if float(back(v)) == value), near)
