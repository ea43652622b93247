"""The README says what CI does, and its example runs."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_both_commands_stand_in_the_readme():
    lines = README.splitlines()
    assert "python3 -m venv .venv && .venv/bin/pip install . && .venv/bin/pachon run" in lines
    assert "python3 -m venv .venv && .venv/bin/pip install -e '.[test]' && .venv/bin/pytest" in lines


def test_ci_runs_the_command_of_the_readme():
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    pattern = re.search(r'grep -m 1 -E "(.*)" README.md', script).group(1)
    matching = [line for line in README.splitlines() if re.search(pattern, line)]
    assert matching == ["python3 -m venv .venv && .venv/bin/pip install -e '.[test]' && .venv/bin/pytest"]


def test_the_example_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", README, flags=re.S)
    assert blocks
    for block in blocks:
        assert len(block.splitlines()) <= 20
        exec(compile(block, "README.md", "exec"), {})
    assert capsys.readouterr().out


def test_no_file_leans_on_what_is_outside_the_repository():
    # Paths of a machine, or of folders beside the checkout, must not enter the project.
    pattern = re.compile(r"\.\./shared|/work/|/root/|/home/")
    kinds = ("*.py", "*.md", "*.yaml", "*.toml", "*.html", "*.txt", "*.csv")
    skipped = {".venv", ".venv-lowest", ".venv-newest", ".git", "build", "dist"}
    found = [
        path.relative_to(ROOT)
        for kind in kinds
        for path in ROOT.rglob(kind)
        if not skipped & set(path.relative_to(ROOT).parts) and path != Path(__file__)
        if pattern.search(path.read_text(encoding="utf-8"))
    ]
    assert found == []
