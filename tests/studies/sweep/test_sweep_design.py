import numpy as np
import pytest
from astropy.table import Table
from scipy.stats import kstest

from pachon.core.errors import ConfigError
from pachon.studies.sweep.design import design_points, point_count
from pachon.studies.sweep.file import load_sweep, read_sweep


def sweep(kind, parameters=None, **design):
    parameters = parameters or {
        "a": {"nominal": 0, "range": [0, 8], "marks": {"low": 2, "odd": 3}},
        "b": {"nominal": 1, "normal": [1, 2], "marks": {"low": 5}},
        "c": {"nominal": "r", "values": ["g", "r", "i"]},
    }
    return read_sweep({"parameters": parameters, "design": {"kind": kind, **design}}, "test")


def test_one_at_a_time_changes_one_value_a_point_and_marks_together():
    found = design_points(sweep("one_at_a_time", points=5))
    nominal = {"a": 0, "b": 1, "c": "r"}
    assert found[0] == nominal
    changed = [{k: v for k, v in point.items() if v != nominal[k]} for point in found[1:]]
    # 2, 4, 6, 8 of the range and the mark 3; quantiles at 2 sigma on either side and the mark 5, which is one of them.
    assert [c["a"] for c in changed if list(c) == ["a"]] == [2, 3, 4, 6, 8]
    assert [c["b"] for c in changed if list(c) == ["b"]] == [-3, -1, 3, 5]
    assert [c["c"] for c in changed if list(c) == ["c"]] == ["g", "i"]
    assert [c for c in changed if len(c) > 1] == [{"a": 2, "b": 5}]
    assert point_count(sweep("one_at_a_time", points=5)) == len(found)


def test_grids_hold_every_combination():
    found = design_points(sweep("grid", points=3))
    assert len(found) == point_count(sweep("grid", points=3)) == 27
    assert {(p["a"], p["b"], p["c"]) for p in found} == {
        (a, b, c) for a in (0, 4, 8) for b in (-3, 1, 5) for c in "gri"
    }


@pytest.mark.parametrize("kind", ["monte_carlo", "latin_hypercube", "sobol"])
def test_random_designs_follow_their_distributions(kind):
    found = design_points(sweep(kind, points=512, seed=3))
    a, b = np.array([[p["a"], p["b"]] for p in found]).T
    # Kolmogorov-Smirnov against the distributions asked for; 1e-3 is a false alarm in a thousand, and seeds are fixed.
    assert kstest(a / 8, "uniform").pvalue > 1e-3
    assert kstest((b - 1) / 2, "norm").pvalue > 1e-3
    counts = [sum(p["c"] == c for p in found) for c in "gri"]
    assert sum(counts) == 512
    assert min(counts) > 130
    assert found == design_points(sweep(kind, points=512, seed=3))
    assert found != design_points(sweep(kind, points=512, seed=4))


def test_latin_hypercubes_have_one_point_in_every_slice():
    a = np.array([p["a"] for p in design_points(sweep("latin_hypercube", points=40))])
    assert (np.sort((a / 8 * 40).astype(int)) == np.arange(40)).all()


def test_more_monte_carlo_points_leave_the_first_as_they_are():
    assert design_points(sweep("monte_carlo", points=50))[:20] == design_points(sweep("monte_carlo", points=20))


@pytest.mark.parametrize(
    ("points", "epochs"), [(2, [0, 5]), (4, [0, 2, 3, 5]), (5, [0, 1, 3, 4, 5]), (50, [0, 1, 2, 3, 4, 5])]
)
def test_keys_of_whole_numbers_have_these_alone(points, epochs):
    """Values of a range were 0.0, 1.25, 2.5..., of which the first was refused already."""
    parameters = {"atmosphere.epoch": {"nominal": 0, "range": [0, 5]}}
    grid = sweep("grid", parameters, points=points)
    values = [point["atmosphere.epoch"] for point in design_points(grid)]
    assert values == epochs
    assert {type(value) for value in values} == {int}
    assert point_count(grid) == len(epochs)


@pytest.mark.parametrize("kind", ["monte_carlo", "latin_hypercube", "sobol"])
def test_random_whole_numbers_are_evenly_likely(kind):
    parameters = {"seed": {"range": [3, 6]}, "stars.truth": {"normal": [100, 2]}}
    seeds, counts = np.array([[*p.values()] for p in design_points(sweep(kind, parameters, points=512, seed=3))]).T
    assert seeds.dtype.kind == counts.dtype.kind == "i"
    # 128 each; four standard deviations of a binomial distribution.
    assert np.abs(np.bincount(seeds)[3:] - 128).max() < 4 * np.sqrt(512 * 0.25 * 0.75)
    # Rounded, a variance of 4 grows by 1/12.
    assert counts.std() == pytest.approx(np.sqrt(4 + 1 / 12), rel=0.15)


@pytest.mark.parametrize("kind", ["grid", "one_at_a_time", "latin_hypercube"])
def test_sides_of_stamps_are_odd(kind):
    """Half of the points had even ones, which are refused."""
    parameters = {"psf.stamp": {"nominal": 41, "range": [31, 51]}}
    stamps = [point["psf.stamp"] for point in design_points(sweep(kind, parameters, points=7))]
    assert (min(stamps), max(stamps)) == (31, 51)
    assert {stamp % 2 for stamp in stamps} == {1}
    assert point_count(sweep("grid", parameters, points=99)) == 11
    with pytest.raises(ConfigError, match=r"parameters.psf.stamp.range\[1\] = 50: expected an odd number"):
        sweep(kind, {"psf.stamp": {"nominal": 41, "range": [31, 50]}})


def test_nominal_values_and_marks_of_whole_numbers(tmp_path):
    parameters = {"psf.stamp": {"nominal": 41.0, "values": [31.0, 51], "marks": {"wide": 61}}}
    stamps = [p["psf.stamp"] for p in design_points(sweep("one_at_a_time", parameters))]
    assert [repr(stamp) for stamp in stamps] == ["41", "31", "51", "61"]
    Table({"psf.stamp": [31.0, 41.0]}).write(tmp_path / "points.ecsv")
    table = read_sweep({"design": {"kind": "table", "file": str(tmp_path / "points.ecsv")}}, "test")
    assert repr(design_points(table)) == "[{'psf.stamp': 31}, {'psf.stamp': 41}]"
    for key, value in (("range", [0.5, 3.0]), ("marks", {"a": 2.5})):
        with pytest.raises(ConfigError, match=rf"parameters\.seed\.{key}.* = .\.5: expected a whole number"):
            sweep("grid", {"seed": {"nominal": 0, "range": [0, 3], key: value}})


def test_points_come_from_a_table(tmp_path):
    Table({"a": [1.0, 2.5], "c": ["g", "i"]}).write(tmp_path / "points.ecsv")
    (tmp_path / "sweep.yaml").write_text("design: {kind: table, file: points.ecsv}\n")
    assert design_points(load_sweep(tmp_path / "sweep.yaml")) == [{"a": 1.0, "c": "g"}, {"a": 2.5, "c": "i"}]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "no such file"),
        ("what is this", "no ECSV table"),
    ],
)
def test_tables_that_are_none_are_refused(tmp_path, content, message):
    if content:
        (tmp_path / "points.ecsv").write_text(content)
    (tmp_path / "sweep.yaml").write_text("design: {kind: table, file: points.ecsv}\n")
    with pytest.raises(ConfigError, match=message) as error:
        design_points(load_sweep(tmp_path / "sweep.yaml"))
    assert "\n" not in str(error.value)


def test_tables_with_a_gap_are_refused(tmp_path):
    Table({"a": [1.0, np.nan]}).write(tmp_path / "points.ecsv")
    (tmp_path / "sweep.yaml").write_text("design: {kind: table, file: points.ecsv}\n")
    with pytest.raises(ConfigError, match=r"points\.ecsv: row 1, a = nan: expected a value"):
        design_points(load_sweep(tmp_path / "sweep.yaml"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("parameters: {a: {valuess: [1]}}", r"unknown key parameters\.a\.valuess = \[1\]: did you mean values"),
        ("parameters: {a: {range: [3, 1]}}", r"parameters\.a\.range = \[3, 1\]: expected the lower value first"),
        ("parameters: {a: {range: [1, 3], values: [2]}}", "has values and range: expected one of values, range, norm"),
        ("parameters: {a: {nominal: 2}}", "has none of them: expected one of values, range, normal"),
        ("parameters: {a: {nominal: 2, values: []}}", r"parameters\.a\.values = \[\]: expected at least one value"),
        ("parameters: {a: {range: [1, 3]}}", r"parameters\.a\.nominal is missing"),
        ("parameters: {a: {normal: [1, 0], nominal: 1}}", "expected a standard deviation above 0"),
        ("parameters: {a: {nominal: 1, range: [1, .inf]}}", r"range\[1\] = Infinity: expected a finite number"),
        ("parameters: {a: {nominal: 1, values: [.nan]}}", r"values\[0\] = NaN: expected a finite number, a text"),
        ("{}", r"parameters = \{\}: expected at least one parameter"),
        ("design: {kind: table}", r"design\.file is missing"),
        ("design: {kind: sobble}", "expected one of one_at_a_time, grid, monte_carlo, latin_hypercube, sobol, table"),
        ("nonsense: 1", "unknown key nonsense = 1"),
    ],
)
def test_bad_sweep_files_get_one_line_that_names_file_and_key(tmp_path, text, message):
    path = tmp_path / "sweep.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message) as error:
        load_sweep(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_another_table_or_prescription_is_another_sweep(tmp_path):
    (tmp_path / "sweep.yaml").write_text("base: {telescope: mine.yaml}\ndesign: {kind: table, file: points.ecsv}\n")
    Table({"a": [1.0]}).write(tmp_path / "points.ecsv")
    (tmp_path / "mine.yaml").write_text("name: mine\n")
    first = load_sweep(tmp_path / "sweep.yaml").digest
    assert load_sweep(tmp_path / "sweep.yaml").digest == first
    (tmp_path / "mine.yaml").write_text("name: other\n")
    second = load_sweep(tmp_path / "sweep.yaml").digest
    Table({"a": [2.0]}).write(tmp_path / "points.ecsv", overwrite=True)
    assert len({first, second, load_sweep(tmp_path / "sweep.yaml").digest}) == 3


def test_swept_files_count_by_their_content(tmp_path):
    rows = "focal_plane.heights: {nominal: a.ecsv, values: [a.ecsv, b.ecsv, lsstcam]}"
    (tmp_path / "sweep.yaml").write_text(f"parameters:\n  {rows}\n")
    for name in "ab":
        (tmp_path / f"{name}.ecsv").write_text(name)
    first = load_sweep(tmp_path / "sweep.yaml")
    assert load_sweep(tmp_path / "sweep.yaml").digest == first.digest
    # Values stay as they are written, for tables and labels.
    assert first.parameters["focal_plane.heights"].values == ("a.ecsv", "b.ecsv", "lsstcam")
    digests = {first.digest}
    for name in "ba":
        (tmp_path / f"{name}.ecsv").write_text("other")
        digests.add(load_sweep(tmp_path / "sweep.yaml").digest)
    assert len(digests) == 3
    # Elsewhere with the same content it is the same sweep.
    (tmp_path / "moved").mkdir()
    for path in tmp_path.glob("*.*"):
        (tmp_path / "moved" / path.name).write_bytes(path.read_bytes())
    assert load_sweep(tmp_path / "moved" / "sweep.yaml").digest in digests


@pytest.mark.parametrize(("section", "key"), [("stars", "catalogue"), ("active_optics", "states")])
def test_files_of_the_base_count_by_their_content(tmp_path, section, key):
    (tmp_path / "sweep.yaml").write_text(
        f"base: {{{section}: {{{key}: own.ecsv}}}}\nparameters: {{seed: {{values: [1], nominal: 1}}}}\n"
    )
    digests = set()
    for text in ("one", "two"):
        (tmp_path / "own.ecsv").write_text(text)
        digests.add(load_sweep(tmp_path / "sweep.yaml").digest)
    assert len(digests) == 2
