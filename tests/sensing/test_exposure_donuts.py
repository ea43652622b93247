"""Donuts of an exposure fitted together: pairs on both sides of focus, and the side of focus, on brute-force images."""

from dataclasses import replace

import numpy as np
import pytest
from donut_images import PIXEL, WAVELENGTH, donut, noisy

import pachon
from pachon.core.errors import DomainError

DEFOCUS, SKY = 1.5e-3, 500.0
FIELDS = np.deg2rad([(0.1, 0.2), (0.9, 0.7)])
OPTIONS = {"pixel_size": PIXEL, "sky_variance": SKY, "threads": 1}


@pytest.fixture(scope="module")
def true(focused):
    return focused.perturbed("M2", shift=(1.5e-4, 0.0, 0.0)).perturbed("Camera", shift=(0.0, 3e-4, 8e-6))


@pytest.fixture(scope="module")
def truth(focused, true):
    before, after = (
        pachon.wavefront_zernikes(t, FIELDS, WAVELENGTH, jmax=22).coefficients[:, 3:] for t in (focused, true)
    )
    return after - before


@pytest.fixture(scope="module")
def pairs(true):
    """Both stars behind focus, then in front of it."""
    sides = [true.perturbed("Detector", shift=(0.0, 0.0, side * DEFOCUS)) for side in (1.0, -1.0)]
    return [noisy(donut(tel, field), SKY, 7 * i) for i, tel in enumerate(sides) for field in FIELDS]


def of_sides(*signs):
    return pachon.DonutModel(
        detector=pachon.DonutDetector(pixel_size=PIXEL, defocus=DEFOCUS * np.array(signs)), neighbours=False
    )


def rss(values):
    return np.sqrt((values**2).sum(axis=-1))


@pytest.mark.slow
def test_pairs_share_one_wavefront(focused, pairs, truth):
    single, joint = (
        pachon.fit_donuts(
            focused, pairs, np.tile(FIELDS, (2, 1)), WAVELENGTH, model=of_sides(1, 1, -1, -1), fit=fit, **OPTIONS
        )
        for fit in (pachon.sensing.SingleDonuts(higher_order=10e-9), pachon.sensing.ExposureDonuts())
    )
    # Alone, a donut near the axis fits both sides of focus; together they tell.
    ambiguous = pachon.sensing.DonutFlag.AMBIGUOUS_SIDE
    assert [bool(flag & ambiguous) for flag in single.flags] == [True, False, True, False]
    assert not (joint.flags & ambiguous).any()
    assert joint.usable.all()
    # One wavefront of each star.
    np.testing.assert_allclose(joint.zernikes[:2], joint.zernikes[2:], atol=1e-15)
    expected = np.tile(truth, (2, 1))
    assert rss(rss(joint.zernikes - expected)) < 0.8 * rss(rss(single.zernikes - expected))
    assert (rss(joint.zernikes - expected) < 3.0 * rss(joint.errors)).all()
    sides = joint.exposure.sides
    assert sides.n_pairs == 2
    # Restated: differences of single fits of the same terms.
    assert sides.rms < 100e-9
    assert 0.2 < sides.chi2 < 3.0
    assert "both sides of focus (2 pairs) differ by" in joint.exposure.notices[0]
    np.testing.assert_allclose(joint.exposure.own, joint.exposure.total - joint.zernikes)


@pytest.mark.long
def test_a_wrong_side_is_said_by_all_donuts_together(focused, pairs):
    """The star beyond 0.8 degrees knows the side; the one near the axis would fit either."""
    behind = {"images": pairs[:2], "fields": FIELDS, "wavelength": WAVELENGTH, "model": of_sides(-1, -1)}
    wrong = pachon.sensing.DonutFlag.DEFOCUS_SIGN
    alone = pachon.fit_donuts(focused, fit=pachon.sensing.SingleDonuts(), **behind, **OPTIONS)
    assert alone.flags[0] & pachon.sensing.DonutFlag.AMBIGUOUS_SIDE
    assert alone.usable.tolist() == [True, False]
    assert alone.flags[1] == wrong
    together = pachon.fit_donuts(focused, fit=pachon.sensing.ExposureDonuts(), **behind, **OPTIONS)
    assert together.flags.tolist() == [wrong, wrong]
    assert np.isnan(together.zernikes).all()


@pytest.mark.long
def test_fits_of_shared_unknowns_decide_on_the_side_too(focused, pairs):
    freedoms = pachon.load_degrees_of_freedom("lsst").select(["M2_dx", "M2_dy", "M2_dz"])
    of_one_side = {"images": pairs[:2], "fields": FIELDS, "wavelength": WAVELENGTH}
    for fit in (pachon.sensing.FieldTerms([1]), pachon.sensing.TelescopeFreedoms(freedoms)):
        right = pachon.fit_donuts(focused, model=of_sides(1, 1), fit=fit, **of_one_side, **OPTIONS)
        assert not (right.flags & pachon.sensing.DonutFlag.AMBIGUOUS_SIDE).any()
        with pytest.raises(pachon.errors.DomainError, match="defocus sign"):
            pachon.fit_donuts(focused, model=of_sides(-1, -1), fit=fit, **of_one_side, **OPTIONS)


def test_one_donut_tells_degrees_of_freedom(focused, pairs):
    """Of a single donut there were none, without a word."""
    freedoms = pachon.load_degrees_of_freedom("lsst").select(["M2_dx", "M2_dy"])
    fit = pachon.fit_donuts(
        focused,
        pairs[:1],
        FIELDS[:1],
        WAVELENGTH,
        model=replace(of_sides(1), diffraction=False),
        fit=pachon.sensing.ExposureDonuts(freedoms=freedoms),
        **OPTIONS,
    )
    estimate = fit.degrees_of_freedom
    assert (estimate.errors < estimate.prior).all()
    assert np.isfinite(fit.zernikes).all()


class Refined(pachon.sensing.ExposureDonuts):
    """Fit that is always refined."""

    def refined(self, instrument, stars, fitted):
        return instrument


@pytest.mark.long
def test_a_refinement_that_does_not_converge_loses_no_donut(focused, pairs, monkeypatch):
    """Two of five donuts of DECam were lost with the higher terms of the air."""

    def fit_star(*given, begun=None, **options):
        fitted = one_star(*given, begun=begun, **options)
        return fitted if begun is None else replace(fitted, flags=fitted.flags | pachon.sensing.DonutFlag.NOT_CONVERGED)

    one_star = pachon.sensing.noise_fit.fit_star
    monkeypatch.setattr(pachon.sensing.noise_fit, "fit_star", fit_star)
    model = replace(of_sides(1, 1), diffraction=False)
    fit = pachon.fit_donuts(focused, pairs[:2], FIELDS, WAVELENGTH, model=model, fit=Refined(), **OPTIONS)
    assert fit.usable.all()
    assert np.isfinite(fit.zernikes).all()


def test_stars_have_a_number_each(focused):
    with pytest.raises(DomainError, match="stars of length 3: expected a number for each of 2 images"):
        pachon.fit_donuts(
            focused,
            np.zeros((2, 9, 9)),
            FIELDS,
            WAVELENGTH,
            fit=pachon.sensing.ExposureDonuts(stars=[1, 2, 3]),
            model=of_sides(1, -1),
        )


@pytest.mark.slow
def test_a_rim_that_the_others_contradict_is_of_one_donut(focused, true):
    """A mirrored stamp looks like M1's rim 0.2 m elsewhere: it is not freed for donuts that fit without."""
    fields = np.deg2rad([(-0.95, -0.82), (-0.05, -0.27), (0.5, -0.34), (0.59, 1.07), (1.35, 0.02)])
    behind = true.perturbed("Detector", shift=(0.0, 0.0, DEFOCUS))
    images = [noisy(donut(behind, field), SKY, 11 * i) for i, field in enumerate(fields)]
    images[3] = images[3][::-1]
    fit = pachon.fit_donuts(
        focused, images, fields, WAVELENGTH, model=of_sides(*np.ones(5)), fit=pachon.sensing.ExposureDonuts(), **OPTIONS
    )
    moved = pachon.sensing.DonutFlag.RIM_MOVED
    assert [bool(flag & moved) for flag in fit.flags] == [False, False, False, True, False]
    before, after = (
        pachon.wavefront_zernikes(t, fields, WAVELENGTH, jmax=22).coefficients[:, 3:] for t in (focused, true)
    )
    good = fit.flags == 0
    assert good.sum() >= 3
    # With M1's rim free for all they were wrong by 500 nm, most of it Z4; with what the mirrored one says by 150.
    error = rss(fit.zernikes - (after - before))
    assert error[good].max() < 50e-9
    assert error[3] < 2.0 * rss(fit.errors[3])
    assert "donut 3 (from 0) differs" in fit.exposure.notices[0]


@pytest.mark.slow
def test_errors_that_all_donuts_have_in_common_do_not_average(true):
    """The model's accuracy, and what a prior takes from the telescope's further terms, are as large for four donuts."""
    behind = true.perturbed("Detector", shift=(0.0, 0.0, DEFOCUS))
    fields = np.deg2rad([(0.9, 0.7)]) + 1e-3 * np.array([(i, j) for i in range(2) for j in range(2)])
    # So bright that photons leave little.
    images = [donut(behind, field, flux=3e8) for field in fields]
    spread, options = 10e-9, {**OPTIONS, "model": replace(of_sides(*np.ones(4)), n_pupil=60, diffraction=False)}
    alone, together = (
        pachon.fit_donuts(true, images, fields, WAVELENGTH, fit=fit, **options)
        for fit in (
            pachon.sensing.SingleDonuts(higher_order=spread),
            pachon.sensing.ExposureDonuts(higher_order=spread),
        )
    )
    # Each alone says how much of these the telescope has, together they say it once.
    least = np.mean([part.diagonal() for part in alone.error_parts.floor], axis=0)
    assert (np.diagonal(together.covariance, axis1=1, axis2=2) > 0.99 * least).all()
