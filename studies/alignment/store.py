"""Visits of a loop on disk: what was exposed and fitted in each, so that a loop that was killed goes on."""

from __future__ import annotations

import io
import json
from contextlib import suppress
from dataclasses import astuple, dataclass, fields, replace
from pathlib import Path

import numpy as np

from ...core.errors import ProductError
from ...core.files import read_arrays, write_bytes
from ...core.long_work import claim_folder
from ...sensing.result import DonutFit
from .config import AlignConfig, load_align_configuration
from .field_quality import FieldMeans

CONFIG_NAME = "config.yaml"
_PATTERN = "visit_*.npz"
_ARRAYS = ("zernikes", "covariance", "usable", "images", "model")


@dataclass(frozen=True, eq=False)
class VisitRecord:
    """Quality of the telescope in a visit, and its donuts.

    Attributes
    ----------
    quality : FieldMeans
        Means over the field.
    zernikes, covariance : ndarray, shapes [n_star, n_noll], [n_star, n_noll, n_noll]
        Wavefronts of the donuts beyond the telescope as designed [m], NaN where there is none, and their covariance.
    usable : ndarray of bool, shape [n_star]
        Donuts with a result.
    images, model : ndarray of float32, shape [n_star, ny, nx]
        Donuts and their best models [electrons]; without stamps between the first and the last visit.
    """

    quality: FieldMeans
    zernikes: np.ndarray
    covariance: np.ndarray
    usable: np.ndarray
    images: np.ndarray
    model: np.ndarray

    @classmethod
    def of(cls, quality: FieldMeans, fit: DonutFit) -> VisitRecord:
        """Keep what a loop needs of the fit of a visit."""
        images, model = (v.astype(np.float32) for v in (fit.images, fit.model))
        # The filter has the covariance of the turbulence itself.
        return cls(quality, fit.zernikes, fit.error_parts.photons, np.asarray(fit.usable), images, model)

    @property
    def residuals(self) -> np.ndarray:
        """Donuts minus their models [electrons]."""
        return self.images - self.model

    def without_images(self) -> VisitRecord:
        """Return the record without its stamps."""
        return replace(self, images=self.images[:0], model=self.model[:0])

    def to_bytes(self, inputs: dict[str, str]) -> bytes:
        """Return the record with the hashes of its inputs as the content of a file, the same bytes for the same."""
        content = io.BytesIO()
        arrays = {name: getattr(self, name) for name in _ARRAYS}
        text = json.dumps(inputs, sort_keys=True)
        np.savez(content, quality=np.array(astuple(self.quality)), inputs=np.array(text), **arrays)
        return content.getvalue()


@dataclass(frozen=True)
class VisitStore:
    """Folder with a file for each visit; of all but the first and the last without stamps."""

    folder: Path
    inputs: dict[str, str]  #: hashes of the files that the configuration names, by key

    @classmethod
    def claimed(cls, folder: Path, config: AlignConfig, inputs: dict[str, str], *, resume: bool) -> VisitStore:
        """Write the configuration into a folder, or check that its visits are of the same, but for their number.

        Raises
        ------
        ProductError
            If the folder holds visits of another configuration, or of this one without ``resume``.
        """
        path = folder / CONFIG_NAME
        if not any(folder.glob(_PATTERN)):
            # Of a loop that was killed in its first visit.
            with suppress(OSError):
                path.unlink()
        claim_folder(
            path,
            config.to_yaml().encode(),
            products=_PATTERN,
            noun="visits",
            now=config.model_dump(mode="json"),
            read=lambda path: load_align_configuration(path).model_dump(mode="json"),
            free_keys=("visits",),
            wanted=resume,
        )
        return cls(folder, inputs)

    def _path(self, visit: int) -> Path:
        return self.folder / f"visit_{visit:05d}.npz"

    def read(self, visit: int) -> VisitRecord | None:
        """Return a visit, or None where it is not there; one that is damaged, or of other inputs, is a ProductError."""
        path = self._path(visit)
        if not path.exists():
            return None
        try:
            content = read_arrays(path, "expected a visit of a loop; delete it, and go on", ProductError)
            means = [float(value) for value in content["quality"]]
            if len(means) != len(fields(FieldMeans)):
                raise ValueError(f"{len(means)} means over the field, not {len(fields(FieldMeans))}")
            quality = FieldMeans(*means)
            before = dict(json.loads(str(content["inputs"])))
            record = VisitRecord(quality, *(content[name] for name in _ARRAYS))
        except (ValueError, KeyError, TypeError) as error:
            raise ProductError(f"{path}: expected a visit of a loop ({error}); delete it, and go on") from None
        changed = [key for key, value in self.inputs.items() if before.get(key) != value]
        if changed:
            raise ProductError(
                f"{path}: the file of {' and '.join(changed)} has changed since this visit; choose another --out"
            )
        return record

    def write(self, visit: int, record: VisitRecord) -> None:
        """Write a visit, and take the stamps off the one before."""
        write_bytes(self._path(visit), record.to_bytes(self.inputs))
        before = self.read(visit - 1) if visit > 1 else None
        if before is not None and len(before.images):
            write_bytes(self._path(visit - 1), before.without_images().to_bytes(self.inputs))
