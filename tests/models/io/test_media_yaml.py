"""Media in prescription files: read, written back, refused."""

import pytest

from pachon.core.errors import PrescriptionError
from pachon.models.io.glass_catalogue import GlassCatalogue
from pachon.models.io.prescription import load_telescope, save_telescope
from pachon.models.media.air import Air
from pachon.models.media.dispersion import Dispersion
from pachon.models.media.medium import ChangedIndex, ConstantIndex, RelativeToAir, Sellmeier
from pachon.models.media.tabulated import TabulatedIndex

SCHOTT = "{formula: schott, coefficients: [2.27, -0.0101, 0.0106, 2.1e-4, -7.6e-6, 4.9e-7], range: [0.4, 1.0]}"
MEDIA = {
    "{n: 1.5}": ConstantIndex(1.5),
    "{B: [0.7, 0.9], C: [0.005, 98.0], range: [0.4, 2.5]}": Sellmeier((0.7, 0.9), (0.005, 98.0), (0.4e-6, 2.5e-6)),
    SCHOTT: Dispersion("schott", (2.27, -0.0101, 0.0106, 2.1e-4, -7.6e-6, 4.9e-7), (0.4e-6, 1e-6)),
    "{wavelengths: [0.4, 0.6, 1.0], indices: [1.53, 1.52, 1.51], interpolation: linear}": TabulatedIndex(
        (0.4e-6, 0.6e-6, 1e-6), (1.53, 1.52, 1.51), "linear"
    ),
    "{wavelengths: [0.4, 0.6, 1.0], indices: [1.53, 1.52, 1.51]}": TabulatedIndex(
        (0.4e-6, 0.6e-6, 1e-6), (1.53, 1.52, 1.51)
    ),
    "{air: ciddor, pressure_pa: 74000, temperature_k: 283, water_vapour_pa: 500, co2_ppm: 420}": Air(
        74000.0, 283.0, 500.0, 420.0
    ),
    "{air: filippenko}": Air(formula="filippenko"),
    "{glass: n-bk7}": GlassCatalogue.bundled()["N-BK7"],
    "{glass: N-BK7, in_air: {air: ciddor, temperature_k: 293.15}}": GlassCatalogue.bundled().in_vacuum("N-BK7"),
    "{n: 1.5, shift: 1.0e-5}": ChangedIndex(ConstantIndex(1.5), 1e-5),
    "{B: [1.0], C: [0.01], range: [0.3, 2.5], shift: 1.0e-5, dispersion: 1.02}": ChangedIndex(
        Sellmeier((1.0,), (0.01,), (0.3e-6, 2.5e-6)), 1e-5, dispersion=1.02
    ),
    "{glass: F2, in_air: {air: ciddor}, shift: -2.0e-5}": ChangedIndex(
        RelativeToAir(GlassCatalogue.bundled()["F2"], Air()), -2e-5
    ),
}
TEXT = """
name: lens
source: a test
version: "1"
units: {length: m, angle: deg, wavelength: um}
stop: {z: 0.0}
pupil: {diameter: 0.02, obscuration: 0.0}
launch_distance: 1.0
reference_sphere_radius: 1.0
field: {radius: 1.0, limit: 2.0}
wavelengths: {range: [0.5, 0.9], default: 0.6}
media:
  mine: MEDIUM
surfaces:
  - {name: front, type: refract, shape: sphere, z: 0.0, radius: -0.1, medium: mine}
  - {name: back, type: refract, shape: plane, z: -0.005, medium: vacuum}
  - {name: image, type: detector, shape: plane, z: -0.2}
"""


def loaded(tmp_path, medium):
    path = tmp_path / "lens.yaml"
    path.write_text(TEXT.replace("MEDIUM", medium), encoding="utf-8")
    return load_telescope(path)


@pytest.mark.parametrize(("text", "medium"), MEDIA.items())
def test_every_kind_is_read_and_written_back(tmp_path, text, medium):
    telescope = loaded(tmp_path, text)
    found = telescope.surface("front").medium_after
    assert found == medium
    assert found.name == "mine"
    save_telescope(telescope, tmp_path / "again.yaml")
    again = load_telescope(tmp_path / "again.yaml")
    assert again == telescope
    assert again.surface("front").medium_after.name == "mine"


def test_a_catalogue_beside_the_file_is_found(tmp_path):
    (tmp_path / "own.agf").write_text("NM MINE 1 0 1.5 60\nCD 2.25\nLD 0.4 1.0\n", encoding="utf-8")
    telescope = loaded(tmp_path, "{glass: mine, catalogue: own.agf}")
    assert float(telescope.surface("front").medium_after.index(6e-7)) == 1.5


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("{formula: shot, coefficients: [1.0], range: [0.4, 1.0]}", "media.mine.formula = 'shot'"),
        ("{formula: schott, coefficients: [1.0], range: [0.4]}", "media.mine.range = .*2 numbers"),
        ("{glass: N-BK8}", "media.mine.glass = 'N-BK8': expected a glass of the catalogue .*did you mean N-BK7"),
        ("{glass: N-BK7, catalogue: none.agf}", r"none\.agf: no such file"),
        ("{air: edlen}", "media.mine.formula = 'edlen': expected one of ciddor, filippenko"),
        ("{air: ciddor, pressure: 1.0}", "unknown key media.mine.pressure .*pressure_pa"),
        ("{n: 1.5, range: [0.4, 1.0]}", "unknown key media.mine.range"),
        ("{wavelengths: [0.4], indices: [1.5]}", "media.mine.wavelengths"),
        ("{n: 1.5, in_air: 3}", "media.mine.in_air = 3: expected a mapping"),
    ],
)
def test_a_malformed_medium_is_one_line_with_its_key(tmp_path, text, expected):
    with pytest.raises(PrescriptionError, match=expected) as error:
        loaded(tmp_path, text)
    assert "\n" not in str(error.value)
    assert str(tmp_path) in str(error.value)
