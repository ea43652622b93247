"""Files of a night: the table of visits and detectors, that of visits, maps of the sky, and the summary."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from ...core.errors import ProductError
from ...core.files import write_bytes, write_json
from ...core.products import Columns, Stamp, write_ecsv
from ...core.statistics import rms
from ...core.table_files import parquet_bytes
from ...pipeline.experiment import Experiment
from ...pipeline.listed_visit import instrument_of
from ...pipeline.run_folder import SUMMARY_NAME
from ...sky.visit_list.rotation import sky_rotations
from ...sky.visit_list.visit_list import VisitList
from . import detector_row as rows
from . import residual_correlation as xi
from .config import NightConfig
from .maps import NightMaps
from .report import REPORT_NAME, night_page
from .visit_product import VisitProduct

#: Names of the tables without their endings.
DETECTOR_TABLE = "visit_detector"
VISIT_TABLE = "visit"
CORRELATION_TABLE = "correlation"
#: Columns of the table of visits: unit, description.
_VISIT_COLUMNS = {
    "visitId": ("", "number of the visit"),
    "band": ("", "band"),
    "ra": ("deg", "pointing, ICRS"),
    "dec": ("deg", "pointing, ICRS"),
    "skyRotation": ("deg", "angle of the camera on the sky, rotSkyPos; of LSSTCam that of +y of images, north to east"),
    "telescopeRotation": ("deg", "position angle of the telescope's +y, north through east"),
    "rotTelPos": ("deg", "camera against telescope"),
    "zenithDistance": ("deg", "zenith distance"),
    "azimuth": ("deg", "azimuth"),
    "expMidptMJD": ("d", "middle of the exposure, TAI"),
    "expTime": ("s", "exposure time of all snaps"),
    "snaps": ("", "number of snaps"),
    "r0": ("m", "Fried parameter at 500 nm at the zenith"),
    "outerScale": ("m", "outer scale"),
    "epoch": ("", "epoch of turbulence, residual aberration and noise"),
}


def write_night(
    folder: Path,
    config: NightConfig,
    experiment: Experiment,
    visits: VisitList,
    stamp: Stamp,
    products: Iterable[VisitProduct],
    *,
    complete: bool = False,
) -> tuple[dict[int, str], dict[str, Any]]:
    """Write tables, maps and summary of finished visits; return those that have failed, and the summary."""
    tables: list[dict[str, np.ndarray]] = []
    correlated: dict[str, list[dict[str, np.ndarray]]] = {}
    left_out: dict[int, str] = {}
    left_out_ccds: dict[str, dict[str, str]] = {}
    maps = NightMaps(config.maps.nside) if config.maps.nside else None
    count = 0
    for product in products:
        count += 1
        if product.reason:
            left_out[product.visit] = product.reason
            continue
        if product.left_out:
            left_out_ccds[str(product.visit)] = product.left_out
        rows_of_visit = len(product.detectors["detector"])
        tables.append(
            {
                "visitId": np.full(rows_of_visit, product.visit, dtype=np.int64),
                "band": np.full(rows_of_visit, product.band),
                **product.detectors,
            }
        )
        if product.correlation:
            correlated.setdefault(product.band, []).append(product.correlation)
        if maps is not None:
            maps.add(product)
    columns = {name: np.concatenate([table[name] for table in tables]) for name in rows.COLUMNS} if tables else {}
    described: Columns = {name: (values, *rows.COLUMNS[name]) for name, values in columns.items()}
    meta = {"what": "PSF, sky and depth of each visit and detector", "instrument": instrument_of(experiment.camera)}
    if described:
        write_named_table(folder / DETECTOR_TABLE, described, {**meta, **stamp.meta()})
    of_visits = _visit_columns(visits, experiment.camera.name)
    write_named_table(folder / VISIT_TABLE, of_visits, {"what": "visits of the list", **stamp.meta()})
    if maps is not None:
        maps.write(folder, stamp)
    means = {band: xi.mean_correlations(correlated[band]) for band in sorted(correlated)}
    if means:
        what = "correlation of g at places of the same visit, mean over visits"
        write_named_table(folder / CORRELATION_TABLE, xi.correlation_columns(means), {"what": what, **stamp.meta()})
    summary = {
        **stamp.meta(),
        "configuration": config.as_dict(),
        "visits": len(visits),
        "finished": count,
        "complete": complete,
        "detectors": len(columns.get("detector", ())),
        "left_out": {str(visit): reason for visit, reason in left_out.items()},
        "left_out_ccds": left_out_ccds,
        "remarks": list(visits.remarks),
        "bands": _band_metrics(columns, correlated),
        "correlation_g": {
            band: {kind: mean.as_dict() for kind, mean in kinds.items()} for band, kinds in means.items()
        },
    }
    write_json(folder / SUMMARY_NAME, summary)
    write_bytes(folder / REPORT_NAME, night_page(summary, visits, columns, maps, means).encode())
    return left_out, summary


def write_named_table(path: Path, columns: Columns, meta: dict[str, Any]) -> None:
    """Write a table as Parquet with units, or as ECSV where there is no writer of Parquet."""
    file = path.with_suffix(".parquet")
    try:
        content = parquet_bytes(file, columns, meta, error=ProductError)
    except ProductError:
        write_ecsv(path.with_suffix(".ecsv"), columns, meta)
        return
    write_bytes(file, content)


def _visit_columns(visits: VisitList, camera: str) -> Columns:
    """Return the columns of the table of visits with a camera."""
    degrees = np.rad2deg
    values = {
        "visitId": visits.visit,
        "band": visits.band,
        "ra": degrees(visits.ra),
        "dec": degrees(visits.dec),
        "skyRotation": degrees(sky_rotations(visits.rotator, visits.roll, camera)) % 360.0,
        "telescopeRotation": degrees(visits.roll),
        "rotTelPos": degrees(visits.rotator),
        "zenithDistance": 90.0 - degrees(visits.altitude),
        "azimuth": degrees(visits.azimuth),
        "expMidptMJD": visits.midpoint,
        "expTime": visits.exposure,
        "snaps": visits.snaps,
        "r0": visits.r0,
        "outerScale": visits.outer_scale,
        "epoch": visits.epoch,
    }
    return {name: (values[name], *_VISIT_COLUMNS[name]) for name in _VISIT_COLUMNS}


def _band_metrics(
    columns: dict[str, np.ndarray], correlated: dict[str, list[dict[str, np.ndarray]]]
) -> dict[str, dict[str, float]]:
    """Return medians of each band, rms and xi+ of what the models leave."""
    metrics: dict[str, dict[str, float]] = {}
    for band in np.unique(columns["band"]).tolist() if columns else ():
        rows_of_band = columns["band"] == band
        medians = {
            f"median_{name}": float(np.median(columns[name][rows_of_band]))
            for name in ("psfSigma", "psfArea", "skyBg", "zeroPoint", "magLim", "effTime")
        }
        numbers = {"detectors": float(rows_of_band.sum()), **medians}
        for name in ("modelDeltaE1Rms", "modelDeltaE2Rms", "modelDeltaSizeRms"):
            values = columns[name][rows_of_band]
            if np.isfinite(values).any():
                numbers[f"rms_{name.removesuffix('Rms')}"] = rms(values)
        metrics[band] = numbers | xi.range_means(correlated.get(band, []))
    return metrics
