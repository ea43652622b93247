"""Files with something wrong in them end in a run or in one clear line, never in another exception or a hang.

Texts are mutated at random: a token, a line or a stretch of characters is dropped, doubled, swapped or replaced by
something that people and editors leave behind. The default run is short; ``pytest -m slow`` tries ten thousand.
"""

import time
import warnings
from pathlib import Path

import numpy as np
import pytest

from pachon.core.errors import PachonError
from pachon.models.io.bundled import DATA
from pachon.models.io.prescription import load_telescope
from pachon.pipeline.config import load_configuration, to_yaml
from pachon.pipeline.experiment import Experiment
from pachon.raytrace.launch import launch_rays
from pachon.raytrace.trace import trace
from pachon.studies.sweep.design import point_count
from pachon.studies.sweep.file import load_sweep
from pachon.studies.sweep.point import check_sweep
from pachon.studies.sweep.sweep import check_room, numbered_points

hypothesis = pytest.importorskip("hypothesis")
st = hypothesis.strategies

SWEEP = (Path(__file__).parents[2] / "studies/sweep/examples/table1_small.yaml").read_text()
CONFIG = to_yaml(
    Experiment.from_config(load_configuration(Path(__file__).parents[2] / "docs/examples/optics_alone.yaml")).config
)
TELESCOPE = (DATA / "lsst_v3.3_r.yaml").read_text()
FREEFORM = (DATA / "rubin_v3.14_r.yaml").read_text()

#: Longest processor time of an example [s].
SECONDS = 10.0

JUNK = st.sampled_from(
    ["", "0", "-1", "1e400", ".nan", ".inf", "-0.0", "1e-320", "null", "~", "true", "[]", "{}", "[1, 2", "{a: 1}", "'",
     '"', ":", "- ", "&a", "*a", "!!python/object:os.system", "!!binary aGk=", "\t", "\0", "\ufeff", "é", "9" * 400,
     "2026-11-21", "0x1f", "1_000", "1e3", "R22", "R99_S00", "all", "M2", "M2.dz_um", "<<", "?", "%YAML 1.2", "---",
     "...", "[[[[[[[[[[[[[[[[[[[[", "{{", "a: b: c", "#"]
)  # fmt: skip


@st.composite
def mutations(draw, text):
    """Return the text after one to three mutations."""
    for _ in range(draw(st.integers(1, 3))):
        lines = text.split("\n")
        i = draw(st.integers(0, len(lines) - 1))
        kind = draw(st.sampled_from(["drop", "double", "swap", "token", "value", "cut", "insert"]))
        if kind == "drop":
            del lines[i]
        elif kind == "double":
            lines.insert(i, lines[i])
        elif kind == "swap":
            j = draw(st.integers(0, len(lines) - 1))
            lines[i], lines[j] = lines[j], lines[i]
        elif kind == "token":
            words = lines[i].split(" ")
            k = draw(st.integers(0, len(words) - 1))
            words[k] = draw(JUNK)
            lines[i] = " ".join(words)
        elif kind == "value":
            head, colon, _ = lines[i].partition(":")
            lines[i] = head + colon + " " + draw(JUNK)
        text = "\n".join(lines)
        if kind in ("cut", "insert") and text:
            a = draw(st.integers(0, len(text) - 1))
            b = min(len(text), a + draw(st.integers(0, 40))) if kind == "cut" else a
            text = text[:a] + draw(JUNK) + text[b:]
    return text


def complaint(path, use):
    """Use a file and return what is wrong with it; any exception but PachonError is a failure of the test."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            use(path)
    except PachonError as error:
        return str(error)
    return "nothing"


def use_telescope(path):
    telescope = load_telescope(path)
    x = np.linspace(-0.4, 0.4, 5) * telescope.pupil_diameter
    result = trace(telescope, launch_rays(telescope, (0.0, 0.0), telescope.default_wavelength, (x, x)), threads=1)
    assert result.position.shape == (5, 3)


def use_configuration(path):
    # Heights and optics are made; the turbulence would only take its time.
    Experiment.from_config(load_configuration(path), path.parent)


def use_sweep(path):
    sweep = load_sweep(path)
    check_room(sweep, path.with_suffix(".sweep"))
    if point_count(sweep) <= 200:
        check_sweep(sweep, numbered_points(sweep, path.parent), path.parent)


CASES = {
    "sweep": (SWEEP, use_sweep),
    "configuration": (CONFIG, use_configuration),
    "telescope": (TELESCOPE, use_telescope),
    "freeform": (FREEFORM, use_telescope),
}


def fuzz(case, tmp_path, count):
    text, use = CASES[case]
    path = tmp_path / f"{case}.yaml"

    @hypothesis.settings(
        max_examples=count,
        # By the clock of a busy machine any example may be late; the processor time is bounded below.
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=list(hypothesis.HealthCheck),
    )
    @hypothesis.given(mutations(text))
    def run(mutated):
        path.write_text(mutated, encoding="utf-8", errors="surrogateescape")
        start = time.process_time()
        said = complaint(path, use)
        assert time.process_time() - start < SECONDS
        assert said.strip()
        assert "\n" not in said

    run()


@pytest.mark.parametrize("case", CASES)
def test_files_as_they_are_work(case, tmp_path):
    text, use = CASES[case]
    (tmp_path / "file.yaml").write_text(text)
    use(tmp_path / "file.yaml")


@pytest.mark.long
@pytest.mark.parametrize("case", CASES)
def test_mutated_files_end_in_a_run_or_one_clear_line(case, tmp_path):
    # A sweep takes a second or more.
    fuzz(case, tmp_path, 1 if case == "sweep" else 8)


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_ten_thousand_mutated_files(case, tmp_path):
    fuzz(case, tmp_path, 2500)
