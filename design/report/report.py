"""Design report: one HTML page with everything in it, pictures included, that prints well."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import PachonError
from ...core.page import Picture, render
from ...core.plotting import picture_bytes
from ...core.version import VERSION
from ...models.telescope import Telescope
from ...raytrace.rays import object_points
from ...wavefront.pupil_sampling import CHIEF_RAY
from ...wavefront.request import Request
from ..layout.layout import layout
from .prescription_table import COLUMNS, first_order_rows, prescription_rows
from .sections import SECTIONS, Section, Where

#: Longest drawing that is kept as one [byte]; a longer one becomes pixels.
_MOST_SVG = 150_000
#: Steps of a report: the tables, and each section.
STEPS = 1 + len(SECTIONS)


@check_arguments
def design_report(
    telescope: Telescope,
    fields: ArrayLike | None = None,
    wavelengths: ArrayLike | None = None,
    *,
    threads: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> str:
    """Make the design report of a telescope.

    Prescription table, first-order data, layout and all analyses. One that a telescope does not admit, such as the
    Seidel sums of tilted surfaces, says why in its place.

    Parameters
    ----------
    telescope, fields, wavelengths, threads
        As in :meth:`pachon.Request.of`; where no wavelengths are given, colour is studied across the band.
    progress : callable, optional
        Called with 1 after each of the :data:`STEPS` steps.

    Returns
    -------
    str
        An HTML page that refers to no other file.

    Raises
    ------
    DomainError
        If a field or wavelength lies outside what the telescope covers.
    """
    # Wrong fields or wavelengths are an error of the report, not of each of its sections.
    request = Request.of(telescope, fields, wavelengths, sampling=CHIEF_RAY, threads=threads)
    where = Where(
        telescope,
        None if fields is None else request.fields,
        None if wavelengths is None else request.wavelengths,
        threads,
    )
    step = progress or (lambda count: None)
    reach = _semi_diameters(where)
    rows = prescription_rows(telescope, request.middle, reach)
    first = first_order_rows(telescope, request.middle)
    step(1)
    pictures: list[Picture] = []
    problems: list[tuple[str, str]] = []
    for section in SECTIONS:
        try:
            pictures.append(_picture(section, where))
        except PachonError as error:
            problems.append((section.title, str(error)))
        step(1)
    return render(
        Path(__file__).parent / "templates",
        "design_report.html",
        telescope=telescope,
        verdict=_verdict(where),
        unit=telescope.length_unit[0],
        columns=COLUMNS,
        rows=rows,
        first_order=first,
        middle=request.middle * 1e9,
        fields=_field_texts(request),
        finite=bool(np.isfinite(telescope.object_distance)),
        afocal=telescope.design_data.afocal,
        wavelengths=[float(w) * 1e9 for w in request.wavelengths],
        pictures=pictures,
        problems=problems,
        version=VERSION,
    )


def _verdict(where: Where) -> str:
    """Return the sizes of the spots in one sentence, beside that of the Airy disc."""
    try:
        spots = where.spots
    except PachonError as error:
        return f"Its spots cannot be traced: {error}."
    radii = spots.rms_radius[np.isfinite(spots.rms_radius)] * 1e6
    if not radii.size:
        return "No ray of any field arrives at the detector."
    low, high = (f"{radius:.3g}" for radius in (radii.min(), radii.max()))
    sizes = low if low == high else f"{low} to {high}"
    fields = "at its one field" if len(spots.fields) == 1 else f"over {len(spots.fields)} fields"
    dark = len(spots.fields) - len(radii)
    lost = f"; {dark} of the fields get no light" if dark else ""
    unit = spots.image_text("µm")
    # A cylinder has no round disc.
    airy = spots.airy_radius[np.isfinite(spots.airy_radius)] * 1e6
    disc = f", the Airy disc has {np.median(airy):.3g} {unit} radius" if airy.size else ""
    return f"Its spots have {sizes} {unit} rms radius {fields}{disc}{lost}."


def _field_texts(request: Request) -> list[str]:
    """Return the fields as text: angles, or places on an object at a finite distance."""
    telescope = request.telescope
    if np.isinf(telescope.object_distance):
        return [f"({x:.4g}°, {y:.4g}°)" for x, y in np.rad2deg(request.fields)]
    name, unit = telescope.length_unit
    places = object_points(telescope, request.directions)[:, :2] / unit + 0.0
    return [f"({x:.4g}, {y:.4g}) {name}" for x, y in places]


def _semi_diameters(where: Where) -> dict[str, float]:
    """Return the radius of each surface, that of its aperture or of the light on it [m]; empty if no light passes."""
    try:
        return layout(where.telescope, where.fields, where.one_wavelength, threads=where.threads).reach
    except PachonError:
        return {}


def _picture(section: Section, where: Where) -> Picture:
    figure: Any = section.draw(where)
    drawing = picture_bytes(figure, "svg")
    if len(drawing) <= _MOST_SVG:
        return Picture(section.title, drawing, section.shows, kind="svg")
    return Picture(section.title, picture_bytes(figure, "png"), section.shows)
