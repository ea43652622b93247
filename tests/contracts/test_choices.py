"""Words of which one is expected: docstring, annotation and table name the same, and wrong ones are refused."""

import inspect
import re
import sys
import typing
from types import SimpleNamespace, UnionType

import pytest
from public_names import public_names

import pachon
from pachon.core.errors import ConfigError
from pachon.models.camera import height_budget, photometry
from pachon.models.camera.corner_rafts import CornerHeights
from pachon.models.io.heights.zernike_table import AS_MEASURED
from pachon.models.io.prescription import WRITTEN, LensFormat
from pachon.models.starting_designs import new
from pachon.pipeline.sensor import brighter_fatter
from pachon.reconstruction.psf_model import recipe
from pachon.studies import validation
from pachon.wavefront.psf import engines

#: Choices that depend on files: their list is open.
OPEN = {("of_maker", "maker")}


def literals(annotation):
    """Words of an annotation, those of a union too."""
    if typing.get_origin(annotation) is typing.Literal:
        return {word for word in typing.get_args(annotation) if isinstance(word, str)}
    if typing.get_origin(annotation) in (typing.Union, UnionType):
        return set().union(*map(literals, typing.get_args(annotation)))
    return set()


def documented_choices():
    """Function or class, argument and words of each ``name : {"a", "b"}`` in docstrings of public names."""
    for value in public_names().values():
        owners = [value]
        if inspect.isclass(value):
            members = [getattr(m, "__func__", m) for key, m in vars(value).items() if not key.startswith("_")]
            owners += [m for m in members if inspect.isfunction(m)]
        for owner in owners:
            for names, kind in re.findall(r"^\s*([\w, ]+) : (.*\{\".*)$", owner.__doc__ or "", flags=re.M):
                words = set(re.findall(r'"([^"]*)"', kind[kind.index("{") : kind.index("}")]))
                yield from ((owner, name, words) for name in names.split(", ") if (owner.__name__, name) not in OPEN)


CHOICES = {(f"{owner.__qualname__}", name): (owner, name, words) for owner, name, words in documented_choices()}


@pytest.mark.parametrize("key", CHOICES, ids=".".join)
def test_annotations_have_the_words_of_the_docstrings(key):
    owner, name, words = CHOICES[key]
    holders = owner.__mro__ if inspect.isclass(owner) else [inspect.unwrap(owner)]
    holder = next(h for h in holders if name in h.__dict__.get("__annotations__", h.__annotations__))
    alone = SimpleNamespace(__annotations__={name: holder.__annotations__[name]})
    annotations = typing.get_type_hints(alone, vars(sys.modules[holder.__module__]))
    # "sky" is a frame of hexapods too; DVCS, which has no z, is refused by the function itself.
    allowed = {"DVCS"} if owner.__name__ == "hexapod_corrections" else set()
    assert literals(annotations[name]) - allowed == words


def test_there_are_many_choices():
    assert len(CHOICES) > 50


@pytest.mark.parametrize(
    ("alias", "table"),
    [
        (engines.EngineName, engines.ENGINES),
        (recipe.BasisName, recipe.BASES),
        (recipe.InterpolationName, recipe.INTERPOLATIONS),
        (recipe.RecipeName, recipe.RECIPES),
        (new.DesignKind, new.KINDS),
        (validation.SchemaKind, [kind.name for kind in validation.KINDS]),
        (height_budget.BudgetName, height_budget.BUDGETS),
        (photometry.BandName, photometry.BANDS),
        (brighter_fatter.SensorVendor, brighter_fatter.COEFFICIENTS),
        (CornerHeights, ("nominal", *AS_MEASURED)),
        (LensFormat, ("", "pachon", "batoid", *WRITTEN.values())),
    ],
)
def test_aliases_have_the_names_of_their_tables(alias, table):
    assert set(typing.get_args(alias)) == set(table)


@pytest.mark.parametrize("table", [engines.ENGINES, recipe.BASES, recipe.INTERPOLATIONS])
def test_kinds_stand_in_tables_under_their_names(table):
    assert {name: kind.name for name, kind in table.items()} == {name: name for name in table}


def test_a_wrong_word_is_one_line_with_the_nearest():
    expected = (
        r"^sampling = 'ring': expected one of gauss, rings, spiral, square or a PupilSampling; did you mean rings\?$"
    )
    with pytest.raises(ConfigError, match=expected) as caught:
        pachon.spots(pachon.paul_baker(), sampling="ring")
    assert caught.value.key == "sampling"
