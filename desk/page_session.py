"""What the sessions of all pages have in common: title, messages, numbers, sidebar, pictures and their colours."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

from bokeh.document import Document
from bokeh.events import DocumentReady
from bokeh.layouts import column
from bokeh.models import Column, CustomJS

from .pictures import Picture
from .widgets import FIRST_THEME, colour, status_line, theme_toggle

#: Shows or hides the frame of a picture with it.
_CARD = "document.querySelector(`[data-picture='${name}']`).hidden = !figure.visible;"


class PageSession(ABC):
    """A page in a browser: its widgets, and pictures in the order of the page."""

    sidebar: Column
    pictures: tuple[Picture, ...]

    def __init__(self, title: str, subtitle: str, document: Document | None = None) -> None:
        self.title, self.subtitle, self.document = title, subtitle, document
        self.theme = "light"
        self.status, self.table = status_line()
        self.theme_toggle = theme_toggle(self.paint)

    @property
    @abstractmethod
    def state_words(self) -> str:
        """What the page shows, in words."""

    def _make_sidebar(self, *widgets: Any) -> None:
        for widget in widgets:
            widget.sizing_mode = "stretch_width"
        self.sidebar = column(*widgets, self.theme_toggle, name="sidebar", sizing_mode="stretch_width")

    def paint(self, theme: str) -> None:
        """Colour the pictures by a theme."""
        self.theme = theme
        for picture in self.pictures:
            picture.paint(theme)

    def add_to(self, document: Document) -> None:
        """Add the roots to the document of a page."""
        colour(self.sidebar)
        for picture in self.pictures:
            card = CustomJS(args={"name": picture.figure.name, "figure": picture.figure}, code=_CARD)
            picture.figure.js_on_change("visible", card)
        for root in (self.sidebar, self.status, self.table, *(picture.figure for picture in self.pictures)):
            document.add_root(root)
        document.js_on_event(DocumentReady, CustomJS(args={"toggle": self.theme_toggle}, code=FIRST_THEME))
