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
``in_air: {air: ciddor, ...}``; ``shift: 1e-5`` adds to the index of any kind, ``dispersion: 1.02`` is a factor of its
change with wavelength, about the d line.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from ....core.errors import PachonError, PrescriptionError
from ....core.schema import Parameters, Tagged, unknown_key, written
from ...media.air import Air
from ...media.dispersion import Dispersion
from ...media.medium import ChangedIndex, ConstantIndex, Medium, RelativeToAir, Sellmeier, with_index_change
from ...media.tabulated import TabulatedIndex
from ..glass_catalogue import GlassCatalogue
from .values import Band, Number, Numbers, OptionalFile, PositiveNumber, Text, Wavelengths


class MediumSection(Parameters):
    """A medium of any kind; `shift` adds to its index, `dispersion` is a factor of its change with wavelength."""

    shift: Number = 0.0
    dispersion: PositiveNumber = 1.0

    def medium(self, name: str) -> Medium:
        """Return the medium under a name."""
        return with_index_change(replace(self.build(), name=name), self.shift, self.dispersion)


AIR = MediumSection.of(
    Air,
    pressure_pa=(Number, Air.pressure),
    temperature_k=(Number, Air.temperature),
    water_vapour_pa=(Number, Air.water_vapour),
    co2_ppm=(Number, Air.co2_ppm),
    air=(Text, Air.formula),
)


class GlassSection(MediumSection):
    """A medium whose indices are relative to the air of `in_air`, or to vacuum."""

    in_air: Annotated[Air | None, Tagged({"air": AIR}, lambda content: "air")] = None

    def medium(self, name: str) -> Medium:
        """Return the medium under a name."""
        medium = replace(self.build(), name=name)
        medium = RelativeToAir(medium, self.in_air, name) if self.in_air else medium
        return with_index_change(medium, self.shift, self.dispersion)


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
    "air": AIR,
    "glass": GlassSection.of(_glass, glass=Text, catalogue=(OptionalFile, None)),
    "B": GlassSection.of(Sellmeier, B=Numbers, C=Numbers, range=Band),
}


def _kind(content: dict[str, Any]) -> str:
    kinds = [*MEDIA, "C", "range", "in_air", "shift", "dispersion"]
    for key in content:
        if key not in kinds and not MEDIA.keys() & content.keys():
            raise unknown_key(key, kinds)
    return next((kind for kind in MEDIA if kind in content), "B")


AnyMedium = Annotated[MediumSection, Tagged(MEDIA, _kind, built=False)]


def medium_items(medium: Medium) -> dict[str, Any]:
    """Return the section of a medium; PrescriptionError where prescription files have no such kind."""
    if isinstance(medium, RelativeToAir):
        return medium_items(medium.relative) | {"in_air": medium_items(medium.air)}
    if isinstance(medium, ChangedIndex):
        factor = {"dispersion": medium.dispersion} if medium.dispersion != 1.0 else {}
        return medium_items(medium.medium) | {"shift": medium.change} | factor
    if (section := written(MEDIA, medium)) is None:
        raise PrescriptionError(f"medium {type(medium).__name__}: expected one that prescription files can hold")
    kind, items = section
    return {kind: items[kind]} | items
