from dataclasses import replace

import numpy as np
import pytest

import pachon
from pachon.core.errors import DomainError
from pachon.design.metrics.through_focus import through_focus


def test_defocus_in_closed_form(paraboloid):
    f_number, wavelength, shift = 20.0, 5e-7, 2e-4
    result = pachon.strehl(paraboloid(2.0, f_number, shift=shift), [(0.0, 0.0)], wavelength)
    rim = shift / (8 * f_number**2)
    # W = rim rho^2: rms rim / sqrt(12), Strehl sinc^2; at f/20 to (1 / 4N)^2 and its square.
    assert result.rms_wavefront[0, 0] == pytest.approx(rim / np.sqrt(12), rel=1e-3)
    assert result.wavefront[0, 0] == pytest.approx(np.sinc(rim / wavelength) ** 2, rel=1e-3)
    assert result.marechal[0, 0] == pytest.approx(np.exp(-((2 * np.pi * rim / wavelength) ** 2) / 12), rel=1e-3)
    # The lattice of the image, 128 points across.
    assert result.psf[0, 0] == pytest.approx(result.wavefront[0, 0], abs=5e-3)


def test_the_image_may_be_left_out(paraboloid):
    result = pachon.strehl(paraboloid(2.0, 20.0), [(0.0, 0.0)], [4e-7, 6e-7], from_psf=False)
    assert np.isnan(result.psf).all()
    assert result.wavefront == pytest.approx(1.0, abs=1e-9)
    assert result.summary()["strehl_of_psf"] == [[None, None]]


def test_the_image_has_the_vignetting_of_the_wavefront(paraboloid):
    factors = ((0.0, 0.0, 0.0, 0.0, 0.0), (0.0, 0.2, 0.3, 0.4, 0.0))
    telescope = paraboloid(2.0, 20.0, shift=6e-4).with_design(
        field_type="angle", fields=((0.0, 0.0), (0.0, 1e-4)), vignetting=factors
    )
    result = pachon.strehl(telescope, wavelengths=5e-7)
    assert result.psf == pytest.approx(result.wavefront, abs=5e-3)
    unvignetted = pachon.strehl(telescope, telescope.design_data.fields, 5e-7)
    assert result.psf[1, 0] > unvignetted.psf[1, 0] + 0.1


def test_only_the_fields_of_large_aberrations_have_no_image(paraboloid):
    result = pachon.strehl(paraboloid(2.0, 1.5), [(0.0, 0.0), (0.0, 1e-2)], 5e-7)
    assert result.psf[0, 0] == pytest.approx(1.0, abs=1e-6)
    assert np.isnan(result.psf[1, 0])
    assert result.rms_wavefront[1, 0] > 1e-5


def test_the_narrow_peak_of_a_large_image(paraboloid):
    # The middle of a blur of 1000 wavelengths times the focal ratio across is a maximum, one Airy disc wide.
    f_number, wavelength = 20.0, 5e-7
    telescope = paraboloid(2.0, f_number, shift=8 * f_number**2 * 20.4 * wavelength)
    radius = 0.5 * telescope.pupil_diameter * np.sqrt((np.arange(4000) + 0.5) / 4000)
    # Against a plane: a sphere differs by the square of the blur over its radius.
    flat = replace(telescope, reference_sphere_radius=1e5)
    opd = pachon.wavefront_opd(flat, (0.0, 0.0), wavelength, (radius, 0.0 * radius)).value
    middle = abs(np.exp(2j * np.pi * opd / wavelength).mean()) ** 2
    # A lattice of 440 points makes it 3 % lower.
    assert pachon.strehl(telescope, [(0.0, 0.0)], wavelength).psf[0, 0] > 0.95 * middle


def test_parallel_light_is_refused_in_one_line(afocal):
    telescope, place = afocal(fold=False), [(0.0, 0.0)]
    for analyse in (pachon.field_curvature, pachon.design.spot_matrix, pachon.strehl):
        with pytest.raises(DomainError, match=r"focus|parallel|image"):
            analyse(telescope, place)
    with pytest.raises(DomainError, match="its light is parallel"):
        pachon.design.target_image(telescope)
    # Chief rays have landing points all the same.
    assert np.isnan(pachon.design.lateral_color(telescope, place).airy_radius).all()


def test_a_chief_ray_that_does_not_arrive_is_named(paraboloid):
    """Far from its vertex the paraboloid sends the chief ray along the plane of the detector."""
    telescope = paraboloid(2.0, 20.0).perturbed("mirror", shift=(0.0, -4.0, 0.0))
    with pytest.raises(DomainError, match=r"field = \(0, 0\) deg: the chief ray does not reach the image"):
        pachon.strehl(telescope, [(0.0, 0.0)], 5e-7)
    with pytest.raises(DomainError, match=r"field = \(0, 0\) deg: the chief ray does not reach the image"):
        through_focus(telescope, [(0.0, 0.0)], 5e-7, [0.0, 1e-4])
