"""The command ``pachon model``."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Option

from .interrupt import interruptible
from .options import (
    Basis,
    ColourColumn,
    Components,
    FlagMask,
    Gain,
    Interpolation,
    Json,
    MinSnr,
    NoPicture,
    Order,
    Quiet,
    Recipe,
    StarImages,
    StarMask,
    StarStamp,
    StarWeight,
    StarX,
    StarY,
    Weights,
    picture_kind,
    recipe_of_options,
)
from .tables import Rows, number_texts, numbers_of, print_json
from .verdicts import model_verdict

if TYPE_CHECKING:
    import numpy as np

    from ..reconstruction.psf_model.colour import FittedColour

app = typer.Typer()


@app.command("model")
def model_command(
    stars: Annotated[Path, Argument(metavar="STARS", help="FITS or ECSV table of stars with stamps.")],
    out: Annotated[Path | None, Option("--out", "-o", help="PSF model to write; STARS_psf.fits by default.")] = None,
    pixel_arcsec: Annotated[float, Option(help="Side of a pixel [arcsec].")] = 0.2,
    x: StarX = "x",
    y: StarY = "y",
    stamp: StarStamp = "stamp",
    weight: StarWeight = None,
    mask: StarMask = None,
    images: StarImages = None,
    colour_column: ColourColumn = None,
    flag_mask: FlagMask = None,
    size: Annotated[int | None, Option(help="Side of the PSF [pixel], odd; that of the stamps less a rim.")] = None,
    min_snr: MinSnr = 20.0,
    gain: Gain = 1.0,
    saturation: Annotated[
        float | None,
        Option(help="Level from which on a pixel is saturated; by default one at which 3 pixels of a star are equal."),
    ] = None,
    background: Annotated[
        bool, Option(help="Subtract the median of the outer pixels of each stamp, wings of the PSF in it.")
    ] = True,
    recipe: Recipe = None,
    basis: Basis = None,
    interpolation: Interpolation = None,
    components: Components = None,
    weights: Weights = None,
    order: Order = None,
    picture: Annotated[
        Path | None, Option("--picture", help="Picture to write, .png, .pdf or .svg; beside the model by default.")
    ] = None,
    no_picture: NoPicture = False,
    table: Annotated[
        Path | None, Option("--table", help="Table of all stars to write; beside the model, .ecsv, by default.")
    ] = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Model the PSF of an image from a table of its stars, and show how well it predicts stars that were held out.

    Stars are centred; pixels without weight, neighbours and cosmic rays apart from a core are masked; stars with
    saturated cores, or too little that is not masked, and those that a column FLAGS calls blended, saturated, cut or
    incomplete (`--flag-mask`), are left out. The model is kriging of pixels, as smooth as the
    stars say, or that of the options. It leaves the model, STARS_psf.fits; a picture beside it, .png (with `--json`
    where `--picture` names it); and all stars with their shapes and what the model made without them predicts, .ecsv.

    **Examples**

    - `pachon model stars.fits`: columns x, y, stamp, or x, y and a cube of images
    - `pachon model sextractor.cat --gain 1.7 --pixel-arcsec 0.263`: XWIN_IMAGE, YWIN_IMAGE, VIGNET
    - `pachon model piff_stars.fits`: X, Y, IMAGE, WEIGHT
    - `pachon model stars.fits --colour-column g_i`: the PSF may depend on the colours of the stars
    - `pachon model stars.ecsv --images stamps.fits --x X --y Y -o psf.fits`
    """
    import numpy as np

    from ..core.files import write_bytes
    from ..core.plotting import picture_bytes
    from ..core.table_files import in_format_of, write_table
    from ..core.units import ARCSEC
    from ..measure.star_selection import StarFlag, require_stars
    from ..models.star_spectrum import psf_colours
    from ..reconstruction.own_stars.own_stars import FEWEST_STARS, fit_own_stars
    from ..reconstruction.own_stars.result import with_left_out
    from ..reconstruction.own_stars.star_catalogue import FLAG_MASK, load_stars

    kind = picture_kind(picture, no_picture)
    chosen_recipe = recipe_of_options(recipe, basis, interpolation, components, weights, order)
    options: dict[str, Any] = {} if chosen_recipe is None else {"recipe": chosen_recipe}
    path = stars.with_name(f"{stars.stem}_psf.fits") if out is None else out
    with interruptible(quiet) as reporter, reporter.stage(f"PSF of {stars.name}"):
        cutouts = load_stars(
            stars, x=x, y=y, stamp=stamp, weight=weight, mask=mask, images=images, colour=colour_column
        )
        bits = FLAG_MASK if flag_mask is None else flag_mask
        kept = cutouts.unflagged(bits)
        require_stars(kept, np.where(kept, 0, StarFlag.FLAGGED_IN_CATALOGUE), FEWEST_STARS)
        fitted = cutouts.part(kept)
        if fitted.colour is not None:
            options["colour"] = psf_colours(fitted.colour, colour_column or "")
        own_stars = fit_own_stars(
            *fitted,
            pixel_arcsec * ARCSEC,
            size=size,
            min_snr=min_snr,
            gain=gain,
            saturation=saturation,
            background=background,
            **options,
        )
        result = with_left_out(own_stars, cutouts.positions, kept)
        result.model.write(path)
        picture_path = picture or (None if as_json else path.with_suffix(".png"))
        if picture_path is not None and not no_picture:
            write_bytes(picture_path, picture_bytes(result.plot(stars.name), kind))
        table_path = table or path.with_suffix(".ecsv")
        write_table(table_path, in_format_of(table_path, result.table()))
    summary_of_stars = result.summary()
    if as_json:
        print_json({"model": str(path), **summary_of_stars})
    elif not quiet:
        summary_of_stars = numbers_of(summary_of_stars)
        flagged = ", ".join(f"{n} {name.replace('_', ' ')}" for name, n in summary_of_stars["flagged"].items() if n)
        percent = partial(_percent, summary_of_stars)
        rows = [
            ("kind of model", str(summary_of_stars["kind"])),
            ("stars, used", f"{summary_of_stars['stars']}, {summary_of_stars['used']}"),
            ("defects, masked or left out", flagged or "none"),
            ("S/N, median", f"{summary_of_stars['median_snr']:.0f}"),
            (f"FWHM, pixels of {pixel_arcsec:.4g} arcsec", f"{summary_of_stars['fwhm_arcsec']:.3g} arcsec"),
            ("rms of g, weighted e of the stars", percent("rms_g", "rms_e")),
            ("... less the model, held out", percent("rms_g_held_out", "rms_e_held_out")),
            ("... of which noise of the stars, in weighted e", percent("rms_e_noise")),
            ("rms dT/T, held out", percent("rms_dt_g_held_out")),
            ("rms of weighted size less the model, held out", percent("rms_size_held_out")),
            ("... of which noise of the stars", percent("rms_size_noise")),
            ("model", str(path)),
            *([] if no_picture else [("picture", str(picture_path))]),
            ("stars", str(table or path.with_suffix(".ecsv"))),
        ]
        if cutouts.flags is not None and not kept.all():
            rows.insert(3, ("... by its FLAGS", _flags_text(cutouts.flags[~kept] & bits)))
        if colour_column is not None:
            rows.insert(1, ("dependence on colour", _colour_text(colour_column, result.model.colour)))
        Rows(("", ""), rows, left=2, verdict=model_verdict(summary_of_stars)).show()


def _percent(figures: dict[str, Any], *keys: str) -> str:
    """Return figures in per cent, dashes for unknown ones: stars may be too sharp for adaptive moments."""
    texts = number_texts((100.0 * figures[key] for key in keys), ".2f")
    return ", ".join(text if text == "-" else f"{text} %" for text in texts)


def _flags_text(flags: np.ndarray) -> str:
    """Return the words for bits of FLAGS that leave stars out."""
    from ..reconstruction.own_stars.star_catalogue import FLAG_WORDS

    counts = {words: int(((flags & bit) > 0).sum()) for bit, words in FLAG_WORDS.items()}
    reasons = ", ".join(f"{n} {words}" for words, n in counts.items() if n)
    return f"{reasons or 'other bits'}; --flag-mask 0 keeps them"


def _colour_text(column: str, colour: FittedColour | None) -> str:
    """Return the words for what the stars say of their colours."""
    if colour is None:
        return f"{column}: none, or colours do not differ"
    without = f", {colour.stars.n_unknown} without count as the mean" if colour.stars.n_unknown else ""
    return f"{column}: probability {colour.probability:.2g}{without}"
