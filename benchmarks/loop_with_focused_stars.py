"""Gain of the active-optics loop from moments of in-focus stars beside the donuts, in linear theory.

Run: python benchmarks/loop_with_focused_stars.py [stars] [states]

The Kalman filter of ``pachon align`` is given e1, e2 and ln(size) (weight of 0.7") of stars in focus beside the
Zernikes of eight corner donuts. Moments depend on the state in second order, so that their derivatives are taken at
states drawn from the filter's own covariance. The errors of the moments are photon noise (0.51 over S/N), a mean over
the field that is free, and turbulence: two exponentials of the distance with half of the variance each, of 3' and 16'
(e1, e2: 5.0e-6 and 7.1e-6 in 15 s, ln(size) 1.6e-5; see docs/explanation/focal_plane_psf.md), which falls as one over
the exposure time. Printed is the wavefront over the field that the filter expects after one correction from twice the
tolerances, and in the long run.
"""

from __future__ import annotations

import argparse

import numpy as np

import pachon
from pachon.core.units import ARCSEC
from pachon.studies import AlignConfig
from pachon.studies.alignment.estimator import estimate_state
from pachon.studies.alignment.scene import NOLL, AlignmentScene
from pachon.wavefront.pupil_sampling import spiral_annulus

PARSER = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
PARSER.add_argument("stars", type=int, nargs="?", default=40, help="stars in focus")
PARSER.add_argument("states", type=int, nargs="?", default=4, help="states of the telescope")
ARGUMENTS = PARSER.parse_args()
STARS = ARGUMENTS.stars
STATES = ARGUMENTS.states
SNR, DONUT_ERROR = 300.0, 28.4e-9
TURBULENCE, SCALES = np.array([5.0e-6, 7.1e-6, 1.6e-5]), np.deg2rad([3.0 / 60.0, 16.0 / 60.0])
FREE_MEAN, STEP, VISITS = 0.02, 0.02, 60


def moments(scene: AlignmentScene, fields: np.ndarray, states: np.ndarray) -> np.ndarray:
    """Return e1, e2 and ln(size) of stars, shape [n_state, n_star, 3], of states in tolerances."""
    out = []
    for state in states:
        telescope = scene.freedoms.apply(scene.telescope, state * scene.tolerances)
        psf = pachon.make_psfs(
            telescope,
            fields,
            scene.wavelengths,
            atmosphere=scene.atmosphere,
            engine="long_exposure",
            stamps=pachon.Stamps(41),
        )
        shapes = pachon.measure_shapes(psf.image, psf.pixel_scale, 0.7 * ARCSEC)
        out.append(np.stack([shapes.e1, shapes.e2, np.log(shapes.size)], axis=-1))
    return np.array(out)


def moment_noise(fields: np.ndarray, part: float) -> np.ndarray:
    """Return the covariance of all moments, with a part of the variance of turbulence, [3 n_star, 3 n_star]."""
    apart = np.hypot(*(fields[:, None] - fields).T)
    shared = sum(0.5 * np.exp(-apart / scale) for scale in SCALES)
    out = np.zeros((len(fields), 3, len(fields), 3))
    for k in range(3):
        out[:, k, :, k] = part * TURBULENCE[k] * shared + FREE_MEAN**2 + np.eye(len(fields)) * (0.51 / SNR) ** 2
    return out.reshape(3 * len(fields), -1)


def expected(scene: AlignmentScene, data: list[tuple[np.ndarray, np.ndarray]]) -> tuple[float, float, np.ndarray]:
    """Return the wavefront over the field after one correction and in the long run [nm], and the last covariance."""
    rows = sum(len(s) for s, _ in data)
    sensitivity, noise, first = np.concatenate([s for s, _ in data]), np.zeros((rows, rows)), 0
    for part, covariance in data:
        block = slice(first, first + len(part))
        noise[block, block], first = covariance, first + len(part)
    # All rows in units of their errors, so that metres and ellipticities stand beside each other.
    scale = np.sqrt(np.diag(noise))
    sensitivity, noise = sensitivity / scale[:, None] * 1e-9, noise / np.outer(scale, scale) * 1e-18
    n = len(scene.freedoms)
    covariance, drift, after = scene.config.errors.initial**2 * np.eye(n), np.diag(scene.steps**2), []
    for _ in range(VISITS):
        covariance = estimate_state(np.zeros(rows), noise, sensitivity, covariance, drift, 1.0).covariance
        after.append(1e9 * scene.expected_wavefront(covariance))
    return after[0], after[-1], covariance


def main() -> None:
    scene = AlignmentScene.of(AlignConfig())
    donuts = scene.sensitivity, scene.turbulence + np.eye(len(scene.sensitivity)) * DONUT_ERROR**2 / len(NOLL)
    one, many, covariance = expected(scene, [donuts])
    print(f"pachon {pachon.__version__}; {STARS} stars of S/N {SNR:.0f}")
    print(f"{'':44} after one correction, in the long run [nm rms over the field]")
    print(f"{'eight donuts':44} {one:8.1f} {many:8.1f}")
    fields = spiral_annulus(0.95 * scene.telescope.field_radius, 0.0, STARS).points
    n, rng = len(scene.freedoms), np.random.default_rng(1)
    draws = rng.multivariate_normal(np.zeros(n), covariance, STATES)
    found: dict[str, list[tuple[float, float]]] = {}
    for state in draws:
        sides = [moments(scene, fields, state + sign * STEP * np.eye(n)) for sign in (1.0, -1.0)]
        rates = ((sides[0] - sides[1]) / (2.0 * STEP)).transpose(1, 2, 0).reshape(-1, n)
        shape = np.tile([True, True, False], STARS)
        for name, part, rows in (
            ("and e1, e2", 1.0, shape),
            ("and e1, e2, size", 1.0, shape | True),
            ("and e1, e2, size, exposure of 150 s", 0.1, shape | True),
            ("and e1, e2, size, no turbulence in them", 0.0, shape | True),
        ):
            noise = moment_noise(fields, part)[np.ix_(rows, rows)]
            found.setdefault(name, []).append(expected(scene, [donuts, (rates[rows], noise)])[:2])
    for name, values in found.items():
        first, last = np.sqrt(np.mean(np.square(values), axis=0))
        print(f"{name:44} {first:8.1f} {last:8.1f}")


if __name__ == "__main__":
    main()
