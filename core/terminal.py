"""Lines on a terminal that show names as they are, whatever a file calls its surfaces."""

from __future__ import annotations

import json
import sys


def terminal_text(text: str) -> str:
    r"""Return a text with escapes such as ``\x1b`` in place of control characters, which a terminal would obey.

    Line feeds stay.
    """
    return text if _is_plain(text) else "".join(c if _is_plain(c) else repr(c)[1:-1] for c in text)


def terminal_json(text: str) -> str:
    r"""Return JSON of the same content with escapes such as ``\u009b`` in place of control characters."""
    return text if _is_plain(text) else "".join(c if _is_plain(c) else json.dumps(c)[1:-1] for c in text)


def print_line(text: str = "", *, error: bool = False) -> None:
    """Print a text, control characters as escapes, on standard output or standard error."""
    print(terminal_text(text), file=sys.stderr if error else sys.stdout, flush=error)


def print_warning(text: str) -> None:
    """Print a warning of the command line on standard error."""
    print_line(f"pachon: warning: {text}", error=True)


def _is_plain(text: str) -> bool:
    return all(line.isprintable() for line in text.split("\n"))
