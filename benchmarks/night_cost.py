"""Cost of the visits of a list: processor time and memory of a few visits, and what a night and ten years would take.

    python benchmarks/night_cost.py visits.csv                # fast engine, models, 20 places and 40 stars a CCD
    python benchmarks/night_cost.py visits.csv --engine statistical --no-models

Two runs, of one raft and of five, give the time of a visit (configuration, air, files) and that of a CCD. Tables, maps
and the report of a night, which are written again as it grows, are timed alone, by a run that goes on after its end.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from pathlib import Path

from pachon import Execution
from pachon.studies import NightConfig, run_night
from pachon.wavefront.atmosphere import exposure_fields

#: Visits of a night, and of ten years of the LSST.
NIGHT = 850
TEN_YEARS = 2_000_000
#: CCDs of the LSST.
CCDS = 189
#: Rafts of the larger run, the first of which are the smaller one.
RAFTS = ("R22", "R02", "R20", "R24", "R42")


def seconds_of(settings, ccds):
    """Return the processor time of visits of CCDs, on one thread."""
    run = {
        "ccds": ccds,
        "psf": {"engine": settings.engine},
        "stars": {"truth": settings.places, "observed": settings.stars},
    }
    config = NightConfig.model_validate(
        {
            "run": run,
            "visits": {"list": str(settings.list.resolve()), "where": settings.where},
            "models": not settings.no_models,
            "maps": {"nside": settings.nside},
        }
    )
    # Visits of a night differ in their air: nothing of the run before is used again but the optics of a band.
    for stored in (exposure_fields.draw_exposure, exposure_fields.moment_spectrum):
        stored.cache_clear()
    with tempfile.TemporaryDirectory() as folder:
        start = time.process_time()
        result = run_night(config, Path(folder), execution=Execution(threads=1))
        middle = time.process_time()
        run_night(config, Path(folder), execution=Execution(threads=1, resume=True))
        report = time.process_time() - middle
        size = sum(path.stat().st_size for path in Path(folder, "visits").iterdir())
    count = len(result.visits)
    # Of a few visits they are written after each.
    seconds = (middle - start - count * report) / count
    print(
        f"{len(ccds)} CCDs, {count} visits: {seconds:.2f} s and {size / count / 1e3:.0f} kB a visit; "
        f"tables, maps and report {report:.1f} s"
    )
    return seconds


def main():
    """Measure and print."""
    parser = argparse.ArgumentParser()
    parser.add_argument("list", type=Path)
    parser.add_argument("--engine", default="fast")
    parser.add_argument("--where")
    parser.add_argument("--places", type=int, default=20)
    parser.add_argument("--stars", type=int, default=40)
    parser.add_argument("--nside", type=int, default=512)
    parser.add_argument("--no-models", action="store_true")
    settings = parser.parse_args()
    ccds = [f"{raft}_S{i}{j}" for raft in RAFTS for i in range(3) for j in range(3)]
    raft_size = len(ccds) // len(RAFTS)
    seconds_of(settings, ccds[:1])  # kernels are compiled
    few, many = seconds_of(settings, ccds[:raft_size]), seconds_of(settings, ccds)
    of_ccd = (many - few) / (len(ccds) - raft_size)
    of_visit = few - raft_size * of_ccd
    whole = of_visit + CCDS * of_ccd
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"{of_visit:.2f} s a visit and {of_ccd:.3f} s a CCD; {memory:.1f} GiB")
    print(f"{CCDS} CCDs: {whole:.0f} s a visit, {NIGHT * whole / 3600:.1f} h a night of {NIGHT} visits,")
    print(f"{TEN_YEARS * whole / 3600 / 24 / 365.25:.1f} years of one core for {TEN_YEARS} visits")


if __name__ == "__main__":
    main()
