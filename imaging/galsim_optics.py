"""A photon operator of GalSim that traces photons through a telescope; needs GalSim.

Photons of GalSim have offsets (x, y) from their object: in pixels with the local WCS of the image, else in arc seconds
(u, v) on the tangent plane about the object, u to the west and v to the north. The operator replaces them by offsets of
the places where they land [pixels].
"""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from typing import Any

import galsim
import numpy as np
from numpy.typing import ArrayLike

from ..core.errors import DomainError
from ..core.units import ARCSEC, angle, metres, require_positive
from ..models.camera.cameras import load_camera
from ..models.camera.focal_plane import FocalPlane
from ..models.camera.silicon import Silicon
from ..models.media.silicon import absorption_length, silicon_index
from ..models.telescope import Telescope
from ..raytrace.photons import LandedPhotons, PhotonBeam, land_photons
from ..raytrace.rays import Projection, field_angles, field_direction
from ..sky.pointing import Pointing


class PachonOptics(galsim.PhotonOp):
    """Photon operator: trace photons from the entrance pupil to the CCD.

    Photons need pupil coordinates, of :class:`galsim.PupilAnnulusSampler` for example, and may have wavelengths [nm];
    the default wavelength of the telescope where they have none. Afterwards they have offsets x, y [pixels], slopes
    dxdz, dydz into the CCD and, where they are lost, a flux of 0: in the telescope, between CCDs or in the gates.

    Parameters
    ----------
    telescope : Telescope
        The telescope, its rotator included.
    field : (tx, ty), optional
        Field angles of the object [rad], or Quantities; or else `sky_pos`.
    sky_pos : galsim.CelestialCoord, optional
        Place of the object on the sky.
    pointing : array_like or Quantity, shape [2]
        Right ascension and declination of the optical axis [rad].
    position_angle : float or Quantity
        Angle of the telescope's +y from north through east [rad].
    projection : str
        Meaning of the field angles: "zemax", "gnomonic" or "postel".
    focal_plane : FocalPlane, optional
        Heights of the CCDs; the nominal detector surface by default.
    ccd : str, optional
        CCD whose pixels are counted, with the first one's centre at (1, 1); needs `image_pos`.
    image_pos : galsim.PositionD, optional
        Pixel of the CCD that offsets are counted from; where the chief ray of the object lands by default.
    pixel_size : float or Quantity, optional
        Side of a pixel [m]; that of the camera by default. With 1, offsets are in metres.
    silicon : Silicon, optional
        Silicon of the CCDs, in which light turns into charge at a random depth; at their surface by default. Not
        together with :class:`galsim.SiliconSensor`, which has its own.
    diffusion : float or Quantity
        Root mean square of the diffusion along each axis [m] of charge from the surface; only with `silicon`.
    threads : int, optional
        Number of threads; all processors by default. The result does not depend on it.

    Raises
    ------
    DomainError
        If not just one of `field` and `sky_pos` is given, the object lies outside the field that the model covers, the
        pixel size is unknown, or one of `ccd` and `image_pos` is missing.
    UnknownNameError
        If the camera has no such CCD.
    """

    def __init__(
        self,
        telescope: Telescope,
        field: tuple[ArrayLike, ArrayLike] | None = None,
        *,
        sky_pos: galsim.CelestialCoord | None = None,
        pointing: ArrayLike = (0.0, 0.0),
        position_angle: ArrayLike = 0.0,
        projection: Projection = "zemax",
        focal_plane: FocalPlane | None = None,
        ccd: str | None = None,
        image_pos: galsim.PositionD | None = None,
        pixel_size: ArrayLike | None = None,
        silicon: Silicon | None = None,
        diffusion: ArrayLike = 4e-6,
        threads: int | None = None,
    ) -> None:
        if (field is None) == (sky_pos is None):
            raise DomainError("field and sky_pos: expected one of them")
        if (ccd is None) != (image_pos is None):
            raise DomainError("ccd and image_pos: expected both or none of them")
        self.telescope, self.focal_plane, self.threads = telescope, focal_plane, threads
        self.silicon, self.diffusion = silicon, float(metres(diffusion, "diffusion"))
        axes = Pointing.of(pointing, angle(position_angle, "position_angle")).axes
        if sky_pos is None:
            assert field is not None
            to_source = -field_direction(*field, projection) @ axes
        else:
            to_source = np.array(sky_pos.get_xyz())
        west, north = _west_and_north(to_source)
        #: Direction to the object, west and north of it, in the telescope frame.
        self.source = np.stack([to_source, west, north]) @ axes.T
        if not self.source[0, 2] > 0:
            raise DomainError("field or sky_pos: expected an object in front of the telescope")
        tx, ty = field_angles(-self.source[:1, :2] / self.source[0, 2])[0]
        self.field = float(tx), float(ty)
        telescope.check_field(*self.field)
        camera = focal_plane.camera if focal_plane else load_camera(telescope.camera) if telescope.camera else None
        if camera is None and (pixel_size is None or ccd is not None):
            raise DomainError(f"{telescope.name} has no camera: expected a pixel_size, and no ccd")
        side = pixel_size if camera is None or pixel_size is not None else camera.pixel_size
        self.pixel_size = require_positive(metres(side, "pixel_size"), "pixel_size", "metres")
        #: Place on the detector that offsets are counted from [m].
        self.origin = self._chief_ray()
        #: Camera and index of the CCD along whose axes offsets are; those of the focal plane without.
        self.ccd = None if camera is None or ccd is None else (camera, camera.ccd_index(ccd))
        if self.ccd is not None and image_pos is not None:
            camera, index = self.ccd
            self.origin = camera.from_pixel(index, np.array([image_pos.x, image_pos.y]) - 1.0)

    def applyTo(  # noqa: N802 - GalSim's name
        self, photon_array: galsim.PhotonArray, local_wcs: Any = None, rng: galsim.BaseDeviate | None = None
    ) -> None:
        """Trace photons, in place.

        Parameters
        ----------
        photon_array : galsim.PhotonArray
            The photons.
        local_wcs : galsim.LocalWCS, optional
            Local WCS of the image, by which offsets in pixels are offsets on the sky; without it they are arc seconds.
        rng : galsim.BaseDeviate, optional
            Random numbers, for the silicon alone.

        Raises
        ------
        DomainError
            If the photons have no pupil coordinates, or the telescope does not cover a wavelength.
        """
        if not photon_array.hasAllocatedPupil():
            raise DomainError("photons without pupil coordinates: expected a sampler such as PupilAnnulusSampler first")
        n = len(photon_array)
        if n == 0:
            return
        if photon_array.hasAllocatedWavelengths():
            wavelength = photon_array.wavelength * 1e-9
        else:
            wavelength = np.full(n, self.telescope.default_wavelength)
        world = np.eye(2) if local_wcs is None else local_wcs.jacobian().getMatrix()
        beam = PhotonBeam(
            offset=(photon_array.x, photon_array.y),
            # Directions to the source: the object's, and per pixel the changes of u and v along west and north.
            source=np.concatenate([self.source[:1], ARCSEC * world.T @ self.source[1:]]),
            pupil=(photon_array.pupil_u, photon_array.pupil_v),
            wavelength=wavelength,
        )
        landed = land_photons(self.telescope, beam, focal_plane=self.focal_plane, threads=self.threads)
        x, y, lit = self._in_silicon(landed, wavelength, rng)
        offset_x, offset_y = self._along_ccd(x - self.origin[0], y - self.origin[1])
        slope_x, slope_y = self._along_ccd(landed.slope_x, landed.slope_y)
        photon_array.x = np.where(lit, offset_x / self.pixel_size, 0.0)
        photon_array.y = np.where(lit, offset_y / self.pixel_size, 0.0)
        photon_array.dxdz = np.where(lit, slope_x, 0.0)
        photon_array.dydz = np.where(lit, slope_y, 0.0)
        photon_array.flux *= lit

    def _along_ccd(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the components along the rows and columns of the CCD of vectors of the focal plane."""
        if self.ccd is None:
            return x, y
        camera, index = self.ccd
        along_x, along_y = np.moveaxis(camera.along_pixels(index, np.stack([x, y], axis=-1)), -1, 0)
        return along_x, along_y

    def _in_silicon(
        self, landed: LandedPhotons, wavelength: np.ndarray, rng: galsim.BaseDeviate | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return positions of the charge [m], and where there is any."""
        if self.silicon is None:
            return landed.x, landed.y, landed.lit
        random = galsim.BaseDeviate(rng).as_numpy_generator()
        temperature = self.silicon.temperature
        path = random.exponential(absorption_length(wavelength, temperature))
        spread = self.silicon.diffusion(path, self.diffusion)
        # Direction cosines u along the surface: the charge appears at (path / n) u.
        forward = (
            path / silicon_index(wavelength, temperature) / np.hypot(1.0, np.hypot(landed.slope_x, landed.slope_y))
        )
        x = landed.x + forward * landed.slope_x + spread * random.normal(size=len(path))
        y = landed.y + forward * landed.slope_y + spread * random.normal(size=len(path))
        return x, y, landed.lit & (path < self.silicon.thickness)

    def _chief_ray(self) -> np.ndarray:
        """Return where the chief ray of the object lands [m], blocked or not."""
        zero = (np.zeros(1), np.zeros(1))
        beam = PhotonBeam(zero, self.source, zero, np.full(1, self.telescope.default_wavelength))
        landed = land_photons(self.telescope, beam, focal_plane=self.focal_plane, threads=1)
        place = np.array([landed.x[0], landed.y[0]])
        if not np.isfinite(place).all():
            raise DomainError(f"field = {self.field!r} rad: expected an object whose chief ray reaches the detector")
        return place

    def _axes(self) -> tuple[float, bool]:
        """Return the angle of the CCD [deg], and whether its pixels' x and y are exchanged."""
        return (
            (0.0, False) if self.ccd is None else (float(self.ccd[0].rotation_deg[self.ccd[1]]), self.ccd[0].transposed)
        )

    def _key(self) -> tuple[Any, ...]:
        arrays = tuple(map(float, (*self.source.ravel(), *self.origin, self.pixel_size, *self._axes())))
        return self.telescope, _content(self.focal_plane), self.silicon, self.diffusion, arrays

    def __eq__(self, other: object) -> bool:
        return isinstance(other, PachonOptics) and self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())

    def __repr__(self) -> str:
        tx, ty = np.rad2deg(self.field)
        heights = "" if self.focal_plane is None else ", focal_plane=..."
        return f"pachon.galsim.PachonOptics({self.telescope.name!r}, field=({tx:.6g}, {ty:.6g}) deg{heights})"


def _content(value: Any) -> Any:
    """Return the contents of a dataclass with arrays as what can be compared."""
    if is_dataclass(value):
        return tuple(_content(getattr(value, field.name)) for field in fields(value))
    return (value.shape, value.tobytes()) if isinstance(value, np.ndarray) else value


def _west_and_north(direction: np.ndarray) -> np.ndarray:
    """Return the unit vectors to the west and to the north of a direction, in equatorial coordinates."""
    # At a pole, as for a pointing, north is along right ascension 180 degrees of its meridian.
    east = np.array([-direction[1], direction[0], 0.0])
    east = east / np.linalg.norm(east) if np.any(east) else np.array([0.0, 1.0, 0.0])
    return np.stack([-east, np.cross(direction, east)])
