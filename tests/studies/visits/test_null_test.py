import dataclasses
import json

import numpy as np
import pytest
from scipy.special import ndtri

from pachon.commands.cli import main
from pachon.core.errors import PachonError, ProductError
from pachon.core.long_work import Execution
from pachon.core.products import Stamp
from pachon.core.units import ARCMIN, ARCSEC
from pachon.imaging.exposure import Exposure
from pachon.measure.shear.shear_shapes import ShearShapes
from pachon.measure.shear.shear_shapes import shear_bias as shear_bias_of_functionals
from pachon.measure.shear.weight import weight_sigma
from pachon.sky.galaxies import Galaxies
from pachon.studies.visits import null_test as module
from pachon.studies.visits.galaxy_shapes import GalaxyShapes, measure_galaxies, stamp_sides
from pachon.studies.visits.null_result import AdditiveBias, density_slope, shear_bias
from pachon.studies.visits.null_test import ellipticity_along, null_test, read_shapes, write_shapes
from pachon.studies.visits.psf_errors import PsfAtGalaxies
from pachon.studies.visits.stack import PsfStack
from pachon.studies.visits.visits import stack_visits

PIXEL = 0.2 * ARCSEC
AXES = np.array([[np.cos(0.3), np.sin(0.3)], [np.sin(0.3), -np.cos(0.3)]]) / PIXEL


def gaussian(e, sigma):
    """PSF of unit sum with an ellipticity e1 + i e2 and a determinant of the covariance of sigma^4 [pixel^4]."""
    y, x = np.mgrid[-15:16, -15:16]
    q = (1 + abs(e) ** 2, 2 * e.real, 2 * e.imag)
    scale = sigma**2 / (1 - abs(e) ** 2)
    xx, yy, xy = scale * (q[0] + q[1]), scale * (q[0] - q[1]), scale * q[2]
    image = np.exp(-0.5 * (yy * x**2 - 2 * xy * x * y + xx * y**2) / (xx * yy - xy**2))
    return (image / image.sum()).astype(np.float32)


def stack_of(true, model, places=9):
    """Return a stack with one true PSF and one model everywhere."""
    x, y = (ARCMIN * v.ravel() for v in np.meshgrid(*2 * [np.linspace(-3.0, 3.0, places)]))
    sky = np.stack([x, y], axis=1) @ np.linalg.inv(AXES * PIXEL).T
    zero = np.zeros(len(x))
    return PsfStack(
        visits=1,
        xi=sky[:, 0],
        eta=sky[:, 1],
        x=x,
        y=y,
        star=zero > 0,
        count=np.ones(len(x), dtype=int),
        true=np.repeat(true[None], len(x), axis=0),
        model=np.repeat(model[None], len(x), axis=0),
        e1=zero,
        e2=zero,
        size=zero,
        model_e1=zero,
        model_e2=zero,
        model_size=zero,
    )


def galaxies(count, seed=1, sersic=0.5):
    rng = np.random.default_rng(seed)
    e = 0.2 * ndtri(rng.uniform(0.05, 0.95, (2, count)))
    position = rng.uniform(-1.0, 1.0, (2, count)) * ARCMIN
    return Galaxies.single(
        xi=position[0],
        eta=position[1],
        magnitude=rng.uniform(20.0, 22.0, count),
        radius=rng.uniform(0.5, 0.8, count) * ARCSEC,
        e1=e[0],
        e2=e[1],
        sersic=np.full(count, sersic),
    )


def test_gaussian_galaxies_come_back_along_the_axes_of_the_stack():
    psf, many = gaussian(0.03 - 0.02j, 1.6), galaxies(60)
    found = measure_galaxies(stack_of(psf, psf), AXES, many, Exposure(noise=False), 1, reach=ARCMIN)
    # The axes are a mirror image of the sky, turned.
    e = ellipticity_along(AXES, many.e1 + 1j * many.e2)
    np.testing.assert_allclose(found.e1 + 1j * found.e2, e, atol=2e-3)
    # The second fit goes on from the first one.
    np.testing.assert_allclose(found.e1, found.true_e1, rtol=0, atol=1e-7)
    assert found.usable.all()
    np.testing.assert_allclose(
        np.stack([found.x, found.y], axis=1), np.stack([many.xi, many.eta], axis=1) @ AXES.T * PIXEL
    )


def test_a_wrong_psf_moves_ellipticities_and_the_true_one_does_not():
    many = galaxies(300, seed=2)
    stack = stack_of(gaussian(0.03 + 0j, 1.6), gaussian(0.0 + 0j, 1.6))
    found = measure_galaxies(stack, AXES, many, Exposure(exposures=100), 1, "noise", reach=ARCMIN)
    both = found.usable & found.true_usable
    shift = (found.e1 - found.true_e1)[both]
    # The covariance before the PSF gets the difference of those of the two PSFs: e (T_psf / T_galaxy) for small e,
    # where T of a round Gaussian is twice the square of its size.
    sigma = many.radius[both] / PIXEL / np.sqrt(2.0 * np.log(2.0))
    assert shift.mean() == pytest.approx(np.mean(0.03 * 1.6**2 / sigma**2), rel=0.1)
    # Each galaxy has the same noise twice: the shift is known far better than the ellipticities.
    assert shift.std() < 0.3 * found.e1[both].std()
    assert abs((found.e2 - found.true_e2)[both].mean()) < 2e-3


def test_stamps_are_hardly_larger_than_the_weight_needs(monkeypatch):
    """A weight that needs 33 pixels had 64, four times as many as one that needs 32, for the same shapes."""
    assert [stamp_sides(needed / 12.0) for needed in (32, 33, 41, 49, 99, 999)] == [
        *((32, 64), (40, 64), (48, 64), (64, 64), (128, 128), (128, 128))
    ]
    psf, many = gaussian(0.03 - 0.02j, 2.3), galaxies(40, sersic=1.0)
    shapes = []
    for sides in ((40,), (128,)):
        monkeypatch.setattr("pachon.studies.visits.galaxy_shapes.stamp_sides", lambda _, sides=sides: 2 * sides)
        shapes.append(measure_galaxies(stack_of(psf, psf), AXES, many, Exposure(noise=False), 1, reach=ARCMIN))
    found, wide = shapes
    # Of an exponential galaxy of 0.8 arcsec two thousandths of the light lie beyond 20 pixels.
    np.testing.assert_allclose(found.true_e1 + 1j * found.true_e2, wide.true_e1 + 1j * wide.true_e2, atol=1e-3)
    np.testing.assert_allclose(found.true_shear.e1, wide.true_shear.e1, atol=1e-4)


def test_small_galaxies_and_those_far_from_a_known_psf_are_left_out():
    psf, many = gaussian(0j, 1.6), galaxies(20)
    tiny = Galaxies.single(many.xi, many.eta, many.magnitude, 0.2 * many.radius)
    found = measure_galaxies(stack_of(psf, psf), AXES, tiny, Exposure(noise=False), 1, reach=ARCMIN)
    # 1.2 times the half-light radius of the PSF needs 0.66 of it before the PSF.
    assert not found.usable.any()
    few = measure_galaxies(stack_of(psf, psf, places=2), AXES, many, Exposure(noise=False), 1, reach=3.5 * ARCMIN)
    assert 0 < len(few) < 20
    assert (np.hypot(3.0 - np.abs(few.x) / ARCMIN, 3.0 - np.abs(few.y) / ARCMIN) < 3.5).all()


def test_no_byte_depends_on_the_threads():
    psf, many = gaussian(0.02j, 1.6), galaxies(40)
    one, two = (
        measure_galaxies(stack_of(psf, psf), AXES, many, Exposure(), 3, reach=ARCMIN, threads=n) for n in (1, 2)
    )
    np.testing.assert_array_equal(one.e1, two.e1)
    np.testing.assert_array_equal(one.error, two.error)


def test_shear_bias_is_that_of_the_measurement():
    rng = np.random.default_rng(3)
    shear = 0.02 * np.where(np.arange(400) % 2 == 0, 1.0, 1j)
    shapes = 0.1 * (rng.standard_normal((400, 4)) + 1j * rng.standard_normal((400, 4)))
    measured = [
        0.93 * sign * shear.real[:, None] + 0.9j * sign * shear.imag[:, None] + shapes + 0.001j for sign in (1, -1)
    ]
    measured[0][7, 2] = np.nan
    found = shear_bias(np.array(measured), shear)
    np.testing.assert_allclose(found.m, [-0.07, -0.1], atol=1e-12)
    assert found.n_rings == 399
    # Shapes cancel in m alone: c has the error of their mean.
    np.testing.assert_allclose(found.c_error, 0.1 / np.sqrt(4 * 399), rtol=0.1)
    assert np.abs(found.c - [0.0, 0.001]).max() < 4 * found.c_error.max()


def test_slope_of_a_power_law():
    density = np.array([10.0, 24.0, 42.0])
    slope = density_slope(density, 3.0 * density**-0.97)
    assert slope.value == pytest.approx(-0.97)
    assert slope.error == pytest.approx(0.0, abs=1e-12)
    assert density_slope(density[:2], density[:2]) is None  # a line through two points has no error
    # The error of a slope in closed form: of residuals r about a line, sqrt(sum r^2 / (n - 2) / sum (x - mean)^2).
    x, r = np.log([1.0, 2.0, 4.0, 8.0]), np.array([0.01, -0.03, 0.03, -0.01])
    scattered = density_slope(np.exp(x), np.exp(-0.97 * x + r))
    assert scattered.value == pytest.approx(-0.97)
    assert scattered.error == pytest.approx(np.sqrt(np.sum(r**2) / 2.0 / np.sum((x - x.mean()) ** 2)))


@pytest.fixture(scope="module")
def tested(visits_config, tmp_path_factory):
    folder = tmp_path_factory.mktemp("null")
    stack_visits(visits_config(places=12), folder, execution=Execution(threads=1))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "FAINTEST_SNR", 100.0)
        return null_test(folder, tiles=1, rings=40, execution=Execution(threads=1)), folder


@pytest.mark.long
def test_the_null_test_of_a_folder(tested):
    results, folder = tested
    assert set(results) == {1, 2}
    written = json.loads((folder / "null_test.json").read_text())["stacks"]
    for visits, result in results.items():
        metrics = written[str(visits)]
        galaxies = result.galaxies
        # Tiles have the shortest side of all CCDs, 4000 pixels.
        area = (4000 * 0.2 / 60.0) ** 2
        assert metrics["usable_per_arcmin2"] == pytest.approx(galaxies.usable.sum() / area, rel=2e-3)
        assert 0.15 < metrics["rms_e_component"] < 0.35
        # Elliptical Gaussians under-fit discs and spheroids by some per cent.
        assert -0.2 < metrics["m1_true"] < 0.05
        assert metrics["m1_true_error"] < 0.03
        # The functionals have no bias beyond their error.
        for name in ("shear_m1_true", "shear_m2_true"):
            assert abs(metrics[name]) < 4.0 * metrics[f"{name}_error"] < 0.2
        assert metrics["shear_galaxies"] > 10
        assert 0.1 < metrics["shear_beta_expected"] < 2.0
        # What galaxies have of the errors of the models is what these leave to first order.
        assert metrics["shear_agreement"] == pytest.approx(1.0, abs=0.1 + 3.0 * metrics["shear_agreement_error"])
        assert 0.15 < metrics["rms_shear_component"] < 0.6
    assert results[2].density > results[1].density
    assert (folder / "null_test.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_a_null_test_goes_on_to_the_same_bytes_with_other_workers(tested, backwards, monkeypatch):
    _, folder = tested
    monkeypatch.setattr(module, "FAINTEST_SNR", 100.0)
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    gone = sorted((folder / "galaxies").iterdir())[0]
    gone.unlink()
    damaged = sorted((folder / "galaxies").iterdir())[0]
    damaged.write_bytes(damaged.read_bytes()[:4000])
    null_test(folder, tiles=1, rings=40, execution=Execution(resume=True, threads=2))
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before
    null_test(folder, tiles=1, rings=40, execution=Execution(workers=backwards))
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


def test_a_folder_without_visits(tmp_path, capsys):
    with pytest.raises(PachonError, match="no visits"):
        null_test(tmp_path)
    assert main(["null-test", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "expected the folder of pachon visits" in error


def test_additive_bias_is_the_part_of_the_psf_and_of_its_error_that_galaxies_have():
    rng = np.random.default_rng(5)
    psf = stack_of(gaussian(0.0 + 0.0j, 2.0), gaussian(0.0 + 0.0j, 2.0), places=30)
    field = 0.01 * (np.sin(psf.x / ARCMIN) + 1j * np.cos(0.7 * psf.y / ARCMIN))
    wrong = 0.003 * (np.cos(3.0 * psf.x / ARCMIN) - 1j * np.sin(2.0 * psf.y / ARCMIN))
    parts, nearest = [], rng.integers(0, len(psf.x), (10, 800))
    for places in nearest:
        shape = 0.02 * (rng.normal(size=800) + 1j * rng.normal(size=800))
        shears = {"true_shear": 0.1 * field[places] + shape}
        shears["shear"] = shears["true_shear"] + 0.8 * wrong[places] + 1e-4 * rng.normal(size=800)
        weight = (rng.random(800) < 0.7).astype(float)
        nothing, flags = np.zeros(800), np.ones(800, dtype=bool)
        # Ellipticities are shears times the response, 0.4, and nothing where galaxies are left out.
        shapes = {
            kind: ShearShapes(
                *(0.4 * weight * v for v in (g.real, g.imag, np.ones(800), nothing, np.ones(800))), weight, nothing
            )
            for kind, g in shears.items()
        }
        columns = psf.x[places], psf.y[places], *[nothing] * 4, flags, nothing, nothing, flags
        parts.append(GalaxyShapes(places, *columns, **shapes))
    at = nearest.ravel()
    bias = AdditiveBias.of(PsfAtGalaxies(field[at], (field - wrong)[at], 0.75 * wrong[at]), parts)
    # Of 5600 galaxies: 0.02 a component over the modulus of the PSF's ellipticity.
    expected_error = 0.02 / np.sqrt(5600.0) / np.sqrt(np.mean(np.abs(field) ** 2))
    assert bias.alpha_true[1] == pytest.approx(expected_error, rel=0.4)
    assert abs(bias.alpha_true[0] - 0.1) < 3.5 * expected_error
    # The shapes are in both and leave the difference: the slope against the error is known much better.
    assert bias.beta[1] < 0.01
    assert abs(bias.beta[0] - 0.8) < 4.0 * bias.beta[1]
    assert bias.beta_expected[0] == pytest.approx(0.75)
    assert bias.agreement[0] == pytest.approx(bias.beta[0] / 0.75)
    of_model = np.mean(np.abs(field - wrong) ** 2)
    slope = (np.conj(field - wrong) * (0.1 * field + 0.8 * wrong)).real.mean() / of_model
    assert abs(bias.alpha_model[0] - slope) < 3.5 * bias.alpha_model[1]


@pytest.mark.long
def test_functionals_of_the_null_test_have_the_shear_without_bias():
    """Galaxies of all kinds under a shear of 0.02 along x of the stack and its opposite, one noise."""
    psf, many = gaussian(0.04 + 0.03j, 1.6), galaxies(120, seed=3, sersic=1.5)
    many = Galaxies.concatenate([many, many.rotated(np.pi / 2)])
    # The axes mirror and turn the sky: this is along x of the stack.
    g = 0.02 * ellipticity_along(AXES, np.ones(1, dtype=complex))[0]
    assert ellipticity_along(AXES, np.array([g]))[0] == pytest.approx(0.02)
    stack, exposure = stack_of(psf, gaussian(0j, 1.6)), Exposure(exposures=100)
    pair = [
        measure_galaxies(
            stack, AXES, many.sheared(s * g.real, s * g.imag), exposure, 1, "noise", reach=ARCMIN
        )
        for s in (1.0, -1.0)
    ]  # fmt: skip
    bias = shear_bias_of_functionals(pair[0].true_shear, pair[1].true_shear, 0.02, 0.0)
    assert bias.m_error[0] < 3e-3
    assert abs(bias.m[0]) < 4.0 * bias.m_error[0]
    assert (np.abs(bias.c) < 4.0 * bias.c_error + 1e-3).all()
    # A model without the ellipticity of the PSF leaves a part of it.
    assert (shear_bias_of_functionals(pair[0].shear, pair[1].shear, 0.02, 0.0).c > 0.01).all()


def test_tiles_under_psfs_of_other_widths_have_one_weight():
    """Ellipticities under other weights have other responses, and the mean response is that of all tiles."""
    stack = stack_of(gaussian(0j, 1.9), gaussian(0j, 1.9))
    wide = stack.xi > 0.0
    stack.true[wide] = stack.model[wide] = gaussian(0j, 2.3)
    exposure, many = Exposure(noise=False, exposures=400), galaxies(30)

    def galaxies_in(xi, eta):
        # The same galaxies on every tile.
        middle = np.mean(xi), np.mean(eta)
        return dataclasses.replace(many, xi=0.3 * many.xi + middle[0], eta=0.3 * many.eta + middle[1])

    depth = module._StackMeasurement(stack, AXES, exposure, galaxies_in, 1, 2.0 * ARCMIN, 0.7 * ARCMIN)
    tiles = [(-1, 0), (1, 0)]
    jobs = list(depth.jobs(tiles, tiles, 10))
    assert {job["sigma"] for job in jobs} == {weight_sigma(None, stack.true, exposure.pixel_scale)}
    assert not (jobs[0]["stack"].true == gaussian(0j, 2.3)).all(axis=(1, 2)).any()
    one, other = (module.measure_job(job, 1).shear for job in jobs[:2])
    # The functionals are those before the PSF.
    np.testing.assert_allclose(one.r11, other.r11, rtol=0.02)


def test_a_tile_with_numbers_that_are_not_finite_is_refused(tmp_path):
    rng = np.random.default_rng(3)
    shear = ShearShapes(*rng.uniform(0.1, 0.2, (7, 5)))
    numbers = [rng.uniform(0.1, 0.2, 5) for _ in range(6)]
    yes = np.ones(5, dtype=bool)
    e1 = np.array([0.1, np.nan, 0.2, 0.0, -0.1])
    stamp, path = Stamp("hash", 1), tmp_path / "tile.fits"
    for usable in (yes, yes & np.isfinite(e1)):
        x, y, magnitude, e2, error, true = numbers
        galaxies = GalaxyShapes(
            np.arange(5), x, y, magnitude, e1, e2, error, usable, true, true, yes, shear=shear, true_shear=shear
        )
        write_shapes(path, galaxies, stamp)
        if usable is yes:
            with pytest.raises(ProductError, match=r"tile\.fits: E1 of usable galaxies is not finite"):
                read_shapes(path, stamp)
        else:
            np.testing.assert_array_equal(read_shapes(path, stamp).usable, usable)


@pytest.mark.parametrize("command", ["null-test", "stack-images"])
def test_a_damaged_configuration_of_the_visits_is_named(tmp_path, capsys, command):
    """A bit of a word that changed: the file is as valid as before, and what it says is not."""
    path = tmp_path / "config.yaml"
    path.write_text("run: {atmosphere: {site: gerro_pachon}}\n")
    assert main([command, str(tmp_path), "--quiet"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"pachon: error: {path}: run.atmosphere.site: unknown site 'gerro_pachon'")
