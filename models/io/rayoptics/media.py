"""Media of ray-optics as glasses of a lens file.

Glasses of makers hold their coefficients; their range of wavelengths is that of the bundled catalogue of the maker.
Model glasses follow Buchdahl's formula with the coefficients in the file.
"""

from __future__ import annotations

from ....core.errors import PrescriptionError
from ...media.dispersion import Dispersion
from ...media.medium import Medium, Sellmeier
from ...media.tabulated import TabulatedIndex
from ..glass_catalogue import MAKERS, GlassCatalogue
from ..json_items import JsonObject
from ..zemax.file import Findings
from ..zemax.placed import Line, PlacedSurfaces
from .items import attributes, class_name, module_name, numbers

#: Formulas of the coefficients, by maker and number of them: Sellmeier's lists those of B before those of C.
FORMULAS = {
    ("schott", 6): "sellmeier", ("ohara", 6): "sellmeier", ("cdgm", 6): "schott", ("hoya", 6): "schott",
    ("sumita", 6): "schott", ("hikari", 6): "schott", ("hikari", 9): "extended_3",
}  # fmt: skip
#: Wavelengths [m] of glasses that the bundled catalogues do not have.
RANGE = (0.32e-6, 2.4e-6)


def medium_lines(gap: JsonObject, found: PlacedSurfaces, findings: Findings) -> list[Line]:
    """Return the line of the medium of a gap, none for air."""
    medium = gap.child("medium")
    kind, values = class_name(medium), attributes(medium)
    if kind == "Air":
        return []
    if kind in ("ConstantIndex", "Medium", "Glass") and "n" in values:
        return found.constant_glass(values.number("n"))
    if kind == "ModelGlass":
        model = attributes(values, "bdhl_model")
        terms = (model.number("rind0"), *numbers(model, "coefs", 2), model.number("wv0"))
        name = f"MODEL {terms!r}"
        return found.glass(name, Dispersion("buchdahl", terms, RANGE, name=values.text("label", "")))
    if kind == "InterpolatedMedium":
        waves, indices = numbers(values, "wvls"), numbers(values, "rndx")
        table = sorted(zip((w / 1e9 for w in waves), indices, strict=False))
        name = values.text("label", "") or f"TABLE {len(found.glasses) + 1}"
        lengths, entries = zip(*table, strict=True) if table else ((), ())
        try:
            return found.glass(name, TabulatedIndex(lengths, entries, name=name))
        except PrescriptionError as error:
            raise medium.problem(f"medium {name}: {error}") from None
    if "gname" in values:
        return _catalogue_glass(medium, values, found)
    raise medium.problem(
        f"medium {kind}: expected Air, ConstantIndex, ModelGlass, InterpolatedMedium or the glass of a maker"
    )


def _catalogue_glass(medium: JsonObject, values: JsonObject, found: PlacedSurfaces) -> list[Line]:
    name, maker = values.text("gname"), module_name(medium)
    known = maker in MAKERS and name in GlassCatalogue.of_maker(maker)
    entry = GlassCatalogue.of_maker(maker)[name] if known else None
    terms = tuple(numbers(values, "coefs")) if "coefs" in values else ()
    formula = FORMULAS.get((maker, len(terms)))
    limits = getattr(entry, "wavelength_range", RANGE)
    if formula is not None:
        own: Medium = (
            Sellmeier(terms[:3], terms[3:], limits, name=name)
            if formula == "sellmeier"
            else Dispersion(formula, terms, limits, name=name)
        )
        return found.glass(f"{name} ({maker})", own)
    return [("GLAS", name)] if entry is None else found.glass(f"{name} ({maker})", entry)
