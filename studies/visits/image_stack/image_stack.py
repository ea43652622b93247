"""Stack of the images of many visits: its settings and its files."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ....core.errors import ConfigError, ProductError, error_context
from ....core.products import Stamp
from ....imaging.exposure import Exposure
from ....imaging.image_file import CcdImage
from ....imaging.wcs import CcdWcs, ccd_wcs
from ....models.camera.camera import Camera
from ....pipeline.experiment import Experiment
from ....pipeline.resolved_values import resolved_value
from ....pipeline.run_folder import CONFIG_NAME
from ..config import STACK_STAMP, VisitsConfig, load_visits_configuration
from ..plan import Visit
from ..psf_visit import StackFrame, middle_wavelength, stack_limit, visit_telescope
from ..visits import sky_points_of
from .config import ImageStackConfig, load_image_stack_configuration
from .tiles import Tile, choose_tiles
from .visit_image import Sky
from .visit_wcs import VisitWcs

#: Folder of the products in that of the visits.
FOLDER_NAME = "images"
#: File of the settings in the folder of the products.
SETTINGS_NAME = "images.yaml"
#: S/N of a star as faint as the faintest galaxies in the stack of all visits, and its FWHM: fainter ones are not
#: detected, and all of those below together are 3 % of its noise in a pixel.
_FAINTEST_SNR = 4.0


@dataclass(frozen=True, eq=False)
class ImageStack:
    """Stack of the images of a folder of visits, made or to be made.

    Attributes
    ----------
    folder : Path
        Of the images.
    visits : VisitsConfig
        Configuration of the visits.
    settings : ImageStackConfig
        Of the images, without open values.
    experiment : Experiment
        Experiment of the visits.
    frame : StackFrame
        Common frame.
    tiles : list of Tile
        Tiles of the sky.
    sky : Sky
        Stars and galaxies.
    stamp : Stamp
        Origin of the products.
    """

    folder: Path
    visits: VisitsConfig
    settings: ImageStackConfig
    experiment: Experiment
    frame: StackFrame
    tiles: list[Tile]
    sky: Sky
    stamp: Stamp

    @classmethod
    def of(cls, visits_folder: Path, settings: ImageStackConfig | None = None) -> ImageStack:
        """Return the stack of a folder of visits, by default with the settings that its images were made with.

        Raises
        ------
        PachonError
            If the folder holds no visits or no images, or the settings do not fit.
        """
        if not (visits_folder / CONFIG_NAME).exists():
            raise ProductError(f"{visits_folder}: no visits (no {CONFIG_NAME}); expected the folder of pachon visits")
        visits = load_visits_configuration(visits_folder / CONFIG_NAME)
        if visits.visits.from_list is not None:
            raise ProductError(f"{visits_folder} has visits of a list: expected visits of one sky and time")
        with error_context(file=visits_folder / CONFIG_NAME):
            experiment = visits.experiment()
        folder = visits_folder / FOLDER_NAME
        before = _settings_before(folder)
        if settings is None and before is None:
            raise ProductError(f"{visits_folder}: no images; expected the folder of pachon stack-images")
        settings = _resolved_settings(settings or before or ImageStackConfig(), before, visits, experiment)
        frame = StackFrame.of(experiment, STACK_STAMP)
        source = visits.galaxy_source(experiment, _exposure(experiment, frame))
        galaxies_in = source.down_to(resolved_value(settings.faintest))
        return cls(
            folder,
            visits,
            settings,
            experiment,
            frame,
            choose_tiles(experiment, frame, resolved_value(settings.side), settings.tiles, visits),
            Sky(sky_points_of(experiment, visits, frame), galaxies_in),
            Stamp(visits.galaxies_digest(experiment, images=settings.model_dump(mode="json")), experiment.config.seed),
        )

    def exposure(self, visits: int = 1) -> Exposure:
        """Return depth and noise of the stack of a number of visits."""
        return _exposure(self.experiment, self.frame, visits, noise=self.settings.noise)

    @property
    def plan(self) -> tuple[Visit, ...]:
        """The visits."""
        return self.visits.plan(self.experiment.config.seed)

    def wcs(self, visits: Sequence[Visit], threads: int | None = None) -> Iterator[tuple[Visit, dict[str, VisitWcs]]]:
        """Yield visits with the world coordinates of their CCDs."""
        camera, wavelength = self.experiment.camera, middle_wavelength(self.experiment)
        wcs_by_rotator: dict[float | None, dict[str, CcdWcs]] = {}
        for visit in visits:
            # About the visit's own pointing, at a position angle of 0, all visits of a rotator angle have the same.
            if visit.rotator_deg not in wcs_by_rotator:
                telescope = visit_telescope(self.experiment, visit)
                camera_wcs = {
                    name: ccd_wcs(telescope, camera, name, wavelength=wavelength, threads=threads)
                    for name in resolved_value(self.experiment.config.ccds)
                }
                wcs_by_rotator = {visit.rotator_deg: camera_wcs}
            yield visit, {name: VisitWcs(ccd, visit) for name, ccd in wcs_by_rotator[visit.rotator_deg].items()}

    def path(self, visits: int, tile: Tile) -> Path:
        """Return the path of the image of a tile in the stack of a number of visits."""
        return self.folder / f"stack_{visits:04d}_tile_{tile.name}.fits"

    def sums_path(self, tile: Tile) -> Path:
        """Return the path of the sums of a tile."""
        return self.folder / f"sums_tile_{tile.name}.fits"

    def image(self, visits: int, tile: Tile) -> CcdImage:
        """Read the image of a tile; ProductError where there is none of these settings, or it is damaged."""
        path = self.path(visits, tile)
        image = CcdImage.read(path)
        if image.stamp != self.stamp:
            raise ProductError("was made with another version, configuration or seed", file=path)
        return image


def tile_side(camera: Camera) -> int:
    """Return the pixels along a side of a square as large as the largest CCD."""
    return int(np.ceil(np.sqrt(camera.pixels.prod(axis=1).max())))


def _resolved_settings(
    settings: ImageStackConfig, before: ImageStackConfig | None, visits: VisitsConfig, experiment: Experiment
) -> ImageStackConfig:
    """Return settings without open values, which are first those of the images that there are."""
    side, faintest = settings.side, settings.faintest
    if before is not None:
        side, faintest = side or before.side, faintest or before.faintest
    if side is None:
        side = tile_side(experiment.camera)
    if faintest is None:
        faintest = round(stack_limit(experiment, _FAINTEST_SNR, visits.visits.count), 2)
    camera, config = experiment.camera, experiment.config
    if not np.isclose(experiment.pixel_size, camera.pixel_size) or not config.atmosphere.enabled:
        raise ConfigError(
            f"psf.pixel_um = {experiment.pixel_size * 1e6:g}, atmosphere.enabled = {config.atmosphere.enabled}: images "
            f"expect pixels of {camera.pixel_size * 1e6:g} um and an atmosphere"
        )
    return settings.model_copy(update={"side": side, "faintest": float(faintest)})


def _exposure(experiment: Experiment, frame: StackFrame, visits: int = 1, *, noise: bool = True) -> Exposure:
    # Stacks are in electrons.
    return Exposure.of_run(experiment, visits, gain=1.0, pixel_scale=frame.pixel_scale, noise=noise)


def _settings_before(folder: Path) -> ImageStackConfig | None:
    path = folder / SETTINGS_NAME
    return load_image_stack_configuration(path) if path.exists() else None
