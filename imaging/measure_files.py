"""Catalogues of many images: each file measured by this process or by a worker, its products written as it is done."""

from __future__ import annotations

import io
import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from astropy.table import Table

from ..core.errors import ConfigError, DomainError, ProductError
from ..core.files import content_hash, parsing, read_bytes
from ..core.memory import require_bytes
from ..core.ordered_jobs import ordered_results
from ..core.progress import Reporter
from ..core.table_files import write_table
from ..core.version import VERSION
from ..core.workers import MakeWorkers
from ..pipeline.config import digest
from ..reconstruction.focal_plane_psf.model import FocalPlanePsf
from ..reconstruction.psf_model.recipe import DEFAULT, Recipe
from .image_file import CcdImage
from .measure import measure_image

#: What names of products add to that of an image.
CATALOGUE_SUFFIX, PSF_SUFFIX = "_galaxies", "_psf"
#: Memory that measuring an image takes, in sizes of its file: 1.3 GiB for 4096 x 4096 pixels.
_FILE_SIZES = 8


class MeasuredFiles(NamedTuple):
    """Results of image files, by their names."""

    metrics: dict[str, dict[str, Any]]  #: those of :class:`~.measure.ImageCatalogue`
    left_out: dict[str, str]  #: why an image could not be measured


@dataclass(frozen=True)
class FileMeasurement:
    """Measure image files; a picklable function for every kind of worker.

    Attributes
    ----------
    folder : Path or None
        Folder of the products; None for that of each image.
    psf : Path or None
        File of the model of all images; None for one of each image.
    recipe : Recipe or None
        Of the models of the images; None for the default one.
    min_snr : float
        Least S/N of stars.
    """

    folder: Path | None
    psf: Path | None
    recipe: Recipe | None
    min_snr: float

    def __call__(self, path: Path, threads: int) -> dict[str, Any] | str:
        """Measure an image, write its PSF model and its catalogue, and return its metrics, or why it has none."""
        psf = None if self.psf is None else _model_in(self.psf, content_hash(self.psf, ProductError))
        image = CcdImage.read(path)
        try:
            catalogue = measure_image(image, psf=psf, recipe=self.recipe, min_snr=self.min_snr, threads=threads)
        except DomainError as error:
            return str(error)
        if psf is None:
            catalogue.psf.write(self.product(path, PSF_SUFFIX))
        table, metrics = catalogue.table(), catalogue.metrics()
        table.meta |= {"MEASHASH": self.digest(path), "METRICS": json.dumps(metrics)}
        # Last: a resumed measurement takes it for the sign of a finished image.
        write_table(self.product(path, CATALOGUE_SUFFIX), table)
        return metrics

    def product(self, path: Path, suffix: str) -> Path:
        """Return the path of a product of an image."""
        return (path.parent if self.folder is None else self.folder) / f"{path.stem}{suffix}.fits"

    def digest(self, path: Path) -> str:
        """Return the SHA-256 of all that decides the products of an image: its file, options, model, version."""
        model = None if self.psf is None else content_hash(self.psf, ProductError)
        image = content_hash(path, ProductError)
        options: dict[str, Any] = {"basis": None, "interpolation": None, "order": None, "min_snr": self.min_snr}
        if self.recipe not in (None, DEFAULT):
            options |= self.recipe.keys()
        return digest({"image": image, "psf": model, "options": options, "version": VERSION})

    def finished(self, path: Path) -> dict[str, Any] | None:
        """Return the metrics of an image that is measured already, in the same way."""
        file = self.product(path, CATALOGUE_SUFFIX)
        try:
            data = read_bytes(file, ProductError)
            with parsing(file, "damaged or no table", ProductError):
                meta = Table.read(io.BytesIO(data), format="fits").meta
        except ProductError:
            return None
        return json.loads(meta["METRICS"]) if meta.get("MEASHASH") == self.digest(path) else None


@lru_cache(maxsize=1)
def _model_in(path: Path, content: str) -> FocalPlanePsf:
    """Return the model in a file of that content; it is kept from image to image."""
    return FocalPlanePsf.read(path)


def images_among(paths: Sequence[Path]) -> list[Path]:
    """Return the paths, each once, without products beside their images, which a pattern of images finds too."""
    products = {
        path.with_name(f"{path.stem}{added}.fits") for path in paths for added in (CATALOGUE_SUFFIX, PSF_SUFFIX)
    }
    return [path for path in dict.fromkeys(paths) if path not in products]


def measure_files(
    images: Sequence[Path],
    folder: Path | None = None,
    *,
    psf: Path | None = None,
    recipe: Recipe | None = None,
    min_snr: float = 30.0,
    resume: bool = False,
    workers: MakeWorkers | None = None,
    threads: int | None = None,
    reporter: Reporter | None = None,
) -> MeasuredFiles:
    """Measure image files, and write a catalogue and a PSF model of each.

    Images without objects, or with too few stars, are reported and left out. Products have the same bytes on any number
    of threads and by any workers.

    Parameters
    ----------
    images : sequence of Path
        Files of :class:`~.image_file.CcdImage`.
    folder : Path, optional
        Folder of the products; by default that of each image.
    psf : Path, optional
        File of a :class:`~pachon.FocalPlanePsf` of all images; by default a model of each image is fitted, and written.
    recipe : Recipe, optional
        Of the models of the images.
    min_snr : float
        Least S/N of stars.
    resume : bool
        Keep the products of images that were measured in the same way.
    workers : callable, optional
        Function that makes the workers, which see the same files; by default this process.
    threads : int, optional
        Number of threads; all processors by default.
    reporter : Reporter, optional
        Progress display; silent by default.

    Raises
    ------
    PachonError
        If two products would have one name, memory is short, an image cannot be read, or none can be measured.
    """
    names = [path.name for path in images]
    if twice := [name for name, count in Counter(names).items() if count > 1]:
        if folder is not None:
            raise ConfigError(f"{folder}: two images are called {twice[0]}; expected different names, or no --out")
        names = [str(path) for path in images]
    reporter = Reporter(quiet=True) if reporter is None else reporter
    measure = FileMeasurement(folder, psf, recipe, min_snr)
    metrics = {name: measure.finished(path) if resume else None for name, path in zip(names, images, strict=True)}
    due = {name: path for name, path in zip(names, images, strict=True) if metrics[name] is None}
    sizes = [path.stat().st_size for path in due.values() if path.is_file()]
    results = ordered_results(
        measure,
        list(due),
        due.values(),
        title=f"objects of {len(due)} images",
        workers=workers,
        threads=threads,
        check=lambda count: require_bytes(count * _FILE_SIZES * max(sizes, default=0), f"{count} images at a time"),
        reporter=reporter,
    )
    left_out = {}
    for name, result in zip(due, results, strict=True):
        if isinstance(result, str):
            left_out[name] = result
            reporter.line(f"{name} is left out: {result}")
        else:
            metrics[name] = result
    if left_out and len(left_out) == len(images):
        name, reason = next(iter(left_out.items()))
        raise DomainError(reason if len(images) == 1 else f"no image can be measured; {name}: {reason}")
    return MeasuredFiles(
        {name: image_metrics for name, image_metrics in metrics.items() if image_metrics is not None}, left_out
    )
