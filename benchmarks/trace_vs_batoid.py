"""Time of the trace of a million rays, beside batoid's.

Run: python benchmarks/trace_vs_batoid.py [rays]

Three telescopes: the LSST's baseline (conics and even aspheres), Rubin as built (tilted, with Zernike terms on three
lens surfaces), and the baseline with a bicubic grid of 201 x 201 nodes on M1. pachon on one thread, with the arrays of
an earlier result (``out=``) and without, and batoid take turns in one process, under the same load; each turn is timed
by processor time, which other work on the machine hardly changes, and by the clock. Then pachon on two threads and on
one take turns by the clock. The first compilation is timed apart. Ratios are
of the best times: other work can only add to a time.
"""

import argparse
import os
import time

os.environ["OMP_NUM_THREADS"] = "1"

import batoid
import numpy as np

import pachon
from pachon.models import GridSag

PARSER = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
PARSER.add_argument("rays", type=int, nargs="?", default=1_000_000, help="rays through each telescope")
ARGUMENTS = PARSER.parse_args()
RAYS = ARGUMENTS.rays
ROUNDS = 7
FIELD, WAVELENGTH = (0.01, 0.02), 620e-9


def with_grid():
    """Return the LSST with 100 nm of ripples on M1, for pachon and for batoid."""
    nodes = np.linspace(-4.3, 4.3, 201)
    values = 1e-7 * np.sin(3 * nodes) * np.cos(2 * nodes)[:, None]
    telescope = pachon.load_telescope("lsst_v3.3_r").with_deformation("M1", GridSag(nodes, nodes, values))
    optic = batoid.Optic.fromYaml("LSST_r.yaml")
    grid = batoid.Bicubic(nodes, nodes, values)
    return telescope, optic.withSurface("M1", batoid.Sum([optic["M1"].surface, grid]))


def timed(work):
    """Return the processor time and the time by the clock [s], and the result."""
    start, processor = time.perf_counter(), time.process_time()
    result = work()
    return np.array([time.process_time() - processor, time.perf_counter() - start]), result


def compare(name, telescope, optic):
    rng = np.random.default_rng(0)
    radius = np.sqrt(rng.uniform(2.558**2, 4.18**2, RAYS))
    angle = rng.uniform(0, 2 * np.pi, RAYS)
    pupil = radius * np.cos(angle), radius * np.sin(angle)
    rays = pachon.launch_rays(telescope, FIELD, WAVELENGTH, pupil)
    few = pachon.launch_rays(telescope, FIELD, WAVELENGTH, ([3.0], [0.0]))
    first = timed(lambda: pachon.trace(telescope, few, threads=1))[0][1]

    fresh, given, theirs, turns, two = [], [], [], [], []
    out = pachon.trace(telescope, rays, threads=1)
    for _ in range(ROUNDS):
        peer = batoid.RayVector.fromStop(
            *pupil, optic=optic, wavelength=WAVELENGTH, theta_x=FIELD[0], theta_y=FIELD[1], projection="zemax"
        )
        theirs.append(timed(lambda peer=peer: optic.trace(peer))[0])
        seconds, result = timed(lambda: pachon.trace(telescope, rays, threads=1))
        fresh.append(seconds)
        given.append(timed(lambda: pachon.trace(telescope, rays, threads=1, out=out))[0])
    for _ in range(ROUNDS):
        turns.append(timed(lambda: pachon.trace(telescope, rays, threads=1))[0][1])
        two.append(timed(lambda: pachon.trace(telescope, rays, threads=2))[0][1])
    position = peer.toCoordSys(batoid.CoordSys()).r
    print(f"{name}: first call (kernels compiled or loaded) {first:.2f} s")
    for i, clock in enumerate(("processor time", "by the clock")):
        peers, *ours = (np.array(times)[:, i] for times in (theirs, fresh, given))
        print(f"  {clock}: batoid {peers.min() / RAYS * 1e9:.0f} ns a ray (median {np.median(peers) / RAYS * 1e9:.0f})")
        for name, seconds in zip(("fresh arrays", "out="), ours, strict=True):
            pairs = peers / seconds
            print(
                f"    {name}: {seconds.min() / RAYS * 1e9:.0f} ns a ray (median {np.median(seconds) / RAYS * 1e9:.0f}),"
                f" {peers.min() / seconds.min():.1f} times batoid (pair by pair {pairs.min():.1f} to {pairs.max():.1f})"
            )
    print(f"  two threads {min(two) / RAYS * 1e9:.0f} ns a ray, {min(turns) / min(two):.2f} times one")
    print(f"  landing points differ by at most {np.nanmax(np.abs(position - result.position)):.1e} m")


def main() -> None:
    print(f"pachon {pachon.__version__}, batoid {batoid.__version__}, {RAYS} rays, one thread")
    compare("LSST", pachon.load_telescope("lsst_v3.3_r"), batoid.Optic.fromYaml("LSST_r.yaml"))
    compare("Rubin as built", pachon.load_telescope("rubin_v3.14_r"), batoid.Optic.fromYaml("Rubin_v3.14_r.yaml"))
    compare("LSST, grid on M1", *with_grid())


if __name__ == "__main__":
    main()
