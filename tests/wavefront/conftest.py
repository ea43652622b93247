"""Inputs of the PSF engines that are exactly known: polynomial pupils and layers of a single mode."""

from dataclasses import dataclass

import numpy as np
import pytest

from pachon.models.aperture import Annulus
from pachon.models.io.site_file import load_site
from pachon.models.shapes.shape import Plane
from pachon.models.surface import Interaction, Surface
from pachon.models.telescope import VACUUM, Telescope
from pachon.wavefront.atmosphere.atmosphere import Atmosphere
from pachon.wavefront.atmosphere.screen_sampling import ScreenSampling
from pachon.wavefront.psf.engine import PsfInputs
from pachon.wavefront.pupil_optics import PupilOptics

FOCAL_LENGTH = 10.31


def ring_telescope(diameter, obscuration, clear):
    """A pupil of which a ring from and to given radii [m] is clear, and a screen behind it."""
    surfaces = (
        Surface("ring", Interaction.PASS, Plane(), (0.0, 0.0, 0.0), VACUUM, Annulus(*clear)),
        Surface("Detector", Interaction.DETECTOR, Plane(), (0.0, 0.0, -10.0), VACUUM),
    )
    return Telescope(
        name="ring",
        surfaces=surfaces,
        stop_z=0.0,
        pupil_diameter=diameter,
        pupil_obscuration=obscuration,
        launch_distance=20.0,
        reference_sphere_radius=10.0,
        field_radius=0.1,
        field_limit=0.1,
        wavelength_range=(3e-7, 1.1e-6),
        default_wavelength=620e-9,
    )


@dataclass(frozen=True)
class PolynomialPupil:
    """Optics whose path over the unit pupil is a polynomial.

    Path = defocus r^2 + coma r^2 x [m] + tilt . p [rad]; vignetting beyond ``cut`` (in units of the radius along x, one
    number or one a wavelength); ``jacobian`` for every star; ``clear``: radii of the ring that is clear [m];
    ``cosines``: direction cosines of the chief rays at the focus.
    """

    defocus: float = 0.0
    coma: float = 0.0
    tilt: tuple = (0.0, 0.0)
    cut: float | tuple = 2.0
    jacobian: np.ndarray | None = None
    diameter: float = 8.36
    obscuration: float = 0.612
    clear: tuple | None = None
    cosines: tuple = (0.0, 0.0)

    @property
    def telescope(self):
        outer = 0.5 * self.diameter
        return ring_telescope(self.diameter, self.obscuration, self.clear or (self.obscuration * outer, outer))

    def inputs(self, wavelengths, plane, **options):
        return PsfInputs(self.telescope, wavelengths, plane, trace=self.trace, **({"threads": 1} | options))

    def trace(self, telescope, fields, wavelengths, pupil, **options):
        assert options.get("aberration") is None
        radius = 0.5 * self.diameter
        jacobian = FOCAL_LENGTH * np.eye(2) if self.jacobian is None else np.asarray(self.jacobian)
        fields, wavelengths = np.atleast_2d(fields), np.atleast_1d(wavelengths)
        x, y = np.asarray(pupil).T / radius
        square = x * x + y * y
        path = self.defocus * square + self.coma * square * x + (self.tilt[0] * x + self.tilt[1] * y) * radius
        slope_x = (2 * self.defocus * x + self.coma * (square + 2 * x * x)) / radius + self.tilt[0]
        slope_y = (2 * self.defocus * y + 2 * self.coma * x * y) / radius + self.tilt[1]
        landing = np.stack([slope_x, slope_y], axis=-1) @ jacobian.T
        lit = (square < 1) & (square >= self.obscuration**2) & (x < np.reshape(self.cut, (-1, 1)))

        def same(values):
            return np.broadcast_to(values, (len(fields), len(wavelengths), *values.shape)).copy()

        return PupilOptics(
            pupil=np.asarray(pupil),
            displacement=same(landing.astype(np.float32)),
            path=same(path),
            exit_pupil_path=same(path),
            lit=np.broadcast_to(lit, (len(fields), len(wavelengths), len(x))).copy(),
            jacobian=np.broadcast_to(jacobian, (len(fields), 2, 2)).copy(),
            reference_points=np.zeros((len(fields), 3)),
            reference_cosines=np.tile(self.cosines, (len(fields), 1)),
            fields=fields,
            wavelengths=wavelengths,
        )


@pytest.fixture
def polynomial_pupil():
    """Make optics of known wavefront for any engine: ``polynomial_pupil(defocus=, coma=, ...)``."""
    return PolynomialPupil


class SingleModes(Atmosphere):
    """Layers whose low screens are one long sine wave each, alternately along x and y, and whose high screens are 0."""

    amplitude = 200e-6

    def low_screen(self, layer, stencil="spline", *, threads=None, out=None):
        wave = self.amplitude * np.sin(2 * np.pi * np.arange(self.screen_size) / self.screen_size)
        screen = np.zeros((self.screen_size, self.screen_size), dtype=np.float32) if out is None else out
        screen[...] = wave if layer % 2 == 0 else wave[:, None]
        return screen

    def high_screen(self, layer, stencil="spline", *, threads=None, out=None):
        screen = np.zeros((self.fine_size, self.fine_size), dtype=np.float32) if out is None else out
        screen[...] = 0.0
        return screen

    def slope_unit(self, layer):
        return 2 * np.pi * self.amplitude / self.screen_length / 32767.0

    def slope_screen(self, layer, *, threads=None, out=None, rows=None):
        wave = np.cos(2 * np.pi * np.arange(self.screen_size) / self.screen_size)
        counts = np.rint(32767.0 * wave).astype(np.int32)
        screen = np.zeros((self.screen_size, self.screen_size), dtype=np.int32) if out is None else out
        screen[...] = counts & 0xFFFF if layer % 2 == 0 else (counts << 16)[:, None]
        return screen

    def slope(self, layer, x, y):
        """Gradient of a layer's path at screen coordinates [rad]."""
        k = 2 * np.pi / self.screen_length
        along = self.amplitude * k * np.cos(k * (x if layer % 2 == 0 else y))
        return np.array([along, 0.0]) if layer % 2 == 0 else np.array([0.0, along])


@pytest.fixture
def single_modes():
    """Two high layers of one 820 m wave each, moving across in four time steps; weak enough to need no filter."""
    return SingleModes.from_site(
        load_site("cerro_pachon").with_layers([4000.0, 9000.0], [0.5, 0.5], [30.0, 20.0], [0.3, 2.0]),
        3,
        r0=50.0,
        screens=ScreenSampling(cutoff=2.0, screen_size=2048, screen_length=819.2, fine_size=256, fine_pixel=0.02),
        exposure=0.4,
        time_step=0.1,
    )
