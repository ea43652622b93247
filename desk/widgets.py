"""Widgets and texts that all pages of the desk have."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from html import escape
from typing import Any

from bokeh.models import CustomJS, Div, Toggle
from bokeh.models.widgets import Widget

from ..core.errors import PachonError
from .pictures import ORANGE

#: Colours of widgets, whose shadow trees the page's own rules do not reach.
_STYLE = """
:host { color: var(--text); }
.bk-input, .bk-btn, .noUi-handle { background-color: var(--card) !important; color: var(--text) !important; }
.bk-input, .bk-btn { border: 1px solid var(--line) !important; }
.bk-input { padding: 2px 6px; height: 28px; min-height: 28px; }
.bk-btn { padding: 4px 8px; }
.bk-btn:hover, .bk-btn.bk-active { border-color: var(--accent) !important; }
select.bk-input { appearance: auto; background-image: none; }
input[type="file"] { height: auto !important; }
.bk-spin-btn { filter: var(--invert); }
.noUi-target { background: var(--line); }
:host(:focus-within) .noUi-handle:focus, .bk-btn:focus-visible, .bk-input:focus { outline: 2px solid var(--accent); }
"""
_THEME = """
document.documentElement.classList.toggle('dark', toggle.active);
toggle.label = toggle.active ? 'Light' : 'Dark';
"""
#: Sets the first theme: that of the address, or of the system.
FIRST_THEME = """
const stated = new URLSearchParams(location.search).get('theme');
toggle.active = stated ? stated == 'dark' : matchMedia('(prefers-color-scheme: dark)').matches;
"""


def theme_toggle(paint: Callable[[str], None]) -> Toggle:
    """Return the button of dark and light pages, which paints the pictures too."""
    toggle = Toggle(label="Dark", width=70)
    toggle.on_change("active", lambda attribute, old, new: paint("dark" if new else "light"))
    toggle.js_on_change("active", CustomJS(args={"toggle": toggle}, code=_THEME))
    return toggle


def status_line() -> tuple[Div, Div]:
    """Return the line of messages, and the place of the numbers."""
    status = Div(text="", visible=False, name="status", sizing_mode="stretch_width")
    return status, Div(text="", name="numbers", sizing_mode="stretch_width")


def status_text(status: Div, message: PachonError | str, *, error: bool = True) -> None:
    """Show one line, or none."""
    text = escape(" ".join(str(message).split()))
    color = "#c2410c" if error else "#16a37a"
    status.visible = bool(text)
    status.text = text and f'<span role="status" style="color:{color};font-weight:600">{text}</span>'


def number_boxes(now: Mapping[str, tuple[float, str]], pinned: Mapping[str, tuple[float, str]]) -> str:
    """Return numbers with their names and units, and those of the pinned state below them."""
    boxes = []
    for name, (value, unit) in now.items():
        below = f'<div style="color:{ORANGE}">A {pinned[name][0]:.4g} {unit}</div>' if name in pinned else ""
        number = f'<b style="font-size:17px">{value:.4g}</b> {escape(unit)}'
        boxes.append(f'<div><div style="opacity:.75">{escape(name)}</div>{number}{below}</div>')
    return f'<div style="display:flex;flex-wrap:wrap;gap:6px 22px">{"".join(boxes)}</div>'


def colour(part: Any) -> None:
    """Colour the widgets of a part of the page."""
    for widget in part.select({"type": Widget}):
        widget.stylesheets = [_STYLE]
