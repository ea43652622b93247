"""Telescopes and experiments from files and options."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.errors import HeightWarning, PachonError, PrescriptionWarning
from ..core.terminal import print_warning

if TYPE_CHECKING:
    from ..models.telescope import Telescope
    from ..pipeline.config import Configuration as RunConfiguration
    from ..pipeline.experiment import Experiment

#: Distance of a stop from the entrance pupil, in diameters of this, that no tolerance would have.
_ASIDE = 0.05


def configuration(
    config: Path | None, set_texts: Sequence[str] | None = None, *, paper_model: bool = False, **options: object
) -> RunConfiguration:
    """Return the configuration of a file, of values of `--set`, and of options by key, None where not given.

    With `paper_model` the PSF model is that of Jee & Tyson 2011 where the file names none.
    """
    from ..core.set_keys import with_set_keys
    from ..pipeline.config import Configuration, load_configuration, with_options
    from ..pipeline.defaults import with_paper_model

    file = Configuration() if config is None else load_configuration(config)
    base = with_set_keys(file, set_texts or ())
    return with_options(with_paper_model(base) if paper_model else base, **options)


def configured_experiment(
    config: Path | None, set_texts: Sequence[str] | None = None, *, paper_model: bool = False, **options: object
) -> Experiment:
    """Return the experiment of a :func:`configuration`."""
    from ..pipeline.experiment import Experiment

    settings = configuration(config, set_texts, paper_model=paper_model, **options)
    try:
        with warnings_shown(HeightWarning):
            return Experiment.from_config(settings, None if config is None else config.parent)
    except PachonError as error:
        if config is None or set_texts or any(value is not None for value in options.values()):
            raise  # an option may be at fault, not the file
        raise error.within(file=config) from None


def load_model(
    model: str, lenient: bool = False, glass_catalogues: Sequence[Path] = (), configuration: int | None = None
) -> Telescope:
    """Return the telescope of that name or file; warnings of a lenient reader go to standard error, a line each."""
    from ..models.io.prescription import load_telescope

    with warnings_shown(PrescriptionWarning):
        return load_telescope(model, lenient=lenient, glass_catalogues=glass_catalogues, configuration=configuration)


def print_doubts(telescope: Telescope) -> None:
    """Warn of a telescope that has no detector, or a stop aside of the light that is to fill it.

    As in Zemax, rays fill the entrance pupil about the axis of the object space unless they are aimed at the stop.
    """
    from ..models.surface import Interaction

    *surfaces, last = telescope.surfaces
    if last.interaction != Interaction.DETECTOR:
        print_warning(f"{telescope.name}: the last surface, {last.name}, is no detector: light is measured on it")
    data = telescope.design_data
    stop = next((i for i, s in enumerate(surfaces) if s.name == data.stop), None)
    if stop is None or data.aiming != "off" or any(s.interaction != Interaction.PASS for s in surfaces[:stop]):
        return
    aside = [v - c for v, c in zip(surfaces[stop].vertex, telescope.pupil_center, strict=False)]
    if math.hypot(*aside) > _ASIDE * telescope.pupil_diameter:
        name, unit = telescope.length_unit
        where = " and ".join(f"{v / unit:.6g} {name} in {axis}" for v, axis in zip(aside, "xy", strict=True) if v)
        print_warning(
            f"{telescope.name}: the stop {data.stop} lies {where} beside the entrance pupil that rays fill: "
            "aim them at it, by --aiming real, or move the pupil (stop.center)"
        )


@contextmanager
def errors_of(file: Path) -> Iterator[None]:
    """Raise the errors of the block that name no file again with this one, whose content they are about."""
    try:
        yield
    except PachonError as error:
        raise (error if error.file else error.within(file=file)) from None


@contextmanager
def warnings_shown(kind: type[Warning]) -> Iterator[None]:
    """Print the warnings of a kind on standard error, a line each, at the end of the ``with`` block."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", kind)
        yield
    for warning in caught:
        print_warning(str(warning.message))
