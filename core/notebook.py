"""HTML of objects for notebooks: a line, a table, a picture."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Callable
from html import escape
from importlib import import_module
from typing import TYPE_CHECKING

from .errors import PachonError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Functions, "module:name" within the package, that draw objects of a class which does not draw itself.
PICTURES: dict[str, str] = {}
#: Dots per inch of pictures in notebooks.
_DPI = 72


class Pictured:
    """Base of an object that notebooks show with a picture of :data:`PICTURES`, drawn by a layer above it."""

    def _repr_html_(self) -> str:
        """Return the representation and the picture, as notebooks show them."""
        kind = type(self).__name__
        module, _, name = PICTURES[kind].partition(":")
        draw = getattr(import_module(f"{__package__.rpartition('.')[0]}.{module}"), name)
        return f"<p>{escape(repr(self))}</p>\n{html_picture(lambda: draw(self), kind)}"


def html_picture(draw: Callable[[], Figure], name: str) -> str:
    """Return a figure as an HTML image, or the line that says why there is none."""
    from .plotting import picture_bytes

    try:
        data = b64encode(picture_bytes(draw(), "png", _DPI)).decode()
    except PachonError as error:
        return f"<p>No picture: {escape(str(error))}</p>"
    return f'<img style="max-width:100%" src="data:image/png;base64,{data}" alt="{escape(name)}">'
