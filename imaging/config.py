"""Configuration of images: a run, a pointing, galaxies, and how the images are exposed.

::

    run: {band: r, ccds: [R22_S11], seed: 3}       # a run's configuration, or the path of its file
    pointing: {ra_deg: 53.1, dec_deg: -27.8, position_angle_deg: 30}
    galaxies: {faintest: 27}
    image: {exposures: 400, way: direct}
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Field

from ..core.arguments import check_arguments
from ..core.errors import ConfigError, ProductError, error_context
from ..core.files import content_hash
from ..core.schema import Count, Positive, Real, Section, Switch, plain_number, validated
from ..pipeline.config import (
    Configuration,
    InterpolationName,
    PointingConfig,
    digest,
    read_configuration,
    refuse_retired_interpolation,
    section_yaml,
    with_run,
)
from ..pipeline.experiment import Experiment
from ..pipeline.listed_visit import visit_experiment
from ..pipeline.wide_stamps import with_stamps
from ..sky.visit_list.visit_list import ListedVisit

#: Pixels along a side of the PSF's stamps where the run leaves them open, as many arcseconds as of the LSST's on finer
#: ones: wings down to 1e-6 of the light.
PSF_STAMP = 63
# Keys of galaxies that are paths of files.
_FILES = ("catalogue", "mosaic")


class GalaxySourceConfig(Section):
    """Source of the galaxies: a population, a catalogue or a mosaic."""

    brightest: Annotated[float, BeforeValidator(plain_number), Field(strict=True, ge=10, le=30)] = Field(
        20.0, description="brightest galaxy of the population [AB mag]"
    )
    density: Positive = Field(1.0, description="factor of the counts, of the population or of the mosaic")
    catalogue: str | None = Field(None, description="path of a catalogue in place of the population")
    convention: Literal["galsim", "tangent_plane"] | None = Field(
        None,
        description="e2 of the catalogue: galsim (> 0 from north-west to south-east), tangent_plane (from north-east)",
    )
    mosaic: str | None = Field(None, description="path of a FITS mosaic, whose galaxies are planted at random places")
    mosaic_zero_point: Real | None = Field(
        None, description="AB magnitude of one unit of the mosaic; by default that of its header"
    )
    mosaic_psf_arcsec: Positive | None = Field(
        None, description="half-light radius of the mosaic's PSF [arcsec]; by default that of its stars"
    )

    def with_files(self, folder: Path) -> Self:
        """Return the section with the absolute path of its file, which starts from `folder` and must be there."""
        paths = {key: path for key in _FILES if (path := getattr(self, key)) is not None}
        if len(paths) > 1:
            raise ConfigError("galaxies.catalogue and galaxies.mosaic: expected one of them")
        for key, path in paths.items():
            paths[key] = str((folder / path).resolve())
            if not Path(paths[key]).is_file():
                raise ConfigError(f"galaxies.{key} = {path}: no such file", key=f"galaxies.{key}")
        return self.model_copy(update=paths)

    def content(self) -> dict[str, Any]:
        """Return the content for a digest, with files by their content."""
        content = self.model_dump(mode="json")
        for key in _FILES:
            if content[key] is not None:
                content[key] = content_hash(Path(content[key]), ProductError)
        return content


class GalaxiesConfig(GalaxySourceConfig):
    """Source of the galaxies of images, and their magnitude limit."""

    faintest: Annotated[float, BeforeValidator(plain_number), Field(strict=True, ge=15, le=30)] = Field(
        29.0, description="faintest galaxy of the population [AB mag]"
    )


class ImageConfig(Section):
    """How images are drawn and exposed."""

    exposures: Count = Field(1, description="exposures that are summed, all of one PSF")
    noise: Switch = Field(True, description="false for the expected image")
    gain: Positive | None = Field(None, description="electrons of one ADU; that of the camera by default")
    sky_mag: Real | None = Field(None, description="sky [AB mag/arcsec^2]; the dark sky of the band by default")
    subtract_background: Switch = Field(True, description="subtract the expected sky and dark current")
    way: Literal["direct", "eigen"] = Field(
        "direct", description="direct (each galaxy under its own PSF), eigen (whole image, component by component)"
    )
    interpolation: InterpolationName | None = Field(
        None, description="of the PSF over the CCD: polynomial, or kriging where that misses 3 % of the peak"
    )
    side: Annotated[int, Field(strict=True, ge=64)] | None = Field(
        None, description="only the central square of a CCD [pixel]; by default all of it"
    )
    preview: Switch = Field(True, description="a PNG of each CCD")
    cutouts: Switch = Field(True, description="a PNG of 100 arcsec at the exposure time, at 6000 s, and without noise")

    @classmethod
    def check(cls, content: dict[str, Any]) -> None:
        """Raise the error of an interpolation that another one has replaced."""
        refuse_retired_interpolation(content)


class ImagesConfig(Section):
    """Settings of images, which determine every byte of them."""

    run: Configuration = Configuration()
    pointing: PointingConfig = PointingConfig()
    galaxies: GalaxiesConfig = GalaxiesConfig()
    image: ImageConfig = ImageConfig()

    def experiment(self, folder: Path | None = None) -> Experiment:
        """Return the experiment of the run; relative paths in its configuration start from `folder`."""
        run = self.run
        if run.pointing not in (None, self.pointing):
            raise ConfigError("run.pointing: expected none, or that of the images, under pointing")
        if run.stars.catalogue is not None or run.atmosphere.zenith_position_angle_deg is not None:
            run = run.model_copy(update={"pointing": self.pointing})
        with error_context(subject="run"):
            return with_stamps(Experiment.from_config(run, folder), run, PSF_STAMP)

    def of_visit(self, visit: ListedVisit, folder: Path | None = None) -> ImagesConfig:
        """Return the settings of a visit of a list: its run, pointing and sky."""
        run = with_stamps(visit_experiment(self.run, visit, folder), self.run, PSF_STAMP).config
        image = self.image
        if math.isfinite(visit.sky):
            image = image.model_copy(update={"sky_mag": visit.sky})
        return self.model_copy(update={"run": run, "pointing": run.pointing, "image": image})

    def resolved(self, experiment: Experiment) -> ImagesConfig:
        """Return the configuration with that of the experiment, every default filled in, for its run."""
        return self.model_copy(update={"run": experiment.config})

    def digest(self, experiment: Experiment) -> str:
        """SHA-256 of all settings that affect the image of a CCD; files count by their content."""
        content = self.model_dump(mode="json", exclude={"run"}) | {"galaxies": self.galaxies.content()}
        for key in ("preview", "cutouts"):
            del content["image"][key]
        if self.image.gain is None:
            content["image"]["gain"] = experiment.band.gain
        return digest({"run": experiment.config_hash, **content})

    def to_yaml(self) -> str:
        """Return the configuration as a YAML file."""
        return section_yaml(self, "All that decides these images.")


@check_arguments
def load_images_configuration(path: Path) -> ImagesConfig:
    """Read a configuration of images, and that of the run that it names.

    Relative paths in both start from the folder of the first.

    Raises
    ------
    ConfigError
        If a file cannot be read, is not YAML, or has an unknown key or a value out of range.
    """
    config = validated(ImagesConfig, with_run(read_configuration(path), path), str(path))
    with error_context(file=path):
        return with_files(config, path.parent)


def with_files(config: ImagesConfig, folder: Path) -> ImagesConfig:
    """Return the configuration with absolute paths of the files of galaxies, which must be there."""
    galaxies = config.galaxies
    if galaxies.brightest >= galaxies.faintest:
        raise ConfigError(
            f"galaxies.faintest = {galaxies.faintest:g}: expected more than galaxies.brightest = {galaxies.brightest:g}"
        )
    return config.model_copy(update={"galaxies": galaxies.with_files(folder)})
