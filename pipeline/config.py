"""Configuration of a run: one YAML file, validated when it is read, every default written out when it is resolved.

Every problem is one line that names the file, the key, its value and what was expected.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import yaml
from pydantic import BeforeValidator, Field, SerializerFunctionWrapHandler, model_serializer

from ..core.arguments import check_arguments
from ..core.errors import ConfigError, shown
from ..core.schema import (
    Count,
    Fraction,
    NotNegative,
    Positive,
    Real,
    Section,
    Switch,
    Whole,
    expected,
    plain_number,
    problem,
    validated,
)
from ..core.yaml_reader import read_mapping
from ..models.camera.photometry import BandName
from ..models.io.camera_file import is_camera
from ..reconstruction.psf_model.recipe import INTERPOLATIONS, BasisName, InterpolationName, Recipe, RecipeName, names_of
from ..reconstruction.psf_model.retired_process import GaussianProcess
from ..wavefront.psf.engines import EngineName
from .named_files import read_run

_Model = TypeVar("_Model", bound=Section)
#: Values of the height budget that a resolved configuration has without their being given.
_CAMERAS_OWN = {"budget": "simulated"}
#: Key of the zenith as an angle from +x towards +y of the telescope, which ``zenith_position_angle_deg`` has replaced.
_RETIRED_ANGLE = "parallactic_angle_deg"
_Declination = Annotated[float, BeforeValidator(plain_number), Field(strict=True, ge=-90, le=90)]


def _listed(value: Any) -> Any:
    """Return a text as a list of it, and other values unchanged."""
    return [value] if isinstance(value, str) else value


class StarsConfig(Section):
    """How many stars stand on a CCD, and how bright they are."""

    truth: Count = Field(100, description="noise-free PSFs on each CCD, where no observed star is")
    observed: Count = Field(40, description="observed stars on each CCD")
    snr_min: Positive = Field(30.0, description="faintest star by its signal-to-noise ratio")
    neighbours: Fraction = Field(0.0, description="fraction of the observed stars with a neighbour on their stamp")
    cosmic_rays: Fraction = Field(0.0, description="fraction of the observed stars that a cosmic ray crosses")
    saturated: Fraction = Field(0.0, description="fraction of the observed stars, the brightest, with a saturated core")

    catalogue: str | None = Field(
        None, description="path of a table of stars to observe in place of drawn ones: .ecsv, .csv, .fits, .parquet"
    )
    columns: dict[str, str] = Field(
        default_factory=dict, description="names of its columns: {ra: RAJ2000, dec: DEJ2000, mag: rmag}"
    )
    brightest: Real | None = Field(
        None, description="brightest star of the catalogue [AB mag]; by default the one that saturates"
    )
    faintest: Real | None = Field(
        None, description="faintest star of the catalogue [AB mag]; by default that of snr_min in 0.6 arcsec"
    )


class PhotometryConfig(Section):
    """Zero point, sky and noise; by default those of the camera in the band."""

    zero_point: Real | None = Field(None, description="AB magnitude of one electron a second at airmass 1")
    dark_sky: Real | None = Field(None, description="sky [AB mag/arcsec^2]")
    extinction: NotNegative | None = Field(None, description="loss in the air [mag/airmass]")
    pixel_arcsec: Positive | None = Field(None, description="angle of a pixel of the CCDs [arcsec]")
    read_noise_e: NotNegative | None = Field(None, description="rms read noise of an exposure [electron/pixel]")
    dark_current_e_s: NotNegative | None = Field(None, description="dark current [electron/s/pixel]")
    full_well_e: Positive | None = Field(None, description="largest signal of an unsaturated pixel [electron]")
    gain: Positive | None = Field(None, description="electrons of one ADU of images")
    source: str | None = Field(None, description="where the camera's numbers are from")


class PointingConfig(Section):
    """Where the telescope looks."""

    ra_deg: Real = Field(0.0, description="right ascension of the optical axis [deg]")
    dec_deg: _Declination = Field(0.0, description="declination of the optical axis [deg]")
    position_angle_deg: Real = Field(0.0, description="of the telescope's +y, from north through east [deg]")


class MotionConfig(Section):
    """Motion of a raft or CCD as a rigid body."""

    dz_um: Real = Field(0.0, description="along +z of the detector [um]")
    rx_urad: Real = Field(0.0, description="about x; positive lifts the side at larger y [urad]")
    ry_urad: Real = Field(0.0, description="about y; positive lowers the side at larger x [urad]")


class ListedVisitConfig(Section):
    """Visit of a list, for the headers of products."""

    number: Whole = Field(description="number of the visit")
    mid_mjd: Real = Field(description="middle of the exposure [MJD, TAI]")
    snaps: Count = Field(1, description="exposures that the time is divided into")


class FocalPlaneConfig(Section):
    """Heights of the CCD surfaces (Jee & Tyson 2011, Table 1)."""

    budget: Literal["simulated", "specification", "flat"] | None = Field(
        None, description="column of Table 1 that the heights are drawn from, or flat; that of the camera by default"
    )
    global_: Switch = Field(True, alias="global", description="height of the whole focal plane")
    raft: Switch = Field(True, description="height of each raft")
    ccd: Switch = Field(True, description="height of each CCD")
    tilt: Switch = Field(True, description="tilt of each CCD")
    potato_chip: Switch = Field(True, description="waves within each CCD")
    global_um: NotNegative | None = Field(None, description="the whole plane, peak to valley, not the budget's [um]")
    raft_um: NotNegative | None = Field(None, description="rafts, peak to valley, not the budget's [um]")
    ccd_um: NotNegative | None = Field(None, description="CCDs, peak to valley, not the budget's [um]")
    tilt_urad: NotNegative | None = Field(None, description="tilts of CCDs, peak to valley, not the budget's [urad]")
    potato_chip_um: NotNegative | None = Field(None, description="waves, peak to valley, not the budget's [um]")
    potato_chip_cycles: tuple[Positive, Positive] | None = Field(
        None, description="fewest and most cycles along a CCD in place of 1 and 2"
    )
    heights: str | None = Field(
        None, description="measured heights in place of a budget: lsstcam (as built), or path of an ECSV or FITS file"
    )
    moved: dict[str, MotionConfig] = Field(
        default_factory=dict, description="rafts and CCDs moved besides: {R22: {dz_um: 5}, R21_S11: {rx_urad: 50}}"
    )

    @property
    def changed(self) -> tuple[str, ...]:
        """Keys of the height budget whose values are not the default ones."""
        defaults, values = FocalPlaneConfig().model_dump(by_alias=True), self.model_dump(by_alias=True)
        # The budget is that of the camera where none is named.
        return tuple(
            key
            for key in values
            if key not in ("heights", "moved") and values[key] not in (defaults[key], _CAMERAS_OWN.get(key))
        )

    @property
    def sizes(self) -> dict[str, Any]:
        """Sizes in place of the budget's, as :class:`~.HeightBudget` has them, in SI."""
        stated_sizes = {
            "global_height": self.global_um,
            "raft_height": self.raft_um,
            "ccd_height": self.ccd_um,
            "ccd_tilt": self.tilt_urad,
            "potato_chip": self.potato_chip_um,
        }
        sizes: dict[str, Any] = {key: value * 1e-6 for key, value in stated_sizes.items() if value is not None}
        return sizes | ({} if self.potato_chip_cycles is None else {"potato_chip_cycles": self.potato_chip_cycles})

    @property
    def terms(self) -> tuple[str, ...]:
        """Names of the terms that are switched on."""
        names = ("global", "raft", "ccd", "tilt", "potato_chip")
        return tuple(n for n in names if getattr(self, "global_" if n == "global" else n))


class ActiveOpticsConfig(Section):
    """Residual aberration that active optics leaves in each visit (0.2 um in Jee & Tyson 2011)."""

    residual_um: Annotated[float, BeforeValidator(plain_number), Field(strict=True, ge=0, le=2)] = Field(
        0.0, description="rms of the wavefront left over, over pupil and field [um]"
    )
    states: str | None = Field(
        None, description="table of states of the telescope (pachon align), of which that of the epoch is taken"
    )


class DetectorConfig(Section):
    """Silicon of the CCDs, in which red light turns into charge below the surface."""

    silicon: Switch = Field(False, description="false: all light turns into charge at the surface")
    thickness_um: Annotated[float, BeforeValidator(plain_number), Field(strict=True, ge=1, le=1000)] = Field(
        100.0, description="thickness [um]"
    )
    temperature_k: Annotated[float, BeforeValidator(plain_number), Field(strict=True, ge=100, le=350)] = Field(
        173.0, description="temperature, on which the absorption depends [K]"
    )


class AtmosphereConfig(Section):
    """Turbulence and refraction above the telescope."""

    enabled: Switch = Field(True, description="false for the optics alone")
    epoch: Whole = Field(
        0, description="number of the visit: turbulence, wind, residual aberration and noise are its own"
    )
    site: str | None = Field(
        None, description="bundled site, or path of a site file; that of the telescope by default, else cerro_pachon"
    )
    r0_m: Positive | None = Field(None, description="Fried parameter at 500 nm at the zenith [m]")
    outer_scale_m: Positive | None = Field(None, description="outer scale [m]")
    exposure_s: Positive = Field(15.0, description="exposure time [s]")
    time_step_s: Positive = Field(0.05, description="time step of the moving screens [s]")
    screen_size: Annotated[int, Field(strict=True, ge=16)] = Field(8192, description="samples on a side of a screen")
    screen_length_m: Positive = Field(1300.0, description="side of a screen [m]")
    ground_lift_m: NotNegative = Field(0.0, description="height given to a layer on the ground [m]")
    zenith_angle_deg: Annotated[float, BeforeValidator(plain_number), Field(strict=True, ge=0, le=80)] = Field(
        0.0, description="angle of the telescope from the zenith, whose airmass dims stars [deg]"
    )
    zenith_position_angle_deg: Real | None = Field(
        None, description="of the zenith, from north through east [deg]; by default it lies towards the telescope's +x"
    )
    ground_wind_m_s: tuple[Real, Real] | None = Field(
        None, description="wind of the lowest layer along x and y of the telescope, in place of the site's [m/s]"
    )

    @model_serializer(mode="wrap")
    def _without_open_wind(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Return the section without the wind where it is the site's, as in hashes from before this key."""
        content: dict[str, Any] = handler(self)
        return {key: value for key, value in content.items() if key != "ground_wind_m_s" or value is not None}


class PsfConfig(Section):
    """How point-spread functions are made."""

    engine: EngineName = Field(
        "fast",
        description="fast (geometric and filters), wave (Fourier optics), long_exposure (mean over turbulence), "
        "statistical (shapes drawn from theory, without screens; 5 s or more, no image motion, no third moments)",
    )
    n_pupil: Annotated[int, Field(strict=True, ge=10)] | None = Field(
        None, description="pupil points of the engines but wave"
    )
    pixel_um: Positive | None = Field(None, description="pixel [um]")
    stamp: Annotated[int, Field(strict=True, ge=7)] | None = Field(None, description="pixels on a side of a stamp, odd")
    diffusion_pixels: NotNegative | None = Field(
        None, description="rms of the charge diffusion, in silicon that from its surface [CCD pixels]"
    )
    jitter_arcsec: NotNegative = Field(0.0, description="rms of the telescope's pointing along each axis [arcsec]")


class SensorConfig(Section):
    """Sensor effects on images of stars; all are off by default."""

    brighter_fatter: Literal["itl", "e2v"] | None = Field(
        None, description="make of the CCDs, for the brighter-fatter effect on observed stars and images"
    )
    tree_rings_um: NotNegative = Field(0.0, description="largest displacement by tree rings [um]")
    tree_ring_period_um: Positive = Field(600.0, description="distance of the rings [um]")
    tree_ring_center_mm: tuple[Real, Real] = Field(
        (30.0, 30.0), description="axis of the rings from the centre of each CCD [mm]"
    )
    edge_rolloff_um: Real = Field(0.0, description="outward displacement at the edges of a CCD [um]")
    edge_rolloff_length_um: Positive = Field(50.0, description="distance over which it falls by e [um]")


def refuse_retired_interpolation(content: dict[str, Any]) -> None:
    """Raise the error of a section whose interpolation another one has replaced."""
    if content.get("interpolation") == GaussianProcess.name:
        raise expected(names_of(INTERPOLATIONS, GaussianProcess.name), "interpolation")


def refuse_parallactic_angle(content: dict[str, Any]) -> None:
    """Raise the error of a run that has the zenith as an angle from +x towards +y of the telescope."""
    air, aim = content.get("atmosphere"), content.get("pointing")
    if not isinstance(air, dict) or _RETIRED_ANGLE not in air:
        return
    angle, roll = air[_RETIRED_ANGLE], aim.get("position_angle_deg", 0.0) if isinstance(aim, dict) else 0.0
    numbers = all(isinstance(value, (int, float)) and math.isfinite(value) for value in (angle, roll))
    # x and y of the telescope point to the position angles roll + 90 and roll.
    value = f"{(90.0 + roll - angle) % 360.0:g}" if numbers else "90 less the angle at no roll"
    raise problem(
        f".{_RETIRED_ANGLE} = {shown(angle)}: expected zenith_position_angle_deg: {value} (from north through east); "
        "files with the old key also name CCDs of the LSST as in a mirror: see docs/howto/camera.md",
        "atmosphere",
    )


class ReconstructionConfig(Section):
    """How the PSF is measured and modelled: by a recipe, each of whose keys may be given in place of its own."""

    model: Literal["ccd", "focal_plane"] = Field(
        "ccd", description="ccd (each CCD by itself), focal_plane (one more model, of the shapes on all CCDs together)"
    )
    turbulence: Literal["exponential", "layers"] = Field(
        "exponential",
        description="its covariance in the focal-plane model: exponential (fitted, each shape by itself), layers "
        "(theory of the site's layers with fitted winds, all shapes together)",
    )
    flag_stars: Switch = Field(
        False, description="leave out stars with neighbours, cosmic rays and saturated cores, as far as they are seen"
    )
    recipe: RecipeName | None = Field(
        None,
        description="of the five keys below that are not given: kriging (of pixels), the default; paper (Jee & Tyson "
        "2011: 20 eigen-PSFs, cubic polynomials, equal weights), that of components alone",
    )
    basis: BasisName | None = Field(
        None, description="what stars are described in: pca (eigen-PSFs), pixels (each on its own), shapelets"
    )
    components: Count | None = Field(None, description="components kept on each CCD, 20 by default; none of pixels")
    interpolation: InterpolationName | None = Field(
        None,
        description="over the CCD: polynomial, kriging (one process and trend for all, with the noise of each star)",
    )
    weights: Literal["equal", "snr", "softened"] | None = Field(
        None, description="of the stars in the polynomials: equal, snr (S/N squared), softened (snr up to about 100)"
    )
    order: Whole | None = Field(
        None, description="order of the polynomials fitted to the observed stars, 3; of the trend in kriging 4"
    )
    truth_order: Whole = Field(4, description="order of the polynomials fitted to the noise-free PSFs")
    weight_fwhm_arcsec: Positive | None = Field(None, description="FWHM of the weight of the moments [arcsec]")

    @classmethod
    def check(cls, content: dict[str, Any]) -> None:
        """Raise the error of an interpolation that another one has replaced."""
        refuse_retired_interpolation(content)

    @model_serializer(mode="wrap")
    def _without_open_recipe(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Return the section without the name of a recipe where there is none: resolved, its keys stand for it."""
        content: dict[str, Any] = handler(self)
        return {key: value for key, value in content.items() if key != "recipe" or value is not None}

    @property
    def names_no_model(self) -> bool:
        """Whether neither a recipe nor one of its keys is given."""
        keys = (self.recipe, self.basis, self.components, self.interpolation, self.weights, self.order)
        return all(value is None for value in keys)

    def psf_recipe(self) -> Recipe:
        """Return the recipe of the PSF model of a CCD, with the keys that are given; ConfigError if they exclude."""
        recipe = Recipe.of(self.recipe, basis=self.basis, interpolation=self.interpolation)
        named = self.recipe or self.basis
        if self.components is not None and named and not recipe.basis.has_components:
            raise ConfigError(
                f"reconstruction.components = {self.components}: expected null with basis = {recipe.basis.name}"
            )
        if self.components is not None and not named:
            recipe = Recipe.of(n_components=self.components, interpolation=self.interpolation)
        if self.weights not in (None, "equal") and recipe.interpolation.needs_noise:
            raise ConfigError(
                f"reconstruction.weights = {self.weights}: expected equal with interpolation = "
                f"{recipe.interpolation.name}, which has the noise of each star"
            )
        return recipe.changed(n_components=self.components, order=self.order, weights=self.weights)


class Configuration(Section):
    """Settings of a run, which determine its products completely."""

    band: BandName | None = Field(None, description="filter: u, g, r, i, z or y")
    telescope: str | None = Field(None, description="bundled model (pachon info lists them), or path of a prescription")
    camera: str | None = Field(None, description="bundled camera, or path of a file, in place of the telescope's own")
    ccds: Annotated[tuple[str, ...] | None, BeforeValidator(_listed)] = Field(
        None, description="CCDs or rafts to compute; central: those in the middle of the field; all"
    )
    seed: Whole = Field(1, description="seed of all random numbers")
    changes: dict[str, Real] = Field(
        default_factory=dict, description="changes of the prescription: {M2.dz_um: 10, Camera.rx_urad: 5, M1.Z5_nm: 20}"
    )
    rotator_deg: Real = Field(0.0, description="angle of the camera, from +x towards +y of the telescope [deg]")
    pointing: PointingConfig | None = Field(
        None, description="for celestial coordinates: {ra_deg: 53.1, dec_deg: -27.8, position_angle_deg: 30}"
    )
    visit: ListedVisitConfig | None = Field(
        None, description="visit of a list, for headers: {number: 1001, mid_mjd: 61001.15, snaps: 1}"
    )
    wavelengths_nm: tuple[Positive, ...] | None = Field(None, description="wavelengths [nm]; five across the band")
    photometry: PhotometryConfig = PhotometryConfig()
    stars: StarsConfig = StarsConfig()
    focal_plane: FocalPlaneConfig = FocalPlaneConfig()
    active_optics: ActiveOpticsConfig = ActiveOpticsConfig()
    detector: DetectorConfig = DetectorConfig()
    atmosphere: AtmosphereConfig = AtmosphereConfig()
    psf: PsfConfig = PsfConfig()
    sensor: SensorConfig = SensorConfig()
    reconstruction: ReconstructionConfig = ReconstructionConfig()

    @classmethod
    def check(cls, content: dict[str, Any]) -> None:
        """Raise the error of a key that another one has replaced, with the value to write."""
        refuse_parallactic_angle(content)

    @model_serializer(mode="wrap")
    def _without_open_visit(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Return the configuration without a visit where it is of none, as in hashes from before this key."""
        content: dict[str, Any] = handler(self)
        return {key: value for key, value in content.items() if key != "visit" or value is not None}

    def as_dict(self) -> dict[str, Any]:
        """Return the configuration as plain lists, mappings and numbers, keys as in the file."""
        return self.model_dump(mode="json", by_alias=True)


def configuration_of(content: dict[str, Any], source: str) -> Configuration:
    """Return the configuration of plain mappings; ConfigError names `source`, the key and the allowed values."""
    return validated(Configuration, content, source)


@check_arguments
def load_configuration(path: Path) -> Configuration:
    """Read a configuration file; values that it leaves out stay open.

    Raises
    ------
    ConfigError
        If the file cannot be read, is not YAML, or has an unknown key or a value out of range.
    """
    return configuration_of(read_configuration(path), str(path))


def read_configuration(path: Path) -> dict[str, Any]:
    """Return the content of a configuration file; ConfigError of one line for a prescription or a camera file."""
    content = read_mapping(path, ConfigError)
    if {"surfaces", "opticalSystem"}.intersection(content):
        raise ConfigError(f"a prescription; expected a configuration, with the line telescope: {path.name}", file=path)
    if is_camera(content):
        raise ConfigError(f"a camera file; expected a configuration, a run's with camera: {path.name}", file=path)
    return content


def with_run(content: dict[str, Any], path: Path) -> dict[str, Any]:
    """Return the content of a file whose `run` is a run's configuration, or the path of its file, with the former.

    Values are checked with those of the file itself. ConfigError if the file of the run cannot be read as YAML.
    """
    run = content.get("run", {})
    if isinstance(run, str):
        run = read_run(path.parent / run, path.parent)
    return {**content, "run": run}


def section_yaml(section: Section, heading: str) -> str:
    """Return a section as a YAML file with one line of comment."""
    content = section.model_dump(mode="json", by_alias=True)
    return f"# {heading}\n" + yaml.safe_dump(content, sort_keys=False, allow_unicode=True)


def with_options(config: _Model, **options: Any) -> _Model:
    """Return the configuration with command line options in place of its values; None leaves a value as it is.

    Options are named by dotted key, dots written as two underscores: ``stars__truth=50``.
    """
    stated_options = {dotted: value for dotted, value in options.items() if value is not None}
    if not stated_options:
        return config
    content = config.model_dump(by_alias=True)
    for dotted, value in stated_options.items():
        *sections, key = dotted.split("__")
        target = content
        for section in sections:
            target = target[section]
        target[key] = value
    return validated(type(config), content, "command line")


def digest(content: Any) -> str:
    """Return the SHA-256 of a value written as canonical JSON, in hexadecimal."""
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def to_yaml(config: Configuration, heading: Sequence[str] = ()) -> str:
    """Return the configuration as a YAML file with a comment to each key."""
    lines = [f"# {line}" for line in heading]
    stated_names = [name for name in type(config).model_fields if name != "visit" or config.visit is not None]
    sections = [name for name in stated_names if isinstance(getattr(config, name), Section)]
    lines += _yaml_lines(config, [n for n in stated_names if n not in sections], "")
    for name in sections:
        section = getattr(config, name)
        lines += ["", f"# {(type(section).__doc__ or '').strip()}", f"{name}:"]
        lines += _yaml_lines(section, list(section.model_dump()), "  ")
    return "\n".join(lines) + "\n"


def _yaml_lines(section: Section, names: list[str], indent: str) -> list[str]:
    lines = []
    for name in names:
        field = type(section).model_fields[name]
        value = getattr(section, name)
        value = list(value) if isinstance(value, tuple) else value
        value = section.model_dump(mode="json", include={name})[name] if isinstance(value, dict) else value
        text = yaml.safe_dump(value, default_flow_style=True, width=2**20, allow_unicode=True)
        text = text.removesuffix("...\n").strip()
        entry = f"{indent}{field.alias or name}: {text}"
        if len(entry) > 60:
            lines += [f"{indent}# {field.description}", entry]
        else:
            lines.append(f"{entry:<34}  # {field.description}")
    return lines
