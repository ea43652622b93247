"""Commands on the field of view and the apertures: ``distortion``, ``vignetting``, ``footprint`` and ``draw``."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Option

from ...core.errors import ConfigError
from ...core.number_text import counted
from .. import completion
from ..choices import names
from ..tables import Column, Rows, field_headings, number_texts, range_text
from .command import Outcome, SharedOptions, design_command

if TYPE_CHECKING:
    from ...design.metrics.distortion import Distortion
    from ...design.metrics.footprint import Footprint
    from ...design.metrics.spots import SpotReference
    from ...design.metrics.vignetting import Vignetting

#: Number of rays that takes longer than two seconds to trace.
_MANY_RAYS = 10_000_000


@design_command()
def distortion(
    shared: SharedOptions,
    centroid: Annotated[bool, Option("--centroid", help="Centroids of the light, not chief rays.")] = False,
) -> Outcome:
    """Compare where stars land with a scaled picture of the sky, r = f tan(theta).

    In percent against the scale that fits best over the field, and against that at the axis, as lens designers do.

    **Examples**

    - `pachon distortion lsst_v3.3_r`: a lattice over the field of view
    - `pachon distortion lsst_v3.3_r --centroid --json`
    """
    from ...design.metrics.distortion import distortion as compute

    reference: SpotReference = "centroid" if centroid else "chief"
    return Outcome(compute(*shared.first_arguments, reference=reference, **shared.trace_options), _distortion_rows)


def _distortion_rows(result: Distortion) -> Rows:
    s = result.summary()
    scales = ("that fits best", result.focal_length), ("at the axis", result.axis_focal_length)
    name, shown = ("angular magnification", "{:.6f}".format) if result.in_angles else ("focal length", _length)
    rows = [
        *((f"{name} {where}", shown(value)) for where, value in scales),
        ("largest distortion against the best scale", f"{s['largest_percent']:.4f} %"),
        ("largest distortion against the axis's scale", f"{s['largest_percent_of_axis_scale']:.4f} %"),
        ("largest shift from the best picture", result.image_text(f"{1e6 * result.largest_shift:.3f} µm")),
        ("rms shift", result.image_text(f"{1e6 * result.rms_shift:.3f} µm")),
    ]
    caption = f"{s['telescope']}, {s['wavelength_nm']:g} nm, {counted(len(result.fields), 'field')}"
    verdict = f"Distortion reaches {s['largest_percent']:.4f} % against the scale that fits best over the field."
    return Rows(("metric", "value"), rows, caption, verdict=verdict)


def _length(metres: float) -> str:
    return f"{metres:.6f} m" if metres >= 1.0 else f"{1e3 * metres:.5f} mm"


@design_command()
def vignetting(
    shared: SharedOptions, rays: Annotated[int, Option(min=16, max=10**7, help="Rays of each field.")] = 16384
) -> Outcome:
    """Find how much of the pupil is lit against field, with an error, as profile and map.

    **Examples**

    - `pachon vignetting lsst_v3.3_r`: rings over the field of view
    - `pachon vignetting lsst_v3.3_r --field-deg 1.2 --field-deg 1.75 --rays 1000000 --json`
    """
    from ...design.metrics.vignetting import field_disc
    from ...design.metrics.vignetting import vignetting as compute

    fields = field_disc(shared.telescope) if shared.fields is None else shared.fields
    parts = len(fields) + 1
    with shared.stage("vignetting", parts) if rays * parts >= _MANY_RAYS else nullcontext() as progress:
        traced = compute(
            shared.telescope, fields, shared.wavelength, n_pupil=rays, progress=progress, **shared.trace_options
        )
        return Outcome(traced, _vignetting_rows)


def _vignetting_rows(result: Vignetting) -> Rows:
    """Return the light at each distance from the axis."""
    import numpy as np

    radius, label = result.axis_distances()
    radius = radius.round(6)
    rows = []
    for r in np.unique(radius):
        ring = radius == r
        light, error = 100.0 * result.relative[ring], 100.0 * result.error[ring].max() / result.axis_fraction
        rows.append((f"{r:g}", f"{light.mean():.2f}", f"{light.min():.2f}", f"{light.max():.2f}", f"{error:.2f}"))
    headings = (label, "light [%]", "least", "most", "error of one field")
    verdict = f"The light that arrives is {range_text(100.0 * result.relative, '.2f', '%')} of that on the axis."
    caption = f"Relative to the axis, where {100 * result.axis_fraction:.2f} % of the annular pupil is lit."
    return Rows(headings, rows, caption, verdict=verdict)


@design_command()
def footprint(
    shared: SharedOptions,
    surface: Annotated[
        list[str] | None,
        names(completion.surfaces, metavar="NAME", help="Name of a surface, once for each; all by default."),
    ] = None,
) -> Outcome:
    """Draw the footprints of beams on surfaces, over the clear apertures, and the light that each surface blocks.

    **Examples**

    - `pachon footprint lsst_v3.3_r`: a panel for each surface
    - `pachon footprint lsst_v3.3_r --surface M2 --surface Filter_entrance --field-deg 0 --field-deg 1.75`
    """
    from ...design.metrics.footprint import footprint as compute

    telescope, fields, wavelength = shared.first_arguments
    return Outcome(compute(telescope, surface or None, fields, wavelength, **shared.trace_options), _footprint_rows)


def _footprint_rows(result: Footprint) -> Rows:
    import numpy as np

    rows = []
    for s in result.surfaces:
        blocked = number_texts(100.0 * s.blocked_fraction, ".2f")
        rows.append((s.surface.name, f"{np.nanmax(s.largest_radius, initial=0.0) * 1e3:.2f}", *blocked))
    fields = field_headings(result)
    caption = (
        "Reaches to: largest distance from the vertex of light that arrives. Then, field by field, the part of the "
        "pupil [%] that the surface is the first to block."
    )
    return Rows(("surface", "reaches to [mm]", *fields), rows, caption, verdict=_footprint_verdict(result))


def _footprint_verdict(result: Footprint) -> str:
    """Return the surface that blocks most of the pupil, and at which field."""
    import numpy as np

    blocked = np.array([s.blocked_fraction for s in result.surfaces])
    surface, field = np.unravel_index(blocked.argmax(), blocked.shape)
    if blocked[surface, field] == 0.0:
        return "None of the surfaces blocks light."
    name, where = result.surfaces[surface].name, field_headings(result)[field]
    return f"{name} blocks most: {100.0 * blocked[surface, field]:.2f} % of the pupil at field {where}."


def _layout_verdict(summary: dict[str, Any]) -> str:
    """Return the size of a telescope, and of how many mirrors and lenses it is."""
    width, _, length = (f"{x:.4g} m" if x >= 1.0 else f"{1e3 * x:.4g} mm" for x in summary["extent_m"])
    mirrors = counted([*summary["interaction"]].count("mirror"), "mirror")
    lenses = counted(len(summary["lens"]), "lens", "lenses")
    return f"{mirrors} and {lenses}, {length} long and {width} wide."


@design_command(
    Column("surface", "surface"),
    Column("kind", "interaction"),
    Column("vertex [mm]", "vertex_m", ".6g", 1e3),
    Column("drawn to [mm]", "drawn_radius_m", ".4g", 1e3),
    left=2,
    verdict=_layout_verdict,
)
def draw(
    shared: SharedOptions,
    out: Annotated[
        Path | None, Option("--out", "-o", help="Telescope and rays in three dimensions to write, .glb.")
    ] = None,
) -> Outcome:
    """Draw a telescope: its section with rays of some fields, and a model in three dimensions.

    Surfaces are cut to their apertures; those without one go as far as the light of the field of view does.

    **Examples**

    - `pachon draw lsst_v3.3_r`
    - `pachon draw lsst_v3.3_r_obstructed --picture lsst.pdf -o lsst.glb`
    - `pachon draw my_lens.zmx --field-deg 0 --field-deg 10`
    """
    from ...core.files import write_bytes
    from ...core.units import field_label
    from ...design.layout.layout import layout

    if out is not None and out.suffix.lower() != ".glb":
        raise ConfigError(f"--out = {str(out)!r}: expected a name that ends in .glb; the picture is --picture")
    result = layout(*shared.first_arguments, **shared.trace_options)
    notes = [f"{field_label(result.fields[i])}: no ray arrives, so none is drawn" for i in result.dark]
    if notes and shared.telescope.design_data.stop and shared.telescope.design_data.aiming == "off":
        notes.append("the rays of these fields may miss the stop: --aiming paraxial aims them at it")
    if out is not None:
        write_bytes(out, result.glb())
        notes.append(f"model: {out.resolve()}")
    return Outcome(result, notes=notes)
