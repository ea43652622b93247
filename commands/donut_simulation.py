"""Files of simulated donuts: ``pachon donuts --simulate``."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.errors import ConfigError
from ..core.number_text import counted
from ..core.terminal import print_line
from .interrupt import interruptible
from .options import wavelength_list

if TYPE_CHECKING:
    from .donut_options import SimulationOptions, TelescopeOptions


def simulate_file(options: TelescopeOptions, simulation: SimulationOptions) -> None:
    """Write a file of donuts of a telescope."""
    from ..pipeline.simulate.donut_file import DonutScene, changed_telescope, simulate_donuts, write_donuts
    from ..sensing.model import DETECTOR, DonutAir, DonutDetector, DonutModel

    name, telescope = options.load()
    if len(options.files) != 1 or options.files[0].suffix.lower() not in (".fits", ".fit"):
        raise ConfigError("--simulate: expected one FILE.fits to write", file=options.files[-1])
    scene = DonutScene.of(simulation.settings or [])
    true = changed_telescope(telescope, simulation.perturb or [])
    model = DonutModel(
        air=DonutAir(outer_scale=options.outer_scale_m),
        detector=DonutDetector(
            options.pixel_size(None, telescope.camera),
            defocus=1e-6 * options.defocus_um,
            moved=options.moved or DETECTOR,
        ),
    ).with_light(wavelength_list(telescope, options.wavelength_nm, None))
    with interruptible(options.quiet) as reporter, reporter.stage("donuts"):
        donuts = simulate_donuts(telescope, true, scene, model, options.field())
    write_donuts(options.files[0], donuts, scene, model, _name_beside(options.files[0], name))
    if not options.quiet:
        print_line(f"{options.files[0]}: {counted(len(donuts.fields), 'donut')}, moved: {model.detector.moved}")


def _name_beside(file: Path, model: str) -> str:
    """Return a bundled name or an absolute path as it is, another path as it is from the folder of a file."""
    if not Path(model).is_file() or Path(model).is_absolute():
        return model
    return os.path.relpath(model, file.parent)
