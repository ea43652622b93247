import gc
import os
import socket
import subprocess
import sys
from contextlib import contextmanager
from types import SimpleNamespace

if "PYTEST_XDIST_WORKER" in os.environ and hasattr(os, "sched_setaffinity"):
    # Each worker has its share of the processors: threads of both on the same ones would wait for each other. Libraries
    # count the processors when they are imported.
    processors = sorted(os.sched_getaffinity(0))
    worker, workers = int(os.environ["PYTEST_XDIST_WORKER"][2:]), int(os.environ["PYTEST_XDIST_WORKER_COUNT"])
    os.sched_setaffinity(0, processors[worker::workers] or processors)

import numpy as np
import pytest
import yaml
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.layout_engine import ConstrainedLayoutEngine

import pachon
from pachon.core.errors import DomainError
from pachon.core.file_lock import file_lock
from pachon.core.long_work import Execution
from pachon.core.products import image_hdu, write_fits
from pachon.pipeline import focal_plane_stage
from pachon.pipeline.config import Configuration, with_options
from pachon.pipeline.experiment import Experiment
from pachon.pipeline.run import run

# A run small enough for tests: far too few stars and steps for figures that mean anything, every stage real.
# Coarse screens, just as long as two CCDs so far apart need, two seconds of exposure, two wavelengths.
SETTINGS = {
    "ccds": ["R22_S11", "R24_S12"],
    "wavelengths_nm": [560.0, 680.0],
    "stars": {"truth": 14, "observed": 12},
    "atmosphere": {"screen_size": 1024, "screen_length_m": 560.0, "exposure_s": 2.0, "time_step_s": 0.5},
    "psf": {"n_pupil": 60},
    "reconstruction": {"components": 4, "order": 1, "truth_order": 2},
}


@pytest.fixture(scope="session", autouse=True)
def coarse_pictures():
    """Pictures of few pixels, without a layout of their panels: tests look at what is drawn, not at how finely.

    The layout takes half the time of a picture. The fixture's value is what makes it, for tests of it.
    """
    layout = ConstrainedLayoutEngine.execute
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pachon.core.plotting._DPI", 60)
        # The default of an argument is that of the import.
        patch.setattr("pachon.core.plotting.picture_bytes.__defaults__", (60,))
        patch.setattr(ConstrainedLayoutEngine, "execute", lambda self, figure: None)
        yield layout


@contextmanager
def _undrawn():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FigureCanvasAgg, "draw", lambda canvas: setattr(canvas, "renderer", canvas.get_renderer()))
        yield


@pytest.fixture(scope="session")
def undrawn():
    """Context in which pictures are composed and written but stay empty, since drawing takes most of their time.

    For tests of files and numbers, whose pictures other tests draw.
    """
    return _undrawn


@pytest.fixture
def empty_pictures(undrawn):
    """Pictures are composed and written but stay empty: see `undrawn`."""
    with undrawn():
        yield


@pytest.fixture(scope="session")
def lsst_r():
    return pachon.load_telescope("lsst_v3.3_r")


@pytest.fixture(scope="session")
def zemax_lsst():
    """The design that the Zemax listings in tests/data/zemax belong to."""
    return pachon.load_telescope("lsst_v3.3_g_vacuum_zemax_check")


@pytest.fixture(scope="session")
def annulus_points():
    """Uniform random points of the LSST's unvignetted entrance pupil, ``points(n, seed)`` [m]."""

    def points(n, seed=0):
        rng = np.random.default_rng(seed)
        radius = np.sqrt(rng.uniform(2.558**2, 4.18**2, n))
        angle = rng.uniform(0, 2 * np.pi, n)
        return radius * np.cos(angle), radius * np.sin(angle)

    return points


@pytest.fixture(scope="session")
def slope():
    """``slope(function, step)``: central differences at 0, extrapolated from two steps, so good to step^4."""

    def of(function, step):
        near, far = ((function(h) - function(-h)) / (2 * h) for h in (step, 2 * step))
        return (4 * near - far) / 3

    return of


@pytest.fixture(scope="session")
def tiny():
    """The small configuration, resolved: ``tiny(stars__truth=20)``."""

    def make(**options):
        flat = {}
        for key, value in SETTINGS.items():
            flat |= {f"{key}__{k}": v for k, v in value.items()} if isinstance(value, dict) else {key: value}
        return Experiment.from_config(with_options(Configuration(), **(flat | options))).config

    return make


@pytest.fixture
def settings_file(tmp_path):
    """The small configuration as a file."""
    path = tmp_path / "small.yaml"
    path.write_text(yaml.safe_dump(SETTINGS))
    return path


class Shapes:
    """Shapes of a plane over the detector, as a focal-plane model returns them."""

    def __init__(self, values):
        self.e1, self.e2, self.size = values[:, 0], values[:, 1], np.exp(values[:, 2])


class Plane:
    """Stand-in for a focal-plane model: a plane through the shapes of the stars, and their scatter."""

    warnings = ("the plane is <flat>",)
    fits = 0

    @classmethod
    def fit(cls, stars, *_, **__):
        cls.fits += 1
        if len(stars) < 30:
            raise DomainError(f"{len(stars)} stars: expected at least 30")
        model = cls()
        terms = cls.terms(stars.x, stars.y)
        model.planes = np.linalg.lstsq(terms, stars.values, rcond=None)[0]
        left = stars.values - terms @ model.planes
        model.scatter = left.std(axis=0)
        inside = np.diag(terms @ np.linalg.pinv(terms))
        model.leave_one_out = Shapes(stars.values - left / (1.0 - inside[:, None]))
        model.chi2 = {"e1": 0.5, "e2": 1.5, "size": 2.5}
        return model

    @staticmethod
    def terms(x, y):
        return np.stack([np.ones(len(x)), x, y], axis=1)

    def shapes(self, ccd, x, y, *, threads=None):
        return Shapes(self.terms(x, y) @ self.planes)

    def uncertainty(self, ccd, x, y, *, threads=None):
        found = self.shapes(ccd, x, y)
        found.e1, found.e2 = (np.full(len(x), s) for s in self.scatter[:2])
        found.size = found.size * self.scatter[2]
        return found

    def predict(self, ccd, x, y, *, threads=None):
        return self.shapes(ccd, x, y), self.uncertainty(ccd, x, y)

    def adaptive_shapes(self, shapes):
        return SimpleNamespace(g1=2.0 * shapes.e1, g2=2.0 * shapes.e2, sigma=1.3 * shapes.size)

    def write(self, path):
        write_fits(path, [image_hdu("PLANES", self.planes, "of e1, e2, ln size")], None, [])


@pytest.fixture(scope="session")
def plane():
    """The stand-in for a focal-plane model."""
    return Plane


@pytest.fixture
def plane_model(monkeypatch):
    """A plane in place of the focal-plane model, for what does not depend on which model it is."""
    monkeypatch.setattr(focal_plane_stage, "FocalPlanePsf", Plane)
    monkeypatch.setattr(Plane, "fits", 0)
    return Plane


@pytest.fixture(scope="session")
def focal_plane_config(tiny):
    """Two CCDs of twenty stars each, the mean over all turbulence: ``focal_plane_config(ccds=("R22_S11",))``."""

    def make(**options):
        mine = {
            "ccds": ("R22_S11", "R22_S12"),
            "stars__observed": 20,
            "wavelengths_nm": [620.0],
            "psf__engine": "long_exposure",
            "psf__n_pupil": 300,
        }
        return tiny(**(mine | {"reconstruction__model": "focal_plane"} | options))

    return make


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """Collect the tests without searches for garbage: there is none among thousands of tests."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()
        gc.freeze()


def pytest_collection_modifyitems(items):
    # A finished run takes seconds.
    for item in items:
        if "finished_run" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.long)


@pytest.fixture(scope="session")
def finished_run(tiny, tmp_path_factory):
    """The folder of a finished run on one thread, one for all processes; tests only read it."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "finished" / "run"
    with file_lock(folder.parent / "lock"):
        if not (folder / "timings.json").exists():
            run(tiny(), folder, execution=Execution(threads=1))
    return folder


@pytest.fixture
def cluster():
    """A Dask scheduler and two workers of one thread, each a process of its own."""
    pytest.importorskip("distributed")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}

    def scheduler():
        where = ["--host", "127.0.0.1", "--port", address.rpartition(":")[2], "--no-dashboard"]
        return subprocess.Popen([sys.executable, "-m", "distributed.cli.dask_scheduler", *where], **quiet)

    def worker():
        how = [address, "--nthreads", "1", "--no-dashboard", "--no-nanny"]
        return subprocess.Popen([sys.executable, "-m", "distributed.cli.dask_worker", *how], **quiet)

    running = {"scheduler": scheduler(), "workers": [worker(), worker()]}
    running["restart"] = lambda: running.update(scheduler=scheduler(), workers=[worker()])
    running["address"] = address
    yield running
    for process in (running["scheduler"], *running["workers"]):
        process.kill()
        process.wait()
