"""Layout of a telescope: sections of its surfaces, cut to their apertures, and rays of some fields."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.number_text import counted
from ...core.plotting import BLUE, GREY, ORANGE, PURPLE, RED, figure_at, plain_text, styled
from ...core.result import Result
from ...models.surface import Interaction, Surface
from ...models.telescope import Telescope
from ...raytrace.rays import Projection
from ...wavefront.request import Request
from ..drawing import field_text, legend_below
from .sections import Lens, drawn_radii, even_edges, find_lenses, ray_paths, stop_rims, surface_section

if TYPE_CHECKING:
    import trimesh
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Rays of a field on either side of the axis.
_FAN = 5
#: Rays of a field around the pupil.
_SPOKES = 12
#: Length of the rays above the telescope, over its height.
_ABOVE = 0.08
#: Colours of the rays, field by field.
_RAYS = (BLUE, GREY, RED, ORANGE, PURPLE, "#2a9d6f")
#: Colours of the surfaces.
_GLASS = "#bfe3f2"
_GLASS_RIM = "#3f7d99"
_MIRROR = "#1a1a1a"
_DETECTOR = "#0b6b3a"
_BAFFLE = "#6b4a2b"
_STOP = "#000000"
#: Length of the bars beside the stop, over its diameter.
_STOP_BAR = 0.1
#: Lenses and detector have a panel of their own below this fraction of the whole size.
_SMALL = 0.4
#: Letters of a name that there is room for above a drawing.
_SHORT_NAME = 14
#: Height of a picture for each more [inch].
_NAME_HEIGHT = 0.06


@dataclass(frozen=True)
class Layout(Result):
    """Sections and rays of a telescope.

    Attributes
    ----------
    telescope : Telescope
        The telescope.
    fields : ndarray, shape [n_field, 2]
        Field angles [rad].
    wavelength : float
        Vacuum wavelength [m].
    reach : dict of str to float
        Radius to which each surface is drawn [m].
    profiles : dict of str to ndarray, shape [n, 3]
        Section x = 0 of each surface [m], telescope frame; NaN breaks the line. Of baffles, the blocking part.
    lenses : tuple of Lens
        Pieces of glass.
    fans : tuple of ndarray, shape [n_ray, n_point, 3]
        Arriving rays of each field through the line x = 0 of the pupil, from above the telescope on [m].
    bundles : tuple of ndarray, shape [n_ray, n_point, 3]
        Arriving rays of each field all around the pupil [m].
    stop : ndarray, shape [2, 3], optional
        The rim of the stop in the section x = 0 [m], telescope frame; None where no surface is stated to be it.
    """

    _row_type = Surface

    telescope: Telescope
    fields: np.ndarray
    wavelength: float
    reach: dict[str, float]
    profiles: dict[str, np.ndarray]
    lenses: tuple[Lens, ...]
    fans: tuple[np.ndarray, ...]
    bundles: tuple[np.ndarray, ...]
    stop: np.ndarray | None = None

    @property
    def dark(self) -> list[int]:
        """Indices of the fields of which no ray arrives, so that none is drawn."""
        return [i for i, rays in enumerate(zip(self.fans, self.bundles, strict=True)) if not any(map(len, rays))]

    @property
    def size(self) -> np.ndarray:
        """Extent of the surfaces along x, y and z [m], shape [3]; the first is that of y."""
        points = np.concatenate([p[np.isfinite(p).all(axis=1)] for p in self.profiles.values()])
        width, height = (float(v) for v in np.ptp(points[:, 1:], axis=0))
        return np.array([width, width, height])

    def _label(self) -> str:
        return f"{self.telescope.name}, {counted(len(self.profiles), 'surface')}, {counted(len(self.fields), 'field')}"

    def _columns(self) -> dict[str, Any]:
        surfaces = self.telescope.surfaces
        names = [s.name for s in surfaces]
        return {"name": names, "vertex": [s.vertex for s in surfaces], "reach": [self.reach[name] for name in names]}

    def _summary(self) -> dict[str, Any]:
        """Return the results by name and unit; lists run over the surfaces."""
        surfaces = self.telescope.surfaces
        return {
            "telescope": self.telescope.name,
            "wavelength_nm": self.wavelength * 1e9,
            "field_deg": np.rad2deg(self.fields),
            "extent_m": self.size,
            "surface": [s.name for s in surfaces],
            "interaction": [s.interaction.name.lower() for s in surfaces],
            "vertex_m": np.array([s.vertex for s in surfaces]),
            "drawn_radius_m": np.array([self.reach[s.name] for s in surfaces]),
            "lens": [lens.name for lens in self.lenses],
            "lens_index": np.array([lens.index for lens in self.lenses]),
            "obstruction": [o.name for o in self.telescope.obstructions],
            "rays_drawn": [len(fan) for fan in self.fans],
            "fields_without_rays_deg": [np.rad2deg(self.fields[i]) for i in self.dark],
        }

    def plot(self, ax: Axes | Figure | None = None) -> Figure:
        """Draw the section of the telescope with its rays and, if they are small, its lenses in another panel."""
        drawing = _Drawing(self)
        surfaces = self.telescope.surfaces
        names = [s.name for s in surfaces if np.isfinite(self.profiles[s.name]).all(axis=1).any()]
        full_box = drawing.box(names)
        within = {lens.front for lens in self.lenses} | {lens.back for lens in self.lenses}
        within |= {s.name for s in surfaces if s.interaction == Interaction.DETECTOR}
        lens_box = drawing.box([n for n in names if n in within]) if within & set(names) else full_box
        zoom = bool(self.lenses) and bool(np.ptp(lens_box, axis=0).max() < _SMALL * np.ptp(full_box, axis=0).max())
        with styled():
            longest = max((len(name) for name in names), default=0)
            if zoom:
                # Names above the drawing take more room where they are long.
                height = 5.4 + _NAME_HEIGHT * max(longest - _SHORT_NAME, 0)
                figure = figure_at(ax, 12.4, height if drawing.lying else 6.4)
                full_axes, lens_axes = figure.subplots(1, 2)
                _draw(lens_axes, drawing, lens_box, within & set(names), beams=False)
                outside = [n for n in names if n not in within]
                _draw(full_axes, drawing, full_box, set(outside), beams=True)
            else:
                ratio = np.ptp(full_box, axis=0)
                wide = float(np.clip(5.2 * ratio[0] / max(ratio[1], 1e-12), 6.4, 12.0))
                figure = figure_at(ax, wide + 1.2, float(np.clip(wide * ratio[1] / ratio[0], 3.0, 7.5)) + 1.6)
                full_axes = figure.subplots()
                _draw(full_axes, drawing, full_box, set(names), beams=True)
            legend_below(figure, full_axes, 8)
            figure.suptitle(
                f"{plain_text(self.telescope.name)}: section x = 0, rays of {self.wavelength * 1e9:.4g} nm; "
                f"light comes from {'the left' if drawing.lying else 'above'}",
                fontsize=11,
            )
            return figure

    def scene(self) -> trimesh.Scene:
        """Return mirrors, lenses, baffles, obstructions and rays as a scene of meshes [m], y up, for a GLB file."""
        from .meshes import layout_scene

        size = float(self.size.max())
        return layout_scene(self.telescope, self.lenses, self.reach, self.fields, self.bundles, size)

    def glb(self) -> bytes:
        """Return the scene as a binary glTF file."""
        exported = self.scene().export(file_type="glb")
        assert isinstance(exported, bytes)
        return exported


@check_arguments
def layout(
    telescope: Telescope | Request,
    fields: ArrayLike | None = None,
    wavelength: ArrayLike | None = None,
    *,
    projection: Projection | None = None,
    threads: int | None = None,
) -> Layout:
    """Lay a telescope out for drawing.

    Parameters
    ----------
    telescope, fields, wavelength, projection, threads
        As in :meth:`pachon.Request.of`; where the design data state no fields, they are the axis and both edges of the
        field along y.
    """
    stated = isinstance(telescope, Request) or telescope.design_data.fields
    request = Request.of(
        telescope,
        fields,
        wavelength,
        projection=projection,
        threads=threads,
        one_wavelength=True,
        default_fields=None if stated else _across_field,
    )
    telescope, threads = request.telescope, request.threads
    points, w = request.fields, request.wavelength
    lenses = find_lenses(telescope, w)
    reach = even_edges(telescope, lenses, drawn_radii(request))
    profiles = {s.name: surface_section(s, reach[s.name]) for s in telescope.surfaces}
    heights = np.concatenate([p[:, 2] for p in profiles.values()])
    heights = np.concatenate([heights[np.isfinite(heights)], [o.height for o in telescope.obstructions]])
    top = float(heights.max() + _ABOVE * max(np.ptp(heights), 0.5 * telescope.pupil_diameter))
    outer, inner = 0.5 * telescope.pupil_diameter, 0.5 * telescope.pupil_diameter * telescope.pupil_obscuration
    arm = np.linspace(1.005 * inner, 0.998 * outer, _FAN) if inner else np.linspace(0.0, 0.998 * outer, _FAN - 1)
    across = np.unique(np.concatenate([-arm, arm]))
    angle = 2.0 * np.pi * np.arange(_SPOKES) / _SPOKES
    rings = np.multiply.outer([0.998 * outer, 1.005 * inner] if inner else [0.998 * outer, 0.5 * outer], angle * 0 + 1)
    around = (rings * np.cos(angle)).ravel(), (rings * np.sin(angle)).ravel()

    def rays(pupil: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, ...]:
        through = np.stack(pupil, axis=-1)
        field_requests = (request.at_fields(slice(i, i + 1)) for i in range(len(points)))
        return tuple(
            ray_paths(telescope, field_request.launch(w, through), top, threads) for field_request in field_requests
        )

    return Layout(
        telescope=telescope,
        fields=points,
        wavelength=w,
        reach=reach,
        profiles=profiles,
        lenses=lenses,
        fans=rays((np.zeros_like(across), across)),
        bundles=rays(around),
        stop=stop_rims(request),
    )


def _across_field(telescope: Telescope) -> list[list[float]]:
    """Return field angles [rad]: both edges of the field along y, and the axis between them."""
    edge = telescope.field_radius
    return [[0.0, -edge], [0.0, 0.0], [0.0, edge]]


def section(telescope: Telescope) -> Figure:
    """Return the drawing of a telescope with rays of the default fields."""
    return layout(telescope).plot()


def draw_section(axes: Axes, layout: Layout) -> None:
    """Draw the section of a whole telescope with its rays, without legend and title."""
    drawing = _Drawing(layout)
    names = [n for n, profile in layout.profiles.items() if np.isfinite(profile).all(axis=1).any()]
    _draw(axes, drawing, drawing.box(names), set(names), beams=True)


class _Drawing:
    """Coordinates of a drawing: (y, z) upright, or (-z, y) for a long telescope."""

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        width, height = layout.size[1:]
        self.lying = bool(height > 1.6 * width)

    def __call__(self, points: np.ndarray) -> np.ndarray:
        y, z = points[..., 1], points[..., 2]
        return np.stack([-z, y] if self.lying else [y, z], axis=-1)

    def names_above(self, names: set[str]) -> bool:
        """Tell whether surfaces follow each other from left to right: then their names stand in a row above."""
        profiles = [self(self.layout.profiles[name]) for name in names]
        lit = [points[np.isfinite(points).all(axis=1)] for points in profiles]
        spread = np.ptp([points.mean(axis=0) for points in lit if len(points)] or np.zeros((1, 2)), axis=0)
        return bool(spread[0] > spread[1]) if spread.any() else self.lying

    def box(self, names: list[str]) -> np.ndarray:
        """Return the lowest and the highest corner of some surfaces, shape [2, 2]."""
        points = np.concatenate([self(self.layout.profiles[name]) for name in names])
        return np.stack([np.nanmin(points, axis=0), np.nanmax(points, axis=0)])


def _draw(axes: Axes, drawing: _Drawing, box: np.ndarray, named: set[str], *, beams: bool) -> None:
    from matplotlib.collections import LineCollection
    from matplotlib.patches import Polygon

    layout = drawing.layout
    size = np.ptp(box, axis=0)
    unit, scale = ("m", 1.0) if size.max() >= 1.5 else ("mm", 1e3)
    margin = 0.06 * size.max()
    low, high = (box[0] - margin) * scale, (box[1] + margin) * scale
    for i, (field, fan) in enumerate(zip(layout.fields, layout.fans, strict=True)):
        color = _RAYS[i % len(_RAYS)]
        axes.add_collection(
            LineCollection(list(drawing(fan) * scale), colors=color, linewidths=0.6, alpha=0.8, zorder=1)
        )
        lost = ": no ray arrives" if i in layout.dark else ""
        axes.plot([], [], color=color, linewidth=1.2, label=_signed_label(field) + lost)
    for lens in layout.lenses:
        front, back = (drawing(layout.profiles[name]) * scale for name in (lens.front, lens.back))
        outline = np.concatenate([front[np.isfinite(front).all(axis=1)], back[np.isfinite(back).all(axis=1)][::-1]])
        if len(outline) > 2:
            axes.add_patch(
                Polygon(
                    outline, closed=True, facecolor=_GLASS, edgecolor=_GLASS_RIM, linewidth=0.9, alpha=0.75, zorder=2
                )
            )
    in_glass = {lens.front for lens in layout.lenses} | {lens.back for lens in layout.lenses}
    for surface in layout.telescope.surfaces:
        if surface.interaction == Interaction.REFRACT and surface.name in in_glass:
            continue
        if surface.interaction == Interaction.PASS and not beams:
            # Baffles stand in front of the mirrors, not among the lenses.
            continue
        color, width = {
            Interaction.MIRROR: (_MIRROR, 2.2),
            Interaction.DETECTOR: (_DETECTOR, 2.6),
            Interaction.PASS: (_BAFFLE, 1.8),
        }.get(surface.interaction, (_GLASS_RIM, 1.0))
        points = drawing(layout.profiles[surface.name]) * scale
        axes.plot(*points.T, color=color, linewidth=width, solid_capstyle="butt", zorder=3)
    for obstruction in layout.telescope.obstructions:
        segments = drawing(_cut(obstruction.triangles.astype(np.float64))) * scale
        axes.add_collection(LineCollection(list(segments), colors=_BAFFLE, linewidths=1.0, zorder=3))
    stop = layout.stop if beams or layout.telescope.design_data.stop in named else None
    if stop is not None:
        # The symbol of a stop: two bars that end at its rim.
        ends = drawing(stop) * scale
        bars = [[rim, rim + _STOP_BAR * (rim - opposite)] for rim, opposite in (ends, ends[::-1])]
        axes.add_collection(LineCollection(bars, colors=_STOP, linewidths=2.2, zorder=5))
    if beams:
        start = np.concatenate([drawing(fan[:, 0]) for fan in layout.fans] or [box]) * scale
        if len(start):
            low, high = np.minimum(low, start.min(axis=0)), np.maximum(high, start.max(axis=0))
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    along = f"along the axis, away from the sky [{unit}]"
    axes.set_xlabel(f"−z, {along}" if drawing.lying else f"y [{unit}]")
    axes.set_ylabel(f"y [{unit}]" if drawing.lying else f"z, towards the sky [{unit}]")
    axes.grid(True, color="0.94", linewidth=0.6)
    axes.set_axisbelow(True)
    above = drawing.names_above(named)
    labels = _labels(drawing, named, scale, (low, high), above)
    if stop is not None:
        rim = max((bar[1] for bar in bars), key=lambda point: float(point[int(above)]))
        # A line to a stop far in front would leave no room for the drawing.
        labels += [("stop", rim)] if (rim >= low).all() and (rim <= high).all() else []
    _write_names(axes, labels, above)


def _labels(
    drawing: _Drawing, named: set[str], scale: float, limits: tuple[np.ndarray, np.ndarray], above: bool
) -> list[tuple[str, np.ndarray]]:
    """Return names with the rims of their surfaces; the surfaces of a lens have one name."""
    layout = drawing.layout
    parts: dict[str, list[str]] = {}
    covered: set[str] = set()
    for lens in layout.lenses:
        if {lens.front, lens.back} <= named:
            # Cemented lenses have a common surface: then each name stands alone.
            shared = {lens.front, lens.back} & covered
            parts[lens.name if not shared else lens.back] = [n for n in (lens.front, lens.back) if n not in shared]
            covered |= {lens.front, lens.back}
    for surface in layout.telescope.surfaces:
        if surface.name in named - covered:
            parts[surface.name] = [surface.name]
    labels = []
    for name, members in parts.items():
        points = np.concatenate([drawing(layout.profiles[m]) for m in members]) * scale
        points = points[np.isfinite(points).all(axis=1)]
        if not len(points):
            continue
        side = int(above)
        rim = points[points[:, side] >= points[:, side].max() - 1e-6 * scale]
        place = rim.mean(axis=0)
        if (place >= limits[0]).all() and (place <= limits[1]).all():
            labels.append((name, place))
    return labels


def _write_names(axes: Axes, labels: list[tuple[str, np.ndarray]], above: bool) -> None:
    """Write names in a row above or a column at the right, far enough apart, with lines to the surfaces."""
    if not labels:
        return
    side = 0 if above else 1
    low, high = axes.get_xlim() if above else axes.get_ylim()
    step = (high - low) / (30.0 if not above else 34.0)
    labels = sorted(labels, key=lambda item: float(item[1][side]))
    places = _apart(np.array([item[1][side] for item in labels]), step, low + step, high - step)
    edge = axes.get_ylim()[1] if above else axes.get_xlim()[1]
    for (name, rim), place in zip(labels, places, strict=True):
        end: Any = (place, edge) if above else (edge, place)
        axes.annotate(
            plain_text(name),
            xy=(rim[0], rim[1]),
            xytext=end,
            rotation=60 if above else 0,
            ha="left",
            va="bottom" if above else "center",
            fontsize=7.5,
            annotation_clip=False,
            arrowprops={"arrowstyle": "-", "color": "0.55", "linewidth": 0.5, "shrinkA": 1.0, "shrinkB": 0.0},
            zorder=4,
        )


def _apart(preferred: np.ndarray, step: float, low: float, high: float) -> np.ndarray:
    """Return ascending positions near preferred ones, a step apart and within bounds where there is room."""
    step = min(step, (high - low) / max(len(preferred) - 1, 1))
    places = np.clip(preferred, low, high)
    # Groups that are too close spread about their middle and merge with neighbours.
    groups = [[float(p), 1] for p in places]
    merged = True
    while merged:
        merged = False
        for i in range(len(groups) - 1):
            (a, n), (b, m) = groups[i], groups[i + 1]
            if b - a < 0.5 * step * (n + m) - 1e-12:
                groups[i : i + 2] = [[(a * n + b * m) / (n + m), n + m]]
                merged = True
                break
    spread = np.concatenate([c + step * (np.arange(n) - 0.5 * (n - 1)) for c, n in groups])
    return spread + max(low - spread[0], 0.0) - max(spread[-1] - high, 0.0)


def _cut(triangles: np.ndarray) -> np.ndarray:
    """Return the intersections of triangles [n, 3, 3] with the plane x = 0, segments of shape [k, 2, 3]."""
    start, end = triangles, np.roll(triangles, -1, axis=1)
    before, after = start[..., 0], end[..., 0]
    crosses = (before < 0) != (after < 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        fraction = np.where(crosses, before / (before - after), np.nan)
    points = start + fraction[..., None] * (end - start)
    divided = crosses.sum(axis=1) == 2
    return points[divided][crosses[divided]].reshape(-1, 2, 3)


def _signed_label(field: np.ndarray) -> str:
    """Return a field as text; on the y axis with its sign."""
    x, y = np.rad2deg(field)
    if abs(x) < 1e-9:
        return "on the axis" if abs(y) < 1e-9 else f"field {y:+.4g}°"
    return f"field {field_text(field)}"
