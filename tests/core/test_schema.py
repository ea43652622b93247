"""Files are validated by sections: the first problem is one line with file, path of keys, value and expected value."""

from typing import Annotated, Any, Literal

import pytest

from pachon.core.errors import ConfigError, PrescriptionError
from pachon.core.schema import Parameters, Real, Section, Tagged, checked, either, known_keys, validated

DISC = Parameters.of(lambda r: ("disc", r), r=Real)
BOX = Parameters.of(lambda w, h: ("box", w, h), w=Real, h=(Real, 1.0))


class Part(Section):
    name: str
    kind: Literal["thin", "thick"] = "thin"
    size: Real = 1.0


class Exclusive(Section):
    file: str = ""
    values: Annotated[tuple[float, ...], checked(lambda v: v if v else None, "a list that is not empty")] = ()

    @classmethod
    def check(cls, content):
        either(content, "file", ("values",))


class Whole(Section):
    parts: tuple[Part, ...] = ()
    shapes: tuple[Annotated[Any, Tagged({"r": DISC, "w": BOX}, lambda c: "r" if "r" in c else "w")], ...] = ()
    one: Exclusive = Exclusive(file="a")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"part": 3}, "unknown key part = 3: did you mean parts?"),
        ({"parts": [{"name": "a", "size": "big"}]}, 'parts[a].size = "big": expected a number'),
        ({"parts": [{"size": 1}]}, "parts[0].name is missing"),
        ({"parts": [{"name": "a", "kind": "thinn"}]}, "expected one of thin, thick (did you mean thin?)"),
        ({"parts": [{"name": "a", "size": "b", "sizes": 1}]}, "unknown key parts[a].sizes = 1: did you mean size?"),
        ({"shapes": [{"w": 1, "r2": 2}]}, "unknown key shapes[0].r2 = 2: expected one of w, h"),
        ({"shapes": [3]}, "shapes[0] = 3: expected a mapping of keys to values"),
        ({"one": {"file": "a", "values": [1]}}, "one.values = [1]: expected file or values, not both"),
        ({"one": {}}, "one.values is missing"),
        ({"one": {"values": []}}, "one.values = []: expected a list that is not empty"),
    ],
)
def test_the_first_problem_is_one_line(content, message):
    with pytest.raises(ConfigError) as caught:
        validated(Whole, content, "file.yaml")
    assert message in str(caught.value)
    assert str(caught.value).startswith("file.yaml: ")
    assert caught.value.file == "file.yaml"
    assert caught.value.key in str(caught.value)


def test_sections_of_a_union_are_built():
    whole = validated(Whole, {"shapes": [{"r": "1e-9"}, {"w": 2}]}, "file.yaml")
    assert whole.shapes == (("disc", 1e-9), ("box", 2.0, 1.0))


def test_an_error_of_a_constructor_has_the_path_of_its_section():
    def fail(r):
        raise PrescriptionError("r = 0: expected more")

    class File(Section):
        shape: Annotated[Any, Tagged({"r": Parameters.of(fail, r=Real)}, lambda content: "r")]

    with pytest.raises(PrescriptionError, match=r"^a\.yaml: shape\.r = 0: expected more$"):
        validated(File, {"shape": {"r": 0}}, "a.yaml", PrescriptionError)


def test_known_keys_have_dots_between_sections():
    assert known_keys(Whole) == ("parts", "shapes", "one.file", "one.values")
