"""Cost of a visit by stage: processor time a CCD, from screens to the models of its stars.

    python benchmarks/visit_cost.py [--rafts R22,R23] [--all] [--visits 2] [--engine fast]

Makes the PSFs and the models of visits as `pachon visits` does, with 40 stars and 20 places a CCD, on one thread, after
one visit that loads kernels. Stages are timed by processor time, each without those within it that are listed. Then the
time a star of single calls of `make_psfs`: for one place, for the 60 of a CCD, and for 800 stars.
"""

import argparse
import hashlib
import time
from contextlib import contextmanager

import numpy as np

import pachon
from pachon import Experiment, PsfModel
from pachon.pipeline.config import with_options
from pachon.pipeline.simulate import ccd_exposure
from pachon.studies import VisitsConfig
from pachon.studies.visits import psf_visit
from pachon.studies.visits.config import STACK_STAMP
from pachon.studies.visits.visits import sky_points_of
from pachon.wavefront.psf.engine import PsfRenderer
from pachon.wavefront.psf.fast import FastRenderer

#: Stages by their functions: owner, attribute, name.
STAGES = [
    (Experiment, "make_screens", "screens (a visit)"),
    (ccd_exposure, "fields_of_groups", "fields of the places"),
    (ccd_exposure, "fields_at", "fields of the places"),
    (ccd_exposure, "make_psfs", "PSFs: everything else"),
    (ccd_exposure, "measure_shapes", "centroids"),
    (PsfRenderer, "_trace", "PSFs: ray trace"),
    (FastRenderer, "_deposit", "PSFs: rays through the screens"),
    (FastRenderer, "_transforms", "PSFs: transforms"),
    (FastRenderer, "_combine", "PSFs: filters"),
    (FastRenderer, "_stamps", "PSFs: stamps"),
    (psf_visit, "observe_ccd", "noise and centring of stars"),
    (psf_visit, "fit_ccd_models", "models: fit"),
    (PsfModel, "at", "models: PSFs at places"),
    (psf_visit, "resample_stamps", "resampling onto the stack"),
]


class Clock:
    """Processor time of stages, each without the stages within it."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._stack: list[str] = []
        self._since = time.process_time()

    def switch(self) -> None:
        now = time.process_time()
        if self._stack:
            self.seconds[self._stack[-1]] = self.seconds.get(self._stack[-1], 0.0) + now - self._since
        self._since = now

    @contextmanager
    def stage(self, name: str):
        self.switch()
        self._stack.append(name)
        try:
            yield
        finally:
            self.switch()
            self._stack.pop()

    def watch(self, owner: object, attribute: str, name: str) -> None:
        if not hasattr(owner, attribute):
            return
        # Class methods are bound before, so that their class comes along.
        bound = isinstance(vars(owner).get(attribute), classmethod)
        function = getattr(owner, attribute)

        def timed(*arguments, **options):
            with self.stage(name):
                return function(*arguments, **options)

        setattr(owner, attribute, staticmethod(timed) if bound else timed)


def time_visits(config: VisitsConfig, count: int) -> None:
    experiment = config.experiment()
    config = config.resolved(experiment)
    frame = psf_visit.StackFrame.of(experiment, STACK_STAMP)
    points = sky_points_of(experiment, config, frame)
    clock = Clock()
    for stage in STAGES:
        clock.watch(*stage)
    ccds, digest = len(experiment.config.ccds), hashlib.sha256()
    for visit in config.plan_of(count + 1, experiment.config.seed):
        if visit.number == 1:
            clock.seconds.clear()
        own = psf_visit.visit_experiment(experiment, visit)
        with clock.stage("everything else"):
            psfs = psf_visit.visit_psfs(own, visit, points, frame, threads=1)
        digest.update(psfs.true.tobytes() + psfs.model.tobytes())
    places = len(psfs.index) / ccds
    print(f"{ccds} CCDs, {count} visits, {places:.0f} places and stars a CCD; SHA-256 {digest.hexdigest()[:16]}")
    screens = clock.seconds.pop("screens (a visit)", 0.0) / count
    for name, seconds in sorted(clock.seconds.items(), key=lambda item: -item[1]):
        print(f"  {name:34s} {1e3 * seconds / count / ccds:7.1f} ms a CCD and visit")
    total = sum(clock.seconds.values()) / count / ccds
    psf = sum(s for name, s in clock.seconds.items() if name[:4] in ("PSFs", "fiel", "cent")) / count / ccds
    models = sum(s for name, s in clock.seconds.items() if name.startswith("models")) / count / ccds
    print(
        f"  PSFs {1e3 * psf:.0f} ms, models {1e3 * models:.0f} ms, all but screens {1e3 * total:.0f} ms a CCD and visit"
    )
    print(f"  screens {screens:.2f} s a visit; 189 CCDs with as many rows: {189 * total + screens:.0f} s a visit")


def time_calls(counts: tuple[int, ...], engine: str) -> None:
    telescope = pachon.load_telescope("lsst_v3.3_r")
    air = pachon.Atmosphere.from_site("cerro_pachon", seed=1)
    fields = 0.01 + np.random.default_rng(1).uniform(-2e-3, 2e-3, (max(counts), 2))
    wavelengths = np.linspace(545e-9, 703e-9, 5)

    def make(chosen_fields):
        return pachon.make_psfs(telescope, chosen_fields, wavelengths, atmosphere=air, engine=engine, threads=1)

    make(fields)
    for count in counts:
        best = np.inf
        for _ in range(3):
            start = time.process_time()
            make(fields[:count])
            best = min(best, time.process_time() - start)
        print(f"  a call of {count} stars: {1e3 * best / count:.2f} ms a star")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rafts", default="R22")
    parser.add_argument("--all", action="store_true")
    parser.add_argument("--visits", type=int, default=2)
    parser.add_argument("--engine", default="fast")
    options = parser.parse_args()
    config = VisitsConfig()
    ccds = ("all",) if options.all else tuple(options.rafts.split(","))
    run = with_options(config.run, ccds=ccds, psf__engine=options.engine)
    time_visits(config.model_copy(update={"run": run}), options.visits)
    time_calls((1, 60, 800), options.engine)


if __name__ == "__main__":
    main()
