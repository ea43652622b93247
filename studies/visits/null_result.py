"""Result of a null test: shear correlations, densities, biases."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ...measure.catalogue.shear_calibration import ShearCalibration
from ...measure.correlation import Correlation, jackknife_error
from ...measure.shear.shear_shapes import ShearBias, ShearShapes, shear_of_sums
from .galaxy_shapes import GalaxyShapes
from .psf_errors import PsfAtGalaxies
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


@dataclass(frozen=True)
class AdditiveBias:
    """Shear of galaxies without shear as a part of the ellipticity of their PSF, and of that of the models' errors.

    Slopes through the origin at the nearest place without a star, with errors of a jackknife over quarters of tiles:
    each a pair of the value and its error, NaN where there are too few galaxies. Ellipticities of PSFs are g of
    adaptive moments.

    Attributes
    ----------
    alpha_model, alpha_true : (float, float)
        Of the shear measured with the PSF of the models against the g of that PSF, and with the true PSF against that
        of the true one.
    beta : (float, float)
        Of the difference of both shears against that of the g of the true PSF and the model.
    beta_expected : (float, float)
        Of the shear that the errors of the models leave to first order against the same.
    agreement : (float, float)
        Of the difference of both shears against the shear that the errors leave to first order: 1.
    """

    alpha_model: tuple[float, float]
    alpha_true: tuple[float, float]
    beta: tuple[float, float]
    beta_expected: tuple[float, float]
    agreement: tuple[float, float]

    @classmethod
    def of(cls, psfs: PsfAtGalaxies, parts: list[GalaxyShapes]) -> AdditiveBias:
        """Compare the galaxies of tiles with their PSFs."""
        joined = GalaxyShapes.joined(parts)
        patch = np.concatenate([4 * k + _quarters(shapes) for k, shapes in enumerate(parts)])
        by_model, by_true = (galaxy_shears(shapes) for shapes in (joined.shear, joined.true_shear))
        difference, psf_error = by_model - by_true, psfs.true - psfs.model
        # At the galaxies that the difference has.
        expected = np.where(np.isfinite(difference), psfs.expected_shear, np.nan)
        return cls(
            _slope(by_model, psfs.model, patch),
            _slope(by_true, psfs.true, patch),
            _slope(difference, psf_error, patch),
            _slope(expected, psf_error, patch),
            _slope(difference, psfs.expected_shear, patch),
        )


def _quarters(shapes: GalaxyShapes) -> np.ndarray:
    """Return the quarter of a tile that each galaxy is in, 0 to 3."""
    if not len(shapes):
        return np.zeros(0, dtype=np.int64)
    return (shapes.x > np.median(shapes.x)) + 2 * (shapes.y > np.median(shapes.y))


def _slope(shear: np.ndarray, e: np.ndarray, patch: np.ndarray) -> tuple[float, float]:
    """Return the slope of complex shears against ellipticities, and its error of a jackknife over patches."""
    selected = np.isfinite(shear) & np.isfinite(e)
    _, labels = np.unique(patch[selected], return_inverse=True)
    product, square = (np.conj(e) * shear).real[selected], (np.abs(e) ** 2)[selected]
    sums = np.stack([np.bincount(labels, values) for values in (product, square)], axis=1)
    if len(sums) < 2:
        return float("nan"), float("nan")
    total = sums.sum(axis=0)
    without = total - sums
    with np.errstate(divide="ignore", invalid="ignore"):
        return float(total[0] / total[1]), float(jackknife_error(without[:, 0] / without[:, 1]))


def galaxy_shears(shapes: ShearShapes) -> np.ndarray:
    """Return weighted ellipticities over the mean response, g1 + i g2 [n], whose mean is the shear.

    Galaxies that the selection leaves out are NaN; the mean is over the others.
    """
    selected = shapes.weight > 0.0
    mean = shapes.sums[selected].mean(axis=0) if selected.any() else np.full(5, np.nan)
    rows = np.where(selected[:, None], shapes.sums, np.nan)
    rows[:, 2:] = mean[2:]
    g1, g2 = shear_of_sums(rows).T
    return np.asarray(g1 + 1j * g2)


@dataclass(frozen=True)
class ShearBiases:
    """Biases of the shear of a null test.

    Attributes
    ----------
    gaussian : dict of str to ShearCalibration
        Of ellipticities of Gaussians, with the PSF of the models and with the true one.
    functionals : dict of str to ShearBias
        Of the functionals.
    additive : AdditiveBias
        Of the functionals, as a part of the ellipticity of the PSF.
    """

    gaussian: dict[str, ShearCalibration]
    functionals: dict[str, ShearBias]
    additive: AdditiveBias


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
    shear_correlations : dict of str to Correlation
        The same of the shears of the functionals; where their PSFs are known, ``expected``: of the shears that errors
        of the models leave to first order, and ``psf_error``: of the errors of g of the PSFs at these galaxies.
    biases : ShearBiases, optional
        Biases of the shear, where they were measured.
    """

    visits: int
    galaxies: GalaxyShapes
    density: float
    correlations: dict[str, Correlation]
    shear_correlations: dict[str, Correlation]
    biases: ShearBiases | None = None

    @classmethod
    def of(
        cls,
        visits: int,
        parts: list[GalaxyShapes],
        area: float,
        biases: ShearBiases | None = None,
        psfs: PsfAtGalaxies | None = None,
    ) -> NullTest:
        """Return the test of the galaxies of tiles of an area [arcmin^2], with errors of a jackknife over the tiles."""
        galaxies = GalaxyShapes.joined(parts)
        kinds = {
            "model": (galaxies.e1, galaxies.e2, galaxies.usable),
            "true": (galaxies.true_e1, galaxies.true_e2, galaxies.true_usable),
            "difference": (galaxies.e1 - galaxies.true_e1, galaxies.e2 - galaxies.true_e2, galaxies.usable_twice),
        }
        by_model, by_true = (galaxy_shears(shapes) for shapes in (galaxies.shear, galaxies.true_shear))
        shears = {"model": by_model, "true": by_true, "difference": by_model - by_true}
        if psfs is not None:
            # At the galaxies that the difference has.
            measured = np.where(np.isfinite(shears["difference"]), 1.0, np.nan)
            of_psfs = {"expected": measured * psfs.expected_shear, "psf_error": measured * (psfs.true - psfs.model)}
            shears |= {kind: g for kind, g in of_psfs.items() if np.isfinite(g).sum() > 1}
        shear_kinds = {kind: (g.real, g.imag, np.isfinite(g)) for kind, g in shears.items()}
        tile = np.repeat(np.arange(len(parts)), [len(tile_galaxies) for tile_galaxies in parts])
        correlated = correlations(galaxies.x, galaxies.y, kinds, tile)
        several = all(rows.sum() > 1 for _, _, rows in shear_kinds.values())
        shear_correlated = correlations(galaxies.x, galaxies.y, shear_kinds, tile) if several else {}
        return cls(visits, galaxies, float(galaxies.usable.sum() / area), correlated, shear_correlated, biases)


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
    metrics |= _shear_metrics(result)
    if result.biases is None:
        return metrics
    for prefix, biases in (("", result.biases.gaussian), ("shear_", result.biases.functionals)):
        for kind, bias in biases.items():
            for name in ("m", "c"):
                for k in range(2):
                    metrics[f"{prefix}{name}{k + 1}_{kind}"] = float(getattr(bias, name)[k])
                    metrics[f"{prefix}{name}{k + 1}_{kind}_error"] = float(getattr(bias, f"{name}_error")[k])
    for name in ("alpha_model", "alpha_true", "beta", "beta_expected", "agreement"):
        value, error = getattr(result.biases.additive, name)
        metrics[f"shear_{name}"], metrics[f"shear_{name}_error"] = value, error
    return metrics


def _shear_metrics(result: NullTest) -> dict[str, float]:
    """Return the figures of the shears of the functionals."""
    by_model, by_true = (galaxy_shears(shapes) for shapes in (result.galaxies.shear, result.galaxies.true_shear))
    selected = result.galaxies.shear.weight > 0.0
    metrics: dict[str, float] = {
        "shear_galaxies": int(selected.sum()),
        "rms_shear_component": float(np.sqrt(0.5 * np.nanmean(np.abs(by_model) ** 2))) if selected.any() else np.nan,
    }
    difference = by_model - by_true
    finite = np.isfinite(difference)
    for name, values in (("g1", difference.real), ("g2", difference.imag)):
        metrics[f"mean_{name}_difference"] = float(values[finite].mean()) if finite.any() else np.nan
    for kind, correlation in result.shear_correlations.items():
        for span in ("short", "long"):
            metrics[f"shear_xi_plus_{kind}_{span}"] = correlation.mean_xi_plus(span)
            metrics[f"shear_xi_plus_{kind}_{span}_error"] = correlation.error_mean_xi_plus(span)
    return metrics


def amplitude(result: NullTest) -> float:
    """Return the mean absolute value of xi+ over the bins with pairs."""
    return float(np.nanmean(np.abs(result.correlations["model"].xi_plus)))


def shot_noise(result: NullTest) -> float:
    """Return the mean absolute value of xi+ that unrelated ellipticities would have in the same bins.

    The standard deviation of xi+ in a bin of N pairs is sqrt(2) sigma^2 / sqrt(N), with the rms sigma of a component.
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
