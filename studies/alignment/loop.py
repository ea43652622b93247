"""The active-optics loop: visit after visit the telescope drifts, exposes its donuts, and is corrected."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ...core.arguments import check_arguments
from ...core.errors import ConfigError
from ...core.long_work import Execution
from ...core.plotting import BLUE, GREY, ORANGE, axes_at, styled
from ...core.random_streams import stream
from ...core.result import Result
from ...core.threads import one_blas_thread
from .config import AlignConfig
from .estimator import estimate_state, steady_covariance
from .exposure import expose, fit
from .field_quality import FieldMeans
from .scene import NOLL, AlignmentScene
from .store import VisitRecord, VisitStore

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Visits after which the expected state no longer changes.
_STEADY = 100


@dataclass(frozen=True, eq=False)
class Alignment(Result):
    """Visits of a loop. States are in units of the tolerances, in the order of the degrees of freedom.

    Attributes
    ----------
    scene : AlignmentScene
        Telescope, sensors and turbulence.
    designed : FieldMeans
        Quality of the telescope as designed.
    visits : tuple of FieldMeans
        Quality in each visit.
    states, estimates : ndarray, shape [n_visit, n]
        State of the telescope in each visit, and its estimate from the donuts.
    errors : ndarray, shape [n_visit, n]
        Expected standard deviations of the states.
    expected : ndarray, shape [n_visit]
        Expected rms of the wavefront over the field that misalignment adds [m].
    floor : float
        The same for a loop that has run for long: drift of one visit, turbulence and photons, those of each donut where
        it was last used [m].
    donuts : ndarray of int, shape [n_visit]
        Donuts that were used.
    first, last : VisitRecord
        Donuts of the first and the last visit.
    """

    _table = ("expected", "donuts", "states", "estimates", "errors")

    scene: AlignmentScene
    designed: FieldMeans
    visits: tuple[FieldMeans, ...]
    states: np.ndarray
    estimates: np.ndarray
    errors: np.ndarray
    expected: np.ndarray
    floor: float
    donuts: np.ndarray
    first: VisitRecord
    last: VisitRecord

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw the wavefront that misalignment adds, visit by visit, as it is and as expected."""
        with styled():
            figure, axes = axes_at(ax, 6.4, 3.8)
            axes.plot([1e9 * v.added for v in self.visits], "o-", color=BLUE, markersize=3.0, label="telescope")
            axes.plot(1e9 * self.expected, color=ORANGE, label="expected from the covariance")
            axes.axhline(1e9 * self.floor, color=GREY, linewidth=0.8, linestyle="--", label="floor")
            axes.set(xlabel="visit", ylabel="wavefront added [nm rms]")
            if np.all(self.expected > 0.0):
                axes.set_yscale("log")
            axes.legend()
            return figure


@check_arguments
def align(
    config: AlignConfig, *, folder: Path | None = None, store: Path | None = None, execution: Execution | None = None
) -> Alignment:
    """Run an active-optics loop.

    Parameters
    ----------
    config : AlignConfig
        All that decides the loop.
    folder : Path, optional
        Folder that relative paths in the configuration start from; the current one by default.
    store : Path, optional
        Folder for a file of each visit, from which a loop goes on that was killed, or that is to be longer.
    execution : Execution, optional
        Threads, progress display, and whether to go on with the visits of `store`, which are an error otherwise. There
        are no workers: each visit begins with the telescope that the one before leaves.

    Raises
    ------
    PachonError
        If a name does not exist, the models do not fit together, donuts do not fit on their stamps, or `store` holds
        visits of another configuration, or of other contents of the files that it names.
    """
    execution = execution or Execution()
    threads, reporter = execution.threads, execution.reporter
    if not execution.alone:
        raise ConfigError("execution.workers: expected none, each visit begins with the telescope of the one before")
    scene = AlignmentScene.of(config, folder)
    store_of_visits = (
        None if store is None else VisitStore.claimed(store, config, scene.inputs, resume=execution.resume)
    )
    errors, n = config.errors, len(scene.freedoms)
    drift = np.diag(scene.steps**2)
    covariance = errors.initial**2 * np.eye(n)
    state = errors.initial * _normals(config.seed, "initial", 0, n)
    quality, states, estimates, spreads, expected, used, fits = [], [], [], [], [], [], []
    photons = np.full((len(scene.stars), len(NOLL), len(NOLL)), np.nan)
    # Bytes must not depend on how BLAS shares sums among threads.
    with one_blas_thread(), reporter.stage("visits", config.visits) as stage:
        for visit in range(config.visits):
            telescope = scene.freedoms.apply(scene.telescope, state * scene.tolerances)
            record = None if store_of_visits is None else store_of_visits.read(visit)
            # The last visit of a shorter loop has no stamps where that is not its last one.
            if record is None or (len(record.images) == 0 and visit == config.visits - 1):
                fitted = fit(scene, expose(scene, telescope, visit, threads), threads)
                record = VisitRecord.of(scene.quality.means(telescope, threads), fitted)
                if store_of_visits is not None:
                    store_of_visits.write(visit, record)
            quality.append(record.quality)
            expected.append(scene.expected_wavefront(covariance))
            spreads.append(np.sqrt(np.diag(covariance)))
            rows = np.repeat(record.usable, len(NOLL))
            photons[record.usable] = record.covariance[record.usable]
            noise = scene.turbulence + _photon_noise(record.covariance)
            estimate = estimate_state(
                record.zernikes.ravel()[rows],
                noise[np.ix_(rows, rows)],
                scene.sensitivity[rows],
                covariance,
                drift,
                config.control.gain,
            )
            states.append(state)
            estimates.append(estimate.state)
            used.append(int(record.usable.sum()))
            fits.append(record)
            del fits[1:-1]
            state = state - config.control.gain * estimate.state
            state = state + scene.steps * _normals(config.seed, "drift", visit, n)
            covariance = estimate.covariance
            stage.advance()
            stage.step(f"visit {visit}: {1e9 * quality[-1].added:.0f} nm added", visit + 1, config.visits)
    start = errors.initial**2 * np.eye(n)
    rows = np.repeat(np.isfinite(photons).all(axis=(1, 2)), len(NOLL))
    noise = (scene.turbulence + _photon_noise(photons))[np.ix_(rows, rows)]
    with one_blas_thread():
        steady = steady_covariance(noise, scene.sensitivity[rows], start, drift, config.control.gain, _STEADY)
    return Alignment(
        scene=scene,
        designed=scene.quality.means(scene.telescope, threads),
        visits=tuple(quality),
        states=np.array(states),
        estimates=np.array(estimates),
        errors=np.array(spreads),
        expected=np.array(expected),
        floor=scene.expected_wavefront(steady),
        donuts=np.array(used),
        first=fits[0],
        last=fits[-1],
    )


def _normals(seed: int, what: str, visit: int, count: int) -> np.ndarray:
    return stream(seed, "alignment", what, visit).standard_normal(count)


def _photon_noise(covariance: np.ndarray) -> np.ndarray:
    """Return the covariance of the Zernikes of all donuts [m^2], [n_data, n_data], from those of each by photons."""
    n_star, n_noll, _ = covariance.shape
    out = np.zeros((n_star, n_noll, n_star, n_noll))
    for star in range(n_star):
        out[star, :, star] = covariance[star]
    return out.reshape(n_star * n_noll, -1)
