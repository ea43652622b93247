"""Clear regions [m] from the sizes that lens files state, and those that they have no place for."""

from __future__ import annotations

from ....core.errors import PrescriptionError
from ...aperture import Annulus, Aperture, Circle, Complement, Ellipse, Rectangle
from .source import Findings, Source


def ring(source: Source, inner: float, outer: float, x: float, y: float) -> Aperture:
    """Return a disc, or a ring, about (x, y); PrescriptionError of the statement if there is none."""
    if not 0 <= inner < outer:
        raise source.error("a smallest and a largest radius")
    return Annulus(inner, outer, x, y) if inner else Circle(outer, x, y)


def rectangle(source: Source, half_x: float, half_y: float, x: float, y: float) -> Aperture:
    """Return a rectangle by half its widths; PrescriptionError of the statement if there is none."""
    _require_positive(source, half_x, half_y)
    return Rectangle(2 * half_x, 2 * half_y, x, y)


def ellipse(source: Source, half_x: float, half_y: float, x: float, y: float) -> Aperture:
    """Return an ellipse by its semi-axes; PrescriptionError of the statement if there is none."""
    _require_positive(source, half_x, half_y)
    return Ellipse(half_x, half_y, x, y)


def _require_positive(source: Source, half_x: float, half_y: float) -> None:
    if not (half_x > 0 and half_y > 0):
        raise source.error("two positive half widths")


def report_aperture(name: str, aperture: Aperture, file: str, held: str, findings: Findings) -> None:
    """Report the clear region of a surface that a kind of file, which holds others, does not have; or leave it out."""
    region = aperture.part if isinstance(aperture, Complement) else aperture
    kind = f"{'' if region is aperture else 'obscuring '}{type(region).__name__}"
    findings.report(PrescriptionError(f"surface {name}: aperture {kind}: {file} has {held}"), "left out")
