"""Images of an object at a finite distance against Huygens' integral over a sphere behind the lens, restated here."""

from pathlib import Path

import numpy as np
import pytest

import pachon
from pachon.design.images.wavelets import lattice_wavelets
from pachon.wavefront.pupil_sampling import gauss_annulus

#: Radius of the sphere [m].
RADIUS = 0.05
#: Sine of the largest angle at the image.
SINE = 0.62
LENS = Path(__file__).parents[2] / "data" / "zmx" / "US05831776-1.zmx"


@pytest.fixture(scope="module")
def lens():
    # A lens for 248 nm with a cone of 38 degrees, its object 0.11 m away, with strong coma off the axis.
    telescope = pachon.load_telescope(str(LENS))
    assert np.isfinite(telescope.object_distance)
    return telescope


def wave_on_sphere(telescope, field, center, pupil):
    """Points [m], paths [m] and amplitudes of rays on the sphere about an image point, in front of the image.

    The squared modulus of a field is its energy density. What crosses a detector is that times the cosine of incidence,
    so the amplitudes have its root: the light on all pixels is then what leaves the sphere.
    """
    step = 1e-4 * telescope.pupil_diameter
    points = np.concatenate([pupil.points + beside for beside in ([0.0, 0.0], [step, 0.0], [0.0, step])])
    end = pachon.trace(telescope, pachon.launch_rays(telescope, tuple(field), telescope.default_wavelength, points.T))
    offset = end.position - center
    along = (offset * end.direction).sum(axis=1)
    back = -along - np.sqrt(along**2 - (offset**2).sum(axis=1) + RADIUS**2)
    place = (end.position + back[:, None] * end.direction).reshape(3, -1, 3)
    # Each ray carries the light of its part of the pupil to a patch of the sphere.
    patch = np.linalg.norm(np.cross(place[1] - place[0], place[2] - place[0]), axis=1) / step**2
    lit = end.status.reshape(3, -1)[0] == 0
    incidence = np.abs(end.direction[: len(lit), 2])
    amplitude = pupil.weights * np.sqrt(patch * incidence)
    return place[0][lit], (end.path_length + back).reshape(3, -1)[0][lit], amplitude[lit]


def irradiance(place, path, amplitude, wavelength, points):
    """Squared modulus of the sum of spherical waves at points [n, 3] [m], over that of waves in phase at distance R."""
    distance = np.linalg.norm(points[:, None] - place, axis=-1)
    wave = amplitude / distance * np.exp(2j * np.pi / wavelength * (path + distance - path[0] - distance[0, 0]))
    return np.abs(wave.sum(axis=1)) ** 2 / (amplitude.sum() / RADIUS) ** 2


@pytest.mark.long
@pytest.mark.parametrize("number", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_images_are_those_of_huygens_integral(lens, number):
    wavelength = lens.default_wavelength
    field = pachon.Request.of(lens).fields[number]
    light = {"fields": field, "wavelengths": wavelength}
    psf = pachon.fft_psf(lens, **light, pixels=21, pixel=0.2e-6, n_pupil=256)
    center = np.array([*psf.reference_point[0], lens.surfaces[-1].vertex[2]])
    wave = wave_on_sphere(lens, field, center, gauss_annulus(0.5 * lens.pupil_diameter, 0.0, 24, 96))
    grid = np.array([[x, y, 0.0] for y in psf.axis for x in psf.axis]) + center
    expected = irradiance(*wave, wavelength, grid).reshape(psf.image[0].shape)
    # In place of the sum over all light: the same lens without aberrations has its peak at 1.
    perfect = lattice_wavelets(
        pachon.Request.of(lens, **light), wavelength, psf.reference_point[0], 2.0 * SINE / 256
    ).wavelets.perfect_peak
    # The rim of the lattice of 256 points is known to a sixth of a cell.
    assert psf.image[0] / psf.pixel**2 / perfect == pytest.approx(expected, abs=5e-3 * expected.max())
    # The brightest place lies up to half a pixel from one of the brightest pixels.
    near = [[x, y, 0.0] for y in 2e-8 * np.arange(-5, 6) for x in 2e-8 * np.arange(-5, 6)]
    strehl = max(irradiance(*wave, wavelength, place + near).max() for place in grid[np.argsort(expected.ravel())[-3:]])
    assert pachon.huygens_psf(lens, **light, pixels=16).strehl[0] == pytest.approx(strehl, rel=5e-3)
    assert psf.strehl[0] == pytest.approx(strehl, rel=5e-3)
    # Light is even over the entrance pupil there, and over the direction cosines at the image in a wavefront's ratio.
    assert pachon.strehl(lens, **light, from_psf=False).wavefront[0, 0] == pytest.approx(strehl, rel=0.05)


def test_large_pixels_hold_the_light(lens):
    # Spots far larger than an Airy disc set the pixels; samples at their centres sum to 1.21.
    field = pachon.Request.of(lens).fields[0]
    psf = pachon.fft_psf(lens, field, lens.default_wavelength, pixels=32, n_pupil=128)
    finer = pachon.fft_psf(lens, field, lens.default_wavelength, pixels=128, pixel=psf.pixel / 4.0, n_pupil=128)
    assert psf.inside[0] == pytest.approx(finer.inside[0], abs=5e-3)
    assert 0.9 < psf.inside[0] < 1.0
