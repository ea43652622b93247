"""Catalogues of many images: each file measured by this process or by a worker, its products written as it is done."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..core.errors import ConfigError
from ..core.memory import require_bytes
from ..core.ordered_jobs import ordered_results
from ..core.progress import Reporter
from ..core.table_files import write_table
from ..core.workers import MakeWorkers
from ..pipeline.focal_plane_psf.model import FocalPlanePsf
from .image_file import CcdImage
from .measure import measure_image

#: What names of products add to that of an image.
CATALOGUE_SUFFIX, PSF_SUFFIX = "_galaxies", "_psf"
#: Memory that measuring an image takes, in sizes of its file: 1.3 GiB for 4096 x 4096 pixels.
_FILE_SIZES = 8


@dataclass(frozen=True, eq=False)
class FileMeasurement:
    """Measure image files; a picklable function for every kind of worker.

    Attributes
    ----------
    folder : Path or None
        Folder of the products; None for that of each image.
    psf : FocalPlanePsf or None
        Model of all images; None for one of each image.
    options : dict
        Further arguments of :func:`~.measure.measure_image`.
    """

    folder: Path | None
    psf: FocalPlanePsf | None
    options: dict[str, Any]

    def __call__(self, path: Path, threads: int) -> dict[str, Any]:
        """Measure an image, write its catalogue and its PSF model, and return its metrics."""
        catalogue = measure_image(CcdImage.read(path), psf=self.psf, threads=threads, **self.options)
        folder = path.parent if self.folder is None else self.folder
        if self.psf is None:
            catalogue.psf.write(folder / f"{path.stem}{PSF_SUFFIX}.fits")
        write_table(folder / f"{path.stem}{CATALOGUE_SUFFIX}.fits", catalogue.table())
        return catalogue.metrics()


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
    psf: FocalPlanePsf | None = None,
    options: dict[str, Any] | None = None,
    workers: MakeWorkers | None = None,
    threads: int | None = None,
    reporter: Reporter | None = None,
) -> dict[str, dict[str, Any]]:
    """Measure image files, and write a catalogue and a PSF model of each; return the metrics of each.

    Products have the same bytes on any number of threads and by any workers.

    Parameters
    ----------
    images : sequence of Path
        Files of :class:`~.image_file.CcdImage`.
    folder : Path, optional
        Folder of the products; by default that of each image.
    psf : FocalPlanePsf, optional
        Model of all images; by default one of each image is fitted, and written.
    options : dict, optional
        Further arguments of :func:`~.measure.measure_image`.
    workers : callable, optional
        Function that makes the workers, which see the same files; by default this process.
    threads : int, optional
        Number of threads; all processors by default.
    reporter : Reporter, optional
        Progress display; silent by default.

    Raises
    ------
    PachonError
        If two products would have one name, memory is short, or an image cannot be measured.
    """
    names = [path.name for path in images]
    if twice := [name for name, count in Counter(names).items() if count > 1]:
        if folder is not None:
            raise ConfigError(f"{folder}: two images are called {twice[0]}; expected different names, or no --out")
        names = [str(path) for path in images]
    sizes = [path.stat().st_size for path in images if path.is_file()]
    metrics = ordered_results(
        FileMeasurement(folder, psf, options or {}),
        names,
        images,
        title=f"objects of {len(images)} images",
        workers=workers,
        threads=threads,
        check=lambda count: require_bytes(count * _FILE_SIZES * max(sizes, default=0), f"{count} images at a time"),
        reporter=Reporter(quiet=True) if reporter is None else reporter,
    )
    return dict(zip(names, metrics, strict=True))
