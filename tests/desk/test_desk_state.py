"""States and views of a desk, without a browser; Bokeh is not needed."""

import runpy
import sys
from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u

import pachon
from pachon.commands.cli import main
from pachon.core.errors import ConfigError, DomainError, PachonError, UnknownNameError
from pachon.desk.bench import Bench
from pachon.desk.design_views import SPOTS, sensitivity_view
from pachon.desk.python_text import python_text
from pachon.desk.state import DeskState, History, is_state_file
from pachon.desk.views import (
    Scene,
    WhiskersView,
    images_view,
    layout_of,
    numbers,
    opd_view,
    section_view,
    spots_view,
    whiskers_view,
)
from pachon.models import OpticsState
from pachon.models.design_data import DesignData
from pachon.wavefront.psf.stamps import Stamps

BENCH = Bench("lsst_v3.3_r")
FULL = replace(
    BENCH.start,
    optics={"M2_dz": 12.0, "M1M3_B2": 0.1},
    hidden={"M2_dz": 3.0},
    heights={"raft": 6.5, "potato_chip": 2.5},
    lifts={"R22": 4.0},
    seed=3,
)


def test_a_state_is_the_same_after_saving_and_loading(tmp_path):
    path = tmp_path / "desk.yaml"
    path.write_text(FULL.to_yaml(), encoding="utf-8")
    assert DeskState.from_file(path) == FULL
    assert is_state_file(path)
    assert BENCH.check(FULL) is FULL


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("desk: 2\nmodel: hsc\n", "expected version 1"),
        ("model: hsc\n", "expected the state of a desk"),
        ("desk: 1\nmodel: hsc\nopticks: {}\n", "did you mean optics"),
        ("desk: 1\nmodel: hsc\noptics: [1]\n", "expected numbers by name"),
        ("desk: 1\nmodel: hsc\noptics: {M2_dz: .nan}\n", "expected a finite number"),
        ("desk: 1\nmodel: hsc\noptics: {M2_dz: !!python/object/apply:os.system [ls]}\n", "expected YAML"),
        ("desk: 1\nmodel: hsc\nfield_deg: 3\n", "expected two angles"),
        ("desk: 1\nmodel: hsc\nheights: {raft: -1}\n", "zero or more"),
        ("desk: 1\nmodel: hsc\nseeing_arcsec: 99\n", "from 0 to 10"),
        ("desk: 1\n", "expected the name of a telescope"),
        ("desk: [1\n", "expected YAML"),
        ("desk: 1\nmodel: 2026-13-45\n", "expected YAML.*month must be in 1..12"),
        ("desk: 1\nmodel: hsc\nmodel: hsc\n", "expected YAML.*occurs twice"),
    ],
)
def test_what_is_no_state_is_one_line(text, message):
    with pytest.raises(ConfigError, match=message) as caught:
        DeskState.from_yaml(text, "x.yaml")
    assert str(caught.value).startswith("x.yaml: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "kind"),
    [
        ({"model": "hsc"}, DomainError),
        ({"optics": {"M7_dz": 1.0}}, UnknownNameError),
        ({"lifts": {"R99": 1.0}}, UnknownNameError),
        ({"field_deg": (5.0, 0.0)}, DomainError),
        ({"wavelength_nm": 1e5}, DomainError),
    ],
)
def test_a_state_of_another_bench_is_refused(change, kind):
    with pytest.raises(kind):
        Scene.of(BENCH, replace(BENCH.start, **change))


def test_a_drag_is_one_step_and_undone_at_once():
    history = History(BENCH.start)
    for value in (1.0, 2.0, 3.0):
        history.push(history.state.with_value("optics.M2_dz", value), "optics.M2_dz")
    history.settle()
    history.push(history.state.with_value("optics.M2_dz", 4.0), "optics.M2_dz")
    assert history.undo().optics == {"M2_dz": 3.0}
    assert history.undo() == history.undo() == BENCH.start
    assert history.redo().optics == {"M2_dz": 3.0}
    history.push(BENCH.start)
    assert history.redo() == BENCH.start


def test_a_state_that_cannot_be_drawn_gives_way_to_the_last_one_that_was():
    first, second, third = (BENCH.start.with_value("optics.M2_dz", value) for value in (1.0, 2.0, 1e8))
    history = History(BENCH.start)
    for state in (first, third):  # of one drag: the second replaces the first
        history.push(state, "optics.M2_dz")
    history.refuse(first)
    assert history.state == history.redo() == first
    assert history.undo() == BENCH.start
    history.push(third)
    history.refuse(BENCH.start)
    assert history.state == history.redo() == history.undo() == BENCH.start
    # Two changes between two pictures: the first is refused when it is gone back to.
    history.push(third)
    history.push(second)
    assert history.undo() == third
    history.refuse(second)
    assert history.state == second
    assert history.undo() == BENCH.start
    assert history.redo() == history.redo() == second


def test_controls_reach_every_number_and_have_units():
    assert len({control.key for control in BENCH.controls}) == len(BENCH.controls) == 50 + 5 + 4
    for control in BENCH.controls:
        assert control.unit in ("um", "arcsec", "urad", "nm", "deg"), control
        middle = 0.5 * (control.low + control.high) or 0.1 * control.high
        assert BENCH.start.with_value(control.key, middle).value(control.key) == middle


def test_views_are_those_of_the_python_api():
    scene = Scene.of(BENCH, FULL)
    telescope = OpticsState({"M2_dz": 15.0, "M1M3_B2": 0.1}).telescope(pachon.load_telescope("lsst_v3.3_r"))
    plane = pachon.FocalPlane.from_budget(seed=3, budget=pachon.models.HeightBudget(0.0, 6.5e-6, 0.0, 0.0, 2.5e-6))
    plane = plane.with_moved("R22", dz=4.0 * u.um)
    spots = pachon.spots(telescope, BENCH.spot_fields, 624 * u.nm, n_pupil=6, focal_plane=plane)
    np.testing.assert_allclose(spots_view(scene).rms_um, spots.rms_radius * 1e6, rtol=1e-9)
    star = np.deg2rad(FULL.field_deg)
    request = pachon.Request.of(telescope, star, 624 * u.nm).on(plane)
    zernikes = pachon.wavefront_zernikes(request, jmax=22)
    np.testing.assert_allclose(opd_view(scene).zernikes_nm, zernikes.coefficients[0, 3:] * 1e9, rtol=1e-6, atol=1e-3)
    opd = pachon.wavefront_opd(request, grid=64)
    assert opd_view(scene).rms_nm == pytest.approx(1e9 * np.sqrt(np.nanmean(opd.without_tilt**2)), rel=1e-9)
    table = numbers(spots_view(scene), opd_view(scene), None, None)
    assert table["spot rms radius, largest"] == (pytest.approx(spots.rms_radius.max() * 1e6), "um")


@pytest.mark.long
def test_whiskers_are_the_moments_of_the_stars_on_their_ccds():
    scene = Scene.of(BENCH, FULL)
    places, star_fields = BENCH.stars()
    assert (BENCH.camera.ccd_at(*places.T) == np.arange(189)).all()
    view = whiskers_view(scene)
    moments = pachon.psf_moments(
        scene.telescope,
        star_fields,
        scene.wavelength,
        focal_plane=scene.focal_plane,
        atmosphere=scene.atmosphere,
        stamps=Stamps.of_camera("lsst", size=27),
    )
    np.testing.assert_allclose(view.e1, moments.g1, atol=1e-12)
    np.testing.assert_allclose(
        view.fwhm_arcsec, np.rad2deg(moments.sigma) * 3600 * 2.0 * np.sqrt(2.0 * np.log(2.0)), rtol=1e-12
    )
    # Moments of the rays and of a Gaussian seeing: the same pattern, but for weights.
    far = replace(BENCH.start, optics={"M2_dz": 400.0})
    assert "rays" in whiskers_view(Scene.of(BENCH, far)).method


def test_a_star_whose_annulus_misses_the_detector_has_zernikes_of_its_lit_part():
    """At the rim of the field of HSC the wavefront of the star before stayed in the picture."""
    bench = Bench("hsc")
    x, y = np.rad2deg(bench.spot_fields[0])
    scene = Scene.of(bench, replace(bench.start, field_deg=(x, y)))
    request = pachon.Request.of(bench.nominal, scene.field[None], scene.wavelength)
    with pytest.raises(DomainError, match="rays of the annulus miss the detector"):
        pachon.wavefront_zernikes(request, jmax=22, pupil="full")
    lit = pachon.wavefront_zernikes(request, jmax=22, pupil="lit").coefficients[0, 3:]
    np.testing.assert_allclose(opd_view(scene).zernikes_nm, 1e9 * lit, rtol=1e-9)


def test_stopped_rays_without_a_smooth_wavefront_have_no_part_in_zernikes():
    """HSC at 0.6 degrees: terms of the whole annulus were 24.7 um rms, the wavefront of the light 0.25 um."""
    bench = Bench("hsc")
    scene = Scene.of(bench, replace(bench.start, field_deg=(0.0, 0.6)))
    view = opd_view(scene)
    lit = pachon.wavefront_zernikes(bench.nominal, scene.field, scene.wavelength, jmax=22, pupil="lit")
    assert view.pupil == "lit"
    np.testing.assert_allclose(view.zernikes_nm, 1e9 * lit.coefficients[0, 3:], rtol=1e-9)
    names = {}
    exec(python_text(bench, scene.state), names)
    np.testing.assert_allclose(names["zernikes"].coefficients[0, 3:] * 1e9, view.zernikes_nm, rtol=1e-9)


def test_encircled_energy_is_of_all_light_not_of_that_on_the_stamp():
    scene = Scene.of(BENCH, replace(BENCH.start, seeing_arcsec=2.0))
    stamps = Stamps.of_camera("lsst", size=101)
    wide = pachon.make_psfs(
        scene.telescope, scene.field[None], scene.wavelength,
        atmosphere=scene.atmosphere, engine="long_exposure", stamps=stamps,
    )  # fmt: skip
    y, x = np.mgrid[-50:51, -50:51]
    order = np.argsort(np.hypot(x, y), axis=None)
    within = wide.inside[0] * np.cumsum(wide.image[0].ravel()[order])
    radius = np.hypot(x, y).ravel()[order][np.searchsorted(within, 0.8)] * np.rad2deg(wide.pixel_scale) * 3600
    found, _ = numbers(None, None, None, images_view(scene))["80 % of the light at the star within"]
    # Rings of pixels are a tenth of an arcsecond wide.
    assert found == pytest.approx(radius, abs=0.05)


def test_widths_of_stars_are_not_those_of_a_weight():
    # The 0.3 arcsec weight of stars without air is the width of none that is larger; and many have no moments under it.
    states = [replace(BENCH.start, seeing_arcsec=0.0, optics={"M2_dz": dz}) for dz in (0.0, 40.0, 80.0, 120.0)]
    widths = [np.median(whiskers_view(Scene.of(BENCH, state)).fwhm_arcsec) for state in states]
    assert 0.2 < widths[0] < 0.3
    assert widths[1:] == sorted(widths[1:])
    # Widths of a star out of focus grow with the distance from it.
    assert widths[3] / widths[2] == pytest.approx(120.0 / 80.0, rel=0.02)


def test_whiskers_have_the_angle_and_length_of_the_ellipticity():
    e, angle = 0.1, np.deg2rad(30.0)
    components = (e * np.cos(2.0 * angle), e * np.sin(2.0 * angle))
    view = WhiskersView(np.zeros(1), np.zeros(1), *(np.array([c]) for c in components), np.ones(1), "")
    x0, y0, x1, y1 = view.ends(50.0)
    assert np.hypot(x1 - x0, y1 - y0)[0] == pytest.approx(5.0)
    assert np.arctan2(y1 - y0, x1 - x0)[0] == pytest.approx(angle)


def test_the_section_names_every_surface_with_its_radius():
    scene = Scene.of(BENCH, BENCH.start)
    pieces = {piece.name: piece for piece in section_view(scene, layout_of(scene)).pieces}
    assert set(BENCH.nominal.surface_names) <= set(pieces)
    assert pieces["M1"].text == f"radius {BENCH.nominal.surface('M1').shape.parameters['radius']:.6g} m, mirror"
    assert pieces["L1"].glass


def test_spots_at_infinity_are_in_angles():
    bench = Bench(replace(pachon.load_telescope("lsst_v3.3_r"), camera=None, design_data=DesignData(afocal=True)))
    scene = Scene.of(bench, bench.start)
    view = spots_view(scene)
    assert sensitivity_view(scene, SPOTS).unit == "urad"
    table = numbers(view, None, None, None)
    assert [table[f"spot rms radius, {name}"][1] for name in ("median", "largest")] == ["urad", "urad"]
    assert "[urad]" in python_text(bench, bench.start)


def test_light_that_does_not_arrive_is_one_line():
    scene = Scene.of(BENCH, replace(BENCH.start, optics={"M2_dz": 1e8}))
    with pytest.raises(PachonError) as caught:
        spots_view(scene)
    assert "\n" not in str(caught.value)


@pytest.mark.long
@pytest.mark.parametrize("state", [FULL, BENCH.start])
def test_the_python_program_prints_the_numbers_of_the_desk(state, capsys, tmp_path):
    path = tmp_path / "desk.py"
    path.write_text(python_text(BENCH, state), encoding="utf-8")
    names = runpy.run_path(str(path))
    view = opd_view(Scene.of(BENCH, state))
    np.testing.assert_allclose(names["zernikes"].coefficients[0, 3:] * 1e9, view.zernikes_nm, rtol=1e-9, atol=1e-6)
    assert "rms radius of the spot [um]" in capsys.readouterr().out


@pytest.mark.parametrize("kind", ["gregorian", "ritchey-chretien"])
def test_whiskers_without_a_camera_stand_where_their_stars_land(kind):
    """A Gregorian turns the sky by half a circle against a Cassegrain."""
    telescope = pachon.new_telescope(kind)
    places, fields = Bench(telescope).stars()
    assert pachon.fields_at(telescope, places) == pytest.approx(fields, abs=1e-9)
    assert np.sign(places[-1, 1]) == (-1.0 if kind == "gregorian" else 1.0) * np.sign(fields[-1, 1])


@pytest.mark.long
def test_a_lens_without_a_camera_has_radii_and_thicknesses(tmp_path):
    pachon.save_telescope(pachon.new_telescope("triplet"), tmp_path / "triplet.yaml")
    bench = Bench(str(tmp_path / "triplet.yaml"))
    assert {"S1_radius", "S2_thickness"} <= set(bench.freedoms.names)
    state = bench.start.with_value("optics.S1_radius", 0.1)
    assert (
        spots_view(Scene.of(bench, state)).rms_um.max() > 1.05 * spots_view(Scene.of(bench, bench.start)).rms_um.max()
    )
    assert np.isfinite(whiskers_view(Scene.of(bench, state)).fwhm_arcsec).all()
    path = tmp_path / "desk.py"
    path.write_text(python_text(bench, state), encoding="utf-8")
    changed = runpy.run_path(str(path))["telescope"]
    radius = bench.nominal.surface("S1").shape.parameters["radius"]
    assert changed.surface("S1").shape.parameters["radius"] == pytest.approx(radius + 1e-4, rel=1e-9)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["desk"], "pachon desk needs Bokeh: pip install 'pachon[desk]'"),
        (["desk", "--port", "0"], "'--port'"),
    ],
)
def test_a_desk_that_cannot_open_is_one_line(arguments, message, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "bokeh", None)
    assert main(arguments) == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert message in err
