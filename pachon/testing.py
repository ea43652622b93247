"""Assertions for the tests of other projects."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from .core.arguments import check_arguments

if TYPE_CHECKING:
    from .models.telescope import Telescope

__all__ = ["assert_matches_baseline"]


@check_arguments
def assert_matches_baseline(
    model: str | os.PathLike[str] | Telescope | None,
    baseline: str | os.PathLike[str],
    *,
    configuration: str | os.PathLike[str] | None = None,
    threads: int | None = None,
) -> None:
    """Assert that all metrics of a telescope agree with its baseline.

    Parameters
    ----------
    model : str, path or Telescope, or None
        Bundled telescope, path of a prescription, or a telescope; None for that of the baseline.
    baseline : path
        File of the baseline.
    configuration : path, optional
        Run configuration in place of the baseline's own.
    threads : int, optional
        Number of threads; all processors by default.

    Raises
    ------
    AssertionError
        If a metric is out of tolerance, with a table of the worst ones.
    PachonError
        If one of the files cannot be read.
    """
    from .studies.baseline.baseline import check_baseline

    check = check_baseline(baseline, model, configuration, threads=threads)
    if not check.passed:
        raise AssertionError(check.text())
