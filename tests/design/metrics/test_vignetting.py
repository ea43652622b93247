import numpy as np
import pytest

from pachon.core.errors import DomainError, UnknownNameError
from pachon.core.plotting import png_bytes
from pachon.design.metrics.footprint import footprint
from pachon.design.metrics.vignetting import field_disc, vignetting
from pachon.models.aperture import Circle
from pachon.wavefront.pupil_sampling import spiral_annulus


def lens(radius, distance):
    """Common part of two equal discs, over the area of one."""
    half = np.clip(distance / (2 * radius), 0, 1)
    return (2 * np.arccos(half) - 2 * half * np.sqrt(1 - half**2)) / np.pi


def test_a_tube_in_front_cuts_the_pupil_as_two_discs_do(paraboloid):
    radius, height = 0.05, 2.5
    tube = paraboloid(2.0, 20.0, baffle=(height, radius))
    angles = np.deg2rad([0.0, 0.3, 0.9, 1.5, 2.0])
    fields = np.stack([angles * np.cos(0.4), angles * np.sin(0.4)], axis=-1)
    result = vignetting(tube, fields, projection="gnomonic", n_pupil=40000)
    expected = lens(radius, height * angles)
    assert result.axis_fraction == 1.0
    # Three standard errors as estimated, which are a few in ten thousand.
    assert (np.abs(result.lit_fraction - expected) <= 3 * result.error + 1e-12).all()
    assert result.error.max() < 1e-3
    assert result.error[1:].min() > 0
    assert result.relative == pytest.approx(expected, abs=1e-3)


def test_the_lsst_loses_a_tenth_at_the_edge_and_little_before(lsst_r):
    result = vignetting(lsst_r, np.deg2rad([[0.0, 0.6], [0.0, 1.0], [0.0, 1.2], [1.75, 0.0]]))
    assert result.relative[0] == pytest.approx(1.0, abs=1e-3)
    # "Flat to 1.2 deg", where 1.7 % are lost, and "about 10 %" at the edge.
    assert result.relative[1:3] == pytest.approx([0.991, 0.983], abs=2e-3)
    assert result.relative[3] == pytest.approx(0.9, abs=0.01)


def test_rays_are_lost_where_batoid_loses_them(lsst_r):
    batoid = pytest.importorskip("batoid")
    optic = batoid.Optic.fromYaml("LSST_r.yaml")
    fields = np.deg2rad([[0.0, 0.9], [1.1, 1.1], [-1.7, 0.3]])
    result = vignetting(lsst_r, fields, 622e-9, n_pupil=4000)
    pupil = spiral_annulus(4.18, 0.612, 4000).points.T
    for field, fraction in zip(fields, result.lit_fraction, strict=True):
        rays = batoid.RayVector.fromStop(
            *pupil, optic=optic, wavelength=622e-9, theta_x=field[0], theta_y=field[1], projection="zemax"
        )
        optic.trace(rays)
        assert fraction == pytest.approx((~rays.vignetted).mean(), abs=1e-12)


def test_it_says_how_far_it_is(lsst_r):
    done = []
    vignetting(lsst_r, field_disc(lsst_r, 1, 4), n_pupil=200_000, progress=done.append)
    # Two fields at a time, and the axis once more.
    assert done == [2, 2, 2]


@pytest.mark.long
def test_profile_and_map(lsst_r):
    result = vignetting(lsst_r, field_disc(lsst_r, 4, 12), n_pupil=500)
    assert png_bytes(result.plot()).startswith(b"\x89PNG")
    summary = result.summary()
    assert summary["smallest_relative"] == min(summary["relative"])
    few = vignetting(lsst_r, [[0.0, 0.0]], n_pupil=64)
    assert few.lit_fraction == [1.0]
    assert png_bytes(few.plot()).startswith(b"\x89PNG")


def test_footprints_of_a_tube_are_shifted_circles(paraboloid):
    radius, height = 0.05, 2.5
    tube = paraboloid(2.0, 20.0, baffle=(height, radius), aperture=Circle(radius))
    slope = 0.01
    result = footprint(tube, ["baffle", "mirror"], [[slope, 0.0]], projection="gnomonic")
    baffle, mirror = result.surfaces
    # Light that reaches the pupil's plane at p crossed the baffle at p - height * slope.
    center = [-height * slope, 0.0]
    distance = np.linalg.norm(baffle.outlines[0, 0] - center, axis=-1)
    assert distance == pytest.approx(radius, rel=2e-6)
    assert np.isnan(baffle.outlines[0, 1]).all()
    assert baffle.largest_radius[0] == pytest.approx(radius + height * slope, rel=1e-5)
    lost = 1 - lens(radius, height * slope)
    # Rings of 24: the edge cuts through two hundred cells of some thousands.
    assert baffle.blocked_fraction[0] == pytest.approx(lost, abs=5e-3)
    # On the mirror, below the pupil's plane by its sag, the light has its own place; almost none is lost there.
    assert mirror.blocked_fraction[0] < 5e-3
    assert (mirror.arriving == baffle.passing).all()
    assert (result.summary()["surfaces"][1]["arriving_fraction"][0]) == pytest.approx(1 - lost, abs=5e-3)


def test_what_surfaces_block_adds_up_to_the_vignetting(lsst_r):
    fields = np.deg2rad([[0.0, 0.0], [0.0, 1.5], [1.2, 1.2]])
    result = footprint(lsst_r, None, fields, sampling="spiral")
    blocked = sum(s.blocked_fraction for s in result.surfaces)
    lit = vignetting(lsst_r, fields, n_pupil=2000)
    assert 1 - blocked == pytest.approx(lit.lit_fraction, abs=1e-12)
    assert [s.surface.name for s in result.surfaces] == list(lsst_r.surface_names)
    # The primary is the stop: its footprint is the pupil, whatever the field.
    assert result.surfaces[0].largest_radius == pytest.approx([4.18] * 3, rel=2e-6)


@pytest.mark.long
def test_pictures_of_footprints(lsst_r, paraboloid):
    assert png_bytes(footprint(lsst_r, "M2").plot()).startswith(b"\x89PNG")
    assert png_bytes(footprint(lsst_r, ["L1_exit", "Detector"], field_disc(lsst_r, 2, 8)).plot()).startswith(b"\x89P")
    dark = paraboloid(baffle=(4.0, 0.01))
    lost = footprint(dark, None, np.deg2rad([[0.0, 1.9]]))
    assert np.isnan(lost.surfaces[-1].largest_radius[0])
    assert png_bytes(lost.plot()).startswith(b"\x89PNG")


def test_bad_input_is_refused(lsst_r, paraboloid):
    with pytest.raises(DomainError, match="n_pupil = 3: expected a whole number of at least 16"):
        vignetting(lsst_r, n_pupil=3)
    dark = paraboloid(2.0, 20.0, obscuration=0.5, aperture=Circle(0.01))
    with pytest.raises(DomainError, match="expected one with light on the axis"):
        vignetting(dark, [[0.0, 0.0]])
    with pytest.raises(UnknownNameError, match=r"unknown surface of lsst_v3\.3_r 'M4'"):
        footprint(lsst_r, "M4")
    with pytest.raises(DomainError, match=r"surfaces = \[\]"):
        footprint(lsst_r, [])


def test_the_scatter_of_a_telescope_without_vignetting_is_no_structure_of_the_plot(paraboloid):
    profile, sky_map, _ = vignetting(paraboloid(), n_pupil=64).plot().axes
    assert profile.get_ylim()[0] < 95.0
    assert sky_map.collections[0].get_clim() == (95.0, 100.0)
