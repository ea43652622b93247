"""PSF engines: their options, the inputs of one call, and the steps common to all renderers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from typing import Any, ClassVar, NamedTuple, Self, TypeVar

import numpy as np

from ...core.errors import ConfigError
from ...core.threads import thread_count
from ...models.camera.focal_plane import FocalPlane
from ...models.camera.silicon import Silicon
from ...models.telescope import Telescope
from ...raytrace.rays import Projection, field_direction
from ..aberration import ResidualWavefront
from ..atmosphere.atmosphere import Atmosphere
from ..pupil_optics import PupilOptics, trace_pupils
from .channels import Channels
from .far_from_focus import check_stamp
from .image_plane import ImagePlane, focal_length

#: Centroids (x, y) of stamps [n, ny, nx] from the centre of the middle pixel [pixels], shape [n, 2].
Recenter = Callable[[np.ndarray], np.ndarray]
_Result = TypeVar("_Result")


@dataclass(frozen=True, eq=False)
class PsfInputs:
    """Inputs of a PSF renderer: checked arguments of :func:`.make_psfs`, and the tracer of the pupils.

    ``trace`` has the signature of :func:`.pupil_optics.trace_pupils`; another one gives optics of known wavefront.
    """

    telescope: Telescope
    wavelengths: np.ndarray  #: [n_wave] m
    plane: ImagePlane
    dispersion: np.ndarray | None = None  #: [n_wave, 2] rad
    focal_plane: FocalPlane | None = None
    atmosphere: Atmosphere | None = None
    aberration: ResidualWavefront | None = None
    silicon: Silicon | None = None
    projection: Projection = "zemax"
    threads: int | None = None
    trace: Callable[..., PupilOptics] = trace_pupils
    has_spectra: bool = False  #: whether stars have photons of their own at each wavelength


@dataclass(frozen=True)
class RenderedStars:
    """Images of one batch of stars."""

    image: np.ndarray  #: fraction of the light that reaches the focal plane, [n_star, ny, nx]; 0 for a dark star
    lit_fraction: np.ndarray  #: of the pupil, [n_star, n_wave]
    reference_point: np.ndarray  #: point of the CCD at the star's place on the stamp, telescope frame, [n_star, 3] m
    offset: np.ndarray  #: place (x, y) of that point from the centre of the middle pixel, [n_star, 2] pixels
    first: np.ndarray | None = None  #: images before they were drawn once more


class ExposedStars(NamedTuple):
    """Stars on the focal plane; ``draw`` samples their stamps, moved back by a shift [pixels], shape [n_star, 2]."""

    draw: Callable[[np.ndarray | None], np.ndarray]
    lit_fraction: np.ndarray
    reference_point: np.ndarray


@dataclass(frozen=True)
class Stars:
    """Stars of one batch."""

    fields: np.ndarray  #: field angles, [n_star, 2] rad
    offsets: np.ndarray  #: places of the reference points from the centre of the middle pixel, [n_star, 2] pixels
    photons: np.ndarray | None = None  #: of each wavelength, of mean 1, [n_star, n_wave]; None where all are 1

    def __len__(self) -> int:
        return len(self.fields)

    def __getitem__(self, index: Any) -> Stars:
        photons = None if self.photons is None else self.photons[index]
        return Stars(self.fields[index], self.offsets[index], photons)


def expose_by_kind(kinds: np.ndarray, expose: Callable[[int, Stars], ExposedStars], stars: Stars) -> ExposedStars:
    """Expose stars of several kinds [n_star], each kind by one call of ``expose`` with the kind and its stars."""
    groups = [np.flatnonzero(kinds == kind) for kind in np.unique(kinds)]
    exposed = [expose(int(kinds[group[0]]), stars[group]) for group in groups]
    order = np.argsort(np.concatenate(groups))

    def draw(shift: np.ndarray | None) -> np.ndarray:
        shifts = [None if shift is None else shift[group] for group in groups]
        return np.concatenate([e.draw(moved) for e, moved in zip(exposed, shifts, strict=True)])[order]

    return ExposedStars(
        draw,
        np.concatenate([e.lit_fraction for e in exposed])[order],
        np.concatenate([e.reference_point for e in exposed])[order],
    )


@dataclass(frozen=True)
class PsfEngine(ABC):
    """Base of the PSF engines: a way to compute PSFs, with its options.

    An engine is a frozen dataclass of its options, of which None means the default, and is listed in
    :mod:`.engines` under its name.
    """

    name: ClassVar[str]  #: in configurations and on the command line
    screens: ClassVar[tuple[str, ...]] = ()  #: kinds of screens that it uses, see :meth:`.Atmosphere.screens`
    needs_atmosphere: ClassVar[bool] = False
    has_turbulence: ClassVar[bool] = True  #: of the exposure itself, in place of the mean over all

    def renderer(self, inputs: PsfInputs) -> PsfRenderer:
        """Return the renderer of the stars of one call; ConfigError if the engine needs an atmosphere."""
        if self.needs_atmosphere and inputs.atmosphere is None:
            raise ConfigError(
                f"engine = {self.name!r}: expected an atmosphere, whose mean it takes ('wave' does without one)"
            )
        return self._renderer(inputs)

    @abstractmethod
    def _renderer(self, inputs: PsfInputs) -> PsfRenderer:
        """Return the renderer of the stars of one call."""

    def with_n_pupil(self, n_pupil: int | None) -> Self:
        """Return the engine with another number of pupil points; the same one if it has no such option."""
        options: dict[str, Any] = {"n_pupil": n_pupil}
        return replace(self, **options) if "n_pupil" in {f.name for f in fields(self)} else self


class PsfRenderer(ABC):
    """Base of the renderers: an engine applied to the telescope, light and stamps of one call."""

    depths: ClassVar[int]  #: conversion depths in silicon of each wavelength
    batch: int  #: number of stars to render at a time
    focal_length: float  #: effective one at the centre of the field [m]

    def __init__(self, inputs: PsfInputs) -> None:
        self._inputs = inputs
        self._telescope = inputs.telescope
        self._diameter = inputs.telescope.pupil_diameter
        self._obscuration = inputs.telescope.pupil_obscuration
        self._wavelengths = np.asarray(inputs.wavelengths, dtype=np.float64)
        self._channels = Channels.of(inputs.silicon, self._wavelengths, inputs.plane.diffusion, self.depths)
        self._plane = replace(inputs.plane, diffusion=self._channels.diffusion)
        self._atmosphere = inputs.atmosphere
        self._threads = inputs.threads
        zero = np.zeros((len(self._wavelengths), 2))
        self._dispersion = zero if inputs.dispersion is None else np.array(inputs.dispersion, dtype=np.float64)
        self.focal_length = center_focal_length(self._telescope, self._wavelengths, inputs.threads, inputs.trace)

    @abstractmethod
    def _expose(self, stars: Stars) -> ExposedStars:
        """Expose stars on the focal plane."""

    def prepare(self, fields: np.ndarray) -> None:  # noqa: B027 - most engines need nothing
        """Prepare what stars at field angles [n_star, 2] [rad] have in common, before the first batch."""

    def batches(self, fields: np.ndarray) -> list[np.ndarray]:
        """Return indices of the stars at field angles [n_star, 2] [rad] that each batch holds."""
        order = self._order(fields)
        return [order[first : first + self.batch] for first in range(0, len(order), self.batch)]

    def _order(self, fields: np.ndarray) -> np.ndarray:
        """Return indices of stars at field angles [n_star, 2] [rad] in the order in which they are rendered."""
        return np.arange(len(fields))

    def render(
        self,
        fields: np.ndarray,
        offsets: np.ndarray,
        recenter: Recenter | None = None,
        photons: np.ndarray | None = None,
    ) -> RenderedStars:
        """Render one batch of stars at field angles [n_star, 2] [rad].

        ``offsets`` [n_star, 2] are the places of the reference points from the centre of the middle pixel [pixels].
        With ``recenter`` the stars are drawn once more, with their centroids at the centre. ``photons`` [n_star,
        n_wave] are the relative numbers of photons of each wavelength, of mean 1; by default all are 1.
        """
        stars = self._expose(Stars(fields, offsets, photons))
        first = stars.draw(None)
        if recenter is None:
            return RenderedStars(first, stars.lit_fraction, stars.reference_point, offsets)
        shift = recenter(first)
        image = stars.draw(shift)
        return RenderedStars(image, stars.lit_fraction, stars.reference_point, offsets - shift, first)

    def _trace(
        self,
        fields: np.ndarray,
        pupil: np.ndarray,
        threads: int | None,
        wavelengths: np.ndarray | None = None,
        *,
        exit_pupil: bool = False,
    ) -> PupilOptics:
        inputs = self._inputs
        optics = inputs.trace(
            self._telescope,
            fields,
            self._wavelengths if wavelengths is None else wavelengths,
            pupil,
            focal_plane=inputs.focal_plane,
            projection=inputs.projection,
            threads=threads,
            aberration=inputs.aberration,
            exit_pupil=exit_pupil,
        )
        check_stamp(optics, inputs.plane)
        return optics

    @property
    def _cut_wavelength(self) -> float:
        """Wavelength [m] at which apertures cut the light: all alike, but for 3e-4 at the edge of the LSST's field."""
        return float(self._wavelengths[len(self._wavelengths) // 2])

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
    """Return the effective focal length at the centre of the field [m], at the middle wavelength."""
    if trace is trace_pupils:
        return _traced_focal_length(telescope, tuple(np.asarray(wavelengths, dtype=np.float64).tolist()))
    return _focal_length_by(trace, telescope, wavelengths, threads)


@lru_cache(maxsize=64)
def _traced_focal_length(telescope: Telescope, wavelengths: tuple[float, ...]) -> float:
    """Return the focal length of a telescope; cached, since every call of few stars would trace it anew."""
    return _focal_length_by(trace_pupils, telescope, np.array(wavelengths), 1)


def _focal_length_by(
    trace: Callable[..., PupilOptics], telescope: Telescope, wavelengths: np.ndarray, threads: int | None
) -> float:
    center = np.zeros((1, 2))
    return float(focal_length(trace(telescope, center, wavelengths, center, threads=threads).jacobian)[0])


def metric_of(jacobian: np.ndarray) -> np.ndarray:
    """Return xx, xy, yy of ``jacobian @ jacobian.T`` [m^2/rad^2], float32, shape [n_star, 3].

    A wavenumber k on the focal plane belongs to the baseline ``wavelength / 2 pi |J^T k|``.
    """
    product = jacobian @ np.swapaxes(jacobian, 1, 2)
    return product.reshape(len(jacobian), 4)[:, [0, 1, 3]].astype(np.float32)
