"""Stars of real images (test data of Piff, BSD-2-Clause): which come through, and how well others predict them."""

from pathlib import Path

import numpy as np
import pytest

from pachon.core.units import ARCSEC
from pachon.measure.pixel_masks import copied_pixels
from pachon.reconstruction.own_stars.own_stars import fit_own_stars
from pachon.reconstruction.own_stars.star_catalogue import load_stars

DATA = Path(__file__).parents[4] / "shared/data/real"
DECAM = DATA / "DECam_00241238_01_psfcat_tb_maxmag_17.0_magcut_3.0_findstars.fits"
RUBIN = DATA / "testStarsRubin.fits"


@pytest.mark.slow
@pytest.mark.skipif(not DECAM.exists(), reason="no DECam stars")
def test_all_stars_of_decam_come_through():
    stars = load_stars(DECAM)
    assert np.isnan(stars.stamps).any(axis=(1, 2)).sum() == 89
    assert copied_pixels(np.nan_to_num(stars.stamps)).any(axis=(1, 2)).sum() == 13
    own = fit_own_stars(*stars, 0.263 * ARCSEC)
    assert len(own.used) == 117
    assert own.used.all()
    metrics = own.summary()
    # With the 24 stars that have no bad pixel and no neighbour they were 0.80 (0.84) and 0.90 (0.90) %.
    assert metrics["rms_e_held_out"] < 1.05 * metrics["rms_e_noise"]
    assert metrics["rms_size_held_out"] < 1.05 * metrics["rms_size_noise"]
    # Stars with masked neighbours are predicted as well as the others.
    masked = np.abs(own.residuals()[0] / own.sigma_e)[(own.flags != 0)[own.used]]
    assert np.median(masked) < 1.2


@pytest.mark.long
@pytest.mark.skipif(not RUBIN.exists(), reason="no Rubin stars")
def test_stars_of_rubin_are_read_and_used_without_options():
    stamps, positions = load_stars(RUBIN)
    assert stamps.shape == (31, 25, 25)
    assert list(np.flatnonzero(np.isnan(stamps).any(axis=(1, 2)))) == [5, 15, 27]  # of weight zero in the file
    assert positions[0] == pytest.approx([38.94393434, positions[0, 1]])
    assert fit_own_stars(stamps, positions, 0.2 * ARCSEC, recipe="paper", basis="pixels", order=0).used.all()


def chi_squares(own, gain):
    """Chi-square a good pixel of each held-out star, its flux fitted, with the noise of sky and star."""
    ny, nx = own.stamps.shape[1:]
    y, x = np.indices((ny, nx)) - ny // 2
    values = []
    for star, model, masked, flux in zip(own.stamps, own.predicted, own.masks, own.shapes.flux[own.used], strict=True):
        outer, good = ~masked & (np.hypot(x, y) > 8.0), ~masked & (np.hypot(x, y) < 10.0)
        sky = 1.4826**2 * np.median(np.abs(star[outer] - np.median(star[outer]))) ** 2
        variance = (sky + np.maximum(model, 0.0) / (flux * gain))[good]
        scale = (star[good] * model[good] / variance).sum() / (model[good] ** 2 / variance).sum()
        values.append(((star[good] - scale * model[good]) ** 2 / variance).mean())
    return np.array(values)


@pytest.mark.slow
@pytest.mark.skipif(not DECAM.exists(), reason="no DECam stars")
def test_pixels_of_decam_stars_are_predicted_as_well_as_by_a_constant():
    """Piff at order 0, a constant, was nearest in the pixels; the shape of the PSF follows a field none the less."""
    stars = load_stars(DECAM)
    options = {"size": 21, "gain": 4.04}
    default = fit_own_stars(*stars, 0.263 * ARCSEC, **options)
    constant = fit_own_stars(
        *stars, 0.263 * ARCSEC, **options, recipe="paper", basis="pixels", order=0, weights="noise"
    )
    both = default.used & constant.used
    assert both.sum() == 117
    excess = chi_squares(default, 4.04) - chi_squares(constant, 4.04)
    # With the smoothness of the shape in every pixel it was 0.08.
    assert excess.mean() < 2.0 * excess.std() / np.sqrt(len(excess))
    assert default.summary()["rms_e_held_out"] < constant.summary()["rms_e_held_out"]
