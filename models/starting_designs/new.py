"""Starting designs by name, and their commented prescription files."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Literal

from ...core.arguments import check_arguments
from ...core.errors import DomainError
from ..digits import with_few_digits
from ..io.yaml.comments import with_comments
from ..io.yaml.writer import telescope_to_yaml
from ..paul_baker import paul_baker
from ..telescope import Telescope
from . import lenses, schmidt, two_mirror

#: What follows from what, by kind, for the head of the file.
_NOTES: dict[Callable[..., Telescope], str] = {
    two_mirror.two_mirror: "Made from focal ratios and the distance of the focus behind the primary: layout and conic "
    "constants are third-order formulas (Schroeder, Astronomical Optics, section 6.2). The hole of M1 clears the light "
    "on M2 for the whole field.",
    two_mirror.newtonian: "A paraboloid. The flat that folds the light to the side adds no aberration and is left "
    "out; Diagonal is its shadow.",
    schmidt.schmidt: "The plate stands at the centre of curvature of M1; its shape makes the first Seidel sum zero, "
    "with the neutral zone at 0.866 of its radius. The shadow of the detector is left out.",
    paul_baker: "Spherical aberration, coma, astigmatism and Petzval sum of third order are zero "
    "(docs/explanation/paul_baker.md).",
    lenses.singlet: "Bent so that third-order coma is zero with the stop at its front.",
    lenses.doublet: "Axial colour between the lines F and C and third-order spherical aberration are zero.",
    lenses.triplet: "Third-order aberrations and both colours are zero, but for a Petzval sum of 0.35 of the power.",
}
DesignKind = Literal[
    "ritchey-chretien",
    "cassegrain",
    "dall-kirkham",
    "gregorian",
    "newtonian",
    "schmidt",
    "three-mirror",
    "singlet",
    "doublet",
    "triplet",
]
#: Function of each kind.
KINDS: dict[DesignKind, Callable[..., Telescope]] = {
    **{kind: partial(two_mirror.two_mirror, kind) for kind in two_mirror.KINDS},
    "newtonian": two_mirror.newtonian,
    "schmidt": schmidt.schmidt,
    "three-mirror": paul_baker,
    "singlet": lenses.singlet,
    "doublet": lenses.doublet,
    "triplet": lenses.triplet,
}


@check_arguments
def new_telescope(
    kind: DesignKind,
    *,
    diameter: float | None = None,
    f_number: float | None = None,
    field_radius: float | None = None,
    primary_f_number: float | None = None,
    back_focus: float | None = None,
) -> Telescope:
    """Design a telescope or lens of a kind from third-order formulas.

    Parameters
    ----------
    kind : str
        "ritchey-chretien", "cassegrain", "dall-kirkham", "gregorian", "newtonian", "schmidt", "three-mirror" (a
        Paul-Baker), "singlet", "doublet" (a cemented achromat) or "triplet" (Cooke's).
    diameter : float, optional
        Diameter of the entrance pupil [m]; each kind has its default, for the others too.
    f_number : float, optional
        Focal ratio.
    field_radius : float, optional
        Radius of the field of view [rad].
    primary_f_number : float, optional
        Focal ratio of the primary; of two-mirror telescopes.
    back_focus : float, optional
        Distance of the focus behind the vertex of the primary [m]; of two-mirror telescopes.

    Raises
    ------
    ConfigError
        If there is no such kind.
    DomainError
        If a number is out of range, or does not belong to the kind.
    """
    options: dict[str, Any] = {"diameter": diameter, "field_radius": field_radius}
    options["focal_ratio" if kind == "three-mirror" else "f_number"] = f_number
    for name, value in (("primary_f_number", primary_f_number), ("back_focus", back_focus)):
        if value is not None and kind not in two_mirror.KINDS:
            raise DomainError(
                f"{name} = {value!r}: expected none for a {kind}; two-mirror telescopes have it", key=name
            )
        options[name] = value
    return KINDS[kind](**{name: value for name, value in options.items() if value is not None})


def new_prescription(kind: DesignKind, **options: Any) -> tuple[Telescope, str]:
    """Return a new telescope and the text of its prescription file, with comments; arguments as `new_telescope`."""
    telescope = with_few_digits(new_telescope(kind, **options))
    make = KINDS[kind]
    note = _NOTES[make.func if isinstance(make, partial) else make]
    return telescope, with_comments(telescope_to_yaml(telescope), f"{telescope.description}.", note)
