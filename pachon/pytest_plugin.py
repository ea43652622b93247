"""A pytest plugin that makes a test of every ``*.baseline.json`` that pytest comes across.

pytest loads it by itself where pachon is installed (``-p no:pachon`` turns it off). It imports nothing of pachon until
such a test runs.
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
    """The file of a baseline."""

    def collect(self) -> Iterator[pytest.Item]:
        """Yield its one test."""
        yield BaselineItem.from_parent(self, name="baseline")


class BaselineItem(pytest.Item):
    """The figures of a telescope against its baseline."""

    def runtest(self) -> None:
        """Compute them and compare."""
        from .testing import assert_matches_baseline

        assert_matches_baseline(None, self.path)

    def repr_failure(self, excinfo: pytest.ExceptionInfo[BaseException], style: Any = None) -> Any:
        """Return the table of what is out, or the line that says what cannot be read."""
        from .core.errors import PachonError

        if isinstance(excinfo.value, (AssertionError, PachonError)):
            return str(excinfo.value)
        return super().repr_failure(excinfo, style)

    def reportinfo(self) -> tuple[Path, int | None, str]:
        """Return what the test is called."""
        return self.path, None, f"baseline {self.path.name}"
