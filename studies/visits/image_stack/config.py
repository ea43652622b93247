"""Settings of a stack of images."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import BeforeValidator, Field

from ....core.errors import ConfigError
from ....core.schema import Count, Section, Switch, plain_number, validated
from ....core.yaml_reader import read_mapping
from ....pipeline.config import section_yaml


class ImageStackConfig(Section):
    """Galaxies, tiles and noise of stacked images; the visits are those of their folder."""

    faintest: Annotated[float, BeforeValidator(plain_number), Field(strict=True, ge=15, le=30)] | None = Field(
        None, description="faintest galaxy [AB mag]; by default as bright as a star of S/N 4 in the stack of all visits"
    )
    tiles: Count = Field(1, description="most tiles of the sky, those nearest to the pointing")
    side: Annotated[int, Field(strict=True, ge=64)] | None = Field(
        None, description="pixels along a side of a tile; by default those of a CCD"
    )
    noise: Switch = Field(True, description="false for expected images")

    def to_yaml(self) -> str:
        """Return the settings as a YAML file."""
        return section_yaml(self, "All that decides these images, beside the visits.")


def load_image_stack_configuration(path: Path) -> ImageStackConfig:
    """Read settings; ConfigError where they cannot be read, or a key or a value is wrong."""
    return validated(ImageStackConfig, read_mapping(path, ConfigError), str(path))
