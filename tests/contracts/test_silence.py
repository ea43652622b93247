"""The library prints nothing by itself: notices go to the logger, progress and lines to the command line."""

import ast
import re
import subprocess
import sys

import pytest
from test_layers import FILES, ROOT

#: Files that write to the terminal: lines, progress, the page that shows a run.
TERMINAL = {"core/terminal.py", "core/progress.py"}
#: Streams of the process that may be flushed or redirected, but not written to.
WRITERS = {"write", "writelines"}
PRINTERS = {"print", "print_line", "print_warning", "pprint", "input"}
#: Only files that have such a word are parsed.
WORDS = re.compile(rf"\b(?:sys\.std|terminal|{'|'.join(sorted(PRINTERS))})")


@pytest.mark.long
def test_nothing_is_printed_outside_the_command_line():
    printed = []
    for path in FILES:
        name = path.relative_to(ROOT).as_posix()
        if name in TERMINAL or name.startswith("commands/"):
            continue
        text = path.read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(text)) if WORDS.search(text) else ():
            function = ast.unparse(node.func) if isinstance(node, ast.Call) else ""
            to_stream = "sys.std" in function and function.rpartition(".")[2] in WRITERS
            imported = isinstance(node, ast.ImportFrom) and (node.module or "").endswith("terminal")
            if to_stream or imported or function in PRINTERS:
                printed.append(f"{name}:{node.lineno}")
    assert printed == []


@pytest.mark.long
def test_the_logger_is_silent_without_a_handler_of_the_user():
    """In a process of its own: commands, which other tests call, add a handler that shows notices."""
    code = "from pachon.core.launch import LOGGER; LOGGER.warning('cannot write compiled kernels')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("", "")
