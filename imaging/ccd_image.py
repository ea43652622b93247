"""The image of one CCD of a configuration, drawn in this process or as the job of a worker."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..core.errors import ConfigError, DomainError, PachonError
from ..core.files import write_bytes
from ..core.products import Stamp
from ..pipeline.experiment import Experiment
from ..pipeline.screen_cache import with_cached_screens
from ..sky.pointing import Pointing
from .config import ImagesConfig
from .draw import Window
from .exposure import Exposure
from .galaxies import GalaxySource, SkyGalaxies
from .preview import cutouts_png, preview_png
from .scene import draw_ccd, stamped


def image_name(name: str) -> str:
    """Return the name of the file of a CCD."""
    return f"image_{name}.fits"


def stamp_of(config: ImagesConfig, experiment: Experiment) -> Stamp:
    """Return the stamp that all images of a configuration bear."""
    return Stamp(config.digest(experiment), experiment.config.seed)


def draw_by_worker(config: ImagesConfig, experiment: Experiment, name: str, threads: int, folder: Path) -> int:
    """Draw one CCD as the job of a worker, which keeps the phase screens of its last CCD for the next one."""
    experiment = with_cached_screens(experiment)
    experiment.make_screens(threads)
    return draw_image(config, experiment, galaxies_of(config, experiment), lambda: None, name, threads, folder)


def draw_image(
    config: ImagesConfig,
    experiment: Experiment,
    galaxies: Any,
    check: Callable[[], None],
    name: str,
    threads: int | None,
    folder: Path,
) -> int:
    """Draw, expose and write one CCD into a folder; return its number of objects.

    `check` is called now and then, and ends the work by raising.
    """
    pointing, path = config.pointing, folder / image_name(name)
    exposure = exposure_of(config, experiment)
    try:
        scene = draw_ccd(
            experiment,
            name,
            galaxies,
            exposure=exposure,
            pointing=Pointing(*map(math.radians, (pointing.ra_deg, pointing.dec_deg, pointing.position_angle_deg))),
            window=window_of(config, experiment, name),
            way=config.image.way,
            interpolation=config.image.interpolation,
            threads=threads,
            progress=lambda _: check(),
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
    try:
        return Exposure.of_run(experiment, image.exposures, **settings)
    except DomainError as error:
        # The sky has another name there.
        problem = error.problem.replace("sky =", "sky_mag =", 1)
        raise DomainError(problem, key=error.key).within(key="image") from None


def galaxies_of(config: ImagesConfig, experiment: Experiment) -> SkyGalaxies:
    """Return the function that gives the galaxies of a part of the sky."""
    settings, pointing = config.galaxies, config.pointing
    source = GalaxySource.read(
        settings,
        exposure_of(config, experiment),
        pointing=(math.radians(pointing.ra_deg), math.radians(pointing.dec_deg)),
        seed=experiment.config.seed,
    )
    # Catalogues and mosaics are drawn to their own depth.
    return source.down_to(settings.faintest if source.given is None else math.inf)
