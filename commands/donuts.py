"""The command ``pachon donuts``."""

from __future__ import annotations

from dataclasses import replace
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer
from typer import Argument, Option

from ..core.errors import ConfigError, PachonError, PrescriptionWarning, ProductError
from ..core.number_text import counted
from ..core.terminal import print_line, print_warning
from . import completion
from .choices import choice, names
from .donut_inputs import (
    DEFAULT_PIXEL_UM,
    DEFAULT_TELESCOPE,
    FRAME_NAMES,
    FrameOptions,
    StampFiles,
    donut_inputs,
)
from .donut_report import observatory_summary, orientation_text, show_fit
from .donut_simulation import simulate_file
from .inputs import load_model, warnings_shown
from .interrupt import interruptible
from .options import GlassCatalogues, Json, Lenient, Projection, Quiet, Threads, picture_kind, wavelength_list
from .tables import print_json

if TYPE_CHECKING:
    from ..raytrace.rays import Projection as FieldProjection
    from ..sensing.frames import FrameName
    from ..sensing.observatory_zernikes import ObservatoryZernikes, ZernikeConvention
    from ..sensing.result import DonutFit
    from ..sensing.stamp_headers import HeaderValues
    from ..sensing.wavefront_fits import WavefrontFit

app = typer.Typer()

#: Panels of the help.
_FILES = "Files and their planes"
_TELESCOPE = "Telescope, light, detector"
_FRAMES = "Frames and conventions"
_FIT = "Fit"
_SIMULATION = "Simulated donuts"
_OUTPUT = "Output"
#: Options with an opposite, whose two names are as wide as others with their values.
_CHOICES = "Diffraction and orientation"
#: Field angle from which on a donut tells its orientation, as a fraction of the telescope's field.
_OFF_AXIS = 0.25
#: Least and greatest side of a pixel, and greatest shift of a body [um].
_PIXELS_UM = (1.0, 1e4)
_MOST_DEFOCUS_UM = 1e5
#: Donuts that are enough for a check of orientation wherever they stand.
_SEVERAL = 3


@app.command("donuts")
def donuts_command(
    files: Annotated[list[Path], Argument(metavar="FILE.fits ...", help="Stamps of donuts, or images of CCDs.")],
    telescope: Annotated[
        str | None,
        names(
            completion.models,
            "--telescope",
            "-t",
            metavar="MODEL",
            help="Bundled model, or path; that of the header, of its camera and band, or lsst_v3.3_r.",
            rich_help_panel=_TELESCOPE,
        ),
    ] = None,
    defocus_um: Annotated[
        float,
        Option(
            help="Shift along z of what --moved names [um], beside the file's: 1500 behind focus.",
            rich_help_panel=_TELESCOPE,
        ),
    ] = 0.0,
    moved: Annotated[
        str | None,
        names(
            completion.words("Detector", "Camera", "M2"),
            metavar="NAME",
            help="Surface or group that defocus moves: Detector, Camera, M2, ...; the file's or its camera's own.",
            rich_help_panel=_TELESCOPE,
        ),
    ] = None,
    wavelength_nm: Annotated[
        list[float] | None,
        Option(
            "--wavelength-nm",
            help="Wavelength [nm], once for each; the header's or the model's own by default.",
            rich_help_panel=_TELESCOPE,
        ),
    ] = None,
    field_deg: Annotated[
        str | None,
        Option(
            "--field-deg",
            metavar="X,Y",
            help="Field angle of all stamps [deg], where files have none.",
            rich_help_panel=_FILES,
        ),
    ] = None,
    positions: Annotated[
        Path | None,
        Option(
            help="Table with field_x, field_y [deg], and for the image of a CCD x, y [pixels].", rich_help_panel=_FILES
        ),
    ] = None,
    stamp: Annotated[
        int, Option(min=16, help="Side of the stamps cut from the image of a CCD [pixels].", rich_help_panel=_FILES)
    ] = 180,
    mask: Annotated[
        Path | None, Option(help="FITS file of masks: pixels other than 0 are left out.", rich_help_panel=_FILES)
    ] = None,
    variance: Annotated[
        Path | None, Option(help="FITS file of variances, in the square of the unit.", rich_help_panel=_FILES)
    ] = None,
    pixel_um: Annotated[
        float | None,
        Option(help="Side of a pixel [um]; that of the headers' camera, or 10.", rich_help_panel=_TELESCOPE),
    ] = None,
    gain: Annotated[
        float | None,
        Option(help="Electrons per unit of the images; GAIN of the header, or 1.", rich_help_panel=_FILES),
    ] = None,
    sky_variance: Annotated[
        float | None,
        Option(
            help="Variance of sky and readout [electron^2]; of the variance plane, or measured, and the gain.",
            rich_help_panel=_FIT,
        ),
    ] = None,
    saturation: Annotated[
        float | None, Option(help="Level of saturated pixels [electrons].", rich_help_panel=_TELESCOPE)
    ] = None,
    terms: Annotated[int, Option("--zernikes", min=4, max=78, help="Highest Noll index.", rich_help_panel=_FIT)] = 22,
    higher_order_nm: Annotated[
        float, Option(help="Rms of each Zernike of the next radial degree [nm].", rich_help_panel=_FIT)
    ] = 10.0,
    exposure_s: Annotated[
        float | None,
        Option(
            help="Length of the exposure [s]: its turbulence adds to errors, and its higher terms are fitted.",
            rich_help_panel=_FIT,
        ),
    ] = None,
    site: Annotated[
        str,
        names(
            completion.sites,
            metavar="SITE|FILE",
            help="Site whose turbulence and winds --exposure-s is about.",
            rich_help_panel=_FIT,
        ),
    ] = "cerro_pachon",
    degrees_of_freedom: Annotated[
        str | None,
        names(
            completion.degrees_of_freedom,
            metavar="lsst|FILE",
            help="Fit degrees of freedom to all donuts; prints hexapod corrections.",
            rich_help_panel=_FIT,
        ),
    ] = None,
    each_alone: Annotated[
        bool,
        Option(
            "--each-alone",
            help="Fit each donut alone, even where several are given of one exposure.",
            rich_help_panel=_FIT,
        ),
    ] = False,
    outer_scale_m: Annotated[
        float, Option(help="Outer scale of the turbulence [m]; inf for Kolmogorov's.", rich_help_panel=_FIT)
    ] = 25.0,
    diffraction: Annotated[
        bool | None,
        Option(
            help="Diffraction at the rims of the pupil: by default where it fits the images better than rays do.",
            rich_help_panel=_CHOICES,
        ),
    ] = None,
    stamp_axes: Annotated[
        str | None,
        names(
            completion.words("DVCS", "x,y", "y,x", "-x,y", "x,-y", "-x,-y"),
            metavar="X,Y",
            help="Axes of the camera along columns and rows of stamps: x,y, -y,x...; DVCS (LSST's images, y,x). "
            "By default those of the headers' detector, or x,y.",
            rich_help_panel=_FRAMES,
        ),
    ] = None,
    rotator_deg: Annotated[
        float | None,
        Option(
            help="Camera from +x towards +y of the telescope (rotTelPos) [deg]; the header's, or 0.",
            rich_help_panel=_FRAMES,
        ),
    ] = None,
    parallactic_deg: Annotated[
        float | None,
        Option(
            help="Position angle of the telescope's +y, north through east: Rubin's parallactic angle [deg].",
            rich_help_panel=_FRAMES,
        ),
    ] = None,
    field_frame: Annotated[
        str, choice(FRAME_NAMES, help="Frame of field angles given.", rich_help_panel=_FRAMES)
    ] = "OCS",
    frame: Annotated[
        str, choice(FRAME_NAMES, help="Frame of results; OCS is the telescope's.", rich_help_panel=_FRAMES)
    ] = "OCS",
    convention: Annotated[
        str,
        choice(
            ("pachon", "ts_wep", "donut"),
            help="Zernikes of results: pachon (nm), ts_wep (um), donut (DECam's, circular, waves of 700 nm).",
            rich_help_panel=_FRAMES,
        ),
    ] = "pachon",
    orientation_check: Annotated[
        bool,
        Option(help="Warn where mirrored or turned stamps fit better; 1 to 3 s.", rich_help_panel=_CHOICES),
    ] = True,
    projection: Projection = "zemax",
    simulate: Annotated[
        bool,
        Option("--simulate", help="Write FILE.fits with donuts of the telescope instead.", rich_help_panel=_SIMULATION),
    ] = False,
    perturb: Annotated[
        list[str] | None,
        names(
            completion.motions,
            metavar="BODY.MOTION=SIZE",
            help="Of --simulate, what is wrong with the telescope: M2.dx=200um.",
            rich_help_panel=_SIMULATION,
        ),
    ] = None,
    settings: Annotated[
        list[str] | None,
        names(
            completion.key_values("donuts"),
            "--set",
            metavar="KEY=VALUE",
            help="Of --simulate: stars, layout (random, corners), sides (1, 2), seeing_arcsec, electrons, sky, "
            "read_noise, stamp, seed.",
            rich_help_panel=_SIMULATION,
        ),
    ] = None,
    out: Annotated[
        Path | None,
        Option("--out", "-o", "--table", help="Table: .ecsv, .fits, .csv or .parquet.", rich_help_panel=_OUTPUT),
    ] = None,
    picture: Annotated[
        Path | None,
        Option(help="Picture of the first six donuts: .png, .pdf or .svg; none by default.", rich_help_panel=_OUTPUT),
    ] = None,
    no_picture: Annotated[bool, Option("--no-picture", help="Draw no picture.", rich_help_panel=_OUTPUT)] = False,
    glass_catalogue: GlassCatalogues = None,
    lenient: Lenient = False,
    threads: Threads = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Measure the wavefront of out-of-focus stars (donuts): annular Zernikes beyond those of the telescope.

    A file holds a cube of stamps and a table with their fields (field_x, field_y [deg], defocus_um), one stamp an
    extension with keywords FIELD_X, FIELD_Y and DEFOC_UM, or the image of a CCD, with --positions. Of LSSTCam, ComCam,
    LATISS and DECam, and of ts_wep's DonutStamps, headers give camera, detector, pixel, angles, band and gain, and
    extensions MASK, VARIANCE (DQ, WEIGHT, ERR) are read. Stamps have x and y along those of the camera, unless
    --stamp-axes or the header's detector says otherwise. A defocus moves what --moved, a keyword MOVED or a column
    moved names, or the header's camera: Camera (full-array mode of LSSTCam), M2 (AuxTel), DECam, else the detector.
    Bad donuts are flagged with the reason. Two donuts or more are taken to be of one exposure, or of both sides of
    focus: they are fitted together (--each-alone: not).

    **Examples**

    - `pachon donuts donuts.fits --defocus-um 1500 -o wavefronts.ecsv --picture donuts.png`
    - `pachon donuts full_array.fits --moved Camera --defocus-um 1500`
    - `pachon donuts try.fits --simulate --moved Camera --defocus-um 1500 --perturb M2.dx=200um --set stars=8`, then
      `pachon donuts try.fits`: without data of your own; true_Z4 ... stand in the file's table
    - `pachon donuts corner_*.fits -t rubin_v3.14_i --degrees-of-freedom lsst --json`
    - `pachon donuts ccd.fits --positions stars.ecsv --stamp 200 --defocus-um -1500`
    - `pachon donuts donutStamps.fits --frame CCS --convention ts_wep` (as LSST's zk_deviation_CCS)
    - `pachon donuts DECam_*.stamp.fits --defocus-um 1650 --convention donut`
    - `pachon donuts stamps.fits --stamp-axes DVCS --rotator-deg 12.3 --degrees-of-freedom lsst --frame ZCS`
    """
    import numpy as np

    from ..models.parameters.degrees_of_freedom_file import load_degrees_of_freedom
    from ..sensing.exposure_fit import ExposureDonuts
    from ..sensing.fit import fit_donuts
    from ..sensing.flags import DonutFlag
    from ..sensing.freedom_fit import TelescopeFreedoms
    from ..sensing.model import DETECTOR, DonutAir, DonutDetector, DonutModel
    from ..sensing.observatory_zernikes import hexapod_corrections
    from ..sensing.orientation import check_orientation
    from ..sensing.stamp_headers import TELESCOPE_KEY
    from ..sensing.wavefront_fits import SingleDonuts
    from ..wavefront.atmosphere.atmosphere import Atmosphere
    from ..wavefront.request import wavelength_points

    _require_within("--defocus-um", defocus_um, (-_MOST_DEFOCUS_UM, _MOST_DEFOCUS_UM))
    if pixel_um is not None:
        _require_within("--pixel-um", pixel_um, _PIXELS_UM)
    if simulate:
        of_fits = {
            "--positions": positions,
            "--mask": mask,
            "--variance": variance,
            "--gain": gain,
            "--exposure-s": exposure_s,
            "--degrees-of-freedom": degrees_of_freedom,
            "--stamp-axes": stamp_axes,
            "--rotator-deg": rotator_deg,
            "--parallactic-deg": parallactic_deg,
            "--out": out,
            "--picture": picture,
        }
        if ignored := [option for option, value in of_fits.items() if value is not None]:
            raise ConfigError(f"{', '.join(ignored)}: expected without --simulate")
        name = telescope or DEFAULT_TELESCOPE
        focused = load_model(name, lenient, glass_catalogue or ())
        side = _pixel_um(pixel_um, None, focused.camera) * 1e-6
        detector = DonutDetector(side, defocus=1e-6 * defocus_um, moved=moved or DETECTOR)
        air = DonutAir(outer_scale=outer_scale_m)
        simulate_file(
            files,
            (name, focused),
            DonutModel(air=air, detector=detector),
            (perturb or [], settings or []),
            wavelength_nm,
            field_deg,
            quiet,
        )
        return
    if perturb or settings:
        raise ConfigError("--perturb, --set: expected them with --simulate alone")
    picture = None if no_picture else picture
    kind = _output_kind(out, picture)
    field_projection, output_frame = cast("FieldProjection", projection), cast("FrameName", frame)
    files_read = StampFiles.read(files, positions, stamp, mask, variance)
    header = files_read.header()
    options = FrameOptions(
        rotator_deg, parallactic_deg, stamp_axes, cast("FrameName", field_frame), field_deg, field_projection
    )
    frames = options.frames(header)
    if "sky" in (frame, field_frame) and frames.parallactic_angle is None:
        raise ConfigError("frame sky without a parallactic angle: expected --parallactic-deg")
    try:
        focused = load_model(telescope or header.model or DEFAULT_TELESCOPE, lenient, glass_catalogue or ())
    except PachonError as error:
        if telescope is not None or header.telescope is None:
            raise
        text = f"{TELESCOPE_KEY} = {header.telescope!r}: {error}; give the telescope by --telescope"
        raise ProductError(text, file=files[0], key=TELESCOPE_KEY) from None
    believed = frames.telescope(focused)
    noll = range(4, terms + 1)
    atmosphere = None if exposure_s is None else Atmosphere.from_site(site, 0, exposure=exposure_s)
    inputs = donut_inputs(files_read, options, frames, believed, _electrons(gain, header))
    higher_order = higher_order_nm * 1e-9
    wavefront: WavefrontFit = ExposureDonuts(noll=noll, higher_order=higher_order)
    if degrees_of_freedom is not None:
        wavefront = TelescopeFreedoms(load_degrees_of_freedom(degrees_of_freedom), noll=noll)
    elif each_alone or len(inputs.images) < 2:
        wavefront = SingleDonuts(noll, higher_order=higher_order)
    model = DonutModel(
        air=DonutAir(outer_scale=outer_scale_m, atmosphere=atmosphere),
        detector=DonutDetector(
            _pixel_um(pixel_um, header.pixel, header.camera) * 1e-6,
            defocus=inputs.defocus + inputs.heights + 1e-6 * defocus_um,
            moved=moved or files_read.moved() or DETECTOR,
            saturation=saturation,
        ),
        diffraction=diffraction,
    )
    light = wavelength_list(believed, wavelength_nm, None)
    if wavelength_nm is None and header.wavelength is not None:
        light = np.array([header.wavelength])
    planes = [variance for variance in inputs.variances if variance is not None]
    sky = planes if len(planes) == len(inputs.images) else None
    if sky_variance is not None:
        sky = [sky_variance] * len(inputs.images)
    if not quiet and header.text:
        lengths = ", ".join(f"{1e9 * wavelength:.4g}" for wavelength in wavelength_points(believed, light))
        print_line(f"{files[0]}: {header.text} of its header; {believed.name} at {lengths} nm", error=True)
    orientation = None
    with (
        warnings_shown(PrescriptionWarning),
        interruptible(quiet) as reporter,
        reporter.stage(f"wavefronts of {counted(len(inputs.images), 'donut')}", total=len(inputs.images)) as stage,
    ):
        fit = fit_donuts(
            believed,
            inputs.images,
            inputs.fields,
            light,
            sky_variance=sky,
            model=model,
            fit=wavefront,
            mask=inputs.masks if any(m.any() for m in inputs.masks) else None,
            projection=field_projection,
            threads=threads,
            progress=stage.advance,
        )
        # Stamps that are mirrored or turned may fit the other side of focus.
        checked = fit.usable | (fit.flags & int(DonutFlag.DEFOCUS_SIGN) > 0)
        which = [int(i) for i in checked.nonzero()[0]]
        off_axis = (abs(inputs.fields[which]) > _OFF_AXIS * believed.field_radius).any()
        as_expected = fit.usable & (fit.flags & int(DonutFlag.OTHER_SIZE) == 0)
        defocused = bool(as_expected.any() or model.detector.shifts(len(fit)).any())
        if orientation_check and defocused and which and (len(which) >= _SEVERAL or off_axis):
            shifts = model.detector.shifts(len(inputs.images))[which]
            orientation = check_orientation(
                believed,
                [inputs.images[i] for i in which],
                inputs.fields[which],
                light,
                sky_variance=None if sky is None else [sky[i] for i in which],
                model=replace(model, detector=replace(model.detector, defocus=shifts)),
                mask=[inputs.masks[i] for i in which],
                projection=field_projection,
                threads=threads,
            )
    if orientation is not None and orientation.doubtful:
        fit = replace(fit, flags=fit.flags | checked * int(DonutFlag.ORIENTATION))
        print_warning(orientation_text(orientation, inputs))
    if not defocused:
        print_warning(
            "defocus is 0 um, that of the files and --defocus-um together: stars are fitted as in focus. Of donuts, "
            "give --defocus-um, DEFOC_UM or a column defocus_um"
        )
    converted = fit.zernikes_in(cast("ZernikeConvention", convention), output_frame, frames=frames)
    motions = None
    if fit.degrees_of_freedom is not None:
        motions = hexapod_corrections(
            fit.degrees_of_freedom, frame="OCS" if output_frame == "DVCS" else output_frame, frames=frames
        )
    _write(fit, converted, out, picture, kind)
    if as_json:
        print_json(fit.summary() | observatory_summary(frames, converted, motions, orientation))
    elif not quiet:
        show_fit(fit, converted, motions)


def _electrons(gain: float | None, header: HeaderValues) -> float:
    """Return electrons of a unit of the images: of the option, the header, or 1."""
    if gain is None:
        return 1.0 if header.gain is None else header.gain
    if not (isfinite(gain) and gain > 0.0):
        raise ConfigError(f"--gain = {gain}: expected electrons of a unit, above 0")
    return gain


def _require_within(option: str, value: float, bounds: tuple[float, float]) -> None:
    """Raise a ConfigError for a length of an option [um] beyond its bounds."""
    if not bounds[0] <= value <= bounds[1]:
        raise ConfigError(f"{option} = {value:g}: expected {bounds[0]:g} to {bounds[1]:g} um")


def _pixel_um(pixel_um: float | None, stated: float | None, camera: str | None) -> float:
    """Return the side of a pixel [um]: of the option, that stated [m], of the camera, or that of the LSST."""
    from ..models.camera.cameras import load_camera

    if pixel_um is not None:
        return pixel_um
    if stated is not None:
        return 1e6 * stated
    return DEFAULT_PIXEL_UM if camera is None else 1e6 * load_camera(camera).pixel_size


def _output_kind(table: Path | None, picture: Path | None) -> str:
    """Return the format of the picture; a ConfigError for names of files of other formats."""
    from ..core.files import require_writable
    from ..core.table_files import FORMATS

    kind = picture_kind(picture)
    if table is not None and table.suffix.lower() not in FORMATS:
        raise ConfigError(f"--out = {table}: expected a name that ends in {', '.join(FORMATS)}")
    if table is not None:
        require_writable(table, file=True)
    return kind


def _write(fit: DonutFit, converted: ObservatoryZernikes, table: Path | None, picture: Path | None, kind: str) -> None:
    """Write the table and the picture of a fit, where they are asked for."""
    from ..core.files import write_bytes
    from ..core.plotting import picture_bytes
    from ..core.table_files import in_format_of, write_table

    if table is not None:
        # The default is a table without a word of frames.
        plain = converted.convention == "pachon" and converted.frame == "OCS"
        wavefronts = fit.to_table() if plain else converted.in_table(fit.to_table())
        write_table(table, in_format_of(table, wavefronts))
    if picture is not None:
        write_bytes(picture, picture_bytes(fit.plot(), kind))
