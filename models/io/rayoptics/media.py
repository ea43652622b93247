"""Media of the files of ray-optics, read and written.

Glasses of makers hold their coefficients; their range of wavelengths is that of the bundled catalogue of the maker.
Model glasses follow Buchdahl's formula with the coefficients in the file.
"""

from __future__ import annotations

from typing import Any

from ...media.dispersion import Dispersion
from ...media.medium import ConstantIndex, Medium, Sellmeier, abbe_number
from ...media.tabulated import TabulatedIndex
from ...telescope import VACUUM
from ..glass_catalogue import MAKERS, GlassCatalogue
from ..json_items import JsonObject
from ..lens.description import LensDescription
from ..lens.glasses import Glasses
from ..lens.sequence import LensSequence
from ..lens.text import scaled
from .items import array, attributes, class_name, instance, module_name, numbers

#: Formulas of the coefficients, by maker and number of them: Sellmeier's lists those of B before those of C.
FORMULAS = {
    ("schott", 6): "sellmeier", ("ohara", 6): "sellmeier", ("cdgm", 6): "schott", ("hoya", 6): "schott",
    ("sumita", 6): "schott", ("hikari", 6): "schott", ("hikari", 9): "extended_3",
}  # fmt: skip
#: Wavelengths [m] of glasses that the bundled catalogues do not have.
RANGE = (0.32e-6, 2.4e-6)
#: Attribute with the range of wavelengths [nm] of glasses that were written here, which ray-optics keeps.
RANGE_KEY = "wavelength_range_nm"
#: Classes of the glasses of makers. ray-optics has those of Hikari with nine coefficients only.
CLASSES = {
    "schott": "SchottGlass", "ohara": "OharaGlass", "hoya": "HoyaGlass", "sumita": "SumitaGlass", "cdgm": "CDGMGlass",
    "hikari": "HikariGlass",
}  # fmt: skip
#: Entries that a table needs for ray-optics' cubic spline.
_LEAST_ENTRIES = 4
#: Entries of the table of a formula.
_ENTRIES = 21
_MODULE = "opticalglass"


def medium_of(gap: JsonObject, lens: LensDescription, glasses: Glasses) -> Medium:
    """Return the medium of a gap."""
    medium = gap.child("medium")
    kind, values = class_name(medium), attributes(medium)
    with medium.part(f"medium {kind}").context():
        if kind == "Air":
            return VACUUM
        if kind in ("ConstantIndex", "Medium", "Glass") and "n" in values:
            index = values.number("n")
            return VACUUM if index == 1.0 else ConstantIndex(index)
        if kind == "ModelGlass":
            model = attributes(values, "bdhl_model")
            terms = (model.number("rind0"), *numbers(model, "coefs", 2), model.number("wv0"))
            return Dispersion("buchdahl", terms, _range(values), name=values.text("label", ""))
        if kind == "InterpolatedMedium":
            waves, indices = numbers(values, "wvls"), numbers(values, "rndx")
            table = sorted(zip((scaled(w, -9) for w in waves), indices, strict=False))
            number = 1 + len({m.name for m in (lens.medium, *(s.after for s in lens.surfaces)) if m != VACUUM})
            lengths, entries = zip(*table, strict=True) if table else ((), ())
            return TabulatedIndex(lengths, entries, name=values.text("label", "") or f"TABLE {number}")
        if "gname" in values:
            return _catalogue_glass(medium, values, glasses)
    raise medium.problem(
        f"medium {kind}: expected Air, ConstantIndex, ModelGlass, InterpolatedMedium or the glass of a maker"
    )


def _catalogue_glass(medium: JsonObject, values: JsonObject, glasses: Glasses) -> Medium:
    name, maker = values.text("gname"), module_name(medium)
    is_bundled = maker in MAKERS and name in GlassCatalogue.of_maker(maker)
    entry = GlassCatalogue.of_maker(maker)[name] if is_bundled else None
    terms = tuple(numbers(values, "coefs")) if "coefs" in values else ()
    formula = FORMULAS.get((maker, len(terms)))
    limits = _range(values, getattr(entry, "wavelength_range", RANGE))
    if formula == "sellmeier":
        return Sellmeier(terms[:3], terms[3:], limits, name=name)
    if formula is not None:
        return Dispersion(formula, terms, limits, name=name)
    return glasses.named(name, values.at("gname")) if entry is None else entry


def _range(values: JsonObject, usual: tuple[float, float] = RANGE) -> tuple[float, float]:
    """Return the range of wavelengths [m] that a medium states, or the usual one."""
    if RANGE_KEY not in values:
        return usual
    low, high = values.numbers(RANGE_KEY, 2)
    return scaled(low, -9), scaled(high, -9)


def _range_items(medium: Sellmeier | Dispersion) -> dict[str, Any]:
    return {RANGE_KEY: [scaled(v, 9) for v in medium.wavelength_range]}


class Media:
    """Items of the media of a telescope; formulas without a class of their own are tables if lenient, else refused."""

    def __init__(self, sequence: LensSequence) -> None:
        self.sequence = sequence
        self.found: dict[Medium, dict[str, Any]] = {}

    def items(self, medium: Medium) -> dict[str, Any]:
        """Return the items of a medium."""
        if medium not in self.found:
            self.found[medium] = _formula_items(medium) or self._table_items(medium)
        return self.found[medium]

    def _table_items(self, medium: Medium) -> dict[str, Any]:
        name = medium.name or type(medium).__name__
        waves, indices = self.sequence.index_table(medium, _ENTRIES, _LEAST_ENTRIES)
        if not isinstance(medium, TabulatedIndex) or waves != medium.wavelengths:
            text = f"glass {name}: {self.sequence.file} has no place for its formula"
            self.sequence.leave_out(text, "written as a table of its indices")
        table = {"label": name, "_catalog": "", "wvls": [scaled(w, 9) for w in waves], "rndx": list(indices)}
        return _item("opticalmedium", "InterpolatedMedium", table | {"kvals": None, "kvals_wvls": None})


def _formula_items(medium: Medium) -> dict[str, Any] | None:
    """Return the items of a medium that ray-optics has a class for, None for another."""
    if medium == VACUUM:
        return _item("opticalmedium", "Air", {})
    if isinstance(medium, ConstantIndex):
        return _item("opticalmedium", "ConstantIndex", {"label": medium.name, "n": medium.n, "_catalog_name": ""})
    if isinstance(medium, Sellmeier) and len(medium.B) <= 3:
        spare = (0.0,) * (3 - len(medium.B))
        return _glass_items(medium, "sellmeier", (*medium.B, *spare, *medium.C, *spare))
    if isinstance(medium, Dispersion) and medium.formula == "buchdahl":
        n, first, second, centre = medium.coefficients
        model = {"wv0": centre, "rind0": n, "coefs": array([first, second]), "label": "", "_catalog_name": ""}
        values = {
            "label": medium.name,
            "_catalog_name": "user",
            "n": n,
            "v": abbe_number(medium),
            **_range_items(medium),
        }
        return _item("modelglass", "ModelGlass", values | {"bdhl_model": _item("buchdahl", "Buchdahl2", model)})
    if isinstance(medium, Dispersion):
        return _glass_items(medium, "schott" if medium.formula == "sumita" else medium.formula, medium.coefficients)
    return None


def _glass_items(
    medium: Sellmeier | Dispersion, formula: str, coefficients: tuple[float, ...]
) -> dict[str, Any] | None:
    """Return the items of the glass of a maker with these coefficients: of its own, or one with the same formula."""
    own_forms = {key: kind for key, kind in FORMULAS.items() if key != ("hikari", 6)}
    makers = [maker for (maker, size), kind in own_forms.items() if (size, kind) == (len(coefficients), formula)]
    if not makers:
        return None
    makers_of_name = [m for m in makers if medium.name in GlassCatalogue.of_maker(m)]
    maker = (makers_of_name or makers)[0]
    values = {"gname": medium.name, "coefs": list(coefficients)}
    return _item(maker, CLASSES[maker], values | _range_items(medium))


def _item(module: str, kind: str, values: dict[str, Any]) -> dict[str, Any]:
    return instance(f"{_MODULE}.{module}", kind, values)
