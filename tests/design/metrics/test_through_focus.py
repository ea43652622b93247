import numpy as np
import pytest
from scipy.optimize import minimize

from pachon.core.errors import DomainError
from pachon.core.plotting import png_bytes
from pachon.design.metrics.spots import spots
from pachon.design.metrics.through_focus import through_focus
from pachon.models.shapes.freeform import Toroid
from pachon.wavefront.opd import wavefront_opd
from pachon.wavefront.pupil_sampling import pupil_sampling


def test_a_displaced_detector_is_found_again(paraboloid):
    result = through_focus(paraboloid(2.0, 4.0, shift=3e-4), [[0.0, 0.0]])
    assert result.best_spot[0] == pytest.approx(-3e-4, abs=1e-13)
    assert result.best_common == pytest.approx(-3e-4, abs=1e-13)
    # The root of a difference of squares of 1e-5 m, rounded.
    assert result.smallest_radius[0] < 1e-12
    # By parabolas through samples some micrometres apart.
    assert result.best_wavefront[0] == pytest.approx(-3e-4, abs=1e-7)
    assert result.strehl.max() == pytest.approx(1.0, abs=0.01)


def test_defocus_in_wavefront_and_strehl_are_the_textbooks(paraboloid):
    f_number, wavelength = 20.0, 5e-7
    heights = np.array([-2e-4, 1e-4, 3e-4])
    result = through_focus(paraboloid(2.0, f_number), [[0.0, 0.0]], wavelength, heights)
    # W = dz rho^2 / (8 N^2): rms W / (2 sqrt 3), Strehl sinc^2(W / 2 lambda). At f/20 to (1/4N)^2, times its square.
    rim = heights / (8 * f_number**2)
    assert result.rms_wavefront[0] == pytest.approx(np.abs(rim) / np.sqrt(12), rel=1e-3)
    assert result.strehl[0] == pytest.approx(np.sinc(rim / wavelength) ** 2, rel=3e-3)
    assert result.rms_radius[0] == pytest.approx(np.abs(heights) / (2 * f_number) / np.sqrt(2), rel=1e-3)


def test_strehl_ratios_are_none_where_the_points_of_the_pupil_are_too_few(paraboloid):
    # 8 rings hold 3.2 waves; beyond some 4, points in rings would add up to ratios that mean nothing, up to 0.9 here.
    f_number, wavelength = 20.0, 5e-7
    rim = np.linspace(0.0, 12.0, 49)
    heights = rim * wavelength * 8 * f_number**2
    result = through_focus(paraboloid(2.0, f_number), [[0.0, 0.0]], wavelength, heights, n_pupil=8)
    finer = through_focus(paraboloid(2.0, f_number), [[0.0, 0.0]], wavelength, heights, n_pupil=32)
    # At whole numbers of waves the middle is dark, and a ring around it the brightest place.
    middle = rim % 1.0 != 0.0
    np.testing.assert_allclose(finer.strehl[0, middle], np.sinc(rim[middle]) ** 2, rtol=0, atol=2e-3)
    known = rim <= 3.1
    np.testing.assert_allclose(result.strehl[0, known], finer.strehl[0, known], rtol=0, atol=1e-3)
    assert np.isnan(result.strehl[0, rim > 3.3]).all()
    assert np.isfinite(result.rms_wavefront).all()


def test_it_is_as_if_the_detector_had_moved(lsst_r):
    fields, height = np.deg2rad([[0.0, 0.4], [1.0, -1.2]]), 2.5e-5
    result = through_focus(lsst_r, fields, 622e-9, [height])
    moved = lsst_r.perturbed("Detector", shift=(0.0, 0.0, height))
    # Both are exact; rounding of squares.
    assert result.rms_radius[:, 0] == pytest.approx(spots(moved, fields, 622e-9).rms_radius, rel=1e-9)
    pupil = pupil_sampling(lsst_r)
    for i, field in enumerate(fields):
        opd = wavefront_opd(moved, field, 622e-9, pupil.points.T)
        weight = pupil.weights[opd.lit] / pupil.weights[opd.lit].sum()
        plane = np.stack([np.ones(len(weight)), opd.x[opd.lit], opd.y[opd.lit]], axis=-1) * np.sqrt(weight)[:, None]
        value = opd.value[opd.lit] * np.sqrt(weight)
        rest = value - plane @ np.linalg.lstsq(plane, value, rcond=None)[0]
        assert result.rms_wavefront[i, 0] == pytest.approx(np.linalg.norm(rest), rel=1e-7)

        waves, points = rest / np.sqrt(weight) / 622e-9, pupil.points[opd.lit] / 4.18

        def at(tilt, weight=weight, waves=waves, points=points):
            return -(abs((weight * np.exp(2j * np.pi * (waves - points @ tilt))).sum()) ** 2)

        # The brightest of all places, from a search on a lattice.
        axis = np.arange(-4.0, 4.1, 0.25)
        start = min(((x, y) for x in axis for y in axis), key=at)
        found = minimize(at, start, method="Nelder-Mead", options={"xatol": 1e-7, "fatol": 1e-12})
        assert result.strehl[i, 0] == pytest.approx(-found.fun, rel=1e-7)


@pytest.mark.slow
def test_the_best_focus_of_all_is_best(lsst_r):
    result = through_focus(lsst_r, None, np.linspace(*lsst_r.band, 3), np.linspace(-1e-5, 1e-5, 201))
    mean = np.sqrt((result.rms_radius**2).mean(axis=0))
    assert result.defocus[np.argmin(mean)] == pytest.approx(result.best_common, abs=6e-8)
    for row, best, size in zip(result.rms_radius, result.best_spot, result.smallest_radius, strict=True):
        assert result.defocus[np.argmin(row)] == pytest.approx(best, abs=6e-8)
        assert row.min() == pytest.approx(size, rel=1e-4)
    # As designed: every field within a few micrometres of the common focus.
    assert np.abs(result.best_spot - result.best_common).max() < 5e-6


def test_summary_and_picture(lsst_r):
    result = through_focus(lsst_r)
    summary = result.summary()
    assert np.shape(summary["rms_radius_um"]) == (5, len(summary["defocus_um"]))
    assert png_bytes(result.plot()).startswith(b"\x89PNG")
    # The range holds every best focus, and the spots grow to about three times their size.
    assert result.defocus[0] < result.best_spot.min()
    assert result.best_spot.max() < result.defocus[-1]
    assert 2 < result.rms_radius[:, 0].max() / result.smallest_radius.max() < 6


def test_bad_input_is_refused(lsst_r, paraboloid):
    with pytest.raises(DomainError, match="expected ascending heights"):
        through_focus(lsst_r, defocus=[1e-5, 0.0])
    dark = paraboloid(baffle=(4.0, 0.01))
    with pytest.raises(DomainError, match=r"field = \(0, 1.9\) deg: no light reaches the detector"):
        through_focus(dark, np.deg2rad([[0.0, 1.9]]))


@pytest.mark.parametrize("fold", [False, True], ids=["plate", "fold mirror"])
def test_parallel_light_has_no_focus(afocal, fold):
    with pytest.raises(DomainError, match=r"field = \(0, 0.1\) deg: the light is parallel; expected a focus"):
        through_focus(afocal(fold), np.deg2rad([[0.0, 0.1]]))


def test_a_cylinder_has_the_focus_of_its_curved_section(paraboloid):
    """One focal ratio is infinite; the heights about the focus are finite all the same."""
    mirror = paraboloid(2.0, 20.0, shift=1e-4)
    surface = next(s for s in mirror.surfaces if s.shape.curvature)
    cylinder = mirror.with_shape(surface.name, Toroid(np.inf, surface.shape.radius, -1.0))
    result = through_focus(cylinder, [[0.0, 0.0]])
    assert result.best_spot[0] == pytest.approx(-1e-4, abs=1e-12)
    assert np.isfinite(result.defocus).all()
    # A line as long as the pupil, of rms D / 4.
    assert result.smallest_radius[0] == pytest.approx(0.25 * cylinder.pupil_diameter, rel=1e-3)
