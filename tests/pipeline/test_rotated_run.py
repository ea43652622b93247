"""A rotated camera in a run: positions and shapes are the camera's, field angles and air the telescope's."""

import dataclasses

import numpy as np
import pytest
import treecorr

import pachon
from pachon.core.errors import DomainError
from pachon.core.long_work import Execution
from pachon.pipeline import run as run_module
from pachon.pipeline.config import with_options
from pachon.pipeline.experiment import Experiment
from pachon.pipeline.report.diagnostics import diagnose
from pachon.pipeline.run import run
from pachon.pipeline.run_folder import stamp_of
from pachon.pipeline.simulate.ccd_exposure import expose_positions
from pachon.pipeline.summary import correlations, separation_bins
from pachon.reconstruction.ccd_product import product_path, read_product, write_product
from pachon.reconstruction.focal_plane_psf import model as focal_plane_model
from pachon.reconstruction.focal_plane_psf import static_heights
from pachon.reconstruction.focal_plane_psf.response import Instrument
from pachon.studies.metrics.scene import Scene
from pachon.studies.sweep.file import read_sweep
from pachon.studies.sweep.point import point_experiment
from pachon.studies.sweep.store import SweepPoint

QUARTER = {"rotator_deg": 90.0}
POSITIONS = np.array([[0.005, -0.012], [0.24, 0.06], [-0.13, 0.2]])


@pytest.fixture
def mean_air(tiny):
    """An experiment of the mean over turbulence, M2 off its axis: ``mean_air(rotator_deg=90.0)``."""

    def make(**options):
        shift = options.pop("shift", (400.0, -900.0))
        changes = {"M2.dx_um": shift[0], "M2.dy_um": shift[1]}
        mine = {"psf__engine": "long_exposure", "wavelengths_nm": [560.0, 680.0], "changes": changes}
        return Experiment.from_config(tiny(**(mine | options)))

    return make


def test_whole_turns_change_no_bit(mean_air):
    stars = [expose_positions(mean_air(rotator_deg=a), POSITIONS, 1) for a in (0.0, 360.0)]
    np.testing.assert_array_equal(stars[0].image, stars[1].image)
    np.testing.assert_array_equal(stars[0].fields, stars[1].fields)


def test_field_angles_are_the_telescopes_and_pixels_the_cameras(mean_air):
    # Shifting M2 the other way round is turning the camera; the zenith too stands still in the telescope frame.
    air = {"atmosphere__zenith_angle_deg": 50.0, "atmosphere__screen_length_m": 1300.0}
    turned = expose_positions(mean_air(**QUARTER, **air, atmosphere__zenith_position_angle_deg=70.0), POSITIONS, 1)
    still = mean_air(shift=(-900.0, -400.0), atmosphere__zenith_position_angle_deg=160.0, **air)
    expected = expose_positions(still, POSITIONS, 1)
    # Images are float32.
    assert np.abs(turned.image - expected.image).max() < 1e-6 * expected.image.max()
    x, y = expected.fields.T
    np.testing.assert_allclose(turned.fields, np.stack([-y, x], axis=1), atol=1e-12)
    unlike = expose_positions(mean_air(atmosphere__zenith_position_angle_deg=70.0, **air), POSITIONS, 1)
    assert np.abs(unlike.image - expected.image).max() > 0.01 * expected.image.max()


def test_the_ideal_telescope_has_the_rotator_too(mean_air):
    air = {"atmosphere__zenith_angle_deg": 50.0, "atmosphere__screen_length_m": 1300.0}
    one, other = (
        dataclasses.replace(mean_air(**options, **air), atmosphere_only=True)
        for options in (QUARTER, {"atmosphere__zenith_position_angle_deg": 180.0})
    )
    images = [expose_positions(e, POSITIONS, 1).image for e in (one, other)]
    # The dispersion of 0.5 arcsec points to -y of the rotated camera; of the ideal telescope nothing else is left.
    # Light travels 840 km to its focus, where rounding is 1e-5 of a pixel.
    assert np.abs(images[0] - images[1]).max() < 5e-5 * images[1].max()
    assert np.abs(images[1] - images[1].transpose(0, 2, 1)).max() > 0.01 * images[1].max()


def test_correlations_take_positions_along_the_axes_of_the_ellipticities(finished_run, tiny, tmp_path):
    angle = np.deg2rad(40.0)
    products = [read_product(product_path(finished_run, n)) for n in ("R22_S11", "R24_S12")]
    turned = [dataclasses.replace(p, rotator=angle) for p in products]
    # The angle is kept in the file, and only where there is one.
    for product in (products[0], turned[0]):
        write_product(tmp_path, product, stamp_of(Experiment.from_config(tiny())), [])
        assert read_product(product_path(tmp_path, "R22_S11")).rotator == pytest.approx(product.rotator, abs=1e-15)
    found = correlations(turned, ("observed",))["observed"]
    # By hand: ellipticities in the telescope frame, e exp(2 i angle), at the field angles.
    stars = [p.observed for p in products]
    x, y, e1, e2 = (np.concatenate([getattr(s, k) for s in stars]) for k in ("field_x", "field_y", "e1", "e2"))
    e = (e1 + 1j * e2) * np.exp(2j * angle)
    catalog = treecorr.Catalog(x=x, y=y, g1=e.real, g2=e.imag)
    bins = separation_bins(products)
    pairs = treecorr.GGCorrelation(min_sep=bins.min_sep, max_sep=bins.max_sep, nbins=bins.n_bins, brute=True)
    pairs.process(catalog)
    filled = found.n_pairs > 0
    size = np.mean(np.abs(e) ** 2)
    # TreeCorr keeps ellipticities in single precision.
    np.testing.assert_allclose(found.xi_plus[filled], pairs.xip[filled], atol=1e-6 * size)
    np.testing.assert_allclose(found.xi_minus[filled], pairs.xim[filled], atol=1e-6 * size)
    plain = correlations(products, ("observed",))["observed"]
    assert np.abs(found.xi_minus - plain.xi_minus)[filled].max() > 0.1 * size


def test_models_of_the_focal_plane_rotate_the_camera_as_products_state(finished_run, lsst_r, tmp_path, monkeypatch):
    """Optics of a camera that was not rotated were fitted to the stars of any run."""
    products = [read_product(product_path(finished_run, n)) for n in ("R22_S11", "R24_S12")]
    turned = [dataclasses.replace(p, rotator=0.4) for p in products]
    stars = pachon.FocalPlaneStars.from_products(turned)
    stars.write(tmp_path / "stars.ecsv")
    assert pachon.FocalPlaneStars.read(tmp_path / "stars.ecsv").rotator == pytest.approx(0.4)
    with pytest.raises(DomainError, match=r"rotator: 0 rad in a product, and 0\.4 rad in another"):
        pachon.FocalPlaneStars.from_products([products[0], turned[1]])
    instruments = []

    def noted(*arguments):
        instruments.extend(a for a in arguments if isinstance(a, Instrument))
        raise InterruptedError

    monkeypatch.setattr(focal_plane_model, "LEAST_STARS", 20)
    monkeypatch.setattr(focal_plane_model, "fit_field", noted)
    monkeypatch.setattr(static_heights, "ExposureFit", noted)
    already = lsst_r.with_rotator(0.4)
    for telescope in (lsst_r, already):
        with pytest.raises(InterruptedError):
            pachon.FocalPlanePsf.fit(stars, telescope)
        with pytest.raises(InterruptedError):
            static_heights.fit_static_heights([stars], telescope)
    assert [i.telescope for i in instruments] == [already] * 4
    assert already.rotator == pytest.approx(0.4, abs=1e-15)


def test_metrics_of_a_sweep_take_them_too(mean_air):
    # The mean over turbulence of an axially symmetric telescope: every rotator angle gives the same correlation.
    options = {"shift": (0.0, 0.0), "focal_plane__budget": "specification", "stars__truth": 12}
    xi = [Scene(e.telescope, e, threads=1).correlation for e in (mean_air(**options), mean_air(**options, **QUARTER))]
    assert np.nanmax(np.abs(xi[0].xi_minus)) > 1e-6
    for name in ("xi_plus", "xi_minus"):
        np.testing.assert_allclose(getattr(xi[1], name), getattr(xi[0], name), atol=1e-8)


def test_the_angle_is_a_parameter_of_sweeps(lsst_r, tmp_path):
    content = {
        "base": {"ccds": ["R22_S11"], "atmosphere": {"enabled": False}},
        "parameters": {"rotator_deg": {"values": [30.0]}},
        "design": {"kind": "grid"},
    }
    sweep = read_sweep(content, "test")
    experiment = point_experiment(sweep, SweepPoint(0, {"rotator_deg": 30.0}, 1), tmp_path)
    assert experiment.telescope == lsst_r.with_rotator(np.deg2rad(30.0))
    assert experiment.rotator == pytest.approx(np.pi / 6)


@pytest.mark.slow
def test_a_run_with_a_rotated_camera(tiny, tmp_path, monkeypatch):
    # Drawing the report takes longest, and others test it.
    monkeypatch.setattr("pachon.pipeline.report.pictures.draw_pictures", lambda *_: [])
    monkeypatch.setattr(run_module, "build_report", lambda *_: "")
    config = with_options(tiny(psf__engine="long_exposure"), **QUARTER)
    run(config, tmp_path / "run", execution=Execution(threads=1))
    products = [read_product(product_path(tmp_path / "run", n)) for n in config.ccds]
    assert [p.rotator for p in products] == [pytest.approx(0.5 * np.pi, abs=1e-15)] * 2
    far = products[1].observed
    # R24_S12 lies on +y of the camera, which is -x of the telescope.
    assert (far.y > 0.2).all()
    assert (far.field_x < -0.02).all()
    assert (np.abs(far.field_y) < 0.005).all()
    assert diagnose(tmp_path / "run").overall["ccds"] == 2
