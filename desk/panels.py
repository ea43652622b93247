"""Panels of pictures that are computed only where they are wanted, each with widgets of its own."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from bokeh.layouts import row
from bokeh.models import Button, MultiSelect, Select, Slider

from ..core.errors import PachonError
from ..design.layout.layout import Layout
from ..measure.correlation import SeparationBins
from .bench import Bench
from .design_pictures import MeritPicture, MtfPicture, SensitivityPicture, SpacePicture, WhiskerCorrelationPicture
from .design_views import (
    METRICS,
    PER_CCD,
    CorrelationView,
    Line,
    MtfView,
    SensitivityView,
    correlation_view,
    improved,
    mtf_view,
    sensitivity_view,
    separation_bins,
    space_view,
)
from .pictures import OpdPicture, Picture, SpotsPicture, WhiskersPicture
from .solid import solid_buttons
from .state import DeskState
from .views import HeightsView, OpdView, Scene, SpotsView, WhiskersView, layout_of, whiskers_view

#: Views by their class.
Views = Mapping[type, Any]
#: Relative fall of the merit at which an optimisation ends, and its pictures at most.
_SETTLED = 1e-5
_MOST_STEPS = 60
#: Variables that are listed at once.
_LISTED = 6
#: Whiskers that a correlation keeps: of the state, the design and A, one and ten a CCD.
_KEPT = 6


class Panel(ABC):
    """Pictures that a tick shows, with their widgets in the sidebar."""

    label: str
    pictures: tuple[Picture, ...]
    widgets: tuple[Any, ...] = ()

    def __init__(self) -> None:
        self.shown = False

    def set_shown(self, shown: bool) -> None:
        """Show or hide pictures and widgets."""
        self.shown = shown
        for part in (*(picture.figure for picture in self.pictures), *self.widgets):
            part.visible = shown

    @property
    def numbers(self) -> dict[str, tuple[float, str]]:
        """Numbers beside those of the desk, with their units; none by default."""
        return {}

    def draw_fast(self, scene: Scene, views: dict[type, Any], compared: Views) -> None:  # noqa: B027 - optional
        """Draw what follows a slider; nothing by default."""

    @abstractmethod
    def draw(self, scene: Scene, views: dict[type, Any], compared: Views) -> None:
        """Draw a state beside the pinned one, and keep its views."""


class MtfPanel(Panel):
    """Modulation transfer at the star."""

    label = "MTF"

    def __init__(self) -> None:
        super().__init__()
        self.picture = MtfPicture()
        self.pictures = (self.picture,)

    def draw(self, scene: Scene, views: dict[type, Any], compared: Views) -> None:
        """Draw the curves of the state, and that of the pinned one."""
        views[MtfView] = mtf_view(scene)
        self.picture.show(views[MtfView], compared.get(MtfView))


class CorrelationPanel(Panel):
    """xi+ of the whiskers beside that of the pinned state or, where there is none, of the design."""

    label = "Correlation"

    def __init__(self, bench: Bench, pinned: Callable[[], DeskState]) -> None:
        super().__init__()
        self._bench, self._pinned = bench, pinned
        self.picture = WhiskerCorrelationPicture()
        self.pictures = (self.picture,)
        self.view: CorrelationView | None = None
        self._kept: list[tuple[DeskState, int, WhiskersView]] = []

    @property
    def numbers(self) -> dict[str, tuple[float, str]]:
        """The values at the shortest separation."""
        return {} if self.view is None else self.view.numbers

    @cached_property
    def _bins(self) -> SeparationBins:
        return separation_bins(self._bench.stars(PER_CCD)[1])

    def draw_fast(self, scene: Scene, views: dict[type, Any], compared: Views) -> None:
        """Draw separations of CCDs, by the whiskers that are drawn already."""
        if WhiskersView in views:
            self.picture.show(self._view(scene, views[WhiskersView], bool(compared)))

    def draw(self, scene: Scene, views: dict[type, Any], compared: Views) -> None:
        """Draw all separations, by ten whiskers a CCD."""
        drawn = views.get(WhiskersView)
        fine = drawn if drawn is not None and self._per_ccd(drawn) == PER_CCD else self._whiskers(scene.state, PER_CCD)
        self.view = self._view(scene, fine, bool(compared))
        self.picture.show(self.view)

    def _per_ccd(self, whiskers: WhiskersView) -> int:
        return PER_CCD if len(whiskers.e1) == len(self._bench.stars(PER_CCD)[0]) else 1

    def _view(self, scene: Scene, now: WhiskersView, is_pinned: bool) -> CorrelationView:
        light = {name: getattr(scene.state, name) for name in ("wavelength_nm", "seeing_arcsec")}
        compared = self._pinned() if is_pinned else replace(self._bench.start, **light)
        per_ccd = self._per_ccd(now)
        reference, against = self._whiskers(compared, per_ccd), "A" if is_pinned else "the design"
        return correlation_view(self._bench.stars(per_ccd)[1], self._bins, now, reference, against)

    def _whiskers(self, state: DeskState, per_ccd: int) -> WhiskersView:
        """Return the whiskers of a state, computed once for each."""
        # They do not depend on the field of the star.
        state = replace(state, field_deg=(0.0, 0.0))
        view = next((w for s, n, w in self._kept if (s, n) == (state, per_ccd)), None)
        if view is None:
            view = whiskers_view(Scene.of(self._bench, state), per_ccd)
        self._kept = [kept for kept in self._kept if kept[2] is not view][1 - _KEPT :]
        self._kept.append((state, per_ccd, view))
        return view


class SensitivityPanel(Panel):
    """Derivatives of a metric by all degrees of freedom."""

    label = "Sensitivities"

    def __init__(self, redraw: Callable[[], None]) -> None:
        super().__init__()
        self.picture = SensitivityPicture()
        self.pictures = (self.picture,)
        self.metric = Select(title="Metric of the sensitivities", value=METRICS[0], options=list(METRICS))
        self.metric.on_change("value", lambda attribute, old, new: redraw())
        self.metric.sizing_mode = "stretch_width"
        self.widgets = (self.metric,)

    def draw(self, scene: Scene, views: dict[type, Any], compared: Views) -> None:
        """Draw the bars of the state."""
        views[SensitivityView] = sensitivity_view(scene, str(self.metric.value))
        self.picture.show(views[SensitivityView])


class SpacePanel(Panel):
    """Surfaces and rays in space."""

    label = "Three dimensions"

    def __init__(self, drawing: Callable[[], Layout]) -> None:
        super().__init__()
        self.picture = SpacePicture()
        self.pictures = (self.picture,)
        self._lines: tuple[Line, ...] = ()
        self.azimuth = Slider(title="View from azimuth [deg]", start=-180, end=180, step=5, value=30)
        self.elevation = Slider(title="View from elevation [deg]", start=-90, end=90, step=5, value=20)
        for slider in (self.azimuth, self.elevation):
            slider.sizing_mode = "stretch_width"
            slider.on_change("value", lambda attribute, old, new: self._show())
        self.widgets = (self.azimuth, self.elevation, solid_buttons(drawing))

    def draw(self, scene: Scene, views: dict[type, Any], compared: Views) -> None:
        """Draw the telescope of the state."""
        self._lines = space_view(layout_of(scene))
        self._show()

    def _show(self) -> None:
        self.picture.show(self._lines, float(self.azimuth.value), float(self.elevation.value))


class BesidePanel(Panel):
    """Spots, whiskers and OPD of the pinned state, beside those of the state and on their scales."""

    label = "A beside now"

    def __init__(self, bench: Bench, new_whiskers: Callable[[str, str], WhiskersPicture]) -> None:
        super().__init__()
        of = "A, pinned: "
        self.spots = SpotsPicture(np.rad2deg(bench.spot_fields), lambda index: None, "spots_a", of)
        self.whiskers, self.opd = new_whiskers("whiskers_a", of), OpdPicture("opd_a", of)
        self.pictures = (self.spots, self.whiskers, self.opd)

    def draw(self, scene: Scene, views: dict[type, Any], compared: Views) -> None:
        """Draw the pinned state, where there is one."""
        if SpotsView in compared:
            self.spots.show(compared[SpotsView], scene.state.field_deg, views.get(SpotsView))
        if OpdView in compared:
            self.opd.show(compared[OpdView], views.get(OpdView))
        if WhiskersView in compared:
            heights, now = compared.get(HeightsView), views.get(WhiskersView)
            self.whiskers.show(compared[WhiskersView], heights, None, now)


class OptimizePanel(Panel):
    """Optimise chosen variables, some steps at a time: each is a state that is drawn, so the page stays live."""

    label = "Optimisation"

    def __init__(
        self,
        bench: Bench,
        scene: Callable[[], Scene],
        change: Callable[[DeskState, str], None],
        defer: Callable[[Callable[[], None]], None],
        say: Callable[[PachonError | str], None],
    ) -> None:
        super().__init__()
        self._scene, self._change, self._defer, self._say = scene, change, defer, say
        self.picture = MeritPicture()
        self.pictures = (self.picture,)
        names = list(bench.freedoms.names)
        self.variables = MultiSelect(title="Variables", options=names, value=names[:1], size=_LISTED)
        self.variables.sizing_mode = "stretch_width"
        self.start_button, self.cancel_button = (Button(label=label, width=120) for label in ("Optimise", "Cancel"))
        self.start_button.on_click(lambda event: self.start())
        self.cancel_button.on_click(lambda event: self.cancel())
        self.widgets = (self.variables, row(self.start_button, self.cancel_button))
        self.merits: list[float] = []
        self.running = False

    def draw(self, scene: Scene, views: dict[type, Any], compared: Views) -> None:
        """Nothing: the curve is that of the last optimisation."""

    def start(self) -> None:
        """Begin; a second start while one runs does nothing."""
        if not self.running:
            self.running, self.merits = True, []
            self._say("")
            self._defer(self._step)

    def cancel(self) -> None:
        """End after the step that runs; the last state stays."""
        self.running = False

    def _step(self) -> None:
        if not self.running:
            self.picture.show(self.merits, "Optimisation: cancelled")
            return
        try:
            better = improved(self._scene(), list(self.variables.value))
        except PachonError as error:
            self.running = False
            self._say(error)
            return
        self.merits += [better.after_um] if self.merits else [better.before_um, better.after_um]
        settled = better.before_um - better.after_um < _SETTLED * better.before_um
        self.running = not settled and len(self.merits) <= _MOST_STEPS
        self._change(better.state, "optimisation")
        self.picture.show(self.merits, f"Optimisation: {'running' if self.running else 'ended'}")
        if self.running:
            self._defer(self._step)
