"""PSF model of all CCDs of an exposure, from the files of its images."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from ..core.errors import ConfigError
from ..core.number_text import counted
from ..core.progress import Reporter
from ..models.telescope import Telescope
from ..pipeline.focal_plane_stage import fit_focal_plane_model
from ..reconstruction.focal_plane_psf.model import FocalPlanePsf
from .config import load_images_configuration
from .image_file import CcdImage
from .image_stars import focal_plane_stars
from .simulate import CONFIG_NAME


def fit_exposure_psf(
    paths: Sequence[Path],
    telescope: Telescope | None = None,
    *,
    min_snr: float = 30.0,
    threads: int | None = None,
    reporter: Reporter | None = None,
) -> FocalPlanePsf:
    """Fit one PSF model to the selected stars of all images of an exposure.

    Without a telescope the configuration of ``pachon images`` beside the first image says all that is known of
    telescope, air and heights, but not how these were drawn.

    Parameters
    ----------
    paths : sequence of Path
        Images of :class:`CcdImage`, read one after the other.
    telescope : Telescope, optional
        Telescope with its camera, in place of that configuration.
    min_snr : float
        Least S/N of stars.
    threads : int, optional
        Number of threads; all processors by default. No byte depends on it.
    reporter : Reporter, optional
        Progress display; silent by default.

    Raises
    ------
    ConfigError
        If there is neither a telescope nor a configuration.
    PachonError
        If a file cannot be read, or there are too few stars.
    """
    reporter = Reporter(quiet=True) if reporter is None else reporter
    config = paths[0].parent / CONFIG_NAME
    if telescope is None and not config.exists():
        raise ConfigError(f"no {config} for the focal-plane model; expected a telescope", key="telescope")
    experiment = None if telescope is not None else load_images_configuration(config).experiment(config.parent)
    weight: dict[str, Any] = {} if experiment is None else {"weight_fwhm": experiment.weight_fwhm}
    with reporter.stage(f"stars of {counted(len(paths), 'image')}", total=len(paths)) as stage:

        def images() -> Iterator[CcdImage]:
            for number, path in enumerate(paths, start=1):
                yield CcdImage.read(path)
                stage.advance()
                stage.step(path.name, number, len(paths))

        stars = focal_plane_stars(images(), min_snr=min_snr, **weight)
    options: dict[str, Any] = {"ccds": list(dict.fromkeys(stars.ccd)), "threads": threads, "reporter": reporter}
    if experiment is None:
        return FocalPlanePsf.fit(stars, telescope, **options)
    return fit_focal_plane_model(experiment, stars, **options)
