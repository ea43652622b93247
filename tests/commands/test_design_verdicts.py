"""First sentences of design commands: each number against a closed form."""

import math
import re

import pytest

from pachon.commands.cli import main
from pachon.commands.tables import Column

HEADER = """
name: {name}
source: "a closed form"
version: "1"
units: {{length: m, angle: deg, wavelength: um}}
stop: {{z: 0.0}}
pupil: {{diameter: 0.5, obscuration: 0}}
launch_distance: 6.0
reference_sphere_radius: 4.0
field: {{radius: 0.1, limit: 1.0}}
wavelengths: {{range: [0.3, 1.2], default: 0.5, band: [0.45, 0.65]}}
"""
#: Focal length 4 m, f/8.
MIRROR = """surfaces:
  - {{name: M1, type: mirror, shape: conic, z: 0.0, radius: 8.0, conic: {conic}, circle: {radius}}}
  - {{name: Detector, type: detector, shape: plane, z: 4.0, circle: 0.1}}
"""
#: Malitson's fused silica (J. Opt. Soc. Am. 55, 1205, 1965), constants of wavelengths in um.
SELLMEIER = [(0.6961663, 0.0684043), (0.4079426, 0.1162414), (0.8974794, 9.896161)]
LENS = """media:
  silica: {{B: {b}, C: {c}, range: [0.21, 3.71]}}
surfaces:
  - {{name: front, type: refract, shape: plane, z: 1.0, medium: silica, circle: 0.3}}
  - {{name: back, type: refract, shape: sphere, z: 0.98, radius: 2.0, medium: vacuum, circle: 0.3}}
  - {{name: Detector, type: detector, shape: plane, z: -3.4, circle: 0.1}}
"""


@pytest.fixture
def verdict(in_folder, capsys):
    """Function that runs a command on a mirror or lens and returns its verdict, and the numbers in it."""

    def run(command, *options, conic=-1.0, radius=0.3, lens=False):
        b, c = [list(pair) for pair in zip(*((b, c**2) for b, c in SELLMEIER), strict=True)]
        surfaces = LENS.format(b=b, c=c) if lens else MIRROR.format(conic=conic, radius=radius)
        (in_folder / "model.yaml").write_text(HEADER.format(name="model") + surfaces)
        assert main([command, "model.yaml", *options, "--no-picture"]) == 0
        sentence = capsys.readouterr().out.splitlines()[0]
        return sentence, [float(text) for text in re.findall(r"(?<![\w.])-?\d+(?:\.\d+)?", sentence)]

    return run


def test_a_footprint_says_which_surface_blocks_most(verdict):
    sentence, (percent, _, _) = verdict("footprint", "--field-deg", "0", radius=0.2)
    assert sentence == f"M1 blocks most: {percent:.2f} % of the pupil at field 0, 0°."
    # The annulus from 0.2 to 0.25 m, to half of the widest of 24 rings of rays: at most pi/2 of 1/24 of their mean.
    assert percent == pytest.approx(100 * (1 - 0.8**2), abs=100 * math.pi / 4 / 24)
    assert verdict("footprint", "--field-deg", "0")[0] == "None of the surfaces blocks light."


def test_fields_without_a_number_are_counted():
    """A Strehl ratio of the axis alone was said to be that of all fields."""
    column = Column("Strehl", lambda ratios: ratios, ".2f", subject="The ratio")
    assert column.verdict([[0.9], [0.8]], {}) == "The ratio is 0.80 to 0.90 over 2 fields."
    sentence = column.verdict([[0.9], [math.nan], [0.8]], {})
    assert sentence == "The ratio is 0.80 to 0.90 at 2 of 3 fields; others have none."
    assert column.verdict([[math.nan], [math.nan]], {}) == "The ratio is unknown over 2 fields."


def test_a_seidel_diagram_names_the_largest_sum(verdict):
    sentence, (total, mirror) = verdict("seidel", "--field-deg", "0.001", conic=0.0)
    assert "Largest beside distortion is spherical" in sentence
    assert "M1 alone" in sentence
    # The sphere is h^4/8R^3 higher than the paraboloid, and its light goes that way twice.
    assert abs(total) == pytest.approx(0.25**4 / (4 * 8.0**3) / 500e-9, abs=6e-5)
    assert mirror == total
    # A paraboloid, at a field so small that coma is none to four digits.
    assert verdict("seidel", "--field-deg", "1e-7")[0].startswith("Beside distortion, all sums vanish;")


def test_a_target_says_what_light_its_image_has(verdict):
    sentence, (light, pixel) = verdict("target", "--width-arcsec", "30", "--rays", "4")
    assert sentence == f"The image has {light:.3f} % of the target's light, on pixels of {pixel:.5g} µm."
    assert light == 100.0
    # A 96th of the target, which has a margin without light, at a focal length of 4 m.
    assert pixel == pytest.approx(4e6 * math.radians(30 / 3600) / 96, rel=1e-4)


def test_sensitivity_names_what_changes_the_wavefront_most(verdict, in_folder):
    sentence, (per_um, per_arcsec) = verdict(
        "sensitivity", "--parameters", "Detector.dz,Detector.dx,M1.rx,Detector.rx", "--field-deg", "0"
    )
    assert re.fullmatch(
        r"The wavefront changes most with Detector.dz, by \S+ nm.* µm, and M1.rx, by .* arcsec\.", sentence
    )
    # Defocus of 1 um at f/8: 1/8N^2 um at the rim, of which the rms is 1/sqrt(12); next order 1/16N^2 of it.
    assert per_um == pytest.approx(1e3 / (8 * 8**2) / math.sqrt(12), rel=1e-3)
    assert per_arcsec > 0


def test_a_drawing_says_the_size(verdict):
    assert verdict("draw", radius=0.25)[0] == "1 mirror and 0 lenses, 4 m long and 500 mm wide."
    assert verdict("draw", lens=True)[0].startswith("0 mirrors and 1 lens, ")


def test_focal_shift_says_how_far_the_focus_moves(verdict):
    wavelengths = ["--wavelength-nm", "450", "--wavelength-nm", "650"]
    sentence, (blue, red, shift, depth) = verdict("focal-shift", *wavelengths, lens=True)

    def focus(um):
        """Behind a plano-convex lens that is plane in front: radius/(n - 1) from the back."""
        n = math.sqrt(1 + sum(b * um**2 / (um**2 - c**2) for b, c in SELLMEIER))
        return 2.0 / (n - 1)

    assert (blue, red) == (450, 650)
    assert shift == pytest.approx(1e3 * (focus(0.65) - focus(0.45)), rel=1e-3)
    # 2 wavelengths, the default of 0.5 um, times the focal ratio squared, that of the middle wavelength.
    assert depth == pytest.approx(2 * 0.5 * (focus(0.55) / 0.5) ** 2, rel=1e-3)
    assert sentence.endswith(f"the paraxial focus moves by {shift:.4g} mm; the depth of focus is ±{depth:.4g} µm.")
