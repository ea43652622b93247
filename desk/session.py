"""A session of a desk: one history of states, its widgets, and the pictures that follow them."""

from __future__ import annotations

import base64
import binascii
from collections.abc import Callable, Sequence
from time import monotonic
from typing import Any

import numpy as np
from bokeh.document import Document
from bokeh.layouts import column, row
from bokeh.models import (
    Button,
    CheckboxGroup,
    CustomJS,
    Div,
    FileInput,
    Select,
    Slider,
    Spinner,
    TextAreaInput,
)

from ..core.errors import PachonError
from .bench import Bench, Control
from .design_views import PER_CCD
from .page_session import PageSession
from .panels import BesidePanel, CorrelationPanel, MtfPanel, OptimizePanel, Panel, SensitivityPanel, SpacePanel
from .pictures import (
    BACKGROUNDS,
    EnergyPicture,
    ImagePicture,
    OpdPicture,
    SectionPicture,
    SpotsPicture,
    WhiskersPicture,
    ZernikePicture,
)
from .python_text import python_text
from .state import DeskState, History
from .views import (
    HeightsView,
    ImagesView,
    OpdView,
    Scene,
    SpotsView,
    WhiskersView,
    heights_view,
    images_view,
    layout_of,
    numbers,
    opd_view,
    section_view,
    spots_view,
    whiskers_view,
)
from .widgets import colour, number_boxes, status_text

#: Range of the lift of one CCD or raft [um].
_LIFT = 50.0
#: Time for further changes to arrive before all are drawn at once [ms].
_PAUSE = 15
#: Longest time between two changes of one drag, that of drawing left out [s].
_DRAG = 2.0
#: Largest file of a state that is read [bytes].
_MOST_BYTES = 10**6
_LIFTS = "Heights of CCDs"
#: Downloads the text of a hidden field under a name.
_DOWNLOAD = """
const link = document.createElement('a');
link.href = URL.createObjectURL(new Blob([text.value], {type: 'text/plain'}));
link.download = name;
link.click();
URL.revokeObjectURL(link.href);
"""


class Session(PageSession):
    """The desk of one page in a browser; two pages share nothing but the bench."""

    def __init__(self, bench: Bench, state: DeskState | None = None, document: Document | None = None) -> None:
        super().__init__(f"{bench.nominal.name}: desk", bench.nominal.description, document)
        self.bench = bench
        self.history = History(bench.check(state or bench.start))
        self._last_scene = Scene.of(bench, self.history.state)
        self._drawn: DeskState | None = None
        self.views: dict[type, Any] = {}
        self.compared: dict[type, Any] = {}
        self.redraws = 0
        self._waiting = self._syncing = False
        self._changed = 0.0
        self._changed_geometry = self._changed_heights = True
        self._sliders: dict[str, tuple[Slider, Spinner, float, float]] = {}
        self._groups: dict[str, Any] = {}
        self._lifted = next(iter(self.bench.lifted_names), "")
        self._make_pictures()
        self._make_widgets()
        self.paint("light")
        self.redraw_fast()
        self.redraw_slow()

    # Pictures

    def _make_pictures(self) -> None:
        places, _ = self.bench.stars()
        extent = 1e3 * float(np.abs(places).max())
        camera = self.bench.camera
        tile = 2e3 * float(camera.half_sizes.min()) if camera is not None else 0.2 * extent
        if camera is not None and len(places) > len(camera):
            tile /= np.sqrt(len(places) / len(camera))
        self.spots = SpotsPicture(np.rad2deg(self.bench.spot_fields), self._choose_field)
        self.opd, self.zernikes, self.energy = OpdPicture(), ZernikePicture(), EnergyPicture()

        def new_whiskers(name: str, of: str) -> WhiskersPicture:
            return WhiskersPicture(extent, tile, heights=camera is not None, name=name, of=of)

        self.optics = ImagePicture("optics", "Rays of the star, optics alone")
        self.seen = ImagePicture("seen", "Image of the star, with the atmosphere")
        self.whiskers = new_whiskers("whiskers", "")
        self.section = SectionPicture()
        self.beside = BesidePanel(self.bench, new_whiskers)
        self.optimization = OptimizePanel(self.bench, lambda: self.scene, self.change, self._defer, self._say)
        sensitivity = SensitivityPanel(lambda: self._draw_panel(sensitivity))
        space = SpacePanel(lambda: layout_of(self.scene))
        panels: list[Panel] = [self.beside, MtfPanel(), sensitivity, self.optimization, space]
        if camera is not None:
            panels.insert(1, CorrelationPanel(self.bench, lambda: self.history.reference))
        self.panels = tuple(panels)
        now = (self.spots, self.whiskers, self.opd)
        # Each picture of the pinned state stands beside that of the state.
        pairs = [picture for pair in zip(now, self.beside.pictures, strict=True) for picture in pair]
        others = [picture for panel in self.panels[1:] for picture in panel.pictures]
        self.pictures = (*pairs, self.zernikes, self.optics, self.energy, self.section, *others, self.seen)

    def _choose_field(self, index: int) -> None:
        x, y = np.rad2deg(self.bench.spot_fields[index])
        state = self.history.state.with_value("field_deg.x", round(float(x), 6))
        self.change(state.with_value("field_deg.y", round(float(y), 6)))

    # Widgets

    def _make_widgets(self) -> None:
        groups = list(dict.fromkeys(control.group for control in self.bench.controls))
        self.group = Select(title="Controls", value=groups[0], options=groups, sizing_mode="stretch_width")
        self.group.on_change("value", lambda attribute, old, new: self._show_group(new))
        self.sliders = column(sizing_mode="stretch_width")
        self._show_group(groups[0])
        backgrounds = list(BACKGROUNDS if self.bench.camera is not None else BACKGROUNDS[1:])
        self.background = Select(title="Behind the whiskers", value=backgrounds[0], options=backgrounds)
        self.background.sizing_mode = "stretch_width"
        self.background.on_change("value", lambda attribute, old, new: self._set_background(new))
        stars = "CCD" if self.bench.camera is not None else "place"
        self.density = Select(
            title="Whiskers",
            value="1",
            options=[("1", f"1 a {stars}"), (str(PER_CCD), f"{PER_CCD} a {stars}, after a moment")],
        )
        self.density.sizing_mode = "stretch_width"
        self.density.on_change("value", lambda attribute, old, new: self.schedule())
        self.state_text = TextAreaInput(value="", visible=False)
        self.python = TextAreaInput(value="", visible=False)
        load = FileInput(accept=".yaml,.yml", title="Load a state (.yaml)", sizing_mode="stretch_width")
        load.on_change("value", lambda attribute, old, new: self._load(new))
        buttons = [
            row(_button("Undo", self.undo), _button("Redo", self.redo), _button("Reset", self.reset)),
            row(_button("Pin as A", self.pin), _button("Back to A", self.back_to_pinned), self.theme_toggle),
        ]
        if self.bench.is_lsst:
            hide = _button("Misalign M2, hidden", self.misalign, 150)
            buttons.append(row(hide, _button("Reveal", self.reveal)))
        saved = _download("Save state", self.state_text, "desk.yaml")
        save = row(saved, _download("As Python", self.python, "desk.py"))
        self.more = CheckboxGroup(labels=[panel.label for panel in self.panels], active=[])
        self.more.on_change("active", lambda attribute, old, new: self.show_panels(new))
        wanted = [widget for panel in self.panels for widget in panel.widgets]
        for panel in self.panels:
            panel.set_shown(False)
        more = [Div(text="More pictures"), self.more, *wanted]
        parts = [self.group, self.sliders, *buttons, *more, self.background, self.density, save, load]
        self.sidebar = column(*parts, self.state_text, self.python, name="sidebar", sizing_mode="stretch_width")

    def _show_group(self, group: str) -> None:
        if group not in self._groups:
            rows = [self._row(control) for control in self.bench.controls if control.group == group]
            if group == _LIFTS:
                rows += self._lift_rows()
            for part in rows:
                colour(part)
            self._groups[group] = rows
        self._sync()
        self.sliders.children = self._groups[group]

    def _row(self, control: Control) -> Any:
        low, high = control.low, control.high
        label = f"{control.label} [{control.unit}]"
        format_text = "0[.]0000" if control.step < 0.01 else "0[.]00"
        value = self.history.state.value(self._key(control.key))
        shown = {"sizing_mode": "stretch_width", "min_width": 120, "format": format_text, "margin": (2, 5, 0, 5)}
        slider = Slider(title=label, start=low, end=high, step=control.step, value=value, **shown)
        number = Spinner(title="", value=value, step=control.step, width=88, margin=(14, 5, 0, 5), name=control.key)
        self._sliders[control.key] = slider, number, low, high
        slider.on_change("value", lambda attribute, old, new: self.set_value(control.key, new))
        number.on_change("value", lambda attribute, old, new: self.set_value(control.key, new, drag=False))
        return row(slider, number, sizing_mode="stretch_width")

    def _lift_rows(self) -> list[Any]:
        names = list(self.bench.lifted_names)
        select = Select(title="Raft or CCD to lift", value=self._lifted, options=names, sizing_mode="stretch_width")
        lift = self._row(Control("lifts", "Its lift", "um", _LIFTS, -_LIFT, _LIFT, 0.5))

        def choose(attribute: str, old: str, new: str) -> None:
            self._lifted = new
            self._sync()

        select.on_change("value", choose)
        return [select, lift]

    def _key(self, key: str) -> str:
        return f"lifts.{self._lifted}" if key == "lifts" else key

    def _sync(self, *, fit: bool = False) -> None:
        """Set all widgets to the numbers of the state; ranges grow to hold them, and shrink again where they fit."""
        self._syncing = True
        try:
            for key, (slider, number, low, high) in self._sliders.items():
                value = self.history.state.value(self._key(key))
                start, end = (low, high) if fit else (slider.start, slider.end)
                slider.update(start=min(start, value), end=max(end, value))
                for widget in (slider, number):
                    if widget.value != value:
                        widget.value = value
        finally:
            self._syncing = False

    # Changes

    def set_value(self, key: str, value: float | None, *, drag: bool = True) -> None:
        """Set the number of a control; all of a drag are one step to undo."""
        if self._syncing or value is None:
            return
        if not drag or monotonic() - self._changed > _DRAG:
            self.history.settle()
        self._changed = monotonic()
        key = self._key(key)
        try:
            state = self.history.state.with_value(key, value)
        except PachonError as error:
            self._say(error)
            self._sync()
            return
        self.change(state, key)
        if not drag:
            self.history.settle()

    def change(self, state: DeskState, control: str = "") -> None:
        """Go to a state and draw it; one that is impossible is one line, and the last good one stays."""
        try:
            scene = Scene.of(self.bench, state)
        except PachonError as error:
            self._say(error)
        else:
            self._say("")
            before = self.history.state
            self.history.push(state, control)
            self._last_scene = scene
            self._follow(before)
        self._sync(fit=not control)

    def _follow(self, before: DeskState) -> None:
        state = self.history.state
        self._changed_geometry |= before.total_optics != state.total_optics
        heights = (before.heights, before.lifts, before.seed) != (state.heights, state.lifts, state.seed)
        self._changed_heights |= heights
        self.schedule()

    def undo(self) -> None:
        """Undo the last change."""
        self._jump(self.history.undo)

    def redo(self) -> None:
        """Redo what was undone."""
        self._jump(self.history.redo)

    def reset(self) -> None:
        """Go to the state at the beginning."""
        self.change(self.history.start)

    def pin(self) -> None:
        """Keep the state as A, that others are compared to."""
        self.history.reference = self.history.state
        self.compared = dict(self.views)
        self.schedule()

    def back_to_pinned(self) -> None:
        """Go to the state that was kept as A."""
        self.change(self.history.reference)

    def misalign(self) -> None:
        """Add a misalignment of M2 that the sliders do not show."""
        self.change(self.history.state.misaligned(int(np.random.default_rng().integers(2**31))))

    def reveal(self) -> None:
        """Say what is hidden, and what the sliders leave of it."""
        hidden, total = self.history.state.hidden, self.history.state.total_optics
        units = dict(zip(self.bench.freedoms.names, self.bench.freedoms.units, strict=True))
        rows = [f"{name}: {value:+.4g} {units[name]}, now {total[name]:+.4g}" for name, value in hidden.items()]
        self._say("; ".join(rows) or "nothing is hidden", error=False)

    def _jump(self, go: Callable[[], DeskState]) -> None:
        before = self.history.state
        go()
        self._say("")
        self._follow(before)
        self._sync(fit=True)

    def _load(self, content: str) -> None:
        try:
            text = base64.b64decode(content, validate=True)[: _MOST_BYTES + 1].decode("utf-8")
            state = DeskState.from_yaml(text[:_MOST_BYTES], "the file")
        except (binascii.Error, UnicodeDecodeError):
            self._say("the file: expected text in UTF-8, as the desk saves it")
        except PachonError as error:
            self._say(error)
        else:
            self.change(state)

    def show_panels(self, active: Sequence[int]) -> None:
        """Show the pictures of some panels, and hide those of the others."""
        for number, panel in enumerate(self.panels):
            panel.set_shown(number in active)
        if self.beside.shown and not self.compared:
            self.pin()
        self.schedule()

    def _draw_panel(self, panel: Panel, *, fast: bool = False) -> None:
        if panel.shown:
            try:
                (panel.draw_fast if fast else panel.draw)(self.scene, self.views, self.compared)
            except PachonError as error:
                self._say(error)

    def _defer(self, action: Callable[[], None]) -> None:
        """Run an action when the page has drawn what it waits for; at once where there is no page."""
        if self.document is None or self.document.session_context is None:
            action()
        else:
            self.document.add_timeout_callback(action, _PAUSE)

    def _set_background(self, name: str) -> None:
        for picture in (self.whiskers, self.beside.whiskers):
            picture.background = name
            picture.paint(self.theme)
        self._show_whiskers()
        self._draw_panel(self.beside)

    @property
    def state_words(self) -> str:
        """The state as a file of it has it."""
        return self.history.state.to_yaml()

    @property
    def scene(self) -> Scene:
        """The scene of the state, made once for each."""
        if self._last_scene.state != self.history.state:
            self._last_scene = Scene.of(self.bench, self.history.state)
        return self._last_scene

    # Drawing

    def schedule(self) -> None:
        """Draw once, soon, however many changes come before; at once where there is no document."""
        if self.document is None or self.document.session_context is None:
            self.redraw_fast()
            self.redraw_slow()
        elif not self._waiting:
            self._waiting = True
            self.document.add_timeout_callback(self._draw_scheduled, _PAUSE)

    def _draw_scheduled(self) -> None:
        self._waiting = False
        self.redraw_fast()
        self._changed = monotonic()
        if self.document is not None:
            self.document.add_timeout_callback(self._draw_rest, _PAUSE)

    def _draw_rest(self) -> None:
        # A change that has come in between is drawn first.
        if not self._waiting:
            self.redraw_slow()
            self._changed = monotonic()

    def redraw_fast(self) -> None:
        """Draw spots, wavefront and coarse whiskers, which follow a slider."""
        scene = self.scene
        try:
            self.views[SpotsView] = spots_view(scene)
        except PachonError as error:
            # The last state that was drawn comes back, as its pictures are there.
            if self._drawn is not None:
                self.history.refuse(self._drawn)
            self._say(error)
            self._sync(fit=True)
            return
        self._drawn = scene.state
        self._update(OpdView, lambda: opd_view(scene))
        if self._changed_heights and self.bench.camera is not None:
            self._update(HeightsView, lambda: heights_view(scene.focal_plane or self.bench.flat))
            self._changed_heights = False
        self._update(WhiskersView, lambda: whiskers_view(scene))
        if SpotsView in self.views:
            self.spots.show(self.views[SpotsView], scene.state.field_deg, self._beside(SpotsView))
        if OpdView in self.views:
            self.opd.show(self.views[OpdView], self._beside(OpdView))
            self.zernikes.show(self.views[OpdView], self.compared.get(OpdView))
        self._show_whiskers()
        for panel in self.panels:
            self._draw_panel(panel, fast=True)
        self._show_numbers()
        self.redraws += 1

    def redraw_slow(self) -> None:
        """Draw images, encircled energy, the section and fine whiskers."""
        scene = self.scene
        self._update(ImagesView, lambda: images_view(scene))
        if ImagesView in self.views:
            view = self.views[ImagesView]
            self.optics.show(view.optics, view.optics_arcsec)
            if view.seen is not None:
                self.seen.show(view.seen, view.seen_arcsec)
            self.seen.figure.visible = view.seen is not None
            self.energy.show(view, self.compared.get(ImagesView))
        if self._changed_geometry:
            try:
                self.section.show(section_view(scene, layout_of(scene)))
            except PachonError as error:
                self._say(error)
            self._changed_geometry = False
        if self.density.value != "1":
            self._update(WhiskersView, lambda: whiskers_view(scene, int(self.density.value)))
            self._show_whiskers()
        for panel in self.panels:
            self._draw_panel(panel)
        self._show_numbers()
        self.state_text.value = self.history.state.to_yaml()
        self.python.value = python_text(self.bench, self.history.state)

    def _update(self, kind: type, make: Callable[[], Any]) -> None:
        """Keep a view; where it cannot be made, the last good one stays and one line says why."""
        try:
            self.views[kind] = make()
        except PachonError as error:
            self._say(error)

    def _show_whiskers(self) -> None:
        if WhiskersView in self.views:
            view, compared = self.views[WhiskersView], self.compared.get(WhiskersView)
            over = None if self.beside.shown else compared
            self.whiskers.show(view, self.views.get(HeightsView), over, self._beside(WhiskersView))

    def _beside(self, kind: type) -> Any:
        """Return the view of the pinned state that stands beside that of the state, None where none does."""
        return self.compared.get(kind) if self.beside.shown else None

    def _show_numbers(self) -> None:
        now, then = (numbers(*(v.get(k) for k in _NUMBERED)) for v in (self.views, self.compared))
        for panel in self.panels:
            now |= panel.numbers if panel.shown else {}
        self.table.text = number_boxes(now, then)

    def _say(self, message: PachonError | str, *, error: bool = True) -> None:
        status_text(self.status, message, error=error)


_NUMBERED = (SpotsView, OpdView, WhiskersView, ImagesView)


def _button(label: str, action: Callable[[], None], width: int = 84) -> Button:
    button = Button(label=label, width=width)
    button.on_click(lambda event: action())
    return button


def _download(label: str, text: TextAreaInput, name: str) -> Button:
    button = Button(label=label, width=110)
    button.js_on_click(CustomJS(args={"text": text, "name": name}, code=_DOWNLOAD))
    return button
