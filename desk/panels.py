"""Panels of pictures that are computed only where they are wanted, each with widgets of its own."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from bokeh.layouts import row
from bokeh.models import Button, MultiSelect, Select, Slider

from ..core.errors import PachonError
from .bench import Bench
from .design_pictures import MeritPicture, MtfPicture, SensitivityPicture, SpacePicture
from .design_views import METRICS, Line, MtfView, SensitivityView, improved, mtf_view, sensitivity_view, space_view
from .pictures import OpdPicture, Picture, SpotsPicture, WhiskersPicture
from .state import DeskState
from .views import HeightsView, OpdView, Scene, SpotsView, WhiskersView, layout_of

#: Views by their class.
Views = Mapping[type, Any]
#: Relative fall of the merit at which an optimisation ends, and its pictures at most.
_SETTLED = 1e-5
_MOST_STEPS = 60
#: Variables that are listed at once.
_LISTED = 6


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

    def __init__(self) -> None:
        super().__init__()
        self.picture = SpacePicture()
        self.pictures = (self.picture,)
        self._lines: tuple[Line, ...] = ()
        self.azimuth = Slider(title="View from azimuth [deg]", start=-180, end=180, step=5, value=30)
        self.elevation = Slider(title="View from elevation [deg]", start=-90, end=90, step=5, value=20)
        self.widgets = (self.azimuth, self.elevation)
        for slider in self.widgets:
            slider.sizing_mode = "stretch_width"
            slider.on_change("value", lambda attribute, old, new: self._show())

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
