"""Kriging of PSFs with the noise of each star: against brute force, and against what one would choose by hand."""

import numpy as np
import pytest

from pachon.core.errors import ConfigError, DomainError
from pachon.core.threads import one_blas_thread
from pachon.measure.shapes import measure_shapes
from pachon.reconstruction.psf_model import kriging
from pachon.reconstruction.psf_model.covariance_posterior import Posterior, StarNumbers
from pachon.reconstruction.psf_model.covariance_search import ShapeSample, fit_covariances
from pachon.reconstruction.psf_model.fit import CcdStars, fit_stars
from pachon.reconstruction.psf_model.model import PsfModel
from pachon.reconstruction.psf_model.polynomial import design_matrix
from pachon.reconstruction.psf_model.recipe import Recipe

SIZE = 21
EXTENT = (-1.0, 1.0, -1.0, 1.0)
OPTIONS = {"basis": "pixels", "interpolation": "kriging", "extent": EXTENT}


def psfs(e1, e2, width):
    """Elliptical Moffat profiles of unit sum, (1 + r^2)^-3, of rms width about `width` pixels."""
    y, x = np.indices((SIZE, SIZE)) - SIZE // 2
    e1, e2, width = (np.asarray(v)[:, None, None] for v in (e1, e2, width))
    square = (x**2 * (1 - 2 * e1) + y**2 * (1 + 2 * e1) - 4 * e2 * x * y) / (2.2 * width) ** 2
    images = (1.0 + square) ** -3
    return images / images.sum(axis=(1, 2), keepdims=True)


def field(seed, count, rough, holdouts=150):
    """Stars in electrons, and noise-free PSFs elsewhere, under a quadratic field and an exponential process."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1.0, 1.0, (count + holdouts, 2))
    distance = np.hypot(*np.moveaxis(points[:, None] - points, -1, 0))
    process = np.linalg.cholesky(np.exp(-2.0 * distance) + 1e-9 * np.eye(len(points)))

    def values():
        smooth = design_matrix(points, EXTENT, 2) @ rng.normal(size=6)
        return 0.006 * (smooth + rough * process @ rng.normal(size=len(points)))

    images = psfs(values(), values(), 1.5 * (1.0 + values()))
    electrons = 4000.0 * 10.0 ** rng.uniform(0.0, 2.0, count)
    stars = electrons[:, None, None] * images[:count]
    stars = stars + rng.normal(size=stars.shape) * np.sqrt(22.0**2 + stars)
    return stars, points[:count], images[count:], points[count:]


def error(images, truth):
    made, true = (measure_shapes(i, 0.2, 0.7) for i in (images, truth))
    return np.sqrt(np.mean((made.e1 - true.e1) ** 2 + (made.e2 - true.e2) ** 2))


@pytest.mark.long
@pytest.mark.parametrize(
    "rough", [pytest.param(0.0, marks=pytest.mark.slow), 0.5, pytest.param(2.0, marks=pytest.mark.slow)]
)
@pytest.mark.parametrize(
    "count", [pytest.param(20, marks=pytest.mark.slow), 40, pytest.param(100, marks=pytest.mark.slow)]
)
def test_it_is_near_to_the_best_of_all_choices_of_polynomials(count, rough):
    # What is best is found with the truth, anew for each field, which nobody has.
    ratios = []
    for seed in range(3):
        stars, places, truth, elsewhere = field(100 * seed + count, count, rough)
        electrons = stars.sum(axis=(1, 2))
        softened = 1.0 / (electrons**-2.0 + (30.0 * 22.0 * 5.0) ** -2.0)
        errors = [
            error(PsfModel.fit(stars, places, **by_hand, weights=weights).at(elsewhere), truth)
            for by_hand in (
                {"recipe": "paper", "basis": "pixels", "order": order, "extent": EXTENT} for order in range(4)
            )
            for weights in (None, electrons**2, softened)
            if (by_hand["order"] + 1) * (by_hand["order"] + 2) // 2 < count
        ]
        ratios.append(error(PsfModel.fit(stars, places, **OPTIONS).at(elsewhere), truth) / min(errors))
    assert np.exp(np.log(ratios).mean()) < 1.1


def exact_fields(degree, count=60, seed=2):
    """Shape numbers of an exact polynomial, ten times their noise a term, with places, noise and terms to degree 4."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1.0, 1.0, (count, 2))
    terms = design_matrix(points, EXTENT, 4)
    degrees = np.repeat(np.arange(5), np.arange(1, 6))
    numbers = terms @ (0.1 * (degrees <= degree)[:, None] * rng.normal(size=(15, 3)))
    return points, numbers + 1e-2 * rng.normal(size=(count, 3)), np.full((count, 3), 1e-4), terms


def test_the_form_of_a_field_is_found():
    with one_blas_thread():
        for degree, name in ((0, "constant"), (1, "linear"), (2, "quadratic")):
            fields = fit_covariances([ShapeSample(*exact_fields(degree, seed=seed)) for seed in range(8)])
            probabilities = [covariances.forms().get(name, 0.0) for covariances in fields]
            # Chance alone gives some of the fields a further term, of about the size of its own error.
            assert np.median(probabilities) > 0.5
            for covariances, probability in zip(fields, probabilities, strict=True):
                if probability < 0.5:
                    continue
                best = list(covariances.forms()).index(name)
                # Variances in units of the noise, 100 where there are terms; fewer than fifty numbers tell each.
                trend = covariances.kernels[best][3:]
                assert ((trend[:degree] > 10.0) & (trend[:degree] < 1000.0)).all()
                assert (trend[degree:] == 0.0).all()
        # Degrees 3 and 4 come with a process, which is then small.
        covariances = fit_covariances([ShapeSample(*exact_fields(4))])[0]
        assert covariances.forms()["quartic, process"] > 0.99
        assert ((covariances.kernel[3:] > 10.0) & (covariances.kernel[3:] < 1000.0)).all()
        assert covariances.kernel[0] < 1.0


def test_ccds_that_are_searched_together_have_the_bytes_of_each_alone():
    # Forms of other CCDs, with other numbers of stars, end sooner and later.
    counts = [33, 40, 34, 9]
    samples = [ShapeSample(*exact_fields(degree % 4, count, seed=count)) for degree, count in enumerate(counts)]
    with one_blas_thread():
        for sample, together in zip(samples, fit_covariances(samples), strict=True):
            alone = fit_covariances([sample])[0]
            assert np.array_equal(together.kernels, alone.kernels)
            assert np.array_equal(together.probabilities, alone.probabilities)


def test_a_ccd_that_cannot_be_modelled_leaves_the_others():
    rng = np.random.default_rng(3)
    places = rng.uniform(0.0, 1.0, (12, 2))
    ccds = [CcdStars(gaussian_stars(rng, 12), places, extent=EXTENT) for _ in range(3)]
    ccds[1] = ccds[1]._replace(stamps=1e-6 * ccds[1].stamps)
    first, second, third = fit_stars(PsfModel, ccds, Recipe.of(), gain=1.0, clipping=None)
    assert isinstance(second, DomainError)
    assert "electrons" in str(second)
    for model, ccd in ((first, ccds[0]), (third, ccds[2])):
        alone = PsfModel.fit(ccd.stamps, places, extent=EXTENT, clipping=None)
        assert np.array_equal(model.at(places), alone.at(places))


def gaussian_stars(rng, count):
    """Round stars of 1e5 electrons on stamps of 15 pixels, with noise."""
    y, x = np.indices((15, 15)) - 7.0
    profile = np.exp(-0.5 * (x * x + y * y) / 2.0**2)
    return 1e5 * profile / profile.sum() + rng.normal(0.0, 10.0, (count, 15, 15))


def process_probability(covariances):
    return sum(p for name, p in covariances.forms().items() if name.endswith("process"))


def test_a_process_is_found_where_there_is_one():
    rng = np.random.default_rng(4)
    points = rng.uniform(-1.0, 1.0, (80, 2))
    terms, noise = design_matrix(points, EXTENT, 4), np.full((80, 3), 1e-4)
    distance = np.hypot(*np.moveaxis(points[:, None] - points, -1, 0))
    rough = np.linalg.cholesky(np.exp(-distance / 0.5)) @ rng.normal(size=(80, 3))
    smooth = terms[:, :6] @ rng.normal(size=(6, 3)) + 1e-2 * rng.normal(size=(80, 3))
    with one_blas_thread():
        covariances, of_smooth = fit_covariances(
            [ShapeSample(points, numbers, noise, terms) for numbers in (smooth + 5e-2 * rough, smooth)]
        )
        # 1e-2 of noise is the unit; the process drawn has a variance of 25.
        assert 8.0 < covariances.kernel[0] < 80.0
        assert process_probability(covariances) > 0.999
        assert process_probability(of_smooth) < 0.5


@pytest.mark.parametrize("process", [True, False])
def test_the_slope_of_the_posterior_is_its_change(process):
    rng = np.random.default_rng(5)
    points = rng.uniform(-1.0, 1.0, (25, 2))
    distance = np.hypot(*np.moveaxis(points[:, None] - points, -1, 0))
    terms = design_matrix(points, EXTENT, 4)
    numbers, noise = 3.0 * rng.normal(size=(25, 3)), rng.uniform(0.1, 2.0, 25)
    posterior = Posterior.of([StarNumbers(distance, numbers, noise, terms)], np.zeros(7), np.full(7, 2.0))
    at, present = rng.normal(size=7), np.array([process, process, True, True, True, False, True])
    both = np.zeros(2, dtype=int)
    value, slope, curvature, information = (
        each[0] for each in vars(posterior.negative_log_posterior(at[None], present[None], both[:1])).values()
    )

    def covariance_at(logarithms):
        variance, length, floor, *trend = np.where(present, np.exp(logarithms), 0.0)
        process_part = variance * np.exp(-distance / length) if process else 0.0
        trend_part = terms @ np.diag(np.repeat([1e4, *trend], [1, 2, 3, 4, 5])) @ terms.T
        return np.diag(noise + floor) + process_part + trend_part

    covariance_matrix = covariance_at(at)
    likelihood = 1.5 * np.linalg.slogdet(covariance_matrix)[1]
    likelihood += 0.5 * np.sum(numbers * np.linalg.solve(covariance_matrix, numbers))
    assert value == pytest.approx(likelihood + 0.5 * ((at[present] / 2.0) ** 2).sum(), rel=1e-10)
    for column in range(7):
        step = np.eye(7)[column] * 1e-5
        around = posterior.negative_log_posterior(np.stack([at + step, at - step]), np.stack([present] * 2), both)
        above, below = around.value
        # Rounding of values near 100, over the step.
        assert slope[column] == pytest.approx((above - below) / 2e-5, abs=1e-7 * abs(value))
        change = (around.slope[0] - around.slope[1]) / 2e-5
        np.testing.assert_allclose(curvature[column], change, atol=1e-6 * np.abs(curvature).max())
    # Fisher's information of Gaussian numbers: half the trace of C^-1 dC C^-1 dC' for each of three.
    changes = [(covariance_at(at + step) - covariance_at(at - step)) / 2e-5 for step in 1e-5 * np.eye(7)]
    relative = np.linalg.solve(covariance_matrix, np.stack(changes))
    expected = 1.5 * np.einsum("aij,bji->ab", relative, relative) + np.diag(np.where(present, 0.25, 0.0))
    np.testing.assert_allclose(information, expected, atol=1e-6 * np.abs(expected).max())


@pytest.fixture(scope="module")
def fitted():
    stars, places, _, elsewhere = field(5, 30, 1.0)
    return PsfModel.fit(stars, places, **OPTIONS), stars, elsewhere


def test_shape_numbers_have_the_mean_trend_and_process_of_large_gaussians(fitted):
    model, _, elsewhere = fitted
    filters = model.interpolation.fields.filters
    numbers = model.coefficients @ filters.T
    covariances = model.interpolation.covariances
    assert len(covariances.kernels) > 1
    assert covariances.probabilities.sum() == pytest.approx(1.0, abs=1e-12)
    at_stars, there = (design_matrix(p, EXTENT, 4) for p in (model.positions, elsewhere))
    expected, alone = np.zeros((len(elsewhere), len(filters))), {0: 0.0, 17: 0.0}
    for (variance, length, floor, *trend), probability in covariances.weighted():
        prior = np.diag(np.repeat([1e4, *trend], [1, 2, 3, 4, 5]))

        def signal(a, b, terms_a, terms_b, variance=variance, length=length, prior=prior):
            distance = np.hypot(*np.moveaxis(a[:, None] - b, -1, 0))
            return variance * np.exp(-distance / length) + terms_a @ prior @ terms_b.T

        of_stars = signal(model.positions, model.positions, at_stars, at_stars) + np.diag(1.0 / model.weights + floor)
        between = signal(elsewhere, model.positions, there, at_stars)
        expected += probability * between @ np.linalg.solve(of_stars, numbers)
        # Each star predicted from the others, by solving without it.
        for star in alone:
            others = np.delete(np.arange(30), star)
            weights = np.linalg.solve(of_stars[np.ix_(others, others)], of_stars[others, star])
            alone[star] = alone[star] + probability * weights @ numbers[others]
    np.testing.assert_allclose(model.amplitudes(elsewhere) @ filters.T, expected, atol=1e-9 * np.abs(expected).max())
    for star, prediction in alone.items():
        left_out = model.leave_one_out()[star] - model.mean
        np.testing.assert_allclose(filters @ left_out.ravel(), prediction, atol=1e-8 * np.abs(expected).max())


def test_places_do_not_depend_on_their_batch_and_files_keep_every_digit(fitted, tmp_path):
    model, _, elsewhere = fitted
    together = model.at(elsewhere)
    assert np.array_equal(model.at(elsewhere[7])[0], together[7])
    model.write(tmp_path / "psf.fits")
    again = PsfModel.read(tmp_path / "psf.fits")
    assert again.smoothness == model.smoothness
    assert np.array_equal(again.at(elsewhere), together)
    assert np.array_equal(again.leave_one_out(), model.leave_one_out())
    np.testing.assert_allclose(together.sum(axis=(1, 2)), 1.0, atol=1e-12)


def test_shape_numbers_are_the_changes_of_the_shape():
    mean = psfs([0.0], [0.0], [1.5])[0]
    others = psfs([1e-4, 0.0, 0.0], [0.0, 1e-4, 0.0], [1.5, 1.5, 1.5 * 1.0002])
    numbers, _ = kriging.shape_numbers(mean, (others - mean).reshape(3, -1))
    # Each is large for its own kind of change, and zero for the others.
    assert np.abs(numbers - np.diag(np.diagonal(numbers))).max() < 2e-3 * np.abs(numbers).max()
    assert (np.diagonal(numbers) > 2e-5).all()


@pytest.mark.parametrize("gain", [1.0, 2.5])
def test_the_noise_of_a_star_is_that_of_many_draws(gain):
    rng = np.random.default_rng(1)
    image, electrons = psfs([0.0], [0.0], [1.5])[0], np.geomspace(3e3, 3e6, 12)
    truth = electrons[:, None, None] * image / gain

    def draw():
        return truth + rng.normal(size=truth.shape) * np.sqrt(22.0**2 + electrons[:, None, None] * image) / gain

    def relative(images):
        return (images * gain / electrons[:, None, None] - image).reshape(12, -1)

    filters = kriging.shape_numbers(image, relative(truth))[1]
    scatter = np.std([kriging.shape_numbers(image, relative(draw()))[0] for _ in range(400)], axis=0)
    stated = np.mean([kriging.star_noise(electrons, relative(draw()), image, filters) for _ in range(20)], 0)
    np.testing.assert_allclose(np.sqrt(stated), scatter, rtol=0.12)


def test_bright_stars_do_not_have_the_noise_of_faint_ones():
    # The deviations are from a mean of equal weights, which the faint stars make noisy.
    rng = np.random.default_rng(8)
    image, electrons = psfs([0.0], [0.0], [1.5])[0], np.geomspace(3e3, 3e6, 24)
    stars = electrons[:, None, None] * image
    stars = stars + rng.normal(size=stars.shape) * np.sqrt(22.0**2 + stars)
    unit = (stars / electrons[:, None, None]).reshape(24, -1)
    filters = kriging.shape_numbers(image, unit)[1]
    stated = kriging.star_noise(electrons, unit - unit.mean(axis=0), image, filters)
    squares = (filters**2).sum(axis=1), filters**2 @ image.ravel()
    true = (22.0 / electrons[:, None]) ** 2 * squares[0] + squares[1] / electrons[:, None]
    # The sky of one stamp is good to a tenth (it was 20 times too large for the brightest).
    np.testing.assert_allclose(stated, true, rtol=0.4)
    assert abs(np.log(stated / true).mean()) < 0.1


def test_few_stars_noise_free_ones_and_equal_ones_are_no_trouble():
    stars, places, truth, elsewhere = field(3, 4, 0.0)
    assert error(PsfModel.fit(stars, places, **OPTIONS).at(elsewhere), truth) < 0.03
    model = PsfModel.fit(truth, elsewhere, **OPTIONS, gain=None, clipping=None)
    assert error(model.at(model.positions), truth) < 1e-4
    same = PsfModel.fit(np.repeat(truth[:1], 12, axis=0), elsewhere[:12], **OPTIONS, gain=None)
    np.testing.assert_allclose(same.at(elsewhere[20:22]), np.repeat(truth[:1], 2, axis=0), atol=1e-12)


@pytest.mark.parametrize("count", [40, 160])
@pytest.mark.parametrize("electrons", [1e3, 1e5])
def test_noise_free_stars_have_no_more_than_the_changes_of_their_psf(count, electrons):
    """Their photon noise is counted, though not there. Stars near a line of shapes show nothing across it."""
    points = np.random.default_rng(1).uniform(-1.0, 1.0, (count + 100, 2))
    height = 0.003 * points[:, 0] + 0.004 * ((points**2).sum(axis=1) - 0.6)  # as of a focus
    images = psfs(0.8 * height, 0.3 * height, 1.5 * (1.0 + height))
    model = PsfModel.fit(electrons * images[:count], points[:count], **OPTIONS)
    truth = images[count:]
    assert np.abs(model.at(points[count:]) - truth).max() < 1.5 * np.abs(truth - truth.mean(axis=0)).max()


def test_stamps_that_are_not_in_electrons_are_noticed():
    stars, places, _, _ = field(3, 12, 0.0)
    unit = stars / stars.sum(axis=(1, 2), keepdims=True)
    with pytest.raises(DomainError, match=r"gain = 1: the middle star has 1 electrons; expected stamps in electrons"):
        PsfModel.fit(unit, places, **OPTIONS)
    for gain in (0.0, -1.0, np.nan):
        with pytest.raises(ConfigError, match=r"gain = .*: expected a number of electrons above 0"):
            PsfModel.fit(stars, places, **OPTIONS, gain=gain)
    with pytest.raises(ConfigError, match="weights: expected none with interpolation = 'kriging'"):
        PsfModel.fit(stars, places, **OPTIONS, weights=np.ones(12))
    with pytest.raises(DomainError, match="expected places apart for interpolation = 'kriging'"):
        PsfModel.fit(stars, np.vstack([places[:11], places[:1]]), **OPTIONS)


def test_noise_of_faint_stars_is_no_part_of_their_core():
    """Outer pixels of their mean, a tenth of the peak by noise, made the weight of its shapes that of the stamp."""
    y, x = np.indices((49, 49)) - 24
    truth = (1.0 + (x**2 + y**2) / 9.0) ** -3.0
    expected = kriging.core_variance(truth)
    for seed in range(5):
        noisy = truth + 0.06 * np.random.default_rng(seed).normal(size=truth.shape)
        assert 0.4 * expected < kriging.core_variance(noisy) < 1.5 * expected
    # A star of one pixel has a weight too.
    assert kriging.core_variance(np.where(x**2 + y**2 > 0, 0.0, 1.0)) > 0.0


def test_too_many_stars_for_the_memory_are_one_clear_line(monkeypatch):
    rng = np.random.default_rng(3)
    places = rng.uniform(-1.0, 1.0, (40, 2))
    monkeypatch.setattr("pachon.core.memory.available_bytes", lambda: 64 * 40**2 - 1)
    message = r"kriging of 40 stars \(recipe 'paper' has no matrix of them\): needs about 0.1 MB of memory, 0.1 MB are"
    with pytest.raises(DomainError, match=message):
        PsfModel.fit(gaussian_stars(rng, 40), places, extent=EXTENT)
