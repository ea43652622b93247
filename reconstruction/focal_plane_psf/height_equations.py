"""Normal equations of the heights from one exposure, its own parameters marginalised, and their file."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg

from ...core.errors import ProductError
from ...core.files import make_folder, read_arrays, write_bytes
from ...core.threads import one_blas_thread
from .covariance import Covariance
from .fit import BlockEquations, ExposureFit
from .response import N_EXPOSURE


class ExposureState(NamedTuple):
    """Parameters of an exposure, and the covariances of its turbulence."""

    exposure: np.ndarray
    covariances: list[Covariance]


class HeightEquations(NamedTuple):
    """Normal equations of the heights: a sum over blocks of stars, with the exposure's own parameters marginalised."""

    blocks: list[tuple[np.ndarray, np.ndarray]]  #: parameters of each block [m], and its matrix [m, m]
    factor: np.ndarray  #: [n_height, n_exposure]: ``factor @ factor.T`` is to be subtracted
    vector: np.ndarray  #: [n_height]
    state: ExposureState

    @classmethod
    def of(cls, fit: ExposureFit, blocks: list[BlockEquations]) -> HeightEquations:
        """Marginalise the parameters of an exposure, with their prior, in the equations of its blocks."""
        n = fit.prior.n_parameter
        cross, vector = np.zeros((n, N_EXPOSURE)), np.zeros(n)
        exposure_matrix, right = np.diag(fit.sigma**-2), -(fit.sigma**-2) * fit.exposure
        heights = []
        for block in blocks:
            used, m = block.used[:-N_EXPOSURE], len(block.used) - N_EXPOSURE
            heights.append((used, block.matrix[:m, :m]))
            cross[used] += block.matrix[:m, m:]
            vector[used] += block.vector[:m]
            exposure_matrix += block.matrix[m:, m:]
            right += block.vector[m:]
        # Parameters of metres and of pure numbers side by side.
        scale = 1.0 / np.sqrt(np.diagonal(exposure_matrix))
        root = scipy.linalg.cholesky(exposure_matrix * scale[:, None] * scale, lower=True)
        factor = scipy.linalg.solve_triangular(root, (cross * scale).T, lower=True).T
        vector -= factor @ scipy.linalg.solve_triangular(root, scale * right, lower=True)
        return cls(
            heights,
            factor,
            vector,
            ExposureState(fit.exposure, [c for c in fit.covariances if isinstance(c, Covariance)]),
        )

    def add_to(self, matrix: np.ndarray, vector: np.ndarray) -> None:
        """Add to the normal equations of all exposures."""
        for used, block in self.blocks:
            matrix[np.ix_(used, used)] += block
        with one_blas_thread():
            matrix -= self.factor @ self.factor.T
        vector += self.vector

    def write(self, path: Path, key: str) -> None:
        """Write a file, with a key of all inputs of the equations."""
        arrays: dict[str, Any] = {"factor": self.factor, "vector": self.vector, "exposure": self.state.exposure}
        for i, (used, block) in enumerate(self.blocks):
            arrays[f"block_used_{i}"] = used
            arrays[f"block_matrix_{i}"] = block[np.tril_indices(len(used))]
        for i, covariance in enumerate(self.state.covariances):
            for name, value in vars(covariance).items():
                arrays[f"{name}_{i}"] = np.asarray(value)
        make_folder(path.parent)
        content = io.BytesIO()
        np.savez(content, key=key, **arrays)
        write_bytes(path, content.getvalue())

    @classmethod
    def read(cls, path: Path, key: str) -> HeightEquations | None:
        """Return the equations of a file, or None where there is no whole file with this key."""
        if not path.exists():
            return None
        try:
            arrays = read_arrays(path, "damaged", ProductError)
            if str(arrays["key"]) != key:
                return None
            blocks, covariances = [], []
            for i in range(sum(name.startswith("block_used_") for name in arrays)):
                used = arrays[f"block_used_{i}"]
                lower = np.zeros((len(used), len(used)))
                lower[np.tril_indices(len(used))] = arrays[f"block_matrix_{i}"]
                blocks.append((used, lower + np.tril(lower, -1).T))
            for i in range(sum(name.startswith("constant_") for name in arrays)):
                amplitude, matrix, ccd = (arrays[f"{name}_{i}"] for name in ("amplitude", "matrix", "ccd"))
                constant, nugget = float(arrays[f"constant_{i}"]), float(arrays[f"nugget_{i}"])
                covariances.append(Covariance(constant, amplitude, matrix, ccd, nugget))
            return cls(blocks, arrays["factor"], arrays["vector"], ExposureState(arrays["exposure"], covariances))
        except (ProductError, ValueError, KeyError, TypeError, IndexError):
            return None
