"""Cost of a sensitivity matrix of 50 degrees of freedom x 28 Zernikes x 31 fields, in forward traces.

Run: python benchmarks/sensitivity_time.py [threads] [rays along the radius]

Five motions each of M2 and the camera, twenty Zernike terms each on M1 and M2. The matrix and ten forward traces of the
same rays take turns in one process, about as long each and under the same load; the ratio is taken pair by pair. Every
column of the matrix is compared with central differences at the end.
"""

import argparse
import time
from dataclasses import replace

import numpy as np

import pachon
from pachon import sensitivity
from pachon.design.optimize.sensitivity import field_rings
from pachon.models import annular_zernikes
from pachon.models.parameters.parameters import apply, with_shape_terms
from pachon.raytrace.rays import field_direction, parallel_rays

PARSER = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
PARSER.add_argument("threads", type=int, nargs="?", default=1, help="threads of both sides")
PARSER.add_argument("rings", type=int, nargs="?", default=14, help="rays along the radius of the pupil")
ARGUMENTS = PARSER.parse_args()
THREADS = ARGUMENTS.threads
RINGS = ARGUMENTS.rings
ROUNDS = 9
MOTIONS = [f"{body}.{motion}" for body in ("M2", "Camera") for motion in ("dx", "dy", "dz", "rx", "ry")]
PARAMETERS = [*MOTIONS, "M1.Z4-23", "M2.Z4-23"]


def main() -> None:
    telescope = pachon.load_telescope("lsst_v3.3_r")
    fields = field_rings(telescope)
    pupil = pachon.pupil_sampling(telescope, "gauss", RINGS)
    light = field_direction(fields[:, 0], fields[:, 1])
    rays = parallel_rays(telescope, light, telescope.default_wavelength, pupil.points)

    def matrix():
        return sensitivity(telescope, PARAMETERS, fields, sampling=pupil, threads=THREADS)

    def forward():
        for _ in range(10):
            pachon.trace(telescope, rays, threads=THREADS)

    times = {}
    for _ in range(ROUNDS + 2):
        for work in (forward, matrix):
            start = time.perf_counter(), time.process_time()
            result = work()
            times.setdefault(work.__name__, []).append((time.perf_counter() - start[0], time.process_time() - start[1]))
    # The first rounds compile, and fill caches.
    trace_s, matrix_s = (np.array(times[name][2:]) / (10 if name == "forward" else 1) for name in ("forward", "matrix"))
    ratios, processor = (matrix_s / trace_s).T
    shape = " x ".join(str(n) for n in result.matrix.shape)
    print(f"pachon {pachon.__version__}, {len(rays)} rays ({len(pupil)} a field), threads: {THREADS}; matrix {shape}")
    print(f"forward trace {np.median(trace_s[:, 0]) * 1e3:7.2f} ms")
    print(f"matrix        {np.median(matrix_s[:, 0]) * 1e3:7.2f} ms")
    print(f"ratio         {np.median(ratios):7.2f} (from {ratios.min():.2f} to {ratios.max():.2f}; at most 10 to show)")
    print(f"processor time, ratio {np.median(processor):7.2f} (from {processor.min():.2f} to {processor.max():.2f})")
    print(f"differs from central differences by {farthest(telescope, result, pupil):.1e} of the largest of a column")


def farthest(telescope, result, pupil) -> float:
    """Compare each column with central differences over three field points, without rims: the lit rays must stay."""
    bare = replace(telescope, surfaces=tuple(replace(s, aperture=None) for s in telescope.surfaces))
    shown = sensitivity(telescope, result.parameters, result.fields[[0, 4, 17]], sampling=pupil)
    radius, obscuration = 0.5 * telescope.pupil_diameter, telescope.pupil_obscuration
    terms = annular_zernikes(shown.matrix.shape[1], *(pupil.points.T / radius), obscuration)
    lit = [pachon.wavefront_opd(telescope, f, shown.wavelength, pupil.points.T).lit for f in shown.fields]

    def zernikes(changed):
        coefficients = []
        for field, use in zip(shown.fields, lit, strict=True):
            value = pachon.wavefront_opd(changed, field, shown.wavelength, pupil.points.T).value
            root = np.sqrt(pupil.weights[use])
            coefficients.append(np.linalg.lstsq((terms[:, use] * root).T, value[use] * root, rcond=None)[0])
        return np.array(coefficients)

    worst = 0.0
    for i, parameter in enumerate(shown.parameters):
        # Zernike terms get a shape of their own from the mirror with its rim: without rims they could not.
        present = with_shape_terms(telescope, [parameter])
        start = replace(bare, surfaces=tuple(replace(s, aperture=None) for s in present.surfaces))
        step = {"m": 2e-4, "rad": 2e-5}[parameter.unit] * (0.1 if parameter.kind == "shape" else 1.0)
        slopes = []
        for h in (step, 2.0 * step):
            up, down = (zernikes(apply(start, {parameter.address: sign * h})) for sign in (1.0, -1.0))
            slopes.append((up - down) / (2.0 * h))
        difference = np.abs((4.0 * slopes[0] - slopes[1]) / 3.0 - shown.matrix[:, :, i])
        worst = max(worst, difference.max() / np.abs(shown.matrix[:, :, i]).max())
    return worst


if __name__ == "__main__":
    main()
