"""HealSparse maps of what a night has seen: PSF, depth, time and epochs, named as LSST's data previews name them."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from ...core.files import write_bytes
from ...core.products import Stamp
from .detector_row import LIMIT_SNR, NANOJANSKY
from .visit_product import VisitProduct

#: Resolution of the coverage of a map, that of LSST's.
_COVERAGE = 32
#: Sums that are kept of each pixel.
_SUMS = ("time", "count", "weight", "noise", "sigma", "g1", "g2", "area", "midpoint")


@dataclass
class BandSums:
    """Sums over the visits of a band at the pixels that they cover, HealSparse maps of double precision."""

    sums: dict[str, Any]
    first: Any  #: earliest epoch
    last: Any  #: latest epoch


@dataclass
class NightMaps:
    """Sums of all bands, to which visits are added in the order of the list."""

    nside: int
    bands: dict[str, BandSums] = field(default_factory=dict)

    def add(self, product: VisitProduct) -> None:
        """Add the pixels of a visit, with the weights, times and epochs of their CCDs."""
        if not len(product.pixels.get("HPIX", ())):
            return
        pixels, table = product.pixels, product.detectors
        order = np.argsort(table["detector"])
        row = order[np.searchsorted(table["detector"][order], pixels["CCD"])]
        weight, midpoint = table["weight"][row], table["expMidptMJD"][row]
        # The weight may be that of the list, in any unit.
        pixel_noise = table["skyNoise"] * 10.0 ** (0.4 * (NANOJANSKY - table["zeroPoint"]))  # nJy
        values = {
            "time": table["expTime"][row],
            "count": np.ones(len(row)),
            "weight": weight,
            "noise": (weight * pixel_noise[row]) ** 2,
            "sigma": weight * pixels["SIGMA"],
            "g1": weight * pixels["G1"],
            "g2": weight * pixels["G2"],
            "area": weight * pixels["AREA"],
            "midpoint": midpoint,
        }
        if product.band not in self.bands:
            sums = {name: _new_map(self.nside) for name in _SUMS}
            self.bands[product.band] = BandSums(sums, _new_map(self.nside), _new_map(self.nside))
        band = self.bands[product.band]
        index = pixels["HPIX"]
        for name, added in values.items():
            _update(band.sums[name], index, np.nan_to_num(_values(band.sums[name], index)) + added)
        _update(band.first, index, np.fmin(_values(band.first, index), midpoint))
        _update(band.last, index, np.fmax(_values(band.last, index), midpoint))

    def pictured(self, name: str) -> tuple[Any, Any, Any]:
        """Return the maps of a band that people look at: rms width of the PSF [pixel], limiting magnitude, visits."""
        content = _quantities(self.bands[name], self.nside)
        keys = ("psf_size", "psf_maglim", "n_exposure")
        maps = [next(entry[0] for key, entry in content.items() if key.startswith(start)) for start in keys]
        return maps[0], maps[1], maps[2]

    def write(self, folder: Path, stamp: Stamp) -> None:
        """Write the maps of all bands, each whole or not at all."""
        for name, band in self.bands.items():
            for quantity, (content, unit) in _quantities(band, self.nside).items():
                _write(folder / f"deepCoadd_{quantity}_{name}.hsp", content, unit, stamp)


def _quantities(band: BandSums, nside: int) -> dict[str, tuple[Any, str]]:
    """Return the maps of a band by name, each with its unit."""
    index = band.sums["weight"].valid_pixels
    at = {name: _values(sums, index) for name, sums in band.sums.items()}
    area = at["area"] / at["weight"]
    # The noise of a PSF's flux in the weighted mean of the visits.
    limit = NANOJANSKY - 2.5 * np.log10(LIMIT_SNR * np.sqrt(area * at["noise"]) / at["weight"])
    columns = {
        "exposure_time_consolidated_map_sum": (at["time"], "s"),
        "n_exposure_consolidated_map_sum": (at["count"], ""),
        "epoch_consolidated_map_min": (_values(band.first, index), "d"),
        "epoch_consolidated_map_max": (_values(band.last, index), "d"),
        "epoch_consolidated_map_mean": (at["midpoint"] / at["count"], "d"),
        "psf_size_consolidated_map_weighted_mean": (at["sigma"] / at["weight"], "pixel"),
        "psf_e1_consolidated_map_weighted_mean": (at["g1"] / at["weight"], ""),
        "psf_e2_consolidated_map_weighted_mean": (at["g2"] / at["weight"], ""),
        "psf_maglim_consolidated_map_weighted_mean": (limit, "mag"),
    }
    maps = {}
    for name, (values, unit) in columns.items():
        content = _new_map(nside)
        _update(content, index, values)
        maps[name] = content, unit
    return maps


def _new_map(nside: int) -> Any:
    import healsparse

    return healsparse.HealSparseMap.make_empty(_COVERAGE, nside, dtype=np.float64)


def _values(content: Any, index: np.ndarray) -> np.ndarray:
    """Return the values at pixels, NaN where there is none."""
    values = np.asarray(content.get_values_pix(index), dtype=np.float64)
    return np.where(values == content.sentinel, np.nan, values)


def _update(content: Any, index: np.ndarray, values: np.ndarray) -> None:
    content.update_values_pix(index, values)


def _write(path: Path, content: Any, unit: str, stamp: Stamp) -> None:
    """Write a map, whole or not at all, with unit and origin in its header."""
    content.metadata = {"BUNIT": unit, **{key: value for key, value, _ in stamp.cards()}}
    with TemporaryDirectory() as place, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        file = Path(place) / path.name
        # Compressed files have the time of day in them.
        content.write(str(file), nocompress=True)
        write_bytes(path, file.read_bytes())
