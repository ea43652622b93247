"""LSSTCam and ComCam on the sky: CCDs by name and pixel, against the world coordinates of imSim.

The oracle restates how imSim (LSST DESC, `imsim/batoid_wcs.py` and `telescope_loader.py` of 2024) makes them: ICRS to
observed place by ERFA (aberration, precession, refraction), field angles about the boresight towards the zenith,
batoid's rays through the rotated camera, x and y of the telescope exchanged for those of the focal plane (DVCS,
LSE-349), and the detectors of obs_lsst (`lsstCamSim.yaml` of 2025, `cameraHeader.yaml`), in mm of DVCS.
"""

from __future__ import annotations

import erfa
import numpy as np
import pytest

import pachon
from pachon.core.units import ARCSEC

batoid = pytest.importorskip("batoid")
galsim = pytest.importorskip("galsim")

#: Latitude and longitude [rad], height [m] of the observatory, as imSim has them.
_LATITUDE, _LONGITUDE, _HEIGHT = np.deg2rad(-30.2444), np.deg2rad(-70.7494), 2650.0
#: Pressure [hPa], temperature [C], relative humidity, wavelength [um]: imSim's defaults at 620 nm.
_AIR = (692.8, 7.0, 0.1, 0.62)
_WAVELENGTH = 620e-9
#: Right ascension, declination, rotator [deg] and UTC: five pointings, the last but one east of the meridian.
POINTINGS = [
    (53.1, -27.8, 0.0, (2025, 11, 20, 4, 30)),
    (10.0, -35.0, 40.0, (2025, 10, 1, 6, 0)),
    (200.0, -60.0, -75.0, (2026, 4, 2, 5, 0)),
    (150.1, 2.2, 85.0, (2026, 2, 10, 4, 0)),
    (300.0, -29.0, -20.0, (2026, 7, 20, 3, 0)),
]
#: Differential refraction and aberration, which pachon leaves out, are up to 3 arcsec at the edge of the field and 50
#: degrees from the zenith; the pixel that obs_lsst calls the middle of ITL's is one off, 0.28 arcsec.
_TOLERANCE = 5.0 * ARCSEC
_ITL_RAFTS = {"R01", "R02", "R03", "R10", "R20", "R41", "R42", "R43"}
#: Pixels along x and y, and obs_lsst's `refpos`, of each kind of detector.
_DETECTORS = {
    "E2V": ((4096, 4004), (2047.5, 2001.5)),
    "ITL": ((4072, 4000), (2036.5, 2000.5)),
    "ITL_WF": ((4072, 2000), (2036.5, 1000.5)),
}
#: `offset` [mm] and `yaw` [deg] of the sensors of three corner rafts; R44 is turned by half from R00.
_CORNERS = {
    "R00_SG0": (-212.24, -258.74, 450),
    "R00_SG1": (-258.74, -212.24, 180),
    "R00_SW0": (-214.25, -202.625, 180),
    "R00_SW1": (-214.25, -225.875, 360),
    "R04_SG0": (258.74, -212.24, 540),
    "R04_SG1": (212.24, -258.74, 270),
    "R04_SW0": (202.625, -214.25, 270),
    "R04_SW1": (225.875, -214.25, 450),
    "R40_SG0": (-258.74, 212.24, 360),
    "R40_SG1": (-212.24, 258.74, 90),
    "R44_SW0": (214.25, 202.625, 0),
    "R44_SW1": (214.25, 225.875, 180),
}


class _ImSim:
    """World coordinates as imSim makes them, for one pointing."""

    def __init__(self, pointing: tuple[float, float, float, tuple[int, ...]], optic: str, camera: str):
        ra, dec, rotator, time = pointing
        self._utc = erfa.dtf2d("UTC", *time, 0.0)
        _, zenith, hour, declination, right_ascension, _ = self._observed(*np.deg2rad([ra, dec]))
        self.zenith_distance = float(zenith)
        q = erfa.hd2pa(hour, declination, _LATITUDE)
        self._field = galsim.TanWCS(
            galsim.AffineTransform(np.cos(q), np.sin(q), np.sin(q), -np.cos(q)),
            galsim.CelestialCoord(right_ascension * galsim.radians, declination * galsim.radians),
            units=galsim.radians,
        )
        rotated = batoid.RotZ(np.deg2rad(rotator))
        self._optic = batoid.Optic.fromYaml(optic).withLocallyRotatedOptic(camera, rotated)

    def _observed(self, ra, dec):
        zero = (0.0, 0.0, 0.0, 0.0)
        return erfa.atco13(ra, dec, *zero, *self._utc, 0.0, _LONGITUDE, _LATITUDE, _HEIGHT, 0.0, 0.0, *_AIR)

    def icrs(self, field: np.ndarray) -> np.ndarray:
        """Return right ascension and declination [rad] of field angles [rad], shape [n, 2]."""
        observed = self._field.xyToradec(*field.T, units="rad")
        at = (*self._utc, 0.0, _LONGITUDE, _LATITUDE, _HEIGHT, 0.0, 0.0, *_AIR)
        return np.stack(erfa.atoc13("R", *observed, *at), axis=1)

    def position_angle(self) -> float:
        """Return the position angle of the telescope's +y, which points to the zenith, in ICRS [rad]."""
        center, above = self.icrs(np.array([[0.0, 1e-4], [0.0, -1e-4]]))
        return float(erfa.pas(*center, *above))

    def field_of(self, focal: np.ndarray) -> np.ndarray:
        """Return the field angles [rad] of places of the focal plane (DVCS) [mm], shape [n, 2], by Newton's method."""
        field = np.zeros_like(focal)
        for _ in range(6):
            landed = self._focal(field)
            slopes = np.stack(
                [(self._focal(field + step) - landed) / 1e-6 for step in 1e-6 * np.eye(2)],
                axis=-1,
            )
            field = field - np.linalg.solve(slopes, (landed - focal)[..., None])[..., 0]
        return field

    def _focal(self, field: np.ndarray) -> np.ndarray:
        rays = batoid.RayVector.fromFieldAngles(
            *field.T, projection="gnomonic", optic=self._optic, wavelength=_WAVELENGTH
        )
        self._optic.trace(rays)
        return 1e3 * np.stack([rays.y, rays.x], axis=1)


def _detector(name: str, kind: str | None = None) -> tuple[tuple[int, int], tuple[float, float], np.ndarray, float]:
    """Return pixels, `refpos`, place in the focal plane [mm] and yaw [rad] of a detector of obs_lsst."""
    if name in _CORNERS:
        *center, yaw = _CORNERS[name]
        kind = "ITL_WF" if "_SW" in name else "ITL"
        return *_DETECTORS[kind], np.array(center), np.deg2rad(yaw)
    row, column, s_row, s_column = (int(name[i]) for i in (1, 2, 5, 6))
    center = [(column - 2) * 127.0 + (s_column - 1) * 42.25, (row - 2) * 127.0 + (s_row - 1) * 42.25]
    return *_DETECTORS[kind or ("ITL" if name[:3] in _ITL_RAFTS else "E2V")], np.array(center), 0.0


def _separations(
    imsim: _ImSim, pointing: tuple, telescope: str, camera: str, name: str, kind: str | None = None
) -> np.ndarray:
    """Return the distances on the sky [rad] of the middle and the four corner pixels of a CCD."""
    (nx, ny), refpos, center, yaw = _detector(name, kind)
    pixels = np.array([[0.5, 0.5], [0, 0], [1, 0], [1, 1], [0, 1]]) * [nx - 1, ny - 1]
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    expected = imsim.icrs(imsim.field_of(center + 0.01 * (pixels - refpos) @ turn.T))
    ra, dec, rotator, _ = pointing
    wcs = pachon.wcs(
        pachon.load_telescope(telescope).with_rotator(np.deg2rad(rotator)),
        name,
        np.deg2rad([ra, dec]),
        imsim.position_angle(),
        camera=camera,
        wavelength=_WAVELENGTH,
    )
    assert wcs.pixel_shape == (nx, ny)
    actual = np.deg2rad(wcs.pixel_to_world_values(*pixels.T))
    return erfa.seps(*expected.T, *actual)


@pytest.mark.parametrize(
    ("pointing", "name"), [*zip(POINTINGS, ("R01_S00", "R24_S12", "R30_S20", "R14_S02", "R42_S01"), strict=True)]
)
def test_science_ccds_of_lsstcam(pointing, name):
    imsim = _ImSim(pointing, "LSST_r.yaml", "LSSTCamera")
    assert imsim.zenith_distance < np.deg2rad(55.0)
    assert _separations(imsim, pointing, "lsst_v3.3_r", "lsst", name).max() < _TOLERANCE


@pytest.mark.slow
@pytest.mark.parametrize("pointing", POINTINGS)
def test_all_science_ccds_of_lsstcam(pointing):
    imsim = _ImSim(pointing, "LSST_r.yaml", "LSSTCamera")
    for name in pachon.load_camera("lsst").ccd_names:
        assert _separations(imsim, pointing, "lsst_v3.3_r", "lsst", name).max() < _TOLERANCE, name


@pytest.mark.parametrize(
    "pointing", [pytest.param(p, marks=pytest.mark.long if p is POINTINGS[1] else pytest.mark.slow) for p in POINTINGS]
)
def test_corner_rafts_of_lsstcam(pointing):
    imsim = _ImSim(pointing, "LSST_r.yaml", "LSSTCamera")
    for name in _CORNERS:
        camera = "lsst_wavefront" if "_SW" in name else "lsst_guider"
        assert _separations(imsim, pointing, "lsst_v3.3_r", camera, name).max() < _TOLERANCE, name


@pytest.mark.parametrize(
    ("pointing", "name"), [*zip(POINTINGS, ("R22_S01", "R22_S20", "R22_S12", "R22_S00", "R22_S21"), strict=True)]
)
def test_ccds_of_comcam(pointing, name):
    imsim = _ImSim(pointing, "ComCam_r.yaml", "ComCam")
    assert _separations(imsim, pointing, "comcam_r", "comcam", name, "ITL").max() < _TOLERANCE
