"""Refractive media in prescription files: from a section of YAML and back.

=================================================================== ==================================================
``{n: 1.5}``                                                        constant index
``{B: [...], C: [...], range: [0.3, 2.5]}``                         Sellmeier, as many terms as wanted; C in um^2
``{formula: schott, coefficients: [...], range: [0.3, 2.5]}``       one of the formulas of `dispersion`
``{wavelengths: [...], indices: [...], interpolation: monotone}``   table; or ``linear``
``{air: ciddor, pressure_pa: 74000, temperature_k: 283, ...}``      air, with ``water_vapour_pa``, ``co2_ppm``
``{glass: N-BK7}``                                                  glass of the bundled catalogue, or of
                                                                    ``catalogue: file.agf`` beside the prescription
=================================================================== ==================================================

``range`` and ``wavelengths`` are in the wavelength unit of the file. Figures relative to air carry the air that they
are relative to, ``in_air: {air: ciddor, ...}``; ``shift: 1e-5`` adds to the index of any kind.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from ....core.errors import PachonError, PrescriptionError
from ....core.yaml_reader import Section
from ...media.air import Air
from ...media.changed_index import ChangedIndex, with_index_change
from ...media.dispersion import Dispersion
from ...media.medium import ConstantIndex, Medium, RelativeToAir, Sellmeier
from ...media.tabulated import TabulatedIndex
from ..glass_catalogue import GlassCatalogue

#: Keys of air and the figures of it that they give.
AIR_KEYS = {
    "pressure_pa": "pressure",
    "temperature_k": "temperature",
    "water_vapour_pa": "water_vapour",
    "co2_ppm": "co2_ppm",
}
#: Keys beside those of any kind: the air that the figures are relative to, and what is added to the index.
WRAPPERS = ("in_air", "shift")


def read_medium(section: Section, wavelength: Callable[[float], float]) -> Medium:
    """Return the medium that a section describes.

    Parameters
    ----------
    section : Section
        Its keys and values.
    wavelength : callable
        Conversion of the file's wavelengths to metres.

    Raises
    ------
    PrescriptionError
        If the section is malformed: file, key, value and what was expected.
    """
    name = section.place.removeprefix("media.")
    try:
        medium: Any = replace(_read_figures(section, wavelength), name=name)
        if "in_air" in section:
            medium = RelativeToAir(medium, _read_air(section.section("in_air")), name)
        return with_index_change(medium, section.number("shift", 0.0))
    except PrescriptionError as error:
        raise section.placed(error) from None


def _read_figures(section: Section, wavelength: Callable[[float], float]) -> Any:
    def limits() -> tuple[float, float]:
        low, high = section.numbers("range", 2)
        return wavelength(low), wavelength(high)

    if "n" in section:
        section.allow("n", *WRAPPERS)
        return ConstantIndex(section.number("n"))
    if "formula" in section:
        section.allow("formula", "coefficients", "range", *WRAPPERS)
        return Dispersion(section.text("formula"), section.numbers("coefficients"), limits())
    if "wavelengths" in section:
        section.allow("wavelengths", "indices", "interpolation", *WRAPPERS)
        w = tuple(wavelength(v) for v in section.numbers("wavelengths"))
        return TabulatedIndex(w, section.numbers("indices"), section.text("interpolation", "monotone"))
    if "air" in section:
        return _read_air(section)
    if "glass" in section:
        section.allow("glass", "catalogue", *WRAPPERS)
        return _read_glass(section)
    section.allow("n", "B", "C", "range", "formula", "wavelengths", "air", "glass", *WRAPPERS)
    return Sellmeier(section.numbers("B"), section.numbers("C"), limits())


def _read_air(section: Section) -> Air:
    section.allow("air", "shift", *AIR_KEYS)
    figures: dict[str, Any] = {name: section.number(key) for key, name in AIR_KEYS.items() if key in section}
    return Air(formula=section.text("air", "ciddor"), **figures)


def _read_glass(section: Section) -> Medium:
    catalogue = GlassCatalogue.bundled()
    if "catalogue" in section:
        # A relative path is meant from where the prescription lies.
        catalogue = GlassCatalogue.read(Path(section.source).parent / section.text("catalogue"))
    name = section.text("glass")
    try:
        return catalogue[name]
    except PachonError as error:
        raise section.error("glass", f"a glass of the catalogue ({error})") from None


def medium_wavelengths(medium: Medium) -> tuple[float, ...]:
    """Return the wavelengths [m] that a description of the medium states."""
    if isinstance(medium, RelativeToAir):
        return medium_wavelengths(medium.figures)
    if isinstance(medium, ChangedIndex):
        return medium_wavelengths(medium.medium)
    if isinstance(medium, TabulatedIndex):
        return medium.wavelengths
    return medium.wavelength_range if isinstance(medium, (Sellmeier, Dispersion)) else ()


def medium_items(
    medium: Medium, number: Callable[[float], str], listed: Callable[..., str], waves: Callable[..., str]
) -> dict[str, str]:
    """Return the keys and values, as text, that :func:`read_medium` makes the same medium of.

    Parameters
    ----------
    medium : Medium
        What to describe.
    number, listed, waves : callable
        Text of a number, of a list of numbers, and of a list of wavelengths [m] in the unit of the file.

    Raises
    ------
    PrescriptionError
        If it is a kind of medium that files do not know.
    """
    if isinstance(medium, ConstantIndex):
        return {"n": number(medium.n)}
    if isinstance(medium, Sellmeier):
        return {"B": listed(medium.B), "C": listed(medium.C), "range": waves(medium.wavelength_range)}
    if isinstance(medium, Dispersion):
        coefficients, limits = listed(medium.coefficients), waves(medium.wavelength_range)
        return {"formula": medium.formula, "coefficients": coefficients, "range": limits}
    if isinstance(medium, TabulatedIndex):
        figures = {"wavelengths": waves(medium.wavelengths), "indices": listed(medium.indices)}
        return figures | {"interpolation": medium.interpolation}
    if isinstance(medium, Air):
        return {"air": medium.formula} | {key: number(getattr(medium, name)) for key, name in AIR_KEYS.items()}
    if isinstance(medium, RelativeToAir):
        air = ", ".join(f"{key}: {value}" for key, value in medium_items(medium.air, number, listed, waves).items())
        return medium_items(medium.figures, number, listed, waves) | {"in_air": f"{{{air}}}"}
    if isinstance(medium, ChangedIndex):
        return medium_items(medium.medium, number, listed, waves) | {"shift": number(medium.change)}
    raise PrescriptionError(f"medium {type(medium).__name__}: expected one that prescription files can hold")
