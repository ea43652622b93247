"""Figure that notebooks show by themselves."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from matplotlib.figure import Figure

#: Dots per inch of pictures in notebooks: as wide as the cell for most figures.
_DPI = 100


class ShownFigure(Figure):
    """Figure that belongs to no window, and that notebooks show without a backend such as ``%matplotlib inline``.

    Parameters
    ----------
    to_png : callable
        Function of figure, format and dots per inch that returns the bytes of the picture.
    """

    def __init__(self, *args: Any, to_png: Callable[[Figure, str, int], bytes], **options: Any) -> None:
        super().__init__(*args, **options)
        self._to_png = to_png

    def _repr_png_(self) -> bytes:
        """Return the picture, as the display protocol of notebooks asks for it."""
        return self._to_png(self, "png", _DPI)
