"""Checks before writing: pickups that the values meet, links with a place, telescopes that lens files can hold."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace

from ...core.errors import PrescriptionError
from ..central_obscuration import central_obscuration
from ..links import Pickup, Solve
from ..media.fitted import fitted_dispersion
from ..media.medium import Medium
from ..paraxial import floating_pupil, stop_makes_pupil
from ..surface import Interaction
from ..telescope import Telescope
from ..thickness import thickness
from .lens.source import Findings

#: Relative difference from a pickup that rounding in files makes.
_ROUNDING = 1e-6
#: Obscuration beyond the shadow of the apertures that rounding in prescriptions makes.
_SHADOW = 1e-3
#: Factors of the shortest and the longest wavelength of a telescope between which a fitted formula holds.
_MARGIN = (0.85, 1.2)
#: Deviation of a fitted index that needs no leniency: a fiftieth of the precision of catalogues.
_LARGEST_DEVIATION = 1e-7


def require_sequential(telescope: Telescope, file: str) -> None:
    """Raise a PrescriptionError for a telescope without a detector at its end, or with meshes; `file` is for it."""
    if telescope.surfaces[-1].interaction != Interaction.DETECTOR:
        raise PrescriptionError(f"{file} needs a detector as its last surface")
    if telescope.obstructions:
        raise PrescriptionError(f"obstruction {telescope.obstructions[0].name}: {file} cannot hold meshes")


def report_unheld(
    telescope: Telescope, links: Iterable[Pickup | Solve], file: str, *, lenient: bool, others: Iterable[str] = ()
) -> None:
    """Raise a PrescriptionError, if lenient a warning, for links, coatings and others without a place in `file`."""
    coated = [f"coating of {s.name}" for s in telescope.surfaces if s.coating is not None]
    if names := ", ".join([*(link.address for link in links), *coated, *others]):
        Findings(lenient).report(PrescriptionError(f"{names}: {file} has no place for it"), "left out")


def report_pupil_plane(telescope: Telescope, findings: Findings, *, own_stop: bool, aimed: str = "off") -> None:
    """Warn where a plane in front has to carry the stop of a telescope, or its pupil is off the axis.

    `aimed` is the aiming of the program of the file.
    """
    data = telescope.design_data
    if any(telescope.pupil_center) and aimed == data.aiming == "off":
        x, y = (f"{1e3 * v:.6g}" for v in telescope.pupil_center)
        problem = f"centre of the entrance pupil ({x}, {y}) mm: the file has no place for it"
        findings.note(PrescriptionError(problem), "read back it is on the axis, but for aimed rays")
    if data.stop is None or own_stop:
        return
    problem = f"stop = {data.stop}, aiming = {data.aiming}: the stop and the stated aperture do not make the pupil"
    instead = "a plane in front carries the stop" + (", and rays are not aimed" if data.aiming != "off" else "")
    findings.note(PrescriptionError(problem), instead)


def report_obscuration(telescope: Telescope, findings: Findings, file: str) -> None:
    """Warn of an obscuration of the pupil that no aperture makes, which `file`, as its name is said, cannot hold."""
    stated, shadow = telescope.pupil_obscuration, central_obscuration(replace(telescope, pupil_obscuration=0.0))
    if stated > shadow + _SHADOW:
        problem = f"pupil.obscuration = {stated:.6g}: {file} has no place for it"
        findings.note(PrescriptionError(problem), f"read back it is that of the apertures, {shadow:.6g}")


def with_formulas(telescope: Telescope, written: Callable[[Medium], object], findings: Findings) -> Telescope:
    """Return a telescope all of whose media a file can hold, formulas fitted to the others.

    `written` raises a PrescriptionError for a medium that the file cannot hold. A formula covers the wavelengths of the
    telescope and some beyond. One that is near its medium is a warning, another one an error unless lenient.
    """
    used = (*telescope.design_data.wavelengths, telescope.default_wavelength, *(telescope.band or ()))
    low, high = telescope.wavelength_range
    low, high = max(low, _MARGIN[0] * min(used)), min(high, _MARGIN[1] * max(used))
    media = [telescope.medium_before, *(s.medium_after for s in telescope.surfaces)]
    fits: dict[Medium, Medium] = {}
    for medium in dict.fromkeys(media):
        try:
            written(medium)
        except PrescriptionError as error:
            fits[medium], deviation = fitted_dispersion(medium, (low, high))
            problem = PrescriptionError(f"medium {medium.name or type(medium).__name__}: {error}")
            instead = (
                f"a formula is fitted, within {deviation:.1g} of its index, {low * 1e9:.4g} to {high * 1e9:.4g} nm"
            )
            (findings.report if deviation > _LARGEST_DEVIATION else findings.note)(problem, instead)
    before, *after = (fits.get(medium, medium) for medium in media)
    surfaces = tuple(replace(s, medium_after=m) for s, m in zip(telescope.surfaces, after, strict=True))
    if not fits:
        return telescope
    fitted = replace(telescope, medium_before=before, surfaces=surfaces)
    # Indices in their last digits change the focal length, and so the pupil of a focal ratio.
    return floating_pupil(fitted, tilted=True) if stop_makes_pupil(telescope) else fitted


def require_met(telescope: Telescope) -> Telescope:
    """Return a telescope; a PrescriptionError where a value of its file is not that of its pickup."""
    for pickup in telescope.design_data.pickups:
        if (expected := unmet_pickup(telescope, pickup)) is not None:
            raise PrescriptionError(f"{pickup.address}: expected {expected}")
    return telescope


def unmet_pickup(telescope: Telescope, pickup: Pickup) -> str | None:
    """Return what a pickup should have made of a telescope that does not meet it, None where it does."""
    follower, source = (telescope.surface(name) for name in (pickup.surface, pickup.source))
    if pickup.quantity == "glass":
        return None if follower.medium_after == source.medium_after else f"the glass of {pickup.source}"
    if pickup.quantity == "thickness":
        names = telescope.surface_names
        actual, followed = (thickness(telescope, names.index(s.name)) for s in (follower, source))
    else:
        key = "conic" if pickup.quantity == "conic" else "radius"
        actual, followed = (
            s.shape.parameters.get(key, 0.0 if key == "conic" else math.inf) for s in (follower, source)
        )
    expected = pickup.scale * followed + pickup.offset
    if actual == expected or abs(actual - expected) <= _ROUNDING * max(abs(expected), abs(actual)):
        return None
    return f"{expected:.9g}, not {actual:.9g}"
