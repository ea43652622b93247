"""Catalogues of many images: each file measured by this process or by a worker, its products written as it is done."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from astropy.io import fits

from ..core.errors import ConfigError, DomainError, ProductError
from ..core.files import content_hash
from ..core.long_work import Execution
from ..core.memory import require_bytes
from ..core.products import read_fits, write_fits
from ..core.version import VERSION
from ..pipeline.config import digest
from ..reconstruction.focal_plane_psf.model import FocalPlanePsf
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
    options : dict
        Further arguments of :func:`~.measure.measure_image`.
    """

    folder: Path | None
    psf: Path | None
    options: dict[str, Any]

    def __call__(self, path: Path, threads: int) -> dict[str, Any] | str:
        """Measure an image, write its PSF model and its catalogue, and return its metrics, or why it has none."""
        psf = None if self.psf is None else _model_in(self.psf, content_hash(self.psf, ProductError))
        image = CcdImage.read(path)
        try:
            catalogue = measure_image(image, psf=psf, threads=threads, **self.options)
        except DomainError as error:
            return str(error)
        table, metrics = catalogue.table(), catalogue.metrics()
        table.meta |= {"MEASHASH": self.digest(path), "METRICS": json.dumps(metrics)}
        if psf is None:
            model_file = self.product(path, PSF_SUFFIX)
            catalogue.psf.write(model_file)
            table.meta["PSFHASH"] = content_hash(model_file, ProductError)
        # Last: a resumed measurement takes it for the sign of a finished image.
        write_fits(self.product(path, CATALOGUE_SUFFIX), [fits.table_to_hdu(table)], None, [])
        return metrics

    def product(self, path: Path, suffix: str) -> Path:
        """Return the path of a product of an image."""
        return (path.parent if self.folder is None else self.folder) / f"{path.stem}{suffix}.fits"

    def digest(self, path: Path) -> str:
        """Return the SHA-256 of all that decides the products of an image: its file, options, model, version."""
        model = None if self.psf is None else content_hash(self.psf, ProductError)
        image = content_hash(path, ProductError)
        return digest({"image": image, "psf": model, "options": self.options, "version": VERSION})

    def finished(self, path: Path) -> dict[str, Any] | None:
        """Return the metrics of an image that is measured already, in the same way; None if a product is damaged.

        The catalogue is checked by its FITS checksums, the PSF model beside it by the hash that the catalogue has.
        """
        try:
            _, table = read_fits(self.product(path, CATALOGUE_SUFFIX))
            if (
                self.psf is None
                and content_hash(self.product(path, PSF_SUFFIX), ProductError) != table.header["PSFHASH"]
            ):
                return None
            return json.loads(table.header["METRICS"]) if table.header["MEASHASH"] == self.digest(path) else None
        except (ProductError, LookupError, ValueError):
            # Of another version or program, too.
            return None


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
    options: dict[str, Any] | None = None,
    execution: Execution | None = None,
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
    options : dict, optional
        Further arguments of :func:`~.measure.measure_image`.
    execution : Execution, optional
        Workers, which see the same files; threads; progress display; and whether to keep the products of images that
        were measured in the same way, where both are whole by their checksums.

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
    execution = execution or Execution()
    measure = FileMeasurement(folder, psf, options or {})
    finished = measure.finished if execution.resume else lambda _: None
    metrics = {name: finished(path) for name, path in zip(names, images, strict=True)}
    due = {name: path for name, path in zip(names, images, strict=True) if metrics[name] is None}
    sizes = [path.stat().st_size for path in due.values() if path.is_file()]
    left_out = {}
    with execution.results(
        measure,
        list(due),
        due.values(),
        title=f"objects of {len(due)} images",
        check=lambda count: require_bytes(count * _FILE_SIZES * max(sizes, default=0), f"{count} images at a time"),
    ) as results:
        for name, result in zip(due, results, strict=True):
            if isinstance(result, str):
                left_out[name] = result
                execution.reporter.line(f"{name} is left out: {result}")
            else:
                metrics[name] = result
    if left_out and len(left_out) == len(images):
        name, reason = next(iter(left_out.items()))
        raise DomainError(reason if len(images) == 1 else f"no image can be measured; {name}: {reason}")
    return MeasuredFiles(
        {name: image_metrics for name, image_metrics in metrics.items() if image_metrics is not None}, left_out
    )
