"""The bundled telescopes against batoid: landing points, optical paths, wavefronts, and which rays are blocked."""

from dataclasses import replace

import numpy as np
import pytest

import pachon
from pachon.models.io.bundled import BUNDLED
from pachon.models.io.glass_search import find_glass
from pachon.models.media.tabulated import TabulatedIndex
from pachon.raytrace.rays import RayStatus

batoid = pytest.importorskip("batoid")

# Name of batoid's file, and a wavelength at either end of what the telescope is for [nm].
PEERS = {
    **{f"rubin_v3.14_{band}": (f"Rubin_v3.14_{band}.yaml", 330, 1100) for band in "ugrizy"},
    "lsst_v3.3_r_obstructed": ("LSST_r_baffles.yaml", 552, 691),
    "comcam_r": ("ComCam_r.yaml", 552, 691),
    "auxtel": ("AuxTel.yaml", 400, 1000),
    "decam": ("DECam.yaml", 350, 1050),
    "hsc": ("HSC.yaml", 420, 1050),
}
# 0.1 nm in position and path; the designs ask for 1 nm. HSC's steepest lenses amplify rounding to 30 pm.
NEAR = 1e-10
WEDGES = ("L1_entrance", "Filter_entrance", "Filter_exit", "L2_entrance", "L3_entrance")


def optic_of(name):
    optic = batoid.Optic.fromYaml(PEERS[name][0])
    if name == "auxtel":
        # The slanted faces of the lenses: batoid 0.9.0's Tilted takes (-tan, sqrt(1 - tan^2)) for their normal, which
        # is off by 0.5 mrad for the filter's slope of 0.1, and moves the image by 1.6 um. A tilted Plane has the right
        # one.
        for wedge in WEDGES:
            slope = optic[wedge].surface.tany
            optic = optic.withSurface(wedge, batoid.Plane())
            optic = optic.withLocallyRotatedOptic(wedge, batoid.RotX(np.arctan(slope)))
    return optic


#: Indices of batoid's tables for HSC, between whose wavelengths it draws straight lines.
HSC_INDICES = {
    "silica": (1.47009272, 1.45801158, 1.45421013, 1.45172729, 1.44917721),
    "BSL7Y": (1.53123287, 1.51671428, 1.51225242, 1.50939738, 1.50653251),
    "PBL1Y": (1.57046066, 1.54784671, 1.54157395, 1.53789058, 1.53457169),
}
HSC_WAVELENGTHS = (0.4e-6, 0.6e-6, 0.75e-6, 0.9e-6, 1.1e-6)


def telescope_of(name):
    """Return the bundled telescope, HSC with batoid's glasses."""
    telescope = pachon.load_telescope(name)
    if name != "hsc":
        return telescope
    surfaces = []
    for surface in telescope.surfaces:
        if (glass := surface.medium_after).name in HSC_INDICES:
            indices = HSC_INDICES[glass.name]
            np.testing.assert_allclose(glass.index(HSC_WAVELENGTHS), indices, atol=3e-10)
            table = TabulatedIndex(HSC_WAVELENGTHS, indices, interpolation="linear", name=glass.name)
            surface = replace(surface, medium_after=table)
        surfaces.append(surface)
    return replace(telescope, surfaces=tuple(surfaces))


def test_glasses_of_hsc_have_the_dispersion_of_their_kind():
    """Indices of melts, in cold air; straight lines were off by 4e-3."""
    wavelengths = np.linspace(0.4e-6, 1.1e-6, 50)
    media = {s.medium_after.name: s.medium_after for s in pachon.load_telescope("hsc").surfaces}
    for name, bound in (("silica", 1e-5), ("BSL7Y", 2.5e-5), ("PBL1Y", 1.2e-4)):
        catalogue = pachon.load_telescope("lsst_v3.3_r").surface("L1_entrance").medium_after
        if name != "silica":
            catalogue = find_glass(name, makers=("ohara",))
        difference = media[name].index(wavelengths) - catalogue.index(wavelengths)
        assert np.ptp(difference) < bound, name


def fields_of(telescope):
    """Return the centre of the field, a place half-way and two at its rim, in no special direction."""
    radius = telescope.field_radius
    return [(0.0, 0.0)] + [
        (f * radius * np.cos(a), f * radius * np.sin(a)) for f, a in ((0.5, 2.0), (0.999, 0.4), (0.999, 4.1))
    ]


def peer_rays(optic, telescope, field, wavelength, pupil):
    rays = batoid.RayVector.fromStop(
        *pupil, optic=optic, wavelength=wavelength, theta_x=field[0], theta_y=field[1], projection="zemax"
    )
    optic.trace(rays)
    return rays


def test_every_bundled_telescope_has_a_peer():
    elsewhere = {n for n in BUNDLED if n.startswith("lsst_v3.3_") and n != "lsst_v3.3_r_obstructed"}
    assert set(PEERS) | elsewhere | {"paul_baker"} == set(BUNDLED)


@pytest.mark.parametrize("name", PEERS)
def test_rays_land_where_batoids_do_and_are_blocked_where_they_are(name):
    telescope, optic = telescope_of(name), optic_of(name)
    rng = np.random.default_rng(4)
    for wavelength in (PEERS[name][1] * 1e-9, telescope.default_wavelength, PEERS[name][2] * 1e-9):
        for field in fields_of(telescope):
            pupil = rng.uniform(-0.51, 0.51, (2, 400)) * telescope.pupil_diameter
            ours = pachon.trace(telescope, pachon.launch_rays(telescope, field, wavelength, pupil))
            theirs = peer_rays(optic, telescope, field, wavelength, pupil)
            # Far outside the lenses of HSC both lose some rays, if not always the same: neither counts as light.
            met = ~theirs.failed & (ours.status <= RayStatus.VIGNETTED)
            assert (~theirs.vignetted & met).sum() > 50
            position = theirs.toCoordSys(batoid.CoordSys()).r
            assert np.abs(ours.position - position)[met].max() < NEAR
            assert np.abs(ours.path_length - theirs.t)[met].max() < NEAR
            assert np.array_equal(ours.vignetted, theirs.vignetted | theirs.failed)


@pytest.mark.parametrize("name", PEERS)
def test_wavefronts_are_batoids(name):
    telescope, optic = telescope_of(name), optic_of(name)
    wavelength = telescope.default_wavelength
    size = 20
    # batoid's even grid of n points: spacing D / (n - 2), from -n/2 steps.
    axis = (np.arange(size) - size // 2) / (size - 2) * telescope.pupil_diameter
    pupil = np.meshgrid(axis, axis)
    # The outermost points of the axes lie on the rim itself, to either side of it by rounding.
    off_rim = np.abs(np.hypot(*pupil) - 0.5 * telescope.pupil_diameter) > 1e-9
    for field in fields_of(telescope)[1:3]:
        theirs = batoid.analysis.wavefront(optic, *field, wavelength, projection="zemax", nx=size)
        ours = pachon.wavefront_opd(telescope, field, wavelength, pupil)
        lit = ours.lit & ~theirs.array.mask
        assert lit.sum() > 50
        assert np.array_equal(ours.lit[off_rim], ~theirs.array.mask[off_rim])
        assert np.abs(ours.waves - theirs.array)[lit].max() * wavelength < NEAR


def clear_part(telescope, field, pupil):
    rays = pachon.launch_rays(telescope, field, telescope.default_wavelength, pupil)
    return 1.0 - pachon.trace(telescope, rays).vignetted.mean()


def test_the_light_of_the_lsst_with_baffles_over_the_field():
    telescope, optic = pachon.load_telescope("lsst_v3.3_r_obstructed"), optic_of("lsst_v3.3_r_obstructed")
    # Points of equal area over the annulus of the pupil, so that a fraction of rays is one of light.
    i = np.arange(8000)
    radius = 4.18 * np.sqrt(0.6**2 + (1 - 0.6**2) * (i + 0.5) / 8000)
    angle = 2 * np.pi * ((i * 0.618033988749895) % 1)
    pupil = radius * np.cos(angle), radius * np.sin(angle)
    degrees = np.array([0.0, 0.4, 0.8, 1.0, 1.2, 1.4, 1.6, 1.75])
    ours, theirs = [], []
    for field in np.deg2rad(degrees) / np.sqrt(2.0):
        ours.append(clear_part(telescope, (field, field), pupil))
        rays = peer_rays(optic, telescope, (field, field), telescope.default_wavelength, pupil)
        theirs.append(1.0 - rays.vignetted.mean())
    assert np.array_equal(ours, theirs)
    light = np.array(ours) / ours[0]
    assert np.all(np.diff(light) < 0)
    # Jee & Tyson (2011), sec. 2: "flat" to 1.2 deg and 10 % down at 1.75 deg. Of the later v3.3 design the rim of M2
    # takes 1.7 % at 1.2 deg and the baffles 0.5 %; at the edge it is 11 %, 10 % without them.
    assert 1 - light[degrees == 0.8][0] < 0.01
    assert 1 - light[degrees == 1.2][0] == pytest.approx(0.022, abs=0.003)
    assert 1 - light[-1] == pytest.approx(0.109, abs=0.005)
