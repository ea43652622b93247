"""Sweeps of a telescope without a camera: metrics against the functions they stand for, compensators, bad input."""

from pathlib import Path

import numpy as np
import pytest
import yaml

import pachon
from pachon.commands.cli import main
from pachon.core.errors import PachonError
from pachon.models.paraxial import following_pupil
from pachon.studies.baseline.baseline import make_baseline
from pachon.studies.metrics.telescope import TELESCOPE_METRICS, TelescopeScene
from pachon.studies.sweep.analysis import summary, verdict
from pachon.studies.sweep.file import read_sweep
from pachon.studies.sweep.store import SweepStore
from pachon.studies.sweep.sweep import run_sweep
from pachon.studies.sweep.table import described_metric
from pachon.studies.sweep.telescope_point import has_no_camera

LENS = "tests/data/zmx/lens1.zmx"
FIELDS = [[0.0, 0.0], [0.0, 8.0]]
CONTENT = {
    "name": "lens",
    "base": {"telescope": LENS, "wavelengths_nm": [486.1, 656.3]},
    "fields_deg": FIELDS,
    "parameters": {"S3.dy_um": {"nominal": 0, "values": [0, 20]}},
    "metrics": ["spots", "wavefront"],
}


def table_of(tmp_path, **changes):
    sweep = read_sweep({**CONTENT, **changes}, "test")
    run_sweep(sweep, tmp_path / "lens.sweep")
    return pachon.studies.load_sweep_table(tmp_path / "lens.sweep")


def test_points_against_telescopes_made_by_hand(tmp_path):
    table = table_of(tmp_path)
    lens = pachon.load_telescope(LENS)
    waves = [486.1e-9, 656.3e-9]
    for shift, rms, worst, wavefront in zip(
        table.parameters["S3.dy_um"],
        table.metrics["spot_rms_um"],
        table.metrics["spot_worst_um"],
        table.metrics["wavefront_rms_nm"],
        strict=True,
    ):
        # The entrance pupil, the image of the stop by S1 to S3, moves with the element.
        moved = following_pupil(lens.perturbed("S3", shift=(0.0, 1e-6 * shift, 0.0)), lens)
        radii = 1e6 * pachon.spots(moved, np.deg2rad(FIELDS), waves, n_pupil=6).rms_radius
        assert rms == pytest.approx(np.sqrt(np.mean(radii**2)), rel=1e-9)
        assert worst == pytest.approx(radii.max(), rel=1e-9)
        squares = []
        for field in np.deg2rad(FIELDS):
            for wave in waves:
                opd = pachon.wavefront_opd(moved, field, wave, grid=64)
                squares.append(np.mean(opd.without_tilt[opd.lit] ** 2))
        # Quadrature over the pupil against a grid of cells at its rim.
        assert wavefront == pytest.approx(1e9 * np.sqrt(np.mean(squares)), rel=0.03)
    assert len(table) == 2
    assert table.metrics["spot_rms_um"][1] > 1.1 * table.metrics["spot_rms_um"][0]


def test_a_file_that_gets_a_camera_has_one(tmp_path):
    """Within one process, as of a notebook."""
    path = tmp_path / "mine.yaml"
    sweep = read_sweep({**CONTENT, "base": {"telescope": str(path)}}, "test")
    pachon.save_telescope(pachon.load_telescope(LENS), path)
    assert has_no_camera(sweep, {}, tmp_path)
    pachon.save_telescope(pachon.load_telescope("lsst_v3.3_r"), path)
    assert not has_no_camera(sweep, {}, tmp_path)


def test_compensators(tmp_path):
    plain = table_of(tmp_path / "a", metrics=["spots"])
    solved = table_of(tmp_path / "b", metrics=["spots"], compensators=["Image.dz_um", "Image.rx_arcmin"])
    assert np.all(solved.metrics["spot_rms_um"] < plain.metrics["spot_rms_um"])
    lens = pachon.load_telescope(LENS)
    height, tilt = (solved.metrics[f"solved Image.{name}"][1] for name in ("dz_um", "rx_arcmin"))
    moved = following_pupil(lens.perturbed("S3", shift=(0.0, 20e-6, 0.0)), lens)
    moved = moved.perturbed("Image", shift=(0.0, 0.0, 1e-6 * height), tilt=(np.deg2rad(tilt / 60.0), 0.0, 0.0))
    radii = 1e6 * pachon.spots(moved, np.deg2rad(FIELDS), [486.1e-9, 656.3e-9], n_pupil=6).rms_radius
    assert solved.metrics["spot_rms_um"][1] == pytest.approx(np.sqrt(np.mean(radii**2)), rel=1e-9)


#: Two paraboloids with one focus, a beam expander of 5: its light is parallel.
EXPANDER = """
name: expander
source: none
version: none
units: {length: m, angle: deg, wavelength: um}
stop: {z: 0.0}
pupil: {diameter: 0.05, obscuration: 0.0}
launch_distance: 2.0
reference_sphere_radius: 1.0
field: {radius: 0.1, limit: 0.5}
wavelengths: {range: [0.4, 0.7], default: 0.5}
design: {afocal: true}
surfaces:
  - {name: M1, type: mirror, shape: conic, z: 0.0, radius: 2.0, conic: -1.0}
  - {name: M2, type: mirror, shape: conic, z: 0.8, radius: 0.4, conic: -1.0}
  - {name: Exit, type: detector, shape: plane, z: -0.1}
"""


@pytest.mark.long
def test_images_at_infinity_are_in_angles(tmp_path):
    """Of the sweep and of a baseline: a spot of an afocal telescope has no micrometres."""
    (tmp_path / "expander.yaml").write_text(EXPANDER)
    telescope = pachon.load_telescope(tmp_path / "expander.yaml")
    base, parameters = {"telescope": str(tmp_path / "expander.yaml")}, {"M2.dz_um": {"nominal": 0, "values": [0, 5]}}
    metrics = ["spots", "ee80", "mtf", "wavefront"]
    table = table_of(tmp_path, base=base, parameters=parameters, fields_deg=[[0, 0.05]], metrics=metrics)
    assert {name: described_metric(name).unit for name in table.metrics} == {
        **dict.fromkeys(("spot_rms_urad", "spot_worst_urad", "ee80_urad", "ee80_worst_urad"), "urad"),
        **dict.fromkeys(("mtf50_per_mrad", "mtf50_worst_per_mrad"), "1/mrad"),
        "wavefront_rms_nm": "nm",
    }
    assert described_metric("ee80_urad").text == described_metric("ee80_um").text
    angles = pachon.spots(telescope.perturbed("M2", shift=(0, 0, 5e-6)), [[0, np.deg2rad(0.05)]], n_pupil=6)
    assert table.metrics["spot_rms_urad"][1] == pytest.approx(1e6 * angles.rms_radius[0], rel=1e-9)
    figures = make_baseline(str(tmp_path / "expander.yaml"), fields=np.deg2rad([[0.0, 0.05]]))[0].figures
    units = {name.partition(" ")[0]: metric.unit for name, metric in figures.items()}
    assert (units["landing"], units["spot"], units["ee80"], units["opd"]) == ("mrad", "urad", "urad", "nm")
    assert figures["distortion focal length"].unit == ""
    # A field of 0.05 degrees leaves five times as large.
    assert figures["landing y field (0, 0.05) pupil (0, 0)"].value == pytest.approx(5 * np.deg2rad(50), rel=1e-4)


@pytest.mark.slow
def test_metrics_of_images():
    """The functions that they stand for, at the fields and wavelengths of the sweep."""
    lens = pachon.load_telescope(LENS)
    fields, waves = np.deg2rad(FIELDS), np.array([587.6e-9])
    scene = TelescopeScene(lens, fields, waves)
    found = {}
    for name in ("ee80", "mtf", "throughput"):
        found |= TELESCOPE_METRICS[name].compute(scene)
    radii = (
        pachon.encircled_energy(pachon.fft_psf(lens, fields, waves, pixels=128, n_pupil=256)).radius_holding(0.8) * 1e6
    )
    # Another number of pixels and of pupil points.
    assert found["ee80_um"] == pytest.approx(radii.mean(), rel=0.01)
    assert found["ee80_worst_um"] == pytest.approx(radii.max(), rel=0.01)
    half = pachon.mtf(lens, fields, waves).frequency_at(0.5) * 1e-3
    assert found["mtf50_worst_per_mm"] == pytest.approx(half.min())
    # No apertures: all of the light.
    assert found["throughput_min"] == 1.0


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"metrics": ["fwhm"]}, r"without a camera 'fwhm'.*spots"),
        ({"metrics": []}, r"metrics = \[\].*spots"),
        ({"base": {"telescope": LENS, "band": "r"}}, r"base.band.*telescope, wavelengths_nm"),
        ({"parameters": {"S99.dy_um": {"nominal": 0, "values": [0, 1]}}}, "S99"),
        ({"parameters": {"atmosphere.r0_m": {"nominal": 0, "values": [0, 1]}}}, "atmosphere"),
        ({"compensators": ["Image.dz"]}, r"compensators.Image.dz.*unit"),
        ({"fields_deg": [[0, 0], [0, 95]]}, r"field = \(0, 95\) deg: expected within"),
        ({"base": {"telescope": "lsst_v3.3_r"}, "metrics": ["fwhm"]}, "fields_deg.*without a camera"),
    ],
)
def test_bad_input(tmp_path, changes, words):
    with pytest.raises(PachonError, match=words):
        table_of(tmp_path, **changes)
    assert not (tmp_path / "lens.sweep").exists()


def test_a_compensator_without_effect_is_a_problem_of_the_point(tmp_path):
    table = table_of(tmp_path, metrics=["spots"], compensators=["Image.dx_um"])
    assert all("Image.dx has no effect" in problem for problem in table.problem)


def test_points_that_fail_are_among_those_that_are_counted(tmp_path):
    """At 5 m beside the axis no light meets the surface."""
    table = table_of(tmp_path, parameters={"S3.dy_um": {"nominal": 0, "values": [5e6]}}, metrics=["spots"])
    assert [bool(problem) for problem in table.problem] == [False, True]
    with SweepStore(tmp_path / "lens.sweep") as store:
        told = summary(table, store.sweep)
    assert (told["points"], told["failed"]) == (2, 1)
    assert "1 of 2 points could not be computed." in verdict(told)


def test_a_sweep_without_a_computed_point_fails(tmp_path, capsys):
    """At 5 m beside the axis no light meets the surface; the store stays, and says why."""
    content = {
        **CONTENT,
        "base": {"telescope": str(Path(LENS).resolve())},
        "parameters": {"S3.dy_um": {"nominal": 5e6, "values": [5.1e6]}},
        "metrics": ["spots"],
    }
    (tmp_path / "lens.yaml").write_text(yaml.safe_dump(content))
    assert main(["sweep", str(tmp_path / "lens.yaml"), "--processes", "1", "--json"]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.splitlines()[-1].endswith(
        "lens.sweep: no point can be computed; point 0: field = (0, 0) deg: the chief ray does not reach the detector"
    )
    with SweepStore(tmp_path / "lens.sweep") as store:
        assert all(result.problem for result in store.results())
