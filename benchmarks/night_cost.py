"""Cost of the visits of a list: processor time and memory of a few visits, and what a night and ten years would take.

    python benchmarks/night_cost.py visits.csv                # fast engine, models, 20 places and 40 stars a CCD
    python benchmarks/night_cost.py visits.csv --engine long_exposure --no-models

Two runs, of a few CCDs and of more, give the time of a visit (configuration, screens, files) and that of a CCD.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from pathlib import Path

from pachon import Execution
from pachon.studies import NightConfig, run_night

#: Visits of a night, and of ten years of the LSST.
NIGHT = 850
TEN_YEARS = 2_000_000
#: CCDs of the LSST.
CCDS = 189


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
    with tempfile.TemporaryDirectory() as folder:
        start = time.process_time()
        result = run_night(config, Path(folder), execution=Execution(threads=1))
        seconds = time.process_time() - start
        size = sum(path.stat().st_size for path in Path(folder, "visits").iterdir())
    count = len(result.visits)
    print(f"{len(ccds)} CCDs, {count} visits: {seconds / count:.2f} s a visit, {size / count / 1e3:.0f} kB a visit")
    return seconds / count


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
    rafts = [f"R22_S{i}{j}" for i in range(3) for j in range(3)]
    seconds_of(settings, rafts[:1])  # kernels are compiled
    few, many = seconds_of(settings, rafts[:3]), seconds_of(settings, rafts)
    of_ccd = (many - few) / (len(rafts) - 3)
    of_visit = few - 3 * of_ccd
    whole = of_visit + CCDS * of_ccd
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"{of_visit:.2f} s a visit and {of_ccd:.3f} s a CCD; {memory:.1f} GiB")
    print(f"{CCDS} CCDs: {whole:.0f} s a visit, {NIGHT * whole / 3600:.1f} h a night of {NIGHT} visits,")
    print(f"{TEN_YEARS * whole / 3600 / 24 / 365.25:.1f} years of one core for {TEN_YEARS} visits")


if __name__ == "__main__":
    main()
