"""A session of a sweep or of tolerances: linked plots of points, slices, effects of parameters, points that open."""

from __future__ import annotations

from typing import Any

import numpy as np
from bokeh.document import Document
from bokeh.models import Button, ColumnDataSource, CustomJS, HoverTool, RangeSlider, Select, Span, Spinner
from bokeh.models.tools import BoxSelectTool, TapTool
from bokeh.transform import dodge

from ..core.errors import PachonError
from ..core.number_text import counted
from .page_session import PageSession
from .pictures import BLUE, GREEN, GREY, ORANGE, Picture
from .sweep_views import PointsBench, TornadoView
from .widgets import number_boxes, status_text

#: Parameters with a plot of their own, at most.
_MOST_PLOTS = 8
#: Choice of no slice.
_NO_SLICE = "any value of all"
#: Opens a point in another tab, at the same address.
_OPEN = """
const address = new URL(location.href);
address.searchParams.set('point', number.value);
window.open(address.href, '_blank', 'noopener');
"""


class PointsPicture(Picture):
    """One column of the points against another; all such pictures have one selection."""

    def __init__(self, name: str, source: ColumnDataSource, x: str, labels: tuple[str, str]) -> None:
        super().__init__(name, "", *labels, square=False)
        points = self.figure.scatter(
            x,
            "metric",
            source=source,
            size=7,
            color=BLUE,
            alpha=0.75,
            selection_color=ORANGE,
            selection_alpha=1.0,
            nonselection_color=GREY,
            nonselection_alpha=0.25,
        )
        select = BoxSelectTool(renderers=[points])
        tips = [("point", "@number"), (labels[0], f"@{{{x}}}"), ("metric", "@metric")]
        self.figure.add_tools(select, TapTool(renderers=[points]), HoverTool(renderers=[points], tooltips=tips))
        self.figure.toolbar.active_drag = select


class TornadoPicture(Picture):
    """Effects of the parameters on a metric."""

    def __init__(self) -> None:
        super().__init__("tornado", "", "", "", square=False)
        self.source = ColumnDataSource({"row": [], "name": [], "low": [], "high": [], "range": []})
        low = self.figure.hbar(dodge("row", -0.16), 0.3, "low", source=self.source, color=ORANGE, alpha=0.8)
        high = self.figure.hbar(dodge("row", 0.16), 0.3, "high", source=self.source, color=BLUE, alpha=0.8)
        self.figure.add_layout(Span(location=0.0, dimension="height", line_color=GREEN, line_dash="dashed"))
        tips = [("", "@name"), ("values", "@range"), ("below nominal", "@low"), ("above, or correlation", "@high")]
        self.figure.add_tools(HoverTool(renderers=[low, high], tooltips=tips))

    def show(self, view: TornadoView) -> None:
        """Draw the bars, the largest at the top."""
        names, rows = list(view.parameters), list(range(len(view.parameters)))
        ranges = list(view.ranges)
        self.source.data = {"row": rows, "name": names, "low": view.low, "high": view.high, "range": ranges}
        self.name_rows(rows, names)
        self.figure.xaxis.axis_label = view.axis
        self.figure.title.text = "Effects of the parameters"


class SweepSession(PageSession):
    """The desk of a sweep, or of telescopes drawn within tolerances, on one page."""

    def __init__(self, bench: PointsBench, document: Document | None = None, message: str = "") -> None:
        count = len(bench.number)
        counts = {"point": count, "parameter": len(bench.parameters), "metric": len(bench.metrics)}
        parts = ", ".join(counted(number, noun) for noun, number in counts.items())
        super().__init__(f"{bench.name}: desk of {bench.what}", parts, document)
        self.bench = bench
        self.metric = next(iter(bench.metrics))
        self.other = list(bench.metrics)[min(1, len(bench.metrics) - 1)]
        names = list(bench.parameters)[:_MOST_PLOTS]
        columns = {f"x{i}": bench.parameters[name] for i, name in enumerate(names)}
        self.source = ColumnDataSource({"number": bench.number, "metric": np.zeros(count), **columns})
        self.source.data["other"] = np.zeros(count)
        y = bench.label(self.metric)
        self.plots = [
            PointsPicture(f"x{i}", self.source, f"x{i}", (bench.label(name), y)) for i, name in enumerate(names)
        ]
        self.against = PointsPicture("other", self.source, "other", (bench.label(self.other), y))
        self.tornado = TornadoPicture()
        self.pictures = (*self.plots, self.against, self.tornado)
        self._make_widgets()
        self.paint("light")
        self.redraw()
        status_text(self.status, message)

    @property
    def state_words(self) -> str:
        """What is shown, in words."""
        return f"{self.bench.name}: {self.bench.label(self.metric)}"

    def _make_widgets(self) -> None:
        metrics = list(self.bench.metrics)
        self.metric_select = Select(title="Metric", value=self.metric, options=metrics)
        self.other_select = Select(title="Against the metric", value=self.other, options=metrics)
        for select, name in ((self.metric_select, "metric"), (self.other_select, "other")):
            select.on_change("value", lambda attribute, old, new, name=name: self.change(name, new))
        self.source.selected.on_change("indices", lambda attribute, old, new: self._select(new))
        first = int(self.bench.number[0])
        self.point = Spinner(title="Point; or click one", value=first, low=0, step=1)
        self.open = Button(label="Open this telescope")
        self.open.js_on_click(CustomJS(args={"number": self.point}, code=_OPEN))
        parameters = list(self.bench.parameters)
        self.slice_select = Select(title="Slice: points with", value=_NO_SLICE, options=[_NO_SLICE, *parameters])
        self.slice_select.on_change("value", lambda attribute, old, new: self._choose_slice(new))
        self.slice_range = RangeSlider(title="within", start=0.0, end=1.0, value=(0.0, 1.0), step=0.1, visible=False)
        self.slice_range.on_change("value_throttled", lambda attribute, old, new: self.show_slice(*new))
        parts: list[Any] = [self.metric_select, self.other_select, self.slice_select, self.slice_range]
        if self.bench.opens:
            parts += [self.point, self.open]
        self._make_sidebar(*parts)

    def change(self, axis: str, metric: str) -> None:
        """Draw another metric, or the metric against another one."""
        if metric in self.bench.metrics:
            setattr(self, axis, metric)
            self.redraw()

    def _choose_slice(self, parameter: str) -> None:
        """Set the range of the slice to a third in the middle of the values of a parameter, or show all points."""
        self.slice_range.visible = parameter in self.bench.parameters
        if not self.slice_range.visible:
            self.source.selected.indices = []
            return
        values = self.bench.parameters[parameter]
        low, high = float(np.nanmin(values)), float(np.nanmax(values))
        third = (high - low) / 3.0
        label = self.bench.label(parameter)
        self.slice_range.update(title=label, start=low, end=high, step=(high - low) / 100.0)
        self.slice_range.value = (low + third, high - third)
        self.show_slice(*self.slice_range.value)

    def show_slice(self, low: float, high: float) -> None:
        """Select the points of a slice; one without points is one line, and the last selection stays."""
        rows = self.bench.in_slice(self.slice_select.value, low, high)
        if not rows:
            status_text(self.status, f"{self.slice_select.value} from {low:g} to {high:g}: no point has such a value")
            return
        status_text(self.status, "")
        self.source.selected.indices = rows

    def _select(self, indices: list[int]) -> None:
        if len(indices) == 1:
            self.point.value = int(self.bench.number[indices[0]])
        self._show_numbers()

    def _show_numbers(self) -> None:
        selected = self.source.selected.indices
        self.table.text = number_boxes(self.bench.numbers(self.metric, selected), {})

    def redraw(self) -> None:
        """Draw the points and the effects."""
        self.source.data.update(metric=self.bench.metrics[self.metric], other=self.bench.metrics[self.other])
        for picture in (*self.plots, self.against):
            picture.figure.yaxis.axis_label = self.bench.label(self.metric)
        self.against.figure.xaxis.axis_label = self.bench.label(self.other)
        try:
            self.tornado.show(self.bench.tornado(self.metric))
        except PachonError as error:
            status_text(self.status, error)
        self._show_numbers()
