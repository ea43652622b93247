"""The command ``pachon donuts``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument, Option

from ..core.errors import ConfigError
from .inputs import load_model
from .interrupt import interruptible
from .options import (
    GlassCatalogues,
    Json,
    Lenient,
    Projection,
    Quiet,
    Threads,
    degrees_pair,
    picture_kind,
    wavelength_list,
)
from .tables import Rows, print_json

if TYPE_CHECKING:
    import numpy as np

    from ..sensing.result import DonutFit
    from ..sensing.wavefront_fits import WavefrontFit

app = typer.Typer()

_CAPTION = (
    "Wavefront beyond the telescope's own: root of the summed squares of the Zernikes, and its error; the largest "
    "terms. Positive where the wavefront leads."
)


@app.command("donuts")
def donuts_command(
    files: Annotated[list[Path], Argument(metavar="FILE.fits ...", help="Stamps of donuts, or images of CCDs.")],
    telescope: Annotated[str, Option("--telescope", "-t", help="Bundled model, or path.")] = "lsst_v3.3_r",
    defocus_um: Annotated[
        float, Option(help="Shift of the detector, not the camera, along z [um], beside the file's: 1500 behind focus.")
    ] = 0.0,
    wavelength_nm: Annotated[
        list[float] | None,
        Option("--wavelength-nm", help="Wavelength [nm], once for each; the model's own by default."),
    ] = None,
    field_deg: Annotated[
        str | None, Option("--field-deg", metavar="X,Y", help="Field angle of all stamps [deg], where files have none.")
    ] = None,
    positions: Annotated[
        Path | None, Option(help="Table with field_x, field_y [deg], and for the image of a CCD x, y [pixels].")
    ] = None,
    stamp: Annotated[int, Option(min=16, help="Side of the stamps cut from the image of a CCD [pixels].")] = 180,
    pixel_um: Annotated[float, Option(help="Side of a pixel [um].")] = 10.0,
    gain: Annotated[float, Option(help="Electrons per unit of the images.")] = 1.0,
    sky_variance: Annotated[
        float | None, Option(help="Variance of sky and readout [electron^2]; from the edges of the stamps by default.")
    ] = None,
    saturation: Annotated[float | None, Option(help="Level of saturated pixels [electrons].")] = None,
    terms: Annotated[int, Option("--zernikes", min=4, max=78, help="Highest Noll index.")] = 22,
    higher_order_nm: Annotated[float, Option(help="Rms of each Zernike of the next radial degree [nm].")] = 10.0,
    exposure_s: Annotated[
        float | None,
        Option(help="Length of the exposure [s]: its turbulence adds to errors, and its higher terms are fitted."),
    ] = None,
    site: Annotated[str, Option(help="Site whose turbulence and winds --exposure-s is about.")] = "cerro_pachon",
    degrees_of_freedom: Annotated[
        str | None, Option(help="Fit degrees of freedom to all donuts: lsst, or a YAML file.")
    ] = None,
    each_alone: Annotated[
        bool, Option("--each-alone", help="Fit each donut alone, even where several are given of one exposure.")
    ] = False,
    outer_scale_m: Annotated[float, Option(help="Outer scale of the turbulence [m]; inf for Kolmogorov's.")] = 25.0,
    diffraction: Annotated[
        bool, Option(help="Diffraction at the rims of the pupil: not in images made of rays alone.")
    ] = True,
    projection: Projection = "zemax",
    out: Annotated[Path | None, Option("--out", "-o", help="Table: .ecsv, .fits, .csv or .parquet.")] = None,
    picture: Annotated[Path | None, Option(help="Picture of the first six donuts: .png, .pdf or .svg.")] = None,
    glass_catalogue: GlassCatalogues = None,
    lenient: Lenient = False,
    threads: Threads = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Measure the wavefront of out-of-focus stars (donuts): annular Zernikes beyond those of the telescope.

    A file holds a cube of stamps and a table with their fields (field_x, field_y [deg], defocus_um), one stamp an
    extension with keywords FIELD_X, FIELD_Y and DEFOC_UM, or the image of a CCD, with --positions. Stamps have x and y
    along those of the detector, and no sky. Bad donuts are flagged with the reason. Two donuts or more are taken to be
    of one exposure, or of both sides of focus: they are fitted together (--each-alone: not).

    **Examples**

    - `pachon donuts donuts.fits --defocus-um 1500 -o wavefronts.ecsv --picture donuts.png`
    - `pachon donuts corner_*.fits -t rubin_v3.14_i --degrees-of-freedom lsst --json`
    - `pachon donuts ccd.fits --positions stars.ecsv --stamp 200 --defocus-um -1500`
    """
    from ..models.parameters.degrees_of_freedom_file import load_degrees_of_freedom
    from ..sensing.exposure_fit import ExposureDonuts
    from ..sensing.fit import fit_donuts
    from ..sensing.freedom_fit import TelescopeFreedoms
    from ..sensing.model import DonutAir, DonutDetector, DonutModel
    from ..sensing.stamp_files import border_variance
    from ..sensing.wavefront_fits import SingleDonuts
    from ..wavefront.atmosphere.atmosphere import Atmosphere

    kind = _output_kind(out, picture)
    believed = load_model(telescope, lenient, glass_catalogue or ())
    noll = range(4, terms + 1)
    atmosphere = None if exposure_s is None else Atmosphere.from_site(site, 0, exposure=exposure_s)
    images, fields, defocus = _stamps(files, positions, stamp, field_deg)
    images = [gain * image for image in images]
    higher_order = higher_order_nm * 1e-9
    wavefront: WavefrontFit = ExposureDonuts(noll=noll, higher_order=higher_order)
    if degrees_of_freedom is not None:
        wavefront = TelescopeFreedoms(load_degrees_of_freedom(degrees_of_freedom), noll=noll)
    elif each_alone or len(images) < 2:
        wavefront = SingleDonuts(noll, higher_order=higher_order)
    model = DonutModel(
        air=DonutAir(outer_scale=outer_scale_m, atmosphere=atmosphere),
        detector=DonutDetector(pixel_um * 1e-6, defocus=defocus + 1e-6 * defocus_um, saturation=saturation),
        diffraction=diffraction,
    )
    with (
        interruptible(quiet) as reporter,
        reporter.stage(f"wavefronts of {len(images)} donuts", total=len(images)) as stage,
    ):
        fit = fit_donuts(
            believed,
            images,
            fields,
            wavelength_list(believed, wavelength_nm, None),
            sky_variance=[border_variance(image) for image in images] if sky_variance is None else sky_variance,
            model=model,
            fit=wavefront,
            projection=projection,
            threads=threads,
            progress=stage.advance,
        )
    _write(fit, out, picture, kind)
    if as_json:
        print_json(fit.summary())
    elif not quiet:
        _show(fit)


def _output_kind(table: Path | None, picture: Path | None) -> str:
    """Return the format of the picture; a ConfigError for names of files of other formats."""
    from ..core.table_files import FORMATS

    kind = picture_kind(picture)
    if table is not None and table.suffix.lower() not in FORMATS:
        raise ConfigError(f"--out = {table}: expected a name that ends in {', '.join(FORMATS)}")
    return kind


def _stamps(
    files: list[Path], positions: Path | None, size: int, field_deg: str | None
) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """Return the stamps of files, their field angles [rad] and shifts of their detectors [m]."""
    import numpy as np

    from ..sensing.stamp_files import read_stamps

    field = None if field_deg is None else np.deg2rad(degrees_pair(field_deg, "--field-deg"))
    images, fields, defocus = [], [], []
    for path in files:
        stamps = read_stamps(path, positions, size)
        places = field if stamps.fields is None else stamps.fields
        if places is None:
            raise ConfigError(
                "no field angles: expected FIELD_X and FIELD_Y, a table with them, or --field-deg", file=path
            )
        images += stamps.images
        fields.append(np.broadcast_to(places, (len(stamps), 2)))
        defocus.append(stamps.defocus)
    return images, np.concatenate(fields), np.concatenate(defocus)


def _write(fit: DonutFit, table: Path | None, picture: Path | None, kind: str) -> None:
    """Write the table and the picture of a fit, where they are asked for."""
    from ..core.files import write_bytes
    from ..core.plotting import picture_bytes
    from ..core.table_files import write_table

    if table is not None:
        write_table(table, fit.to_table())
    if picture is not None:
        write_bytes(picture, picture_bytes(fit.plot(), kind))


def _show(fit: DonutFit) -> None:
    import numpy as np

    rows = []
    for i, (x, y) in enumerate(np.rad2deg(fit.fields)):
        if not fit.usable[i]:
            rows.append((f"{x:.4g}, {y:.4g}", fit.reasons[i], *[""] * 5))
            continue
        nm, error = fit.zernikes[i] * 1e9, fit.errors[i] * 1e9
        largest = ", ".join(f"Z{fit.noll[k]} {nm[k]:+.0f}" for k in np.argsort(-np.abs(nm))[:3])
        seeing = np.rad2deg(fit.fwhm[i]) * 3600.0
        quality = fit.chi2[i] / fit.n_pixels[i]
        sizes = f"{np.linalg.norm(nm):.0f}", f"{np.linalg.norm(error):.0f}"
        rows.append((f"{x:.4g}, {y:.4g}", fit.reasons[i] or "ok", *sizes, largest, f"{seeing:.2f}", f"{quality:.2f}"))
    headings = ("field [deg]", "flags", "rms [nm]", "error [nm]", "largest [nm]", 'FWHM ["]', "chi2 a pixel")
    Rows(headings, rows, _CAPTION, left=2).show()
    for line in _remarks(fit):
        typer.echo(line)


def _remarks(fit: DonutFit) -> list[str]:
    """Return what is to be said of all donuts together, in sentences."""
    from ..sensing.flags import DonutFlag

    remarks, exposure = [], fit.exposure
    wrong, ambiguous = (
        int(sum(bool(flag & bit) for flag in fit.flags)) for bit in (DonutFlag.DEFOCUS_SIGN, DonutFlag.AMBIGUOUS_SIDE)
    )
    if wrong:
        remarks.append(f"{wrong} of {len(fit)} donuts fit the other side of focus: the sign of their defocus is wrong.")
    if ambiguous:
        remarks.append(
            f"{ambiguous} of {len(fit)} donuts fit both sides of focus: results are those of the side given."
        )
    if exposure is not None:
        remarks.append(
            f"{int(fit.usable.sum())} donuts are fitted as of one telescope (--each-alone: each by itself). By their "
            f"scatter the air has {1e9 * exposure.air_rms:.0f} nm rms, which the errors include, and the fits "
            f"{exposure.noise_scale:.2g} times the variance that they claim."
        )
        remarks += [notice[0].upper() + notice[1:] + "." for notice in exposure.notices]
    return remarks
