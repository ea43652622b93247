"""Commands are guessed: an option has one meaning in all of them, by its name and type, and help shows its choices.

Commands whose product is a folder (runs, images, visits, studies) have their pictures in it, beside the tables.
"""

import ast
import inspect
import re
import typing
from functools import lru_cache
from pathlib import Path

import pytest
import typer

from pachon.commands import cli, config_kinds
from pachon.commands.cli import main
from pachon.design.analyses.spot_matrix import spot_matrix
from pachon.design.metrics.field_zernikes import PupilToFit
from pachon.design.optimize.merit_function import MeritName
from pachon.imaging.config import ImageConfig
from pachon.imaging.image_formats.load import WeightName
from pachon.models.camera.corner_rafts import CornerHeights
from pachon.models.camera.photometry import BandName
from pachon.models.design_data import Aiming
from pachon.models.io.prescription import LensFormat
from pachon.models.starting_designs.new import DesignKind
from pachon.raytrace.rays import Projection
from pachon.reconstruction.psf_model.recipe import BasisName, InterpolationName, RecipeName, WeightsName
from pachon.sensing.frames import FrameName
from pachon.sensing.observatory_zernikes import ZernikeConvention
from pachon.studies.shimming.shim import ShimmedParts, ShimMerit
from pachon.studies.tolerance.file import ToleranceFile
from pachon.studies.validation import SchemaKind
from pachon.wavefront.pupil_sampling import SamplingName

ROOT = typer.main.get_command(cli.app)
#: Words for one thing: of each line a command has at most the first.
SYNONYMS = (
    ("--out", "--output", "--folder", "--outdir", "--file", "--fits", "--glb", "--destination"),
    ("--picture", "--plot", "--figure", "--png", "--image-file"),
    ("--table", "--csv", "--ecsv", "--write"),
    ("--json", "--as-json", "--format-json"),
    ("--quiet", "--silent", "-q"),
    ("--set", "--option", "--override", "-O"),
    ("--threads", "--jobs", "--cores"),
    ("--seed", "--random-seed"),
    ("--field-deg", "--field", "--angle"),
    ("--wavelength-nm", "--wavelength", "--lambda"),
)
#: Arguments and options that are configurations.
CONFIGURATIONS = {"config", "tolerances", "sweep"}


@pytest.fixture
def in_folder(tmp_path, monkeypatch):
    """An empty current folder."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def leaves(command, path=()):
    """Commands under one, with their names."""
    commands = getattr(command, "commands", None)
    if commands is None:
        # Help gives parameters the words that stand for their values.
        command.get_params(command.make_context(command.name, [], resilient_parsing=True))
        yield " ".join(path), command
        return
    for name, inner in commands.items():
        yield from leaves(inner, (*path, name))


COMMANDS = dict(leaves(ROOT))


def options_of(command):
    """Options of a command by each of their names."""
    return {name: p for p in command.params if p.param_type_name == "option" for name in p.opts}


def annotation_of(command, name):
    """Type of a parameter as its function has it, in words."""
    function = inspect.unwrap(command.callback)
    annotation = inspect.signature(command.callback).parameters[name].annotation
    return str(eval(annotation, function.__globals__) if isinstance(annotation, str) else annotation)


@lru_cache
def tree_of(file):
    return ast.parse(Path(file).read_text(encoding="utf-8"))


def called_functions(command):
    """Names that a command's function uses, and the functions of its file that it calls, and so on."""
    function = inspect.unwrap(command.callback)
    bodies = {
        node.name: node for node in tree_of(function.__code__.co_filename).body if isinstance(node, ast.FunctionDef)
    }
    names, remaining = set(), [function.__name__]
    while remaining:
        body = bodies.pop(remaining.pop(), None)
        if body is None:
            continue
        used = {n.id for n in ast.walk(body) if isinstance(n, ast.Name)}
        used |= {n.attr for n in ast.walk(body) if isinstance(n, ast.Attribute)}
        names |= used
        remaining += [name for name in used if name in bodies]
    return names


def is_design(command):
    return "command.<locals>" in command.callback.__qualname__ or command.callback.__module__.endswith("design.command")


def test_there_are_many_commands():
    assert len(COMMANDS) > 45


@pytest.mark.parametrize("name", COMMANDS)
def test_o_is_out_and_out_is_data(name):
    options = options_of(COMMANDS[name])
    assert options.get("-o") is options.get("--out")
    if "--out" in options:
        out = options["--out"]
        assert out.name == "out"
        assert "Path" in annotation_of(COMMANDS[name], "out")
        assert out.metavar in ("FILE", "FOLDER")
        assert not re.match(r"(?i)picture|image to write|plot", out.help)


@pytest.mark.parametrize("name", COMMANDS)
def test_pictures_and_tables_are_files_of_the_same_options(name):
    command = COMMANDS[name]
    options = options_of(command)
    assert ("--picture" in options) == ("--no-picture" in options)
    for option, parameter in (("--picture", "picture"), ("--table", "table")):
        if option in options and options[option].name != "out":
            assert options[option].name == parameter
            assert options[option].metavar == "FILE"
            assert "Path" in annotation_of(command, parameter)
    if "--no-picture" in options:
        assert options["--no-picture"].is_flag
        assert options["--no-picture"].default is False


@pytest.mark.parametrize("name", COMMANDS)
def test_what_draws_takes_picture_and_what_prints_a_table_takes_table(name):
    command, options = COMMANDS[name], options_of(COMMANDS[name])
    names = called_functions(command)
    if is_design(command) or "picture_bytes" in names:
        assert "--picture" in options
    if is_design(command) or "Rows" in names:
        assert "--table" in options


@pytest.mark.parametrize("name", COMMANDS)
def test_no_two_options_are_for_one_thing(name):
    options = options_of(COMMANDS[name])
    for word, *others in SYNONYMS:
        assert not set(others) & set(options), f"expected {word}"
    texts = [p.help for p in {id(p): p for p in options.values()}.values()]
    assert len(texts) == len(set(texts))


@pytest.mark.parametrize("name", [n for n, c in COMMANDS.items() if CONFIGURATIONS & {p.name for p in c.params}])
def test_what_takes_a_configuration_takes_set(name):
    settings = options_of(COMMANDS[name]).get("--set")
    assert settings.multiple or "list" in annotation_of(COMMANDS[name], settings.name)
    assert settings.metavar == "KEY=VALUE"


def test_kinds_of_configurations_name_the_commands_that_take_set():
    stated = {
        "sweep run" if command == "sweep" else command
        for kind in config_kinds.KINDS.values()
        for command in kind.commands.split(", ")
    }
    taking = {name for name, command in COMMANDS.items() if "--set" in options_of(command)}
    assert {command.partition(" --")[0] for command in stated} == taking


def settings_shown():
    """Keys that examples of help and documentation set, with the kind of configuration of their command."""
    kinds = {
        command.partition(" --")[0]: name
        for name, kind in reversed(config_kinds.KINDS.items())
        for command in kind.commands.split(", ")
    }
    docs = (path.read_text(encoding="utf-8") for path in (Path(__file__).parents[2] / "docs").rglob("*.md"))
    for text in (*(command.help or "" for command in COMMANDS.values()), *docs):
        for line in re.findall(r"^.*\bpachon (?:.*) --set .*$", text, flags=re.M):
            command = max((c for c in kinds if re.search(rf"\bpachon {c}\b", line)), key=len, default=None)
            for key in re.findall(r"--set ([\w.]+)=", line) if command else ():
                yield "night" if " --list " in line and command == "visits" else kinds[command], key


@pytest.mark.parametrize(("kind", "key"), sorted(set(settings_shown())))
def test_keys_that_examples_set_exist(kind, key, capsys):
    assert main(["config", f"{kind}.{key}"]) == 0


@pytest.mark.long
@pytest.mark.parametrize("name", COMMANDS)
def test_help_at_80_columns_is_not_cut_and_has_no_types_of_python(name, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    assert main([*name.split(), "--help"]) == 0
    text = capsys.readouterr().out
    assert "…" not in text
    assert not re.search(r"<[a-z]|\bPATH\b|\[Path\]|\bINTEGER\b|\bFLOAT\b", text)


@pytest.mark.parametrize(
    ("path", "option", "words"),
    [
        ("spots", "--sampling", SamplingName),
        ("spots", "--projection", Projection),
        ("spots", "--aiming", Aiming),
        ("zernikes", "--pupil", PupilToFit),
        ("spot-matrix", "--against", inspect.signature(spot_matrix, eval_str=True).parameters["against"].annotation),
        ("optimize", "--merit", MeritName),
        ("convert", "--format", LensFormat),
        ("donuts", "--frame", FrameName),
        ("donuts", "--field-frame", FrameName),
        ("donuts", "--convention", ZernikeConvention),
        ("new", "kind", DesignKind),
        ("schema", "kind", SchemaKind),
        ("shim", "--minimise", ShimMerit),
        ("shim", "--parts", ShimmedParts),
        ("align", "--heights", CornerHeights),
        ("align", "--believed-heights", CornerHeights),
        ("model", "--recipe", RecipeName),
        ("model", "--basis", BasisName),
        ("model", "--interpolation", InterpolationName),
        ("model", "--weights", WeightsName),
        ("measure", "--weight-kind", WeightName),
        ("images", "--way", ImageConfig.model_fields["way"].annotation),
        ("tolerance", "--method", ToleranceFile.model_fields["method"].annotation),
        ("run", "--band", BandName),
    ],
)
def test_choices_are_the_words_of_the_functions_that_take_them(path, option, words):
    """Options state them once more, since the modules that compute are slow to import."""
    command = COMMANDS[path]
    parameter = next(p for p in command.params if option in (*p.opts, p.name))
    context = command.make_context(command.name, [], resilient_parsing=True)
    assert {item.value for item in parameter.shell_complete(context, "")} == {*typing.get_args(words)} - {""}
    if not parameter.metavar.isupper():
        assert set(parameter.metavar.split("|")) == {*typing.get_args(words)}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["spots", "paul_baker", "-o", "a.png"], "pachon spots -o: it names data, of which this command writes none: "),
        (
            ["opd", "paul_baker", "--out", "a.png"],
            "expected --picture FILE for the picture, --table FILE for the numbers",
        ),
        (["camera", "hsc", "-o", "a.png"], "expected --picture FILE"),
        (["draw", "paul_baker", "-o", "a.png"], "expected a name that ends in .glb; the picture is --picture"),
        (["psf", "paul_baker", "-o", "a.png"], "expected a name that ends in .fits; the picture is --picture"),
        (["run", "--table", "a.txt"], "--table = a.txt: expected a name that ends in .ecsv, .csv, .fits, .parquet"),
        (["spots", "paul_baker", "--sampling", "ring"], "did you mean rings?"),
        (["spots", "paul_baker", "--pictur", "a.png"], "--picture"),
    ],
)
def test_options_that_are_gone_or_wrong_say_what_to_write(arguments, words, in_folder, capsys):
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert words in error
    assert list(in_folder.iterdir()) == []


@pytest.mark.long
@pytest.mark.parametrize(
    "arguments", ["paul_baker b.yaml", "paul_baker -o b.yaml", "--out b.yaml paul_baker", "--out=b.yaml paul_baker"]
)
def test_an_argument_out_may_be_given_as_the_option(arguments, in_folder):
    assert main(["convert", *arguments.split()]) == 0
    assert (in_folder / "b.yaml").exists()
    assert main(["new", *arguments.replace("b.yaml", "c.yaml").replace("paul_baker", "singlet").split()]) == 0
    assert (in_folder / "c.yaml").exists()
