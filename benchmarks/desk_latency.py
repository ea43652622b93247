"""Time from a move of a slider to the redrawn pictures of the desk, for the LSST.

Run: python benchmarks/desk_latency.py [moves]

Moves of M2 along the axis on one page: spots of 21 fields, the OPD map and Zernikes at the star, and whiskers on the
189 CCDs are drawn at once; then the images of the star and the layout; 10 whiskers a CCD last, where they are wanted.
Sources of Bokeh are updated as they are for a browser, whose own time (some 50 ms a picture's worth of data) is not in
it. Beside the clock stands the processor time of all threads, which other work on the machine changes less. The growth
of the resident memory over the moves is printed too.
"""

import argparse
import resource
import time

import numpy as np

from pachon.desk.bench import Bench
from pachon.desk.session import Session
from pachon.desk.views import Scene, whiskers_view

PARSER = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
PARSER.add_argument("moves", type=int, nargs="?", default=40, help="moves of the slider")
ARGUMENTS = PARSER.parse_args()
MOVES = ARGUMENTS.moves


def timed(function) -> tuple[float, float]:
    """Return the time of a call by the clock, and of the processors [ms]."""
    start, processors = time.perf_counter(), time.process_time()
    function()
    return 1e3 * (time.perf_counter() - start), 1e3 * (time.process_time() - processors)


def show(name: str, times: list[tuple[float, float]]) -> None:
    """Print the median and the 95th percentile by the clock, and the median of the processors."""
    clock, processors = np.transpose(times)
    shown = f"median {np.median(clock):6.0f} ms, 95 % {np.quantile(clock, 0.95):6.0f} ms"
    print(f"{name:40s} {shown}, processors {np.median(processors):6.0f} ms")


bench = Bench("lsst_v3.3_r")
session = Session(bench)
session.schedule = lambda: None
fast, slow, many = [], [], []
memory = 0
for move in range(MOVES):
    value = 0.5 * ((move % 40) - 20)
    fast.append(timed(lambda: (session.set_value("optics.M2_dz", value), session.redraw_fast())))  # noqa: B023
    slow.append(timed(session.redraw_slow))
    if move % 10 == 0:
        scene = Scene.of(bench, session.history.state)
        many.append(timed(lambda: whiskers_view(scene, 10)))  # noqa: B023 - called at once
    if move == min(20, MOVES - 1):
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
show("spots, OPD, Zernikes, 189 whiskers", fast)
show("images, encircled energy, layout", slow)
show("189 x 10 whiskers", many)
print(f"growth of the peak memory: {(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory) / 1024:.0f} MiB")
