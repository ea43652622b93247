"""Refractive media in prescription files: sections of YAML, and their text.

=================================================================== ==================================================
``{n: 1.5}``                                                        constant index
``{B: [...], C: [...], range: [0.3, 2.5]}``                         Sellmeier, as many terms as wanted; C in um^2
``{formula: schott, coefficients: [...], range: [0.3, 2.5]}``       one of the formulas of `dispersion`
``{wavelengths: [...], indices: [...], interpolation: monotone}``   table; or ``linear``
``{air: ciddor, pressure_pa: 74000, temperature_k: 283, ...}``      air, with ``water_vapour_pa``, ``co2_ppm``
``{glass: N-BK7}``                                                  glass of the bundled catalogue, or of
                                                                    ``catalogue: file.agf`` beside the prescription
=================================================================== ==================================================

``range`` and ``wavelengths`` are in the wavelength unit of the file. Indices relative to air carry that air,
``in_air: {air: ciddor, ...}``; ``shift: 1e-5`` adds to the index of any kind.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from ....core.errors import PachonError, PrescriptionError
from ....core.schema import Parameters, Tagged, mapping, unknown_key
from ...media.air import Air
from ...media.dispersion import Dispersion
from ...media.medium import ChangedIndex, ConstantIndex, Medium, RelativeToAir, Sellmeier, with_index_change
from ...media.tabulated import TabulatedIndex
from ..glass_catalogue import GlassCatalogue
from .values import Band, Number, Numbers, OptionalFile, Text, Wavelengths

#: Keys of air, and its attributes.
AIR_KEYS = {
    "pressure_pa": "pressure",
    "temperature_k": "temperature",
    "water_vapour_pa": "water_vapour",
    "co2_ppm": "co2_ppm",
}


class MediumSection(Parameters):
    """A medium of any kind; `shift` adds to its index."""

    shift: Number = 0.0

    def medium(self, name: str) -> Medium:
        """Return the medium under a name."""
        return with_index_change(replace(self.build(), name=name), self.shift)


class AirSection(MediumSection):
    """Air; quantities that are left out are those of :class:`~pachon.models.media.air.Air`."""

    air: Text = "ciddor"
    pressure_pa: Number = 0.0
    temperature_k: Number = 0.0
    water_vapour_pa: Number = 0.0
    co2_ppm: Number = 0.0

    def build(self) -> Air:
        """Return the air."""
        given = {AIR_KEYS[key]: getattr(self, key) for key in AIR_KEYS if key in self.model_fields_set}
        return Air(formula=self.air, **given)


class GlassSection(MediumSection):
    """A medium whose indices are relative to the air of `in_air`, or to vacuum."""

    in_air: Annotated[AirSection | None, mapping] = None

    def medium(self, name: str) -> Medium:
        """Return the medium under a name."""
        medium = replace(self.build(), name=name)
        relative = medium if self.in_air is None else RelativeToAir(medium, self.in_air.build(), name)
        return with_index_change(relative, self.shift)


def _glass(name: str, file: Path | None) -> Medium:
    catalogue = GlassCatalogue.bundled() if file is None else GlassCatalogue.read(file)
    try:
        return catalogue[name]
    except PachonError as error:
        problem = f"glass = {name!r}: expected a glass of the catalogue ({error})"
        raise PrescriptionError(problem, key="glass") from None


#: Sections of media by the key that tells their kind.
MEDIA: dict[str, type[MediumSection]] = {
    "n": GlassSection.of(ConstantIndex, n=Number),
    "formula": GlassSection.of(Dispersion, formula=Text, coefficients=Numbers, range=Band),
    "wavelengths": GlassSection.of(
        TabulatedIndex, wavelengths=Wavelengths, indices=Numbers, interpolation=(Text, "monotone")
    ),
    "air": AirSection,
    "glass": GlassSection.of(_glass, glass=Text, catalogue=(OptionalFile, None)),
    "B": GlassSection.of(Sellmeier, B=Numbers, C=Numbers, range=Band),
}


def _kind(content: dict[str, Any]) -> str:
    known = [*MEDIA, "C", "range", "in_air", "shift"]
    for key in content:
        if key not in known and not MEDIA.keys() & content.keys():
            raise unknown_key(key, known)
    return next((kind for kind in MEDIA if kind in content), "B")


AnyMedium = Annotated[MediumSection, Tagged(MEDIA, _kind, built=False)]


def medium_wavelengths(medium: Medium) -> tuple[float, ...]:
    """Return the wavelengths [m] in the section of a medium."""
    if isinstance(medium, RelativeToAir):
        return medium_wavelengths(medium.relative)
    if isinstance(medium, ChangedIndex):
        return medium_wavelengths(medium.medium)
    if isinstance(medium, TabulatedIndex):
        return medium.wavelengths
    return medium.wavelength_range if isinstance(medium, (Sellmeier, Dispersion)) else ()


def medium_items(medium: Medium, wavelength: Callable[[float], float]) -> dict[str, Any]:
    """Return the section of a medium; `wavelength` converts metres to the unit of the file.

    Raises
    ------
    PrescriptionError
        If prescription files have no such kind of medium.
    """

    def waves(values: tuple[float, ...]) -> list[float]:
        return [wavelength(v) for v in values]

    if isinstance(medium, ConstantIndex):
        return {"n": medium.n}
    if isinstance(medium, Sellmeier):
        return {"B": medium.B, "C": medium.C, "range": waves(medium.wavelength_range)}
    if isinstance(medium, Dispersion):
        limits = waves(medium.wavelength_range)
        return {"formula": medium.formula, "coefficients": medium.coefficients, "range": limits}
    if isinstance(medium, TabulatedIndex):
        table = {"wavelengths": waves(medium.wavelengths), "indices": medium.indices}
        return table | {"interpolation": medium.interpolation}
    if isinstance(medium, Air):
        return {"air": medium.formula} | {key: getattr(medium, name) for key, name in AIR_KEYS.items()}
    if isinstance(medium, RelativeToAir):
        return medium_items(medium.relative, wavelength) | {"in_air": medium_items(medium.air, wavelength)}
    if isinstance(medium, ChangedIndex):
        return medium_items(medium.medium, wavelength) | {"shift": medium.change}
    raise PrescriptionError(f"medium {type(medium).__name__}: expected one that prescription files can hold")
