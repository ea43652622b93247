"""Profiles of ray-optics as shapes of Zemax surfaces.

================ ====================================================================================================
Spherical, Conic curvature ``cv``, conic constant ``cc``
EvenPolynomial   + ``coefs`` of r^2, r^4..., or ``coef2``, ``coef4``...
RadialPolynomial + ``coefs`` of r, r^2..., or ``coef1``, ``coef2``...; its conic constant may stand as ``ec`` = cc + 1
================ ====================================================================================================
"""

from __future__ import annotations

from typing import Any

from ....core.errors import PrescriptionError
from ..json_items import JsonObject
from ..lens.shapes import MOST_ODD
from ..lens.source import Findings
from ..profile import Profile
from ..zemax.placed import Line, numbered
from .items import attributes, class_name, instance, numbers

#: Zemax type, and power of r of each step of the coefficients.
POLYNOMIALS = {"EvenPolynomial": ("EVENASPH", 2), "RadialPolynomial": ("ODDASPHE", 1)}
#: Attributes that are copies of others or count them.
_COPIES = ("max_nonzero_coef", *(f"coef{i}" for i in range(1, 21)), "coefs")
_MOST_TERMS = 10
_MODULE = "rayoptics.elem.profiles"
#: Parameters of Zemax's even aspheres that hold coefficients.
_PARAMETERS = 8


def profile_lines(profile: JsonObject, findings: Findings) -> list[Line]:
    """Return the lines of a profile."""
    kind, values = class_name(profile), attributes(profile)
    known = ("Spherical", "Conic", *POLYNOMIALS)
    if kind not in known:
        findings.report(profile.problem(f"profile {kind}: expected one of {', '.join(known)}"), "taken as a sphere")
    curvature = values.number("cv", 0.0)
    conic = values.number("ec") - 1.0 if "ec" in values and "cc" not in values else values.number("cc", 0.0)
    head: list[Line] = [("CURV", curvature), ("CONI", conic)]
    if kind not in POLYNOMIALS:
        values.report_rest(findings, ("c",) if kind == "Spherical" else ())
        return [("TYPE", "STANDARD"), *head]
    name, step = POLYNOMIALS[kind]
    terms = numbers(values, "coefs") if "coefs" in values else []
    terms = terms or [values.number(f"coef{step * i}", 0.0) for i in range(1, _MOST_TERMS + 1)]
    values.report_rest(findings, _COPIES)
    if step == 1 and any(terms[MOST_ODD:]):
        raise profile.problem(f"coefs = {len(terms)} numbers: expected at most {MOST_ODD}")
    if step == 1 or not any(terms[_PARAMETERS:]):
        return [("TYPE", name), *head, *numbered("PARM", terms)]
    return [("TYPE", "XASPHERE"), *head, *numbered("XDAT", [float(len(terms)), 1.0, *terms])]


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
