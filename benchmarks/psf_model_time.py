"""Time of the PSF models of a whole focal plane: stamps in memory to models on disk.

Run: python benchmarks/psf_model_time.py RUN [--ccds N] [--threads N] [--repeats N]

RUN is the folder of a `pachon run`: its observed stars, 31 x 31 pixels and centred, are taken CCD after CCD, from the
beginning again until there are enough. Each model is fitted and written to a FITS file of its own in a temporary
folder. Polynomials of order 3 over 20 eigen-PSFs, as in Jee & Tyson 2011, and a Gaussian process for each of the 20,
in one process, in turns. The first fit of each kind, which loads libraries, is not counted.
"""

import argparse
import platform
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import version
from pathlib import Path

import numpy as np

import pachon
from pachon.reconstruction.ccd_product import CcdProduct, read_product

OPTIONS = {"polynomials": {"order": 3}, "kriging": {"interpolation": "kriging", "gain": None}}


def fit_and_write(product: CcdProduct, options: dict, path: Path) -> None:
    stars = product.observed
    used = stars.used
    positions = np.stack([stars.x, stars.y], axis=1)[used]
    extent = product.model.extent
    pachon.PsfModel.fit(product.observed_images[used], positions, n_components=20, extent=extent, **options).write(path)


def seconds(products: list[CcdProduct], options: dict, count: int, threads: int) -> float:
    """Return the seconds that a number of models take."""
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(threads) as pool:
        jobs = [(products[i % len(products)], options, Path(folder) / f"{i}.fits") for i in range(count)]
        start = time.perf_counter()
        list(pool.map(lambda job: fit_and_write(*job), jobs))
        return time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="folder of a pachon run")
    parser.add_argument("--ccds", type=int, default=189, help="models to make")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    products = [read_product(path, holdout_images=False) for path in sorted(arguments.run.glob("ccd_*.fits"))]
    stars = [int(p.observed.used.sum()) for p in products]
    print(
        f"pachon {version('pachon')}, numpy {np.__version__}, "
        f"{platform.machine()}, {arguments.threads} threads: "
        f"{arguments.ccds} CCDs of {min(stars)} to {max(stars)} stars"
    )
    for options in OPTIONS.values():
        seconds(products, options, 1, 1)
    times = {name: [] for name in OPTIONS}
    for _ in range(arguments.repeats):
        for name, options in OPTIONS.items():
            times[name].append(seconds(products, options, arguments.ccds, arguments.threads))
    for name, each in times.items():
        print(f"{name:20s} {min(each):6.1f} s at best, {max(each):6.1f} s at worst of {len(each)}")


if __name__ == "__main__":
    main()
