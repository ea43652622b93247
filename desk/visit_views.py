"""The visits of a list, stacks of visits, and views of them; nothing here draws."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..core.errors import ProductError, unknown_name
from ..core.files import parsing
from ..core.number_text import counted
from ..core.statistics import FWHM_PER_RMS, finite_median, rms
from ..core.units import ARCMIN, ARCSEC
from ..measure.correlation import Correlation
from ..studies.night.detector_row import COLUMNS
from ..studies.night.night import VISITS_FOLDER
from ..studies.night.sky_pixels import healpix_module
from ..studies.night.visit_product import VisitProduct
from ..studies.visits.stack import PsfStack
from ..studies.visits.stack_metrics import correlations
from .result_views import PlacesView, SkyMapView
from .views import WhiskersView

#: Columns that are no numbers to look at.
_PLACES = ("visitId", "detector", "band", "ra", "dec", "expMidptMJD")
#: Pixels of a map that are drawn, at most: finer ones are averaged.
_MOST_PIXELS = 6000
#: Beginning of the names of maps.
_MAP = "deepCoadd_"
#: What stands in them between the quantity and its reduction.
_BETWEEN = "_consolidated_map_"
#: Choice of all visits, or of all bands.
ALL = "all"


@dataclass(frozen=True)
class NightState:
    """What is shown of a night."""

    band: str  #: or :data:`ALL`
    visit: str  #: number, or :data:`ALL`
    column: str


class NightBench:
    """The finished visits of a night: a row for each visit and CCD.

    Parameters
    ----------
    folder : Path
        Folder that ``pachon visits --list`` wrote.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        paths = [path for path in sorted((folder / VISITS_FOLDER).glob("visit_*.fits")) if "_ccd_" not in path.name]
        #: Products by the number of the visit, in the order of time; those that failed are left out.
        self.visits: dict[str, VisitProduct] = {}
        self.failed = 0
        products = []
        for path in paths:
            with parsing(path, "no product of a visit", ProductError):
                products.append(VisitProduct.read(path))
        self.failed = sum(bool(product.reason) for product in products)
        good = [product for product in products if not product.reason]
        for product in sorted(good, key=lambda product: float(product.detectors["expMidptMJD"][0])):
            self.visits[str(product.visit)] = product
        if not self.visits:
            raise ProductError("no visit is finished: expected visits/visit_*.fits", file=folder)
        self.bands = tuple(dict.fromkeys(product.band for product in self.visits.values()))
        self.columns = tuple(
            name
            for name in COLUMNS
            if name not in _PLACES
            and any(np.isfinite(product.detectors[name]).any() for product in self.visits.values())
        )
        ra, dec = (np.concatenate([v.detectors[name] for v in self.visits.values()]) for name in ("ra", "dec"))
        #: Middle of all CCDs on the sky, right ascension and declination [deg].
        self.center = math.degrees(float(np.angle(np.exp(1j * np.deg2rad(ra)).mean()))), float(np.median(dec))
        files = {_map_name(path): path for path in sorted(folder.glob(f"{_MAP}*{_BETWEEN}*.hsp"))}
        #: Files of the maps by quantity and band, sizes of PSFs first.
        self.maps = dict(sorted(files.items(), key=lambda item: not item[0].startswith("psf_size")))

    @property
    def start(self) -> NightState:
        """All visits, by the width of their PSFs."""
        return NightState(ALL, ALL, "psfSigma")

    def shown(self, state: NightState) -> dict[str, VisitProduct]:
        """Return the visits of the band of a state, in the order of time."""
        return {key: visit for key, visit in self.visits.items() if state.band in (ALL, visit.band)}

    def label(self, column: str) -> str:
        """Return the name of a column with its unit."""
        unit = COLUMNS[column][0]
        return f"{column} [{unit}]" if unit else column

    def sky(self, state: NightState) -> PlacesView:
        """Return a column at the middles of the CCDs on the sky [deg], of the visit or of all of the band."""
        visits = self.shown(state)
        products = list(visits.values()) if state.visit == ALL else [visits[state.visit]]
        ra, dec, value = (
            np.concatenate([product.detectors[name] for product in products]) for name in ("ra", "dec", state.column)
        )
        count = counted(len(products), "visit")
        what = count if state.visit == ALL else f"visit {state.visit}, {products[0].band}"
        return PlacesView(self._near(ra), dec, value, self.label(state.column), f"{state.column} on the sky, {what}")

    def map(self, name: str) -> SkyMapView:
        """Return a map; ProductError where it is damaged, ConfigError where the package that reads it is missing."""
        if name not in self.maps:
            raise unknown_name("map", name, self.maps)
        hpgeom, path = healpix_module(), self.maps[name]
        import healsparse

        with parsing(path, "damaged or no map", ProductError):
            content = healsparse.HealSparseMap.read(str(path))
            nside = content.nside_sparse
            while content.n_valid > _MOST_PIXELS and nside > content.nside_coverage:
                nside //= 2
                content = content.degrade(nside)
            pixels = content.valid_pixels
            ra, dec = hpgeom.boundaries(nside, pixels, nest=True)
            unit = str((content.metadata or {}).get("BUNIT", ""))
            values = np.asarray(content.get_values_pix(pixels), dtype=float)
        label = f"{name} [{unit}]" if unit else name
        return SkyMapView(self._near(ra), dec, values, label, f"{name}: {len(pixels)} pixels, nside {nside}")

    def _near(self, ra: np.ndarray) -> np.ndarray:
        """Return right ascensions [deg] within half a turn of the middle."""
        middle = self.center[0] % 360.0
        return middle + (ra - middle + 180.0) % 360.0 - 180.0

    def times(self, state: NightState) -> PlacesView:
        """Return the medians of a column over the CCDs of each visit of the band, against hours of the first one."""
        products = list(self.shown(state).values())
        start = float(next(iter(self.visits.values())).detectors["expMidptMJD"][0])
        hours = np.array([24.0 * (float(product.detectors["expMidptMJD"][0]) - start) for product in products])
        value = np.array([finite_median(product.detectors[state.column]) for product in products])
        return PlacesView(hours, value, value, self.label(state.column), f"{state.column}, median over CCDs, by visit")

    def numbers(self, state: NightState) -> dict[str, tuple[float, str]]:
        """Return the numbers of what is shown."""
        view, unit = self.sky(state), COLUMNS[state.column][0]
        table = {"visits": (float(len(self.shown(state))), ""), "CCDs shown": (float(len(view.value)), "")}
        finite = view.value[np.isfinite(view.value)]
        if len(finite):
            for name, reduce in (("least", np.min), ("median", np.median), ("largest", np.max)):
                table[f"{state.column}, {name}"] = (float(reduce(finite)), unit)
        if self.failed:
            table["visits that failed"] = (float(self.failed), "")
        return table


def _map_name(path: Path) -> str:
    """Return quantity and band of the file of a map, such as ``psf_size, r``."""
    quantity, _, ending = path.stem.removeprefix(_MAP).partition(_BETWEEN)
    reduced, _, band = ending.rpartition("_")
    return f"{quantity} {reduced}, {band}" if quantity == "epoch" else f"{quantity}, {band}"


def is_night(folder: Path) -> bool:
    """Return whether a folder has products of the visits of a list."""
    return (folder / VISITS_FOLDER).is_dir()


def stacks_in(folder: Path) -> list[Path]:
    """Return the stacks of visits in a folder, that of the fewest first."""
    return sorted(folder.glob("stack_[0-9]*.fits"))


#: Kinds of ellipticities of stacks.
STACK_KINDS = ("PSF", "mean of the models", "PSF - model")


class StackBench:
    """Stacks of visits at points of the sky.

    Parameters
    ----------
    folder : Path
        Folder that ``pachon visits`` wrote.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        stacks = [PsfStack.read(path) for path in stacks_in(folder)]
        #: Stacks by their number of visits.
        self.stacks = {str(stack.visits): stack for stack in sorted(stacks, key=lambda stack: stack.visits)}

    def whiskers(self, visits: str, kind: str) -> WhiskersView:
        """Return adaptive moments along the axes of a stack; places in arcmin, widths by the weighted size."""
        stack, (g1, g2) = self.stacks[visits], self._ellipticity(visits, kind)
        size = {STACK_KINDS[0]: stack.size, STACK_KINDS[1]: stack.model_size}.get(kind, stack.size - stack.model_size)
        good = np.isfinite(g1) & np.isfinite(g2)
        fwhm = FWHM_PER_RMS * size[good] / ARCSEC
        title = f"Stack of {counted(int(visits), 'visit')}, {kind}: {counted(int(np.count_nonzero(good)), 'point')}"
        return WhiskersView(stack.x[good] / ARCMIN, stack.y[good] / ARCMIN, g1[good], g2[good], fwhm, title)

    def correlation(self, visits: str, kind: str) -> Correlation:
        """Return xi+ of the ellipticities that are shown."""
        stack, (g1, g2) = self.stacks[visits], self._ellipticity(visits, kind)
        rows = np.isfinite(g1) & np.isfinite(g2)
        found = correlations(stack.x, stack.y, {kind: (g1, g2, rows)}, np.zeros(len(stack), dtype=int))
        return found[kind]

    def _ellipticity(self, visits: str, kind: str) -> tuple[np.ndarray, np.ndarray]:
        if kind not in STACK_KINDS:
            raise unknown_name("kind of ellipticities", kind, STACK_KINDS)
        stack = self.stacks[visits]
        if kind == STACK_KINDS[0]:
            return stack.g1, stack.g2
        if kind == STACK_KINDS[1]:
            return stack.model_g1, stack.model_g2
        return stack.g1 - stack.model_g1, stack.g2 - stack.model_g2

    def numbers(self, visits: str, kind: str) -> dict[str, tuple[float, str]]:
        """Return the numbers of what is shown."""
        view = self.whiskers(visits, kind)
        table = {"points": (float(len(view.e1)), ""), "visits": (float(visits), "")}
        if len(view.e1):
            table["adaptive ellipticity g, rms"] = (100.0 * rms(view.e), "%")
        return table
