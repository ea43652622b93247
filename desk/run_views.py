"""The stars of a run, and views of a selection of them; nothing here draws."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..core.errors import DomainError, ProductError, unknown_name
from ..core.statistics import FWHM_PER_RMS, finite_median, rms
from ..core.units import ARCSEC
from ..measure.correlation import Correlation, SeparationBins, shear_correlation
from ..reconstruction.ccd_product import CcdStars, Stars, product_path, read_product
from .views import WhiskersView

#: What is shown of the stars.
KINDS = ("noise-free", "observed", "model", "observed - model", "noise-free - model")
#: Stars whose stamps are shown at once; rows are star, model, star - model.
_STAMPS = 6
#: Shortest separation and number of bins of a correlation [rad].
_SHORTEST = 10.0 * ARCSEC
_BINS = 12
#: Fewest stars of a correlation.
_FEWEST = 20


@dataclass(frozen=True)
class RunState:
    """What is selected of a run: kind of shapes, CCD of the stamps, and range of magnitudes of observed stars."""

    kind: str
    ccd: str
    magnitudes: tuple[float, float]


@dataclass(frozen=True)
class StampsView:
    """Stars of a CCD, the model there, and their difference."""

    image: np.ndarray  #: parts of the brightest pixel of each star, rows star, model, difference from above
    stars: int  #: columns
    side_arcsec: float  #: side of a stamp [arcsec]


class RunBench:
    """The stars of all CCDs of a run."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        paths = sorted(folder.glob("ccd_*.fits")) if folder.is_dir() else []
        if not paths:
            raise ProductError("no run: expected a folder with ccd_*.fits", file=folder)
        self.ccds: dict[str, CcdStars] = {}
        for path in paths:
            product = read_product(path, holdout_images=False)
            self.ccds[product.name] = product.ccd_stars
        self.centers_mm = 1e3 * np.array([stars.center for stars in self.ccds.values()])

    @property
    def start(self) -> RunState:
        """The selection at the beginning: all observed stars less their models, and the first CCD."""
        magnitudes = np.concatenate([stars.observed.magnitude for stars in self.ccds.values()])
        low, high = float(np.floor(np.nanmin(magnitudes))), float(np.ceil(np.nanmax(magnitudes)))
        return RunState(KINDS[1], next(iter(self.ccds)), (low, high))

    def check(self, state: RunState) -> RunState:
        """Return a selection as it is; PachonError where it is none of this run."""
        if state.kind not in KINDS:
            raise unknown_name("kind of shapes", state.kind, KINDS)
        if state.ccd not in self.ccds:
            raise unknown_name("CCD of the run", state.ccd, self.ccds)
        if not state.magnitudes[0] <= state.magnitudes[1]:
            raise DomainError(f"magnitudes = {state.magnitudes}: expected two that rise")
        return state

    def nearest_ccd(self, x_mm: float, y_mm: float) -> str:
        """Return the CCD whose centre is nearest to a place on the detector [mm]."""
        return list(self.ccds)[int(np.argmin(np.hypot(*(self.centers_mm - (x_mm, y_mm)).T)))]

    def selected(self, state: RunState) -> tuple[list[Stars], np.ndarray]:
        """Return the stars of a selection, CCD by CCD, and which of all of them are in it."""
        self.check(state)
        if "noise-free" in state.kind:
            holdouts: list[Stars] = [stars.holdout for stars in self.ccds.values()]
            return holdouts, np.ones(sum(map(len, holdouts)), dtype=bool)
        observed = [stars.observed for stars in self.ccds.values()]
        magnitude = np.concatenate([stars.magnitude for stars in observed])
        return list(observed), (magnitude >= state.magnitudes[0]) & (magnitude <= state.magnitudes[1])


def _columns(bench: RunBench, state: RunState, *names: str) -> list[np.ndarray]:
    """Return columns of the selected stars; those of shapes as the kind has them."""
    stars, chosen = bench.selected(state)

    def column(name: str) -> np.ndarray:
        return np.concatenate([getattr(s, name) for s in stars])[chosen]

    columns = []
    for name in names:
        if name not in ("g1", "g2", "sigma"):
            columns.append(column(name))
        elif state.kind == "model":
            columns.append(column(f"model_{name}"))
        else:
            columns.append(column(name) - (column(f"model_{name}") if "- model" in state.kind else 0.0))
    return columns


def run_whiskers(bench: RunBench, state: RunState) -> WhiskersView:
    """Return the adaptive moments of the selected stars at their places; sizes as FWHM of those Gaussians."""
    x, y, g1, g2, sigma = _columns(bench, state, "x", "y", "g1", "g2", "sigma")
    good = np.isfinite(g1) & np.isfinite(g2)
    title = f"Whiskers, {state.kind}: adaptive moments of {np.count_nonzero(good)} stars"
    fwhm = FWHM_PER_RMS * sigma[good] / ARCSEC
    return WhiskersView(1e3 * x[good], 1e3 * y[good], g1[good], g2[good], fwhm, title)


def run_correlation(bench: RunBench, state: RunState) -> Correlation:
    """Return the correlation function xi+ of the selected ellipticities, those of adaptive moments."""
    x, y, g1, g2 = _columns(bench, state, "field_x", "field_y", "g1", "g2")
    good = np.isfinite(g1) & np.isfinite(g2)
    if np.count_nonzero(good) < _FEWEST:
        raise DomainError(f"{np.count_nonzero(good)} stars are selected: expected {_FEWEST} for a correlation")
    longest = max(float(np.hypot(np.ptp(x[good]), np.ptp(y[good]))), 4.0 * _SHORTEST)
    bins = SeparationBins(_SHORTEST, longest, _BINS)
    return shear_correlation(x[good], y[good], g1[good], g2[good], bins=bins)


def run_stamps(bench: RunBench, state: RunState) -> StampsView:
    """Return stamps of the brightest selected stars of the CCD, with the model at each."""
    bench.check(state)
    path = product_path(bench.folder, state.ccd)
    noise_free = "noise-free" in state.kind
    product = read_product(path, holdout_images=noise_free)
    stars: Stars = product.holdout if noise_free else product.observed
    images = product.holdout_images if noise_free else product.observed_images
    usable = np.isfinite(images).all(axis=(1, 2))
    order = np.arange(len(stars))
    if not noise_free:
        magnitude = product.observed.magnitude
        usable &= (magnitude >= state.magnitudes[0]) & (magnitude <= state.magnitudes[1])
        order = np.argsort(magnitude, kind="stable")
    shown = order[usable[order]][:_STAMPS]
    if not len(shown):
        raise DomainError(f"CCD {state.ccd}: no star is selected")
    model = product.model.at(np.stack([stars.x, stars.y], axis=-1)[shown])
    side = min(images.shape[-1], model.shape[-1])
    star_row, model_row = (_middle(row, side) for row in (images[shown], model))
    # Each star over its own light within the stamp, and all over the peak of its model.
    star_row = star_row * (model_row.sum(axis=(1, 2)) / star_row.sum(axis=(1, 2)))[:, None, None]
    peak = model_row.max(axis=(1, 2))[:, None, None]
    rows = [np.concatenate(list(row / peak), axis=1) for row in (star_row - model_row, model_row, star_row)]
    return StampsView(np.concatenate(rows), len(shown), side * product.pixel_scale / ARCSEC)


def _middle(images: np.ndarray, side: int) -> np.ndarray:
    first = (images.shape[-1] - side) // 2
    return np.asarray(images[:, first : first + side, first : first + side], dtype=np.float64)


def run_numbers(view: WhiskersView, ccds: int) -> dict[str, tuple[float, str]]:
    """Return the numbers of a selection, with their units."""
    table = {"stars": (float(len(view.e1)), ""), "CCDs": (float(ccds), "")}
    if len(view.e1):
        table["adaptive ellipticity g, rms"] = (100.0 * rms(view.e), "%")
        table["FWHM of the adaptive size, median"] = (finite_median(view.fwhm_arcsec), "arcsec")
    return table
