"""Content of written Zemax files, and telescopes that are refused; rays are compared in test_zemax_rays."""

from dataclasses import replace

import numpy as np
import pytest

from pachon.core.errors import PrescriptionError, PrescriptionWarning
from pachon.models.aperture import Circle, Intersection, Polygon
from pachon.models.io.glass_catalogue import GlassCatalogue
from pachon.models.io.prescription import load_telescope, save_telescope
from pachon.models.media.medium import ConstantIndex, Sellmeier
from pachon.models.media.tabulated import TabulatedIndex
from pachon.models.shapes.freeform import Biconic
from pachon.models.shapes.polynomial import XYPolynomial, ZernikeSag
from pachon.models.shapes.shape import Conic, EvenAsphere
from pachon.models.shapes.sum import Sum
from pachon.models.surface import Interaction


@pytest.fixture
def lsst():
    return load_telescope("lsst_v3.3_r")


def with_surface(telescope, name, **changes):
    surfaces = tuple(replace(s, **changes) if s.name == name else s for s in telescope.surfaces)
    return replace(telescope, surfaces=surfaces)


def with_glass(telescope, glass):
    old = telescope.surface("L1_entrance").medium_after
    surfaces = tuple(
        replace(s, medium_after=glass if s.medium_after == old else s.medium_after) for s in telescope.surfaces
    )
    return replace(telescope, surfaces=surfaces)


def test_a_telescope_is_read_back_as_it_was(tmp_path, lsst):
    save_telescope(lsst, tmp_path / "lsst.zmx")
    again = load_telescope(tmp_path / "lsst.zmx")
    assert again.surface_names == lsst.surface_names
    assert again.default_wavelength == lsst.default_wavelength
    assert again.field_radius == pytest.approx(lsst.field_radius, rel=1e-14)
    for one, other in zip(lsst.surfaces, again.surfaces, strict=True):
        assert other.interaction == one.interaction
        # Thicknesses are differences of heights, figures in mm: rounding.
        assert other.vertex == pytest.approx(one.vertex, abs=2e-15)
        assert type(other.shape) is type(one.shape)
        for name, value in one.shape.parameters.items():
            assert other.shape.parameters[name] == pytest.approx(value, rel=1e-14), (one.name, name)
        assert (other.aperture is None) == (one.aperture is None)
        assert float(other.medium_after.index(6e-7)) == float(one.medium_after.index(6e-7))


def test_glasses_go_to_a_catalogue_beside_the_file_unless_the_bundled_one_has_them(tmp_path, lsst):
    save_telescope(lsst, tmp_path / "own.zmx")
    own = GlassCatalogue.read(tmp_path / "own.agf")
    assert [own.entry(name).medium for name in own] == [lsst.surface("L1_entrance").medium_after]
    known = with_glass(lsst, GlassCatalogue.bundled()["N-BK7"])
    save_telescope(known, tmp_path / "known.zmx")
    assert not (tmp_path / "known.agf").exists()
    assert "GLAS N-BK7 " in (tmp_path / "known.zmx").read_text(encoding="utf-8")
    save_telescope(with_glass(lsst, ConstantIndex(1.46, "melt 7")), tmp_path / "constant.zmx")
    constant = load_telescope(tmp_path / "constant.zmx").surface("L1_entrance").medium_after
    assert constant.name == "MELT_7"
    # The square root of the square.
    assert float(constant.index(6e-7)) == pytest.approx(1.46, rel=2e-16)


def test_writing_twice_gives_the_same_bytes(tmp_path, lsst):
    for name in ("a", "b"):
        save_telescope(lsst, tmp_path / f"{name}.zmx")
    assert (tmp_path / "a.zmx").read_bytes() == (tmp_path / "b.zmx").read_bytes()
    assert (tmp_path / "a.agf").read_bytes() == (tmp_path / "b.agf").read_bytes()


def test_the_plane_of_the_pupil_is_not_read_back_as_a_surface(tmp_path, lsst):
    save_telescope(lsst, tmp_path / "a.zmx")
    text = (tmp_path / "a.zmx").read_text(encoding="utf-8")
    assert text.count("STOP") == 1
    assert "COMM pachon entrance pupil" in text
    again = load_telescope(tmp_path / "a.zmx")
    assert again.stop_z == pytest.approx(lsst.stop_z, abs=1e-15)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"shape": EvenAsphere(19.8, -1.2, (0.0,) * 7 + (1e-20,))}, "surface M1: 8 coefficients"),
        ({"shape": Sum((Biconic(19.8, 19.9), ZernikeSag((1e-6,), 4.2)))}, "surface M1: sum with Biconic"),
        ({"shape": Sum((EvenAsphere(19.8, -1.2, (1e-9,)), XYPolynomial(((1, 0, 1e-6),))))}, "surface M1: asphere with"),
        (
            {"shape": Sum((Conic(19.8, -1.2), ZernikeSag((1e-6,), 4.2), XYPolynomial(((1, 0, 1e-6),))))},
            "M1: sum of several",
        ),
        ({"aperture": Polygon(((0.0, 0.0), (1.0, 0.0), (0.0, 1.0)))}, "surface M1: aperture Polygon"),
        ({"aperture": Intersection((Circle(4.0), Circle(3.0, 1.0)))}, "surface M1: aperture Intersection"),
    ],
)
def test_what_a_zemax_file_cannot_hold_is_one_line(tmp_path, lsst, changes, expected):
    with pytest.raises(PrescriptionError, match=expected):
        save_telescope(with_surface(lsst, "M1", **changes), tmp_path / "a.zmx")
    assert list(tmp_path.iterdir()) == []


SMOOTH = Sellmeier((0.1, 0.2, 0.3, 0.4, 0.05, 0.01), (0.001, 0.003, 0.005, 0.008, 0.01, 90.0))
ROUGH = TabulatedIndex((3e-7, 5e-7, 5.5e-7, 6e-7, 1.2e-6), (1.47, 1.465, 1.464, 1.459, 1.45))


def test_a_glass_without_a_formula_of_zemax_is_fitted(tmp_path, lsst):
    """Six terms of Sellmeier's formula, of which Zemax has five at most: as smooth as any glass."""
    with pytest.warns(PrescriptionWarning, match="a formula is fitted, within [0-9]e-1[0-9] of its index"):
        save_telescope(with_glass(lsst, SMOOTH), tmp_path / "a.zmx")
    again = load_telescope(tmp_path / "a.zmx").surface("L1_entrance").medium_after
    w = np.linspace(*lsst.band, 50)
    assert np.abs(again.index(w) - SMOOTH.index(w)).max() < 1e-10


def test_a_glass_that_no_formula_is_near_is_refused(tmp_path, lsst):
    """A table with an edge: a smooth formula is far from it, and said to be so where lenient."""
    with pytest.raises(PrescriptionError, match="none of the dispersion formulas"):
        save_telescope(with_glass(lsst, ROUGH), tmp_path / "a.zmx")
    with pytest.warns(PrescriptionWarning, match="a formula is fitted, within 0.000[0-9]+ of its index"):
        save_telescope(with_glass(lsst, ROUGH), tmp_path / "a.zmx", lenient=True)
    again = load_telescope(tmp_path / "a.zmx").surface("L1_entrance").medium_after
    assert np.abs(again.index(lsst.band) - ROUGH.index(lsst.band)).max() < 1e-3


def test_a_telescope_without_a_detector_is_refused(tmp_path, lsst):
    last = replace(lsst.surfaces[-1], interaction=Interaction.PASS)
    with pytest.raises(PrescriptionError, match="needs a detector"):
        save_telescope(replace(lsst, surfaces=(*lsst.surfaces[:-1], last)), tmp_path / "a.zmx")


def test_a_place_that_cannot_be_written_is_one_line(lsst, tmp_path):
    with pytest.raises(PrescriptionError, match="cannot write"):
        save_telescope(lsst, tmp_path / "none" / "a.zmx")
