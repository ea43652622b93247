"""Coatings of surfaces in prescriptions: read, written, used by throughput, ghosts and illumination."""

import numpy as np
import pytest

import pachon
from pachon.core.errors import PrescriptionError

LENS = """
name: lens
source: a plano-convex lens
version: "1"
units: {length: mm, angle: deg, wavelength: um}
stop: {z: 0}
pupil: {diameter: 1, obscuration: 0}
launch_distance: 100
reference_sphere_radius: 100
field: {radius: 1, limit: 5}
wavelengths: {range: [0.45, 0.7], default: 0.55, band: [0.5, 0.6]}
coatings:
  quarter: {layers: [{index: 1.38, thickness_nm: 99.6}]}
  flat: {wavelength_nm: [400, 800], efficiency: [0.99, 0.97]}
  steep: {wavelength_nm: [400, 800], angle_deg: [0, 40], efficiency: [[0.9, 0.8], [0.7, 0.6]]}
media:
  glass: {n: 1.5}
surfaces:
  - {name: S1, type: refract, shape: sphere, z: 0, radius: -50, medium: glass, coating: quarter}
  - {name: S2, type: refract, shape: plane, z: -4, medium: vacuum, coating: flat}
  - {name: Image, type: detector, shape: plane, z: -101, coating: steep}
"""


@pytest.fixture
def lens(tmp_path):
    (tmp_path / "lens.yaml").write_text(LENS)
    return pachon.load_telescope(tmp_path / "lens.yaml")


def test_they_are_read_and_written_exactly(lens, tmp_path):
    assert lens.surface("S1").coating == pachon.models.LayerStack((1.38,), (99.6e-9,), "quarter")
    assert lens.surface("S2").coating.efficiencies == (0.99, 0.97)
    assert lens.surface("Image").coating.angles == pytest.approx((0.0, np.deg2rad(40.0)))
    for format in ("pachon", "batoid"):
        pachon.save_telescope(lens, tmp_path / "again.yaml", format=format)
        again = pachon.load_telescope(tmp_path / "again.yaml")
        assert [s.coating for s in again.surfaces] == [s.coating for s in lens.surfaces]
    # A change of the telescope keeps them.
    assert lens.perturbed("S1", shift=(1e-5, 0.0, 0.0)).surface("S1").coating == lens.surface("S1").coating


def test_throughput_and_ghosts_take_them(lens):
    found = pachon.design.throughput(lens, [(0.0, 0.0)], [500e-9])
    same = pachon.design.throughput(
        lens, [(0.0, 0.0)], [500e-9], coatings=pachon.design.Coatings({s.name: s.coating for s in lens.surfaces})
    )
    assert found.value == pytest.approx(same.value, rel=1e-14)
    # On the axis: a film with r = (n - m^2) / (n + m^2) at its own wavelength, then both tables; rays are not steep.
    at_film = pachon.design.throughput(lens, [(0.0, 0.0)], [4 * 1.38 * 99.6e-9]).value
    film = 1.0 - ((1.5 - 1.38**2) / (1.5 + 1.38**2)) ** 2
    mean = 4 * 1.38 * 99.6
    tables = (0.99 - 0.02 * (mean - 400) / 400) * (0.9 - 0.2 * (mean - 400) / 400)
    assert at_film == pytest.approx(film * tables, rel=2e-3)
    # One that is given takes the place of the surface's own.
    given = pachon.design.Coatings({"S1": pachon.models.Coating((4e-7, 8e-7), (0.5, 0.5))})
    other = pachon.design.throughput(lens, [(0.0, 0.0)], [4 * 1.38 * 99.6e-9], coatings=given)
    assert other.value == pytest.approx(at_film * 0.5 / film, rel=1e-3)
    ghost = pachon.ghosts(lens, field=(0.0, 0.0), wavelength=550e-9)
    bare = pachon.ghosts(lens.with_coatings({}), field=(0.0, 0.0), wavelength=550e-9)
    assert ghost.summary()["total_flux"] < 0.5 * bare.summary()["total_flux"]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("coating: flat", "coating: flatt", r"surfaces\[S2\].*coating = 'flatt': expected .*flat"),
        ("[0.99, 0.97]", "[0.99, 1.97]", "coatings.flat.*efficiency of flat: expected 2 numbers from 0 to 1"),
        ("coating: steep", "coating: quarter", r"surfaces\[Image\].*layers are those of lens surfaces"),
        ("efficiency: [0.99, 0.97]", "layers: []", "coatings.flat"),
    ],
)
def test_wrong_ones_are_refused(tmp_path, old, new, words):
    assert old in LENS
    (tmp_path / "bad.yaml").write_text(LENS.replace(old, new))
    with pytest.raises(PrescriptionError, match=words) as found:
        pachon.load_telescope(tmp_path / "bad.yaml")
    assert "\n" not in str(found.value)


def test_formats_without_coatings_refuse_them(lens, tmp_path):
    for name in ("lens.zmx", "lens.json"):
        with pytest.raises(PrescriptionError, match=r"coating of S1, coating of S2, coating of Image: .* no place"):
            pachon.save_telescope(lens, tmp_path / name)
        with pytest.warns(match="coating of S1"):
            pachon.save_telescope(lens, tmp_path / name, lenient=True)
        assert pachon.load_telescope(tmp_path / name).surface_names


def test_coatings_without_a_name_load_back_equal(lens, tmp_path):
    nameless = lens.with_coatings({"S1": pachon.models.Coating((4e-7, 8e-7), (0.9, 0.8))})
    pachon.save_telescope(nameless, tmp_path / "again.yaml")
    assert pachon.load_telescope(tmp_path / "again.yaml") == nameless
