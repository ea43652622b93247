"""Images as other programs write them: drawn without this project, so that their truth is known."""

from types import SimpleNamespace

import numpy as np
from astropy.io import fits

SIDE, SKY, GAIN, READ_NOISE = 320, 400.0, 2.5, 5.0
#: Gaussian PSF [pixel]: covariance xx, xy, yy.
PSF = (2.9, 0.15, 2.5)


def world(side=SIDE, scale=0.263):
    header = fits.Header()
    for axis, kind in (("1", "RA---TAN"), ("2", "DEC--TAN")):
        header[f"CTYPE{axis}"], header[f"CUNIT{axis}"], header[f"CRPIX{axis}"] = kind, "deg", 0.5 * side
    header["CRVAL1"], header["CRVAL2"] = 150.0, 2.0
    header["CD1_1"], header["CD1_2"], header["CD2_1"], header["CD2_2"] = -scale / 3600, 0.0, 0.0, scale / 3600
    return header


def gaussian(yy, xx, x, y, covariance, flux):
    xx_, xy_, yy_ = covariance
    det = xx_ * yy_ - xy_**2
    dx, dy = xx - x, yy - y
    return flux / (2 * np.pi * np.sqrt(det)) * np.exp(-0.5 * (yy_ * dx**2 - 2 * xy_ * dx * dy + xx_ * dy**2) / det)


def draw_field(n_stars, n_galaxies, seed=1, side=SIDE):
    """Image [ADU] of Gaussian stars and galaxies on a jittered grid, sky included, its true variance, and the truth."""
    rng = np.random.default_rng(seed)
    count = n_stars + n_galaxies
    grid = int(np.ceil(np.sqrt(count)))
    step = side / grid
    places = np.stack(np.meshgrid(*[(np.arange(grid) + 0.5) * step] * 2), axis=-1).reshape(-1, 2)
    places = places[rng.permutation(len(places))[:count]] + rng.uniform(-2, 2, (count, 2))
    star = np.arange(count) < n_stars
    flux = np.exp(rng.uniform(9.2, 11.0, count))
    shear = np.where(star[:, None], 0.0, rng.uniform(-0.3, 0.3, (count, 2)))
    size = rng.uniform(1.6, 2.6, count)
    yy, xx = np.indices((side, side), dtype=float)
    light = np.zeros((side, side))
    for (x, y), is_star, f, g, s in zip(places, star, flux, shear, size, strict=True):
        matrix = np.array([[1 + g[0], g[1]], [g[1], 1 - g[0]]]) / np.sqrt(1 - g @ g)
        (cxx, cxy), (_, cyy) = np.zeros((2, 2)) if is_star else s**2 * matrix @ matrix
        # Beyond 20 pixels there is less than 1e-8 of any.
        rows, columns = (slice(max(int(at) - 20, 0), int(at) + 22) for at in (y, x))
        part = np.s_[rows, columns]
        light[part] += gaussian(yy[part], xx[part], x, y, (PSF[0] + cxx, PSF[1] + cxy, PSF[2] + cyy), f)
    electrons = rng.poisson((light + SKY) * GAIN) + rng.normal(0.0, READ_NOISE, light.shape)
    return SimpleNamespace(
        image=(electrons / GAIN).astype(np.float32),
        variance=(light + SKY) / GAIN + (READ_NOISE / GAIN) ** 2,
        sky_variance=SKY / GAIN + (READ_NOISE / GAIN) ** 2,
        places=places,
        star=star,
        flux=flux,
        shear=shear,
    )


def header_of(**cards):
    header = world()
    header.update({"GAIN": GAIN, "MAGZERO": 30.0, "FILTER": "r", "EXPTIME": 90.0} | cards)
    return header
