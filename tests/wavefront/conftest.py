"""Stand-ins that make the PSF engines' inputs exactly known: polynomial pupils and layers of a single mode."""

from types import SimpleNamespace

import numpy as np
import pytest

from pachon.wavefront.atmosphere.atmosphere import Atmosphere
from pachon.wavefront.psf import fast as fast_psf
from pachon.wavefront.psf import wave as wave_psf
from pachon.wavefront.pupil_optics import PupilOptics

FOCAL_LENGTH = 10.31


@pytest.fixture
def polynomial_pupil(monkeypatch):
    """Give both engines a telescope whose path over the unit pupil is a polynomial, and return that telescope.

    ``polynomial_pupil(defocus=, coma=, tilt=, ...)``: path = defocus r^2 + coma r^2 x [m] + tilt . p [rad]; vignetting
    beyond ``cut`` (in units of the radius along x); ``jacobian`` for every star.
    """

    def install(*, defocus=0.0, coma=0.0, tilt=(0.0, 0.0), cut=2.0, jacobian=None, diameter=8.36, obscuration=0.612):
        radius = 0.5 * diameter
        if jacobian is None:
            jacobian = FOCAL_LENGTH * np.eye(2)

        def trace(
            telescope, fields, wavelengths, pupil, focal_plane=None, projection="zemax", threads=None, aberration=None
        ):
            assert aberration is None
            fields, wavelengths = np.atleast_2d(fields), np.atleast_1d(wavelengths)
            x, y = np.asarray(pupil).T / radius
            square = x * x + y * y
            path = defocus * square + coma * square * x + (tilt[0] * x + tilt[1] * y) * radius
            slope_x = (2 * defocus * x + coma * (square + 2 * x * x)) / radius + tilt[0]
            slope_y = (2 * defocus * y + 2 * coma * x * y) / radius + tilt[1]
            landing = np.stack([slope_x, slope_y], axis=-1) @ np.asarray(jacobian).T
            lit = (square < 1) & (square >= obscuration**2) & (x < cut)

            def same(values):
                return np.broadcast_to(values, (len(fields), len(wavelengths), *values.shape)).copy()

            return PupilOptics(
                pupil=np.asarray(pupil),
                displacement=same(landing.astype(np.float32)),
                path=same(path),
                lit=same(lit),
                jacobian=np.broadcast_to(jacobian, (len(fields), 2, 2)).copy(),
                reference=np.zeros((len(fields), 3)),
                fields=fields,
                wavelengths=wavelengths,
            )

        monkeypatch.setattr(fast_psf, "trace_pupils", trace)
        monkeypatch.setattr(wave_psf, "trace_pupils", trace)
        return SimpleNamespace(pupil_diameter=diameter, pupil_obscuration=obscuration, trace=trace)

    return install


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

    def slope_screen(self, layer, *, threads=None, out=None):
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
        "cerro_pachon",
        3,
        r0=50.0,
        cutoff=2.0,
        altitudes=[4000.0, 9000.0],
        weights=[0.5, 0.5],
        wind_speeds=[30.0, 20.0],
        wind_directions=[0.3, 2.0],
        exposure=0.4,
        time_step=0.1,
        screen_size=2048,
        screen_length=819.2,
        fine_size=256,
        fine_pixel=0.02,
    )
