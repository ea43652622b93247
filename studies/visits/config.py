"""Configuration of visits: a run, how often and how its field is visited, and the galaxies of the null test.

::

    run: {band: r, seed: 3, active_optics: {residual_um: 0.2}}     # a run's configuration, or the path of its file
    visits: {count: 100, dither_deg: 0.2}
    galaxies: {mosaic: udf.fits}    # or {catalogue: galaxies.ecsv}; by default a population as in the Ultra Deep Field
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field, SerializerFunctionWrapHandler, model_serializer

from ...core.arguments import check_arguments
from ...core.errors import ConfigError, DomainError, error_context
from ...core.number_text import counted
from ...core.schema import Count, Real, Section, Whole, plain_number, validated
from ...imaging.config import GalaxySourceConfig
from ...imaging.exposure import Exposure
from ...imaging.galaxies import GalaxySource
from ...pipeline.config import (
    Configuration,
    PointingConfig,
    digest,
    read_configuration,
    section_yaml,
    with_options,
    with_run,
)
from ...pipeline.defaults import CENTRAL
from ...pipeline.experiment import Experiment
from ...pipeline.listed_visit import telescope_of_band
from ...pipeline.resolved_values import require_drawn_stars
from ...pipeline.wide_stamps import with_stamps
from ...sky.pointing import Pointing
from ..night.config import SELECTION_KEYS, ListSection, read_section
from .plan import Visit, listed_plan, plan_visits

#: Side of the stamps of the stack [pixel], as wide on the sky as of the LSST's where pixels are finer.
STACK_STAMP = 31
#: Keys that a list of the same visits may have otherwise.
LIST_KEYS = tuple(f"visits.from_list.{key}" for key in SELECTION_KEYS)
#: Side of the stamps of a visit [pixel], likewise, of which turned axes cut the corners.
VISIT_STAMP = 49
#: Largest distance of a listed pointing from the common one [deg], that of dithers.
_LARGEST_FIELD = 5.0


class VisitsSection(Section):
    """Schedule of the visits, and their stars and stacks."""

    count: Count = Field(10, le=100_000, description="number of visits")
    dither_deg: Annotated[float, BeforeValidator(plain_number), Field(strict=True, ge=0, le=5)] = Field(
        0.0, description="radius of the disc over which pointings are spread [deg]"
    )
    stars: Count = Field(40, description="stars on the sky per area of a CCD, to which PSF models are fitted")
    places: Count = Field(20, description="places per area of a CCD where no star is and models are checked")
    snapshots: tuple[Count, ...] = Field((1, 10, 100), description="numbers of visits whose stacks are kept")
    first_epoch: Whole = Field(0, description="epoch of the first visit")
    roll_deg: Literal["random"] | tuple[Real, ...] = Field(
        "random",
        description="position angles of the telescope: random, but for the first visit, or a list, one for each [deg]",
    )
    rotator_deg: Literal["random"] | tuple[Real, ...] | None = Field(
        None, description="angles of the camera against the telescope in place of the run's: random, or a list [deg]"
    )
    rotator_limit_deg: Annotated[float, BeforeValidator(plain_number), Field(strict=True, ge=0, le=180)] = Field(
        90.0, description="largest angle of the rotator of either sense that is drawn [deg]"
    )

    from_list: ListSection | None = Field(
        None, description="list of visits whose pointings, angles, air and weights are taken: {list: ddf.db, band: r}"
    )

    @model_serializer(mode="wrap")
    def _without_list(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Return the section without a list where there is none, as in files from before this key."""
        content: dict[str, Any] = handler(self)
        return {key: value for key, value in content.items() if key != "from_list" or value is not None}


#: Keys of visits that are drawn, which those of a list have themselves.
_OF_DRAWN = ("count", "dither_deg", "roll_deg", "rotator_deg", "first_epoch")
_ANGLES = {key: VisitsSection.model_fields[key].default for key in ("roll_deg", "rotator_deg", "rotator_limit_deg")}


class VisitsConfig(Section):
    """Settings of a stack of visits, which determine its products."""

    run: Configuration = Configuration()
    visits: VisitsSection = VisitsSection()
    galaxies: GalaxySourceConfig = GalaxySourceConfig()

    def experiment(self, folder: Path | None = None) -> Experiment:
        """Return the experiment of all visits; relative paths in its configuration start from `folder`.

        Where the run leaves them open, CCDs are those in the middle of the field, of the LSST R22: CCDs across it share
        no sky.
        """
        run = self.run
        if run.ccds is None:
            run = with_options(run, ccds=(CENTRAL,))
        with error_context(key="run"):
            require_drawn_stars(run)
            return with_stamps(Experiment.from_config(run, folder), run, VISIT_STAMP)

    def resolved(self, experiment: Experiment) -> VisitsConfig:
        """Return the configuration with every default of the run filled in."""
        return self.model_copy(update={"run": experiment.config})

    def digest(self, experiment: Experiment) -> str:
        """SHA-256 of all settings that affect the PSFs of a visit; galaxies, visits' number and kept stacks do not."""
        visits = self.visits.model_dump(mode="json", exclude={"count", "snapshots"})
        # Default angles are left out, so that products from before these keys stay valid.
        visits = {key: value for key, value in visits.items() if key not in _ANGLES or value != _ANGLES[key]}
        if self.visits.from_list is not None and self.visits.from_list.digest is not None:
            visits["from_list"] = self.visits.from_list.digest
        return digest({"run": experiment.config_hash, "ccds": experiment.config.ccds, "visits": visits})

    def galaxies_digest(self, experiment: Experiment, **content: Any) -> str:
        """SHA-256 of the settings of the visits, of `content`, and of galaxies other than the default ones."""
        galaxy_content = {} if self.galaxies == GalaxySourceConfig() else {"galaxies": self.galaxies.content()}
        return digest({"visits": self.digest(experiment), **content, **galaxy_content})

    def galaxy_source(self, experiment: Experiment, exposure: Exposure) -> GalaxySource:
        """Read the galaxies about the common pointing, which is that of the run for a catalogue with ra and dec.

        Raises
        ------
        PachonError
            If their file cannot be read or has no such galaxies, or they would bury the sky.
        """
        pointing = experiment.config.pointing
        at = None if pointing is None else (np.deg2rad(pointing.ra_deg), np.deg2rad(pointing.dec_deg))
        try:
            return GalaxySource.read(self.galaxies, exposure, pointing=at, seed=experiment.config.seed)
        except DomainError as error:
            if at is None and error.key == "pointing":
                text = f"galaxies.catalogue = {self.galaxies.catalogue}: expected run.pointing, for its ra and dec"
                raise ConfigError(text, key="run.pointing") from None
            raise

    def plan(self, seed: int) -> tuple[Visit, ...]:
        """Return the visits."""
        return self.plan_of(self.visits.count, seed)

    def plan_of(self, count: int, seed: int) -> tuple[Visit, ...]:
        """Return the first `count` visits."""
        visits = self.visits
        if visits.from_list is not None:
            listed = read_section(visits.from_list, self.run)
            if len(listed) < count:
                most = counted(len(listed), "visit")
                raise ConfigError(f"visits.count = {count}: expected at most the {most} of the list")
            return listed_plan(listed, _pointing_of(self.run))[:count]
        try:
            return plan_visits(
                count,
                seed,
                dither=float(np.deg2rad(visits.dither_deg)),
                first_epoch=visits.first_epoch,
                rolls_deg=visits.roll_deg,
                rotators_deg=visits.rotator_deg,
                rotator_limit_deg=visits.rotator_limit_deg,
            )
        except DomainError as error:
            raise ConfigError(f"visits.{error}") from None

    def with_named_list(self, folder: Path | None = None) -> VisitsConfig:
        """Return these settings with all that follows from the list that they name, as :meth:`with_list` does.

        Those of a stack that was begun have it already, those without a list have nothing to add.
        """
        named = self.visits.from_list
        return self if named is None or named.digest is not None else self.with_list(named, folder)

    def with_list(self, section: ListSection, folder: Path | None = None) -> VisitsConfig:
        """Return the settings of the visits of a list of one field, whose run has their band, pointing and time.

        The common pointing is that of the run, or the middle of the list. Relative paths start from `folder`.

        Raises
        ------
        PachonError
            If the list cannot be read.
        ConfigError
            If it has several bands, or pointings more than 5 degrees apart, or the settings those of visits without a
            list.
        """
        begun = self.visits.from_list is not None and self.visits.from_list.digest is not None
        for key in () if begun else _OF_DRAWN:
            if getattr(self.visits, key) != VisitsSection.model_fields[key].default:
                raise ConfigError(f"visits.{key}: expected none with a list, whose visits have their own")
        section = section.model_copy(update={"list": str(((folder or Path()) / str(section.list)).resolve())})
        listed = read_section(section, self.run, folder)
        bands = np.unique(listed.band).tolist()
        if len(bands) > 1:
            raise ConfigError(f"{listed.source}: bands {', '.join(bands)}: expected one for a stack, by --band")
        run = with_options(
            self.run,
            band=bands[0],
            telescope=telescope_of_band(self.run.telescope, bands[0], folder),
            atmosphere__exposure_s=float(np.median(listed.exposure)),
        )
        if run.pointing is None:
            middle = Pointing(float(listed.ra[0]), float(listed.dec[0]))
            xi, eta = middle.from_celestial(listed.ra, listed.dec).mean(axis=0)
            ra, dec = np.rad2deg(middle.to_celestial([xi, eta])[0]).tolist()
            run = run.model_copy(update={"pointing": PointingConfig(ra_deg=ra, dec_deg=dec)})
        sky = _pointing_of(run).from_celestial(listed.ra, listed.dec)
        reach = float(np.rad2deg(np.arctan(np.hypot(*sky.T).max())))
        if not reach <= _LARGEST_FIELD:
            raise ConfigError(
                f"{listed.source}: pointings up to {reach:.1f} deg from the middle: expected one field, at most "
                f"{_LARGEST_FIELD:g} deg"
            )
        visits = self.visits.model_copy(
            update={
                "from_list": section.model_copy(update={"digest": listed.digest}),
                "count": len(listed),
                "dither_deg": reach,
            }
        )
        return self.model_copy(update={"run": run, "visits": visits})

    @property
    def kept(self) -> tuple[int, ...]:
        """Numbers of visits whose stacks are kept, the last one among them."""
        count = self.visits.count
        return tuple(sorted({n for n in self.visits.snapshots if n < count} | {count}))

    def to_yaml(self) -> str:
        """Return the configuration as a YAML file."""
        return section_yaml(self, "All that decides these visits.")


def _pointing_of(run: Configuration) -> Pointing:
    """Return the common pointing."""
    aim = run.pointing or PointingConfig()
    return Pointing(float(np.deg2rad(aim.ra_deg)), float(np.deg2rad(aim.dec_deg)))


@check_arguments
def load_visits_configuration(path: Path) -> VisitsConfig:
    """Read a configuration of visits, and that of the run that it names.

    Relative paths in both start from the folder of the first.

    Raises
    ------
    ConfigError
        If a file cannot be read, is not YAML, or has an unknown key or a value out of range.
    """
    config = validated(VisitsConfig, with_run(read_configuration(path), path), str(path))
    with error_context(file=path):
        return config.model_copy(update={"galaxies": config.galaxies.with_files(path.parent)})
