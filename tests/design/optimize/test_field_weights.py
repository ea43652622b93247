"""Weights of fields and wavelengths that the design data state, in merits and in means of reports."""

from pathlib import Path

import numpy as np
import pytest

import pachon
from pachon.design.optimize.before_after import with_fields
from pachon.design.optimize.merit import Beams, SpotMerit, WavefrontMerit
from pachon.models.io.prescription import load_telescope
from pachon.studies.metrics.telescope import TelescopeScene, spots, throughput

LENS = Path(__file__).parents[2] / "data" / "zmx" / "lens1.zmx"
WEIGHTS, COLORS = np.array([4.0, 0.0, 1.0]) / 5.0, np.array([1.0, 2.0, 1.0]) / 4.0


@pytest.fixture(scope="module")
def lens():
    return load_telescope(LENS).with_design(field_weights=(4.0, 0.0, 1.0), wavelength_weights=(1.0, 2.0, 1.0))


@pytest.fixture(scope="module")
def squares(lens):
    """Mean square radius about the centroid of each field, with the weights of the wavelengths, from single rays."""
    found, pupil = [], pachon.pupil_sampling(lens, "gauss", 6)
    for field in lens.design_data.fields:
        place, weight = [], []
        for wavelength, color in zip(lens.design_data.wavelengths, COLORS, strict=True):
            end = pachon.trace(lens, pachon.launch_rays(lens, field, wavelength, tuple(pupil.points.T)), threads=1)
            lit = (end.status == 0) * pupil.weights
            place.append(end.position[:, :2])
            weight.append(color * lit / lit.sum())
        place, weight = np.concatenate(place), np.concatenate(weight)
        away = np.where((weight > 0)[:, None], place, 0.0) - weight @ np.where((weight > 0)[:, None], place, 0.0)
        found.append(weight @ (away**2).sum(axis=1))
    return np.array(found)


def test_merits_have_the_weights_of_the_file(lens, squares):
    merit = SpotMerit(lens, Beams.of(lens, threads=1))
    assert (merit.residuals(lens) ** 2).sum() == pytest.approx(WEIGHTS @ squares, rel=1e-9)
    rms = [
        np.linalg.norm(WavefrontMerit(lens, Beams.of(lens, f, threads=1)).residuals(lens))
        for f in lens.design_data.fields
    ]
    merit = WavefrontMerit(lens, Beams.of(lens, threads=1))
    assert (merit.residuals(lens) ** 2).sum() == pytest.approx(WEIGHTS @ np.square(rms), rel=1e-9)
    # Weights that are given come first, and those of the file belong to its own fields alone.
    given = SpotMerit(lens, Beams.of(lens, field_weights=[0, 0, 1], threads=1))
    assert (given.residuals(lens) ** 2).sum() == pytest.approx(squares[2], rel=1e-9)
    same = SpotMerit(lens, Beams.of(lens, np.array(lens.design_data.fields), threads=1))
    assert (same.residuals(lens) ** 2).sum() == pytest.approx(squares.mean(), rel=1e-9)


def test_means_of_reports_have_the_weights_of_the_file(lens, squares):
    scene = TelescopeScene(lens, threads=1)
    # Nothing is vignetted, so weights of the rays are those of the merit.
    assert spots(scene)["spot_rms_um"] == pytest.approx(1e6 * np.sqrt(WEIGHTS @ squares), rel=1e-9)
    assert throughput(scene)["throughput_mean"] == pytest.approx(1.0)
    focus = pachon.through_focus(lens, n_pupil=6, threads=1)
    axis = pachon.through_focus(lens.with_design(field_weights=(1.0, 0.0, 0.0)), n_pupil=6, threads=1)
    assert axis.best_common == pytest.approx(axis.best_spot[0], rel=1e-12)
    # A parabola each: its curvature is the mean square of the slopes, from two heights.
    heights = np.array([0.0, 1e-4])
    spot = pachon.through_focus(lens, defocus=heights, n_pupil=6, threads=1)
    curvature = (spot.rms_radius[:, 1] ** 2 - spot.smallest_radius**2) / (heights[1] - spot.best_spot) ** 2
    expected = (WEIGHTS * curvature) @ spot.best_spot / (WEIGHTS @ curvature)
    assert focus.best_common == pytest.approx(expected, rel=1e-6)


def test_parts_of_a_request_keep_their_weights(lens):
    request = pachon.Request.of(lens)
    assert request.field_weights == pytest.approx(WEIGHTS)
    assert request.at_fields(slice(1, 3)).field_weights == pytest.approx([0.0, 1.0])
    assert request.at_fields(request.fields).field_weights == pytest.approx(np.full(3, 1 / 3))


def test_pictures_before_and_after_have_the_vignetting_factors_of_the_file():
    """Some of the fields of a merit, each with its own factors: the spots that `pachon spots` has."""
    lens = pachon.models.triplet(diameter=0.01, f_number=5.0)
    rows = ((0.0, 0.0, 0.0, 0.0, 0.0), (0.0, 0.1, 0.0, 0.3, 0.0), (0.0, 0.2, 0.1, 0.4, 0.0))
    lens = lens.with_design(fields=((0.0, 0.0), (0.0, 0.1), (0.0, 0.2)), field_weights=(), vignetting=rows)
    whole = pachon.spots(lens, sampling="rings", n_pupil=4)
    found = pachon.optimize(
        lens, [f"{lens.surfaces[-1].name}.dz"], n_pupil=2, solver=pachon.design.LeastSquares(max_steps=2)
    )
    some, none = with_fields(lens, found.fields[0][1:], found.vignetting[0][1:])
    assert none is None
    drawn = pachon.spots(some, sampling="rings", n_pupil=4)
    assert drawn.rms_radius == pytest.approx(whole.rms_radius[1:], rel=1e-12)
    plain = pachon.spots(lens, found.fields[0][1:], sampling="rings", n_pupil=4)
    assert (np.abs(drawn.rms_radius / plain.rms_radius - 1.0) > 0.05).all()
