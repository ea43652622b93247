"""Time of a million rays that are aimed at the stop and traced to the image, beside optiland's.

Run: python benchmarks/aiming_vs_optiland.py [rays]

Three of optiland's own sample systems, each at its widest field, rays at random all over the pupil. pachon, on one
thread and on two, and optiland ("robust" aiming, at its own tolerance of 1e-6 and at 1e-11) take turns in one process.
Processor time first, which other work on the machine hardly changes, then the clock. Ratios are of the best times.
"""

import argparse
import os
import tempfile
import time
import warnings
from importlib.metadata import version

os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np
from optiland.fileio import save_optiland_file
from optiland.samples import objectives

import pachon

PARSER = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
PARSER.add_argument("rays", type=int, nargs="?", default=1_000_000, help="rays through each system")
RAYS = PARSER.parse_args().rays
ROUNDS = 3
SYSTEMS = ("CookeTriplet", "DoubleGauss", "WideAngle100FOV")


def timed(work):
    processor, clock = time.process_time(), time.perf_counter()
    result = work()
    return time.process_time() - processor, time.perf_counter() - clock, result


def compare(name):
    optic = getattr(objectives, name)()
    with tempfile.TemporaryDirectory() as folder:
        save_optiland_file(optic, f"{folder}/system.json")
        telescope = pachon.load_telescope(f"{folder}/system.json").with_design(aiming="real")
    rng = np.random.default_rng(0)
    radius, angle = np.sqrt(rng.random(RAYS)), 2 * np.pi * rng.random(RAYS)
    px, py = radius * np.cos(angle), radius * np.sin(angle)
    largest = max(field.y for field in optic.fields.fields)
    pupil = 0.5 * telescope.pupil_diameter * np.stack([-px, py])
    field, wavelength = (0.0, np.deg2rad(largest)), telescope.default_wavelength

    def ours(threads):
        rays = pachon.launch_rays(telescope, field, wavelength, tuple(pupil))
        return pachon.trace(telescope, rays, threads=threads)

    def theirs():
        return optic.ray_tracer.trace_generic(0.0, 1.0, px, py, optic.primary_wavelength, record=False)

    ours(1)
    found = {"pachon": [], "1e-6": [], "1e-11": []}
    for _ in range(ROUNDS):
        found["pachon"].append(timed(lambda: ours(1)))
        for tolerance, steps in (("1e-6", 10), ("1e-11", 100)):
            optic.ray_tracer.set_aiming("robust", max_iter=steps, tol=float(tolerance))
            found[tolerance].append(timed(theirs))
    best = {key: np.min([run[:2] for run in runs], axis=0) for key, runs in found.items()}
    end, peer = found["pachon"][-1][2], found["1e-11"][-1][2]
    place = telescope.surfaces[-1].to_local(end.position)[:, :2]
    apart = np.hypot(place[:, 0] + 1e-3 * np.asarray(peer.x), place[:, 1] - 1e-3 * np.asarray(peer.y))
    print(f"{name}, field {largest:g} deg")
    for key, (processor, clock) in best.items():
        ratio = (
            ""
            if key == "pachon"
            else f"; {processor / best['pachon'][0]:.1f} times pachon, clock {clock / best['pachon'][1]:.1f}"
        )
        label = key if key == "pachon" else f"optiland {key}"
        print(f"  {label}: {processor / RAYS * 1e9:.0f} ns a ray, clock {clock / RAYS * 1e9:.0f}{ratio}")
    print(f"  landing points differ by at most {np.nanmax(apart):.1e} m")


def main() -> None:
    warnings.simplefilter("ignore")
    print(f"pachon {pachon.__version__}, optiland {version('optiland')}, {RAYS} rays, one thread")
    for name in SYSTEMS:
        compare(name)


if __name__ == "__main__":
    main()
