"""Profiles of ray-optics as shapes, and shapes as profiles.

================ ====================================================================================================
Spherical, Conic curvature ``cv``, conic constant ``cc``
EvenPolynomial   + ``coefs`` of r^2, r^4..., or ``coef2``, ``coef4``...
RadialPolynomial + ``coefs`` of r, r^2..., or ``coef1``, ``coef2``...; its conic constant may stand as ``ec`` = cc + 1
================ ====================================================================================================
"""

from __future__ import annotations

from typing import Any

from ....core.errors import PrescriptionError
from ...shapes.shape import Shape
from ..json_items import JsonObject
from ..lens import shapes
from ..lens.shapes import MOST_ODD
from ..lens.source import Findings
from ..profile import Profile
from .items import attributes, class_name, instance, numbers

#: Power of r of each step of the coefficients.
POLYNOMIALS = {"EvenPolynomial": 2, "RadialPolynomial": 1}
#: Attributes that are copies of others or count them.
_COPIES = ("max_nonzero_coef", *(f"coef{i}" for i in range(1, 21)), "coefs")
_MOST_TERMS = 10
_MODULE = "rayoptics.elem.profiles"


def shape_of(profile: JsonObject, unit: float, findings: Findings) -> Shape:
    """Return the shape of a profile, whose lengths are in a unit [m]."""
    kind, values = class_name(profile), attributes(profile)
    kinds = ("Spherical", "Conic", *POLYNOMIALS)
    if kind not in kinds:
        findings.report(profile.problem(f"profile {kind}: expected one of {', '.join(kinds)}"), "taken as a sphere")
    curvature = values.number("cv", 0.0) / unit
    constant = values.number("ec") - 1.0 if "ec" in values and "cc" not in values else values.number("cc", 0.0)
    if kind not in POLYNOMIALS:
        values.report_rest(findings, ("c",) if kind == "Spherical" else ())
        return shapes.conic(curvature, constant)
    step = POLYNOMIALS[kind]
    terms = numbers(values, "coefs") if "coefs" in values else []
    terms = terms or [values.number(f"coef{step * i}", 0.0) for i in range(1, _MOST_TERMS + 1)]
    values.report_rest(findings, _COPIES)
    if step == 1 and any(terms[MOST_ODD:]):
        raise profile.problem(f"coefs = {len(terms)} numbers: expected at most {MOST_ODD}")
    powers = [a * unit ** (1 - step * i) for i, a in enumerate(terms, start=1)]
    series = shapes.even_asphere if step == 2 else shapes.odd_asphere
    return series(curvature, constant, powers)


def profile_items(profile: Profile) -> dict[str, Any]:
    """Return the items of a profile; PrescriptionError where ray-optics has none like it."""
    if profile.terms or profile.curvature_x is not None:
        raise PrescriptionError("shape: a ray-optics file is written with conics and powers of r")
    terms = [*(profile.odd or profile.even)]
    values = {"cv": profile.curvature}
    if not any(terms):
        kind = "Conic" if profile.conic else "Spherical"
        return instance(_MODULE, kind, values | ({"cc": profile.conic} if profile.conic else {}))
    kind = "RadialPolynomial" if profile.odd else "EvenPolynomial"
    coefficients = [*terms, *[0.0] * (_MOST_TERMS - len(terms))]
    return instance(
        _MODULE, kind, values | {"cc": profile.conic, "coefs": coefficients, "max_nonzero_coef": len(terms)}
    )
