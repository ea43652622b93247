"""Mutated files of every format that is read: a result or an error of pachon in one line, within 2 s and 500 MB.

YAML prescriptions, configurations and sweeps have a test of their own (``test_bad_input.py``). ``pytest -m slow
tests/contracts/test_bad_input.py tests/contracts/test_wrong_files.py`` makes 10 000 cases of those and 32 800 of these.
"""

import base64
import gzip
import io
import os
import sqlite3
import warnings
import zlib
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
from astropy.io import fits
from astropy.table import Table
from bounds import CHARACTERS, SECONDS, Hang, bounded

import pachon
from pachon.core.errors import PachonError
from pachon.design.optimize.optimize_file import optimization_arguments
from pachon.imaging.image_file import OBJECT_COLUMNS
from pachon.models.io.bundled import DATA
from pachon.models.io.grid_file import read_grid, write_grid
from pachon.models.mesh_file import load_mesh
from pachon.pipeline.alignment_states import with_active_optics_state
from pachon.pipeline.star_list import place_stars
from pachon.sensing.stamp_files import read_stamps
from pachon.sky.cutouts import read_mosaic
from pachon.studies.sweep.file import read_sweep
from pachon.studies.sweep.store import PointResult, SweepStore, create_store, readable_rows
from pachon.studies.visits.image_stack.config import load_image_stack_configuration

ROOT = Path(__file__).parents[2]
CORPUS = Path(__file__).parent / "corpus"
#: Folder to which files that fail are copied, to join the corpus.
KEEP = os.environ.get("PACHON_KEEP_WRONG_FILES")
CAMERA = pachon.lsst_camera()
RNG = np.random.default_rng(5)


def _text(table, kind):
    text = io.StringIO()
    table.write(text, format=kind)
    return text.getvalue().encode()


def _fits(*hdus):
    data = io.BytesIO()
    fits.HDUList([fits.PrimaryHDU(), *hdus]).writeto(data)
    return data.getvalue()


def _points():
    offsets = RNG.uniform(-20.0, 20.0, (12, 2))
    columns = {"x": offsets[:, 0], "y": offsets[:, 1], "z": np.ones(12)}
    return Table(columns, units={"x": "mm", "y": "mm", "z": "um"})


def _stars():
    stamps = np.exp(-0.5 * (np.mgrid[-3:4, -3:4] ** 2).sum(axis=0))
    return Table({"x": np.arange(3.0), "y": np.arange(3.0), "stamp": np.stack([stamps] * 3)})


def _written(write, suffix, folder):
    path = folder / f"written{suffix}"
    write(path)
    return path.read_bytes()


def _store(path):
    sweep = read_sweep({"parameters": {"a": {"nominal": 0, "range": [0, 4]}}, "design": {"points": 3}}, "test")
    create_store(path, sweep, [], {})
    with SweepStore(path) as store:
        store._connection.execute("""INSERT INTO points VALUES (0, '{"a": 1.0}', 1)""")
        store._connection.commit()
        store.write(PointResult(0, {"fwhm": 1.0}, None, 0.1, "here"))


VISIT_LIST = (
    b"visitId,ra,dec,expMidptMJD,expTime,band,rotTelPos,seeingFwhm500,altitude,numExposures,skyBrightness\n"
    b"1,53.1,-27.8,61001.15,30,r,-35,0.72,80.5,1,21.1\n2,53.2,-27.9,61001.16,30,i,-35,0.71,,2,20.2\n"
)
INSTANCE_CATALOGUE = b"""# a catalogue
rightascension 53.25
declination -27.9
mjd 61040.0811
altitude 85.3
filter 2
rotskypos 22.4
rottelpos 10
nsnap 2
obshistid 1004
seeing 0.6
vistime 32.2
object 1 53.2 -27.9 20 flat
"""


def _visit_database(path):
    names, *rows = VISIT_LIST.decode().splitlines()
    connection = sqlite3.connect(path)
    with connection:
        connection.execute(f"CREATE TABLE observations ({names})")
        for row in rows:
            values = [value if value in "ri" else float(value) for value in row.split(",")]
            connection.execute(f"INSERT INTO observations VALUES ({','.join('?' * len(values))})", values)
    connection.close()


def _image(path):
    pixels = RNG.normal(size=(16, 16))
    objects = {key: np.zeros(2) for key in OBJECT_COLUMNS}
    mask = np.zeros(pixels.shape, int)
    pachon.imaging.CcdImage("R22_S11", pixels, np.ones_like(pixels), mask, fits.Header(), objects).write(path)


def _foreign_image():
    header = fits.Header({"GAIN": 2.0, "SATURATE": 5e4, "MAGZERO": 30.0, "EXPTIME": 90.0, "FILTER": "r"})
    for axis, kind in (("1", "RA---TAN"), ("2", "DEC--TAN")):
        header[f"CTYPE{axis}"], header[f"CRVAL{axis}"], header[f"CDELT{axis}"] = kind, 10.0, 1e-4
    pixels = RNG.normal(1e3, 10.0, size=(40, 40)).astype(np.float32)
    return _fits(
        fits.ImageHDU(pixels, header, name="SCI"),
        fits.ImageHDU(np.zeros(pixels.shape, np.int16), name="MSK"),
        fits.ImageHDU(np.full(pixels.shape, 0.01, np.float32), name="WGT"),
    )


def _psfex():
    column = fits.Column("PSF_MASK", format="81E", dim="(9,9,1)", array=[np.ones((1, 9, 9), np.float32)])
    table = fits.BinTableHDU.from_columns([column], name="PSF_DATA")
    table.header.update({"POLNAXIS": 0, "PSF_SAMP": 0.7})
    return _fits(table)


def _use_store(path):
    try:
        pachon.studies.load_sweep_table(path)
    finally:
        # What an export saves of a damaged store.
        list(readable_rows(path))


def _use_piff(path):
    psf = pachon.load_piff(path)
    psf.draw(100.0, 100.0, chip=next(iter(psf.chips)), size=5)


def _use_stars(path):
    options = {"wavelength": 6e-7, "band": "r", "brightest": 10.0, "faintest": 25.0, "columns": {}}
    place_stars(
        path,
        pachon.load_telescope("lsst_v3.3_r"),
        CAMERA,
        ("R22_S11",),
        pointing=pachon.Pointing(0.93, -0.49),
        **options,
    )


def _mesh(kind):
    made = trimesh.creation.box((1.0, 1.0, 1.0)).export(file_type=kind)
    return made.encode() if isinstance(made, str) else made


def _gltf():
    made = trimesh.creation.box((1.0, 1.0, 1.0)).export(file_type="gltf")
    text = made["model.gltf"]
    for name, content in made.items():
        if name != "model.gltf":
            text = text.replace(name.encode(), b"data:application/octet-stream;base64," + base64.b64encode(content))
    return text


def _mosaic():
    sky = {"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRPIX1": 1, "CRPIX2": 1, "CRVAL1": 0, "CRVAL2": 0}
    scale = {"CDELT1": -1e-5, "CDELT2": 1e-5, "CUNIT1": "deg", "CUNIT2": "deg"}
    return fits.ImageHDU(RNG.normal(size=(24, 24)).astype(np.float32), fits.Header(sky | scale))


def _psf_model(path):
    stamps = np.exp(-0.5 * (np.mgrid[-3:4, -3:4] ** 2).sum(axis=0)) + 0.01 * RNG.random((6, 7, 7))
    pachon.PsfModel.fit(stamps, RNG.uniform(-1, 1, (6, 2)), n_components=2, order=0).write(path)


def _donuts():
    stamp = RNG.normal(size=(12, 12)).astype(np.float32)
    places = {"FIELD_X": 0.1, "FIELD_Y": -0.2, "DEFOC_UM": 1500.0}
    return _fits(*(fits.ImageHDU(stamp, fits.Header(places)) for _ in range(2)))


def _use_donuts(path):
    stamps = read_stamps(path)
    assert len(stamps.images) == len(stamps.defocus)


def _use_donut_table(path):
    (cube := path.with_name("cube.fits")).write_bytes(_fits(fits.ImageHDU(np.ones((2, 12, 12)))))
    read_stamps(cube, path)


def _use_optimization(path):
    optimization_arguments(pachon.design.load_optimization(path), pachon.load_telescope(LENS), path)


STARS = Table({"ra": [53.1, 53.2], "dec": [-27.8, -27.9], "mag": [18.0, 19.5]})
STATES = Table({"visit": [3, 4], "M2_dz": [1.0, 2.0]}, units={"M2_dz": "um"})
OPTIMIZATION = b"""variables: [S1.radius, S2.thickness]
bounds: {S2.thickness_mm: [0.5, 6], S1.radius_mm: [-20, -10]}
fields_deg: [[0, 0], [0, 12]]
operands:
  - {kind: focal_length_mm, target: 25, weight: 2}
  - {kind: mtf, field_deg: [0, 0], frequency_per_mm: 40, angle_deg: 90, min: 0.5}
"""
TOLERANCES = b"""merit: wavefront
surfaces: {radius_percent: 0.2}
elements: {wedge_arcmin: 1}
tolerances: [{name: M2.dz_um, size: 10, distribution: truncated, limit: 15}]
compensators: [Detector.dz_um]
draws: 20
rings: 2
"""
COATINGS = b"""coatings:
  silver: {wavelength_nm: [400, 600, 1000], efficiency: [0.93, 0.97, 0.98]}
surfaces: {M1: silver}
glasses:
  silica: {thickness_mm: 25, wavelength_nm: [350, 1000], efficiency: [0.995, 0.999]}
"""
GRID = pachon.models.GridSag(np.arange(5.0), np.arange(5.0), np.zeros((5, 5)))
GALAXIES = pachon.sky.Galaxies.single([0.0, 1e-5], [0.0, 1e-5], [22.0, 23.0], [2e-6, 3e-6])
LENS = ROOT / "tests/data/zmx/lens1.zmx"
SEQ = b"""RDM;LEN
TITLE 'singlet'
EPD   8.0
DIM   M
WL    656.3 587.6
REF   1
WTW   1 1
XAN   0.0 0.0
YAN   0.0 8.5
SO    0.0 0.1e14
S     60.0 5.0 516.642
S     -60.0 2.0
  STO
S     0.0 60.0
SI    0.0 0.0
GO
"""
LENSES = ROOT / "tests/data/lensfiles"
LEN = b"""LEN NEW "singlet" 60 2
EBR 4.0
ANG 8.5
AIR
TH 1e20
NXT
GLA 1.5168 1.5224 1.5143
RD 60.0; TLA 0.5
TH 5.0
NXT
AIR
RD -60.0
AST
PY 0
NXT
AIR
END 3
"""


def _archive():
    """Return a Zemax archive with one lens file, packed without compression."""
    header = bytearray(0x288)
    data, name = LENS.read_bytes(), "lens.zmx".encode("utf-16-le")
    header[0], header[0x10:0x18] = 0xEC, len(data).to_bytes(8, "little")
    header[0x30 : 0x30 + len(name)] = name
    return bytes(header) + data


def _cases(folder):
    """Return ending, content and use of each format."""
    return {
        "zmx": (".zmx", LENS.read_bytes(), lambda p: pachon.load_telescope(p, lenient=True)),
        "seq": (".seq", SEQ, lambda p: pachon.load_telescope(p, lenient=True)),
        "len": (".len", LEN, lambda p: pachon.load_telescope(p, lenient=True)),
        "json": (".json", (LENSES / "cooke_triplet.json").read_bytes(),
                 lambda p: pachon.load_telescope(p, lenient=True)),
        "roa": (".roa", (LENSES / "tilts.roa").read_bytes(), lambda p: pachon.load_telescope(p, lenient=True)),
        "zar": (".zar", _archive(), lambda p: pachon.load_telescope(p, lenient=True)),
        "agf": (".agf", next(DATA.glob("*.agf")).read_bytes(), pachon.models.GlassCatalogue.read),
        "baseline": (".json", (ROOT / "studies/baseline/bundled/lsst_v3.3_r.baseline.json").read_bytes(),
                     pachon.studies.read_baseline),
        "site": (".yaml", (DATA / "cerro_pachon.yaml").read_bytes(), pachon.models.load_site),
        "images": (".yaml", b"run: {ccds: [R22_S11], seed: 3}\nimage: {exposures: 2}\n",
                   lambda p: pachon.imaging.load_images_configuration(p)),
        "visits": (".yaml", b"run: {ccds: [R22_S11]}\nvisits: {count: 3, snapshots: [1, 3]}\n",
                   lambda p: pachon.studies.load_visits_configuration(p).plan(1)),
        "visit_list": (".csv", VISIT_LIST, pachon.sky.read_visit_list),
        "instance_catalogue": (".txt", INSTANCE_CATALOGUE, pachon.sky.read_visit_list),
        "visit_database": (".db", _written(_visit_database, ".db", folder), pachon.sky.read_visit_list),
        "degrees": (".yaml", yaml.safe_dump({"name": "mine", "degrees_of_freedom": [
            {"name": "a", "unit": "um", "of": "M2.dz"}]}).encode(), pachon.load_degrees_of_freedom),
        "heights_ecsv": (".ecsv", _text(_points(), "ascii.ecsv"), lambda p: pachon.FocalPlane.from_file(p)),
        "heights_fits": (".fits", _fits(fits.table_to_hdu(_points())), lambda p: pachon.FocalPlane.from_file(p)),
        "galaxies_ecsv": (".ecsv", _written(lambda p: pachon.sky.write_galaxies(p, GALAXIES), ".ecsv", folder),
                          pachon.sky.read_galaxies),
        "galaxies_fits": (".fits", _written(lambda p: pachon.sky.write_galaxies(p, GALAXIES), ".fits", folder),
                          pachon.sky.read_galaxies),
        "stars": (".fits", _fits(fits.table_to_hdu(_stars())), pachon.load_stars),
        "mosaic": (".fits", _fits(_mosaic()), lambda p: read_mosaic(p, 25.0)),
        "grid": (".fits", _written(lambda p: write_grid(GRID, p), ".fits", folder), read_grid),
        "image": (".fits", _written(_image, ".fits", folder), pachon.imaging.CcdImage.read),
        "foreign_image": (".fits", _foreign_image(), pachon.load_image),
        "psfex": (".psf", _psfex(), pachon.reconstruction.load_psfex),
        "psf_model": (".fits", _written(_psf_model, ".fits", folder), pachon.PsfModel.read),
        "stl": (".stl", _mesh("stl"), lambda p: load_mesh(p, merged=True)),
        "glb": (".glb", _mesh("glb"), lambda p: load_mesh(p, merged=False)),
        "gltf": (".gltf", _gltf(), lambda p: load_mesh(p, merged=True)),
        "obj": (".obj", _mesh("obj"), lambda p: load_mesh(p, merged=True)),
        "ply": (".ply", _mesh("ply"), lambda p: load_mesh(p, merged=True)),
        "off": (".off", _mesh("off"), lambda p: load_mesh(p, merged=True)),
        "piff": (".piff", (ROOT / "tests/data/piff/gaussian.piff").read_bytes(), _use_piff),
        "star_list": (".csv", b"ra,dec,mag\n53.1,-27.8,18\n53.2,-27.9,19.5\n", _use_stars),
        "star_list_ecsv": (".ecsv", _text(STARS, "ascii.ecsv"), _use_stars),
        "star_list_fits": (".fits", _fits(fits.table_to_hdu(STARS)), _use_stars),
        "camera": (".yaml", (DATA / "camera_comcam.yaml").read_bytes(), pachon.load_camera),
        "tolerances": (".yaml", TOLERANCES, lambda p: pachon.studies.load_tolerances(p, "paul_baker")),
        "optimization": (".yaml", OPTIMIZATION, _use_optimization),
        "align": (".yaml", b"visits: 3\nseed: 2\n", pachon.studies.load_align_configuration),
        "image_stack": (".yaml", b"tiles: 2\nside: 128\n", load_image_stack_configuration),
        "coatings": (".yaml", COATINGS, pachon.design.Coatings.read),
        "states": (".ecsv", _text(STATES, "ascii.ecsv"),
                   lambda p: with_active_optics_state(pachon.load_telescope("lsst_v3.3_r"), str(p), 3)),
        "donuts": (".fits", _donuts(), _use_donuts),
        "donut_table": (".csv", b"field_x,field_y,defocus_um\n0.1,0.2,1500\n0.3,0.4,-1500\n", _use_donut_table),
        "store": (".sweep", _written(_store, ".sweep", folder), _use_store),
    }  # fmt: skip


NAMES = (
    "zmx", "seq", "len", "json", "roa", "zar", "agf", "baseline", "site", "images", "visits",
    "visit_list", "instance_catalogue", "visit_database", "degrees",
    "heights_ecsv", "heights_fits", "galaxies_ecsv", "galaxies_fits", "stars", "mosaic", "grid", "image",
    "foreign_image", "psfex",
    "psf_model", "stl", "glb", "gltf", "obj", "ply", "off", "piff", "star_list", "star_list_ecsv",
    "star_list_fits", "camera", "tolerances", "optimization", "align", "image_stack", "coatings", "states", "donuts",
    "donut_table", "store",
)  # fmt: skip
TOKENS = [
    b"", b"0", b"-1", b"1e400", b"nan", b"inf", b"-0.0", b"9" * 60, b"null", b"[]", b"{}", b"[" * 50, b'"', b"'", b"\0",
    b"\xff\xfe", b"\xc3\xa9", b"\n", b"2147483648", b"999999999", b"/dev/zero", b"1_0", b"\t", b"T", b"#",
]  # fmt: skip


def mutated(data, rng):
    """Return the bytes after one to three mutations: of a stretch, a bit, a number or a line."""
    for _ in range(rng.integers(1, 4)):
        at = int(rng.integers(0, max(1, len(data))))
        length = int(rng.choice([1, 2, 4, 8, 80, 2880]))
        token = TOKENS[rng.integers(len(TOKENS))]
        kind = rng.choice(["bit", "drop", "double", "token", "end", "zero", "largest", "number", "line"])
        if kind == "bit" and data:
            data = data[:at] + bytes([data[at] ^ (1 << int(rng.integers(8)))]) + data[at + 1 :]
        elif kind == "drop":
            data = data[:at] + data[at + length :]
        elif kind == "double":
            data = data[:at] + data[at : at + length] + data[at:]
        elif kind == "token":
            data = data[:at] + token + data[at:]
        elif kind == "end":
            data = data[:at]
        elif kind in ("zero", "largest"):
            byte = b"\0" if kind == "zero" else b"\xff"
            data = data[:at] + byte * min(length, len(data) - at) + data[at + length :]
        elif kind == "number":
            # The next word of digits.
            first = next((i for i in range(at, len(data)) if data[i : i + 1].isdigit()), len(data))
            last = next((i for i in range(first, len(data)) if not data[i : i + 1].isdigit()), len(data))
            data = data[:first] + token + data[last:]
        elif kind == "line":
            lines = data.split(b"\n")
            i, j = rng.integers(0, len(lines), 2)
            lines[i], lines[j] = lines[j], lines[i]
            data = b"\n".join(lines)
    return data


def complaint(path, function):
    """Use a file and return what is wrong with how it was refused; None where it was read or refused as it should."""
    try:
        with bounded(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            function(path)
    except PachonError as error:
        text = str(error)
        return None if text.strip() and "\n" not in text and len(text) <= CHARACTERS else f"message: {text}"
    except Hang:
        return f"more than {SECONDS:g} s"
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return None


@pytest.fixture(scope="module")
def cases(tmp_path_factory):
    made = _cases(tmp_path_factory.mktemp("made"))
    assert tuple(made) == NAMES
    return made


def fuzz(name, case, tmp_path, count):
    suffix, data, function = case
    bad = []
    for seed in range(count):
        for beside in tmp_path.iterdir():
            beside.unlink()
        path = tmp_path / f"file{suffix}"
        path.write_bytes(mutated(data, np.random.default_rng([zlib.crc32(name.encode()), seed])))
        if (problem := complaint(path, function)) is not None:
            bad.append(f"{name}, seed {seed}: {problem[:200]}")
            if KEEP:
                kept = gzip.compress(path.read_bytes(), mtime=0)
                (Path(KEEP) / f"{name}.{seed}{suffix}.gz").write_bytes(kept)
    assert not bad, "\n".join(bad)


@pytest.mark.parametrize("name", NAMES)
def test_files_as_they_are_are_read(name, cases, tmp_path):
    suffix, data, function = cases[name]
    (tmp_path / f"file{suffix}").write_bytes(data)
    with warnings.catch_warnings():
        # Some CCDs have no heights.
        warnings.simplefilter("ignore", pachon.errors.HeightWarning)
        function(tmp_path / f"file{suffix}")


@pytest.mark.long
@pytest.mark.parametrize("name", NAMES)
def test_mutated_files_are_read_or_refused(name, cases, tmp_path):
    fuzz(name, cases[name], tmp_path, 10)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_eight_hundred_mutated_files_of_each_format(name, cases, tmp_path):
    fuzz(name, cases[name], tmp_path, 800)


@pytest.mark.parametrize("path", sorted(CORPUS.glob("*.gz")), ids=lambda path: path.name)
def test_files_that_once_failed(path, cases, tmp_path):
    suffix, _, function = cases[path.name.partition(".")[0]]
    (tmp_path / f"file{suffix}").write_bytes(gzip.decompress(path.read_bytes()))
    assert complaint(tmp_path / f"file{suffix}", function) is None
