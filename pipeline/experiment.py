"""From a configuration to the telescope, focal plane and atmosphere that it names, with every default filled in."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TypeVar

import numpy as np
from pydantic import BaseModel

from ..core.errors import ConfigError, PachonError
from ..core.progress import Reporter
from ..design.parameters.changes import apply_changes
from ..models.camera.camera import Camera, load_camera
from ..models.camera.focal_plane import FocalPlane
from ..models.camera.height_budget import load_budget
from ..models.io.prescription import ENDINGS, bundled_names, load_telescope
from ..models.site import Site, load_site
from ..models.telescope import Telescope
from ..raytrace.rays import field_direction
from ..wavefront.aberration import ResidualWavefront
from ..wavefront.atmosphere.atmosphere import Atmosphere
from ..wavefront.atmosphere.refraction import dispersion_shift
from ..wavefront.psf.fast import PUPIL_POINTS, PUPIL_POINTS_STILL
from ..wavefront.psf.long_exposure import PUPIL_POINTS as PUPIL_POINTS_LONG
from ..wavefront.psf.psf import SCREENS
from ..wavefront.pupil_optics import chief_rays
from .config import BandName, Configuration, digest
from .psf_model.fit import COMPONENTS
from .psf_model.polynomial import term_count
from .simulate.photometry import ARCSEC
from .simulate.screen_cover import check_screens

#: The middle row of three rafts: from the centre of the field to its edge, with a neighbour on either side.
DEFAULT_CCDS = tuple(f"R2{raft}_S1{column}" for raft in "234" for column in "012")
#: Pixel of the camera's CCDs, of which charge diffusion is a fraction [m].
CCD_PIXEL = 10e-6
_WAVELENGTHS = 5
# The optics alone are seen as the paper's Fig. 8 has them: without charge diffusion, which would hide most of their
# ellipticity, and on pixels fine enough for a weight of 0.3".
_WITH_ATMOSPHERE = {"n_pupil": PUPIL_POINTS, "pixel_um": 10.0, "stamp": 31, "diffusion_pixels": 0.4}
_OPTICS_ALONE = {"n_pupil": PUPIL_POINTS_STILL, "pixel_um": 2.5, "stamp": 61, "diffusion_pixels": 0.0}
_ENGINE_DEFAULTS: dict[str, dict[str, float]] = {"long_exposure": {"n_pupil": PUPIL_POINTS_LONG}}
_T = TypeVar("_T")
_Model = TypeVar("_Model", bound=BaseModel)


@dataclass(frozen=True)
class Experiment:
    """All that a run needs to compute any CCD.

    Attributes
    ----------
    config : Configuration
        Resolved configuration.
    telescope : Telescope
        Prescription.
    focal_plane : FocalPlane
        CCD heights.
    atmosphere : Atmosphere or None
        Turbulence; None for the optics alone.
    aberration : ResidualWavefront or None
        What active optics leaves uncorrected; None for nothing.
    site : Site
        Where the telescope stands.
    air_alone : bool
        Whether stars are seen through a beam without aberrations, from the same places on the sky: without what the
        design of the telescope, the heights and active optics do.
    """

    config: Configuration
    telescope: Telescope
    focal_plane: FocalPlane
    atmosphere: Atmosphere | None
    aberration: ResidualWavefront | None
    site: Site
    air_alone: bool = False

    @property
    def camera(self) -> Camera:
        """The camera."""
        return self.focal_plane.camera

    @property
    def wavelengths(self) -> np.ndarray:
        """Wavelengths [m]."""
        return np.array(self.config.wavelengths_nm) * 1e-9

    @property
    def pixel_size(self) -> float:
        """Pixel of the stamps [m]."""
        return _given(self.config.psf.pixel_um) * 1e-6

    @property
    def stamp_size(self) -> int:
        """Pixels on a side of a stamp."""
        return _given(self.config.psf.stamp)

    @property
    def diffusion(self) -> float:
        """Charge diffusion, rms [m]."""
        return _given(self.config.psf.diffusion_pixels) * CCD_PIXEL

    @property
    def jitter(self) -> float:
        """Pointing of the telescope, rms along each axis [rad]."""
        return self.config.psf.jitter_arcsec * ARCSEC

    @property
    def weight_fwhm(self) -> float:
        """FWHM of the weight of the moments [rad]."""
        return _given(self.config.reconstruction.weight_fwhm_arcsec) * ARCSEC

    @property
    def dispersion(self) -> np.ndarray | None:
        """Shift in field angle of each wavelength by the air [rad], shape [n_wave, 2]; None without an atmosphere."""
        settings = self.config.atmosphere
        if not settings.enabled:
            return None
        middle = float(self.wavelengths[len(self.wavelengths) // 2])
        return dispersion_shift(
            self.wavelengths,
            middle,
            math.radians(settings.zenith_angle_deg),
            math.radians(settings.parallactic_angle_deg),
            self.site.weather,
        )

    @property
    def screen_kinds(self) -> tuple[str, ...]:
        """Kinds of screens that the engine keeps of the atmosphere; none where there is none."""
        return () if self.atmosphere is None else SCREENS[self.config.psf.engine]

    @contextmanager
    def screens(self, threads: int | None = None, reporter: Reporter | None = None) -> Iterator[None]:
        """Make all screens of the atmosphere, and release them at the end of the ``with`` block.

        Parameters
        ----------
        threads : int, optional
            Number of threads; all processors by default. No byte depends on it.
        reporter : Reporter, optional
            Progress display; silent by default.
        """
        if self.atmosphere is None:
            yield
            return
        try:
            if self.screen_kinds:
                reporter = Reporter(quiet=True) if reporter is None else reporter
                with reporter.stage(f"atmosphere: {self.atmosphere.layer_count} screens"):
                    for kind in self.screen_kinds:
                        self.atmosphere.screens(kind, threads)
            yield
        finally:
            self.atmosphere.release()

    @cached_property
    def field_radius_on_detector(self) -> float:
        """Distance from the axis at which the edge of the field of view lands on the detector [m]."""
        direction = field_direction([self.telescope.field_radius], [0.0])
        landed = chief_rays(self.telescope, direction, self.telescope.default_wavelength)
        return float(np.hypot(*self.telescope.surfaces[-1].to_local(landed.position)[0, :2]))

    @cached_property
    def config_hash(self) -> str:
        """SHA-256 of all that decides the bytes of a CCD's product.

        The list of CCDs is left out, since no CCD depends on which others are asked for; a file that the configuration
        names counts by its content, not by where it lies.
        """
        content = self.config.as_dict()
        del content["ccds"]
        content["telescope"] = _name_or_content(_given(self.config.telescope), bundled_names())
        content["atmosphere"]["site"] = _name_or_content(self.config.atmosphere.site, ())
        return digest(content)


def resolve(config: Configuration, folder: Path | None = None) -> Configuration:
    """Fill in every default that depends on other values, and check what only several values together can show.

    Parameters
    ----------
    config : Configuration
        What the file and the command line say.
    folder : Path, optional
        Folder that relative paths in the configuration start from; the current one by default.

    Raises
    ------
    ConfigError, UnknownNameError, PrescriptionError, DomainError
        If a name does not exist, or values do not fit together.
    """
    name, band = config.telescope, config.band
    if name is None:
        band = band or "r"
        name = f"lsst_v3.3_{band}"
    else:
        name = _absolute(name, folder, bundled_names())
        band = band or _band_of(name)
    telescope = load_telescope(name)
    if telescope.camera is None:
        raise ConfigError(f"telescope = {name}: expected a model with a camera, such as lsst_v3.3_{band}")
    camera = load_camera(telescope.camera)
    atmosphere = config.atmosphere
    site_name = _absolute(atmosphere.site, folder, ())
    site = load_site(site_name)
    wavelengths = config.wavelengths_nm
    if wavelengths is None:
        low, high = telescope.band or telescope.wavelength_range
        wavelengths = tuple(round(float(w) * 1e9, 3) for w in np.linspace(low, high, _WAVELENGTHS))
    resolved = config.model_copy(
        update={
            "band": band,
            "telescope": name,
            "ccds": chosen_ccds(camera, DEFAULT_CCDS if config.ccds is None else config.ccds),
            "wavelengths_nm": wavelengths,
            "atmosphere": _filled(
                atmosphere.model_copy(update={"site": site_name}),
                {"r0_m": float(site.r0), "outer_scale_m": float(site.outer_scale)},
            ),
            "psf": _filled(
                config.psf,
                (_WITH_ATMOSPHERE if atmosphere.enabled else _OPTICS_ALONE)
                | _ENGINE_DEFAULTS.get(config.psf.engine, {}),
            ),
            "reconstruction": _filled(
                config.reconstruction,
                {
                    "weight_fwhm_arcsec": 0.7 if atmosphere.enabled else 0.3,
                    "components": None if config.reconstruction.basis == "pixels" else COMPONENTS,
                    "order": 3 if config.reconstruction.interpolation == "polynomial" else 0,
                },
            ),
        }
    )
    _check(resolved, apply_changes(telescope, resolved.changes))
    check_screens(resolved, telescope, camera, site)
    return resolved


def prepare(config: Configuration) -> Experiment:
    """Make the telescope, the focal plane and the atmosphere of a resolved configuration.

    Raises
    ------
    PachonError
        If one of them cannot be made: one line that says where in the configuration.
    """
    telescope = apply_changes(load_telescope(_given(config.telescope)), config.changes)
    camera = load_camera(_given(telescope.camera))
    site = load_site(config.atmosphere.site)
    plane = config.focal_plane
    if plane.budget == "flat":
        focal_plane = FocalPlane.flat(camera)
    else:
        budget = replace(load_budget(plane.budget), **plane.sizes)
        focal_plane = FocalPlane.from_budget(camera, seed=config.seed, terms=plane.terms, budget=budget)
    for name, motion in plane.moved.items():
        focal_plane = focal_plane.with_moved(
            name, dz=motion.dz_um * 1e-6, rx=motion.rx_urad * 1e-6, ry=motion.ry_urad * 1e-6
        )
    atmosphere = None
    air = config.atmosphere
    if air.enabled:
        try:
            atmosphere = Atmosphere.from_site(
                site,
                seed=config.seed,
                r0=air.r0_m,
                outer_scale=air.outer_scale_m,
                exposure=air.exposure_s,
                time_step=air.time_step_s,
                screen_size=air.screen_size,
                screen_length=air.screen_length_m,
                ground_lift=air.ground_lift_m,
                zenith_angle=math.radians(air.zenith_angle_deg),
                epoch=air.epoch,
            )
        except PachonError as error:
            raise ConfigError(f"atmosphere: {error}") from None
    aberration = None
    if config.active_optics.residual_um > 0.0:
        rms = config.active_optics.residual_um * 1e-6
        aberration = ResidualWavefront.draw(telescope, rms, config.seed, air.epoch)
    return Experiment(config, telescope, focal_plane, atmosphere, aberration, site)


def truth_components(config: Configuration) -> int:
    """Return how many principal components describe the noise-free PSFs of a resolved configuration."""
    components = config.reconstruction.components
    return min(COMPONENTS, config.stars.truth - 1) if components is None else components


def chosen_ccds(camera: Camera, names: Iterable[str]) -> tuple[str, ...]:
    """Return the names of CCDs in the order of the camera, each once; rafts and ``all`` stand for all of theirs.

    Raises
    ------
    UnknownNameError
        If there is no such CCD or raft; the nearest names are offered.
    ConfigError
        If none is given.
    """
    indices: set[int] = set()
    for name in names:
        if name == "all":
            indices.update(range(len(camera)))
        elif "_" not in name:
            indices.update(camera.ccd_index(n) for n in camera.ccds_of_raft(name))
        else:
            indices.add(camera.ccd_index(name))
    if not indices:
        raise ConfigError("ccds = []: expected at least one name, such as R22_S11, or all")
    return tuple(camera.ccd_names[i] for i in sorted(indices))


def _check(config: Configuration, telescope: Telescope) -> None:
    """Check what several values must be together."""
    for i, wavelength in enumerate(_given(config.wavelengths_nm)):
        low, high = (1e9 * w for w in telescope.wavelength_range)
        if not low <= wavelength <= high:
            raise ConfigError(
                f"wavelengths_nm[{i}] = {wavelength:g}: expected {low:g} to {high:g}, which {telescope.name} covers"
            )
    if not config.wavelengths_nm:
        raise ConfigError("wavelengths_nm = []: expected at least one wavelength in nm")
    if _given(config.psf.stamp) % 2 == 0:
        raise ConfigError(f"psf.stamp = {config.psf.stamp}: expected an odd number of pixels")
    fit, stars = config.reconstruction, config.stars
    if fit.basis == "pixels" and fit.components is not None:
        raise ConfigError(f"reconstruction.components = {fit.components}: expected null with basis = pixels")
    if fit.interpolation == "gp" and fit.weights != "equal":
        raise ConfigError(f"reconstruction.weights = {fit.weights}: expected equal with interpolation = gp")
    for kind in ("observed", "truth"):
        count = getattr(stars, kind)
        # The noise-free PSFs are always described by principal components.
        components = truth_components(config) if kind == "truth" else fit.components
        if components is not None and components > count - 1 and (kind == "truth" or fit.basis == "pca"):
            raise ConfigError(
                f"reconstruction.components = {components}: expected at most {count - 1}, one less than "
                f"stars.{kind} = {count}"
            )
        key = "order" if kind == "observed" else "truth_order"
        terms = term_count(getattr(fit, key))
        if terms > count:
            raise ConfigError(
                f"reconstruction.{key} = {getattr(fit, key)}: its {terms} terms need as many stars, "
                f"stars.{kind} = {count}"
            )
    if config.focal_plane.budget == "flat" and config.focal_plane.sizes:
        raise ConfigError(
            "focal_plane.budget = flat: expected simulated or specification where sizes of its terms are given"
        )
    if config.psf.engine == "long_exposure" and not config.atmosphere.enabled:
        raise ConfigError("psf.engine = long_exposure: expected atmosphere.enabled = true, whose mean it takes")
    if config.atmosphere.time_step_s > config.atmosphere.exposure_s:
        raise ConfigError(
            f"atmosphere.time_step_s = {config.atmosphere.time_step_s:g}: expected at most the exposure, "
            f"atmosphere.exposure_s = {config.atmosphere.exposure_s:g}"
        )


def _given(value: _T | None) -> _T:
    """Return a value that a resolved configuration always has."""
    if value is None:
        raise ConfigError("the configuration is not resolved")
    return value


def _filled(section: _Model, defaults: Mapping[str, object]) -> _Model:
    """Return a section with defaults in place of what was left open."""
    return section.model_copy(update={key: v for key, v in defaults.items() if getattr(section, key) is None})


def _band_of(name: str) -> BandName:
    """Return the band that the name of a model ends in, such as lsst_v3.3_i; r where it does not."""
    ending = Path(name).stem.rpartition("_")[2] if Path(name).suffix.lower() in ENDINGS else name.rpartition("_")[2]
    bands: dict[str, BandName] = {"u": "u", "g": "g", "r": "r", "i": "i", "z": "z", "y": "y"}
    return bands.get(ending, "r")


def _absolute(name: str, folder: Path | None, bundled: Sequence[str]) -> str:
    """Return a bundled name as it is, and the path of a file as an absolute one."""
    if name in bundled or Path(name).suffix.lower() not in ENDINGS:
        return name
    return str(((folder or Path()) / name).resolve())


def _name_or_content(name: str, bundled: Sequence[str]) -> str:
    """Return a bundled name, or the hash of the file of that name."""
    if name in bundled or Path(name).suffix.lower() not in ENDINGS:
        return name
    return hashlib.sha256(Path(name).read_bytes()).hexdigest()
