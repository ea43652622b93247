"""Materials of optiland as media, and media as materials.

A ``Material`` is known by the file of the refractiveindex.info database that it was taken from, whose folder is the
maker; without one by its name. Formulas of a ``DataMaterial`` are numbered as in that database: 1 and 2 are
Sellmeier's, 3 a series of powers.
"""

from __future__ import annotations

import re
from typing import Any

from ....core.errors import PrescriptionError
from ...media.dispersion import Dispersion, model_glass
from ...media.medium import ConstantIndex, Medium, Sellmeier
from ...media.tabulated import TabulatedIndex
from ...telescope import VACUUM
from ..glass_catalogue import MAKERS, SUBSTANCES, GlassCatalogue
from ..json_items import JsonObject
from ..lens.description import LensDescription
from ..lens.glasses import Glasses
from ..lens.source import Findings
from ..lens.text import scaled

#: Powers of the wavelength [um] in the series of makers, by the name of the formula.
SERIES = {
    "schott": (0, 2, -2, -4, -6, -8),
    "extended": (0, 2, -2, -4, -6, -8, -10, -12),
    "extended_2": (0, 2, -2, -4, -6, -8, 4, 6),
    "extended_3": (0, 2, 4, -2, -4, -6, -8, -10, -12),
}
#: Wavelengths [um] that a formula is read for where the file states none.
WIDEST_RANGE = (0.2, 20.0)


def medium_of(material: JsonObject, lens: LensDescription, glasses: Glasses) -> Medium:
    """Return the medium of a material."""
    kind = material.text("type")
    if kind == "IdealMaterial":
        index = material.number("index")
        with material.at("index").context():
            return VACUUM if index == 1.0 else ConstantIndex(index)
    if kind in ("Material", "MaterialFile"):
        return _catalogue_glass(material, glasses, lens.findings)
    if kind == "DataMaterial":
        with material.part("definition").context():
            # Materials without a name are numbered among the glasses of the lens.
            number = 1 + len({m.name for m in (lens.medium, *(s.after for s in lens.surfaces)) if m != VACUUM})
            return _data_medium(material, material.text("name", "") or f"MATERIAL_{number}")
    if kind == "AbbeMaterial":
        nd, vd = material.number("index"), material.number("abbe")
        text = f"AbbeMaterial {nd:g}, {vd:g}: optiland's dispersion of it is not read"
        lens.findings.note(material.problem(text), "taken as a model glass of that index and Abbe number")
        with material.at("index").context():
            return model_glass(nd, vd)
    raise material.problem(
        f"material_post {kind}: expected IdealMaterial, Material, MaterialFile, DataMaterial or AbbeMaterial"
    )


def _catalogue_glass(material: JsonObject, glasses: Glasses, findings: Findings) -> Medium:
    path = re.findall(r"[^/\\]+", material.text("filename", ""))
    name = path[-1].rsplit(".", 1)[0] if path else material.text("name")
    maker = (path[-2] if len(path) > 1 else material.text("reference", "")).lower()
    if "main" in path[:-2]:
        # Substances stand in folders of their own, a file for each author.
        name, maker = f"{path[path.index('main') + 1]}_{name}", SUBSTANCES
    if maker in (*MAKERS, SUBSTANCES) and name in GlassCatalogue.of_maker(maker):
        # Several makers have glasses of one name.
        return GlassCatalogue.of_maker(maker)[name]
    if maker:
        text = f"material {name} of {maker}: not among the bundled glasses"
        findings.report(material.problem(text), "a glass of that name is taken")
    return glasses.named(name, material.at("filename" if path else "name"))


def _data_medium(material: JsonObject, name: str) -> Medium:
    dispersion = material.child("definition").child("dispersion")
    if dispersion.text("kind") == "tabulated":
        waves, indices = dispersion.numbers("wavelengths_um"), dispersion.numbers("indices")
        return TabulatedIndex(tuple(scaled(w, -6) for w in waves), tuple(indices), "linear", name=name)
    formula, terms = dispersion.text("formula"), dispersion.numbers("coefficients")
    limits = dispersion.numbers("wavelength_range_um") or WIDEST_RANGE
    if len(limits) != 2:
        dispersion.refuse("wavelength_range_um", "two numbers")
    low, high = (scaled(v, -6) for v in limits)
    if formula in ("formula 1", "formula 2") and terms and terms[0] == 0 and len(terms) % 2:
        b, c = tuple(terms[1::2]), tuple(v * v if formula == "formula 1" else v for v in terms[2::2])
        return Sellmeier(b, c, (low, high), name=name)
    if formula == "formula 3" and len(terms) % 2:
        coefficients = {0.0: terms[0], **dict(zip(terms[2::2], terms[1::2], strict=True))}
        for key, powers in SERIES.items():
            if coefficients.keys() <= set(powers):
                return Dispersion(key, tuple(coefficients.get(p, 0.0) for p in powers), (low, high), name=name)
    raise dispersion.problem(f"{formula} of {name}: expected formula 1 or 2 (Sellmeier) or 3 (powers of makers)")


def material_items(medium: Medium) -> dict[str, Any]:
    """Return the dictionary of a medium; PrescriptionError where optiland has none like it."""
    if isinstance(medium, ConstantIndex):
        return {"type": "IdealMaterial", "index": medium.n, "absorp": 0.0, **_PROPAGATION}
    if isinstance(medium, Sellmeier):
        terms = [v for pair in zip(medium.B, medium.C, strict=True) for v in pair]
        return _data_items(medium, "formula 2", [0.0, *terms], medium.wavelength_range)
    if isinstance(medium, Dispersion) and ("schott" if medium.formula == "sumita" else medium.formula) in SERIES:
        powers = SERIES["schott" if medium.formula == "sumita" else medium.formula]
        first, *higher_terms = medium.coefficients
        terms = [v for a, p in zip(higher_terms, powers[1:], strict=False) for v in (a, float(p))]
        return _data_items(medium, "formula 3", [first, *terms], medium.wavelength_range)
    if isinstance(medium, TabulatedIndex) and medium.interpolation == "linear":
        table = {"wavelengths_um": [scaled(w, 6) for w in medium.wavelengths], "indices": list(medium.indices)}
        return _material(medium, {"kind": "tabulated", **table})
    raise PrescriptionError("expected a constant index, a formula of Sellmeier or of powers, or a linear table")


_PROPAGATION = {"propagation_model": {"class": "HomogeneousPropagation"}}


def _data_items(medium: Medium, formula: str, terms: list[float], limits: tuple[float, float]) -> dict[str, Any]:
    low, high = (scaled(v, 6) for v in limits)
    dispersion = {"kind": "formula", "formula": formula, "coefficients": terms, "wavelength_range_um": [low, high]}
    return _material(medium, dispersion)


def _material(medium: Medium, dispersion: dict[str, Any]) -> dict[str, Any]:
    definition = {"dispersion": dispersion, "extinction": None, "thermal": None}
    return {
        "type": "DataMaterial", **_PROPAGATION, "name": medium.name, "definition": definition, "bounds": "clamp",
        "metadata": {},
    }  # fmt: skip
