"""Pictures of a desk: Bokeh figures whose sources are updated in place."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from bokeh.models import (
    BasicTicker,
    ColorBar,
    ColumnDataSource,
    CrosshairTool,
    FixedTicker,
    HoverTool,
    LinearColorMapper,
    TapTool,
)
from bokeh.palettes import Cividis256, RdBu11, Viridis256, interp_palette
from bokeh.plotting import figure

from .views import HeightsView, ImagesView, OpdView, SectionView, SpotsView, WhiskersView

#: Okabe and Ito's colours, told apart by the colour-blind, of middle brightness: for dark and light pages.
BLUE, ORANGE, GREEN, GREY = "#2b8cd6", "#e08a1e", "#16a37a", "#8a8f98"
#: Colours of values about zero.
DIVERGING = interp_palette(list(RdBu11), 255)
#: Text, lines and background of pages, by theme.
THEMES = {
    "light": {"text": "#22262b", "line": "#c9ced6", "page": "#ffffff", "mirror": "#22262b"},
    "dark": {"text": "#d9dde3", "line": "#3d444d", "page": "#1b1f24", "mirror": "#e6e9ee"},
}
_HEIGHT = 330


class Picture:
    """A figure, and the state of a theme."""

    def __init__(
        self,
        name: str,
        title: str,
        x_label: str,
        y_label: str,
        *,
        square: bool = True,
        log_x: bool = False,
        log_y: bool = False,
    ) -> None:
        self.figure = figure(
            name=name,
            title=title,
            height=_HEIGHT,
            sizing_mode="stretch_width",
            tools="pan,wheel_zoom,box_zoom,reset,save",
            active_scroll=None,
            match_aspect=square,
            x_axis_type="log" if log_x else "linear",
            y_axis_type="log" if log_y else "linear",
            x_axis_label=x_label,
            y_axis_label=y_label,
            min_border=4,
            output_backend="canvas",
        )
        self.figure.toolbar.logo = None
        self.figure.xaxis.ticker.desired_num_ticks = 5
        self.figure.toolbar.autohide = True
        self.bars: list[ColorBar] = []
        self.mapper: LinearColorMapper
        self._palette: Any = None

    def add_bar(self, mapper: LinearColorMapper, title: str) -> ColorBar:
        """Add a colour bar with the name and unit of its values."""
        bar = ColorBar(color_mapper=mapper, title=title, ticker=BasicTicker(desired_num_ticks=5), width=12, padding=4)
        self.figure.add_layout(bar, "right")
        self.bars.append(bar)
        return bar

    def scale(self, palette: Any, low: float, high: float) -> None:
        """Set the colours of the mapper, and the values that they go between."""
        # Bokeh takes milliseconds to check the colours of a palette.
        if palette is not self._palette:
            self._palette = self.mapper.palette = palette
        self.mapper.update(low=low, high=high)

    def name_rows(self, places: Sequence[float], names: Iterable[str]) -> None:
        """Put names in the place of numbers at the axis of y."""
        axis = self.figure.yaxis[0]
        axis.ticker = FixedTicker(ticks=list(places))
        axis.major_label_overrides = dict(zip(places, names, strict=True))

    def paint(self, theme: str) -> None:
        """Colour all but the data by a theme."""
        colors = THEMES[theme]
        drawn = self.figure
        drawn.background_fill_color = drawn.border_fill_color = colors["page"]
        drawn.outline_line_color = colors["line"]
        drawn.title.text_color = colors["text"]
        drawn.title.text_font_size = "13px"
        for axis in drawn.axis:
            axis.axis_label_text_color = axis.major_label_text_color = colors["text"]
            axis.axis_line_color = axis.major_tick_line_color = axis.minor_tick_line_color = colors["line"]
            axis.axis_label_text_font_style = "normal"
            axis.axis_label_text_font_size = "12px"
        for grid in drawn.grid:
            grid.grid_line_color = colors["line"]
            grid.grid_line_alpha = 0.4
        for bar in self.bars:
            bar.background_fill_color = colors["page"]
            bar.title_text_color = bar.major_label_text_color = colors["text"]
            bar.title_text_font_style, bar.title_text_font_size = "normal", "11px"
            bar.major_tick_line_color = colors["text"]
        for legend in drawn.legend:
            legend.background_fill_color, legend.background_fill_alpha = colors["page"], 0.7
            legend.label_text_color, legend.border_line_color = colors["text"], None
            legend.label_text_font_size = "11px"
            legend.padding, legend.spacing, legend.margin = 3, 1, 4


class SectionPicture(Picture):
    """The layout in section."""

    def __init__(self) -> None:
        super().__init__("section", "Layout, section x = 0", "z [m]", "y [m]")
        self._lenses, self._surfaces, self._rays = (ColumnDataSource({"xs": [], "ys": []}) for _ in range(3))
        self.figure.multi_line("xs", "ys", source=self._rays, color="color", alpha=0.45, line_width=0.8)
        glass = self.figure.patches("xs", "ys", source=self._lenses, color=BLUE, alpha=0.35)
        self._lines = self.figure.multi_line("xs", "ys", source=self._surfaces, line_width="width")
        tips = [("", "@name"), ("", "@text")]
        self.figure.add_tools(HoverTool(renderers=[glass, self._lines], tooltips=tips, line_policy="interp"))

    def show(self, view: SectionView) -> None:
        """Draw a section."""
        for source, glass in ((self._lenses, True), (self._surfaces, False)):
            pieces = [piece for piece in view.pieces if piece.glass == glass]
            source.data = {
                "xs": [piece.z_m for piece in pieces],
                "ys": [piece.y_m for piece in pieces],
                "name": [piece.name for piece in pieces],
                "text": [piece.text for piece in pieces],
                "width": [0.8 if "refract" in piece.text else 2.4 for piece in pieces],
            }
        colors = [(GREY, ORANGE, GREEN)[i % 3] for i in view.ray_fields]
        self._rays.data = {"xs": [z for z, _ in view.rays], "ys": [y for _, y in view.rays], "color": colors}

    def paint(self, theme: str) -> None:
        """Colour all but the rays by a theme."""
        super().paint(theme)
        self._lines.glyph.line_color = THEMES[theme]["mirror"]


class SpotsPicture(Picture):
    """Spots over the field, magnified; a click chooses the field of the star."""

    def __init__(self, field_deg: np.ndarray, choose: Callable[[int], None], name: str = "spots", of: str = "") -> None:
        super().__init__(name, f"{of}Spots over the field", "field x [deg]", "field y [deg]")
        self._fields = field_deg
        distance = np.linalg.norm(field_deg[:, None] - field_deg, axis=-1)
        spacing = float(np.median(np.where(distance > 0, distance, np.inf).min(axis=1))) if len(field_deg) > 1 else 1.0
        self._spacing = spacing if math.isfinite(spacing) else 1.0
        self._rays = ColumnDataSource({"x": [], "y": []})
        self._marks = ColumnDataSource({"x": field_deg[:, 0], "y": field_deg[:, 1], "rms": np.zeros(len(field_deg))})
        self._star = ColumnDataSource({"x": [], "y": []})
        self._bar = ColumnDataSource({"x": [], "y": [], "text": []})
        self._bar_line = ColumnDataSource({"x": [], "y": []})
        marks = self.figure.scatter("x", "y", source=self._marks, size=26, alpha=0.0, nonselection_alpha=0.0)
        marks.selection_glyph = None
        self.figure.scatter("x", "y", source=self._rays, size=1.8, color=BLUE, alpha=0.75)
        star = {"size": 34, "fill_alpha": 0.0, "line_color": ORANGE, "line_width": 1.5}
        self.figure.scatter("x", "y", source=self._star, marker="square", **star)
        self.figure.line("x", "y", source=self._bar_line, line_width=3, color=ORANGE)
        self._label = self.figure.text("x", "y", "text", source=self._bar, text_font_size="11px", y_offset=-4)
        tips = [("field [deg]", "@x{0.000}, @y{0.000}"), ("rms radius", "@rms{0.00} @unit, @arcsec{0.000} arcsec")]
        self.figure.add_tools(HoverTool(renderers=[marks], tooltips=tips), TapTool(renderers=[marks]))

        def chosen(attribute: str, old: list[int], new: list[int]) -> None:
            if new:
                choose(new[0])
                self._marks.selected.indices = []

        self._marks.selected.on_change("indices", chosen)

    def show(self, view: SpotsView, star_deg: tuple[float, float], beside: SpotsView | None = None) -> None:
        """Draw spots, and a frame about the star; spots that stand beside them have the same scale."""
        away = np.hypot(view.x, view.y)
        distances = [away, *([] if beside is None else [np.hypot(beside.x, beside.y)])]
        bar = _round_up(max([1e-3, *(float(np.quantile(d, 0.98)) for d in distances if len(d))]))
        scale = 0.45 * self._spacing / bar
        field = view.field_deg[view.index]
        near = away < 2.2 * bar
        self._rays.data = {
            "x": np.float32(field[near, 0] + scale * view.x[near]),
            "y": np.float32(field[near, 1] + scale * view.y[near]),
        }
        marks = {"x": view.field_deg[:, 0], "y": view.field_deg[:, 1], "rms": view.rms_um, "arcsec": view.rms_arcsec}
        self._marks.data = {**marks, "unit": [view.unit] * len(view.rms_um)}
        self._star.data = {"x": [star_deg[0]], "y": [star_deg[1]]}
        x0, y0 = self._fields[:, 0].min() - 0.3 * self._spacing, self._fields[:, 1].min() - 0.75 * self._spacing
        self._bar_line.data = {"x": [x0, x0 + scale * bar], "y": [y0, y0]}
        self._bar.data = {"x": [x0], "y": [y0], "text": [f"{bar:.4g} {view.unit}"]}

    def paint(self, theme: str) -> None:
        """Colour all but the spots by a theme."""
        super().paint(theme)
        self._label.glyph.text_color = THEMES[theme]["text"]


class MapPicture(Picture):
    """A square map with a colour bar."""

    def __init__(self, name: str, title: str, axes: tuple[str, str], bar: str, palette: Any) -> None:
        super().__init__(name, title, *axes)
        self.mapper = LinearColorMapper(palette=palette, low=0.0, high=1.0, nan_color="rgba(0,0,0,0)")
        self.source = ColumnDataSource({"image": [np.zeros((2, 2))], "x": [0.0], "y": [0.0], "w": [1.0], "h": [1.0]})
        self.image = self.figure.image("image", "x", "y", "w", "h", source=self.source, color_mapper=self.mapper)
        self.bar = self.add_bar(self.mapper, bar)

    def show_map(self, image: np.ndarray, half: float, low: float, high: float) -> None:
        """Draw an image of a square about the origin, between two values."""
        self.mapper.update(low=low, high=high if high > low else low + 1.0)
        self.source.data = {"image": [np.float32(image)], "x": [-half], "y": [-half], "w": [2 * half], "h": [2 * half]}


class OpdPicture(MapPicture):
    """The OPD over the entrance pupil."""

    def __init__(self, name: str = "opd", of: str = "") -> None:
        self._title = f"{of}OPD at the star"
        super().__init__(name, self._title, ("pupil x [m]", "pupil y [m]"), "nm", DIVERGING)

    def show(self, view: OpdView, beside: OpdView | None = None) -> None:
        """Draw a map; blue is the sign of a longer path. One that stands beside it has the same scale."""
        maps = [v.opd_nm[np.isfinite(v.opd_nm)] for v in (view, beside) if v is not None]
        bound = max((float(np.quantile(np.abs(lit), 0.99)) for lit in maps if len(lit)), default=1.0)
        self.show_map(view.opd_nm, view.half_m, -bound, bound)
        self.figure.title.text = f"{self._title}, rms {view.rms_nm:.4g} nm"


class ZernikePicture(Picture):
    """Annular Zernikes of the star, beside those of the state that is compared to."""

    def __init__(self) -> None:
        super().__init__("zernikes", "Zernikes at the star", "Noll index", "coefficient [nm]", square=False)
        self.source = ColumnDataSource({"j": [], "c": [], "a": []})
        self.figure.vbar("j", 0.8, "c", source=self.source, color=BLUE, legend_label="now")
        mark = {"fill_alpha": 0.0, "line_color": ORANGE, "line_width": 1.8, "size": 9}
        self.figure.scatter("j", "a", source=self.source, marker="diamond", legend_label="A, pinned", **mark)
        self.figure.legend.items[1].visible = False
        self.figure.legend.orientation, self.figure.legend.location = "horizontal", "top_right"
        self.figure.xaxis.ticker = list(range(4, 23, 3))
        self.figure.add_tools(HoverTool(tooltips=[("Z", "@j"), ("now", "@c{0.0} nm"), ("A", "@a{0.0} nm")]))

    def show(self, view: OpdView, reference: OpdView | None) -> None:
        """Draw coefficients."""
        compared = np.full(len(view.noll), np.nan) if reference is None else reference.zernikes_nm
        self.source.data = {"j": view.noll, "c": view.zernikes_nm, "a": compared}
        self.figure.title.text = "Zernikes at the star" + " (lit part of the pupil)" * (view.pupil == "lit")
        self.figure.legend.items[1].visible = reference is not None


class ImagePicture(MapPicture):
    """An image of the star, over its peak on a square root scale."""

    def __init__(self, name: str, title: str) -> None:
        super().__init__(name, title, ("x [arcsec]", "y [arcsec]"), "sqrt(image / peak)", Viridis256)

    def show(self, image: np.ndarray, pixel_arcsec: float) -> None:
        """Draw an image."""
        peak = float(image.max())
        stretched = np.sqrt(np.maximum(image, 0.0) / peak) if peak > 0 else np.zeros_like(image)
        self.show_map(stretched, 0.5 * pixel_arcsec * image.shape[1], 0.0, 1.0)


class EnergyPicture(Picture):
    """Encircled energy of the star."""

    def __init__(self) -> None:
        super().__init__("energy", "Encircled energy at the star", "radius [arcsec]", "light within [%]", square=False)
        self._curves = {}
        lines = (
            ("optics alone", BLUE, "solid"),
            ("with the atmosphere", GREEN, "solid"),
            ("A, pinned", ORANGE, "dashed"),
        )
        for label, color, dash in lines:
            self._curves[label] = ColumnDataSource({"x": [], "y": []})
            style = {"color": color, "line_dash": dash, "line_width": 2, "legend_label": label}
            self.figure.line("x", "y", source=self._curves[label], **style)
        self.figure.legend.location = "bottom_right"
        self.figure.y_range.start, self.figure.y_range.end = 0, 104
        self.figure.add_tools(CrosshairTool(line_alpha=0.3))

    def show(self, view: ImagesView, reference: ImagesView | None) -> None:
        """Draw curves; A is that with the atmosphere, where there is one."""
        curves = {"optics alone": view.optics_energy, "with the atmosphere": view.seen_energy}
        for label, curve in curves.items():
            self._curves[label].data = _curve(view.radius_arcsec, curve)
        compared = None
        if reference is not None:
            compared = reference.optics_energy if reference.seen_energy is None else reference.seen_energy
        radius = view.radius_arcsec if reference is None else reference.radius_arcsec
        self._curves["A, pinned"].data = _curve(radius, compared)
        shown = (True, view.seen_energy is not None, compared is not None)
        for item, visible in zip(self.figure.legend.items, shown, strict=True):
            item.visible = visible


#: What may stand behind the whiskers.
BACKGROUNDS = ("heights of CCDs", "FWHM", "ellipticity")


class WhiskersPicture(Picture):
    """Whiskers over the focal plane, on a map of heights, FWHM or ellipticity."""

    def __init__(
        self,
        extent_mm: float,
        tile_mm: float,
        *,
        heights: bool,
        center_mm: tuple[float, float] = (0.0, 0.0),
        name: str = "whiskers",
        of: str = "",
    ) -> None:
        super().__init__(name, "Whiskers", "detector x [mm]", "detector y [mm]")
        self._extent, self._center, self._of = extent_mm, center_mm, of
        self._heights: HeightsView | None = None
        # Whiskers of many stars on one CCD lie beside their tiles too.
        self._on_tiles = tile_mm > 0.05 * extent_mm
        self.background = BACKGROUNDS[0] if heights else BACKGROUNDS[1]
        self.mapper = LinearColorMapper(palette=DIVERGING, low=-1.0, high=1.0, nan_color="rgba(0,0,0,0)")
        self._map = ColumnDataSource({"image": [np.zeros((2, 2))], "x": [0.0], "y": [0.0], "w": [1.0], "h": [1.0]})
        self._image = self.figure.image("image", "x", "y", "w", "h", source=self._map, color_mapper=self.mapper)
        self._tiles = ColumnDataSource({"x": [], "y": [], "v": [], "e": [], "fwhm": []})
        tile = {"width": tile_mm, "height": tile_mm, "source": self._tiles, "line_color": None}
        self._rects = self.figure.rect("x", "y", fill_color={"field": "v", "transform": self.mapper}, **tile)
        self._whiskers, self._compared, self._key = (
            ColumnDataSource({"x0": [], "y0": [], "x1": [], "y1": []}) for _ in range(3)
        )
        ends = ("x0", "y0", "x1", "y1")
        self.figure.segment(*ends, source=self._compared, color=ORANGE, line_width=2.5, alpha=0.8)
        self._lines = self.figure.segment(*ends, source=self._whiskers, line_width=1.6)
        key = self.figure.segment(*ends, source=self._key, color=ORANGE, line_width=3)
        for axis in (self.figure.x_range, self.figure.y_range):
            # The map of heights may cover more CCDs.
            axis.renderers = [self._rects, key]
        self._key_text = ColumnDataSource({"x": [], "y": [], "text": []})
        self._label = self.figure.text("x", "y", "text", source=self._key_text, text_font_size="11px", y_offset=-4)
        self._bar = self.add_bar(self.mapper, "um")
        tips = [("x, y [mm]", "@x{0.0}, @y{0.0}"), ("e", "@e{0.00} %"), ("FWHM", "@fwhm{0.000} arcsec")]
        self.figure.add_tools(HoverTool(renderers=[self._rects], tooltips=tips))

    def show(
        self,
        view: WhiskersView,
        heights: HeightsView | None,
        compared: WhiskersView | None,
        beside: WhiskersView | None = None,
    ) -> None:
        """Draw whiskers, those of the state that is compared to below them; ones beside them have the same scale."""
        shown = [shapes for shapes in (view, compared, beside) if shapes is not None]
        drawn = [shapes.e for shapes in shown if np.isfinite(shapes.e).any()]
        key = _round_up(max([2e-3, *(float(np.nanquantile(e, 0.9)) for e in drawn)]))
        length = 0.11 * self._extent / key
        for source, shapes in ((self._whiskers, view), (self._compared, compared)):
            ends = _NO_ENDS if shapes is None else dict(zip(_NO_ENDS, shapes.ends(length), strict=True))
            source.data = ends
        x0, y0 = self._center[0] - self._extent, self._center[1] - 1.3 * self._extent
        self._key.data = {"x0": [x0], "y0": [y0], "x1": [x0 + length * key], "y1": [y0]}
        self._key_text.data = {"x": [x0], "y": [y0], "text": [f"e = {100 * key:.3g} %"]}
        self.figure.title.text = self._of + view.method
        of_heights = self.background == BACKGROUNDS[0]
        mapped = [v.fwhm_arcsec if self.background == BACKGROUNDS[1] else 100.0 * v.e for v in shown]
        values = mapped[0]
        self._tiles.data = {
            "x": view.x_mm,
            "y": view.y_mm,
            "v": values,
            "e": 100.0 * view.e,
            "fwhm": view.fwhm_arcsec,
        }
        self._rects.glyph.fill_alpha = 0.0 if of_heights else 1.0
        self._image.visible = of_heights
        if of_heights and heights is not None:
            seen = np.abs(heights.height_um[np.isfinite(heights.height_um)])
            bound = max(float(np.quantile(seen, 0.99)) if len(seen) else 0.0, 1.0)
            self.scale(DIVERGING, -bound, bound)
            if heights is not self._heights:
                self._heights, half = heights, heights.half_mm
                image = np.float32(heights.height_um)
                self._map.data = {"image": [image], "x": [-half], "y": [-half], "w": [2 * half], "h": [2 * half]}
            self._bar.title = "height [um]"
        else:
            finite = np.concatenate(mapped if beside is not None else mapped[:1])
            finite = finite[np.isfinite(finite)]
            low, high = (float(v) for v in np.quantile(finite, [0.01, 0.99])) if len(finite) else (0.0, 1.0)
            self.scale(Cividis256, low, high if high > low else low + 1e-3)
            self._bar.title = "FWHM [arcsec]" if self.background == BACKGROUNDS[1] else "e [%]"

    def paint(self, theme: str) -> None:
        """Colour all but the data by a theme; whiskers stand out from the middle of the scale."""
        super().paint(theme)
        on_tiles = "#000000" if self.background == BACKGROUNDS[0] else "#ffffff"
        self._lines.glyph.line_color = on_tiles if self._on_tiles else THEMES[theme]["text"]
        self._label.glyph.text_color = THEMES[theme]["text"]


_NO_ENDS: dict[str, Any] = {"x0": [], "y0": [], "x1": [], "y1": []}


def _curve(radius: np.ndarray, fraction: np.ndarray | None) -> dict[str, Any]:
    return {"x": [], "y": []} if fraction is None else {"x": radius, "y": 100.0 * fraction}


def _round_up(value: float) -> float:
    """Return 1, 2 or 5 times a power of ten at or above a positive number."""
    power = 10.0 ** math.floor(math.log10(value))
    return next(m * power for m in (1.0, 2.0, 5.0, 10.0) if m * power >= value * (1 - 1e-9))
