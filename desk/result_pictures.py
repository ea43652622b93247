"""Pictures that pages of results share: rows of images, correlations, numbers at places, bars with errors."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from bokeh.models import ColumnDataSource, HoverTool, LinearColorMapper, Span, TapTool, Whisker
from bokeh.palettes import Cividis256

from .pictures import BLUE, DIVERGING, GREY, ORANGE, MapPicture, Picture
from .result_views import ErrorBarsView, PlacesView, RowsView, SkyMapView

#: Least width of a degree of right ascension over one of declination in pictures: near the poles it vanishes.
_LEAST_ASPECT = 0.05


class RowsPicture(MapPicture):
    """Rows of images, on a signed square-root scale."""

    def __init__(self, name: str, title: str, unit: str = "arcsec") -> None:
        super().__init__(name, title, (f"x [{unit}]", ""), "signed sqrt(image / peak)", DIVERGING)
        self.mapper.update(low=-1.0, high=1.0)

    def show(self, view: RowsView) -> None:
        """Draw the rows, the first at the top."""
        image, side = view.image, view.side_arcsec
        stretched = np.float32(np.sign(image) * np.sqrt(np.abs(image)))
        width, height = view.columns * side, len(view.rows) * side
        self.source.data = {"image": [stretched], "x": [0.0], "y": [0.0], "w": [width], "h": [height]}
        self.figure.title.text = view.title
        places = [(row + 0.5) * side for row in range(len(view.rows))]
        self.name_rows(places, reversed(list(view.rows)))


class _WithErrors(Picture):
    """A picture of numbers with standard errors."""

    def _add_errors(self) -> None:
        self.source = ColumnDataSource({"x": [], "y": [], "low": [], "high": []})
        bars = Whisker(source=self.source, base="x", lower="low", upper="high", line_color=GREY)
        for head in (bars.upper_head, bars.lower_head):
            head.line_color = GREY
        self.figure.add_layout(bars)
        self.figure.add_layout(Span(location=0.0, dimension="width", line_color=ORANGE, line_dash="dashed"))

    def _show(self, x: np.ndarray, y: np.ndarray, error: np.ndarray) -> None:
        self.source.data = {"x": x, "y": y, "low": y - error, "high": y + error}


class CorrelationPicture(_WithErrors):
    """A correlation function xi+."""

    def __init__(self, title: str) -> None:
        super().__init__("xi", title, "separation [arcmin]", "xi+", square=False, log_x=True)
        self._add_errors()
        self.figure.line("x", "y", source=self.source, color=BLUE, line_width=1.5)
        self.figure.scatter("x", "y", source=self.source, color=BLUE, size=7)

    def show(self, r_arcmin: np.ndarray, xi_plus: np.ndarray, error: np.ndarray) -> None:
        """Draw points with their standard errors."""
        self._show(r_arcmin, xi_plus, error)


class BarsPicture(_WithErrors):
    """Bars with standard errors."""

    def __init__(self, name: str, x_label: str, y_label: str) -> None:
        super().__init__(name, "", x_label, y_label, square=False)
        self._add_errors()
        self.figure.vbar("x", 0.8, "y", source=self.source, color=BLUE)
        self.figure.add_tools(HoverTool(tooltips=[(x_label, "@x"), (y_label, "@y"), ("from", "@low to @high")]))

    def show(self, view: ErrorBarsView) -> None:
        """Draw the bars."""
        self.figure.title.text = view.title
        self._show(view.x, view.value, view.error)


class PlacesPicture(Picture):
    """Numbers at places in colours; a click chooses a place, which is framed."""

    def __init__(
        self, name: str, labels: tuple[str, str], choose: Callable[[int], None], *, size: int = 18, square: bool = True
    ) -> None:
        super().__init__(name, "", *labels, square=square)
        self.mapper = LinearColorMapper(palette=Cividis256, low=0.0, high=1.0, nan_color=GREY)
        self.source = ColumnDataSource({"x": [], "y": [], "value": []})
        self._chosen = ColumnDataSource({"x": [], "y": []})
        for axis in (self.figure.x_range, self.figure.y_range):
            # Marks at the rim are whole.
            axis.range_padding = 0.2
        color: Any = {"field": "value", "transform": self.mapper}
        style = {"source": self.source, "marker": "square", "size": size, "line_color": GREY}
        marks = self.figure.scatter("x", "y", fill_color=color, nonselection_fill_alpha=1.0, **style)
        frame = {"fill_alpha": 0.0, "line_color": ORANGE, "line_width": 2.5, "marker": "square", "size": size + 6}
        self.figure.scatter("x", "y", source=self._chosen, **frame)
        self.bar = self.add_bar(self.mapper, "")
        tips = [(labels[0], "@x{0.0000}"), (labels[1], "@y{0.0000}"), ("", "@value")]
        self.figure.add_tools(HoverTool(renderers=[marks], tooltips=tips), TapTool(renderers=[marks]))

        def chosen(attribute: str, old: list[int], new: list[int]) -> None:
            if new:
                choose(new[0])
                self.source.selected.indices = []

        self.source.selected.on_change("indices", chosen)

    def show(self, view: PlacesView, chosen: int | None = None) -> None:
        """Draw numbers at places; one of them may be framed."""
        low, high = _limits(view.value)
        if view.diverging:
            high = max(abs(low), abs(high))
            low = -high
        self.scale(DIVERGING if view.diverging else Cividis256, low, high)
        self.bar.title = view.label
        self.figure.title.text = view.title
        self.source.data = {"x": view.x, "y": view.y, "value": view.value}
        framed = slice(0, 0) if chosen is None else slice(chosen, chosen + 1)
        self._chosen.data = {"x": view.x[framed], "y": view.y[framed]}


class SkyMapPicture(Picture):
    """Pixels of the sky in colours."""

    def __init__(self, dec_deg: float) -> None:
        super().__init__("map", "", "right ascension [deg]", "declination [deg]")
        as_sky(self, dec_deg)
        self.mapper = LinearColorMapper(palette=Cividis256, low=0.0, high=1.0, nan_color=GREY)
        self.source = ColumnDataSource({"xs": [], "ys": [], "value": []})
        color: Any = {"field": "value", "transform": self.mapper}
        pixels = self.figure.patches("xs", "ys", source=self.source, fill_color=color, line_color=None)
        self.bar = self.add_bar(self.mapper, "")
        self.figure.add_tools(HoverTool(renderers=[pixels], tooltips=[("", "@value")]))

    def show(self, view: SkyMapView) -> None:
        """Draw the pixels."""
        self.scale(Cividis256, *_limits(view.value))
        self.bar.title, self.figure.title.text = view.label, view.title
        self.source.data = {"xs": list(view.ra), "ys": list(view.dec), "value": view.value}


def as_sky(picture: Picture, dec_deg: float) -> None:
    """Turn east to the left, and make angles alike along both axes at a declination."""
    picture.figure.x_range.flipped = True
    picture.figure.aspect_scale = max(math.cos(math.radians(dec_deg)), _LEAST_ASPECT)


def _limits(values: np.ndarray) -> tuple[float, float]:
    """Return the values that colours go between: all but the outermost hundredths."""
    finite = values[np.isfinite(values)]
    low, high = (float(v) for v in np.quantile(finite, [0.01, 0.99])) if len(finite) else (0.0, 1.0)
    return low, high if high > low else low + 1e-6
