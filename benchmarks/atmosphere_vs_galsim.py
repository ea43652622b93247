"""Stars by the atmosphere alone, beside those of GalSim: width, ellipticity, correlation.

Run: python benchmarks/atmosphere_vs_galsim.py [--seeds N] [--exposures N] [--stars N] [--photons N] [--figure FILE]

Both sides have the site's six layers (heights, weights, Fried parameter, outer scale, wind), 15 s, one wavelength, the
annular pupil of the LSST, pixels of 0.1 arcsec, and neither optics nor charge diffusion. A seed is one set of screens a
side with one draw of wind directions, used by both; its exposures begin a minute apart, at other parts of the screens.
Stars lie within 5 arcmin of the axis, at the same places throughout. Shapes are pachon's weighted moments (0.7 arcsec)
on both sides. Two comparisons:

1. Each side through screens of its own: mean FWHM, mean |e|^2 (all of it, and about the mean of each exposure), xi+.
2. pachon's fast engine through GalSim's own screens, star by star beside GalSim's photons, without sample variance.

Errors come from the scatter of the seeds. Photon noise stays out of GalSim's side: every star is shot twice, |e|^2 is
the product of the two ellipticities, and the FWHM is twice that of the sum of the two less their mean.

pachon needs a telescope: here a single paraboloid of f/1000, whose coma (3 theta / 16 N^2) blurs a star 5 arcmin off
the axis by a negligible 1e-4 arcsec rms; the LSST itself would blur it by 0.05 arcsec.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import time
from pathlib import Path

import galsim
import matplotlib.pyplot as plt
import numpy as np
import scipy.fft

import pachon
from pachon import Atmosphere, ScreenSampling, Telescope
from pachon.core.random_streams import stream
from pachon.core.units import ARCMIN, ARCSEC
from pachon.measure.shapes import fwhm
from pachon.models.ideal_telescope import ideal_telescope
from pachon.wavefront.atmosphere.layer_screens import SLOPE_LAG

SITE, WAVELENGTH = "cerro_pachon", 620e-9
PIXEL, STAMP, WEIGHT_FWHM = 0.1 * ARCSEC, 61, 0.7 * ARCSEC
FIELD = 5.0 * ARCMIN
# Wide enough for 15 s at 20 m/s, the pupil and 10 arcmin at 15 km; the pixel is that of 8192 samples over 1.3 km.
SIZE, LENGTH = 3072, 3072 * 1300.0 / 8192
EPOCH_STEP = 60.0
BINS = pachon.SeparationBins(0.5 * ARCMIN, 10.0 * ARCMIN, 6, exact=True)


def long_paraboloid() -> Telescope:
    """Return a telescope with the LSST's pupil and negligible aberration."""
    return ideal_telescope(pachon.load_telescope("lsst_v3.3_r"))


def through_screens(atmosphere: Atmosphere, screens: np.ndarray, **changes) -> Atmosphere:
    """Return an atmosphere with given slopes, packed as its own are, and other times, offsets or heights."""

    class Borrowing(Atmosphere):
        def screens(self, kind, threads=None, rows=None):
            return screens

    values = {f.name: getattr(atmosphere, f.name) for f in dataclasses.fields(atmosphere) if f.init}
    return Borrowing(**(values | changes))


def galsim_layers(atmosphere: Atmosphere, seed: int) -> galsim.PhaseScreenList:
    """Return GalSim's screens for the same layers and winds, made as photon shooting at the wavelength makes them."""
    layers = galsim.Atmosphere(
        screen_size=atmosphere.screen_length,
        screen_scale=atmosphere.screen_pixel,
        rng=galsim.BaseDeviate(seed + 1),
        altitude=list(atmosphere.altitudes / 1e3),
        r0_500=atmosphere.r0,
        r0_weights=list(atmosphere.weights),
        L0=atmosphere.outer_scale,
        vx=list(atmosphere.velocities[:, 0]),
        vy=list(atmosphere.velocities[:, 1]),
    )
    layers.instantiate(kmax=layers.makePSF(**galsim_exposure()).screen_kmax)
    return layers


def galsim_exposure(**options) -> dict:
    """Return the arguments of GalSim's makePSF."""
    lsst = pachon.load_telescope("lsst_v3.3_r")
    pupil = {"diam": lsst.pupil_diameter, "obscuration": lsst.pupil_obscuration}
    return {"lam": WAVELENGTH * 1e9, "exptime": 15.0, "geometric_shooting": True} | pupil | options


def galsim_stars(
    layers: galsim.PhaseScreenList,
    fields: np.ndarray,
    rng: galsim.BaseDeviate,
    photons: int,
    start: float = 0.0,
    *,
    exposure: float = 15.0,
    pixel: float = PIXEL,
    stamp: int = STAMP,
) -> np.ndarray:
    """Return photon images of stars, shape [star, y, x]; ``fields`` are slopes of the light's travel."""
    aperture = layers.makePSF(**galsim_exposure()).aper
    images = []
    for tx, ty in fields:
        # GalSim's angle is where the star stands on the sky; light travels the other way.
        theta = (-tx * galsim.radians, -ty * galsim.radians)
        psf = layers.makePSF(**galsim_exposure(aper=aperture, theta=theta, t0=start, exptime=exposure))
        image = psf.drawImage(nx=stamp, ny=stamp, scale=pixel / ARCSEC, method="phot", n_photons=photons, rng=rng)
        # It draws the sky, pachon the focal plane, rotated by half a circle.
        images.append(image.array[::-1, ::-1])
    return np.array(images)


def pachon_stars(telescope: Telescope, atmosphere: Atmosphere, fields: np.ndarray, **options) -> np.ndarray:
    """Return the fast engine's images of stars, shape [star, y, x]."""
    pixel = PIXEL * telescope.reference_sphere_radius
    stamps = pachon.Stamps(**({"size": STAMP, "pixel_size": pixel, "diffusion": 0.0} | options))
    return pachon.make_psfs(telescope, fields, [WAVELENGTH], atmosphere=atmosphere, stamps=stamps, threads=1).image


def ellipticity(images: np.ndarray, pixel: float = PIXEL) -> np.ndarray:
    """Return complex ellipticities e1 + i e2."""
    shapes = pachon.measure_shapes(images, pixel, WEIGHT_FWHM)
    return shapes.e1 + 1j * shapes.e2


def summary(fields: np.ndarray, first: np.ndarray, second: np.ndarray, width: np.ndarray) -> dict[str, np.ndarray]:
    """Return the statistics of one seed from ellipticities [exposure, star], measured twice, and widths."""
    centred = [e - e.mean(axis=1, keepdims=True) for e in (first, second)]
    both = 0.5 * (first + second)
    xi = [pachon.shear_correlation(*fields.T, e.real, e.imag, bins=BINS) for e in both]
    within = [pachon.shear_correlation(*fields.T, e.real, e.imag, bins=BINS, subtract_mean=True) for e in both]
    return {
        "fwhm": width.mean() / ARCSEC,
        "variance": np.mean((first * second.conj()).real),
        "variance within": np.sum((centred[0] * centred[1].conj()).real) / (first.size - len(first)),
        "r": xi[0].r_arcmin,
        "xi": np.mean([c.xi_plus for c in xi], axis=0),
        "xi within": np.mean([c.xi_plus for c in within], axis=0),
    }


def through_galsim_screens(atmosphere: Atmosphere, layers: galsim.PhaseScreenList) -> Atmosphere:
    """Return an atmosphere with the slopes that pachon would make of the modes of GalSim's screens."""
    size, pixel = atmosphere.screen_size, atmosphere.screen_pixel
    axis = (np.arange(size) - size // 2) * pixel
    kx, ky = 2.0 * math.pi * np.fft.rfftfreq(size, pixel), 2.0 * math.pi * np.fft.fftfreq(size, pixel)[:, None]
    lag = np.sinc(np.hypot(kx, ky) * SLOPE_LAG / (2.0 * math.pi))
    cutoff = 2.0 * math.pi * layers.makePSF(**galsim_exposure()).screen_kmax
    screens = np.empty((len(layers), size, size), dtype=np.int32)
    result = through_screens(atmosphere, screens, offsets=np.full((len(layers), 2), -axis[0]), cutoff=cutoff)
    for number, layer in enumerate(layers):
        # GalSim's wavefronts are in nanometres, and at its own samples nothing is interpolated.
        spectrum = scipy.fft.rfft2(1e-9 * layer.wavefront(*np.meshgrid(axis, axis), 0.0)) * lag
        x_counts, y_counts = (
            np.rint(scipy.fft.irfft2(1j * k * spectrum, s=(size, size)) / result.slope_unit(number)).astype(np.int32)
            for k in (kx, ky)
        )
        screens[number] = (y_counts << 16) | (x_counts & 0xFFFF)
    return result


def one_seed(seed: int, exposures: int, stars: int, photons: int) -> dict[str, dict[str, np.ndarray]]:
    """Return the statistics of one seed: of "pachon", "galsim", and pachon through GalSim's screens ("shared")."""
    telescope = long_paraboloid()
    own = Atmosphere.from_site(SITE, seed, screens=ScreenSampling(screen_size=SIZE, screen_length=LENGTH))
    layers = galsim_layers(own, seed)
    atmospheres = {
        "pachon": through_screens(own, own.screens("slopes", 1)),
        "shared": through_galsim_screens(own, layers),
    }
    own.release()
    fields = stream(0, "stars").uniform(-FIELD, FIELD, (stars, 2))
    rng = galsim.BaseDeviate(1000 + seed)
    shape = (exposures, stars)
    shapes = {name: np.empty(shape, dtype=complex) for name in ("pachon", "shared", "first", "second")}
    width = {name: np.empty(shape) for name in ("pachon", "shared", "galsim")}
    for exposure in range(exposures):
        start = exposure * EPOCH_STEP
        for name, atmosphere in atmospheres.items():
            later = through_screens(atmosphere, atmosphere.screens("slopes"), times=atmosphere.times + start)
            images = pachon_stars(telescope, later, fields)
            shapes[name][exposure], width[name][exposure] = ellipticity(images), fwhm(images, PIXEL)
        halves = [galsim_stars(layers, fields, rng, photons // 2, start) for _ in range(2)]
        shapes["first"][exposure], shapes["second"][exposure] = (ellipticity(half) for half in halves)
        # The maximum of a noisy image is too high by an amount that goes as one over the photons.
        half_width = 0.5 * (fwhm(halves[0], PIXEL) + fwhm(halves[1], PIXEL))
        width["galsim"][exposure] = 2.0 * fwhm(halves[0] + halves[1], PIXEL) - half_width
    result = {
        "galsim": summary(fields, shapes["first"], shapes["second"], width["galsim"]),
        "pachon": summary(fields, shapes["pachon"], shapes["pachon"], width["pachon"]),
        "shared": summary(fields, shapes["shared"], shapes["shared"], width["shared"]),
    }
    ours, first, second = shapes["shared"], shapes["first"], shapes["second"]
    result["shared"]["product"] = np.mean((ours * (0.5 * (first + second)).conj()).real)
    result["shared"]["difference"] = np.mean(((ours - first) * (ours - second).conj()).real)
    return result


class Comparison:
    """Statistics of all seeds.

    ``sides`` maps "pachon", "galsim" and "shared" (pachon through GalSim's screens) to dictionaries of the statistics
    of :func:`summary`, each an array with the seeds along its first axis.
    """

    def __init__(self, results: list[dict[str, dict[str, np.ndarray]]]) -> None:
        self.sides = {
            side: {name: np.array([r[side][name] for r in results]) for name in results[0][side]} for side in results[0]
        }

    def mean(self, side: str, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return a mean over the seeds and its error."""
        values = self.sides[side][name]
        return values.mean(axis=0), values.std(axis=0, ddof=1) / math.sqrt(len(values))

    def ratio(self, name: str, side: str = "pachon") -> tuple[np.ndarray, np.ndarray]:
        """Return the mean of one side over that of GalSim, and its error."""
        ours, theirs = self.sides[side][name], self.sides["galsim"][name]
        # Winds or screens that both sides of a seed have in common cancel in the difference.
        scatter = ours / ours.mean(axis=0) - theirs / theirs.mean(axis=0)
        ratio = ours.mean(axis=0) / theirs.mean(axis=0)
        return ratio, np.abs(ratio) * scatter.std(axis=0, ddof=1) / math.sqrt(len(scatter))

    @property
    def correlation(self) -> float:
        """Correlation of the ellipticities of the same stars through the same screens, without photon noise."""
        shared = self.sides["shared"]
        power = shared["variance"].mean() * self.sides["galsim"]["variance"].mean()
        return float(shared["product"].mean() / math.sqrt(power))

    @property
    def difference(self) -> float:
        """Their rms difference in a component, without photon noise."""
        return math.sqrt(max(0.0, 0.5 * float(self.sides["shared"]["difference"].mean())))


def compare(seeds: range, exposures: int, stars: int, photons: int, report=lambda text: None) -> Comparison:
    """Return the comparison over a range of seeds; ``report`` is called with a line a seed."""
    results = []
    with galsim.utilities.single_threaded():
        for seed in seeds:
            start = time.perf_counter()
            results.append(one_seed(seed, exposures, stars, photons))
            ours, theirs = results[-1]["pachon"], results[-1]["galsim"]
            report(
                f"  seed {seed:3d}: FWHM {ours['fwhm']:.4f} {theirs['fwhm']:.4f} arcsec,"
                f" <|e|^2> {ours['variance']:.2e} {theirs['variance']:.2e}, {time.perf_counter() - start:.0f} s"
            )
    return Comparison(results)


def endless_widths() -> tuple[float, float]:
    """Return the FWHM of an endless exposure in the same pixels [arcsec]: in theory, and as GalSim shoots it."""
    # Waves of metres make the slopes: small screens suffice, and the wind does not matter.
    air = Atmosphere.from_site(
        SITE, 0, exposure=1.0, screens=ScreenSampling(screen_size=1024, screen_length=LENGTH / 3.0)
    )
    layers = galsim_layers(air, 0)
    u, v = stream(0, "places").uniform(0.0, air.screen_length, (2, 1_000_000))
    slopes = 1e-9 * np.array(layers.wavefront_gradient(u, v, 0.0))
    # Far more than one wave long in an endless exposure, slopes are Gaussian.
    rays = galsim.Gaussian(sigma=math.sqrt(np.mean(slopes**2)) / ARCSEC)
    options = galsim_exposure()
    theory = galsim.VonKarman(lam=options["lam"], r0_500=air.r0, L0=air.outer_scale)
    airy = galsim.Airy(lam=options["lam"], diam=options["diam"], obscuration=options["obscuration"])
    shot = galsim.Convolve(rays, layers.makePSF(**options).second_kick)
    images = [
        profile.drawImage(nx=STAMP, ny=STAMP, scale=PIXEL / ARCSEC).array.astype(float)
        for profile in (galsim.Convolve(theory, airy), shot)
    ]
    return tuple(fwhm(images, PIXEL) / ARCSEC)


def draw(comparison: Comparison, path: Path) -> None:
    """Draw xi+ of both sides."""
    figure, axes = plt.subplots(1, 2, figsize=(9.0, 3.6), layout="constrained")
    titles = {"xi": "as observed", "xi within": "less the mean of each exposure"}
    for panel, (name, title) in zip(axes, titles.items(), strict=True):
        for side, label, colour, shift in (("pachon", "pachon", "C0", 0.98), ("galsim", "GalSim", "C1", 1.02)):
            mean, error = comparison.mean(side, name)
            r = comparison.mean(side, "r")[0] * shift
            panel.errorbar(r, mean, error, fmt="o-", color=colour, label=label, capsize=2)
        panel.axhline(0.0, color="0.6", lw=0.8)
        panel.set(xscale="log", xlabel="separation [arcmin]", ylabel=r"$\xi_+$", title=title)
        panel.ticklabel_format(axis="y", style="sci", scilimits=(0, 0))
        panel.set_xticks([0.5, 1, 2, 5, 10], ["0.5", "1", "2", "5", "10"])
        panel.minorticks_off()
    axes[0].legend()
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description="The atmosphere alone, against GalSim's.")
    parser.add_argument("--seeds", type=int, default=24, help="sets of screens a side")
    parser.add_argument("--exposures", type=int, default=16, help="exposures of 15 s through each set")
    parser.add_argument("--stars", type=int, default=16)
    parser.add_argument("--photons", type=int, default=100_000, help="photons of GalSim a star")
    parser.add_argument("--figure", type=Path, help="file for a plot of xi+")
    arguments = parser.parse_args()
    print(f"pachon {pachon.__version__}, GalSim {galsim.__version__}; one thread each")
    print(
        f"six layers, 15 s, {WAVELENGTH * 1e9:.0f} nm, screens of {SIZE}^2 over {LENGTH:.1f} m; {arguments.seeds} seeds"
        f" of {arguments.exposures} exposures of {arguments.stars} stars"
    )
    comparison = compare(range(arguments.seeds), arguments.exposures, arguments.stars, arguments.photons, print)
    print("1. each side through its own screens     pachon                   GalSim                   pachon / GalSim")
    for name, unit, form in (("fwhm", "arcsec", ".4f"), ("variance", "", ".2e"), ("variance within", "", ".2e")):
        row = (comparison.mean("pachon", name), comparison.mean("galsim", name), comparison.ratio(name))
        cells = "  ".join(f"{m:{f}} +- {e:{f}}" for (m, e), f in zip(row, (form, form, ".3f"), strict=True))
        print(f"  {name:>16} {unit:6}  {cells}")
    theory, shot = endless_widths()
    print(f"  FWHM of an endless exposure: theory {theory:.4f}, GalSim's rays and second kick {shot:.4f} arcsec")
    for name in ("xi", "xi within"):
        for k, r in enumerate(comparison.mean("pachon", "r")[0]):
            row = (comparison.mean("pachon", name), comparison.mean("galsim", name), comparison.ratio(name))
            cells = "  ".join(f"{m[k]:{f}} +- {e[k]:{f}}" for (m, e), f in zip(row, (".2e", ".2e", ".2f"), strict=True))
            print(f"  {name:>16} {r:5.2f}'  {cells}")
    print("2. pachon's fast engine through GalSim's screens, over GalSim")
    for name in ("fwhm", "variance", "variance within"):
        print("  {:>16}  {:.3f} +- {:.3f}".format(name, *comparison.ratio(name, "shared")))
    print(
        f"  star by star: correlation of e {comparison.correlation:.4f}, rms difference in a component"
        f" {comparison.difference:.1e}"
    )
    if arguments.figure:
        draw(comparison, arguments.figure)


if __name__ == "__main__":
    main()
