"""The camera as built, measured heights and silicon, in baselines and in sweeps."""

import numpy as np
import pytest
import yaml
from astropy import units
from astropy.table import Table

import pachon
from pachon.commands.cli import main
from pachon.core.units import ARCSEC
from pachon.measure.shapes import fwhm, measure_shapes
from pachon.models.camera.silicon import Silicon
from pachon.pipeline.simulate.photometry import effective_fwhm
from pachon.studies.baseline.baseline import check_baseline, make_baseline
from pachon.studies.baseline.file import write_baseline
from pachon.studies.sweep.store import SweepStore
from pachon.wavefront.chief_rays import fields_at

#: All of them need a finished study, of seconds.
pytestmark = pytest.mark.long

#: Two CCDs 14 um above and 12 um below the mean plane, in y, where light goes deep.
CCDS = ["R22_S11", "R11_S01"]
RUN = {
    "band": "y",
    "wavelengths_nm": [970],
    "seed": 3,
    "focal_plane": {"heights": "lsstcam"},
    "detector": {"silicon": True},
    "psf": {"engine": "long_exposure"},
    "stars": {"truth": 12, "observed": 12},
    "reconstruction": {"components": 3, "order": 1, "truth_order": 1},
}


def with_detector(**detector):
    return yaml.safe_dump({**RUN, "detector": detector})


def at_centres(camera, plane, silicon):
    """Long exposures at the centres of the two CCDs, without baselines and sweeps."""
    telescope = pachon.load_telescope("lsst_v3.3_y")
    centers = camera.centers[[camera.ccd_index(name) for name in CCDS]]
    air = pachon.Atmosphere.from_site("cerro_pachon", seed=RUN["seed"])
    return pachon.make_psfs(
        telescope,
        fields_at(telescope, centers),
        [970e-9],
        focal_plane=plane,
        atmosphere=air,
        engine="long_exposure",
        stamps=pachon.Stamps(silicon=silicon),
    )


@pytest.mark.slow
def test_a_baseline_has_the_heights_and_the_depth_of_light(tmp_path):
    (tmp_path / "run.yaml").write_text(yaml.safe_dump(RUN))
    baseline, left_out = make_baseline("lsst_v3.3_y", tmp_path, tmp_path / "run.yaml", ccds=CCDS, threads=1)
    assert not left_out
    plane = pachon.FocalPlane.as_measured("lsstcam")
    camera, figures = plane.camera, {name: figure.value for name, figure in baseline.figures.items()}
    expected = dict(zip(camera.ccd_names, 1e6 * plane.height(*camera.centers.T), strict=True))
    found = {name: figures[f"height {name}"] for name in expected}
    assert found == pytest.approx(expected, abs=1e-6)
    psfs = at_centres(camera, plane, Silicon())
    widths = fwhm(psfs.image, psfs.pixel_scale) / ARCSEC
    e1 = measure_shapes(psfs.image, psfs.pixel_scale, 0.7 * ARCSEC).e1
    assert [figures[f"psf fwhm {name}"] for name in CCDS] == pytest.approx(widths, abs=1e-5)
    assert [figures[f"psf e1 {name}"] for name in CCDS] == pytest.approx(e1, abs=1e-5)
    # Kept for y alone: light of 970 nm that stops at the surface has other PSFs, and the same heights.
    some = {k: v for k, v in baseline.figures.items() if k.partition(" ")[0] in ("height", "psf")}
    write_baseline(tmp_path / "y.json", baseline.model_copy(update={"figures": some}))
    (tmp_path / "run.yaml").write_text(with_detector(silicon=False))
    out = check_baseline(tmp_path / "y.json", threads=1).out
    assert {d.name.partition(" ")[0] for d in out} == {"psf"}
    plain = fwhm(at_centres(camera, plane, None).image, psfs.pixel_scale) / ARCSEC
    assert np.abs(plain - widths).max() > 1e-3
    assert [d.found for d in out if d.name == "psf fwhm R11_S01"] == pytest.approx([plain[1]], abs=1e-5)


def test_a_sweep_over_heights_and_silicon(tmp_path, monkeypatch):
    """FWHM on one CCD for heights as measured and of nought, without silicon and with it, against lone exposures."""
    monkeypatch.chdir(tmp_path)
    plane = pachon.FocalPlane.as_measured("lsstcam")
    camera = plane.camera
    corners = camera.from_uv(np.arange(len(camera))[:, None], np.array([[-0.9, -0.9], [0.9, -0.9], [0.0, 0.9]]))
    x, y = corners.reshape(-1, 2).T * units.m
    Table({"x": x, "y": y, "z": 0.0 * x}).write("flat.ecsv")
    sweep = {
        "base": {k: v for k, v in RUN.items() if k not in ("focal_plane", "detector", "seed")} | {"ccds": CCDS[:1]},
        "parameters": {
            "focal_plane.heights": {"nominal": "flat.ecsv", "values": ["flat.ecsv", "lsstcam"]},
            "detector.silicon": {"nominal": False, "values": [False, True]},
        },
        "design": {"kind": "grid"},
        "metrics": ["fwhm"],
    }
    (tmp_path / "both.yaml").write_text(yaml.safe_dump(sweep, sort_keys=False))
    assert main(["sweep", "both.yaml", "--processes", "1", "--threads", "1", "--quiet"]) == 0
    with SweepStore(tmp_path / "both.sweep") as store:
        found = [r.metrics["effective_fwhm_arcsec"] for r in store.results()]
    assert len(found) == 4
    states = [(p, s) for p in (pachon.FocalPlane.flat(camera), plane) for s in (None, Silicon())]
    psfs = [at_centres(camera, p, s) for p, s in states]
    expected = [effective_fwhm(p.image[:1], p.pixel_scale) / ARCSEC for p in psfs]
    # Medians of a dozen places of the CCD against its centre.
    assert np.diff(found) == pytest.approx(np.diff(expected), abs=3e-3)
    assert np.ptp(expected) > 2e-2


def test_a_value_without_meaning_is_named(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "none.yaml").write_text("parameters: {focal_plane.heights: {values: [null, lsstcam]}}\n")
    assert main(["sweep", "none.yaml"]) == 2
    message = "parameters.focal_plane.heights.values[0] = null: expected a finite number, a text, true or false\n"
    assert capsys.readouterr().err.endswith(message)
