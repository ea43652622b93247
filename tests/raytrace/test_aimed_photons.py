"""Photons of a lens whose rays are aimed at the stop."""

from pathlib import Path

import numpy as np
import pytest

import pachon
from pachon.models.io.prescription import load_telescope
from pachon.raytrace.photons import PhotonBeam, land_photons
from pachon.raytrace.rays import field_direction

WIDE = Path(__file__).parents[1] / "data" / "zmx" / "circular_aperture_example_with_aperture.zmx"


def test_photons_are_the_rays_that_fill_the_stop():
    wide, field = load_telescope(WIDE), np.deg2rad((10.0, 40.0))
    pupil = 0.5 * wide.pupil_diameter * np.array([[0.0, 0.0], [0.0, 0.9], [-0.6, -0.7], [0.5, 0.1]])
    source = np.concatenate([-field_direction(*field)[None], np.zeros((2, 3))])
    beam = PhotonBeam((np.zeros(4), np.zeros(4)), source, tuple(pupil.T), np.full(4, wide.default_wavelength))
    landed = land_photons(wide, beam, threads=1)
    end = pachon.trace(wide, pachon.launch_rays(wide, field, wide.default_wavelength, tuple(pupil.T)), threads=1)
    place = wide.surfaces[-1].to_local(end.position)
    assert np.stack([landed.x, landed.y], axis=-1) == pytest.approx(place[:, :2], abs=1e-15)
    assert np.array_equal(landed.lit, end.status == 0)
    assert landed.lit.any()
    # Without aiming they are other rays.
    plain = land_photons(wide.with_design(aiming="off"), beam, threads=1)
    assert not np.array_equal(plain.lit, landed.lit)
