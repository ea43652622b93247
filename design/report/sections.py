"""Sections of the design report: every analysis by title, with what it shows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from ...core.errors import DomainError
from ...models.telescope import Telescope
from ..analyses.analysis import band_wavelengths
from ..analyses.color import chromatic_focus, lateral_color
from ..analyses.field_curvature import field_curvature
from ..analyses.illumination import relative_illumination
from ..analyses.ray_fans import opd_fans, ray_fans
from ..analyses.seidel import seidel_diagram
from ..analyses.spot_matrix import spot_matrix
from ..analyses.strehl import strehl
from ..analyses.target_image import target_image
from ..analyses.throughput import throughput
from ..images.encircled_energy import encircled_energy
from ..images.mtf import mtf
from ..layout.layout import layout
from ..metrics.field_zernikes import wavefront_zernikes
from ..metrics.footprint import footprint
from ..metrics.spots import SpotDiagram, spots
from ..metrics.through_focus import through_focus

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Where:
    """Telescope, field points and wavelengths of a report; None where the telescope's own serve."""

    telescope: Telescope
    fields: np.ndarray | None
    wavelengths: np.ndarray | None
    threads: int | None

    @property
    def one_wavelength(self) -> float | None:
        """The wavelength in the middle of the list [m]; None where none is given."""
        return None if self.wavelengths is None else float(self.wavelengths[len(self.wavelengths) // 2])

    @property
    def colors(self) -> ArrayLike | None:
        """Wavelengths [m] across the band where none are given."""
        if self.telescope.design_data.wavelengths:
            return self.wavelengths
        return band_wavelengths(self.telescope, self.wavelengths, 3)

    @cached_property
    def spots(self) -> SpotDiagram:
        """Spots of all wavelengths at the fields."""
        return spots(self.telescope, self.fields, self.colors, sampling="rings", n_pupil=16, threads=self.threads)


@dataclass(frozen=True)
class Section:
    """One section of the report."""

    title: str
    shows: str  #: caption
    draw: Callable[[Where], Figure]


def _target(w: Where) -> Figure:
    return target_image(w.telescope, wavelengths=w.colors, n_rays=150, threads=w.threads).plot()


def _strehl(w: Where) -> Figure:
    where = (w.telescope, w.fields, w.one_wavelength)
    try:
        return strehl(*where, threads=w.threads).plot()
    except DomainError:
        # Aberrations of very many waves have no diffraction image worth its time.
        return strehl(*where, from_psf=False, threads=w.threads).plot()


#: In the order of the report.
SECTIONS = (
    Section(
        "Layout",
        "Section x = 0, surfaces cut to their apertures, with rays of some fields.",
        lambda w: layout(w.telescope, w.fields, w.one_wavelength, threads=w.threads).plot(),
    ),
    Section(
        "Ray fans",
        "Transverse aberration against the pupil coordinate along the field (tangential) and across it (sagittal), "
        "relative to the chief ray of the middle wavelength.",
        lambda w: ray_fans(w.telescope, w.fields, w.colors, threads=w.threads).plot(),
    ),
    Section(
        "OPD fans",
        "Path of the chief ray less path of the ray, in waves of each wavelength.",
        lambda w: opd_fans(w.telescope, w.fields, w.colors, threads=w.threads).plot(),
    ),
    Section(
        "Spots",
        "Geometric spots of all wavelengths about their centroid; the black circle is the Airy disc.",
        lambda w: w.spots.plot(),
    ),
    Section(
        "Spots through focus",
        "Rows are fields, columns heights of the detector to two depths of focus on either side.",
        lambda w: spot_matrix(w.telescope, w.fields, w.colors, n_pupil=8, threads=w.threads).plot(),
    ),
    Section(
        "Through focus",
        "Spot radius, wavefront and Strehl ratio against the height of the detector.",
        lambda w: through_focus(w.telescope, w.fields, w.colors, n_pupil=12, threads=w.threads).plot(),
    ),
    Section(
        "Field curvature and distortion",
        "Foci of rays close to the chief ray, behind the detector; distortion against f tan θ.",
        lambda w: field_curvature(w.telescope, None, w.colors, threads=w.threads).plot(),
    ),
    Section(
        "Lateral colour",
        "Landing points of the chief rays against that of the middle wavelength.",
        lambda w: lateral_color(w.telescope, None, w.wavelengths, threads=w.threads).plot(),
    ),
    Section(
        "Chromatic focal shift",
        "Focus on the axis across the band, paraxial and of zones of the pupil.",
        lambda w: chromatic_focus(w.telescope, threads=w.threads).plot(),
    ),
    Section(
        "Seidel diagram",
        "Third-order wavefront of each surface at the rims of pupil and field; colour between the edges of the band.",
        lambda w: seidel_diagram(w.telescope, w.one_wavelength).plot(),
    ),
    Section(
        "Wavefront in Zernike terms",
        "Annular Zernike terms of the wavefront in Noll's order; a term is its own rms.",
        lambda w: wavefront_zernikes(w.telescope, w.fields, w.one_wavelength, threads=w.threads).plot(),
    ),
    Section(
        "Strehl ratio",
        "From the wavefront over the lit pupil, from its rms, and from the peak of the diffraction image.",
        _strehl,
    ),
    Section(
        "Encircled energy",
        "Light within a radius about the centroid, diffraction included.",
        lambda w: encircled_energy(w.telescope, w.fields, w.one_wavelength, threads=w.threads).plot(),
    ),
    Section(
        "Modulation transfer function",
        "Contrast of waves along the field and across it, diffraction included.",
        lambda w: mtf(w.telescope, w.fields, w.one_wavelength, threads=w.threads).plot(),
    ),
    Section("Image of a bar target", "Geometric, on the axis; bars as wide as their gaps.", _target),
    Section(
        "Relative illumination",
        "Irradiance by a uniform source against the field, vignetting included.",
        lambda w: relative_illumination(w.telescope, None, w.one_wavelength, n_pupil=1000, threads=w.threads).plot(),
    ),
    Section(
        "Throughput",
        "With reflections of bare glass after Fresnel; mirrors and detector are perfect here.",
        lambda w: throughput(w.telescope, w.fields, w.wavelengths, n_pupil=1000, threads=w.threads).plot(),
    ),
    Section(
        "Footprints",
        "Light of each field on each surface over its clear aperture; red where it is blocked.",
        lambda w: footprint(w.telescope, None, w.fields, w.one_wavelength, n_pupil=12, threads=w.threads).plot(),
    ),
)
