import numpy as np

from pachon.reconstruction.psf_model.outliers import find_outliers, restore_predicted

SIZE = 31


def stars(count=40, noise=2e-3, seed=0):
    """Round Gaussian stars of unit sum, flattened, with equal noise."""
    y, x = np.mgrid[:SIZE, :SIZE] - SIZE // 2
    image = np.exp(-0.5 * (x**2 + y**2) / 1.6**2)
    rng = np.random.default_rng(seed)
    return image.ravel() / image.sum() + rng.normal(0.0, noise, (count, SIZE * SIZE))


def test_nothing_to_find():
    images = stars() * np.random.default_rng(1).uniform(1e3, 1e5, (40, 1))
    # 38 440 pixels of Gaussian noise hold 0.02 beyond five sigma.
    assert find_outliers(images, 5.0, 20).sum() == 0
    assert find_outliers(stars(noise=0.0), 5.0, 20).sum() == 0


def test_every_bright_pixel_is_found_and_no_other():
    images = stars()
    rng = np.random.default_rng(2)
    planted = np.zeros(images.shape, dtype=bool)
    planted[rng.integers(0, 40, 60), rng.integers(0, SIZE * SIZE, 60)] = True
    images[planted] += rng.choice([-1.0, 1.0], planted.sum()) * rng.uniform(0.05, 2.0, planted.sum())
    np.testing.assert_array_equal(find_outliers(images, 5.0, 20), planted)


def test_a_hit_in_the_core_does_not_condemn_the_star():
    # One pixel twice as bright as the whole star: the star's sum is three times its flux.
    images = stars()
    core = SIZE * SIZE // 2
    images[5, core] += 2.0
    found = find_outliers(images, 5.0, 20)
    assert found[5, core]
    assert found.sum() == 1


def test_predicted_deviations_are_restored_and_cosmic_rays_are_not():
    rng = np.random.default_rng(3)
    x = rng.uniform(-1.0, 1.0, 30)
    terms = np.stack([np.ones(30), x, x**2], axis=1)
    mean = np.full(50, 0.02)
    values = mean + np.outer(x**2 - 1 / 3, rng.normal(0.0, 0.01, 50))
    rejected = np.zeros(values.shape, dtype=bool)
    corner = int(np.argmax(np.abs(x)))
    rejected[corner, 10:14] = True
    assert not restore_predicted(values, mean, rejected, terms).any()
    struck = (corner + 1) % 30
    values[struck, 30] += 0.5
    rejected[struck, 30] = True
    expected = np.zeros_like(rejected)
    expected[struck, 30] = True
    np.testing.assert_array_equal(restore_predicted(values, mean, rejected, terms), expected)
