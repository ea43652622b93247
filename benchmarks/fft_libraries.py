"""FFT libraries for the wave engine: complex transforms of a square in single precision, one thread, interleaved.

    python benchmarks/fft_libraries.py [--rounds 40] [--sizes 480 500 512 1024]

Needs the bench extra: ducc0, pyfftw and mkl_fft. Every library transforms the same array, one after the other in each
round, and is checked against NumPy's double precision; printed are the median times, ratios to SciPy's, and errors.
"""

import argparse
import time
from importlib.metadata import version

import ducc0
import mkl_fft
import numpy as np
import pyfftw
import scipy.fft
from threadpoolctl import threadpool_limits


def transforms(field):
    """Return one call without arguments for each library."""
    source = pyfftw.empty_aligned(field.shape, dtype="complex64")
    plan = pyfftw.FFTW(
        source, pyfftw.empty_aligned(field.shape, dtype="complex64"), axes=(0, 1), flags=("FFTW_MEASURE",)
    )
    source[:] = field
    out = np.empty_like(field)
    return {
        f"scipy {version('scipy')}": lambda: scipy.fft.fft2(field, workers=1),
        f"ducc0 {version('ducc0')}": lambda: ducc0.fft.c2c(field, axes=(0, 1), nthreads=1, out=out),
        f"pyfftw {version('pyfftw')}": plan,
        f"mkl_fft {version('mkl_fft')}": lambda: mkl_fft.fft2(field),
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=40)
    parser.add_argument("--sizes", type=int, nargs="+", default=[480, 500, 512, 1024])
    options = parser.parse_args()
    rng = np.random.default_rng(1)
    with threadpool_limits(limits=1):
        for size in options.sizes:
            field = rng.standard_normal((size, size, 2), dtype=np.float32).view(np.complex64)[..., 0]
            exact = np.fft.fft2(field.astype(np.complex128))
            calls = transforms(field)
            seconds = {name: [] for name in calls}
            for _ in range(options.rounds + 1):
                for name, call in calls.items():
                    start = time.perf_counter()
                    call()
                    seconds[name].append(time.perf_counter() - start)
            median = {name: float(np.median(times[1:])) for name, times in seconds.items()}
            ours = next(iter(median.values()))
            print(f"{size} x {size} complex64")
            for name, call in calls.items():
                error = np.sqrt(np.mean(np.abs(call() - exact) ** 2) / np.mean(np.abs(exact) ** 2))
                print(
                    f"  {name:20s} {1e3 * median[name]:6.2f} ms  {median[name] / ours:5.2f} of scipy  error {error:.1e}"
                )


if __name__ == "__main__":
    main()
