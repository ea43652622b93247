"""Files of tolerances, YAML.

::

    merit: spots                                   # or wavefront, ee80, mtf
    fields_deg: [[0, 0], [0, 8.5], [0, 12]]
    wavelengths_nm: [486.1, 587.6, 656.3]
    surfaces: {radius_percent: 0.2, irregularity_nm: 60}
    elements: {thickness_um: 30, decentre_um: 20, tilt_arcmin: 1, wedge_arcmin: 1, index: 5.0e-4, abbe_percent: 0.5}
    gaps: {thickness_um: 30}
    tolerances:
      - {name: S3.tilt_arcmin, size: 0.5, distribution: normal}
      - {name: S1.irregularity_nm, size: 30, zernikes: [5, 11]}
      - {name: Image.rx_arcmin, size: 2}
    compensators: [Image.dz_um]
    requirement: 15                                # um; nm for wavefront
    loss_percent: 10
    draws: 1000

`surfaces`, `elements` and `gaps` are the tolerances of all of them; those of the list replace what they name again.
Sizes are in the unit at the end of the name. An element is a piece of glass or a cemented group. It is named L1, L2...
or, where it is a group of the telescope, as that.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from ...core.arguments import check_arguments
from ...core.errors import ConfigError, error_context
from ...core.files import path_beside
from ...core.schema import Count, NotNegative, Positive, Real, Section, Whole, validated
from ...core.set_keys import set_key_errors, set_keys
from ...core.yaml_reader import read_mapping
from ...models.io.prescription import prescription_digest
from ...pipeline.config import digest

Distribution = Literal["uniform", "normal", "truncated", "end_point"]
Pair = tuple[Real, Real]


class ToleranceSection(Section):
    """Tolerance of one parameter, motion, compound or degree of freedom."""

    name: str = Field(description="address and unit, such as S1.radius_mm, L2.tilt_arcmin, S1.irregularity_nm")
    size: Positive = Field(description="largest deviation, or standard deviation, in the unit of the name")
    distribution: Distribution | None = Field(None, description="that of the file by default")
    limit: Positive | None = Field(None, description="largest deviation of a truncated distribution")
    zernikes: tuple[Whole, Whole] = Field((5, 15), description="lowest and highest Noll index of an irregularity")
    power: Real = Field(2.0, description="fall of the variance of an irregularity with the radial order, an exponent")


class SurfaceTolerances(Section):
    """Tolerances of every mirror and lens surface."""

    radius_percent: Positive | None = Field(None, description="radius of curvature [%]")
    decentre_um: Positive | None = Field(None, description="decentre along x and y [um]")
    tilt_arcmin: Positive | None = Field(None, description="tilt about x and y [arcmin]")
    irregularity_nm: Positive | None = Field(None, description="rms of the irregularity of the surface [nm]")


class ElementTolerances(Section):
    """Tolerances of every element: piece of glass or cemented group."""

    thickness_um: Positive | None = Field(None, description="thickness at the centre [um]")
    decentre_um: Positive | None = Field(None, description="decentre along x and y [um]")
    tilt_arcmin: Positive | None = Field(None, description="tilt about x and y [arcmin]")
    wedge_arcmin: Positive | None = Field(None, description="tilt of the second surface against the first [arcmin]")
    index: Positive | None = Field(None, description="index of refraction")
    abbe_percent: Positive | None = Field(None, description="Abbe number [%]")


class GapTolerances(Section):
    """Tolerances of every space between mirrors and elements, but that in front of the detector."""

    thickness_um: Positive | None = Field(None, description="thickness [um]")


class ToleranceFile(Section):
    """Content of a file of tolerances."""

    telescope: str = Field("", description="name or file; that of the command by default")
    merit: Literal["spots", "wavefront", "ee80", "mtf"] = Field("spots", description="what is to stay good")
    fields_deg: Annotated[tuple[Pair, ...], Field(min_length=1)] | None = Field(None, description="field angles [deg]")
    field_weights: tuple[NotNegative, ...] | None = Field(None, description="weights of the fields")
    wavelengths_nm: Annotated[tuple[Positive, ...], Field(min_length=1)] | None = Field(None, description="[nm]")
    rings: Count = Field(4, description="rings of pupil points")
    frequency_per_mm: Positive | None = Field(
        None, description="spatial frequency of the merit mtf [1/mm]; of afocal telescopes per mrad"
    )
    surfaces: SurfaceTolerances = SurfaceTolerances()
    elements: ElementTolerances = ElementTolerances()
    gaps: GapTolerances = GapTolerances()
    tolerances: tuple[ToleranceSection, ...] = Field((), description="single tolerances")
    distribution: Distribution = Field("uniform", description="distribution where none is given")
    degrees_of_freedom: str | None = Field(None, description="named degrees of freedom, lsst or a file of them")
    compensators: tuple[str, ...] = Field((), description="motions, with their units, that follow each deviation")
    requirement: Positive | None = Field(None, description="of the merit, for the yield [um; nm of wavefront; 1]")
    loss_percent: Positive = Field(10.0, description="loss of the merit that an inverse sensitivity allows")
    method: Literal["linear", "quadratic", "traced"] = Field("traced", description="method of the Monte Carlo")
    draws: Count = Field(1000, description="telescopes of the Monte Carlo")
    seed: Whole = Field(1, description="seed of the draws")

    @property
    def digest(self) -> str:
        """SHA-256 of the file and of those that it names."""
        named = [path for path in (self.telescope, self.degrees_of_freedom) if path and Path(path).is_file()]
        return digest({"tolerances": self.model_dump(mode="json"), "files": [prescription_digest(p) for p in named]})


@check_arguments
def load_tolerances(
    path: str | os.PathLike[str], telescope: str | None = None, settings: Sequence[str] = ()
) -> ToleranceFile:
    """Read a file of tolerances, of another telescope where its name or path is given.

    `settings` are other values of some keys: ``key=value`` each, dots between sections.

    Raises
    ------
    ConfigError
        If the file cannot be read, or is malformed: one line with file, key, value and what was expected.
    """
    path = Path(path)
    content = set_keys(ToleranceFile, read_mapping(path, ConfigError), settings)
    with set_key_errors(settings):
        file = validated(ToleranceFile, content, str(path))
    with error_context(file=path):
        telescope_name = file.telescope if telescope is None else telescope
        if not telescope_name:
            raise ConfigError("telescope is missing: expected a name or a file")
        changed = {"telescope": path_beside(path.parent, telescope_name) if telescope is None else telescope_name}
        if file.degrees_of_freedom is not None:
            changed["degrees_of_freedom"] = path_beside(path.parent, file.degrees_of_freedom)
        changed_file = file.model_copy(update=changed)
        _check(changed_file)
    return changed_file


def with_settings(file: ToleranceFile, **settings: Any) -> ToleranceFile:
    """Return a file with other values of some keys, those that are not None."""
    changed = {key: value for key, value in settings.items() if value is not None}
    changed_file = validated(
        ToleranceFile, {**file.model_dump(mode="json", exclude_unset=True), **changed}, "tolerances"
    )
    _check(changed_file)
    return changed_file


def _check(file: ToleranceFile) -> None:
    """Check values that depend on each other."""
    if (file.merit == "mtf") != (file.frequency_per_mm is not None):
        raise ConfigError(f"frequency_per_mm = {file.frequency_per_mm}: expected with merit mtf, and only there")
    if file.method != "traced" and file.merit not in ("spots", "wavefront"):
        raise ConfigError(f"method = {file.method!r}: expected 'traced' for the merit {file.merit}")
