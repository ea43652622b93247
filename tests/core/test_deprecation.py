"""Old names of arguments go on working with a warning that names the new ones."""

import inspect

import pytest

from pachon.core.arguments import check_arguments
from pachon.core.deprecation import renamed_arguments
from pachon.core.errors import ConfigError, DomainError


@renamed_arguments(colour="color")
@check_arguments
def paint(size: float, *, color: float = 0.0) -> float:
    """Return a number."""
    return size + color


def test_the_new_name_is_silent():
    assert paint(1.0, color=2.0) == 3.0
    assert [*inspect.signature(paint).parameters] == ["size", "color"]


def test_the_old_name_works_with_a_warning_on_the_line_of_the_caller():
    with pytest.warns(DeprecationWarning, match=r"^paint\(colour=\.\.\.\) is deprecated; use color=\.\.\.$") as caught:
        assert paint(1.0, colour=2.0) == 3.0
    assert caught[0].filename == __file__


def test_the_old_name_is_checked_as_the_new_one():
    with (
        pytest.warns(DeprecationWarning, match="colour"),
        pytest.raises(DomainError, match="color = 'red': expected a number"),
    ):
        paint(1.0, colour="red")


def test_both_names_are_refused():
    with pytest.raises(ConfigError, match="colour and color are one argument: expected color alone"):
        paint(1.0, colour=2.0, color=3.0)
