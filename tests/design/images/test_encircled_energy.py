"""Encircled energy against closed forms and brute force."""

import math

import numpy as np
import pytest
from scipy.integrate import cumulative_simpson
from scipy.special import j0, j1

import pachon
import pachon.design.images.encircled_energy as module
from pachon.core.errors import ConfigError, DomainError
from pachon.design.images.diffraction import fft_psf
from pachon.design.images.encircled_energy import encircled_energy, energy_curve
from pachon.design.metrics.spots import spots

WAVE = 500e-9


def test_a_gaussian_about_its_centroid():
    y, x = np.indices((61, 61))
    image = np.exp(-0.5 * ((x - 33.3) ** 2 + (y - 28.6) ** 2) / 16.0)
    radii = np.array([0.0, 2.0, 4.0, 8.0])
    energy = np.interp(radii, *energy_curve(0.5 * image / image.sum()))
    # A pixel counts as a square of even light: it adds 1/12 to the variance of 16.
    assert energy == pytest.approx(0.5 * (1.0 - np.exp(-0.5 * radii**2 / (16.0 + 1.0 / 12.0))), abs=1e-3)


def test_pixels_are_squares_of_even_light():
    image = np.zeros((9, 11))
    image[2:7, 4:9] = 2.0
    radius, light = energy_curve(image, center=(6.0, 4.0))
    # A circle within the square of 5 x 5 holds its own area; parts of a quarter of a pixel know it to some per cent.
    assert np.interp([1.1, 2.3], radius, light) == pytest.approx(2.0 * np.pi * np.array([1.1, 2.3]) ** 2, rel=0.03)
    assert np.interp(3.6, radius, light) == pytest.approx(50.0, abs=1e-6)


@pytest.mark.long
@pytest.mark.parametrize("obscuration", [0.0, 0.6])
def test_a_perfect_pupil(paraboloid, obscuration):
    telescope = paraboloid(f_number=50.0, obscuration=obscuration)
    radii = 50.0 * WAVE * np.array([0.5, 1.0, 2.0, 4.0, 8.0])
    found = encircled_energy(telescope, [[0.0, 0.0]], WAVE, radii=radii, n_pupil=300).fraction[0]
    # The pattern of an annulus (Born & Wolf, sec. 8.6.2), integrated over circles.
    e = obscuration
    v = np.linspace(1e-9, 30.0, 6001)
    amplitude = (2.0 * j1(v) / v - (e**2 * 2.0 * j1(e * v) / (e * v) if e else 0.0)) / (1.0 - e**2)
    theory = 0.5 * (1.0 - e**2) * cumulative_simpson(amplitude**2 * v, x=v, initial=0.0)
    # The rim of the lattice, and light that comes round after 300 Airy units: a thousandth.
    assert found == pytest.approx(np.interp(np.pi * radii / (50.0 * WAVE), v, theory), abs=1.5e-3)


@pytest.mark.parametrize("fraction", [0.5, 0.8, 0.9])
def test_radii_of_a_perfect_pupil(paraboloid, fraction):
    """They were up to 1.5 % too large: pixels in steps, fewer points of the pupil, straight lines between radii."""
    found = encircled_energy(paraboloid(f_number=50.0), [[0.0, 0.0]], WAVE).radius_holding(fraction)[0]
    v = np.linspace(1e-9, 12.0, 6001)
    theory = np.interp(fraction, 1.0 - j0(v) ** 2 - j1(v) ** 2, v)
    assert np.pi * found / (50.0 * WAVE) == pytest.approx(theory, rel=1.5e-3)


def test_one_radius_is_a_curve_too(paraboloid):
    energy = encircled_energy(paraboloid(f_number=50.0), [[0.0, 0.0]], WAVE, radii=[30e-6])
    np.testing.assert_array_equal(energy.radius_holding(0.5), [30e-6])
    assert np.isnan(energy.radius_holding(0.99)).all()


def test_rays_of_a_defocused_annulus_fill_a_ring(paraboloid):
    telescope = paraboloid(f_number=20.0, obscuration=0.5, shift=1e-3)
    radii = np.linspace(5e-6, 26e-6, 22)
    energy = encircled_energy(telescope, [[0.0, 0.0]], kind="geometric", radii=radii)
    # Rays through the height r of the pupil land at r / f times the defocus, but for a thousandth at f/20.
    inner, outer = 0.5 * 25e-6, 25e-6
    share = np.clip((radii**2 - inner**2) / (outer**2 - inner**2), 0.0, 1.0)
    assert energy.fraction[0] == pytest.approx(share, abs=3e-3)
    assert energy.radius_holding(0.5)[0] == pytest.approx(np.sqrt(0.5 * (inner**2 + outer**2)), rel=0.01)


@pytest.mark.parametrize("sampling", ["gauss", "rings"])
def test_rings_of_rays_at_equal_distances_stand_in_the_middle_of_their_light(paraboloid, sampling):
    """As in the radii of the spots: the ring above, of a few rings of rays."""
    diagram = spots(paraboloid(f_number=20.0, obscuration=0.5, shift=1e-3), [[0.0, 0.0]], sampling=sampling, n_pupil=6)
    for fraction in (0.3, 0.45, 0.6, 0.75):
        radius = 25e-6 * np.sqrt(0.25 + 0.75 * fraction)
        assert encircled_energy(diagram).radius_holding(fraction)[0] == pytest.approx(radius, rel=0.01)
        assert diagram.radius_holding(fraction)[0] == pytest.approx(radius, rel=0.01)


def test_light_that_falls_beside_the_image_is_missed(paraboloid):
    psf = fft_psf(paraboloid(f_number=20.0), [[0.0, 0.0]], WAVE, pixels=24)
    energy = encircled_energy(psf)
    assert energy.fraction[0, -1] < psf.inside[0] < 1.0
    assert np.isnan(energy.radius_holding(0.999)[0])
    with pytest.raises(DomainError, match="the images' edge"):
        encircled_energy(psf, radii=[1.0])


@pytest.mark.long
def test_over_the_field_of_the_lsst():
    telescope = pachon.load_telescope("lsst_v3.3_i")
    fields = np.deg2rad([[0.0, 0.0], [0.0, 0.7], [0.0, 1.0], [0.0, 1.4], [0.0, 1.75]])
    energy = encircled_energy(fft_psf(telescope, fields, 750e-9, pixels=160))
    summary = energy.summary()
    radius = np.array(summary["ee80_radius_arcsec"])
    assert radius == pytest.approx(np.rad2deg(energy.radius_holding(0.8) * energy.plate_scale) * 3600.0)
    # FFT PSFs of batoid for this design gave 0.091, 0.088, 0.078 and 0.091; they hold the wings to about 40 um.
    assert radius[[0, 2, 3, 4]] == pytest.approx([0.091, 0.088, 0.078, 0.091], rel=0.035)
    assert max(summary["ee50_radius_um"]) < min(summary["ee80_radius_um"])
    assert energy.plot().get_size_inches()[0] > 5


def test_what_cannot_be_had_is_an_error(lsst_r, paraboloid):
    with pytest.raises(ConfigError, match="kind = 'both'"):
        encircled_energy(lsst_r, kind="both")
    for radii in ([-1e-6, 1e-6], [2e-6, 1e-6], [math.nan]):
        with pytest.raises(DomainError, match="ascending lengths"):
            encircled_energy(lsst_r, radii=radii)
    with pytest.raises(DomainError, match="fraction = 1"):
        encircled_energy(lsst_r, [[0.0, 0.0]], kind="geometric").radius_holding(1)
    with pytest.raises(DomainError, match="image of shape"):
        energy_curve(np.full((3, 3), np.nan))
    with pytest.raises(DomainError, match="expected light"):
        energy_curve(np.zeros((3, 3)))


def test_images_and_spots_already_made_are_the_source(lsst_r):
    fields = np.deg2rad([[0.0, 1.0]])
    spot = spots(lsst_r, fields, WAVE, sampling="spiral", n_pupil=500)
    again = encircled_energy(lsst_r, fields, WAVE, kind="geometric", n_pupil=500)
    np.testing.assert_array_equal(encircled_energy(spot).fraction, again.fraction)
    for name, value in {"fields": fields, "wavelengths": WAVE, "kind": "geometric", "n_pupil": 3}.items():
        with pytest.raises(ConfigError, match=f"{name} = .*: given beside a SpotDiagram, which has its own"):
            encircled_energy(spot, **{name: value})


@pytest.mark.parametrize(
    ("name", "replacement"),
    [
        ("pixels", "telescope=fft_psf(telescope, fields, wavelengths, pixels=...)"),
        ("sampling", "telescope=spots(telescope, fields, wavelengths, sampling=...)"),
        ("projection", "telescope=Request.of(telescope, fields, wavelengths, projection=...)"),
    ],
)
def test_arguments_of_earlier_versions_name_their_place(lsst_r, name, replacement):
    with pytest.raises(ConfigError) as raised:
        encircled_energy(lsst_r, **{name: None})
    assert str(raised.value) == f"{name}: no argument of encircled_energy; expected {replacement}"


@pytest.mark.long
def test_energy_of_a_field_does_not_depend_on_the_other_fields(paraboloid):
    """Coma of another field made pixels as large as the radius of the Airy disc, and its radii wrong by as much."""
    telescope = paraboloid(f_number=4.0)
    fields = np.deg2rad([[0.0, 0.0], [0.0, 0.3]])
    alone, both = (pachon.encircled_energy(telescope, some_fields, 500e-9) for some_fields in (fields[:1], fields))
    for fraction in (0.3, 0.5, 0.8, 0.9):
        # The curve of one field is joined by straight lines 0.17 um long.
        assert both.radius_holding(fraction)[0] == pytest.approx(alone.radius_holding(fraction)[0], rel=6e-3)
    assert both.radius_holding(0.5)[1] > 20e-6
    # Beyond the edge of its own image the curve goes on.
    assert (np.diff(both.fraction, axis=1) > -1e-6).all()
    assert both.fraction[0, -1] > alone.fraction[0, -1]


def test_widths_of_images_narrower_than_their_pixels_are_not_known(paraboloid):
    psf = pachon.fft_psf(paraboloid(f_number=4.0), [[0.0, 0.0]], 500e-9, pixel=4e-6, pixels=16)
    assert np.isnan(psf.fwhm[0])
    assert psf.summary()["fwhm_um"] == [None]
    assert "within some pixels" in psf.plot().axes[0].get_xlabel()


def test_no_image_is_made_twice_for_large_spots(paraboloid, monkeypatch):
    # 4 mm off the focus the spot of f/20 is far larger than an Airy disc, and its pixels are as fine as they get.
    telescope = paraboloid(shift=4e-3)
    made = []
    monkeypatch.setattr(module, "fft_psf", lambda *a, **k: made.append(a) or fft_psf(*a, **k))
    energy = module.diffracted_energy(pachon.Request.of(telescope, [(0.0, 0.0)], WAVE), pixels=32)
    assert len(made) == 1
    # A disc of light of 0.2 mm: 80 % within sqrt(0.8) of its radius, but for its rings of diffraction.
    assert energy.radius_holding(0.8)[0] == pytest.approx(np.sqrt(0.8) * 1e-4, rel=0.05)
