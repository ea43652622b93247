"""Images of all CCDs of a configuration, in one folder."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..core.arguments import check_arguments
from ..core.errors import ConfigError, PachonError, ProductError, error_context
from ..core.files import claim_folder, write_bytes
from ..core.memory import require_bytes
from ..core.products import Stamp
from ..core.progress import Reporter
from ..core.units import ARCMIN, ARCSEC
from ..core.yaml_reader import read_mapping
from ..pipeline.config import differences
from ..pipeline.defaults import given
from ..pipeline.experiment import Experiment
from ..pipeline.memory import needed_bytes
from ..sky.catalogue import read_galaxies
from ..sky.mosaic import GalaxyStamps
from ..sky.population import GalaxyPopulation, counts
from .config import ImagesConfig
from .draw import Window
from .exposure import Exposure
from .image_file import is_whole
from .preview import cutouts_png, preview_png
from .scene import check_density, draw_ccd, stamped

#: Limits of the bins over which the light of a population is summed.
_MAGNITUDES = 200
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
    threads: int | None = None,
    reporter: Reporter | None = None,
) -> ImagesResult:
    """Draw, expose and write the CCDs of a configuration.

    Every file has the same bytes whenever and with however many threads it is made, whatever the other CCDs.

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
    names = given(experiment.config.ccds)
    windows, exposure = {name: _window(config, experiment, name) for name in names}, _exposure(config, experiment)
    galaxies = _galaxies(config, experiment, exposure)
    most = max(window.width * window.height for window in windows.values())
    require_bytes(needed_bytes(experiment, threads) + BYTES_PER_PIXEL * most, "images")
    stamp = Stamp(config.digest(experiment), experiment.config.seed)
    _claim(folder, resolved, resume=resume)
    paths = {name: folder / f"image_{name}.fits" for name in names}
    kept = tuple(name for name in names if resume and is_whole(paths[name], stamp))
    missing = [name for name in names if name not in kept]
    objects: dict[str, int] = {}
    if missing:
        with experiment.screens(threads, reporter):
            bar = reporter.stage(f"images of {len(missing)} CCDs", total=len(missing))
            with bar as stage:
                for i, name in enumerate(missing, start=1):
                    objects[name] = _image(
                        config,
                        experiment,
                        name,
                        galaxies,
                        exposure,
                        windows[name],
                        stamp,
                        paths[name],
                        threads,
                        stage.advance,
                    )
                    stage.advance()
                    stage.step(name, i, len(missing))
    return ImagesResult(folder, paths, kept, tuple(missing), objects)


def _image(
    config: ImagesConfig,
    experiment: Experiment,
    name: str,
    galaxies: Any,
    exposure: Exposure,
    window: Window,
    stamp: Stamp,
    path: Path,
    threads: int | None,
    check: Any,
) -> int:
    """Draw, expose and write one CCD; return its number of objects."""
    pointing = config.pointing
    try:
        scene = draw_ccd(
            experiment,
            name,
            galaxies,
            exposure=exposure,
            pointing=(math.radians(pointing.ra_deg), math.radians(pointing.dec_deg)),
            position_angle=math.radians(pointing.position_angle_deg),
            window=window,
            way=config.image.way,
            interpolation=config.image.interpolation,
            threads=threads,
            progress=lambda _: check(0),
        )
    except PachonError as error:
        raise error.within(subject=f"CCD {name}") from None
    image = stamped(scene.exposed(threads=threads), stamp)
    if config.image.preview:
        write_bytes(path.with_suffix(".png"), preview_png(image))
    if config.image.cutouts:
        write_bytes(path.with_name(f"cutouts_{name}.png"), cutouts_png(scene, threads=threads))
    # Last, since it is what a run that goes on looks for.
    image.write(path)
    return len(scene.objects["ID"])


def _window(config: ImagesConfig, experiment: Experiment, name: str) -> Window:
    """Return the part of a CCD that is drawn."""
    camera, side = experiment.camera, config.image.side
    nx, ny = camera.pixels[camera.ccd_index(name)].tolist()
    if side is None:
        return Window(0, 0, nx, ny)
    if side > min(nx, ny):
        text = f"image.side = {side}: expected at most {min(nx, ny)}, the pixels of a CCD"
        raise ConfigError(text, key="image.side")
    return Window((nx - side) // 2, (ny - side) // 2, side, side)


def _exposure(config: ImagesConfig, experiment: Experiment) -> Exposure:
    """Return depth and noise of the images."""
    image = config.image
    settings = {"sky": image.sky_mag, "subtract_background": image.subtract_background, "noise": image.noise}
    if image.gain is not None:
        settings["gain"] = image.gain
    with error_context(key="image"):
        return Exposure.of_run(experiment, image.exposures, **settings)


def _galaxies(config: ImagesConfig, experiment: Experiment, exposure: Exposure) -> Any:
    """Return the galaxies of the configuration, or the function that draws those of a part of the sky."""
    wanted, pointing = config.galaxies, config.pointing
    if wanted.catalogue is not None:
        return read_galaxies(wanted.catalogue, pointing=(math.radians(pointing.ra_deg), math.radians(pointing.dec_deg)))
    if wanted.mosaic is not None:
        seed = experiment.config.seed
        stamps = GalaxyStamps.from_mosaic(
            wanted.mosaic,
            zero_point=wanted.mosaic_zero_point,
            psf_radius=None if wanted.mosaic_psf_arcsec is None else wanted.mosaic_psf_arcsec * ARCSEC,
            finest_pixel=exposure.pixel_scale,
            seed=seed,
        )
        with error_context(key="galaxies"):
            planted = wanted.density * stamps.surface_density
            mean = planted * exposure.pixel_scale**2 * float(exposure.electrons(stamps.magnitude).mean())
            check_density(mean, exposure, f"density = {wanted.density:g}: ")
            return stamps.population(seed, density=planted * ARCMIN**2).galaxies_in
    with error_context(key="galaxies"):
        population = GalaxyPopulation(wanted.faintest, experiment.config.seed, wanted.brightest, wanted.density)
        magnitude = np.linspace(wanted.brightest, wanted.faintest, _MAGNITUDES)
        number = wanted.density * np.diff(counts(magnitude)) * (exposure.pixel_scale / ARCMIN) ** 2
        light = number * exposure.electrons(0.5 * (magnitude[:-1] + magnitude[1:]))
        check_density(float(light.sum()), exposure, f"density = {wanted.density:g}: ")
    return population.galaxies_in


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
