"""What a sweep measures at each point: figures of one experiment, by name.

All stars are without noise, at places that do not depend on the point, but for the reconstruction, which looks at them
through noise as a run does.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from ...core.errors import ConfigError, unknown_name
from ...design.images.encircled_energy import energy_curve
from ...pipeline.experiment import Experiment
from ...pipeline.measure.correlation import Correlation, shear_correlation
from ...pipeline.measure.shapes import Shapes, measure_shapes
from ...pipeline.measure.summary import (
    LONG_RANGE,
    LONGEST_ARCMIN,
    SHORTEST_ARCMIN,
    correlations,
    mean_xi_plus,
    run_figures,
)
from ...pipeline.psf_model.polynomial import design_matrix
from ...pipeline.simulate.ccd_exposure import (
    Exposed,
    expose_ccd,
    expose_places,
    truth_places,
)
from ...pipeline.simulate.ccd_model import model_ccd
from ...pipeline.simulate.photometry import ARCSEC, effective_fwhm
from ...wavefront.opd import wavefront_opd
from ...wavefront.zernike import fit_zernikes

#: Rings of field angle in which the mean ellipticity is given [deg].
RINGS = ((0.0, 0.5), (0.5, 1.0), (1.0, 1.5), (1.5, 1.8))
#: Zernike terms of the wavefront that are given, Noll.
ZERNIKES = tuple(range(4, 12))
_BINS = 15
_ARCMIN = 60.0 * ARCSEC
# CCDs are neighbours where their centres are no farther apart than this, over the side of a CCD.
_NEIGHBOUR = 1.08
# Fit of ellipticity within a CCD, by which it is carried to the border.
_BORDER_ORDER = 2


@dataclass(frozen=True)
class _Scene:
    """The stars of one point; what several metrics need is computed once."""

    experiment: Experiment
    threads: int

    @cached_property
    def names(self) -> tuple[str, ...]:
        return self.experiment.config.ccds or ()

    @cached_property
    def places(self) -> list[np.ndarray]:
        """Places on the detector [m] of each CCD."""
        return [truth_places(self.experiment, name) for name in self.names]

    @cached_property
    def stars(self) -> Exposed:
        return expose_places(self.experiment, np.concatenate(self.places), self.threads)

    @cached_property
    def shapes(self) -> Shapes:
        return measure_shapes(self.stars.image, self.stars.pixel_scale, self.experiment.weight_fwhm)

    @cached_property
    def correlation(self) -> Correlation:
        fields, shapes = self.stars.fields, self.shapes
        longest = max(float(np.hypot(*np.ptp(fields, axis=0))), 2.0 * SHORTEST_ARCMIN * _ARCMIN)
        (x, y), shortest = fields.T, SHORTEST_ARCMIN * _ARCMIN
        return shear_correlation(x, y, shapes.e1, shapes.e2, min_sep=shortest, max_sep=longest, n_bins=_BINS)


def _fwhm(scene: _Scene) -> dict[str, float]:
    stars = scene.stars
    return {"fwhm_arcsec": effective_fwhm(stars.image, stars.pixel_scale) / ARCSEC}


def _rms_e(scene: _Scene) -> dict[str, float]:
    e = np.stack([scene.shapes.e1, scene.shapes.e2])
    return {"rms_e": float(np.sqrt(np.nanmean(e**2))), "mean_e": float(np.nanmean(np.hypot(*e)))}


def _e_rings(scene: _Scene) -> dict[str, float]:
    radius = np.rad2deg(np.hypot(*scene.stars.fields.T))
    size = np.hypot(scene.shapes.e1, scene.shapes.e2)
    figures = {}
    for low, high in RINGS:
        inside = size[(radius >= low) & (radius < high) & np.isfinite(size)]
        figures[f"mean_e_{low:g}_to_{high:g}_deg"] = float(inside.mean()) if inside.size else np.nan
    return figures


def _border_jump(scene: _Scene) -> dict[str, float]:
    """Root mean square, per component, of the jump of e across the middles of borders between neighbours."""
    camera = scene.experiment.camera
    centers = camera.centers[[camera.ccd_index(name) for name in scene.names]]
    pairs = np.array(sorted(cKDTree(centers).query_pairs(_NEIGHBOUR * camera.ccd_size))).reshape(-1, 2)
    if not len(pairs):
        return {"border_jump_e": np.nan}
    middles = centers[pairs].mean(axis=1)
    first = np.cumsum([0, *map(len, scene.places)])
    # Ellipticity on either side of each border, carried there by a fit within the CCD.
    sides = np.full((len(pairs), 2, 2), np.nan)
    for k, places in enumerate(scene.places):
        stars = slice(first[k], first[k + 1])
        e = np.stack([scene.shapes.e1[stars], scene.shapes.e2[stars]], axis=1)
        good, borders = np.isfinite(e).all(axis=1), pairs == k
        (x, y), half = centers[k], camera.half_size
        extent = (x - half, x + half, y - half, y + half)
        points = np.concatenate([places[good], middles[borders.any(axis=1)]])
        terms = design_matrix(points, extent, _BORDER_ORDER)
        if good.sum() >= terms.shape[1]:
            sides[borders] = terms[good.sum() :] @ np.linalg.lstsq(terms[: good.sum()], e[good], rcond=None)[0]
    jumps = sides[:, 0] - sides[:, 1]
    return {"border_jump_e": float(np.sqrt(np.nanmean(np.square(jumps))))}


def _xi_raw(scene: _Scene) -> dict[str, float]:
    return {
        "xi_raw_short": mean_xi_plus(scene.correlation, 0.0, LONG_RANGE),
        "xi_raw_long": mean_xi_plus(scene.correlation, LONG_RANGE, LONGEST_ARCMIN),
    }


def _xi_bins(scene: _Scene) -> dict[str, float]:
    found = scene.correlation
    plus = {f"xi_plus_{r:.3g}_arcmin": float(v) for r, v in zip(found.r_arcmin, found.xi_plus, strict=True)}
    minus = {f"xi_minus_{r:.3g}_arcmin": float(v) for r, v in zip(found.r_arcmin, found.xi_minus, strict=True)}
    return plus | minus


def _reconstruction(scene: _Scene) -> dict[str, float]:
    """Look at stars through noise and model each CCD as a run does, and return what the models leave."""
    products = [
        model_ccd(scene.experiment, expose_ccd(scene.experiment, name, threads=scene.threads)) for name in scene.names
    ]
    found = correlations(products)
    together = run_figures(products, found)["all"]
    figures = {
        f"xi_{kind}_{name}": mean_xi_plus(found[kind], *bounds)
        for kind in ("residual", "away")
        for name, bounds in {"short": (0.0, LONG_RANGE), "long": (LONG_RANGE, LONGEST_ARCMIN)}.items()
    }
    return figures | {key: float(together[key]) for key in ("rms_residual_at_stars", "rms_residual_away")}


def _ee80(scene: _Scene) -> dict[str, float]:
    """Radius that holds 80 % of the light of a stamp, of the mean star."""
    mean = scene.stars.image.astype(np.float64).mean(axis=0)
    radii, within = energy_curve(mean)
    radius = float(np.interp(0.8 * mean.sum(), within, radii))
    return {"ee80_arcsec": radius * scene.stars.pixel_scale / ARCSEC}


def _throughput(scene: _Scene) -> dict[str, float]:
    light = scene.stars.light
    return {"throughput_mean": float(light.mean()), "throughput_min": float(light.min())}


def _zernikes(scene: _Scene) -> dict[str, float]:
    """Root mean square over the field of each term of the wavefront, at five fields to the edge on either axis."""
    telescope = scene.experiment.telescope
    angles = telescope.field_radius * np.array([0.0, 0.5, 0.95])
    fields = {(0.0, 0.0), *((a, 0.0) for a in angles), *((0.0, a) for a in angles)}
    wavelength = float(scene.experiment.wavelengths[len(scene.experiment.wavelengths) // 2])
    found = []
    for field in sorted(fields):
        opd = wavefront_opd(telescope, field, wavelength, grid=48, threads=scene.threads)
        fit = fit_zernikes(opd, 0.5 * telescope.pupil_diameter, telescope.pupil_obscuration, jmax=22)
        found.append(fit.coefficients)
    rms = np.sqrt(np.mean(np.square(found), axis=0)) * 1e9
    return {f"Z{j}_nm": float(rms[j - 1]) for j in ZERNIKES}


_METRICS: dict[str, Callable[[_Scene], dict[str, float]]] = {
    "fwhm": _fwhm,
    "rms_e": _rms_e,
    "e_rings": _e_rings,
    "border_jump": _border_jump,
    "xi_raw": _xi_raw,
    "xi_bins": _xi_bins,
    "reconstruction": _reconstruction,
    "ee80": _ee80,
    "throughput": _throughput,
    "zernikes": _zernikes,
}
#: Names of all metrics.
METRICS = tuple(_METRICS)


def check_metrics(names: Sequence[str]) -> None:
    """Raise an error that names the first metric that does not exist."""
    if not names:
        raise ConfigError(f"metrics = []: expected some of {', '.join(METRICS)}")
    for name in names:
        if name not in METRICS:
            raise unknown_name("metric", name, METRICS)


def measure_metrics(experiment: Experiment, names: Sequence[str], threads: int) -> dict[str, float]:
    """Return the figures of one experiment.

    Parameters
    ----------
    experiment : Experiment
        Telescope, focal plane, atmosphere and settings.
    names : sequence of str
        What to measure, of :data:`METRICS`; each gives one or several figures.
    threads : int
        Number of threads; no byte depends on it.

    Raises
    ------
    PachonError
        If something cannot be computed.
    """
    scene = _Scene(experiment, threads)
    figures: dict[str, float] = {}
    for name in dict.fromkeys(names):
        figures |= _METRICS[name](scene)
    return figures
