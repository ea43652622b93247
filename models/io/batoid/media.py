"""Media of batoid files: sections of YAML, and their text.

A medium is a number, its refractive index, or has its class under ``type``: ``ConstMedium`` (``n``), ``TableMedium``
(``wavelengths`` [m], ``ns``), ``SellmeierMedium`` (``B1`` to ``C3``), ``SumitaMedium`` (``A0`` to ``A5``), ``Air``
(``pressure`` [kPa], ``temperature`` [K], ``h2o_pressure`` [kPa]).
"""

from __future__ import annotations

from decimal import Decimal
from typing import Annotated, Any

from pydantic import BeforeValidator

from ....core.errors import PrescriptionError
from ....core.schema import Parameters, Tagged, expected
from ....core.yaml_reader import as_number
from ...media.air import Air
from ...media.dispersion import Dispersion
from ...media.medium import ConstantIndex, Medium, Sellmeier
from ...media.tabulated import TabulatedIndex
from ..yaml.values import Number, Numbers

#: Wavelengths [m] that dispersion formulas are read for, as batoid states none: those of fused silica.
FORMULA_RANGE = Sellmeier.wavelength_range


class MediumSection(Parameters):
    """A medium: the name of its class, and its parameters."""

    type: str


def _sellmeier(*coefficients: float) -> Sellmeier:
    return Sellmeier(coefficients[:3], coefficients[3:], FORMULA_RANGE)


def _sumita(*coefficients: float) -> Dispersion:
    return Dispersion("sumita", coefficients, FORMULA_RANGE)


def _table(wavelengths: tuple[float, ...], indices: tuple[float, ...]) -> TabulatedIndex:
    return TabulatedIndex(wavelengths, indices, "linear")


def _air(pressure: float, temperature: float, vapour: float) -> Air:
    return Air(_scaled(pressure, 3), temperature, _scaled(vapour, 3), formula="filippenko")


def _scaled(value: float, power: int) -> float:
    """Return a number times a power of ten: the decimal point is moved, so that it loads back equal."""
    return float(Decimal(repr(value)).scaleb(power))


_SELLMEIER = [f"{letter}{i}" for letter in "BC" for i in (1, 2, 3)]
_SUMITA = [f"A{i}" for i in range(6)]
#: Sections by the name of the class.
MEDIA: dict[str, type[MediumSection]] = {
    "ConstMedium": MediumSection.of(ConstantIndex, n=Number),
    "TableMedium": MediumSection.of(_table, wavelengths=Numbers, ns=Numbers),
    "SellmeierMedium": MediumSection.of(_sellmeier, **dict.fromkeys(_SELLMEIER, Number)),
    "SumitaMedium": MediumSection.of(_sumita, **dict.fromkeys(_SUMITA, Number)),
    "Air": MediumSection.of(
        _air, pressure=(Number, 69.328), temperature=(Number, 293.15), h2o_pressure=(Number, 1.067)
    ),
}


def _as_section(value: Any) -> Any:
    if isinstance(value, dict):
        return value
    if (index := as_number(value)) is None:
        raise expected("a refractive index, or a mapping with a type")
    return {"type": "ConstMedium", "n": index}


#: A medium as the annotation of a field.
AnyMedium = Annotated[Medium, Tagged.by_value("type", MEDIA), BeforeValidator(_as_section)]


def medium_items(medium: Medium) -> float | dict[str, Any]:
    """Return the section of a medium; PrescriptionError where batoid has no such medium."""
    if isinstance(medium, ConstantIndex):
        return medium.n
    if isinstance(medium, Sellmeier) and len(medium.B) <= 3:
        terms = [*medium.B, *[0.0] * (3 - len(medium.B)), *medium.C, *[0.0] * (3 - len(medium.C))]
        return {"type": "SellmeierMedium"} | dict(zip(_SELLMEIER, terms, strict=True))
    if isinstance(medium, Dispersion) and medium.formula in ("schott", "sumita"):
        terms = [*medium.coefficients, *[0.0] * (6 - len(medium.coefficients))]
        return {"type": "SumitaMedium"} | dict(zip(_SUMITA, terms, strict=True))
    if isinstance(medium, TabulatedIndex) and medium.interpolation == "linear":
        return {"type": "TableMedium", "wavelengths": list(medium.wavelengths), "ns": list(medium.indices)}
    if isinstance(medium, Air) and medium.formula == "filippenko":
        kpa = _scaled(medium.pressure, -3), _scaled(medium.water_vapour, -3)
        return {"type": "Air", "pressure": kpa[0], "temperature": medium.temperature, "h2o_pressure": kpa[1]}
    kind = getattr(medium, "formula", getattr(medium, "interpolation", ""))
    raise PrescriptionError(
        f"medium {medium.name or type(medium).__name__}{f' ({kind})' if kind else ''}: "
        f"expected one that batoid has: {', '.join(MEDIA)}"
    )
