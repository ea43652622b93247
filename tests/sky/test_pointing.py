"""Pointing: slopes, tangent plane and celestial coordinates against basis vectors and astropy."""

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import FK5, SkyCoord

import pachon
from pachon.core.errors import DomainError
from pachon.raytrace.rays import field_direction

RA, DEC, ROLL = 5.9, -1.2, 0.7
AIM = pachon.Pointing(RA, DEC, ROLL)
SLOPES = np.random.default_rng(1).uniform(-0.03, 0.03, (20, 2))


def sources():
    """Right ascensions and declinations of the sources of light of the slopes, by the basis vectors of the sky."""
    outwards = np.array([np.cos(DEC) * np.cos(RA), np.cos(DEC) * np.sin(RA), np.sin(DEC)])
    east = np.array([-np.sin(RA), np.cos(RA), 0.0])
    north = np.cross(outwards, east)
    y = np.cos(ROLL) * north + np.sin(ROLL) * east
    x = np.cross(y, outwards)
    found = -field_direction(*SLOPES.T, "gnomonic") @ np.stack([x, y, outwards])
    return np.stack([np.arctan2(found[:, 1], found[:, 0]) % (2 * np.pi), np.arcsin(found[:, 2])], axis=1)


def test_slopes_become_celestial_coordinates_and_back():
    celestial = AIM.to_celestial(AIM.to_sky(SLOPES))
    # Radians, some of 6: rounding.
    assert np.allclose(celestial, sources(), rtol=0, atol=1e-13)
    assert np.allclose(AIM.to_slopes(AIM.from_celestial(*celestial.T)), SLOPES, rtol=0, atol=1e-13)


def test_the_tangent_plane_is_that_of_astropy():
    from astropy.wcs import WCS

    header = {"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRVAL1": np.rad2deg(RA), "CRVAL2": np.rad2deg(DEC)}
    wcs = WCS(header | {"CRPIX1": 1.0, "CRPIX2": 1.0, "CDELT1": 1.0, "CDELT2": 1.0, "CUNIT1": "deg", "CUNIT2": "deg"})
    xi, eta = wcs.all_world2pix(np.rad2deg(sources()), 0).T
    assert np.allclose(AIM.from_celestial(*sources().T), np.deg2rad(np.stack([xi, eta], axis=1)), rtol=0, atol=1e-13)


def test_what_lies_behind_the_pointing_has_no_place():
    assert np.isnan(AIM.from_celestial([RA + np.pi], [-DEC])).all()


def test_a_sky_coord_counts_in_icrs():
    aim = pachon.Pointing.of(SkyCoord(RA, DEC, unit="rad").transform_to(FK5(equinox="J2015")), 40.0 * u.deg)
    assert np.allclose((aim.ra, aim.dec, aim.position_angle), (RA, DEC, np.deg2rad(40.0)), rtol=0, atol=1e-12)


@pytest.mark.parametrize("wrong", [(1.0, 2.0), (np.nan, 0.0), (1.0,), SkyCoord([1, 2] * u.deg, [0, 0] * u.deg)])
def test_a_pointing_that_is_none_is_refused(wrong):
    with pytest.raises(DomainError, match="pointing"):
        pachon.Pointing.of(wrong)


def test_quantities_are_angles():
    aim = pachon.Pointing(np.rad2deg(RA) * u.deg, DEC * u.rad, np.rad2deg(ROLL) * 60.0 * u.arcmin)
    assert np.allclose((aim.ra, aim.dec, aim.position_angle), (RA, DEC, ROLL), rtol=1e-15)
    with pytest.raises(DomainError, match=r"dec = 1\.0 kg: expected a unit that converts to rad"):
        pachon.Pointing(1.0, 1.0 * u.kg)


@pytest.mark.parametrize("dec", [0.0, -1.2, 0.5 * np.pi - 0.01])
def test_north_and_east_on_the_tangent_plane(dec):
    aim = pachon.Pointing(RA, dec)
    ra, dec = np.array([RA + 0.02, RA - 3.0]), np.array([dec - 0.015, min(dec + 0.01, 0.5 * np.pi - 0.002)])
    ra, dec = ra[: 1 + (dec[0] > 1.0)], dec[: 1 + (dec[0] > 1.0)]  # the second lies beyond the pole
    step = 1e-6
    east = aim.from_celestial(ra + step / np.cos(dec), dec) - aim.from_celestial(ra - step / np.cos(dec), dec)
    north = aim.from_celestial(ra, dec + step) - aim.from_celestial(ra, dec - step)
    differences = np.stack([east, north], axis=2) / (2.0 * step)
    assert np.allclose(aim.jacobians(ra, dec), differences, rtol=0, atol=1e-6)
