"""Commands on a whole field of view and the way there: ``pachon distortion``, ``vignetting``, ``footprint``.

:mod:`~pachon.commands.cli` registers them.
"""

from __future__ import annotations

from typing import Annotated, Any

import typer

from .options import (
    FieldsDeg,
    Json,
    Lenient,
    Model,
    Picture,
    Projection,
    Threads,
    WavelengthNm,
    deliver,
    field_list,
    field_texts,
    interruptible,
    load_model,
    number_texts,
    picture_kind,
    show_table,
)

#: Rays that take longer than two seconds.
_MANY_RAYS = 10_000_000


def distortion_command(
    model: Model,
    field_deg: FieldsDeg = None,
    wavelength_nm: WavelengthNm = None,
    centroid: Annotated[bool, typer.Option("--centroid", help="Centroids of the light, not chief rays.")] = False,
    projection: Projection = "zemax",
    picture: Picture = None,
    threads: Threads = None,
    lenient: Lenient = False,
    as_json: Json = False,
) -> None:
    """Compare where stars land with a scaled picture of the sky, r = f tan(theta).

    In percent against the scale that fits best over the field, and against that at the axis, as lens designers do.

    **Examples**

    - `pachon distortion lsst_v3.3_r`: a lattice over the field of view

    - `pachon distortion lsst_v3.3_r --centroid --json`
    """
    from ..design.metrics.distortion import distortion

    picture_kind(picture)
    telescope = load_model(model, lenient)
    result = distortion(
        telescope,
        field_list(field_deg),
        None if wavelength_nm is None else wavelength_nm * 1e-9,
        reference="centroid" if centroid else "chief",
        projection=projection,
        threads=threads,
    )

    def show() -> None:
        s = result.summary()
        rows = [
            ("focal length that fits best", f"{s['focal_length_m']:.6f} m"),
            ("focal length at the axis", f"{s['axis_focal_length_m']:.6f} m"),
            ("largest distortion against the best scale", f"{s['largest_percent']:.4f} %"),
            ("largest distortion against the axis's scale", f"{s['largest_percent_of_axis_scale']:.4f} %"),
            ("largest shift from the best picture", f"{s['largest_shift_um']:.3f} µm"),
            ("rms shift", f"{s['rms_shift_um']:.3f} µm"),
        ]
        show_table(("what", "here"), rows, f"{s['telescope']}, {s['wavelength_nm']:g} nm, {len(result.fields)} fields")

    deliver(result, f"distortion_{telescope.name}", picture, as_json, show)


def vignetting_command(
    model: Model,
    field_deg: FieldsDeg = None,
    wavelength_nm: WavelengthNm = None,
    rays: Annotated[int, typer.Option(min=16, max=10**7, help="Rays of each field.")] = 16384,
    projection: Projection = "zemax",
    picture: Picture = None,
    threads: Threads = None,
    lenient: Lenient = False,
    as_json: Json = False,
) -> None:
    """Find how much of the pupil is lit against field, with an error, as profile and map.

    **Examples**

    - `pachon vignetting lsst_v3.3_r`: rings over the field of view

    - `pachon vignetting lsst_v3.3_r --field-deg 1.2 --field-deg 1.75 --rays 1000000 --json`
    """
    import numpy as np

    from ..design.metrics.vignetting import field_disc, vignetting

    picture_kind(picture)
    telescope = load_model(model, lenient)
    wavelength = None if wavelength_nm is None else wavelength_nm * 1e-9
    fields: Any = field_list(field_deg) if field_deg else field_disc(telescope)
    options: dict[str, Any] = dict(rays=rays, projection=projection, threads=threads)
    if rays * (len(fields) + 1) < _MANY_RAYS:
        result = vignetting(telescope, fields, wavelength, **options)
    else:
        with interruptible(False) as reporter, reporter.stage("vignetting", len(fields) + 1) as stage:
            result = vignetting(telescope, fields, wavelength, **options, progress=stage.advance)

    def show() -> None:
        radius = np.rad2deg(np.linalg.norm(result.fields, axis=-1)).round(6)
        rows = []
        for r in np.unique(radius):
            ring = radius == r
            light, error = 100.0 * result.relative[ring], 100.0 * result.error[ring].max() / result.axis_fraction
            rows.append((f"{r:g}", f"{light.mean():.2f}", f"{light.min():.2f}", f"{light.max():.2f}", f"{error:.2f}"))
        columns = ("distance from the axis [deg]", "light [%]", "least", "most", "error of one field")
        axis = f"Relative to the axis, where {100 * result.axis_fraction:.2f} % of the annular pupil is lit."
        show_table(columns, rows, axis)

    deliver(result, f"vignetting_{telescope.name}", picture, as_json, show)


def footprint_command(
    model: Model,
    surface: Annotated[
        list[str] | None, typer.Option(help="Name of a surface, once for each; all of them by default.")
    ] = None,
    field_deg: FieldsDeg = None,
    wavelength_nm: WavelengthNm = None,
    projection: Projection = "zemax",
    picture: Picture = None,
    threads: Threads = None,
    lenient: Lenient = False,
    as_json: Json = False,
) -> None:
    """Draw what the light of field points fills on surfaces, over the clear apertures, and what each surface blocks.

    **Examples**

    - `pachon footprint lsst_v3.3_r`: a panel for each surface

    - `pachon footprint lsst_v3.3_r --surface M2 --surface Filter_entrance --field-deg 0 --field-deg 1.75`
    """
    import numpy as np

    from ..design.metrics.footprint import footprint

    picture_kind(picture)
    telescope = load_model(model, lenient)
    wavelength = None if wavelength_nm is None else wavelength_nm * 1e-9
    result = footprint(
        telescope, surface or None, field_list(field_deg), wavelength, projection=projection, threads=threads
    )

    def show() -> None:
        fields = [f"{text}°" for text in field_texts(result.summary())]
        rows = []
        for s in result.surfaces:
            blocked = number_texts(100.0 * s.blocked_fraction, ".2f")
            rows.append((s.surface.name, f"{np.nanmax(s.largest_radius, initial=0.0) * 1e3:.2f}", *blocked))
        show_table(
            ("surface", "reaches to [mm]", *fields),
            rows,
            "Reaches to: largest distance from the vertex of light that arrives. Then, field by field, the part of the "
            "pupil [%] that the surface is the first to block.",
        )

    deliver(result, f"footprint_{telescope.name}", picture, as_json, show)


COMMANDS = {"distortion": distortion_command, "vignetting": vignetting_command, "footprint": footprint_command}
