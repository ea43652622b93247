"""Random Zemax files against an independent tracer in extended precision, which follows the file surface by surface.

Coordinate breaks of both orders, mirrors in air and in glass, conics, even and odd aspheres, biconics, toroids and
polynomials. Another kind of surface is an entry of `SHAPES` (its lines and its sag) and, where it deflects light in
another way, of `DEFLECTIONS`.
"""

from dataclasses import dataclass, field

import numpy as np
import pytest

import pachon
from pachon.raytrace.rays import RayStatus

WAVELENGTH = 587.5618e-9
#: Fields [deg] and the radius of the entrance pupil [mm].
FIELDS = ((0.0, 0.0), (1.5, -2.0))
PUPIL = 3.0
#: Radius [mm] that the surfaces are made to: beyond it powers of the radius may turn back, and rays cross them twice.
SIZE = 12.0
#: Largest coordinate [mm] of landing points: rays that graze the image plane farther away magnify every angle.
FARTHEST = 150.0
LONG = np.longdouble
#: Newton's method for freeforms ends at steps of 2e-13 m, with the slopes of the place before: with second derivatives
#: of 200 / m that is 4e-11 rad, over 15 cm of path to the image 6e-12 m.
SLOPES = 6e-12
HEAD = f"""VERS 190513 30 123457 L123457
MODE SEQ
UNIT MM X W X CM MR CPMM
ENPD {2 * PUPIL:g}
FTYP 0 0 2 1 0 0 0
XFLN 0 1.5
YFLN 0 -2
WAVM 1 0.5875618 1
PWAV 1
SURF 0
  TYPE STANDARD
  CURV 0
  DISZ INFINITY
SURF 1
  STOP
  TYPE STANDARD
  CURV 0
  DISZ 10
"""


@dataclass
class Element:
    """One surface or coordinate break of a file, in its units (mm, deg)."""

    kind: str
    thickness: float
    numbers: dict = field(default_factory=dict)
    index_after: float | None = None  # None: a mirror

    def lines(self):
        """Return the lines of the file."""
        if self.kind == "COORDBRK":
            parameters = [f"  PARM {i} {v!r}" for i, v in self.numbers.items()]
            return ["  TYPE COORDBRK", "  CURV 0", *parameters, f"  DISZ {self.thickness!r}"]
        glass = []
        if self.index_after is None:
            glass = ["  GLAS MIRROR 0 0 1.5 40"]
        elif self.index_after != 1.0:
            glass = [f"  GLAS ___BLANK 1 0 {self.index_after!r} 0"]
        return [f"  TYPE {self.kind}", *SHAPES[self.kind][0](self.numbers), *glass, f"  DISZ {self.thickness!r}"]


def conic_lines(n):
    return [f"  CURV {n['c']!r}", f"  CONI {n['k']!r}"]


def parameter_lines(n):
    return [*conic_lines(n), *(f"  PARM {i} {v!r}" for i, v in n["parameters"].items())]


def polynomial_lines(n):
    terms = n["terms"]
    rows = [f"  XDAT 1 {len(terms)}", f"  XDAT 2 {n['radius']!r}"]
    return [*conic_lines(n), *rows, *(f"  XDAT {3 + i} {v!r}" for i, v in enumerate(terms))]


def conic_sag(n, x, y):
    s = x * x + y * y
    return n["c"] * s / (1 + np.sqrt(1 - (1 + n["k"]) * n["c"] ** 2 * s))


def even_sag(n, x, y):
    s = x * x + y * y
    return conic_sag(n, x, y) + sum(a * s**i for i, a in n["parameters"].items())


def odd_sag(n, x, y):
    r = np.sqrt(x * x + y * y)
    return conic_sag(n, x, y) + sum(a * r**i for i, a in n["parameters"].items())


def biconic_sag(n, x, y):
    cx, kx = 1 / LONG(n["parameters"][1]), n["parameters"][2]
    inside = 1 - (1 + kx) * (cx * x) ** 2 - (1 + n["k"]) * (n["c"] * y) ** 2
    return (cx * x * x + n["c"] * y * y) / (1 + np.sqrt(inside))


def toroid_sag(n, x, y):
    """Return the arc of y, rotated about an axis along y at the radius R from the vertex."""
    g = n["c"] * y * y / (1 + np.sqrt(1 - (1 + n["k"]) * (n["c"] * y) ** 2))
    radius = LONG(n["parameters"][1])
    return radius - np.sign(radius) * np.sqrt((radius - g) ** 2 - x * x)


def polynomial_sag(n, x, y):
    u, v = x / n["radius"], y / n["radius"]
    powers = [(i - j, j) for i in range(1, 6) for j in range(i + 1)]
    return conic_sag(n, x, y) + sum(a * u**i * v**j for a, (i, j) in zip(n["terms"], powers, strict=False))


#: Lines of a file and sag for each kind of surface.
SHAPES = {
    "STANDARD": (conic_lines, conic_sag),
    "EVENASPH": (parameter_lines, even_sag),
    "ODDASPHE": (parameter_lines, odd_sag),
    "BICONICX": (parameter_lines, biconic_sag),
    "TOROIDAL": (parameter_lines, toroid_sag),
    "XPOLYNOM": (polynomial_lines, polynomial_sag),
}


def random_surface(rng, kind, thickness, index_after):
    curvature = float(rng.choice([-1, 1]) / rng.uniform(25, 150)) if rng.uniform() > 0.1 else 0.0
    numbers = {"c": curvature, "k": float(rng.uniform(-2.5, 1.0))}
    if kind in ("BICONICX", "TOROIDAL"):
        numbers["c"] = numbers["c"] or 0.01
        numbers["parameters"] = {1: float(rng.choice([-1, 1]) * rng.uniform(25, 150))}
        if kind == "BICONICX":
            numbers["parameters"][2] = float(rng.uniform(-2, 1))
    elif kind == "EVENASPH":
        numbers["parameters"] = {i: float(rng.normal() * 10.0 ** (-1.5 - 1.8 * i)) for i in range(1, 5)}
    elif kind == "ODDASPHE":
        numbers["parameters"] = {i: float(rng.normal() * 10.0 ** (-2.0 - 0.9 * i)) for i in range(1, 7)}
    elif kind == "XPOLYNOM":
        numbers |= {"radius": float(rng.uniform(4, 8)), "terms": [float(v) for v in 0.02 * rng.normal(size=12)]}
    return Element(kind, thickness, numbers, index_after)


def coordinate_break(rng, tilts, thickness=0.0):
    shifts = rng.uniform(-0.7, 0.7, 2)
    values = [*shifts, *tilts]
    numbers = {i: float(v) for i, v in enumerate(values, start=1)} | {6: int(rng.integers(2))}
    return Element("COORDBRK", thickness, numbers)


def random_system(seed):
    """Return the elements of a system: mirrors turn the light round, folds turn the axis."""
    rng = np.random.default_rng([36, seed])
    elements, index, sense = [], 1.0, 1.0
    for _ in range(int(rng.integers(2, 7))):
        thickness = float(rng.uniform(3, 15))
        kind = str(rng.choice(list(SHAPES)))
        event = rng.uniform()
        if event < 0.35:
            elements.append(coordinate_break(rng, rng.uniform(-8, 8, 3)))
        if event < 0.15:
            # A fold by twice the tilt, about a diagonal of its own.
            tilts = np.array([rng.choice([-1, 1]) * rng.uniform(25, 50), rng.uniform(-15, 15), rng.uniform(-180, 180)])
            sense = -sense
            elements.append(coordinate_break(rng, tilts * [1, 1, 0]))
            elements.append(random_surface(rng, kind, 0.0, None))
            elements.append(coordinate_break(rng, tilts * [1, 1, 0] + [0, 0, tilts[2]], sense * thickness))
        elif event < 0.5:
            sense = -sense
            elements.append(random_surface(rng, kind, sense * thickness, None))
        else:
            index = float(rng.uniform(1.3, 1.9)) if index == 1.0 or rng.uniform() < 0.3 else 1.0
            elements.append(random_surface(rng, kind, sense * thickness, index))
    return elements


def file_text(elements):
    image = ["  TYPE STANDARD", "  CURV 0", "  DISZ 0"]
    blocks = [element.lines() for element in elements] + [image]
    return HEAD + "\n".join(line for i, b in enumerate(blocks, start=2) for line in (f"SURF {i}", *b)) + "\n"


def axis_rotation(axis, degrees):
    angle = np.radians(LONG(degrees))
    c, s = np.cos(angle), np.sin(angle)
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    matrix = np.eye(3, dtype=LONG)
    matrix[i, i], matrix[i, j], matrix[j, i], matrix[j, j] = c, -s, s, c
    return matrix


def mirrored(direction, normal, n, n_after):
    return direction - 2 * (direction * normal).sum(axis=0) * normal


def refracted(direction, normal, n, n_after):
    """Return directions by Snell's law for the sines: the part along the surface is n / n' times as long."""
    along = (direction * normal).sum(axis=0)
    tangential = (direction - along * normal) * (n / n_after)
    rest_squared = 1 - (tangential**2).sum(axis=0)
    return tangential + np.sign(along) * np.sqrt(rest_squared) * normal


DEFLECTIONS = {"mirror": mirrored, "lens": refracted}


def landed(sag, place, direction):
    """Return rays [3, n] on a surface by Newton's method from its vertex plane; NaN where it fails."""

    def slopes(x, y):
        # Derivatives by complex steps have no rounding of differences.
        step = LONG(1e-40) * np.clongdouble(1j)
        return (np.imag(sag(x + step, y + 0 * step)) / LONG(1e-40), np.imag(sag(x + 0 * step, y + step)) / LONG(1e-40))

    t = -place[2] / direction[2]
    for _ in range(60):
        x, y, z = place + t * direction
        along_x, along_y = slopes(x, y)
        rate = direction[2] - along_x * direction[0] - along_y * direction[1]
        step = (z - sag(x, y)) / rate
        t = t - step
        # A NaN, of a ray that is lost, does not go on.
        if not (np.abs(step) > 1e-16).any():
            break
    t = np.where(np.abs(step) < 1e-15, t, np.nan)
    x, y, z = place + t * direction
    along_x, along_y = slopes(x, y)
    normal = np.stack([-along_x, -along_y, np.ones_like(x)])
    return place + t * direction, normal / np.sqrt((normal**2).sum(axis=0)), t


def traced(elements, place, direction):
    """Return rays [3, n] at the image, their optical path and largest radius, all in the frame of surface 1 [mm]."""
    origin, axes = np.array([0, 0, 10], dtype=LONG), np.eye(3, dtype=LONG)
    place, direction = place.astype(LONG), direction.astype(LONG)
    index, path = LONG(1), np.zeros(place.shape[1], dtype=LONG)
    reach = np.zeros(place.shape[1])
    image = Element("STANDARD", 0.0, {"c": 0.0, "k": 0.0}, 1.0)
    for element in [*elements, image]:
        if element.kind == "COORDBRK":
            dx, dy, *tilts, order = (element.numbers[i] for i in range(1, 7))
            rotations = [axis_rotation(i, tilt) for i, tilt in enumerate(tilts)]
            shift = np.array([dx, dy, 0], dtype=LONG)
            if order == 0:
                origin = origin + axes @ shift
                axes = axes @ rotations[0] @ rotations[1] @ rotations[2]
            else:
                axes = axes @ rotations[2] @ rotations[1] @ rotations[0]
                origin = origin + axes @ shift
        else:
            local, travel = axes.T @ (place - origin[:, None]), axes.T @ direction
            sag = SHAPES[element.kind][1]
            local, normal, t = landed(lambda x, y, n=element.numbers, sag=sag: sag(n, x, y), local, travel)
            path = path + index * t
            after = index if element.index_after is None else LONG(element.index_after)
            deflect = DEFLECTIONS["mirror" if element.index_after is None else "lens"]
            if element is not image:
                travel = deflect(travel, normal, index, after)
                reach = np.maximum(reach, np.hypot(local[0], local[1]).astype(float))
            place, direction, index = axes @ local + origin[:, None], axes @ travel, after
        origin = origin + axes[:, 2] * LONG(element.thickness)
    return place, direction, path, reach


def compare(seed, folder):
    """Return the number of rays that arrive, and the largest difference of the two tracers over what is allowed."""
    elements = random_system(seed)
    path = folder / f"random_{seed}.zmx"
    path.write_text(file_text(elements))
    telescope = pachon.load_telescope(path)
    angle = np.arange(9) * 2.4
    size = PUPIL * 1e-3 * np.sqrt((np.arange(9) + 0.5) / 9)
    pupil = size * np.cos(angle), size * np.sin(angle)
    start_z = telescope.surfaces[0].vertex[2]
    # From the telescope frame to that of surface 1, in mm.
    flip = np.array([[-1.0], [1.0], [-1.0]])
    arrived, worst = 0, 0.0
    for tx, ty in np.radians(FIELDS):
        rays = pachon.launch_rays(telescope, (-tx, ty), WAVELENGTH, pupil)
        results = pachon.trace(telescope, rays, "all")
        place, direction = 1e3 * flip * (rays.position - [0.0, 0.0, start_z]).T, flip * rays.direction.T
        with np.errstate(all="ignore"):
            *expected, reach = traced(elements, place, direction)
            moved = traced(elements, place * (1 + 1e-13), direction)[:3]
        reached = (np.abs(expected[0]) < FARTHEST).all(axis=0) & (reach < SIZE)
        end = results[-1]
        assert (end.status == RayStatus.OK)[reached].all(), f"seed {seed}: statuses {end.status}, expected {reached}"
        traces = 1e3 * flip * (end.position - [0.0, 0.0, start_z]).T, flip * end.direction.T, 1e3 * end.path_length
        for ours, theirs, beside in zip(traces, expected, moved, strict=True):
            # What a thousand roundings become that the system magnifies.
            rounding = np.abs(beside - theirs)[..., reached].max(initial=0.0) / 1e3
            difference = np.abs(ours - theirs)[..., reached].max(initial=0.0) / 1e3
            worst = max(worst, float(difference / (SLOPES + rounding)))
        arrived += int(reached.sum())
        for result, surface in zip(results, telescope.surfaces, strict=True):
            lit = result.status == RayStatus.OK
            x, y, z = surface.to_local(result.position[lit]).T
            height = (z - surface.sag(x, y)) * surface.normal(x, y)[:, 2]
            # Where rays go astray, places of metres.
            assert (np.abs(height) < 1e-12 * np.maximum(1.0, np.hypot(x, y))).all(), f"seed {seed}: {surface.name}"
    return arrived, worst


def check(seeds, folder):
    counts, worst = zip(*(compare(seed, folder) for seed in seeds), strict=True)
    assert sum(counts) > 9 * len(seeds)
    assert max(worst) < 1.0, f"seed {seeds[int(np.argmax(worst))]}: {max(worst)} times the tolerance"


@pytest.mark.long
def test_random_systems(tmp_path):
    check(range(6), tmp_path)


@pytest.mark.slow
def test_many_random_systems(tmp_path):
    check(range(6, 900), tmp_path)
