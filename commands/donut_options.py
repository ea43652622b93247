"""Options of ``pachon donuts``, in groups: those of simulations, those of fits, and those of both."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

from typer import Argument, Option

from ..core.errors import ConfigError
from . import completion
from .choices import choice, names
from .inputs import load_model
from .options import GlassCatalogues, Json, Lenient, Projection, Quiet, Threads, degrees_pair, picture_kind

if TYPE_CHECKING:
    import numpy as np

    from ..models.telescope import Telescope
    from ..raytrace.rays import Projection as FieldProjection
    from ..sensing.frames import DonutFrames, FrameName
    from ..sensing.model import DonutAir
    from ..sensing.observatory_zernikes import ZernikeConvention
    from ..sensing.stamp_headers import HeaderValues

#: Panels of the help.
_FILES = "Files and their planes"
_TELESCOPE = "Telescope, light, detector"
_FRAMES = "Frames and conventions"
_FIT = "Fit"
_SIMULATION = "Simulated donuts"
_OUTPUT = "Output"
#: Options with an opposite, whose two names are as wide as others with their values.
_CHOICES = "Diffraction and orientation"
#: Frames of field angles and of results.
FRAME_NAMES = ("OCS", "CCS", "DVCS", "ZCS", "sky")
#: Telescope where neither option nor header names one.
DEFAULT_TELESCOPE = "lsst_v3.3_r"
#: Side of a pixel where neither option nor header says it [um].
_DEFAULT_PIXEL_UM = 10.0
#: Least and greatest side of a pixel, and greatest shift of a body [um].
_PIXELS_UM = (1.0, 1e4)
_MOST_DEFOCUS_UM = 1e5
#: Least and greatest part of the air that donuts share.
_SHARED_AIR = (0.01, 0.99)


@dataclass(frozen=True)
class TelescopeOptions:
    """Files, telescope, light and detector, of fits and of simulations."""

    files: Annotated[list[Path], Argument(metavar="FILE.fits ...", help="Stamps of donuts, or images of CCDs.")]
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
    ] = None
    defocus_um: Annotated[
        float,
        Option(
            help="Shift along z of what --moved names [um], beside the file's: 1500 behind focus.",
            rich_help_panel=_TELESCOPE,
        ),
    ] = 0.0
    moved: Annotated[
        str | None,
        names(
            completion.words("Detector", "Camera", "M2"),
            metavar="NAME",
            help="Surface or group that defocus moves: Detector, Camera, M2, ...; the file's or its camera's own.",
            rich_help_panel=_TELESCOPE,
        ),
    ] = None
    wavelength_nm: Annotated[
        list[float] | None,
        Option(
            "--wavelength-nm",
            help="Wavelength [nm], once for each; the header's or the model's own by default.",
            rich_help_panel=_TELESCOPE,
        ),
    ] = None
    field_deg: Annotated[
        str | None,
        Option(
            "--field-deg",
            metavar="X,Y",
            help="Field angle of all stamps [deg], where files have none.",
            rich_help_panel=_FILES,
        ),
    ] = None
    pixel_um: Annotated[
        float | None,
        Option(help="Side of a pixel [um]; that of the headers' camera, or 10.", rich_help_panel=_TELESCOPE),
    ] = None
    outer_scale_m: Annotated[
        float, Option(help="Outer scale of the turbulence [m]; inf for Kolmogorov's.", rich_help_panel=_FIT)
    ] = 25.0
    glass_catalogue: GlassCatalogues = None
    lenient: Lenient = False
    quiet: Quiet = False

    def __post_init__(self) -> None:
        """Check ranges and the field angle."""
        _require_within("--defocus-um", self.defocus_um, (-_MOST_DEFOCUS_UM, _MOST_DEFOCUS_UM))
        if self.pixel_um is not None:
            _require_within("--pixel-um", self.pixel_um, _PIXELS_UM)
        self.field()

    def field(self) -> np.ndarray | None:
        """Return the field angle of all stamps [rad], shape [2], where there is one."""
        import numpy as np

        return None if self.field_deg is None else np.deg2rad(degrees_pair(self.field_deg, "--field-deg"))

    def load(self, default: str = DEFAULT_TELESCOPE) -> tuple[str, Telescope]:
        """Return the name of the telescope, or a default, and the telescope in focus."""
        name = self.telescope or default
        return name, load_model(name, self.lenient, self.glass_catalogue or ())

    def pixel_size(self, stated: float | None, camera: str | None) -> float:
        """Return the side of a pixel [m]: of the option, that stated [m], of the camera, or that of the LSST."""
        from ..models.camera.cameras import load_camera

        if self.pixel_um is not None:
            return 1e-6 * self.pixel_um
        if stated is not None:
            return stated
        return 1e-6 * _DEFAULT_PIXEL_UM if camera is None else load_camera(camera).pixel_size


@dataclass(frozen=True)
class StampOptions:
    """Stamps of files, their planes and their unit."""

    positions: Annotated[
        Path | None,
        Option(
            help="Table with field_x, field_y [deg], and for the image of a CCD x, y [pixels].", rich_help_panel=_FILES
        ),
    ] = None
    stamp: Annotated[
        int, Option(min=16, help="Side of the stamps cut from the image of a CCD [pixels].", rich_help_panel=_FILES)
    ] = 180
    mask: Annotated[
        Path | None, Option(help="FITS file of masks: pixels other than 0 are left out.", rich_help_panel=_FILES)
    ] = None
    variance: Annotated[
        Path | None, Option(help="FITS file of variances, in the square of the unit.", rich_help_panel=_FILES)
    ] = None
    gain: Annotated[
        float | None,
        Option(help="Electrons per unit of the images; GAIN of the header, or 1.", rich_help_panel=_FILES),
    ] = None

    def electrons(self) -> float | None:
        """Return electrons of a unit of the images of the option; None for those of the headers, or 1."""
        if self.gain is not None and not (isfinite(self.gain) and self.gain > 0.0):
            raise ConfigError(f"--gain = {self.gain}: expected electrons of a unit, above 0")
        return self.gain


@dataclass(frozen=True)
class FitOptions:
    """Noise, unknowns and checks of a fit."""

    sky_variance: Annotated[
        float | None,
        Option(
            help="Variance of sky and readout [electron^2]; of the variance plane, or measured, and the gain.",
            rich_help_panel=_FIT,
        ),
    ] = None
    saturation: Annotated[
        float | None, Option(help="Level of saturated pixels [electrons].", rich_help_panel=_TELESCOPE)
    ] = None
    terms: Annotated[int, Option("--zernikes", min=4, max=78, help="Highest Noll index.", rich_help_panel=_FIT)] = 22
    higher_order_nm: Annotated[
        float, Option(help="Rms of each Zernike of the next radial degree [nm].", rich_help_panel=_FIT)
    ] = 10.0
    exposure_s: Annotated[
        float | None,
        Option(
            help="Length of the exposure [s]: its turbulence adds to errors, and its higher terms are fitted.",
            rich_help_panel=_FIT,
        ),
    ] = None
    site: Annotated[
        str | None,
        names(
            completion.sites,
            metavar="SITE|FILE",
            help="Site of turbulence and winds; that of the telescope by default, else cerro_pachon.",
            rich_help_panel=_FIT,
        ),
    ] = None
    shared_air: Annotated[
        float | None,
        Option(
            help="Part of the air's variance that all donuts share, if known; fitted about the site's.",
            rich_help_panel=_FIT,
        ),
    ] = None
    degrees_of_freedom: Annotated[
        str | None,
        names(
            completion.degrees_of_freedom,
            metavar="lsst|FILE",
            help="Fit degrees of freedom to all donuts; prints hexapod corrections.",
            rich_help_panel=_FIT,
        ),
    ] = None
    each_alone: Annotated[
        bool,
        Option(
            "--each-alone",
            help="Fit each donut alone, even where several are given of one exposure.",
            rich_help_panel=_FIT,
        ),
    ] = False
    diffraction: Annotated[
        bool | None,
        Option(
            help="Diffraction at the rims of the pupil: by default where it fits the images better than rays do.",
            rich_help_panel=_CHOICES,
        ),
    ] = None
    orientation_check: Annotated[
        bool,
        Option(help="Warn where mirrored or turned stamps fit better; 1 to 3 s.", rich_help_panel=_CHOICES),
    ] = True
    threads: Threads = None

    def check(self) -> None:
        """Check a range, and that options go together."""
        if self.shared_air is not None:
            _require_within("--shared-air", self.shared_air, _SHARED_AIR, unit="")
        if self.each_alone and self.degrees_of_freedom is not None:
            raise ConfigError("--each-alone and --degrees-of-freedom: expected one of them")

    @property
    def noll(self) -> range:
        """Noll indices of the wavefront."""
        return range(4, self.terms + 1)

    def air(self, telescope: Telescope, outer_scale: float) -> DonutAir:
        """Return the air in front of a telescope, of an outer scale [m]: its turbulence where the exposure is known."""
        from ..sensing.model import DonutAir
        from ..wavefront.atmosphere.atmosphere import Atmosphere

        air = DonutAir(outer_scale=outer_scale, site=self.site, shared=self.shared_air)
        if self.exposure_s is None:
            return air
        return replace(air, atmosphere=Atmosphere.from_site(air.layers(telescope), 0, exposure=self.exposure_s))


@dataclass(frozen=True)
class FrameOptions:
    """Frames of stamps, field angles and results; angles in place of those of headers."""

    stamp_axes: Annotated[
        str | None,
        names(
            completion.words("DVCS", "x,y", "y,x", "-x,y", "x,-y", "-x,-y"),
            metavar="X,Y",
            help="Axes of the camera along columns and rows of stamps: x,y, -y,x...; DVCS (LSST's images, y,x). "
            "By default those of the headers' detector, or x,y.",
            rich_help_panel=_FRAMES,
        ),
    ] = None
    rotator_deg: Annotated[
        float | None,
        Option(
            help="Camera from +x towards +y of the telescope (rotTelPos) [deg]; the header's, or 0.",
            rich_help_panel=_FRAMES,
        ),
    ] = None
    parallactic_deg: Annotated[
        float | None,
        Option(
            help="Position angle of the telescope's +y, north through east: Rubin's parallactic angle [deg].",
            rich_help_panel=_FRAMES,
        ),
    ] = None
    field_frame: Annotated[str, choice(FRAME_NAMES, help="Frame of field angles given.", rich_help_panel=_FRAMES)] = (
        "OCS"
    )
    frame: Annotated[
        str, choice(FRAME_NAMES, help="Frame of results; OCS is the telescope's.", rich_help_panel=_FRAMES)
    ] = "OCS"
    convention: Annotated[
        str,
        choice(
            ("pachon", "ts_wep", "donut"),
            help="Zernikes of results: pachon (nm), ts_wep (um), donut (DECam's, circular, waves of 700 nm).",
            rich_help_panel=_FRAMES,
        ),
    ] = "pachon"
    projection: Projection = "zemax"

    @property
    def names(self) -> tuple[FrameName, FrameName]:
        """Frames of field angles given, and of results."""
        return cast("FrameName", self.field_frame), cast("FrameName", self.frame)

    @property
    def zernike_convention(self) -> ZernikeConvention:
        """Convention of the Zernikes of results."""
        return cast("ZernikeConvention", self.convention)

    @property
    def field_projection(self) -> FieldProjection:
        """Meaning of field angles."""
        return cast("FieldProjection", self.projection)

    def frames(self, header: HeaderValues) -> DonutFrames:
        """Return angles and axes, those of headers where no option gives them."""
        import numpy as np

        from ..sensing.frames import DonutFrames

        rotator = header.rotator or 0.0 if self.rotator_deg is None else np.deg2rad(self.rotator_deg)
        parallactic = header.parallactic_angle if self.parallactic_deg is None else np.deg2rad(self.parallactic_deg)
        for option, value in (("--rotator-deg", rotator), ("--parallactic-deg", parallactic)):
            if value is not None and not np.isfinite(value):
                raise ConfigError(f"{option} = {value}: expected a finite number of degrees")
        if "sky" in self.names and parallactic is None:
            raise ConfigError("frame sky without a parallactic angle: expected --parallactic-deg")
        try:
            return DonutFrames(rotator, parallactic, self.stamp_axes or "x,y")
        except ConfigError as error:
            raise error.renamed("--stamp-axes") from None


@dataclass(frozen=True)
class SimulationOptions:
    """Simulated donuts in place of a fit."""

    simulate: Annotated[
        bool,
        Option("--simulate", help="Write FILE.fits with donuts of the telescope instead.", rich_help_panel=_SIMULATION),
    ] = False
    perturb: Annotated[
        list[str] | None,
        names(
            completion.motions,
            metavar="BODY.MOTION=SIZE",
            help="Of --simulate, what is wrong with the telescope: M2.dx=200um.",
            rich_help_panel=_SIMULATION,
        ),
    ] = None
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
    ] = None


@dataclass(frozen=True)
class OutputOptions:
    """Table, picture and JSON of a fit."""

    out: Annotated[
        Path | None,
        Option("--out", "-o", "--table", help="Table: .ecsv, .fits, .csv or .parquet.", rich_help_panel=_OUTPUT),
    ] = None
    picture: Annotated[
        Path | None,
        Option(help="Picture of the first six donuts: .png, .pdf or .svg; none by default.", rich_help_panel=_OUTPUT),
    ] = None
    no_picture: Annotated[bool, Option("--no-picture", help="Draw no picture.", rich_help_panel=_OUTPUT)] = False
    as_json: Json = False

    @property
    def picture_path(self) -> Path | None:
        """Picture to write."""
        return None if self.no_picture else self.picture

    def kind_of_picture(self) -> str:
        """Return the format of the picture; a ConfigError for names of files of other formats."""
        from ..core.files import require_writable
        from ..core.table_files import FORMATS

        kind = picture_kind(self.picture, self.no_picture)
        if self.out is not None and self.out.suffix.lower() not in FORMATS:
            raise ConfigError(f"--out = {self.out}: expected a name that ends in {', '.join(FORMATS)}")
        if self.out is not None:
            require_writable(self.out, file=True)
        return kind


def _require_within(option: str, value: float, bounds: tuple[float, float], unit: str = " um") -> None:
    """Raise a ConfigError for a number of an option beyond its bounds."""
    if not bounds[0] <= value <= bounds[1]:
        raise ConfigError(f"{option} = {value:g}: expected {bounds[0]:g} to {bounds[1]:g}{unit}")
