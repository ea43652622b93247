"""The same bytes from four threads and from processes, spawned or forked; memory that does not grow with calls."""

import multiprocessing
import zlib
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import pachon

pytestmark = pytest.mark.slow

FIELDS, WAVELENGTH = [(0.0, 0.01), (0.02, 0.0)], 620e-9
CALLS_MORE, GROWTH = 200, 20e6  #: allocators go up and down by 10 MB


@cache
def telescope():
    return pachon.load_telescope("lsst_v3.3_r")


@cache
def air():
    screens = pachon.ScreenSampling(screen_size=256, screen_length=25.6)
    return pachon.Atmosphere.from_site("cerro_pachon", seed=2, exposure=0.1, screens=screens)


def traced():
    x, y = map(np.ravel, np.meshgrid(*2 * [np.linspace(-3.0, 3.0, 200)]))
    end = pachon.trace(telescope(), pachon.launch_rays(telescope(), FIELDS[0], WAVELENGTH, (x, y)))
    return end.position.tobytes() + end.path_length.tobytes()


CALLS = {
    "trace": traced,
    "make_psfs": lambda: pachon.make_psfs(
        telescope(),
        FIELDS,
        [WAVELENGTH],
        atmosphere=air(),
        engine=pachon.FastEngine(n_pupil=300),
        stamps=pachon.Stamps(255),
    ).image.tobytes(),
    "wavefront_opd": lambda: pachon.wavefront_opd(telescope(), FIELDS[1], WAVELENGTH, grid=256).value.tobytes(),
    "fft_psf": lambda: pachon.fft_psf(telescope(), [FIELDS[1]], WAVELENGTH, pixels=256, n_pupil=64).image.tobytes(),
}


def sums(_=None):
    """Sums of the bytes of each call's result."""
    return {name: zlib.crc32(call()) for name, call in CALLS.items()}


def test_four_threads_at_once():
    alone = sums()
    with ThreadPoolExecutor(4) as pool:
        assert all(each == alone for each in pool.map(sums, range(8)))


@pytest.mark.parametrize("method", ["spawn", "fork"])
def test_processes(method):
    # The parent has started Warp and its threads by then: a fork takes that over.
    alone = sums()
    with multiprocessing.get_context(method).Pool(2) as pool:
        assert all(each == alone for each in pool.map_async(sums, range(4)).get(timeout=120))


def resident():
    """Memory of this process [bytes]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="memory is read from /proc")
@pytest.mark.parametrize("name", CALLS)
def test_three_hundred_calls_take_no_more_memory_than_one_hundred(name):
    for _ in range(100):
        result = CALLS[name]()
    # What is kept by mistake must show.
    assert CALLS_MORE * len(result) > 3.0 * GROWTH
    before = resident()
    for _ in range(CALLS_MORE):
        CALLS[name]()
    assert resident() - before < GROWTH
