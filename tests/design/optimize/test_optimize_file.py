"""Files of optimisations: operands with units, configurations, and what is wrong in one line."""

import re

import numpy as np
import pytest

import pachon
from pachon.commands.cli import main
from pachon.core.errors import PachonError
from pachon.design.optimize.optimize import optimize
from pachon.design.optimize.optimize_file import OptimizeFile, catalogue_of, load_optimization, optimization_arguments

LENS = "tests/data/zmx/lens1.zmx"


@pytest.fixture(scope="module")
def triplet():
    return pachon.load_telescope(LENS)


@pytest.fixture
def arguments(tmp_path, triplet):
    """``arguments(text)``: those of optimize for a file of that text."""

    def read(text):
        path = tmp_path / "opt.yaml"
        path.write_text(text)
        return optimization_arguments(load_optimization(path), triplet, path)

    return read


def test_units(arguments):
    found = arguments(
        """
        variables: [S1.radius, S2.thickness]
        bounds: {S2.thickness_mm: [0.5, 6], S1.radius_mm: [-20, -10]}
        fields_deg: [[0, 0], [0, 12]]
        wavelengths_nm: [486.1, 587.6]
        operands:
          - {kind: focal_length_mm, target: 25, weight: 2}
          - {kind: distortion_percent, field_deg: [0, 12], min: -1, max: 1}
          - {kind: incidence_angle_deg, surface: S3, field_deg: [0, 12], pupil: [0, 1], max: 45, wavelength_nm: 500}
          - {kind: edge_thickness_um, surface: S1, radius_mm: 4, min: 500}
          - {kind: mtf, field_deg: [0, 0], frequency_per_mm: 40, angle_deg: 90, min: 0.5}
          - {kind: rms_spot_um, field_deg: [0, 0], wavelengths_nm: [500], n_pupil: 3, max: 5}
        """
    )
    twelve = float(np.deg2rad(12.0))
    assert found["bounds"]["S2.thickness"] == pytest.approx((0.5e-3, 6e-3))
    assert found["bounds"]["S1.radius"] == pytest.approx((-20e-3, -10e-3))
    assert np.asarray(found["telescope"].fields)[1] == pytest.approx([0.0, twelve])
    assert found["telescope"].wavelengths == pytest.approx([486.1e-9, 587.6e-9])
    focal, distortion, angle, edge, mtf, spot = found["telescope"].operands
    assert focal == pachon.design.FocalLength(0.025, weight=2.0)
    assert (distortion.field, distortion.minimum, distortion.maximum) == ((0.0, pytest.approx(twelve)), -0.01, 0.01)
    assert angle.maximum == pytest.approx(np.pi / 4)
    assert (angle.surface, angle.pupil, angle.wavelength) == ("S3", (0.0, 1.0), pytest.approx(500e-9))
    assert (edge.radius, edge.minimum) == (pytest.approx(4e-3), pytest.approx(5e-4))
    assert (mtf.frequency, mtf.angle, mtf.minimum) == (pytest.approx(4e4), pytest.approx(np.pi / 2), 0.5)
    assert (spot.wavelengths, spot.n_pupil, spot.maximum) == ((pytest.approx(5e-7),), 3, pytest.approx(5e-6))
    result = optimize(**{**found, "solver": pachon.design.LeastSquares(max_steps=1), "n_pupil": 2})
    assert len(result.operands) == 6


def test_configurations(arguments, tmp_path, triplet):
    other = pachon.models.telescope.replace(triplet, name="near")
    pachon.save_telescope(other, tmp_path / "near.yaml")
    found = arguments(
        """
        variables: [S1.curvature, "near:S7.thickness"]
        bounds: {"near:S7.thickness_mm": [15, 25]}
        fields_deg: [[0, 0]]
        configurations:
          - {telescope: near.yaml, weight: 2, fields_deg: [[0, 5]], operands: [{kind: f_number, target: 3}]}
        """
    )
    first, second = found["telescope"]
    assert [first.telescope.name, second.telescope.name] == ["lens1", "near"]
    assert second.weight == 2.0
    assert np.asarray(second.fields)[0, 1] == pytest.approx(np.deg2rad(5.0))
    assert found["bounds"] == {"near:S7.thickness": pytest.approx((15e-3, 25e-3))}
    result = optimize(**{**found, "solver": pachon.design.LeastSquares(max_steps=2), "n_pupil": 2})
    assert [(o.configuration, o.operand.kind) for o in result.operands] == [("near", "f_number")]


def test_a_zoom_position_of_the_same_name_is_named_by_its_file(arguments, tmp_path, triplet):
    pachon.save_telescope(triplet, tmp_path / "tele.yaml")
    found = arguments('{variables: [S1.curvature, "tele:S7.thickness"], configurations: [{telescope: tele.yaml}]}')
    assert [c.telescope.name for c in found["telescope"]] == ["lens1", "tele"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("merit: spots", "variables"),
        ("variables: []", "variables"),
        ("{variables: [S1.radius], colour: red}", "unknown key colour"),
        ("{variables: [S1.radius], merit: beauty}", "merit.*spots"),
        ("{variables: [S1.radius], operands: [{kind: focal, target: 1}]}", r"operands.0.*focal.*focal_length_mm"),
        ("{variables: [S1.radius], operands: [{kind: focal_length, target: 1}]}", r"unit at the end, one of m, mm"),
        ("{variables: [S1.radius], operands: [{kind: focal_length_deg, target: 1}]}", r"unit at the end"),
        ("{variables: [S1.radius], operands: [{kind: edge_thickness_mm, min: 1}]}", "surface is missing"),
        (
            "{variables: [S1.radius], operands: [{kind: f_number, target: 3, surface: S1}]}",
            "key of operand f_number.*surface",
        ),
        ("{variables: [S1.radius], operands: [{kind: f_number}]}", "operands.0.*either a value"),
        ("{variables: [S1.radius], operands: [{kind: f_number, min: 3, max: 2}]}", "minimum below the maximum"),
        ("{variables: [S1.radius], bounds: {S1.radius: [1, 2]}}", r"bounds.S1.radius.*unit at the end"),
        ("{variables: [S1.radius], bounds: {'near:S1.radius_mm': [1, 2]}}", "configuration of bounds.*near"),
        ("{variables: [S1.radius], configurations: [{telescope: no_such}]}", "configurations.0.*no_such"),
    ],
)
def test_wrong_files(arguments, tmp_path, text, words):
    with pytest.raises(PachonError, match=words) as caught:
        arguments(text)
    assert str(caught.value).startswith(str(tmp_path / "opt.yaml"))
    assert "\n" not in str(caught.value)


def test_weights_belong_to_the_points_that_they_are_stated_with(arguments):
    states = arguments(
        f"""
        variables: [S1.curvature]
        fields_deg: [[0, 0], [0, 5], [0, 10]]
        field_weights: [1, 1, 5]
        wavelengths_nm: [500, 600]
        wavelength_weights: [1, 2]
        configurations:
          - {{telescope: {LENS}, fields_deg: [[0, 0], [0, 3]]}}
          - {{telescope: {LENS}, wavelengths_nm: [550, 650], field_weights: [2, 1, 1]}}
        """
    )["telescope"]
    weights = [[None if w is None else [*w] for w in (s.field_weights, s.wavelength_weights)] for s in states]
    assert weights == [[[1, 1, 5], [1, 2]], [None, [1, 2]], [[2, 1, 1], None]]
    assert [len(s.fields) for s in states] == [3, 2, 3]


def test_the_catalogue_of_glasses(tmp_path):
    """A maker, or a file beside that of the optimisation; by default that of common glasses."""
    path = tmp_path / "opt.yaml"
    (tmp_path / "own.agf").write_text("NM OWN 2 0 1.5 60 0\nCD 1.0 0.01 0.2 0.02 1.0 100.0\n")

    def catalogue(**content):
        file = OptimizeFile.model_validate({"variables": ["S1.radius"], "glasses": ["N-BK7"], **content})
        return catalogue_of(file, path)

    assert catalogue() is None
    assert "S-BSL7" in catalogue(glass_catalogue="ohara")
    assert list(catalogue(glass_catalogue="own.agf")) == ["OWN"]
    for content, words in (
        ({"glass_catalogue": "oharra"}, "opt.yaml: glass_catalogue: unknown glass maker 'oharra'"),
        ({"glass_catalogue": "none.agf"}, "none.agf: no such file"),
        ({"glass_catalogue": "ohara", "glasses": []}, "opt.yaml: glass_catalogue = 'ohara': expected glasses that"),
    ):
        with pytest.raises(pachon.PachonError, match=words):
            catalogue(**content)


@pytest.mark.long
@pytest.mark.parametrize("kind", ["distortion_percent", "DISG"])
def test_a_distortion_is_shown_and_stored_in_percent(arguments, triplet, tmp_path, capsys, kind):
    """The percentage is that of `pachon field-curvature`, whose scale is that of two slopes near the axis."""
    text = f"""
        variables: [S7.thickness]
        fields_deg: [[0, 0], [0, 8]]
        operands: [{{kind: {kind}, field_deg: [0, 8], min: -0.5, max: 0.5}}]
        max_steps: 1
        """
    (change,) = optimize(**arguments(text)).operands
    percent = pachon.field_curvature(triplet.with_design(aiming="real"), [[0.0, np.deg2rad(8.0)]]).distortion[0, 1]
    assert change.start == pytest.approx(0.01 * percent, rel=1e-4)
    stored = change.stored()
    assert (stored["unit"], stored["goal"]) == ("percent", ">= -0.5, <= 0.5")
    assert stored["start"] == pytest.approx(percent, rel=1e-4)
    command = ["optimize", LENS, "--config", str(tmp_path / "opt.yaml"), "--no-picture", "-o", str(tmp_path / "o.yaml")]
    assert main(command) == 0
    line = re.search(r"\(0 8 deg\): (\S+) -> \S+ percent \(>= -0.5, <= 0.5\)", capsys.readouterr().out)
    assert float(line[1]) == pytest.approx(percent, rel=1e-4)
    assert main(["operands", LENS, "--operand", f"{kind} field_deg=0,8"]) == 0
    assert "percent" in capsys.readouterr().out


def test_limits_that_contradict_are_shown_in_their_unit(arguments):
    text = "{variables: [S1.radius], operands: [{kind: distortion_percent, field_deg: [0, 8], min: 2, max: 1}]}"
    with pytest.raises(PachonError, match="minimum = 2 percent, maximum = 1 percent"):
        arguments(text)
