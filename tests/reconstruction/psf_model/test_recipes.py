"""Recipes: the rule of their keys, files of earlier versions, stars left out by brute force, a new interpolation."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from pachon.core.errors import ConfigError, ProductError
from pachon.reconstruction.psf_model import file
from pachon.reconstruction.psf_model.interpolation import FittedInterpolation, Interpolation
from pachon.reconstruction.psf_model.kriging import Kriging
from pachon.reconstruction.psf_model.model import PsfModel
from pachon.reconstruction.psf_model.pixels import Pixels
from pachon.reconstruction.psf_model.polynomial import design_matrix, mapped
from pachon.reconstruction.psf_model.polynomial_fit import Polynomial
from pachon.reconstruction.psf_model.principal_components import PrincipalComponents
from pachon.reconstruction.psf_model.recipe import BASES, DEFAULT, INTERPOLATIONS, RECIPES, WEIGHTS, Recipe
from pachon.reconstruction.psf_model.shapelets import Shapelets

#: Written by the version before recipes, with images at three places and stars left out beside them (README there).
FILES = sorted((Path(__file__).parents[2] / "data/psf_models").glob("*.fits"))


def stars(count=16, seed=2):
    """Stars in electrons, and places."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(-1.0, 1.0, (count, 2))
    y, x = np.mgrid[:11, :11] - 5
    width = 1.5 + 0.1 * places[:, 0, None, None] + 0.1 * np.sin(3.0 * places[:, 1, None, None])
    images = np.exp(-0.5 * (x**2 + y**2) / width**2)
    images *= 2e4 * 10 ** rng.uniform(0.0, 1.0, (count, 1, 1)) / images.sum(axis=(1, 2), keepdims=True)
    return images + rng.normal(size=images.shape) * np.sqrt(100.0 + images), places


def test_one_default_and_each_key_changes_itself():
    assert RECIPES["kriging"] == DEFAULT == Recipe(Pixels(), Kriging(4), "equal")
    assert RECIPES["paper"] == Recipe(PrincipalComponents(20), Polynomial(3), "equal")
    for name, recipe in RECIPES.items():
        keys = recipe.keys()
        stated = {key: value for key, value in keys.items() if value is not None}
        assert Recipe.of(name, **stated) == Recipe.of(name) == recipe
        for key, value in stated.items():
            assert Recipe.of(name, **{key: value}) == recipe
        for basis in set(BASES) - {keys["basis"]}:
            assert recipe.changed(basis=basis) == replace(recipe, basis=BASES[basis]())
        for kind in set(INTERPOLATIONS) - {keys["interpolation"]}:
            assert recipe.changed(interpolation=kind) == replace(recipe, interpolation=INTERPOLATIONS[kind]())
        assert recipe.changed(order=1) == replace(recipe, interpolation=type(recipe.interpolation)(1))
    for weights in WEIGHTS:
        assert RECIPES["paper"].changed(weights=weights) == replace(RECIPES["paper"], weights=weights)
    assert RECIPES["paper"].changed(basis=Shapelets(6, scale=1.5)).keys()["scale"] == 1.5


def test_options_without_effect_are_refused():
    for keys, match in (
        ({"weights": "snr"}, "weights = snr: expected equal with interpolation = kriging"),
        ({"weights": "bright"}, "weights = 'bright': expected one of equal, snr"),
        ({"basis": "pixels", "n_components": 3}, "n_components = 3: expected None with basis = 'pixels'"),
        ({"scale": 1.0}, "scale = 1.0: .* for shapelets only"),
        ({"interpolation": "gp"}, "'gp': expected one of polynomial, kriging, which replaced gp"),
        ({"recipe": "mine"}, "recipe = 'mine': expected one of kriging, paper"),
    ):
        with pytest.raises(ConfigError, match=match):
            Recipe.of(**keys)
    with pytest.raises(ConfigError, match="weights = 'snr': expected equal, noise"):
        PsfModel.fit(*stars(), recipe=RECIPES["paper"].changed(n_components=3, order=1, weights="snr"))


def test_the_call_of_python_is_the_recipe():
    images, places = stars(24)
    by_default = PsfModel.fit(images, places)
    for options in ({"recipe": "kriging"}, {"basis": "pixels"}, {"interpolation": "kriging"}, {"order": 4}):
        assert PsfModel.fit(images, places, **options).at(places).tobytes() == by_default.at(places).tobytes()
    paper = PsfModel.fit(images, places, recipe="paper")
    assert PsfModel.fit(images, places, n_components=20, order=3).at(places).tobytes() == paper.at(places).tobytes()
    assert (PsfModel.fit(images, places, basis="pca").interpolation.name, paper.interpolation.name) == (
        "kriging",
        "polynomial",
    )


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_files_of_earlier_versions_are_read_as_they_were(path, tmp_path, monkeypatch):
    model, expected = PsfModel.read(path), np.load(path.with_suffix(".npz"))
    basis, interpolation = path.stem.split("_")
    assert (model.basis.name, model.interpolation.name) == (basis, interpolation.replace("weights", "polynomial"))
    # Exponentials differ by their last bit between processors: by epsilon times the sum of what they multiply, and the
    # image by its own rounding. All else is the same to the bit.
    atol = 0.0
    if interpolation == "gp":
        weights = np.abs(model.interpolation.kernels[:, 0] * model.interpolation.alpha).sum(axis=0)
        terms = np.tensordot(weights, np.abs(model.basis.components), axes=1)
        atol = np.finfo(float).eps * (terms + np.abs(expected["images"])).max()
    np.testing.assert_allclose(model.at(expected["places"]), expected["images"], rtol=0.0, atol=atol)
    # Rounding of the peak, 0.1. Kriging solves with the covariance, and the rounding of solvers (LAPACK's differ by its
    # version) grows by its condition number, 2e5: 4e-12 at most.
    peak, tolerance = np.abs(expected["left_out"]).max(), 1e-15
    if interpolation == "kriging":
        tolerance = np.finfo(float).eps * np.linalg.cond(covariance_of(model)).max() * peak
        assert tolerance < 1e-10 * peak
    np.testing.assert_allclose(model.leave_one_out(), expected["left_out"], rtol=0.0, atol=tolerance)
    # The file is the same again, but for the version that wrote it.
    monkeypatch.setattr("pachon.reconstruction.psf_model.model.CREATOR", fits.getheader(path).cards["CREATOR"])
    model.write(tmp_path / "again.fits")
    assert (tmp_path / "again.fits").read_bytes() == path.read_bytes()


def covariance_of(model):
    """The covariance of the stars' coefficients, [k, n, n], by the formulas of each kernel, noise included."""
    interpolation, points = model.interpolation, mapped(model.positions, model.extent)
    distance = np.hypot(*np.moveaxis(points[:, None] - points, -1, 0))
    noise = np.diag(1.0 / interpolation.weights)
    if interpolation.name == "gp":
        return np.stack(
            [v * np.exp(-0.5 * (distance / s) ** 2) + (n or 1.0) * noise for v, s, n in interpolation.kernels]
        )
    variance, length, floor, *trend = interpolation.kernel
    terms = design_matrix(model.positions, model.extent, model.order)
    prior = np.diag(np.repeat([1e4, *trend], np.arange(1, len(trend) + 2)))
    whole = variance * np.exp(-distance / length) + terms @ prior @ terms.T + noise + floor * np.eye(len(points))
    return np.repeat(whole[None], model.n_components, axis=0)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_left_out_is_leaving_out(path):
    """Each star's coefficients from those of the others, by solving without it."""
    model = PsfModel.read(path)
    terms, coefficients = design_matrix(model.positions, model.extent, model.order), model.coefficients
    residuals = model.interpolation.leave_one_out(coefficients)
    for star in (0, 9):
        others = np.arange(model.n_stars) != star
        if model.interpolation.name == "polynomial":
            root = np.sqrt(np.ones(model.n_stars) if model.weights is None else model.weights)[:, None]
            solution = np.linalg.lstsq((root * terms)[others], (root * coefficients)[others], rcond=None)[0]
            predicted = terms[star] @ solution
        else:
            # Universal kriging: unbiased for the trend of a file's process, with Lagrange multipliers; simple kriging
            # where the covariance holds the trend.
            trend = terms if model.interpolation.name == "gp" else terms[:, :0]
            n_terms, predicted = trend.shape[1], np.empty(model.n_components)
            for k, covariance in enumerate(covariance_of(model)):
                system = np.block(
                    [[covariance[np.ix_(others, others)], trend[others]], [trend[others].T, np.zeros((n_terms,) * 2)]]
                )
                weights = np.linalg.solve(system, np.concatenate([covariance[others, star], trend[star]]))
                predicted[k] = weights[: others.sum()] @ coefficients[others, k]
        scale = np.abs(coefficients).max()
        np.testing.assert_allclose(residuals[star], coefficients[star] - predicted, rtol=0.0, atol=1e-9 * scale)


@dataclass(frozen=True)
class Nearest(Interpolation):
    """The coefficients of the nearest star."""

    name = "nearest"
    label = "nearest star"
    words = "the nearest star, without "
    needs_noise = False

    def fit(self, stars):
        return FittedNearest(
            stars.positions, stars.extent, 0, np.zeros((1, stars.coefficients.shape[1])), None, stars.coefficients
        )


@dataclass(frozen=True, eq=False)
class FittedNearest(FittedInterpolation, kind=Nearest):
    """The stars."""

    coefficients: np.ndarray

    def at(self, positions):
        squares = ((np.atleast_2d(positions)[:, None] - self.positions) ** 2).sum(axis=2)
        return self.coefficients[squares.argmin(axis=1)]

    def leave_one_out(self, coefficients):
        squares = ((self.positions[:, None] - self.positions) ** 2).sum(axis=2)
        np.fill_diagonal(squares, np.inf)
        return coefficients - coefficients[squares.argmin(axis=1)]

    @classmethod
    def _fields_of(cls, parts):
        return {"coefficients": parts.columns["coefficient"].reshape(len(parts.columns["position"]), -1)}


def test_an_interpolation_is_a_class(monkeypatch, tmp_path):
    """Fit, files, stars left out and bases follow from one class and its entry in the table."""
    images, places = stars()
    unit = images / images.sum(axis=(1, 2), keepdims=True)
    path = tmp_path / "psf.fits"
    PsfModel.fit(images, places, interpolation=Nearest(), clipping=None).write(path)
    with pytest.raises(ProductError, match="INTERP = 'nearest', which is none"):
        PsfModel.read(path)
    monkeypatch.setitem(INTERPOLATIONS, "nearest", Nearest)
    monkeypatch.setattr(file, "FITTED_INTERPOLATIONS", (*file.FITTED_INTERPOLATIONS, FittedNearest))
    model = PsfModel.fit(images, places, interpolation="nearest", clipping=None)
    np.testing.assert_allclose(model.at(places), unit, atol=1e-15)
    squares = ((places[3] - places) ** 2).sum(axis=1)
    np.testing.assert_allclose(model.leave_one_out()[3], unit[np.argsort(squares)[1]], atol=1e-15)
    for basis in ("pixels", "pca", "shapelets"):
        options = {} if basis == "pixels" else {"n_components": 4}
        model = PsfModel.fit(images, places, basis=basis, interpolation="nearest", **options)
        model.write(path)
        assert PsfModel.read(path).at(places).tobytes() == model.at(places).tobytes()
