"""Cost of the visits of a list: processor time and memory of whole visits, and what a night and ten years would take.

    python benchmarks/night_cost.py visits.csv                # fast engine, models, 20 places and 40 stars a CCD
    python benchmarks/night_cost.py visits.csv --engine statistical --no-models

Each visit is computed on one thread as a worker of the command does; its air is its own, and only the optics of a band
are used again. The least of the visits is nearest to what a quiet processor takes. Tables, maps and the report of a
night, which are written again as it grows, are timed once, of the same visits with one CCD.
"""

from __future__ import annotations

import argparse
import resource
import statistics
import tempfile
import time
from pathlib import Path

from pachon import Execution
from pachon.core.products import Stamp
from pachon.pipeline.listed_visit import visit_experiment
from pachon.studies import NightConfig, run_night
from pachon.studies.night.visit_product import VisitWork
from pachon.wavefront.atmosphere import exposure_fields

#: Visits of a night, and of ten years of the LSST.
NIGHT = 850
TEN_YEARS = 2_000_000


def night_config(settings, ccds):
    """Return the night of the settings on some CCDs."""
    run = {
        "ccds": ccds,
        "psf": {"engine": settings.engine},
        "stars": {"truth": settings.places, "observed": settings.stars},
    }
    return NightConfig.model_validate(
        {
            "run": run,
            "visits": {"list": str(settings.list.resolve()), "where": settings.where},
            "models": not settings.no_models,
            "maps": {"nside": settings.nside},
        }
    )


def seconds_of_report(settings):
    """Return the processor time of tables, maps and report; kernels are compiled and optics traced besides."""
    config = night_config(settings, ["R22_S11"])
    with tempfile.TemporaryDirectory() as folder:
        run_night(config, Path(folder), execution=Execution(threads=1))
        start = time.process_time()
        run_night(config, Path(folder), execution=Execution(threads=1, resume=True))
        return time.process_time() - start


def seconds_of_visits(settings):
    """Return the processor time of each visit, its CCDs and the size of its file [byte]."""
    config = night_config(settings, ["all"])
    visits = config.read_list(None)
    experiment = visit_experiment(config.run, visits[0], None)
    config = config.started(visits, experiment, None)
    work = VisitWork(config, Stamp(config.content_digest(experiment), experiment.config.seed), None)
    seconds = []
    with tempfile.TemporaryDirectory() as folder:
        for index in range(min(len(visits), settings.visits)):
            # Visits of a night differ in their air: nothing of the one before is used again.
            for stored in (exposure_fields.draw_exposure, exposure_fields.moment_spectrum):
                stored.cache_clear()
            start = time.process_time()
            reason = work.compute_here(None, visits[index], 1, Path(folder))
            seconds.append(time.process_time() - start)
            if reason:
                raise SystemExit(f"{visits[index].label}: {reason}")
        size = sum(path.stat().st_size for path in Path(folder).iterdir()) / len(seconds)
    return seconds, len(experiment.config.ccds), size


def main():
    """Measure and print."""
    parser = argparse.ArgumentParser()
    parser.add_argument("list", type=Path)
    parser.add_argument("--engine", default="fast")
    parser.add_argument("--where")
    parser.add_argument("--visits", type=int, default=4, help="visits to compute, at most")
    parser.add_argument("--places", type=int, default=20)
    parser.add_argument("--stars", type=int, default=40)
    parser.add_argument("--nside", type=int, default=512)
    parser.add_argument("--no-models", action="store_true")
    settings = parser.parse_args()
    report = seconds_of_report(settings)
    seconds, ccds, size = seconds_of_visits(settings)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    middle, least = statistics.median(seconds), min(seconds)
    print(f"{len(seconds)} visits of {ccds} CCDs: {least:.1f} to {max(seconds):.1f} s each, median {middle:.1f} s;")
    print(f"{size / 1e3:.0f} kB a visit; tables, maps and report {report:.1f} s; {memory:.1f} GiB")
    for name, each in (("median", middle), ("least", least)):
        night, years = NIGHT * each / 3600.0, TEN_YEARS * each / 3600.0 / 24.0 / 365.25
        print(
            f"by the {name}: {night:.1f} h of one core a night of {NIGHT} visits, {0.5 * night:.2f} h on two; "
            f"{years:.1f} years of one for {TEN_YEARS} visits"
        )


if __name__ == "__main__":
    main()
