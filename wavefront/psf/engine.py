"""The protocol of PSF engines: one set of inputs, and the steps that all engines share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, TypeVar

import numpy as np

from ...core.errors import ConfigError
from ...core.threads import thread_count
from ...models.camera.focal_plane import FocalPlane
from ...models.telescope import Telescope
from ...raytrace.rays import field_direction
from ..aberration import ResidualWavefront
from ..atmosphere.atmosphere import Atmosphere
from ..pupil_optics import PupilOptics, trace_pupils
from .image_plane import ImagePlane, focal_length

#: Options of :class:`PsfInputs` that some engines take.
OPTIONS = ("n_pupil", "oversampling", "padding", "pupil_spacing")
#: Centroids (x, y) of stamps [n, ny, nx] from the centre of the middle pixel [pixels], shape [n, 2].
Recenter = Callable[[np.ndarray], np.ndarray]
_Result = TypeVar("_Result")


@dataclass(frozen=True, eq=False)
class PsfInputs:
    """Inputs of a PSF engine.

    Attributes
    ----------
    telescope : Telescope
        The telescope.
    wavelengths : ndarray, shape [n_wave]
        Vacuum wavelengths [m].
    plane : ImagePlane
        Stamp and detector.
    dispersion : ndarray, shape [n_wave, 2], optional
        Shift in field angle of each wavelength [rad]; 0 by default.
    focal_plane : FocalPlane, optional
        CCD heights; the nominal flat plane by default.
    atmosphere : Atmosphere, optional
        The exposure; none outside the atmosphere.
    aberration : ResidualWavefront, optional
        Added to the traced wavefront.
    projection : str
        Meaning of the field angles.
    threads : int, optional
        Number of threads; all processors by default. No byte depends on it.
    n_pupil : int, optional
        Approximate number of pupil points (fast and long_exposure).
    oversampling : int, optional
        Cells of the fine grid per pixel (fast).
    padding : bool, optional
        Whether all baselines are kept, up to the diameter of the pupil (wave). By default they are where there is no
        atmosphere or next to no charge diffusion.
    pupil_spacing : float, optional
        Distance of the pupil points [m] (wave). By default the image repeats itself outside the stamp only, and the
        distance is at most :data:`.wave.LARGEST_SPACING`, or :data:`.wave.LARGEST_SPACING_OPTICS` without an
        atmosphere.
    trace : callable
        Tracer of the pupils, with the signature of :func:`.pupil_optics.trace_pupils`. Another one gives optics of
        known wavefront.
    """

    telescope: Telescope
    wavelengths: np.ndarray
    plane: ImagePlane
    dispersion: np.ndarray | None = None
    focal_plane: FocalPlane | None = None
    atmosphere: Atmosphere | None = None
    aberration: ResidualWavefront | None = None
    projection: str = "zemax"
    threads: int | None = None
    n_pupil: int | None = None
    oversampling: int | None = None
    padding: bool | None = None
    pupil_spacing: float | None = None
    trace: Callable[..., PupilOptics] = trace_pupils


@dataclass(frozen=True)
class RenderedStars:
    """Images of one batch of stars.

    Attributes
    ----------
    image : ndarray, shape [n_star, ny, nx]
        Fraction of the light that reaches the focal plane in each pixel, float64; 0 for a dark star.
    lit_fraction : ndarray, shape [n_star, n_wave]
        Lit fraction of the pupil.
    reference_point : ndarray, shape [n_star, 3]
        Point of the CCD at the star's place on the stamp, telescope frame [m].
    offset : ndarray, shape [n_star, 2]
        Place (x, y) of the reference point from the centre of the middle pixel [pixels].
    """

    image: np.ndarray
    lit_fraction: np.ndarray
    reference_point: np.ndarray
    offset: np.ndarray


class Exposed(NamedTuple):
    """Stars before their pixels: ``draw`` returns the stamps, moved back by a shift [pixels], shape [n_star, 2]."""

    draw: Callable[[np.ndarray | None], np.ndarray]
    lit_fraction: np.ndarray
    reference_point: np.ndarray


class PsfEngine(ABC):
    """Base of the PSF engines.

    Parameters
    ----------
    inputs : PsfInputs
        Telescope, detector, atmosphere and options.

    Attributes
    ----------
    name : str
        Name of the engine.
    options : tuple of str
        Members of :data:`OPTIONS` that the engine takes.
    screens : tuple of str
        Kinds of screens that the engine uses, as :meth:`.Atmosphere.screens` names them.
    batch : int
        Number of stars to render at a time.
    focal_length : float
        Effective focal length at the centre of the field [m].

    Raises
    ------
    ConfigError
        If an option is given that the engine does not take.
    DomainError
        If an option is outside its range.
    """

    name: ClassVar[str]
    options: ClassVar[tuple[str, ...]]
    screens: ClassVar[tuple[str, ...]]
    batch: int

    def __init__(self, inputs: PsfInputs) -> None:
        for option in OPTIONS:
            value = getattr(inputs, option)
            if value is not None and option not in self.options:
                raise ConfigError(
                    f"{option} = {value!r}: not an option of engine = {self.name!r}, which takes"
                    f" {' and '.join(self.options)}"
                )
        self._inputs = inputs
        self._telescope = inputs.telescope
        self._diameter = inputs.telescope.pupil_diameter
        self._obscuration = inputs.telescope.pupil_obscuration
        self._wavelengths = np.asarray(inputs.wavelengths, dtype=np.float64)
        self._plane = inputs.plane
        self._atmosphere = inputs.atmosphere
        self._threads = inputs.threads
        still = np.zeros((len(self._wavelengths), 2))
        self._dispersion = still if inputs.dispersion is None else np.array(inputs.dispersion, dtype=np.float64)
        self.focal_length = center_focal_length(self._telescope, self._wavelengths, inputs.threads, inputs.trace)

    @abstractmethod
    def _expose(self, fields: np.ndarray, offsets: np.ndarray) -> Exposed:
        """Carry the light of stars to the focal plane."""

    def render(self, fields: np.ndarray, offsets: np.ndarray, recenter: Recenter | None = None) -> RenderedStars:
        """Render one batch of stars.

        Parameters
        ----------
        fields : ndarray, shape [n_star, 2]
            Field angles [rad].
        offsets : ndarray, shape [n_star, 2]
            Places of the reference points from the centre of the middle pixel [pixels].
        recenter : callable, optional
            Centroids of given stamps [pixels]. The stars are drawn once more, with their centroids at the centre.

        Returns
        -------
        RenderedStars
        """
        stars = self._expose(fields, offsets)
        image = stars.draw(None)
        if recenter is not None:
            shift = recenter(image)
            offsets = offsets - shift
            image = stars.draw(shift)
        return RenderedStars(image, stars.lit_fraction, stars.reference_point, offsets)

    def _trace(self, fields: np.ndarray, pupil: np.ndarray, threads: int | None) -> PupilOptics:
        given = self._inputs
        return given.trace(
            self._telescope,
            fields,
            self._wavelengths,
            pupil,
            focal_plane=given.focal_plane,
            projection=given.projection,
            threads=threads,
            aberration=given.aberration,
        )

    def _direction(self, fields: np.ndarray) -> np.ndarray:
        """Return directions in which the light of stars travels, shape [n_star, 3]."""
        return field_direction(fields[..., 0], fields[..., 1], self._inputs.projection)

    def _map(self, job: Callable[..., _Result], *items: Iterable[Any]) -> list[_Result]:
        """Return results of a job for each star, in order, on all threads."""
        with ThreadPoolExecutor(thread_count(self._threads)) as pool:
            return list(pool.map(job, *items))


def center_focal_length(
    telescope: Telescope,
    wavelengths: np.ndarray,
    threads: int | None = None,
    trace: Callable[..., PupilOptics] = trace_pupils,
) -> float:
    """Return the effective focal length at the centre of the field [m].

    Parameters
    ----------
    telescope : Telescope
        The telescope.
    wavelengths : ndarray, shape [n_wave]
        Vacuum wavelengths [m], of which the middle one counts.
    threads : int, optional
        Number of threads.
    trace : callable
        Tracer of the pupils, as in :class:`PsfInputs`.
    """
    center = np.zeros((1, 2))
    return float(focal_length(trace(telescope, center, wavelengths, center, threads=threads).jacobian)[0])


def metric_of(jacobian: np.ndarray) -> np.ndarray:
    """Return xx, xy, yy of ``jacobian @ jacobian.T`` [m^2/rad^2], float32, shape [n_star, 3].

    A wavenumber k on the focal plane belongs to the baseline ``wavelength / 2 pi |J^T k|``.
    """
    product = jacobian @ np.swapaxes(jacobian, 1, 2)
    return product.reshape(len(jacobian), 4)[:, [0, 1, 3]].astype(np.float32)
