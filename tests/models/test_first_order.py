from dataclasses import replace

import numpy as np
import pytest
from conic_trace import fan_coefficients, trace

from pachon.core.errors import DomainError
from pachon.models.first_order import first_order, footprints, seidel_sums
from pachon.models.io.prescription import load_telescope
from pachon.models.media.medium import ConstantIndex
from pachon.models.shapes.freeform import Biconic
from pachon.models.shapes.shape import Conic, EvenAsphere, Plane
from pachon.models.shapes.sum import Sum
from pachon.models.surface import Interaction, Surface
from pachon.models.telescope import VACUUM, Telescope

LSST_NAMES = [f"lsst_v3.3_{band}" for band in "ugrizy"]


def telescope_of(rows, *, stop_z, diameter, field=0.01):
    """Build a telescope of (z, radius, conic, index after or None for a mirror)."""
    surfaces, medium = [], VACUUM
    for i, (z, radius, conic, after) in enumerate(rows):
        kind = Interaction.MIRROR if after is None else Interaction.REFRACT
        medium = medium if after is None else ConstantIndex(after)
        shape = Plane() if np.isinf(radius) else Conic(radius, conic)
        surfaces.append(Surface(f"s{i}", kind, shape, (0.0, 0.0, z), medium))
    return Telescope(
        name="test",
        surfaces=tuple(surfaces),
        stop_z=stop_z,
        pupil_diameter=diameter,
        pupil_obscuration=0.5,
        launch_distance=10.0,
        reference_sphere_radius=1.0,
        field_radius=field,
        field_limit=2 * field,
        wavelength_range=(3e-7, 1e-6),
        default_wavelength=5e-7,
    )


# A paraboloid alone; a Cassegrain with odd conics and a stop in front; a thick lens behind a stop; a mirror and a lens
# in one, immersed at the end in a medium of index 1.2.
SYSTEMS = {
    "mirror": ([(0.0, 4.0, -1.0, None)], 0.5, 0.4),
    "cassegrain": ([(0.0, 5.0, -0.7, None), (1.7, 2.0, -3.5, None)], 0.8, 0.4),
    "lens": ([(0.0, -1.1, 0.4, 1.5), (-0.05, 1.4, -0.3, 1.0)], 0.07, 0.08),
    "catadioptric": (
        [(0.0, 6.0, -0.5, None), (2.0, 3.5, 0.2, 1.4), (2.05, -5.0, 1.0, 1.0), (2.2, np.inf, 0.0, 1.2)],
        -0.4,
        0.5,
    ),
}


def test_a_paraboloid_has_the_textbook_figures():
    rows, stop_z, diameter = SYSTEMS["mirror"]
    figures = first_order(telescope_of(rows, stop_z=stop_z, diameter=diameter))
    assert figures.focal_length == pytest.approx(2.0, rel=1e-15)
    assert figures.f_number == pytest.approx(5.0, rel=1e-15)
    assert figures.back_focus == pytest.approx(2.0, rel=1e-15)
    assert figures.focus_z == pytest.approx(2.0, rel=1e-15)
    # 206265" over 2 m.
    assert figures.arcsec_per_um == pytest.approx(206264.806 / 2e6, rel=1e-8)
    # The stop 0.5 m in front is imaged by 1/s' = 1/2 - 1/0.5: 2/3 m behind the mirror, 4/3 times as large.
    assert figures.exit_pupil_z == pytest.approx(-2 / 3, rel=1e-14)
    assert figures.exit_pupil_diameter == pytest.approx(0.4 * 4 / 3, rel=1e-14)
    assert figures.effective_area == pytest.approx(np.pi * 0.04 * 0.75, rel=1e-14)


def test_a_stop_at_the_focus_makes_it_telecentric():
    rows, _, diameter = SYSTEMS["mirror"]
    figures = first_order(telescope_of(rows, stop_z=2.0, diameter=diameter))
    assert np.isinf(figures.exit_pupil_z)
    assert np.isinf(figures.exit_pupil_diameter)


@pytest.mark.parametrize("system", SYSTEMS)
def test_focus_is_where_a_close_ray_crosses_the_axis(system):
    rows, stop_z, diameter = SYSTEMS[system]
    figures = first_order(telescope_of(rows, stop_z=stop_z, diameter=diameter))
    h = 1e-5
    points, v = trace(rows, np.array([[0.0, h, stop_z]]), np.array([[0.0, 0.0, -1.0]]))
    slope = v[0, 1] / abs(v[0, 2])
    # A real ray at 10 um: third order adds parts of (1e-5)^2.
    assert figures.focus_z == pytest.approx(points[-1][0, 2] - points[-1][0, 1] * v[0, 2] / v[0, 1], rel=1e-8)
    n = 1.2 if system == "catadioptric" else 1.0
    assert figures.focal_length == pytest.approx(-h / slope / n, rel=1e-8)
    assert figures.back_focus == pytest.approx(-points[-1][0, 1] / slope, rel=1e-8)


@pytest.mark.parametrize("system", SYSTEMS)
def test_seidel_sums_are_the_third_order_coefficients_of_traced_rays(system):
    rows, stop_z, diameter = SYSTEMS[system]
    field = 1e-3
    telescope = telescope_of(rows, stop_z=stop_z, diameter=diameter, field=field)
    s1, s2, s3, s4, s5 = seidel_sums(telescope).total
    figures = first_order(telescope)
    # Welford (1986), chapter 8: y = y0 + (S1 r^3 + 3 S2 r^2 + (3 S3 + S4) r + S5) / (2 n u) along the meridional fan,
    # x = (S1 r^3 + (S3 + S4) r) / (2 n u) along the sagittal one, and n u = -1 / (2 f-number) of the marginal ray.
    scale = -1 / figures.f_number

    def coefficients(t, shrink=1.0):
        return fan_coefficients(rows, figures.focus_z, stop_z, shrink * diameter / 2, t)

    t = np.tan(field)
    # A tenth of the pupil, so that the Taylor series ends early; powers of the fan scale back exactly.
    shrink = 0.1
    y_plus, x_plus = coefficients(t, shrink)
    y_axis, _ = coefficients(0.0, shrink)
    spherical = y_axis[3] / shrink**3
    coma = y_plus[2] / shrink**2
    meridional = (y_plus[1] - y_axis[1]) / shrink
    sagittal = (x_plus[1] - y_axis[1]) / shrink
    # The chief ray at the field and at twice the field: y(2 t) - 2 y(t) = (8 - 2) times the cubic part.
    chief = [fan_coefficients(rows, figures.focus_z, stop_z, diameter / 20, k * t)[0][0] for k in (1, 2)]
    distortion = (chief[1] - 2 * chief[0]) / 6
    measured = np.array([spherical, coma, meridional, sagittal, distortion])
    expected = np.array([s1, 3 * s2, 3 * s3 + s4, s3 + s4, s5]) / scale
    # Higher orders are down by the squares of the field and of a hundredth of the pupil; rounding is 1e-16 m / 0.1^3.
    assert np.allclose(measured, expected, rtol=1e-4, atol=1e-12)


def test_an_aspheric_coefficient_acts_as_its_fourth_order_conic():
    # c^3 k / 8 r^4 and a4 r^4 are the same to third order.
    rows, stop_z, diameter = SYSTEMS["cassegrain"]
    conic = telescope_of(rows, stop_z=stop_z, diameter=diameter)
    surfaces = tuple(
        Surface(s.name, s.interaction, EvenAsphere(r, 0.0, (k / (8 * r**3), 1.0)), s.vertex, s.medium_after)
        for s, (_, r, k, _) in zip(conic.surfaces, rows, strict=True)
    )
    fields = {f: getattr(conic, f) for f in conic.__dataclass_fields__}
    even = Telescope(**(fields | {"surfaces": surfaces}))
    assert np.allclose(seidel_sums(even).contributions, seidel_sums(conic).contributions, rtol=1e-12, atol=1e-20)


def test_known_sums_of_a_sphere_and_a_paraboloid():
    # A sphere stopped at its centre has spherical aberration only; S1 = 2 y^4 / R^3, S4 = -2 H^2 / R (Petzval, n = 1).
    field = 1e-3
    sphere = telescope_of([(0.0, 4.0, 0.0, None)], stop_z=4.0, diameter=0.4, field=field)
    total = seidel_sums(sphere).total
    lagrange = 0.2 * np.tan(field)
    assert np.allclose(total[:4], [2 * 0.2**4 / 64, 0, 0, -2 * lagrange**2 / 4], rtol=1e-12, atol=1e-20)
    paraboloid = telescope_of([(0.0, 4.0, -1.0, None)], stop_z=0.0, diameter=0.4, field=field)
    assert seidel_sums(paraboloid).total[0] == pytest.approx(0.0, abs=1e-19)


@pytest.mark.parametrize("name", LSST_NAMES)
def test_the_lsst_is_f_1_23_of_10_31_m(name):
    figures = first_order(load_telescope(name))
    # 10.302 m in u to 10.314 m in y: the lenses disperse.
    assert figures.focal_length == pytest.approx(10.31, abs=0.01)
    assert figures.f_number == pytest.approx(1.23, abs=0.005)
    assert 0.0197 <= figures.arcsec_per_um <= 0.02003
    # The prescriptions are in best focus for the field, within 0.1 mm of the paraxial one.
    detector = load_telescope(name).surface("Detector").vertex[2]
    assert figures.focus_z == pytest.approx(detector, abs=1e-4)


@pytest.mark.parametrize("name", LSST_NAMES)
def test_lsst_first_order_equals_batoids_close_rays(name):
    batoid = pytest.importorskip("batoid")
    telescope = load_telescope(name)
    figures = first_order(telescope)
    optic = batoid.Optic.fromYaml(f"LSST_{name[-1]}.yaml")
    h, t = 1e-4, 1e-5
    position = np.array([[h, 0, 10.0], [0, 0, 10.0], [0, (10.0 - telescope.stop_z) * t, 10.0]])
    velocity = np.array([[0, 0, -1.0], [0, 0, -1.0], [0, -t, -1.0]])
    velocity /= np.linalg.norm(velocity, axis=1)[:, None]
    rays = batoid.RayVector(*position.T, *velocity.T, wavelength=telescope.default_wavelength)
    optic.trace(rays)
    slope = rays.vx[0] / rays.vz[0]
    # Real rays a tenth of a millimetre off: third order is down by 1e-9; batoid's refraction rounds at 1e-13 of slope.
    assert figures.focal_length == pytest.approx(abs(h / slope), rel=1e-7)
    height = telescope.surface("Detector").vertex[2]
    assert figures.focus_z == pytest.approx(height - rays.x[0] / slope, abs=1e-7)
    crossing = height - rays.y[2] * rays.vz[2] / rays.vy[2]
    assert figures.exit_pupil_z == pytest.approx(crossing, rel=1e-6)


def test_footprints_are_marginal_plus_chief_ray():
    rows, stop_z, diameter = SYSTEMS["cassegrain"]
    telescope = telescope_of(rows, stop_z=stop_z, diameter=diameter)
    # M1: the rim plus the chief ray's travel of 0.8 m; M2: the converging rim, and the chief ray reflected.
    t = np.tan(0.01)
    on_m1 = 0.2 + 0.8 * t
    on_m2 = 0.2 * (1 - 1.7 / 2.5) + abs(0.8 * t + 1.7 * (t - 0.8 * t / 2.5))
    assert np.allclose(footprints(telescope, 0.01), [on_m1, on_m2], rtol=1e-12)


def test_what_has_no_first_order_figures_is_refused():
    telescope = load_telescope("lsst_v3.3_r")
    for moved in (telescope.perturbed("M2", shift=(1e-3, 0, 0)), telescope.perturbed("M2", tilt=(1e-3, 0, 0))):
        with pytest.raises(DomainError, match="surface M2 of lsst_v3"):
            first_order(moved)
    # A shift along the axis, or a turn about it, keeps it centred.
    first_order(telescope.perturbed("M2", shift=(0, 0, 1e-3), tilt=(0, 0, 1.0)))
    with pytest.raises(DomainError, match="wavelength"):
        seidel_sums(telescope, wavelength=2e-6)
    mersenne = [(0.0, 4.0, -1.0, None), (1.5, 1.0, -1.0, None)]
    with pytest.raises(DomainError, match="expected one with a focus"):
        first_order(telescope_of(mersenne, stop_z=0.0, diameter=0.4))
    detector_alone = replace(telescope, surfaces=telescope.surfaces[-1:], groups={}, group_frames={})
    for function in (first_order, seidel_sums):
        with pytest.raises(DomainError, match="at least one mirror or lens surface"):
            function(detector_alone)


@pytest.mark.parametrize("turned", [False, True], ids=["curved along y", "curved along x"])
def test_a_cylindrical_lens(turned):
    """A cylinder has the focal length of its one curvature, by the lens maker's equation, not twice that."""
    shape = Biconic(np.inf, -0.1) if not turned else Biconic(-0.1, np.inf)
    base = telescope_of([(0.0, -0.1, 0.0, 1.5), (-0.01, np.inf, 0.0, 1.0)], stop_z=0.0, diameter=0.01)
    front, back = base.surfaces
    lens = replace(base, surfaces=(replace(front, shape=shape), back))
    found = first_order(lens)
    assert found.focal_length == pytest.approx(0.2, rel=1e-14)
    assert found.back_focus == pytest.approx(0.2 - 0.01 / 1.5, rel=1e-13)
    # The same lens, turned about the axis by a right angle.
    quarter = ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    again = replace(lens, surfaces=(replace(front, shape=shape, rotation=quarter), back))
    assert first_order(again).focal_length == pytest.approx(0.2, rel=1e-13)


def test_a_toroid_has_the_focal_length_of_the_plane_of_zemax():
    """Curvatures along y count where both act; turned by 45 degrees about the axis, their mean (Euler)."""
    base = telescope_of([(0.0, 0.2, 0.0, None)], stop_z=0.0, diameter=0.01)
    for part in (Biconic(0.4, 0.2), Sum((Biconic(0.4, np.inf), Biconic(np.inf, 0.2)))):
        mirror = replace(base.surfaces[0], shape=part)
        assert first_order(replace(base, surfaces=(mirror,))).focal_length == pytest.approx(0.1, rel=1e-14)
    c = np.sqrt(0.5)
    turned = replace(mirror, rotation=((c, -c, 0.0), (c, c, 0.0), (0.0, 0.0, 1.0)))
    assert first_order(replace(base, surfaces=(turned,))).focal_length == pytest.approx(0.5 / 3.75, rel=1e-14)


def near(system, distance):
    """Return a system with its object at a distance in front of the stop, on the axis."""
    rows, stop_z, diameter = SYSTEMS[system]
    return replace(telescope_of(rows, stop_z=stop_z, diameter=diameter), object_distance=stop_z + distance)


def axis_ray(telescope, rows, height):
    """Trace the ray from the axis of the object through a height in the pupil: where it ends, and its direction."""
    away = telescope.object_distance - telescope.stop_z
    direction = np.array([0.0, height, -away]) / np.hypot(height, away)
    points, v = trace(rows, np.array([[0.0, height, telescope.stop_z]]), direction[None])
    return points[-1][0], v[0]


@pytest.mark.parametrize("system", SYSTEMS)
def test_the_image_of_a_near_object_is_where_close_rays_cross(system):
    rows, stop_z, diameter = SYSTEMS[system]
    telescope = near(system, 30.0)
    figures = first_order(telescope)
    h, n = 1e-5, 1.2 if system == "catadioptric" else 1.0
    point, v = axis_ray(telescope, rows, h)
    slope = abs(v[1] / v[2])
    assert figures.image_z == pytest.approx(point[2] - point[1] * v[2] / v[1], rel=1e-8)
    # Lagrange's invariant: the magnification is the ratio of the optical slopes.
    assert abs(figures.magnification) == pytest.approx(h / 30.0 / (n * slope), rel=1e-8)
    assert figures.working_f_number == pytest.approx(h / (n * slope * diameter), rel=1e-8)
    # A chief ray from a height in the object lands where the magnification says, as close to the axis as that is.
    start = np.array([[0.0, 0.0, stop_z]])
    direction = np.array([[0.0, -h / 30.0, -1.0]]) / np.hypot(h / 30.0, 1.0)
    points, chief = trace(rows, start, direction)
    landed = points[-1][0, 1] + (figures.image_z - points[-1][0, 2]) * chief[0, 1] / chief[0, 2]
    assert landed == pytest.approx(figures.magnification * h, rel=1e-7)


def test_an_object_at_infinity_has_its_image_in_the_focus():
    rows, stop_z, diameter = SYSTEMS["cassegrain"]
    figures = first_order(telescope_of(rows, stop_z=stop_z, diameter=diameter))
    assert figures.image_z == figures.focus_z
    assert figures.magnification == 0.0
    assert figures.working_f_number == pytest.approx(abs(figures.f_number), rel=1e-14)


@pytest.mark.parametrize("system", SYSTEMS)
def test_spherical_aberration_of_a_near_object_is_that_of_traced_rays(system):
    rows, _, diameter = SYSTEMS[system]
    telescope = near(system, 30.0)
    figures, s1 = first_order(telescope), seidel_sums(telescope).total[0]

    def miss(height):
        point, v = axis_ray(telescope, rows, height)
        return point[1] + (figures.image_z - point[2]) * v[1] / v[2]

    # y = S1 r^3 / (2 n u) at the paraxial image; the next term is r^2 smaller and cancels between two rays.
    rim = 0.5 * diameter
    coefficients = np.array([miss(rim * r) / r**3 for r in (0.1, 0.2)])
    found = (4.0 * coefficients[0] - coefficients[1]) / 3.0
    assert abs(found) == pytest.approx(abs(s1) * figures.working_f_number, rel=1e-4)
    # It is another one than that of a star.
    assert abs(seidel_sums(replace(telescope, object_distance=np.inf)).total[0] / s1 - 1.0) > 1e-3


def test_a_sphere_images_its_centre_of_curvature_without_aberration():
    # Stop at the mirror: 1:1 about the stop, so that coma and distortion vanish by symmetry.
    sphere = telescope_of([(0.0, 4.0, 0.0, None)], stop_z=0.0, diameter=0.4, field=1e-2)
    sums = seidel_sums(replace(sphere, object_distance=4.0)).total
    assert np.allclose(sums[[0, 1, 4]], 0.0, atol=1e-18)
    assert abs(sums[2]) > 1e-6
    assert first_order(replace(sphere, object_distance=4.0)).magnification == pytest.approx(-1.0, rel=1e-14)


def test_in_a_telecentric_object_space_the_exit_pupil_is_the_back_focus():
    rows, stop_z, diameter = SYSTEMS["lens"]
    lens = replace(telescope_of(rows, stop_z=stop_z, diameter=diameter, field=0.02), object_distance=stop_z + 3.0)
    heights = {"fields": ((0.0, 0.0), (0.0, 0.05)), "field_type": "object_height"}
    telecentric = lens.with_design(aperture="object_na", aperture_value=0.01, stop="s1", telecentric=True, **heights)
    figures, usual = first_order(telecentric), first_order(lens)
    assert figures.exit_pupil_z == pytest.approx(figures.focus_z, rel=1e-13)
    for name in ("focal_length", "image_z", "magnification", "working_f_number"):
        assert getattr(figures, name) == pytest.approx(getattr(usual, name), rel=1e-13)
    # Diameter: the cone of the image at the distance of the pupil.
    away = abs(figures.image_z - figures.exit_pupil_z)
    assert figures.exit_pupil_diameter == pytest.approx(away / figures.working_f_number, rel=1e-12)
    # Spherical aberration and Petzval sum do not depend on where the stop is.
    moved, still = seidel_sums(telecentric).total, seidel_sums(lens).total
    assert moved[[0, 3]] == pytest.approx(still[[0, 3]], rel=1e-12)
    # Moving the stop from s to s' adds S1 times the ratio of the change of chief to marginal heights (Welford, 8.5).
    shift = 0.02 * 3.0 / (0.5 * diameter)
    assert abs(abs(moved[1] - still[1]) - shift * abs(still[0])) < 1e-3 * shift * abs(still[0])


def test_a_relay_without_power_has_an_image_and_a_magnification():
    # Two paraboloids of focal lengths 2 and 1 m with a common focus, the object in the focus of the first: -1/2.
    rows = [(0.0, 4.0, -1.0, None), (3.0, -2.0, -1.0, None)]
    relay = replace(telescope_of(rows, stop_z=0.5, diameter=0.1), object_distance=2.0)
    figures = first_order(relay)
    assert np.isinf(figures.focal_length)
    assert figures.magnification == pytest.approx(-0.5, rel=1e-12)
    # In the focus of the second mirror.
    assert figures.image_z == pytest.approx(2.0, rel=1e-12)
    with pytest.raises(DomainError, match="expected one with a focus"):
        first_order(replace(relay, object_distance=np.inf))
