"""Gratings written for optiland, against optiland's own rays."""

import warnings

import numpy as np
import pytest

import pachon
from pachon.models.media.medium import ConstantIndex
from pachon.models.rotation import rotation_matrix
from pachon.models.telescope import VACUUM

pytest.importorskip("optiland")

# The tables of materials take seconds to load.
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]
WAVELENGTH = 550e-9


def axes(*degrees):
    return tuple(map(tuple, rotation_matrix(np.radians(degrees)).tolist()))


def spectrograph(interaction, shape, grating, *, tilt, after=VACUUM, before=VACUUM):
    """One grating and a plane in the way of its light."""
    ruled = pachon.Surface(
        "ruled", pachon.Interaction[interaction], shape, (0.0, 0.0, 0.0), after, rotation=axes(*tilt), grating=grating
    )
    behind = 0.2 if interaction == "MIRROR" else -0.2
    detector = pachon.Surface("Detector", pachon.Interaction.DETECTOR, pachon.Plane(), (0.0, 0.0, behind), after)
    return pachon.Telescope(
        "spectrograph", (ruled, detector), stop_z=0.0, pupil_diameter=0.03, pupil_obscuration=0.0, launch_distance=2.0,
        reference_sphere_radius=1.0, field_radius=0.01, field_limit=0.2, wavelength_range=(4e-7, 8e-7),
        default_wavelength=WAVELENGTH, band=(5e-7, 6e-7), medium_before=before,
    )  # fmt: skip


def landing_points(telescope, path, points, field):
    """Where rays through points of the pupil [m] land, here and in optiland [m]."""
    from optiland.fileio import load_optiland_file
    from optiland.rays import RealRays

    pachon.save_telescope(telescope, path)
    surfaces = list(load_optiland_file(str(path)).surfaces)[1:]
    offset = 1 if surfaces[0].comment == "pachon entrance pupil" else 0
    height = float(np.ravel(surfaces[offset].geometry.cs.z)[0]) + 1e3 * telescope.surfaces[0].vertex[2]
    rays = pachon.launch_rays(telescope, field, WAVELENGTH, points)
    x, y, z = (rays.position * [-1e3, 1e3, -1e3]).T
    along = (rays.direction * [-1.0, 1.0, -1.0]).T
    peer = RealRays(x, y, z + height, *along, np.ones(x.size), np.full(x.size, WAVELENGTH * 1e6))
    for surface in surfaces:
        peer = surface.trace(peer)
    end = pachon.trace(telescope, rays)
    assert (end.status == pachon.RayStatus.OK).all()
    theirs = np.stack([np.asarray(v) for v in (peer.x, peer.y, np.asarray(peer.z) - height)], axis=-1)
    return end.position, theirs * [-1e-3, 1e-3, -1e-3]


PLANE = [
    ("MIRROR", (12.0, -7.0, 20.0), pachon.models.Grating(2, 300.0, 0.4), VACUUM),
    ("MIRROR", (35.0, 5.0, 0.0), pachon.models.Grating(1, 1200.0, 0.0), VACUUM),
    ("REFRACT", (5.0, 3.0, 0.0), pachon.models.Grating(-1, 600.0, -0.7), VACUUM),
    ("REFRACT", (5.0, 3.0, 0.0), pachon.models.Grating(3, 100.0, 1.3), ConstantIndex(1.6)),
    # An echelle in conical incidence.
    ("MIRROR", (0.0, 6.0, 0.0), pachon.models.Grating(40, 31.6, 0.0), VACUUM),
]


@pytest.mark.parametrize(("interaction", "tilt", "grating", "after"), PLANE)
def test_plane_gratings(interaction, tilt, grating, after, tmp_path):
    telescope = spectrograph(interaction, pachon.Plane(), grating, tilt=tilt, after=after)
    x, y = np.meshgrid(np.linspace(-0.01, 0.01, 5), np.linspace(-0.01, 0.01, 5))
    ours, theirs = landing_points(telescope, tmp_path / "ours.json", (x.ravel(), y.ravel()), (0.01, -0.02))
    assert np.abs(ours - theirs).max() < 1e-13


CURVED = [
    ("MIRROR", pachon.Sphere(0.5), VACUUM),
    ("MIRROR", pachon.Conic(-0.4, -1.3), VACUUM),
    ("REFRACT", pachon.Sphere(0.5), VACUUM),
    ("REFRACT", pachon.Sphere(-0.3), ConstantIndex(1.6)),
]


@pytest.mark.parametrize(("interaction", "shape", "after"), CURVED)
def test_curved_gratings_in_their_plane_of_symmetry(interaction, shape, after, tmp_path):
    """Elsewhere optiland divides the period by the length of a vector along the surface, and not across the grooves."""
    telescope = spectrograph(interaction, shape, pachon.models.Grating(1, 300.0), tilt=(7.0, 0.0, 0.0), after=after)
    y = np.linspace(-0.012, 0.012, 9)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        ours, theirs = landing_points(telescope, tmp_path / "ours.json", (0.0 * y, y), (0.0, 0.03))
    assert np.abs(ours - theirs).max() < 1e-13
    x, skew = np.meshgrid(np.linspace(-0.01, 0.01, 5), y)
    ours, theirs = landing_points(telescope, tmp_path / "ours.json", (x.ravel(), skew.ravel()), (0.02, 0.03))
    assert np.abs(ours - theirs).max() < 2e-4
