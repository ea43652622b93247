"""Result of a null test: shear correlations, densities, biases."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from ...measure.catalogue.shear_calibration import ShearCalibration
from ...measure.correlation import Correlation, jackknife_error
from .galaxy_shapes import GalaxyShapes
from .stack import PsfStack
from .stack_metrics import correlations

#: Fewest densities for a slope: two lie on a line whatever their errors are.
_LEAST_DENSITIES = 3


def shear_bias(e: np.ndarray, shear: np.ndarray) -> ShearCalibration:
    """Return the bias from galaxies under a shear and its opposite, with the same noise (Pujol et al. 2019).

    Shapes and noise cancel in the difference of the two, and so hardly add to the error of m.

    Parameters
    ----------
    e : ndarray of complex, shape [2, n, k]
        Ellipticities e1 + i e2 of n rings of k galaxies, under the shear and its opposite. A ring with a NaN is left
        out.
    shear : ndarray of complex, shape [n]
        g1 + i g2 of each ring, along one of the two axes.
    """
    complete = np.isfinite(e).all(axis=(0, 2))
    mean = e[:, complete].mean(axis=2)
    level, change = 0.5 * (mean[0] + mean[1]), 0.5 * (mean[0] - mean[1])
    biases = []
    for component in (np.real, np.imag):
        g = component(shear[complete])
        along = np.abs(g) > 0.5 * np.abs(shear[complete])
        response = component(change)[along] / g[along]
        c = component(level)
        ends = [(v.mean(), v.std(ddof=1) / np.sqrt(len(v))) if len(v) > 1 else (np.nan, np.nan) for v in (response, c)]
        biases.append((ends[0][0] - 1.0, ends[0][1], *ends[1]))
    m, m_error, c, c_error = np.array(biases).T
    return ShearCalibration(m, m_error, c, c_error, int(complete.sum()))


def psf_leakage(stack: PsfStack, parts: list[GalaxyShapes]) -> dict[str, tuple[float, float]]:
    """Return the part of the PSF's ellipticity that usable galaxies have, with its error, by either PSF.

    The slope through the origin of their ellipticities against that of the true PSF (weighted moments) at the nearest
    place without a star, with an error of a jackknife over tiles.

    Parameters
    ----------
    stack : PsfStack
        PSFs of the stack.
    parts : list of GalaxyShapes
        Galaxies of each tile.
    """
    places = ~stack.star
    tree = cKDTree(np.stack([stack.x, stack.y], axis=1)[places])
    psf = (stack.e1 + 1j * stack.e2)[places]
    nearest = [psf[tree.query(np.stack([tile_galaxies.x, tile_galaxies.y], axis=1))[1]] for tile_galaxies in parts]
    leakage = {}
    for kind, prefix in (("model", ""), ("true", "true_")):
        sums = np.zeros((len(parts), 2))
        for tile_sums, tile_galaxies, at in zip(sums, parts, nearest, strict=True):
            e1, e2, usable = (getattr(tile_galaxies, prefix + name) for name in ("e1", "e2", "usable"))
            e, p = (e1 + 1j * e2)[usable], at[usable]
            tile_sums[:] = (np.conj(p) * e).real.sum(), (np.abs(p) ** 2).sum()
        product, square = (sums.sum(axis=0) - sums).T
        without = product / np.where(square > 0.0, square, np.nan)
        total = sums.sum(axis=0)
        slope = float(total[0] / total[1]) if total[1] > 0.0 else float("nan")
        leakage[kind] = slope, float(jackknife_error(without))
    return leakage


@dataclass(frozen=True, eq=False)
class NullTest:
    """Shear correlations of galaxies in a stack of a number of visits.

    Attributes
    ----------
    visits : int
        Visits in the stack.
    galaxies : GalaxyShapes
        All galaxies.
    density : float
        Usable ones per square arcminute.
    correlations : dict of str to Correlation
        ``model``: ellipticities measured with the PSF of the models; ``true``: with the true PSF; ``difference``: of
        the two, of galaxies that are usable with either.
    calibration : dict of str to ShearCalibration
        Biases of the shear with the PSF of the models and the true one, where they were measured.
    leakage : dict of str to (float, float)
        Part of the PSF's ellipticity that galaxies have, and its error, where it was measured: :func:`psf_leakage`.
    """

    visits: int
    galaxies: GalaxyShapes
    density: float
    correlations: dict[str, Correlation]
    calibration: dict[str, ShearCalibration] = field(default_factory=dict)
    leakage: dict[str, tuple[float, float]] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        visits: int,
        parts: list[GalaxyShapes],
        area: float,
        calibration: dict[str, ShearCalibration] | None = None,
        leakage: dict[str, tuple[float, float]] | None = None,
    ) -> NullTest:
        """Return the test of the galaxies of tiles of an area [arcmin^2], with errors of a jackknife over the tiles."""
        galaxies = GalaxyShapes.joined(parts)
        usable_in_both = galaxies.usable_twice
        kinds = {
            "model": (galaxies.e1, galaxies.e2, galaxies.usable),
            "true": (galaxies.true_e1, galaxies.true_e2, galaxies.true_usable),
            "difference": (galaxies.e1 - galaxies.true_e1, galaxies.e2 - galaxies.true_e2, usable_in_both),
        }
        tile = np.repeat(np.arange(len(parts)), [len(tile_galaxies) for tile_galaxies in parts])
        correlated = correlations(galaxies.x, galaxies.y, kinds, tile)
        return cls(visits, galaxies, float(galaxies.usable.sum() / area), correlated, calibration or {}, leakage or {})


def null_metrics(result: NullTest) -> dict[str, float]:
    """Return the figures of a null test; keys end in their unit."""
    galaxies = result.galaxies
    usable, usable_in_both = galaxies.usable, galaxies.usable_twice
    shift = np.stack([galaxies.e1 - galaxies.true_e1, galaxies.e2 - galaxies.true_e2])[:, usable_in_both]
    metrics: dict[str, float] = {
        "galaxies": len(galaxies),
        "usable": int(usable.sum()),
        "usable_per_arcmin2": result.density,
        "rms_e_component": float(np.sqrt(0.5 * np.mean(galaxies.e1[usable] ** 2 + galaxies.e2[usable] ** 2))),
        "mean_e1_difference": float(shift[0].mean()),
        "mean_e2_difference": float(shift[1].mean()),
        "mean_abs_xi_plus": amplitude(result),
        "shot_noise_xi_plus": shot_noise(result),
    }
    for kind, correlation in result.correlations.items():
        for span in ("short", "long"):
            metrics[f"xi_plus_{kind}_{span}"] = correlation.mean_xi_plus(span)
            metrics[f"xi_plus_{kind}_{span}_error"] = correlation.error_mean_xi_plus(span)
    for kind, (slope, error) in result.leakage.items():
        metrics[f"psf_leakage_{kind}"], metrics[f"psf_leakage_{kind}_error"] = slope, error
    for kind, shear_calibration in result.calibration.items():
        for name in ("m", "c"):
            for k in range(2):
                metrics[f"{name}{k + 1}_{kind}"] = float(getattr(shear_calibration, name)[k])
                metrics[f"{name}{k + 1}_{kind}_error"] = float(getattr(shear_calibration, f"{name}_error")[k])
    return metrics


def amplitude(result: NullTest) -> float:
    """Return the mean absolute value of xi+ over the bins with pairs."""
    return float(np.nanmean(np.abs(result.correlations["model"].xi_plus)))


def shot_noise(result: NullTest) -> float:
    """Return the mean absolute value of xi+ that unrelated ellipticities would have in the same bins.

    The standard deviation of xi+ in a bin of N pairs is sqrt(2) sigma^2 / sqrt(2 N) = sigma^2 / sqrt(N), with the rms
    sigma of a component.
    """
    galaxies, xi = result.galaxies, result.correlations["model"]
    square = 0.5 * float(np.mean(galaxies.e1[galaxies.usable] ** 2 + galaxies.e2[galaxies.usable] ** 2))
    pairs = xi.n_pairs[xi.n_pairs > 0]
    return float(np.sqrt(2.0 / np.pi) * np.mean(np.sqrt(2.0) * square / np.sqrt(pairs)))


class Slope(NamedTuple):
    """Slope of a straight line, with its standard error from the scatter about the line."""

    value: float
    error: float


def density_slope(density: np.ndarray, values: np.ndarray) -> Slope | None:
    """Return the slope of log amplitude against log density; None of fewer than three: no error."""
    if len(np.unique(density)) < _LEAST_DENSITIES:
        return None
    x, y = np.log(density), np.log(values)
    value, level = np.polyfit(x, y, 1)
    scatter = np.sum((y - level - value * x) ** 2) / (len(x) - 2)
    return Slope(float(value), float(np.sqrt(scatter / np.sum((x - x.mean()) ** 2))))
