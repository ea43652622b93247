"""Diffraction images, encircled energy and ghosts against batoid."""

import numpy as np
import pytest

import pachon
from pachon.design.analyses.coatings import Coatings
from pachon.design.images.diffraction import fft_psf, huygens_psf
from pachon.design.images.encircled_energy import encircled_energy
from pachon.design.metrics.ghost_paths import GhostTrace, Reflectivities, ghost_pairs
from pachon.wavefront.pupil_sampling import PupilSampling

batoid = pytest.importorskip("batoid")


def grid_of_batoid(n, radius=4.18, obscuration=0.612):
    """The odd grid that batoid launches, within the annulus that pachon's pupil is."""
    axis = np.linspace(-radius, radius, n)
    x, y = np.meshgrid(axis, axis)
    inside = (np.hypot(x, y) <= radius) & (np.hypot(x, y) >= obscuration * radius)
    points = np.stack([x[inside], y[inside]], axis=-1)
    return PupilSampling(points, np.ones(len(points)))


def coordinates(lattice):
    """Focal-plane x and y of each element of a lattice of batoid, whose array is [y, x] and whose coords are [x, y]."""
    return lattice.coords[..., 0].T, lattice.coords[..., 1].T


@pytest.mark.parametrize("angle", [(0.0, 0.0), (0.7, -1.2)])
def test_huygens_images(angle):
    telescope = pachon.load_telescope("lsst_v3.3_i")
    optic = batoid.Optic.fromYaml("LSST_i.yaml")
    field = np.deg2rad(angle)
    theirs = batoid.huygensPSF(optic, *field, 750e-9, projection="zemax", nx=75, dx=0.4e-6, nxOut=31).array
    ours = huygens_psf(
        telescope, [field], 750e-9, pixel=0.4e-6, pixels=31, sampling=grid_of_batoid(75), reference="chief"
    ).image[0]
    # Rays of batoid have equal amplitudes; here those whose neighbours spread over more directions have more, by
    # up to 1 % off the axis.
    assert ours / ours.sum() == pytest.approx(theirs / theirs.sum(), abs=4e-3 * ours.max() / ours.sum())


@pytest.mark.parametrize("angle", [(0.0, 0.0), (0.7, -1.2)])
def test_fourier_images_by_moments(angle):
    telescope = pachon.load_telescope("lsst_v3.3_i")
    optic = batoid.Optic.fromYaml("LSST_i.yaml")
    field = np.deg2rad(angle)
    theirs = batoid.fftPSF(optic, *field, 750e-9, projection="zemax", nx=128, pad_factor=4)
    x, y = coordinates(theirs)
    ours = fft_psf(telescope, [field], 750e-9, pixel=0.2e-6, pixels=192, n_pupil=256, reference="chief")

    def moments(x, y, light):
        # Weighted as a shape would be, so that the wings, which differ by aliases, do not count.
        weight = light * np.exp(-0.5 * (x**2 + y**2) / 3e-6**2)
        weight = weight / weight.sum()
        return np.array([(weight * x).sum(), (weight * y).sum()]), np.array(
            [(weight * x * x).sum(), (weight * x * y).sum(), (weight * y * y).sum()]
        )

    first, second = moments(x, y, theirs.array)
    mine_first, mine_second = moments(*np.meshgrid(ours.axis, ours.axis), ours.image[0])
    size = second[0] + second[2]
    # Their lattice is linear in the entrance pupil, the true one is not quite.
    assert mine_first == pytest.approx(first, abs=0.02 * np.sqrt(size))
    assert mine_second == pytest.approx(second, abs=0.02 * size)


@pytest.mark.long
@pytest.mark.parametrize(
    "angle", [pytest.param(0.0, marks=pytest.mark.slow), 1.0, pytest.param(1.4, marks=pytest.mark.slow), 1.75]
)
def test_radius_of_80_percent_of_the_light(angle):
    telescope = pachon.load_telescope("lsst_v3.3_i")
    optic = batoid.Optic.fromYaml("LSST_i.yaml")
    field = np.deg2rad([[0.0, angle]])
    energy = encircled_energy(telescope, field, 750e-9)
    psf = batoid.fftPSF(optic, *field[0], 750e-9, projection="zemax", nx=256, pad_factor=4, reference="mean")
    x, y = coordinates(psf)
    light = psf.array / psf.array.sum()
    center = (light * x).sum(), (light * y).sum()
    radius = np.hypot(x - center[0], y - center[1]).ravel()
    order = np.argsort(radius)
    expected = np.interp(0.8, np.cumsum(light.ravel()[order]), radius[order])
    # The curve is flat there: a hundredth of the light makes 3 % of the radius.
    assert energy.radius_holding(0.8)[0] == pytest.approx(expected, rel=0.015)


def test_ghosts_land_where_split_rays_of_batoid_land(lsst_r):
    optic = batoid.Optic.fromYaml("LSST_r.yaml")
    bare = batoid.SimpleCoating(0.02, 0.98)
    for item in optic.itemDict.values():
        if isinstance(item, batoid.RefractiveInterface):
            item.forwardCoating = item.reverseCoating = bare
        if isinstance(item, batoid.Detector):
            item.forwardCoating = bare
    field = np.deg2rad([0.3, 0.8])
    rng = np.random.default_rng(5)
    radius, angle = 4.18 * np.sqrt(rng.uniform(0.4, 1.0, 40)), rng.uniform(0.0, 2.0 * np.pi, 40)
    pupil = radius * np.cos(angle), radius * np.sin(angle)
    start = batoid.RayVector.fromStop(
        *pupil, optic=optic, wavelength=622e-9, theta_x=field[0], theta_y=field[1], projection="zemax"
    )
    start.flux[:] = 1.0
    forward, _ = optic.traceSplit(start, minFlux=1e-4)
    theirs = {tuple(rays.path): rays for rays in forward}
    compared = 0
    names = lsst_r.surface_names
    rays = pachon.launch_rays(lsst_r, field, 622e-9, pupil)
    pairs = ghost_pairs(lsst_r)
    surfaces = Reflectivities(lsst_r, 0.02, 0.02, Coatings(), rays.wavelength)
    found = GhostTrace(lsst_r, rays, surfaces, None).ghosts(pairs)
    for (first, second), ours in zip(pairs, found, strict=True):
        path = (*names[:first], *names[first:second:-1], *names[second:])
        if path not in theirs:
            assert not len(ours.weight)
            continue
        other = theirs[path].toCoordSys(batoid.CoordSys())
        # batoid leaves out what is stopped, and keeps the order. The detector lies along the telescope's axes.
        assert ours.position == pytest.approx(other.r[:, :2], abs=1e-9)
        # Theirs is the light that enters the detector, which reflects 2 %.
        assert ours.weight == pytest.approx(other.flux / 0.98)
        compared += len(ours.weight)
    assert compared > 500
