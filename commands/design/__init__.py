"""The commands on the design of a telescope, each with a table, a picture and metrics as JSON."""

from . import metrics, analyses, light, field, images, opd, optimize, operands, report  # noqa: I001  (the order of the help)
from .command import app

__all__ = ["analyses", "app", "field", "images", "light", "metrics", "opd", "operands", "optimize", "report"]
