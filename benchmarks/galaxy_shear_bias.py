"""Multiplicative and additive bias of the shear from fits of elliptical Gaussians, by galaxy profile, size and noise.

Run: python benchmarks/galaxy_shear_bias.py [--rings N] [--realisations N]

Rings of four galaxies, rotated by 45 degrees, of intrinsic ellipticity 0.1 to 0.4, sheared by 0.02 in eight directions,
at random sub-pixel places, under PSFs of 3.4 pixels FWHM with an ellipticity of 0.05, rendered by GalSim. First without
noise, by the ratio of half-light radii of galaxy and PSF; then Gaussian galaxies under white noise.
"""

import argparse

import galsim
import numpy as np

import pachon

SHEAR, ORIENTATIONS = 0.02, 4
PSFS = {
    name: galsim.Convolve(profile(fwhm=3.4).shear(g1=0.05, g2=0.0), galsim.Pixel(1.0))
    for name, profile in (("Kolmogorov", galsim.Kolmogorov), ("Gaussian", galsim.Gaussian))
}
PSF_RADIUS = 2.1  # half-light radius of the first one [pixel]
PROFILES = {
    "Gaussian": galsim.Gaussian,
    "exponential": galsim.Exponential,
    "de Vaucouleurs": galsim.DeVaucouleurs,
}


def make_rings(
    psf, profile, radius: float, count: int, side: int, *, same: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Return stamps [count, 4, side, side] of unit flux, and the shear of each ring; `same` for one ring throughout."""
    rng = np.random.default_rng(7)
    shears = SHEAR * np.exp(2j * np.pi * np.arange(count) / 8)
    stamps = np.empty((count, ORIENTATIONS, side, side))
    for i, shear in enumerate(shears):
        rng = np.random.default_rng(7) if same else rng
        e = rng.uniform(0.1, 0.4) * np.exp(2j * np.pi * rng.uniform())
        for k in range(ORIENTATIONS):
            turned = e * np.exp(2j * np.pi * k / ORIENTATIONS)
            galaxy = profile(half_light_radius=radius).shear(g1=turned.real, g2=turned.imag)
            galaxy = galaxy.shear(g1=shear.real, g2=shear.imag).shift(*rng.uniform(-0.5, 0.5, 2))
            drawn = galsim.Convolve(galaxy, psf).drawImage(nx=side, ny=side, scale=1.0, method="no_pixel", dtype=float)
            stamps[i, k] = drawn.array
    return stamps, shears


def calibrate(
    stamps: np.ndarray, shears: np.ndarray, variance: float, psf: np.ndarray
) -> pachon.measure.ShearCalibration:
    fits = pachon.measure.fit_galaxy_stamps(stamps.reshape(-1, *stamps.shape[2:]), variance, psf)
    e1, e2 = (np.where(fits.good, e, np.nan).reshape(stamps.shape[:2]) for e in (fits.e1, fits.e2))
    return pachon.measure.shear_calibration(e1, e2, shears.real, shears.imag)


def image_of(psf) -> np.ndarray:
    """Return a PSF on 65 x 65 pixels: 0.1 % of the light of a Kolmogorov PSF lies beyond."""
    image = psf.drawImage(nx=65, ny=65, scale=1.0, method="no_pixel", dtype=float).array
    return image / image.sum()


def show(label: str, found: pachon.measure.ShearCalibration) -> None:
    (m1, m2), (e1, e2) = found.m, found.m_error
    (c1, c2), (d1, _) = found.c, found.c_error
    print(
        f"{label}: m1 = {m1:+.4f} +- {e1:.4f}, m2 = {m2:+.4f} +- {e2:.4f}, "
        f"c1 = {c1:+.1e}, c2 = {c2:+.1e} (+- {d1:.1e}), {found.n_rings} rings",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rings", type=int, default=16)
    parser.add_argument("--realisations", type=int, default=400, help="of the noise, for each galaxy")
    arguments = parser.parse_args()
    print(f"pachon {pachon.__version__}, GalSim {galsim.__version__}")
    for psf_name, profile in PSFS.items():
        for name, galaxy in PROFILES.items():
            for ratio in (0.7, 1.0, 1.5):
                stamps, shears = make_rings(profile, galaxy, ratio * PSF_RADIUS, arguments.rings, 32)
                found = calibrate(stamps, shears, 1.0, image_of(profile))
                show(f"{psf_name} PSF, {name}, {ratio} of the PSF's radius", found)
    psf = image_of(PSFS["Kolmogorov"])
    stamps, shears = make_rings(PSFS["Kolmogorov"], galsim.Gaussian, PSF_RADIUS, 8, 32, same=True)
    rng = np.random.default_rng(9)
    for snr in (15.0, 30.0, 60.0):
        # S/N of the light in the best aperture, the image itself. All shears share their noise, which leaves m.
        sigma = float(np.sqrt((stamps**2).sum(axis=(2, 3)).mean())) / snr
        noise = rng.normal(0.0, sigma, (arguments.realisations, 1, *stamps.shape[1:]))
        fits = pachon.measure.fit_galaxy_stamps((stamps + noise).reshape(-1, *stamps.shape[2:]), sigma**2, psf)
        e1, e2 = (
            np.where(fits.good, e, np.nan).reshape(arguments.realisations, *stamps.shape[:2])
            for e in (fits.e1, fits.e2)
        )
        whole = np.isfinite(e1 + e2).all(axis=(1, 2))
        each = [
            pachon.measure.shear_calibration(a, b, shears.real, shears.imag)
            for a, b in zip(e1[whole], e2[whole], strict=True)
        ]
        m = np.array([found.m for found in each])
        (m1, m2), (error1, error2) = m.mean(axis=0), m.std(axis=0) / np.sqrt(len(m))
        print(
            f"Gaussian, S/N {snr:.0f} (of the fitted flux {np.median(fits.snr):.0f}): m1 = {m1:+.4f} +- {error1:.4f}, "
            f"m2 = {m2:+.4f} +- {error2:.4f}; {fits.good.mean():.1%} of the fits without flags, "
            f"{whole.mean():.0%} of the sets used",
            flush=True,
        )


if __name__ == "__main__":
    main()
