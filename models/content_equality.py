"""Immutable objects with arrays, equal if their contents are."""

from __future__ import annotations

from collections.abc import Hashable

import numpy as np
from numpy.typing import DTypeLike


class ContentEquality:
    """Base of frozen dataclasses with arrays: read-only arrays, equality and hash of their bytes."""

    @property
    def _content(self) -> tuple[Hashable, ...]:
        raise NotImplementedError

    def _freeze(self, **dtypes: DTypeLike) -> None:
        """Replace fields by read-only arrays of given types."""
        for name, dtype in dtypes.items():
            array = np.array(getattr(self, name), dtype=dtype)
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, type(self)) and self._content == other._content

    def __hash__(self) -> int:
        return hash(self._content)
