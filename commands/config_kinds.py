"""Kinds of configurations: their classes, and the commands that take them."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from pydantic import BaseModel


class Kind(NamedTuple):
    """A kind of configuration: the class of its files, the commands that take them, and what it decides."""

    module: str
    name: str
    commands: str
    text: str


#: Kinds of configurations, the first that of keys without a kind.
KINDS = {
    "run": Kind(
        "pipeline.config",
        "Configuration",
        "run, attribute, study, shim, camera, baseline save, check",
        "telescope, sky and PSF models",
    ),
    "images": Kind("imaging.config", "ImagesConfig", "images", "images of galaxies and stars"),
    "visits": Kind("studies.visits.config", "VisitsConfig", "visits", "stacks of visits to one field"),
    "night": Kind("studies.night.config", "NightConfig", "visits --list", "visits of a scheduler's list"),
    "sweep": Kind("studies.sweep.file", "SweepFile", "sweep", "parameters that vary, and what is measured"),
    "align": Kind("studies.alignment.config", "AlignConfig", "align", "errors, donuts and control of the loop"),
    "tolerances": Kind("studies.tolerance.file", "ToleranceFile", "tolerance", "tolerances, merit and Monte Carlo"),
    "donuts": Kind("pipeline.simulate.donut_file", "DonutScene", "donuts --simulate", "stars, air and noise of donuts"),
    "optimization": Kind(
        "design.optimize.optimize_file", "OptimizeFile", "optimize --config", "variables, operands and glasses"
    ),
}


def model_of(kind: str) -> type[BaseModel]:
    """Return the class of the files of a kind."""
    model: type[BaseModel] = getattr(import_module(f"..{KINDS[kind].module}", __package__), KINDS[kind].name)
    return model
