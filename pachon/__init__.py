"""Ray-traced telescope wavefronts, von Karman atmospheres and PSF reconstruction on the CPU.

The public names of pachon. Each is imported from its own module when it is first used, so ``import pachon`` is quick.
"""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import version as _version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .design.bundles import field_points as field_points
    from .design.degrees_of_freedom import DegreesOfFreedom as DegreesOfFreedom
    from .design.degrees_of_freedom_file import load_degrees_of_freedom as load_degrees_of_freedom
    from .design.diffraction import fft_psf as fft_psf
    from .design.diffraction import huygens_psf as huygens_psf
    from .design.distortion import distortion as distortion
    from .design.encircled_energy import encircled_energy as encircled_energy
    from .design.encircled_energy import energy_curve as energy_curve
    from .design.field_zernikes import double_zernikes as double_zernikes
    from .design.field_zernikes import wavefront_zernikes as wavefront_zernikes
    from .design.footprint import footprint as footprint
    from .design.ghosts import ghosts as ghosts
    from .design.layout import layout as layout
    from .design.monte_carlo import monte_carlo as monte_carlo
    from .design.mtf import mtf as mtf
    from .design.optimize import optimize as optimize
    from .design.principal_rays import principal_rays as principal_rays
    from .design.pupil_sampling import pupil_sampling as pupil_sampling
    from .design.sensitivity import sensitivity as sensitivity
    from .design.spots import spots as spots
    from .design.thermal import thermal as thermal
    from .design.through_focus import through_focus as through_focus
    from .design.tolerances import Tolerance as Tolerance
    from .design.vignetting import vignetting as vignetting
    from .models.camera import lsst_camera as lsst_camera
    from .models.errors import PachonError as PachonError
    from .models.focal_plane import FocalPlane as FocalPlane
    from .models.glass_catalogue import GlassCatalogue as GlassCatalogue
    from .models.obstruction import Obstruction as Obstruction
    from .models.paul_baker import paul_baker as paul_baker
    from .models.prescription import load_telescope as load_telescope
    from .models.prescription import save_telescope as save_telescope
    from .models.shape_freeform import ZernikeSag as ZernikeSag
    from .models.shape_grid import GridSag as GridSag
    from .models.shape_mesh import MeshSurface as MeshSurface
    from .models.telescope import Telescope as Telescope
    from .models.zernike_polynomials import annular_zernikes as annular_zernikes
    from .pipeline.correlation import shear_correlation as shear_correlation
    from .pipeline.psf_model import PsfModel as PsfModel
    from .pipeline.shapes import measure_shapes as measure_shapes
    from .pipeline.star_catalogue import load_stars as load_stars
    from .pipeline.star_selection import flag_stars as flag_stars
    from .raytrace.mesh import land_on_mesh as land_on_mesh
    from .raytrace.rays import Rays as Rays
    from .raytrace.rays import RayStatus as RayStatus
    from .raytrace.rays import launch_rays as launch_rays
    from .raytrace.trace import trace as trace
    from .wavefront.aberration import ResidualWavefront as ResidualWavefront
    from .wavefront.atmosphere import Atmosphere as Atmosphere
    from .wavefront.opd import wavefront_opd as wavefront_opd
    from .wavefront.opd_batch import wavefront_opds as wavefront_opds
    from .wavefront.psf import make_psfs as make_psfs
    from .wavefront.pupil_optics import fields_at as fields_at
    from .wavefront.zernike import fit_zernikes as fit_zernikes

__version__ = _version("pachon")

_HOMES = {
    "design.bundles": ("field_points",),
    "design.degrees_of_freedom": ("DegreesOfFreedom",),
    "design.degrees_of_freedom_file": ("load_degrees_of_freedom",),
    "design.diffraction": ("fft_psf", "huygens_psf"),
    "design.distortion": ("distortion",),
    "design.encircled_energy": ("encircled_energy", "energy_curve"),
    "design.field_zernikes": ("double_zernikes", "wavefront_zernikes"),
    "design.footprint": ("footprint",),
    "design.ghosts": ("ghosts",),
    "design.layout": ("layout",),
    "design.monte_carlo": ("monte_carlo",),
    "design.mtf": ("mtf",),
    "design.optimize": ("optimize",),
    "design.principal_rays": ("principal_rays",),
    "design.pupil_sampling": ("pupil_sampling",),
    "design.sensitivity": ("sensitivity",),
    "design.spots": ("spots",),
    "design.thermal": ("thermal",),
    "design.through_focus": ("through_focus",),
    "design.tolerances": ("Tolerance",),
    "design.vignetting": ("vignetting",),
    "models.camera": ("lsst_camera",),
    "models.errors": ("PachonError",),
    "models.focal_plane": ("FocalPlane",),
    "models.glass_catalogue": ("GlassCatalogue",),
    "models.obstruction": ("Obstruction",),
    "models.paul_baker": ("paul_baker",),
    "models.prescription": ("load_telescope", "save_telescope"),
    "models.shape_freeform": ("ZernikeSag",),
    "models.shape_grid": ("GridSag",),
    "models.shape_mesh": ("MeshSurface",),
    "models.telescope": ("Telescope",),
    "models.zernike_polynomials": ("annular_zernikes",),
    "pipeline.correlation": ("shear_correlation",),
    "pipeline.psf_model": ("PsfModel",),
    "pipeline.shapes": ("measure_shapes",),
    "pipeline.star_catalogue": ("load_stars",),
    "pipeline.star_selection": ("flag_stars",),
    "raytrace.mesh": ("land_on_mesh",),
    "raytrace.rays": ("RayStatus", "Rays", "launch_rays"),
    "raytrace.trace": ("trace",),
    "wavefront.aberration": ("ResidualWavefront",),
    "wavefront.atmosphere": ("Atmosphere",),
    "wavefront.opd": ("wavefront_opd",),
    "wavefront.opd_batch": ("wavefront_opds",),
    "wavefront.psf": ("make_psfs",),
    "wavefront.pupil_optics": ("fields_at",),
    "wavefront.zernike": ("fit_zernikes",),
}
_HOME = {name: module for module, names in _HOMES.items() for name in names}

__all__ = ["__version__", *sorted(_HOME)]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'pachon' has no attribute {name!r}")
    value = getattr(import_module(f".{_HOME[name]}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
