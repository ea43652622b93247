"""Fans, field curvature and distortion beside optiland's, on systems of the same numbers."""

import numpy as np
import pytest

import pachon
from pachon.models.media.medium import ConstantIndex
from pachon.models.shapes.shape import Conic, Plane
from pachon.models.surface import Interaction, Surface
from pachon.models.telescope import VACUUM, Telescope

WAVELENGTH = 0.55e-6
#: Rows of radius, thickness [mm], index behind (0: mirror) and conic; the stop is a plane in front of the first, by the
#: first thickness; diameter of the pupil [mm] and field [deg].
SYSTEMS = {
    "singlet": ([(None, 5.0, 1.0, 0.0), (50.0, 4.0, 1.5168, 0.0), (-200.0, 74.0, 1.0, 0.0)], 10.0, 8.0),
    # Kingslake's achromat: crown in front.
    "doublet": (
        [(None, 2.0, 1.0, 0.0), (61.47, 6.0, 1.5168, 0.0), (-44.64, 2.5, 1.6727, 0.0), (-129.94, 95.0, 1.0, 0.0)],
        20.0,
        3.0,
    ),
    # The Cooke triplet of optiland's samples, with its stop in front.
    "triplet": (
        [
            (None, 1.0, 1.0, 0.0),
            (22.01359, 3.25896, 1.62041, 0.0),
            (-435.76044, 6.00755, 1.0, 0.0),
            (-22.21328, 0.99997, 1.62005, 0.0),
            (20.29192, 4.75041, 1.0, 0.0),
            (79.6836, 2.95208, 1.62041, 0.0),
            (-18.39533, 42.20778, 1.0, 0.0),
        ],
        8.0,
        10.0,
    ),
    # A Ritchey-Chretien, its primary the stop.
    "ritchey-chretien": ([(None, 0.0, 1.0, 0.0), (-4000.0, -1500.0, 0, -1.06), (-1400.0, 1800.0, 0, -3.1)], 800.0, 0.4),
}


def ours(rows, diameter, field):
    """Our telescope: light travels down, so a thickness and a radius change sign."""
    surfaces, z, medium = [], 0.0, VACUUM
    for i, (radius, thickness, index, conic) in enumerate(rows):
        if radius is not None:
            mirror = index == 0
            medium = medium if mirror else ConstantIndex(index) if index != 1 else VACUUM
            kind = Interaction.MIRROR if mirror else Interaction.REFRACT
            surfaces.append(Surface(f"S{i}", kind, Conic(-1e-3 * radius, conic), (0.0, 0.0, z), medium))
        z -= 1e-3 * thickness
    surfaces.append(Surface("image", Interaction.DETECTOR, Plane(), (0.0, 0.0, z), VACUUM))
    angle = np.deg2rad(field)
    return Telescope(
        name="lens", surfaces=tuple(surfaces), stop_z=0.0, pupil_diameter=1e-3 * diameter, pupil_obscuration=0.0,
        launch_distance=3.0, reference_sphere_radius=1.0, field_radius=angle, field_limit=2 * angle,
        wavelength_range=(0.4e-6, 0.8e-6), default_wavelength=WAVELENGTH,
    )  # fmt: skip


def theirs(rows, diameter, field):
    materials = pytest.importorskip("optiland.materials")
    from optiland.optic import Optic

    optic = Optic()
    optic.surfaces.add(index=0, radius=np.inf, thickness=np.inf)
    for i, (radius, thickness, index, conic) in enumerate(rows):
        glass = "mirror" if index == 0 else materials.IdealMaterial(n=index) if index != 1 else "air"
        options = {"radius": np.inf if radius is None else radius, "conic": conic, "is_stop": i == 0}
        optic.surfaces.add(index=i + 1, thickness=thickness, material=glass, **options)
    optic.surfaces.add(index=len(rows) + 1)
    optic.set_aperture(aperture_type="EPD", value=diameter)
    optic.fields.set_type(field_type="angle")
    optic.fields.add(y=0)
    optic.fields.add(y=field)
    optic.wavelengths.add(value=WAVELENGTH * 1e6, is_primary=True)
    return optic


@pytest.mark.slow
@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.filterwarnings("ignore")
def test_fans_curvature_and_distortion(name):
    theirs_, mine = theirs(*SYSTEMS[name]), ours(*SYSTEMS[name])
    from optiland.analysis.distortion import Distortion
    from optiland.analysis.field_curvature import FieldCurvature
    from optiland.analysis.ray_fan import RayFan
    from optiland.wavefront import OPDFan

    # Light that goes along +z there goes along -z here, up and down stay: y keeps its sign. An even number of mirrors.
    field = mine.field_radius
    places = [(0.0, 0.0), (0.0, field)]
    fans = pachon.ray_fans(mine, places, n_points=17).along * 1e3
    data = RayFan(theirs_, num_points=17).data
    for i, one in enumerate(["(0.0, 0.0)", "(0.0, 1.0)"]):
        found = data[next(k for k in data if k.replace("np.float64", "").replace("(0, ", "(0.0, ") == one)]
        found = next(iter(found.values()))
        # A nanometre: 1e-6 mm.
        assert fans[i, 0, 0] == pytest.approx(np.asarray(found["y"]), abs=1e-6)
        assert np.abs(fans[i, 0, 1]) == pytest.approx(np.abs(np.asarray(found["x"])), abs=1e-6)
    line = np.stack([np.zeros(5), np.linspace(0.0, 1.0, 5) * field], axis=-1)
    curvature = pachon.field_curvature(mine, line)
    (foci,) = FieldCurvature(theirs_, num_points=5).data
    # Their rays, 1e-5 of the pupil apart, are rounded to some 10 nm.
    assert curvature.tangential[:, 0] * 1e3 == pytest.approx(np.asarray(foci[0]), abs=3e-4)
    assert curvature.sagittal[:, 0] * 1e3 == pytest.approx(np.asarray(foci[1]), abs=3e-4)
    (percent,) = Distortion(theirs_, num_points=5).data
    # They scale with 1e-10 of the field, we with 1e-4 rad.
    assert curvature.distortion[1:, 0] == pytest.approx(np.asarray(percent)[1:], abs=1e-4)
    optics = pachon.first_order(mine)
    # From the image to the exit pupil, along the light.
    distance = mine.surfaces[-1].vertex[2] - optics.exit_pupil_z
    opd = OPDFan(theirs_, num_rays=17)
    for i, place in enumerate(places):
        height = float(np.linalg.norm(mine.surfaces[-1].to_local(chief(mine, place))[:2]))
        radius = float(np.copysign(np.hypot(distance, height), distance))
        waves = pachon.design.opd_fans(mine, [place], n_points=17, sphere_radius=radius).waves[0, 0]
        found = np.asarray(opd.get_data(opd.fields[i], opd.wavelengths[0]).opd)
        x, y = np.asarray(opd.distribution.x), np.asarray(opd.distribution.y)
        for fan, along, across in ((0, y, x), (1, x, y)):
            on_fan = np.abs(across) < 1e-12
            there = np.argsort(along[on_fan])
            expected = np.interp(np.linspace(-1, 1, 17), along[on_fan][there], found[on_fan][there])
            # Left and right may be exchanged across the field, where the fan is symmetric.
            assert waves[fan] == pytest.approx(expected, abs=1e-3)


def chief(telescope, place):
    rays = pachon.launch_rays(telescope, place, WAVELENGTH, ([0.0], [0.0]))
    return pachon.trace(telescope, rays).position[0]


@pytest.mark.slow
@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.filterwarnings("ignore")
def test_seidel_sums(name):
    optic, mine = theirs(*SYSTEMS[name]), ours(*SYSTEMS[name])
    # Theirs are in mm and of the other sign.
    expected = -1e-3 * np.asarray(optic.aberrations.seidels()).ravel() / np.array([8, 2, 2, 4, 2])
    assert pachon.design.seidel_diagram(mine).coefficients[:, :5].sum(axis=0) == pytest.approx(
        expected, rel=1e-9, abs=1e-18
    )


@pytest.mark.slow
def test_fringe_zernikes():
    zernike = pytest.importorskip("optiland.zernike")
    radius, angle = np.random.default_rng(3).uniform([0.0, -np.pi], [1.0, np.pi], (20, 2)).T
    mine = pachon.models.fringe_zernikes(36, radius * np.cos(angle), radius * np.sin(angle))
    for j in range(36):
        one = zernike.ZernikeFringe(coeffs=np.eye(36)[j])
        assert mine[j] == pytest.approx(np.asarray(one.poly(radius, angle)), abs=1e-10), j + 1
