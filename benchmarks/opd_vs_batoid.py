"""Time of the wavefronts of 1000 field points, end to end, beside batoid.wavefront in a loop.

Run: python benchmarks/opd_vs_batoid.py [fields] [model]

The model is one that batoid has too: lsst_v3.3_r (its LSST_r.yaml) or rubin_v3.14_r. Both sides make maps of 53 x 53
points over the entrance pupil. They take turns in one process, under the same load of the machine: a round is forty of
the fields by batoid (its loop costs the same for each) and all of them by pachon. batoid's threads are OMP_NUM_THREADS,
which it reads when it is first used, so that its loop on 2 threads is timed in a process of its own that takes turns
with this one. Ratios are of the best rounds of each; on a busy machine the ratio of the processor times on one thread
is more reliable. The first compilation is shown apart.
"""

import argparse
import os
import subprocess
import sys
import time

os.environ.setdefault("OMP_NUM_THREADS", "1")

import batoid
import numpy as np

PARSER = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
PARSER.add_argument("fields", type=int, nargs="?", default=1000, help="field points")
PARSER.add_argument("model", nargs="?", default="lsst_v3.3_r", help="lsst_v3.3_r or rubin_v3.14_r")
PARSER.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
ARGUMENTS = PARSER.parse_args()
FIELDS = ARGUMENTS.fields
MODEL = ARGUMENTS.model
PEERS = {"lsst_v3.3_r": "LSST_r.yaml", "rubin_v3.14_r": "Rubin_v3.14_r.yaml"}
WAVELENGTH, GRID, ROUNDS = 620e-9, 53, 15
PEER_FIELDS = 40


def fields() -> np.ndarray:
    """Return field angles, uniform over a disc of 1.75 degrees [rad]."""
    rng = np.random.default_rng(0)
    radius = np.deg2rad(1.75) * np.sqrt(rng.uniform(0, 1, FIELDS))
    angle = rng.uniform(0, 2 * np.pi, FIELDS)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def peer_seconds(optic: batoid.Optic, chosen: np.ndarray) -> float:
    """Return batoid's seconds a field."""
    start = time.perf_counter()
    for x, y in chosen:
        batoid.wavefront(optic, x, y, WAVELENGTH, projection="zemax", nx=GRID)
    return (time.perf_counter() - start) / len(chosen)


def serve_rounds() -> None:
    """Time a round of batoid for every line of standard input: the part of the process with other threads."""
    optic, chosen = batoid.Optic.fromYaml(PEERS[MODEL]), fields()[: PEER_FIELDS // 2]
    for _ in sys.stdin:
        print(peer_seconds(optic, chosen), flush=True)


def main() -> None:
    import pachon

    telescope = pachon.load_telescope(MODEL)
    optic = batoid.Optic.fromYaml(PEERS[MODEL])
    angles = fields()
    chosen = angles[:PEER_FIELDS]
    axis = np.linspace(-0.5, 0.5, GRID) * optic.pupilSize
    # The grid of batoid's map, of odd size, extends from rim to rim.
    pupil = np.meshgrid(axis, axis)
    start = time.perf_counter()
    pachon.wavefront_opds(telescope, angles[:1], WAVELENGTH, pupil)
    print(f"pachon {pachon.__version__}, batoid {batoid.__version__}, {MODEL}, {FIELDS} fields, {GRID} x {GRID} points")
    print(f"load of the machine: {', '.join(f'{v:.1f}' for v in os.getloadavg())} on {os.cpu_count()} processors")
    print(f"first call (kernels compiled or loaded): {time.perf_counter() - start:.2f} s")

    command = [sys.executable, __file__, str(FIELDS), MODEL, "--serve"]
    # Its threads sleep while they wait, or on a busy machine they would wait for each other most of the time.
    environment = os.environ | {"OMP_NUM_THREADS": "2", "OMP_WAIT_POLICY": "passive"}
    seconds: dict[str, list[float]] = {"batoid 1 thread": [], "batoid 2 threads": [], "1 thread": [], "2 threads": []}
    peer_busy: list[float] = []
    our_busy: list[float] = []
    with subprocess.Popen(command, stdin=-1, stdout=-1, text=True, env=environment) as other:
        assert other.stdin is not None
        assert other.stdout is not None
        for _ in range(ROUNDS):
            busy = time.process_time()
            seconds["batoid 1 thread"].append(peer_seconds(optic, chosen))
            peer_busy.append((time.process_time() - busy) / len(chosen))
            other.stdin.write("go\n")
            other.stdin.flush()
            seconds["batoid 2 threads"].append(float(other.stdout.readline()))
            for threads in (1, 2):
                start, busy = time.perf_counter(), time.process_time()
                maps = pachon.wavefront_opds(telescope, angles, WAVELENGTH, pupil, threads=threads)
                spent = (time.perf_counter() - start) / FIELDS
                seconds["1 thread" if threads == 1 else "2 threads"].append(spent)
                if threads == 1:
                    our_busy.append((time.process_time() - busy) / FIELDS)
        other.stdin.close()
    best = {name: min(values) for name, values in seconds.items()}
    for name, value in best.items():
        print(f"{name if 'batoid' in name else 'pachon ' + name:17} {value * 1e3:7.3f} ms a field")
    for peer in ("batoid 1 thread", "batoid 2 threads"):
        for ours in ("1 thread", "2 threads"):
            rounds = np.array(seconds[peer]) / np.array(seconds[ours])
            print(
                f"pachon {ours} beside {peer:16}: {best[peer] / best[ours]:5.1f} times as fast "
                f"(round by round {rounds.min():.1f} to {rounds.max():.1f})"
            )
    rounds = np.array(peer_busy) / np.array(our_busy)
    print(
        f"processor time on one thread: {min(peer_busy) * 1e3:.3f} and {min(our_busy) * 1e3:.3f} ms a field, "
        f"ratio {min(peer_busy) / min(our_busy):.1f} (round by round {rounds.min():.1f} to {rounds.max():.1f})"
    )
    worst = 0.0
    for i in range(len(chosen)):
        theirs = batoid.wavefront(optic, *angles[i], WAVELENGTH, projection="zemax", nx=GRID).array * WAVELENGTH
        both = maps.lit[i] & ~np.ma.getmaskarray(theirs)
        worst = max(worst, float(np.abs(maps.value[i] - theirs.data)[both].max()))
    print(f"maps differ by at most {worst:.1e} m ({len(chosen)} fields)")

    print("cost a field [ms] by number of fields, 2 threads:", end="")
    for n in (FIELDS // 8, FIELDS // 4, FIELDS // 2, FIELDS):
        start = time.perf_counter()
        pachon.wavefront_opds(telescope, angles[:n], WAVELENGTH, pupil, threads=2)
        print(f"  {n}: {(time.perf_counter() - start) / n * 1e3:.3f}", end="")
    print()


if __name__ == "__main__":
    serve_rounds() if ARGUMENTS.serve else main()
