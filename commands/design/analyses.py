"""Commands on aberrations as lens designers show them: fans, curvature, colour, Seidel sums, spot matrices."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

from typer import Option

from ...core.errors import ConfigError
from ..choices import choice
from ..tables import FIELD, Column, Rows, number_texts, range_text
from .command import Outcome, SharedOptions, Study, design_command

if TYPE_CHECKING:
    from ...design.analyses.seidel import SeidelDiagram

Points = Annotated[int, Option(min=3, max=10001, help="Rays along each diameter of the pupil.")]


@design_command(
    FIELD,
    Column("largest, tangential, sagittal [µm]", "largest_um", ".3f", subject="The largest transverse aberration"),
    caption="Transverse aberration along each fan against the chief ray of the middle wavelength.",
    band=True,
)
def fans(shared: SharedOptions, points: Points = 65) -> Study:
    """Draw ray fans: transverse aberration against the pupil, tangential and sagittal.

    Tangential is the diameter of the pupil along the field point's direction from the axis, sagittal that across it.

    **Examples**

    - `pachon fans my_lens.zmx`
    - `pachon fans lsst_v3.3_r --across-band 3 --field-deg 0 --field-deg 1.2 --picture fans.pdf`
    """
    from ...design.analyses.ray_fans import ray_fans

    return ray_fans(*shared.first_arguments, n_points=points, **shared.trace_options)


@design_command(
    FIELD,
    Column("peak to valley [waves]", "peak_to_valley_waves", ".4f", subject="The peak to valley of the wavefront"),
    caption="Over both fans, a number for each wavelength; reference sphere of {reference_sphere_m:.6g} m.",
    band=True,
)
def opd_fans(shared: SharedOptions, points: Points = 65) -> Study:
    """Draw OPD fans: optical path difference against the pupil, tangential and sagittal, in waves.

    **Examples**

    - `pachon opd-fans my_lens.zmx`
    - `pachon opd-fans lsst_v3.3_r --field-deg 0 --field-deg 1.2 --json`
    """
    from ...design.analyses.ray_fans import opd_fans as compute

    return compute(*shared.first_arguments, n_points=points, **shared.trace_options)


@design_command(
    FIELD,
    Column("tangential focus [µm]", "tangential_focus_um", ".3f", subject="The tangential focus"),
    Column("sagittal focus [µm]", "sagittal_focus_um", ".3f"),
    Column("distortion [%]", lambda result: result.distortion, ".5f"),
    caption="A number for each wavelength; foci are behind the detector as light travels.",
    band=True,
)
def field_curvature(shared: SharedOptions) -> Study:
    """Draw tangential and sagittal field curvature, and distortion, against the field.

    Foci are those of rays close to the chief ray; distortion is against f tan(theta) with the scale on the axis.

    **Examples**

    - `pachon field-curvature my_lens.zmx`: a line from the axis to the edge of the field
    - `pachon field-curvature lsst_v3.3_r --across-band 3`
    """
    from ...design.analyses.field_curvature import field_curvature as compute

    return compute(*shared.first_arguments, **shared.trace_options)


@design_command(
    FIELD,
    Column("shift [µm]", "shift_um", ".4f"),
    Column("spread [µm]", "spread_um", ".4f", subject="The spread of the colours"),
    Column("Airy [µm]", "airy_radius_um", ".3f"),
    caption="Shift of the chief ray of each wavelength along the field, against {reference_nm:.6g} nm.",
    band=True,
)
def lateral_color(shared: SharedOptions) -> Study:
    """Draw lateral colour: landing points of the chief rays of several wavelengths, against the field.

    **Examples**

    - `pachon lateral-color my_lens.zmx`: the file's wavelengths, or five across the band
    - `pachon lateral-color lsst_v3.3_r --across-band 3`
    """
    from ...design.analyses.color import lateral_color as compute

    return compute(*shared.first_arguments, **shared.trace_options)


def _focal_shift_verdict(summary: dict[str, Any]) -> str:
    """Return how far the focus moves over the wavelengths, or over the pupil where there is one wavelength alone."""
    depth = f"the depth of focus is ±{_length(summary['depth_of_focus_um'])}"
    if len(summary["wavelength_nm"]) == 1:
        zones = summary["shift_um"][0]
        return f"The foci of the zones differ by {_length(max(zones) - min(zones))}; {depth}."
    band = range_text(summary["wavelength_nm"], ".6g", "nm")
    return f"Over {band} the paraxial focus moves by {_length(summary['largest_paraxial_shift_um'])}; {depth}."


def _length(micrometres: float) -> str:
    return f"{micrometres:.4g} µm" if micrometres < 1e3 else f"{micrometres / 1e3:.4g} mm"


@design_command(
    Column("wavelength [nm]", "wavelength_nm", ".6g"),
    Column("shift [µm], zone by zone", "shift_um", ".4f"),
    caption="Paraxial, then by zones of the pupil; against the paraxial focus at {reference_nm:.6g} nm.",
    left=0,
    verdict=_focal_shift_verdict,
    band=True,
)
def focal_shift(
    shared: SharedOptions,
    zone: Annotated[list[float] | None, Option(help="Zone of the pupil, up to 1, once for each; 0.7 and 1.")] = None,
) -> Study:
    """Draw the chromatic focal shift: focus on the axis against the wavelength, paraxial and of real rays.

    **Examples**

    - `pachon focal-shift my_lens.zmx`
    - `pachon focal-shift lsst_v3.3_r --zone 0.8 --json`
    """
    from ...design.analyses.color import chromatic_focus

    if shared.field_deg:
        raise ConfigError("--field-deg: expected none; the focus is that on the axis")
    zones = {} if zone is None else {"zones": zone}
    return chromatic_focus(shared.telescope, shared.wavelength, threads=shared.threads, **zones)


@design_command()
def seidel(shared: SharedOptions) -> Outcome:
    """Draw the Seidel diagram: third-order and chromatic aberrations of each surface, in waves.

    Wavefront at the rims of pupil and field; `--field-deg` takes the field angle of the chief ray.

    **Examples**

    - `pachon seidel my_lens.zmx`
    - `pachon seidel paul_baker --field-deg 0.3 --json`
    """
    import numpy as np

    from ...design.analyses.seidel import seidel_diagram
    from ...raytrace.rays import field_direction

    if shared.fields is not None and len(shared.fields) != 1:
        raise ConfigError("--field-deg: expected one field")
    angle = None
    if shared.fields is not None:
        x, y, z = field_direction(shared.fields[0, 0], shared.fields[0, 1], shared.projection)
        angle = float(np.arctan2(np.hypot(x, y), -z))
    return Outcome(seidel_diagram(shared.telescope, shared.wavelength, field=angle), _seidel_rows)


def _seidel_rows(result: SeidelDiagram) -> Rows:
    s = result.summary()
    names = [*s["surfaces"], "sum"]
    values = [*s["waves"], s["total_waves"]]
    rows = [(name, *(f"{v:.4f}" for v in row)) for name, row in zip(names, values, strict=True)]
    headings = [f"{symbol} {name}" for symbol, name in zip(s["coefficients"], s["aberrations"], strict=True)]
    caption = f"{s['telescope']}: waves at {s['wavelength_nm'][0]:.6g} nm; colours between the edges of the band."
    return Rows(("surface", *headings), rows, caption, verdict=_seidel_verdict(s))


def _seidel_verdict(summary: dict[str, Any]) -> str:
    """Return the largest aberration of the sum, and the surface that adds most; distortion does not blur."""
    import numpy as np

    blurring = [k for k, name in enumerate(summary["aberrations"]) if name != "distortion"]
    total, of_surfaces = (np.array(summary[key])[..., blurring] for key in ("total_waves", "waves"))
    worst = np.abs(total).argmax()
    if np.abs(total[worst]) < 5e-5:
        return f"Beside distortion, all sums vanish; one surface has up to {np.abs(of_surfaces).max():.4g} waves."
    strongest = np.abs(of_surfaces[:, worst]).argmax()
    return (
        f"Largest beside distortion is {summary['aberrations'][blurring[worst]]}, {total[worst]:.4f} waves at the rims "
        f"of pupil and field; {summary['surfaces'][strongest]} alone has {of_surfaces[strongest, worst]:.4f}."
    )


def _matrix_heading(summary: dict[str, Any]) -> str:
    """Return the heading of the spots of a matrix, with its heights or wavelengths."""
    key, unit = ("defocus_um", "µm") if "defocus_um" in summary else ("columns_nm", "nm")
    return f"rms [µm] at {', '.join(number_texts(summary[key], '.4g'))} {unit}"


@design_command(
    FIELD,
    Column(_matrix_heading, "rms_radius_um", ".3f", subject="The rms radius of the spots"),
    Column("Airy [µm]", "airy_radius_um", ".3f"),
    band=True,
)
def spot_matrix(
    shared: SharedOptions,
    against: Annotated[str, choice(("focus", "wavelength"), help="What changes from column to column.")] = "focus",
    range_um: Annotated[
        tuple[float, float] | None, Option(metavar="LOW HIGH", help="Heights of the detector [um].")
    ] = None,
    steps: Annotated[int, Option(min=2, max=50, help="Heights in that range.")] = 5,
    rays: Annotated[int, Option(min=1, max=200, help="Rays along the radius of the pupil.")] = 10,
) -> Study:
    """Draw spots of each field in a row, through focus or wavelength by wavelength.

    **Examples**

    - `pachon spot-matrix my_lens.zmx`: to two depths of focus
    - `pachon spot-matrix lsst_v3.3_r --range-um -20 20 --field-deg 0 --field-deg 1.75`
    - `pachon spot-matrix my_lens.zmx --against wavelength --across-band 5`
    """
    import numpy as np

    from ...design.analyses.spot_matrix import spot_matrix as compute

    defocus = None if range_um is None else np.linspace(*range_um, steps) * 1e-6
    # The function itself refuses other texts.
    columns = cast('Literal["focus", "wavelength"]', against)
    return compute(*shared.first_arguments, against=columns, defocus=defocus, n_pupil=rays, **shared.trace_options)
