"""Lens files that are text: their encodings, and their lines as keyword and words."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from decimal import Decimal
from pathlib import Path

from ....core.errors import PrescriptionError, cut_short
from ....core.files import read_bytes, text_lines
from .source import Source

#: Beginnings of files in UTF-16.
BYTE_ORDER_MARKS = (b"\xff\xfe", b"\xfe\xff")
#: Characters at the beginning of a file by which UTF-16 without such a mark is known.
_BEGINNING = 16


def read_text(path: Path) -> str:
    """Return the text of a file in UTF-16, UTF-8 or Windows-1252."""
    return decoded(read_bytes(path, PrescriptionError), str(path))


def decoded(raw: bytes, source: str) -> str:
    """Return the text of the bytes of a file, as :func:`read_text` does; `source` is its name for messages."""
    # Without a byte order mark each second byte of a text in English tells.
    unmarked = len(raw) > 2 * _BEGINNING and not any(raw[1 : 2 * _BEGINNING : 2]) and all(raw[: 2 * _BEGINNING : 2])
    wide = unmarked or raw.startswith(BYTE_ORDER_MARKS)
    try:
        text = raw.decode("utf-16-le" if unmarked else "utf-16" if wide else "utf-8-sig")
    except UnicodeDecodeError:
        if wide:
            raise PrescriptionError("not a UTF-16 text file, although it begins like one", file=source) from None
        # Windows' own characters; it has none for five bytes, which are control characters in ISO 8859-1.
        try:
            text = raw.decode("cp1252")
        except UnicodeDecodeError:
            text = raw.decode("iso-8859-1")
    if "\0" in text:
        raise PrescriptionError("not a text file", file=source)
    return text


def number_text(value: float) -> str:
    """Return the shortest text that loads back equal; zero without a minus sign."""
    return repr(float(value) + 0.0)


def scaled(number: float, power: int) -> float:
    """Return a number with its decimal point moved to the right: 0.6328 and -6 are the float 632.8e-9."""
    return float(Decimal(repr(float(number))).scaleb(power))


@dataclass(frozen=True, slots=True)
class Record(Source):
    """A line of a file: its keyword, the other words, and these as they stand in the file.

    `line` counts from 1.
    """

    line: int = 1
    words: tuple[str, ...] = ()
    text: str = ""

    @property
    def location(self) -> str:
        """Line and place within the file."""
        return f"line {self.line}" + (f", {self.place}" if self.place else "")

    @property
    def shown(self) -> str:
        """Keyword and words, cut short."""
        return cut_short(" ".join((self.keyword, *self.words)))

    def number(self, position: int, default: float | None = None, *, infinite: bool = False) -> float:
        """Return a word as a number, or a default where there are fewer words; without a default that is an error.

        INFINITY is a number only where `infinite` is set.
        """
        if position >= len(self.words):
            if default is None:
                raise self.error(f"a number as word {position + 1} after {self.keyword}")
            return default
        word = self.words[position]
        if infinite and word.upper() in ("INFINITY", "INF", "1E10", "1.0E+10"):
            return math.inf
        try:
            value = float(word)
        except ValueError:
            value = math.nan
        if not math.isfinite(value) or "_" in word:
            raise self.error(f"a number in place of {word!r}")
        return value

    def numbers(self) -> list[float]:
        """Return all words as numbers."""
        return [self.number(i) for i in range(len(self.words))]

    def integer(self, position: int, default: int | None = None) -> int:
        """Return a word as a whole number."""
        value = self.number(position, default)
        if value != int(value) or abs(value) > 1e9:
            raise self.error(f"a whole number in place of {self.words[position]!r}")
        return int(value)


@dataclass
class FileSurface:
    """Commands of one surface: its numbers by command, and the last line of each; its glass and its name."""

    number: int
    values: dict[str, float] = field(default_factory=dict)
    commands: dict[str, Record] = field(default_factory=dict)
    glass: Record | None = None
    name: str = ""

    @property
    def place(self) -> str:
        """Place in the file, for messages."""
        return f"surface {self.number}"

    def get(self, key: str) -> float:
        """Return a number, 0 where the file has none."""
        return self.values.get(key, 0.0)


def records(text: str, source: str) -> list[Record]:
    """Return the lines of a file that are not empty; those from a line "SURF n" on belong to surface n."""
    lines = []
    place = ""
    for number, content in enumerate(text_lines(text), start=1):
        words = content.split()
        if words:
            keyword, *following_words = words
            if keyword.upper() == "SURF" and following_words:
                place = f"surface {cut_short(following_words[0])}"
            after = content.strip()[len(keyword) :].strip()
            lines.append(Record(source, place, keyword.upper(), line=number, words=tuple(following_words), text=after))
    return lines
