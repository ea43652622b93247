"""The long-exposure engine on pupils of any form: vanes, plates, vignetting, no obscuration, small ones."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import pachon
import pachon.wavefront.psf.long_exposure as engine_module
from pachon.models.aperture import Circle, Complement, Vane
from pachon.models.obstruction import Obstruction
from pachon.models.shapes.shape import Plane
from pachon.models.surface import Interaction, Surface
from pachon.raytrace.pack.surfaces import clear_annulus
from pachon.wavefront.atmosphere.turbulence import diffraction_otf, structure_function
from pachon.wavefront.psf.clear_pupil import lit_fractions
from pachon.wavefront.psf.engine import PsfInputs, Stars
from pachon.wavefront.psf.image_plane import ImagePlane
from pachon.wavefront.psf.lattice_pupil import FEWEST_POINTS, LatticeTransfer
from pachon.wavefront.psf.long_exposure import LongExposureEngine
from pachon.wavefront.psf.mean_rays import MeanRaysRenderer
from pachon.wavefront.psf.psf import make_psfs
from pachon.wavefront.psf.stamps import Stamps
from pachon.wavefront.pupil_optics import trace_pupils

ARCSEC = np.pi / 180 / 3600
R0, OUTER_SCALE = 0.16, 25.0
#: A lens of 10 cm with a hyperbolic face.
REFRACTOR = Path(__file__).parents[2] / "data" / "telescopes" / "refractor.yaml"


def air(seed=1, **options):
    return pachon.Atmosphere.from_site("cerro_pachon", seed, **({"r0": R0, "outer_scale": OUTER_SCALE} | options))


def renderer_for(telescope, wavelengths, plane, n_pupil=None, threads=1):
    inputs = PsfInputs(telescope, np.atleast_1d(wavelengths), plane, atmosphere=air(), threads=threads)
    return LongExposureEngine(n_pupil).renderer(inputs)


def brute_force(telescope, field, wavelengths, plane, *, spacing, longest):
    """The mean image by the autocorrelation of a fine lattice of rays, and the angle of a pixel [rad]."""
    wavelengths = np.atleast_1d(wavelengths)
    jacobian = trace_pupils(telescope, field[None], wavelengths, np.zeros((1, 2))).jacobian[0]
    focal = np.sqrt(abs(np.linalg.det(jacobian)))
    size = int(np.ceil((1.06 * telescope.pupil_diameter + longest) / spacing / 8)) * 8
    line = (np.arange(size) - size // 2) * spacing
    p = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2) @ jacobian / focal
    radius = np.hypot(*p.T) / (0.5 * telescope.pupil_diameter)
    inside = np.flatnonzero((radius < 1.0) & (radius >= telescope.pupil_obscuration))
    optics = trace_pupils(telescope, field[None], wavelengths, p[inside])
    step = np.arange(-int(longest / spacing), int(longest / spacing) + 1)
    image = np.zeros((plane.size, plane.size))
    for wave, wavelength in enumerate(wavelengths):
        lit = optics.lit[0, wave]
        pupil = np.zeros(size * size, dtype=complex)
        pupil[inside[lit]] = np.exp(2j * np.pi / wavelength * optics.path[0, wave, lit])
        otf = np.fft.ifft2(np.abs(np.fft.fft2(pupil.reshape(size, size))) ** 2)[np.ix_(step, step)] / lit.sum()
        k = -2 * np.pi * spacing / (wavelength * focal) * step
        along = np.stack(np.meshgrid(k, k), axis=-1) @ jacobian * wavelength / (2 * np.pi)
        structure = structure_function(np.hypot(along[..., 0], along[..., 1]), R0, OUTER_SCALE)
        otf *= np.exp(-0.5 * (2 * np.pi / wavelength) ** 2 * structure) * plane.transfer(k, k[:, None])
        to_pixels = np.exp(1j * np.outer(plane.pixel_centers, k))
        image += (plane.pixel_size * abs(k[1] - k[0]) / (2 * np.pi)) ** 2 * (to_pixels @ otf @ to_pixels.T).real
    return image / len(wavelengths), plane.pixel_size / focal


def shape(image, scale):
    found = pachon.measure_shapes(image[None], scale, 0.7 * ARCSEC)
    return np.array([found.e1[0], found.e2[0]]), found.size[0]


def defocused(name, shift):
    telescope = pachon.load_telescope(name)
    return telescope.perturbed(telescope.surfaces[-1].name, shift=(0.0, 0.0, shift))


def tube(telescope):
    """A telescope behind a ring far in front of it, which vignettes most of the pupil off the axis."""
    ring = Surface("tube", Interaction.PASS, Plane(), (0.0, 0.0, 120.0), telescope.medium_before, Circle(4.3))
    return replace(telescope, name="tube", surfaces=(ring, *telescope.surfaces))


def discs_alone(telescope):
    """A telescope without vanes, plates and other apertures that are no discs or rings."""
    surfaces = [replace(s, aperture=None) if clear_annulus(s.aperture) is None else s for s in telescope.surfaces]
    return replace(telescope, surfaces=tuple(surfaces), obstructions=())


LSST, COARSE = ImagePlane(31, 10e-6, 4e-6), ImagePlane(37, 15e-6, 5e-6)


@pytest.mark.long
@pytest.mark.parametrize(
    ("make", "field_deg", "plane", "wavelengths", "spacing", "longest"),
    [
        pytest.param(lambda: defocused("hsc", 20e-6), (0.5, 0.5), COARSE, 770e-9, 0.0125, 1.0, marks=pytest.mark.slow),
        # Other wavelengths, where dark rays pass the lenses far outside of what is ground.
        (lambda: defocused("hsc", -10e-6), (-0.2, 0.69), COARSE, [700e-9, 820e-9], 0.0125, 1.0),
        (lambda: discs_alone(pachon.load_telescope("hsc")), (0.1, 0.35), COARSE, 770e-9, 0.0125, 1.0),
        pytest.param(
            lambda: defocused("decam", 20e-6),
            (0.5, -0.7),
            COARSE,
            [580e-9, 640e-9, 700e-9],
            0.01,
            1.0,
            marks=pytest.mark.slow,
        ),
        (lambda: defocused("lsst_v3.3_r_obstructed", 10e-6), (1.3, -0.8), LSST, 620e-9, 0.0125, 1.0),
        # Vignetted to a half and to 0.38 of the ring; and a small pupil, of which strips along the rims are a half.
        pytest.param(
            lambda: tube(defocused("lsst_v3.3_r", 10e-6)), (0.9, 0.6), LSST, 620e-9, 0.0125, 1.0, marks=pytest.mark.slow
        ),
        (lambda: tube(defocused("lsst_v3.3_r", 10e-6)), (1.3, 1.1), LSST, 620e-9, 0.0125, 1.0),
        (lambda: defocused("auxtel", 150e-6), (0.03, 0.04), ImagePlane(65, 10e-6, 4e-6), 620e-9, 0.004, 1.19),
    ],
)
def test_against_brute_force_over_the_pupil(make, field_deg, plane, wavelengths, spacing, longest):
    telescope, field = make(), np.radians(field_deg)
    expected, scale = brute_force(telescope, field, wavelengths, plane, spacing=spacing, longest=longest)
    stars = renderer_for(telescope, wavelengths, plane).render(field[None], np.zeros((1, 2)))
    (e, size), (e_wave, size_wave) = shape(stars.image[0], scale), shape(expected, scale)
    # Points of the lattices of both, which are lit or dark: 2e-4 for 7500 points of a ring, 8e-5 for 30 000.
    np.testing.assert_allclose(e, e_wave, atol=2e-4)
    assert size == pytest.approx(size_wave, rel=2e-4)
    np.testing.assert_allclose(stars.image[0], expected, atol=1.5e-3 * expected.max())


@pytest.mark.long
def test_many_spokes_of_a_half_lit_pupil():
    for telescope, field_deg in (
        (defocused("lsst_v3.3_r", 10e-6), (1.5, 1.21)),
        (tube(defocused("lsst_v3.3_r", 0.0)), (0.6, 0.85)),
    ):
        field = np.radians(field_deg)
        expected, scale = brute_force(telescope, field, 620e-9, LSST, spacing=0.0125, longest=1.0)
        stars = renderer_for(telescope, 620e-9, LSST).render(field[None], np.zeros((1, 2)))
        assert 0.5 < stars.lit_fraction[0, 0] < 0.6
        (e, size), (e_wave, size_wave) = shape(stars.image[0], scale), shape(expected, scale)
        np.testing.assert_allclose(e, e_wave, atol=1e-4)
        # Strips that overlapped where two rims meet would make 1.7e-4 and 3.2e-4.
        assert size == pytest.approx(size_wave, rel=5e-5)


def closed_form(plane, diameter, obscuration, focal, wavelength, r0, margin=1.25):
    """The image of perfect optics: Fried's long-exposure transfer function times that of the pupil."""
    reach = int(np.ceil(diameter * margin * plane.side / (wavelength * focal))) + 1
    k = 2 * np.pi / (margin * plane.side) * np.arange(-reach, reach + 1)
    b = np.hypot(k, k[:, None]) * wavelength * focal / (2 * np.pi)
    otf = diffraction_otf(b, diameter, obscuration) * plane.transfer(k, k[:, None])
    otf *= np.exp(-0.5 * (2 * np.pi / wavelength) ** 2 * structure_function(b, r0, OUTER_SCALE))
    to_pixels = np.exp(1j * np.outer(plane.pixel_centers, k))
    return (plane.pixel_size * (k[1] - k[0]) / (2 * np.pi)) ** 2 * (to_pixels @ otf @ to_pixels.T).real


def test_a_small_refractor_is_the_closed_product_of_transfer_functions():
    """An open pupil as wide as the Fried parameter, where no baseline is left out."""
    telescope = pachon.load_telescope(REFRACTOR)
    plane = ImagePlane(31, 2.4e-6, 0.5e-6)
    image = renderer_for(telescope, 620e-9, plane).render(np.zeros((1, 2)), np.zeros((1, 2))).image[0]
    expected = closed_form(plane, 0.1, 0.0, 0.8, 620e-9, R0)
    # Rays that come round after 98 times lambda/D carry 3e-4; the rim of the lattice.
    np.testing.assert_allclose(image, expected, atol=5e-4 * expected.max())
    assert shape(image, 2.4e-6 / 0.8)[1] == pytest.approx(shape(expected, 2.4e-6 / 0.8)[1], rel=5e-4)
    # A run of wave optics without an atmosphere is sharper: turbulence does its share.
    sharp = make_psfs(
        telescope, [[0, 0]], 620e-9, engine="wave", stamps=Stamps(pixel_size=2.4e-6, diffusion=5e-7)
    ).image[0]
    assert sharp.max() > 1.2 * image.max()


def test_weak_turbulence_keeps_long_baselines(polynomial_pupil):
    """A Fried parameter of 2 m leaves 0.1 of a baseline as long as the ring is wide."""
    plane = ImagePlane(61, 2e-6, 0.0)
    engine = LongExposureEngine().renderer(
        polynomial_pupil().inputs(np.array([620e-9]), plane, atmosphere=air(r0=2.0), threads=1)
    )
    image = engine.render(np.zeros((1, 2)), np.zeros((1, 2))).image[0]
    expected = closed_form(plane, 8.36, 0.612, engine.focal_length, 620e-9, 2.0)
    np.testing.assert_allclose(image, expected, atol=2e-3 * expected.max())


@pytest.mark.long
@pytest.mark.parametrize("silicon", [None, pachon.models.Silicon()])
def test_lattice_and_strips_agree(silicon, monkeypatch):
    """Five wavelengths, dispersed; the reference star of each way is the same telescope by the other."""
    telescope = defocused("lsst_v3.3_y", 8e-6)
    fields, wavelengths = np.radians([(0.0, 0.0), (0.8, 0.6), (1.3, 1.0)]), np.linspace(*telescope.band, 5)
    dispersion = np.stack([np.linspace(-1e-6, 1e-6, 5), np.zeros(5)], axis=1)
    light = pachon.Light(wavelengths, dispersion=dispersion)
    stamps = Stamps(jitter=2e-7, offsets=[[0.3, 0.2]] * 3, silicon=silicon)
    found = []
    for rings in (engine_module.has_only_annuli, lambda telescope: False):
        monkeypatch.setattr(engine_module, "has_only_annuli", rings)
        found.append(make_psfs(telescope, fields, light, atmosphere=air(), engine="long_exposure", stamps=stamps))
    strips, lattice = found
    np.testing.assert_allclose(lattice.image, strips.image, atol=1.5e-3 * strips.image.max())
    np.testing.assert_allclose(lattice.inside, strips.inside, atol=2e-4)
    for star in range(3):
        one, other = (shape(p.image[star], p.pixel_scale) for p in found)
        np.testing.assert_allclose(one[0], other[0], atol=2e-4)
        assert one[1] == pytest.approx(other[1], rel=3e-4)


def test_bytes_do_not_depend_on_threads_batches_or_company():
    telescope = pachon.load_telescope("hsc")
    rng = np.random.default_rng(1)
    fields, offsets = rng.uniform(-0.008, 0.008, (5, 2)), rng.uniform(-0.5, 0.5, (5, 2))

    def images(select, threads):
        engine = renderer_for(telescope, [750e-9, 790e-9], COARSE, threads=threads, n_pupil=1000)
        return engine.render(fields[select], offsets[select]).image

    everything = images(slice(None), 1)
    np.testing.assert_array_equal(images(slice(None), 3), everything)
    np.testing.assert_array_equal(images([4, 0], 2), everything[[4, 0]])


def test_vanes_and_solids_are_served(lsst_r):
    """Light is lost behind them, and the image keeps its sum."""
    vane = Complement(Vane(0.1, both_ways=True))
    plane = Surface("spider", Interaction.PASS, Plane(), (0.0, 0.0, 9.0), lsst_r.medium_before, vane)
    corner = np.array([[[2.6, -0.5, 9.0], [4.2, -0.5, 9.0], [4.2, 0.5, 9.0]]])
    star = np.array([[0.01, 0.015]])
    plain = make_psfs(lsst_r, star, 620e-9, atmosphere=air(), engine="long_exposure")
    for telescope, least in (
        (replace(lsst_r, surfaces=(plane, *lsst_r.surfaces)), 0.005),
        (replace(lsst_r, obstructions=(Obstruction("plate", corner),)), 0.005),
    ):
        found = make_psfs(telescope, star, 620e-9, atmosphere=air(), engine="long_exposure")
        assert 0.9 * plain.lit_fraction < found.lit_fraction < plain.lit_fraction - least
        assert found.inside == pytest.approx(plain.inside, abs=5e-4)


@pytest.mark.parametrize(
    ("aperture", "lit"),
    [
        (Complement(Circle(0.5, x=3.4)), 1.0 - 0.5**2 / (4.18**2 - 2.558**2)),
        (Circle(0.6, x=-2.0, y=2.6), 0.6**2 / (4.18**2 - 2.558**2)),
    ],
)
def test_discs_beside_the_axis(lsst_r, aperture, lit):
    """No spoke of a few tens is one clear piece there, or meets them."""
    plane = Surface("mask", Interaction.PASS, Plane(), (0.0, 0.0, 9.0), lsst_r.medium_before, aperture)
    telescope = replace(lsst_r, surfaces=(plane, *lsst_r.surfaces))
    found = make_psfs(telescope, np.zeros((1, 2)), 620e-9, atmosphere=air(), engine="long_exposure")
    assert found.lit_fraction == pytest.approx(lit, abs=1e-3)
    # Of a thousand rays.
    assert lit_fractions(telescope, np.array([[0.0, 0.0, -1.0]]), 620e-9) == pytest.approx(lit, abs=3e-3)


def test_donuts_of_a_telescope_with_vanes():
    """Out of focus the points are as close as the donut needs, and its image is that of brute force."""
    telescope, plane = defocused("hsc", 0.5e-3), ImagePlane(51, 15e-6, 5e-6)
    engine = renderer_for(telescope, 770e-9, plane)
    field = np.radians([[0.3, 0.2]])
    assert engine._lattice.refinement(engine._lattice_rays(engine._lattice, Stars(field, np.zeros((1, 2))))) == [2]
    image = engine.render(field, np.zeros((1, 2))).image[0]
    expected, _ = brute_force(telescope, field[0], 770e-9, plane, spacing=0.0125, longest=1.2)
    np.testing.assert_allclose(image, expected, atol=2e-3 * expected.max())
    # Dense rays under one filter, which stars still farther out are left to, lose 4 % of the peak along the rims.
    inputs = PsfInputs(telescope, np.array([770e-9]), plane, atmosphere=air(), threads=1)
    rays = MeanRaysRenderer(inputs, 1 << 14).expose_without_refinement(Stars(field, np.zeros((1, 2)))).draw(None)[0]
    np.testing.assert_allclose(image, rays, atol=0.05 * rays.max())
    assert image.sum() == pytest.approx(rays.sum(), rel=2e-3)


def test_rims_of_donuts_that_lose_a_third_of_their_light():
    """Rays that the apertures of HSC stop land up to 50 mm away; rims are where rays pass."""
    telescope, plane = defocused("hsc", 0.5e-3), ImagePlane(51, 15e-6, 5e-6)
    field, at = np.radians([[0.0, 0.675]]), np.zeros((1, 2))
    image = renderer_for(telescope, 770e-9, plane).render(field, at).image[0]
    inputs = PsfInputs(telescope, np.array([770e-9]), plane, atmosphere=air(), threads=1)
    rays = MeanRaysRenderer(inputs, 1 << 14).expose_without_refinement(Stars(field, at)).draw(None)[0]
    np.testing.assert_allclose(rays, image, atol=0.02 * image.max())


def test_dark_stars_and_points_asked_for(lsst_r):
    plate = Obstruction("lid", np.array([[[-9.0, -9.0, 9.0], [9.0, -9.0, 9.0], [0.0, 20.0, 9.0]]]))
    found = make_psfs(
        replace(lsst_r, obstructions=(plate,)), [[0, 0]], 620e-9, atmosphere=air(), engine="long_exposure"
    )
    assert found.flags.tolist() == [1]
    assert not found.image.any()
    hsc = pachon.load_telescope("hsc")
    points = LongExposureEngine.default_points
    assert (points(lsst_r), points(hsc)) == (80, 30000)
    with pytest.raises(pachon.PachonError, match=f"n_pupil = 80: expected .*{FEWEST_POINTS}"):
        renderer_for(hsc, 770e-9, COARSE, n_pupil=80)


def test_points_of_the_lattice_fill_the_ring():
    transfer = LatticeTransfer.fill(8.2, 0.155, 7500, np.array([620e-9]))
    assert len(transfer.points) == pytest.approx(7500 * (1 - 0.155**2), rel=2e-3)
    radius = np.hypot(*transfer.points.T)
    assert radius.min() >= 4.1 * 0.155
    assert radius.max() < 4.1
    assert transfer.refined(3).lattice.spacing == pytest.approx(transfer.lattice.spacing / 3)
