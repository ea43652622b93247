"""Correlation of the PSF, and of what the models leave of it, over the focal plane: of a visit, and of a night.

The correlation of a visit is that of adaptive g at places where no star is, along the axes of the focal plane. Visits
have different air, so their scatter says how well the mean over a night is known.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ...core.products import Columns
from ...measure.correlation import SEPARATION_RANGES, SeparationBins, in_range, mean_over_pairs, shear_correlation
from ...pipeline.experiment import Experiment
from ...pipeline.photometry import pixel_angle
from ...pipeline.resolved_values import resolved_value
from ...pipeline.summary import bins_up_to

#: Ellipticities that are correlated: of the noise-free PSFs, and of these less the models' where no star is.
KINDS = ("truth", "away")
#: Columns of the correlation of a visit: unit, description.
COLUMNS = {
    "R": ("arcmin", "mean separation of the pairs"),
    "PAIRS": ("", "pairs"),
    "XI_TRUTH": ("", "xi+ of g of the noise-free PSFs"),
    "XI_AWAY": ("", "xi+ of g of the noise-free PSFs less that of the models where no star is"),
}
#: Places up to which pairs are counted one by one: a third of a second.
_EXACT_LIMIT = 3000


class PlaceEllipticities(NamedTuple):
    """Ellipticities g at places of a CCD, along the axes of the focal plane."""

    xy: np.ndarray  #: places [m], [n, 2]
    truth: np.ndarray  #: of the noise-free PSFs, [2, n]
    away: np.ndarray  #: of these less those of the model, [2, n]; NaN without a model


@dataclass(frozen=True)
class MeanCorrelation:
    """Mean of xi+ over visits, in bins of separation."""

    r_arcmin: np.ndarray
    xi_plus: np.ndarray
    error_plus: np.ndarray  #: from the scatter of the visits; NaN of fewer than two
    pairs: np.ndarray  #: of all visits
    visits: int

    def as_dict(self) -> dict[str, object]:
        """Return the columns, and the number of visits, by the names of the products."""
        return {
            "r_arcmin": self.r_arcmin,
            "xi_plus": self.xi_plus,
            "error_plus": self.error_plus,
            "pairs": self.pairs,
            "visits": self.visits,
        }


def correlate_visit(experiment: Experiment, ccds: Sequence[PlaceEllipticities]) -> dict[str, np.ndarray]:
    """Return :data:`COLUMNS` of a visit, in bins that are the same for all visits of a night; nothing of one place."""
    x, y = (np.concatenate([ccd.xy for ccd in ccds]) * _angle_per_length(experiment)).T
    bins = _separation_bins(experiment, exact=len(x) <= _EXACT_LIMIT)
    columns: dict[str, np.ndarray] = {}
    for kind in KINDS:
        values = np.concatenate([getattr(ccd, kind) for ccd in ccds], axis=1)
        name = f"XI_{kind.upper()}"
        if np.isfinite(values).all(axis=0).sum() < 2:
            columns[name] = np.full(bins.n_bins, np.nan)
            continue
        correlation = shear_correlation(x, y, *values, bins=bins)
        columns.setdefault("R", correlation.r_arcmin)
        columns.setdefault("PAIRS", correlation.n_pairs)
        columns[name] = correlation.xi_plus
    return {name: columns[name] for name in COLUMNS} if "R" in columns else {}


def mean_correlations(visits: Sequence[Mapping[str, np.ndarray]]) -> dict[str, MeanCorrelation]:
    """Return the mean over visits of each kind that they have; a visit counts by its pairs in each bin."""
    means: dict[str, MeanCorrelation] = {}
    for kind in KINDS if visits else ():
        xi = np.stack([visit[f"XI_{kind.upper()}"] for visit in visits])
        pairs = np.where(np.isfinite(xi), np.stack([visit["PAIRS"] for visit in visits]), 0)
        if not pairs.any():
            continue
        total = pairs.sum(axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            mean = np.nansum(pairs * xi, axis=0) / total
            r = (pairs * np.stack([visit["R"] for visit in visits])).sum(axis=0) / total
        means[kind] = MeanCorrelation(r, mean, _error_of_mean(xi, pairs), total, int(pairs.any(axis=1).sum()))
    return means


def range_means(visits: Sequence[Mapping[str, np.ndarray]]) -> dict[str, float]:
    """Return mean xi+ of each kind over pairs of :data:`~.SEPARATION_RANGES`, and its error from visit to visit.

    Keys are as of a run: ``xi_plus_g_away_short``, ``error_xi_plus_g_away_short``. What has no pairs is left out.
    """
    metrics: dict[str, float] = {}
    for kind in KINDS if visits else ():
        for name in SEPARATION_RANGES:
            sums = []
            for visit in visits:
                xi = visit[f"XI_{kind.upper()}"]
                within = in_range(visit["R"], name) & np.isfinite(xi)
                pairs = visit["PAIRS"][within]
                if pairs.any():
                    sums.append((float(pairs.sum()), float(mean_over_pairs(pairs, xi[within]))))
            if sums:
                pairs_of_visits, values = np.array(sums).T
                key = f"xi_plus_g_{kind}_{name}"
                metrics[key] = float(np.average(values, weights=pairs_of_visits))
                metrics[f"error_{key}"] = float(_error_of_mean(values[:, None], pairs_of_visits[:, None])[0])
    return metrics


def correlation_columns(means: Mapping[str, Mapping[str, MeanCorrelation]]) -> Columns:
    """Return the correlations of all bands as columns of one table: band, separation, xi+ and error of each kind."""
    rows: dict[str, list[np.ndarray]] = {name: [] for name in ("band", "r", "pairs")}
    for kind in KINDS:
        rows |= {f"xiPlus_{kind}": [], f"xiPlus_{kind}Err": []}
    for band, kinds in means.items():
        first = next(iter(kinds.values()))
        missing = np.full(len(first.r_arcmin), np.nan)
        rows["band"].append(np.full(len(first.r_arcmin), band))
        rows["r"].append(first.r_arcmin)
        rows["pairs"].append(first.pairs)
        for kind in KINDS:
            rows[f"xiPlus_{kind}"].append(kinds[kind].xi_plus if kind in kinds else missing)
            rows[f"xiPlus_{kind}Err"].append(kinds[kind].error_plus if kind in kinds else missing)
    meanings = {
        "band": ("", "band"),
        "r": ("arcmin", "mean separation of the pairs"),
        "pairs": ("", "pairs of all visits"),
        "xiPlus_truth": ("", COLUMNS["XI_TRUTH"][1] + ", mean over visits"),
        "xiPlus_truthErr": ("", "standard error from visit to visit"),
        "xiPlus_away": ("", COLUMNS["XI_AWAY"][1] + ", mean over visits"),
        "xiPlus_awayErr": ("", "standard error from visit to visit"),
    }
    return {name: (np.concatenate(values), *meanings[name]) for name, values in rows.items() if values}


def _error_of_mean(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the standard error of weighted means over the first axis by their scatter; NaN of fewer than two."""
    count = (weights > 0).sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = weights / weights.sum(axis=0)
        mean = np.nansum(shares * values, axis=0)
        square = np.nansum((shares * (values - mean)) ** 2, axis=0) * count / (count - 1.0)
    return np.where(count > 1, np.sqrt(square), np.nan)


def _angle_per_length(experiment: Experiment) -> float:
    """Return the angle on the sky of a length on the focal plane near the axis [rad/m]."""
    pixel_size = experiment.camera.pixel_size
    return pixel_angle(experiment.telescope, pixel_size) / pixel_size


def _separation_bins(experiment: Experiment, exact: bool) -> SeparationBins:
    """Return the bins of a night: from 0.56 arcmin to beyond the largest separation on its CCDs."""
    camera = experiment.camera
    numbers = np.array([camera.ccd_index(name) for name in resolved_value(experiment.config.ccds)])
    extent = float(np.hypot(*np.ptp(camera.corners(numbers).reshape(-1, 2), axis=0)))
    return bins_up_to(extent * _angle_per_length(experiment), exact)
