"""The statistical engine against screens: variances and half-variograms of shapes, their kurtosis, other weights, cost.

    python benchmarks/statistical_engine.py screens FOLDER [--telescope decam] [--exposure 30] [--winds 2] [--count 16]
    python benchmarks/statistical_engine.py compare FOLDER [--telescope ...] [--exposure ...] [--winds ...] [--draws 80]
    python benchmarks/statistical_engine.py plot FOLDER [--picture docs/images/statistical_variogram.png]
    python benchmarks/statistical_engine.py time

`screens` exposes stars by the fast engine with the same winds and other turbulence, `count` sets of screens, each at
four places, and writes their shapes; again it adds to what the folder has. Pairs of stars 3 arcsec apart tell the noise
of the engine's own sampling, which is taken off. `compare` draws as many exposures of the statistical engine, measures
them alike and prints ratios, with the standard errors of the screens' exposures. `time` prints the times of a visit of
189 CCDs with 60 stars, interleaved with the fast engine, with and without the time of its screens.
"""

import argparse
import json
import math
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

import pachon
from pachon.core.units import ARCMIN, ARCSEC
from pachon.wavefront.atmosphere.layers import layer_random

#: Wavelength [m], sampling of the screens and weights of the moments [arcsec].
WAVELENGTH = {"lsst_v3.3_r": 620e-9, "decam": 640e-9, "hsc": 760e-9}
WEIGHTS = (0.5, 0.7, 1.0)
PLACES = 4
#: Lags of the table [arcmin], and the half width of their bins as a part of them.
LAGS = (1.0, 3.0, 7.0, 15.0, 30.0, 60.0)
NAMES = ("e1", "e2", "ln size")
RMS = 0.1e-6


def star_fields(telescope):
    """Return field angles [rad]: crosses of 1, 3 and 7 arcmin, twins 3 arcsec apart, and a grid of 15 arcmin."""
    radius = min(telescope.field_radius, math.radians(1.72)) * 0.97
    rng = np.random.default_rng(0)
    line = np.array([0.0, 1.0, 3.0, 7.0]) * ARCMIN
    cross = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    reach = radius - 0.003
    middles = rng.uniform(-reach, reach, (200, 2))
    middles = middles[np.hypot(*middles.T) < reach - 0.003][:18]
    patches = (middles[:, None] + cross).reshape(-1, 2)
    twins = patches[::8] + 3.0 * ARCSEC
    grid = 15.0 * ARCMIN * np.arange(-8, 9)
    grid = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
    fields = np.concatenate([patches, twins, grid])
    return fields[np.hypot(*fields.T) < radius]


def atmosphere(seed, options):
    """Return the exposure of a seed with the winds of the set, whatever the seed."""
    site = pachon.models.load_site("cerro_pachon")
    directions = [2.0 * math.pi * layer_random(options.winds, 0, n, "wind", 1)[0] for n in range(len(site.altitudes))]
    return pachon.Atmosphere.from_site(
        site.with_layers(wind_directions=directions), 1000 * options.winds + seed, exposure=options.exposure
    )


def expose(options, telescope, fields, air, engine):
    """Return the PSFs of an exposure."""
    stamps = pachon.Stamps.of_camera("lsst")
    if options.telescope == "decam":
        stamps = pachon.Stamps.of_camera("decam")
        # Under a weight of 0.5 arcsec sums over its own pixels of 0.26 depend on the place within them, by 4e-3 in e1.
        stamps = replace(stamps, size=61, pixel_size=0.5 * stamps.pixel_size)
    aberration = pachon.wavefront.ResidualWavefront.draw(telescope, RMS, 1, 0)
    return pachon.make_psfs(
        telescope,
        fields,
        [WAVELENGTH[options.telescope]],
        atmosphere=air,
        aberration=aberration,
        stamps=stamps,
        engine=engine,
        threads=1,
    )


def shapes(psfs):
    """Return e1, e2 and ln size under each weight, [weight, 3, star]."""
    measured = [pachon.measure_shapes(psfs.image, psfs.pixel_scale, w * ARCSEC) for w in WEIGHTS]
    return np.array([[s.e1, s.e2, np.log(s.size)] for s in measured])


def case(options):
    """Return the name of a telescope, exposure time and wind set."""
    return f"{options.telescope}_{options.exposure:g}s_winds{options.winds}"


def screens(options):
    """Expose by the fast engine; one file a set of screens."""
    telescope = pachon.load_telescope(options.telescope)
    fields = star_fields(telescope)
    options.folder.mkdir(parents=True, exist_ok=True)
    for seed in range(options.first, options.first + options.count):
        file = options.folder / f"{case(options)}_{seed:03d}.npz"
        if file.exists():
            continue
        base = atmosphere(seed, options)
        base.screens("slopes", threads=1)
        measured, images = [], []
        for place in range(PLACES):
            offsets = np.random.default_rng([seed, place]).uniform(0.0, base.screen_length, base.offsets.shape)
            psfs = expose(options, telescope, fields, replace(base, offsets=offsets), "fast")
            measured.append(shapes(psfs))
            images.append(psfs.image[:320:32])
        base.release()
        np.savez(file, shapes=np.array(measured), images=np.array(images))
        print(case(options), seed, np.array(measured)[:, 1].std(axis=2).mean(axis=0).round(5).tolist(), flush=True)


def pairs(fields, lag):
    """Return indices of the pairs of stars a lag [arcmin] apart, within 2 %."""
    distance = np.hypot(*(fields[:, None] - fields).T) / ARCMIN
    return np.nonzero(np.triu(np.abs(distance / lag - 1.0) < 0.02))


def half_variograms(values, fields, lag):
    """Return half-variograms and cross ones (e1, e2, ln size, e1 e2, e1 s, e2 s) of exposures, [exposure, 6]."""
    i, j = pairs(fields, lag)
    d = values[:, :, i] - values[:, :, j]
    products = [d[:, a] * d[:, b] for a, b in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
    return 0.5 * np.mean(products, axis=2).T


def mean_error(values):
    """Return the mean over exposures and its standard error."""
    return values.mean(axis=0), values.std(axis=0, ddof=1) / math.sqrt(len(values))


def loaded(options):
    """Return shapes of all exposures by screens, [exposure, weight, 3, star], and images."""
    files = sorted(options.folder.glob(f"{case(options)}_[0-9]*.npz"))
    data = [np.load(f) for f in files]
    return np.concatenate([d["shapes"] for d in data]), np.concatenate([d["images"] for d in data])


def about_the_mean(values):
    """Return values [exposure, ...] less their mean over exposures, of unchanged variance."""
    return (values - values.mean(axis=0)) * math.sqrt(len(values) / (len(values) - 1.0))


def drawn_shapes(options, telescope, fields):
    """Return shapes of exposures of the statistical engine, [exposure, weight, 3, star], once drawn from the folder."""
    file = options.folder / f"drawn_{case(options)}.npz"
    if not file.exists():
        exposures = [
            shapes(expose(options, telescope, fields, atmosphere(5000 + n, options), "statistical"))
            for n in range(options.draws)
        ]
        np.savez(file, shapes=np.array(exposures))
    return np.load(file)["shapes"]


def compare(options):
    """Print ratios of screens and statistical engine, and write them to the folder."""
    telescope = pachon.load_telescope(options.telescope)
    fields = star_fields(telescope)
    by_screens, images = loaded(options)
    drawn = drawn_shapes(options, telescope, fields)
    # The engines differ in the mean too, by diffraction on the aberrated pupil, which the fast one leaves out.
    static = by_screens[:, 1].mean(axis=0) - drawn[:, 1].mean(axis=0)
    by_screens, drawn = about_the_mean(by_screens), about_the_mean(drawn)
    close = 3.0 * math.sqrt(2.0) / 60.0
    noise = half_variograms(by_screens[:, 1], fields, close).mean(axis=0)
    noise = noise - half_variograms(drawn[:, 1], fields, close).mean(axis=0)
    print(f"{case(options)}: {len(by_screens)} exposures by screens, {len(drawn)} drawn, {len(fields)} stars")
    print("sampling noise of a star by the fast engine:", np.sqrt(np.maximum(noise[:3], 0.0)).round(5).tolist())
    table = {"lag": [], "screens": [], "error": [], "drawn": [], "drawn_error": [], "noise": noise.tolist()}
    (a, ea), (b, eb) = (mean_error((v[:, 1] ** 2).mean(axis=2)) for v in (by_screens, drawn))
    ratio = (a - noise[:3]) / b
    print(
        "variance, screens / drawn:",
        ratio.round(3).tolist(),
        "+-",
        (ratio * np.hypot(ea / a, eb / b)).round(3).tolist(),
    )
    print("difference of the means over exposures, rms over the field:", static.std(axis=1).round(5).tolist(),
          "mean", static.mean(axis=1).round(5).tolist())  # fmt: skip
    for lag in LAGS:
        (a, ea), (b, eb) = (mean_error(half_variograms(s[:, 1], fields, lag)) for s in (by_screens, drawn))
        a = a - noise
        cross = (a[3:] - b[3:]) / np.sqrt(b[[0, 0, 1]] * b[[1, 2, 2]])
        error = a[:3] / b[:3] * np.hypot(ea[:3] / a[:3], eb[:3] / b[:3])
        print(f"lag {lag:4g}': half-variogram / 1e-6", (1e6 * a[:3]).round(2).tolist(),
              "screens / drawn", (a[:3] / b[:3]).round(3).tolist(), "+-", error.round(3).tolist(),
              "cross (e1 e2, e1 s, e2 s)", cross.round(3).tolist())  # fmt: skip
        for name, value in (("lag", lag), ("screens", a), ("error", ea), ("drawn", b), ("drawn_error", eb)):
            table[name].append(value if np.isscalar(value) else value.tolist())
    for name, values in (("screens", by_screens), ("drawn", drawn)):
        v = values[:, 1] - values[:, 1].mean(axis=2, keepdims=True)
        by_star = v / v.std(axis=0)
        kurtosis = (by_star**4).mean(axis=(0, 2)) - 3.0
        common = values[:, 1].mean(axis=2)
        correlation = np.corrcoef(v.transpose(1, 0, 2).reshape(3, -1))[[0, 0, 1], [1, 2, 2]]
        print(f"{name}: excess kurtosis of stars about each exposure's mean", kurtosis.round(3).tolist(),
              "rms of the mean of an exposure", common.std(axis=0).round(5).tolist(),
              "correlations about it", correlation.round(3).tolist())  # fmt: skip
        remainders = [np.sqrt(np.mean(polynomial_remainders(values[:, 1], fields, n) ** 2, axis=(0, 2)))
                      for n in (1, 2, 3)]  # fmt: skip
        if name == "screens":
            remainders = [np.sqrt(np.maximum(r**2 - noise[:3], 0.0)) for r in remainders]
        print("  rms after polynomials of order 1, 2, 3:", np.array(remainders).round(6).tolist())
    for k, weight in enumerate(WEIGHTS):
        if k == 1:
            continue
        a, b = (s[:, k] - s[:, 1] for s in (by_screens, drawn))
        print(f"weight {weight}: rms change from 0.7 arcsec: screens", a.std(axis=(0, 2)).round(5).tolist(),
              "drawn", b.std(axis=(0, 2)).round(5).tolist())  # fmt: skip
    matched(images, options, telescope, fields)
    (options.folder / f"{case(options)}.json").write_text(json.dumps(table))


def polynomial_remainders(values, fields, order):
    """Return values [exposure, 3, star] less polynomials over the field fitted to each exposure."""
    x, y = fields.T / np.abs(fields).max()
    terms = np.stack([x**i * y**j for i in range(order + 1) for j in range(order + 1 - i)], axis=1)
    q, _ = np.linalg.qr(terms)
    return values - values @ q @ q.T


def matched(images, options, telescope, fields):
    """Print how far images by screens are from long exposures, each under the Gaussian kernel of its shape.

    What is the same in all exposures of a star is diffraction on the aberrated pupil, which the fast engine leaves out.
    """
    long = expose(options, telescope, fields[:320:32], atmosphere(0, options), "long_exposure")
    size, scale = long.image.shape[1], long.pixel_scale / ARCSEC
    grid = 2 * size
    fx, fy = np.meshgrid(np.fft.rfftfreq(grid, scale), np.fft.fftfreq(grid, scale))
    spectra = np.fft.rfft2(long.image.astype(float), s=(grid, grid))

    def blurred(star, moments):
        kernel = np.exp(-2.0 * np.pi**2 * (moments[0] * fx**2 + moments[1] * fy**2 + 2.0 * moments[2] * fx * fy))
        return np.fft.irfft2(spectra[star] * kernel, s=(grid, grid))[:size, :size]

    def shape(image, weight):
        s = pachon.measure_shapes(image, long.pixel_scale, weight * ARCSEC)
        return np.array([s.e1[0], s.e2[0], np.log(s.size[0])])

    misfits = []
    for exposure in images[:: max(1, len(images) // 64)]:
        for star in range(len(spectra)):
            moments, goal = np.zeros(3), shape(exposure[star], 0.7)
            for _ in range(4):
                now = shape(blurred(star, moments), 0.7)
                change = [(shape(blurred(star, moments + d), 0.7) - now) / 1e-3 for d in 1e-3 * np.eye(3)]
                moments = moments + np.linalg.solve(np.array(change).T, goal - now)
            image = blurred(star, moments)
            misfits.append([shape(image, w) - shape(exposure[star], w) for w in (0.5, 1.0)])
    misfits = np.reshape(misfits, (-1, len(spectra), 2, 3))
    rms = np.sqrt(np.mean(misfits**2, axis=(0, 1)))
    beside = np.sqrt(np.mean(np.var(misfits, axis=0, ddof=1), axis=0))
    print("images by screens less long exposures under a matched kernel, rms at 0.5 and 1.0 arcsec:",
          rms.round(5).tolist(), "about the mean of each star's exposures:", beside.round(5).tolist())  # fmt: skip


def plot(options):
    """Draw half-variograms of all cases with a comparison."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    files = sorted(options.folder.glob("*.json"))
    figure, axes = plt.subplots(1, len(files), figsize=(4.2 * len(files), 3.8), squeeze=False, sharey=True)
    for axis, file in zip(axes[0], files, strict=True):
        table = {k: np.array(v) for k, v in json.loads(file.read_text()).items()}
        for k, name in enumerate(NAMES):
            color = f"C{k}"
            axis.errorbar(table["lag"], 1e6 * table["screens"][:, k], 1e6 * table["error"][:, k], fmt="o", color=color,
                          markersize=4, label=f"{name}, screens")  # fmt: skip
            axis.plot(table["lag"], 1e6 * table["drawn"][:, k], color=color, label=f"{name}, statistical")
        axis.set(xscale="log", yscale="log", xlabel="separation [arcmin]", title=file.stem.replace("_", " "))
    axes[0, 0].set_ylabel("half-variogram [1e-6]")
    axes[0, 0].legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(options.picture, dpi=110)


def times(options):
    """Print processor times of a visit: 189 CCDs with 60 stars, one thread."""
    telescope = pachon.load_telescope("lsst_v3.3_r")
    plane = pachon.FocalPlane.from_budget("lsst", seed=1)
    rng = np.random.default_rng(1)
    centers = plane.camera.centers
    positions = (centers[:, None] + rng.uniform(-0.0195, 0.0195, (len(centers), options.stars, 2))).reshape(-1, 2)
    fields = pachon.fields_at(telescope, positions, threads=1)
    few = fields[:: max(1, len(fields) // 200)]
    waves = {1: [620e-9], 5: np.linspace(545e-9, 703e-9, 5)}
    for count, wavelengths in waves.items():
        seconds = {"fast": [], "stamps": [], "shapes": [], "fields": []}
        with_screens = pachon.Atmosphere.from_site("cerro_pachon", 3)
        start = time.process_time()
        with_screens.screens("slopes", threads=1)
        made = time.process_time() - start
        arguments = {"wavelengths": wavelengths, "focal_plane": plane, "threads": 1}
        by_engine, shapes_alone = partial(pachon.make_psfs, telescope), partial(pachon.psf_moments, telescope)
        for visit in range(1 + options.repeats):
            for n, (name, engine, places, call) in enumerate((
                ("fast", "fast", few, by_engine),
                ("stamps", "statistical", fields, by_engine),
                ("shapes", "statistical", fields, shapes_alone),
                ("fields", "statistical", fields[:1], shapes_alone),
            )):  # fmt: skip
                # Each has its own winds: nothing of the statistics of another is of use.
                air = pachon.Atmosphere.from_site("cerro_pachon", 3, epoch=1000 * count + 10 * visit + n)
                start = time.process_time()
                call(places, engine=engine, atmosphere=with_screens if engine == "fast" else air, **arguments)
                if visit:
                    seconds[name].append(time.process_time() - start)
        with_screens.release()
        spent = {name: float(np.median(values)) for name, values in seconds.items()}
        by_screens = len(fields) * spent["fast"] / len(few)
        print(f"{count} wavelengths, pachon {pachon.__version__}: fast {1e6 * spent['fast'] / len(few):.0f} us a star,"
              f" screens {made:.1f} s; fields of an exposure {spent['fields']:.2f} s", flush=True)  # fmt: skip
        for name in ("stamps", "shapes"):
            print(f"  a visit of {len(fields)} {name}: {spent[name]:.2f} s; fast / statistical"
                  f" {(made + by_screens) / spent[name]:.1f} with its screens, {by_screens / spent[name]:.1f} without",
                  flush=True)  # fmt: skip


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", choices=("screens", "compare", "plot", "time"))
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--telescope", default="lsst_v3.3_r", choices=tuple(WAVELENGTH))
    parser.add_argument("--exposure", type=float, default=15.0, help="[s]")
    parser.add_argument("--winds", type=int, default=1, help="number of the wind set")
    parser.add_argument("--first", type=int, default=0, help="first set of screens")
    parser.add_argument("--count", type=int, default=8, help="sets of screens")
    parser.add_argument("--draws", type=int, default=80, help="exposures of the statistical engine")
    parser.add_argument("--stars", type=int, default=60, help="stars of a CCD whose times are taken")
    parser.add_argument("--repeats", type=int, default=3, help="visits whose times are taken")
    parser.add_argument("--picture", type=Path, default=Path("statistical_variogram.png"))
    options = parser.parse_args()
    {"screens": screens, "compare": compare, "plot": plot, "time": times}[options.task](options)
