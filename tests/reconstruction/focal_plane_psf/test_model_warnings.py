"""Remarks and errors of the focal-plane model about stars and telescopes that do not fit."""

from dataclasses import replace

import numpy as np
import pytest

from pachon import load_telescope
from pachon.core.errors import DomainError
from pachon.core.units import ARCSEC
from pachon.models.camera.cameras import load_camera
from pachon.reconstruction.focal_plane_psf import likelihood
from pachon.reconstruction.focal_plane_psf.model import FocalPlanePsf
from pachon.reconstruction.focal_plane_psf.mosaic import Mosaic
from pachon.reconstruction.focal_plane_psf.stars import FocalPlaneStars


@pytest.fixture(scope="module")
def camera():
    return load_camera("lsst")


@pytest.fixture(scope="module")
def stars(camera):
    """Sixty stars on nine CCDs, of a smooth field of 5e-3 and noise of 1e-3."""
    rng = np.random.default_rng(1)
    ccd = np.repeat([camera.ccd_index(f"R22_S{i}{k}") for i in range(3) for k in range(3)], 7)[:60]
    xy = camera.from_uv(ccd, rng.uniform(-0.9, 0.9, (60, 2)))
    phase = np.cos(xy @ np.array([[60.0, 10.0, 40.0], [20.0, 70.0, -40.0]]))
    values = np.array([0.0, 0.0, -13.0]) + 5e-3 * phase + 1e-3 * rng.standard_normal((60, 3))
    return FocalPlaneStars(tuple(camera.ccd_names[c] for c in ccd), *xy.T, values, np.full((60, 3), 1e-3))


def with_noise(stars, noise):
    return FocalPlaneStars(stars.ccd, stars.x, stars.y, stars.values, noise)


def test_stamps_of_other_pixels_than_the_instrument_give_one_clear_line(stars, camera, lsst_r):
    """Drawn images had the pixels of the instrument, and principal components those of the stamps."""
    binned = replace(stars, stamps=np.full((60, 15, 15), 1.0 / 225.0), pixel_scale=0.4 * ARCSEC)
    with pytest.raises(DomainError, match=r"^pixel_scale = 0\.4 arcsec of the stamps: expected 0\.2[^\n]*20 um$"):
        FocalPlanePsf.fit(binned, lsst_r, camera=camera)


@pytest.mark.parametrize(("ccd", "y"), [(["R22_S11", "R22_S12"], [0.0] * 3), ("R22_S11", [0.0] * 2)])
def test_places_of_other_numbers_of_ccds_give_one_clear_line(camera, ccd, y):
    with pytest.raises(DomainError, match=r"^x, y, ccd have shapes [^\n]*$"):
        Mosaic.of_camera(camera).places(ccd, [0.0] * 3, y)


def test_stamps_without_a_whole_one_are_as_none(stars, camera):
    unseen = replace(stars, stamps=np.full((60, 15, 15), np.nan), pixel_scale=0.2 * ARCSEC)
    model = FocalPlanePsf.fit(unseen, camera=camera)
    assert model.mean_star is None
    assert model.used.all()


@pytest.mark.long
def test_noise_in_the_wrong_unit_is_noticed(stars, camera):
    # Of percent in place of parts: a hundred times too large.
    model = FocalPlanePsf.fit(with_noise(stars, 100.0 * stars.noise), camera=camera)
    remarks = [w for w in model.warnings if "the noise of the stars is not as stated" in w]
    assert len(remarks) == 3
    assert all("\n" not in w for w in remarks)
    assert max(model.chi2.values()) < 0.01


@pytest.mark.long
def test_hyperparameters_at_their_bounds_are_said(stars, camera, monkeypatch):
    # Lengths that hardly may differ from the first guess.
    start = np.log(likelihood._START[0])
    monkeypatch.setattr(likelihood, "_LENGTHS", (start - 0.01, start + 0.01))
    model = FocalPlanePsf.fit(stars, camera=camera)
    (remark,) = [w for w in model.warnings if w.startswith("hyperparameters at their bounds: ")]
    assert "length 2 of e1" in remark


@pytest.mark.long
@pytest.mark.parametrize("name", ["auxtel", "hsc"])
def test_a_telescope_that_does_not_cover_the_camera_gives_one_clear_line(stars, part, name):
    corner = part("R01", count=4)
    ccd = np.arange(60) % 4
    x, y = corner.centers[ccd].T
    there = FocalPlaneStars(tuple(corner.ccd_names[c] for c in ccd), x, y, stars.values, stars.noise)
    with pytest.raises(DomainError, match=r"^[^\n]*field[^\n]*$"):
        FocalPlanePsf.fit(there, load_telescope(name), camera=corner)


def test_galaxies_among_stars_change_nothing(stars, camera):
    """Of two in 60 one was left out, and both were in the covariances: sizes were off by three times as much."""
    values, galaxies = stars.values.copy(), [7, 31]
    values[galaxies] += np.array([[0.1, -0.05, 0.3], [-0.05, 0.02, 0.2]])
    model = FocalPlanePsf.fit(replace(stars, values=values), camera=camera, threads=1)
    assert np.flatnonzero(~model.used).tolist() == galaxies
    without = FocalPlanePsf.fit(stars.chosen(model.used), camera=camera, threads=1)
    x, y = stars.x[galaxies], stars.y[galaxies]
    ccd = [stars.ccd[i] for i in galaxies]
    for a, b in zip(vars(model.shapes(ccd, x, y)).values(), vars(without.shapes(ccd, x, y)).values(), strict=True):
        np.testing.assert_allclose(a, b, atol=2e-4)
    assert model.warnings == without.warnings
