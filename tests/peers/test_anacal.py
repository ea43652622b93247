"""Shear of forced measurements against AnaCal (Li & Mandelbaum 2023), on the same stamps under the same PSF."""

import numpy as np
import pytest

import pachon

anacal = pytest.importorskip("anacal")

ARCSEC = np.pi / 648000
SCALE, SIDE, PER_SIDE, SHEAR = 0.2, 64, 32, 0.01
COUNT = PER_SIDE**2


def moffat():
    """PSF of unit sum of FWHM 0.7 arcsec and an ellipticity of 0.04, [63, 63]."""
    y, x = np.mgrid[-31:32, -31:32]
    u, v = 0.96 * x - 0.02 * y, 1.04 * y - 0.02 * x
    psf = (1.0 + (u**2 + v**2) / 3.0**2) ** -3.0
    return psf / psf.sum()


@pytest.fixture(scope="module")
def sample():
    """Stamps under a shear and its opposite [2, n, side, side], offsets, and the noise of 100 visits."""
    rng, exposure = np.random.default_rng(1), pachon.Exposure(exposures=100)
    half = pachon.draw_galaxies(120 * ARCSEC, faintest=25.5, seed=3).take(np.arange(COUNT // 2))
    galaxies = type(half).concatenate([half, half.rotated(np.pi / 2)])
    offsets = rng.uniform(-0.5, 0.5, (COUNT, 2))
    wide = np.zeros((2 * SIDE, 2 * SIDE))
    wide[SIDE - 31 : SIDE + 32, SIDE - 31 : SIDE + 32] = moffat()
    jacobian = np.broadcast_to(np.eye(2) / (SCALE * ARCSEC), (COUNT, 2, 2))
    stamps = []
    for sign in (1.0, -1.0):
        sheared = galaxies.sheared(sign * SHEAR, 0.0)
        spectra = sheared.transform(np.arange(COUNT), jacobian, offsets, 2 * SIDE) * np.fft.rfft2(wide)
        images = np.fft.irfft2(spectra)[:, SIDE // 2 : -SIDE // 2, SIDE // 2 : -SIDE // 2]
        stamps.append(images * exposure.electrons(galaxies.magnitude)[:, None, None])
    return np.array(stamps), offsets, exposure.noise_rms


def tiled(stamps):
    grid = stamps.reshape(PER_SIDE, PER_SIDE, SIDE, SIDE).transpose(0, 2, 1, 3)
    return np.ascontiguousarray(grid.reshape(PER_SIDE * SIDE, PER_SIDE * SIDE))


def by_anacal(stamps, offsets, noise, noise_stamps):
    """Ellipticities and responses of forced FPFS at the places of the galaxies, [n] each."""
    psf = np.zeros((SIDE, SIDE))
    psf[1:, 1:] = moffat()
    row, column = np.divmod(np.arange(COUNT), PER_SIDE)
    places = np.zeros(COUNT, dtype=[("y", "f8"), ("x", "f8")])
    places["x"], places["y"] = (SIDE * np.array([column, row]) + SIDE // 2) + offsets.T
    task = anacal.fpfs.FpfsTask(npix=SIDE, pixel_scale=SCALE, sigma_shapelets=0.52, psf_array=psf)
    task.prepare_covariance(variance=noise**2)
    config = anacal.fpfs.FpfsConfig(sigma_shapelets1=0.52, npix=SIDE, c0=4.0 * float(task.std_m00))
    table = anacal.fpfs.process_image(
        fpfs_config=config,
        pixel_scale=SCALE,
        noise_variance=noise**2,
        mag_zero=anacal.fpfs.THRESHOLD_REF_MAG_ZERO,
        gal_array=tiled(stamps).astype(np.float32),
        psf_array=psf,
        noise_array=None if noise_stamps is None else tiled(noise_stamps).astype(np.float32),
        detection=places,
    )
    return table["fpfs1_e1"], table["fpfs1_de1_dg1"]


def by_functionals(stamps, offsets, noise, seed):
    estimator = pachon.measure.ShearEstimator(moffat(), SCALE * ARCSEC, noise)
    shapes = estimator.ellipticity_and_response(estimator.moments(stamps, offsets + 0.5), seed=seed)
    return shapes.e1, shapes.r11


#: Block of each galaxy of the jackknife, with its rotated copy.
BLOCKS = np.arange(COUNT) % (COUNT // 2) // 32


def block_sums(pair):
    """Sums over blocks of the columns measured under the shear and its opposite, [blocks, sign, 2]."""
    sums = [[np.bincount(BLOCKS, column) for column in columns] for columns in pair]
    return np.moveaxis(np.array(sums), -1, 0)


def bias(pairs):
    """m of pairs of ellipticities and responses of blocks [blocks, sign, 2], and of it without each block."""

    def of_sums(sums):
        return (sums[..., 0, 0] - sums[..., 1, 0]) / (sums[..., 0, 1] + sums[..., 1, 1]) / SHEAR - 1.0

    sums = np.array(pairs)
    return of_sums(sums.sum(axis=0)), of_sums(sums.sum(axis=0) - sums)


def error_of(without_block):
    count = len(without_block)
    return float(np.sqrt((count - 1) / count * ((without_block - without_block.mean()) ** 2).sum()))


@pytest.mark.slow
def test_both_have_the_shear_of_noise_free_stamps(sample):
    stamps, offsets, noise = sample
    for measure in (lambda s: by_anacal(s, offsets, noise, None), lambda s: by_functionals(s, offsets, noise, None)):
        m, _ = bias(block_sums([measure(images) for images in stamps]))
        # The second order of a shear of 0.01, which is 0.5 to 1 of its square.
        assert abs(m) < 2e-4, m


@pytest.mark.slow
def test_noisy_stamps_have_the_same_shear_within_errors(sample):
    stamps, offsets, noise = sample
    rng, sums = np.random.default_rng(2), {"anacal": [], "functionals": []}
    for realisation in range(8):
        pixels, added = noise * rng.standard_normal((2, *stamps.shape[1:]))
        measured = {
            "anacal": [by_anacal(images + pixels, offsets, noise, added) for images in stamps],
            "functionals": [by_functionals(images + pixels, offsets, noise, realisation) for images in stamps],
        }
        for name, pair in measured.items():
            sums[name] += list(block_sums(pair))
    (m, without), (peer_m, peer_without) = bias(sums["functionals"]), bias(sums["anacal"])
    print(f"functionals {m:+.5f} +- {error_of(without):.5f}, anacal {peer_m:+.5f} +- {error_of(peer_without):.5f}, "
          f"difference {m - peer_m:+.5f} +- {error_of(without - peer_without):.5f}")  # fmt: skip
    assert error_of(without) < 6e-3
    assert abs(m) < 3.0 * error_of(without)
    assert abs(peer_m) < 3.0 * error_of(peer_without)
    assert abs(m - peer_m) < 3.0 * error_of(without - peer_without)
