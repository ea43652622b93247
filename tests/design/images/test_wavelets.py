"""Wavelets: aimed rays, light, and what cannot be imaged."""

from pathlib import Path

import numpy as np
import pytest

import pachon
from pachon.core.errors import DomainError
from pachon.design.images.diffraction import fft_psf
from pachon.design.images.mtf import mtf
from pachon.design.images.wavelets import lattice_wavelets, spot_reach, traced_wavelets
from pachon.design.metrics.spots import spots
from pachon.design.metrics.vignetting import vignetting
from pachon.wavefront.pupil_sampling import gauss_annulus, square_annulus
from pachon.wavefront.request import Request

DATA = Path(__file__).parents[2] / "data" / "zmx"


@pytest.mark.parametrize("angle", [(0.0, 0.0), (0.0, 1.75), (-0.9, 1.1)])
def test_the_light_of_a_lattice_is_what_is_not_vignetted(lsst_r, angle):
    field = np.deg2rad(angle)
    center = spots(lsst_r, field).reference_point[0]
    lattice = lattice_wavelets(Request.of(lsst_r, field), 620e-9, center, 0.81 / 128)
    expected = vignetting(lsst_r, [field], 620e-9, n_pupil=40000)
    # A cell that a rim crosses is known to 1/36 of it, and there are some 600 of them among 8000.
    assert lattice.wavelets.lit_fraction == pytest.approx(expected.lit_fraction[0], abs=1e-3)


def test_both_kinds_have_the_same_peak_if_perfect(lsst_r):
    field = np.deg2rad([0.4, 0.9])
    center = spots(lsst_r, field).reference_point[0]
    traced = traced_wavelets(Request.of(lsst_r, field, sampling=square_annulus(4.18, 0.612, 200)), 620e-9, center)
    aimed = lattice_wavelets(Request.of(lsst_r, field), 620e-9, center, 0.81 / 200).wavelets
    assert aimed.perfect_peak == pytest.approx(traced.perfect_peak, rel=2e-3)
    assert aimed.lit_fraction == pytest.approx(traced.lit_fraction, rel=2e-3)


def test_a_turned_lattice_has_the_same_light_in_other_cells(lsst_r):
    field = np.deg2rad([0.4, 0.9])
    center = spots(lsst_r, field).reference_point[0]
    one, other = (lattice_wavelets(Request.of(lsst_r, field), 620e-9, center, 0.81 / 128, a) for a in (0.0, 0.7))
    assert other.wavelets.lit_fraction == pytest.approx(one.wavelets.lit_fraction, abs=1e-3)
    rows = other.wavelets.cosine[:, 1:] - other.wavelets.cosine[:, :-1]
    assert rows == pytest.approx(np.broadcast_to(other.spacing * np.array([np.cos(0.7), np.sin(0.7)]), rows.shape))


def test_rays_that_go_astray_beyond_a_rim_do_no_harm():
    # At the edge of its field a third of HSC's rays are stopped, some of them by total reflection.
    telescope = pachon.load_telescope("hsc")
    field = np.array([0.0, telescope.field_radius])
    center = spots(telescope, field).reference_point[0]
    lattice = lattice_wavelets(Request.of(telescope, field), 770e-9, center, 0.4 / 128)
    expected = vignetting(telescope, [field], 770e-9, n_pupil=40000).lit_fraction[0]
    assert expected < 0.7
    assert lattice.wavelets.lit_fraction == pytest.approx(expected, abs=2e-3)


def test_a_few_stray_rays_do_not_set_the_scale(paraboloid):
    diagram = spots(paraboloid(f_number=20.0, shift=1e-3), [[0.0, 0.0]], sampling=gauss_annulus(0.05, 0.0, 20, 60))
    # 99 % of the light of a disc of 25 um, and a tenth more.
    assert spot_reach(diagram) == pytest.approx(1.1 * np.sqrt(0.99) * 25e-6, rel=0.02)


def test_parallel_light_makes_no_image(paraboloid):
    telescope = paraboloid(focal_length=1e7, f_number=1e8)
    for measure in (fft_psf, mtf):
        with pytest.raises(DomainError, match="focal ratio"):
            measure(telescope, [[0.0, 0.0]])


HEAD = """name: parallel
source: none
version: "1"
units: {length: m, angle: deg, wavelength: um}
stop: {z: 0.0}
pupil: {diameter: 0.05, obscuration: 0.0}
launch_distance: 2.0
reference_sphere_radius: 1.0
field: {radius: 0.2, limit: 0.5}
wavelengths: {range: [0.4, 0.7], default: 0.5}
surfaces:
"""
#: Two paraboloids with one focus: light of the axis is parallel behind them, that of other fields is not quite.
EXPANDER = """  - {name: M1, type: mirror, shape: paraboloid, z: 0.0, radius: 2.0}
  - {name: M2, type: mirror, shape: paraboloid, z: 0.8, radius: 0.4}
  - {name: Exit, type: detector, shape: plane, z: -0.1}
"""
CYLINDER = """  - {name: M1, type: mirror, shape: toroid, z: 0.0, radius_x: flat, radius_y: 2.0, conic_y: -1}
  - {name: Image, type: detector, shape: plane, z: 1.0}
"""


def test_light_that_is_parallel_at_one_field_makes_no_image(tmp_path):
    """It ended in a division by zero: the focal ratio of another field is finite."""
    (tmp_path / "expander.yaml").write_text(HEAD + EXPANDER)
    telescope = pachon.load_telescope(tmp_path / "expander.yaml")
    for measure in (fft_psf, mtf):
        with pytest.raises(DomainError, match=r"focal ratio above 1e\+07"):
            measure(telescope, [[0.0, 0.0], [0.0, np.deg2rad(0.2)]])


def test_light_that_is_parallel_in_one_plane_has_no_lattice(tmp_path):
    (tmp_path / "cylinder.yaml").write_text(HEAD + CYLINDER)
    telescope = pachon.load_telescope(tmp_path / "cylinder.yaml")
    request = Request.of(telescope, [[0.0, 0.0]], sampling=square_annulus(0.025, 0.0, 16), wavelengths=500e-9)
    with pytest.raises(DomainError, match="all rays have directions in one plane; expected a pupil"):
        lattice_wavelets(request, 500e-9, np.zeros(2), 1e-4)


def test_aimed_rays_of_a_field_with_vignetting_factors():
    lens = pachon.load_telescope(DATA / "circular_aperture_example_with_aperture.zmx")
    factors = (0.1, -0.05, 0.3, 0.2, 0.4)
    lens = lens.with_design(aiming="real", fields=((0.0, np.deg2rad(20.0)),), field_weights=(), vignetting=(factors,))
    wavelength = lens.default_wavelength
    request = Request.of(lens, sampling=square_annulus(0.5 * lens.pupil_diameter, 0.0, 160), wavelengths=wavelength)
    center = spots(lens, wavelengths=wavelength).reference_point[0]
    traced = traced_wavelets(request, wavelength, center)
    aimed = lattice_wavelets(request, wavelength, center, np.ptp(traced.cosine, axis=0).max() / 160).wavelets
    # The same light on the same area of directions; squares represent the rim of either kind to some parts in 1000.
    assert 0.9 < traced.lit_fraction / (0.7 * 0.8) <= 1.0
    assert aimed.lit_fraction == pytest.approx(traced.lit_fraction, rel=3e-3)
    assert aimed.perfect_peak == pytest.approx(traced.perfect_peak, rel=3e-3)
    # Rays of like directions have like paths.
    lit = np.argwhere(aimed.amplitude > 0)[::97]
    for row, column in lit:
        away = np.linalg.norm(traced.cosine - aimed.cosine[row, column], axis=-1) + (traced.amplitude == 0)
        near = np.argsort(away)[:12]
        plane = np.column_stack([np.ones(12), traced.cosine[near] - aimed.cosine[row, column]])
        expected = np.linalg.lstsq(plane, traced.opd[near], rcond=None)[0][0]
        assert aimed.opd[row, column] == pytest.approx(expected, abs=0.02 * np.ptp(traced.opd))
