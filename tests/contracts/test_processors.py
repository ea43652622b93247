"""Kernels compiled for processors without AVX-512 give the same numbers, to rounding.

``pytest -m slow tests/contracts/test_processors.py -s``: all kernels are compiled twice, which takes minutes.
"""

import platform
import subprocess
import sys

import numpy as np
import pytest

#: Compiler flags of processors: the one of this machine, one with AVX2 and FMA, and one with neither.
FLAGS = {"native": None, "AVX2": "-target-cpu haswell", "SSE4": "-target-cpu nehalem"}

PROGRAM = """
import sys
import numpy as np
from pachon.core import launch

if sys.argv[2]:
    launch.CPU_COMPILER_FLAGS = sys.argv[2]
    launch.FORWARD_OPTIONS["cpu_compiler_flags"] = sys.argv[2]
import pachon

telescope = pachon.load_telescope("lsst_v3.3_r")
w, field = 622e-9, (0.01, 0.02)
x, y = np.random.default_rng(1).uniform(-4.2, 4.2, (2, 20000))
rays = pachon.trace(telescope, pachon.launch_rays(telescope, field, w, (x, y)))
lit = rays.status == 0
opd = pachon.wavefront_opd(telescope, field, w, grid=128)
air = pachon.Atmosphere.from_site(
    "cerro_pachon", seed=2, exposure=1.0, screens=pachon.ScreenSampling(screen_size=1024, screen_length=100.0)
)
psfs = {
    engine: pachon.make_psfs(telescope, [field, (0.0, 0.0)], [w], atmosphere=air, engine=engine).image
    for engine in ("fast", "long_exposure", "wave")
}
moments = pachon.adaptive_moments(psfs["fast"], 1e-6)
np.savez(
    sys.argv[1], status=rays.status, position=rays.position[lit], direction=rays.direction[lit],
    path=rays.path_length[lit], opd=opd.value,
    g1=moments.g1, sigma=moments.sigma, **psfs,
)
"""


@pytest.mark.slow
@pytest.mark.skipif(platform.machine().lower() not in ("x86_64", "amd64"), reason="flags of x86 processors")
def test_processors_agree(tmp_path):
    results = {}
    for name, flags in FLAGS.items():
        path = tmp_path / f"{name}.npz"
        command = [sys.executable, "-c", PROGRAM, str(path), flags or ""]
        subprocess.run(command, check=True, capture_output=True, text=True, timeout=1800)
        results[name] = dict(np.load(path))
    native = results.pop("native")
    for name, other in results.items():
        np.testing.assert_array_equal(other["status"], native["status"])
        print(name)
        for key in ("position", "direction", "path", "opd"):
            scale = np.nanmax(np.abs(native[key])) if key == "path" else 1.0
            difference = np.nanmax(np.abs(other[key] - native[key])) / scale
            print(f"  {key}: {difference:.1e}")
            assert difference < 1e-12, (name, key, difference)
        for key in ("fast", "long_exposure", "wave"):
            difference = np.abs(other[key] - native[key]).max() / native[key].max()
            print(f"  {key} image: {difference:.1e} of the peak")
            assert difference < 1e-5, (name, key, difference)
        for key in ("g1", "sigma"):
            print(f"  {key}: {np.abs(other[key] / native[key] - 1.0).max():.1e} relative")
