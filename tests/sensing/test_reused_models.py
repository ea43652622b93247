"""What fits of donuts reuse or leave out for speed, against what it stands for."""

from dataclasses import replace

import numpy as np
import pytest
from donut_images import PIXEL, WAVELENGTH
from scipy.spatial.distance import cdist
from test_image_model import stamp_of

import pachon
from pachon.models.zernike_polynomials import annular_zernike_gradients, low_zernike_gradients
from pachon.raytrace.rays import field_direction
from pachon.sensing import moving_rims
from pachon.sensing.donut_rays import ZernikeRays
from pachon.sensing.likelihood import linearized, model_image
from pachon.sensing.moving_rims import PupilShadows
from pachon.sensing.pupil_cells import pupil_cells
from pachon.sensing.residual_power import StationaryField
from pachon.sensing.solve import Group, solve

STAR = np.array([1e6, 1.2, -0.7, 3.0, 5.0, 0.1, -0.2])
WAVE = 60e-9 * np.cos(np.arange(8))


@pytest.mark.parametrize("obscuration", [0.0, 0.612, 0.9])
def test_zernikes_by_monomials_have_the_same_gradients(obscuration):
    rho, theta = np.random.default_rng(1).uniform((obscuration, 0.0), (1.0, 2.0 * np.pi), (200, 2)).T
    noll, x, y = np.array([4, 11, 22, 37, 56, 78, 79]), rho * np.cos(theta), rho * np.sin(theta)
    for terms in (noll[:-1], noll):
        expected = annular_zernike_gradients(int(terms.max()), x, y, obscuration)[terms - 1]
        values = low_zernike_gradients(terms, x, y, obscuration)
        np.testing.assert_allclose(values, expected, atol=1e-11 * np.abs(expected).max())


def test_a_stationary_field_is_its_covariance():
    """Times columns and traces of products, with pixels left out, against whole matrices."""
    rng = np.random.default_rng(2)
    used = rng.uniform(size=(9, 12)) < 0.8
    amplitudes, lengths = rng.uniform(0.5, 2.0, (2, *used.shape)), (0.7, 1.8)
    fields = [StationaryField(used, *pair) for pair in zip(amplitudes, lengths, strict=True)]
    distance = cdist(np.argwhere(used), np.argwhere(used))
    matrices = []
    for amplitude, length in zip(amplitudes, lengths, strict=True):
        sizes = amplitude[used] / np.sqrt((amplitude[used] ** 2).mean())
        matrices.append(np.exp(-0.5 * (distance / length) ** 2) * np.outer(sizes, sizes))
    columns = rng.normal(size=(used.sum(), 3)).astype(np.float32)
    for field, matrix in zip(fields, matrices, strict=True):
        np.testing.assert_allclose(field.times(columns), matrix @ columns, atol=1e-5 * np.abs(matrix @ columns).max())
    assert fields[0].product(fields[1]) == pytest.approx(np.trace(matrices[0] @ matrices[1]), rel=1e-6)
    even = StationaryField(np.ones((5, 4), dtype=bool), np.ones((5, 4)), 1.0)
    grid = np.indices((5, 4)).reshape(2, -1).T
    expected = np.exp(-0.5 * cdist(grid, grid) ** 2)
    np.testing.assert_allclose(even.times(np.eye(20, dtype=np.float32)), expected, atol=1e-6)


def test_sums_over_pairs_have_the_covariance_of_sums():
    rng = np.random.default_rng(3)
    field = StationaryField(np.ones((6, 8), dtype=bool), np.ones((6, 8)), 1.3)
    rows, columns = (np.kron(np.eye(n // 2), [[1.0, 1.0]]) / np.sqrt(2.0) for n in (6, 8))
    sums = np.kron(rows, columns)
    values = rng.normal(size=(3, 4, 2))
    expected = sums @ field.times(np.eye(48, dtype=np.float32)) @ sums.T @ values.reshape(12, 2)
    given = field.times_sums(values, rows, columns).reshape(12, 2)
    np.testing.assert_allclose(given, expected, atol=1e-5 * np.abs(expected).max())


def test_merged_cells_have_the_light_of_their_parts(behind_focus):
    """Light, centroid and second moments of all cells, and the same image but for its finest detail."""
    rays = stamp_of(behind_focus, 48).rays
    cells, merged = rays.cells, rays.merged().cells

    def moments(cells):
        squares = cells.moments + cells.points[:, :, None] * cells.points[:, None, :]
        return cells.weights.sum(), cells.weights @ cells.points, np.tensordot(cells.weights, squares, axes=1)

    assert len(merged) < 0.35 * len(cells)
    for given, expected in zip(moments(merged), moments(cells), strict=True):
        np.testing.assert_allclose(given, expected, atol=1e-12)
    landings = (rays.landing(WAVE), rays.merged().landing(WAVE))
    middles = [weights @ landing for weights, landing in zip((cells.weights, merged.weights), landings, strict=True)]
    # The curvature of the landing points over a cell: a hundredth of a pixel.
    np.testing.assert_allclose(middles[1], middles[0], atol=0.01 * PIXEL)


def test_light_follows_its_response_while_it_stays(behind_focus):
    """Against light that is traced: to a thousandth of its way, which is 1e-4 pixels."""
    rays, traced = (stamp_of(behind_focus, 48).rays for _ in range(2))
    rays.landing(WAVE)
    near = WAVE + 0.4e-9
    way = np.abs(traced.landing(near) - rays.landing(WAVE)).max()
    error = np.abs(rays.landing(near) - traced.landing(near)).max()
    assert 0.0 < error < 2e-3 * way < 1e-4 * PIXEL


def test_derivatives_hold_while_the_light_stays(behind_focus):
    """A hundredth of a pixel on they are those of before, at most a few per cent off; the image itself is exact."""
    stamp = stamp_of(behind_focus, 48)
    stamp = replace(stamp, image=model_image(stamp, STAR, WAVE))
    linearized(stamp, STAR, WAVE)
    for step, same in ((0.01, True), (0.2, False)):
        star = np.add(STAR, [1e4, step, 0.0, 1.0, 0.0, 0.0, 0.0])
        after = linearized(stamp, star, WAVE)
        fresh_stamp = stamp_of(behind_focus, 48, image=stamp.image)
        fresh = linearized(fresh_stamp, star, WAVE)
        np.testing.assert_allclose(after.model, fresh.model, rtol=1e-6)
        np.testing.assert_allclose(after.scales, fresh.scales)
        changes, exact = (point.columns * point.scales.astype(np.float32) for point in (after, fresh))
        off = np.linalg.norm(changes - exact, axis=0) / np.maximum(np.linalg.norm(exact, axis=0), 1e-30)
        assert 1e-5 < off.max() < 0.05 if same else off.max() < 1e-6, off
    # Where the model lacks much, the smallest step counts.
    stamp = replace(stamp, image=1.5 * stamp.image)
    stamp.forget()
    linearized(stamp, STAR, WAVE)
    star = np.add(STAR, [0.0, 0.01, 0.0, 0.0, 0.0, 0.0, 0.0])
    fresh = linearized(stamp_of(behind_focus, 48, image=stamp.image), star, WAVE)
    np.testing.assert_array_equal(linearized(stamp, star, WAVE).columns, fresh.columns)


def test_a_search_ends_where_it_is_hopeless(behind_focus):
    """After its first step, with the loss that it predicts, which is near that of the whole search."""
    stamp = stamp_of(behind_focus, 48)
    truth = model_image(stamp, STAR, WAVE)
    stamp = replace(stamp, image=truth + np.random.default_rng(3).normal(0.0, 60.0, truth.shape))
    group, start = Group((stamp,), np.eye(8)[None], np.zeros(8)), np.add(STAR, [1e4, 0.5, 0.5, 0.0, 0.5, 0.0, 0.0])
    whole = solve(group, [start], np.zeros(8))
    short = solve(group, [start], np.zeros(8), hopeless=0.5 * whole.loss)
    assert not short.converged or whole.converged
    assert short.loss == pytest.approx(whole.loss, rel=0.1)
    unhindered = solve(group, [start], np.zeros(8), hopeless=2.0 * whole.loss)
    np.testing.assert_array_equal(unhindered.shared, whole.shared)


@pytest.mark.parametrize("degrees", [0.3, 1.75])
def test_rims_far_from_the_light_are_none_that_bound_it(focused, monkeypatch, degrees):
    """Shadows are those of a search among all rims."""
    telescope = focused.perturbed("Camera", shift=(0.0, 0.0, 1.5e-3))
    direction = field_direction(*np.deg2rad([0.6 * degrees, 0.8 * degrees]))
    cells = pupil_cells(telescope, direction, WAVELENGTH, 48)
    quick = PupilShadows(telescope, direction, WAVELENGTH, cells).candidates()
    monkeypatch.setattr(moving_rims, "_BETWEEN", np.inf)
    every = PupilShadows(telescope, direction, WAVELENGTH, cells).candidates()
    assert [body.members for body in quick[0]] == [body.members for body in every[0]]
    np.testing.assert_allclose(quick[1].points, every[1].points, atol=1e-9)
    np.testing.assert_allclose(quick[1].across, every[1].across, rtol=1e-6, atol=1e-9)


def test_light_next_to_the_cells_lands_where_rays_say(behind_focus):
    direction = field_direction(*np.deg2rad([0.6, 0.9]))
    cells = pupil_cells(behind_focus, direction, WAVELENGTH, 40)
    waves = np.array([WAVELENGTH]), np.ones(1)
    rays = ZernikeRays(behind_focus, direction, *waves, cells, np.arange(4, 12))
    lit = cells.points[::7] + 0.2 * cells.side
    beside = replace(cells, points=lit, weights=np.ones(len(lit)), moments=cells.moments[::7])
    exact = ZernikeRays(behind_focus, direction, *waves, beside, np.arange(4, 12)).landing(WAVE)
    landing, spread = rays.beside(lit, beside.moments, rays.landing(WAVE))
    np.testing.assert_allclose(landing, exact, atol=0.04 * PIXEL)
    assert np.abs(spread).max() < PIXEL**2


@pytest.mark.long
def test_a_fit_with_diffraction_that_begins_with_rays_is_one_from_the_start(focused):
    telescope, field = focused.perturbed("Camera", shift=(0.0, 0.0, 1.5e-3)), np.deg2rad([[1.0, 0.7]])
    true = telescope.perturbed("M2", shift=(1e-4, 0.0, 0.0))
    model = pachon.DonutModel(
        air=pachon.DonutAir(fwhm=np.deg2rad(0.6 / 3600)), detector=pachon.DonutDetector(PIXEL), diffraction=True
    )
    image = pachon.draw_donuts(true, field, WAVELENGTH, electrons=5e6, model=model, stamps=pachon.Stamps(91)).images
    image = np.random.default_rng(4).poisson(image + 300.0) - 300.0
    options = {"sky_variance": 300.0, "pixel_size": PIXEL, "threads": 1}
    automatic, forced = (
        pachon.fit_donuts(
            telescope, image, field, WAVELENGTH, model=pachon.DonutModel(diffraction=diffraction), **options
        )
        for diffraction in (None, True)
    )
    assert automatic.diffraction
    assert automatic.reasons == forced.reasons
    difference = automatic.zernikes[0] - forced.zernikes[0]
    assert difference @ np.linalg.solve(forced.covariance[0], difference) < 0.3
    np.testing.assert_allclose(automatic.errors, forced.errors, rtol=0.05)
