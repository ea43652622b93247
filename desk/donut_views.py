"""The wavefronts of donuts, and views of them; nothing here draws."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from astropy import units as u

from ..core.errors import ProductError
from ..core.files import parsing
from ..core.statistics import finite_median
from ..core.table_files import ENDINGS, read_columns
from ..core.units import ARCSEC
from ..sensing.result import DonutFit
from .result_views import ErrorBarsView, PlacesView, RowsView


@dataclass(frozen=True)
class DonutStamps:
    """Images of donuts and their best models [electrons], each [n, ny, nx]."""

    image: np.ndarray
    model: np.ndarray


@dataclass(frozen=True)
class DonutBench:
    """Wavefronts of n donuts beyond that of the telescope believed in.

    Parameters
    ----------
    name : str
        Name of the fit: its telescope, or its file.
    noll : ndarray of int, shape [n_noll]
        Noll indices.
    zernikes, errors : ndarray, shape [n, n_noll]
        Coefficients and their standard errors [nm].
    field_deg : ndarray, shape [n, 2]
        Field angles [deg].
    fwhm_arcsec : ndarray, shape [n]
        FWHM of the atmosphere [arcsec].
    reasons : list of str
        Flags of each donut in words.
    stamps : DonutStamps, optional
        Images, which tables of donuts do not have.
    """

    name: str
    noll: np.ndarray
    zernikes: np.ndarray
    errors: np.ndarray
    field_deg: np.ndarray
    fwhm_arcsec: np.ndarray
    reasons: list[str]
    stamps: DonutStamps | None = None

    @classmethod
    def of(cls, fit: DonutFit) -> DonutBench:
        """Return the bench of a fit."""
        values = 1e9 * fit.zernikes, 1e9 * fit.errors, np.rad2deg(fit.fields), fit.fwhm / ARCSEC
        words = [reasons or "ok" for reasons in fit.reasons]
        return cls(f"donuts of {fit.telescope}", fit.noll, *values, words, DonutStamps(fit.images, fit.model))

    @classmethod
    def read(cls, path: Path) -> DonutBench:
        """Read the table that ``pachon donuts -o`` wrote; ProductError where it is none."""
        columns = read_columns(path)
        noll = np.array([j for j in range(2, 79) if {f"z{j}", f"z{j}_err"} <= set(columns)])
        if not len(noll) or not {"field_x", "field_y", "fwhm", "reasons"} <= set(columns):
            raise ProductError("expected the table of pachon donuts: field_x, field_y, fwhm, Z4, Z4_err...", file=path)
        with parsing(path, "damaged table of donuts", ProductError):

            def stacked(names: list[str]) -> np.ndarray:
                return np.stack([np.asarray(columns[name], dtype=float) for name in names], axis=-1)

            units = [getattr(columns[f"z{j}"], "unit", None) or u.nm for j in noll]
            if any(not unit.is_equivalent(u.nm) for unit in units):
                raise ProductError(f"Zernikes in {units[0]}: expected lengths", file=path)
            in_nm = np.array([unit.to(u.nm) for unit in units])
            zernikes, errors = (in_nm * stacked([f"z{j}{end}" for j in noll]) for end in ("", "_err"))
            [fwhm] = stacked(["fwhm"]).T
            words = [str(word) for word in columns["reasons"]]
            return cls(path.stem, noll, zernikes, errors, stacked(["field_x", "field_y"]), fwhm, words)

    def __len__(self) -> int:
        return len(self.zernikes)

    def bars(self, donut: int) -> ErrorBarsView:
        """Return the Zernikes of a donut."""
        title = f"Donut {donut}: Zernikes beyond those of the telescope"
        return ErrorBarsView(self.noll, self.zernikes[donut], self.errors[donut], title)

    def over_field(self, noll: int) -> PlacesView:
        """Return a Zernike at the fields of the donuts."""
        values = self.zernikes[:, int(np.flatnonzero(self.noll == noll)[0])]
        x, y = self.field_deg.T
        return PlacesView(x, y, values, f"Z{noll} [nm]", f"Z{noll} over the field", diverging=True)

    def images(self, donut: int) -> RowsView | None:
        """Return image, model and difference of a donut over the peak of the model; None without images or a model."""
        if self.stamps is None or not np.isfinite(self.stamps.model[donut]).any():
            return None
        image, model = self.stamps.image[donut], self.stamps.model[donut]
        peak, side = np.nanmax(model), max(image.shape)
        square = np.zeros((3, side, side))
        # Smaller stamps are NaN beside their pixels.
        for k, values in enumerate((image, model, image - model)):
            square[k, : image.shape[0], : image.shape[1]] = np.nan_to_num(values / peak)
        return RowsView({"": square}, float(side), f"Donut {donut}: image, model, image - model")

    def numbers(self, donut: int) -> dict[str, tuple[float, str]]:
        """Return the numbers of a donut, and medians of all."""
        size = np.sqrt((self.zernikes**2).sum(axis=1))
        return {
            "donuts": (float(len(self)), ""),
            "rms of the wavefront": (float(size[donut]), "nm"),
            "rms, median of all": (finite_median(size), "nm"),
            "FWHM of the atmosphere": (float(self.fwhm_arcsec[donut]), "arcsec"),
        }


def is_table(path: Path) -> bool:
    """Return whether a file has the ending of a table."""
    return path.suffix.lower() in ENDINGS
