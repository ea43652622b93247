"""Spectrographs against theory: Rowland circle, Czerny-Turner, echelle in conical incidence."""

from dataclasses import replace

import numpy as np
import pytest

import pachon
from pachon.design.optimize.targets import ChiefRay
from pachon.models.parameters.parameters import apply
from pachon.models.rotation import rotation_matrix
from pachon.models.telescope import VACUUM
from pachon.wavefront.pupil_sampling import pupil_sampling

WAVELENGTH = 550e-9


def axes(*degrees):
    return tuple(map(tuple, rotation_matrix(np.radians(degrees)).tolist()))


def spectrograph(*surfaces, **changes):
    basis = {
        "stop_z": 0.0, "pupil_diameter": 0.04, "pupil_obscuration": 0.0, "launch_distance": 3.0,
        "reference_sphere_radius": 1.0, "field_radius": 0.001, "field_limit": 0.1, "wavelength_range": (2e-7, 2e-6),
        "default_wavelength": WAVELENGTH, "band": (5e-7, 6e-7),
    }  # fmt: skip
    return pachon.Telescope("spectrograph", surfaces, **(basis | changes))


#: Radius of the concave grating [m], angle of incidence [rad], grooves [1/m].
RADIUS, INCIDENCE, LINES = 1.0, np.radians(20.0), 1.2e6


def rowland(defocus=0.0):
    """A concave grating of 1200 lines per mm, entrance slit and detector on its Rowland circle."""
    turn = rotation_matrix([INCIDENCE, 0.0, 0.0])
    sine = WAVELENGTH * LINES - np.sin(INCIDENCE)
    leaving = turn @ [0.0, sine, np.sqrt(1.0 - sine**2)]
    reach = RADIUS * np.sqrt(1.0 - sine**2) + defocus
    ruled = pachon.Surface(
        "grating", pachon.Interaction.MIRROR, pachon.Sphere(RADIUS), (0.0, 0.0, 0.0), VACUUM,
        rotation=tuple(map(tuple, turn.tolist())), grating=pachon.models.Grating(1, 1e-3 * LINES),
    )  # fmt: skip
    # The detector across the light, its z axis along it.
    x = np.array([1.0, 0.0, 0.0])
    frame = np.stack([x, np.cross(leaving, x), leaving], axis=1)
    screen = pachon.Surface(
        "Detector", pachon.Interaction.DETECTOR, pachon.Plane(), tuple((reach * leaving).tolist()), VACUUM,
        rotation=tuple(map(tuple, frame.tolist())),
    )  # fmt: skip
    distance = RADIUS * np.cos(INCIDENCE)
    return spectrograph(ruled, screen, object_distance=distance, reference_sphere_radius=float(reach)), sine


def point_paths(telescope, points):
    """The path from the slit by points of the grating to the middle of the detector: no law of refraction in it."""
    ruled, screen = telescope.surfaces
    slit = np.array([0.0, 0.0, telescope.object_distance])
    local = ruled.to_local(points)
    lengths = np.linalg.norm(points - slit, axis=1) + np.linalg.norm(points - screen.vertex, axis=1)
    return lengths + WAVELENGTH * LINES * local[:, 1]


def test_the_wavefront_of_a_rowland_circle():
    telescope, sine = rowland()
    axis = np.linspace(-0.02, 0.02, 21)
    x, y = (v.ravel() for v in np.meshgrid(axis, axis))
    opd = pachon.wavefront_opd(telescope, (0.0, 0.0), WAVELENGTH, pupil=(x, y))
    rays = pachon.launch_rays(telescope, (0.0, 0.0), WAVELENGTH, (x, y))
    points = pachon.trace(telescope, rays, "all")[0].position
    middle = point_paths(telescope, np.zeros((1, 3)))
    expected = middle - point_paths(telescope, points)
    lit = opd.lit.ravel()
    assert lit.sum() > 300
    # Paths along rays to the sphere behind the image, and to the point: the two differ by the square of the distance at
    # which a ray passes it, here up to 4 mm of astigmatism, over the radius.
    landed = telescope.surfaces[1].to_local(pachon.trace(telescope, rays).position)
    second = np.sum(landed[:, :2] ** 2, axis=1) / telescope.reference_sphere_radius
    difference = opd.value.ravel() - expected
    assert np.abs(np.abs(difference) - second)[lit].max() < 0.05 * second[lit].max()
    assert np.abs(difference[(x == 0.0) & lit]).max() < 1e-11
    # In the meridian neither defocus nor coma is left, and the fourth order is that of theory (Beutler, JOSA 35, 311).
    middle_row = (x == 0.0) & lit
    w = telescope.surfaces[0].to_local(points[middle_row])[:, 1]
    fourth = np.sin(INCIDENCE) ** 2 / np.cos(INCIDENCE) + sine**2 / np.sqrt(1.0 - sine**2)
    theory = -fourth * w**4 / (8.0 * RADIUS**3)
    # The next orders are w / R of it.
    assert np.abs(opd.value.ravel()[middle_row] - theory).max() < 0.05 * np.abs(theory).max()
    # Astigmatism along the grooves, of the second order.
    across = (np.abs(y) < 1e-12) & lit
    height = telescope.surfaces[0].to_local(points[across])[:, 0]
    astigmatism = 0.5 * fourth * height**2 / RADIUS
    assert np.abs(expected[across] + astigmatism).max() < 2e-3 * astigmatism.max()


def test_the_focus_is_on_the_rowland_circle():
    """A shift of the detector along the light by e defocuses in the meridian by e cos^2 b w^2 / (2 r'^2)."""
    telescope, sine = rowland()
    y = np.linspace(-0.02, 0.02, 41)
    values = {}
    for shift in (-1e-3, 0.0, 1e-3):
        moved, _ = rowland(shift)
        values[shift] = pachon.wavefront_opd(moved, (0.0, 0.0), WAVELENGTH, pupil=(0.0 * y, y)).value
    ruled = pachon.trace(telescope, pachon.launch_rays(telescope, (0.0, 0.0), WAVELENGTH, (0.0 * y, y)), "all")[0]
    w = telescope.surfaces[0].to_local(ruled.position)[:, 1]
    defocus = 0.5 * (values[1e-3] - values[-1e-3])
    reach = telescope.reference_sphere_radius
    expected = 0.5 * 1e-3 * (1.0 - sine**2) * w**2 / reach**2
    lit = np.isfinite(defocus)
    fourth = np.sin(INCIDENCE) ** 2 / np.cos(INCIDENCE) + sine**2 / np.sqrt(1.0 - sine**2)
    assert np.abs(np.abs(defocus) - expected)[lit].max() < 0.05 * expected[lit].max()
    assert np.nanmax(np.abs(values[0.0])) < 1.1 * fourth * np.max(w**4) / (8.0 * RADIUS**3)


#: Focal length of collimator and camera [m], and the angle at which each turns the light [rad].
FOCAL, FOLD = 0.5, np.radians(8.0)


def czerny_turner():
    """Two spherical mirrors and a plane grating of 600 lines per mm between them, in the plane of y and z."""

    def frame(normal):
        x = np.array([1.0, 0.0, 0.0])
        return tuple(map(tuple, np.stack([x, np.cross(normal, x), normal], axis=1).tolist()))

    def turned(direction, angle):
        return rotation_matrix([angle, 0.0, 0.0]) @ direction

    down = np.array([0.0, 0.0, -1.0])
    up = turned(-down, FOLD)
    bisector = (up - down) / np.linalg.norm(up - down)
    collimator = pachon.Surface(
        "collimator", pachon.Interaction.MIRROR, pachon.Sphere(2 * FOCAL), (0.0, 0.0, 0.0), VACUUM,
        rotation=frame(bisector),
    )  # fmt: skip
    place = 0.5 * up
    normal = turned(-up, np.radians(25.0))
    ruled = pachon.Surface(
        "grating", pachon.Interaction.MIRROR, pachon.Plane(), tuple(place.tolist()), VACUUM, rotation=frame(normal),
        grating=pachon.models.Grating(1, 600.0),
    )  # fmt: skip
    incoming = ruled.along(up)
    sine = incoming[1] + WAVELENGTH * 6e5
    leaving = ruled.matrix @ [0.0, sine, np.sqrt(1.0 - sine**2)]
    camera_place = place + 0.4 * leaving
    back = turned(-leaving, FOLD)
    bisector = (back - leaving) / np.linalg.norm(back - leaving)
    camera = pachon.Surface(
        "camera", pachon.Interaction.MIRROR, pachon.Sphere(2 * FOCAL), tuple(camera_place.tolist()), VACUUM,
        rotation=frame(bisector),
    )  # fmt: skip
    screen = pachon.Surface(
        "Detector", pachon.Interaction.DETECTOR, pachon.Plane(), tuple((camera_place + FOCAL * back).tolist()), VACUUM,
        rotation=frame(back),
    )  # fmt: skip
    # The slit in the focus of the collimator, on the axis.
    telescope = spectrograph(
        collimator, ruled, camera, screen, object_distance=FOCAL, pupil_diameter=0.02, reference_sphere_radius=FOCAL
    )
    return telescope, incoming[1], sine


def test_the_dispersion_of_a_czerny_turner():
    """A wavelength lands at f times the tangent of its angle from the middle one, m / (spacing cos b) a wavelength."""
    telescope, incidence, sine = czerny_turner()
    wavelengths = WAVELENGTH + np.linspace(-10e-9, 10e-9, 9)
    landed = []
    for wavelength in wavelengths:
        end = pachon.trace(telescope, pachon.launch_rays(telescope, (0.0, 0.0), wavelength, ([0.0], [0.0])))
        assert end.status[0] == pachon.RayStatus.OK
        landed.append(telescope.surfaces[-1].to_local(end.position)[0])
    landed = np.array(landed)
    assert np.abs(landed[:, 0]).max() < 1e-16
    assert np.abs(landed[4]).max() < 1e-15
    angle = np.arcsin(incidence + wavelengths * 6e5) - np.arcsin(sine)
    # Paraxially over the camera 0.4 m behind the grating, whose tangential focal length is R cos / 2.
    reach = 0.4 + FOCAL - 0.4 * FOCAL / (FOCAL * np.cos(0.5 * FOLD))
    # The square of the slopes at the edge, 6 mrad, and of the asymmetry of the mirror.
    assert np.abs(np.abs(landed[:, 1]) - np.abs(reach * np.tan(angle))).max() < 1e-3 * np.abs(landed[:, 1]).max()
    dispersion = (landed[5, 1] - landed[3, 1]) / (wavelengths[5] - wavelengths[3])
    assert abs(dispersion) == pytest.approx(reach * 6e5 / np.sqrt(1.0 - sine**2), rel=1e-4)


def test_spectral_lines_are_images_of_the_slit():
    """Half a nanometre apart, the lines of a point of the slit are as far apart as theory has it."""
    telescope, _, sine = czerny_turner()
    middle, beside = (
        pachon.spots(telescope, [[0.0, 0.0]], wavelength).reference_point.reshape(2)
        for wavelength in (WAVELENGTH, WAVELENGTH + 0.5e-9)
    )
    expected = 0.5e-9 * FOCAL * 6e5 / np.sqrt(1.0 - sine**2)
    assert np.linalg.norm(beside - middle) == pytest.approx(expected, rel=0.01)


#: Grooves of the echelle [1/m], its blaze angle R2 [rad], the angle out of the plane of dispersion [rad].
ECHELLE, BLAZE, GAMMA = 31.6e3, np.arctan(2.0), np.radians(6.0)


@pytest.mark.parametrize("order", range(-120, -59, 10))
def test_an_echelle_in_conical_incidence(order):
    """m wavelength / spacing = cos g (sin a + sin b), and the angle g to the grooves' normal plane stays."""
    wavelength = 2.0 * np.sin(BLAZE) * np.cos(GAMMA) / (abs(order) * ECHELLE)
    ruled = pachon.Surface(
        "echelle", pachon.Interaction.MIRROR, pachon.Plane(), (0.0, 0.0, 0.0), VACUUM,
        rotation=axes(-np.degrees(BLAZE), 0.0, 0.0), grating=pachon.models.Grating(order, 1e-3 * ECHELLE),
    )  # fmt: skip
    telescope = spectrograph(ruled, field_limit=0.3)
    direction = np.array([[np.sin(GAMMA), 0.0, -np.cos(GAMMA)]])
    for shift in (-2e-9, 0.0, 3e-9):
        ray = pachon.Rays(-direction, direction, np.zeros(1), wavelength + shift)
        end = pachon.trace(telescope, ray)
        x, y, _ = ruled.along(end.direction)[0]
        incidence = -np.arcsin(ruled.along(direction)[0, 1] / np.cos(GAMMA))
        diffracted = np.arcsin(order * (wavelength + shift) * ECHELLE / np.cos(GAMMA) - np.sin(incidence))
        assert x == pytest.approx(np.sin(GAMMA), abs=1e-15)
        assert y == pytest.approx(-np.cos(GAMMA) * np.sin(-diffracted), abs=2e-15)
        if shift == 0.0:
            # Littrow but for the angle out of the plane: the light returns.
            assert np.allclose(end.direction[0], direction[0] * [1.0, 1.0, -1.0], atol=2e-15)


def stop_behind_a_grating():
    """A telescope of a concave grating and a stop behind it."""
    ruled = pachon.Surface(
        "grating", pachon.Interaction.MIRROR, pachon.Sphere(1.0), (0.0, 0.0, 0.0), VACUUM,
        rotation=axes(10.0, 0.0, 0.0), grating=pachon.models.Grating(1, 300.0),
    )  # fmt: skip
    sine = WAVELENGTH * 3e5 - np.sin(np.radians(10.0))
    leaving = ruled.matrix @ [0.0, sine, np.sqrt(1.0 - sine**2)]
    stop = pachon.Surface("stop", pachon.Interaction.PASS, pachon.Plane(), tuple((0.2 * leaving).tolist()), VACUUM)
    screen = pachon.Surface(
        "Detector", pachon.Interaction.DETECTOR, pachon.Plane(), tuple((0.48 * leaving).tolist()), VACUUM
    )
    return spectrograph(ruled, stop, screen)


def test_rays_are_aimed_at_a_stop_behind_a_grating():
    telescope = stop_behind_a_grating()
    aimed = telescope.with_design(
        stop="stop", aiming="real", aperture="entrance_pupil", aperture_value=0.04, fields=((0.0, 0.0),)
    )
    points = (np.array([0.0, 0.01, 0.0]), np.array([0.0, 0.0, 0.015]))
    rays = pachon.launch_rays(aimed, (0.002, -0.001), WAVELENGTH, points)
    at_stop = telescope.surfaces[1].to_local(pachon.trace(aimed, rays, "all")[1].position)
    assert np.abs(at_stop[0, :2]).max() < 1e-9


# No other test needs the kernel of photons of any wavelength through any telescope, which takes 20 s to compile. It has
# the loops of two kernels that others need: photons through lenses and mirrors, and rays through any telescope.
@pytest.mark.slow
def test_photons_of_a_wavelength_each_land_where_rays_of_it_do():
    telescope = stop_behind_a_grating()
    rng = np.random.default_rng(7)
    wavelengths = rng.uniform(5e-7, 6e-7, 100)
    x, y = rng.uniform(-0.01, 0.01, (2, 100))
    from pachon.raytrace.photons import PhotonBeam, land_photons

    source = np.array([[0.001, 0.002, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    landed = land_photons(telescope, PhotonBeam((0.0 * x, 0.0 * y), source, (x, y), wavelengths))
    assert landed.lit.all()
    for i in range(0, 100, 9):
        direction = -source[:1] / np.linalg.norm(source[0])
        start = np.array([x[i], y[i], 0.0]) - 2.0 * direction
        ray = pachon.Rays(start, direction, np.zeros(1), float(wavelengths[i]))
        end = telescope.surfaces[-1].to_local(pachon.trace(telescope, ray).position)[0]
        assert np.allclose([landed.x[i], landed.y[i]], end[:2], atol=1e-15)


def test_a_lost_order_is_dark_and_does_not_spoil_others():
    telescope, _ = rowland()
    ruled, screen = telescope.surfaces
    steep = replace(telescope, surfaces=(replace(ruled, grating=pachon.models.Grating(2, 1400.0)), screen))
    with pytest.raises(pachon.errors.DomainError, match="order 2 of the grating grating does not exist at 900 nm"):
        pachon.wavefront_opd(steep, (0.0, 0.0), 900e-9, grid=16)
    end = pachon.trace(steep, pachon.launch_rays(steep, (0.0, 0.0), 900e-9, ([0.0], [0.0])))
    assert end.status[0] == pachon.RayStatus.EVANESCENT
    assert np.isnan(end.position).all()


def test_sensitivities_by_grooves():
    """Turned grooves are a turned sphere; the terms by lines are those of differences."""
    telescope, _ = rowland()
    pupil = pupil_sampling(telescope, "square", 16)
    names = ["grating.lines_per_mm", "grating.groove_angle", "grating.rz"]
    found = pachon.sensitivity(telescope, names, np.zeros((1, 2)), sampling=pupil, n_zernike=11)
    lines, angle, turn = np.moveaxis(found.matrix[0], -1, 0)
    assert np.abs(angle - turn)[3:].max() < 1e-10 * np.abs(turn[3:]).max()

    def terms(h):
        moved = apply(telescope, {"grating.lines_per_mm": h})
        return pachon.sensitivity(moved, names[:1], np.zeros((1, 2)), sampling=pupil, n_zernike=11).zernikes[0]

    step = 1.0
    near, far = ((terms(k * step) - terms(-k * step)) / (2 * k * step) for k in (1.0, 2.0))
    numeric = (4.0 * near - far) / 3.0
    assert np.abs(lines - numeric).max() < 1e-7 * np.abs(numeric).max()


@pytest.mark.long
def test_an_optimisation_finds_the_lines_of_a_grating():
    """Lines and their direction are those that bring the light back to the middle of the detector."""
    telescope, _ = rowland()
    ruled = replace(telescope.surfaces[0], grating=pachon.models.Grating(1, 1197.0, 0.002))
    start = replace(telescope, surfaces=(ruled, *telescope.surfaces[1:]))
    names = ["grating.lines_per_mm", "grating.groove_angle"]
    targets = [ChiefRay((0.0, 0.0), axis, value=0.0, weight=100.0) for axis in ("x", "y")]
    found = pachon.optimize(start, names, "spots", np.zeros((1, 2)), targets=targets)
    assert found.values == pytest.approx([1200.0, 0.0], abs=1e-5)


def test_only_gratings_have_grooves():
    telescope, _ = rowland()
    with pytest.raises(pachon.PachonError, match=r"'Detector\.lines_per_mm': expected a surface with a grating"):
        apply(telescope, {"Detector.lines_per_mm": 1.0})
