"""Pictures of a design on the desk: MTF, xi+, sensitivities, optimisation, three dimensions, A beside now."""

from dataclasses import replace

import numpy as np
import pytest

import pachon
from pachon.core.errors import PachonError
from pachon.desk.bench import Bench
from pachon.desk.design_views import (
    METRICS,
    improved,
    mtf_view,
    projected,
    sensitivity_view,
    separation_bins,
    space_view,
)
from pachon.desk.views import Scene, layout_of, opd_view, spots_view

BENCH = Bench("lsst_v3.3_r")
MOVED = replace(BENCH.start, optics={"M2_dz": 30.0, "M2_dx": 500.0})


@pytest.mark.long
@pytest.mark.parametrize("metric", METRICS[:2])
def test_sensitivities_are_differences_of_the_metric(metric):
    view = sensitivity_view(Scene.of(BENCH, MOVED), metric)
    # Derivatives are those at a fixed set of lit rays; steps are small, and errors of differences below 1e-3.
    for name, step in (("M2_dz", 0.5), ("M1M3_B2", 0.01)):
        low, high = (
            sensitivity_view(Scene.of(BENCH, replace(MOVED, optics={**MOVED.optics, name: value})), metric).value
            for value in (MOVED.optics.get(name, 0.0) - step, MOVED.optics.get(name, 0.0) + step)
        )
        index = view.names.index(name)
        assert view.derivative[index] == pytest.approx((high - low) / (2.0 * step), rel=1e-3, abs=1e-3)
        control = next(c for c in BENCH.controls if c.key == f"optics.{name}")
        assert view.effect[index] == pytest.approx(view.derivative[index] * control.step)


#: Terms of the heights beside the potato chip.
OTHERS = ("global", "raft", "ccd", "tilt")
#: All rafts 20 um above the detector.
LIFTED = dict.fromkeys(BENCH.camera.raft_names, 20.0)


@pytest.mark.parametrize("lifts", [{}, LIFTED], ids=["flat", "lifted"])
def test_sensitivities_begin_at_the_numbers_of_the_desk(lifts):
    scene = Scene.of(BENCH, replace(MOVED, lifts=lifts))
    zernikes = opd_view(scene).zernikes_nm
    # Both fits have the same terms; the rings of the pupil differ.
    assert sensitivity_view(scene, "Z4 at the star").value == pytest.approx(zernikes[0], rel=1e-2)
    radius = np.sqrt(np.mean(spots_view(scene).rms_um ** 2))
    assert sensitivity_view(scene, METRICS[1]).value == pytest.approx(radius, rel=1e-6)


@pytest.mark.long
def test_the_transfer_is_that_of_the_python_api():
    scene = Scene.of(BENCH, MOVED)
    view = mtf_view(scene)
    result = pachon.mtf(scene.telescope, np.deg2rad(MOVED.field_deg), MOVED.wavelength_nm * 1e-9)
    np.testing.assert_allclose(view.tangential, result.tangential[0], atol=1e-9)
    np.testing.assert_allclose(view.frequency, result.frequency * 1e-3)


@pytest.mark.long
def test_an_optimisation_finds_the_misalignment_that_optimize_finds():
    better = improved(Scene.of(BENCH, MOVED), ["M2_dz", "M2_dx"])
    expected = pachon.optimize(
        Scene.of(BENCH, MOVED).telescope,
        ["M2.dz", "M2.dx"],
        fields=BENCH.spot_fields,
        wavelengths=MOVED.wavelength_nm * 1e-9,
        n_pupil=6,
    )
    assert better.before_um == pytest.approx(1e6 * expected.merits[0], rel=1e-9)
    # Some steps go most of the way; the rest is that of the next ones.
    assert better.after_um == pytest.approx(1e6 * expected.merits[1], rel=1e-3)
    assert better.state.optics["M2_dz"] == pytest.approx(30.0 + 1e6 * expected.changes[0], abs=0.1)
    with pytest.raises(PachonError):
        improved(Scene.of(BENCH, MOVED), [])


@pytest.mark.long
def test_an_optimisation_finds_bending_modes_and_the_heights_of_ccds():
    # Both are planted: the modes in the state, and CCDs that stand on one height.
    bent = replace(
        BENCH.start, optics={"M1M3_B2": 0.2, "M2_B5": 0.1}, lifts=dict.fromkeys(BENCH.camera.raft_names, 20.0)
    )
    state = improved(Scene.of(BENCH, bent), ["M1M3_B2", "M2_B5", "Camera_dz"]).state
    flat = improved(Scene.of(BENCH, replace(bent, lifts={})), ["M1M3_B2", "M2_B5", "Camera_dz"]).state
    # CCDs 20 um above the detector are in focus where the camera is as much lower.
    assert state.optics["Camera_dz"] - flat.optics["Camera_dz"] == pytest.approx(-20.0, abs=0.5)
    designed = improved(Scene.of(BENCH, BENCH.start), ["M1M3_B2", "M2_B5", "Camera_dz"]).state
    for name in ("M1M3_B2", "M2_B5"):
        assert flat.optics[name] == pytest.approx(designed.optics[name], abs=2e-3)


def test_a_view_in_space_has_its_axes():
    axes = np.eye(3)
    # From +x: +y to the right and +z up. From above, turned by a right angle: -x to the right, -y up.
    np.testing.assert_allclose(projected(axes, 0.0, 0.0), [[0, 0], [1, 0], [0, 1]], atol=1e-15)
    np.testing.assert_allclose(projected(axes, np.pi / 2, np.pi / 2), [[-1, 0], [0, -1], [0, 0]], atol=1e-15)


def test_lines_lie_on_the_surfaces_within_their_apertures():
    lines = space_view(layout_of(Scene.of(BENCH, BENCH.start)))
    surface = BENCH.nominal.surface("M1")
    points = np.concatenate([line.points for line in lines if line.name == "M1"])
    x, y, z = surface.to_local(points[np.isfinite(points).all(axis=1)]).T
    np.testing.assert_allclose(z, surface.shape.sag(x, y), atol=1e-12)
    assert np.hypot(x, y).min() >= surface.aperture.inner
    assert {line.kind for line in lines} >= {"ray", "mirror", "refract", "detector"}


@pytest.mark.long
def test_the_potato_chip_is_felt_in_the_correlation_that_the_python_api_gives():
    pytest.importorskip("bokeh", reason="a desk needs Bokeh: pip install 'pachon[desk]'")
    from pachon.desk.panels import CorrelationPanel

    panel = CorrelationPanel(BENCH, lambda: BENCH.start)
    drawn = {}
    for size in (10.0, 20.0):
        panel.draw(Scene.of(BENCH, replace(BENCH.start, heights={"potato_chip": size})), {}, {})
        drawn[size] = panel.view
    fields = BENCH.stars(10)[1]
    # Table 1's simulated potato chip is 5 um; the seeing is 0.6 arcsec at 500 nm.
    plane = pachon.FocalPlane.from_budget("lsst", seed=1).scaled({"potato_chip": 4.0} | dict.fromkeys(OTHERS, 0.0))
    atmosphere = pachon.Atmosphere.from_site("cerro_pachon", 1, r0=0.9759 * 500e-9 / np.deg2rad(0.6 / 3600.0))
    wavelength = BENCH.start.wavelength_nm * 1e-9
    xi = []
    for heights in (None, plane):
        options = {"focal_plane": heights, "atmosphere": atmosphere, "stamps": pachon.Stamps(size=27)}
        moments = pachon.psf_moments(BENCH.nominal, fields, wavelength, **options)
        xi.append((moments.g1, moments.g2))
    view, bins = drawn[20.0], separation_bins(fields)
    flat, now = np.array(xi)
    for value, shapes in ((view.reference, flat), (view.xi_plus, now), (view.change, now - flat)):
        expected = pachon.shear_correlation(*fields.T, *shapes, bins=bins)
        # The Fried parameter has four digits; TreeCorr keeps single precision.
        np.testing.assert_allclose(value, expected.xi_plus, rtol=1e-3, atol=1e-5 * np.abs(expected.xi_plus).max())
    np.testing.assert_allclose(view.r_arcmin, expected.r_arcmin)
    # Defocus on astigmatism: ellipticities grow with heights, xi+ with their square; one to two waves on a CCD of 13
    # arcmin are the same within 3 arcmin and opposite at twice that.
    assert view.change[0] == pytest.approx(4.0 * drawn[10.0].change[0], rel=0.05)
    assert view.change[1] < -0.5 * view.change[0] < 0.0
    assert np.abs(view.change[3:]).max() < 0.1 * view.change[0]


@pytest.mark.long
def test_panels_draw_where_they_are_shown_and_an_optimisation_is_one_step_to_undo():
    pytest.importorskip("bokeh", reason="a desk needs Bokeh: pip install 'pachon[desk]'")
    from pachon.desk.session import Session

    bench = Bench(pachon.new_telescope("triplet"))
    start = {"S3_radius": 0.2}
    session = Session(bench, replace(bench.start, optics=start))
    by_label = {panel.label: panel for panel in session.panels}
    assert not any(picture.figure.visible for panel in session.panels for picture in panel.pictures)
    session.show_panels(range(len(session.panels)))
    assert session.status.text == ""
    mtf = by_label["MTF"].picture.source.data
    np.testing.assert_array_equal(mtf["t"], mtf_view(session.scene).tangential)
    bars = by_label["Sensitivities"].picture.source.data
    assert len(bars["name"]) == 16
    # The pinned state is on the scale of the state.
    session.set_value("optics.S3_radius", 0.1)
    assert session.beside.opd.mapper.high == session.opd.mapper.high
    np.testing.assert_array_equal(session.beside.opd.source.data["image"][0].shape, (64, 64))
    panel = session.optimization
    panel.variables.value = ["S3_radius"]
    panel.start()
    assert not panel.running
    assert panel.merits[-1] < 0.5 * panel.merits[0]
    assert session.history.undo().optics == {"S3_radius": 0.1}


class Callbacks:
    """A document of a page whose callbacks run when they are told to."""

    session_context = object()

    def __init__(self):
        self.waiting = []

    def add_timeout_callback(self, action, pause):
        self.waiting.append(action)

    def run(self):
        while self.waiting:
            self.waiting.pop(0)()


@pytest.mark.long
def test_a_refused_drag_leaves_numbers_and_pictures_of_one_state():
    """The numbers of the state before the drag stood beside pictures of the drag; sliders reached to 1e8 um."""
    pytest.importorskip("bokeh", reason="a desk needs Bokeh: pip install 'pachon[desk]'")
    from pachon.desk.session import Session
    from pachon.desk.views import SpotsView

    page = Callbacks()
    session = Session(BENCH, None, page)
    page.run()
    for value in (10.0, 20.0, 1e8):
        session.set_value("optics.M2_dz", value)
        page.run()
    assert "does not reach the detector" in session.status.text
    assert session.history.state.optics == {"M2_dz": 20.0}
    np.testing.assert_array_equal(session.views[SpotsView].rms_um, spots_view(session.scene).rms_um)
    slider = session.sliders.children[0].children[0]
    assert (slider.start, slider.end) == (-100.0, 100.0)
    session.redo()
    assert session.history.state.optics == {"M2_dz": 20.0}
    session.undo()
    assert session.history.state.optics == {}
    # A number that was typed is a step of its own, whatever the slider does after it.
    session.set_value("optics.M2_dz", 5.0, drag=False)
    session.set_value("optics.M2_dz", 8.0)
    session.undo()
    assert session.history.state.optics == {"M2_dz": 5.0}
