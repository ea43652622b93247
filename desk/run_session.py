"""A session of a run: what is selected of its stars, and the pictures that follow."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from bokeh.document import Document
from bokeh.events import Tap
from bokeh.layouts import column
from bokeh.models import ColumnDataSource, FixedTicker, RangeSlider, Select, Span, Whisker

from ..core.errors import PachonError
from ..measure.correlation import Correlation
from .page_session import PageSession
from .pictures import BLUE, ORANGE, MapPicture, Picture, WhiskersPicture, diverging_palette
from .run_views import KINDS, RunBench, RunState, StampsView
from .run_views import run_correlation as correlation_of
from .run_views import run_numbers as numbers_of
from .run_views import run_stamps as stamps_of
from .run_views import run_whiskers as whiskers_of
from .widgets import number_boxes, status_text

#: Half of the side of a CCD, about [mm].
_CCD = 22.0


class StampsPicture(MapPicture):
    """Stamps of stars, the model at each and the difference, row by row."""

    def __init__(self) -> None:
        axes = ("x [arcsec]", "")
        super().__init__("stamps", "Stars of the CCD", axes, "part of the model's peak", diverging_palette())

    def show(self, view: StampsView, ccd: str) -> None:
        """Draw the stamps of a CCD."""
        self.mapper.update(low=-1.0, high=1.0)
        width, height = view.stars * view.side_arcsec, 3 * view.side_arcsec
        image = np.sign(view.image) * np.sqrt(np.abs(view.image))
        self.source.data = {"image": [np.float32(image)], "x": [0.0], "y": [0.0], "w": [width], "h": [height]}
        self.bar.title = "signed sqrt(image / peak)"
        self.figure.title.text = f"{ccd}: the first {view.stars} stars of the selection"
        places = [(row + 0.5) * view.side_arcsec for row in range(3)]
        axis = self.figure.yaxis[0]
        axis.ticker = FixedTicker(ticks=places)
        axis.major_label_overrides = dict(zip(places, ("star - model", "model", "star"), strict=True))


class CorrelationPicture(Picture):
    """The correlation function of the selection."""

    def __init__(self) -> None:
        super().__init__(
            "xi", "Correlation of the selection, adaptive g", "separation [arcmin]", "xi+", square=False, log_x=True
        )
        self.source = ColumnDataSource({"r": [], "xi": [], "low": [], "high": []})
        self.figure.line("r", "xi", source=self.source, color=BLUE, line_width=1.5)
        self.figure.scatter("r", "xi", source=self.source, color=BLUE, size=7)
        bars = Whisker(source=self.source, base="r", lower="low", upper="high", line_color=BLUE)
        for head in (bars.upper_head, bars.lower_head):
            head.line_color = BLUE
        self.figure.add_layout(bars)
        self.figure.add_layout(Span(location=0.0, dimension="width", line_color=ORANGE, line_dash="dashed"))

    def show(self, view: Correlation) -> None:
        """Draw points with their errors."""
        low, high = view.xi_plus - view.error_plus, view.xi_plus + view.error_plus
        self.source.data = {"r": view.r_arcmin, "xi": view.xi_plus, "low": low, "high": high}


class RunSession(PageSession):
    """The desk of a run on one page."""

    def __init__(self, bench: RunBench, document: Document | None = None) -> None:
        super().__init__(f"{bench.folder.resolve().name}: desk of a run", f"{len(bench.ccds)} CCDs", document)
        self.bench, self.state = bench, bench.start
        low, high = bench.centers_mm.min(axis=0), bench.centers_mm.max(axis=0)
        extent, (x, y) = 0.5 * float((high - low).max()) + _CCD, (0.5 * (low + high)).tolist()
        self.whiskers = WhiskersPicture(extent, 0.02 * extent, heights=False, center_mm=(x, y))
        self.whiskers.background = "ellipticity"
        self.whiskers.figure.on_event(Tap, lambda event: self._tap(event.x, event.y))
        self.stamps, self.xi = StampsPicture(), CorrelationPicture()
        self.pictures = (self.whiskers, self.xi, self.stamps)
        self._make_widgets()
        self.paint("light")
        self.redraw()

    @property
    def state_words(self) -> str:
        """The selection in words."""
        low, high = self.state.magnitudes
        return (
            f"{self.bench.folder.resolve().name}: {self.state.kind}, CCD {self.state.ccd}, magnitudes {low} to {high}"
        )

    def _make_widgets(self) -> None:
        low, high = self.state.magnitudes
        self.kind = Select(title="Shapes", value=self.state.kind, options=list(KINDS))
        self.kind.on_change("value", lambda attribute, old, new: self.change(kind=new))
        self.ccd = Select(title="CCD of the stamps; or click one", value=self.state.ccd, options=list(self.bench.ccds))
        self.ccd.on_change("value", lambda attribute, old, new: self.change(ccd=new))
        self.magnitudes = RangeSlider(title="Magnitudes of observed stars [AB]", start=low, end=high, step=0.1)
        self.magnitudes.value = (low, high)
        self.magnitudes.on_change("value_throttled", lambda attribute, old, new: self.change(magnitudes=tuple(new)))
        for widget in (self.kind, self.ccd, self.magnitudes):
            widget.sizing_mode = "stretch_width"
        parts = [self.kind, self.ccd, self.magnitudes, self.theme_toggle]
        self.sidebar = column(*parts, name="sidebar", sizing_mode="stretch_width")

    def change(self, **values: Any) -> None:
        """Change the selection; one that is impossible is one line, and the last good one stays."""
        state = replace(self.state, **values)
        if state == self.state:
            return
        before, self.state = self.state, state
        if not self.redraw():
            self.state = before
            self.kind.value, self.ccd.value = before.kind, before.ccd

    def _tap(self, x: float | None, y: float | None) -> None:
        if x is not None and y is not None:
            self.ccd.value = self.bench.nearest_ccd(x, y)

    def redraw(self) -> bool:
        """Draw the selection, and return whether all of it could be drawn."""
        views: list[tuple[Callable[[RunBench, RunState], Any], Callable[[Any], None]]] = [
            (whiskers_of, lambda view: self.whiskers.show(view, None, None)),
            (correlation_of, self.xi.show),
            (stamps_of, lambda view: self.stamps.show(view, self.state.ccd)),
        ]
        try:
            made = [make(self.bench, self.state) for make, _ in views]
        except PachonError as error:
            status_text(self.status, error)
            return False
        for view, (_, show) in zip(made, views, strict=True):
            show(view)
        status_text(self.status, "")
        self.table.text = number_boxes(numbers_of(made[0], len(self.bench.ccds)), {})
        return True
