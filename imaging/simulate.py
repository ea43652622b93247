"""Images of all CCDs of a configuration, in one folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ..core.arguments import check_arguments
from ..core.errors import ProductError
from ..core.files import claim_folder
from ..core.memory import require_bytes
from ..core.progress import Reporter
from ..core.workers import MakeWorkers
from ..core.yaml_reader import read_mapping
from ..pipeline.config import differences
from ..pipeline.experiment import Experiment
from ..pipeline.memory import needed_bytes
from ..pipeline.resolved_values import resolved_value
from .ccd_image import draw_by_workers, draw_image, galaxies_of, image_name, stamp_of, window_of
from .config import ImagesConfig
from .image_file import is_whole

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
    resume: bool = False,
    workers: MakeWorkers | None = None,
    threads: int | None = None,
    reporter: Reporter | None = None,
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
    resume : bool
        Keep CCDs that are finished already.
    workers : callable, optional
        Function that makes the workers that draw the CCDs, as in :func:`~pachon.run`; by default this process.
    threads : int, optional
        Number of threads; all processors by default.
    reporter : Reporter, optional
        Progress display; silent by default.

    Raises
    ------
    PachonError
        If the configuration does not hold together, the folder holds images of another one, or a file cannot be
        written.
    """
    reporter = Reporter(quiet=True) if reporter is None else reporter
    experiment = config.experiment() if experiment is None else experiment
    resolved = config.resolved(experiment)
    names = resolved_value(experiment.config.ccds)
    windows = {name: window_of(config, experiment, name) for name in names}
    galaxies = galaxies_of(config, experiment)
    most = max(window.width * window.height for window in windows.values())
    require_bytes(needed_bytes(experiment, threads) + BYTES_PER_PIXEL * most, "images")
    stamp = stamp_of(config, experiment)
    _claim(folder, resolved, resume=resume)
    paths = {name: folder / image_name(name) for name in names}
    kept = tuple(name for name in names if resume and is_whole(paths[name], stamp))
    missing = [name for name in names if name not in kept]
    objects: dict[str, int] = {}
    if missing and workers is not None:
        objects = draw_by_workers(config, experiment, folder, missing, workers, reporter)
    elif missing:
        with experiment.screens(threads, reporter):
            bar = reporter.stage(f"images of {len(missing)} CCDs", total=len(missing))
            with bar as stage:
                for i, name in enumerate(missing, start=1):
                    objects[name] = draw_image(config, experiment, name, galaxies, folder, threads, stage.advance)
                    stage.advance()
                    stage.step(name, i, len(missing))
    return ImagesResult(folder, paths, kept, tuple(missing), objects)


def _claim(folder: Path, config: ImagesConfig, *, resume: bool) -> None:
    """Make the folder, or check that its images are of the same configuration, and write images.yaml."""
    path, now = folder / CONFIG_NAME, config.model_dump(mode="json", by_alias=True)

    def check() -> None:
        try:
            before = read_mapping(path, ProductError)
        except ProductError as error:
            raise ProductError(f"{folder} holds images that cannot be read ({error}); choose another --out") from None
        # No CCD depends on the others.
        if resume and isinstance(before.get("run"), dict):
            before["run"]["ccds"] = now["run"]["ccds"]
        found = differences(before, now)
        if found:
            text = "; ".join(found[:3])
            raise ProductError(f"{folder} holds images of another configuration ({text}); choose another --out")

    claim_folder(path, config.to_yaml().encode(), products="image_*.fits", check=check)
