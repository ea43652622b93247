"""Defects, selection and the kinds of models of a configuration."""

import dataclasses

import numpy as np
import pytest

from pachon.core.errors import ConfigError, DomainError
from pachon.measure.shapes import measure_shapes
from pachon.measure.star_selection import StarFlag
from pachon.pipeline.config import ReconstructionConfig, with_options
from pachon.pipeline.defaults import with_paper_model
from pachon.pipeline.experiment import Experiment
from pachon.pipeline.simulate import ccd_model
from pachon.pipeline.simulate.ccd_exposure import expose_ccd, expose_centered
from pachon.pipeline.simulate.ccd_model import model_ccd
from pachon.pipeline.simulate.ccd_observation import CollectedStars, observe_ccd
from pachon.reconstruction.psf_model.checks import snr_weights
from pachon.reconstruction.psf_model.recipe import Recipe

NAME = "R22_S11"
N = 40


@pytest.fixture(scope="module")
def experiment(tiny):
    return Experiment.from_config(tiny(ccds=(NAME,), stars__observed=N))


@pytest.fixture(scope="module")
def exposure(experiment):
    return expose_ccd(experiment, NAME, threads=1)


@pytest.fixture(scope="module")
def plain(experiment, exposure):
    return model_ccd(experiment, exposure)


def configured(experiment, **options):
    """The experiment with other stars or another model; the PSFs of its stars do not depend on them."""
    return dataclasses.replace(
        experiment, config=Experiment.from_config(with_options(experiment.config, **options)).config
    )


def observed(experiment, exposure, electrons=2e5, **options):
    stars = exposure.observed
    chosen = configured(experiment, **options)
    return observe_ccd(chosen, CollectedStars(NAME, stars.image, stars.pixel_scale, np.full(N, electrons)), noisy=True)


def test_vignetting_dims_the_sky_as_it_does_stars(experiment, exposure):
    # It was that of the axis: at 0.75 deg of HSC the noise of 30 % more light than arrives.
    stars, found = exposure.observed, []
    for light in (1.0, 0.5):
        collected = CollectedStars(NAME, stars.image, stars.pixel_scale, np.full(N, 2e5), light)
        observation = observe_ccd(experiment, collected, noisy=True)
        rim = observation.images[:, [0, 1, -2, -1]] * 2e5
        found.append((observation.noise, rim.std()))
    (sky, noise), scatter = found[0]
    (dimmed, same), dimmed_scatter = found[1]
    assert (dimmed, same) == (pytest.approx(0.5 * sky), noise)
    # The light of the wings is a tenth of the variance of the dark sky.
    assert dimmed_scatter / scatter == pytest.approx(np.sqrt((dimmed + noise**2) / (sky + noise**2)), rel=0.05)


def test_without_defects_nothing_is_looked_for(plain):
    assert not plain.observed.defects.any()
    assert plain.observed.used.all()


def test_defects_spoil_as_many_stars_as_asked_and_leave_the_others(experiment, exposure):
    clean = observed(experiment, exposure)
    for options in ({"stars__neighbours": 0.25}, {"stars__cosmic_rays": 0.25}):
        defective = observed(experiment, exposure, **options)
        same = (defective.images == clean.images).all(axis=(1, 2))
        # Binomial: 10 +- 2.7 of 40, three standard deviations.
        assert 2 <= N - same.sum() <= 18
    # All have the same electrons, so that the peaks' order is that of their noise; a tenth of 40 is four.
    full = observed(experiment, exposure, stars__saturated=0.1)
    assert (full.images != clean.images).any(axis=(1, 2)).sum() == 4


def test_stars_with_defects_are_found_and_left_out(experiment, exposure):
    options = {"stars__neighbours": 0.15, "stars__cosmic_rays": 0.15, "stars__saturated": 0.1}
    clean, defective = observed(experiment, exposure), observed(experiment, exposure, **options)
    found = observed(experiment, exposure, reconstruction__flag_stars=True, **options)
    np.testing.assert_array_equal(found.images, defective.images)
    touched = (defective.images != clean.images).any(axis=(1, 2))
    # Stars of S/N over 200: the study of the selection found every such defect, and flagged 2 good stars of 640.
    assert np.array_equal(found.defects != 0, touched)
    assert ((found.defects & StarFlag.SATURATED) != 0).sum() == 4
    assert np.array_equal(found.used, ~touched)
    assert np.isnan(found.shapes.e1[touched]).all()
    np.testing.assert_array_equal(found.shapes.e1[~touched], clean.shapes.e1[~touched])
    # Who does not look uses them all.
    assert defective.used.sum() > found.used.sum()


def test_without_noise_there_are_no_defects(experiment, exposure):
    product = model_ccd(
        configured(experiment, stars__neighbours=1.0, reconstruction__flag_stars=True), exposure, noisy=False
    )
    assert product.observed.used.all()


def test_a_ccd_all_of_whose_stars_are_rejected_is_one_line(experiment, exposure):
    defects = {"stars__neighbours": 1.0, "stars__cosmic_rays": 1.0, "stars__snr_min": 200.0}
    chosen = configured(experiment, reconstruction__flag_stars=True, **defects)
    with pytest.raises(DomainError, match=r"^\d of 40 stars left \(\d+ neighbour.*\): expected at least 5$"):
        model_ccd(chosen, exposure)


@pytest.mark.parametrize(
    ("options", "basis", "components", "weights"),
    [
        ({"reconstruction__basis": "pixels", "reconstruction__components": None}, "pixels", 961, "equal"),
        ({"reconstruction__basis": "shapelets", "reconstruction__components": 12}, "shapelets", 12, "equal"),
        ({"reconstruction__weights": "snr"}, "pca", 4, "snr"),
        ({"reconstruction__weights": "softened"}, "pca", 4, "softened"),
        ({"reconstruction__interpolation": "kriging"}, "pca", 4, "equal"),
        (None, "pixels", 961, None),
    ],
)
def test_the_configuration_chooses_the_model(experiment, exposure, plain, options, basis, components, weights):
    config = experiment.config
    if options is None:
        # Nothing given but the polynomials of the noise-free PSFs.
        fit = ReconstructionConfig(truth_order=2)
        chosen = dataclasses.replace(
            experiment, config=Experiment.from_config(config.model_copy(update={"reconstruction": fit})).config
        )
    elif basis == "pixels":
        fit = config.reconstruction.model_copy(update={"components": None, "basis": "pixels"})
        chosen = dataclasses.replace(
            experiment, config=Experiment.from_config(config.model_copy(update={"reconstruction": fit})).config
        )
    else:
        chosen = configured(experiment, stars__truth=60, **options)
    product = model_ccd(chosen, exposure)
    model = product.model
    assert (model.basis.name, model.n_components, model.order) == (basis, components, 4 if options is None else 1)
    kriged = options is None or "reconstruction__interpolation" in options
    assert model.interpolation.kind.needs_noise == kriged
    if kriged:
        # A process weighs stars by their own noise, of which a bright one has less.
        assert np.corrcoef(np.log(model.weights), np.log(product.observed.snr))[0, 1] > 0.95
    else:
        expected = snr_weights(weights, product.observed.snr)
        assert (model.weights is None) == (expected is None)
        if expected is not None:
            np.testing.assert_array_equal(model.weights, expected)
    assert not np.array_equal(product.holdout.model_e1, plain.holdout.model_e1)
    # The noise-free PSFs are described by principal components all the same.
    assert product.noise_free_model.basis.name == "pca"
    # Another description of the same stars is about as good.
    assert np.isfinite(product.observed.leave_one_out_e1).all()
    assert np.std(product.holdout.residual_e1) < 3.0 * np.std(plain.holdout.residual_e1)


def test_kriging_has_the_noise_of_the_light_that_arrives(experiment, exposure, monkeypatch):
    """It had that of stars which nothing vignettes."""
    fit, fitted = ccd_model.fit_ccd_models, []

    def recorded(experiment, ccds, **options):
        fitted.extend(ccds)
        return fit(experiment, ccds, **options)

    monkeypatch.setattr(ccd_model, "fit_ccd_models", recorded)
    vignetted = dataclasses.replace(exposure.observed, lit_fraction=np.linspace(0.2, 0.9, N))
    kriged = configured(experiment, reconstruction__interpolation="kriging")
    stars = model_ccd(kriged, dataclasses.replace(exposure, observed=vignetted)).observed
    np.testing.assert_allclose(fitted[0].stamps.sum(axis=(1, 2)), stars.electrons[stars.used], rtol=1e-12)


def test_weights_are_between_equal_and_inverse_variance():
    snr = np.array([30.0, 100.0, 1000.0])
    assert snr_weights("equal", snr) is None
    np.testing.assert_allclose(snr_weights("snr", snr), [900.0, 1e4, 1e6])
    np.testing.assert_allclose(snr_weights("softened", snr), [900.0 / 1.09, 5e3, 1e4 / 1.01])
    with pytest.raises(ConfigError, match="expected one of equal, snr, softened"):
        snr_weights("none", snr)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"basis": "pixels", "components": 20}, "components = 20: expected null with basis = pixels"),
        ({"interpolation": "kriging", "weights": "snr"}, "weights = snr: expected equal with interpolation = kriging"),
        ({"interpolation": "gp"}, 'interpolation = "gp": expected one of polynomial, kriging, which replaced gp'),
        ({"recipe": "best"}, 'reconstruction.recipe = "best": expected one of kriging, paper'),
        ({"basis": "shapelet"}, 'reconstruction.basis = "shapelet": expected one of pca, pixels, shapelets'),
        ({"components": 40}, "components = 40: expected at most 39, one less than stars.observed = 40"),
    ],
)
def test_models_that_cannot_be_are_one_line(tiny, options, message):
    with pytest.raises(ConfigError, match=message):
        tiny(stars__observed=N, stars__truth=100, **{f"reconstruction__{key}": v for key, v in options.items()})


KEYS = ("basis", "components", "interpolation", "weights", "order")
KRIGING = {"basis": "pixels", "components": None, "interpolation": "kriging", "weights": "equal", "order": 4}
PAPER = {"basis": "pca", "components": 20, "interpolation": "polynomial", "weights": "equal", "order": 3}


@pytest.mark.parametrize(("recipe", "keys"), [(None, KRIGING), ("kriging", KRIGING), ("paper", PAPER)])
def test_stating_a_default_changes_no_byte_and_another_value_that_key_alone(tiny, recipe, keys):
    kind = type(tiny())

    def resolved(**given):
        given |= {} if recipe is None else {"recipe": recipe}
        return Experiment.from_config(kind(**{"reconstruction": given}))

    nothing = resolved()
    assert nothing.config.reconstruction.model_dump(include=set(KEYS)) == keys
    assert "recipe" not in nothing.config.as_dict()["reconstruction"]
    for key, value in keys.items():
        stated = resolved(**{key: value})
        assert stated.config.as_dict() == nothing.config.as_dict()
        assert stated.config_hash == nothing.config_hash
    others = {"order": 2, "basis": "shapelets", "interpolation": "polynomial" if keys is KRIGING else "kriging"}
    if keys is PAPER:
        others |= {"components": 7, "weights": "snr"}
    for key, value in others.items():
        # Another basis or interpolation has options of its own.
        follow = {"basis": {"components": 20}, "interpolation": {"order": 3 if keys is KRIGING else 4}}.get(key, {})
        changed = resolved(**{key: value}).config.reconstruction
        assert changed.model_dump(include=set(KEYS)) == {**keys, key: value, **follow}
        again = Experiment.from_config(kind(**{"reconstruction": changed.model_dump()})).config.reconstruction
        assert again == changed


def test_python_and_configuration_have_one_recipe(tiny):
    kind = type(tiny())
    for given in ({}, {"basis": "pca"}, {"order": 2}, {"interpolation": "polynomial"}, {"recipe": "paper", "order": 1}):
        assert Experiment.from_config(kind(**{"reconstruction": given})).config.reconstruction.psf_recipe() == (
            Recipe.of(**given)
        )


def test_components_which_pixels_lack_are_those_of_the_paper(tiny):
    found = Experiment.from_config(type(tiny())(**{"reconstruction": {"components": 7}})).config.reconstruction
    assert found.model_dump(include=set(KEYS)) == PAPER | {"components": 7}
    assert Recipe.of(n_components=7, order=2).keys() == Recipe.of("paper", n_components=7, order=2).keys()
    # With a basis of its own nothing else changes.
    assert Recipe.of(basis="pca", n_components=7).interpolation == Recipe.of().interpolation


def test_the_paper_takes_the_place_of_no_model_alone(tiny):
    kind = type(tiny())
    pinned = with_paper_model(kind())
    assert Experiment.from_config(pinned).config.reconstruction.model_dump(include=set(PAPER)) == PAPER
    chosen = kind(**{"reconstruction": {"interpolation": "polynomial"}})
    assert with_paper_model(chosen) is chosen
    # Twelve PSFs have eleven components about their mean.
    few = with_paper_model(kind(**{"stars": {"truth": 16, "observed": 12}}))
    assert Experiment.from_config(few).config.reconstruction.components == 11


def test_stars_drawn_again_on_the_centre_of_a_pixel(experiment, exposure):
    both = expose_ccd(experiment, NAME, centered=True, threads=1)
    assert np.array_equal(both.observed.image, exposure.observed.image)
    assert np.array_equal(both.observed.offset, exposure.observed.offset)
    assert np.array_equal(both.holdout.image, exposure.holdout.image)
    alone = expose_centered(experiment, exposure.positions.observed, threads=1)
    shapes = [measure_shapes(s.image, s.pixel_scale, experiment.weight_fwhm) for s in (both.centered, alone)]
    for name, tolerance in (("e1", 1e-6), ("e2", 1e-6), ("x", 1e-3), ("y", 1e-3)):
        np.testing.assert_allclose(*(getattr(s, name) for s in shapes), rtol=0, atol=tolerance)
    np.testing.assert_allclose(both.centered.image, alone.image, rtol=0, atol=5e-4 * alone.image.max())
