"""The command ``pachon measure``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from ..core.errors import ConfigError
from .inputs import load_model
from .options import Basis, Components, Interpolation, Json, Order, Quiet, Recipe, Threads, Weights, recipe_of_options
from .tables import Rows, print_json
from .workers import Processes, long_work

app = typer.Typer()

_CAPTION = "Completeness and purity of the stars; magnitude at which half of the objects are found; purity of all."
_MODELS = ("ccd", "focal_plane")


@app.command("measure")
def measure_command(
    images: Annotated[list[Path], Argument(metavar="IMAGE.fits ...", help="Images of pachon images.")],
    out: Annotated[
        Path | None, Option("--out", "-o", help="Folder of the catalogues; by default that of each.")
    ] = None,
    model: Annotated[
        str, Option(help="PSF model: ccd, one of each image, or focal_plane, one of the stars of all images.")
    ] = "ccd",
    telescope: Annotated[
        str | None,
        Option(
            help="Telescope of the focal-plane model: name or file. By default images.yaml beside the images has it."
        ),
    ] = None,
    recipe: Recipe = None,
    basis: Basis = None,
    interpolation: Interpolation = None,
    components: Components = None,
    weights: Weights = None,
    order: Order = None,
    min_snr: Annotated[float, Option(help="Least S/N of stars.")] = 30.0,
    resume: Annotated[bool, Option("--resume", help="Keep whole products of images measured in the same way.")] = False,
    processes: Processes = None,
    threads: Threads = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Detect objects on images, select stars, model the PSF from them, and fit the shapes of galaxies.

    Each image.fits leaves image_galaxies.fits, a table with sky positions, magnitudes and ellipticities before the PSF,
    and image_psf.fits, the PSF model of the CCD. With `--model focal_plane` one model of all images of an exposure
    takes its place: focal_plane_psf.fits. Simulated images know the truth: completeness and purity are printed. Images
    without objects, or with too few stars, are reported and left out.

    **Examples**

    - `pachon measure pachon_images/image_R22_S11.fits`
    - `pachon measure pachon_images/image_*.fits -o catalogues --processes 2`: two images at a time
    - `pachon measure pachon_images/image_*.fits -o catalogues --resume`: go on where it was stopped
    - `pachon measure pachon_images/image_*.fits -o catalogues --recipe paper`: the PSF in the paper's way
    - `pachon measure pachon_images/image_*.fits -o catalogues --model focal_plane`: optics, heights and turbulence
    """
    from ..core.files import make_folder
    from ..imaging.exposure_psf import fit_exposure_psf
    from ..imaging.measure_files import images_among, measure_files

    if model not in _MODELS:
        raise ConfigError(f"--model = {model!r}: expected one of {', '.join(_MODELS)}")
    if model == "ccd" and telescope is not None:
        raise ConfigError("--telescope: expected with --model focal_plane alone")
    if out is not None:
        make_folder(out)
    images = images_among(images)
    ccd_recipe = recipe_of_options(recipe, basis, interpolation, components, weights, order)
    if model != "ccd" and ccd_recipe is not None:
        raise ConfigError("--recipe and its options are of models of a CCD: expected none with --model focal_plane")
    hint = "catalogues that are written stay, and --resume goes on from there"
    with long_work(quiet, hint, threads=threads, resume=resume, processes=processes) as execution:
        psf = None
        if model == "focal_plane":
            telescope_model = None if telescope is None else load_model(telescope)
            psf = (images[0].parent if out is None else out) / "focal_plane_psf.fits"
            fit_exposure_psf(
                images, telescope_model, min_snr=min_snr, threads=threads, reporter=execution.reporter
            ).write(psf)
        measured = measure_files(images, out, psf=psf, recipe=ccd_recipe, min_snr=min_snr, execution=execution)
    if as_json:
        print_json({"images": measured.metrics, "left_out": measured.left_out})
    elif not quiet:
        rows = [
            (
                name,
                str(m["objects"]),
                str(m["stars"]),
                f"{m.get('star_completeness', float('nan')):.2f}, {m.get('star_purity', float('nan')):.2f}",
                str(m.get("magnitude_half_complete", "")),
                f"{m.get('purity', float('nan')):.3f}",
                f"{m['usable_per_arcmin2']:.1f}",
            )
            for name, m in measured.metrics.items()
        ]
        headings = ("image", "objects", "stars", "complete, pure", "half [mag]", "purity", "usable/arcmin²")
        Rows(headings, rows, _CAPTION).show()
