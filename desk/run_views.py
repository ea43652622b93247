"""The stars of a run, and views of a selection of them; nothing here draws."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..core.errors import DomainError, ProductError, unknown_name
from ..core.number_text import counted
from ..core.statistics import FWHM_PER_RMS, finite_median, rms
from ..core.units import ARCSEC
from ..measure.correlation import Correlation, SeparationBins, shear_correlation
from ..reconstruction.ccd_product import CcdStars, ObservedStars, Stars, product_path, read_product
from .result_views import RowsView
from .views import WhiskersView

#: What is shown of the stars, and the model that is taken off, by the beginning of its columns.
KINDS = {
    "noise-free": "",
    "observed": "",
    "model": "",
    "observed - model": "model_",
    "observed - model without the star": "leave_one_out_",
    "noise-free - model": "model_",
}
#: The same of runs with a model of the whole focal plane.
CCD_KINDS = {"observed - model of the CCD alone": "ccd_", "noise-free - model of the CCD alone": "ccd_"}
#: Stars whose stamps are shown at once; rows are star, model, star - model.
_STAMPS = 6
#: Components of a PSF model that are shown, the first.
_COMPONENTS = 7
#: Shortest separation and number of bins of a correlation [rad].
_SHORTEST = 10.0 * ARCSEC
_BINS = 12
#: Fewest stars of a correlation.
_FEWEST = 20


@dataclass(frozen=True)
class RunState:
    """What is selected of a run."""

    kind: str  #: of shapes
    ccd: str  #: of the stamps
    magnitudes: tuple[float, float]  #: range of observed stars
    x_mm: tuple[float, float]  #: range of places on the detector
    y_mm: tuple[float, float]


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
        #: Kinds of shapes, and the beginning of the columns of the model that is taken off.
        self.kinds = KINDS | (CCD_KINDS if all(stars.has_focal_plane_model for stars in self.ccds.values()) else {})

    @property
    def start(self) -> RunState:
        """The selection at the beginning: all observed stars, and the first CCD."""
        magnitudes = np.concatenate([stars.observed.magnitude for stars in self.ccds.values()])
        low, high = float(np.floor(np.nanmin(magnitudes))), float(np.ceil(np.nanmax(magnitudes)))
        places = np.concatenate(
            [1e3 * np.stack([s.x, s.y]) for c in self.ccds.values() for s in (c.observed, c.holdout)], axis=1
        )
        x_mm, y_mm = ((float(np.floor(axis.min())), float(np.ceil(axis.max()))) for axis in places)
        return RunState("observed", next(iter(self.ccds)), (low, high), x_mm, y_mm)

    def check(self, state: RunState) -> RunState:
        """Return a selection as it is; PachonError where it is none of this run."""
        if state.kind not in self.kinds:
            raise unknown_name("kind of shapes", state.kind, self.kinds)
        if state.ccd not in self.ccds:
            raise unknown_name("CCD of the run", state.ccd, self.ccds)
        for name in ("magnitudes", "x_mm", "y_mm"):
            low, high = getattr(state, name)
            if not low <= high:
                raise DomainError(f"{name} = {(low, high)}: expected two that rise")
        return state

    def nearest_ccd(self, x_mm: float, y_mm: float) -> str:
        """Return the CCD whose centre is nearest to a place on the detector [mm]."""
        return list(self.ccds)[int(np.argmin(np.hypot(*(self.centers_mm - (x_mm, y_mm)).T)))]

    def selected(self, state: RunState) -> tuple[list[Stars], np.ndarray]:
        """Return the stars of the kind of a selection, CCD by CCD, and which of all of them are in it."""
        self.check(state)
        if state.kind.startswith("noise-free"):
            stars: list[Stars] = [ccd.holdout for ccd in self.ccds.values()]
        else:
            stars = [ccd.observed for ccd in self.ccds.values()]
        return stars, np.concatenate([_in_ranges(of_ccd, state) for of_ccd in stars])


def _in_ranges(stars: Stars, state: RunState) -> np.ndarray:
    """Return which stars are within the ranges of places and magnitudes; noise-free ones have no magnitude."""
    inside = np.ones(len(stars), dtype=bool)
    ranges = [(1e3 * stars.x, state.x_mm), (1e3 * stars.y, state.y_mm)]
    if isinstance(stars, ObservedStars):
        ranges.append((stars.magnitude, state.magnitudes))
    for values, (low, high) in ranges:
        inside &= (values >= low) & (values <= high)
    return inside


def _columns(bench: RunBench, state: RunState, *names: str) -> list[np.ndarray]:
    """Return columns of the selected stars; those of shapes as the kind has them."""
    stars, chosen = bench.selected(state)

    def column(name: str) -> np.ndarray:
        return np.concatenate([getattr(s, name) for s in stars])[chosen]

    columns = []
    for name in names:
        subtracted = bench.kinds[state.kind]
        if name not in ("g1", "g2", "sigma"):
            columns.append(column(name))
        elif state.kind == "model":
            columns.append(column(f"model_{name}"))
        else:
            columns.append(column(name) - (column(f"{subtracted}{name}") if subtracted else 0.0))
    return columns


def run_whiskers(bench: RunBench, state: RunState) -> WhiskersView:
    """Return the adaptive moments of the selected stars at their places; sizes as FWHM of those Gaussians."""
    x, y, g1, g2, sigma = _columns(bench, state, "x", "y", "g1", "g2", "sigma")
    good = np.isfinite(g1) & np.isfinite(g2)
    title = f"Whiskers, {state.kind}: adaptive moments of {counted(int(np.count_nonzero(good)), 'star')}"
    fwhm = FWHM_PER_RMS * sigma[good] / ARCSEC
    return WhiskersView(1e3 * x[good], 1e3 * y[good], g1[good], g2[good], fwhm, title)


def run_correlation(bench: RunBench, state: RunState) -> Correlation:
    """Return the correlation function xi+ of the selected ellipticities, those of adaptive moments."""
    x, y, g1, g2 = _columns(bench, state, "field_x", "field_y", "g1", "g2")
    good = np.isfinite(g1) & np.isfinite(g2)
    if np.count_nonzero(good) < _FEWEST:
        stars = counted(int(np.count_nonzero(good)), "star is", "stars are")
        raise DomainError(f"{stars} selected: expected {_FEWEST} for a correlation")
    longest = max(float(np.hypot(np.ptp(x[good]), np.ptp(y[good]))), 4.0 * _SHORTEST)
    bins = SeparationBins(_SHORTEST, longest, _BINS)
    return shear_correlation(x[good], y[good], g1[good], g2[good], bins=bins)


def run_stamps(bench: RunBench, state: RunState) -> RowsView:
    """Return stamps of the brightest selected stars of the CCD, with the model at each."""
    bench.check(state)
    path = product_path(bench.folder, state.ccd)
    noise_free = "noise-free" in state.kind
    product = read_product(path, holdout_images=noise_free)
    stars: Stars = product.holdout if noise_free else product.observed
    images = product.holdout_images if noise_free else product.observed_images
    usable = np.isfinite(images).all(axis=(1, 2)) & _in_ranges(stars, state)
    order = np.arange(len(stars)) if noise_free else np.argsort(product.observed.magnitude, kind="stable")
    shown = order[usable[order]][:_STAMPS]
    if not len(shown):
        raise DomainError(f"CCD {state.ccd}: no star is selected")
    model = product.model.at(np.stack([stars.x, stars.y], axis=-1)[shown])
    side = min(images.shape[-1], model.shape[-1])
    star_row, model_row = (_middle(row, side) for row in (images[shown], model))
    # Each star over its own light within the stamp, and all over the peak of its model.
    star_row = star_row * (model_row.sum(axis=(1, 2)) / star_row.sum(axis=(1, 2)))[:, None, None]
    peak = model_row.max(axis=(1, 2))[:, None, None]
    rows = {
        "star": star_row / peak,
        "model": model_row / peak,
        "star - model": (star_row - model_row) / peak,
    }
    title = f"{state.ccd}: the first {counted(len(shown), 'star')} of the selection"
    return RowsView(rows, side * product.pixel_scale / ARCSEC, title)


def run_components(bench: RunBench, state: RunState) -> RowsView:
    """Return mean and first components of the PSF model of the CCD, eigen-PSFs where the basis is that of the stars."""
    bench.check(state)
    product = read_product(product_path(bench.folder, state.ccd), holdout_images=False)
    model = product.model
    count = min(_COMPONENTS, model.n_components) if model.basis.kind.has_components else 0
    images = np.stack([model.mean, *model.components[:count]])
    row = images / np.abs(images).max(axis=(1, 2), keepdims=True)
    title = f"{state.ccd}: mean of the PSF model"
    if count:
        explained = 100.0 * model.explained
        title += (
            f" and {count} of {model.n_components} components, {model.basis.name}: {explained:.1f} % of the variance"
        )
    return RowsView({"": row}, model.mean.shape[0] * product.pixel_scale / ARCSEC, title)


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
