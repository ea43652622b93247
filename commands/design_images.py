"""Commands that make images of stars and drawings of telescopes: ``pachon psf``, ``ee``, ``mtf``, ``ghosts``, ``draw``.

:mod:`~pachon.commands.cli` registers them.
"""

from __future__ import annotations

from pathlib import Path
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
    interruptible,
    load_model,
    number_texts,
    pair_texts,
    picture_kind,
    show_table,
    wavelength_list,
)

PupilPoints = Annotated[
    int | None, typer.Option(min=16, max=4096, help="Lattice points across the pupil; enough of them by default.")
]


def psf_command(
    model: Model,
    field_deg: FieldsDeg = None,
    wavelength_nm: WavelengthsNm = None,
    across_band: AcrossBand = None,
    huygens: Annotated[bool, typer.Option("--huygens", help="Sum the wave of every ray at every pixel.")] = False,
    pixel_um: Annotated[float | None, typer.Option(help="Distance of pixels [um]; λf/5 or more by default.")] = None,
    pixels: Annotated[int, typer.Option(min=16, max=4096, help="Pixels on a side.")] = 128,
    pupil_points: PupilPoints = None,
    projection: Projection = "zemax",
    lenient: Lenient = False,
    fits: Annotated[Path | None, typer.Option(help="FITS file to write the images to, [field, y, x].")] = None,
    picture: Picture = None,
    threads: Threads = None,
    as_json: Json = False,
) -> None:
    """Make diffraction images of the telescope alone: Strehl ratio, FWHM, and the images themselves.

    By a Fourier sum over directions at the image, exact off the axis too; or by Huygens' wavelets.

    **Examples**

    - `pachon psf lsst_v3.3_i`: five fields from the axis to the edge

    - `pachon psf lsst_v3.3_i --across-band 5 --field-deg 1.4 --fits psf.fits`

    - `pachon psf paul_baker --field-deg 0 --huygens --json`
    """
    from ..core.errors import ConfigError
    from ..design.images.diffraction import fft_psf, huygens_psf

    picture_kind(picture)
    if huygens and pupil_points is not None:
        raise ConfigError("--huygens and --pupil-points: expected one of them")
    telescope = load_model(model, lenient)
    fields, waves = field_list(field_deg), wavelength_list(telescope, wavelength_nm, across_band)
    common: dict[str, Any] = dict(
        pixel=None if pixel_um is None else pixel_um * 1e-6, pixels=pixels, projection=projection, threads=threads
    )
    with interruptible(False) as reporter, reporter.stage("diffraction images", _images(fields, waves)) as stage:
        if huygens:
            result = huygens_psf(telescope, fields, waves, advance=stage.advance, **common)
        else:
            result = fft_psf(telescope, fields, waves, pupil_points=pupil_points, advance=stage.advance, **common)
    if fits is not None:
        from ..core.files import image_hdu, write_fits

        cards = [
            ("MODEL", result.telescope, "telescope"),
            ("METHOD", result.method, "fft or huygens"),
            ("PIXEL", result.pixel * 1e6, "[um] distance of pixel centres"),
        ]
        write_fits(fits, [image_hdu("PSF", result.image, "part of the light in each pixel")], None, cards)

    def show() -> None:
        s = result.summary()
        rows = zip(
            field_texts(s),
            number_texts(s["strehl"], ".4f"),
            number_texts(s["fwhm_um"], ".3f"),
            number_texts(s["fwhm_arcsec"], ".4f"),
            number_texts(s["airy_radius_um"], ".3f"),
            number_texts(100.0 * s["light_inside"], ".2f"),
            number_texts(100.0 * s["lit_fraction"], ".2f"),
            strict=True,
        )
        columns = ("field [deg]", "Strehl", "FWHM [µm]", "FWHM [arcsec]", "Airy [µm]", "inside [%]", "lit [%]")
        side = s["pixels"] * s["pixel_um"]
        show_table(
            columns,
            [*rows],
            f"{s['pixels']} x {s['pixels']} pixels of {s['pixel_um']:.4g} µm; inside: of the light, within the "
            f"{side:.4g} µm of the image; lit: of the annular pupil. {s['pupil_points']} points across the pupil.",
        )

    deliver(result, f"psf_{telescope.name}", picture, as_json, show)


def ee_command(
    model: Model,
    field_deg: FieldsDeg = None,
    wavelength_nm: WavelengthsNm = None,
    across_band: AcrossBand = None,
    geometric: Annotated[bool, typer.Option("--geometric", help="Of rays alone, without diffraction.")] = False,
    pixels: Annotated[int, typer.Option(min=16, max=4096, help="Pixels of the images, on a side.")] = 256,
    pupil_points: PupilPoints = None,
    projection: Projection = "zemax",
    lenient: Lenient = False,
    picture: Picture = None,
    threads: Threads = None,
    as_json: Json = False,
) -> None:
    """Measure the encircled energy: radii that hold 50, 80 and 90 % of a star's light, in µm and arc seconds.

    With diffraction, about the centroid of the rays.

    **Examples**

    - `pachon ee lsst_v3.3_i`

    - `pachon ee lsst_v3.3_i --wavelength-nm 750 --field-deg 0 --field-deg 1 --field-deg 1.4 --field-deg 1.75`

    - `pachon ee my_lens.zmx --geometric --across-band 5 --json`
    """
    from ..design.images.encircled_energy import encircled_energy

    picture_kind(picture)
    telescope = load_model(model, lenient)
    fields, waves = field_list(field_deg), wavelength_list(telescope, wavelength_nm, across_band)
    total = None if geometric else _images(fields, waves)
    with interruptible(False) as reporter, reporter.stage("encircled energy", total) as stage:
        result = encircled_energy(
            telescope,
            fields,
            waves,
            kind="geometric" if geometric else "diffraction",
            pixels=pixels,
            pupil_points=pupil_points,
            projection=projection,
            threads=threads,
            advance=stage.advance,
        )

    def show() -> None:
        s = result.summary()
        shares = [(share, unit) for share in (50, 80, 90) for unit in ("um", "arcsec")]
        columns = [f"{share} % [{unit.replace('um', 'µm')}]" for share, unit in shares]
        values = [number_texts(s[f"ee{a}_radius_{unit}"], ".3f" if unit == "um" else ".4f") for a, unit in shares]
        show_table(
            ("field [deg]", *columns),
            [*zip(field_texts(s), *values, strict=True)],
            "Radii about the centroid of the rays.",
        )

    deliver(result, f"ee_{telescope.name}", picture, as_json, show)


def mtf_command(
    model: Model,
    field_deg: FieldsDeg = None,
    wavelength_nm: WavelengthsNm = None,
    across_band: AcrossBand = None,
    pupil_points: Annotated[int, typer.Option(min=16, max=4096, help="Lattice points across the pupil.")] = 256,
    projection: Projection = "zemax",
    lenient: Lenient = False,
    picture: Picture = None,
    threads: Threads = None,
    as_json: Json = False,
) -> None:
    """Draw the modulation transfer, tangential and sagittal, beside that of a perfect wavefront and of rays alone.

    **Examples**

    - `pachon mtf lsst_v3.3_r`

    - `pachon mtf my_lens.zmx --across-band 5 --field-deg 0 --field-deg 10 -o mtf.pdf`
    """
    from ..design.images.mtf import mtf

    picture_kind(picture)
    telescope = load_model(model, lenient)
    fields, waves = field_list(field_deg), wavelength_list(telescope, wavelength_nm, across_band)
    with interruptible(False) as reporter, reporter.stage("modulation transfer", _images(fields, waves)) as stage:
        result = mtf(
            telescope,
            fields,
            waves,
            pupil_points=pupil_points,
            projection=projection,
            threads=threads,
            advance=stage.advance,
        )

    def show() -> None:
        s = result.summary()
        rows = zip(
            field_texts(s),
            pair_texts(s["half_contrast_cycles_per_mm"], ".2f"),
            pair_texts(s["half_contrast_cycles_per_arcsec"], ".3f"),
            pair_texts(s["cutoff_cycles_per_mm"], ".1f"),
            pair_texts(s["f_number"], ".4f"),
            strict=True,
        )
        columns = ("field [deg]", "50 % [cycles/mm]", "50 % [cycles/arcsec]", "cut-off [cycles/mm]", "f/")
        show_table(columns, [*rows], "Pairs: tangential, sagittal. 50 %: where the contrast first falls to a half.")

    deliver(result, f"mtf_{telescope.name}", picture, as_json, show)


def ghosts_command(
    model: Model,
    field_deg: Annotated[
        str | None,
        typer.Option(
            "--field-deg",
            metavar="X,Y | R",
            help="Field angle of the star [deg], or its distance from the axis along +y; half-way by default.",
        ),
    ] = None,
    wavelength_nm: WavelengthNm = None,
    reflectivity: Annotated[
        list[str] | None,
        typer.Option(
            metavar="R | NAME=R", help="Of the lens surfaces, one for all or by name; by default that of bare glass."
        ),
    ] = None,
    detector_reflectivity: Annotated[float, typer.Option(min=0.0, max=1.0, help="Of the detector.")] = 0.15,
    rays: Annotated[int, typer.Option(min=400, max=10_000_000, help="Rays of the star.")] = 40000,
    projection: Projection = "zemax",
    lenient: Lenient = False,
    picture: Picture = None,
    threads: Threads = None,
    as_json: Json = False,
) -> None:
    """Trace every ghost that two reflections make: its light, irradiance, size and focus, the brightest first.

    **Examples**

    - `pachon ghosts lsst_v3.3_r`

    - `pachon ghosts lsst_v3.3_r --field-deg 1.2 --reflectivity 0.01 --detector-reflectivity 0.3`

    - `pachon ghosts lsst_v3.3_r --reflectivity Filter_exit=0.005 --reflectivity Filter_entrance=0.005 --json`
    """
    from ..design.metrics.ghost_paths import ghost_pairs
    from ..design.metrics.ghosts import ghosts

    picture_kind(picture)
    coatings = _reflectivities(reflectivity or [])
    telescope = load_model(model, lenient)
    fields = field_list(None if field_deg is None else [field_deg])
    with (
        interruptible(False) as reporter,
        reporter.stage("ghosts", max(len(ghost_pairs(telescope)), 1)) as stage,
    ):
        result = ghosts(
            telescope,
            None if fields is None else fields[0],
            None if wavelength_nm is None else wavelength_nm * 1e-9,
            reflectivity=coatings,
            detector_reflectivity=detector_reflectivity,
            rays=rays,
            projection=projection,
            threads=threads,
            advance=stage.advance,
        )

    def show() -> None:
        s = result.summary()
        rows = zip(
            s["first"],
            s["second"],
            number_texts(s["flux"], ".3e"),
            number_texts(s["peak_per_mm2"], ".2e"),
            number_texts(s["peak_magnitudes_per_arcsec2"], ".2f"),
            number_texts(s["diameter_mm"], ".2f"),
            pair_texts(s["centroid_mm"], ".1f"),
            number_texts(s["focus_mm"], ".2f"),
            strict=True,
        )
        columns = ("reflected at", "and then at", "light", "peak [1/mm²]", "peak [mag/arcsec²]", "diameter [mm]")
        show_table(
            (*columns, "at [mm]", "focus [mm]"),
            [*rows],
            "Light and peak over the light of the star's own image; magnitudes below the star's own. Focus: height "
            f"above the detector. All ghosts together hold {100 * s['total_flux']:.3g} % of the star's light.",
            left=2,
        )

    deliver(result, f"ghosts_{telescope.name}", picture, as_json, show)


def draw_command(
    model: Model,
    field_deg: FieldsDeg = None,
    wavelength_nm: WavelengthNm = None,
    glb: Annotated[
        Path | None, typer.Option(help="Write the telescope and its rays in three dimensions, .glb.")
    ] = None,
    projection: Projection = "zemax",
    lenient: Lenient = False,
    picture: Picture = None,
    threads: Threads = None,
    as_json: Json = False,
) -> None:
    """Draw a telescope: its section with rays of some fields, and a model in three dimensions.

    Surfaces are cut to their apertures; those without one go as far as the light of the field of view does.

    **Examples**

    - `pachon draw lsst_v3.3_r`

    - `pachon draw lsst_v3.3_r_obstructed -o lsst.pdf --glb lsst.glb`

    - `pachon draw my_lens.zmx --field-deg 0 --field-deg 10`
    """
    from ..core.errors import ConfigError
    from ..core.files import write_bytes
    from ..design.layout import layout

    picture_kind(picture)
    if glb is not None and glb.suffix.lower() != ".glb":
        raise ConfigError(f"--glb = {str(glb)!r}: expected a name that ends in .glb")
    telescope = load_model(model, lenient)
    wavelength = None if wavelength_nm is None else wavelength_nm * 1e-9
    result = layout(telescope, field_list(field_deg), wavelength, projection=projection, threads=threads)
    if glb is not None:
        write_bytes(glb, result.glb())

    def show() -> None:
        s = result.summary()
        rows = zip(
            s["surface"],
            s["interaction"],
            (", ".join(f"{v:.6g}" for v in vertex) for vertex in s["vertex_m"] * 1e3),
            number_texts(s["drawn_radius_m"] * 1e3, ".4g"),
            strict=True,
        )
        show_table(("surface", "kind", "vertex [mm]", "drawn to [mm]"), [*rows], left=2)
        if glb is not None:
            print(f"model: {glb.resolve()}")

    deliver(result, f"draw_{telescope.name}", picture, as_json, show)


def _images(fields: Any, waves: Any) -> int:
    """Return how many images there will be, over fields and wavelengths."""
    import numpy as np

    return (5 if fields is None else len(fields)) * (1 if waves is None else np.size(waves))


def _reflectivities(texts: list[str]) -> float | dict[str, float] | None:
    """Return what ``--reflectivity`` says: nothing, one number for all, or numbers by name."""
    from ..core.errors import ConfigError

    found: dict[str, float] = {}
    for text in texts:
        name, _, value = text.rpartition("=")
        try:
            number = float(value)
        except ValueError:
            raise ConfigError(f"--reflectivity = {text!r}: expected a number, or NAME=number") from None
        if not name:
            if len(texts) > 1:
                raise ConfigError(f"--reflectivity = {text!r}: expected one number alone, or NAME=number for each")
            return number
        found[name] = number
    return found or None


COMMANDS = {
    "psf": psf_command,
    "ee": ee_command,
    "mtf": mtf_command,
    "ghosts": ghosts_command,
    "draw": draw_command,
}
