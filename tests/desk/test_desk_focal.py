"""The desk of a focal-plane model: its views are the predictions of the model, and a click draws the PSF there."""

import numpy as np
import pytest

import pachon
from pachon.core.errors import ProductError
from pachon.core.units import ARCSEC
from pachon.desk.focal_views import FocalBench

CCDS = ("R22_S11", "R22_S12")
PIXEL = 0.2 * ARCSEC
RMS_TO_FWHM = np.sqrt(8.0 * np.log(2.0))


def fitted(telescope=None, *, stamps=True):
    """Fit 20 Gaussian stars a CCD, of FWHM 0.6 arcsec, whose e1 grows by 0.05 over 50 mm along y."""
    camera, rng = pachon.load_camera("lsst"), np.random.default_rng(1)
    index = np.repeat([camera.ccd_names.index(name) for name in CCDS], 20)
    xy = camera.from_uv(index, rng.uniform(-0.95, 0.95, (40, 2)))
    y, x = np.mgrid[-12:13, -12:13]
    sigma = 0.6 * ARCSEC / RMS_TO_FWHM / PIXEL
    images = np.array([np.exp(-0.5 * ((x / (1 + e)) ** 2 + (y / (1 - e)) ** 2) / sigma**2) for e in xy[:, 1]])
    images /= images.sum(axis=(1, 2), keepdims=True)
    moments = pachon.measure_shapes(images, PIXEL, 0.7 * ARCSEC)
    values = np.stack([moments.e1, moments.e2, np.log(moments.size)], axis=1)
    names = tuple(camera.ccd_names[i] for i in index)
    pictures = {"stamps": images, "pixel_scale": PIXEL} if stamps else {}
    stars = pachon.FocalPlaneStars(names, *xy.T, values, np.full(values.shape, 1e-3), **pictures)
    return pachon.FocalPlanePsf.fit(stars, telescope, camera=camera, threads=1)


@pytest.fixture(scope="module")
def model():
    return fitted()


def test_maps_are_the_predictions_of_the_model(model):
    bench = FocalBench("model", model)
    names, (x, y) = [bench.ccd_name(i) for i in range(len(bench))], bench.places.T
    assert set(names) == set(CCDS)
    shapes, sigma = model.shapes(names, x, y), model.uncertainty(names, x, y)
    view = bench.whiskers()
    np.testing.assert_allclose(view.e1, shapes.e1, rtol=1e-12)
    # That of the stars, not the smaller one of their light under the weight.
    np.testing.assert_allclose(view.fwhm_arcsec, 0.6, rtol=5e-3)
    np.testing.assert_array_equal((view.x_mm, view.y_mm), (1e3 * x, 1e3 * y))
    # e1 of the stars grows with y: by about its half within the weight.
    assert np.corrcoef(view.e1, view.y_mm)[0, 1] > 0.99
    expected = 100 * np.sqrt((sigma.e1**2 + sigma.e2**2) / 2)
    np.testing.assert_allclose(bench.map("uncertainty of e").value, expected, rtol=1e-12)
    larger, smaller = (
        RMS_TO_FWHM * np.sqrt(1.0 / (1.0 / size**2 - (RMS_TO_FWHM / (0.7 * ARCSEC)) ** 2)) / ARCSEC
        for size in (shapes.size + 1e-3 * sigma.size, shapes.size - 1e-3 * sigma.size)
    )
    np.testing.assert_allclose(bench.map("uncertainty of FWHM").value, (larger - smaller) / 2e-3, rtol=1e-6)
    np.testing.assert_array_equal(bench.map("FWHM").value, view.fwhm_arcsec)
    assert bench.heights() is None


def test_images_are_those_that_the_model_draws(model):
    bench = FocalBench("model", model)
    view, where = bench.psf(7), (bench.ccd_name(7), *bench.places[7])
    image, sigma = model.draw(*where)[0], model.draw_uncertainty(*where)[0]
    np.testing.assert_array_equal(view.rows["PSF"][0], image / image.max())
    np.testing.assert_array_equal(view.rows["sigma"][0], sigma / image.max())
    assert view.side_arcsec == pytest.approx(25 * 0.2)
    [row] = bench.components().rows.values()
    assert len(row) == 1 + len(model.pca.components)
    np.testing.assert_allclose(np.abs(row).max(axis=(1, 2)), 1.0)


@pytest.mark.long
def test_a_click_draws_the_psf_there(model, tmp_path):
    pytest.importorskip("bokeh", reason="a desk needs Bokeh: pip install 'pachon[desk]'")
    from pachon.desk.focal_session import FocalSession

    model.write(tmp_path / "model.fits")
    desk = pachon.open_desk(tmp_path / "model.fits")
    assert {root.name for root in desk.document().roots} >= {"whiskers", "field", "psf", "components"}
    session = FocalSession(FocalBench("model", model))
    session.field.source.selected.indices = [3]
    assert session.psf.figure.title.text == f"PSF on {CCDS[0]}, and its uncertainty"
    shapes, _ = session.bench.predicted
    assert f">{100 * shapes.e1[3]:.4g}</b>" in session.table.text
    session.map.value = "FWHM"
    np.testing.assert_array_equal(session.field.source.data["value"], session.bench.fwhm)
    # Without stamps and telescope there is no image, and one line says so.
    session = FocalSession(FocalBench("model", fitted(stamps=False)))
    assert not session.psf.figure.visible
    assert "no image: the stars of the fit had no stamps" in session.status.text


def test_a_damaged_model_is_one_line(model, tmp_path):
    pytest.importorskip("bokeh", reason="a desk needs Bokeh: pip install 'pachon[desk]'")
    model.write(tmp_path / "model.fits")
    data = (tmp_path / "model.fits").read_bytes()
    (tmp_path / "model.fits").write_bytes(data[: len(data) // 2])
    with pytest.raises(ProductError, match=r"model\.fits"):
        pachon.open_desk(tmp_path / "model.fits")
