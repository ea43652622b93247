"""The sensitivity matrix against central differences of the fitted wavefront, and against symmetry."""

from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u

import pachon
from pachon.core.errors import ConfigError, DomainError, UnknownNameError
from pachon.core.plotting import png_bytes
from pachon.design.optimize.sensitivity import field_rings, sensitivity
from pachon.models.parameters.parameters import apply, with_shape_terms
from pachon.models.shapes.grid import GridSag
from pachon.models.shapes.mesh import MeshSurface
from pachon.models.zernike_polynomials import annular_zernikes
from pachon.wavefront.chief_rays import fields_at
from pachon.wavefront.pupil_sampling import pupil_sampling
from pachon.wavefront.zernike import fit_zernikes

FIELDS = np.deg2rad([[0.0, 0.0], [0.5, 1.0], [-1.2, 1.2]])
#: Steps at which rounding (1e-15 m a wavefront) and the fourth order of the differences are both below 1e-7.
STEPS = {
    "M2.dx": 1e-3,
    "M2.dz": 1e-3,
    "M2.rx": 3e-4,
    "Camera.dy": 3e-3,
    "Camera.rx": 1e-3,
    "Detector.dz": 1e-3,
    "M1.radius": 2e-2,
    "M1.conic": 3e-3,
    "M1.a6": 1e-8,
    "M1.Z5": 1e-4,
    "M2.Z8": 1e-4,
    "M3.Z11": 1e-4,
    "L2_exit.conic": 0.5,
    "L2_entrance.curvature": 3e-3,
    "L1_entrance.n": 3e-4,
    "silica.n": 3e-3,
}


def bare(telescope):
    """Return the telescope without apertures: in differences the lit rays must stay the same."""
    return replace(telescope, surfaces=tuple(replace(s, aperture=None) for s in telescope.surfaces))


@pytest.fixture(scope="module")
def pupil(lsst_r):
    return pupil_sampling(lsst_r, "square", 24)


@pytest.fixture(scope="module")
def result(lsst_r, pupil):
    return sensitivity(lsst_r, STEPS, FIELDS, sampling=pupil)


@pytest.fixture(scope="module")
def zernikes(lsst_r, pupil):
    """Terms of a telescope without rims, fitted over the rays that are lit in the telescope with rims."""
    points, w = pupil.points.T, lsst_r.default_wavelength
    lit = [pachon.wavefront_opd(lsst_r, field, w, points).lit for field in FIELDS]

    def of(telescope):
        found = []
        for field, mask in zip(FIELDS, lit, strict=True):
            opd = replace(pachon.wavefront_opd(telescope, field, w, points), lit=mask)
            found.append(fit_zernikes(opd, 4.18, lsst_r.pupil_obscuration, 28).coefficients)
        return np.array(found)

    return of


def test_the_terms_are_those_of_the_fit(lsst_r, result, zernikes):
    # Rounding of paths of 30 m.
    assert np.abs(result.zernikes - zernikes(lsst_r)).max() < 1e-14
    assert result.matrix.shape == (3, 28, len(STEPS))
    assert result.rms.shape == (len(STEPS),)
    # The unit is another one for each parameter.
    assert result.to_table()["rms"].unit is None


@pytest.mark.parametrize("address", list(STEPS))
def test_matrix_against_central_differences(lsst_r, result, zernikes, slope, address):
    column = result.parameters.names.index(address)
    # Zernike terms take their rims from the aperture, so they are added before it is removed.
    start = bare(with_shape_terms(lsst_r, [result.parameters.parameters[column]]))
    numeric = slope(lambda h: zernikes(apply(start, {address: h})), STEPS[address])
    matrix = result.matrix[:, :, column]
    assert np.abs(matrix).max() > 1e-5
    # Of the largest term at each field point, and of the largest without piston and tilt.
    assert np.abs(matrix - numeric).max() < 1e-7 * np.abs(numeric).max()
    assert np.abs(matrix - numeric)[:, 3:].max() < 1e-7 * np.abs(numeric[:, 3:]).max()


def test_nodes_of_a_grid(lsst_r, pupil, slope):
    """One node of a measured deformation: the sag around it alone, against the wavefront itself."""
    axis = np.linspace(-1.8, 1.8, 31)
    deformed = lsst_r.with_deformation("M2", GridSag(axis, axis, np.zeros((31, 31))))
    address = "M2.node[18,26]"
    field, w = FIELDS[1], lsst_r.default_wavelength
    found = sensitivity(deformed, [address, "M2.Z6"], FIELDS[1:2], sampling=pupil).matrix[0]
    terms = annular_zernikes(28, *(pupil.points.T / 4.18), lsst_r.pupil_obscuration)
    lit = pachon.wavefront_opd(deformed, field, w, pupil.points.T).lit

    def zernikes(h):
        changed = apply(bare(deformed), {address: h})
        opd = pachon.wavefront_opd(changed, field, w, pupil.points.T).value
        return np.linalg.lstsq(terms[:, lit].T, opd[lit], rcond=None)[0]

    numeric = slope(zernikes, 1e-6)
    # A bicubic has jumps in its second derivative, so differences of a step h err by h, and not by h^4.
    assert np.abs(found[:, 0] - numeric).max() < 1e-6 * np.abs(numeric).max()
    assert np.abs(numeric).max() > 1e-3


def test_no_byte_depends_on_threads(lsst_r, result, pupil):
    for threads in (1, 3):
        again = sensitivity(lsst_r, STEPS, FIELDS, sampling=pupil, threads=threads)
        assert np.array_equal(again.matrix, result.matrix)


def test_symmetry(lsst_r):
    """A turn by 90 degrees takes x to y: M2.dx at (r, 0) is M2.dy at (0, r), defocus the same, and so on."""
    found = sensitivity(lsst_r, ["M2.dx", "M2.dy", "M2.dz"], np.array([[0.02, 0.0], [0.0, 0.02]]), n_zernike=11)
    dx, dy = found.matrix[0, :, 0], found.matrix[1, :, 1]
    for one, other in ((4, 4), (11, 11), (8, 7)):
        assert dx[one - 1] == pytest.approx(dy[other - 1], rel=1e-9)
    # Astigmatism at 0 degrees changes its sign.
    assert dx[5] == pytest.approx(-dy[5], rel=1e-9)
    # Along the axis of symmetry nothing in the other direction.
    assert np.abs(found.matrix[0, [2, 4, 6], 0]).max() < 1e-12
    assert found.matrix[0, 3, 2] == pytest.approx(found.matrix[1, 3, 2], rel=1e-9)


def test_defocus_of_a_slow_paraboloid(paraboloid):
    """Moving the detector by d makes d / (16 F^2 sqrt(3)) of Z4 in a slow beam (Noll 1976)."""
    slow = paraboloid(f_number=40.0)
    matrix = sensitivity(slow, ["detector.dz"], np.zeros((1, 2)), n_zernike=4).matrix
    # The next order of 1 - cos(theta) is (1/80)^2 / 4 of it.
    assert abs(matrix[0, 3, 0]) == pytest.approx(1 / (16 * 40.0**2 * np.sqrt(3)), rel=2e-4)


def test_modes_show_what_cannot_be_told_apart(lsst_r):
    found = sensitivity(lsst_r, ["M1.radius", "M1.curvature", "Camera.dz"], FIELDS)
    values, modes = found.modes()
    # Radius and curvature are one parameter.
    assert values[-1] < 1e-12 * values[0]
    assert np.abs(modes[-1][2]) < 1e-6
    assert np.allclose(np.abs(modes[-1][:2]), np.sqrt(0.5))


def test_detector_dz_is_the_height_of_a_ccd(lsst_r, pupil, slope):
    """For the field points that land on it: against focal planes of CCDs, raised and lowered."""
    camera = pachon.lsst_camera()
    field = fields_at(lsst_r, camera.centers[[40]] + [0.004, -0.003])
    found = sensitivity(lsst_r, ["Detector.dz"], field, sampling=pupil).matrix[0, :, 0]
    corners = np.array([[0.0, 0.0], [0.01, 0.0], [0.0, 0.01]])
    x, y = (camera.centers[:, None] + corners).reshape(-1, 2).T

    def zernikes(h):
        plane = pachon.FocalPlane.from_heights({"x": x, "y": y, "z": np.full(len(x), h)})
        opd = pachon.wavefront_opd(lsst_r, field[0], lsst_r.default_wavelength, pupil.points.T, focal_plane=plane)
        return fit_zernikes(opd, 4.18, lsst_r.pupil_obscuration, 28).coefficients

    numeric = slope(zernikes, 2e-4)
    assert np.abs(found - numeric).max() < 1e-7 * np.abs(numeric).max()


def test_what_does_nothing_is_zero(lsst_r):
    """Turns about the axis, and motions of the detector along itself while the sphere goes along."""
    found = sensitivity(lsst_r, ["M2.rz", "M2.dz", "Camera.rz"])
    assert np.array_equal(np.flatnonzero(found.rms), [1])
    values, _ = found.modes()
    assert values[1] == 0.0
    assert found.plot().get_axes()


def test_a_mesh_has_no_derivatives(paraboloid):
    x, y = np.meshgrid(np.linspace(-0.1, 0.1, 5), np.linspace(-0.1, 0.1, 5))
    telescope = paraboloid()
    grid = np.arange(16).reshape(4, 4) + np.arange(4)[:, None]
    corner = grid.ravel()[:, None]
    faces = np.concatenate([corner + np.array([0, 1, 6]), corner + np.array([0, 6, 5])])
    vertices = np.stack([x.ravel(), y.ravel(), telescope.surface("mirror").shape.sag(x, y).ravel()], axis=-1)
    with pytest.raises(DomainError, match=r"surface mirror.*mesh"):
        sensitivity(telescope.with_shape("mirror", MeshSurface(vertices, faces)), ["detector.dz"], np.zeros((1, 2)))


def test_summary_and_picture(result, tmp_path):
    summary = result.summary()
    assert summary["parameters"] == list(STEPS)
    assert np.shape(summary["matrix_m_per_unit"]) == (3, 28, len(STEPS))
    assert result.plot().get_axes()


def test_parameters_without_effect_have_a_picture(paraboloid):
    """A logarithmic axis for singular values that are all zero was a warning of matplotlib."""
    result = sensitivity(paraboloid(baffle=(1.0, 0.06)), ["baffle.dz"], [[0.0, 0.0]], n_zernike=11)
    assert not result.matrix.any()
    assert result.plot().axes[1].get_yscale() == "linear"
    assert png_bytes(result.plot()).startswith(b"\x89PNG")


def test_fields_and_quantities(lsst_r):
    assert field_rings(lsst_r).shape == (31, 2)
    one = sensitivity(lsst_r, ["M2.dz"], [[0.0, 1.0]] * u.deg, 500 * u.nm, n_zernike=6, n_pupil=6)
    two = sensitivity(lsst_r, ["M2.dz"], np.deg2rad([[0.0, 1.0]]), 5e-7, n_zernike=6, n_pupil=6)
    assert np.array_equal(one.matrix, two.matrix)


def test_many_terms_have_points_enough(lsst_r):
    """Terms of a lit annulus are orthogonal: more of them leave the first as they are, and are small."""
    field = [[0.0, 0.0]]
    few, many = (sensitivity(lsst_r, ["M1.Z22"], field, n_zernike=n).matrix[0, :, 0] for n in (28, 400))
    np.testing.assert_allclose(many[:28], few, atol=1e-9 * np.abs(few).max())
    # 1.06e-4, as by 40 rings; 12 made it 120.
    assert np.abs(many[28:]).max() < 2e-4 * np.abs(few).max()


def test_terms_that_vignetted_light_cannot_tell_apart_are_refused():
    """Derivatives of Z4 to Z22 were 40 times too large for 200 terms."""
    hsc = pachon.load_telescope("hsc")
    with pytest.raises(DomainError, match=r"light passes at 6. % of the pupil, where n_zernike = 150 terms"):
        sensitivity(hsc, ["CAM.dz"], np.deg2rad([[0.0, 0.7125]]), n_zernike=150)


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        (dict(parameters=["M2.dq"]), UnknownNameError, "dq"),
        (dict(parameters=[]), ConfigError, "at least one"),
        (dict(fields=[[0.1, 0.0]]), DomainError, "deg"),
        (dict(n_zernike=0), DomainError, "n_zernike"),
        (dict(sampling="square", n_pupil=4), DomainError, "n_zernike = 28"),
        (dict(sampling="hexagons"), ConfigError, "hexagons"),
    ],
)
def test_bad_arguments(lsst_r, change, error, words):
    with pytest.raises(error, match=words):
        sensitivity(lsst_r, **(dict(parameters=["M2.dz"], fields=FIELDS) | change))
