"""Analyses of rays that land on CCDs at their heights: a CCD that is lifted is a detector that is moved."""

import numpy as np
import pytest

import pachon
from pachon.core.errors import ConfigError, DomainError
from pachon.design.analyses.coatings import Coatings
from pachon.design.metrics.ghost_paths import GhostTrace, Reflectivities, ghost_pairs

TELESCOPE = pachon.load_telescope("lsst_v3.3_r")
LIFT = 20e-6
#: All CCDs lifted alike, and the detector moved by as much.
LIFTED = pachon.FocalPlane.flat()
for _raft in LIFTED.camera.raft_names:
    LIFTED = LIFTED.with_moved(_raft, dz=LIFT)
MOVED = TELESCOPE.perturbed("Detector", shift=(0.0, 0.0, LIFT))
#: Not in a gap between CCDs.
FIELDS = pachon.fields_at(TELESCOPE, LIFTED.camera.centers[[94, 10]] + 1e-3)


@pytest.mark.parametrize(
    "analysis",
    [
        lambda t, **on: pachon.spots(t, FIELDS, n_pupil=5, **on).rms_radius,
        lambda t, **on: pachon.through_focus(t, FIELDS, defocus=[0.0, 1e-5], n_pupil=5, **on).rms_radius,
        lambda t, **on: pachon.strehl(t, FIELDS[:1], from_psf=False, n_pupil=5, **on).rms_wavefront,
        lambda t, **on: (
            pachon.encircled_energy(t, FIELDS, kind="geometric", n_pupil=200, radii=[5e-6, 2e-5], **on).fraction
        ),
        pytest.param(
            lambda t, **on: pachon.encircled_energy(t, FIELDS[:1], radii=[3e-6], **on).fraction, marks=pytest.mark.long
        ),
        pytest.param(lambda t, **on: pachon.strehl(t, FIELDS[:1], **on).psf, marks=pytest.mark.long),
        lambda t, **on: pachon.fft_psf(t, FIELDS[:1], pixels=9, n_pupil=64, pixel=2e-6, **on).strehl,
    ],
)
def test_a_focal_plane_that_is_lifted_is_a_detector_that_is_moved(analysis):
    # Rounding of rays that go on from one surface rather than to another.
    np.testing.assert_allclose(analysis(TELESCOPE, focal_plane=LIFTED), analysis(MOVED), rtol=1e-6)
    assert np.abs(analysis(TELESCOPE) / analysis(MOVED) - 1.0).max() > 1e-2


@pytest.mark.parametrize(
    "analysis",
    [
        lambda r: pachon.wavefront_zernikes(r, jmax=11).coefficients,
        lambda r: pachon.ray_fans(r).displacement,
        lambda r: pachon.wavefront_opds(r, grid=8).value,
        lambda r: 1e-9 * pachon.huygens_psf(r, pixels=9, pixel=2e-6, sampling="gauss").image,
        lambda r: pachon.ghosts(r.at_fields(slice(1)), n_pupil=400, brightest=2).star,
        lambda r: pachon.design.chromatic_focus(r, zones=[0.8]).focus,
        lambda r: 1e-9 * pachon.mtf(r.at_fields(slice(1)), n_pupil=64).tangential,
    ],
)
def test_a_request_takes_its_focal_plane_along(analysis):
    flat, moved = (pachon.Request.of(t, FIELDS, 620e-9, n_pupil=4) for t in (TELESCOPE, MOVED))
    # The CCD is its tangent plane, and paths are metres in 1e-16.
    np.testing.assert_allclose(analysis(flat.on(LIFTED)), analysis(moved), rtol=0, atol=2e-11)


def test_images_stand_on_the_slope_of_a_ccd():
    """A CCD turned about its centre, on the axis, is a detector that is turned."""
    camera, angle = LIFTED.camera, 2e-3
    name = camera.ccd_names[int(camera.ccd_at(0.0, 0.0))]
    tilted = pachon.FocalPlane.flat().with_moved(name, rx=angle)
    turned = TELESCOPE.perturbed("Detector", tilt=(angle, 0.0, 0.0))
    field = pachon.fields_at(TELESCOPE, np.array([[0.0, 0.01]]))
    on_ccd, on_turned, flat = (
        pachon.fft_psf(t, field, pixels=17, n_pupil=128, pixel=2e-6, reference="chief", focal_plane=plane).image
        for t, plane in ((TELESCOPE, tilted), (turned, None), (TELESCOPE, None))
    )
    assert np.abs(on_ccd - on_turned).max() < 1e-3 * on_turned.max()
    assert np.abs(on_ccd - flat).max() > 0.1 * flat.max()


def test_light_between_the_ccds_is_lost():
    edge = LIFTED.camera.centers[94] + [LIFTED.camera.half_sizes[94, 0], 0.0]
    field = pachon.fields_at(TELESCOPE, edge[None])
    lit = pachon.spots(TELESCOPE, field, focal_plane=pachon.FocalPlane.flat()).lit_fraction
    request = pachon.Request.of(TELESCOPE, field, TELESCOPE.default_wavelength).on(pachon.FocalPlane.flat())
    assert pachon.design.throughput(request, sampling="gauss").lit_fraction[0] == pytest.approx(lit, abs=1e-12)
    nominal = pachon.spots(TELESCOPE, field)
    landing = nominal.displacement[0, 0] + nominal.reference_point[0]
    on_ccd = LIFTED.ccd_at(*landing.T) >= 0
    assert lit[0] == pytest.approx(nominal.weight[0, 0][on_ccd].sum(), abs=1e-12)
    assert 0.1 < lit[0] / nominal.lit_fraction[0] < 0.9


def test_ghosts_between_the_ccds_are_lost():
    request, plane = pachon.Request.of(TELESCOPE, FIELDS[:1], 620e-9, n_pupil=8), pachon.FocalPlane.flat()
    surfaces = Reflectivities(TELESCOPE, None, 0.15, Coatings(), 620e-9)
    pairs = [p for p in ghost_pairs(TELESCOPE) if "Filter_exit" in {TELESCOPE.surface_names[i] for i in p}]
    traces = [GhostTrace(TELESCOPE, request.launch(620e-9), surfaces, 1, on) for on in (None, plane)]
    full, cut = (list(t.ghosts(pairs)) for t in traces)
    on_ccds = [ghost.weight[plane.ccd_at(*ghost.position.T) >= 0].sum() for ghost in full]
    assert [ghost.weight.sum() for ghost in cut] == pytest.approx(on_ccds, rel=1e-12)
    assert sum(on_ccds) < 0.99 * sum(ghost.weight.sum() for ghost in full)


def test_a_focal_plane_beside_one_or_where_it_means_nothing_is_refused():
    request = pachon.Request.of(TELESCOPE, FIELDS).on(LIFTED)
    with pytest.raises(ConfigError, match=r"^focal_plane: given beside a Request, which has its own$"):
        pachon.spots(request, focal_plane=LIFTED)
    with pytest.raises(ConfigError, match=r"^focal_plane: expected none for images of targets"):
        pachon.design.target_image(pachon.Request.of(TELESCOPE, FIELDS[0]).on(LIFTED))
    with pytest.raises(ConfigError, match=r"^focal_plane: expected none for merit functions"):
        pachon.design.Beams.of(request)
    with pytest.raises(DomainError, match="focal plane"):
        pachon.Request.of(TELESCOPE.with_design(afocal=True), FIELDS).on(LIFTED)
