"""Memory that a run needs, checked before anything is computed."""

from __future__ import annotations

from dataclasses import replace

from ..core.errors import ConfigError
from ..core.memory import available_bytes, readable
from ..core.threads import thread_count
from .experiment import Experiment
from .resolved_values import resolved_value

# Measured on runs of 0.5 to 2.6 GB (both engines, screens of 512 to 8192, 140 to 8000 stars on a CCD): the estimate is
# 3 to 18 % above the peak.
# Python with its libraries and kernels while PSFs are made [byte].
_BASE = 400_000_000
# The same with the pictures of the report, when the screens are gone [byte].
_REPORT = 650_000_000
# A thread of the wave engine: fields, intensities and spectra of a star at five wavelengths [byte].
_WAVE_THREAD = 150_000_000
# The same in silicon besides: intensities and phases of three depths of each [byte].
_SILICON_THREAD = 110_000_000
# Copies of the stamps of a CCD's stars that are held at once, in bytes a pixel.
_STAMP_BYTES = 48


def screen_bytes(experiment: Experiment) -> int:
    """Return the memory of the screens of an experiment, as far as its CCDs need them [bytes]."""
    air, kinds = experiment.atmosphere, experiment.screen_kinds
    if air is None:
        return 0
    return air.screen_bytes(kinds, experiment.screen_rows if "slopes" in kinds else None)


def needed_bytes(experiment: Experiment, threads: int | None = None) -> int:
    """Return an estimate of the peak memory of a run [bytes]."""
    config = experiment.config
    observed_counts = [experiment.observed_count(name) for name in resolved_value(config.ccds)]
    stars = config.stars.truth + max(observed_counts)
    workers = thread_count(threads) if config.psf.engine == "wave" else 0
    stamps = stars * experiment.stamp_size**2 * _STAMP_BYTES
    of_worker = _WAVE_THREAD + (0 if experiment.silicon is None else _SILICON_THREAD)
    # The report holds the PSF model of every CCD; one without components stores each star, and its weight in kriging.
    stored_stars = 0 if config.reconstruction.psf_recipe().basis.has_components else sum(observed_counts)
    models = 16 * stored_stars * experiment.stamp_size**2
    return max(_REPORT + models, _BASE + screen_bytes(experiment) + workers * of_worker + stamps)


def check_memory(experiment: Experiment, threads: int | None = None, *, copies: int = 1) -> None:
    """Raise ConfigError, with the key that takes most of it, if a run needs more memory than is available.

    `copies` are the processes of this machine that each hold the whole of it; 0 where all are on others.
    """
    free, needed = available_bytes(), needed_bytes(experiment, threads)
    if free is None or copies * needed <= free:
        return
    if needed <= free:
        raise ConfigError(
            f"{copies} processes need about {readable(copies * needed)} of memory, {readable(free)} are free; "
            f"{int(free // needed)} would do"
        )
    short = f"needs about {readable(needed)} of memory, {readable(free)} are free"
    other_bytes = needed - screen_bytes(experiment)
    stars = experiment.config.stars
    if other_bytes > free or experiment.atmosphere is None:
        star_count = max(map(experiment.observed_count, resolved_value(experiment.config.ccds)))
        raise ConfigError(f"stars.truth = {stars.truth}, stars.observed = {star_count}: {short}")
    smaller = experiment.atmosphere
    while smaller.screen_size > 16 and other_bytes + screen_bytes(replace(experiment, atmosphere=smaller)) > free:
        smaller = replace(smaller, screen_size=smaller.screen_size // 2)
    raise ConfigError(
        f"atmosphere.screen_size = {experiment.atmosphere.screen_size}: {short}; {smaller.screen_size} would do with"
        f" {readable(other_bytes + screen_bytes(replace(experiment, atmosphere=smaller)))}"
    )
