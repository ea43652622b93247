"""Commands that make images of stars: ``psf``, ``ee``, ``mtf`` and ``ghosts``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from typer import Option

from ...core.errors import ConfigError
from ...core.terminal import print_line
from .. import completion
from ..choices import names
from ..tables import FIELD, Column
from .command import SharedOptions, Study, design_command

#: Pairs of surfaces whose ghosts take longer than ten seconds.
_MANY_PAIRS = 200
#: What a radius of encircled energy stands for in the verdict: one is enough.
_SUBJECTS = {(80, "µm"): "The radius of 80 % of the light"}
PupilPoints = Annotated[
    int | None, Option(min=16, max=4096, help="Lattice points across the pupil; enough by default.")
]


def _pixels_text(s: dict[str, Any]) -> str:
    """Return size and number of the pixels of diffraction images."""
    pixel, unit = (s["pixel_urad"], "µrad") if "pixel_urad" in s else (s["pixel_um"], "µm")
    return (
        f"{s['pixels']} x {s['pixels']} pixels of {pixel:.4g} {unit}; inside: of the light, within the "
        f"{s['pixels'] * pixel:.4g} {unit} of the image; lit: of the annular pupil; a dash: too narrow for the pixels. "
        f"{s['pupil_points']} points across the pupil."
    )


@design_command(
    FIELD,
    Column("Strehl", "strehl", ".4f", subject="The Strehl ratio"),
    Column("FWHM [µm]", "fwhm_um", ".3f"),
    Column("FWHM [arcsec]", "fwhm_arcsec", ".4f"),
    Column("Airy [µm]", "airy_radius_um", ".3f"),
    Column("inside [%]", "light_inside", ".2f", 100.0),
    Column("lit [%]", "lit_fraction", ".2f", 100.0),
    caption=_pixels_text,
    band=True,
)
def psf(
    shared: SharedOptions,
    huygens: Annotated[bool, Option("--huygens", help="Sum the wave of every ray at every pixel.")] = False,
    pixel_um: Annotated[
        float | None, Option(min=1e-6, max=1e6, help="Distance of pixels [um]; λf/5 or more by default.")
    ] = None,
    pixels: Annotated[int, Option(min=16, max=4096, help="Pixels on a side.")] = 128,
    pupil_points: PupilPoints = None,
    out: Annotated[Path | None, Option("--out", "-o", help="FITS file of the images to write, [field, y, x].")] = None,
) -> Study:
    """Make diffraction images of the telescope alone: Strehl ratio, FWHM, and the images themselves.

    By a Fourier sum over directions at the image, exact off the axis too; or by Huygens' wavelets.

    **Examples**

    - `pachon psf lsst_v3.3_i`: five fields from the axis to the edge
    - `pachon psf lsst_v3.3_i --across-band 5 --field-deg 1.4 -o psf.fits`
    - `pachon psf paul_baker --field-deg 0 --huygens --json`
    """
    from ...core.products import image_hdu, write_fits
    from ...design.images.diffraction import fft_psf, huygens_psf

    if out is not None and out.suffix.lower() not in (".fits", ".fit"):
        raise ConfigError(f"--out = {str(out)!r}: expected a name that ends in .fits; the picture is --picture")
    if huygens and pupil_points is not None:
        raise ConfigError("--huygens and --pupil-points: expected one of them")
    compute = huygens_psf if huygens else fft_psf
    pixel = None if pixel_um is None else pixel_um * 1e-6
    with shared.stage("diffraction images", shared.images) as progress:
        result = compute(shared.request, pixel=pixel, pixels=pixels, n_pupil=pupil_points, progress=progress)
    if out is not None:
        cards = [
            ("MODEL", result.telescope, "telescope"),
            ("METHOD", result.method, "fft or huygens"),
            ("PIXEL", result.pixel * 1e6, f"[{result.image_unit('um')}] distance of pixel centres"),
        ]
        write_fits(out, [image_hdu("PSF", result.image, "part of the light in each pixel")], None, cards)
    return result


@design_command(
    FIELD,
    *(
        Column(
            f"{fraction} % [{unit}]", f"ee{fraction}_radius_{key}", form, subject=_SUBJECTS.get((fraction, unit), "")
        )
        for fraction in (50, 80, 90)
        for unit, key, form in (("µm", "um", ".3f"), ("arcsec", "arcsec", ".4f"))
    ),
    caption="Radii about the centroid of the rays.",
    band=True,
)
def ee(
    shared: SharedOptions,
    geometric: Annotated[bool, Option("--geometric", help="Of rays alone, without diffraction.")] = False,
    pixels: Annotated[int, Option(min=16, max=4096, help="Pixels of the images, on a side.")] = 256,
    pupil_points: PupilPoints = None,
) -> Study:
    """Measure the encircled energy: radii that hold 50, 80 and 90 % of a star's light, in µm and arc seconds.

    With diffraction, about the centroid of the rays.

    **Examples**

    - `pachon ee lsst_v3.3_i`
    - `pachon ee lsst_v3.3_i --wavelength-nm 750 --field-deg 0 --field-deg 1 --field-deg 1.4 --field-deg 1.75`
    - `pachon ee my_lens.zmx --geometric --across-band 5 --json`
    """
    from ...design.images.encircled_energy import diffracted_energy, encircled_energy

    if geometric:
        return encircled_energy(shared.request, kind="geometric")
    with shared.stage("encircled energy", shared.images) as progress:
        return diffracted_energy(shared.request, pixels=pixels, n_pupil=pupil_points, progress=progress)


@design_command(
    FIELD,
    Column("50 % [cycles/mm]", "half_contrast_cycles_per_mm", ".2f", subject="The frequency of half contrast"),
    Column("50 % [cycles/arcsec]", "half_contrast_cycles_per_arcsec", ".3f"),
    Column("cut-off [cycles/mm]", "cutoff_cycles_per_mm", ".1f"),
    Column("f/", "f_number", ".4f"),
    caption="Pairs: tangential, sagittal. 50 %: where the contrast first falls to a half.",
    band=True,
)
def mtf(
    shared: SharedOptions,
    pupil_points: Annotated[
        int | None,
        Option(min=16, max=4096, help="Lattice points across the pupil; 256 by default, or as many as spots need."),
    ] = None,
) -> Study:
    """Draw the modulation transfer, tangential and sagittal, beside that of a perfect wavefront and of rays alone.

    **Examples**

    - `pachon mtf lsst_v3.3_r`
    - `pachon mtf my_lens.zmx --across-band 5 --field-deg 0 --field-deg 10 --picture mtf.pdf`
    """
    from ...design.images.mtf import mtf as compute

    with shared.stage("modulation transfer", shared.images) as progress:
        return compute(*shared.first_arguments, n_pupil=pupil_points, progress=progress, **shared.trace_options)


@design_command(
    Column("reflected at", "first"),
    Column("and then at", "second"),
    Column("light", "flux", ".3e"),
    Column("peak [1/mm²]", "peak_per_mm2", ".2e"),
    Column("peak [mag/arcsec²]", "peak_magnitudes_per_arcsec2", ".2f"),
    Column("diameter [mm]", "diameter_mm", ".2f"),
    Column("at [mm]", "centroid_mm", ".1f"),
    Column("focus [mm]", "focus_mm", ".2f"),
    caption=lambda s: (
        "Light and peak over the light of the star's own image; magnitudes below the star's own. Focus: height "
        "above the detector."
    ),
    verdict=lambda s: f"All ghosts together hold {100 * s['total_flux']:.3g} % of the star's light.",
    left=2,
    most=20,
)
def ghosts(
    shared: SharedOptions,
    field_deg: Annotated[
        str | None,
        Option(
            metavar="X,Y | R",
            help="Field angle of the star [deg], or its distance from the axis along +y; half-way by default.",
        ),
    ] = None,
    reflectivity: Annotated[
        list[str] | None,
        names(
            completion.coated_surfaces,
            metavar="R | NAME=R",
            help="Of the lens surfaces, one for all or by name; by default that of bare glass.",
        ),
    ] = None,
    detector_reflectivity: Annotated[float, Option(min=0.0, max=1.0, help="Of the detector.")] = 0.15,
    coatings: Annotated[
        Path | None, Option(metavar="FILE", help="Coatings of lens surfaces, a file as of throughput.")
    ] = None,
    rays: Annotated[int, Option(min=400, max=400_000, help="Rays of the star.")] = 40000,
    brightest: Annotated[
        int | None,
        Option(
            min=1, metavar="N", help="Only the N pairs of surfaces that are brightest in a first trace of 4000 rays."
        ),
    ] = None,
) -> Study:
    """Trace every ghost that two reflections make: its light, irradiance, size and focus, the brightest first.

    **Examples**

    - `pachon ghosts lsst_v3.3_r`
    - `pachon ghosts lsst_v3.3_r --field-deg 1.2 --reflectivity 0.01 --detector-reflectivity 0.3`
    - `pachon ghosts my_lens.zmx --brightest 20`: of a lens of many surfaces
    - `pachon ghosts lsst_v3.3_r --reflectivity Filter_exit=0.005 --reflectivity Filter_entrance=0.005 --json`
    """
    from ...design.metrics.ghost_paths import ghost_pairs
    from ...design.metrics.ghosts import Reflectivity
    from ...design.metrics.ghosts import ghosts as compute

    lenses = _reflectivities(reflectivity or [])
    field = None if shared.fields is None else shared.fields[0]
    pairs = len(ghost_pairs(shared.telescope))
    traced = max(pairs if brightest is None else min(brightest, pairs), 1)
    if traced > _MANY_PAIRS:
        print_line(
            f"ghosts of {pairs} pairs of surfaces, {rays} rays each: with --brightest 20 or --rays 4000 a tenth of "
            "the time or less",
            error=True,
        )
    with shared.stage("ghosts", traced) as progress:
        return compute(
            shared.telescope,
            field,
            shared.wavelength,
            reflectivity=Reflectivity(lenses, detector_reflectivity, coatings),
            n_pupil=rays,
            brightest=brightest,
            progress=progress,
            **shared.trace_options,
        )


def _reflectivities(texts: list[str]) -> float | dict[str, float] | None:
    """Return the reflectivities: None where there are none, one number for all, or numbers by name."""
    surface_reflectivities: dict[str, float] = {}
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
        surface_reflectivities[name] = number
    return surface_reflectivities or None
