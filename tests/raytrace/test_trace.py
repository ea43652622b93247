"""The ray trace against Zemax, a brute-force NumPy trace and invariants."""

import csv
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy import units as u

import pachon
from pachon.core.errors import ConfigError, DomainError
from pachon.models.aperture import Circle
from pachon.models.media.medium import ConstantIndex
from pachon.models.shapes.shape import Conic, Plane, Sphere
from pachon.models.surface import Interaction, Surface
from pachon.models.telescope import Telescope
from pachon.raytrace.kernels.packet import LANES
from pachon.raytrace.rays import Rays, RayStatus, field_direction
from pachon.raytrace.repeated_trace import RepeatedTrace

ZEMAX = Path(__file__).parents[1] / "data" / "zemax"
PUPIL_RADIUS = 4.18
# Zemax surface numbers of M1, M2, M3, L1 (2), L2 (2), filter (2), L3 (2), detector.
ZEMAX_NUMBERS = [5, 6, 8, 10, 11, 12, 13, 14, 15, 16, 17, 18]


def simple_telescope(*surfaces, **changes):
    fields = dict(
        name="test",
        surfaces=surfaces,
        stop_z=0.0,
        pupil_diameter=1.0,
        pupil_obscuration=0.0,
        launch_distance=5.0,
        reference_sphere_radius=1.0,
        field_radius=0.1,
        field_limit=0.5,
        wavelength_range=(3e-7, 1e-6),
        default_wavelength=5e-7,
    )
    return Telescope(**(fields | changes))


GLASS = ConstantIndex(1.5)
VACUUM = ConstantIndex(1.0)


def brute_force(telescope, position, direction, wavelength):
    """Trace one ray at a time, finding each surface by bisection on its sag: nothing shared with the kernels."""
    ends = []
    for p, d in zip(position, direction, strict=True):
        p, d, path, n = p.copy(), d.copy(), 0.0, float(telescope.medium_before.index(wavelength))
        for s in telescope.surfaces:
            rotation, vertex = np.array(s.rotation), np.array(s.vertex)
            q, v = rotation.T @ (p - vertex), rotation.T @ d
            to_plane = -q[2] / v[2]
            low, high = to_plane - 1.2, to_plane + 1.2

            def height(t, q=q, v=v, s=s):
                x, y, z = q + t * v
                return z - float(s.shape.sag(x, y))

            if not height(low) * height(high) < 0:
                raise AssertionError("no bracket")
            for _ in range(200):
                mid = 0.5 * (low + high)
                if height(low) * height(mid) <= 0:
                    high = mid
                else:
                    low = mid
            t = 0.5 * (low + high)
            q = q + t * v
            path += n * t
            h = 1e-4
            x, y = q[:2]
            # Fourth-order central differences: error h^4 f'''''/30, below 1e-15 for these surfaces.
            sag = s.shape.sag
            gx = (8 * (sag(x + h, y) - sag(x - h, y)) - (sag(x + 2 * h, y) - sag(x - 2 * h, y))) / (12 * h)
            gy = (8 * (sag(x, y + h) - sag(x, y - h)) - (sag(x, y + 2 * h) - sag(x, y - 2 * h))) / (12 * h)
            normal = np.array([-float(gx), -float(gy), 1.0])
            normal /= np.linalg.norm(normal)
            if s.interaction == Interaction.MIRROR:
                v = v - 2 * (v @ normal) * normal
            elif s.interaction == Interaction.REFRACT:
                after = float(s.medium_after.index(wavelength))
                if v @ normal < 0:
                    normal = -normal
                cosine = v @ normal
                sine = (v - cosine * normal) * n / after
                v = sine + np.sqrt(1 - sine @ sine) * normal
                n = after
            p, d = rotation @ q + vertex, rotation @ v
        ends.append((p, d, path))
    return tuple(np.array(part) for part in zip(*ends, strict=True))


@pytest.mark.parametrize(
    ("listing", "field", "pupil"),
    [
        ("lsst_v3.3_ray_500nm_chief_hx1.csv", (1.75, 0.0), (0.0, 0.0)),
        ("lsst_v3.3_ray_500nm_skew_hx0.5_hy0.5_px0.5_py0.5.csv", (0.875, 0.875), (0.5, 0.5)),
    ],
)
def test_zemax_rays_at_every_surface(zemax_lsst, listing, field, pupil):
    lines = [line for line in (ZEMAX / listing).read_text().splitlines() if not line.startswith("#")]
    rows = {int(row["surface"]): row for row in csv.DictReader(lines)}
    rays = pachon.launch_rays(
        zemax_lsst, field * u.deg, 500e-9, tuple(np.array([p * PUPIL_RADIUS]) for p in pupil), projection="zemax"
    )
    results = pachon.trace(zemax_lsst, rays, surfaces="all")
    assert [r.surface for r in results] == list(zemax_lsst.surface_names)
    for number, result in zip(ZEMAX_NUMBERS, results, strict=True):
        row = rows[number]
        expected = np.array([float(row["x_mm"]), float(row["y_mm"]), -float(row["z_mm"])]) * 1e-3
        # Zemax lists millimetres with seven to eleven decimals: half a unit of the eighth is 5e-12 m.
        assert np.abs(result.position[0] - expected).max() < 1e-10
        cosines = np.array([float(row["cos_x"]), float(row["cos_y"]), -float(row["cos_z"])])
        # Listed to ten decimals; after an odd number of mirrors Zemax lists the opposite of the travel.
        assert min(np.abs(result.direction[0] - sign * cosines).max() for sign in (1, -1)) < 1e-10


def test_brute_force_through_a_perturbed_telescope(lsst_r, annulus_points):
    telescope = lsst_r.perturbed("M2", shift=(1e-3, -2e-3, 5e-4), tilt=(1e-3, 2e-3, 0.0))
    telescope = telescope.perturbed("Camera", shift=(-5e-4, 1e-3, 3e-4), tilt=(-5e-4, 1e-3, 2e-3))
    rays = pachon.launch_rays(telescope, (0.012, -0.007), 620e-9, annulus_points(5))
    position, direction, path = brute_force(telescope, rays.position, rays.direction, rays.wavelength)
    result = pachon.trace(telescope, rays)
    # The brute-force normals are good to 1e-12, over 10 m of travel 1e-11 m; bisection itself to 1e-15 m.
    assert np.abs(result.position - position).max() < 2e-11
    assert np.abs(result.direction - direction).max() < 1e-11
    assert np.abs(result.path_length - path).max() < 2e-11


def test_paraboloid_focuses_an_axial_beam_exactly():
    mirror = Surface("M", Interaction.MIRROR, Conic(4.0, -1.0), (0, 0, 0), VACUUM)
    detector = Surface("D", Interaction.DETECTOR, Plane(), (0, 0, 2.0), VACUUM)
    telescope = simple_telescope(mirror, detector)
    x = np.linspace(-0.9, 0.9, 37)
    result = pachon.trace(telescope, pachon.launch_rays(telescope, (0, 0), 5e-7, (x, 0.3 * x)))
    # Closed form: every ray crosses the focus, with the same path; rounding of numbers of order 1 to 10.
    assert np.abs(result.position[:, :2]).max() < 1e-14
    assert np.ptp(result.path_length) < 1e-14


def test_snell_and_unit_directions_at_every_surface(lsst_r, annulus_points):
    rays = pachon.launch_rays(lsst_r, (0.02, 0.01), 620e-9, annulus_points(200))
    results = pachon.trace(lsst_r, rays, surfaces="all")
    n, before = 1.0, rays.direction
    for surface, result in zip(lsst_r.surfaces, results, strict=True):
        assert np.abs(np.linalg.norm(result.direction, axis=1) - 1).max() < 1e-14
        if surface.interaction == Interaction.DETECTOR:
            break
        x, y, _ = (result.position - np.array(surface.vertex)).T
        h = 1e-5
        normal = np.stack(
            [
                -(surface.shape.sag(x + h, y) - surface.shape.sag(x - h, y)) / (2 * h),
                -(surface.shape.sag(x, y + h) - surface.shape.sag(x, y - h)) / (2 * h),
                np.ones_like(x),
            ],
            axis=1,
        )
        normal /= np.linalg.norm(normal, axis=1)[:, None]
        after = float(surface.medium_after.index(620e-9)) if surface.interaction == Interaction.REFRACT else n
        # n (d x N) is continuous through any surface; the differences above are good to about 1e-10.
        change = n * np.cross(before, normal) - after * np.cross(result.direction, normal)
        assert np.abs(change).max() < 1e-9
        n, before = after, result.direction


def test_reversed_rays_return_to_their_start(lsst_r, annulus_points):
    rays = pachon.launch_rays(lsst_r, (0.01, 0.02), 620e-9, annulus_points(64))
    end = pachon.trace(lsst_r, rays)
    optics = lsst_r.surfaces[:-1]
    media = [lsst_r.medium_before, *(s.medium_after for s in optics)]
    backwards = [replace(s, medium_after=media[i]) for i, s in reversed(list(enumerate(optics)))]
    end_plane = Surface("start", Interaction.DETECTOR, Plane(), (0, 0, 12.0), VACUUM)
    reversed_telescope = replace(lsst_r, surfaces=(*backwards, end_plane), groups={}, group_frames={})
    back = pachon.trace(reversed_telescope, Rays(end.position, -end.direction, np.zeros(64), 620e-9))
    assert np.abs(back.direction + rays.direction).max() < 1e-13
    along = (12.0 - rays.position[:, 2]) / rays.direction[:, 2]
    start = rays.position + along[:, None] * rays.direction
    assert np.abs(back.position - start).max() < 1e-12


def test_moving_the_whole_telescope_moves_the_image_with_it(lsst_r, annulus_points):
    shift = np.array([0.01, -0.02, 0.03])
    moved = lsst_r
    for name in ("M1", "M2", "M3", "Camera"):
        moved = moved.perturbed(name, shift=shift)
    rays = pachon.launch_rays(lsst_r, (0.01, 0.0), 620e-9, annulus_points(40))
    carried = Rays(rays.position + shift, rays.direction, rays.path_length, rays.wavelength)
    here, there = pachon.trace(lsst_r, rays), pachon.trace(moved, carried)
    assert np.abs(there.position - here.position - shift).max() < 1e-13
    assert np.array_equal(there.status, here.status)


@pytest.mark.parametrize("cuts", [[1], [7, 40, 41], [LANES], [3, LANES + 5, 2 * LANES]])
def test_cutting_a_batch_changes_no_byte(lsst_r, annulus_points, cuts):
    px, py = annulus_points(100)
    whole = pachon.trace(lsst_r, pachon.launch_rays(lsst_r, (0.02, 0.01), 620e-9, (px, py)))
    parts = [
        pachon.trace(lsst_r, pachon.launch_rays(lsst_r, (0.02, 0.01), 620e-9, part))
        for part in zip(np.split(px, cuts), np.split(py, cuts), strict=True)
    ]
    for name in ("position", "direction", "path_length", "status"):
        assert np.array_equal(np.concatenate([getattr(p, name) for p in parts]), getattr(whole, name))


def test_threads_change_no_byte(lsst_r, annulus_points):
    rays = pachon.launch_rays(lsst_r, (0.02, 0.01), 620e-9, annulus_points(1000))
    one, three = pachon.trace(lsst_r, rays, threads=1), pachon.trace(lsst_r, rays, threads=3)
    for name in ("position", "direction", "path_length", "status"):
        assert np.array_equal(getattr(one, name), getattr(three, name))


@pytest.mark.parametrize("n", [5, LANES, 1000])
def test_arrays_of_an_earlier_trace_are_used_again(lsst_r, annulus_points, n):
    rays, others = (pachon.launch_rays(lsst_r, (x, 0.01), 620e-9, annulus_points(n)) for x in (0.02, -0.01))
    fresh, given = pachon.trace(lsst_r, rays), pachon.trace(lsst_r, others)
    result = pachon.trace(lsst_r, rays, out=given)
    for name in ("position", "direction", "path_length", "status"):
        assert np.array_equal(getattr(result, name), getattr(fresh, name))
        assert np.shares_memory(getattr(result, name), getattr(given, name))
    again = pachon.trace(lsst_r, others, out=result)
    assert np.shares_memory(again.position, given.position)
    assert np.array_equal(pickle.loads(pickle.dumps(again)).position, again.position)


def test_arrays_that_do_not_fit_are_refused(lsst_r, annulus_points):
    rays, more = (pachon.launch_rays(lsst_r, (0.02, 0.01), 620e-9, annulus_points(n)) for n in (64, 65))
    last, every = pachon.trace(lsst_r, rays), pachon.trace(lsst_r, rays, surfaces="all")
    on_ccds = pachon.trace(lsst_r, rays, focal_plane=pachon.FocalPlane.flat("lsst"))
    for out in (pachon.trace(lsst_r, more), every[-1], on_ccds, pickle.loads(pickle.dumps(last))):
        with pytest.raises(
            DomainError, match=r"^out = <TraceResult.*>: expected the result of an earlier trace of 64 rays"
        ):
            pachon.trace(lsst_r, rays, out=out)
    with pytest.raises(ConfigError, match=r'^out: expected surfaces = "last", and no focal plane$'):
        pachon.trace(lsst_r, rays, surfaces="all", out=last)


def test_no_rays_give_an_empty_result(lsst_r):
    result = pachon.trace(lsst_r, pachon.launch_rays(lsst_r, (0, 0), 620e-9, ([], [])))
    assert result.position.shape == (0, 3)
    assert result.status.shape == (0,)


def test_statuses():
    ball = Surface("ball", Interaction.REFRACT, Sphere(0.5), (0, 0, 0), GLASS, Circle(0.3))
    detector = Surface("D", Interaction.DETECTOR, Plane(), (0, 0, -0.3), GLASS)
    telescope = simple_telescope(ball, detector)
    x = np.array([0.0, 0.299, 0.3, 0.45, 0.6])
    result = pachon.trace(telescope, pachon.launch_rays(telescope, (0, 0), 5e-7, (x, 0 * x)))
    assert list(result.status) == [
        RayStatus.OK,
        RayStatus.OK,
        RayStatus.VIGNETTED,
        RayStatus.VIGNETTED,
        RayStatus.MISSED,
    ]
    # A vignetted ray goes on; a missed one has no position.
    assert np.isfinite(result.position[:4]).all()
    assert np.isnan(result.position[4]).all()


def test_total_reflection_beyond_the_critical_angle():
    face = Surface("face", Interaction.REFRACT, Plane(), (0, 0, 0), VACUUM)
    detector = Surface("D", Interaction.DETECTOR, Plane(), (0, 0, -1), VACUUM)
    telescope = simple_telescope(face, detector, medium_before=GLASS, field_limit=1.5)
    critical = np.arcsin(1 / 1.5)
    for angle, expected in ((critical - 1e-6, RayStatus.OK), (critical + 1e-6, RayStatus.TOTAL_REFLECTION)):
        rays = pachon.launch_rays(telescope, (angle, 0), 5e-7, ([0.0], [0.0]))
        assert pachon.trace(telescope, rays).status[0] == expected


def test_rays_of_one_launch_start_in_phase(lsst_r, annulus_points):
    rays = pachon.launch_rays(lsst_r, (0.02, -0.01), 620e-9, annulus_points(50))
    along = np.einsum("ij,ij->i", rays.position, rays.direction)
    assert np.ptp(along) < 1e-14
    # ... and before the first surface.
    assert rays.position[:, 2].min() > max(s.vertex[2] for s in lsst_r.surfaces)


def test_projections():
    tx, ty = 0.02, -0.03
    zemax, gnomonic, postel = (field_direction(tx, ty, p) for p in ("zemax", "gnomonic", "postel"))
    assert np.allclose(zemax[:2] / -zemax[2], np.tan([tx, ty]), rtol=1e-15)
    assert np.allclose(gnomonic[:2] / -gnomonic[2], [tx, ty], rtol=1e-15)
    assert np.isclose(np.arccos(-postel[2]), np.hypot(tx, ty), rtol=1e-12)
    assert np.isclose(np.arctan2(postel[1], postel[0]), np.arctan2(ty, tx), rtol=1e-15)


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        (dict(field=(0.2, 0.0)), DomainError, "2.5 deg"),
        (dict(wavelength=5e-6), DomainError, "300 to 1200 nm"),
        (dict(wavelength=-1.0), DomainError, "positive"),
        (dict(wavelength=3 * u.s), DomainError, "unit"),
        (dict(projection="stereo"), ConfigError, "zemax"),
    ],
)
def test_bad_launches_name_the_argument(lsst_r, change, error, words):
    arguments = dict(field=(0.0, 0.0), wavelength=620e-9, pupil=([3.0], [0.0]), projection="zemax") | change
    with pytest.raises(error, match=words):
        pachon.launch_rays(lsst_r, **arguments)


def test_unknown_choice_of_surfaces(lsst_r):
    rays = pachon.launch_rays(lsst_r, (0, 0), 620e-9, ([3.0], [0.0]))
    with pytest.raises(ConfigError, match="surfaces = 'first': expected one of last, all"):
        pachon.trace(lsst_r, rays, surfaces="first")


@pytest.mark.parametrize(
    ("shapes", "named"),
    [
        (((64, 3), (64, 3), (640,)), r"position of rays has shape \(64, 3\): expected \[640, 3\]"),
        (((640, 3), (64, 3), (640,)), r"direction of rays has shape \(64, 3\): expected \[640, 3\]"),
        (((3,), (3,), ()), r"position of rays has shape \(3,\): expected \[n, 3\]"),
    ],
)
def test_rays_of_different_lengths_are_refused(shapes, named):
    with pytest.raises(DomainError, match=named):
        Rays(*(np.zeros(shape) for shape in shapes), 500e-9)


def test_rays_traced_again_and_again_are_those_of_a_trace(lsst_r):
    traced = RepeatedTrace(lsst_r, 620e-9, 4)
    angle = np.random.default_rng(1).uniform(0.0, 2 * np.pi, 5000)
    for n in (40, 1, 0, 300, 5000, 7):
        rays = pachon.launch_rays(lsst_r, (0.01, 0.02), 620e-9, (4.5 * np.cos(angle[:n]), 3.0 * np.sin(angle[:n])))
        expected = pachon.trace(lsst_r, rays, "all")[4].position
        assert np.array_equal(traced.positions(rays), expected, equal_nan=True)
