"""Pytest plugin that makes a test of every ``*.baseline.json`` in the folders of the tests.

pytest loads it where pachon is installed; ``-p no:pachon`` turns it off. It imports nothing of pachon until such a test
runs.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest


def pytest_collect_file(file_path: Path, parent: pytest.Collector) -> pytest.Collector | None:
    """Collect baselines."""
    if file_path.name.endswith(".baseline.json"):
        return BaselineFile.from_parent(parent, path=file_path)
    return None


class BaselineFile(pytest.File):
    """File of a baseline."""

    def collect(self) -> Iterator[pytest.Item]:
        """Yield its test."""
        yield BaselineItem.from_parent(self, name="baseline")


class BaselineItem(pytest.Item):
    """Metrics of a telescope against its baseline."""

    def runtest(self) -> None:
        """Compare them."""
        from .testing import assert_matches_baseline

        assert_matches_baseline(None, self.path)

    def repr_failure(self, excinfo: pytest.ExceptionInfo[BaseException], style: Any = None) -> Any:
        """Return the table of the worst metrics, or the line of the error."""
        from .core.errors import PachonError

        if isinstance(excinfo.value, (AssertionError, PachonError)):
            return str(excinfo.value)
        return super().repr_failure(excinfo, style)

    def reportinfo(self) -> tuple[Path, int | None, str]:
        """Return the name of the test."""
        return self.path, None, f"baseline {self.path.name}"
