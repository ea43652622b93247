"""Glasses by name: makers' catalogues and those that a user has configured."""

import os

import pytest

import pachon
from pachon.core.errors import ConfigError, PrescriptionError, PrescriptionWarning
from pachon.models.io.glass_catalogue import GlassCatalogue
from pachon.models.io.glass_search import find_glass
from pachon.models.io.prescription import prescription_digest
from pachon.models.io.user_glasses import user_catalogues, user_configuration_path

MINE = "NM MYGLASS 1 0 1.6 50\nCD 2.56\nLD 0.3 2.0\nNM N-BK7 1 0 1.9 50\nCD 3.61\nLD 0.3 2.0\n"
LENS = """MODE SEQ
ENPD 5
UNIT MM
FTYP 0 0 1 1
YFLN 1
WAVM 1 0.55 1
SURF 0
  DISZ INFINITY
SURF 1
  STOP
  CURV 0.01
  GLAS {glass} 0 0 1.5 40
  DISZ 3
SURF 2
  DISZ 50
SURF 3
"""


@pytest.fixture
def catalogue(tmp_path):
    folder = tmp_path / "glasses"
    folder.mkdir()
    (folder / "mine.agf").write_text(MINE)
    (folder / "notes.txt").write_text("no catalogue")
    return folder / "mine.agf"


@pytest.fixture(autouse=True)
def no_configuration(monkeypatch, tmp_path):
    monkeypatch.delenv("PACHON_GLASS_PATH", raising=False)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))


def configure(text):
    path = user_configuration_path()
    path.parent.mkdir(parents=True)
    path.write_text(text)
    return path


def lens(tmp_path, glass):
    path = tmp_path / "lens.zmx"
    path.write_text(LENS.format(glass=glass))
    return path


def test_a_glass_is_looked_up_at_its_makers(tmp_path):
    assert find_glass("nlak9") == GlassCatalogue.of_maker("schott")["N-LAK9"]
    # Schott comes before Hikari, which has an SF15 of its own; Sumita's name is its alone.
    assert find_glass("K-SSK1") == GlassCatalogue.of_maker("sumita")["K-SSK1"]
    assert find_glass("NOGLASS") is None
    # What a user can do about it, with the nearest names of all makers.
    with pytest.raises(PrescriptionError, match=r"no catalogue: expected .*--glass-catalogue .*L-TIM28 or") as found:
        pachon.load_telescope(lens(tmp_path, "L-TIM28_MOLD"))
    assert "\n" not in str(found.value)
    telescope = pachon.load_telescope(lens(tmp_path, "L-TIM28"))
    # Ohara's data sheet: 1.68948.
    assert float(telescope.surfaces[0].medium_after.index(587.56e-9)) == pytest.approx(1.68948, abs=5e-6)


@pytest.mark.parametrize("way", ["file", "folder", "variable"])
def test_a_configured_catalogue_is_searched_after_the_bundled_ones(tmp_path, monkeypatch, catalogue, way):
    path = lens(tmp_path, "MYGLASS")
    with pytest.raises(PrescriptionError, match=r"GLAS MYGLASS .* the glass is in no catalogue"):
        pachon.load_telescope(path)
    if way == "variable":
        monkeypatch.setenv("PACHON_GLASS_PATH", os.pathsep.join([str(catalogue), str(catalogue.parent)]))
    else:
        # Relative to the folder of the configuration, or absolute.
        named = f"../../glasses/{catalogue.name}" if way == "file" else catalogue.parent
        configure(f"glass_catalogues: [{named}]\n")
    assert float(pachon.load_telescope(path).surfaces[0].medium_after.index(550e-9)) == pytest.approx(1.6, rel=1e-15)
    # The bundled N-BK7 comes first, one that is given before it.
    bk7 = lens(tmp_path, "N-BK7")
    assert pachon.load_telescope(bk7).surfaces[0].medium_after == GlassCatalogue.bundled()["N-BK7"]
    given = pachon.load_telescope(bk7, glass_catalogues=[catalogue])
    assert float(given.surfaces[0].medium_after.index(550e-9)) == pytest.approx(1.9, rel=1e-15)


def test_configured_catalogues_belong_to_the_digest_of_a_lens_file(tmp_path, catalogue):
    path = lens(tmp_path, "MYGLASS")
    without = prescription_digest(path)
    configure(f"glass_catalogues: [{catalogue}]\n")
    configured = prescription_digest(path)
    assert configured != without
    catalogue.write_text(MINE.replace("2.56", "2.57"))
    assert prescription_digest(path) not in (configured, without)
    # Of our own files, which name no glasses, they are no part.
    own = tmp_path / "own.yaml"
    pachon.save_telescope(pachon.paul_baker(), own)
    before = prescription_digest(own)
    catalogue.write_text(MINE)
    assert prescription_digest(own) == before


def test_wrong_configurations_are_named(tmp_path, monkeypatch, catalogue):
    assert user_catalogues() == ()
    path = configure("glass_catalogues: [nowhere.agf]\n")
    with pytest.warns(PrescriptionWarning, match=r"config.yaml: glass_catalogues: .*nowhere.agf: expected an AGF file"):
        assert user_catalogues() == ()
    path.write_text("glass_catalogs: [a.agf]\n")
    with pytest.raises(ConfigError, match=r"config.yaml: unknown key glass_catalogs"):
        user_catalogues()
    path.write_text("glass_catalogues: mine.agf\n")
    with pytest.raises(ConfigError, match="glass_catalogues"):
        user_catalogues()
    monkeypatch.setenv("PACHON_GLASS_PATH", str(tmp_path / "none"))
    with pytest.warns(PrescriptionWarning, match=r"PACHON_GLASS_PATH: .*none: expected an AGF file, or a folder"):
        assert user_catalogues() == ()


def test_a_catalogue_for_a_telescope_without_glasses_is_refused(tmp_path):
    own = tmp_path / "mine.yaml"
    pachon.save_telescope(pachon.load_telescope("paul_baker"), own)
    for name in ("paul_baker", str(own)):
        with pytest.raises(PrescriptionError, match=r"glass_catalogues: expected a lens file \(\.zmx, ") as error:
            pachon.load_telescope(name, glass_catalogues=["nofile.agf"])
        assert str(error.value).startswith(f"{name}: ")
