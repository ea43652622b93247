"""Brighter-fatter effect and tree rings against GalSim's SiliconSensor.

Both see the same photons as a plain sensor: what is compared is the change of the moments, whose noise comes only from
the photons near a boundary.
"""

import numpy as np
import pytest
from scipy.special import erf

from pachon.pipeline.sensor.brighter_fatter import boundary_shifts, brighter_fatter
from pachon.pipeline.sensor.displacement import TreeRings, displace_stamps

galsim = pytest.importorskip("galsim")

SIZE, SIGMA, PIXEL = 31, 1.5, 10e-6
Y, X = np.mgrid[:SIZE, :SIZE] - SIZE // 2


@pytest.fixture(scope="module")
def star():
    along = np.diff(0.5 * (1.0 + erf((np.arange(SIZE + 1) - SIZE / 2) / (SIGMA * np.sqrt(2.0)))))
    return np.outer(along, along)


def moments(image):
    """Centroid x, y [pixel], then second moments xx, yy, xy [pixel^2]."""
    light = image / image.sum()
    x, y = (light * X).sum(), (light * Y).sum()
    return np.array([x, y, *((light * a).sum() for a in ((X - x) ** 2, (Y - y) ** 2, (X - x) * (Y - y)))])


def changes(electrons, count, sensor, **options):
    """Mean change of the moments of Gaussian stars by a SiliconSensor without diffusion, and its standard error."""
    found = []
    for seed in range(count):
        x, y = np.random.default_rng(seed).normal(0.0, SIGMA, (2, electrons))
        photons = galsim.PhotonArray(electrons, x=x, y=y, flux=np.ones(electrons))
        images = []
        rng = galsim.BaseDeviate(seed + 1)
        for model in (galsim.Sensor(), galsim.SiliconSensor(sensor, rng=rng, diffusion_factor=0.0, **options)):
            image = galsim.ImageD(SIZE, SIZE)
            image.setCenter(0, 0)
            model.accumulate(photons, image)
            images.append(image.array.copy())
        found.append(moments(images[1]) - moments(images[0]))
    return np.mean(found, axis=0), np.std(found, axis=0, ddof=1) / np.sqrt(count)


@pytest.mark.parametrize("make", ["itl", "e2v"])
@pytest.mark.parametrize("vertices", [8, 32])
def test_areas_of_pixels_under_a_star(make, vertices):
    # Without photons: a star of 80 000 electrons in its brightest pixel.
    charge = 8e4 * np.exp(-(X**2 + Y**2) / (2.0 * SIGMA**2))
    areas = galsim.SiliconSensor(f"lsst_{make}_50_{vertices}").calculate_pixel_areas(galsim.ImageD(charge)).array
    shift_x, shift_y = boundary_shifts(charge[None], make)
    ours = 1.0 + (np.diff(shift_x, axis=2) + np.diff(shift_y, axis=1))[0]
    inner = slice(4, -4)
    change = np.abs(areas - 1.0)[inner, inner].max()
    assert change > 0.03
    # Straight boundaries displaced by the mean, to first order; polygons of 8 vertices a side are those of 32 to 2 %.
    assert np.abs(areas - ours)[inner, inner].max() < 0.02 * change


@pytest.mark.parametrize(
    ("make", "electrons", "count"),
    [
        pytest.param("itl", 1_000_000, 4, marks=pytest.mark.long),
        pytest.param("e2v", 1_000_000, 4, marks=pytest.mark.slow),
        pytest.param("itl", 100_000, 60, marks=pytest.mark.slow),
        pytest.param("e2v", 100_000, 60, marks=pytest.mark.slow),
        pytest.param("e2v", 10_000, 200, marks=pytest.mark.slow),
    ],
)
def test_growth_of_stars_with_their_electrons(make, electrons, count, star):
    # GalSim moves the boundaries after every tenth of the star, so that the first tenth falls into still pixels: on
    # average 9/20 of the charge act in place of half.
    theirs, error = np.multiply(changes(electrons, count, f"lsst_{make}_50_8", nrecalc=electrons / 10), 10.0 / 9.0)
    ours = moments(brighter_fatter(star[None], [electrons], sensor=make)[0]) - moments(star)
    # Three standard errors; 2 % for the first order and for 8 vertices in place of 32.
    assert (np.abs(ours - theirs)[2:4] < 3.0 * error[2:4] + 0.02 * theirs[2:4]).all()
    # What there is to find is many standard errors: the brightest stars tell it to 3 %.
    assert (error[2:4] < (0.03 if electrons == 1_000_000 else 0.1) * theirs[2:4]).all()


@pytest.mark.long
@pytest.mark.parametrize("place", [pytest.param(0.0, marks=pytest.mark.slow), 15.0])
def test_tree_rings_move_and_stretch_stars(place, star):
    amplitude, period, center = 0.05, 60.0, np.array([-20.0, -1500.0])
    # GalSim's function is of boundaries, ours of light; and it counts pixels from their lower left corner.
    table = galsim.LookupTable.from_func(
        lambda r: -amplitude * np.cos(2.0 * np.pi * r / period), x_min=0.0, x_max=2000.0, npoints=100_001
    )
    axis = galsim.PositionD(*(center - [0.0, place] + 0.5))
    theirs, error = changes(
        200_000, 12, "lsst_itl_50_8", strength=1e-6, nrecalc=1e9, treering_func=table, treering_center=axis
    )
    rings = TreeRings(amplitude * PIXEL, period * PIXEL, tuple(center * PIXEL))
    at = np.array([[0.0, place]]) * PIXEL
    ours = moments(displace_stamps(star[None], [rings], at, PIXEL)[0]) - moments(star)
    # Stamps leave out the displacement of the star as a whole.
    ours[:2] += rings.at(*at[0]) / PIXEL
    assert (np.abs(ours - theirs) < 3.5 * error + 1e-5).all()
    # What there is to find: 0.05 pixels on a crest, 1 % of the second moment between two.
    assert np.abs(theirs[1]) > 0.04 or np.abs(theirs[3]) > 0.015
