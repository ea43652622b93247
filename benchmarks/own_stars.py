"""PSF models of own stars: the default beside every option, and Piff, on GalSim's fields, smooth and turbulent.

Run: python benchmarks/own_stars.py [--stars 20,50,100,200] [--seeds N] [--first-seed N] [--without TEXTS] [--piff]

Stars are GalSim's Kolmogorov profiles of 0.7", S/N 30 to 600, on stamps of 33 x 33 pixels of 0.2", anywhere in a pixel.
Ellipticity and size are quadratic over the CCD (smooth), with a process of twice their size that falls off
exponentially over a quarter of the CCD besides (turbulent). The default is `fit_own_stars` without options. All options
are fitted to the same centred stars. Each is drawn at 150 places without a star, and measured as the noise-free PSF is.
The best option is that of the least rms error of e, found with the truth, anew for each field. Beside them stands what
nobody has: a quadratic with weights by the true noise of each star, exact where smooth; it is none of the options.
"""

import argparse
import time
import warnings

import galsim
import numpy as np

import pachon
from pachon import PachonError
from pachon.core.units import ARCSEC
from pachon.measure import center_stamps
from pachon.reconstruction.psf_model import kriging
from pachon.reconstruction.psf_model.polynomial import design_matrix

PIXEL, STAMP, SKY, FWHM = 0.2, 33, 22.0, 0.7
PLACES, AMPLITUDE, CORRELATION = 150, 0.006, 0.5
EXTENT = (-1.0, 1.0, -1.0, 1.0)
ROUGH = {"smooth": 0.0, "turbulent": 2.0}
EXACT = "quadratic, true noise"


def psfs(shear, growth, offsets, size):
    """Return noise-free stars of unit sum."""
    images = []
    for (g1, g2), grown, offset in zip(shear, growth, offsets, strict=True):
        profile = galsim.Kolmogorov(fwhm=FWHM * (1.0 + grown)).shear(e1=2.0 * g1, e2=2.0 * g2)
        images.append(profile.drawImage(nx=size, ny=size, scale=PIXEL, offset=tuple(offset)).array.astype(float))
    return np.stack(images) / np.sum(images, axis=(1, 2), keepdims=True)


def field(kind, count, seed):
    """Return stars in electrons, their places, other places, and a function to noise-free PSFs there."""
    rng = np.random.default_rng([seed, count, int(ROUGH[kind])])
    points = rng.uniform(-1.0, 1.0, (count + PLACES, 2))
    distance = np.hypot(*np.moveaxis(points[:, None] - points, -1, 0))
    process = np.linalg.cholesky(np.exp(-distance / CORRELATION) + 1e-9 * np.eye(len(points)))
    values = [
        AMPLITUDE
        * (design_matrix(points, EXTENT, 2) @ rng.normal(size=6) + ROUGH[kind] * process @ rng.normal(size=len(points)))
        for _ in range(3)
    ]
    shear, growth = np.stack(values[:2], axis=1), values[2]
    electrons = 4000.0 * 10.0 ** rng.uniform(0.0, 2.0, count)
    stars = psfs(shear[:count], growth[:count], rng.uniform(-0.5, 0.5, (count, 2)), STAMP)
    stars *= electrons[:, None, None]
    stars += rng.normal(size=stars.shape) * np.sqrt(SKY**2 + stars)
    return (
        stars,
        points[:count],
        points[count:],
        lambda size: psfs(shear[count:], growth[count:], np.zeros((PLACES, 2)), size),
    )


def errors(images, truth):
    """Return the rms errors of a component of e and of the relative size."""
    made, true = (pachon.measure_shapes(i, PIXEL * ARCSEC, FWHM * ARCSEC) for i in (images, truth))
    e = np.sqrt(np.nanmean([(made.e1 - true.e1) ** 2, (made.e2 - true.e2) ** 2]))
    return np.array([e, np.sqrt(np.nanmean((made.size / true.size - 1.0) ** 2))])


def options(electrons):
    """Return the options of PsfModel.fit that one could choose."""
    weights = {"equal weights": None, "(S/N)^2": electrons**2, "weights by noise": "noise"}
    found = {
        f"pixels, order {order}, {name}": {"recipe": "paper", "basis": "pixels", "order": order, "weights": value}
        for order in range(4)
        for name, value in weights.items()
    }
    found |= {f"PCA auto, order {order}": {"n_components": "auto", "order": order} for order in (1, 2, 3, "auto")}
    found["PCA 20, order 3 (paper)"] = {"n_components": min(20, len(electrons) - 2)}
    found["kriging of pixels"] = {}
    return found


def exact_weights(electrons, mean):
    """Return weights of stars by the true noise of their ellipticities, for a noise-free mean PSF."""
    _, filters = kriging.shape_numbers(mean, np.zeros((1, mean.size)))
    squares = (filters[:2] ** 2).sum(axis=0)
    return 1.0 / (SKY**2 * squares.sum() / electrons**2 + squares @ mean.ravel() / electrons)


def piff_psfs(stars, positions, places, order, size):
    """Return PSFs of Piff's PixelGrid and BasisPolynomial at places; positions in units of half a CCD."""
    import piff

    wcs, side = galsim.PixelScale(1.0 / 2000.0), stars.shape[1]
    given = []
    median = np.median(stars / stars.sum(axis=(1, 2), keepdims=True), axis=0)
    for star, (x, y) in zip(stars, np.round(2000.0 * positions).astype(int).tolist(), strict=True):
        corner = {"xmin": x - side // 2, "ymin": y - side // 2}
        variance = SKY**2 + star.sum() * np.maximum(median, 0.0)
        image, weight = (galsim.ImageD(values, wcs=wcs, **corner) for values in (star.copy(), 1.0 / variance))
        given.append(piff.Star(piff.StarData(image, galsim.PositionD(x, y), weight), None))
    psf = piff.SimplePSF(piff.PixelGrid(wcs.scale, 25), piff.BasisPolynomial(order))
    psf.set_context({0: wcs}, None)
    psf.fit(given)
    return np.stack(
        [psf.draw(x, y, center=True, stamp_size=size).array for x, y in np.round(2000.0 * places).astype(int).tolist()]
    )


def one_field(kind, count, seed, piff_orders, without=()):
    """Return the errors of the default and of every option, and the kind of model that the default chose."""
    stars, positions, places, truth_of = field(kind, count, seed)
    start = time.process_time()
    own = pachon.fit_own_stars(stars, positions, PIXEL * ARCSEC, background=False, extent=EXTENT)
    seconds = time.process_time() - start
    size = own.model.mean.shape[0]
    truth, used = truth_of(size), own.used
    found = {"default": errors(own.model.at(places), truth)}
    first = pachon.measure_shapes(stars, PIXEL * ARCSEC, FWHM * ARCSEC)
    centred = center_stamps(stars, first.x, first.y, size=size, normalize=False)[used]
    electrons = centred.sum(axis=(1, 2))
    exact = {"recipe": "paper", "basis": "pixels", "order": 2, "weights": exact_weights(electrons, truth.mean(axis=0))}
    chosen = {name: how for name, how in options(electrons).items() if not any(text in name for text in without)}
    for name, how in ({EXACT: exact} | chosen).items():
        try:
            found[name] = errors(pachon.PsfModel.fit(centred, positions[used], extent=EXTENT, **how).at(places), truth)
        except PachonError:  # more terms than stars
            continue
    for order in piff_orders:
        drawn = piff_psfs(centred, positions[used], places, order, size)
        found[f"Piff, order {order}"] = errors(drawn, truth)
    return found, own.kind, seconds


def show(kind, count, results):
    """Print the table of one kind of field and number of stars, from results of :func:`one_field`."""
    fields, kinds, seconds = zip(*results, strict=True)
    others = [[v for name, v in found.items() if name not in ("default", EXACT)] for found in fields]
    best = [min(each, key=lambda v: v[0]) for each in others]
    everywhere = [name for name in fields[0] if all(name in found for found in fields)]
    logs = {name: np.log([found[name] / top for found, top in zip(fields, best, strict=True)]) for name in everywhere}
    error = logs["default"][:, 0].std(ddof=1) / np.sqrt(len(fields)) if len(fields) > 1 else np.nan
    level = np.exp(np.mean(np.log(best), axis=0))
    print(
        f"\n{kind}, {count} stars: rms of e {level[0]:.2e} and of size {level[1]:.2e} by the best option of each field"
    )
    chosen = ", ".join(f"{kinds.count(k)} x {k}" for k in sorted(set(kinds)))
    print(
        f"  the default chose {chosen}, {np.mean(seconds):.1f} s of processor time; its ratio of e +- {error:.2f}, "
        f"worst {np.exp(logs['default'][:, 0].max()):.2f}"
    )
    for name, values in sorted(logs.items(), key=lambda item: item[1][:, 0].mean()):
        e, size = np.exp(values.mean(axis=0))
        print(f"  {name:36s} e over the best {e:5.2f}   size {size:5.2f}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--stars", default="20,50,100,200")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--fields", default="smooth,turbulent")
    parser.add_argument("--without", default="", help="Leave out options whose names have one of these texts.")
    parser.add_argument("--piff", action="store_true", help="Piff at orders 1 and 2, too; slow")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    print(f"pachon {pachon.__version__}, GalSim {galsim.__version__}; geometric means over {arguments.seeds} fields")
    orders = (1, 2) if arguments.piff else ()
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.seeds)
    without = [text for text in arguments.without.split(",") if text]
    for kind in arguments.fields.split(","):
        for count in map(int, arguments.stars.split(",")):
            show(kind, count, [one_field(kind, count, seed, orders, without) for seed in seeds])


if __name__ == "__main__":
    main()
