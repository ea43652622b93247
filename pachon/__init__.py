"""Ray-traced telescope wavefronts, von Karman atmospheres and PSF reconstruction on the CPU.

The public names of pachon. Each is imported from its own module when it is first used, so ``import pachon`` is quick.
"""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import version as _version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .models.camera import lsst_camera as lsst_camera
    from .models.errors import PachonError as PachonError
    from .models.focal_plane import FocalPlane as FocalPlane
    from .models.paul_baker import paul_baker as paul_baker
    from .models.prescription import load_telescope as load_telescope
    from .models.prescription import save_telescope as save_telescope
    from .models.telescope import Telescope as Telescope
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
    from .wavefront.psf import make_psfs as make_psfs
    from .wavefront.pupil_optics import fields_at as fields_at
    from .wavefront.zernike import annular_zernikes as annular_zernikes
    from .wavefront.zernike import fit_zernikes as fit_zernikes

__version__ = _version("pachon")

_HOMES = {
    "models.camera": ("lsst_camera",),
    "models.errors": ("PachonError",),
    "models.focal_plane": ("FocalPlane",),
    "models.paul_baker": ("paul_baker",),
    "models.prescription": ("load_telescope", "save_telescope"),
    "models.telescope": ("Telescope",),
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
    "wavefront.psf": ("make_psfs",),
    "wavefront.pupil_optics": ("fields_at",),
    "wavefront.zernike": ("annular_zernikes", "fit_zernikes"),
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
