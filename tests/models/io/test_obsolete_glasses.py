"""Schott's obsolete glasses against published figures and fits, and designs of patents and textbooks that use them."""

import numpy as np
import pytest

import pachon
from pachon.models.first_order import first_order
from pachon.models.io.glass_catalogue import OBSOLETE, GlassCatalogue
from pachon.models.io.glass_search import find_glass, makers_in

LINE_D, LINE_F, LINE_C = 0.5875618e-6, 0.4861327e-6, 0.6562725e-6
OLD = GlassCatalogue.of_maker(OBSOLETE)
#: n_d and V_d as Schott's catalogues print them, with five and two decimals.
PUBLISHED = {
    "SK5": (1.58913, 61.27), "SK1": (1.61025, 56.71), "KF9": (1.52341, 51.49), "PSK3": (1.55232, 63.46),
    "LAKN6": (1.64250, 57.96), "LAKN7": (1.65160, 58.52), "BALKN3": (1.51849, 60.25), "LASF14A": (1.82223, 37.45),
    "BASF1": (1.62606, 38.96),
}  # fmt: skip
#: Robb and Mercado (1983), Appl. Opt. 22, 1198, table V, of Schott's catalogue of 1980: index at 0.574 um, two
#: coefficients of Buchdahl's colour coordinate, and the largest error of the fit.
ROBB = {
    "SK1": (1.611029, -0.059425, 0.0011338, 3.2e-5), "KF9": (1.524146, -0.056040, 0.0038714, 2.0e-5),
    "PSK3": (1.552954, -0.048312, -0.0029585, 7e-6), "LAKN6": (1.643302, -0.061300, -0.00025817, 2.7e-5),
    "LAKN7": (1.652407, -0.061612, -0.00082255, 2.3e-5), "BALKN3": (1.519112, -0.047654, -0.0010567, 1.4e-5),
    "BASF1": (1.627210, -0.087845, 0.020655, 4.6e-5), "SK19": (1.614195, -0.059075, 0.00075367, 2.9e-5),
    "SSK4": (1.618460, -0.061819, 0.0020500, 3.3e-5), "BAF54": (1.667716, -0.076047, 0.0080052, 3.8e-5),
    "LF2": (1.590243, -0.078815, 0.015822, 3.8e-5),
}  # fmt: skip


def figures(medium):
    d, f, c = (float(v) for v in medium.index(np.array([LINE_D, LINE_F, LINE_C])))
    return d, (d - 1) / (f - c)


@pytest.mark.parametrize("name", PUBLISHED)
def test_index_and_abbe_number_are_the_published_ones(name):
    nd, vd = figures(OLD[name])
    assert nd == pytest.approx(PUBLISHED[name][0], abs=1e-5)
    assert vd == pytest.approx(PUBLISHED[name][1], abs=0.02)


def test_every_glass_has_the_index_and_abbe_number_of_its_line():
    assert len(OLD) > 220
    for name in OLD:
        entry = OLD.entry(name)
        nd, vd = figures(entry.medium)
        assert nd == pytest.approx(entry.nd, abs=1e-5), name
        assert vd == pytest.approx(entry.vd, abs=0.02), name


@pytest.mark.parametrize("name", ROBB)
def test_indices_in_the_visible_are_those_of_an_independent_fit(name):
    base, first, second, largest = ROBB[name]
    # Lines h to r; the largest error is that of the fit, and the catalogues have five decimals.
    micrometres = np.array([0.4046561, 0.4358343, 0.4861327, 0.546074, 0.5875618, 0.6562725, 0.7065188])
    shift = micrometres - 0.574
    colour = shift / (1 + 2.5 * shift)
    expected = base + first * colour + second * colour**2
    np.testing.assert_allclose(OLD[name].index(micrometres * 1e-6), expected, rtol=0, atol=largest + 5e-6)


def test_the_catalogues_that_a_file_states_come_first(tmp_path):
    """F4 of Schott is F3 of CDGM, nearly; without a maker the glass of textbooks is meant."""
    cdgm = GlassCatalogue.of_maker("cdgm")["F4"]
    assert find_glass("F4") == OLD["F4"] != cdgm
    assert find_glass("F4", makers=("cdgm",)) == cdgm
    text = DESIGNS["triplet"].zmx().replace("GLAS F2", "GLAS F4")
    for line, expected in (("", OLD["F4"]), ("GCAT CDGM SCHOTT\n", cdgm), ("GCAT SCHOTT_2008 CDGM\n", OLD["F4"])):
        path = tmp_path / "lens.zmx"
        path.write_text(line + text)
        lens = pachon.load_telescope(path)
        assert lens.surfaces[2].medium_after == expected
        # CODE V's names have their makers.
        pachon.save_telescope(lens.with_design(aiming="paraxial"), tmp_path / "lens.seq")
        assert pachon.load_telescope(tmp_path / "lens.seq").surfaces[2].medium_after == expected


def test_crystals_go_by_the_names_of_opticstudio():
    """Barium fluoride at 0.5893 um, magnesium fluoride and sapphire (ordinary rays) at d, silicon at 4 um..."""
    figures_of = {"BAF2": (0.5893, 1.4744, 1e-4), "MGF2": (0.58756, 1.3777, 1e-4), "SAPPHIRE": (0.58756, 1.7682, 1e-4),
                  "SILICON": (4.0, 3.4255, 1e-3), "GERMANIUM": (10.0, 4.0032, 1.5e-3), "LIF": (0.5893, 1.3921, 1e-4),
                  "ZNSE": (10.6, 2.4028, 5e-4), "WATER": (0.58926, 1.33335, 5e-5)}  # fmt: skip
    for name, (micrometres, index, near) in figures_of.items():
        medium = find_glass(name, makers=makers_in(["INFRARED"]))
        assert float(medium.index(micrometres * 1e-6)) == pytest.approx(index, abs=near), name
    # Without a catalogue the flint of CDGM has that name.
    assert float(find_glass("BAF2").index(LINE_D)) == pytest.approx(1.5697, abs=1e-4)


def test_common_glasses_stay_what_they_are_where_their_maker_is_stated():
    common = GlassCatalogue.bundled()
    assert find_glass("N-BK7", makers=("schott",)) == common["N-BK7"]
    assert find_glass("H_LAK52") == find_glass("H-LAK52") is not None


class Design:
    """Radii, thicknesses and glasses of a lens for an object at infinity [mm], the last thickness its back focus."""

    def __init__(self, rows, focal_length, back_focus, diameter, stop, near=(0.05, 0.006)):
        self.rows, self.focal_length, self.back_focus = rows, focal_length, back_focus
        self.diameter, self.stop = diameter, stop
        # Half a unit of the last digit of the source; where its detector is out of the paraxial focus, that distance.
        self.near_focal_length, self.near_back_focus = near

    def zmx(self):
        lines = ["MODE SEQ", "UNIT MM", f"ENPD {self.diameter}", "FTYP 0 0 1 3", "XFLN 0", "YFLN 0"]
        lines += ["WAVM 1 0.4861327 1", "WAVM 2 0.5875618 1", "WAVM 3 0.6562725 1", "PWAV 2", "SURF 0"]
        lines += ["  DISZ INFINITY"]
        for number, (radius, thickness, glass) in enumerate(self.rows, start=1):
            lines += [f"SURF {number}", f"  CURV {1 / radius if radius else 0.0!r}", f"  DISZ {thickness}"]
            lines += [f"  GLAS {glass} 0 0 1.5 40"] if glass else []
            lines += ["  STOP"] if number == self.stop else []
        return "\n".join([*lines, f"SURF {len(self.rows) + 1}", "  DISZ 0"]) + "\n"

    def seq(self):
        lines = ["RDM", "LEN", "DIM M", f"EPD {self.diameter}", "WL 656.2725 587.5618 486.1327", "REF 2", "YAN 0"]
        lines += ["SO 0 1e13"]
        for number, (radius, thickness, glass) in enumerate(self.rows, start=1):
            lines += [f"S {radius} {thickness} {f'{glass}_SCHOTT' if glass else ''}"]
            lines += ["  STO"] if number == self.stop else []
        return "\n".join([*lines, "SI 0 0", "GO"]) + "\n"

    def oslo(self):
        lines = ['LEN NEW "design" 1 1', f"EBR {self.diameter / 2}", "ANG 1", "AIR", "TH 1e20", "NXT"]
        for number, (radius, thickness, glass) in enumerate(self.rows, start=1):
            lines += [f"GLA {glass}" if glass else "AIR", f"RD {radius}", f"TH {thickness}"]
            lines += ["AST", "NXT"] if number == self.stop else ["NXT"]
        return "\n".join([*lines, "AIR", "WV 0.5875618 0.4861327 0.6562725", "END"]) + "\n"


#: Focal lengths and back foci as the sources state them; W. J. Smith, Modern Lens Design (1992) prints four digits.
DESIGNS = {
    # Smith p. 305, US 2,601,805 (Loewenthal).
    "loewenthal": Design(
        [(85.5, 11.6, "LAF2"), (408.33, 1.5, ""), (40.35, 17, "SK55"), (156.05, 3.5, "FN11"), (25.05, 13.7, ""),
         (0, 8.3, ""), (-36.8, 3.5, "SF8"), (55, 23, "LAF2"), (-51.5, 1, ""), (123.5, 17, "LAF2"),
         (-204.96, 55.066, "")], 100.4, 55.07, 74.0, 6,
    ),
    # Smith p. 304, US 2,771,006 (Werfeli).
    "werfeli": Design(
        [(93.32, 11.32, "LAF3"), (358.29, 0.4, ""), (46.32, 20, "BAF9"), (0, 2, "LF2"), (28.68, 14, ""), (0, 10, ""),
         (-41.32, 6, "SF14"), (60.8, 22, "LAF2"), (-55, 13, ""), (90.2, 16, "LAF3"), (-212.58, 56.424, "")],
        100.1, 56.42, 80.0, 6,
    ),
    # Smith p. 65, Gauss's telescope objective.
    "gauss": Design(
        [(17.654, 1.4, "BK7"), (53.898, 0.1, ""), (16.53, 0.6, "SF1"), (13.075, 94.931, "")], 100.0, 94.93, 14.2, 1,
    ),
    # The Cooke triplet that comes with Zemax; focal length 50 mm at f/5.
    "triplet": Design(
        [(22.01359, 3.258956, "SK16"), (-435.76044, 6.007551, ""), (-22.21328, 0.999975, "F2"),
         (20.29192, 4.750409, ""), (79.68360, 2.952076, "SK16"), (-18.39533, 42.207778, "")],
        50.0, 42.21, 10.0, 4, (0.05, 0.25),
    ),
    # A Petzval lens with a field flattener, of OSLO's and Zemax's sample files.
    "petzval": Design(
        [(91.6686, 21.676, "BALKN3"), (-60.188078, 3.484, "F4"), (3972.6186, 76.5094, ""), (35.20674, 17.3606, "BK7"),
         (-58.825151, 3.484, "F2"), (-166.140883, 19.39953, ""), (-27.78333, 1.96965, "F2"), (1111723.05, 15.1963, "")],
        100.0, 15.2, 56.0, 1, (0.05, 0.05),
    ),
}  # fmt: skip


def opened(tmp_path, design):
    for ending, text in ((".zmx", design.zmx()), (".seq", design.seq()), (".len", design.oslo())):
        (tmp_path / f"lens{ending}").write_text(text)
        yield pachon.load_telescope(tmp_path / f"lens{ending}")


@pytest.mark.parametrize("name", DESIGNS)
def test_designs_of_patents_and_textbooks_open_strictly(tmp_path, name):
    design = DESIGNS[name]
    for lens in opened(tmp_path, design):
        properties = first_order(lens)
        assert properties.focal_length * 1e3 == pytest.approx(design.focal_length, abs=design.near_focal_length)
        assert properties.back_focus * 1e3 == pytest.approx(design.back_focus, abs=design.near_back_focus)


@pytest.mark.parametrize("name", PUBLISHED)
def test_a_lens_of_each_glass_has_the_focal_length_of_its_index(tmp_path, name):
    """The lensmaker's equation of a thick lens, with the published index."""
    radius, thickness, nd = 80.0, 6.0, PUBLISHED[name][0]
    power = (nd - 1) * (2 / radius - (nd - 1) * thickness / (nd * radius**2))
    for lens in opened(tmp_path, Design([(radius, thickness, name), (-radius, 70, "")], 0, 0, 10, 1)):
        assert first_order(lens).focal_length * 1e3 == pytest.approx(1 / power, rel=3e-5)


def test_glasses_of_further_makers():
    """Lines of LZOS's catalogue at F, C, s and 1.529 um; Corning France's code C20-60 is index and Abbe number."""
    bf1 = find_glass("LZ_BF1")
    for micrometres, index in ((0.48613, 1.531447), (0.65627, 1.521897), (0.8521, 1.51681), (1.5296, 1.50793)):
        assert float(bf1.index(micrometres * 1e-6)) == pytest.approx(index, abs=5e-5)
    nd, vd = figures(find_glass("C20-60", makers=makers_in(["OLD_CORN"])))
    assert (round(nd, 2), round(vd)) == (1.62, 60)
