"""Matches against all pairs, and rates against counts by hand."""

import numpy as np
import pytest

import pachon


def test_matches_are_mutually_nearest_pairs():
    rng = np.random.default_rng(1)
    found, true = rng.uniform(0, 100, (60, 2)), rng.uniform(0, 100, (80, 2))
    found[:30] = true[:30] + rng.normal(0, 0.5, (30, 2))
    distance = np.hypot(*(found[:, None] - true[None]).transpose(2, 0, 1))
    expected = [
        j if distance[i, j] <= 3.0 and distance[:, j].argmin() == i else -1 for i, j in enumerate(distance.argmin(1))
    ]
    matched = pachon.measure.match_positions(*found.T, *true.T, 3.0)
    assert matched.tolist() == expected
    assert 25 < (matched >= 0).sum() < 60


def test_two_detections_of_one_object_match_once():
    assert pachon.measure.match_positions([0.0, 0.4], [0.0, 0.0], [0.1], [0.0], 1.0).tolist() == [0, -1]
    assert pachon.measure.match_positions([], [], [0.1], [0.0], 1.0).tolist() == []
    assert pachon.measure.match_positions([1.0], [1.0], [], [], 1.0).tolist() == [-1]


def test_rates_are_counts():
    rates = pachon.measure.detection_rates(
        [20.2, 20.9, 21.1, 21.5, np.nan], [0, 2, -1, 3, 4], [20.1, 20.6, 21.2, 21.3, 20.9, 21.8], [20, 21, 22, 23]
    )
    assert rates.n_true.tolist() == [3, 3, 0]
    assert rates.n_found.tolist() == [2, 2, 0]
    assert rates.n_detected.tolist() == [2, 2, 0]
    assert rates.n_real.tolist() == [2, 1, 0]
    np.testing.assert_array_equal(rates.completeness, [2 / 3, 2 / 3, np.nan])
    np.testing.assert_array_equal(rates.purity, [1.0, 0.5, np.nan])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: pachon.measure.match_positions([1.0], [1.0, 2.0], [1.0], [1.0], 1.0), "x, y have shapes"),
        (lambda: pachon.measure.match_positions([1.0], [np.nan], [1.0], [1.0], 1.0), "x, y: expected finite"),
        (lambda: pachon.measure.match_positions([1.0], [1.0], [1.0], [1.0], 0.0), "radius = 0.0: expected a positive"),
        (lambda: pachon.measure.detection_rates([1.0], [0, 0], [1.0], [0, 1]), "match .2,.: expected"),
        (lambda: pachon.measure.detection_rates([1.0], [1], [1.0], [0, 1]), "match: expected integers below 1"),
        (lambda: pachon.measure.detection_rates([1.0], [0], [1.0], [1, 1]), "edges: expected at least two rising"),
    ],
)
def test_bad_input(call, message):
    with pytest.raises(pachon.errors.DomainError, match=message):
        call()
