"""Files of simulated donuts: ``pachon donuts --simulate``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from ..core.errors import ConfigError
from ..core.number_text import counted
from ..core.terminal import print_line
from .interrupt import interruptible
from .options import degrees_pair, wavelength_list

if TYPE_CHECKING:
    from ..models.telescope import Telescope
    from ..sensing.model import DonutModel


def simulate_file(
    files: list[Path],
    believed: tuple[str, Telescope],
    model: DonutModel,
    texts: tuple[list[str], list[str]],
    wavelength_nm: list[float] | None,
    field_deg: str | None,
    quiet: bool,
) -> None:
    """Write a file of donuts: telescope believed in, by its name and itself, model, texts of its errors and scene."""
    import numpy as np

    from ..pipeline.simulate.donut_file import DonutScene, changed_telescope, simulate_donuts, write_donuts

    if len(files) != 1 or files[0].suffix.lower() not in (".fits", ".fit"):
        raise ConfigError("--simulate: expected one FILE.fits to write", file=files[-1])
    name, telescope = believed
    scene, true = DonutScene.of(texts[1]), changed_telescope(telescope, texts[0])
    model = model.with_light(wavelength_list(telescope, wavelength_nm, None))
    field = None if field_deg is None else np.deg2rad(degrees_pair(field_deg, "--field-deg"))
    with interruptible(quiet) as reporter, reporter.stage("donuts"):
        donuts = simulate_donuts(telescope, true, scene, model, field)
    write_donuts(files[0], donuts, scene, model, name)
    if not quiet:
        print_line(f"{files[0]}: {counted(len(donuts.fields), 'donut')}, moved: {model.detector.moved}")
