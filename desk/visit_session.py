"""Sessions of visits: those of a list by their rows of CCDs, and stacks by their points of the sky."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from bokeh.document import Document
from bokeh.models import HoverTool, Select

from ..core.errors import PachonError
from ..core.number_text import counted
from .page_session import PageSession
from .pictures import WhiskersPicture
from .result_pictures import CorrelationPicture, PlacesPicture, SkyMapPicture, as_sky
from .visit_views import ALL, STACK_KINDS, NightBench, StackBench
from .widgets import number_boxes, status_text


class NightSession(PageSession):
    """The desk of the visits of a list on one page."""

    def __init__(self, bench: NightBench, document: Document | None = None) -> None:
        name = bench.folder.resolve().name
        visits = counted(len(bench.visits), "visit")
        super().__init__(f"{name}: desk of visits", f"{visits} in {', '.join(bench.bands)}", document)
        self.bench, self.state = bench, bench.start
        self.sky = PlacesPicture("sky", ("right ascension [deg]", "declination [deg]"), lambda row: None, size=14)
        as_sky(self.sky, bench.center[1])
        self.map = SkyMapPicture(bench.center[1])
        self.times = PlacesPicture("times", ("hours since the first visit", ""), self._choose, square=False)
        self.pictures = (self.sky, self.times, self.map)
        self._make_widgets()
        self.paint("light")
        self.redraw()
        self.map.figure.visible = bool(bench.maps)
        if bench.maps:
            self.show_map(self.map_select.value)

    @property
    def state_words(self) -> str:
        """What is shown, in words."""
        return (
            f"{self.bench.folder.resolve().name}: {self.state.column}, band {self.state.band}, visit {self.state.visit}"
        )

    def _make_widgets(self) -> None:
        self.column = Select(title="Column", value=self.state.column, options=list(self.bench.columns))
        self.band = Select(title="Band", value=ALL, options=[ALL, *self.bench.bands])
        self.visit = Select(title="Visit; or click one", value=ALL, options=[ALL, *self.bench.visits])
        parts = {"column": self.column, "band": self.band, "visit": self.visit}
        for name, widget in parts.items():
            widget.on_change("value", lambda attribute, old, new, name=name: self.change(**{name: new}))
        names = list(self.bench.maps)
        self.map_select = Select(title="Map", value=names[0] if names else "", options=names, visible=bool(names))
        self.map_select.on_change("value", lambda attribute, old, new: self.show_map(new))
        self._make_sidebar(*parts.values(), self.map_select)

    def show_map(self, name: str) -> None:
        """Show another map; one that cannot be read is one line."""
        self.map.figure.visible = False
        try:
            self.map.show(self.bench.map(name))
            self.map.figure.visible = True
            status_text(self.status, "")
        except PachonError as error:
            status_text(self.status, error)

    def _choose(self, row: int) -> None:
        self.visit.value = list(self.bench.shown(self.state))[row]

    def change(self, **values: Any) -> None:
        """Change what is shown; a visit of another band than the one chosen gives way to all of the band."""
        self.state = replace(self.state, **values)
        visits = self.bench.shown(self.state)
        if self.state.visit not in (ALL, *visits):
            self.state = replace(self.state, visit=ALL)
        self.visit.update(options=[ALL, *visits], value=self.state.visit)
        self.redraw()

    def redraw(self) -> None:
        """Draw the column over the sky, and by visit."""
        visits = list(self.bench.shown(self.state))
        self.sky.show(self.bench.sky(self.state))
        times = self.bench.times(self.state)
        self.times.figure.yaxis.axis_label = times.label
        self.times.show(times, visits.index(self.state.visit) if self.state.visit in visits else None)
        self.table.text = number_boxes(self.bench.numbers(self.state), {})


class StackSession(PageSession):
    """The desk of stacks of visits on one page."""

    def __init__(self, bench: StackBench, document: Document | None = None) -> None:
        name = bench.folder.resolve().name
        super().__init__(f"{name}: desk of stacked visits", f"stacks of {', '.join(bench.stacks)} visits", document)
        self.bench, self.visits, self.kind = bench, list(bench.stacks)[-1], STACK_KINDS[0]
        view = bench.whiskers(self.visits, self.kind)
        extent = 1.05 * float(max(np.abs(view.x_mm).max(), np.abs(view.y_mm).max()))
        self.whiskers = WhiskersPicture(extent, 0.02 * extent, heights=False)
        self.whiskers.background = "ellipticity"
        figure = self.whiskers.figure
        figure.xaxis.axis_label, figure.yaxis.axis_label = "x of the stack [arcmin]", "y of the stack [arcmin]"
        [hover] = figure.select({"type": HoverTool})
        hover.tooltips = [
            ("x, y [arcmin]", "@x{0.00}, @y{0.00}"),
            ("g", "@e{0.00} %"),
            ("FWHM under the weight", "@fwhm{0.000} arcsec"),
        ]
        self.xi = CorrelationPicture("Correlation of adaptive g")
        self.pictures = (self.whiskers, self.xi)
        self.stack = Select(title="Visits in the stack", value=self.visits, options=list(bench.stacks))
        self.kinds = Select(title="Shapes", value=self.kind, options=list(STACK_KINDS))
        for name, widget in {"visits": self.stack, "kind": self.kinds}.items():
            widget.on_change("value", lambda attribute, old, new, name=name: self.change(name, new))
        self._make_sidebar(self.stack, self.kinds)
        self.paint("light")
        self.redraw()

    @property
    def state_words(self) -> str:
        """What is shown, in words."""
        return f"{self.bench.folder.resolve().name}: {counted(int(self.visits), 'visit')}, {self.kind}"

    def change(self, name: str, value: str) -> None:
        """Show another stack, or other shapes."""
        setattr(self, name, value)
        self.redraw()

    def redraw(self) -> None:
        """Draw the points."""
        self.whiskers.show(self.bench.whiskers(self.visits, self.kind), None, None)
        view = self.bench.correlation(self.visits, self.kind)
        self.xi.show(view.r_arcmin, view.xi_plus, view.error_plus)
        self.table.text = number_boxes(self.bench.numbers(self.visits, self.kind), {})
