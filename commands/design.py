"""Commands that measure images: ``pachon spots``, ``focus``, ``zernikes`` and ``rays``.

:mod:`~pachon.commands.cli` registers them.
"""

from __future__ import annotations

from typing import Annotated, Any

import typer

from .options import (
    AcrossBand,
    FieldsDeg,
    Json,
    Lenient,
    Model,
    Picture,
    Projection,
    Threads,
    WavelengthNm,
    WavelengthsNm,
    deliver,
    field_list,
    field_texts,
    load_model,
    number_texts,
    pair_texts,
    picture_kind,
    show_table,
    wavelength_list,
)

Sampling = Annotated[str, typer.Option(help="Points of the pupil: gauss, rings, spiral or square.")]
Rays = Annotated[
    int | None,
    typer.Option(min=1, help="Their number along the radius (gauss, rings), in all (spiral), across (square)."),
]


def spots_command(
    model: Model,
    field_deg: FieldsDeg = None,
    wavelength_nm: WavelengthsNm = None,
    across_band: AcrossBand = None,
    sampling: Sampling = "gauss",
    rays: Rays = None,
    projection: Projection = "zemax",
    picture: Picture = None,
    threads: Threads = None,
    lenient: Lenient = False,
    as_json: Json = False,
) -> None:
    """Draw and measure spot diagrams: rms radius, radius of 80 % of the rays, in micrometres and arc seconds.

    Sizes are about the centroid of all wavelengths together. Diffraction is left out; the Airy disc is drawn.

    **Examples**

    - `pachon spots lsst_v3.3_r`: five fields from the axis to the edge

    - `pachon spots lsst_v3.3_r --across-band 5 -o spots.pdf`: the whole band in colours

    - `pachon spots my_telescope.yaml --field-deg 0 --field-deg 0.3,0.4 --wavelength-nm 656.3 --json`
    """
    from ..design.metrics.spots import spots
    from ..wavefront.pupil_sampling import pupil_sampling

    picture_kind(picture)
    telescope = load_model(model, lenient)
    result = spots(
        telescope,
        field_list(field_deg),
        wavelength_list(telescope, wavelength_nm, across_band),
        sampling=pupil_sampling(telescope, sampling, rays),
        projection=projection,
        threads=threads,
    )

    def show() -> None:
        s = result.summary()
        columns = ("field [deg]", "rms [µm]", "rms [arcsec]", "80 % [µm]", "80 % [arcsec]", "largest [µm]")
        rows = zip(
            field_texts(s),
            number_texts(s["rms_radius_um"], ".3f"),
            number_texts(s["rms_radius_arcsec"], ".4f"),
            number_texts(s["radius_80_percent_um"], ".3f"),
            number_texts(s["radius_80_percent_arcsec"], ".4f"),
            number_texts(s["geometric_radius_um"], ".3f"),
            number_texts(s["airy_radius_um"], ".3f"),
            number_texts(100.0 * s["lit_fraction"], ".2f"),
            strict=True,
        )
        show_table((*columns, "Airy [µm]", "lit [%]"), [*rows], "Radii about the centroid; lit: of the annular pupil.")

    deliver(result, f"spots_{telescope.name}", picture, as_json, show)


def focus_command(
    model: Model,
    field_deg: FieldsDeg = None,
    wavelength_nm: WavelengthsNm = None,
    across_band: AcrossBand = None,
    range_um: Annotated[
        tuple[float, float] | None,
        typer.Option(metavar="LOW HIGH", help="Heights of the detector [um]; by default as far as spots treble."),
    ] = None,
    steps: Annotated[int, typer.Option(min=3, max=10000, help="Heights in that range.")] = 61,
    projection: Projection = "zemax",
    picture: Picture = None,
    threads: Threads = None,
    lenient: Lenient = False,
    as_json: Json = False,
) -> None:
    """Move the detector through focus: spots, wavefront and Strehl ratio against its height, and the best focus.

    Heights are those of the detector above its place along its own z axis.

    **Examples**

    - `pachon focus lsst_v3.3_r`

    - `pachon focus paul_baker --range-um -500 200 --field-deg 0 --field-deg 0.5`
    """
    import numpy as np

    from ..core.errors import ConfigError
    from ..design.metrics.through_focus import through_focus

    picture_kind(picture)
    if range_um is not None and not range_um[0] < range_um[1]:
        raise ConfigError(f"--range-um = {range_um[0]:g} {range_um[1]:g}: expected the lower height first")
    telescope = load_model(model, lenient)
    result = through_focus(
        telescope,
        field_list(field_deg),
        wavelength_list(telescope, wavelength_nm, across_band),
        None if range_um is None else np.linspace(*range_um, steps) * 1e-6,
        projection=projection,
        threads=threads,
    )

    def show() -> None:
        s = result.summary()
        columns = ("field [deg]", "best for the spot [µm]", "smallest rms [µm]", "best for the wavefront [µm]")
        rows = zip(
            field_texts(s),
            number_texts(s["best_focus_spot_um"], "+.3f"),
            number_texts(s["smallest_rms_radius_um"], ".3f"),
            number_texts(s["best_focus_wavefront_um"], "+.3f"),
            number_texts(result.rms_wavefront.min(axis=1) * 1e9, ".2f"),
            number_texts(result.strehl.max(axis=1), ".4f"),
            strict=True,
        )
        common = f"The spots of all fields together are smallest at {s['best_focus_common_um']:+.3f} µm."
        show_table((*columns, "smallest rms [nm]", "largest Strehl"), [*rows], common)

    deliver(result, f"focus_{telescope.name}", picture, as_json, show)


def zernikes_command(
    model: Model,
    field_deg: FieldsDeg = None,
    wavelength_nm: WavelengthNm = None,
    jmax: Annotated[int, typer.Option(min=4, max=500, help="Highest Noll index in the pupil.")] = 28,
    pupil: Annotated[str, typer.Option(help="full: the whole annulus, orthogonal; lit: where light passes.")] = "full",
    over_field: Annotated[bool, typer.Option("--map", help="Maps over the field of view.")] = False,
    double: Annotated[
        int | None, typer.Option(min=1, max=200, metavar="KMAX", help="Double Zernikes, so many terms in the field.")
    ] = None,
    projection: Projection = "zemax",
    picture: Picture = None,
    threads: Threads = None,
    lenient: Lenient = False,
    as_json: Json = False,
) -> None:
    """Fit annular Zernikes (Noll, in nm) to the wavefronts of field points, or over the whole field of view.

    **Examples**

    - `pachon zernikes lsst_v3.3_r`: five fields from the axis to the edge

    - `pachon zernikes lsst_v3.3_r --map`: each term over the field

    - `pachon zernikes lsst_v3.3_r --double 22 --json`: Zernikes of the field times those of the pupil
    """
    from ..core.errors import ConfigError
    from ..design.metrics.field_zernikes import double_zernikes, wavefront_zernikes
    from ..design.metrics.vignetting import field_disc

    picture_kind(picture)
    if sum((bool(field_deg), over_field, double is not None)) > 1:
        raise ConfigError("--field-deg, --map and --double: expected one of them")
    telescope = load_model(model, lenient)
    wavelength = None if wavelength_nm is None else wavelength_nm * 1e-9
    common: dict[str, Any] = dict(jmax=jmax, pupil=pupil, projection=projection, threads=threads)
    if double is not None:
        table = double_zernikes(telescope, wavelength, kmax=double, **common)
        deliver(table, f"double_zernikes_{telescope.name}", picture, as_json, lambda: _show_double(table))
        return
    fields = field_disc(telescope) if over_field else field_list(field_deg)
    result = wavefront_zernikes(telescope, fields, wavelength, **common)
    deliver(result, f"zernikes_{telescope.name}", picture, as_json, lambda: _show_zernikes(result, over_field))


def _show_zernikes(result: Any, over_field: bool) -> None:
    import numpy as np

    from ..models.zernike_polynomials import NOLL_NAMES

    s = result.summary()
    nm = s["zernike_nm"]
    names = [f"{j} {NOLL_NAMES.get(j, '')}".strip() for j in range(1, nm.shape[1] + 1)]
    where = f"{s['telescope']}, {s['wavelength_nm']:g} nm; {s['pupil']} pupil, obscuration {s['obscuration']:g}; nm"
    if over_field:
        figures = [nm.mean(axis=0), np.sqrt((nm**2).mean(axis=0)), nm.min(axis=0), nm.max(axis=0)]
        columns = ["mean", "rms", "least", "largest"]
    else:
        figures = list(nm)
        columns = [f"{text}°" for text in field_texts(s)]
    show_table(
        ("term", *columns), [*zip(names, *(number_texts(values, ".2f") for values in figures), strict=True)], where
    )


def _show_double(result: Any) -> None:
    import numpy as np

    s = result.summary()
    nm = s["double_zernike_nm"]
    order = np.argsort(-np.abs(nm[:, 3:]), axis=None, kind="stable")[:16]
    rows = []
    for k, j in zip(*np.unravel_index(order, nm[:, 3:].shape), strict=True):
        rows.append((f"{k + 1}", f"{j + 4}", f"{nm[k, j + 3]:.3f}"))
    caption = f"The largest from defocus on; rms of all {s['rms_without_tilt_nm']:.2f} nm over pupil and field."
    show_table(("field k", "pupil j", "coefficient [nm]"), rows, caption, left=0)


def rays_command(
    model: Model,
    field_deg: FieldsDeg = None,
    wavelength_nm: WavelengthNm = None,
    projection: Projection = "zemax",
    picture: Picture = None,
    threads: Threads = None,
    lenient: Lenient = False,
    as_json: Json = False,
) -> None:
    """Trace chief and marginal rays: focal ratio, plate scale, exit pupil, incidence on the detector, field by field.

    Tangential is the direction of the field point seen from the axis, sagittal is across it.

    **Examples**

    - `pachon rays lsst_v3.3_r`

    - `pachon rays paul_baker --field-deg 0.3,0.4 --json`
    """
    from ..design.metrics.principal_rays import principal_rays

    picture_kind(picture)
    telescope = load_model(model, lenient)
    wavelength = None if wavelength_nm is None else wavelength_nm * 1e-9
    result = principal_rays(telescope, field_list(field_deg), wavelength, projection=projection, threads=threads)

    def show() -> None:
        s = result.summary()
        rows = zip(
            field_texts(s),
            pair_texts(s["chief_landing_mm"], ".4f"),
            number_texts(s["chief_incidence_deg"], ".4f"),
            pair_texts(s["f_number"], ".4f"),
            pair_texts(s["plate_scale_arcsec_per_um"], ".6f"),
            pair_texts(1e3 * s["exit_pupil_distance_m"], ".3f"),
            pair_texts(1e3 * s["exit_pupil_diameter_m"], ".3f"),
            strict=True,
        )
        columns = ("field [deg]", "chief ray at [mm]", "incidence [deg]", "f/", "[arcsec/µm]", "exit pupil at [mm]")
        caption = "Pairs: tangential, sagittal. The exit pupil is at that distance from the detector, along the light."
        show_table((*columns, "its diameter [mm]"), [*rows], caption)

    deliver(result, f"rays_{telescope.name}", picture, as_json, show)


COMMANDS = {"spots": spots_command, "focus": focus_command, "zernikes": zernikes_command, "rays": rays_command}
