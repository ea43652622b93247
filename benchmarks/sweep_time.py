"""Time of the Table 1 study on one and two processes, and overhead of store and scheduler.

Run: python benchmarks/sweep_time.py [points]

One and two processes take turns over the same points of the bundled study (189 CCDs of 20 stars each), under the
same load of the machine. Overhead is wall time in which no worker computes. The full study has 1000 points.
"""

import argparse
import resource
import tempfile
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

import pachon
from pachon import process_workers
from pachon.studies import load_sweep
from pachon.studies.sweep.point import PointMeasurement
from pachon.studies.sweep.store import SweepStore, create_store
from pachon.studies.sweep.sweep import numbered_points

PARSER = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
PARSER.add_argument("points", type=int, nargs="?", default=40, help="points of the sweep")
ARGUMENTS = PARSER.parse_args()
POINTS = ARGUMENTS.points
EXAMPLE = Path(__file__).parents[1] / "studies" / "sweep" / "examples" / "table1.yaml"
ROUNDS = 2


def measure(processes: int, points, sweep, folder: Path) -> tuple[float, float]:
    """Return wall and computing time of the points beyond the first of each worker [s]."""
    store = folder / f"{processes}.sweep"
    store.unlink(missing_ok=True)
    create_store(store, sweep, points, {})
    workers = process_workers(PointMeasurement(sweep, "."), processes, threads=processes)
    start, warm, busy = 0.0, 0, 0.0
    with SweepStore(store) as opened:
        for result in workers.results(points):
            assert result.problem is None, result.problem
            opened.write(result)
            warm += 1
            # A worker's first point pays for its imports and kernels, once a sweep.
            if warm == processes:
                start = time.perf_counter()
            elif warm > processes:
                busy += result.seconds
        return time.perf_counter() - start, busy


def main() -> None:
    sweep = load_sweep(EXAMPLE)
    points = numbered_points(sweep, Path())
    print(f"pachon {pachon.__version__}: {sweep.name}, {len(points)} points, of which {POINTS} are computed")
    chosen = [replace(p, number=i) for i, p in enumerate(points[:: len(points) // POINTS][:POINTS])]
    with tempfile.TemporaryDirectory() as folder:
        run = partial(measure, points=chosen, sweep=sweep, folder=Path(folder))
        times = {1: [], 2: []}
        for _ in range(ROUNDS):
            for processes in times:
                wall, busy = run(processes)
                times[processes].append(wall)
                rate = (POINTS - processes) / wall
                print(
                    f"{processes} process{'es' * (processes > 1)}: {rate:.2f} points/s, {1000 / rate / 60:.1f} min for "
                    f"1000; store and hand-out {100 * (1 - busy / (wall * processes)):.1f} % of the time"
                )
        ratios = np.array(times[1]) / (POINTS - 1) * (POINTS - 2) / np.array(times[2])
        low, high = ratios.min(), ratios.max()
        print(f"two processes are {np.median(ratios):.2f} times as fast as one (from {low:.2f} to {high:.2f})")
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024**2
    print(f"largest worker: {peak:.2f} GiB")


if __name__ == "__main__":
    main()
