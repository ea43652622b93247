"""A camera rotated against the telescope: images, heights and positions go with it; mirrors, spiders and air stay."""

import numpy as np
import pytest

import pachon
from pachon.models.camera.focal_plane import FocalPlane
from pachon.wavefront.chief_rays import fields_at
from pachon.wavefront.psf.long_exposure import LongExposureEngine
from pachon.wavefront.psf.psf import make_psfs
from pachon.wavefront.psf.stamps import Stamps

#: Decentre of M2 [m]: coma and a pattern of astigmatism without symmetry.
DECENTRE = np.array([1e-3, -5e-4])
POSITIONS = np.array([[0.01, 0.002], [0.2, 0.1], [-0.25, 0.13]])
ONE_WAVE = [620e-9]


def turned(vectors, angle):
    """Vectors [n, 2] or [2] rotated from x towards y."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.asarray(vectors) @ np.array([[cosine, sine], [-sine, cosine]])


def decentred(telescope, shift):
    return telescope.perturbed("M2", shift=(*shift, 0.0))


@pytest.fixture(scope="module")
def air():
    return pachon.Atmosphere.from_site("cerro_pachon", seed=2)


@pytest.fixture(scope="module")
def heights():
    return FocalPlane.from_budget("lsst", seed=1)


@pytest.mark.parametrize(
    ("engine", "degrees", "tolerance"),
    [
        # The pupil points of the engine turn into each other: 16 spokes, a square lattice. Images are float32.
        ("long_exposure", 90.0, 1e-6),
        ("long_exposure", -157.5, 1e-6),
        pytest.param("wave", 90.0, 1e-6, marks=pytest.mark.long),
        # They do not, and sample the pupil at other points: as any other set of as many points.
        ("long_exposure", 30.0, 2e-3),
        pytest.param("wave", 30.0, 2e-3, marks=pytest.mark.slow),
    ],
)
def test_turning_the_camera_is_turning_all_else_the_other_way(lsst_r, air, heights, engine, degrees, tolerance):
    angle = np.deg2rad(degrees)
    camera = decentred(lsst_r, DECENTRE).with_rotator(angle)
    mirror = decentred(lsst_r, turned(DECENTRE, -angle))
    options = {"atmosphere": air if engine == "long_exposure" else None, "focal_plane": heights, "threads": 1}
    # One star is enough for the slow engine; so are the few points of the pupil of a small stamp where they turn into
    # each other.
    places = POSITIONS if engine == "long_exposure" else POSITIONS[1:2]
    options["stamps"] = Stamps(15) if engine == "wave" and degrees == 90.0 else Stamps()
    spread = np.array([[1e-7, -3e-7]])
    one, other = (
        make_psfs(t, fields_at(t, places), pachon.Light(ONE_WAVE, dispersion=d), engine=engine, **options).image
        for t, d in ((camera, spread), (mirror, turned(spread, -angle)))
    )
    assert np.abs(one - other).max() < tolerance * other.max()
    # Without the rotator they are other images, by far more than the largest tolerance.
    still = make_psfs(decentred(lsst_r, DECENTRE), fields_at(lsst_r, places), ONE_WAVE, engine=engine, **options)
    assert np.abs(still.image - other).max() > 0.02 * other.max()


@pytest.mark.parametrize("engine", ["long_exposure", "fast", pytest.param("wave", marks=pytest.mark.long)])
def test_the_image_of_a_star_turns_back_by_a_quarter(lsst_r, single_modes, air, engine):
    # One star, one field: mirrors, air and dispersion are the same, only the pixels are turned by 90 degrees.
    telescope = decentred(lsst_r, DECENTRE)
    field = fields_at(telescope, POSITIONS[1:2])
    options = {"atmosphere": {"wave": None, "long_exposure": air, "fast": single_modes}[engine], "threads": 1}
    options |= {"engine": engine, "stamps": Stamps(15) if engine == "wave" else Stamps()}
    light = pachon.Light(ONE_WAVE, dispersion=[[2e-7, -1e-7]])
    still = make_psfs(telescope, field, light, **options)
    quarter = make_psfs(telescope.with_rotator(0.5 * np.pi), field, light, **options)
    # x, y of the camera are y, -x of the telescope.
    expected = still.image[0].T[::-1]
    assert np.abs(quarter.image[0] - expected).max() < 1e-6 * expected.max()


@pytest.mark.parametrize("degrees", [30.0, -77.0])
def test_second_moments_turn_with_the_camera(lsst_r, air, degrees):
    # e = (a - b)/(a + b) exp(2 i phi), phi from the x axis of the camera; fine pixels, for moments without their axes.
    telescope, angle = decentred(lsst_r, DECENTRE), np.deg2rad(degrees)
    field = fields_at(telescope, POSITIONS)
    e = []
    for made in (telescope, telescope.with_rotator(angle)):
        psf = make_psfs(
            made,
            field,
            ONE_WAVE,
            atmosphere=air,
            threads=1,
            engine=LongExposureEngine(n_pupil=600),
            stamps=Stamps(81, pixel_size=5e-6),
        )
        shapes = pachon.measure_shapes(psf.image, psf.pixel_scale, 0.7 / 206265)
        e.append(shapes.e1 + 1j * shapes.e2)
    assert np.abs(e[0]).max() > 0.01
    # Rounding in float32, and pixels of a tenth of the FWHM.
    assert np.abs(e[1] - e[0] * np.exp(-2j * angle)).max() < 2e-6


def test_rays_land_on_the_heights_of_the_rotated_camera(lsst_r, heights):
    # An axially symmetric telescope: rays from a direction turned by the angle land turned, at the same height.
    angle = 1.1
    field = fields_at(lsst_r, POSITIONS)
    ends = []
    for telescope, by in ((lsst_r, 0.0), (lsst_r.with_rotator(angle), angle)):
        slopes = turned(np.tan(field), by)
        pupil = turned(np.array([[3.0, 1.0]]), by).T
        ends.append(
            np.concatenate(
                [
                    pachon.trace(
                        telescope,
                        pachon.launch_rays(telescope, np.arctan(s), 620e-9, tuple(pupil)),
                        focal_plane=heights,
                    ).position
                    for s in slopes
                ]
            )
        )
    nominal = lsst_r.surfaces[-1].vertex[2]
    x, y = ends[0][:, :2].T
    assert np.abs(ends[0][:, 2] - nominal - heights.height(x, y)).max() < 1e-12
    assert np.ptp(ends[0][:, 2]) > 1e-6
    np.testing.assert_allclose(ends[1][:, :2], turned(ends[0][:, :2], angle), atol=1e-12)
    np.testing.assert_allclose(ends[1][:, 2], ends[0][:, 2], atol=1e-12)


def test_spiders_stay_with_the_telescope(annulus_points):
    telescope = pachon.load_telescope("lsst_v3.3_r_obstructed")
    pupil = annulus_points(2000)
    still, rotated = (
        pachon.trace(t, pachon.launch_rays(t, (0.01, 0.02), 620e-9, pupil)).vignetted
        for t in (telescope, telescope.with_rotator(0.3))
    )
    assert 20 < still.sum() < 1000
    np.testing.assert_array_equal(rotated, still)
