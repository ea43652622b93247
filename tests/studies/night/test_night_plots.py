"""Pictures of a night: what is small on a wide sky is seen, at its place and in the colours of its values."""

from types import SimpleNamespace

import numpy as np
import pytest

from pachon.studies.night import plots


@pytest.mark.parametrize("apart", [15.0, 40.0, 100.0], ids=["plane", "wide plane", "whole sky"])
def test_single_pixels_are_seen_on_a_wide_sky(monkeypatch, apart):
    healsparse = pytest.importorskip("healsparse")
    content = healsparse.HealSparseMap.make_empty(32, 512, dtype=np.float64)
    content.update_values_pos(np.array([5.0, 5.0 + apart]), np.array([-30.0, -20.0]), np.array([1.5, 2.0]))
    ra, dec = content.valid_pixels_pos(lonlat=True)
    monkeypatch.setattr(plots, "png_bytes", lambda figure: figure)
    figure = plots.maps_plot(SimpleNamespace(bands={"r": None}, pictured=lambda band: (content,) * 3))
    width = figure.axes[0]
    dots = next(drawn for drawn in width.collections if len(drawn.get_offsets()) == 2)
    places = np.asarray(dots.get_offsets())
    if apart > 60.0:
        # Hammer's projection in radians about the mean direction, east at the left.
        assert np.ptp(places[:, 0]) == pytest.approx(np.deg2rad(np.ptp(ra)))
        assert places[np.argmax(dots.get_array()), 0] < 0.0
        places = np.rad2deg(places)
    else:
        np.testing.assert_allclose(np.sort(places[:, 0]), np.sort(ra))
        assert width.get_xlim()[0] > width.get_xlim()[1]
    np.testing.assert_allclose(np.sort(places[:, 1]), np.sort(dec))
    assert {tuple(drawn.get_clim()) for drawn in width.collections if drawn.get_array() is not None} == {(1.5, 2.0)}


def test_right_ascensions_about_0_h_are_those_of_the_sky(monkeypatch):
    healsparse = pytest.importorskip("healsparse")
    content = healsparse.HealSparseMap.make_empty(32, 512, dtype=np.float64)
    content.update_values_pos(np.array([352.0, 11.0]), np.array([-30.0, -20.0]), np.array([1.5, 2.0]))
    monkeypatch.setattr(plots, "png_bytes", lambda figure: figure.draw_without_rendering() or figure)
    panel = plots.maps_plot(SimpleNamespace(bands={"r": None}, pictured=lambda band: (content,) * 3)).axes[0]
    labels = [float(text.get_text()) for text in panel.get_xticklabels()]
    assert 0.0 <= min(labels) < 10.0
    assert 350.0 < max(labels) < 360.0


def test_maps_of_one_value_in_one_strip_can_be_read(monkeypatch):
    """Panels were lines beside tall colour bars, with fractions of visits."""
    healsparse = pytest.importorskip("healsparse")
    content = healsparse.HealSparseMap.make_empty(32, 512, dtype=np.float64)
    content.update_values_pos(np.array([5.0, 12.0, 19.0]), np.full(3, -30.0), np.ones(3))
    monkeypatch.setattr(plots, "png_bytes", lambda figure: figure.draw_without_rendering() or figure)
    figure = plots.maps_plot(SimpleNamespace(bands={"r": None}, pictured=lambda band: (content,) * 3))
    labels = []
    for panel in figure.axes:
        (bar,) = panel.child_axes
        sides, bar_sides = panel.get_window_extent(), bar.get_window_extent()
        assert sides.height == pytest.approx(0.5 * sides.width, rel=0.01)
        assert bar_sides.height == pytest.approx(sides.height)
        labels.append([text.get_text() for text in bar.get_yticklabels()])
    assert labels == [["1"], ["1"], ["0", "1"]]
