"""Shims: motions that undo known motions, minima by brute force, the configuration with the shims."""

import json
from dataclasses import replace

import numpy as np
import pytest

from pachon.commands.cli import main
from pachon.core.errors import ConfigError
from pachon.core.files import json_text
from pachon.core.units import ARCSEC
from pachon.measure.correlation import SeparationBins, shear_correlation
from pachon.models.camera.focal_plane import FocalPlane
from pachon.pipeline.config import Configuration, load_configuration, with_options
from pachon.pipeline.experiment import Experiment
from pachon.pipeline.simulate.ccd_exposure import expose_positions
from pachon.reconstruction.focal_plane_psf.height_series import HeightSeries
from pachon.studies.shimming.curves import E, G, Places, T, focus_curves, measured
from pachon.studies.shimming.pairs import PairSum, separation_edges
from pachon.studies.shimming.product import shim_metrics
from pachon.studies.shimming.shim import (
    STATES,
    Motion,
    _best_motions,
    draw_shims,
    moved_parts,
    shim,
    shimmed_configuration,
)
from pachon.wavefront.chief_rays import fields_at

# Three CCDs that are not in a row hold a raft.
OPTIONS = {"ccds": ("R34_S00", "R34_S11", "R34_S20"), "psf__engine": "long_exposure", "wavelengths_nm": (620.0,)}


def experiment_of(**options):
    return Experiment.from_config(with_options(Configuration(), **(OPTIONS | options)))


@pytest.fixture(scope="module")
def built():
    return experiment_of(focal_plane__heights="lsstcam")


@pytest.fixture(scope="module")
def shims(built):
    return shim(built, threads=1)


@pytest.mark.long
def test_curves_are_the_engine_at_any_height(built):
    places = Places.gauss(built.focal_plane, ("R34_S11",), 3)
    curves = focus_curves(built, places, 40e-6)
    heights = np.random.default_rng(1).uniform(-40e-6, 40e-6, len(places.ccd))
    values, slopes = curves.at(heights), curves.slope(heights)
    camera = built.camera
    for i in (0, 4, 8):
        plane = FocalPlane.flat(camera).with_moved("R34", dz=heights[i])
        direct = measured(built, plane, places)[i]
        assert values[i, 0] == pytest.approx(direct[0], abs=2e-4)
        # One in a hundred of the weighted ellipticities of some 1e-2 at these heights; g is twice as large.
        assert values[i, E] == pytest.approx(direct[E], abs=2e-4)
        assert values[i, G] == pytest.approx(direct[G], abs=4e-4)
        assert values[i, T] == pytest.approx(direct[T], rel=1e-3)
    step = 1e-8
    differences = (curves.at(heights + step) - curves.at(heights - step)) / (2 * step)
    assert np.allclose(slopes, differences, rtol=1e-5, atol=1e-3)


def test_means_over_gauss_nodes_are_those_over_the_area():
    # A quadratic of four CCDs, in closed form.
    plane = FocalPlane.flat()
    names = ("R22_S11", "R22_S12")
    places = Places.gauss(plane, names, 3)
    # 4004 pixels along x; R22_S12 stands beside R22_S11 along y.
    assert places.mean(places.offset[:, 0] ** 2) == pytest.approx(20.02e-3**2 / 3, rel=1e-12)
    assert places.mean(places.position[:, 1]) == pytest.approx(42.25e-3 / 2, rel=1e-12)


@pytest.mark.long
def test_known_motions_are_undone():
    """Whatever a raft is moved by, its shims bring it to the same place: where it is best."""
    flat = experiment_of(focal_plane__budget="flat")
    moved = replace(flat, focal_plane=flat.focal_plane.with_moved("R34", dz=7e-6, rx=4e-5, ry=-9e-5))
    x, y = flat.camera.centers[[flat.camera.ccd_index(n) for n in flat.config.ccds]].T
    one, other = (shim(e, merit="ellipticity", threads=1).focal_plane.height(x, y) for e in (flat, moved))
    # The curves of the two span different ranges. The minimum is flat: 0.1 um changes the mean width by 1e-6 of it.
    assert np.allclose(one, other, rtol=0, atol=0.1e-6)


@pytest.mark.long
def test_a_shimmed_raft_is_sharpest(built, shims):
    """Brute force: the engine finds larger mean widths after any further motion, by as much one way as the other."""
    fit = Places.gauss(built.focal_plane, built.config.ccds, 3)

    def width(**motion):
        plane = moved_parts(shims.focal_plane, {"R34": Motion(**motion)})
        return fit.mean(measured(built, plane, fit)[:, 0])

    best = width()
    # From the curves, which hold to 1e-4 each and better in the mean.
    assert shims.fitted["shimmed"].fwhm == pytest.approx(best, abs=2e-5)
    for key, step in (("dz", 3e-6), ("rx", 6e-5), ("ry", 6e-5)):
        plus, minus = width(**{key: step}), width(**{key: -step})
        assert min(plus, minus) > best
        # The derivative vanishes: the parabola through three points has its vertex within a tenth of the step.
        assert abs(plus - minus) < 0.2 * (plus + minus - 2 * best)


def pair_by_pair(sky, weight, e, edges):
    """xi+ of each bin with pairs, by all pairs at once."""
    i, j = np.triu_indices(len(sky), 1)
    which = np.searchsorted(edges, np.hypot(*(sky[i] - sky[j]).T), side="right") - 1
    chosen = [np.flatnonzero(which == b) for b in range(len(edges) - 1)]
    share = weight[i] * weight[j]
    return np.array([share[c] @ (e[i[c]] * e[j[c]]).sum(axis=1) / share[c].sum() for c in chosen if len(c)])


def test_pair_sums_are_those_of_treecorr_and_their_derivatives_finite_differences():
    rng = np.random.default_rng(5)
    sky, weight, e = rng.uniform(0, 0.01, (60, 2)), rng.uniform(0.5, 2.0, 60), rng.normal(0, 1e-2, (60, 2))
    edges = separation_edges(0.5e-3, 9e-3)
    assert len(edges) == 9
    assert np.allclose(np.diff(np.log(edges)), np.log(18) / 8)
    pairs = PairSum.of(sky, weight, edges)
    expected = pair_by_pair(sky, weight, e, edges)
    assert pairs.xi_plus(e) == pytest.approx(expected, rel=1e-12)
    found = shear_correlation(*sky.T, *e.T, bins=SeparationBins(edges[0], edges[-1], 8), weight=weight)
    # TreeCorr keeps ellipticities in single precision.
    assert found.xi_plus[found.n_pairs > 0] == pytest.approx(expected, abs=1e-7 * (e**2).sum(axis=1).mean())
    value, slope = pairs.mean_square(e)
    assert value == pytest.approx((expected**2).mean(), rel=1e-12)
    for i, k in ((0, 0), (17, 1), (59, 0)):
        step = np.zeros_like(e)
        step[i, k] = 1e-6
        difference = (pairs.mean_square(e + step)[0] - pairs.mean_square(e - step)[0]) / 2e-6
        assert slope[i, k] == pytest.approx(difference, rel=1e-6)


@pytest.mark.slow
def test_no_motion_of_a_grid_has_a_smaller_correlation(built):
    """Brute force over piston and tilts of a raft of three CCDs, with the correlation pair by pair."""
    found = shim(built, merit="xi", threads=1)
    fit, check = (Places.gauss(built.focal_plane, built.config.ccds, order) for order in (5, 4))
    curves = focus_curves(built, fit, 40e-6)
    sky, other = (fields_at(built.telescope, places.position, 620e-9) for places in (fit, check))
    positions, both = np.concatenate([fit.position, check.position]), np.concatenate([sky, other])
    longest, on_detector = (np.hypot(*np.ptp(values, axis=0)) for values in (both, positions))
    # A quarter of the shortest side of all CCDs, 4000 pixels.
    edges = separation_edges(0.25 * 40.00e-3 * longest / on_detector, longest)

    def correlation(heights):
        return float(np.sqrt((pair_by_pair(sky, fit.weight, curves.at(heights)[:, G], edges) ** 2).mean()))

    heights = fit.heights(found.focal_plane)
    best = correlation(heights)
    # Single precision of TreeCorr, and a series that spans other heights.
    assert found.fitted["shimmed"].rms_xi_g == pytest.approx(best, rel=2e-3)
    assert best < correlation(fit.heights(shim(built, merit="ellipticity", threads=1).focal_plane))
    x, y = (fit.position - fit.position.mean(axis=0)).T
    steps = np.array([-6.0, -2.0, 0.0, 2.0, 6.0]) * 1e-6
    others = [correlation(heights + dz + rx * y / 0.04 + ry * x / 0.04) for dz in steps for rx in steps for ry in steps]
    assert len(others) == 125
    assert min(others) >= best * (1 - 1e-9)


@pytest.mark.long
def test_gains_are_in_order_and_checked_elsewhere(built, shims):
    for states in (shims.fitted, shims.checked):
        assert tuple(states) == STATES
        assert states["as built"].fwhm > states["focused"].fwhm - 1e-6
        assert states["focused"].fwhm > states["shimmed"].fwhm - 1e-5
        assert states["shimmed"].fwhm > states["plane"].fwhm
        for state in states.values():
            # The round weight makes PSFs rounder: that of 0.7" halves g of this seeing.
            assert 1.5 < state.rms_g / state.rms_e < 2.5
            assert 2.0 < state.rms_xi_g / state.rms_xi < 6.0
    ccds = shim(built, parts="ccds", threads=1)
    assert len(ccds.motions) == 3
    assert ccds.fitted["shimmed"].fwhm < shims.fitted["shimmed"].fwhm


@pytest.mark.long
def test_correlations_are_along_the_axes_of_a_turned_camera(shims):
    """The telescope is nearly the same in all directions, so that a turn of its camera changes no xi+ and no xi-."""
    turned = shim(experiment_of(focal_plane__heights="lsstcam", rotator_deg=30.0), threads=1)
    for state in ("as built", "focused"):
        correlation, found = shims.correlations[state], turned.correlations[state]
        largest = np.abs(correlation.xi_minus).max()
        assert found.xi_minus == pytest.approx(correlation.xi_minus, abs=0.05 * largest)
        assert found.xi_plus == pytest.approx(correlation.xi_plus, abs=0.05 * largest)


@pytest.mark.long
def test_the_configuration_with_the_shims_is_the_shimmed_focal_plane(built, shims):
    plain = with_options(built.config, focal_plane__moved={"R34": {"dz_um": 1.0}, "R22_S11": {"rx_urad": 5.0}})
    config = shimmed_configuration(plain, shims)
    plane = Experiment.from_config(config).focal_plane
    expected = shims.focal_plane.with_moved("R34", dz=1e-6).with_moved("R22_S11", rx=5e-6)
    x, y = np.random.default_rng(3).uniform(-0.3, 0.3, (2, 500))
    assert np.allclose(plane.height(x, y), expected.height(x, y), rtol=0, atol=1e-13, equal_nan=True)


@pytest.mark.long
def test_the_command_writes_motions_gains_and_a_configuration(tmp_path, capsys):
    out = tmp_path / "shims"
    arguments = ["shim", "--heights", "lsstcam", "--ccds", "R22_S11", "--parts", "ccds", "-o", str(out)]
    assert main([*arguments, "--json", "--threads", "2"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert list(found["motions"]) == ["R22_S11"]
    assert {p.name for p in out.iterdir()} == {
        "shims.ecsv",
        "correlations.ecsv",
        "shims.json",
        "shims.png",
        "config.yaml",
    }
    moved = load_configuration(out / "config.yaml").focal_plane.moved
    assert "R22_S11" in moved
    # One thread, the same numbers.
    config = with_options(load_configuration(out / "config.yaml"), focal_plane__moved={})
    again = shim(Experiment.from_config(config), parts="ccds", threads=1)
    assert json.loads(json_text(shim_metrics(again))) == found


def test_bad_arguments_are_one_line(capsys):
    experiment = experiment_of(focal_plane__heights="lsstcam")
    with pytest.raises(ConfigError, match="merit = 'size': expected one of fwhm, ellipticity, xi"):
        shim(experiment, merit="size")
    with pytest.raises(ConfigError, match="parts = 'raft': expected one of rafts, ccds"):
        shim(experiment, parts="raft")
    with pytest.raises(ConfigError, match=r"psf\.engine = fast: expected long_exposure"):
        shim(experiment_of(psf__engine="fast"))
    assert main(["shim", "--heights", "nowhere"]) == 2
    assert "focal_plane.heights = nowhere: expected lsstcam" in capsys.readouterr().err


def test_a_flat_focal_plane_in_focus_does_not_saturate_the_plot():
    flat = FocalPlane.flat("decam")
    focused = moved_parts(flat, {name: Motion(dz=17e-6) for name in flat.names})
    figure = draw_shims(None, {"focused as a whole": focused, "motions of ccds": flat.with_moved("S5", dz=-1e-6)})
    lowest, highest = figure.axes[0].images[-1].get_clim()
    assert lowest == -highest
    assert 17.0 <= highest < 25.0


def test_ccds_without_rafts_are_refused_before_the_images_are_made(monkeypatch, tmp_path, capsys):
    """HSC's, whose curves of focus take half a minute for four CCDs."""
    monkeypatch.setattr("pachon.studies.shimming.shim.focus_curves", lambda *_: pytest.fail("curves were computed"))
    assert main(["shim", "--set", "telescope=hsc", "--ccds", "hsc049", "-o", str(tmp_path / "out")]) == 2
    assert (
        capsys.readouterr()
        .err.splitlines()[-1]
        .endswith("--parts = rafts: expected ccds, as hsc049 of hsc is on no raft")
    )


@pytest.mark.long
def test_measured_shapes_are_those_of_hsm(built):
    """GalSim's adaptive moments of the same images; T of its sigma, which is that of the determinant."""
    galsim = pytest.importorskip("galsim")
    places = Places.gauss(built.focal_plane, ("R34_S11",), 2)
    values = measured(built, built.focal_plane, places, 1)
    stars = expose_positions(built, places.position, 1)
    for row, image in zip(values, stars.image, strict=True):
        found = galsim.hsm.FindAdaptiveMom(galsim.Image(np.asarray(image, dtype=float)))
        g = found.observed_shape
        # As in the tests of adaptive moments: the two stop at other iterations.
        assert row[G] == pytest.approx([g.g1, g.g2], abs=2e-6)
        sigma = found.moments_sigma * stars.pixel_scale / ARCSEC
        assert row[T] == pytest.approx(2.0 * sigma**2 * (1.0 + g.g**2) / (1.0 - g.g**2), rel=1e-5)


def test_a_focus_far_from_the_prescription_is_met(monkeypatch):
    """Widths of a parabola: bands other than the prescription's are in focus tens of um away, AuxTel 230 um."""
    built = experiment_of(telescope="decam", band="g", ccds=("N4", "S4"))
    heights = np.array([-230e-6, -226e-6])
    middle = np.array([built.camera.ccd_index(name) for name in ("N4", "S4")])

    def widths(experiment, plane, places, threads=None):
        best = heights[(places.ccd == middle[1]).astype(int)]
        width = 0.8 + ((places.heights(plane) - best) / 1e-4) ** 2
        shape = np.full_like(width, 0.01)
        return np.stack([width, shape, shape, width**2, shape, shape], axis=1)

    monkeypatch.setattr("pachon.studies.shimming.curves.measured", widths)
    monkeypatch.setattr("pachon.studies.shimming.shim.measured", widths)
    found = shim(built, parts="ccds", threads=1)
    assert found.focus.dz == pytest.approx(-228e-6, abs=1e-6)
    assert found.focal_plane.height(*built.camera.centers[middle].T) == pytest.approx(heights, abs=0.05e-6)
    assert found.checked["shimmed"].fwhm == pytest.approx(0.8, abs=1e-7)


def test_motions_stay_within_the_curves_however_large_the_merit():
    """A tilt by which two columns of places are rounder would lift the third, whose g is constant, to 90 um of 30."""
    places = Places.gauss(FocalPlane.flat("decam"), ("N4",), 3)
    column = np.rint(places.offset[:, 0] / np.abs(places.offset[:, 0]).max()).astype(int)
    coefficients = np.zeros((2, len(places.ccd), 6))
    coefficients[0, :, G.start] = 0.1
    coefficients[1, :, G.start] = np.choose(column + 1, [0.09, -0.09, 0.0])
    curves = HeightSeries(coefficients, 30e-6)
    center, rows = places.position.mean(axis=0), np.arange(len(places.ccd))
    (motion,) = _best_motions(curves, places, np.zeros(len(rows)), [(center, rows)], "ellipticity", None)
    heights = motion.dz - (places.position[:, 0] - center[0]) * np.tan(motion.ry)
    assert 29e-6 < np.abs(heights).max() < 31e-6
