"""Reports as one self-contained HTML file, and numbers rounded to the digits that their errors allow."""

from __future__ import annotations

import base64
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined


@dataclass(frozen=True)
class Picture:
    """One picture of a report."""

    title: str
    data: bytes
    shows: str  #: caption
    paper: str = ""  #: corresponding figure of Jee & Tyson 2011; empty where there is none
    kind: str = "png"  #: format of the data: png or svg

    @property
    def source(self) -> str:
        """The picture as a data URI."""
        mime = "svg+xml" if self.kind == "svg" else self.kind
        return f"data:image/{mime};base64," + base64.b64encode(self.data).decode("ascii")


def render(folder: Path, template: str, **content: Any) -> str:
    """Return a page made from a template of a folder; a missing name is an error.

    Templates include the common styles of this layer, ``style.css`` and ``print.css``, and import ``pictures.html``.
    """
    environment = Environment(
        loader=FileSystemLoader([folder, Path(__file__).parent / "templates"]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(**content)


def with_error(value: float, error: float) -> str:
    """Return a number with its error, to the second digit of that; to three digits where the error is not known."""
    if not error > 0.0:
        return f"{value:.3g}"
    return f"{with_digits(value, error)} ± {error:.2g}"


def with_digits(value: float, error: float) -> str:
    """Return a number to the second digit of its error; to three digits where the error is not known."""
    if value == 0.0 or not error > 0.0:
        return f"{value:.3g}"
    digits = 2 + math.floor(math.log10(abs(value))) - math.floor(math.log10(error))
    return f"{value:.{min(max(digits, 1), 9)}g}"
