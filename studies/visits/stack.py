"""Stacks of the PSFs of visits, true ones and models, at points of the sky."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from ...core.arguments import check_arguments
from ...core.errors import DomainError, ProductError
from ...core.number_text import counted
from ...core.plotting import figure_at, styled
from ...core.products import Stamp, column, image_hdu, read_fits, table_hdu, write_fits
from ...core.result import Result
from ...core.units import ARCMIN, ARCSEC
from ...measure.adaptive_moments import AdaptiveMoments, adaptive_moments
from ...measure.focal_plane_axes import draw_compass, draw_whisker_panels
from ...measure.shapes import Shapes, measure_shapes
from ...sky.sky_shapes import along_sky
from .psf_visit import VisitPsfs
from .visit_figures import FIGURES, VisitFigures, figure_columns

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Card of the number of visits.
VISITS_CARD = "VISITS"


@dataclass(eq=False)
class PsfSums:
    """Sums of the PSFs of visits, all of one weight or each of its own.

    Attributes
    ----------
    visits : int
        Number of visits.
    count : ndarray of int, shape [n]
        Visits that cover each point.
    true, model : ndarray of float32, shape [n, size, size]
        Sums of PSFs of unit sum, times the weights of their visits.
    figures : list of VisitFigures
        Those of each visit.
    weight : ndarray, shape [n], optional
        Sums of the weights at each point; None where all visits have the weight 1.
    """

    visits: int
    count: np.ndarray
    true: np.ndarray
    model: np.ndarray
    figures: list[VisitFigures] = field(default_factory=list)
    weight: np.ndarray | None = None

    @classmethod
    def empty(cls, n: int, size: int) -> PsfSums:
        """Return the sums of no visit."""
        return cls(0, np.zeros(n, dtype=np.int32), *np.zeros((2, n, size, size), dtype=np.float32))

    def add(self, psfs: VisitPsfs) -> None:
        """Add one visit."""
        if psfs.weight is None:
            self.true[psfs.index] += psfs.true
            self.model[psfs.index] += psfs.model
        else:
            self.weight = np.zeros(len(self.count)) if self.weight is None else self.weight
            self.true[psfs.index] += np.float32(psfs.weight) * psfs.true
            self.model[psfs.index] += np.float32(psfs.weight) * psfs.model
            self.weight[psfs.index] += psfs.weight
        self.count[psfs.index] += 1
        self.figures.append(psfs.figures)
        self.visits += 1

    def write(self, path: Path, stamp: Stamp) -> None:
        """Write the sums, exactly as they are."""
        hdus = [fits.ImageHDU(self.count, name="COUNT"), image_hdu("TRUE", self.true, "sums of the true PSFs")]
        hdus.append(image_hdu("MODEL", self.model, "sums of the PSFs of the models"))
        hdus.append(table_hdu("VISITS", figure_columns(self.figures)))
        if self.weight is not None:
            hdus.append(fits.ImageHDU(self.weight, name="WEIGHT"))
        write_fits(path, hdus, stamp, [(VISITS_CARD, self.visits, "in the sums")])

    @classmethod
    def read(cls, path: Path, stamp: Stamp) -> PsfSums:
        """Read sums; ProductError for those of another configuration, and for a damaged file."""
        hdus = _read_table(path, stamp)
        count = np.array(hdus["COUNT"].data, dtype=np.int32)
        images = _image_from_hdu(hdus["TRUE"]), _image_from_hdu(hdus["MODEL"])
        weight = np.array(hdus["WEIGHT"].data, dtype=np.float64) if "WEIGHT" in hdus else None
        columns = [column(hdus["VISITS"], name) for name in FIGURES]
        figures = [VisitFigures(*map(float, row)) for row in zip(*columns, strict=True)]
        return cls(hdus[0].header[VISITS_CARD], count, *images, figures, weight)


@dataclass(frozen=True, eq=False)
class PsfStack(Result):
    """PSFs of the stack of a number of visits at the points that at least half of them saw.

    Beside the weighted e1, e2 and size there are g and T of adaptive moments, from the images.

    Attributes
    ----------
    visits : int
        Visits in the stack.
    xi, eta : ndarray, shape [n]
        Position on the sky, gnomonic about the common pointing [rad].
    x, y : ndarray, shape [n]
        Position along the axes of the stack [rad].
    star : ndarray of bool, shape [n]
        Whether models are fitted to the point; elsewhere they are only compared.
    count : ndarray of int, shape [n]
        Visits that saw the point.
    true, model : ndarray of float32, shape [n, size, size]
        Mean PSFs along the axes of the stack, of unit sum.
    e1, e2 : ndarray, shape [n]
        Ellipticity of the true PSF, along the axes of the stack.
    size : ndarray, shape [n]
        Weighted rms size of the true PSF [rad].
    model_e1, model_e2 : ndarray, shape [n]
        Ellipticity of the model, along the axes of the stack.
    model_size : ndarray, shape [n]
        Weighted rms size of the model [rad].
    """

    _table = ("xi", "eta", "star", "count", "e1", "e2", "size", "model_e1", "model_e2", "model_size",
              "e1_sky", "e2_sky", "g1", "g2", "model_g1", "model_g2", "g1_sky", "g2_sky",
              "relative_size_residual")  # fmt: skip
    _images = ("true", "model")

    visits: int
    xi: np.ndarray
    eta: np.ndarray
    x: np.ndarray
    y: np.ndarray
    star: np.ndarray
    count: np.ndarray
    true: np.ndarray
    model: np.ndarray
    e1: np.ndarray
    e2: np.ndarray
    size: np.ndarray
    model_e1: np.ndarray
    model_e2: np.ndarray
    model_size: np.ndarray

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw whiskers of the PSF, of the mean of the models, and of their difference."""
        panels = {
            "PSF": (self.e1, self.e2),
            "mean of the models": (self.model_e1, self.model_e2),
            "PSF - model": (self.residual_e1, self.residual_e2),
        }
        with styled():
            figure = figure_at(ax, 13.0, 4.6)
            labels = "x of the stack [arcmin]", "y of the stack [arcmin]"
            panel_axes = figure.subplots(1, 3)
            draw_whisker_panels(panel_axes, self.x / ARCMIN, self.y / ARCMIN, panels, labels)
            for axes in panel_axes:
                draw_compass(axes, *self.sky_directions)
            return figure

    @classmethod
    @check_arguments
    def of(
        cls,
        sums: PsfSums,
        sky: np.ndarray,
        star: NDArray[np.bool_],
        axes: np.ndarray,
        pixel_scale: float,
        weight_fwhm: float,
    ) -> PsfStack:
        """Measure the PSFs of sums at points of the sky [n, 2]; `axes` are d(x, y of the stack [pixel])/d(xi, eta).

        DomainError if there are less than two stars or two places.
        """
        rows = np.flatnonzero((sums.count > 0) & (2 * sums.count >= sums.visits))
        if (~star[rows]).sum() < 2 or star[rows].sum() < 2:
            visits = counted(sums.visits, "visit")
            raise DomainError(
                f"{len(rows)} stars and places were seen by half of {visits}: expected more of them, or "
                "CCDs around the middle of the field, which all rolls see"
            )
        count = sums.count[rows]
        divisor = count if sums.weight is None else sums.weight[rows]
        true, model = (v[rows] / divisor[:, None, None].astype(np.float32) for v in (sums.true, sums.model))
        shapes: list[Shapes] = [measure_shapes(images, pixel_scale, weight_fwhm) for images in (true, model)]
        places = sky[rows], sky[rows] @ axes.T * pixel_scale
        columns = {
            f"{name}{key}": getattr(s, key)
            for s, name in zip(shapes, ("", "model_"), strict=True)
            for key in ("e1", "e2", "size")
        }
        return cls(
            visits=sums.visits,
            xi=places[0][:, 0],
            eta=places[0][:, 1],
            x=places[1][:, 0],
            y=places[1][:, 1],
            star=star[rows],
            count=count,
            true=true,
            model=model,
            **columns,
        )

    @property
    def residual_e1(self) -> np.ndarray:
        """True minus model ellipticity, first component."""
        return self.e1 - self.model_e1

    @property
    def residual_e2(self) -> np.ndarray:
        """True minus model ellipticity, second component."""
        return self.e2 - self.model_e2

    @property
    def e1_sky(self) -> np.ndarray:
        """Ellipticity of the true PSF along xi and eta, as of the table's places, > 0 from east to west.

        North of a place is not along eta: about the common pointing at -28 deg it is 0.5 deg off at 1 deg from it.
        """
        return self._along_sky(self.e1, self.e2)[0]

    @property
    def e2_sky(self) -> np.ndarray:
        """Ellipticity of the true PSF along xi and eta, > 0 from north-west to south-east."""
        return self._along_sky(self.e1, self.e2)[1]

    @property
    def g1_sky(self) -> np.ndarray:
        """Ellipticity g of adaptive moments of the true PSF along xi and eta, > 0 from east to west."""
        return self._along_sky(self.g1, self.g2)[0]

    @property
    def g2_sky(self) -> np.ndarray:
        """Ellipticity g of adaptive moments of the true PSF along xi and eta, > 0 from north-west to south-east."""
        return self._along_sky(self.g1, self.g2)[1]

    def _along_sky(self, first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return ellipticities along the axes of the stack along west and north of the tangent plane."""
        # The axes of the stack are those of the plane, turned and mirrored.
        along_stack, plane = np.stack([self.x, self.y], axis=1), np.stack([-self.xi, self.eta], axis=1)
        jacobian = np.linalg.lstsq(along_stack, plane, rcond=None)[0].T
        return along_sky(first, second, np.broadcast_to(jacobian, (len(self), 2, 2)))

    @cached_property
    def adaptive(self) -> tuple[AdaptiveMoments, AdaptiveMoments]:
        """Adaptive moments of the true PSFs and of the models; sigma in pixels of the stack."""
        true, model = (adaptive_moments(images, 1.0) for images in (self.true, self.model))
        return true, model

    @property
    def g1(self) -> np.ndarray:
        """Ellipticity g of adaptive moments of the true PSF, along x of the stack."""
        return self.adaptive[0].g1

    @property
    def g2(self) -> np.ndarray:
        """Ellipticity g of adaptive moments of the true PSF, along x = y."""
        return self.adaptive[0].g2

    @property
    def model_g1(self) -> np.ndarray:
        """Ellipticity g of adaptive moments of the mean of the models, along x of the stack."""
        return self.adaptive[1].g1

    @property
    def model_g2(self) -> np.ndarray:
        """Ellipticity g of adaptive moments of the mean of the models, along x = y."""
        return self.adaptive[1].g2

    @property
    def relative_size_residual(self) -> np.ndarray:
        """(T - T of the models)/T of adaptive moments, T = Mxx + Myy."""
        true, model = self.adaptive
        return np.asarray(1.0 - model.T / true.T)

    @property
    def sky_directions(self) -> tuple[np.ndarray, np.ndarray]:
        """North and east as unit vectors along the axes of the stack, [2] each; NaN where points do not tell them."""
        sky, places = np.stack([self.xi, self.eta], axis=1), np.stack([self.x, self.y], axis=1)
        to_places = np.linalg.lstsq(sky, places, rcond=None)[0]  # rows: x, y of a step in xi, and in eta
        length = np.linalg.norm(to_places, axis=1, keepdims=True)
        east, north = to_places / np.where(length > 0.0, length, np.nan)
        return north, east

    def __len__(self) -> int:
        return len(self.xi)

    def around(self, places: np.ndarray, margin: float) -> PsfStack:
        """Return the points in the rectangle of places [n, 2] along the axes of the stack, with a margin [rad]."""
        low, high = (f(places, axis=0, initial=start) for f, start in ((np.min, np.inf), (np.max, -np.inf)))
        at = np.stack([self.x, self.y], axis=1)
        rows = np.flatnonzero(((at >= low - margin) & (at <= high + margin)).all(axis=1))
        return replace(self, **{name: getattr(self, name)[rows] for name in (*_COLUMNS, *self._images)})

    @check_arguments
    def write_product(self, path: Path, stamp: Stamp) -> None:
        """Write the stack as a FITS table of points and two cubes of images."""
        table = table_hdu(
            "POINTS",
            {
                name.upper(): (getattr(self, name) / scale if scale != 1.0 else getattr(self, name), unit, description)
                for name, (scale, unit, description) in {**_COLUMNS, **_ADAPTIVE_COLUMNS}.items()
            }
            | {
                "E1_SKY": (self.e1_sky, "", "E1, E2 along xi and eta, > 0 from east to west"),
                "E2_SKY": (self.e2_sky, "", "likewise, > 0 from north-west to south-east"),
                "G1_SKY": (self.g1_sky, "", "G1, G2 along xi and eta, > 0 from east to west"),
                "G2_SKY": (self.g2_sky, "", "likewise, > 0 from north-west to south-east"),
            },
        )
        images = [image_hdu("TRUE", self.true, "true PSFs"), image_hdu("MODEL", self.model, "PSFs of the models")]
        write_fits(path, [table, *images], stamp, [(VISITS_CARD, self.visits, "in the stack")])

    @classmethod
    @check_arguments
    def read(cls, path: Path, stamp: Stamp | None = None) -> PsfStack:
        """Read a stack; ProductError for a damaged file and, with a stamp, for one of another configuration."""
        hdus = _read_table(path, stamp)
        columns = {name: column(hdus["POINTS"], name.upper()) for name in _COLUMNS}
        columns = {
            name: columns[name] * scale if scale != 1.0 else columns[name] for name, (scale, _, _) in _COLUMNS.items()
        }
        images = {"true": _image_from_hdu(hdus["TRUE"]), "model": _image_from_hdu(hdus["MODEL"])}
        return cls(**{"visits": hdus[0].header[VISITS_CARD], **columns, **images})


_COLUMNS = {
    "xi": (ARCMIN, "arcmin", "towards east, gnomonic"),
    "eta": (ARCMIN, "arcmin", "towards north, gnomonic"),
    "x": (ARCMIN, "arcmin", "along x of the stack"),
    "y": (ARCMIN, "arcmin", "along y of the stack"),
    "star": (1.0, "", "whether models are fitted to the point"),
    "count": (1.0, "", "visits that saw the point"),
    "e1": (1.0, "", "ellipticity (a-b)/(a+b) along x of the stack"),
    "e2": (1.0, "", "ellipticity along x = y"),
    "size": (ARCSEC, "arcsec", "weighted rms size"),
    "model_e1": (1.0, "", "of the mean of the models"),
    "model_e2": (1.0, "", "of the mean of the models"),
    "model_size": (ARCSEC, "arcsec", "of the mean of the models"),
}
#: Columns that follow from the images, which a file has for its readers.
_ADAPTIVE_COLUMNS = {
    "g1": (1.0, "", "g of adaptive moments along x of the stack"),
    "g2": (1.0, "", "g along x = y"),
    "model_g1": (1.0, "", "of the mean of the models"),
    "model_g2": (1.0, "", "of the mean of the models"),
    "relative_size_residual": (1.0, "", "(T - T model)/T of adaptive moments"),
}


def _read_table(path: Path, stamp: Stamp | None) -> fits.HDUList:
    hdus = read_fits(path, stamp)
    if VISITS_CARD not in hdus[0].header:
        raise ProductError("no stack of visits", file=path)
    return hdus


def _image_from_hdu(hdu: fits.ImageHDU) -> np.ndarray:
    return np.array(hdu.data, dtype=np.float32)
