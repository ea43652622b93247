"""Pictures of a design: modulation transfer, xi+, sensitivities, the course of an optimisation, three dimensions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from bokeh.core.properties import value
from bokeh.models import (
    ColumnDataSource,
    CrosshairTool,
    CustomJSTickFormatter,
    FixedTicker,
    HoverTool,
    Span,
)

from .design_views import CorrelationView, Line, MtfView, SensitivityView, projected
from .pictures import BLUE, GREEN, GREY, ORANGE, THEMES, Picture

#: Bars of sensitivities at most.
_MOST_BARS = 16


class MtfPicture(Picture):
    """Modulation transfer of the star."""

    def __init__(self) -> None:
        axes = ("spatial frequency [cycles/mm]", "contrast")
        super().__init__("mtf", "MTF at the star, optics alone", *axes, square=False)
        self.source = ColumnDataSource({"f": [], "t": [], "s": [], "limit": []})
        self._compared = ColumnDataSource({"f": [], "t": []})
        for column, label, color, dash in (
            ("t", "tangential", BLUE, "solid"),
            ("s", "sagittal", GREEN, "dashed"),
            ("limit", "perfect wavefront", GREY, "dotted"),
        ):
            style = {"color": color, "line_dash": dash, "line_width": 2, "legend_label": label}
            self.figure.line("f", column, source=self.source, **style)
        style = {"color": ORANGE, "line_dash": "dashed", "line_width": 2, "legend_label": "A, tangential"}
        self.figure.line("f", "t", source=self._compared, **style)
        self.figure.legend.location = "top_right"
        self.figure.y_range.start, self.figure.y_range.end = 0.0, 1.02
        self.figure.add_tools(CrosshairTool(line_alpha=0.3))

    def show(self, view: MtfView, reference: MtfView | None) -> None:
        """Draw curves, and the tangential one of the state that is compared to."""
        curves = {"t": view.tangential, "s": view.sagittal, "limit": view.limit}
        self.source.data = {"f": view.frequency, **curves}
        none = np.empty(0)
        self._compared.data = {
            "f": none if reference is None else reference.frequency,
            "t": none if reference is None else reference.tangential,
        }
        self.figure.legend.items[-1].visible = reference is not None


class WhiskerCorrelationPicture(Picture):
    """xi+ of the whiskers, of those of the state that is compared to, and of the change between both."""

    def __init__(self) -> None:
        axes = ("separation [arcmin]", "|xi+| of e, hollow where negative")
        super().__init__("xi", "Correlation", *axes, square=False, log_x=True, log_y=True)
        self.sources: dict[str, ColumnDataSource] = {}
        for name, color, dash, marker in (
            ("reference", ORANGE, "dashed", "diamond"),
            ("change", GREEN, "dotted", "square"),
            ("xi_plus", BLUE, "solid", "circle"),
        ):
            self.sources[name] = ColumnDataSource({"r": [], "size": [], "xi": [], "alpha": []})
            style = {"source": self.sources[name], "legend_label": name}
            self.figure.line("r", "size", color=color, line_dash=dash, line_width=1.5, **style)
            marks = {"line_color": color, "fill_color": color, "fill_alpha": "alpha", "size": 8, "line_width": 1.5}
            self.figure.scatter("r", "size", marker=marker, **marks, **style)
        self.figure.legend.location = "bottom_left"
        self.figure.xaxis.ticker = FixedTicker(
            ticks=[float(f"{first}e{power}") for power in range(-2, 5) for first in (1, 2, 5)]
        )
        self.figure.yaxis.formatter = CustomJSTickFormatter(code="return tick.toExponential(0)")
        scatters = [renderer for renderer in self.figure.renderers if "fill_alpha" in renderer.glyph.properties()]
        tips = [("separation", "@r{0.0} arcmin"), ("xi+", "@xi")]
        self.figure.add_tools(HoverTool(renderers=scatters, tooltips=tips))

    def show(self, view: CorrelationView) -> None:
        """Draw the curves; bins without pairs are left out."""
        for name, source in self.sources.items():
            xi = getattr(view, name)
            # A state beside itself has no change, and a logarithm none of zero.
            drawn = np.isfinite(xi) & (xi != 0.0)
            xi = xi[drawn]
            alpha = np.where(xi > 0, 0.9, 0.0)
            source.data = {
                "r": view.r_arcmin[drawn],
                "size": np.abs(xi),
                "xi": [f"{v:.3g}" for v in xi],
                "alpha": alpha,
            }
        labels = (view.against, f"change from {view.against}", "now")
        for item, label in zip(self.figure.legend.items, labels, strict=True):
            item.label = value(label)
        self.figure.title.text = f"Correlation of {view.count} whiskers"


class SensitivityPicture(Picture):
    """Changes of a metric by a step of each slider, the largest at the top."""

    def __init__(self) -> None:
        super().__init__("sensitivity", "Sensitivities", "", "", square=False)
        self.source = ColumnDataSource({"row": [], "effect": [], "name": [], "derivative": [], "color": []})
        bars = self.figure.hbar("row", 0.7, "effect", source=self.source, color="color", alpha=0.85)
        self.figure.add_layout(Span(location=0.0, dimension="height", line_color=GREY))
        tips = [("", "@name"), ("by a step of the slider", "@effect{0.0000}"), ("derivative", "@derivative")]
        self.figure.add_tools(HoverTool(renderers=[bars], tooltips=tips))

    def show(self, view: SensitivityView) -> None:
        """Draw the largest bars."""
        order = np.argsort(np.abs(view.effect), kind="stable")[-_MOST_BARS:]
        rows, effect = list(range(len(order))), view.effect[order]
        names = [view.names[i] for i in order]
        self.source.data = {
            "row": rows,
            "effect": effect,
            "name": names,
            "derivative": [f"{view.derivative[i]:.6g} {view.unit} / {view.units[i]}" for i in order],
            "color": [BLUE if value >= 0 else ORANGE for value in effect],
        }
        self.name_rows(rows, names)
        self.figure.xaxis.axis_label = f"change by a step of the slider [{view.unit}]"
        self.figure.title.text = f"{view.metric}: {view.value:.4g} {view.unit}"


class MeritPicture(Picture):
    """The merit of an optimisation, step by step."""

    def __init__(self) -> None:
        super().__init__("merit", "Optimisation", "picture", "rms spot radius over the field [um]", square=False)
        self.source = ColumnDataSource({"x": [], "y": []})
        self.figure.line("x", "y", source=self.source, color=BLUE, line_width=2)
        self.figure.scatter("x", "y", source=self.source, color=BLUE, size=6)
        self.figure.add_tools(HoverTool(tooltips=[("merit", "@y{0.0000} um")]))

    def show(self, merits_um: Sequence[float], title: str) -> None:
        """Draw the merits of all pictures."""
        self.source.data = {"x": list(range(len(merits_um))), "y": list(merits_um)}
        self.figure.title.text = title


class SpacePicture(Picture):
    """Surfaces and rays in space, from a direction."""

    def __init__(self) -> None:
        super().__init__("space", "Three dimensions", "across [m]", "up [m]")
        self._rays, self._surfaces = (ColumnDataSource({"xs": [], "ys": []}) for _ in range(2))
        self.figure.multi_line("xs", "ys", source=self._rays, color=ORANGE, alpha=0.4, line_width=0.8)
        glasses = {"field": "color"}
        self._lines = self.figure.multi_line("xs", "ys", source=self._surfaces, line_color=glasses, line_width="width")
        tips = [("", "@name"), ("", "@kind")]
        self.figure.add_tools(HoverTool(renderers=[self._lines], tooltips=tips, line_policy="interp"))
        self._drawn: tuple[Sequence[Line], float, float] = ((), 0.0, 0.0)
        self._mirror = THEMES["light"]["mirror"]

    def show(self, lines: Sequence[Line], azimuth_deg: float, elevation_deg: float) -> None:
        """Draw lines as seen from a direction."""
        self._drawn = lines, azimuth_deg, elevation_deg
        angles = math.radians(azimuth_deg), math.radians(elevation_deg)
        for source, rays in ((self._rays, True), (self._surfaces, False)):
            kept = [line for line in lines if (line.kind == "ray") == rays]
            ends = [projected(line.points, *angles) for line in kept]
            data: dict[str, list[Any]] = {
                "xs": [np.float32(p[:, 0]) for p in ends],
                "ys": [np.float32(p[:, 1]) for p in ends],
            }
            if not rays:
                colors = {"refract": BLUE, "detector": GREEN, "pass": GREY}
                data |= {"name": [line.name for line in kept], "kind": [line.kind for line in kept]}
                data["color"] = [colors.get(line.kind, self._mirror) for line in kept]
                data["width"] = [1.4 if line.kind in ("mirror", "detector") else 0.8 for line in kept]
            source.data = data
        self.figure.title.text = f"Three dimensions, from azimuth {azimuth_deg:.0f}, elevation {elevation_deg:.0f} deg"

    def paint(self, theme: str) -> None:
        """Colour all by a theme."""
        super().paint(theme)
        self._mirror = THEMES[theme]["mirror"]
        self.show(*self._drawn)
