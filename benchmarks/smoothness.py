"""PSF models that choose their smoothness: the default over the best of polynomials of order 0 to 2, where no star is.

Run: python benchmarks/smoothness.py [--stars 10,20,40,80,200] [--seeds N]

Fields are constant, linear and quadratic over the CCD, and turbulent: a constant with a process that falls off
exponentially over a quarter of the CCD. Stars are Moffat profiles of 4e3 to 4e5 electrons; polynomials have weights by
the noise of each star. Rms errors are over all fields of a kind; the best is found with the truth.
"""

import argparse

import numpy as np

import pachon
from pachon.core.errors import PachonError
from pachon.measure.shapes import measure_shapes
from pachon.reconstruction.psf_model.polynomial import design_matrix

SIZE, PLACES, SKY, AMPLITUDE = 21, 150, 22.0, 0.006
EXTENT = (-1.0, 1.0, -1.0, 1.0)
KINDS = {"constant": (0, 0.0), "linear": (1, 0.0), "quadratic": (2, 0.0), "turbulent": (0, 2.0)}
RECIPES = {
    n: pachon.reconstruction.Recipe(pachon.reconstruction.Pixels(), pachon.reconstruction.Polynomial(n), "noise")
    for n in (0, 1, 2)
}


def psfs(e1, e2, width):
    """Return Moffat profiles of unit sum."""
    y, x = np.indices((SIZE, SIZE)) - SIZE // 2
    e1, e2, width = (np.asarray(v)[:, None, None] for v in (e1, e2, width))
    square = (x**2 * (1 - 2 * e1) + y**2 * (1 + 2 * e1) - 4 * e2 * x * y) / (2.2 * width) ** 2
    images = (1.0 + square) ** -3
    return images / images.sum(axis=(1, 2), keepdims=True)


def field(kind, count, seed):
    """Return stars in electrons, their places, noise-free PSFs elsewhere, and these places."""
    order, rough = KINDS[kind]
    rng = np.random.default_rng([seed, count, [*KINDS].index(kind)])
    points = rng.uniform(-1.0, 1.0, (count + PLACES, 2))
    distance = np.hypot(*np.moveaxis(points[:, None] - points, -1, 0))
    process = np.linalg.cholesky(np.exp(-2.0 * distance) + 1e-9 * np.eye(len(points)))
    terms = design_matrix(points, EXTENT, order)
    e1, e2, growth = (
        AMPLITUDE * (terms @ rng.normal(size=terms.shape[1]) + rough * process @ rng.normal(size=len(points)))
        for _ in range(3)
    )
    images = psfs(0.02 + e1, e2, 1.5 * (1.0 + growth))
    stars = 4000.0 * 10.0 ** rng.uniform(0.0, 2.0, count)[:, None, None] * images[:count]
    return (
        stars + rng.normal(size=stars.shape) * np.sqrt(SKY**2 + stars),
        points[:count],
        images[count:],
        points[count:],
    )


def squares(images, truth):
    """Return the mean squares of the errors of a component of e and of the relative size."""
    model, true = (measure_shapes(i, 0.2, 0.7) for i in (images, truth))
    e = np.nanmean([(model.e1 - true.e1) ** 2, (model.e2 - true.e2) ** 2])
    return np.array([e, np.nanmean((model.size / true.size - 1.0) ** 2)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--stars", default="10,20,40,80,200")
    parser.add_argument("--seeds", type=int, default=20)
    arguments = parser.parse_args()
    print(f"pachon {pachon.__version__}; {arguments.seeds} fields each: rms error over that of the best polynomial")
    for kind in KINDS:
        for count in map(int, arguments.stars.split(",")):
            errors = {name: np.zeros(2) for name in ("default", *RECIPES)}
            for seed in range(arguments.seeds):
                stars, places, truth, elsewhere = field(kind, count, seed)
                for name in list(errors):
                    try:
                        model = pachon.PsfModel.fit(stars, places, recipe=RECIPES.get(name), extent=EXTENT)
                    except PachonError:  # more terms than stars
                        del errors[name]
                        continue
                    errors[name] += squares(model.at(elsewhere), truth)
            default = errors.pop("default")
            e, size = np.sqrt(default / np.min(list(errors.values()), axis=0))
            print(f"{kind:10s} {count:4d} stars   e {e:.2f}   size {size:.2f}", flush=True)


if __name__ == "__main__":
    main()
