import inspect
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy import units as u

import pachon
from pachon.core.errors import ConfigError, DomainError

DATA = Path(__file__).parents[1] / "data" / "zmx"


def test_defaults_are_five_fields_one_wavelength_and_gauss_points(lsst_r):
    request = pachon.Request.of(lsst_r)
    np.testing.assert_allclose(np.rad2deg(request.fields[:, 1]), [0.0, 0.5, 1.0, 1.5, 1.75], atol=1e-12)
    assert not request.fields[:, 0].any()
    assert request.wavelengths.tolist() == [lsst_r.default_wavelength]
    assert request.weights.tolist() == [1.0]
    np.testing.assert_array_equal(request.pupil.points, pachon.pupil_sampling(lsst_r, "gauss").points)
    assert np.hypot(*request.unit_pupil.T).max() <= 1.0


def test_quantities_one_point_and_one_wavelength_are_taken(lsst_r):
    request = pachon.Request.of(lsst_r, [0.5, 1.0] * u.deg, 620 * u.nm, sampling="rings", n_pupil=3)
    np.testing.assert_allclose(request.fields, np.deg2rad([[0.5, 1.0]]), rtol=1e-15)
    assert request.wavelength == pytest.approx(620e-9, rel=1e-15)
    assert len(request.pupil) == len(pachon.pupil_sampling(lsst_r, "rings", 3))


def test_weights_sum_to_one_and_the_middle_wavelength_is_in_the_list(lsst_r):
    request = pachon.Request.of(lsst_r, None, [600e-9, 620e-9, 650e-9], wavelength_weights=[1, 2, 1])
    assert request.weights.tolist() == [0.25, 0.5, 0.25]
    assert request.middle == 620e-9
    with pytest.raises(DomainError, match="3 wavelengths are given; expected one"):
        _ = request.wavelength


@pytest.mark.parametrize(
    ("projection", "slopes"),
    [("zemax", np.tan([0.01, 0.02])), ("gnomonic", [0.01, 0.02])],
)
def test_slopes_are_those_of_the_light_in_the_projection(lsst_r, projection, slopes):
    request = pachon.Request.of(lsst_r, [0.01, 0.02], projection=projection)
    np.testing.assert_allclose(np.linalg.norm(request.directions, axis=-1), 1.0, rtol=1e-15)
    np.testing.assert_allclose(request.slopes, [slopes], rtol=1e-14)


def test_rays_and_bundles_are_those_of_its_points(lsst_r):
    request = pachon.Request.of(lsst_r, [[0.0, 0.0], [0.0, 0.01]], n_pupil=4)
    bundles = request.bundles(request.wavelength)
    end = pachon.trace(lsst_r, request.launch(request.wavelength))
    np.testing.assert_array_equal(bundles.status, end.status.reshape(2, -1))
    np.testing.assert_allclose(
        bundles.landing(), lsst_r.surfaces[-1].to_local(end.position)[:, :2].reshape(2, -1, 2), atol=1e-15
    )
    for part, some in request.parts():
        np.testing.assert_array_equal(some.bundles(request.wavelength).path, bundles.path[part])


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"fields": [[0.0, 0.0, 0.0]]}, DomainError, "expected field angles x, y"),
        ({"fields": [[0.0, 1.0]]}, DomainError, "field = "),
        ({"wavelengths": 1e-5}, DomainError, "wavelength"),
        ({"wavelengths": [[6e-7]]}, DomainError, "expected one wavelength or a list"),
        ({"wavelength_weights": [1.0, 1.0]}, DomainError, "wavelength_weights = .*expected 1 numbers"),
        ({"wavelength_weights": [-1.0]}, DomainError, "none negative"),
        ({"sampling": "hexagonal"}, ConfigError, "expected one of gauss, rings"),
        ({"n_pupil": 0}, DomainError, "expected a whole number"),
        ({"projection": "tan"}, ConfigError, "expected one of zemax, gnomonic, postel"),
    ],
)
def test_bad_input_is_refused_when_the_request_is_made(lsst_r, change, error, words):
    with pytest.raises(error, match=words):
        pachon.Request.of(lsst_r, **change)


def test_pupil_coordinates_are_those_that_were_aimed():
    lens = pachon.load_telescope(DATA / "circular_aperture_example_with_aperture.zmx")
    factors = (0.1, -0.05, 0.3, 0.2, 0.4)
    lens = lens.with_design(aiming="real", fields=((0.1, 0.4),), field_weights=(), vignetting=(factors,))
    request = pachon.Request.of(lens)
    points = 0.5 * lens.pupil_diameter * np.array([[0.0, 0.0], [0.9, 0.0], [-0.3, 0.8]])
    entrance = request.entrance_points(lens.default_wavelength, points).reshape(-1, 2)
    assert np.abs(entrance - points).max() > 0.01 * lens.pupil_diameter
    again = request.pupil_coordinates(lens.default_wavelength, entrance)
    assert again == pytest.approx(points, abs=1e-11 * lens.pupil_diameter)


def test_perturbed_telescopes_are_aimed_as_if_alone():
    lens = pachon.load_telescope(DATA / "circular_aperture_example_with_aperture.zmx").with_design(aiming="real")
    request = pachon.Request.of(lens, n_pupil=3)
    light, pupil = lens.default_wavelength, request.pupil.points
    assert np.array_equal(request.entrance_points_of(lens, light, pupil), request.entrance_points(light, pupil))
    name = next(s.name for s in lens.surfaces if s.interaction == pachon.Interaction.REFRACT)
    # A tolerance, and a change that no search follows from the design.
    for shift in ((2e-5, -1e-5, 3e-5), (0.0, 0.0, 0.3 * lens.pupil_diameter)):
        moved = lens.perturbed(name, shift=shift, tilt=(1e-3, 0.0, 0.0))
        found = request.entrance_points_of(moved, light, pupil)
        alone = replace(request, telescope=moved).entrance_points(light, pupil)
        # Both searches end at 1e-12 of the radius of the stop.
        assert found == pytest.approx(alone, abs=1e-11 * lens.pupil_diameter)
        assert np.abs(found - request.entrance_points(light, pupil)).max() > 1e-6 * lens.pupil_diameter


def arrays(result):
    """All arrays of a result, by name."""
    return {name: value for name, value in vars(result).items() if isinstance(value, np.ndarray)}


@pytest.mark.parametrize(
    ("analysis", "options"),
    [
        (pachon.wavefront_opds, {"grid": 8}),
        (pachon.distortion, {}),
        (pachon.design.principal_rays, {}),
        (pachon.design.relative_illumination, {"n_pupil": 64}),
        (pachon.vignetting, {"n_pupil": 64}),
        (pachon.wavefront_zernikes, {}),
        (pachon.encircled_energy, {"kind": "geometric", "n_pupil": 64}),
        (pachon.fft_psf, {"n_pupil": 64, "pixels": 16}),
        (pachon.field_curvature, {}),
        (pachon.huygens_psf, {"n_pupil": 32, "pixels": 16}),
        (pachon.design.lateral_color, {}),
        (pachon.mtf, {"n_pupil": 64}),
        (pachon.design.opd_fans, {"n_points": 5}),
        (pachon.ray_fans, {"n_points": 5}),
        (pachon.design.spot_matrix, {}),
        (pachon.spots, {}),
        (pachon.strehl, {"from_psf": False}),
        (pachon.through_focus, {}),
        (pachon.design.throughput, {}),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_analyses_take_a_request_in_place_of_a_telescope(lsst_r, analysis, options):
    fields = np.deg2rad([[0.3, 0.2], [1.0, -0.6], [0.0, 1.4]])
    request = pachon.Request.of(lsst_r, fields, 620e-9, threads=1)
    by_request, by_telescope = arrays(analysis(request, **options)), arrays(analysis(lsst_r, fields, 620e-9, **options))
    assert by_request
    assert by_request.keys() == by_telescope.keys()
    for name, values in by_telescope.items():
        assert np.array_equal(by_request[name], values, equal_nan=values.dtype.kind == "f"), name


@pytest.mark.parametrize(
    ("analysis", "options"),
    [
        (pachon.wavefront_opd, {"grid": 8}),
        (pachon.design.target_image, {"n_rays": 5}),
        (pachon.ghosts, {"n_pupil": 400}),
        (pachon.layout, {}),
        (pachon.footprint, {"surfaces": "M1"}),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_analyses_of_one_field_take_a_request_too(lsst_r, analysis, options):
    field = np.deg2rad([0.3, 0.2])
    request = pachon.Request.of(lsst_r, field, 620e-9, threads=1)
    names = inspect.signature(analysis).parameters
    where = {"field" if "field" in names else "fields": field}
    where["wavelength" if "wavelength" in names else "wavelengths"] = 620e-9
    by_request, by_telescope = analysis(request, **options), analysis(lsst_r, **where, **options)
    for name, values in arrays(by_telescope).items():
        assert np.array_equal(getattr(by_request, name), values, equal_nan=True), name


def test_requests_keep_what_the_design_data_state():
    lens = pachon.load_telescope(DATA / "circular_aperture_example_with_aperture.zmx")
    factors = ((0.1, -0.05, 0.3, 0.2, 0.4), (0.0, 0.0, 0.1, 0.1, 0.0))
    lens = lens.with_design(fields=((0.0, 0.4), (0.1, 0.2)), field_weights=(1.0, 3.0), vignetting=factors)
    request = pachon.Request.of(lens, n_pupil=4)
    ours, theirs = pachon.spots(request), pachon.spots(lens, n_pupil=4)
    assert ours.request is request
    assert np.array_equal(ours.displacement, theirs.displacement)
    assert np.array_equal(ours.weight, theirs.weight)
    assert ours.request.field_weights.tolist() == [0.25, 0.75]
    # Other pupil points and threads may be given, and nothing else.
    rings = pachon.spots(request, sampling="rings", n_pupil=2, threads=1).request
    assert np.array_equal(rings.pupil.points, pachon.pupil_sampling(lens, "rings", 2).points)
    assert np.array_equal(rings.vignetting, factors)
    assert rings.threads == 1
    for name, value in {"fields": [0.0, 0.0], "wavelengths": 6e-7, "projection": "postel"}.items():
        with pytest.raises(ConfigError, match=rf"^{name} = .*: given beside a Request, which has its own$"):
            pachon.spots(request, **{name: value})
    with pytest.raises(DomainError, match=r"^wavelength: 2 wavelengths are given; expected one$"):
        pachon.distortion(pachon.Request.of(lens, wavelengths=[5.5e-7, 6e-7]))
