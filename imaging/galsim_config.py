"""Types of GalSim's configuration files: ``PachonOptics`` (photon_ops) and ``Pachon`` (image.wcs); needs GalSim."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import galsim
import galsim.config

from ..core.errors import DomainError, check_choice
from ..models.camera.cameras import load_camera
from ..models.camera.focal_plane import FocalPlane
from ..models.camera.silicon import Silicon
from ..models.io.prescription import load_telescope
from ..models.telescope import Telescope
from .galsim_optics import PachonOptics
from .galsim_psf import galsim_wcs
from .wcs import ccd_wcs

_HEIGHTS = ("nominal", "flat", "budget", "as_measured")
_PLACE = {"telescope": str, "ccd": str, "boresight": galsim.CelestialCoord}


@lru_cache(maxsize=8)
def _telescope(name: str, rotator: float) -> Telescope:
    return load_telescope(name).with_rotator(rotator)


@lru_cache(maxsize=8)
def _focal_plane(camera: str | None, heights: str, seed: int) -> FocalPlane | None:
    check_choice("heights", heights, _HEIGHTS)
    if heights == "nominal" or camera is None:
        return None
    if heights == "budget":
        return FocalPlane.from_budget(camera, seed=seed)
    return FocalPlane.flat(camera) if heights == "flat" else FocalPlane.as_measured("lsstcam")


@lru_cache(maxsize=8)
def _wcs(telescope: Telescope, ccd: str, pointing: tuple[float, float], angle: float) -> galsim.GSFitsWCS:
    if telescope.camera is None:
        raise DomainError(f"ccd = {ccd!r}: expected a telescope with a camera, not {telescope.name}")
    camera = load_camera(telescope.camera)
    return galsim_wcs(ccd_wcs(telescope, camera, ccd, pointing=pointing, position_angle=angle))


def _angle(given: dict[str, Any], key: str) -> float:
    return float(given.pop(key) / galsim.radians) if key in given else 0.0


class PachonOpticsBuilder(galsim.config.PhotonOpBuilder):
    """Builder of :class:`.PachonOptics` for the object that is drawn, at ``sky_pos`` and ``image_pos``."""

    def buildPhotonOp(  # noqa: N802 - GalSim's name
        self, config: dict[str, Any], base: dict[str, Any], logger: Any
    ) -> PachonOptics:
        """Return the photon operator of a section."""
        optional = {"position_angle": galsim.Angle, "rotator": galsim.Angle, "heights": str, "seed": int,
                    "silicon": bool, "threads": int}  # fmt: skip
        parameters, _ = galsim.config.GetAllParams(config, base, req=_PLACE, opt=optional)
        boresight, angle = parameters["boresight"], _angle(parameters, "position_angle")
        telescope = _telescope(parameters["telescope"], _angle(parameters, "rotator"))
        return PachonOptics(
            telescope,
            sky_pos=base["sky_pos"],
            pointing=(boresight.ra.rad, boresight.dec.rad),
            position_angle=angle,
            focal_plane=_focal_plane(telescope.camera, parameters.get("heights", "nominal"), parameters.get("seed", 0)),
            ccd=parameters["ccd"],
            image_pos=base["image_pos"],
            silicon=Silicon() if parameters.get("silicon") else None,
            threads=parameters.get("threads"),
        )


class PachonWcsBuilder(galsim.config.WCSBuilder):
    """Builder of the world coordinates of a CCD."""

    def buildWCS(self, config: dict[str, Any], base: dict[str, Any], logger: Any) -> galsim.GSFitsWCS:  # noqa: N802
        """Return the WCS of a section."""
        optional = {"position_angle": galsim.Angle, "rotator": galsim.Angle}
        parameters, _ = galsim.config.GetAllParams(config, base, req=_PLACE, opt=optional)
        boresight, angle = parameters["boresight"], _angle(parameters, "position_angle")
        telescope = _telescope(parameters["telescope"], _angle(parameters, "rotator"))
        return _wcs(telescope, parameters["ccd"], (boresight.ra.rad, boresight.dec.rad), angle)


galsim.config.RegisterPhotonOpType("PachonOptics", PachonOpticsBuilder())
galsim.config.RegisterWCSType("Pachon", PachonWcsBuilder())
