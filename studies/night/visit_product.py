"""Product of one visit: a row of each detector, and the PSF at the pixels of the maps, in one FITS file."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ...core.errors import DomainError, PachonError, ProductError
from ...core.number_text import counted
from ...core.products import Columns, Stamp, column, is_whole, read_fits, table_hdu, write_fits
from ...core.progress import Reporter
from ...core.units import ARCSEC
from ...models.camera.camera import Camera
from ...pipeline.experiment import Experiment
from ...pipeline.listed_visit import visit_experiment
from ...pipeline.resolved_values import resolved_value
from ...pipeline.run_folder import ccd_cards
from ...pipeline.simulate.ccd_exposure import CcdExposure, ccd_stars
from ...pipeline.simulate.ccd_loop import one_by_one, simulate_ccds
from ...pipeline.simulate.ccd_model import CcdFit, fit_ccds, model_ccds
from ...pipeline.simulate.photometry import PROVISIONAL_FWHM
from ...pipeline.simulate.sky_axes import sky_jacobians
from ...pipeline.simulate.star_field import StarField
from ...reconstruction.ccd_product import CcdProduct, product_path, write_product
from ...sky.visit_list.visit_list import ListedVisit
from . import detector_row as rows
from . import residual_correlation as xi
from .config import NightConfig
from .sky_pixels import covered_pixels, interpolated

#: Columns of the pixels of the maps: unit, description.
PIXEL_COLUMNS = {
    "HPIX": ("", "nested HEALPix pixel"),
    "CCD": ("", "number of the CCD in the camera, from 0"),
    "SIGMA": ("pixel", "determinant radius of the PSF"),
    "G1": ("", "g on the sky, > 0 from east to west"),
    "G2": ("", "g on the sky, > 0 from north-west to south-east"),
    "AREA": ("pixel2", "effective area of the PSF"),
}
_ROW_COLUMNS = tuple(name for name in rows.COLUMNS if name not in ("visitId", "band"))
#: Stars of the CCDs that are exposed and modelled together: a visit is computed whole or not at all. An array of their
#: stamps has 20 MB; beyond 32 MB each is mapped anew.
_STARS_TOGETHER = 1500


@dataclass(frozen=True)
class VisitProduct:
    """Content of the file of a visit."""

    visit: int
    band: str
    detectors: dict[str, np.ndarray]  #: columns but for visit and band, empty where the visit has failed
    pixels: dict[str, np.ndarray]  #: columns of :data:`PIXEL_COLUMNS`
    correlation: dict[str, np.ndarray]  #: columns of :data:`.residual_correlation.COLUMNS`, or nothing
    left_out: dict[str, str]  #: CCDs without a PSF model, each with the reason
    reason: str = ""  #: why the visit has failed

    def write(self, path: Path, stamp: Stamp) -> None:
        """Write the file, whole or not at all."""
        # Descriptions, which the table of the night has, are too long for cards.
        detectors: Columns = {name: (self.detectors[name], rows.COLUMNS[name][0], "") for name in self.detectors}
        pixels: Columns = {name: (self.pixels[name], PIXEL_COLUMNS[name][0], "") for name in self.pixels}
        correlation: Columns = {name: (self.correlation[name], xi.COLUMNS[name][0], "") for name in self.correlation}
        tables = (("DETECTORS", detectors), ("PIXELS", pixels), ("XI", correlation))
        hdus = [table_hdu(name, table) for name, table in tables if table]
        cards = [
            ("VISIT", self.visit, "number of the visit"),
            ("BAND", self.band, "band"),
            ("LEFTOUT", json.dumps(self.left_out), ""),
            ("REASON", self.reason, ""),
        ]
        write_fits(path, hdus, stamp, cards)

    @classmethod
    def read(cls, path: Path, stamp: Stamp | None = None) -> VisitProduct:
        """Read the file of a visit; ProductError if it is damaged and, with a stamp, if it is of another night."""
        hdus = read_fits(path, stamp)
        header = hdus[0].header
        tables = {hdu.name: {name: column(hdu, name) for name in hdu.columns.names} for hdu in hdus[1:] if hdu.name}
        return cls(
            header["VISIT"],
            header["BAND"],
            tables.get("DETECTORS", {}),
            tables.get("PIXELS", {}),
            tables.get("XI", {}),
            json.loads(header["LEFTOUT"]),
            header["REASON"],
        )


@dataclass(frozen=True)
class VisitWork:
    """Computation of the visits of a night, the same for all of them; picklable and small."""

    config: NightConfig
    stamp: Stamp
    base: Path | None  #: folder that relative paths in the configuration start from

    def __call__(self, visit: ListedVisit, threads: int, folder: Path) -> str:
        """Write the product of a visit into a folder as the job of a worker; return why it failed, or nothing."""
        return self.compute_here(None, visit, threads, folder)

    def compute_here(self, reporter: Reporter | None, visit: ListedVisit, threads: int | None, folder: Path) -> str:
        """Write the product of a visit; a visit that fails has a product with the reason.

        ProductError if it cannot be written.
        """
        try:
            product = self._product(visit, threads, folder, reporter)
        except ProductError:
            raise
        except PachonError as error:
            product = VisitProduct(visit.visit, visit.band, {}, {}, {}, {}, _one_line(error, visit))
        product.write(folder / product_name(visit.visit), self.stamp)
        return product.reason

    def _product(
        self, visit: ListedVisit, threads: int | None, folder: Path, reporter: Reporter | None
    ) -> VisitProduct:
        experiment = visit_experiment(self.config.run, visit, self.base)
        names = resolved_value(experiment.config.ccds)
        detectors: dict[str, dict[str, float]] = {}
        places: dict[int, rows.PlaceShapes] = {}
        ellipticities: dict[str, xi.PlaceEllipticities] = {}

        def reduce(exposures: Sequence[CcdExposure]) -> list[PachonError | None]:
            models: Sequence[CcdProduct | CcdFit | PachonError | None] = [None] * len(exposures)
            if self.config.models:
                models = (model_ccds if self.config.products else fit_ccds)(experiment, exposures)
            return one_by_one(reduce_ccd, exposures, models)

        def reduce_ccd(exposure: CcdExposure, model: CcdProduct | CcdFit | PachonError | None) -> None:
            ccd = experiment.camera.ccd_index(exposure.name)
            fit = CcdFit.of(model) if isinstance(model, CcdProduct) else model
            measured = fit.holdout if isinstance(fit, CcdFit) else None
            shapes = rows.place_shapes(experiment, exposure.positions.holdout, exposure.holdout, measured)
            if not np.isfinite(shapes.sigma[0]):
                raise DomainError("the PSF in its middle has no shape: expected light there, wider than a pixel")
            if isinstance(fit, PachonError):
                raise fit
            if isinstance(model, CcdProduct):
                cards = ccd_cards(experiment, exposure.name)
                write_product(folder, model, self.stamp, cards, _prefix(visit.visit))
            detectors[exposure.name] = _row(experiment, visit, exposure, shapes) | rows.model_columns(experiment, fit)
            places[ccd] = shapes
            truth = np.stack([shapes.g1, shapes.g2])
            away = np.full_like(truth, np.nan)
            if fit is not None:
                away = truth - np.stack([fit.holdout.model_g1, fit.holdout.model_g2])
            ellipticities[exposure.name] = xi.PlaceEllipticities(shapes.xy, truth, away)

        with experiment.screens(threads, reporter):
            simulated = simulate_ccds(
                experiment,
                reduce,
                names,
                fields={name: _fields(experiment, name, self.config.models) for name in names},
                title=f"{visit.label}, {visit.band}: {counted(len(names), 'CCD')}",
                strict=False,
                together=_STARS_TOGETHER,
                threads=threads,
                reporter=reporter,
            )
        if not detectors:
            name, reason = next(iter(simulated.not_modelled.items()))
            raise DomainError(f"none of {len(names)} CCDs has a PSF; CCD {name}: {reason}")
        order = [name for name in names if name in detectors]
        columns = {key: np.array([detectors[name][key] for name in order]) for key in _ROW_COLUMNS}
        columns["detector"] = columns["detector"].astype(np.int64)
        pixels = _pixels(experiment, places, self.config.maps.nside) if self.config.maps.nside else {}
        correlation = xi.correlate_visit(experiment, [ellipticities[name] for name in order])
        return VisitProduct(visit.visit, visit.band, columns, pixels, correlation, simulated.not_modelled)


def product_name(visit: int) -> str:
    """Return the name of the file of a visit."""
    return f"visit_{visit}.fits"


def has_ccd_products(path: Path, stamp: Stamp, camera: Camera) -> bool:
    """Return whether the CCDs of a visit, by the file of the visit, have whole products beside it."""
    product = VisitProduct.read(path, stamp)
    names = [camera.ccd_names[ccd] for ccd in product.detectors.get("detector", ())]
    return all(is_whole(product_path(path.parent, name, _prefix(product.visit)), stamp) for name in names)


def _prefix(visit: int) -> str:
    """Return the beginning of the names of the products of a visit's CCDs."""
    return f"visit_{visit}_"


def _one_line(error: PachonError, visit: ListedVisit) -> str:
    """Return the text of an error without the name of its visit."""
    return str(error).removeprefix(f"{visit.label}: ")


def _fields(experiment: Experiment, name: str, models: bool) -> StarField:
    """Return the stars and places of a CCD, the first place in its middle; without models one star, as one must be."""
    field = ccd_stars(experiment, name, PROVISIONAL_FWHM)
    camera = experiment.camera
    middle = camera.centers[camera.ccd_index(name)]
    field = replace(field, holdout=np.concatenate([middle[None], field.holdout]))
    if models:
        return field
    return replace(
        field,
        observed=field.observed[:1],
        magnitude=field.magnitude[:1],
        electrons=field.electrons[:1],
        temperature=None if field.temperature is None else field.temperature[:1],
    )


def _row(
    experiment: Experiment, visit: ListedVisit, exposure: CcdExposure, shapes: rows.PlaceShapes
) -> dict[str, float]:
    """Return the row of a CCD but for its model."""
    camera, pointing = experiment.camera, resolved_value(experiment.pointing)
    ccd = camera.ccd_index(exposure.name)
    lit_fraction = float(exposure.holdout.lit_fraction[0])
    xx, yy, xy = rows.moments_along_pixels(camera, ccd, shapes.sigma[0], shapes.g1[0], shapes.g2[0])
    noise = rows.noise_columns(experiment, lit_fraction)
    sky, zero_point = noise["skyBg"], noise["zeroPoint"]
    if math.isfinite(visit.weight):
        noise["weight"] = visit.weight
    ra, dec = pointing.to_celestial(pointing.to_sky(np.tan(exposure.holdout.fields[:1])))[0]
    jacobian = sky_jacobians(experiment, [shapes.xy[:1]])[0][0]
    pixel_scale = camera.pixel_size * math.sqrt(abs(float(np.linalg.det(jacobian))))
    sigma, area = float(shapes.sigma[0]), float(shapes.area[0])
    return {
        "detector": ccd,
        "expMidptMJD": visit.midpoint,
        "expTime": visit.exposure,
        "ra": math.degrees(ra),
        "dec": math.degrees(dec),
        "zenithDistance": math.degrees(visit.zenith_angle),
        "pixelScale": pixel_scale / ARCSEC,
        "psfSigma": sigma,
        "psfIxx": float(xx),
        "psfIyy": float(yy),
        "psfIxy": float(xy),
        "psfArea": area,
        **noise,
        "magLim": rows.limiting_magnitude(experiment, area, sky, zero_point),
        "effTime": rows.effective_time(experiment, sigma, sky, zero_point, 1.0 / math.sin(visit.altitude)),
    }


def _pixels(experiment: Experiment, places: dict[int, rows.PlaceShapes], nside: int) -> dict[str, np.ndarray]:
    """Return the columns of the pixels of the maps that the CCDs with a PSF cover."""
    covered = covered_pixels(experiment, nside)
    mask = np.isin(covered.ccd, list(places))
    index, ccd, xy = (values[mask] for values in covered)
    values = np.zeros((len(index), 4))
    of_ccds = [np.flatnonzero(ccd == number) for number in places]
    jacobians = sky_jacobians(experiment, [xy[on_ccd] for on_ccd in of_ccds])
    for (number, shapes), on_ccd, sky_axes in zip(places.items(), of_ccds, jacobians, strict=True):
        if len(on_ccd):
            values[on_ccd] = interpolated(experiment.camera, number, shapes, sky_axes, xy[on_ccd])
    return dict(zip(PIXEL_COLUMNS, (index, ccd.astype(np.int64), *values.T), strict=True))
