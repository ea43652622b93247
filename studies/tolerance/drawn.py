"""Telescopes of a finished tolerance study, made again from its store."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from ...core.errors import ProductError, error_context
from ...core.schema import validated
from ...models.io.prescription import load_telescope
from ...models.paraxial import following_stop
from ...models.telescope import Telescope
from ..sweep.store import SweepStore
from .file import ToleranceFile
from .plan import tolerance_plan
from .study import STORE


def drawn_telescope(store: Path, values: Mapping[str, float], name: str) -> tuple[Telescope, ToleranceFile]:
    """Return the telescope of a study at deviations and compensators by their names, and the file of the study.

    Parameters
    ----------
    store : Path
        Store of the study.
    values : mapping of str to float
        Deviations and compensators, in the units of the study.
    name : str
        Name of the telescope.

    Raises
    ------
    ProductError
        If there is no such store, or the telescope's file is another one now.
    PachonError
        If the telescope's file cannot be read.
    """
    with SweepStore(store, STORE) as opened, opened.sqlite_errors():
        content, digest = json.loads(opened.about["sweep"]), opened.about["digest"]
    file = validated(ToleranceFile, content, str(store))
    with error_context(file=store):
        telescope = load_telescope(file.telescope)
        if file.digest != digest:
            raise ProductError(f"{file.telescope} has changed since: expected the telescope of the study", file=store)
        plan = tolerance_plan(file, following_stop(telescope))
        changed = plan.degrees_of_freedom.apply(plan.telescope, values)
    return replace(changed, name=name), file
