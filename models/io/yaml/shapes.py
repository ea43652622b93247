"""Shapes in prescription files: from a section of YAML and back.

A surface has its shape's name under ``shape`` and the figures beside it; the sum of several shapes is a list of
mappings under ``shape``, each written the same way. Figures are lengths in the file's unit, and powers of it:

================= ====================================================================================================
``plane``
``sphere``        ``radius``
``conic``         ``radius``, ``conic``
``paraboloid``    ``radius``
``even_asphere``  ``radius``, ``conic``, ``coefficients`` of r^4, r^6, r^8...; a radius may be ``flat``
``odd_asphere``   ``radius``, ``conic``, ``coefficients`` of r^1, r^2, r^3...; a radius may be ``flat``
``biconic``       ``radius_x``, ``radius_y``, ``conic_x``, ``conic_y``; a radius may be ``flat``
``toroid``        ``radius_x`` (from the axis that it turns about), ``radius_y``, ``conic_y``; a radius may be ``flat``
``xy_polynomial`` ``terms``: a list of [power of x, power of y, coefficient]
``zernike``       ``coefficients`` (Noll order from j = 1), ``outer_radius``, ``inner_radius``
``grid``          ``file``, a FITS image, or ``nodes_x``, ``nodes_y`` and ``values``, a row of x for each y
``mesh``          ``file`` and ``scale``, its unit in metres, or ``vertices`` and ``faces`` in base 64; ``smooth``:
                  whether slopes are interpolated
================= ====================================================================================================

A relative path of a file is meant from where the prescription lies. Of a surface of type ``phase`` the shape is the map
of optical path.
"""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from ....core.errors import PrescriptionError
from ....core.yaml_reader import Section, as_number
from ...shapes.freeform import Biconic, OddAsphere, Toroid, XYPolynomial, ZernikeSag
from ...shapes.grid import GridSag
from ...shapes.mesh import MeshSurface
from ...shapes.shape import Conic, EvenAsphere, Plane, Shape, Sphere, Sum
from ..grid_file import read_grid

Convert = Callable[[float], float]

#: The keys that each shape has beside its name.
SHAPE_KEYS = {
    "plane": (),
    "sphere": ("radius",),
    "conic": ("radius", "conic"),
    "paraboloid": ("radius",),
    "even_asphere": ("radius", "conic", "coefficients"),
    "odd_asphere": ("radius", "conic", "coefficients"),
    "biconic": ("radius_x", "radius_y", "conic_x", "conic_y"),
    "toroid": ("radius_x", "radius_y", "conic_y"),
    "xy_polynomial": ("terms",),
    "zernike": ("coefficients", "outer_radius", "inner_radius"),
    "grid": ("file", "nodes_x", "nodes_y", "values"),
    "mesh": ("file", "scale", "vertices", "faces", "smooth"),
}


def shape_keys(section: Section) -> tuple[str, ...]:
    """Return the keys that the shape of a surface may have beside ``shape``: none, where that is a list."""
    if isinstance(section.value("shape"), list):
        return ()
    return SHAPE_KEYS[section.choice("shape", tuple(SHAPE_KEYS))]


def read_shape(section: Section, length: Convert) -> Shape:
    """Return the shape that a section, a surface or a part of a sum, describes.

    Parameters
    ----------
    section : Section
        Mapping with ``shape`` and figures; keys that are none of a shape's are the caller's business.
    length : callable
        Conversion of the file's lengths to metres.

    Raises
    ------
    PrescriptionError
        If a figure is missing, malformed or impossible: file, key, value and what was expected.
    """
    if not isinstance(section.value("shape"), list):
        return _READERS[section.choice("shape", tuple(SHAPE_KEYS))](section, length)
    parts = []
    for part in section.sections("shape", "shape"):
        part.allow("shape", *shape_keys(part))
        try:
            parts.append(read_shape(part, length))
        except PrescriptionError as error:
            raise part.placed(error) from None
    return Sum(tuple(parts))


def _radius(section: Section, key: str, length: Convert) -> float:
    return length(section.number(key))


def _radius_or_flat(section: Section, key: str, length: Convert) -> float:
    if key in section and section.value(key) == "flat":
        return np.inf
    return length(section.number(key))


def _powers(section: Section, powers: range, length: Convert) -> tuple[float, ...]:
    """Return coefficients, each of its power of the radius: a length over a length to that power."""
    unit = length(1.0)
    numbers = section.numbers("coefficients")
    return tuple(a if unit == 1.0 else a * unit ** (1 - n) for n, a in zip(powers, numbers, strict=False))


def _read_even_asphere(section: Section, length: Convert) -> Shape:
    terms = _powers(section, range(4, 1000, 2), length)
    return EvenAsphere(_radius_or_flat(section, "radius", length), section.number("conic", 0.0), terms)


def _read_odd_asphere(section: Section, length: Convert) -> Shape:
    terms = _powers(section, range(1, 1000), length)
    return OddAsphere(_radius_or_flat(section, "radius", length), section.number("conic", 0.0), terms)


def _read_biconic(section: Section, length: Convert) -> Shape:
    along_x, along_y = (_radius_or_flat(section, key, length) for key in ("radius_x", "radius_y"))
    return Biconic(along_x, along_y, section.number("conic_x", 0.0), section.number("conic_y", 0.0))


def _read_toroid(section: Section, length: Convert) -> Shape:
    along_x, along_y = (_radius_or_flat(section, key, length) for key in ("radius_x", "radius_y"))
    return Toroid(along_x, along_y, section.number("conic_y", 0.0))


def _read_xy_polynomial(section: Section, length: Convert) -> Shape:
    rows = section.value("terms")
    if not isinstance(rows, list) or not rows:
        raise section.error("terms", "a list of [power of x, power of y, coefficient]")
    unit = length(1.0)
    terms = []
    for row in rows:
        numbers = [as_number(v) for v in row] if isinstance(row, list) and len(row) == 3 else [None]
        i, j, a = numbers if len(numbers) == 3 else (None, None, None)
        if i is None or j is None or a is None or i % 1 or j % 1 or i < 0 or j < 0:
            raise section.error("terms", f"[power of x, power of y, coefficient], not {row!r}")
        terms.append((int(i), int(j), a if unit == 1.0 else a * unit ** (1 - i - j)))
    return XYPolynomial(tuple(terms))


def _read_zernike(section: Section, length: Convert) -> Shape:
    return ZernikeSag(
        tuple(length(a) for a in section.numbers("coefficients")),
        length(section.number("outer_radius")),
        length(section.number("inner_radius", 0.0)),
    )


def _beside(section: Section) -> Path:
    # A relative path is meant from where the prescription lies.
    return Path(section.source).parent / section.text("file")


def _read_grid(section: Section, length: Convert) -> Shape:
    if "file" in section:
        for key in ("nodes_x", "nodes_y", "values"):
            if key in section:
                raise section.error(key, f"file or {key}, not both")
        return read_grid(_beside(section))
    rows = section.value("values")
    if not isinstance(rows, list):
        raise section.error("values", "a list of rows of numbers")
    # A section of the rows by number lets each report itself.
    table = Section({str(j): row for j, row in enumerate(rows)}, section.source, f"{section.place}.values")
    numbers = [table.numbers(key) for key in table.keys()]  # noqa: SIM118 - a Section is no mapping
    if len({len(row) for row in numbers}) > 1:
        raise section.error("values", "rows of one length")
    x, y = ([length(v) for v in section.numbers(key)] for key in ("nodes_x", "nodes_y"))
    return GridSag(x, y, [[length(v) for v in row] for row in numbers])


def _read_mesh(section: Section, length: Convert) -> Shape:
    smooth = section.value("smooth") if "smooth" in section else False
    if not isinstance(smooth, bool):
        raise section.error("smooth", "true or false")
    if "file" in section:
        for key in ("vertices", "faces"):
            if key in section:
                raise section.error(key, f"file or {key}, not both")
        scale = section.number("scale", 1.0, positive=True)
        return MeshSurface.from_file(_beside(section), scale=scale, smooth=smooth)
    return MeshSurface(_decoded(section, "vertices", "<f8"), _decoded(section, "faces", "<i4"), smooth=smooth)


def _decoded(section: Section, key: str, kind: str) -> np.ndarray:
    try:
        return np.frombuffer(base64.b64decode(section.text(key), validate=True), dtype=kind).reshape(-1, 3)
    except (binascii.Error, ValueError):
        raise section.error(key, "three numbers a row, in base 64") from None


_READERS: dict[str, Callable[[Section, Convert], Shape]] = {
    "plane": lambda section, length: Plane(),
    "sphere": lambda section, length: Sphere(_radius(section, "radius", length)),
    "conic": lambda section, length: Conic(_radius(section, "radius", length), section.number("conic")),
    "paraboloid": lambda section, length: Conic(_radius(section, "radius", length), -1.0),
    "even_asphere": _read_even_asphere,
    "odd_asphere": _read_odd_asphere,
    "biconic": _read_biconic,
    "toroid": _read_toroid,
    "xy_polynomial": _read_xy_polynomial,
    "zernike": _read_zernike,
    "grid": _read_grid,
    "mesh": _read_mesh,
}


def shape_items(shape: Shape, number: Callable[[float], str], listed: Callable[..., str]) -> dict[str, str]:
    """Return the keys and values, as text in metres, that :func:`read_shape` makes the same shape of.

    Parameters
    ----------
    shape : Shape
        What to describe; grids and meshes are written out, so that a file stands by itself.
    number, listed : callable
        Text of a number, and of several.
    """

    def rows(values: np.ndarray) -> str:
        return "[" + ", ".join(listed(row) for row in values) + "]"

    def encoded(values: np.ndarray, kind: str) -> str:
        return json.dumps(base64.b64encode(values.astype(kind).tobytes()).decode())

    def figures(**values: float) -> dict[str, str]:
        return {key: number(value) if np.isfinite(value) else "flat" for key, value in values.items()}

    if isinstance(shape, Sum):
        parts = (shape_items(part, number, listed) for part in shape.parts)
        texts = ("{" + ", ".join(f"{key}: {value}" for key, value in items.items()) + "}" for items in parts)
        return {"shape": "[" + ", ".join(texts) + "]"}
    if isinstance(shape, Plane):
        return {"shape": "plane"}
    if isinstance(shape, Sphere):
        return {"shape": "sphere", "radius": number(shape.radius)}
    if isinstance(shape, Conic):
        return {"shape": "conic", "radius": number(shape.radius), "conic": number(shape.conic)}
    if isinstance(shape, (EvenAsphere, OddAsphere)):
        name = "even_asphere" if isinstance(shape, EvenAsphere) else "odd_asphere"
        conic = figures(radius=shape.radius, conic=shape.conic)
        return {"shape": name} | conic | {"coefficients": listed(shape.coefficients)}
    if isinstance(shape, Biconic):
        radii = figures(radius_x=shape.radius_x, radius_y=shape.radius_y)
        return {"shape": "biconic"} | radii | figures(conic_x=shape.conic_x, conic_y=shape.conic_y)
    if isinstance(shape, Toroid):
        return {"shape": "toroid"} | figures(radius_x=shape.radius_x, radius_y=shape.radius_y, conic_y=shape.conic_y)
    if isinstance(shape, XYPolynomial):
        terms = ", ".join(f"[{i}, {j}, {number(a)}]" for i, j, a in shape.terms)
        return {"shape": "xy_polynomial", "terms": f"[{terms}]"}
    if isinstance(shape, ZernikeSag):
        radii = {"outer_radius": number(shape.outer_radius), "inner_radius": number(shape.inner_radius)}
        return {"shape": "zernike", "coefficients": listed(shape.coefficients)} | radii
    if isinstance(shape, GridSag):
        nodes = {"nodes_x": listed(shape.x), "nodes_y": listed(shape.y)}
        return {"shape": "grid"} | nodes | {"values": rows(shape.values)}
    if isinstance(shape, MeshSurface):
        points = {"vertices": encoded(shape.vertices, "<f8"), "faces": encoded(shape.faces, "<i4")}
        return {"shape": "mesh"} | points | {"smooth": "true" if shape.smooth else "false"}
    raise PrescriptionError(f"shape {type(shape).__name__}: expected one of {', '.join(SHAPE_KEYS)}")
