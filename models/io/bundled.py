"""Names, descriptions and sources of the prescriptions that come with the package."""

from __future__ import annotations

from pathlib import Path

from ...core.yaml_reader import read_mapping

#: Folder of the files that come with the package.
DATA = Path(__file__).parents[1] / "data"
BUNDLED = (
    *(f"lsst_v3.3_{band}" for band in "ugrizy"),
    "lsst_v3.3_r_obstructed",
    "lsst_v3.3_g_vacuum_zemax_check",
    *(f"rubin_v3.14_{band}" for band in "ugrizy"),
    "comcam_r",
    "auxtel",
    "decam",
    "hsc",
    "paul_baker",
)


def bundled_file(name: str) -> Path:
    """Return the prescription file of a bundled telescope."""
    return DATA / f"{name}.yaml"


def bundled_models() -> list[dict[str, str]]:
    """Return name, description and source of each bundled telescope, without making it."""
    contents = {name: read_mapping(bundled_file(name)) for name in BUNDLED}
    return [{"name": name, **{key: str(c[key]) for key in ("description", "source")}} for name, c in contents.items()]
