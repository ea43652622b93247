from dataclasses import replace

import numpy as np
import pytest
import trimesh
from astropy import units as u
from astropy.table import Table

from pachon.core.errors import ConfigError, DomainError, UnknownNameError
from pachon.models.camera.focal_plane import FocalPlane
from pachon.models.camera.height_budget import SIMULATED, SPECIFICATION, TERMS, HeightBudget
from pachon.models.camera.lsst import lsst_camera

CAMERA = lsst_camera()
NAME = "R22_S11"
#: Halves of the sides of CCD NAME along x and y [m]: 4004 and 4096 pixels of 10 um.
HALF = np.array([20.02e-3, 20.48e-3])
#: The same of every CCD, of the two kinds: 4000 and 4072 pixels of ITL's.
HALVES = np.array([(20.0e-3, 20.36e-3) if vendor == "itl" else HALF for vendor in CAMERA.vendors])


def points_on(names, rng, n):
    ccds = np.repeat([CAMERA.ccd_index(name) for name in names], n)
    return (CAMERA.centers[ccds] + HALVES[ccds] * rng.uniform(-1.0, 1.0, (n * len(names), 2))).T


def on_every_ccd(u, v):
    """Return x, y [m], shape (189, len(v), len(u)), of a grid on every CCD, in halves of its sides."""
    x = CAMERA.centers[:, 0, None, None] + HALVES[:, 0, None, None] * u
    y = CAMERA.centers[:, 1, None, None] + HALVES[:, 1, None, None] * v[:, None]
    return np.broadcast_arrays(x, y)


def dense(n=81):
    """Return x, y, shape (189, n, n), of a grid on every CCD."""
    axis = np.linspace(-1.0, 1.0, n) * (1 - 1e-12)
    return on_every_ccd(axis, axis)


def test_budgets_are_the_columns_of_table_1():
    assert HeightBudget(10e-6, 4.8e-6, 4e-6, 2.5e-4, 4e-6, (1.0, 2.0)) == SPECIFICATION
    assert HeightBudget(10e-6, 6.5e-6, 10e-6, 2.5e-4, 5e-6, (1.0, 2.0)) == SIMULATED


def test_flat_is_zero_on_ccds_and_nan_in_gaps():
    flat = FocalPlane.flat("lsst")
    assert flat.height(0.0, 0.0) == 0.0
    assert np.isnan(flat.height(42.25e-3 / 2, 0.0))
    assert np.array_equal(flat.gradient([0.0, 1.0], [0.0, 0.0]), [[0.0, 0.0], [np.nan, np.nan]], equal_nan=True)
    assert flat.names == CAMERA.ccd_names
    assert flat.terms == ()


def test_height_is_the_documented_polynomial_and_waves():
    fp = FocalPlane.from_budget("lsst", seed=5)
    rng = np.random.default_rng(2)
    for name in ("R01_S00", "R22_S11", "R43_S21"):
        i = fp.ccd_index(name)
        a, b = rng.uniform(-1.0, 1.0, (2, 50))
        dx, dy = HALVES[i, 0] * a, HALVES[i, 1] * b
        x, y = CAMERA.centers[i, 0] + dx, CAMERA.centers[i, 1] + dy
        powers = [1 + 0 * a, a, b, a**2, a * b, b**2, a**3, a**2 * b, a * b**2, b**3]
        expected = fp.polynomial[i] @ np.array(powers)
        for amplitude, kx, ky, phase in fp.waves[i]:
            expected = expected + amplitude * np.cos(kx * dx + ky * dy + phase)
        # Heights of 1e-5 m; positions lose 1e-16 m of 0.3 m, which slopes of 1e-3 shrink further.
        assert np.allclose(fp.height(x, y), expected, rtol=0, atol=1e-18)


def test_global_spans_its_peak_to_valley_exactly_and_is_one_quadratic():
    fp = FocalPlane.from_budget("lsst", seed=3, terms=["global"])
    x, y = dense(41)
    h = fp.height(x, y)
    # A grid of 1 mm misses an extreme inside a CCD by curvature * (0.5 mm)^2 / 2 < 1e-10 m; corners it holds.
    assert h.max() - h.min() == pytest.approx(10e-6, abs=1e-10)
    assert h.max() + h.min() == pytest.approx(0.0, abs=1e-10)
    basis = np.stack([np.ones(x.size), *(v.ravel() for v in (x, y, x * x, x * y, y * y))], -1)
    coefficients, *_ = np.linalg.lstsq(basis, h.ravel(), rcond=None)
    assert np.allclose(basis @ coefficients, h.ravel(), rtol=0, atol=1e-17)


def test_pistons_are_uniform_within_half_their_peak_to_valley():
    rafts, ccds = [], []
    for seed in range(20):
        raft = FocalPlane.from_budget("lsst", seed=seed, terms=["raft"]).polynomial
        for name in CAMERA.raft_names:
            members = [CAMERA.ccd_index(n) for n in CAMERA.ccds_of_raft(name)]
            assert np.ptp(raft[members, 0]) == 0.0
            rafts.append(raft[members[0], 0])
        ccds.append(FocalPlane.from_budget("lsst", seed=seed, terms=["ccd"]).polynomial[:, 0])
        assert not raft[:, 1:].any()
    for values, span in ((np.array(rafts), 6.5e-6), (np.concatenate(ccds), 10e-6)):
        assert np.abs(values).max() <= span / 2
        # n uniform values: mean within 4 sigma, and a standard deviation of span / sqrt(12) within 4 sigma.
        n = values.size
        sigma = span / np.sqrt(12)
        assert abs(values.mean()) < 4 * sigma / np.sqrt(n)
        assert values.std() == pytest.approx(sigma, rel=4 * np.sqrt(0.2 / n))


def test_tilts_are_uniform_about_each_axis():
    slopes = np.concatenate([FocalPlane.from_budget("lsst", seed=s, terms="tilt").polynomial for s in range(10)])
    angles = np.arctan(slopes[:, 1:3] / np.tile(HALVES, (10, 1)))
    assert np.abs(angles).max() <= 1.25e-4
    # 1890 values: four sigma of mean and spread; the axes independent within four sigma of 1 / sqrt(n).
    assert np.abs(angles.mean(axis=0)).max() < 4 * 2.5e-4 / np.sqrt(12 * 1890)
    assert np.allclose(angles.std(axis=0), 2.5e-4 / np.sqrt(12), rtol=4 * np.sqrt(0.2 / 1890))
    assert abs(np.corrcoef(angles.T)[0, 1]) < 4 / np.sqrt(1890)
    assert not slopes[:, [0, 3, 4, 5, 6, 7, 8, 9]].any()


def test_potato_chip_has_its_peak_to_valley_cycles_and_zero_mean():
    fp = FocalPlane.from_budget("lsst", seed=4, terms=["potato_chip"])
    x, y = dense(129)
    h = fp.height(x[::8], y[::8])
    # Scaled on the same number of points.
    assert np.allclose(np.ptp(h, axis=(1, 2)), 5e-6, rtol=0, atol=1e-12)
    # Along the longer side.
    cycles = np.hypot(fp.waves[:, :, 1], fp.waves[:, :, 2]) * HALVES[:, 1:] / np.pi
    assert cycles.min() >= 1.0
    assert cycles.max() <= 2.0
    assert np.ptp(cycles) > 0.9
    # The two waves cross at right angles.
    first, second = fp.waves[:, 0, 1:3], fp.waves[:, 1, 1:3]
    assert np.allclose(np.sum(first * second, axis=1), 0, atol=1e-9)
    # Mean by Gauss-Legendre, exact to rounding for so few cycles.
    t, w = np.polynomial.legendre.leggauss(20)
    x, y = on_every_ccd(t, t)
    mean = np.einsum("i,j,nij->n", w, w, fp.height(x, y)) / 4
    assert np.abs(mean).max() < 1e-15


def test_every_term_has_its_own_stream():
    full = FocalPlane.from_budget("lsst", seed=1)
    assert full.terms == TERMS
    alone = {term: full.with_terms([term]) for term in TERMS}
    for term in TERMS:
        assert alone[term].height(0.01, 0.02) != 0.0
    # Leaving a term out leaves the rest as they were: the same bytes as the sum of the others.
    for missing in ("global", "raft", "ccd", "tilt"):
        rest = full.with_terms([t for t in TERMS if t != missing])
        assert rest.waves.tobytes() == full.waves.tobytes()
        expected = np.zeros((189, 10))
        for term in TERMS:
            if term != missing:
                expected += alone[term].polynomial
        assert rest.polynomial.tobytes() == expected.tobytes()
    assert not full.with_terms(["global", "tilt"]).waves.any()
    assert full.with_terms(reversed(TERMS)).polynomial.tobytes() == full.polynomial.tobytes()
    assert full.with_terms([]).height(0.0, 0.0) == 0.0


def test_same_seed_same_bytes_other_seed_other_heights():
    one, again, other = (FocalPlane.from_budget("lsst", seed=s) for s in (8, 8, 9))
    assert one.polynomial.tobytes() == again.polynomial.tobytes()
    assert one.waves.tobytes() == again.waves.tobytes()
    assert np.all(one.polynomial[:, :3] != other.polynomial[:, :3])


def test_budgets_scale_the_same_draws():
    simulated = FocalPlane.from_budget("lsst", seed=1, terms=["ccd", "potato_chip"])
    specified = FocalPlane.from_budget("lsst", seed=1, terms=["ccd", "potato_chip"], budget="specification")
    assert np.allclose(specified.waves[:, :, 0], 0.8 * simulated.waves[:, :, 0], rtol=1e-14)
    mine = FocalPlane.from_budget("lsst", seed=1, budget=HeightBudget(0.0, 0.0, 0.0, 0.0, 0.0))
    assert mine.height(0.1, 0.05) == 0.0


def test_gradient_is_the_derivative_of_height():
    rng = np.random.default_rng(6)
    drawn = FocalPlane.from_budget("lsst", seed=2)
    x, y = points_on(["R22_S11", "R14_S20"], rng, 900)
    fitted = FocalPlane.from_heights({"x": x, "y": y, "z": drawn.height(x, y)})
    assert fitted.grid is not None
    step = 1e-6
    x, y = points_on(["R22_S11", "R14_S20"], rng, 100)
    for fp in (drawn, fitted):
        central = np.stack(
            [
                (fp.height(x + step, y) - fp.height(x - step, y)) / (2 * step),
                (fp.height(x, y + step) - fp.height(x, y - step)) / (2 * step),
            ],
            axis=-1,
        )
        near = np.isfinite(central).all(axis=1)
        # Central differences over 2 um of heights known to 1e-21 m: third derivative * step^2 / 6 < 1e-10.
        assert np.allclose(fp.gradient(x, y)[near], central[near], rtol=0, atol=1e-10)
        assert near.sum() > 190


def test_measured_points_recover_a_known_surface():
    rng = np.random.default_rng(3)
    truth = FocalPlane.from_budget("lsst", seed=11)
    x, y = points_on([NAME, "R30_S02"], rng, 1000)
    fp = FocalPlane.from_heights(Table({"x": x, "y": y, "z": truth.height(x, y)}))
    assert fp.grid is not None
    assert fp.grid.shape == (189, 18, 18)
    px, py = points_on([NAME, "R30_S02"], rng, 4000)
    error = fp.height(px, py) - truth.height(px, py)
    # Cubic splines on 15 cells of a ripple of up to 2 cycles: (k h)^4 / 384 = 0.13 % of two waves of 1.25 um, 3 nm at
    # most where points surround; a strip of 2.5 % along the rim, and corners above all, is extrapolated.
    assert np.sqrt(np.mean(error**2)) < 3e-9
    center = CAMERA.centers[CAMERA.ccd_at(px, py)].T
    inside = np.hypot(*(np.maximum(np.abs([px, py] - center) - 0.95 * HALF[:, None], 0))) == 0
    assert np.abs(error[inside]).max() < 10e-9
    assert np.abs(error).max() < 200e-9


def test_rays_that_do_not_arrive_have_no_slope_and_no_warning():
    """Heights that cubic polynomials do not fit have splines beside them."""
    u, v = (w.ravel() for w in np.meshgrid(np.linspace(-1, 1, 24), np.linspace(-1, 1, 24)))
    plane = FocalPlane.from_heights({"x": u * HALF[0], "y": v * HALF[1], "z": 1e-6 * np.exp(-20.0 * (u**2 + v**2))})
    assert plane.grid is not None
    ccd = np.full(2, plane.ccd_index(plane.camera.ccd_names[int(plane.ccd_at(0.0, 0.0))]))
    slopes = plane.slopes_on(ccd, np.array([0.3 * HALF[0], np.nan]), np.array([0.2 * HALF[1], 0.0]))
    assert np.isfinite(slopes[0]).all()
    assert np.isnan(slopes[1]).all()


def test_noise_in_measured_points_averages_down():
    rng = np.random.default_rng(5)
    x, y = points_on([NAME], rng, 2000)
    z = rng.normal(0.0, 1e-6, x.size)
    fp = FocalPlane.from_heights({"x": x, "y": y, "z": z})
    h = fp.height(*points_on([NAME], rng, 2000))
    # 400 coefficients on 2000 points leave about sqrt(400 / 2000) of the noise, some more near the rim.
    assert 0.3e-6 < h.std() < 0.6e-6


def test_noise_does_not_grow_where_a_ccd_has_no_points():
    # A weak smoothing alone took 0.2 um to 6 um in the 8 % of the CCD that were not measured.
    rng = np.random.default_rng(6)
    x, y = points_on([NAME], rng, 3000)
    center = CAMERA.centers[CAMERA.ccd_index(NAME)]
    u, v = (x - center[0]) / HALF[0], (y - center[1]) / HALF[1]
    z = 4e-6 * (u**2 + v**2)
    measured = u < 0.84
    fp = FocalPlane.from_heights(
        {"x": x[measured], "y": y[measured], "z": (z + rng.normal(0.0, 0.2e-6, x.size))[measured]}
    )
    error = fp.height(x, y) - z
    assert np.std(error[measured]) < 0.07e-6
    assert np.abs(error).max() < 1e-6


@pytest.mark.parametrize(("n", "degree"), [(3, 1), (8, 1), (9, 2), (19, 2), (20, 3), (40, 3)])
def test_few_points_give_a_polynomial_that_they_support(n, degree):
    rng = np.random.default_rng(n)
    x, y = points_on([NAME], rng, n)
    u, v = x / HALF[0], y / HALF[1]
    z = 1e-6 * (1 + u - 2 * v)
    if degree >= 2:
        z = z + 1e-6 * (u**2 - 0.5 * u * v)
    if degree == 3:
        z = z + 1e-6 * (u**3 - 2 * u * v**2)
    fp = FocalPlane.from_heights({"x": x, "y": y, "z": z})
    assert fp.grid is None
    # The surface lies in the span of the fit: rounding, magnified by the condition of few random points.
    assert np.allclose(fp.height(x, y), z, rtol=0, atol=1e-12)
    assert fp.measured.sum() == 1
    assert fp.measured[fp.ccd_index(NAME)]
    assert fp.height(0.1, 0.0) == 0.0


def test_points_in_a_few_rows_fall_back_to_a_lower_degree():
    u = np.tile(np.linspace(-0.9, 0.9, 15), 2)
    v = np.repeat([-0.5, 0.5], 15)
    z = 1e-6 * (2 * u - v)
    fp = FocalPlane.from_heights({"x": u * HALF[0], "y": v * HALF[1], "z": z})
    assert np.allclose(fp.height(u * HALF[0], v * HALF[1]), z, rtol=0, atol=1e-18)


def test_units_of_columns_are_honoured():
    rng = np.random.default_rng(1)
    x, y = points_on([NAME], rng, 30)
    plain = FocalPlane.from_heights({"x": x, "y": y, "z": 1e-5 * x / HALF[0]})
    table = Table({"x": x * 1e3, "y": y * 1e3, "z": 10 * x / HALF[0]}, units={"x": "mm", "y": "mm", "z": "um"})
    quantities = {"x": x * 1e3 * u.mm, "y": y * u.m, "z": 1e4 * x / HALF[0] * u.nm}
    array = np.rec.fromarrays([x, y, 1e-5 * x / HALF[0]], names="x,y,z")
    for other in (table, quantities, array):
        # Same numbers but for the rounding of the conversion.
        assert np.allclose(FocalPlane.from_heights(other).polynomial, plain.polynomial, rtol=0, atol=1e-19)


@pytest.mark.long
def test_table_and_mesh_round_trip():
    rafts = ("R01", "R22", "R43")
    chosen = np.flatnonzero(np.isin(CAMERA.raft_of, rafts))
    camera = replace(
        CAMERA,
        ccd_names=tuple(CAMERA.ccd_names[i] for i in chosen),
        raft_names=rafts,
        raft_index=np.repeat([0, 1, 2], 9),
        centers=CAMERA.centers[chosen],
        pixels=CAMERA.pixels[chosen],
        vendors=tuple(CAMERA.vendors[i] for i in chosen),
        rotation_deg=CAMERA.rotation_deg[chosen],
    )
    truth = FocalPlane.from_budget(camera, seed=1)
    rng = np.random.default_rng(9)
    px, py = points_on(["R01_S00", "R22_S11", "R43_S22"], rng, 500)
    table = truth.to_table(32)
    assert len(table) == 27 * 33**2
    assert str(table["z"].unit) == "m"
    for again in (FocalPlane.from_heights(table, camera=camera), FocalPlane.from_mesh(truth.to_mesh(32), camera)):
        assert again.measured.all()
        # 33 x 33 regular points and 15 cells: (k h)^4 / 384 of 1.25 um.
        assert np.abs(again.height(px, py) - truth.height(px, py)).max() < 5e-9


@pytest.mark.parametrize(
    ("table", "expected"),
    [
        ({"x": [0.0], "y": [0.0]}, "column 'z' is missing"),
        ({"x": [0.0], "y": [0.0], "z": [np.nan]}, "column 'z', row 0 = nan: expected finite numbers"),
        ({"x": [0.0, 1.0], "y": [0.0], "z": [0.0]}, "expected one length"),
        ({"x": [1.0], "y": [0.0], "z": [0.0]}, "none of 1 point lies on a CCD"),
        ({"x": [0.0, 0.001], "y": [0.0, 0.0], "z": [0.0, 0.0]}, "heights on R22_S11: 2 points: expected at least 3"),
        ({"x": [0.0, 1e-3, 2e-3], "y": [0.0] * 3, "z": [0.0] * 3}, "heights on R22_S11: 3 points: .* not on one line"),
        ({"x": ["a"], "y": [0.0], "z": [0.0]}, "heights column 'x'"),
        ({"x": [1.0] * u.deg, "y": [0.0], "z": [0.0]}, "heights column 'x'"),
        (np.zeros(3), "column 'x' is missing"),
    ],
)
def test_bad_tables_are_refused(table, expected):
    with pytest.raises(DomainError, match=expected):
        FocalPlane.from_heights(table)


def test_bad_arguments_are_refused():
    with pytest.raises(UnknownNameError, match="unknown height term 'potato': did you mean potato_chip"):
        FocalPlane.from_budget("lsst", seed=1, terms=["potato"])
    with pytest.raises(ConfigError, match=r"budget = 'simulation': expected .*; did you mean simulated"):
        FocalPlane.from_budget("lsst", seed=1, budget="simulation")
    with pytest.raises(UnknownNameError, match="unknown camera"):
        FocalPlane.from_budget("lst", seed=1)
    for seed in (-1, 1.5, "1", True):
        with pytest.raises(DomainError, match="seed = "):
            FocalPlane.from_budget("lsst", seed=seed)
    with pytest.raises(DomainError, match=r"ccd_tilt = -1\.0"):
        HeightBudget(0.0, 0.0, 0.0, -1.0, 0.0)
    with pytest.raises(DomainError, match="potato_chip_cycles"):
        HeightBudget(0.0, 0.0, 0.0, 0.0, 0.0, (2.0, 1.0))
    with pytest.raises(DomainError, match="expected a focal plane drawn from a height budget"):
        FocalPlane.flat().with_terms(["global"])
    for cells in (0, 1.5, True):
        with pytest.raises(DomainError, match="cells_per_ccd = "):
            FocalPlane.flat().to_mesh(cells)


def test_mesh_has_a_tile_a_ccd_facing_up_within_the_facet_error():
    fp = FocalPlane.from_budget("lsst", seed=1)
    cells = 8
    mesh = fp.to_mesh(cells)
    assert isinstance(mesh, trimesh.Trimesh)
    assert mesh.faces.shape == (189 * 2 * cells**2, 3)
    assert mesh.vertices.shape == (189 * (cells + 1) ** 2, 3)
    assert np.all(mesh.face_normals[:, 2] > 0.99)
    # Tiles cover the CCDs and nothing else; slopes of 1e-3 add a part in 1e6 of area.
    assert mesh.area == pytest.approx(4.0 * HALVES.prod(axis=1).sum(), rel=2e-6)
    # Interpolate at centres and near the middles of the longest sides, off the rims by more than rounding.
    bound = np.repeat(fp.facet_error(cells), 2 * cells**2)
    corners = mesh.vertices[mesh.faces]
    worst = 0.0
    for weights in ((1 / 3, 1 / 3, 1 / 3), (0.49, 0.02, 0.49), (0.49, 0.49, 0.02)):
        x, y, z = np.einsum("c,fcd->df", weights, corners)
        h = fp.height(x, y)
        assert np.all(np.abs(z - h) <= bound)
        worst = max(worst, (np.abs(z - h) / bound).max())
    # The bound is no more than a few times what happens.
    assert worst > 0.2


def test_facet_error_falls_with_the_square_of_the_cell_and_covers_splines():
    rng = np.random.default_rng(4)
    truth = FocalPlane.from_budget("lsst", seed=1)
    x, y = points_on([NAME], rng, 800)
    fitted = FocalPlane.from_heights({"x": x, "y": y, "z": truth.height(x, y)})
    i = fitted.ccd_index(NAME)
    assert fitted.facet_error(64)[i] == pytest.approx(fitted.facet_error(32)[i] / 4, rel=1e-12)
    mesh = fitted.to_mesh(16)
    faces = slice(i * 512, (i + 1) * 512)
    x, y, z = mesh.triangles_center[faces].T
    assert np.all(np.abs(z - fitted.height(x, y)) <= fitted.facet_error(16)[i])


def test_arrays_cannot_be_changed():
    fp = FocalPlane.from_budget("lsst", seed=1)
    with pytest.raises(ValueError, match="read-only"):
        fp.polynomial[0, 0] = 1.0


def test_a_moved_raft_is_a_rigid_body_and_nothing_else_moves():
    camera = lsst_camera()
    plane = FocalPlane.from_budget(camera, seed=3)
    moved = plane.with_moved("R21", dz=5e-6, rx=1e-4, ry=-2e-4)
    inside = [camera.ccd_index(n) for n in camera.ccds_of_raft("R21")]
    centre = camera.centers[inside].mean(axis=0)
    rng = np.random.default_rng(0)
    x, y = (camera.centers + rng.uniform(-0.9, 0.9, (189, 2)) * (0.5 * camera.shortest_side)).T
    change = moved.height(x, y) - plane.height(x, y)
    # A point at (dx, dy) of a plane turned by rx about x and ry about y rises by dy tan rx - dx tan ry.
    expected = 5e-6 + (y - centre[1]) * np.tan(1e-4) - (x - centre[0]) * np.tan(-2e-4)
    outside = np.setdiff1d(np.arange(189), inside)
    assert np.abs(change[inside] - expected[inside]).max() < 1e-18
    assert (change[outside] == 0.0).all()
    one = plane.with_moved("R21_S11", dz=1e-6)
    assert (one.height(*camera.centers.T) != plane.height(*camera.centers.T)).sum() == 1


def test_moves_of_unknown_rafts_and_by_no_number_are_refused():
    plane = FocalPlane.flat()
    with pytest.raises(UnknownNameError, match="R00"):
        plane.with_moved("R00", dz=1e-6)
    with pytest.raises(DomainError, match=r"R22 dz = nan: expected one finite number"):
        plane.with_moved("R22", dz=np.nan)


def test_scaled_terms_are_the_draw_of_a_scaled_budget():
    plane, factors = FocalPlane.from_budget(seed=3), {"raft": 2.0, "potato_chip": 0.0, "global": 0.5}
    budget = HeightBudget(5e-6, 13e-6, 10e-6, 2.5e-4, 0.0)
    drawn, scaled = FocalPlane.from_budget(seed=3, budget=budget), plane.scaled(factors)
    # Other orders of sums: rounding of some 10 um.
    np.testing.assert_allclose(scaled.polynomial, drawn.polynomial, rtol=0, atol=1e-19)
    np.testing.assert_allclose(scaled.waves, drawn.waves, rtol=0, atol=1e-12)
    assert scaled.budget == drawn.budget
    # Heights are linear in the factors, and a factor is of the heights as they are now.
    np.testing.assert_allclose(
        scaled.scaled({"raft": 0.5}).polynomial, plane.scaled(factors | {"raft": 1.0}).polynomial
    )
    assert plane.with_terms("raft").scaled({"ccd": 3.0}).terms == ("raft",)


@pytest.mark.parametrize("plane", [FocalPlane.from_budget(seed=3), FocalPlane.as_measured()])
def test_scaled_heights_are_the_heights_times_a_factor(plane):
    x, y = 0.9e-2 * np.array([[-20.0, 3.0, 14.0], [5.0, -2.0, 11.0]])
    scaled = plane.scaled(-2.0)
    np.testing.assert_allclose(scaled.height(x, y), -2.0 * plane.height(x, y), rtol=1e-12)
    np.testing.assert_allclose(scaled.gradient(x, y), -2.0 * plane.gradient(x, y), rtol=1e-12)


def test_factors_that_mean_nothing_are_refused():
    plane = FocalPlane.flat()
    with pytest.raises(DomainError, match=r"^factors of terms: expected a focal plane drawn from a height budget$"):
        plane.scaled({"raft": 2.0})
    with pytest.raises(DomainError, match=r"^raft = -1.0: expected a finite factor, not negative$"):
        FocalPlane.from_budget(seed=1).scaled({"raft": -1.0})
    with pytest.raises(UnknownNameError, match="wobble"):
        FocalPlane.from_budget(seed=1).scaled({"wobble": 1.0})
    with pytest.raises(DomainError, match=r"^factors = nan"):
        plane.scaled(float("nan"))


def test_heights_of_minus_zero_are_none():
    """NumPy draws no numbers between 0 and -0."""
    budget = replace(SIMULATED, raft_height=-0.0, ccd_height=-0.0, ccd_tilt=-0.0)
    drawn = FocalPlane.from_budget("lsst", seed=1, terms=["raft", "ccd", "tilt"], budget=budget)
    assert not drawn.polynomial.any()
