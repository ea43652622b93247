"""The library prints nothing by itself: notices go to the logger, progress and lines to the command line."""

import ast
import logging

import pytest
from test_layers import FILES, ROOT

from pachon.core.launch import LOGGER

#: Files that write to the terminal: lines, progress, the page that shows a run.
TERMINAL = {"core/terminal.py", "core/progress.py"}
#: Streams of the process that may be flushed or redirected, but not written to.
WRITERS = {"write", "writelines"}
PRINTERS = {"print", "print_line", "print_warning", "pprint", "input"}


@pytest.mark.long
def test_nothing_is_printed_outside_the_command_line():
    printed = []
    for path in FILES:
        name = path.relative_to(ROOT).as_posix()
        if name in TERMINAL or name.startswith("commands/"):
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            function = ast.unparse(node.func) if isinstance(node, ast.Call) else ""
            to_stream = "sys.std" in function and function.rpartition(".")[2] in WRITERS
            imported = isinstance(node, ast.ImportFrom) and (node.module or "").endswith("terminal")
            if to_stream or imported or function in PRINTERS:
                printed.append(f"{name}:{node.lineno}")
    assert printed == []


def test_the_logger_is_silent_without_a_handler_of_the_user(capsys):
    assert any(isinstance(handler, logging.NullHandler) for handler in LOGGER.handlers)
    alone = [handler for handler in logging.root.handlers if type(handler).__module__.startswith("_pytest")]
    for handler in alone:
        logging.root.removeHandler(handler)
    try:
        LOGGER.warning("cannot write compiled kernels")
    finally:
        for handler in alone:
            logging.root.addHandler(handler)
    assert capsys.readouterr() == ("", "")
