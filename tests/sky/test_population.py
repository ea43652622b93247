"""Random galaxies against published counts, sizes and shapes; the same galaxies in every region."""

import numpy as np
import pytest
from astropy import units as u
from scipy.special import gammaincinv

from pachon.core.errors import DomainError
from pachon.core.units import ARCMIN, ARCSEC
from pachon.sky.galaxies import Galaxies
from pachon.sky.morphology import IRREGULAR_KINDS, draw_ellipticity, galaxy_kinds
from pachon.sky.population import GalaxyPopulation, draw_galaxies

NAMES = ("xi", "eta", "magnitude", "radius", "first", "dx", "dy", "fraction", "component_radius", "e1", "e2", "sersic")


@pytest.fixture(scope="module")
def deep():
    """As much sky as the Ultra Deep Field, 11 square arcminutes, to its limit."""
    return draw_galaxies(0.5 * np.sqrt(11.0) * ARCMIN, 29.0, 3)


@pytest.fixture(scope="module")
def wide():
    """100 square arcminutes to 26.5."""
    return draw_galaxies(5.0 * ARCMIN, 26.5, 4)


def same(a, b):
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in NAMES)


def discs(galaxies):
    """Galaxies of two components of which the second is a bulge."""
    second = np.minimum(galaxies.first[:-1] + 1, len(galaxies.sersic) - 1)
    return (np.diff(galaxies.first) == 2) & (galaxies.sersic[second] == 4.0)


def photons(galaxies, index, count, rng):
    """Places of photons from a galaxy, by inversion of the light within a radius."""
    parts = np.arange(galaxies.first[index], galaxies.first[index + 1])
    part = rng.choice(parts, size=count, p=galaxies.fraction[parts])
    n = galaxies.sersic[part]
    r = (rng.gamma(2.0 * n) / gammaincinv(2.0 * n, 0.5)) ** n
    z = r * np.exp(2j * np.pi * rng.random(count))
    e = galaxies.e1[part] + 1j * galaxies.e2[part]
    z = galaxies.component_radius[part] * (z + e * np.conj(z)) / np.sqrt(1.0 - np.abs(e) ** 2)
    return z + galaxies.dx[part] + 1j * galaxies.dy[part]


def test_counts_are_those_of_the_science_book(wide):
    for magnitude in (22.0, 24.0, 25.3, 26.5):
        # LSST Science Book 2009, eq. 3.7, above the bright limit of 20.
        expected = 100.0 * 46.0 * (10.0 ** (0.31 * (magnitude - 25.0)) - 10.0 ** (0.31 * -5.0))
        # Four sigma of a Poisson number.
        assert abs(np.sum(wide.magnitude < magnitude) - expected) < 4.0 * np.sqrt(expected)
    assert wide.magnitude.min() > 20.0


def test_the_ultra_deep_field_has_as_many_objects(deep):
    # Coe et al. 2006 detect 8042 objects at 10 sigma, to i = 29.01; the power law is 9 % above them.
    assert len(deep) == pytest.approx(8042, rel=0.12)


def test_sizes_of_discs_fall_with_magnitude(wide):
    of = discs(wide)
    main = wide.first[:-1][of]
    e = np.hypot(wide.e1, wide.e2)[main]
    # Along the major axis, in exponential scale lengths (Miller et al. 2013).
    length = np.log(wide.radius[of] * np.sqrt((1.0 + e) / (1.0 - e)) / 1.678 / ARCSEC)
    residual = length + 1.145 + 0.269 * (wide.magnitude[of] - 23.0)
    assert of.sum() > 2000
    # Four sigma of a mean and of a standard deviation.
    assert abs(residual.mean()) < 4.0 * 0.4 / np.sqrt(of.sum())
    assert residual.std() == pytest.approx(0.4, abs=4.0 * 0.4 / np.sqrt(2.0 * of.sum()))


def test_faint_galaxies_are_as_small_as_those_of_the_ultra_deep_field(deep):
    # Bouwens et al. 2004: galaxies of 26 < z' < 27.5 have half-light radii of 0.1 to 0.3 arcsec.
    radius = deep.radius[(deep.magnitude > 26.0) & (deep.magnitude < 27.5)] / ARCSEC
    assert 0.1 < np.median(radius) < 0.2
    assert np.percentile(radius, 95) == pytest.approx(0.27, abs=0.05)


def test_ellipticities_have_the_dispersion_of_the_literature(wide):
    # Second moments of the components, of one profile, about the centroid of each galaxy.
    e = wide.e1 + 1j * wide.e2
    place = np.log(2.0) * (wide.dx + 1j * wide.dy) ** 2
    size = wide.component_radius**2 * (1.0 + np.abs(e) ** 2) / (1.0 - np.abs(e) ** 2)
    stretch = 2.0 * e / (1.0 + np.abs(e) ** 2) * size + place
    moments = [np.add.reduceat(wide.fraction * m, wide.first[:-1]) for m in (stretch, size + np.abs(place))]
    distortion = moments[0] / moments[1]
    whole = distortion / (1.0 + np.sqrt(1.0 - np.abs(distortion) ** 2))
    # Leauthaud et al. 2007 (COSMOS): 0.26 a component.
    assert whole.real.std() == pytest.approx(0.26, abs=0.02)
    assert whole.imag.std() == pytest.approx(0.26, abs=0.02)
    # No direction is preferred: four sigma of a mean.
    assert abs(whole.mean()) < 4.0 * 0.37 / np.sqrt(len(wide))


def test_axis_ratios_of_discs_peak_where_those_of_spirals_do():
    uniform = (np.arange(200000) + 0.5) / 200000
    e = draw_ellipticity(uniform, spheroid=False)
    ratio = (1.0 - e) / (1.0 + e)
    density, edges = np.histogram(ratio, bins=20, range=(0.0, 1.0))
    # Elmegreen et al. 2005: a clear peak at about 0.55 in the Ultra Deep Field.
    assert 0.4 < edges[density.argmax()] < 0.7
    assert np.sqrt(np.mean(e**2) / 2.0) == pytest.approx(0.256, abs=0.001)
    spheroid = draw_ellipticity(uniform, spheroid=True)
    assert np.sqrt(np.mean(spheroid**2) / 2.0) == pytest.approx(0.224, abs=0.001)


def test_half_of_the_faint_galaxies_are_irregular(deep):
    faint = deep.magnitude > 26.0
    components = np.diff(deep.first)[faint]
    tadpole = (components == 2) & ~discs(deep)[faint]
    n = faint.sum()
    # Four sigma of a binomial number.
    error = 4.0 * np.sqrt(0.25 / n)
    assert np.mean((components > 2) | tadpole) == pytest.approx(0.5, abs=error)
    # Elmegreen et al. 2005: 126 doubles and 97 tadpoles among 515.
    assert np.mean(components == 3) == pytest.approx(0.5 * 126 / 515, abs=error)
    assert np.mean(tadpole) == pytest.approx(0.5 * 97 / 515, abs=error)
    assert np.mean(components == 1) == pytest.approx(0.1, abs=error)


def test_bright_galaxies_are_more_regular():
    uniform = (np.arange(1000) + 0.5) / 1000
    kinds = [galaxy_kinds(np.full(1000, m), uniform, uniform) for m in (20.0, 22.0, 24.0, 29.0)]
    assert np.allclose([np.mean(k >= 2) for k in kinds], [0.2, 0.35, 0.5, 0.5], atol=2e-3)
    assert sum(k.number for k in IRREGULAR_KINDS) == 178 + 114 + 126 + 97


def test_half_of_the_light_lies_within_the_half_light_radius(wide):
    rng = np.random.default_rng(0)
    ratio = []
    for i in range(150):
        z = photons(wide, i, 2000, rng)
        # The centroid of a galaxy is its position, without the far photons of bulges.
        near = np.abs(z) < 5.0 * wide.radius[i]
        assert abs(z[near].mean()) < 0.25 * wide.radius[i]
        ratio.append(np.median(np.abs(z)) / wide.radius[i])
    # Circles hold half of the light of ellipses at radii larger than sqrt(a b), and sums are no Gaussians.
    assert np.median(ratio) == pytest.approx(1.05, abs=0.05)
    assert np.percentile(ratio, [2, 98]) == pytest.approx([0.85, 1.45], abs=0.15)


def test_any_region_has_the_same_galaxies():
    population = GalaxyPopulation(25.0, 8)
    whole = population.galaxies_in((-2 * ARCMIN, 2 * ARCMIN), (-1 * ARCMIN, 3 * ARCMIN))
    xi, eta = (-1.3 * ARCMIN, 0.2 * ARCMIN), (0.1 * ARCMIN, 2.9 * ARCMIN)
    part = population.galaxies_in(xi, eta)
    inside = (whole.xi >= xi[0]) & (whole.xi < xi[1]) & (whole.eta >= eta[0]) & (whole.eta < eta[1])
    assert 50 < len(part) == inside.sum() < len(whole)
    assert same(part, whole.take(inside))
    left = population.galaxies_in((-2 * ARCMIN, -0.4 * ARCMIN), (-1 * ARCMIN, 0.0))
    right = population.galaxies_in((-0.4 * ARCMIN, 2 * ARCMIN), (-1 * ARCMIN, 0.0))
    assert sorted(np.concatenate([left.xi, right.xi])) == sorted(whole.xi[whole.eta < 0.0])


def test_a_fainter_limit_adds_galaxies():
    shallow, deep = (draw_galaxies(ARCMIN, limit, 5) for limit in (24.5, 26.0))
    assert same(shallow, deep.take(deep.magnitude < 24.5))


def test_another_seed_or_density_makes_another_sky():
    first, second = (draw_galaxies(2 * ARCMIN, 25.0, seed) for seed in (1, 2))
    assert not np.isin(first.xi, second.xi).any()
    thrice = draw_galaxies(2 * ARCMIN, 25.0, 1, density=3.0)
    assert abs(len(thrice) - 3 * len(first)) < 4.0 * np.sqrt(12 * len(first))
    assert len(draw_galaxies(0.1 * ARCSEC, 21.0, 1)) == 0


def test_regions_take_quantities():
    by_number = draw_galaxies(ARCMIN, 24.0, 2)
    assert same(by_number, draw_galaxies(1.0 * u.arcmin, 24.0, 2))
    assert same(by_number, draw_galaxies([[-1, 1], [-1, 1]] * u.arcmin, 24.0, 2))


def test_galaxies_are_spread_over_the_cells_evenly(wide):
    # A chi-square of 100 cells of mean 134 or so, within four sigma.
    number, _, _ = np.histogram2d(wide.xi, wide.eta, bins=10)
    assert abs(np.sum((number - number.mean()) ** 2) / number.mean() - 99.0) < 4.0 * np.sqrt(2.0 * 99.0)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ((ARCMIN, 19.0, 1), "brightest < faintest"),
        ((ARCMIN, np.nan, 1), "brightest < faintest"),
        ((ARCMIN, 25.0, -1), "seed = -1"),
        ((-1.0, 25.0, 1), "region = -1"),
        (((0.1, 0.0), (0.0, 0.1)), "xi = "),
        (([1.0, 2.0, 3.0], 25.0, 1), "region = "),
        ((0.3, 29.0, 1), "galaxies of this region: needs about"),
    ],
)
def test_bad_arguments(arguments, text):
    if len(arguments) == 2:
        arguments = (arguments, 25.0, 1)
    with pytest.raises(DomainError, match=text):
        draw_galaxies(*arguments)


def test_an_empty_region_has_no_galaxies():
    assert isinstance(draw_galaxies(1e-9, 21.0, 1), Galaxies)
