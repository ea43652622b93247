"""Catalogues of many images: each file measured by this process or by a worker, its products written as it is done."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from astropy.io import fits

from ..core.errors import ConfigError, DomainError, ProductError
from ..core.file_names import file_name
from ..core.files import content_hash, write_bytes
from ..core.long_work import Execution
from ..core.memory import require_bytes
from ..core.number_text import counted
from ..core.products import read_fits, write_fits
from ..core.version import VERSION
from ..pipeline.config import digest
from ..reconstruction.psf_model.model import PsfModel
from ..reconstruction.psf_model.recipe import DEFAULT, Recipe
from .image_file import CcdImage
from .image_formats.load import ImageSettings, ImageSource, image_sources, image_stem, load_image
from .image_formats.pixel_noise import BlankImageError
from .image_psf import ImagePsf, load_image_psf
from .measure import measure_image
from .measure_picture import measured_png
from .object_colours import ObjectColours, read_object_colours
from .star_positions import read_star_positions

#: What names of products add to that of an image.
CATALOGUE_SUFFIX, PSF_SUFFIX, PICTURE_SUFFIX = "_galaxies", "_psf", "_measured"
#: Memory that measuring an image takes, in sizes of its pixels, variance and mask: 1.7 GiB for 4096 x 4096 pixels and
#: 20 000 objects.
_PIXEL_SIZES = 11


class MeasuredFiles(NamedTuple):
    """Results of image files, by their names."""

    metrics: dict[str, dict[str, Any]]  #: those of :class:`~.measure.ImageCatalogue`
    left_out: dict[str, str]  #: why an image could not be measured


@dataclass(frozen=True)
class MeasureOptions:
    """How images are measured; in paths of files ``{stem}`` stands for the name of the image without .fits.

    Attributes
    ----------
    psf : str, Path or None
        File of a PSF model: of this program, Piff or PSFEx. None for one of the stars of each image.
    recipe : Recipe or None
        Of the models of the images; None for the default one.
    stars : str, Path or None
        Table of the stars of an image, by pixels or celestial coordinates; None for stars by their size.
    colours : str, Path or None
        Table of the colours of stars and galaxies, by pixels or celestial coordinates; None to know none.
    colour_column : str or None
        Its column.
    min_snr : float
        Least S/N of stars.
    settings : ImageSettings
        What headers lack.
    pictures : bool
        Whether a picture of each measured image is written.
    """

    psf: str | Path | None = None
    recipe: Recipe | None = None
    stars: str | Path | None = None
    colours: str | Path | None = None
    colour_column: str | None = None
    min_snr: float = 30.0
    settings: ImageSettings = field(default_factory=ImageSettings)
    pictures: bool = False

    def of(self, path: Path) -> MeasureOptions:
        """Return the options of an image, its name in those of files."""
        settings = replace(
            self.settings, weight=_beside(self.settings.weight, path), mask=_beside(self.settings.mask, path)
        )
        return replace(
            self,
            psf=_beside(self.psf, path),
            stars=_beside(self.stars, path),
            colours=_beside(self.colours, path),
            settings=settings,
        )

    def object_colours(self, image: CcdImage, among: int) -> ObjectColours | None:
        """Return the colours of the objects of an image among those of its file; None where no table has them."""
        if self.colours is None or self.colour_column is None:
            return None
        return read_object_colours(Path(self.colours), self.colour_column, image, among)

    def keys(self) -> dict[str, Any]:
        """Return all that decides the products of an image, files by their content."""
        keys: dict[str, Any] = {"basis": None, "interpolation": None, "order": None, "min_snr": self.min_snr}
        if self.recipe not in (None, DEFAULT):
            keys |= self.recipe.keys()
        settings = {
            name: content_hash(Path(value), ProductError) if name in ("weight", "mask") else value
            for name, value in vars(self.settings).items()
            if value is not None and value != getattr(ImageSettings, name, None)
        }
        if self.stars is not None:
            settings["stars"] = content_hash(Path(self.stars), ProductError)
        if self.colours is not None:
            settings["colours"] = content_hash(Path(self.colours), ProductError)
            settings["colour_column"] = self.colour_column
        return keys | settings


def _beside(pattern: str | Path | None, path: Path) -> Path | None:
    return None if pattern is None else Path(str(pattern).replace("{stem}", image_stem(path)))


@dataclass(frozen=True)
class FileMeasurement:
    """Measure images of files; a picklable function for every kind of worker.

    Attributes
    ----------
    folder : Path or None
        Folder of the products; None for that of each image.
    options : MeasureOptions
        How they are measured.
    """

    folder: Path | None
    options: MeasureOptions

    def __call__(self, source: ImageSource, threads: int) -> dict[str, Any] | str:
        """Measure an image, write its PSF model and its catalogue, and return its metrics, or why it has none."""
        options = self.options.of(source.path)
        psf = (
            None if options.psf is None else _model_in(Path(options.psf), content_hash(Path(options.psf), ProductError))
        )
        try:
            image = load_image(source.path, extension=source.extension, settings=options.settings)
            stars = None if options.stars is None else read_star_positions(Path(options.stars), image, source.among)
            catalogue = measure_image(
                image,
                psf=psf,
                recipe=options.recipe,
                stars=stars,
                colours=options.object_colours(image, source.among),
                min_snr=options.min_snr,
                threads=threads,
            )
        except (DomainError, BlankImageError) as error:
            return str(error)
        table, metrics = catalogue.table(), catalogue.metrics()
        table.meta |= {"MEASHASH": self.digest(source), "METRICS": json.dumps(metrics)}
        if isinstance(catalogue.psf, PsfModel) and psf is None:
            product = self.product(source, PSF_SUFFIX)
            catalogue.psf.write(product)
            table.meta["PSFHASH"] = content_hash(product, ProductError)
        if options.pictures:
            write_bytes(self.picture(source), measured_png(catalogue))
        # Last: a resumed measurement takes it for the sign of a finished image.
        write_fits(self.product(source, CATALOGUE_SUFFIX), [fits.table_to_hdu(table)], None, [])
        return metrics

    def product(self, source: ImageSource, suffix: str) -> Path:
        """Return the path of a product of an image."""
        extension = "" if source.extension is None else f"_{file_name(source.extension)}"
        folder = source.path.parent if self.folder is None else self.folder
        return folder / f"{image_stem(source.path)}{extension}{suffix}.fits"

    def picture(self, source: ImageSource) -> Path:
        """Return the path of the picture of an image."""
        return self.product(source, PICTURE_SUFFIX).with_suffix(".png")

    def digest(self, source: ImageSource) -> str:
        """Return the SHA-256 of all that decides the products of an image: its file, options, model, version."""
        options = self.options.of(source.path)
        model = None if options.psf is None else content_hash(Path(options.psf), ProductError)
        keys: dict[str, Any] = {"image": content_hash(source.path, ProductError), "psf": model}
        if source.extension is not None:
            keys["extension"] = source.extension
        return digest(keys | {"options": options.keys(), "version": VERSION})

    def finished(self, source: ImageSource) -> dict[str, Any] | None:
        """Return the metrics of an image that is measured already, in the same way; None if a product is damaged.

        The catalogue is checked by its FITS checksums, the PSF model beside it by the hash that the catalogue has. A
        picture that is asked for must be there.
        """
        if self.options.pictures and not self.picture(source).is_file():
            return None
        try:
            _, table = read_fits(self.product(source, CATALOGUE_SUFFIX))
            if (
                self.options.psf is None
                and content_hash(self.product(source, PSF_SUFFIX), ProductError) != table.header["PSFHASH"]
            ):
                return None
            return json.loads(table.header["METRICS"]) if table.header["MEASHASH"] == self.digest(source) else None
        except (ProductError, LookupError, ValueError):
            # Of another version or program, too.
            return None


@lru_cache(maxsize=1)
def _model_in(path: Path, content: str) -> ImagePsf:
    """Return the model in a file of that content; it is kept from image to image."""
    return load_image_psf(path)


def images_among(paths: Sequence[Path]) -> list[Path]:
    """Return the paths, each once, without products beside their images, which a pattern of images finds too."""
    stems = {(path.parent, image_stem(path)) for path in paths}

    def is_product(path: Path) -> bool:
        name = image_stem(path)
        before = [name.removesuffix(suffix) for suffix in (CATALOGUE_SUFFIX, PSF_SUFFIX) if name.endswith(suffix)]
        # Products of one extension have its name behind that of the image.
        starts = {start[:i] for start in before for i in range(1, len(start) + 1) if f"{start}_"[i] == "_"}
        return any((path.parent, start) in stems for start in starts)

    return [path for path in dict.fromkeys(paths) if not is_product(path)]


def measure_files(
    images: Sequence[Path],
    folder: Path | None = None,
    *,
    extension: str | None = None,
    options: MeasureOptions | None = None,
    execution: Execution | None = None,
) -> MeasuredFiles:
    """Measure the images of files, and write a catalogue and a PSF model of each.

    Images without objects or noise, or with too few stars, are reported and left out. Products have the same bytes on
    any number of threads and by any workers.

    Parameters
    ----------
    images : sequence of Path
        Files that :func:`~pachon.load_image` reads; all images of those that have several.
    folder : Path, optional
        Folder of the products; by default that of each image.
    extension : str, optional
        Name or number of the extension of the image, in each file.
    options : MeasureOptions, optional
        PSF model, recipe, stars, and what headers lack.
    execution : Execution, optional
        Workers, which see the same files; threads; progress display; and whether to keep the products of images that
        were measured in the same way, where both are whole by their checksums.

    Raises
    ------
    PachonError
        If two products would have one name, memory is short, an image cannot be read, or none can be measured.
    """
    file_names = [path.name for path in images]
    if twice := [name for name, count in Counter(file_names).items() if count > 1]:
        if folder is not None:
            raise ConfigError(f"{folder}: two images are called {twice[0]}; expected different names, or no --out")
        file_names = [str(path) for path in images]
    sources = {
        name if source.extension is None else f"{name}[{source.extension}]": source
        for name, path in zip(file_names, images, strict=True)
        for source in image_sources(path, extension)
    }
    execution = execution or Execution()
    measure = FileMeasurement(folder, options or MeasureOptions())
    finished = measure.finished if execution.resume else lambda _: None
    metrics = {name: finished(source) for name, source in sources.items()}
    due = {name: source for name, source in sources.items() if metrics[name] is None}
    size = max((source.n_bytes for source in due.values()), default=0)
    left_out = {}
    with execution.results(
        measure,
        list(due),
        due.values(),
        title=f"objects of {counted(len(due), 'image')}",
        check=lambda count: require_bytes(count * _PIXEL_SIZES * size, f"{counted(count, 'image')} at a time"),
    ) as results:
        for name, result in zip(due, results, strict=True):
            if isinstance(result, str):
                left_out[name] = result
                execution.reporter.line(f"{name} is left out: {result}")
            else:
                metrics[name] = result
                for warning in result.get("warnings", ()):
                    execution.reporter.line(f"{name}: {warning}")
    if left_out and len(left_out) == len(sources):
        name, reason = next(iter(left_out.items()))
        raise DomainError(reason if len(sources) == 1 else f"no image can be measured; {name}: {reason}")
    return MeasuredFiles(
        {name: image_metrics for name, image_metrics in metrics.items() if image_metrics is not None}, left_out
    )
