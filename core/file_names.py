"""Names of files from names of telescopes, cameras and the like, which are any text."""

from __future__ import annotations

import hashlib

#: Longest name, so that words before and behind it fit within the 255 bytes of common file systems [byte].
MAX_BYTES = 80
#: Characters that separate folders, or that some file system or shell reserves.
_RESERVED = frozenset('/\\:*?"<>|')
#: Names of devices, with any ending and in any case, under Windows.
_DEVICES = frozenset(("con", "prn", "aux", "nul", *(f"{port}{i}" for port in ("com", "lpt") for i in range(1, 10))))
#: Hexadecimal digits of the hash that tells apart names which differ only in replaced characters.
_HASH_DIGITS = 8


def file_name(name: str) -> str:
    """Return a name as one part of a path.

    Letters of all scripts, digits, spaces, inner dots and dashes stay. Slashes, control and other reserved characters
    and a first dot or dash become ``_``, and at most 80 bytes are left. A name that changes so ends in a hash of the
    whole name: different names make different files.
    """
    text = "".join("_" if c in _RESERVED or not c.isprintable() else c for c in name)
    if text[:1] in (".", "-"):
        text = f"_{text[1:]}"
    text = text.rstrip(". ")
    if not text or text.partition(".")[0].strip().lower() in _DEVICES:
        text = f"_{text}"
    if text == name and len(text.encode()) <= MAX_BYTES:
        return text
    whole_name = hashlib.sha256(name.encode("utf-8", "surrogatepass")).hexdigest()
    return f"{_cut(text, MAX_BYTES - _HASH_DIGITS - 1)}-{whole_name[:_HASH_DIGITS]}"


def _cut(text: str, size: int) -> str:
    """Return as many characters from the first on as fit into so many bytes."""
    return text.encode()[:size].decode(errors="ignore")
