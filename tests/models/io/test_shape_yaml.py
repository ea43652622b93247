"""Shapes in prescription files, grids in FITS files, meshes in mesh files: read, written, refused in one line."""

import numpy as np
import pytest
import trimesh
from astropy.io import fits

from pachon.core.errors import PrescriptionError
from pachon.models.io.grid_file import read_grid, write_grid
from pachon.models.io.prescription import load_telescope, save_telescope
from pachon.models.shapes.freeform import Biconic, OddAsphere, Toroid
from pachon.models.shapes.grid import GridSag
from pachon.models.shapes.mesh import MeshSurface
from pachon.models.shapes.polynomial import XYPolynomial, ZernikeSag
from pachon.models.shapes.qbfs import QbfsAsphere
from pachon.models.shapes.shape import Conic, EvenAsphere, Plane, Sphere
from pachon.models.shapes.sum import Sum
from pachon.models.surface import Interaction

GRID = GridSag(np.linspace(-1, 1, 5), np.linspace(-1, 1, 4), np.arange(20.0).reshape(4, 5) * 1e-7)
SQUARE = MeshSurface([[0, 0, 0], [1, 0, 0.1], [1, 1, 0], [0, 1, 0.2]], [[0, 1, 2], [0, 2, 3]], smooth=True)
SHAPES = [
    Plane(),
    Sphere(3.0),
    Conic(3.0, -1.0),
    EvenAsphere(np.inf, 0.0, (0.1, 1e-9)),
    OddAsphere(4.0, -1.0, (0.0, 0.1)),
    Biconic(1.0, np.inf, -1.0),
    Toroid(1.0, -2.0, 0.5),
    Toroid(1.0, -2.0, 0.5, (1e-3, 0.0, 2e-5)),
    QbfsAsphere(3.0, -1.0, 0.9, (1e-5, -2e-6)),
    QbfsAsphere(np.inf, 0.0, 0.9, (1e-5,)),
    XYPolynomial(((0, 0, 1e-8), (2, 1, 3.0))),
    ZernikeSag((0.0, 0.0, 0.0, 1e-7), 0.8, 0.3),
    GRID,
    SQUARE,
    Sum((Sphere(3.0), ZernikeSag((1e-7,), 1.0), GRID)),
]

FILE = """
name: one
source: a test
version: "1"
units: {length: LENGTH, angle: deg, wavelength: um}
stop: {z: 0.0}
pupil: {diameter: 2.0, obscuration: 0.0}
launch_distance: 5.0
reference_sphere_radius: 5.0
field: {radius: 1.0, limit: 2.0}
wavelengths: {range: [0.3, 1.2], default: 0.6}
surfaces:
  - {name: only, type: mirror, z: 0.0, SHAPE}
"""


def load(tmp_path, shape, length="m"):
    path = tmp_path / "one.yaml"
    path.write_text(FILE.replace("SHAPE", shape).replace("LENGTH", length), encoding="utf-8")
    return load_telescope(path).surfaces[0].shape


@pytest.mark.parametrize("shape", SHAPES, ids=lambda s: type(s).__name__)
def test_every_shape_is_written_and_read_to_the_last_bit(tmp_path, shape):
    telescope = load_telescope("paul_baker").with_shape("M1", shape)
    save_telescope(telescope, tmp_path / "mine.yaml")
    assert load_telescope(tmp_path / "mine.yaml").surface("M1").shape == shape


def test_figures_scale_with_the_unit_of_length(tmp_path):
    assert load(tmp_path, "shape: paraboloid, radius: 2000", "mm") == Conic(2.0, -1.0)
    odd = load(tmp_path, "shape: odd_asphere, radius: flat, coefficients: [0.5, 0.001]", "mm")
    assert odd.coefficients == (0.5, pytest.approx(1.0))
    assert odd.radius == np.inf
    assert load(tmp_path, "shape: xy_polynomial, terms: [[1, 1, 0.002]]", "mm").terms == ((1, 1, pytest.approx(2.0)),)
    zernike = load(tmp_path, "shape: zernike, coefficients: [0.0, 1.0e-3], outer_radius: 500", "mm")
    assert zernike == ZernikeSag((0.0, 1e-6), 0.5)
    assert load(tmp_path, "shape: biconic, radius_x: 1, radius_y: flat, conic_x: -1") == Biconic(1.0, np.inf, -1.0)


def test_a_phase_screen_is_a_type_of_surface(tmp_path):
    path = tmp_path / "screen.yaml"
    text = FILE.replace("SHAPE", "shape: zernike, coefficients: [0.0, 1.0e-6], outer_radius: 1").replace("LENGTH", "m")
    path.write_text(text.replace("type: mirror", "type: phase"), encoding="utf-8")
    assert load_telescope(path).surfaces[0].interaction == Interaction.PHASE


def test_a_grid_comes_from_a_fits_file_beside_the_prescription(tmp_path):
    write_grid(GRID, tmp_path / "figure.fits")
    shape = load(tmp_path, "shape: [{shape: sphere, radius: 3.0}, {shape: grid, file: figure.fits}]")
    assert isinstance(shape, Sum)
    assert np.array_equal(shape.parts[1].values, GRID.values)
    # Nodes are written as a first one and a step.
    assert np.allclose(shape.parts[1].x, GRID.x, rtol=0, atol=1e-15)


def test_a_fits_grid_in_other_units(tmp_path):
    hdu = fits.ImageHDU(np.arange(16.0).reshape(4, 4))
    for axis in (1, 2):
        hdu.header.update({f"CRPIX{axis}": 2.0, f"CRVAL{axis}": 10.0, f"CDELT{axis}": 5.0, f"CUNIT{axis}": "mm"})
    hdu.header["BUNIT"] = "nm"
    fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(tmp_path / "map.fits")
    grid = read_grid(tmp_path / "map.fits")
    assert np.allclose(grid.x, [0.005, 0.010, 0.015, 0.020])
    assert np.allclose(grid.values, np.arange(16.0).reshape(4, 4) * 1e-9)


def test_bad_grid_files_are_refused_in_one_line(tmp_path):
    def written(name, values, **cards):
        header = fits.Header({"CRPIX1": 1, "CRVAL1": 0, "CDELT1": 1, "CRPIX2": 1, "CRVAL2": 0, "CDELT2": 1})
        for key, value in cards.items():
            header[key] = value
        fits.PrimaryHDU(values, header).writeto(tmp_path / name)
        return tmp_path / name

    (tmp_path / "text.fits").write_text("no FITS at all")
    (tmp_path / "figure.h5").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(100))
    (tmp_path / "figure.mat").write_bytes(b"MATLAB 5.0 MAT-file, Platform: GLNXA64" + bytes(100))
    holes = np.zeros((5, 5))
    holes[1, 3] = np.nan
    bare = tmp_path / "bare.fits"
    fits.PrimaryHDU(np.zeros((5, 5))).writeto(bare)
    cases = [
        (tmp_path / "none.fits", "no such file"),
        (tmp_path / "text.fits", "cannot be read as FITS"),
        (tmp_path / "figure.h5", "HDF5 file, whose maps have no nodes and no unit: expected a FITS image"),
        (tmp_path / "figure.mat", "MATLAB file, whose maps have no nodes and no unit: expected a FITS image"),
        (written("cube.fits", np.zeros((2, 5, 5))), "expected a FITS image of two dimensions"),
        (written("nan.fits", holes), r"values\[1, 3\] = nan: expected finite numbers"),
        (written("few.fits", np.zeros((3, 5))), "grid y has 3 nodes: expected at least 4"),
        (written("unit.fits", np.zeros((5, 5)), BUNIT="Jy"), "BUNIT = 'Jy': expected a unit of length"),
        (written("step.fits", np.zeros((5, 5)), CDELT2=-1.0), "expected ascending nodes"),
        (bare, "CRPIX1 is missing"),
        (written("turned.fits", np.zeros((5, 5)), PC1_2=0.5), "PC1_2 = 0.5: expected 0, nodes along x and y"),
        (written("rotated.fits", np.zeros((5, 5)), CROTA2=30.0), "CROTA2 = 30.0: expected 0"),
    ]
    for path, message in cases:
        with pytest.raises(PrescriptionError, match=message) as caught:
            read_grid(path)
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)


def test_a_mesh_comes_from_a_file_beside_the_prescription(tmp_path):
    trimesh.Trimesh(SQUARE.vertices * 1000, SQUARE.faces).export(tmp_path / "square.stl")
    shape = load(tmp_path, "shape: mesh, file: square.stl, scale: 0.001, smooth: true")
    # STL holds single precision.
    assert np.allclose(shape.sag([0.5, 0.9], [0.1, 0.8]), SQUARE.sag([0.5, 0.9], [0.1, 0.8]), rtol=0, atol=1e-7)
    assert shape.smooth


def test_meshes_that_are_no_surface_are_refused():
    three_on_an_edge = ([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0.5, 2, 0]], [[0, 1, 2], [0, 1, 3], [0, 1, 4]])
    cases = [
        (trimesh.creation.icosphere(), "folds over"),
        (trimesh.Trimesh(*three_on_an_edge, process=False), "no manifold: 1 edges belong to more than two facets"),
        (trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 0, 1]], [[0, 1, 2]], process=False), "edge-on"),
        (trimesh.Trimesh([[0, 0, 0], [1, 0, np.nan], [0, 1, 0]], [[0, 1, 2]], process=False), "finite"),
    ]
    for mesh, message in cases:
        with pytest.raises(PrescriptionError, match=message):
            MeshSurface.from_mesh(mesh)
    with pytest.raises(PrescriptionError, match="without facets"):
        MeshSurface([[0, 0, 0]], np.zeros((0, 3)))


def test_a_mesh_is_flat_between_its_vertices_and_ends_at_its_rim():
    # The facet 0, 1, 2 is z = 0.1 (x - y).
    x, y = np.array([0.5, 0.9, 0.3]), np.array([0.1, 0.8, 0.3])
    facets = MeshSurface(SQUARE.vertices, SQUARE.faces[:, ::-1])
    assert np.allclose(facets.sag(x, y), 0.1 * (x - y), rtol=0, atol=1e-15)
    assert np.allclose(facets.gradient(x[:2], y[:2]), [[0.1, 0.1], [-0.1, -0.1]], rtol=0, atol=1e-15)
    assert np.isnan(facets.sag([1.2, -0.1, 0.5], [0.5, 0.5, 1.1])).all()
    smooth = SQUARE.gradient(1.0, 0.0)
    assert np.allclose(smooth, (0.1, -0.1), rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ("shape: bicnic", r"surfaces\[only\].shape = 'bicnic': expected one of .*did you mean biconic"),
        ("shape: biconic, radius_x: 1", r"surfaces\[only\].radius_y is missing"),
        ("shape: toroid, radius_x: 0, radius_y: 1", r"radius_x = 0.0: expected a finite radius"),
        ("shape: zernike, coefficients: [1], outer_radius: 1, inner_radius: 2", "expected 0 <= inner < outer"),
        ("shape: xy_polynomial, terms: [[1, 1]]", r"terms = .*expected \[power of x, power of y, coefficient\]"),
        ("shape: xy_polynomial, terms: [[1.5, 1, 2]]", r"terms = .*expected \[power of x"),
        ("shape: []", r"surfaces\[only\].shape = \[\]: expected a list of mappings"),
        ("shape: [{shape: sphere, radius: 1, conic: 2}]", r"unknown key surfaces\[only\].shape\[sphere\].conic"),
        ("shape: [{radius: 1}]", r"surfaces\[only\].shape\[0\].shape is missing"),
        ("shape: sphere, radius: 1, terms: []", r"unknown key surfaces\[only\].terms"),
        ("shape: grid, file: a.fits, values: []", "file or values, not both"),
        ("shape: grid, nodes_x: [0, 1, 2], nodes_y: [0, 1, 2, 3], values: [[1, 2], [1]]", "rows of one length"),
        (
            "shape: grid, nodes_x: [0, 1, 2, 3], nodes_y: [0, 1, 2, 3], values: [[0, 0, 0, .nan]]",
            r"values\[0\] = .*expected a list of numbers",
        ),
        ("shape: mesh, file: a.step", r"a.step: expected a mesh file that ends in .stl"),
        ("shape: mesh, file: a.stl", r"a.stl: no such file"),
        ("shape: mesh, vertices: '!!', faces: ''", "vertices = '!!': expected three numbers a row, in base 64"),
        ("shape: mesh, file: a.stl, smooth: 2", "smooth = 2: expected true or false"),
    ],
)
def test_malformed_shapes_say_file_key_value_and_what_was_expected(tmp_path, shape, message):
    with pytest.raises(PrescriptionError, match=message) as caught:
        load(tmp_path, shape)
    assert str(caught.value).startswith(str(tmp_path))
    assert "\n" not in str(caught.value)
