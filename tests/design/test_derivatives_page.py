"""The examples of docs/derivatives.md run."""

import re
from pathlib import Path

import pytest

PAGE = (Path(__file__).parents[2] / "docs" / "derivatives.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE, flags=re.S)


@pytest.mark.parametrize("block", BLOCKS, ids=["sensitivity", "optimize"])
def test_examples_run(block, capsys):
    exec(compile(block, "derivatives.md", "exec"), {})
    assert capsys.readouterr().out
