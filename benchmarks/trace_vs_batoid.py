"""How fast is the trace of a million LSST rays, beside batoid's, on one thread?

Run: python benchmarks/trace_vs_batoid.py [rays]

The two take turns in one process, so that both see the same machine. The first compilation is timed apart. The ratio
is batoid's time over pachon's, pair by pair.
"""

import os
import sys
import time

os.environ["OMP_NUM_THREADS"] = "1"

import batoid
import numpy as np

import pachon

RAYS = int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000
ROUNDS = 7
FIELD, WAVELENGTH = (0.01, 0.02), 620e-9


def main() -> None:
    rng = np.random.default_rng(0)
    radius = np.sqrt(rng.uniform(2.558**2, 4.18**2, RAYS))
    angle = rng.uniform(0, 2 * np.pi, RAYS)
    pupil = radius * np.cos(angle), radius * np.sin(angle)
    telescope = pachon.load_telescope("lsst_v3.3_r")
    optic = batoid.Optic.fromYaml("LSST_r.yaml")
    rays = pachon.launch_rays(telescope, FIELD, WAVELENGTH, pupil)

    start = time.perf_counter()
    pachon.trace(telescope, pachon.launch_rays(telescope, FIELD, WAVELENGTH, ([3.0], [0.0])), threads=1)
    print(f"pachon {pachon.__version__}, batoid {batoid.__version__}, {RAYS} rays, 12 surfaces, one thread")
    print(f"first call (kernels compiled or loaded): {time.perf_counter() - start:.2f} s")
    ours, theirs = [], []
    for _ in range(ROUNDS):
        peer = batoid.RayVector.fromStop(
            *pupil, optic=optic, wavelength=WAVELENGTH, theta_x=FIELD[0], theta_y=FIELD[1], projection="zemax"
        )
        start = time.perf_counter()
        optic.trace(peer)
        theirs.append(time.perf_counter() - start)
        start = time.perf_counter()
        result = pachon.trace(telescope, rays, threads=1)
        ours.append(time.perf_counter() - start)
    ratios = np.array(theirs) / np.array(ours)
    position = peer.toCoordSys(batoid.CoordSys()).r
    print(f"batoid {np.median(theirs) / RAYS * 1e9:6.0f} ns a ray")
    print(f"pachon {np.median(ours) / RAYS * 1e9:6.0f} ns a ray")
    print(f"ratio  {np.median(ratios):6.1f} (from {ratios.min():.1f} to {ratios.max():.1f})")
    print(f"landing points differ by at most {np.abs(position - result.position).max():.1e} m")


if __name__ == "__main__":
    main()
