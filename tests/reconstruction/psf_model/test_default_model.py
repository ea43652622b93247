"""The default PSF model beside polynomials of order 0 to 2, where no star is, on fields whose truth is known.

The polynomials have weights by the noise of each star. Ratios are of rms errors over all fields of a kind and number of
stars, to the best of the three there, found with the truth.
"""

import numpy as np
import pytest

from pachon.measure.shapes import measure_shapes
from pachon.reconstruction.psf_model.model import PsfModel
from pachon.reconstruction.psf_model.pixels import Pixels
from pachon.reconstruction.psf_model.polynomial import design_matrix
from pachon.reconstruction.psf_model.polynomial_fit import Polynomial
from pachon.reconstruction.psf_model.recipe import Recipe

SIZE = 21
EXTENT = (-1.0, 1.0, -1.0, 1.0)
#: Order of the polynomials and rms of the process, over the coefficients of the polynomials.
KINDS = {"constant": (0, 0.0), "linear": (1, 0.0), "quadratic": (2, 0.0), "turbulent": (0, 2.0)}
POLYNOMIALS = {f"order {n}": Recipe(Pixels(), Polynomial(n), "noise") for n in (0, 1, 2)}


def psfs(e1, e2, width):
    """Elliptical Moffat profiles of unit sum, (1 + r^2)^-3, of rms width about `width` pixels."""
    y, x = np.indices((SIZE, SIZE)) - SIZE // 2
    e1, e2, width = (np.asarray(v)[:, None, None] for v in (e1, e2, width))
    square = (x**2 * (1 - 2 * e1) + y**2 * (1 + 2 * e1) - 4 * e2 * x * y) / (2.2 * width) ** 2
    images = (1.0 + square) ** -3
    return images / images.sum(axis=(1, 2), keepdims=True)


def field(kind, count, seed, *, correlated=False, holdouts=100):
    """Stars in electrons with sky and photon noise, their places, and noise-free PSFs elsewhere."""
    order, rough = KINDS[kind]
    rng = np.random.default_rng([seed, count, [*KINDS].index(kind)])
    points = rng.uniform(-1.0, 1.0, (count + holdouts, 2))
    distance = np.hypot(*np.moveaxis(points[:, None] - points, -1, 0))
    process = np.linalg.cholesky(np.exp(-2.0 * distance) + 1e-9 * np.eye(len(points)))
    terms = design_matrix(points, EXTENT, order)
    e1, e2, growth = (
        0.006 * (terms @ rng.normal(size=terms.shape[1]) + rough * process @ rng.normal(size=len(points)))
        for _ in range(3)
    )
    images = psfs(0.02 + e1, e2, 1.5 * (1.0 + growth))
    electrons = 4000.0 * 10.0 ** rng.uniform(0.0, 2.0, count)
    stars = electrons[:, None, None] * images[:count]
    noise = rng.normal(size=stars.shape)
    if correlated:  # by half with the neighbour at the left and above, as after resampling
        noise = (noise + 0.5 * np.roll(noise, 1, axis=1) + 0.5 * np.roll(noise, 1, axis=2)) / np.sqrt(1.5)
    return stars + noise * np.sqrt(22.0**2 + stars), points[:count], images[count:], points[count:]


def squares(images, truth):
    """Mean squares of the errors of a component of e and of the relative size."""
    model, true = (measure_shapes(i, 0.2, 0.7) for i in (images, truth))
    e = np.nanmean([(model.e1 - true.e1) ** 2, (model.e2 - true.e2) ** 2])
    return np.array([e, np.nanmean((model.size / true.size - 1.0) ** 2)])


def ratios(kind, count, seeds, **options):
    """Ratio of the rms errors of the default, of e and of size, to the best of the polynomials."""
    errors = {name: np.zeros(2) for name in ("default", *POLYNOMIALS)}
    for seed in seeds:
        stars, places, truth, elsewhere = field(kind, count, seed, **options)
        for name in errors:
            recipe = POLYNOMIALS.get(name)
            if recipe is None or recipe.interpolation.least_stars < count:
                model = PsfModel.fit(stars, places, recipe=recipe, extent=EXTENT)
                errors[name] += squares(model.at(elsewhere), truth)
    best = np.min([errors[name] for name in POLYNOMIALS if errors[name].all()], axis=0)
    return np.sqrt(errors["default"] / best)


@pytest.mark.long
@pytest.mark.parametrize("kind", ["constant", "turbulent"])
def test_a_constant_is_no_worse_and_turbulence_much_better(kind):
    # Eight fields are good to a tenth; without a constant among its forms kriging is at 1.2 and more.
    assert (ratios(kind, 20, range(8)) < {"constant": 1.1, "turbulent": 1.0}[kind]).all()


@pytest.mark.slow
@pytest.mark.parametrize("correlated", [False, True])
@pytest.mark.parametrize("count", [10, 20, 40, 80, 200])
@pytest.mark.parametrize("kind", [*KINDS])
def test_the_default_is_within_a_twentieth_of_the_best(kind, count, correlated):
    # Sixty fields of ten stars, and forty of forty, are good to 0.03 only.
    seeds = range(100, 100 + {10: 240, 20: 120, 40: 120, 80: 30, 200: 20}[count])
    assert (ratios(kind, count, seeds, correlated=correlated) < 1.05).all()
