import numpy as np
import pytest

from pachon.core.threads import one_blas_thread
from pachon.models.camera.camera import Camera
from pachon.models.camera.cameras import load_camera
from pachon.models.camera.focal_plane import FocalPlane
from pachon.reconstruction.focal_plane_psf.response import Instrument
from pachon.reconstruction.focal_plane_psf.stars import FocalPlaneStars


@pytest.fixture(autouse=True, scope="module")
def one_thread_of_linear_algebra():
    """As in the product, which runs blocks of stars side by side: threads within small matrices only wait."""
    with one_blas_thread():
        yield


@pytest.fixture(scope="session")
def part():
    """A camera of some rafts on the LSST's grid: ``part("R22", "R23")``, or of the first few CCDs of these.

    CCDs are squares, and columns of the grid follow one another along x.
    """

    def of(*rafts, count=None):
        whole = load_camera("lsst")
        keep = [i for i, raft in enumerate(whole.raft_of) if raft in rafts][:count]
        index = np.array([rafts.index(whole.raft_of[i]) for i in keep])
        names = tuple(whole.ccd_names[i] for i in keep)
        return Camera("part", names, rafts, index, whole.centers[keep][:, ::-1], np.array([4096, 4096]), 10e-6)

    return of


#: One wavelength [m], to be quick.
WAVELENGTHS = [620e-9]


class Exposure:
    """Stars of one synthetic exposure: long-exposure shapes at known heights, a random field drawn exactly, and noise.

    The first stars of each CCD have noise and are to be fitted; the others are holdout positions.
    """

    def __init__(self, telescope, camera, plane, *, stars=40, holdout=15, noise=1e-3, turbulence=0.004, seed=0, at=1):
        places = np.random.default_rng(at)
        rng = np.random.default_rng(seed)
        self.camera, self.plane = camera, plane
        per_ccd = stars + holdout
        self.ccd = np.repeat(np.arange(len(camera)), per_ccd)
        offsets = places.uniform(-0.97, 0.97, (len(self.ccd), 2))
        self.xy = camera.centers[self.ccd] + (0.5 * camera.shortest_side) * offsets
        self.first = np.tile(np.arange(per_ccd) < stars, len(camera))
        self.names = np.array(camera.ccd_names)[self.ccd]
        instrument = Instrument.of(telescope, WAVELENGTHS)
        fields = instrument.fields(self.xy)
        self.flat = instrument.shapes(fields, FocalPlane.flat(camera), None)
        optics = instrument.shapes(fields, plane, None)
        # Streaks of 100 by 15 mm along a wind at 30 degrees: the exponential of a length, by Cholesky.
        along = np.array([[np.cos(0.5), np.sin(0.5)], [-np.sin(0.5), np.cos(0.5)]]) / np.array([[0.1], [0.015]])
        difference = (self.xy[:, None] - self.xy) @ along.T
        self.covariance = turbulence**2 * (np.exp(-np.hypot(*difference.T)) + 1e-10 * np.eye(len(self.xy)))
        self.optics = optics
        self.truth = optics + np.linalg.cholesky(self.covariance) @ rng.standard_normal((len(self.xy), 3))
        self.noise = np.full(self.truth.shape, noise)
        self.values = self.truth + self.noise * rng.standard_normal(self.truth.shape)

    def stars(self, which=None, **changes):
        """The stars to be fitted, or others, as FocalPlaneStars."""
        which = self.first if which is None else which
        x, y = self.xy[which].T
        columns = {"values": self.values[which], "noise": self.noise[which]} | changes
        return FocalPlaneStars(tuple(self.names[which]), x, y, **columns)


@pytest.fixture(scope="session")
def exposure_of(lsst_r, part):
    """``exposure_of(plane, **options)``: an :class:`Exposure` of the r-band telescope."""

    def of(plane, **options):
        return Exposure(lsst_r, plane.camera, plane, **options)

    return of


@pytest.fixture(scope="session")
def wavelengths():
    return WAVELENGTHS
