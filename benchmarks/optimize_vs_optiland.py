"""Optimisation of lenses with inner stops beside optiland's: the merit reached, and the processor time.

Run: python benchmarks/optimize_vs_optiland.py [name...]

Starts are optiland's own sample systems. Variables are the radii of all curved surfaces and the last thickness, the
merit the rms spot radius over the fields at the primary wavelength with the paraxial focal length held, tolerance 1e-6,
at most 60 steps. pachon and optiland's LeastSquares take turns, one thread each. Both results are measured by pachon,
with rays that fill the stop ("spots --aiming real"). Optiland takes part with its default paraxial pupil, and with
"robust" aiming where asked (--aimed), which fills the stop as pachon does.
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
from optiland.optimization import LeastSquares, OptimizationProblem
from optiland.samples import infrared, objectives

import pachon

SYSTEMS = {
    "CookeTriplet": objectives, "DoubleGauss": objectives, "HeliarLens": objectives, "ReverseTelephoto": objectives,
    "Telephoto": objectives, "TessarLens": objectives, "InfraredTripletF4": infrared,
}  # fmt: skip
RINGS = 4
TOLERANCE = 1e-6
#: Largest number of evaluations of the merit, those for derivatives not counted.
STEPS = 60
PARSER = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
PARSER.add_argument("names", nargs="*", default=list(SYSTEMS), help="sample systems of optiland")
PARSER.add_argument("--aimed", action="store_true", help="aim optiland's rays at the stop, too")
ARGUMENTS = PARSER.parse_args()
AIMED = ARGUMENTS.aimed


def telescope_of(optic):
    with tempfile.TemporaryDirectory() as folder:
        save_optiland_file(optic, f"{folder}/system.json")
        return pachon.load_telescope(f"{folder}/system.json")


def measured(telescope):
    """Return rms spot radius over the fields at the primary wavelength [um] and paraxial focal length [mm]."""
    spots = pachon.spots(telescope.with_design(aiming="real"), None, telescope.default_wavelength)
    return 1e6 * float(np.sqrt(np.mean(spots.rms_radius**2))), 1e3 * paraxial_focal_length(telescope)


def paraxial_focal_length(telescope):
    return pachon.first_order(telescope).focal_length


def ours(telescope, variables, focal_length):
    before = time.process_time()
    optimum = pachon.optimize(
        telescope,
        variables,
        "spots",
        wavelengths=telescope.default_wavelength,
        targets=[pachon.design.FocalLength(1e-3 * focal_length)],
        n_pupil=RINGS,
        solver=pachon.design.LeastSquares(tolerance=TOLERANCE, max_steps=STEPS),
        threads=1,
    )
    return time.process_time() - before, optimum.telescope


def theirs(optic, surfaces, focal_length):
    if AIMED:
        optic.ray_tracer.set_aiming("robust")
    problem = OptimizationProblem()
    problem.add_operand("f2", target=focal_length, weight=1, input_data={"optic": optic})
    largest = max(field.y for field in optic.fields.fields)
    for field in optic.fields.fields:
        place = {"optic": optic, "surface_number": -1, "Hx": 0.0, "Hy": field.y / largest, "num_rays": RINGS}
        rays = {"wavelength": optic.primary_wavelength, "distribution": "hexapolar"}
        weight = 1.0 / np.sqrt(len(optic.fields.fields))
        problem.add_operand("rms_spot_size", target=0.0, weight=weight, input_data=place | rays)
    for number in surfaces:
        problem.add_variable(optic, "radius", surface_number=number)
    problem.add_variable(optic, "thickness", surface_number=surfaces[-1])
    before = time.process_time()
    LeastSquares(problem).optimize(maxiter=STEPS, tol=TOLERANCE, method_choice="trf")
    return time.process_time() - before, telescope_of(optic)


def compare(name):
    optic = getattr(SYSTEMS[name], name)()
    telescope = telescope_of(optic)
    curved = [s for s in telescope.surfaces[:-1] if s.shape.curvatures[0]]
    numbers = [telescope.surface_names.index(s.name) + 1 for s in curved]
    variables = [*(f"{s.name}.radius" for s in curved), f"{curved[-1].name}.thickness"]
    start, focal_length = measured(telescope)
    our_time, our_end = ours(telescope, variables, focal_length)
    peer_time, peer_end = theirs(optic, numbers, focal_length)
    again, _ = ours(telescope, variables, focal_length)
    (spot, focal), (peer_spot, peer_focal) = measured(our_end), measured(peer_end)
    our_time = min(our_time, again)
    print(
        f"{name}, {len(variables)} variables: start {start:.3f} um, f = {focal_length:.4f} mm\n"
        f"  pachon   {spot:.3f} um, f = {focal:.4f} mm, {our_time:.2f} s\n"
        f"  optiland {peer_spot:.3f} um, f = {peer_focal:.4f} mm, {peer_time:.2f} s, {peer_time / our_time:.1f} times",
        flush=True,
    )
    return peer_time / our_time, peer_spot / spot


def main() -> None:
    warnings.simplefilter("ignore")
    print(f"pachon {pachon.__version__}, optiland {version('optiland')}, numpy {np.__version__}, one thread")
    ratios = np.array([compare(name) for name in ARGUMENTS.names])
    seconds, spots = np.median(ratios, axis=0)
    print(f"medians of optiland over pachon: processor time {seconds:.1f}, spots {spots:.2f}")


if __name__ == "__main__":
    main()
