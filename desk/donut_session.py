"""A session of donuts: Zernikes of one and over the field, its image and model."""

from __future__ import annotations

from bokeh.document import Document
from bokeh.models import Select, Spinner

from ..core.number_text import counted
from .donut_views import DonutBench
from .page_session import PageSession
from .result_pictures import BarsPicture, PlacesPicture, RowsPicture
from .widgets import number_boxes, status_text


class DonutSession(PageSession):
    """The desk of wavefronts of donuts on one page."""

    def __init__(self, bench: DonutBench, document: Document | None = None) -> None:
        super().__init__(f"{bench.name}: desk of donuts", counted(len(bench), "donut"), document)
        self.bench, self.donut, self.noll = bench, 0, int(bench.noll[0])
        self.field = PlacesPicture("field", ("field x [deg]", "field y [deg]"), self._choose)
        self.bars = BarsPicture("zernikes", "Noll index", "coefficient [nm]")
        self.stamps = RowsPicture("stamps", "Donut", "pixels")
        self.pictures = (self.field, self.bars, self.stamps)
        self.donut_spinner = Spinner(title="Donut; or click one", value=0, low=0, high=len(bench) - 1, step=1)
        self.donut_spinner.on_change("value", lambda attribute, old, new: self.show_donut(new))
        self.term = Select(title="Over the field", value=f"Z{self.noll}", options=[f"Z{j}" for j in bench.noll])
        self.term.on_change("value", lambda attribute, old, new: self.show_term(int(new[1:])))
        self._make_sidebar(self.donut_spinner, self.term)
        self.paint("light")
        self.redraw()

    @property
    def state_words(self) -> str:
        """What is shown, in words."""
        return f"{self.bench.name}: donut {self.donut}, Z{self.noll}"

    def _choose(self, donut: int) -> None:
        self.donut_spinner.value = donut

    def show_donut(self, donut: int | float | None) -> None:
        """Show another donut."""
        if donut is None or not 0 <= int(donut) < len(self.bench):
            self.donut_spinner.value = self.donut
            return
        self.donut = int(donut)
        self.redraw()

    def show_term(self, noll: int) -> None:
        """Show another Zernike over the field."""
        self.noll = noll
        self.redraw()

    def redraw(self) -> None:
        """Draw the donut and the Zernike."""
        self.bars.show(self.bench.bars(self.donut))
        self.field.show(self.bench.over_field(self.noll), self.donut)
        images = self.bench.images(self.donut)
        self.stamps.figure.visible = images is not None
        if images is not None:
            self.stamps.show(images)
        reason = self.bench.reasons[self.donut]
        status_text(self.status, "" if reason == "ok" else f"donut {self.donut}: {reason}")
        self.table.text = number_boxes(self.bench.numbers(self.donut), {})
