"""Images of all CCDs of a configuration, in one folder."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from ..core.arguments import check_arguments
from ..core.errors import ProductError
from ..core.long_work import Execution, claim_folder
from ..core.memory import require_bytes
from ..core.number_text import counted
from ..core.yaml_reader import read_mapping
from ..pipeline.experiment import Experiment
from ..pipeline.memory import check_memory, needed_bytes
from ..pipeline.resolved_values import resolved_value
from .ccd_image import draw_by_worker, draw_image, galaxies_of, image_name, stamp_of, window_of
from .config import ImagesConfig

CONFIG_NAME = "images.yaml"
#: Copies of a CCD's pixels that are held at once, in bytes a pixel: scene, image, variance, mask, and the file twice.
BYTES_PER_PIXEL = 40


@dataclass(frozen=True)
class ImagesResult:
    """Images of a configuration."""

    folder: Path
    images: dict[str, Path]  #: path of the image of each CCD
    kept: tuple[str, ...]  #: CCDs that were finished before
    computed: tuple[str, ...]  #: CCDs of this call
    objects: dict[str, int]  #: number of objects on each CCD of this call


@check_arguments
def simulate_images(
    config: ImagesConfig,
    folder: Path,
    *,
    experiment: Experiment | None = None,
    execution: Execution | None = None,
) -> ImagesResult:
    """Draw, expose and write the CCDs of a configuration.

    Every file has the same bytes whenever, with however many threads and by whatever workers it is made, whatever the
    other CCDs.

    Parameters
    ----------
    config : ImagesConfig
        Configuration.
    folder : Path
        Folder of the images, made where missing.
    experiment : Experiment, optional
        Experiment of the configuration, if it is made already.
    execution : Execution, optional
        Workers that draw the CCDs, threads, whether to keep finished CCDs, and progress display.

    Raises
    ------
    PachonError
        If the configuration does not hold together, the folder holds images of another one, or a file cannot be
        written.
    """
    execution = execution or Execution()
    threads, reporter, alone = execution.threads, execution.reporter, execution.alone
    experiment = config.experiment() if experiment is None else experiment
    resolved = config.resolved(experiment)
    names = resolved_value(experiment.config.ccds)
    windows = {name: window_of(config, experiment, name) for name in names}
    galaxies = galaxies_of(config, experiment)
    largest_window = max(window.width * window.height for window in windows.values())
    require_bytes(needed_bytes(experiment, threads) + BYTES_PER_PIXEL * largest_window, "images")
    stamp = stamp_of(config, experiment)
    claim_images(folder, resolved, resume=execution.resume)
    paths = {name: folder / image_name(name) for name in names}
    finished_ccds = execution.finished(paths, stamp)
    unfinished_ccds = [name for name in names if name not in finished_ccds]
    objects: dict[str, int] = {}
    if unfinished_ccds:
        draw: partial[int] = (
            partial(draw_image, config, experiment, galaxies, reporter.check)
            if alone
            else partial(draw_by_worker, config, experiment)
        )
        with (
            experiment.screens(threads, reporter) if alone else nullcontext(),
            execution.results(
                draw,
                [f"CCD {name}" for name in unfinished_ccds],
                unfinished_ccds,
                title=f"images of {counted(len(unfinished_ccds), 'CCD')}",
                folder=folder,
                product=lambda number: paths[unfinished_ccds[number]],
                check=lambda processes: check_memory(experiment, threads if alone else 1, copies=processes),
            ) as results,
        ):
            objects = dict(zip(unfinished_ccds, results, strict=True))
    return ImagesResult(folder, paths, finished_ccds, tuple(unfinished_ccds), objects)


def claim_images(folder: Path, config: ImagesConfig, *, resume: bool) -> None:
    """Make the folder, or check that its images are of the same configuration, and write images.yaml."""
    claim_folder(
        folder / CONFIG_NAME,
        config.to_yaml().encode(),
        products="image_*.fits",
        noun="images",
        now=config.model_dump(mode="json", by_alias=True),
        read=lambda path: read_mapping(path, ProductError),
        # No CCD depends on the others.
        free_keys=("run.ccds",) if resume else (),
    )
