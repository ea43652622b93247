import json

import numpy as np
import pytest
from astropy.table import Table
from scipy.special import j0

from pachon.commands.cli import main
from pachon.core.errors import ConfigError, DomainError, UnknownNameError
from pachon.core.units import ARCSEC
from pachon.measure.correlation import SeparationBins, shear_correlation
from pachon.measure.shapes import measure_shapes
from pachon.measure.stamps import center_stamps
from pachon.pipeline.config import load_configuration, with_options
from pachon.pipeline.experiment import Experiment
from pachon.pipeline.focal_plane_stage import apply_focal_plane_model
from pachon.pipeline.simulate.ccd_exposure import expose_ccd
from pachon.pipeline.simulate.ccd_model import model_ccd, model_ccds
from pachon.pipeline.summary import correlations
from pachon.reconstruction.ccd_product import CCD_KINDS, KINDS
from pachon.studies.attribution import attribution
from pachon.studies.attribution.attribution import attribute, change_errors, without_cause
from pachon.studies.attribution.causes import (
    CAUSES,
    FULL,
    GROUND_LIFT,
    NOISE,
    OPTICS,
    always_on,
    checked_causes,
    without,
)
from pachon.studies.attribution.product import write_attribution
from pachon.wavefront.atmosphere.turbulence import structure_function

RESIDUALS = ("at_stars", "left_out", "away")
#: All of them need a finished study, of seconds.
pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def attributed(tiny):
    return attribute(tiny(), ("tilt", "diffusion", "atmosphere", NOISE), threads=1)


def test_the_full_case_is_the_run(finished_run, attributed):
    summary = json.loads((finished_run / "summary.json").read_text())["all"]
    full = attributed.metrics[FULL]
    residuals = [f"{start}{end}" for start in ("rms_residual_", "rms_residual_g_", "rms_dt_g_") for end in RESIDUALS]
    for key in (*residuals, "fwhm_arcsec"):
        assert full[key] == pytest.approx(summary[key], rel=1e-8)  # nine digits in the file
    # Below 10' the summary averages the same pairs; with patches sums go in another order.
    for kind in ("truth", "observed", "residual", "away", "g_truth", "g_observed", "g_residual", "g_away"):
        assert full[f"xi_plus_{kind}_short"] == pytest.approx(summary[f"xi_plus_{kind}_short"], rel=1e-8)
    # g is about twice the weighted e of this seeing.
    assert 1.5 < full["rms_g_truth"] / full["rms_e_truth"] < 2.5


def test_a_case_is_a_run_without_the_cause(tiny, attributed):
    experiment = Experiment.from_config(with_options(tiny(), focal_plane__tilt=False))
    names = experiment.config.ccds
    products = [model_ccd(experiment, expose_ccd(experiment, name, threads=1)) for name in names]
    e = np.concatenate([[p.holdout.e1, p.holdout.e2] for p in products], axis=1)
    assert attributed.metrics["tilt"]["rms_e_truth"] == np.sqrt(np.mean(e**2))
    g = np.concatenate([[p.holdout.g1, p.holdout.g2] for p in products], axis=1)
    assert attributed.metrics["tilt"]["rms_g_truth"] == np.sqrt(np.mean(g**2))
    for kind, expected in correlations(products, KINDS).items():
        assert attributed.correlations["tilt"][kind].xi_plus.tobytes() == expected.xi_plus.tobytes()
    for kind, expected in correlations(products, KINDS, "g").items():
        assert attributed.correlations_g["tilt"][kind].xi_plus.tobytes() == expected.xi_plus.tobytes()
    assert attributed.metrics["tilt"]["rms_e_truth"] != attributed.metrics[FULL]["rms_e_truth"]


def test_changes_are_differences(attributed):
    full = attributed.metrics[FULL]
    assert not any(key.startswith(("change_", "error_")) for key in full)
    for case in ("tilt", "diffusion", "atmosphere", NOISE):
        figures = attributed.metrics[case]
        for key in full:
            # NaN without turbulence: images narrower than a pixel have no adaptive moments.
            np.testing.assert_equal(figures[f"change_{key}"], full[key] - figures[key])


def test_error_of_a_change_is_its_own_jackknife():
    rng = np.random.default_rng(0)
    x = np.concatenate([k * 0.02 + rng.uniform(0.0, 0.004, 12) for k in range(3)])
    y = rng.uniform(0.0, 0.004, 36)
    patch = np.repeat(np.arange(3), 12)
    bins = SeparationBins(1e-4, 0.05, 8)
    e, f = rng.normal(0.0, 0.02, (2, 2, 36))

    def long_range(ellipticity, keep):
        c = shear_correlation(x[keep], y[keep], *ellipticity[:, keep], bins=bins)
        inside = (c.r_arcmin >= 10.0) & (c.r_arcmin < 180.0) & (c.n_pairs > 0)
        return np.sum(c.n_pairs[inside] * c.xi_plus[inside]) / c.n_pairs[inside].sum()

    left = [long_range(e, patch != k) - long_range(f, patch != k) for k in range(3)]
    expected = np.sqrt(2.0 / 3.0 * np.sum((left - np.mean(left)) ** 2))
    kinds = ("truth", "observed", "residual", "away")
    one, other = (dict.fromkeys(kinds, shear_correlation(x, y, *v, bins=bins, patch=patch)) for v in (e, f))
    found = change_errors(one, other)
    assert found["error_xi_plus_away_long"] == pytest.approx(expected, rel=1e-9)  # sums in another order
    assert change_errors(one, other, "g")["error_xi_plus_g_away_long"] == found["error_xi_plus_away_long"]
    # Stars and their mates in the other case are the same: what both have in common is in no error.
    assert change_errors(one, one)["error_xi_plus_away_long"] == 0.0
    # A case whose images have no adaptive moments has no correlation of g.
    assert np.isnan(change_errors(one, {}, "g")["error_xi_plus_g_away_long"])


def test_without_noise_the_truth_stays(attributed):
    full, quiet = attributed.metrics[FULL], attributed.metrics[NOISE]
    assert quiet["rms_e_truth"] == full["rms_e_truth"]
    assert quiet["fwhm_arcsec"] == full["fwhm_arcsec"]
    assert quiet["rms_residual_at_stars"] < full["rms_residual_at_stars"]
    truth, same = attributed.correlations[FULL]["truth"], attributed.correlations[NOISE]["truth"]
    assert truth.xi_plus.tobytes() == same.xi_plus.tobytes()


def test_without_noise_the_model_is_that_of_bright_stars(tiny):
    # The limit of ever brighter stars through the noisy path: photons of 1e11 electrons scatter by 3e-6 of the light.
    experiment = Experiment.from_config(tiny(ccds=("R22_S11",)))
    exposure = expose_ccd(experiment, "R22_S11", threads=1)
    product = model_ccd(experiment, exposure)
    quiet = model_ccd(experiment, exposure, noisy=False)
    np.testing.assert_array_equal(quiet.holdout.e1, product.holdout.e1)
    stamps = center_stamps(exposure.observed.image, *_centroids(experiment, exposure), size=experiment.stamp_size)
    rng = np.random.default_rng(0)
    bright = rng.poisson(1e11 * np.maximum(stamps, 0.0)) / 1e11
    shapes = measure_shapes(bright, exposure.observed.pixel_scale, experiment.weight_fwhm)
    # Ten times that scatter; noisy stars of S/N 30 differ by 3e-2.
    np.testing.assert_allclose(quiet.observed.e1, shapes.e1, rtol=0.0, atol=3e-5)
    np.testing.assert_allclose(quiet.observed.e2, shapes.e2, rtol=0.0, atol=3e-5)
    assert np.abs(product.observed.e1 - shapes.e1).max() > 3e-4
    assert quiet.observed.used.all()
    assert np.isfinite(quiet.observed.leave_one_out_e1).all()


def _centroids(experiment, exposure):
    first = measure_shapes(exposure.observed.image, exposure.observed.pixel_scale, experiment.weight_fwhm)
    return first.x, first.y


def test_causes_do_what_they_should(attributed):
    full = attributed.metrics[FULL]["fwhm_arcsec"]
    # Charge diffusion of 0.4 pixel of 0.2" adds 0.08" rms, 0.19" FWHM, about in quadrature to a seeing-limited core.
    sharper = attributed.metrics["diffusion"]["fwhm_arcsec"]
    assert np.sqrt(full**2 - sharper**2) == pytest.approx(0.19, rel=0.2)
    assert attributed.metrics["atmosphere"]["fwhm_arcsec"] < 0.75 * full


def test_optics_off_leaves_the_air_alone(tiny):
    """The mean over all turbulence is round: what ellipticity there is, the telescope makes."""
    config = tiny(psf__engine="long_exposure", ccds=("R22_S11", "R24_S12"))
    figures = attribute(config, ("heights", OPTICS), threads=1).metrics
    # Heights of some micrometres do most, the design a little.
    assert figures["full"]["rms_e_truth"] > figures["heights"]["rms_e_truth"] > figures[OPTICS]["rms_e_truth"]
    # A flat detector stretches the sky by 1/cos along the radius more than across: e = 2.2e-4 at 1.7 deg.
    assert figures[OPTICS]["rms_e_truth"] < 3e-4
    experiment = Experiment.from_config(config)
    alone = without_cause(experiment, OPTICS)
    full, air = (expose_ccd(e, "R24_S12", threads=1) for e in (experiment, alone))
    np.testing.assert_array_equal(full.holdout.fields, air.holdout.fields)
    assert air.holdout.pixel_scale == pytest.approx(full.holdout.pixel_scale, rel=1e-12)
    np.testing.assert_allclose(air.holdout.lit_fraction, 1.0, rtol=1e-6)  # no rim of a camera in the way
    # What air, diffusion (0.4 pixel rms) and pixel (rms 0.29 of its side, 0.2") make of a point: a Hankel transform.
    # Of diffraction it knows the rims: each takes r times its diameter from the overlap of the pupil with itself.
    r, angle = np.linspace(0.0, 4.0, 4001)[1:], np.linspace(0.0, 0.6, 601) * ARCSEC
    outer, inner = 4.18, 0.61 * 4.18
    pupil = np.maximum(1.0 - 4.0 * r * (outer + inner) / (2.0 * np.pi * (outer**2 - inner**2)), 0.0)
    blur = np.hypot(0.4, 12.0**-0.5) * 0.2 * ARCSEC
    image = np.zeros(len(angle))
    for wavelength in (560e-9, 680e-9):
        air = 0.5 * (2.0 * np.pi / wavelength) ** 2 * structure_function(r, 0.16, 25.0)
        seen = pupil * np.exp(-air - 0.5 * (2.0 * np.pi * r / wavelength * blur) ** 2) * r
        image += (j0(2.0 * np.pi * angle[:, None] * r / wavelength) * seen).sum(axis=1) / wavelength**2
    expected = 2.0 * np.interp(0.5, image[::-1] / image[0], angle[::-1]) / ARCSEC
    assert figures[OPTICS]["fwhm_arcsec"] == pytest.approx(expected, rel=0.01)


@pytest.mark.slow
def test_a_ccd_that_one_case_cannot_model_is_left_out_of_all(tiny, monkeypatch):
    options = {"psf__engine": "long_exposure"}
    alone = attribute(tiny(**options, ccds=("R22_S11",)), ("diffusion",), threads=1)

    def model_or_fail(experiment, exposures, **how):
        products = model_ccds(experiment, exposures, **how)
        if experiment.config.psf.diffusion_pixels:
            return products
        error = DomainError("stamps[3] has no flux left outside its outliers")
        return [p if e.name == "R22_S11" else error for e, p in zip(exposures, products, strict=True)]

    monkeypatch.setattr(attribution, "model_ccds", model_or_fail)
    found = attribute(tiny(**options, ccds=("R22_S11", "R24_S12")), ("diffusion",), threads=1)
    assert found.left_out == {"R24_S12": "stamps[3] has no flux left outside its outliers"}
    assert repr(found.metrics) == repr(alone.metrics)  # NaN are equal
    with pytest.raises(DomainError, match=r"CCD R24_S12: .* no CCD can be modelled in all cases"):
        attribute(tiny(**options, ccds=("R24_S12",)), ("diffusion",), threads=1)


def test_a_lifted_ground_layer_is_the_same_air(tiny):
    full = Experiment.from_config(tiny())
    lifted = without_cause(full, "ground_layer")
    np.testing.assert_array_equal(lifted.atmosphere.altitudes[1:], full.atmosphere.altitudes[1:])
    assert (full.atmosphere.altitudes[0], lifted.atmosphere.altitudes[0]) == (0.0, GROUND_LIFT)
    asked = Experiment.from_config(with_options(tiny(), atmosphere__ground_lift_m=GROUND_LIFT))
    np.testing.assert_array_equal(lifted.atmosphere.altitudes, asked.atmosphere.altitudes)
    assert lifted.atmosphere.screens("slopes") is full.atmosphere.screens("slopes")


def test_the_command_names_every_cause(capsys):
    assert main(["attribute", "--help"]) == 0
    words = set(capsys.readouterr().out.replace(",", " ").replace(";", " ").split())
    assert words > set(CAUSES)


def test_without_heights_or_active_optics_nothing_is_moved(tiny):
    """Shims are motions of rafts: without the heights that they make up for, they would be heights themselves."""
    for options in ({}, {"focal_plane__budget": "flat"}, {"focal_plane__heights": "lsstcam"}):
        full = Experiment.from_config(tiny(focal_plane__moved={"R22": {"dz_um": 12.0}}, **options))
        assert "heights" in checked_causes(full.config)
        flat = without_cause(full, "heights").focal_plane
        assert not flat.height(*flat.camera.centers.T).any()
    misaligned = with_options(tiny(), active_optics__states="states.ecsv")
    assert "active_optics" in checked_causes(misaligned)
    assert without(misaligned, "active_optics").active_optics.states is None


def test_causes_that_are_off_are_no_causes(tiny):
    config = tiny()
    assert checked_causes(config) == tuple(c for c in CAUSES if c not in ("active_optics", *OFF))
    config = tiny(focal_plane__tilt=False, psf__diffusion_pixels=0.0, active_optics__residual_um=0.2)
    assert not {"tilt", "diffusion"} & set(checked_causes(config))
    assert "active_optics" in checked_causes(config)
    assert not {"heights", "ccd"} & set(checked_causes(tiny(focal_plane__budget="flat")))
    for engine in ("long_exposure", "statistical"):
        of_engine = tiny(psf__engine=engine, atmosphere__exposure_s=15.0)
        assert "atmosphere" not in checked_causes(of_engine)
        assert always_on(of_engine) == {"atmosphere": f"psf.engine = {engine}, which needs it"}
    assert always_on(config) == always_on(tiny(atmosphere__enabled=False)) == {}
    for options, cause, message in (
        ({"focal_plane__tilt": False}, "tilt", "focal_plane.tilt = false"),
        ({"focal_plane__budget": "flat"}, "heights", "focal_plane.budget = flat"),
        ({"psf__engine": "long_exposure"}, "atmosphere", "psf.engine = long_exposure"),
        ({"psf__diffusion_pixels": 0.0}, "diffusion", "psf.diffusion_pixels = 0"),
        ({}, "active_optics", "active_optics.residual_um = 0"),
        ({"atmosphere__ground_lift_m": 200.0}, "ground_layer", "no layer is on the ground"),
        ({"reconstruction__model": "focal_plane"}, "atmosphere", "reconstruction.model = focal_plane, which needs it"),
        ({"psf__engine": "long_exposure"}, "ground_layer", "no star is imaged through turbulence"),
        ({"atmosphere__enabled": False}, OPTICS, "nothing would be left"),
    ):
        with pytest.raises(ConfigError, match=message):
            attribute(tiny(**options), (cause,))
    with pytest.raises(UnknownNameError, match="did you mean tilt"):
        attribute(config, ("tillt",))


def test_files_hold_what_was_returned(tiny, attributed, tmp_path):
    files = write_attribution(attributed, tmp_path, tiny())
    assert load_configuration(tmp_path / "config.yaml") == tiny()
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(files)
    table = Table.read(tmp_path / "attribution.ecsv")
    assert list(table["off"]) == list(attributed.metrics)
    assert table["change_rms_e_truth"][1] == attributed.metrics["tilt"]["change_rms_e_truth"]
    assert np.isnan(table["change_rms_e_truth"][0])
    assert all(column.description for column in table.itercols())
    xi = Table.read(tmp_path / "correlations.ecsv")
    rows = xi[xi["kind"] == "diffusion away"]
    np.testing.assert_array_equal(rows["xi_plus"], attributed.correlations["diffusion"]["away"].xi_plus)
    xi = Table.read(tmp_path / "correlations_g.ecsv")
    rows = xi[xi["kind"] == "diffusion away"]
    np.testing.assert_array_equal(rows["xi_plus"], attributed.correlations_g["diffusion"]["away"].xi_plus)
    for key, words in (
        ("rms_g_truth", "rms of one component of g of adaptive moments, truth"),
        ("rms_residual_g_at_stars", "rms of one component of g of adaptive moments, residual at stars"),
        ("rms_residual_away", "rms of one component of the weighted e, residual away"),
        ("rms_dt_g_away", "rms of (T - T model)/T of adaptive moments, away"),
        ("xi_plus_g_truth_long", "mean xi+ of g, truth, 10 to 180 arcmin"),
    ):
        assert table[key].description == words
    assert (tmp_path / "attribution.png").read_bytes().startswith(b"\x89PNG")


def test_command_line(settings_file, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("pachon.studies.attribution.product.attribution_plot", lambda *_: b"")
    out = tmp_path / "out"
    command = ["attribute", str(settings_file), "--out", str(out), "--average", "--threads", "1", "--quiet"]
    assert main([*command, "--causes", "ccd,noise", "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert list(figures) == ["ccd", "full", "noise"]
    assert json.loads((out / "attribution.json").read_text())["figures"] == figures
    assert main([*command[:-1], "--causes", "noise", "--ccds", "R22_S11"]) == 0
    printed = capsys.readouterr()
    assert "everything on" in printed.err
    assert printed.out.endswith(f"attribution: {out.resolve()}\n")
    assert main(["attribute", "--help"]) == 0
    assert "pachon attribute " in capsys.readouterr().out.partition("Examples")[2]


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["--causes", "wind"], ["'wind'"]),
        (["--causes", ","], ["--causes = ','"]),
        (["--causes", "atmosphere", "--average"], ["atmosphere cannot be switched off", "long_exposure"]),
        (["--raft", "R22", "--ccds", "R22_S11"], ["--ccds and --raft"]),
        (["--ccds", "R22_S1l"], ["did you mean R22_S"]),
    ],
)
def test_bad_input_is_one_line(settings_file, tmp_path, capsys, arguments, parts):
    assert main(["attribute", str(settings_file), "--out", str(tmp_path / "out"), *arguments]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert err.startswith("pachon: error: ")
    for part in parts:
        assert part in err
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_cases_have_the_focal_plane_model_that_a_run_has(focal_plane_config, plane_model, tmp_path):
    config = focal_plane_config()
    result = attribute(config, ("tilt", NOISE), threads=1)
    assert plane_model.fits == 3
    for case, options, noisy in ((FULL, {}, True), ("tilt", {"focal_plane__tilt": False}, True), (NOISE, {}, False)):
        experiment = Experiment.from_config(with_options(config, **options))
        products = [model_ccd(experiment, expose_ccd(experiment, name, threads=1), noisy=noisy) for name in config.ccds]
        applied, _ = apply_focal_plane_model(experiment, products)
        expected = correlations(applied, (*KINDS, *CCD_KINDS))
        assert tuple(result.correlations[case]) == tuple(expected)
        for kind, found in result.correlations[case].items():
            assert found.xi_plus.tobytes() == expected[kind].xi_plus.tobytes()
        metrics = result.metrics[case]
        for end, of in (("", applied), ("_ccd", products)):
            away = np.concatenate([p.ellipticity("away") for p in of], axis=1)
            assert metrics[f"rms_residual_away{end}"] == np.sqrt(np.mean(away**2))
    tilt, full = result.metrics["tilt"], result.metrics[FULL]
    key = "xi_plus_away_ccd_short"
    assert tilt[f"change_{key}"] == full[key] - tilt[key]
    assert "atmosphere" not in checked_causes(config)
    write_attribution(result, tmp_path, config)
    table = Table.read(tmp_path / "attribution.ecsv")
    assert table[key].description == "mean xi+ of the weighted e, away of the CCDs' own models, 0 to 10 arcmin"
    assert table["xi_plus_away_short"].description == "mean xi+ of the weighted e, away, 0 to 10 arcmin"


SENSORS = {
    "detector__silicon": True,
    "sensor__brighter_fatter": "e2v",
    "sensor__tree_rings_um": 2.0,
    "sensor__edge_rolloff_um": 40.0,
    "sensor__edge_rolloff_length_um": 5000.0,
}


OFF = {
    "absorption_depth": {"detector__silicon": False},
    "brighter_fatter": {"sensor__brighter_fatter": None},
    "tree_rings": {"sensor__tree_rings_um": 0.0},
    "edge_rolloff": {"sensor__edge_rolloff_um": 0.0},
}


@pytest.mark.slow
def test_silicon_and_sensor_effects_are_causes_where_they_are_on(tiny):
    names = ("absorption_depth", "brighter_fatter", "tree_rings", "edge_rolloff")
    assert not set(names) & set(checked_causes(Experiment.from_config(tiny()).config))
    on = Experiment.from_config(tiny(**SENSORS)).config
    assert set(names) < set(checked_causes(on))
    reasons = ("detector.silicon = false", "sensor.brighter_fatter = null", "sensor.tree_rings_um = 0")
    for name, reason in zip(names, (*reasons, "sensor.edge_rolloff_um = 0"), strict=True):
        with pytest.raises(ConfigError, match=f"^{name} cannot be switched off: {reason}$"):
            checked_causes(tiny(), [name])
        # One key, and nothing else, is another one.
        assert without(on, name) == Experiment.from_config(tiny(**(SENSORS | OFF[name]))).config


def test_a_case_without_a_sensor_effect_is_the_run_without_it(tiny):
    """On each CCD the stars of every case are those of an experiment whose configuration never had the effect."""
    on = tiny(ccds=("R22_S11",), psf__engine="long_exposure", wavelengths_nm=(690.0,), **SENSORS)
    result = attribute(on, list(OFF), threads=1)
    for name, options in OFF.items():
        plain = tiny(ccds=("R22_S11",), psf__engine="long_exposure", wavelengths_nm=(690.0,), **(SENSORS | options))
        experiment = Experiment.from_config(plain)
        product = model_ccd(experiment, expose_ccd(experiment, "R22_S11", threads=1))
        e = np.array([product.holdout.e1, product.holdout.e2])
        assert result.metrics[name]["rms_e_truth"] == np.sqrt(np.mean(e**2))
        changed = result.metrics[name]["change_rms_e_truth"] != 0.0
        # The noise-free PSF is that of a faint star, without the brighter-fatter effect.
        assert changed == (name != "brighter_fatter")
        assert result.metrics[name]["change_rms_residual_at_stars"] != 0.0
