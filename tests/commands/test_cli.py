"""The command line: output streams, exit statuses, and one clear line for every kind of bad input."""

import gc
import json
import logging
import os
import re
import shutil
import signal
import subprocess
import sys
import time

import pytest

import pachon
from pachon.commands import cli
from pachon.commands.cli import main
from pachon.commands.imports import import_modules
from pachon.models.io import prescription
from pachon.models.io.bundled import BUNDLED
from pachon.models.io.site_file import DATA
from pachon.pipeline import memory
from pachon.pipeline import run as run_module


def refused(capsys, *arguments):
    """Return the one line on standard error of a call that must exit with status 2 and print nothing else."""
    assert main(arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("pachon: error: ")
    assert err.count("\n") == 1
    return err


@pytest.mark.parametrize("command", [[], ["run"], ["opd"], ["info"]])
def test_help_explains_and_gives_examples(capsys, command):
    assert main([*command, "--help"]) == 0
    out = capsys.readouterr().out
    assert "Usage: pachon" in out
    if command:
        assert f"pachon {command[0]} " in out.partition("Examples")[2]


@pytest.mark.parametrize("group", [[], ["baseline"]])
def test_a_group_alone_prints_its_help_and_no_error(capsys, group):
    assert main(group) == 2
    out, err = capsys.readouterr()
    assert err == ""
    main([*group, "--help"])
    assert out == capsys.readouterr().out
    assert "Usage: pachon" in out


def test_version(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"pachon {pachon.__version__}\n"


@pytest.mark.long
@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["bogus"], ["bogus"]),
        (["run", "--sed", "1"], ["--sed"]),
        (["run", "--threads", "0"], ["--threads"]),
        (["run", "--seed", "x"], ["--seed"]),
        (["run", "none.yaml"], ["none.yaml", "no such file"]),
        (["run", "--seed", "-1"], ["seed = -1", "from 0"]),
        (["run", "--truth-stars", "0"], ["stars.truth = 0"]),
        (["run", "--truth-stars", "5"], ["reconstruction.truth_order = 4", "stars.truth = 5"]),
        (["run", "--ccds", "R22_S1l"], ["'R22_S1l'", "did you mean R22_S"]),
        (["run", "--raft", "R00"], ["'R00'"]),
        (["run", "--ccds", ","], ["--ccds = ','", "R22_S11,R22_S12"]),
        (["run", "--all", "--raft", "R22"], ["--ccds, --raft and --all", "one of them"]),
        (["info", "lsst_v3.3_q"], ["'lsst_v3.3_q'", "did you mean"]),
        (["info", "none.yaml"], ["none.yaml", "no such file"]),
        (["opd", "lsst_v3.3_r", "--field-deg", "1,"], ["--field-deg = '1,'", "two numbers", "0,1.2", "one along +y"]),
        (["opd", "lsst_v3.3_r", "--field-deg", "0,9"], ["deg", "expected within"]),
        (["opd", "lsst_v3.3_r", "--wavelength-nm", "2000"], ["wavelength = 2000 nm", "expected 300 to 1200"]),
        (
            ["opd", "lsst_v3.3_r", "--grid", "16", "--picture", "no/such/folder.png"],
            ["no/such/folder.png", "No such file"],
        ),
    ],
)
def test_bad_input_is_one_line_and_status_2(capsys, in_folder, arguments, parts):
    line = refused(capsys, *arguments)
    for part in parts:
        assert part in line
    assert list(in_folder.iterdir()) == []


@pytest.mark.parametrize("command", ["spots", "tolerance", "diagnose", "model", "convert"])
def test_a_missing_argument_is_named_with_an_example(capsys, command):
    assert main([command]) == 2
    error = capsys.readouterr().err
    assert error.startswith("pachon: error: ")
    assert f" For example: pachon {command} " in error
    assert error.count("\n") == 1


def test_a_mistyped_key_names_file_key_and_what_is_allowed(capsys, in_folder):
    (in_folder / "mine.yaml").write_text("psf: {engin: fast}\n")
    line = refused(capsys, "run", "mine.yaml")
    assert "mine.yaml: unknown key psf.engin" in line
    assert "did you mean engine?" in line


LAYER = "  - {altitude: %g, weight: %g, wind_speed: %g}\n"


@pytest.mark.parametrize(
    ("config", "layers", "parts"),
    [
        ("", [(0, 1.2, 5), (5000, -0.2, 5)], ["windy.yaml: weights = (1.2, -0.2): expected fractions from 0"]),
        ("", [(0, 0.6, 5), (5000, 0.3, 5)], ["windy.yaml: weights = (0.6, 0.3)", "that sum to 1, not 0.9"]),
        ("", [(0, 0.6, 5), (5000, 0.4, 200)], ["mine.yaml: atmosphere.exposure_s = 15: ", "of at least 3029 "]),
        ("  exposure_s: 90\n", [(0, 1, 10)], ["mine.yaml: atmosphere.exposure_s = 90: ", "at least 909 "]),
        ("  time_step_s: 20\n", [(0, 1, 10)], ["atmosphere.time_step_s = 20: ", "atmosphere.exposure_s = 15"]),
        (
            "  screen_size: 16\n  screen_length_m: 900\n",
            [(0, 1, 10)],
            ["mine.yaml: atmosphere.screen_size = 16: ", "at least 431", "at most 33.4"],
        ),
        ("  screen_size: 65537\n", [(0, 1, 10)], ["atmosphere: screen_size = 65537: expected a whole number"]),
        ("  site: none.yaml\n", [], ["none.yaml: no such file"]),
        ("  site: folder.yaml\n", [], ["folder.yaml: cannot be read"]),
        ("  epoch: 1.5\n", [], ["mine.yaml: atmosphere.epoch = 1.5: expected a whole number"]),
    ],
)
def test_a_bad_atmosphere_is_one_line_and_status_2(capsys, in_folder, config, layers, parts):
    site = (DATA / "cerro_pachon.yaml").read_text()
    rows = "".join(LAYER % layer for layer in layers)
    (in_folder / "windy.yaml").write_text(re.sub(r"layers:\n(  - .*\n)*", f"layers:\n{rows}", site))
    (in_folder / "folder.yaml").mkdir()
    where = "" if "site:" in config else "  site: windy.yaml\n" if layers else ""
    length = "" if "screen_length_m" in config else "  screen_length_m: 890\n"
    (in_folder / "mine.yaml").write_text(f"ccds: R22_S11\natmosphere:\n{where}{length}{config}")
    line = refused(capsys, "run", "mine.yaml", "--out", "out")
    for part in parts:
        assert part in line
    assert not (in_folder / "out").exists()


@pytest.mark.parametrize("command", ["run", "attribute"])
def test_errors_of_values_in_a_file_name_the_file(capsys, in_folder, command):
    (in_folder / "mine.yaml").write_text("ccds: R22_S1l\n")
    line = refused(capsys, command, "mine.yaml", "--out", "out")
    assert line.startswith("pachon: error: mine.yaml: ")
    assert "did you mean R22_S" in line
    assert not (in_folder / "out").exists()


def test_only_the_command_that_runs_is_built():
    names = {command.name for group in cli._GROUPS for command in group.app.registered_commands}
    assert {"run", "spots", "check", "convert"} < names
    for name in names:
        app = cli._app_with(name)
        assert [command.name for command in app.registered_commands] == [name]
        assert not app.registered_groups
    assert [group.name for group in cli._app_with("sweep").registered_groups] == ["sweep"]
    assert cli._app_with("spts") is cli.app


def test_quick_imports_leave_garbage_collection_on():
    assert gc.isenabled()
    import_modules(["math"])
    assert gc.isenabled()


def test_help_loads_nothing_that_computes():
    code = (
        "import sys; from pachon.commands.cli import main; main(['--help']);"
        "print(sorted({'numpy', 'scipy', 'warp', 'astropy', 'matplotlib', 'pydantic'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize(
    ("command", "needless"),
    [
        (
            ["info", "lsst_v3.3_r"],
            ["warp", "trimesh", "scipy.interpolate", "astropy.table", "matplotlib"],
        ),
        (
            ["spots", "paul_baker", "--picture", "spots.png"],
            ["trimesh", "scipy.interpolate", "scipy.sparse", "astropy.table"],
        ),
    ],
)
@pytest.mark.long
def test_a_command_imports_no_large_library_that_it_does_not_use(command, needless, tmp_path):
    code = f"import sys; from pachon.commands.cli import main; main({command}); print(*sys.modules, file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path,
                          env={**os.environ, "PYTHONPATH": os.getcwd()}, check=True)  # fmt: skip
    assert set(needless).isdisjoint(done.stderr.split())


def test_screens_too_large_for_the_memory_are_one_line(capsys, in_folder, monkeypatch):
    monkeypatch.setattr(memory, "available_bytes", lambda: 21_000_000_000)
    (in_folder / "mine.yaml").write_text("atmosphere: {screen_size: 65536}\n")
    line = refused(capsys, "run", "mine.yaml")
    assert "atmosphere.screen_size = 65536: needs about 33 GB of memory, 21 GB are free; 32768 would do" in line
    assert not (in_folder / "pachon_run").exists()


@pytest.mark.long
def test_info_lists_models_and_shows_one(capsys):
    assert main(["info", "--json"]) == 0
    assert [m["name"] for m in json.loads(capsys.readouterr().out)["models"]] == list(BUNDLED)
    assert main(["info", "lsst_v3.3_r", "--json"]) == 0
    metrics = json.loads(capsys.readouterr().out)
    # Published properties of the LSST: f/1.23, 10.3 m, 3.5 degrees of field.
    assert metrics["f_number"] == pytest.approx(1.23, abs=0.01)
    assert metrics["focal_length_m"] == pytest.approx(10.3, abs=0.05)
    # 206265 arcsec/rad over the focal length in um.
    assert metrics["plate_scale_arcsec_per_um"] == pytest.approx(0.206265 / metrics["focal_length_m"], rel=1e-5)
    assert metrics["field_radius_deg"] == 1.75
    assert [s["name"] for s in metrics["surfaces"]][:3] == ["M1", "M2", "M3"]
    assert main(["info", "lsst_v3.3_r"]) == 0
    table = capsys.readouterr().out
    assert "19.835" in table
    assert "10.31" in table
    assert "…" not in table


@pytest.mark.long
def test_opd_writes_a_picture_and_prints_its_zernikes(capsys, in_folder):
    arguments = ["opd", "lsst_v3.3_r", "--field-deg", "0,1.2", "--wavelength-nm", "622", "--grid", "48"]
    assert main(arguments) == 0
    assert "defocus" in capsys.readouterr().out
    picture = in_folder / "opd_lsst_v3.3_r_0_1.2_622nm.png"
    first = picture.read_bytes()
    assert first.startswith(b"\x89PNG")
    assert main([*arguments, "--json"]) == 0
    metrics = json.loads(capsys.readouterr().out)
    assert len(metrics["zernike_nm"]) == 28
    # On the y axis of the field the wavefront is symmetric in x: no tilt or coma along x.
    assert abs(metrics["zernike_nm"][1]) < 1e-3
    assert abs(metrics["zernike_nm"][7]) < 1e-3
    assert abs(metrics["zernike_nm"][2]) > 100.0
    assert picture.read_bytes() == first


def test_run_prints_its_metrics_and_the_path_of_the_report(capsys, monkeypatch, finished_run, tmp_path):
    monkeypatch.setattr("pachon.pipeline.report.pictures.draw_pictures", lambda *_: [])
    folder = tmp_path / "copied"
    shutil.copytree(finished_run, folder)
    assert main(["run", str(folder / "config.yaml"), "--out", str(folder), "--resume"]) == 0
    out, err = capsys.readouterr()
    assert "R22_S11" in out
    assert "ξ+" in out
    assert out.endswith(f"report: {folder.resolve() / 'report.html'}\n")
    assert "2 of 2 CCDs are finished already" in err
    # Not a terminal: plain lines, no escape codes of a progress bar.
    assert "\x1b" not in out + err


@pytest.mark.long
def test_json_is_all_that_standard_output_holds(capsys, monkeypatch, settings_file, tmp_path):
    monkeypatch.setattr("pachon.pipeline.report.pictures.draw_pictures", lambda *_: [])
    out_folder = tmp_path / "out"
    assert main(["run", str(settings_file), "--out", str(out_folder), "--ccds", "R22_S11", "--json", "--quiet"]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out) == json.loads((out_folder / "summary.json").read_text())
    assert err == ""


def test_another_configuration_in_the_folder_is_refused(capsys, finished_run):
    line = refused(capsys, "run", str(finished_run / "config.yaml"), "--out", str(finished_run), "--seed", "9")
    assert "seed: 1 -> 9" in line


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_an_unwritable_folder_is_one_line(capsys, in_folder):
    (in_folder / "locked").mkdir(mode=0o500)
    assert "Permission denied" in refused(capsys, "run", "--out", "locked/run")


def test_a_folder_under_a_file_is_one_line(capsys, in_folder):
    (in_folder / "file").write_text("")
    assert "cannot write file/run: Not a directory" in refused(capsys, "run", "--out", "file/run")


def test_a_full_disk_is_one_line(capsys, settings_file, tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError(28, os.strerror(28), "/data/run")

    monkeypatch.setattr(run_module, "claim_run", full)
    assert main(["run", str(settings_file), "--out", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err == "pachon: error: /data/run: No space left on device\n"


def test_ctrl_c_in_a_short_command_is_one_line(capsys, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(prescription, "load_telescope", interrupted)
    assert main(["info", "lsst_v3.3_r"]) == 130
    assert capsys.readouterr().err == "pachon: error: interrupted\n"


def test_too_little_memory_is_one_line(capsys, monkeypatch):
    def huge(*_, **__):
        raise MemoryError

    monkeypatch.setattr(cli, "_built", lambda app: huge)
    assert "not enough memory" in refused(capsys, "run")


@pytest.mark.slow
def test_ctrl_c_ends_with_130_and_resume_goes_on(finished_run, settings_file, tmp_path):
    folder = tmp_path / "out"
    # Eighteen CCDs, each exposed by itself: plenty of time between the first product and the last.
    alone = "from pachon.pipeline.simulate import ccd_loop; ccd_loop._STARS_TOGETHER = 1"
    command = [sys.executable, "-c", f"import sys; {alone}; from pachon.commands.cli import main; sys.exit(main())"]
    arguments = ["run", str(settings_file), "--out", str(folder), "--ccds", "R22,R23", "--threads", "1"]
    with subprocess.Popen([*command, *arguments], stderr=subprocess.PIPE, text=True) as process:
        deadline = time.monotonic() + 120.0
        while not list(folder.glob("ccd_*.fits")) and time.monotonic() < deadline:
            time.sleep(0.02)
        process.send_signal(signal.SIGINT)
        err = process.communicate(timeout=60)[1]
    assert process.returncode == 130
    assert "Traceback" not in err
    assert err.splitlines()[-1].startswith("pachon: error: interrupted; finished CCDs are in")
    assert "--resume" in err.splitlines()[-1]
    names = {p.name for p in folder.iterdir()}
    assert "config.yaml" in names
    assert "report.html" not in names
    assert not [n for n in names if n.endswith(".partial")]
    done = sorted(folder.glob("ccd_*.fits"))
    assert 1 <= len(done) < 18
    if "ccd_R22_S11.fits" in names:
        assert (folder / "ccd_R22_S11.fits").read_bytes() == (finished_run / "ccd_R22_S11.fits").read_bytes()


@pytest.mark.long
def test_shells_complete_commands_and_options(tmp_path):
    command = [sys.executable, "-m", "pachon"]
    words = {"pachon zer": "zernikes", "pachon spots --samp": "--sampling"}
    for typed, completed in words.items():
        asked = {"_PACHON_COMPLETE": "complete_bash", "COMP_WORDS": typed, "COMP_CWORD": str(typed.count(" "))}
        done = subprocess.run(command, env=os.environ | asked, capture_output=True, text=True)
        assert done.stdout.split() == [completed]
    # The shell is that of the parent process, whatever started the tests.
    shown = ["bash", "-c", '"$@"; exit $?', "bash", *command, "--show-completion", "bash"]
    script = subprocess.run(shown, capture_output=True, text=True)
    assert "complete -o default -F _pachon_completion pachon" in script.stdout


@pytest.mark.long
@pytest.mark.parametrize("arguments", [("info", "hsc"), pytest.param(("operands",), marks=pytest.mark.slow)])
def test_a_reader_that_leaves_ends_a_command_quietly(arguments):
    # Two commands of a shell: "pachon info hsc | head -1", with the status of the first.
    code = "import sys; from pachon.commands.cli import main; sys.exit(main())"
    with subprocess.Popen(
        [sys.executable, "-c", code, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        process.stdout.close()
        err = process.stderr.read()
    assert process.returncode == 0
    assert err == b""


@pytest.mark.long
def test_a_terminal_that_knows_ascii_alone_shows_question_marks():
    code = "import sys; from pachon.commands.cli import main; sys.exit(main(['info', 'hsc']))"
    done = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, "PYTHONIOENCODING": "ascii:strict"}, capture_output=True
    )
    assert (done.returncode, done.stderr) == (0, b"")
    assert b"radius 0.75?" in done.stdout


def test_notices_of_the_library_are_shown_once(capsys):
    for _ in range(2):
        assert main(["--version"]) == 0
    logging.getLogger("pachon").info("compiling %s", "trace\x1b[31m")
    assert capsys.readouterr().err == "compiling trace\\x1b[31m\n"
