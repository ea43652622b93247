"""Telescope, focal plane and atmosphere of a configuration."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..core.arguments import check_arguments
from ..core.errors import ConfigError, PachonError, PrescriptionError, error_context
from ..core.files import read_bytes
from ..core.number_text import counted
from ..core.progress import Reporter
from ..core.random_streams import stream
from ..core.units import ARCSEC
from ..models.camera.camera import Camera
from ..models.camera.focal_plane import FocalPlane
from ..models.camera.height_budget import load_budget
from ..models.camera.photometry import Band
from ..models.camera.silicon import Silicon
from ..models.io.heights.file import ENDINGS as HEIGHT_ENDINGS
from ..models.io.heights.zernike_table import AS_MEASURED
from ..models.site import Site
from ..models.telescope import Telescope
from ..raytrace.rays import field_direction
from ..sky.pointing import Pointing
from ..wavefront.aberration import ResidualWavefront
from ..wavefront.atmosphere.atmosphere import Atmosphere
from ..wavefront.atmosphere.screen_sampling import ScreenSampling
from ..wavefront.chief_rays import chief_rays
from ..wavefront.psf.engines import ENGINES
from .config import Configuration, digest
from .config_hash import hashed_content
from .defaults import resolve
from .dispersion import air_dispersion, zenith_direction
from .photometry import airmass_of, band_of, lit_fraction_on_axis
from .resolved_values import resolved_value
from .sensor.displacement import Displacement, EdgeRolloff, TreeRings
from .simulate.screen_cover import check_samples, corner_fields
from .star_list import StarList, listed_stars, pointing_of


@dataclass(frozen=True)
class Experiment:
    """Telescope, focal plane, atmosphere and settings of a run.

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
        Residual aberration of the active optics; None without.
    site : Site
        Site of the telescope.
    atmosphere_only : bool
        Whether an ideal telescope replaces the optics, at the same field angles: without the aberrations of the design,
        the CCD heights and the active optics.
    star_list : StarList or None
        Stars of the catalogue of the configuration; None where stars are drawn.
    axes_deg : float
        Angle by which the axes of positions and stamps are turned from those of the configuration's focal plane
        [deg], see :meth:`along`.
    """

    config: Configuration
    telescope: Telescope
    focal_plane: FocalPlane
    atmosphere: Atmosphere | None
    aberration: ResidualWavefront | None
    site: Site
    atmosphere_only: bool = False
    star_list: StarList | None = None
    axes_deg: float = 0.0

    def __repr__(self) -> str:
        return f"<Experiment: {self.telescope!r}, {self.focal_plane!r}, {self.config.psf.engine} engine>"

    @classmethod
    @check_arguments
    def from_config(cls, config: Configuration, folder: Path | None = None) -> Experiment:
        """Make the telescope, focal plane and atmosphere of a configuration.

        Parameters
        ----------
        config : Configuration
            Configuration; defaults need not be filled in.
        folder : Path, optional
            Folder that relative paths in the configuration start from; the current one by default.

        Raises
        ------
        PachonError
            If a name does not exist, values do not fit together, or one of the models cannot be made: one line with
            the key.
        """
        resolved = resolve(config, folder)
        config, telescope, site = resolved.config, resolved.telescope, resolved.site
        aberration = None
        if config.active_optics.residual_um > 0.0:
            rms = config.active_optics.residual_um * 1e-6
            aberration = ResidualWavefront.draw(telescope, rms, config.seed, config.atmosphere.epoch)
        check_samples(config, telescope)
        focal_plane, atmosphere = _focal_plane(config, resolved.camera), _atmosphere(config, site)
        listed = listed_stars(config, telescope, resolved.camera)
        return cls(config, telescope, focal_plane, atmosphere, aberration, site, star_list=listed)

    @property
    def camera(self) -> Camera:
        """The camera."""
        return self.focal_plane.camera

    @cached_property
    def band(self) -> Band:
        """Zero point, sky and noise of the camera in the band, at the airmass of the exposure."""
        return band_of(resolved_value(self.config.band), self.config.photometry, airmass_of(self.config.atmosphere))

    @cached_property
    def lit_fraction_on_axis(self) -> float:
        """Part of the entrance pupil that is lit on the axis, where the zero point is measured."""
        return lit_fraction_on_axis(self.telescope, float(self.wavelengths[len(self.wavelengths) // 2]))

    @property
    def wavelengths(self) -> np.ndarray:
        """Wavelengths [m]."""
        return np.array(self.config.wavelengths_nm) * 1e-9

    @property
    def pixel_size(self) -> float:
        """Pixel of the stamps [m]."""
        return resolved_value(self.config.psf.pixel_um) * 1e-6

    @property
    def pointing(self) -> Pointing | None:
        """Where the telescope looks, and its orientation on the sky; None where it does not matter."""
        return pointing_of(self.config)

    @check_arguments
    def observed_count(self, ccd: str) -> int:
        """Return the number of observed stars on a CCD."""
        return self.config.stars.observed if self.star_list is None else len(self.star_list.on(ccd)[1])

    @property
    def stamp_size(self) -> int:
        """Pixels on a side of a stamp."""
        return resolved_value(self.config.psf.stamp)

    @property
    def diffusion(self) -> float:
        """Charge diffusion, rms [m]; in silicon that of charge from the surface."""
        return resolved_value(self.config.psf.diffusion_pixels) * self.camera.pixel_size

    @property
    def silicon(self) -> Silicon | None:
        """Silicon of the CCDs; None where all light turns into charge at their surface."""
        detector = self.config.detector
        return Silicon(detector.thickness_um * 1e-6, detector.temperature_k) if detector.silicon else None

    @property
    def jitter(self) -> float:
        """Pointing of the telescope, rms along each axis [rad]."""
        return self.config.psf.jitter_arcsec * ARCSEC

    @property
    def weight_fwhm(self) -> float:
        """FWHM of the weight of the moments [rad]."""
        return resolved_value(self.config.reconstruction.weight_fwhm_arcsec) * ARCSEC

    @property
    def rotator(self) -> float:
        """Angle of the axes of the focal plane from +x towards +y of the telescope frame [rad]."""
        return math.radians(self.config.rotator_deg + self.axes_deg)

    @check_arguments
    def along(self, ccd: str) -> Experiment:
        """Return the same experiment with the axes of the focal plane turned, so that they are those of a CCD.

        A position (x, y) is then ``camera.frame(index).along_ccd(x, y)`` of the position before; light, screens and
        heights are the same. The experiment itself where the CCD is not turned.
        """
        angle = float(self.camera.rotation_deg[self.camera.ccd_index(ccd)])
        if not angle:
            return self
        return replace(
            self,
            telescope=self.telescope.with_rotator(math.radians(angle)),
            focal_plane=replace(self.focal_plane, camera=self.camera.turned(angle)),
            axes_deg=self.axes_deg + angle,
        )

    @check_arguments
    def displacements(self, name: str) -> tuple[Displacement, ...]:
        """Return the static displacements of charge on a CCD; the rings of each CCD have a phase of their own."""
        sensor, camera = self.config.sensor, self.camera
        index = camera.ccd_index(name)
        effects: list[Displacement] = []
        if sensor.tree_rings_um:
            phase = stream(self.config.seed, "tree rings", name).uniform(0.0, 2.0 * math.pi)
            along_x, along_y = (mm * 1e-3 for mm in sensor.tree_ring_center_mm)
            x, y = map(float, camera.frame(index).along_focal_plane(along_x, along_y))
            effects.append(TreeRings(sensor.tree_rings_um * 1e-6, sensor.tree_ring_period_um * 1e-6, (x, y), phase))
        if sensor.edge_rolloff_um:
            length = sensor.edge_rolloff_length_um * 1e-6
            a, b = camera.half_sizes[index].tolist()
            turn = math.radians(camera.rotation_deg[index])
            effects.append(EdgeRolloff(sensor.edge_rolloff_um * 1e-6, length, (a, b), turn))
        return tuple(effects)

    @property
    def zenith_direction(self) -> float:
        """Direction of the zenith on the sky, from +x towards +y of the telescope [rad]."""
        return zenith_direction(self.config)

    @property
    def dispersion(self) -> np.ndarray | None:
        """Shift in field angle of each wavelength by the air [rad], shape [n_wave, 2]; None where there is none.

        An ideal telescope in place of one with a corrector has a perfect one.
        """
        if self.atmosphere_only and self.telescope.dispersion_corrector is not None:
            return None
        return air_dispersion(self.config, self.site)

    @property
    def screen_kinds(self) -> tuple[str, ...]:
        """Kinds of screens that the engine keeps of the atmosphere; none where there is none."""
        return () if self.atmosphere is None else ENGINES[self.config.psf.engine].screens

    @check_arguments
    def make_screens(self, threads: int | None = None) -> None:
        """Make the screens of the atmosphere, where they are not made, as far as the CCDs of the configuration need."""
        if self.atmosphere is None or not self.screen_kinds:
            return
        rows = self.screen_rows
        for kind in self.screen_kinds:
            self.atmosphere.screens(kind, threads, rows)

    @property
    def screen_rows(self) -> np.ndarray:
        """Rows of the slopes of screens that light of the CCDs crosses, bool [n_layer, size]; none without screens."""
        if self.atmosphere is None:
            return np.zeros((0, 0), dtype=bool)
        fields = corner_fields(self.telescope, self.camera, self.config.ccds or ())
        # Half a pupil of room, for stars beyond the edges of the CCDs and the curvature of the field.
        return self.atmosphere.rows_under(field_direction(*fields.T), self.telescope.pupil_diameter)

    @contextmanager
    @check_arguments
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
                with reporter.stage(f"atmosphere: {counted(self.atmosphere.layer_count, 'screen')}"):
                    self.make_screens(threads)
            yield
        finally:
            self.atmosphere.release()

    @property
    def snaps(self) -> int:
        """Snaps that the exposure is the sum of: those of a visit of a list, else 1."""
        return 1 if self.config.visit is None else self.config.visit.snaps

    @cached_property
    def field_radius_on_detector(self) -> float:
        """Distance from the axis at which the edge of the field of view lands on the detector [m]."""
        direction = field_direction([self.telescope.field_radius], [0.0])
        landed = chief_rays(self.telescope, direction, self.telescope.default_wavelength)
        return float(np.hypot(*self.telescope.surfaces[-1].to_local(landed.position)[0, :2]))

    @cached_property
    def config_hash(self) -> str:
        """SHA-256 of all settings that affect the product of a CCD.

        The list of CCDs is left out, since no CCD depends on the others. A file named in the configuration counts by
        its content, not by its path, and so do the files that a prescription names.
        """
        return digest(hashed_content(self.config))


def _focal_plane(config: Configuration, camera: Camera) -> FocalPlane:
    plane = config.focal_plane
    if plane.heights is not None:
        with error_context(key="focal_plane"):
            focal_plane = measured_focal_plane(plane.heights, camera)
        for name in resolved_value(config.ccds):
            if not focal_plane.measured[camera.ccd_index(name)]:
                raise ConfigError(f"focal_plane.heights = {plane.heights}: no heights of {name}, one of ccds")
    elif plane.budget == "flat":
        focal_plane = FocalPlane.flat(camera)
    else:
        budget = replace(load_budget(resolved_value(plane.budget)), **plane.sizes)
        focal_plane = FocalPlane.from_budget(camera, seed=config.seed, terms=plane.terms, budget=budget)
    for name, motion in plane.moved.items():
        focal_plane = focal_plane.with_moved(
            name, dz=motion.dz_um * 1e-6, rx=motion.rx_urad * 1e-6, ry=motion.ry_urad * 1e-6
        )
    return focal_plane


def measured_focal_plane(name: str, camera: Camera) -> FocalPlane:
    """Return measured heights, of a camera as built or of a file.

    Raises
    ------
    ConfigError
        If there is no such camera as built, or it is another camera.
    PachonError
        If the file is no file of heights.
    """
    if Path(name).suffix.lower() in HEIGHT_ENDINGS:
        with error_context(key="heights"):
            content = read_bytes(Path(name), PrescriptionError)
            return _focal_plane_of_file(_HeightsFile(name, hashlib.sha256(content).hexdigest()), camera)
    if name not in AS_MEASURED:
        expected = f"{', '.join(AS_MEASURED)}, or a file ending in {', '.join(HEIGHT_ENDINGS)}"
        raise ConfigError(f"heights = {name}: expected {expected}", key="heights")
    focal_plane = FocalPlane.as_measured(name)
    if focal_plane.camera.name != camera.name:
        raise ConfigError(f"heights = {name}: expected heights of the telescope's camera, {camera.name}", key="heights")
    return focal_plane


class _HeightsFile(NamedTuple):
    """One version of a file of heights."""

    path: str
    sha256: str  #: of its content


@lru_cache(maxsize=1)
def _focal_plane_of_file(file: _HeightsFile, camera: Camera) -> FocalPlane:
    """Return the heights of a file; cached, since a fit takes seconds and the points of a sweep share it."""
    return FocalPlane.from_file(file.path, camera)


def _atmosphere(config: Configuration, site: Site) -> Atmosphere | None:
    air = config.atmosphere
    if not air.enabled:
        return None
    try:
        return Atmosphere.from_site(
            site,
            seed=config.seed,
            r0=air.r0_m,
            outer_scale=air.outer_scale_m,
            exposure=air.exposure_s,
            time_step=air.time_step_s,
            screens=ScreenSampling(screen_size=air.screen_size, screen_length=air.screen_length_m),
            ground_lift=air.ground_lift_m,
            zenith_angle=math.radians(air.zenith_angle_deg),
            epoch=air.epoch,
        )
    except PachonError as error:
        raise ConfigError(f"atmosphere: {error}") from None
