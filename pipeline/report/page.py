"""Reports as one HTML file with everything in it, pictures included."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined


@dataclass(frozen=True)
class Picture:
    """One picture of a report."""

    title: str
    png: bytes
    shows: str  #: caption
    paper: str = ""  #: corresponding figure of Jee & Tyson 2011; empty where there is none

    @property
    def source(self) -> str:
        """The picture as a data URI."""
        return "data:image/png;base64," + base64.b64encode(self.png).decode("ascii")


def render(template: str, **content: Any) -> str:
    """Return a page made from one of the templates; a missing name is an error."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent / "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(**content)
