"""Commands on rays and wavefronts of field points: ``spots``, ``focus``, ``zernikes`` and ``rays``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, cast

from typer import Option

from ...core.errors import ConfigError
from ..choices import choice
from ..tables import FIELD, Column, Rows, field_headings, number_texts, numbers_of, range_text
from .command import Outcome, SharedOptions, Study, design_command

if TYPE_CHECKING:
    from collections.abc import Iterable

    import numpy as np

    from ...design.metrics.field_zernikes import DoubleZernikes, FieldZernikes, PupilToFit, ZernikeOrdering
    from ...wavefront.pupil_sampling import SamplingName


@design_command(
    FIELD,
    Column("rms [µm]", "rms_radius_um", ".3f", subject="The rms radius of the spots"),
    Column("rms [arcsec]", "rms_radius_arcsec", ".4f"),
    Column("80 % [µm]", "radius_80_percent_um", ".3f"),
    Column("80 % [arcsec]", "radius_80_percent_arcsec", ".4f"),
    Column("largest [µm]", "geometric_radius_um", ".3f"),
    Column("Airy [µm]", "airy_radius_um", ".3f"),
    Column("lit [%]", "lit_fraction", ".2f", 100.0),
    caption="Radii about the centroid; lit: of the annular pupil.",
    band=True,
)
def spots(
    shared: SharedOptions,
    sampling: Annotated[str, choice(("gauss", "rings", "spiral", "square"), help="Sampling of the pupil.")] = "gauss",
    rays: Annotated[
        int | None, Option(min=1, help="Rays along the radius (gauss, rings), in all (spiral), across.")
    ] = None,
) -> Study:
    """Draw and measure spot diagrams: rms radius, radius of 80 % of the rays, in micrometres and arc seconds.

    Sizes are about the centroid of all wavelengths together. Diffraction is left out; the Airy disc is drawn.

    **Examples**

    - `pachon spots lsst_v3.3_r`: five fields from the axis to the edge
    - `pachon spots lsst_v3.3_r --across-band 5 --picture spots.pdf`: the whole band in colours
    - `pachon spots my_telescope.yaml --field-deg 0 --field-deg 0.3,0.4 --wavelength-nm 656.3 --json`
    """
    from ...design.metrics.spots import spots as compute

    return compute(
        *shared.first_arguments, sampling=cast("SamplingName", sampling), n_pupil=rays, **shared.trace_options
    )


def _largest(strehl: np.ndarray) -> np.ndarray:
    """Return the largest ratio of each field; NaN where all are too far from focus to be known."""
    import numpy as np

    finite = np.isfinite(strehl)
    return np.where(finite.any(axis=1), np.where(finite, strehl, 0.0).max(axis=1), np.nan)


@design_command(
    FIELD,
    Column("best for the spot [µm]", "best_focus_spot_um", "+.3f"),
    Column("smallest rms [µm]", "smallest_rms_radius_um", ".3f"),
    Column("best for the wavefront [µm]", "best_focus_wavefront_um", "+.3f"),
    Column("smallest rms [nm]", lambda result: result.rms_wavefront.min(axis=1), ".2f", 1e9),
    Column("largest Strehl", lambda result: _largest(result.strehl), ".4f"),
    verdict="The spots of all fields together are smallest with the detector at {best_focus_common_um:+.3f} µm.",
    band=True,
)
def focus(
    shared: SharedOptions,
    range_um: Annotated[
        tuple[float, float] | None,
        Option(
            metavar="LOW HIGH",
            help="Heights of the detector [um]; by default until spots are three times their smallest.",
        ),
    ] = None,
    steps: Annotated[int, Option(min=3, max=10000, help="Heights in that range.")] = 61,
) -> Study:
    """Move the detector through focus: spots, wavefront and Strehl ratio against its height, and the best focus.

    Heights are those of the detector above its place along its own z axis.

    **Examples**

    - `pachon focus lsst_v3.3_r`
    - `pachon focus paul_baker --range-um -500 200 --field-deg 0 --field-deg 0.5`
    """
    import numpy as np

    from ...design.metrics.through_focus import through_focus

    if range_um is not None and not range_um[0] < range_um[1]:
        raise ConfigError(f"--range-um = {range_um[0]:g} {range_um[1]:g}: expected the lower height first")
    heights = None if range_um is None else np.linspace(*range_um, steps) * 1e-6
    return through_focus(*shared.first_arguments, heights, **shared.trace_options)


@design_command()
def zernikes(
    shared: SharedOptions,
    jmax: Annotated[int, Option(min=4, max=500, help="Highest index in the pupil.")] = 28,
    pupil: Annotated[
        str,
        choice(
            ("auto", "full", "lit"),
            help="full: the whole annulus, orthogonal; lit: where light passes; auto: full, but lit where stopped rays "
            "would spoil the terms.",
        ),
    ] = "auto",
    over_field: Annotated[bool, Option("--map", help="Maps over the field of view.")] = False,
    double: Annotated[
        int | None, Option(min=1, max=200, metavar="KMAX", help="Double Zernikes, terms in the field.")
    ] = None,
    fringe: Annotated[bool, Option("--fringe", help="Fringe order, up to 37 terms of amplitude one.")] = False,
) -> Outcome:
    """Fit annular Zernikes (Noll, in nm) to the wavefronts of field points, or over the whole field of view.

    **Examples**

    - `pachon zernikes lsst_v3.3_r`: five fields from the axis to the edge
    - `pachon zernikes lsst_v3.3_r --map`: each term over the field
    - `pachon zernikes lsst_v3.3_r --double 22 --json`: Zernikes of the field times those of the pupil
    - `pachon zernikes my_lens.zmx --fringe --jmax 37`: as interferometers order and scale them
    """
    from ...design.metrics.field_zernikes import double_zernikes, wavefront_zernikes
    from ...design.metrics.vignetting import field_disc
    from ...wavefront.request import Request

    if sum((bool(shared.field_deg), over_field, double is not None)) > 1:
        raise ConfigError("--field-deg, --map and --double: expected one of them")
    telescope = shared.telescope
    if fringe and double is not None:
        raise ConfigError("--fringe and --double: expected one of them")
    fields = None if double is not None else field_disc(telescope) if over_field else shared.fields
    request = Request.of(telescope, fields, shared.wavelength, one_wavelength=True, **shared.trace_options)
    to_fit = cast("PupilToFit", pupil)
    if double is not None:
        terms = double_zernikes(request, jmax=jmax, kmax=double, pupil=to_fit)
        return Outcome(terms, _double_rows, stem=f"double_zernikes_{shared.stem}")
    ordering: ZernikeOrdering = "fringe" if fringe else "noll"
    coefficients = wavefront_zernikes(request, jmax=jmax, pupil=to_fit, ordering=ordering)
    return Outcome(coefficients, _map_rows if over_field else _rows)


def _rows(result: FieldZernikes) -> Rows:
    """Return every term at every field."""
    summary = numbers_of(result.summary())
    return _terms(summary, field_headings(result), summary["zernike_nm"], _rms_verdict(result))


def _rms_verdict(result: FieldZernikes) -> str:
    """Return the rms of the terms beyond tilt; empty of Fringe terms, whose amplitudes are no rms."""
    import numpy as np

    if result.summary()["ordering"] != "noll":
        return ""
    rms = 1e9 * np.sqrt((result.coefficients[:, 3:] ** 2).sum(axis=1))
    over = f" over {len(rms)} fields" if len(rms) > 1 else ""
    # Fitted where light passes, they are large where there is none: 1313 nm beside 162 nm at the edge of HSC's field.
    lit = ", of the whole annulus; that of the light is in pachon strehl" if result.pupil == "lit" else ""
    return f"The terms from defocus on have {range_text(rms, '.2f', 'nm')} rms{over}{lit}."


def _map_rows(result: FieldZernikes) -> Rows:
    """Return statistics of every term over the field."""
    import numpy as np

    nm = 1e9 * result.coefficients
    values = [nm.mean(axis=0), np.sqrt((nm**2).mean(axis=0)), nm.min(axis=0), nm.max(axis=0)]
    return _terms(result.summary(), ["mean", "rms", "least", "largest"], values, _rms_verdict(result))


def term_labels(count: int, ordering: ZernikeOrdering = "noll") -> list[str]:
    """Return the indices of the first terms, with their names where they have one."""
    from ...design.metrics.field_zernikes import term_label

    return [term_label(j, ordering) for j in range(1, count + 1)]


def _terms(summary: dict[str, Any], headings: list[str], columns: Iterable[np.ndarray], verdict: str) -> Rows:
    cells = [number_texts(values, ".2f") for values in columns]
    caption = "{telescope}, {wavelength_nm:g} nm; {pupil} pupil, obscuration {obscuration:g}; nm".format_map(summary)
    labels = term_labels(len(cells[0]), summary["ordering"])
    return Rows(["term", *headings], [*zip(labels, *cells, strict=True)], caption, verdict=verdict)


def _double_rows(result: DoubleZernikes) -> Rows:
    """Return the sixteen largest terms from defocus on."""
    import numpy as np

    summary = result.summary()
    nm = 1e9 * result.coefficients[:, 3:]
    order = np.unravel_index(np.argsort(-np.abs(nm), axis=None, kind="stable")[:16], nm.shape)
    rows = [(f"{k + 1}", f"{j + 4}", f"{nm[k, j]:.3f}") for k, j in zip(*order, strict=True)]
    caption = f"The largest from defocus on; rms of all {summary['rms_without_tilt_nm']:.2f} nm over pupil and field."
    return Rows(("field k", "pupil j", "coefficient [nm]"), rows, caption, left=0)


@design_command(
    FIELD,
    Column("chief ray at [mm]", "chief_landing_mm", ".4f"),
    Column("incidence [deg]", "chief_incidence_deg", ".4f"),
    Column("f/", "f_number", ".4f", subject="The focal ratio"),
    Column("[arcsec/µm]", "plate_scale_arcsec_per_um", ".6f"),
    Column("exit pupil at [mm]", "exit_pupil_distance_m", ".3f", 1e3),
    Column("its diameter [mm]", "exit_pupil_diameter_m", ".3f", 1e3),
    caption="Pairs: tangential, sagittal. The exit pupil is at that distance from the detector, along the light.",
)
def rays(shared: SharedOptions) -> Study:
    """Trace chief and marginal rays: focal ratio, plate scale, exit pupil, incidence on the detector, field by field.

    Tangential is the direction of the field point seen from the axis, sagittal is across it.

    **Examples**

    - `pachon rays lsst_v3.3_r`
    - `pachon rays paul_baker --field-deg 0.3,0.4 --json`
    """
    from ...design.metrics.principal_rays import principal_rays

    return principal_rays(*shared.first_arguments, **shared.trace_options)
