"""Landing on CCD surfaces: against the height function itself, the mesh, and in the gaps."""

from dataclasses import replace

import numpy as np
import pytest

import pachon
from pachon.core.errors import DomainError
from pachon.models.camera.lsst import lsst_camera
from pachon.models.media.medium import ConstantIndex
from pachon.models.starting_designs.schmidt import schmidt
from pachon.raytrace.photons import PhotonBeam, land_photons
from pachon.raytrace.rays import RayStatus, field_direction
from pachon.wavefront.chief_rays import fields_at
from pachon.wavefront.pupil_optics import trace_pupils


@pytest.fixture(scope="module")
def focal_plane():
    return pachon.FocalPlane.from_budget("lsst", seed=4)


@pytest.fixture(scope="module")
def bundles(lsst_r, annulus_points):
    """Bundles of 60 rays to 40 places of the focal plane, drawn over all CCDs."""
    rng = np.random.default_rng(8)
    centers = lsst_camera().centers
    chosen = rng.choice(len(centers), 40, replace=False)
    positions = centers[chosen] + rng.uniform(-0.018, 0.018, (40, 2))
    fields = fields_at(lsst_r, positions)
    return [pachon.launch_rays(lsst_r, field, 620e-9, annulus_points(60, i)) for i, field in enumerate(fields)]


@pytest.mark.parametrize("heights", ["budget", "as built"])
def test_rays_end_on_the_surface_and_on_their_own_line(lsst_r, focal_plane, bundles, heights):
    if heights == "as built":
        focal_plane = pachon.FocalPlane.as_measured("lsstcam")
    for rays in bundles[:20]:
        flat = pachon.trace(lsst_r, rays)
        end = pachon.trace(lsst_r, rays, focal_plane=focal_plane)
        x, y, z = lsst_r.surfaces[-1].to_local(end.position).T
        on = end.ccd >= 0
        # Newton leaves 1e-14 m; the telescope frame stands 4.4 m away, so its rounding adds 1e-15.
        assert np.abs(z - focal_plane.height(x, y))[on].max() < 2e-14
        step = end.position - flat.position
        assert np.abs(np.cross(step, flat.direction)).max() < 2e-15
        assert np.allclose(end.path_length - flat.path_length, np.einsum("ij,ij->i", step, flat.direction), atol=1e-14)
        assert np.array_equal(end.ccd, focal_plane.ccd_at(x, y))


def test_heights_are_those_over_a_curved_detector():
    """A Schmidt camera with a CCD that follows its focal surface, tilted and 30 um above it."""
    telescope, grid = schmidt(0.5, 2.5), np.stack(np.meshgrid(*[np.linspace(-0.019, 0.019, 5)] * 2)).reshape(2, -1)
    table = {"x": grid[0], "y": grid[1], "z": 3e-5 + 2e-4 * grid[0] - 1e-4 * grid[1]}
    plane = pachon.FocalPlane.from_heights(table, "auxtel")
    field, pupil = np.deg2rad((0.7, -0.5)), tuple(np.random.default_rng(1).uniform(-0.15, 0.15, (2, 40)))
    end = pachon.trace(telescope, pachon.launch_rays(telescope, field, 590e-9, pupil), focal_plane=plane)
    detector = telescope.surfaces[-1]
    x, y, z = detector.to_local(end.position).T
    assert np.abs(z - detector.shape.sag(x, y) - plane.height(x, y)).max() < 1e-14
    optics = trace_pupils(telescope, [field], 590e-9, np.stack(pupil, axis=-1), focal_plane=plane)
    offset = detector.to_local(end.position) - detector.to_local(optics.reference_points)
    # The sphere departs from its tangent plane by 40 um squared over twice its radius.
    np.testing.assert_allclose(optics.displacement[0, 0], offset[:, :2], atol=1e-9)
    source = np.stack([-field_direction(*field), *np.zeros((2, 3))])
    beam = PhotonBeam(tuple(np.zeros((2, 40))), source, pupil, np.full(40, 590e-9))
    photons = land_photons(telescope, beam, focal_plane=plane)
    np.testing.assert_allclose(np.stack([photons.x, photons.y]), [x, y], atol=1e-12)


def test_lost_rays_leave_the_others_on_the_mesh(lsst_r, focal_plane, bundles):
    mesh, end = focal_plane.to_mesh(4), pachon.trace(lsst_r, bundles[0])
    position, direction = end.position.copy(), end.direction.copy()
    expected = pachon.raytrace.land_on_mesh(lsst_r.surfaces[-1], mesh, position, direction)
    position[7], direction[[7, 11]] = np.nan, np.nan
    landing = pachon.raytrace.land_on_mesh(lsst_r.surfaces[-1], mesh, position, direction)
    lost = np.isin(np.arange(60), [7, 11])
    assert (landing.facet[lost] == -1).all()
    assert (expected.facet[~lost] >= 0).any()
    np.testing.assert_array_equal(landing.position[~lost], expected.position[~lost])


@pytest.mark.slow
def test_mesh_agrees_to_the_facet_error(lsst_r, focal_plane, bundles):
    cells = 24
    mesh = focal_plane.to_mesh(cells)
    bound = focal_plane.facet_error(cells)
    worst = 0.0
    for rays in bundles:
        flat = pachon.trace(lsst_r, rays)
        exact = pachon.trace(lsst_r, rays, focal_plane=focal_plane)
        landing = pachon.raytrace.land_on_mesh(lsst_r.surfaces[-1], mesh, flat.position, flat.direction)
        on = (exact.ccd >= 0) & (landing.facet >= 0)
        assert on.mean() > 0.9
        # Measured along z, where the bound holds; 1e-3 for the slope of the surface under an oblique ray.
        off = np.abs(landing.position - exact.position)[on, 2]
        assert (off <= bound[exact.ccd[on]] * (1 + 1e-3) + 1e-14).all()
        worst = max(worst, (off / bound[exact.ccd[on]]).max())
    # The bound is not idle: some ray comes within a factor of twenty of it.
    assert worst > 0.05


@pytest.mark.long
def test_finer_mesh_converges_as_the_square_of_its_cells(lsst_r, focal_plane, bundles):
    errors = []
    for cells in (8, 32):
        mesh, off = focal_plane.to_mesh(cells), []
        for rays in bundles[:8]:
            flat = pachon.trace(lsst_r, rays)
            exact = pachon.trace(lsst_r, rays, focal_plane=focal_plane)
            landing = pachon.raytrace.land_on_mesh(lsst_r.surfaces[-1], mesh, flat.position, flat.direction)
            on = (exact.ccd >= 0) & (landing.facet >= 0)
            off.append(np.abs(landing.position - exact.position)[on, 2])
        errors.append(np.sqrt(np.mean(np.concatenate(off) ** 2)))
    # A factor 16; 8 bundles sample few facets, so within 40 %.
    assert 9.6 < errors[0] / errors[1] < 22.4


def test_a_ray_in_a_gap_says_so(lsst_r, annulus_points):
    flat = pachon.FocalPlane.flat("lsst")
    # Between R22_S11 and R22_S12: CCD pitch 42.25 mm, CCD 40.96 mm.
    field = fields_at(lsst_r, [[0.5 * 0.04225, 0.0]])[0]
    rays = pachon.launch_rays(lsst_r, field, 620e-9, annulus_points(100))
    end = pachon.trace(lsst_r, rays, focal_plane=flat)
    assert (end.ccd == -1).all()
    assert set(end.status) <= {RayStatus.GAP, RayStatus.VIGNETTED}
    assert (end.status == RayStatus.GAP).any()
    nominal = pachon.trace(lsst_r, rays)
    assert np.array_equal(end.position, nominal.position)
    with pytest.raises(DomainError, match="between the CCDs"):
        pachon.wavefront_opd(lsst_r, field, 620e-9, grid=8, focal_plane=flat)


def test_cutting_a_batch_changes_no_byte(lsst_r, focal_plane, annulus_points):
    px, py = annulus_points(50)
    whole = pachon.trace(lsst_r, pachon.launch_rays(lsst_r, (0.02, 0.01), 620e-9, (px, py)), focal_plane=focal_plane)
    for part in (slice(0, 3), slice(3, 20), slice(20, None)):
        rays = pachon.launch_rays(lsst_r, (0.02, 0.01), 620e-9, (px[part], py[part]))
        end = pachon.trace(lsst_r, rays, focal_plane=focal_plane)
        assert np.array_equal(end.position, whole.position[part])
        assert np.array_equal(end.path_length, whole.path_length[part])


def test_the_last_step_is_in_the_medium_before_the_detector(lsst_r, annulus_points):
    # L3's exit face into water, and vacuum named behind the detector: what counts is the water in front of it.
    wet = replace(
        lsst_r,
        surfaces=(
            *lsst_r.surfaces[:-2],
            replace(lsst_r.surfaces[-2], medium_after=ConstantIndex(1.33)),
            lsst_r.surfaces[-1],
        ),
    )
    center = lsst_camera().centers[lsst_camera().ccd_index("R22_S11")]
    table = {"x": center[0] + np.array([0, 0.01, 0]), "y": center[1] + np.array([0, 0, 0.01]), "z": np.full(3, 1e-5)}
    rays = pachon.launch_rays(wet, (0.0, 0.0), 620e-9, annulus_points(20))
    flat = pachon.trace(wet, rays)
    end = pachon.trace(wet, rays, focal_plane=pachon.FocalPlane.from_heights(table))
    along = np.einsum("ij,ij->i", end.position - flat.position, flat.direction)
    assert along.min() > 1e-5
    # 30 m of path round to 4e-15 m.
    assert np.abs(end.path_length - flat.path_length - 1.33 * along).max() < 2e-14


def test_heights_follow_a_tilted_detector(lsst_r, annulus_points):
    table = {"x": [], "y": [], "z": []}
    center = lsst_camera().centers[lsst_camera().ccd_index("R22_S11")]
    for dx in (-0.01, 0.0, 0.01):
        for dy in (-0.01, 0.0, 0.01):
            table["x"].append(center[0] + dx)
            table["y"].append(center[1] + dy)
            table["z"].append(1e-5)
    raised = pachon.FocalPlane.from_heights(table)
    tilted = lsst_r.perturbed("Detector", tilt=(1e-3, 0.0, 0.0))
    rays = pachon.launch_rays(tilted, (0.0, 0.0), 620e-9, annulus_points(20))
    end = pachon.trace(tilted, rays, focal_plane=raised)
    # 10 um along the detector's own normal, everywhere on the CCD.
    assert np.abs(tilted.surfaces[-1].to_local(end.position)[:, 2] - 1e-5).max() < 1e-14
