"""A session of a run: what is selected of its stars, and the pictures that follow."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from bokeh.document import Document
from bokeh.events import SelectionGeometry, Tap
from bokeh.models import BoxAnnotation, Button, RangeSlider, Select
from bokeh.models.tools import BoxSelectTool

from ..core.errors import PachonError
from ..core.number_text import counted
from .page_session import PageSession
from .pictures import ORANGE, Picture, WhiskersPicture
from .result_pictures import CorrelationPicture, RowsPicture
from .run_views import RunBench, RunState
from .run_views import run_components as components_of
from .run_views import run_correlation as correlation_of
from .run_views import run_numbers as numbers_of
from .run_views import run_stamps as stamps_of
from .run_views import run_whiskers as whiskers_of
from .widgets import number_boxes, status_text

#: Half of the side of a CCD, about [mm].
_CCD = 22.0


class RunSession(PageSession):
    """The desk of a run on one page."""

    def __init__(self, bench: RunBench, document: Document | None = None) -> None:
        super().__init__(f"{bench.folder.resolve().name}: desk of a run", counted(len(bench.ccds), "CCD"), document)
        self.bench, self.state = bench, bench.start
        low, high = bench.centers_mm.min(axis=0), bench.centers_mm.max(axis=0)
        extent, (x, y) = 0.5 * float((high - low).max()) + _CCD, (0.5 * (low + high)).tolist()
        self.whiskers = WhiskersPicture(extent, 0.02 * extent, heights=False, center_mm=(x, y))
        self.whiskers.background = "ellipticity"
        self.whiskers.figure.on_event(Tap, lambda event: self._tap(event.x, event.y))
        select = BoxSelectTool(renderers=[])
        self.whiskers.figure.add_tools(select)
        self.whiskers.figure.on_event(SelectionGeometry, lambda event: self._brush(event.geometry))
        self.region = BoxAnnotation(fill_alpha=0.0, line_color=ORANGE, line_width=2, visible=False)
        self.whiskers.figure.add_layout(self.region)
        self.xi = CorrelationPicture("Correlation of adaptive g")
        self.stamps = RowsPicture("stamps", "Stars of the CCD")
        self.components = RowsPicture("components", "PSF model of the CCD")
        self.pictures = (self.whiskers, self.xi, self.stamps, self.components)
        self._make_widgets()
        self.paint("light")
        self.redraw()

    @property
    def state_words(self) -> str:
        """The selection in words."""
        ranges = {"magnitudes": self.state.magnitudes, "x [mm]": self.state.x_mm, "y [mm]": self.state.y_mm}
        words = ", ".join(f"{name} {low:g} to {high:g}" for name, (low, high) in ranges.items())
        return f"{self.bench.folder.resolve().name}: {self.state.kind}, CCD {self.state.ccd}, {words}"

    def _make_widgets(self) -> None:
        self.kind = Select(title="Shapes", value=self.state.kind, options=list(self.bench.kinds))
        self.kind.on_change("value", lambda attribute, old, new: self.change(kind=new))
        self.ccd = Select(title="CCD of the stamps; or click one", value=self.state.ccd, options=list(self.bench.ccds))
        self.ccd.on_change("value", lambda attribute, old, new: self.change(ccd=new))
        self.ranges = {
            "magnitudes": self._range("magnitudes", "Magnitudes of observed stars [AB]", 0.1),
            "x_mm": self._range("x_mm", "Detector x [mm]; or select a box", 1.0),
            "y_mm": self._range("y_mm", "Detector y [mm]", 1.0),
        }
        whole = Button(label="Select all stars")
        whole.on_click(lambda: self.show_state(replace(self.bench.start, kind=self.state.kind, ccd=self.state.ccd)))
        parts = [self.kind, self.ccd, *self.ranges.values(), whole]
        self._make_sidebar(*parts)

    def _range(self, name: str, title: str, step: float) -> RangeSlider:
        low, high = getattr(self.state, name)
        slider = RangeSlider(title=title, start=low, end=high, step=step, value=(low, high))
        slider.on_change("value_throttled", lambda attribute, old, new: self.change(**{name: tuple(new)}))
        return slider

    def show_state(self, state: RunState) -> None:
        """Set the widgets to a selection, and draw it."""
        self.change(**{name: getattr(state, name) for name in ("kind", "ccd", *self.ranges)})

    def _set_widgets(self) -> None:
        self.kind.value, self.ccd.value = self.state.kind, self.state.ccd
        for name, slider in self.ranges.items():
            slider.value = getattr(self.state, name)

    def _brush(self, geometry: Any) -> None:
        """Select the stars in a box that was drawn; one that leaves the field is cut at its rim."""
        if geometry.get("type") != "rect":
            return
        box = {}
        for axis in "xy":
            low, high = getattr(self.bench.start, f"{axis}_mm")
            ends = (min(max(geometry[f"{axis}{end}"], low), high) for end in (0, 1))
            box[f"{axis}_mm"] = tuple(sorted(ends))
        middle = (0.5 * sum(box["x_mm"]), 0.5 * sum(box["y_mm"]))
        self.change(**box, ccd=self.bench.nearest_ccd(*middle))

    def change(self, **values: Any) -> None:
        """Change the selection; one that is impossible is one line, and the last good one stays."""
        state = replace(self.state, **values)
        if state == self.state:
            return
        before, self.state = self.state, state
        if not self.redraw():
            self.state = before
        self._set_widgets()

    def _tap(self, x: float | None, y: float | None) -> None:
        if x is not None and y is not None:
            self.ccd.value = self.bench.nearest_ccd(x, y)

    def redraw(self) -> bool:
        """Draw the selection, and return whether it has stars; a picture that it has too few for is empty."""
        try:
            whiskers = whiskers_of(self.bench, self.state)
        except PachonError as error:
            status_text(self.status, error)
            return False
        if not len(whiskers.e1):
            status_text(self.status, "no star is selected")
            return False
        self.whiskers.show(whiskers, None, None)
        views: list[tuple[Callable[[RunBench, RunState], Any], Picture, Callable[[Any], None]]] = [
            (correlation_of, self.xi, lambda view: self.xi.show(view.r_arcmin, view.xi_plus, view.error_plus)),
            (stamps_of, self.stamps, self.stamps.show),
            (components_of, self.components, self.components.show),
        ]
        message = ""
        for make, picture, show in views:
            try:
                show(make(self.bench, self.state))
                picture.figure.visible = True
            except PachonError as error:
                picture.figure.visible = False
                message = message or str(error)
        start, (left, right), (bottom, top) = self.bench.start, self.state.x_mm, self.state.y_mm
        self.region.update(left=left, right=right, bottom=bottom, top=top)
        self.region.visible = (self.state.x_mm, self.state.y_mm) != (start.x_mm, start.y_mm)
        status_text(self.status, message)
        self.table.text = number_boxes(numbers_of(whiskers, len(self.bench.ccds)), {})
        return True
