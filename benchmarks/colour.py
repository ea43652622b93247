"""What it costs to ignore the colours of stars and galaxies in PSF models, in r and i, and what a colour term leaves.

    python benchmarks/colour.py [--field 0.5,0.3] [--zenith 45] [--draws 20] [--without-silicon]

PSFs of the LSST averaged over all turbulence, 24 wavelengths a band, in silicon, light spread by the air along x. Stars
are blackbodies of 3500 to 10 000 K, evenly in the logarithm. Galaxies stand at redshifts 0 to 1: old ones are
blackbodies of 4800 K that lose 1/1.8 of their light below 4000 Angstrom, young ones the same with as much light of
10 000 K at 5500 Angstrom, and a break of 1.25 (D4000: Balogh et al. 1999). The model of the stars is used for the
galaxies, without colours, and with mean wavelengths in the band as colours. T and g are those of adaptive moments; m
and c along the zenith are of a round exponential galaxy of half-light radius 0.35" through the shear functionals.

Without noise first; then models of 40 stars a CCD with S/N of 30 to 1000, each drawn anew.
"""

import argparse

import numpy as np
from scipy import fft

import pachon
from pachon.measure.rho_statistics import trace_of_moments
from pachon.measure.shear.estimator import ShearEstimator
from pachon.models.io.site_file import load_site
from pachon.wavefront.atmosphere.refraction import dispersion_shift

ARCSEC = np.pi / 648000
SCALE, PSF_SIDE, SIDE = 0.2 * ARCSEC, 47, 64
WAVELENGTHS = 24
REDSHIFTS = np.linspace(0.0, 1.0, 21)
COOL, HOT = 3500.0, 10000.0
SHEAR = 0.01
#: Scale length of the exponential galaxy [pixel].
LENGTH = 0.35 / 1.678 / 0.2
#: Sky and read noise of a pixel [electron].
SKY_RMS = 22.0


def galaxy_photons(waves, redshift, young):
    """Photons of a galaxy, old or young, at wavelengths within a band."""
    at_rest = np.concatenate([[550e-9], waves / (1.0 + redshift)])
    light = pachon.blackbody_photons([4800.0, 10000.0], at_rest)
    light /= light[:, :1]
    photons = light[0] + young * light[1]
    return (photons * np.where(at_rest < 400e-9, 1.0 / (1.25 if young else 1.8), 1.0))[1:]


def light_of(photons, waves, zenith):
    """Light of spectra, spread along x by the air."""
    spread = dispersion_shift(waves, waves[len(waves) // 2], zenith, 0.0, load_site("cerro_pachon").weather)
    return pachon.Light(waves, photons, spread)


def centroids(images, pixel_scale):
    """Centroids x, y from the middle pixel [pixel]: stars are centred before they are modelled."""
    found = pachon.measure_shapes(images, pixel_scale, 0.7 * ARCSEC)
    return np.stack([found.x, found.y], axis=1)


def psfs(band, fields, photons, waves, zenith, silicon):
    """PSFs of unit sum of spectra at fields."""
    air = pachon.Atmosphere.from_site("cerro_pachon", seed=1, zenith_angle=zenith)
    images = pachon.make_psfs(
        pachon.load_telescope(f"lsst_v3.3_{band}"),
        fields,
        light_of(photons, waves, zenith),
        atmosphere=air,
        engine="long_exposure",
        stamps=pachon.Stamps(PSF_SIDE, silicon=silicon, recenter=centroids),
        threads=1,
    ).image.astype(float)
    return images / images.sum(axis=(1, 2), keepdims=True)


def shapes(images):
    """T and g1 of adaptive moments."""
    moments = pachon.adaptive_moments(images, SCALE, threads=1)
    return np.stack([trace_of_moments(moments.sigma, moments.g1, moments.g2), moments.g1])


def galaxy_stamps(psf_images, shear):
    """A round exponential galaxy under a shear along x, through PSFs."""
    wide = np.zeros((len(psf_images), 2 * SIDE, 2 * SIDE))
    first = SIDE - PSF_SIDE // 2
    wide[:, first : first + PSF_SIDE, first : first + PSF_SIDE] = psf_images
    ky, kx = 2.0 * np.pi * fft.fftfreq(2 * SIDE)[:, None], 2.0 * np.pi * fft.rfftfreq(2 * SIDE)
    square = ((1.0 + shear) ** 2 * kx**2 + (1.0 - shear) ** 2 * ky**2) / (1.0 - shear**2)
    drawn = fft.irfft2(fft.rfft2(wide) * (1.0 + LENGTH**2 * square) ** -1.5, s=(2 * SIDE, 2 * SIDE))
    half = SIDE // 2
    return drawn[:, half:-half, half:-half]


def shear_bias(true, model):
    """m and c of each galaxy whose PSF is taken to be that of a model."""
    estimator, rows = ShearEstimator(model, SCALE, 1e-6), np.arange(len(true))
    measured = []
    for sign in (1.0, -1.0):
        moments = estimator.moments(
            galaxy_stamps(true, sign * SHEAR), np.full((len(true), 2), 0.5), psf_index=rows, threads=1
        )
        shape = estimator.ellipticity_and_response(moments, psf_index=rows)
        measured.append(shape.e1 / shape.r11)
    plus, minus = measured
    return np.stack([(plus - minus) / (2.0 * SHEAR) - 1.0, 0.5 * (plus + minus)])


def errors(true, model):
    """dT/T, dg1, m and c of a model beside the true PSFs, m and c less those with the true PSFs."""
    (true_trace, true_g), (trace, g) = shapes(true), shapes(model)
    return np.stack([trace / true_trace - 1.0, g - true_g, *(shear_bias(true, model) - shear_bias(true, true))])


def row(label, values):
    print(f"{label:44}" + "".join(f"  {mean:+9.1e} {worst:8.1e}" for mean, worst in values))


def summary(found):
    return [(v.mean(), np.abs(v).max()) for v in found]


def noisy(images, rng):
    """Stars in electrons with S/N of 30 to 1000, more of them faint."""
    snr = 30.0 * (1000.0 / 30.0) ** (rng.random(len(images)) ** 1.7)
    noise_pixels = 1.0 / (images**2).sum(axis=(1, 2))
    electrons = 0.5 * snr**2 * (1.0 + np.sqrt(1.0 + 4.0 * noise_pixels * SKY_RMS**2 / snr**2))
    light = electrons[:, None, None] * images
    return light + rng.normal(size=light.shape) * np.sqrt(SKY_RMS**2 + np.maximum(light, 0.0))


def study(band, zenith_degrees, field_degrees, draws, silicon):
    telescope, zenith = pachon.load_telescope(f"lsst_v3.3_{band}"), np.deg2rad(zenith_degrees)
    low, high = telescope.band
    waves = low + (np.arange(WAVELENGTHS) + 0.5) / WAVELENGTHS * (high - low)
    middle, rng = np.deg2rad(np.array(field_degrees)), np.random.default_rng(2)
    fields = middle + np.deg2rad(rng.uniform(-0.1, 0.1, (40, 2)))
    kelvin = np.exp(rng.uniform(np.log(COOL), np.log(HOT), 40))
    star_photons = pachon.blackbody_photons(kelvin, waves)
    stars, colour = (
        psfs(band, fields, star_photons, waves, zenith, silicon),
        pachon.effective_colour(waves, star_photons),
    )
    kinds = {
        "stars, 3500 and 10 000 K": pachon.blackbody_photons([COOL, HOT], waves),
        "old galaxies": np.stack([galaxy_photons(waves, z, young=False) for z in REDSHIFTS]),
        "young galaxies": np.stack([galaxy_photons(waves, z, young=True) for z in REDSHIFTS]),
    }
    spectra = np.concatenate(list(kinds.values()))
    ends = np.cumsum([len(photons) for photons in kinds.values()])[:-1]
    places, asked = np.repeat(middle[None], len(spectra), axis=0), pachon.effective_colour(waves, spectra)
    true = psfs(band, places, spectra, waves, zenith, silicon)
    model = pachon.PsfModel.fit(stars, fields, gain=None, clipping=None, colour=colour)
    plain = pachon.PsfModel.fit(stars, fields, gain=None, clipping=None)
    print(
        f"\n{band}, {zenith_degrees:g} deg from the zenith: stars at {1e9 * colour.min():.1f} to "
        f"{1e9 * colour.max():.1f} nm, galaxies at {1e9 * asked[2:].min():.1f} to {1e9 * asked[2:].max():.1f} nm"
    )
    print(f"{'mean, largest':44}" + "".join(f"  {name:>18}" for name in ("dT/T", "dg1", "m", "c")))
    for label, images in (
        ("without colours", plain.at(places)),
        ("with colours", model.at(places, colour=asked)),
        ("with spectra", pachon.reconstruction.psf_of_spectrum(model, places, light_of(spectra, waves, zenith), SCALE)),
    ):
        parts = np.split(errors(true, images), ends, axis=1)
        for kind, values in zip(kinds, parts, strict=True):
            row(f"{kind}, {label}", summary(values))
    if not draws:
        return
    squares: dict[str, list] = {"without colours": [], "with colours": [], "with spectra": []}
    probabilities = []
    (true_trace, true_g) = shapes(true[2:])
    for draw in range(draws):
        drawn = noisy(stars, np.random.default_rng(draw))
        fitted = pachon.PsfModel.fit(drawn, fields, colour=colour)
        probabilities.append(fitted.colour.probability)
        for label, images in (
            ("without colours", pachon.PsfModel.fit(drawn, fields).at(places[2:])),
            ("with colours", fitted.at(places[2:], colour=asked[2:])),
            (
                "with spectra",
                pachon.reconstruction.psf_of_spectrum(fitted, places[2:], light_of(spectra[2:], waves, zenith), SCALE),
            ),
        ):
            trace, g = shapes(images)
            squares[label].append([((trace / true_trace - 1.0) ** 2).mean(), ((g - true_g) ** 2).mean()])
    print(f"40 stars with noise, {draws} draws: probability of a dependence {np.median(probabilities):.2g} (median)")
    for label, values in squares.items():
        trace, g = np.sqrt(np.mean(values, axis=0))
        print(f"  galaxies, {label}: rms of dT/T {trace:.2e}, of g1 {g:.2e}")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--field", default="0.5,0.3", help="place in the field [deg]")
    parser.add_argument("--zenith", type=float, default=45.0, help="zenith angle beside 0 [deg]")
    parser.add_argument("--draws", type=int, default=20, help="draws of the noise of stars")
    parser.add_argument("--without-silicon", action="store_true", help="all light turns into charge at the surface")
    arguments = parser.parse_args()
    silicon = None if arguments.without_silicon else pachon.models.Silicon()
    field = [float(value) for value in arguments.field.split(",")]
    print(f"pachon {pachon.__version__}")
    for band in "ri":
        for zenith in (0.0, arguments.zenith):
            study(band, zenith, field, arguments.draws, silicon)


if __name__ == "__main__":
    main()
