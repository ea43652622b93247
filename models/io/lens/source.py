"""Where a statement of a lens file stands, in the words of its format, and reports of what is not understood."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from ....core.errors import PachonError, PrescriptionError, PrescriptionNote, PrescriptionWarning


@dataclass(frozen=True, slots=True)
class Source:
    """A statement of a lens file: the file, the place in it, the keyword and its value as they stand there.

    `place` is for messages, such as ``"surface 3"``; it is empty for the system data of a file.
    """

    file: str
    place: str = ""
    keyword: str = ""
    value: str = ""

    @property
    def location(self) -> str:
        """Place within the file."""
        return self.place

    @property
    def shown(self) -> str:
        """Keyword and value as the format states them, cut short."""
        return f"{self.keyword} = {self.value}" if self.value else self.keyword

    def problem(self, text: str) -> PrescriptionError:
        """Return an error at this place."""
        return PrescriptionError(text, file=self.file, place=self.location or None)

    def error(self, expected: str) -> PrescriptionError:
        """Return the error of a statement with other than the expected values."""
        return self.problem(f"{self.shown}: expected {expected}")

    @contextmanager
    def context(self) -> Iterator[None]:
        """Raise errors of what the statement makes as errors of the statement."""
        try:
            yield
        except PrescriptionError as error:
            if error.file is not None:
                raise error.within(file=self.file, place=self.location or None) from None
            raise self.problem(": ".join(filter(None, (self.shown, str(error))))) from None
        except (OverflowError, ZeroDivisionError):
            text = "the parameters of its shape are too large or too small"
            raise self.problem(": ".join(filter(None, (self.shown, text)))) from None


@dataclass
class Findings:
    """Parts of a file that are not understood: errors, or where `lenient` is set warnings."""

    lenient: bool = False

    def report(self, error: PachonError, instead: str = "") -> None:
        """Raise the error or, if lenient, warn; `instead` is the assumption in its place, for the warning."""
        if not self.lenient:
            raise error
        self._warn(error, instead, PrescriptionWarning)

    def doubt(self, error: PachonError, instead: str = "") -> None:
        """Warn of what is likely a fault of the file and read as it is, in either mode."""
        self._warn(error, instead, PrescriptionWarning)

    def note(self, error: PachonError, instead: str = "") -> None:
        """Say what is read in another way, `instead`, in either mode."""
        self._warn(error, instead, PrescriptionNote)

    def _warn(self, error: PachonError, instead: str, category: type[PrescriptionWarning]) -> None:
        warnings.warn(f"{error}; {instead}" if instead else str(error), category, stacklevel=3)
