"""The image of one CCD of a configuration, drawn by this process or as the job of a worker."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..core.errors import ConfigError, PachonError, ProductError, error_context
from ..core.files import folder_of_worker, marked_folder, write_bytes
from ..core.products import Stamp
from ..core.progress import Reporter
from ..core.workers import MakeWorkers
from ..pipeline.ccd_worker import CcdJob
from ..pipeline.experiment import Experiment
from ..pipeline.memory import check_memory
from ..pipeline.screen_cache import with_cached_screens
from .config import ImagesConfig
from .draw import Window
from .exposure import Exposure
from .galaxies import GalaxySource, SkyGalaxies
from .preview import cutouts_png, preview_png
from .scene import draw_ccd, stamped


@dataclass(frozen=True)
class DrawnImage:
    """Result of one CCD, as a worker returns it."""

    name: str
    objects: int = 0  #: number of objects on it
    files: tuple[tuple[str, bytes], ...] = ()  #: names and contents, where the worker does not share the folder
    problem: str | None = None  #: one line: the CCD could not be drawn, or a file not be written


@dataclass(frozen=True)
class ImageComputation:
    """Draw CCDs of a configuration; a picklable function for every kind of worker."""

    config: ImagesConfig
    experiment: Experiment
    folder: Path
    mark: str  #: file in the folder, by which workers that share it are told

    def __call__(self, job: CcdJob, threads: int) -> DrawnImage:
        """Draw one CCD."""
        experiment = with_cached_screens(self.experiment)
        try:
            experiment.make_screens(threads)
            galaxies = galaxies_of(self.config, experiment)
            with folder_of_worker(self.folder, self.mark) as place:
                objects = draw_image(self.config, experiment, job.name, galaxies, place, threads)
                # The image last: a resumed run takes it for the sign of a finished CCD.
                own = sorted(place.iterdir(), key=lambda path: path.name == image_name(job.name))
                sent = () if place == self.folder else tuple((path.name, path.read_bytes()) for path in own)
        except PachonError as error:
            return DrawnImage(job.name, problem=" ".join(str(error).split()))
        return DrawnImage(job.name, objects, sent)


def draw_by_workers(
    config: ImagesConfig,
    experiment: Experiment,
    folder: Path,
    names: Sequence[str],
    workers: MakeWorkers,
    reporter: Reporter,
) -> dict[str, int]:
    """Have workers draw CCDs into a folder, and return the number of objects on each.

    Raises
    ------
    ProductError
        If a CCD cannot be drawn, a file cannot be written, or a worker is lost.
    """
    objects: dict[str, int] = {}
    with marked_folder(folder) as mark:
        chosen = workers(ImageComputation(config, experiment, folder.resolve(), mark))
        check_memory(experiment, 1, copies=chosen.processes)
        with reporter.stage(f"images of {len(names)} CCDs, {chosen.description}", len(names)) as stage:
            for number, drawn in enumerate(chosen.results(CcdJob(name) for name in names), start=1):
                if drawn.problem is not None:
                    raise ProductError(drawn.problem)
                for name, data in drawn.files:
                    write_bytes(folder / name, data)
                objects[drawn.name] = drawn.objects
                stage.advance()
                stage.step(drawn.name, number, len(names))
    return {name: objects[name] for name in names}


def image_name(name: str) -> str:
    """Return the name of the file of a CCD."""
    return f"image_{name}.fits"


def stamp_of(config: ImagesConfig, experiment: Experiment) -> Stamp:
    """Return the stamp that all images of a configuration bear."""
    return Stamp(config.digest(experiment), experiment.config.seed)


def draw_image(
    config: ImagesConfig,
    experiment: Experiment,
    name: str,
    galaxies: Any,
    folder: Path,
    threads: int | None,
    check: Callable[[int], None] | None = None,
) -> int:
    """Draw, expose and write one CCD into a folder; return its number of objects."""
    pointing, path = config.pointing, folder / image_name(name)
    exposure = exposure_of(config, experiment)
    try:
        scene = draw_ccd(
            experiment,
            name,
            galaxies,
            exposure=exposure,
            pointing=(math.radians(pointing.ra_deg), math.radians(pointing.dec_deg)),
            position_angle=math.radians(pointing.position_angle_deg),
            window=window_of(config, experiment, name),
            way=config.image.way,
            interpolation=config.image.interpolation,
            threads=threads,
            progress=None if check is None else lambda _: check(0),
        )
    except PachonError as error:
        raise error.within(subject=f"CCD {name}") from None
    image = stamped(scene.exposed(threads=threads), stamp_of(config, experiment))
    if config.image.preview:
        write_bytes(path.with_suffix(".png"), preview_png(image))
    if config.image.cutouts:
        write_bytes(path.with_name(f"cutouts_{name}.png"), cutouts_png(scene, threads=threads))
    # Last: a resumed run takes it for the sign of a finished CCD.
    image.write(path)
    return len(scene.objects["ID"])


def window_of(config: ImagesConfig, experiment: Experiment, name: str) -> Window:
    """Return the part of a CCD that is drawn."""
    camera, side = experiment.camera, config.image.side
    nx, ny = camera.pixels[camera.ccd_index(name)].tolist()
    if side is None:
        return Window(0, 0, nx, ny)
    if side > min(nx, ny):
        text = f"image.side = {side}: expected at most {min(nx, ny)}, the pixels of a CCD"
        raise ConfigError(text, key="image.side")
    return Window((nx - side) // 2, (ny - side) // 2, side, side)


def exposure_of(config: ImagesConfig, experiment: Experiment) -> Exposure:
    """Return depth and noise of the images."""
    image = config.image
    settings = {"sky": image.sky_mag, "subtract_background": image.subtract_background, "noise": image.noise}
    if image.gain is not None:
        settings["gain"] = image.gain
    with error_context(key="image"):
        return Exposure.of_run(experiment, image.exposures, **settings)


def galaxies_of(config: ImagesConfig, experiment: Experiment) -> SkyGalaxies:
    """Return the function that gives the galaxies of a part of the sky."""
    wanted, pointing = config.galaxies, config.pointing
    source = GalaxySource.read(
        wanted,
        exposure_of(config, experiment),
        pointing=(math.radians(pointing.ra_deg), math.radians(pointing.dec_deg)),
        seed=experiment.config.seed,
    )
    # Catalogues and mosaics are drawn to their own depth.
    return source.down_to(wanted.faintest if source.given is None else math.inf)
