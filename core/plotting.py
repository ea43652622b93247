"""Basics of plotting: figures without global state, style, palette, bytes of a picture."""

from __future__ import annotations

import io
import logging
import math
from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np

from .errors import ConfigError, DomainError, shown

# Matplotlib takes a third of a second to import: only where something is drawn.
if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

#: The palette, in the order in which curves of one picture take it; all differ in lightness too.
GREY, BLUE, RED, ORANGE, PURPLE = "#3a3a3a", "#1f6fbf", "#c8322b", "#e08a00", "#7a4fb5"
_STYLE = {
    "font.size": 9.0,
    "axes.titlesize": 10.0,
    "axes.labelsize": 9.0,
    "axes.linewidth": 0.7,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "legend.fontsize": 8.0,
    "legend.frameon": False,
    "image.origin": "lower",
    "image.interpolation": "nearest",
    "text.usetex": False,
    "svg.hashsalt": "pachon",
}
_DPI = 150
#: Stamps of one picture.
_STAMPS = 6
#: Metadata of each format, left out: equal pictures have equal bytes.
_NAMELESS: dict[str, dict[str, None]] = {
    "png": {"Software": None},
    "pdf": {"Creator": None, "Producer": None, "CreationDate": None},
    "svg": {"Date": None, "Creator": None},
}
# Matplotlib announces the building of its font cache.
logging.getLogger("matplotlib.font_manager").setLevel(logging.ERROR)


def styled() -> AbstractContextManager[None]:
    """Return the context in which figures are drawn: our style on top of matplotlib's own, not the user's."""
    import matplotlib

    return matplotlib.rc_context({**matplotlib.rcParamsDefault, **_STYLE, "backend": "agg"})


def new_figure(width: float, height: float, layout: Literal["constrained", "compressed"] = "constrained") -> Figure:
    """Return an empty figure of a size in inches that belongs to no window and no global state; notebooks show it."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    from .figure import ShownFigure

    figure = ShownFigure(figsize=(width, height), layout=layout, facecolor="white", to_png=picture_bytes)
    FigureCanvasAgg(figure)
    return figure


def figure_at(ax: Axes | Figure | None, width: float, height: float) -> Figure:
    """Return where a picture of several panels is drawn.

    That is a new figure of a size in inches, the given figure or subfigure, or the place of the given axes, which are
    removed: a subfigure takes their cell of the grid.

    Raises
    ------
    DomainError
        If ``ax`` is none of these, or axes that stand in no grid of subplots.
    """
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

    if ax is None:
        return new_figure(width, height)
    if isinstance(ax, FigureBase):
        return cast("Figure", ax)
    cell = ax.get_subplotspec() if isinstance(ax, Axes) else None
    if cell is None:
        raise DomainError(f"ax = {shown(ax)}: expected Axes of a grid of subplots, a Figure or a SubFigure", key="ax")
    parent: Any = ax.get_figure(root=False)
    ax.remove()
    return cast("Figure", parent.add_subfigure(cell))


def axes_at(ax: Axes | Figure | None, width: float, height: float) -> tuple[Figure, Axes]:
    """Return where a picture of one panel is drawn: figure and axes, the given ones if they are axes."""
    from matplotlib.axes import Axes

    if isinstance(ax, Axes):
        return cast("Figure", ax.get_figure(root=False)), ax
    figure = figure_at(ax, width, height)
    return figure, figure.subplots()


def draw_stamps(ax: Axes | Figure | None, images: np.ndarray, pixel: float, titles: Sequence[str]) -> Figure:
    """Draw the first six stamps, shape [n, ny, nx], each from zero to its peak; pixels of some arc seconds."""
    count = min(len(images), _STAMPS)
    with styled():
        figure = figure_at(ax, max(2.1 * count, 4.2), 2.6)
        row = figure.subplots(1, count, squeeze=False)[0]
        half = 0.5 * pixel * images.shape[-1]
        for axes, image, title in zip(row, images, titles, strict=False):
            # The square root shows the wings.
            shown = np.sqrt(np.maximum(image, 0.0))
            axes.imshow(shown, extent=(-half, half, -half, half), cmap="inferno", vmin=0.0)
            axes.set_title(plain_text(title), fontsize=8.5)
            axes.set_xlabel("x [arcsec]")
        row[0].set_ylabel("y [arcsec]\nsquare root of the light", fontsize=8)
        return figure


def picture_bytes(figure: Figure, kind: str, dpi: int = _DPI) -> bytes:
    """Return a figure as the bytes of a png, pdf or svg file, without date and version of the software."""
    if kind not in _NAMELESS:
        raise ConfigError(f"picture format {kind!r}: expected one of {', '.join(_NAMELESS)}")
    buffer = io.BytesIO()
    # Ticks are made, and take their style, when a figure is drawn.
    with styled():
        if kind == "png":
            _draw_once(figure, buffer, dpi)
        else:
            figure.savefig(buffer, format=kind, dpi=dpi, metadata=_NAMELESS[kind])
    return buffer.getvalue()


def _draw_once(figure: Figure, buffer: io.BytesIO, dpi: int) -> None:
    """Write a figure as PNG: as ``savefig``, which draws all twice, the first time for the layout alone."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas, before = figure.canvas, figure.dpi
    try:
        figure.dpi = dpi
        FigureCanvasAgg(figure).print_png(buffer, metadata=_NAMELESS["png"])
    finally:
        figure.dpi = before
        figure.set_canvas(canvas)


def symlog_scale(axes: Axes, linear: float) -> None:
    """Give an axis of values a scale that is logarithmic, and linear about zero up to a power of ten below a value."""
    # With another threshold a tick would be nearer to zero.
    axes.set_yscale("symlog", linthresh=10.0 ** math.floor(math.log10(linear)))


def round_length(value: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten up to a positive value."""
    power = 10.0 ** math.floor(math.log10(value))
    return next(m * power for m in (5.0, 2.0, 1.0) if m * power <= value * (1 + 1e-9))


def png_bytes(figure: Figure) -> bytes:
    """Return a figure as PNG, without date and version of the software."""
    return picture_bytes(figure, "png")


def plain_text(name: str) -> str:
    """Return a name as pictures draw it letter by letter; matplotlib takes text between dollar signs for maths."""
    return name.replace("$", r"\$")


def label_log_axis(axis: Axis) -> None:
    """Put plain numbers at 1, 2 and 5 of each decade of a logarithmic axis; more would overlap where it is short."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def figure_of(axes: Axes) -> Figure:
    """Return the figure that axes belong to."""
    return cast("Figure", axes.get_figure(root=True))


def length_unit_of(largest: float) -> tuple[str, float]:
    """Return the unit of an axis with lengths up to one [m], and numbers of it per metre."""
    return ("mm", 1e3) if largest < 0.5 else ("m", 1.0)
