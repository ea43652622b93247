"""Messages of a lens file are in the words of its own format: files with something wrong in them, at random."""

import json
import random
import re
import warnings
from pathlib import Path

import pytest
from test_codev_reader import MIRRORS, TRIPLET
from test_oslo_reader import GUIDE

import pachon
from pachon.models.io.codev import reader as codev
from pachon.models.io.oslo import reader as oslo
from pachon.models.io.zemax.file import IGNORED_HEADER, IGNORED_SURFACE

DATA = Path(__file__).parents[2] / "data"
#: Files that are broken, by their endings.
FILES = {
    ".zmx": [(DATA / "lenses" / f"{name}.zmx").read_text() for name in ("triplet", "fold")],
    ".seq": [TRIPLET, MIRRORS.format(mode="BEN")],
    ".len": [GUIDE],
    ".json": [(DATA / "lensfiles" / f"{name}.json").read_text() for name in ("cooke_triplet", "freeforms")],
    ".roa": [(DATA / "lensfiles" / f"{name}.roa").read_text() for name in ("sasian_triplet", "tilts")],
}
_ZEMAX = """
SURF COORDBRK EVENASPH ODDASPHE BICONICX TOROIDAL SZERNSAG XPOLYNOM XASPHERE PARM XDAT WAVM PWAV FTYP XFLN YFLN ENVD
DISZ CONI GLAS COMM CLAP FLAP OBSC SQAP ELAP OBDC ENPD FNUM OBNA FLOA VDXN VDYN VCXN VCYN VANN
"""
_CODEV = "RDY CUY GLA STO SLB CIR PIM SI SO"
_OSLO = "LEN NEW NXT RD CV AP AIR RFL GLA AST ASP"
_OPTILAND = "coeffs_poly_y imageFNO objectNA float_by_stop_size is_stop material_post norm_radius radius_x"
_RAYOPTICS = "ifcs stop_surface interact_mode profile_id reference_wvl clear_apertures rndx wvls gname"
#: Keywords by the ending of the files that have them.
KEYWORDS = {
    ".zmx": {*IGNORED_HEADER, *IGNORED_SURFACE, *_ZEMAX.split()},
    ".seq": {*codev.SYSTEM, *codev.NUMBERS, *codev.IGNORED, *_CODEV.split()},
    ".len": {*oslo.APERTURES, *oslo.FIELDS, *oslo.NUMBERS, *oslo.IGNORED, *_OSLO.split()},
    ".json": set(_OPTILAND.split()),
    ".roa": set(_RAYOPTICS.split()),
}
#: Numbers and words that take the places of others.
JUNK = ("gizmo", "0", "-7", "1e300", "1e-300", "3.5", "NaN")


def broken_text(text, rng):
    """Return a text with lines or words dropped, doubled, swapped or replaced."""
    lines = text.splitlines()
    for _ in range(rng.choice((1, 1, 2))):
        i, j = rng.randrange(len(lines)), rng.randrange(len(lines))
        how = rng.choice(("drop", "double", "swap", "word", "word", "word"))
        if how == "drop":
            lines[i] = ""
        elif how == "double":
            lines.insert(j, lines[i])
        elif how == "swap":
            lines[i], lines[j] = lines[j], lines[i]
        elif words := lines[i].split():
            words[rng.randrange(len(words))] = rng.choice(JUNK)
            lines[i] = " ".join(words)
    return "\n".join(lines) + "\n"


def broken_json(text, rng):
    """Return a text of JSON with a value dropped or replaced."""
    content = json.loads(text)
    places, nodes = [], [content]
    while nodes:
        node = nodes.pop()
        items = node.items() if isinstance(node, dict) else enumerate(node)
        for key, value in items:
            places.append((node, key))
            nodes += [value] if isinstance(value, (dict, list)) else []
    node, key = rng.choice(places)
    node[key] = rng.choice((0, -3.5, 1e300, float("inf"), "gizmo", [1.0, 2.0], None))
    return json.dumps(content)


@pytest.mark.long
@pytest.mark.parametrize("ending", FILES)
def test_no_message_has_a_keyword_of_another_format(tmp_path, ending):
    others = set().union(*(words for key, words in KEYWORDS.items() if key != ending)) - KEYWORDS[ending]
    # A word that stands in the file itself may be repeated.
    foreign = {word for word in others if len(word) > 2}
    rng, messages = random.Random(ending), []
    for number in range(60):
        text = FILES[ending][number % len(FILES[ending])]
        text = broken_json(text, rng) if ending in (".json", ".roa") else broken_text(text, rng)
        path = tmp_path / f"lens{ending}"
        path.write_text(text)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                pachon.load_telescope(path)
            except pachon.PachonError as error:
                messages.append((str(error), text))
        messages += [
            (str(w.message), text) for w in caught if issubclass(w.category, pachon.errors.PrescriptionWarning)
        ]
    assert len(messages) > 15
    for message, text in messages:
        assert message.startswith(str(path))
        words = set(re.findall(r"[A-Za-z_0-9]+", message.removeprefix(str(path))))
        assert not (words & foreign) - set(re.findall(r"[A-Za-z_0-9]+", text)), message
