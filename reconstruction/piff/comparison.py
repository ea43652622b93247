"""A PSF model of Piff and one of ours at the same stars: residuals and rho statistics side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from astropy.table import QTable, Table
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from ...core.arguments import check_arguments
from ...core.files import make_folder, write_bytes, write_json
from ...core.number_text import counted
from ...core.products import Columns, described_table, write_ecsv
from ...core.result import Result
from ...core.statistics import finite_mean, rms
from ...core.table_files import write_table
from ...core.units import ARCSEC, pure_numbers
from ...measure.correlation_plots import correlation_columns, draw_rho, rho_plot
from ...measure.rho_statistics import RhoStatistics, trace_of_moments
from ...measure.shapes import Shapes, measure_shapes
from ..own_stars.masked_stars import as_bad_pixels, sky_of_stamps
from ..own_stars.own_stars import FEWEST_STARS, SKY, fit_own_stars
from ..own_stars.result import OwnStars, part_of, star_rho_statistics
from ..psf_model.colour import as_colours
from ..psf_model.polynomial import as_positions
from .psf import PiffPsf

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Farthest that a star of the table may be from that of the file [pixel]: programs count pixels from 0 or from 1.
_NEAR = 2.0
#: Fewest reserved stars at which models are compared.
_FEWEST_RESERVED = 5


@dataclass(frozen=True, eq=False)
class PiffComparison(Result):
    """Residuals of the models of Piff and of ours.

    Attributes
    ----------
    stars : Table
        Stars that are used: place, S/N, shape, whether Piff's fit used the star, and shapes of both models there.
    models : Table
        A row for each model and kind of residual: number of stars, means and rms of e and (T - T model)/T.
    rho : dict of str to RhoStatistics
        By the names in the first column of `models`.
    """

    stars: Table
    models: Table
    rho: dict[str, RhoStatistics]

    def _label(self) -> str:
        return f"{counted(len(self.stars), 'star')}, {', '.join(self.models['model'])}"

    def _summary(self) -> dict[str, Any]:
        return {row["model"]: {k: row[k] for k in self.models.colnames[1:]} for row in self.models}

    def to_table(self) -> QTable:
        """Return the residuals of each model."""
        return QTable(self.models)

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw the rho statistics of each model."""
        return draw_rho(ax, self.rho)

    def as_dict(self) -> dict[str, Any]:
        """Return all metrics as plain mappings and arrays."""
        return {
            "models": self._summary(),
            "rho": {name: {key: c.as_dict() for key, c in rho.items()} for name, rho in self.rho.items()},
        }

    @check_arguments
    def write_folder(self, folder: Path) -> tuple[str, ...]:
        """Write the tables, a picture of the rho statistics and all metrics into a folder; return their names."""
        make_folder(folder)
        correlations = {f"{name}: {key}": c for name, rho in self.rho.items() for key, c in rho.items()}
        for name, table in (("stars.ecsv", self.stars), ("models.ecsv", self.models)):
            write_table(folder / name, table)
        write_ecsv(folder / "rho.ecsv", correlation_columns(correlations), {"what": "rho statistics 1 to 5"})
        write_bytes(folder / "rho.png", rho_plot(self.rho))
        write_json(folder / "comparison.json", self.as_dict())
        return ("stars.ecsv", "models.ecsv", "rho.ecsv", "rho.png", "comparison.json")


@check_arguments
def compare_with_piff(
    psf: PiffPsf,
    stamps: ArrayLike,
    positions: ArrayLike,
    *,
    chip: int | None = None,
    pixel_scale: ArrayLike | None = None,
    properties: Mapping[str, ArrayLike] | None = None,
    masks: NDArray[np.bool_] | None = None,
    bins: int = 8,
    **options: Any,
) -> PiffComparison:
    """Compare a model of Piff with one of ours, made of the same stars, by residuals at the stars.

    Ours predicts each star from others (:func:`~pachon.fit_own_stars`). Piff's fit has seen all stars that it did not
    reserve, so its residuals there are too small. Where five or more of the stars are not of its fit, those rows are
    the fair ones: there ours is made of the stars of Piff's fit alone. Where the sky of the stars is subtracted, images
    of Piff lose the same part of their wings.

    Parameters
    ----------
    psf : PiffPsf
        Model of Piff.
    stamps, positions : array
        Stars [n, ny, nx] and places [n, 2], as :func:`~pachon.load_stars` reads them; pixels as Piff counts them.
    chip : int, optional
        Number of the chip; may be left out where there is one.
    pixel_scale : float or Quantity, optional
        Side of a pixel [rad]; that of the Piff file by default.
    properties : mapping of str to array, optional
        Values [n] of :attr:`PiffPsf.property_names`.
    masks : array of bool, optional
        [n, ny, nx], True for pixels to ignore, as :func:`~pachon.fit_own_stars` takes them.
    bins : int
        Bins of the rho statistics.
    **options
        Other options of :func:`~pachon.fit_own_stars`.

    Raises
    ------
    DomainError
        If there is no such chip, or what :func:`~pachon.fit_own_stars` raises it for.
    """
    places = as_positions(positions)
    scale = psf.pixel_scale(places.mean(axis=0), chip=chip) if pixel_scale is None else pixel_scale
    pachon_stars = fit_own_stars(stamps, places, scale, masks=masks, **options)
    used = pachon_stars.used
    star_properties = {key: pure_numbers(values, key)[used] for key, values in (properties or {}).items()}
    raw_images = np.asarray(stamps, dtype=np.float64)
    drawn = psf.at(places[used], chip=chip, size=max(raw_images.shape[1:]), properties=star_properties)
    if options.get("background", True):
        drawn = _less_sky(drawn, as_bad_pixels(raw_images, masks)[used])
    images = _middle(drawn, 2 * (pachon_stars.stamps.shape[1],))
    shapes, held_out, theirs = (
        part_of(pachon_stars.shapes, used),
        part_of(pachon_stars.held_out, used),
        _measured(pachon_stars, images),
    )
    in_fit = _in_fit(psf, places[used], chip)
    everywhere = np.ones(len(in_fit), dtype=bool)
    rows = [("pachon, star held out", held_out, everywhere)]
    if in_fit.any():
        rows.append(("Piff, stars of its fit", theirs, in_fit))
    if (~in_fit).sum() >= _FEWEST_RESERVED:
        if in_fit.sum() >= FEWEST_STARS:
            fitted_stars = np.flatnonzero(used)[in_fit]
            fitted_masks = None if masks is None else np.asarray(masks)[fitted_stars]
            colours = _colours(options, len(places))
            fitted_options = options if colours is None else options | {"colour": colours[fitted_stars]}
            model = fit_own_stars(
                np.asarray(stamps)[fitted_stars], places[fitted_stars], scale, masks=fitted_masks, **fitted_options
            ).model
            predicted = model.at(places[used], colour=None if colours is None else colours[used])
            rows.append(("pachon, other stars", _measured(pachon_stars, predicted), ~in_fit))
        rows.append(("Piff, other stars", theirs, ~in_fit))
    return PiffComparison(
        _stars(pachon_stars, in_fit, theirs),
        _models(shapes, rows),
        {name: _rho(pachon_stars, shapes, model, star_mask, bins) for name, model, star_mask in rows},
    )


def _less_sky(drawn: np.ndarray, bad: np.ndarray) -> np.ndarray:
    """Return images [n, size, size] less what :func:`~pachon.fit_own_stars` takes for the sky of stamps [n, ny, nx].

    Part of it are the wings of the PSF.
    """
    level, _ = sky_of_stamps(_middle(drawn, bad.shape[1:]), bad, SKY * min(bad.shape[1:]))
    return drawn - np.nan_to_num(level)[:, None, None]


def _middle(images: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return parts of a shape (ny, nx) of images [n, size, size] about their middle pixels."""
    first_row, first_column = (images.shape[1] // 2 - count // 2 for count in shape)
    return images[:, first_row : first_row + shape[0], first_column : first_column + shape[1]]


def _colours(options: Mapping[str, Any], count: int) -> np.ndarray | None:
    """Return the colours of so many stars among the options of their model; None without any."""
    colour = options.get("colour")
    return None if colour is None else np.broadcast_to(as_colours(colour, count), (count,))


def _in_fit(psf: PiffPsf, places: np.ndarray, chip: int | None) -> np.ndarray:
    """Return which stars Piff's fit used, [n] bool."""
    of_chip = psf.stars["used"] & (psf.stars["chip"] == (next(iter(psf.chips)) if chip is None else chip))
    fit_places = np.stack([psf.stars["x"], psf.stars["y"]], axis=1)[of_chip]
    return cKDTree(fit_places).query(places)[0] <= _NEAR if len(fit_places) else np.zeros(len(places), dtype=bool)


def _measured(own: OwnStars, images: np.ndarray) -> Shapes:
    return measure_shapes(images, own.pixel_scale, own.weight_fwhm)


def _growth(stars: Shapes, model: Shapes) -> np.ndarray:
    """Return (T - T of the model)/T, T = Q11 + Q22, [n]."""
    star_trace = trace_of_moments(stars.size, stars.e1, stars.e2)
    result: np.ndarray = 1.0 - trace_of_moments(model.size, model.e1, model.e2) / star_trace
    return result


def _models(stars: Shapes, rows: Sequence[tuple[str, Shapes, np.ndarray]]) -> Table:
    metrics = []
    for _, model, star_mask in rows:
        d1, d2, growth = (v[star_mask] for v in (stars.e1 - model.e1, stars.e2 - model.e2, _growth(stars, model)))
        components = np.concatenate([d1, d2])
        metrics.append([finite_mean(d1), finite_mean(d2), rms(components), finite_mean(growth), rms(growth)])
    texts = (
        ("mean_e1", "mean of e1 less that of the model"),
        ("mean_e2", "mean of e2 less that of the model"),
        ("rms_e", "rms of a component of e less that of the model"),
        ("mean_dt", "mean of (T - T model)/T, T = Q11 + Q22"),
        ("rms_dt", "rms of (T - T model)/T"),
    )
    columns: Columns = {
        "model": (np.array([name for name, _, _ in rows]), "", "model, and at which stars"),
        "stars": (np.array([int(star_mask.sum()) for _, _, star_mask in rows]), "", "number of stars"),
    }
    columns |= {key: (np.array(v), "", text) for (key, text), v in zip(texts, zip(*metrics, strict=True), strict=True)}
    return described_table(columns, {"what": "residuals of two PSF models"})


def _stars(own: OwnStars, in_fit: np.ndarray, theirs: Shapes) -> Table:
    used = own.used
    columns: Columns = {
        "x": (own.positions[used, 0], "", "place, as in the table of the stars"),
        "y": (own.positions[used, 1], "", "likewise"),
        "snr": (own.snr[used], "", "signal-to-noise ratio"),
        "in_piff_fit": (in_fit, "", "whether Piff's fit used the star"),
    }
    held_out = part_of(own.held_out, used)
    for prefix, shapes, text in (
        ("", part_of(own.shapes, used), "of the star"),
        ("pachon_", held_out, "of our model made without the star"),
        ("piff_", theirs, "of Piff's model"),
    ):
        columns[f"{prefix}e1"] = (shapes.e1, "", f"ellipticity (a-b)/(a+b) along x, {text}")
        columns[f"{prefix}e2"] = (shapes.e2, "", f"ellipticity along x = y, {text}")
        columns[f"{prefix}size"] = (shapes.size / ARCSEC, "arcsec", f"(Q11 Q22 - Q12^2)^(1/4), {text}")
    weight = {"weight_fwhm_arcsec": own.weight_fwhm / ARCSEC}
    return described_table(columns, {"what": "stars, and two PSF models there", **weight})


def _rho(own: OwnStars, stars: Shapes, model: Shapes, chosen: np.ndarray, bins: int) -> RhoStatistics:
    """Return the rho statistics of a model at some stars; separations are those on the detector."""
    places = own.positions[own.used][chosen] * own.pixel_scale
    return star_rho_statistics(places, part_of(stars, chosen), part_of(model, chosen), bins)
