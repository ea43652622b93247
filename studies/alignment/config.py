"""Configuration of the active-optics loop: the errors of the telescope, the donuts, and how it is corrected.

::

    telescope: lsst_v3.3_r
    visits: 100
    errors: {initial: 2, gravity: 0.1, thermal: 0.05}     # in tolerances
    donuts: {heights: lsstcam, believed_heights: nominal}
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field

from ...core.arguments import check_arguments
from ...core.schema import Count, NotNegative, Positive, Section, Switch, Whole, plain_number, validated
from ...pipeline.config import read_configuration, section_yaml

Heights = Literal["nominal", "lsstcam"]


class ErrorsSection(Section):
    """Misalignment of the telescope before the first visit, and its drifts."""

    tolerance_nm: Positive = Field(
        50.0, description="rms wavefront over the field that the tolerance of each degree of freedom makes [nm]"
    )
    tolerances: dict[str, Positive] = Field(
        default_factory=dict, description="tolerances by name, each in the unit of its degree of freedom"
    )
    initial: NotNegative = Field(2.0, description="rms of every degree of freedom before the first visit [tolerances]")
    gravity: NotNegative = Field(
        0.1, description="rms step of every degree of freedom from visit to visit, as the telescope moves [tolerances]"
    )
    thermal: NotNegative = Field(
        0.05, description="rms step of pistons (dz) and bending modes (B), as the temperature drifts [tolerances]"
    )


class DonutsSection(Section):
    """Stars on the wavefront sensors in the corners."""

    per_sensor: Count = Field(1, description="stars on each of the eight halves")
    electrons: Positive = Field(5e6, description="electrons of each star")
    sky: NotNegative = Field(300.0, description="electrons of the sky in a pixel")
    read_noise: NotNegative = Field(8.8, description="rms noise of a pixel without light [electrons]")
    second_stars: Annotated[float, BeforeValidator(plain_number), Field(strict=True, ge=0, le=1)] = Field(
        0.0, description="fraction of the stamps with a second star"
    )
    cosmic_rays: Annotated[float, BeforeValidator(plain_number), Field(strict=True, ge=0, le=1)] = Field(
        0.0, description="fraction of the stamps with a cosmic ray"
    )
    heights: Heights = Field("nominal", description="heights of the sensors: nominal, or lsstcam (as measured)")
    believed_heights: Heights | None = Field(None, description="heights that the fit takes them to have; the true ones")
    stamp: Annotated[int, Field(strict=True, ge=31)] = Field(181, description="pixels on a side of a stamp")


class AirSection(Section):
    """Turbulence above the telescope."""

    site: str = Field("cerro_pachon", description="bundled site, or path of a site file")
    r0_m: Positive | None = Field(None, description="Fried parameter at 500 nm [m]; that of the site")
    outer_scale_m: Positive | None = Field(None, description="outer scale [m]; that of the site")
    exposure_s: Positive = Field(15.0, description="exposure time [s]")
    wavefront: Switch = Field(True, description="whether turbulence leaves a wavefront in the mean of an exposure")


class ControlSection(Section):
    """Correction of the telescope."""

    gain: Annotated[float, BeforeValidator(plain_number), Field(strict=True, gt=0, le=1)] = Field(
        1.0, description="fraction of the estimated state that is taken off"
    )


class AlignConfig(Section):
    """All that decides an active-optics loop."""

    telescope: str = Field("lsst_v3.3_r", description="bundled model, or path of a prescription")
    wavelengths_nm: tuple[Positive, ...] | None = Field(None, description="wavelengths [nm]; the telescope's default")
    degrees_of_freedom: str = Field("lsst", description="bundled degrees of freedom, or path of a file of them")
    visits: Count = Field(20, description="number of visits")
    seed: Whole = Field(1, description="seed of all random numbers")
    errors: ErrorsSection = ErrorsSection()
    donuts: DonutsSection = DonutsSection()
    air: AirSection = AirSection()
    control: ControlSection = ControlSection()

    def to_yaml(self) -> str:
        """Return the configuration as a YAML file."""
        return section_yaml(self, "All that decides this loop.")


@check_arguments
def load_align_configuration(path: Path) -> AlignConfig:
    """Read a configuration of the loop.

    Raises
    ------
    ConfigError
        If the file cannot be read, is not YAML, or has an unknown key or a value out of range.
    """
    return validated(AlignConfig, read_configuration(path), str(path))
