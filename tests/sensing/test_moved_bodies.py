"""What a defocus moves: the detector, the camera or a mirror, on both sides of focus, in fits of every kind."""

from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from donut_images import PIXEL, WAVELENGTH, donut, noisy

import pachon
from pachon.core.errors import ProductError, UnknownNameError
from pachon.raytrace.rays import field_direction
from pachon.sensing.degrees import FreedomRays
from pachon.sensing.light import Instrument
from pachon.sensing.pupil_cells import pupil_cells
from pachon.sensing.stamp_files import read_stamps
from pachon.sensing.terms import WavefrontTerms

FIELD = np.deg2rad([0.6, 0.9])
SIDES = np.array([1.0, -1.0])
KNOWN_BLUR = pachon.DonutModel(
    air=pachon.DonutAir(fwhm=0.0), detector=pachon.DonutDetector(pixel_size=PIXEL, diffusion=PIXEL)
)


def model_of(body, shifts, pixel=PIXEL):
    detector = pachon.DonutDetector(pixel_size=pixel, diffusion=pixel, defocus=shifts, moved=body)
    return replace(KNOWN_BLUR, detector=detector)


def rss(values):
    return float(np.linalg.norm(values))


def instrument_of(telescope, detector):
    return Instrument.of(telescope, pachon.DonutModel(detector=detector), WavefrontTerms.of(np.arange(4, 12)))


@pytest.fixture(scope="module")
def auxtel():
    return pachon.load_telescope("auxtel")


def wave(telescope, rms, seed=3):
    """Coefficients from j = 1 within the span of Z4 to Z15 [m]."""
    values = np.zeros(15)
    values[3:] = np.random.default_rng(seed).standard_normal(12)
    return rms * values / np.linalg.norm(values)


# Rims of so many rays across leave so much; images of a moved detector have it too.
@pytest.mark.parametrize(
    ("body", "rays", "error"),
    [
        pytest.param("Camera", 250, 20e-9, marks=pytest.mark.long),
        pytest.param("Camera", 900, 4e-9, marks=pytest.mark.slow),
        pytest.param("M2", 900, 4e-9, marks=pytest.mark.slow),
    ],
)
def test_both_sides_of_a_moved_body_have_one_wavefront(focused, body, rays, error):
    """Brute-force rays through the moved telescope; the fit is told what moved, and how far."""
    zernikes = wave(focused, 120e-9)
    images = [
        donut(focused.perturbed(body, shift=(0.0, 0.0, side * 1.5e-3)), FIELD, zernikes=zernikes, rays=rays)
        for side in SIDES
    ]
    common = {"sky_variance": 1000.0, "fit": pachon.sensing.SingleDonuts(range(4, 16), higher_order=0.0), "threads": 1}
    fit = pachon.fit_donuts(
        focused, images, [FIELD] * 2, WAVELENGTH, model=model_of("Detector", 1.5e-3 * SIDES), moved=body, **common
    )
    assert fit.reasons == ["", ""]
    for fitted in fit.zernikes:
        assert rss(fitted - zernikes[3:]) < error


@pytest.mark.slow
def test_the_wrong_body_costs_what_the_design_has(focused):
    """Difference of the wavefronts of two telescopes, one with the camera moved and one with the detector."""
    shift = (0.0, 0.0, 1.5e-3)
    image = donut(focused.perturbed("Camera", shift=shift), FIELD, rays=700)
    fit = pachon.fit_donuts(
        focused, image[None], [FIELD], WAVELENGTH, model=model_of("Detector", 1.5e-3), sky_variance=1000.0, threads=1
    )
    camera, detector = (
        pachon.wavefront_zernikes(focused.perturbed(name, shift=shift), [FIELD], WAVELENGTH, jmax=22).coefficients[0]
        for name in ("Camera", "Detector")
    )
    assert rss(camera[4:] - detector[4:]) > 150e-9
    assert rss(fit.zernikes[0] - (camera - detector)[3:]) < 8e-9


@pytest.mark.slow
def test_auxtel_moves_its_secondary_mirror(auxtel):
    """A folded telescope in which 0.8 mm of M2 are 34 mm of focus; the wrong side is known by a pair."""
    field, pixel, shift = np.deg2rad([0.02, -0.03]), 30e-6, 0.8e-3
    zernikes = wave(auxtel, 150e-9)
    images = [
        donut(auxtel.perturbed("M2", shift=(0.0, 0.0, d)), field, zernikes=zernikes, rays=700, pixel=pixel)
        for d in shift * SIDES
    ]
    common = {"sky_variance": 1000.0, "noll": range(4, 16), "threads": 1}
    fit = pachon.fit_donuts(
        auxtel, images, [field] * 2, WAVELENGTH, model=model_of("M2", shift * SIDES, pixel), **common
    )
    assert fit.reasons == ["", ""]
    for fitted in fit.zernikes:
        assert rss(fitted - zernikes[3:]) < 6e-9


@pytest.mark.parametrize(
    ("name", "bodies", "shift"), [("lsst_v3.3_r", ("Detector", "Camera", "M2"), 1.5e-3), ("auxtel", ("M2",), 0.2e-3)]
)
def test_the_other_side_of_focus_is_that_of_the_body(name, bodies, shift):
    """The best focus stands as far on the other side of the detector, to what the design's own depth changes."""
    telescope, direction = pachon.load_telescope(name), field_direction(*0.05 * FIELD[:, None], "zemax")[0]
    for body in bodies:
        instrument = instrument_of(telescope, pachon.DonutDetector(moved=body))
        light = instrument.light(direction, shift)
        other = instrument.mirrored(light)
        assert other.depth == pytest.approx(-light.depth, rel=2e-2)
        moved = {s.name for s, t in zip(telescope.surfaces, other.telescope.surfaces, strict=True) if s != t}
        assert moved == set(telescope.groups.get(body, (body,)))


def test_the_other_side_of_focus_has_the_same_unknowns(focused):
    """At 1.77 degrees a rim of L2 vignettes the star on one side of focus alone."""
    direction = field_direction(*np.deg2rad([[1.25], [1.25]]), "zemax")[0]
    instrument = instrument_of(focused, pachon.DonutDetector(moved="Camera"))
    light = instrument.light(direction, 1.5e-3)
    assert [rim.name for rim in instrument.mirrored(light).rims] == [rim.name for rim in light.rims]


def test_heights_stay_those_of_the_detector(focused):
    """A CCD that stands 30 um high on a moved camera: the camera moved, and the detector 30 um farther."""
    plane = pachon.FocalPlane.flat("lsst").with_moved("R32", dz=30e-6).with_moved("R33", dz=30e-6)
    direction = field_direction(*FIELD[:, None], "zemax")[0]
    light = instrument_of(focused, pachon.DonutDetector(moved="Camera", focal_plane=plane)).light(direction, 1.5e-3)
    expected = focused.perturbed("Camera", shift=(0, 0, 1.5e-3)).perturbed("Detector", shift=(0, 0, 30e-6))
    for surface, other in zip(light.telescope.surfaces, expected.surfaces, strict=True):
        np.testing.assert_allclose(surface.vertex, other.vertex, atol=1e-12)


def test_a_camera_with_a_wedged_window_moves_along_its_detector(auxtel):
    """The first surface of LATISS is tilted by 1.15 degrees, and M2 moves along the telescope."""
    name, axis = pachon.DonutDetector(moved="LATISS").body(auxtel)
    assert name == "LATISS"
    np.testing.assert_allclose(axis, auxtel.surfaces[-1].matrix[:, 2])
    np.testing.assert_allclose(pachon.DonutDetector(moved="M2").body(auxtel)[1], (0, 0, 1))


@pytest.mark.parametrize(
    "body", [pytest.param("Camera", marks=pytest.mark.long), pytest.param("M2", marks=pytest.mark.slow)]
)
def test_derivatives_by_degrees_of_freedom_are_those_of_the_moved_telescope(focused, body):
    """Differences of landing points of rays traced anew."""
    freedoms = pachon.load_degrees_of_freedom("lsst").select(["M2_dx", "M2_rx", "Camera_dz", "Camera_ry", "M1M3_B3"])
    direction = field_direction(*FIELD[:, None], "zemax")[0]
    light = instrument_of(focused, pachon.DonutDetector(moved=body)).light(direction, -1.5e-3)
    cells = pupil_cells(light.telescope, direction, WAVELENGTH, 20)
    rays = FreedomRays(light.telescope, direction, np.array([WAVELENGTH]), np.ones(1), cells, freedoms, np.eye(2))
    at = np.array([50.0, 3.0, 5.0, -4.0, 0.1])
    step = np.array([1.0, 0.1, 1.0, 0.1, 0.01])
    response = rays.response(at)
    for k, size in enumerate(step):
        change = size * np.eye(5)[k]
        difference = (rays.landing(at + change) - rays.landing(at - change)) / (2.0 * size)
        scale = np.abs(difference).max()
        np.testing.assert_allclose(response[:, :, k].T, difference, atol=1e-5 * scale)


@pytest.mark.slow
@pytest.mark.parametrize("body", ["Camera", "M2"])
def test_joint_fits_of_both_sides_of_a_moved_body(focused, body):
    freedoms = pachon.load_degrees_of_freedom("lsst").select(
        ["M2_dz", "M2_dx", "M2_ry", "Camera_dz", "Camera_dy", "M1M3_B2", "M1M3_B6"]
    )
    values = np.array([10.0, 150.0, 3.0, -8.0, 400.0, 0.1, -0.05])
    prior = np.array([40.0, 400.0, 10.0, 30.0, 1000.0, 0.3, 0.3])
    true = freedoms.apply(focused, values)
    fields = np.deg2rad([[1.15, 1.15], [-1.15, 1.15], [1.15, -1.15], [-1.15, -1.15]])
    defocus = 1.5e-3 * np.array([1.0, -1.0, -1.0, 1.0])
    images = [
        noisy(donut(true.perturbed(body, shift=(0.0, 0.0, d)), f), 500.0, 7 + i)
        for i, (f, d) in enumerate(zip(fields, defocus, strict=True))
    ]
    common = {"sky_variance": 500.0, "model": model_of(body, defocus), "threads": 1}
    fit = pachon.fit_donuts(
        focused, images, fields, WAVELENGTH, fit=pachon.sensing.TelescopeFreedoms(freedoms, prior=prior), **common
    )
    estimate = fit.degrees_of_freedom
    error = estimate.values - values
    assert error @ np.linalg.solve(estimate.covariance, error) < 20.0  # 7 degrees of freedom; 1 in 200 beyond
    before, after = (
        pachon.wavefront_zernikes(t, fields, WAVELENGTH, jmax=22).coefficients[:, 3:] for t in (focused, true)
    )
    assert rss(fit.zernikes - (after - before)) < 3.0 * rss(fit.errors)


@pytest.mark.slow
def test_field_terms_of_both_sides_of_a_moved_camera(focused):
    """A wavefront that is linear over the field."""
    fields = np.deg2rad([[0.8, 0.0], [-0.8, 0.0], [0.0, 0.8], [0.3, 0.3]])
    double = np.zeros((3, 11))
    double[0, [4, 7]], double[1, 3] = (60e-9, -50e-9), 40e-9
    radius = focused.field_radius
    waves = np.stack([np.ones(4), 2.0 * fields[:, 0] / radius, 2.0 * fields[:, 1] / radius]).T @ double
    defocus = 1.5e-3 * np.array([1.0, -1.0, 1.0, -1.0])
    images = [
        noisy(donut(focused.perturbed("Camera", shift=(0.0, 0.0, d)), f, zernikes=w), 500.0, i)
        for i, (f, d, w) in enumerate(zip(fields, defocus, waves, strict=True))
    ]
    fit = pachon.fit_donuts(
        focused,
        images,
        fields,
        WAVELENGTH,
        sky_variance=500.0,
        model=model_of("Camera", defocus),
        fit=pachon.sensing.FieldTerms([1, 2, 3], noll=range(4, 12)),
        threads=1,
    )
    error = (fit.double_zernikes - double[:, 3:]).ravel()
    assert error @ np.linalg.solve(fit.double_zernike_covariance, error) / error.size < 2.5


@pytest.mark.long
def test_drawn_donuts_have_the_body_of_the_model(focused):
    """The same image as of the telescope with the camera moved by hand."""
    common = {"atmosphere": pachon.Atmosphere.from_site("cerro_pachon", seed=1), "stamps": pachon.Stamps(41), "seed": 2}
    by_hand = focused.perturbed("Camera", shift=(0.0, 0.0, -1.5e-3))
    drawn, expected = (
        pachon.draw_donuts(telescope, [FIELD], WAVELENGTH, model=model_of(body, shift, 40e-6), **common).images
        for telescope, body, shift in ((focused, "Camera", -1.5e-3), (by_hand, "Detector", 0.0))
    )
    np.testing.assert_array_equal(drawn, expected)


def test_an_unknown_body_is_one_line_with_groups_and_surfaces(focused):
    image = np.zeros((1, 32, 32))
    with pytest.raises(UnknownNameError) as error:
        pachon.fit_donuts(focused, image, [FIELD], WAVELENGTH, moved="camera")
    text = str(error.value)
    assert text.startswith("moved = 'camera': expected a group of lsst_v3.3_r (Camera, L1, L2, Filter, L3)")
    assert "M1, M2, M3" in text
    assert "\n" not in text


def test_files_name_the_body(tmp_path):
    """A keyword of each stamp, or a column; several names are an error."""
    stamp, header = np.ones((20, 20)), fits.Header({"FIELD_X": 0.1, "FIELD_Y": 0.2, "DEFOC_UM": 800.0, "MOVED": "M2"})
    fits.HDUList([fits.PrimaryHDU(), *[fits.ImageHDU(stamp, header)] * 2]).writeto(tmp_path / "stamps.fits")
    assert read_stamps(tmp_path / "stamps.fits").moved == "M2"
    table = Table({"field_x": [0.1, 0.2], "field_y": [0.0, 0.0], "moved": ["Camera", "Camera"]})
    units = [fits.PrimaryHDU(np.stack([stamp, stamp])), fits.BinTableHDU(table)]
    fits.HDUList(units).writeto(tmp_path / "cube.fits")
    assert read_stamps(tmp_path / "cube.fits").moved == "Camera"
    table["moved"] = ["Camera", "M2"]
    fits.HDUList([units[0], fits.BinTableHDU(table)]).writeto(tmp_path / "two.fits")
    with pytest.raises(ProductError, match="moved = Camera, M2: expected one body"):
        read_stamps(tmp_path / "two.fits")
