"""Hash of a configuration: all values that affect products, files by their content."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..core.table_files import ENDINGS as STAR_ENDINGS
from ..models.camera.cameras import CAMERAS
from ..models.camera.cameras import ENDINGS as CAMERA_ENDINGS
from ..models.camera.photometry import BANDS
from ..models.io.bundled import BUNDLED
from ..models.io.heights.file import ENDINGS as HEIGHT_ENDINGS
from ..models.io.heights.zernike_table import AS_MEASURED
from ..models.io.prescription import ENDINGS, prescription_digest
from .alignment_states import ENDINGS as STATE_ENDINGS
from .config import Configuration
from .photometry import band_of
from .resolved_values import resolved_value

#: Keys of catalogues of stars: without a catalogue they are left out, as in hashes from before these keys.
_CATALOGUE_KEYS = ("catalogue", "columns", "brightest", "faintest")


def hashed_content(config: Configuration) -> dict[str, Any]:
    """Return the content of a resolved configuration for the hash of the product of a CCD.

    The list of CCDs is left out, since no CCD depends on the others.
    """
    content = config.as_dict()
    del content["ccds"]
    if not config.detector.silicon:
        # The section has no effect.
        del content["detector"]
    name = resolved_value(config.telescope)
    content["telescope"] = name if name in BUNDLED else prescription_digest(name)
    content = hashed_photometry(hashed_camera(content), config)
    content["focal_plane"] = hashed_heights(content["focal_plane"])
    content["active_optics"] = hashed_states(content["active_optics"])
    content["stars"] = hashed_stars(content["stars"])
    content["reconstruction"] = hashed_reconstruction(content["reconstruction"])
    if config.pointing is None:
        del content["pointing"]
    content["atmosphere"]["site"] = _name_or_content(resolved_value(config.atmosphere.site), ())
    return content


def hashed_photometry(content: dict[str, Any], config: Configuration) -> dict[str, Any]:
    """Return a configuration for a hash: without photometry where it is the LSST's, and never with its source."""
    other_sections = {key: value for key, value in content.items() if key != "photometry"}
    if config.band is not None:
        lsst = BANDS[config.band]
        if band_of(config.band, config.photometry.model_copy(update={"source": lsst.source})) == lsst:
            return other_sections
    return other_sections | {
        "photometry": {key: value for key, value in content["photometry"].items() if key != "source"}
    }


def hashed_camera(content: dict[str, Any]) -> dict[str, Any]:
    """Return a configuration for a hash: a camera file by its content; no key where the telescope's own is taken."""
    name = content["camera"]
    other_keys = {key: value for key, value in content.items() if key != "camera"}
    return other_keys if name is None else other_keys | {"camera": _name_or_content(name, CAMERAS, CAMERA_ENDINGS)}


def hashed_heights(section: dict[str, Any]) -> dict[str, Any]:
    """Return the section of the focal plane for a hash: a file of heights by its content; no key where there is none.

    So configurations without measured heights keep the hashes that they had before there were any.
    """
    name = section["heights"]
    if name is None:
        return {key: value for key, value in section.items() if key != "heights"}
    # Hashes of older versions include a budget beside measured heights.
    return section | {"budget": "simulated", "heights": _name_or_content(name, tuple(AS_MEASURED), HEIGHT_ENDINGS)}


def hashed_states(section: dict[str, Any]) -> dict[str, Any]:
    """Return the section of the active optics for a hash, as :func:`hashed_heights` does that of the focal plane."""
    name = section["states"]
    other_keys = {key: value for key, value in section.items() if key != "states"}
    return other_keys if name is None else other_keys | {"states": _name_or_content(name, (), STATE_ENDINGS)}


def hashed_stars(section: dict[str, Any]) -> dict[str, Any]:
    """Return the section of the stars for a hash: a catalogue by its content, no keys of it where there is none."""
    name = section["catalogue"]
    if name is None:
        return {key: value for key, value in section.items() if key not in _CATALOGUE_KEYS}
    return {key: value for key, value in section.items() if key != "observed"} | {
        "catalogue": _name_or_content(name, (), STAR_ENDINGS)
    }


def hashed_reconstruction(section: dict[str, Any]) -> dict[str, Any]:
    """Return the section of the PSF models for a hash, as :func:`hashed_heights` does that of the focal plane."""
    if section["turbulence"] != "exponential":
        return section
    return {key: value for key, value in section.items() if key != "turbulence"}


def _name_or_content(name: str, bundled: Sequence[str], endings: Sequence[str] = ENDINGS) -> str:
    """Return a bundled name, or the hash of the file of that name."""
    if name in bundled or Path(name).suffix.lower() not in endings:
        return name
    return hashlib.sha256(Path(name).read_bytes()).hexdigest()
