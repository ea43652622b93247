"""Rows of several groups, one after the other, and those of each again."""

from __future__ import annotations

from collections.abc import Sequence, Sized
from dataclasses import fields
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

_Columns = TypeVar("_Columns", bound="DataclassInstance")


def slices_of(groups: Sequence[Sized]) -> list[slice]:
    """Return the slice of each group in their concatenation."""
    slices, first = [], 0
    for group in groups:
        slices.append(slice(first, first + len(group)))
        first += len(group)
    return slices


def rows_of(columns: _Columns, rows: slice) -> _Columns:
    """Return some rows of an object, all of whose fields are columns."""
    return type(columns)(**{field.name: getattr(columns, field.name)[rows] for field in fields(columns)})
