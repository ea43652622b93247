"""Defaults of a configuration that depend on telescope, camera and site."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from pydantic import BaseModel

from ..core.errors import ConfigError, error_context
from ..core.table_files import ENDINGS as STAR_ENDINGS
from ..core.units import ARCSEC
from ..models.camera.camera import Camera
from ..models.camera.cameras import CAMERAS, load_camera
from ..models.camera.cameras import ENDINGS as CAMERA_ENDINGS
from ..models.camera.photometry import nearest_band
from ..models.io.bundled import BUNDLED
from ..models.io.heights.file import ENDINGS as HEIGHT_ENDINGS
from ..models.io.heights.zernike_table import AS_MEASURED
from ..models.io.prescription import ENDINGS, load_telescope
from ..models.io.site_file import load_site
from ..models.parameters.changes import apply_changes
from ..models.site import Site
from ..models.telescope import Telescope
from ..raytrace.ideal_lens import require_image
from ..reconstruction.psf_model.basis import COMPONENTS
from ..sky.visit_list.seeing import seeing_width
from ..wavefront.psf.engines import ENGINES
from ..wavefront.psf.fast import PUPIL_POINTS, PUPIL_POINTS_STILL, FastEngine
from ..wavefront.psf.long_exposure import LongExposureEngine
from .alignment_states import ENDINGS as STATE_ENDINGS
from .alignment_states import with_active_optics_state
from .band_focus import refocus, wavelengths_of_band
from .config import AtmosphereConfig, BandName, Configuration, PsfConfig, ReconstructionConfig
from .config_checks import WEIGHT_PIXELS, check_combinations
from .dispersion import with_dispersion_corrected
from .photometry import airmass_of, band_of, pixel_angle, resolved_photometry
from .resolved_values import resolved_value
from .simulate.photometry import PROVISIONAL_FWHM, limiting_magnitude, saturation_magnitude
from .simulate.screen_cover import check_screens, corner_fields

#: Name that stands for the CCDs in the middle of the field.
CENTRAL = "central"
#: Largest number of CCDs of a camera that is computed whole by default.
_FEW = 9
#: Site of telescopes that name none.
SITE = "cerro_pachon"
# The optics alone as in Fig. 8 of Jee & Tyson 2011: without charge diffusion, which would dilute most of their
# ellipticity, and on pixels fine enough for a weight of 0.3", a quarter of those of the CCDs.
_WITH_ATMOSPHERE = {"n_pupil": PUPIL_POINTS, "diffusion_pixels": 0.4}
_OPTICS_ALONE = {"n_pupil": PUPIL_POINTS_STILL, "diffusion_pixels": 0.0}
_FINE = 4
# FWHM of the weight of the moments with an atmosphere [arcsec] (Jee & Tyson 2011, sec. 3); where pixels are coarse,
# WEIGHT_PIXELS of them, or the moments would be sums over one or two pixels.
_WEIGHT = 0.7
# FWHM of the weight of the moments without an atmosphere [arcsec], as above.
_WEIGHT_ALONE = 0.3
# Side of a stamp with an atmosphere [arcsec], 31 pixels of the LSST.
_SIDE = 6.2
# Least side in widths of the seeing: half of it makes rms widths 1 % too large, this 0.1 %.
_SEEINGS = 5.0
# Largest side of a stamp in wide seeing, over that above.
_LARGEST = 3.0
# Side of a stamp without an atmosphere [arcsec], 61 fine pixels.
_SIDE_ALONE = 3.05
# Fewest pixels on a side of a stamp.
_FEWEST = 15
_Model = TypeVar("_Model", bound=BaseModel)


@dataclass(frozen=True)
class ResolvedConfiguration:
    """Configuration without open values, and the models that it names."""

    config: Configuration  #: every default filled in, paths absolute
    telescope: Telescope  #: changes applied, dispersion corrected, camera rotated
    camera: Camera
    site: Site  #: of the atmosphere


def resolve(config: Configuration, folder: Path | None = None) -> ResolvedConfiguration:
    """Fill in every default, and check values that depend on each other; a resolved configuration stays as it is.

    Relative paths start from `folder`, by default the current one. A name that does not exist, or values that do not
    fit together, raise ConfigError, UnknownNameError, PrescriptionError or DomainError.
    """
    name, band = config.telescope, config.band
    if name is None:
        name = f"lsst_v3.3_{band or 'r'}"
    name = _absolute_path(name, folder, BUNDLED)
    with error_context(key=None if config.telescope is None else "telescope"):
        telescope = load_telescope(name)
    named_band = _band_of(name, telescope)
    of_band = f"{name.removesuffix(f'_{named_band}')}_{band}"
    if name != of_band and of_band in BUNDLED:
        raise ConfigError(f"band = {band}: telescope {name} has filter {named_band}; expected {of_band}", key="band")
    camera_name = None
    if config.camera is not None:
        camera_name = _absolute_path(config.camera, folder, CAMERAS, CAMERA_ENDINGS)
    camera = _camera_of(telescope, camera_name)
    ends = telescope.band or telescope.wavelength_range
    changes = config.changes
    # The light of another filter than that of the model, or of one filter where the model has none.
    if band is not None and (band != named_band or ends == telescope.wavelength_range):
        prescribed, ends = telescope.band or (telescope.default_wavelength,) * 2, camera.photometry.edges(band)
        changes = changes | refocus(telescope, camera, ends, prescribed, changes)
    band = band or named_band
    atmosphere = config.atmosphere
    site_name = _absolute_path(atmosphere.site or telescope.site or SITE, folder, ())
    plane = config.focal_plane
    if plane.heights is not None:
        heights = _absolute_path(plane.heights, folder, tuple(AS_MEASURED), HEIGHT_ENDINGS)
        plane = plane.model_copy(update={"heights": heights})
    elif plane.budget is None:
        plane = plane.model_copy(update={"budget": camera.height_budget})
    active = config.active_optics
    if active.states is not None:
        active = active.model_copy(update={"states": _absolute_path(active.states, folder, (), STATE_ENDINGS)})
    with error_context(key=None if atmosphere.site is None else "atmosphere.site"):
        site = load_site(site_name)
    site = _with_ground_wind(site, atmosphere.ground_wind_m_s)
    atmosphere = _with_defaults(
        atmosphere.model_copy(update={"site": site_name}),
        {"r0_m": float(site.r0), "outer_scale_m": float(site.outer_scale)},
    )
    stars, light = config.stars, resolved_photometry(config.photometry, telescope, camera, band, ends)
    if stars.catalogue is not None:
        width, seconds, measured = PROVISIONAL_FWHM, atmosphere.exposure_s, band_of(band, light, airmass_of(atmosphere))
        stars = _with_defaults(
            stars.model_copy(update={"catalogue": _absolute_path(stars.catalogue, folder, (), STAR_ENDINGS)}),
            {
                "brightest": round(saturation_magnitude(measured, seconds, width), 3),
                "faintest": round(limiting_magnitude(stars.snr_min, measured, seconds, width), 3),
            },
        )
    wavelengths = config.wavelengths_nm
    if wavelengths is None:
        dispersed = atmosphere.enabled and atmosphere.zenith_angle_deg > 0.0
        wavelengths = tuple(round(float(w) * 1e9, 3) for w in wavelengths_of_band(ends, dispersed=dispersed))
    psf = _with_defaults(
        config.psf,
        (_WITH_ATMOSPHERE | _pupil_points(config.psf, telescope) if atmosphere.enabled else _OPTICS_ALONE)
        | _stamp_geometry(config.psf.stamp, atmosphere, telescope, camera),
    )
    resolved = config.model_copy(
        update={
            "band": band,
            "telescope": name,
            "camera": camera_name,
            "ccds": chosen_ccds(camera, default_ccds(camera) if config.ccds is None else config.ccds),
            "wavelengths_nm": wavelengths,
            "changes": changes,
            "photometry": light,
            "stars": stars,
            "focal_plane": plane,
            "active_optics": active,
            "atmosphere": atmosphere,
            "psf": psf,
            "reconstruction": _reconstruction(
                config.reconstruction, _moment_weight(atmosphere.enabled, psf, telescope)
            ),
        }
    )
    check_combinations(resolved, telescope, _pixel_arcsec(resolved.psf, telescope))
    telescope = configured_telescope(telescope, resolved, site)
    # Stars may fall anywhere on a CCD: all of it must be within the field.
    corner_fields(telescope, camera, resolved.ccds or ())
    check_screens(resolved, telescope, camera, site)
    return ResolvedConfiguration(resolved, telescope, camera, site)


def _with_ground_wind(site: Site, wind: tuple[float, float] | None) -> Site:
    """Return the site with another wind in its lowest layer, along x and y of the telescope [m/s]."""
    if wind is None:
        return site
    return site.with_layers(
        wind_speeds=(math.hypot(*wind), *site.wind_speeds[1:]),
        wind_directions=(math.atan2(wind[1], wind[0]), *site.wind_directions[1:]),
    )


def _pupil_points(psf: PsfConfig, telescope: Telescope) -> dict[str, float]:
    """Return the points of the pupil, with an atmosphere, of engines in which they depend on the telescope."""
    engine = ENGINES[psf.engine]
    return {"n_pupil": engine.default_points(telescope)} if issubclass(engine, FastEngine | LongExposureEngine) else {}


def _reconstruction(fit: ReconstructionConfig, weight_fwhm_arcsec: float) -> ReconstructionConfig:
    """Return the section with every key of its recipe written out, in place of the recipe's name."""
    recipe = fit.psf_recipe()
    return _with_defaults(
        fit.model_copy(
            update={
                "recipe": None,
                "basis": recipe.basis.name,
                "components": recipe.basis.n_components,
                "interpolation": recipe.interpolation.name,
                "weights": recipe.weights,
                "order": recipe.interpolation.order,
            }
        ),
        {"weight_fwhm_arcsec": weight_fwhm_arcsec},
    )


def with_paper_model(config: Configuration) -> Configuration:
    """Return the configuration with the PSF model of Jee & Tyson 2011 for each CCD where it names none.

    With few stars, it has as many components as they determine.
    """
    fit = config.reconstruction
    if not fit.names_no_model:
        return config
    components = max(1, min(COMPONENTS, config.stars.truth - 1, config.stars.observed - 1))
    return config.model_copy(
        update={"reconstruction": fit.model_copy(update={"recipe": "paper", "components": components})}
    )


def _camera_of(telescope: Telescope, name: str | None) -> Camera:
    """Return the camera of a name or file, by default that of the telescope.

    ConfigError where there is none, DomainError where the telescope is afocal.
    """
    require_image(telescope, "a camera")
    camera_name = name or telescope.camera
    if camera_name is None:
        raise ConfigError(
            f"telescope = {telescope.name}, which has none: expected a camera: {', '.join(CAMERAS)}, or a file, "
            "e.g. camera: hsc"
        )
    with error_context(key="camera"):
        return load_camera(camera_name)


def _stamp_geometry(stamp: int | None, air: AtmosphereConfig, telescope: Telescope, camera: Camera) -> dict[str, float]:
    """Return the default pixels [um] and, where it is open, side of stamps, as large on the sky as those of the LSST.

    Those of wide PSFs are larger: light beyond the rim wraps around.
    """
    side, fine = (_SIDE * ARCSEC, 1) if air.enabled else (_SIDE_ALONE * ARCSEC, _FINE)
    pixel = camera.pixel_size / fine
    geometry: dict[str, float] = {"pixel_um": round(pixel * 1e6, 9)}
    if stamp is None:
        if air.enabled:
            r0, outer_scale = (np.array(resolved_value(value)) for value in (air.r0_m, air.outer_scale_m))
            seeing = float(seeing_width(r0, outer_scale)) * airmass_of(air) ** 0.6
            side = min(max(side, _SEEINGS * seeing), _LARGEST * side)
        pixels = side / pixel_angle(telescope, pixel)
        geometry["stamp"] = max(2 * round(0.5 * (pixels - 1.0)) + 1, _FEWEST)
    return geometry


def _pixel_arcsec(psf: PsfConfig, telescope: Telescope) -> float:
    return pixel_angle(telescope, resolved_value(psf.pixel_um) * 1e-6) / ARCSEC


def _moment_weight(enabled: bool, psf: PsfConfig, telescope: Telescope) -> float:
    """Return the FWHM of the weight of the moments [arcsec]."""
    least = WEIGHT_PIXELS * _pixel_arcsec(psf, telescope)
    return max(_WEIGHT if enabled else _WEIGHT_ALONE, round(least, 3))


def configured_telescope(telescope: Telescope, config: Configuration, site: Site) -> Telescope:
    """Return a telescope with the changes, the state of the visit and the rotator angle of a configuration.

    Its dispersion corrector, if it has one, is where light of the band needs it.
    """
    telescope = apply_changes(telescope, config.changes)
    states = config.active_optics.states
    if states is not None:
        with error_context(key="active_optics.states"):
            telescope = with_active_optics_state(telescope, states, config.atmosphere.epoch)
    return with_dispersion_corrected(telescope.with_rotator(math.radians(config.rotator_deg)), config, site)


def chosen_ccds(camera: Camera, names: Iterable[str]) -> tuple[str, ...]:
    """Return the names of CCDs in the order of the camera, each once; rafts and ``all`` stand for all of theirs.

    ``central`` stands for the raft in the middle of the field, or without rafts for the nine CCDs nearest to it. An
    unknown name raises UnknownNameError, none at all ConfigError.
    """
    indices: set[int] = set()
    for name in names:
        if name == "all":
            indices.update(range(len(camera)))
        elif name == CENTRAL:
            indices.update(_central_ccds(camera))
        else:
            indices.update(camera.members(name))
    if not indices:
        raise ConfigError(f"ccds = []: expected at least one name, such as {camera.ccd_names[0]}, or all")
    return tuple(camera.ccd_names[i] for i in sorted(indices))


def _central_ccds(camera: Camera) -> np.ndarray:
    """Return the indices of the CCDs of the raft in the middle of the field, or of as many nearest to it."""
    nearest = np.argsort(np.hypot(*camera.centers.T), kind="stable")
    raft = camera.raft_index[nearest[0]]
    return np.flatnonzero(camera.raft_index == raft) if raft >= 0 else nearest[:_FEW]


def default_ccds(camera: Camera) -> tuple[str, ...]:
    """Return CCDs from the centre of the field to its edge, with a neighbour on either side: a row along x of images.

    Of the LSST it is the middle row of three rafts, R22 to R24; a camera of few CCDs is computed whole.
    """
    if len(camera) <= _FEW:
        return camera.ccd_names
    order = [1, 0] if camera.transposed else [0, 1]
    x, y = camera.centers[:, order].T
    middle = int(np.argmin(np.hypot(x, y)))
    width, height = np.ptp(camera.corners([middle])[0], axis=0)[order]
    row = (np.abs(y - y[middle]) < 0.5 * height) & (x > x[middle] - 1.5 * width)
    return tuple(camera.ccd_names[i] for i in np.flatnonzero(row))


def _with_defaults(section: _Model, defaults: Mapping[str, object]) -> _Model:
    """Return a section with defaults for its open values."""
    return section.model_copy(update={key: v for key, v in defaults.items() if getattr(section, key) is None})


def _band_of(name: str, telescope: Telescope) -> BandName:
    """Return the band that the name of a model ends in, such as lsst_v3.3_i, or the one nearest to its wavelengths."""
    ending = Path(name).stem.rpartition("_")[2] if Path(name).suffix.lower() in ENDINGS else name.rpartition("_")[2]
    bands: dict[str, BandName] = {"u": "u", "g": "g", "r": "r", "i": "i", "z": "z", "y": "y"}
    return bands.get(ending, "r" if telescope.band is None else bands[nearest_band(telescope.band)])


def _absolute_path(name: str, folder: Path | None, bundled: Sequence[str], endings: Sequence[str] = ENDINGS) -> str:
    """Return a bundled name as it is, and the path of a file as an absolute one."""
    if name in bundled or Path(name).suffix.lower() not in endings:
        return name
    return str(((folder or Path()) / name).resolve())
