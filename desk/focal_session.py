"""A session of a focal-plane model: predicted shapes, their uncertainty, eigen-PSFs, and the PSF at a place."""

from __future__ import annotations

import numpy as np
from bokeh.document import Document
from bokeh.models import Select

from ..core.number_text import counted
from .focal_views import MAPS, FocalBench
from .page_session import PageSession
from .pictures import BACKGROUNDS, WhiskersPicture
from .result_pictures import PlacesPicture, RowsPicture
from .widgets import number_boxes, status_text

#: Side of the mark of a place, at least and at most [pixels].
_LEAST_MARK = 5
_LARGEST_MARK = 26
#: Sides of all marks in a row together [pixels].
_ROW = 250


class FocalSession(PageSession):
    """The desk of a focal-plane model on one page."""

    def __init__(self, bench: FocalBench, document: Document | None = None) -> None:
        ccds = len(np.unique(bench.ccd))
        super().__init__(f"{bench.name}: desk of a focal-plane model", f"{counted(ccds, 'CCD')} with stars", document)
        self.bench, self.place = bench, 0
        self.heights = bench.heights()
        x, y = (1e3 * bench.center).tolist()
        self.whiskers = WhiskersPicture(
            1e3 * bench.reach, 1e3 * bench.spacing, heights=self.heights is not None, center_mm=(x, y)
        )
        size = min(max(round(_ROW * bench.spacing / (2.0 * bench.reach)), _LEAST_MARK), _LARGEST_MARK)
        self.field = PlacesPicture("field", ("detector x [mm]", "detector y [mm]"), self.show_place, size=size)
        self.psf, self.components = RowsPicture("psf", "PSF"), RowsPicture("components", "Eigen-PSFs")
        self.pictures = (self.whiskers, self.field, self.psf, self.components)
        backgrounds = list(BACKGROUNDS[0 if self.heights is not None else 1 :])
        self.background = Select(title="Behind the whiskers", value=self.whiskers.background, options=backgrounds)
        self.background.on_change("value", lambda attribute, old, new: self.show_background(new))
        self.map = Select(title="Map; a click on it chooses the place", value=MAPS[0], options=list(MAPS))
        self.map.on_change("value", lambda attribute, old, new: self.show_map())
        self._make_sidebar(self.background, self.map)
        self.paint("light")
        eigen = bench.components()
        self.components.figure.visible = eigen is not None
        if eigen is not None:
            self.components.show(eigen)
        self.show_background(self.whiskers.background)
        self.show_place(int(np.argmin(np.hypot(*(bench.places - bench.center).T))))

    @property
    def state_words(self) -> str:
        """What is shown, in words."""
        x, y = 1e3 * self.bench.places[self.place]
        return f"{self.bench.name}: {self.map.value}; PSF on {self.bench.ccd_name(self.place)} at {x:.1f}, {y:.1f} mm"

    def show_background(self, name: str) -> None:
        """Draw the whiskers on heights, FWHM or ellipticity."""
        self.whiskers.background = name
        self.whiskers.paint(self.theme)
        self.whiskers.show(self.bench.whiskers(), self.heights, None)

    def show_map(self) -> None:
        """Draw the map, the place framed."""
        self.field.show(self.bench.map(self.map.value), self.place)

    def show_place(self, place: int) -> None:
        """Draw the PSF at another place."""
        self.place = place
        self.show_map()
        image = self.bench.psf(place)
        self.psf.figure.visible = image is not None
        if image is not None:
            self.psf.show(image)
        remarks = list(self.bench.model.warnings)
        if image is None:
            remarks.append("no image: the stars of the fit had no stamps")
        status_text(self.status, "; ".join(remarks))
        self.table.text = number_boxes(self.bench.numbers(place), {})
