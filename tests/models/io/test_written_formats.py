"""Telescopes written in every format and read back: rays, design data, and what is refused by name."""

import re
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import pachon
from pachon.core.errors import ConfigError, PrescriptionError, PrescriptionWarning
from pachon.models.aperture import Circle, Complement, Polygon, Rectangle
from pachon.models.design_data import DesignData
from pachon.models.io.glass_catalogue import GlassCatalogue
from pachon.models.io.prescription import WRITTEN
from pachon.models.media.dispersion import Dispersion
from pachon.models.media.medium import ConstantIndex, Sellmeier
from pachon.models.media.tabulated import TabulatedIndex
from pachon.models.shapes.freeform import Toroid
from pachon.models.shapes.polynomial import XYPolynomial, ZernikeSag
from pachon.models.shapes.sum import Sum
from pachon.models.surface import Interaction

ROOT = Path(__file__).parents[3]
LENSES = ROOT / "tests" / "data" / "lenses"
ENDINGS = [ending for ending in WRITTEN if ending != ".yml"]
#: What each format changes of the design data, besides rounding; OSLO begins with the primary wavelength.
CHANGED = {
    ".yaml": (), ".zmx": (), ".seq": ("aiming", "length_unit"), ".len": ("aiming", "wavelengths", "wavelength_weights"),
    ".json": ("aiming", "length_unit", "temperature", "pressure"), ".roa": ("aiming",),
}  # fmt: skip


def lens(name):
    return pachon.load_telescope(LENSES / f"{name}.zmx")


def again(telescope, path, **options):
    """Write a telescope and read it back, without warnings in the way."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PrescriptionWarning)
        pachon.save_telescope(telescope, path, **options)
    return pachon.load_telescope(path)


def warnings_of(telescope, path):
    """Return what is said where a telescope is written leniently."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        pachon.save_telescope(telescope, path, lenient=True)
    return "\n".join(str(one.message) for one in said)


def with_surface(telescope, name, **changes):
    surfaces = tuple(replace(s, **changes) if s.name == name else s for s in telescope.surfaces)
    return replace(telescope, surfaces=surfaces)


def with_glass(telescope, glass):
    old = telescope.surfaces[0].medium_after
    surfaces = tuple(replace(s, medium_after=glass if s.medium_after == old else old) for s in telescope.surfaces[:1])
    return replace(telescope, surfaces=(*surfaces, *telescope.surfaces[1:]))


def assert_same_rays(one, other, *, statuses=True):
    """Compare rays at every surface, at all wavelengths, on the axis and off it."""
    rng = np.random.default_rng(5)
    radius, angle = 0.5 * one.pupil_diameter * np.sqrt(rng.uniform(size=40)), rng.uniform(0, 2 * np.pi, 40)
    points = (radius * np.cos(angle), radius * np.sin(angle))
    # Each program aims rays in its own way: here they go through the same points of the entrance pupil.
    one, other = (t.with_design(aiming="off") for t in (one, other))
    down = one.surfaces[0].vertex[2] - other.surfaces[0].vertex[2]
    for wavelength in {one.default_wavelength, *one.design_data.wavelengths}:
        for fraction in (0.0, 0.6):
            field = (0.3 * fraction * one.field_radius, fraction * one.field_radius)
            traced = []
            for telescope in (one, other):
                rays = pachon.launch_rays(telescope, field, wavelength, points, projection="zemax")
                traced.append(pachon.trace(telescope, rays, surfaces="all"))
            for here, there in zip(*traced, strict=True):
                if statuses:
                    assert np.array_equal(here.status, there.status)
                lit = np.asarray(here.status) <= pachon.RayStatus.VIGNETTED
                assert lit.sum() > 20
                # Heights of several metres, in millimetres in the file.
                difference = np.array(here.position) - np.array(there.position) - [0.0, 0.0, down]
                assert np.abs(difference[lit]).max() < 1e-12


def assert_same_data(one, other, changed=()):
    """Compare design data, but for the keys that a format changes."""
    for key in set(DesignData.__dataclass_fields__) - set(changed):
        here, there = getattr(one.design_data, key), getattr(other.design_data, key)
        if isinstance(here, tuple) and here and not hasattr(here[0], "address"):
            assert np.allclose(here, there, rtol=1e-14, atol=1e-17), key
        else:
            assert there == (pytest.approx(here, rel=1e-14) if isinstance(here, float) else here), key
    if "wavelengths" in changed:
        data, read = one.design_data, other.design_data
        weights = dict(zip(data.wavelengths, data.wavelength_weights, strict=True))
        assert dict(zip(read.wavelengths, read.wavelength_weights, strict=True)) == weights


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("name", ["triplet", "ritchey_chretien"])
def test_every_format_reads_back_what_was_written(tmp_path, name, ending):
    telescope = lens(name)
    assert telescope.design_data.stop is not None
    assert len(telescope.design_data.fields) == len(telescope.design_data.wavelengths) == 3
    read = again(telescope, tmp_path / f"again{ending}")
    assert read.surface_names == telescope.surface_names
    assert [s.interaction for s in read.surfaces] == [s.interaction for s in telescope.surfaces]
    assert [s.medium_after for s in read.surfaces] == [s.medium_after for s in telescope.surfaces]
    for here, there in zip(telescope.surfaces, read.surfaces, strict=True):
        assert (here.aperture is None) == (there.aperture is None)
        if here.aperture is not None:
            assert isinstance(there.aperture, Circle)
            assert there.aperture.radius == pytest.approx(here.aperture.radius, rel=1e-14)
    assert read.description == telescope.description
    assert read.default_wavelength == telescope.default_wavelength
    assert read.stop_z == pytest.approx(telescope.stop_z, abs=1e-15)
    assert read.pupil_diameter == pytest.approx(telescope.pupil_diameter, rel=1e-14)
    assert_same_data(telescope, read, CHANGED[ending])
    assert_same_rays(telescope, read)


#: Lenses and what formats refuse of them, as a part of the line; warnings, but for shapes, where lenient.
REFUSED = {
    ("odd_asphere", ".seq"): "surface front: shape: a CODE V file is written with conics",
    ("fold", ".len"): "surface fold: aperture Ellipse: an OSLO file has discs about the vertex",
    ("relay", ".len"): "field_weights: an OSLO file has no place for them",
}


@pytest.mark.parametrize("ending", [".seq", ".len", ".roa"])
@pytest.mark.parametrize("name", ["singlet", "doublet", "aspheres", "odd_asphere", "decentred", "fold", "relay"])
def test_rays_of_lenses_written_in_other_formats(tmp_path, name, ending):
    telescope, path = lens(name), tmp_path / f"lens{ending}"
    words = REFUSED.get((name, ending))
    if words is not None:
        with pytest.raises(PrescriptionError, match=f"^{name}: {words}"):
            again(telescope, path)
        assert not path.exists()
        if "shape" in words:
            return
        assert words in warnings_of(telescope, path)
    read = again(telescope, path, lenient=words is not None)
    assert_same_rays(telescope, read, statuses=words is None or "aperture" not in words)
    changed = {*CHANGED[ending], *(("field_weights",) if words is not None else ())}
    # The paraxial focal ratio is that of surfaces on one axis: folded, the diameter of the pupil is written.
    changed |= {"aperture", "aperture_value"} if name == "fold" else set()
    assert_same_data(telescope, read, changed)
    sizes = [s.semi_diameter for s in telescope.surfaces]
    if any(sizes) and ending != ".roa":
        # OSLO's one AP is the size of a clear disc too; ray-optics has a size for every surface.
        kept = [r.semi_diameter for s, r in zip(telescope.surfaces, read.surfaces, strict=True) if s.aperture is None]
        known = [s.semi_diameter for s in telescope.surfaces if s.aperture is None]
        assert kept == pytest.approx(known)


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_tilted_stop_stays_on_its_surface(tmp_path, ending):
    """The image of a tilted stop stands where it stood: its middle did not move."""
    telescope = lens("singlet").with_design(aiming="off")
    telescope = telescope.perturbed(telescope.design_data.stop, tilt=(0.01, 0.0, 0.0))
    read = again(telescope, tmp_path / f"lens{ending}", lenient=True)
    assert read.design_data.stop == telescope.design_data.stop
    assert_same_rays(telescope, read)


@pytest.mark.parametrize("ending", [".zmx", ".seq", ".len", ".json", ".roa"])
def test_a_stop_that_does_not_make_the_pupil_stands_on_a_plane_in_front(tmp_path, ending):
    telescope = lens("singlet").with_design(aiming="off")
    telescope = replace(telescope, stop_z=telescope.stop_z + 1e-3)
    path = tmp_path / f"lens{ending}"
    read = again(telescope, path, lenient=True)
    assert "the stop and the stated aperture do not make the pupil" in warnings_of(telescope, path)
    assert read.design_data.stop is None
    assert_same_rays(telescope, read)


@pytest.mark.parametrize("aperture", ["FLOA", "FNUM 12 0"])
@pytest.mark.parametrize("ending", [".yaml", ".zmx", ".seq", ".len", ".json", ".roa"])
def test_a_stop_behind_a_fold_keeps_its_pupil(tmp_path, ending, aperture):
    """Distances along the first axis, in Zemax and CODE V files, made another pupil: 29 mm for 40 of a doublet."""
    text = (LENSES / "fold.zmx").read_text().replace("  STOP\n", "").replace("FNUM 6 0", aperture)
    stop = "DISZ -20\nSURF 7\n  STOP\n  TYPE STANDARD\n  CURV 0\n  DIAM 2 1\n  DISZ -25.9\nSURF 8\n"
    (tmp_path / "fold.zmx").write_text(text.replace("DISZ -45.9\nSURF 7\n", stop))
    telescope = pachon.load_telescope(tmp_path / "fold.zmx").with_design(aiming="off")
    assert telescope.design_data.stop == "S7"
    read = again(telescope, tmp_path / f"again{ending}", lenient=True)
    assert read.pupil_diameter == pytest.approx(telescope.pupil_diameter, rel=1e-12)
    assert_same_rays(telescope, read)
    # Where rays are aimed the stop stays.
    aimed = again(telescope.with_design(aiming="paraxial"), tmp_path / f"aimed{ending}", lenient=True)
    assert aimed.design_data.stop == "S7"


@pytest.mark.parametrize("ending", [".zmx", ".seq", ".len", ".json", ".roa"])
def test_a_detector_in_front_of_others_is_a_plane_that_the_light_passes(tmp_path, ending):
    """It ended the glass that it stands in, and a ray-optics file had a gap too few to be read."""
    telescope = pachon.load_telescope(LENSES / "fold.zmx").with_design(aiming="paraxial")
    pachon.save_telescope(telescope, tmp_path / "fold.yaml")
    text = (tmp_path / "fold.yaml").read_text()
    place = text.index("  - {name: ", text.index("{name: crown"))
    monitor = "  - {name: monitor, type: detector, shape: plane, z: -0.002}\n"
    (tmp_path / "fold.yaml").write_text(text[:place] + monitor + text[place:])
    telescope = pachon.load_telescope(tmp_path / "fold.yaml")
    assert telescope.surfaces[1].interaction == Interaction.DETECTOR
    read = again(telescope, tmp_path / f"again{ending}", lenient=True)
    assert len(read.surfaces) == len(telescope.surfaces)
    assert [s.interaction for s in read.surfaces].count(Interaction.DETECTOR) == 1
    assert_same_rays(telescope, read)


#: A triplet whose stop is the back of its negative lens; no ray aiming, as is Zemax's default.
STOP_INSIDE = ROOT / "tests" / "data" / "lensfiles" / "stop_inside.zmx"


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize(
    "change", [{"S2.thickness_mm": 2.0, "S1.radius_mm": 3.0}, {"S1.dy_um": 100.0}, {"S3.rx_mrad": 2.0}]
)
def test_a_changed_lens_keeps_its_stop_inside(tmp_path, ending, change):
    telescope = pachon.load_telescope(STOP_INSIDE)
    changed = pachon.models.apply_changes(telescope, change)
    path = tmp_path / f"lens{ending}"
    read = again(changed, path)
    assert "pachon entrance pupil" not in path.read_text()
    assert (read.design_data.stop, read.surface_names) == ("S4", telescope.surface_names)
    assert read.pupil_diameter == pytest.approx(0.01, rel=1e-14)
    # The first vertex is the origin of what is read.
    shift = read.surfaces[0].vertex[2] - changed.surfaces[0].vertex[2]
    assert read.stop_z == pytest.approx(changed.stop_z + shift, abs=1e-15)
    # Files of lenses have no place for a pupil off the axis; CODE V aims its rays at the stop.
    assert any(changed.pupil_center) == ("S2.thickness_mm" not in change)
    said = "centre of the entrance pupil (" in warnings_of(changed, path)
    assert said == (any(changed.pupil_center) and ending not in (".seq", ".yaml"))
    assert_same_rays(changed if ending == ".yaml" else replace(changed, pupil_center=(0.0, 0.0)), read)


@pytest.mark.parametrize("name", ["lsst_v3.3_r", "paul_baker"])
@pytest.mark.parametrize("ending", [".seq", ".len", ".roa"])
def test_telescopes_without_design_data(tmp_path, name, ending):
    """Their pupil stands on a plane in front, which the reader takes off; their glass is a table of three indices."""
    telescope = pachon.load_telescope(name)
    read = again(telescope, tmp_path / f"again{ending}", lenient=True)
    assert read.surface_names == telescope.surface_names
    assert read.stop_z - read.surfaces[0].vertex[2] == pytest.approx(
        telescope.stop_z - telescope.surfaces[0].vertex[2], abs=1e-14
    )
    assert_same_rays(telescope, read, statuses=ending == ".seq")


@pytest.mark.parametrize("ending", [".zmx", ".seq", ".len", ".json", ".roa"])
def test_an_obscuration_that_no_aperture_makes_is_told(tmp_path, ending):
    """Files of lenses have apertures alone: light fills the middle of what is read."""
    singlet, path = lens("singlet"), tmp_path / f"lens{ending}"
    blocked = replace(singlet, pupil_obscuration=0.4)
    assert "pupil.obscuration = 0.4" not in warnings_of(singlet, path)
    said = warnings_of(blocked, path)
    assert "pupil.obscuration = 0.4: " in said
    assert "has no place for it; read back it is that of the apertures, 0" in said
    assert pachon.load_telescope(path).pupil_obscuration == 0.0
    # The rim of M1 makes it.
    assert "pupil.obscuration" not in warnings_of(pachon.load_telescope("paul_baker"), path)


def test_text_of_a_codev_file(tmp_path):
    again(
        lens("singlet").with_design(vignetting=((0.0,) * 5, (0.0, 0.1, 0.2, 0.3, 0.0), (0.0,) * 5)), tmp_path / "a.seq"
    )
    text = (tmp_path / "a.seq").read_text()
    lines = [line.strip() for line in text.splitlines()]
    for line in (
        "TITLE 'Singlet at finite conjugates'", "DIM M", "NAO 0.06", "WL 486.1327 587.5618 656.2725", "REF 2",
        "WTW 1.0 2.0 1.0", "YOB 0.0 7.0 10.0", "TEM 25.0", "VUX 0.0 0.2 0.0", "VLX 0.0 0.2 0.0",
        "SO 0.0 150.0", "S 60.0 5.0 NBK7_SCHOTT", "STO", "CIR EDG 14.0", "CIR 13.0", "S -60.0 93.0", "SI 0.0 0.0",
    ):  # fmt: skip
        assert line in lines, line
    # Atmospheres in millimetres of mercury.
    assert float(re.search(r"^PRE (.*)$", text, re.M)[1]) == pytest.approx(0.9 * 760.0)
    upper, lower = (float(re.search(rf"^V{half}Y 0.0 (\S+)", text, re.M)[1]) for half in "UL")
    # The pupil reaches from lower - 1 to 1 - upper: decentre 0.1, compression 0.3.
    assert (upper, lower) == (pytest.approx(0.2), pytest.approx(0.4))


def test_text_of_an_oslo_file(tmp_path):
    again(replace(lens("doublet"), description='Air "100 mm" 2 lens; f/4'), tmp_path / "a.len")
    lines = (tmp_path / "a.len").read_text().splitlines()
    # Numbers that stand by themselves would be arguments of LEN NEW.
    assert lines[0] == 'LEN NEW "Air mm lens; f/4" 100 4'
    for line in ("EBR 12.5", "ANG 1.0", "UNI 1.0", "TEM 20.0", "PRE 1.0", "GLA N-BK7", "AST", "AP CHK 13.0", "RFL"):
        assert (line in lines) == (line != "RFL"), line
    # The primary wavelength is the first one.
    assert "WV 0.5875618 0.4861327 0.6562725" in lines
    assert "WW 2.0 1.0 1.0" in lines
    assert lines[-1] == "END 4"


def test_system_data_that_oslo_has_not(tmp_path):
    telescope, path = lens("doublet"), tmp_path / "a.len"
    fields = telescope.design_data.fields
    shifted = ((0.0, 0.0, 0.1, 0.1, 0.0),) * 3
    for changes, words in (
        ({"fields": ((0.0, 0.0), (0.0, 0.01))}, "fields: an OSLO file states one, and means 0, 0.7 and 1 times it"),
        ({"fields": tuple((y, x) for x, y in fields)}, "fields: an OSLO file states one"),
        ({"vignetting": shifted}, "vignetting: an OSLO file has no place for its factors"),
        ({"aperture": "stop", "aperture_value": 0.0125}, "aperture = stop: an OSLO file has no place for it"),
    ):
        with pytest.raises(PrescriptionError, match=f"^doublet: {re.escape(words)}"):
            again(telescope.with_design(**changes), path)
        assert not path.exists()
        read = again(telescope.with_design(**changes), path, lenient=True)
        assert read.pupil_diameter == pytest.approx(0.025, rel=1e-14)
        path.unlink()
    real = telescope.with_design(field_type="real_image_height", fields=((0.0, 0.0), (0.0, 7e-4), (0.0, 1e-3)))
    with pytest.raises(PrescriptionError, match="field_type = real_image_height: an OSLO file has none"):
        again(real, path, lenient=True)


def test_vignetting_factors_are_written_where_there_is_a_place(tmp_path):
    factors = ((0.0,) * 5, (0.05, -0.1, 0.2, 0.3, 0.0), (-0.05, 0.1, 0.0, 0.25, 0.0))
    telescope = lens("triplet").with_design(vignetting=factors)
    for ending in (".seq", ".roa"):
        read = again(telescope, tmp_path / f"a{ending}")
        assert np.allclose(read.design_data.vignetting, factors, rtol=0, atol=1e-15)
        turned = telescope.with_design(vignetting=((0.0, 0.0, 0.1, 0.1, 0.3),) * 3)
        with pytest.raises(PrescriptionError, match=r"triplet: vignetting: .* has no angle of the pupil"):
            again(turned, tmp_path / f"b{ending}", lenient=True)


def test_a_changed_aiming_is_said(tmp_path):
    with pytest.warns(PrescriptionWarning, match="aiming = off: a CODE V file does not state .* it is paraxial"):
        pachon.save_telescope(lens("doublet"), tmp_path / "a.seq")
    with pytest.warns(PrescriptionWarning, match="aiming = paraxial: an OSLO file does not state .* it is off"):
        pachon.save_telescope(lens("triplet"), tmp_path / "a.len")


GLASSES = {
    "constant": ConstantIndex(1.46, "melt 7"),
    "table": TabulatedIndex((4e-7, 5e-7, 6e-7, 7e-7), (1.53, 1.52, 1.515, 1.513), name="mine"),
    "Sellmeier": Sellmeier((0.696, 0.408, 0.897), (0.00468, 0.0135, 97.9), (3e-7, 2e-6), name="silica"),
    "Buchdahl": Dispersion("buchdahl", (1.6, -0.07, 0.008, 0.5875618), (4e-7, 8e-7), name="model"),
    "Herzberger": Dispersion("herzberger", (2.4, 0.1, 1e-3, -1e-4, 1e-6, 1e-9), (4e-7, 8e-7), name="salt"),
}


@pytest.mark.parametrize("kind", GLASSES)
@pytest.mark.parametrize("ending", [".seq", ".len", ".roa"])
def test_glasses_of_no_catalogue(tmp_path, kind, ending):
    glass, path = GLASSES[kind], tmp_path / f"a{ending}"
    telescope = with_glass(lens("singlet"), glass)
    held = kind in ("constant", "table") or (ending == ".roa" and kind in ("Sellmeier", "Buchdahl"))
    if not held:
        with pytest.raises(PrescriptionError, match=rf"singlet: glass {glass.name}: a.* has no place for its formula"):
            again(telescope, path)
    read = again(telescope, path, lenient=not held).surfaces[0].medium_after
    waves = np.array(telescope.design_data.wavelengths)
    # At the stated wavelengths tables have the indices of their formulas.
    assert np.allclose(read.index(waves), glass.index(waves), rtol=3e-16, atol=0)
    if held and kind != "constant":
        assert read.wavelength_range == glass.wavelength_range
        between = np.linspace(*glass.wavelength_range, 50)[1:-1]
        assert np.allclose(read.index(between), glass.index(between), rtol=3e-16, atol=0)
    if kind == "table":
        assert read == glass


def test_names_of_glasses_in_codev_files(tmp_path):
    """Without hyphens and with the maker; what stands behind an underscore would be taken for one."""
    silica, crown = GlassCatalogue.bundled()["F_SILICA"], GlassCatalogue.of_maker("ohara")["S-BSL7"]
    read = again(with_glass(lens("singlet"), crown), tmp_path / "a.seq")
    assert "SBSL7_OHARA" in (tmp_path / "a.seq").read_text()
    assert read.surfaces[0].medium_after == crown
    with pytest.raises(PrescriptionError, match="glass F_SILICA: a CODE V file has no place for its formula"):
        again(with_glass(lens("singlet"), silica), tmp_path / "b.seq")
    read = again(with_glass(lens("singlet"), silica), tmp_path / "b.seq", lenient=True).surfaces[0].medium_after
    assert read.name == "FSILICA"
    assert 18 <= len(read.wavelengths) <= 21


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"shape": ZernikeSag((0.0, 0.0, 0.0, 1e-6), 0.012)}, r"surface crown: shape ZernikeSag: expected a conic"),
        ({"shape": Sum((Toroid(0.06, 0.07), XYPolynomial(((1, 0, 1e-6),))))}, "surface crown: sum of Toroid, XYPoly"),
        ({"aperture": Polygon(((-0.01, -0.01), (0.01, -0.01), (0.0, 0.02)))}, "surface crown: aperture Polygon"),
        ({"aperture": Complement(Rectangle(0.01, 0.01))}, "surface crown: aperture obscuring Rectangle"),
        ({"semi_diameter": None, "shape": Toroid(0.06, 0.07)}, "surface crown: shape: a"),
    ],
)
@pytest.mark.parametrize("ending", [".seq", ".len", ".roa"])
def test_what_has_no_counterpart_is_one_line(tmp_path, ending, changes, words):
    telescope = with_surface(lens("doublet"), "crown", **changes)
    if ending == ".len" and "shape: a" in words:
        read = again(telescope, tmp_path / "toroid.len")
        assert isinstance(read.surfaces[0].shape, Toroid)
        assert_same_rays(telescope, read)
        return
    with pytest.raises(PrescriptionError, match=f"^doublet: {words}") as found:
        again(telescope, tmp_path / f"a{ending}")
    assert "\n" not in str(found.value)
    assert list(tmp_path.iterdir()) == []


def test_polynomials_of_x_and_y_in_oslo(tmp_path):
    terms = ((1, 0, 1e-4), (0, 2, 1e-2), (2, 1, 0.3), (0, 3, -0.2))
    sphere = lens("doublet").surfaces[0].shape
    # Of several polynomials, as of a deformation, equal powers add up.
    for further in ((), (XYPolynomial(((2, 1, 0.5), (1, 0, 2e-4))), XYPolynomial(((2, 0, 1e-3), (0, 2, 1e-3))))):
        telescope = with_surface(lens("doublet"), "crown", shape=Sum((sphere, XYPolynomial(terms), *further)))
        assert_same_rays(telescope, again(telescope, tmp_path / "a.len"))


def test_squares_of_the_radius(tmp_path):
    """A term in r^2 has a place in OSLO and ray-optics, none in CODE V; on a plane it makes an even asphere."""
    square = XYPolynomial(((2, 0, 1e-3), (0, 2, 1e-3)))
    fourth = XYPolynomial(((4, 0, 2.0), (2, 2, 4.0), (0, 4, 2.0)))
    doublet = lens("doublet")
    for shape in (Sum((doublet.surfaces[0].shape, square)), Sum((square, fourth))):
        telescope = with_surface(doublet, "crown", shape=shape)
        for ending in (".len", ".roa"):
            assert_same_rays(telescope, again(telescope, tmp_path / f"a{ending}", lenient=True))
        with pytest.raises(PrescriptionError, match="surface crown: shape: a CODE V file"):
            again(telescope, tmp_path / "a.seq", lenient=True)
    assert_same_rays(
        with_surface(doublet, "crown", shape=fourth),
        again(with_surface(doublet, "crown", shape=fourth), tmp_path / "b.seq", lenient=True),
    )


def test_archives_are_not_written(tmp_path):
    with pytest.raises(
        PrescriptionError, match=r"a\.zar: the layout of Zemax archives is not published: save as \.zmx"
    ):
        pachon.save_telescope(lens("doublet"), tmp_path / "a.zar")
    with pytest.raises(
        ConfigError, match="format = 'zar': expected one of pachon, batoid, zemax, codev, oslo, optiland"
    ):
        pachon.save_telescope(lens("doublet"), tmp_path / "a.seq", format="zar")
    # Files of CODE V in YAML were written, and no longer read.
    with pytest.raises(ConfigError, match=r"a\.yaml: format = codev: expected pachon, that of names that end in .yaml"):
        pachon.save_telescope(lens("doublet"), tmp_path / "a.yaml", format="codev")


def test_the_table_of_the_docs_names_the_endings_that_are_written():
    page = (ROOT / "docs" / "howto" / "files.md").read_text()
    table = re.findall(r"^\| `(\.\w+)` \|[^|]*\| yes \|([^|]*)\|", page, re.M)
    written = {ending for ending, words in table if words.strip().startswith("yes")}
    assert written == set(ENDINGS)
    assert {ending for ending, _ in table} == {*ENDINGS, ".zar"}


@pytest.mark.parametrize("ending", ENDINGS)
def test_an_image_at_infinity_is_kept_or_refused_by_name(tmp_path, ending):
    afocal = lens("triplet").with_design(afocal=True)
    path = tmp_path / f"afocal{ending}"
    if ending in (".yaml", ".zmx", ".seq"):
        assert again(afocal, path).design_data.afocal
        return
    with pytest.raises(PrescriptionError, match=r"afocal: .* has no place"):
        pachon.save_telescope(afocal, path)
    assert "afocal" in warnings_of(afocal, path)
    assert not pachon.load_telescope(path).design_data.afocal
