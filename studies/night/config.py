"""Configuration of a night: a run, the list of visits that replaces its pointing and air, and what comes out.

::

    run: {ccds: [R22], stars: {truth: 20}}                  # a run's configuration, or the path of its file
    visits: {list: baseline.db, where: "night = 5", band: "r,i"}
    maps: {nside: 1024}
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from ...core.arguments import check_arguments
from ...core.errors import ConfigError, ProductError
from ...core.files import path_beside
from ...core.schema import Section, Switch, Whole, plain_number, validated
from ...pipeline.config import Configuration, digest, read_configuration, section_yaml, with_run
from ...pipeline.defaults import SITE
from ...pipeline.experiment import Experiment
from ...sky.visit_list.read_list import read_visit_list
from ...sky.visit_list.visit_list import VisitList

#: Least and most numbers of pixels along a side of a base pixel: the coverage map's, and that of LSST's maps.
_LEAST_SIDE = 32
_MOST_SIDE = 32768
#: Keys of a list that say which file and which visits of it are taken: their digest tells the visits.
SELECTION_KEYS = ("list", "where", "band", "night")


class ListSection(Section):
    """List of visits, and which of them are taken."""

    list: str | None = Field(None, description="path of the list: a database, a table, or an instance catalogue")
    where: str | None = Field(None, description="condition on the columns of the list, in SQL")
    band: str | None = Field(None, description="bands to take, with commas between")
    night: Whole | None = Field(None, description="night to take: a date YYYYMMDD, or a number of the column night")
    airmass_law: Literal["von_karman", "opsim"] = Field(
        "von_karman", description="seeing away from the zenith: von_karman (with the outer scale), opsim (airmass^0.6)"
    )
    digest: str | None = Field(None, description="SHA-256 of the visits, written where a night starts")


class MapsSection(Section):
    """Maps of the sky."""

    nside: Annotated[int, BeforeValidator(plain_number), Field(strict=True, ge=0, le=_MOST_SIDE)] = Field(
        512, description="HEALPix resolution, a power of 2 from 32; 0 for no maps"
    )


class NightConfig(Section):
    """Settings of the visits of a list, which determine their products."""

    run: Configuration = Configuration()
    visits: ListSection = ListSection()
    maps: MapsSection = MapsSection()
    models: Switch = Field(True, description="false: no stars and no PSF models, noise-free PSFs alone")
    products: Switch = Field(False, description="keep stars, PSFs and models of each CCD of each visit as FITS")

    def read_list(self, folder: Path | None = None) -> VisitList:
        """Read the list; a relative path starts from `folder`.

        Raises
        ------
        ConfigError
            If there is none, or settings do not fit together.
        PachonError
            If it cannot be read, or its visits are not those of the digest.
        """
        if self.visits.list is None:
            raise ConfigError("visits.list = null: expected the path of a list of visits", key="visits.list")
        nside = self.maps.nside
        if nside and (nside < _LEAST_SIDE or nside & (nside - 1)):
            raise ConfigError(f"maps.nside = {nside}: expected 0, or a power of 2 from {_LEAST_SIDE}", key="maps.nside")
        if self.products and not self.models:
            raise ConfigError("products = true: expected models = true, which they hold", key="products")
        if self.run.reconstruction.model != "ccd":
            text = f"run.reconstruction.model = {self.run.reconstruction.model}: expected ccd for visits of a list"
            raise ConfigError(text, key="run.reconstruction.model")
        return read_section(self.visits, self.run, folder)

    def started(self, visits: VisitList, experiment: Experiment, folder: Path | None = None) -> NightConfig:
        """Return the settings with the CCDs of an experiment, an absolute path and the digest of the list."""
        path = str(((folder or Path()) / str(self.visits.list)).resolve())
        listed = self.visits.model_copy(update={"list": path, "digest": visits.digest})
        run = self.run.model_copy(update={"ccds": experiment.config.ccds})
        return self.model_copy(update={"run": run, "visits": listed})

    def content_digest(self, experiment: Experiment) -> str:
        """SHA-256 of all settings that affect products, with the files of the run by their content."""
        content = self.model_dump(mode="json", by_alias=True)
        content["visits"] = self.visits.digest
        return digest({"night": content, "run": experiment.config_hash})

    def as_dict(self) -> dict[str, Any]:
        """Return the settings as plain mappings."""
        return self.model_dump(mode="json", by_alias=True)

    def to_yaml(self) -> str:
        """Return the settings as a YAML file."""
        return section_yaml(self, "All that decides this night.")


@check_arguments
def load_night_configuration(path: Path) -> NightConfig:
    """Read a configuration of a night, and that of the run that it names.

    ConfigError if a file cannot be read, is not YAML, or has an unknown key or a value out of range.
    """
    return validated(NightConfig, with_run(read_configuration(path), path), str(path))


def read_section(settings: ListSection, run: Configuration, folder: Path | None = None) -> VisitList:
    """Read the list of a section for the telescope of a run; relative paths of both start from `folder`.

    PachonError if it cannot be read, or its visits are not those of the digest.
    """
    path = (folder or Path()) / str(settings.list)
    camera = run.camera or ("comcam" if "comcam" in (run.telescope or "") else "lsst")
    selection = settings.where, settings.band, settings.night
    visits = _visits_of(path, _state_of(path), selection, camera, _air_of(run, folder), settings.airmass_law)
    if settings.digest not in (None, visits.digest):
        raise ProductError("the list has changed: expected the visits of the digest of the configuration", file=path)
    return visits


# A database of ten years takes seconds to read: settings are made of it, and then the plan of the visits.
@lru_cache(maxsize=2)
def _visits_of(
    path: Path,
    state: object,
    selection: tuple[Any, Any, Any],
    camera: str,
    air: tuple[str, float | None, str],
    airmass_law: Any,
) -> VisitList:
    """Read the list in a file of a state."""
    (where, band, night), (site, outer_scale, remark) = selection, air
    visits = read_visit_list(
        path,
        where=where,
        band=band,
        night=night,
        camera=camera,
        site=site,
        airmass_law=airmass_law,
        outer_scale=outer_scale,
    )
    return replace(visits, remarks=(*visits.remarks, remark)) if remark else visits


def require_same_list(folder: Path, noun: str, before: ListSection | None, now: ListSection | None) -> None:
    """Raise ProductError where a folder holds something of other visits than those that are wanted now."""
    if before is not None and now is not None and before.digest != now.digest:
        raise ProductError(
            f"{folder} holds {noun} of another list: {now.list} has changed, or other visits of it are taken; choose "
            "another --out"
        )


def _state_of(path: Path) -> tuple[int, int] | None:
    """Return time and size of a file, which change with its content; None where there is none."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_size


def _air_of(run: Configuration, folder: Path | None) -> tuple[str, float | None, str]:
    """Return the bundled site of a run, the outer scale of its air if it is another, and a remark where it is assumed.

    A site file has layers and an outer scale, but no place.
    """
    from ...models.io.bundled import BUNDLED as TELESCOPES
    from ...models.io.prescription import load_telescope
    from ...models.io.site_file import BUNDLED, load_site

    from_folder = partial(path_beside, folder or Path())
    site, outer_scale = run.atmosphere.site, run.atmosphere.outer_scale_m
    if site in BUNDLED:
        return site, outer_scale, ""
    telescope = None if run.telescope is None else load_telescope(from_folder(run.telescope))
    place = None if telescope is None else telescope.site
    if place is None and run.telescope in (None, *TELESCOPES):
        place = SITE
    if site is None and place not in BUNDLED:
        site = place
    if site is not None and outer_scale is None:
        outer_scale = float(load_site(from_folder(site)).outer_scale)
    if place in BUNDLED:
        return place, outer_scale, ""
    return SITE, outer_scale, f"telescope {run.telescope} has no bundled site: place of {SITE} is taken"
