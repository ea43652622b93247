"""For the tests of other projects: a telescope against its baseline."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .models.telescope import Telescope


def assert_matches_baseline(
    model: str | os.PathLike[str] | Telescope | None,
    baseline: str | os.PathLike[str],
    *,
    configuration: str | os.PathLike[str] | None = None,
    threads: int | None = None,
) -> None:
    """Assert that every figure of a telescope lies within the tolerance of its baseline.

    Parameters
    ----------
    model : str, path or Telescope, or None
        Bundled telescope, path of a prescription, or a telescope; None for the one that the baseline names.
    baseline : path
        The file that ``pachon baseline save`` wrote.
    configuration : path, optional
        Run configuration in place of the baseline's own.
    threads : int, optional
        Number of threads; all processors by default.

    Raises
    ------
    AssertionError
        If a figure is out of tolerance; it says which, worst first.
    PachonError
        If one of the files cannot be read.
    """
    from .studies.baseline.baseline import check_baseline

    config = None if configuration is None else Path(configuration)
    check = check_baseline(Path(baseline), model, config, threads=threads)
    if not check.passed:
        raise AssertionError(check.text())
