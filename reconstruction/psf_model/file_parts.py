"""Parts of a PSF model's FITS file: cards of its header, images, and columns of the table of its stars."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np


@dataclass(frozen=True, eq=False)
class ModelParts:
    """Cards, images and columns of a file; read ones are float64 in the byte order of the machine."""

    cards: dict[str, Any]  #: of the header: (value, comment) by keyword; the value alone where they are read
    images: dict[str, np.ndarray]  #: by the ending of their name
    columns: dict[str, np.ndarray] = field(default_factory=dict)  #: [n] or [n, k], of the stars
    eigenvalues: np.ndarray = field(default_factory=lambda: np.empty(0))  #: of the stars
    extent: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)  #: (xmin, xmax, ymin, ymax) of the CCD
    name: str = ""  #: start of the names of the extensions

    def image(self, ending: str) -> np.ndarray:
        """Return an image; KeyError with its name if it is missing."""
        if ending not in self.images:
            raise KeyError(f"{self.name}_{ending}".upper())
        return self.images[ending]

    def extended(self, images: dict[str, np.ndarray], columns: dict[str, np.ndarray]) -> ModelParts:
        """Return the parts with further images and columns."""
        return replace(self, images=self.images | images, columns=self.columns | columns)
