"""Validation of files: every problem at once, with its line; JSON schemas that take the bundled files."""

from pathlib import Path

import pytest
import yaml
from visit_rows import COLUMNS, ROWS

import pachon
from pachon.core.errors import ConfigError
from pachon.studies.validation import KINDS

ROOT = Path(__file__).parents[2]
BAD = """name: bad
source: x
version: "1"
units: {length: m, angle: deg, wavelength: um}
stop: {z: 0.44}
pupil: {diameter: -8.36, obscuration: 0.612}
launch_distance: 15.0
reference_sphere_radius: 5.0
field: {radius: 1.75, limt: 2.5}
wavelengths: {range: [0.3, 1.2], default: 0.624}
surfaces:
  - {name: M1, type: mirror, shape: conic, z: 0.0, radius: nineteen, conic: -1.2}
  - {name: M2, type: miror, shape: conic, z: 6.0, radius: 5.0, conic: -0.2}
camrea: lsst
"""


def places(validation):
    return {(p.place, p.key) for p in validation.problems}


def test_all_problems_of_a_prescription(tmp_path):
    path = tmp_path / "bad.yaml"
    path.write_text(BAD)
    found = pachon.validate_file(path)
    assert found.kind == "prescription"
    assert places(found) == {
        ("line 14", "camrea"),
        ("line 9", "field.limt"),
        ("line 9", "field.limit"),
        ("line 6", "pupil.diameter"),
        ("line 12", "surfaces[M1].radius"),
        ("line 13", "surfaces[M2].type"),
    }
    assert all(str(p).startswith(f"{path}, line ") for p in found.problems)


def test_media_and_surfaces_that_cannot_be_made_are_reported_each(tmp_path):
    text = (ROOT / "models/data/paul_baker.yaml").read_text()
    text = text.replace("radius: 18.006185731371453", "radius: 0.0").replace("circle: 0.5864", "circle: -0.5864")
    path = tmp_path / "two.yaml"
    path.write_text(text)
    found = pachon.validate_file(path)
    assert [p.key for p in found.problems] == ["surfaces[M3]", "surfaces[Detector]"]
    assert all(p.place for p in found.problems)


def test_values_that_contradict_one_another(tmp_path):
    text = (ROOT / "models/data/paul_baker.yaml").read_text().replace("default: 0.6", "default: 3.0")
    path = tmp_path / "contradiction.yaml"
    path.write_text(text)
    (problem,) = pachon.validate_file(path).problems
    assert "default_wavelength" in str(problem)


@pytest.mark.parametrize(
    ("text", "kind", "keys"),
    [
        ("stars: {truth: -1, obsrved: 3}\nband: q\n", "run", ["stars.obsrved", "band", "stars.truth"]),
        ("name: s\nparameters: {}\nmetrics: [fwhm]\ndesign: {kind: grit}\n", "sweep", ["design.kind"]),
        ("name: s\nparameters: {}\nmetrics: [fwhm]\n", "sweep", [None]),
        (
            "base: {stars: {truth: -1}, psf: {stmp: 3}}\nparameters: {M2.dz_um: {nominal: 0, range: [0, 9]}}\n",
            "sweep",
            ["base.psf.stmp", "base.stars.truth"],
        ),
        ("parameters: {M2.dz_um: {nominal: 0, range: [0, 9]}}\nmetrics: [fwhmm]\n", "sweep", [None]),
        ("parameters: {M9.dz_um: {nominal: 0, range: [0, 9]}}\n", "sweep", [None]),
        ("coatings: {a: {wavelength_nm: [5, 4]}}\nsurfaces: {M1: a}\n", "coatings", ["coatings.a.efficiency"]),
        ("tolerances: [{name: S1.radius_mm, size: 1}]\nloss: 3\n", "tolerances", ["loss"]),
        ("tolerances: [{name: S1.radius_mm, size: 1}]\ndraws: 20\n", "tolerances", []),
        ("variables: [S1.radius]\nbounds: {S1.radius: 3}\n", "optimization", ["bounds.S1.radius"]),
        ("name: c\nsource: s\npixel_um: 15\npixels: [2, 2]\nccds: [{name: A, x_mm: 0, y_mm: 0}]\n", "camera", []),
        ("name: c\nsource: s\npixel_um: -15\nccds: [{name: A, x_mm: 0}]\n", "camera", ["pixel_um", "ccds[A].y_mm"]),
        ("ccds: [R22]\n", "run", []),
        ("name: 'a", "YAML", [None]),
    ],
)
def test_other_kinds(tmp_path, text, kind, keys):
    path = tmp_path / "file.yaml"
    path.write_text(text)
    found = pachon.validate_file(path)
    assert (found.kind, [p.key for p in found.problems]) == (kind, keys)
    assert len(found.summary()["problems"]) == len(keys)


def test_files_of_the_project_have_no_problems():
    good = [
        "models/data/lsst_degrees_of_freedom.yaml",
        "models/data/paul_baker.yaml",
        "models/data/cerro_pachon.yaml",
        "models/data/camera_hsc.yaml",
        "studies/sweep/examples/table1_small.yaml",
    ]
    for name in good:
        assert pachon.validate_file(ROOT / name).problems == ()


def test_lens_files_and_heights(tmp_path):
    lens = (ROOT / "tests/data/zmx/lens1.zmx").read_text()
    (tmp_path / "lens.zmx").write_text(lens.replace("TYPE STANDARD", "TYPE BINARY_2"))
    found = pachon.validate_file(tmp_path / "lens.zmx")
    assert found.kind == "lens file"
    assert "BINARY_2" in str(found.problems[0])
    (tmp_path / "heights.csv").write_text("ccd,x\n1,2\n")
    assert pachon.validate_file(tmp_path / "heights.csv").problems


def test_a_list_makes_visits_a_night(tmp_path):
    path = tmp_path / "night.yaml"
    path.write_text("run: {ccds: [R22]}\nvisits: {list: baseline.db, band: r}\n")
    found = pachon.validate_file(path)
    assert (found.kind, found.problems) == ("night", ())
    path.write_text("run: {ccds: [R22]}\nvisits: {list: baseline.db, bands: r}\nmaps: {nsid: 1024}\n")
    found = pachon.validate_file(path)
    assert found.kind == "night"
    assert places(found) == {("line 2", "visits.bands"), ("line 3", "maps.nsid")}
    path.write_text("run: {ccds: [R22]}\nvisits: {count: 3}\n")
    assert pachon.validate_file(path).kind == "visits"


@pytest.mark.parametrize(
    ("kind", "text", "problem"),
    [
        ("images", "run: {telescope: nosuch}\nimage: {exposures: 2}\n", "unknown telescope 'nosuch'"),
        ("visits", "run: {ccds: [R99_S11]}\nvisits: {count: 2}\n", "unknown CCD of lsst 'R99_S11'"),
        ("visits", "visits: {count: 2, roll_deg: [0]}\n", "visits.roll_deg"),
        ("night", "run: {telescope: comcam_r}\nvisits: {list: list.csv}\n", "band i, 1 visit of list.csv: "),
        ("align", "visits: 3\ntelescope: nosuch\n", "unknown telescope 'nosuch'"),
    ],
)
def test_names_that_configurations_name(tmp_path, kind, text, problem):
    """Of runs alone they were looked up: others had no problems, and ended in their commands at once."""
    (tmp_path / "list.csv").write_text("\n".join([",".join(COLUMNS), ",".join(map(str, ROWS[2]))]))
    (tmp_path / "file.yaml").write_text(text)
    found = pachon.validate_file(tmp_path / "file.yaml")
    assert found.kind == kind
    assert problem in str(found.problems[0])


@pytest.mark.parametrize(
    ("text", "problems"),
    [
        ("visits: {roll_deg: 5}\n", ["visits.roll_deg = 5: expected one of random, or a list"]),
        ("visits: {roll_deg: [a]}\n", ['visits.roll_deg[0] = "a": expected a number']),
        ("base: 5\nparameters: {}\n", ["base = 5: expected a mapping of keys to values, or a text"]),
        (
            "name: c\nsource: s\npixel_um: 15\npixels: [9, 9]\nccds: [{name: A, x_mm: 0, y_mm: 0}]\nphotometry: 3\n",
            ["photometry = 3: expected one of lsst, or a mapping of keys to values"],
        ),
    ],
)
def test_values_of_several_types_have_one_problem(tmp_path, text, problems):
    """Each type had one, under its name in pydantic: visits.roll_deg.tuple[function-after[forbid_inf..."""
    (tmp_path / "file.yaml").write_text(text)
    found = pachon.validate_file(tmp_path / "file.yaml").problems
    assert [problem.problem for problem in found] == problems
    assert all(problem.place for problem in found)


def test_unknown_files(tmp_path):
    for name, text in (("a.docx", "x"), ("b.yaml", "colour: red\n")):
        (tmp_path / name).write_text(text)
        with pytest.raises(ConfigError, match=name):
            pachon.validate_file(tmp_path / name)


@pytest.mark.long
def test_schemas_take_what_the_validators_take():
    jsonschema = pytest.importorskip("jsonschema")
    for kind, name in (
        ("prescription", "models/data/paul_baker.yaml"),
        ("prescription", "models/data/hsc.yaml"),
        ("run", "docs/examples/optics_alone.yaml"),
        ("sweep", "studies/sweep/examples/table1.yaml"),
        ("site", "models/data/cerro_pachon.yaml"),
    ):
        schema = jsonschema.Draft202012Validator(pachon.studies.file_schema(kind))
        content = yaml.safe_load((ROOT / name).read_text())
        assert list(schema.iter_errors(content)) == []
        assert list(schema.iter_errors({**content, "colour": "red"})) != []
    bad = jsonschema.Draft202012Validator(pachon.studies.file_schema("prescription"))
    assert len(list(bad.iter_errors(yaml.safe_load(BAD)))) >= 3


@pytest.mark.long
def test_schemas_of_every_kind_name_its_keys():
    for kind in KINDS:
        schema = pachon.studies.file_schema(kind.name)
        found = schema["properties"] if "properties" in schema else schema["$defs"][kind.model.__name__]["properties"]
        assert set(found) == {field.alias or name for name, field in kind.model.model_fields.items()}
    with pytest.raises(ConfigError, match="kind = 'x'"):
        pachon.studies.file_schema("x")
