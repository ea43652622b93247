"""Which side of focus: fits on both sides compared by the donuts of an exposure, with parity as the oracle."""

import numpy as np
import pytest

from pachon.sensing.sides import BothSides, SideFit, decide_sides, pair_agreement


def fits(given, mirrored, depth=1e-3):
    waves, spread = np.array([50e-9, -20e-9]), np.diag([1e-17, 1e-17])
    return BothSides(SideFit(given, waves, spread), SideFit(mirrored, -waves, spread), depth)


def flat(numbers, chosen):
    return 0.0


def test_a_donut_is_ambiguous_where_both_sides_fit_as_well():
    assert fits(100.0, 110.0).ambiguous
    assert fits(100.0, 90.0).ambiguous
    assert not fits(100.0, 140.0).ambiguous


def test_all_donuts_of_a_side_decide_together():
    right = decide_sides([fits(100.0, 110.0)] * 4, flat)
    assert right.decided.all()
    assert not right.wrong.any()
    wrong = decide_sides([fits(110.0, 100.0), None, fits(400.0, 100.0)], flat)
    assert wrong.wrong.tolist() == [True, False, True]
    undecided = decide_sides([fits(100.0, 105.0)] * 2, flat)
    assert not undecided.decided.any()


def test_each_side_of_focus_is_decided_by_itself():
    donuts = [fits(100.0, 400.0), fits(100.0, 400.0), fits(400.0, 100.0, -1e-3), fits(100.0, 105.0, -1e-3)]
    decision = decide_sides(donuts, flat)
    assert decision.wrong.tolist() == [False, False, True, True]
    assert decision.decided.all()


def test_smooth_wavefronts_decide_where_images_do_not():
    """The images say nothing; the telescope is the smoother one on the side that is given."""
    decision = decide_sides([fits(100.0, 100.0)] * 3, lambda _, chosen: 0.0 if chosen[0].zernikes[0] > 0.0 else 50.0)
    assert decision.decided.all()
    assert not decision.wrong.any()


def test_chi_square_of_pairs_is_that_of_their_differences():
    rng = np.random.default_rng(2)
    covariance = np.tile(np.diag([1.0, 4.0, 9.0]), (400, 1, 1))
    zernikes = rng.normal(size=(400, 3)) * [1.0, 2.0, 3.0]
    star, behind = np.repeat(np.arange(200), 2), np.tile([True, False], 200)
    agreement = pair_agreement(zernikes, covariance, star, behind, 2.0, np.zeros((3, 3)))
    assert agreement.n_pairs == 200
    # Of 600 squares.
    assert agreement.chi2_claimed == pytest.approx(1.0, abs=0.2)
    assert agreement.chi2 == pytest.approx(0.5 * agreement.chi2_claimed)
    assert agreement.rms == pytest.approx(np.sqrt(2.0 * 14.0), rel=0.1)
    assert pair_agreement(zernikes, covariance, np.arange(400), behind, 1.0, np.zeros((3, 3))) is None
