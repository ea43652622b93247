"""The command ``pachon measure``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer
from typer import Argument, Option

from ..core.errors import ConfigError
from ..core.number_text import CellText, NumberText
from . import completion
from .choices import choice, names
from .inputs import load_model
from .options import (
    Basis,
    ColourColumn,
    Components,
    Interpolation,
    Json,
    Order,
    Quiet,
    Recipe,
    TableFile,
    Threads,
    Weights,
    recipe_of_options,
    refuse_stated,
)
from .tables import Rows, print_json, write_rows
from .verdicts import measure_verdict
from .workers import Processes, long_work

if TYPE_CHECKING:
    from ..imaging.image_formats.load import WeightName
    from ..imaging.measure_files import MeasuredFiles

app = typer.Typer()

_CAPTION = "Completeness and purity of the stars; magnitude at which half of the objects are found; purity of all."
_HEADINGS = ("image", "objects", "stars", "usable", "density [1/arcmin²]", "complete, pure", "half [mag]", "purity")
#: Columns of images without the truth.
_COLUMNS = 5


@app.command("measure")
def measure_command(
    images: Annotated[list[Path], Argument(metavar="IMAGE.fits ...", help="FITS images of any program.")],
    out: Annotated[
        Path | None, Option("--out", "-o", help="Folder of the catalogues; by default that of each.")
    ] = None,
    model: Annotated[
        str, choice(("ccd", "focal_plane"), help="PSF model: one of each image, or one of the stars of all images.")
    ] = "ccd",
    telescope: Annotated[
        str | None,
        names(
            completion.models,
            metavar="MODEL",
            help="Telescope of the focal-plane model: name or file. By default images.yaml beside the images has it.",
        ),
    ] = None,
    recipe: Recipe = None,
    basis: Basis = None,
    interpolation: Interpolation = None,
    components: Components = None,
    weights: Weights = None,
    order: Order = None,
    psf: Annotated[
        str | None,
        Option(help="File of a PSF model: of pachon, Piff or PSFEx; {stem} is the name of the image without .fits."),
    ] = None,
    stars: Annotated[
        str | None, Option(help="Table of stars (x, y or ra, dec; FITS, ECSV, CSV), or {stem}..., in place of a locus.")
    ] = None,
    colours: Annotated[
        str | None,
        Option(help="Table with the colours of stars and galaxies, or {stem}...; that of --stars by default."),
    ] = None,
    colour_column: ColourColumn = None,
    min_snr: Annotated[float, Option(help="Least S/N of stars.")] = 30.0,
    extension: Annotated[
        str | None, Option(help="Extension of the image, name or number; by default all images of a file.")
    ] = None,
    weight: Annotated[str | None, Option(help="FITS file of the noise of the pixels, or {stem}....")] = None,
    weight_kind: Annotated[
        str,
        choice(
            ("weight", "variance", "rms"),
            help="What it holds; a weight is an inverse variance on any scale.",
        ),
    ] = "weight",
    mask: Annotated[str | None, Option(help="FITS file of the mask, or {stem}....")] = None,
    gain: Annotated[
        float | None, Option(help="Electrons in a unit of the image; by default those of the header.")
    ] = None,
    zero_point: Annotated[
        float | None, Option(help="Magnitude of a unit of the image; by default that of the header.")
    ] = None,
    pixel_scale: Annotated[
        float | None, Option(help="Side of a pixel of an image without world coordinates [arcsec].")
    ] = None,
    saturation: Annotated[
        float | None, Option(help="Level of saturated pixels [unit of the image]; by default that of the header.")
    ] = None,
    pictures: Annotated[
        bool, Option("--pictures", help="Also image_measured.png: objects, stellar locus, stars beside their PSF.")
    ] = False,
    resume: Annotated[bool, Option("--resume", help="Keep whole products of images measured in the same way.")] = False,
    processes: Processes = None,
    table: TableFile = None,
    threads: Threads = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Detect objects on images, select stars, model the PSF from them, and fit the shapes of galaxies.

    Each image.fits leaves image_galaxies.fits, a table with sky positions, magnitudes and ellipticities before the PSF,
    and image_psf.fits, the PSF model of the CCD. With `--model focal_plane` one model of all images of an exposure
    takes its place: focal_plane_psf.fits. Simulated images know the truth: completeness and purity are printed. Images
    without objects, or with fewer than three stars, are reported and left out.

    Images are those of pachon images, LSST, HSC, DES, or any with world coordinates and a gain, in one extension or
    many, compressed or not; docs/howto/measuring.md says what is read, and what the options stand for.

    **Examples**

    - `pachon measure pachon_images/image_R22_S11.fits`
    - `pachon measure pachon_images/image_*.fits -o catalogues --processes 2`: two images at a time
    - `pachon measure pachon_images/image_*.fits -o catalogues --resume`: go on where it was stopped
    - `pachon measure pachon_images/image_*.fits -o catalogues --recipe paper`: the PSF in the paper's way
    - `pachon measure pachon_images/image_*.fits -o catalogues --model focal_plane`: optics, heights and turbulence
    - `pachon measure D00232418_i_c19.fits.fz --psf "{stem}_piff.fits"`: an image of DES with the PSF model of Piff
    - `pachon measure coadd.fits --colours catalogue.fits --colour-column g_i`: a PSF for the colour of each galaxy
    - `pachon measure coadd.fits --weight coadd.weight.fits --gain 2.1 --zero-point 30`: what the header lacks
    """
    from ..core.files import make_folder
    from ..core.units import ARCSEC
    from ..imaging.exposure_psf import fit_exposure_psf
    from ..imaging.image_formats.load import ImageSettings
    from ..imaging.measure_files import MeasureOptions, images_among, measure_files

    if weight_kind != "weight" and weight is None:
        raise ConfigError("--weight-kind: expected --weight with it")
    # Those that the stars of the focal-plane model would not follow.
    of_ccd: dict[str, object] = {
        "--psf": psf,
        "--stars": stars,
        "--extension": extension,
        "--weight": weight,
        "--mask": mask,
    }
    of_ccd |= {"--gain": gain, "--saturation": saturation}
    if model != "ccd":
        refuse_stated(of_ccd, ": expected with --model ccd alone")
    if model == "ccd" and telescope is not None:
        raise ConfigError("--telescope: expected with --model focal_plane alone")
    if out is not None:
        make_folder(out)
    images = images_among(images)
    ccd_recipe = recipe_of_options(recipe, basis, interpolation, components, weights, order)
    if model != "ccd" and ccd_recipe is not None:
        raise ConfigError("--recipe and its options are of models of a CCD: expected none with --model focal_plane")
    if colour_column is not None and model != "ccd":
        raise ConfigError("--colour-column: expected with --model ccd alone")
    if colours is not None and colour_column is None:
        raise ConfigError("--colours: expected --colour-column, the name of its column")
    if colour_column is not None and colours is None and stars is None:
        raise ConfigError("--colour-column: expected --colours or --stars, the table that has it")
    if psf is not None and ccd_recipe is not None:
        raise ConfigError("--recipe and its options are of models of a CCD: expected none with --psf")
    settings = ImageSettings(
        weight=weight,
        weight_kind=cast("WeightName", weight_kind),
        mask=mask,
        gain=gain,
        zero_point=zero_point,
        pixel_scale=None if pixel_scale is None else pixel_scale * ARCSEC,
        saturation=saturation,
    )
    hint = "catalogues that are written stay, and --resume goes on from there"
    with long_work(quiet, hint, threads=threads, resume=resume, processes=processes) as execution:
        psf_file: str | Path | None = psf
        if model == "focal_plane":
            telescope_model = None if telescope is None else load_model(telescope)
            psf_file = (images[0].parent if out is None else out) / "focal_plane_psf.fits"
            fit_exposure_psf(
                images, telescope_model, min_snr=min_snr, threads=threads, reporter=execution.reporter
            ).write(psf_file)
        options = MeasureOptions(
            psf_file,
            ccd_recipe,
            stars,
            (stars if colours is None else colours) if colour_column is not None else None,
            colour_column,
            min_snr,
            settings,
            pictures,
        )
        measured = measure_files(images, out, extension=extension, options=options, execution=execution)
    rows = _image_rows(measured)
    write_rows(rows, table)
    if as_json:
        print_json({"images": measured.metrics, "left_out": measured.left_out})
    elif not quiet:
        rows.show()


def _image_rows(measured: MeasuredFiles) -> Rows:
    """Return what was measured on each image; with the truth, how much of it."""
    rows = []
    for name, m in measured.metrics.items():
        density = m["usable_per_arcmin2"]
        row = [
            name,
            str(m["objects"]),
            str(m["stars"]),
            str(m["usable"]),
            "" if density is None else NumberText(density, ".1f"),
        ]
        if "purity" in m:
            row += [
                CellText(
                    f"{m['star_completeness']:.2f}, {m['star_purity']:.2f}",
                    {"star completeness": m["star_completeness"], "star purity": m["star_purity"]},
                ),
                "" if m["magnitude_half_complete"] is None else str(m["magnitude_half_complete"]),
                NumberText(m["purity"], ".3f"),
            ]
        rows.append(row)
    has_truth = any("purity" in m for m in measured.metrics.values())
    columns = len(_HEADINGS) if has_truth else _COLUMNS
    padded_rows = [(row + [""] * columns)[:columns] for row in rows]
    return Rows(
        _HEADINGS[:columns],
        padded_rows,
        _CAPTION if has_truth else "",
        verdict=measure_verdict(measured.metrics, len(measured.left_out)),
    )
