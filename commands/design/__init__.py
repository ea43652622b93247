"""The commands on the design of a telescope, each with a table, a picture and metrics as JSON."""

from . import metrics, field, images, opd, optimize  # noqa: I001  (the order of the help)
from .command import app

__all__ = ["app", "field", "images", "metrics", "opd", "optimize"]
