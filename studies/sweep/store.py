"""File of a sweep or another study of many points: SQLite in WAL mode, a row a point, each written once and whole.

Metrics are JSON with all digits of a double, in a column apart from times and workers. Two stores of one sweep hold the
same metrics, byte for byte, whatever the workers and interruptions.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from ...core.errors import ConfigError, PachonError, ProductError, cut_short
from ...core.files import make_folder, partial_path, plain_values, publish_new
from ...core.long_work import differences
from ...core.version import VERSION
from .file import Point, SweepFile, read_sweep

#: Format of the tables; stores of other formats are refused. In those of 1 the CCDs of the LSST were others.
FORMAT = 2
_TABLES = """
CREATE TABLE about (key TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE points (number INTEGER PRIMARY KEY, parameters TEXT NOT NULL, seed INTEGER NOT NULL);
CREATE TABLE results (
    number INTEGER PRIMARY KEY REFERENCES points (number),
    metrics TEXT,
    problem TEXT,
    seconds REAL NOT NULL,
    worker TEXT NOT NULL,
    pachon TEXT NOT NULL
);
"""


@dataclass(frozen=True)
class SweepPoint:
    """A point to compute: its number, the values of its parameters, and the seed of its random numbers."""

    number: int
    parameters: Point
    seed: int

    @property
    def label(self) -> str:
        """Name in messages."""
        return f"point {self.number}"


@dataclass(frozen=True)
class PointResult:
    """Result of one point."""

    number: int
    metrics: dict[str, float] | None  #: None where the point could not be computed
    problem: str | None  #: reason why it could not be computed, in one line
    seconds: float  #: time of the computation
    worker: str  #: machine and process of the computation


class StoredStudy(Protocol):
    """File of a study as a store keeps it: a section with a digest of its content and of the files that it names."""

    @property
    def digest(self) -> str:
        """SHA-256 of the content."""

    def model_dump(self, *, mode: str) -> dict[str, Any]:
        """Return the content as plain mappings."""


@dataclass(frozen=True)
class StoreKind:
    """Words of messages about the store of a study."""

    name: str  #: "sweep"
    maker: str  #: command or function that makes such a store
    rescue: str  #: remedy for a damaged one

    @property
    def article(self) -> str:
        """The name with its article."""
        return f"a {self.name}"


SWEEP = StoreKind("sweep", "pachon sweep makes", "pachon sweep export saves what it can")


class DamagedStoreError(ProductError):
    """Store that SQLite cannot read."""


class SweepStore:
    """Open file of a study, which must exist; a ProductError where it is no store, of another format, or damaged."""

    def __init__(self, path: Path, kind: StoreKind = SWEEP) -> None:
        if not path.is_file():
            raise ProductError(f"no such file; expected the store of {kind.article}, such as {kind.maker}", file=path)
        self.path, self.kind = path, kind
        with self.sqlite_errors():
            self._connection = sqlite3.connect(path, timeout=30.0)
            about = dict(self._connection.execute("SELECT key, value FROM about"))
        if about.get("format") != str(FORMAT):
            reason = "; those of 1 name the CCDs of the LSST as in a mirror (docs/howto/camera.md): make it again"
            raise ProductError(f"store of format {about.get('format')}: expected {FORMAT}{reason}", file=path)
        self.about = about

    def __enter__(self) -> SweepStore:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file, with the content of the write-ahead log."""
        with self.sqlite_errors():
            self._connection.close()

    @property
    def sweep(self) -> SweepFile:
        """Sweep of the store."""
        with self.sqlite_errors():
            return read_sweep(json.loads(self.about["sweep"]), str(self.path))

    def points(self) -> list[SweepPoint]:
        """Return all points in order."""
        with self.sqlite_errors():
            rows = self._connection.execute("SELECT number, parameters, seed FROM points ORDER BY number").fetchall()
            return [SweepPoint(number, json.loads(parameters), seed) for number, parameters, seed in rows]

    def results(self) -> list[PointResult]:
        """Return the results so far, in the order of the points."""
        with self.sqlite_errors():
            rows = self._connection.execute(
                "SELECT number, metrics, problem, seconds, worker FROM results ORDER BY number"
            ).fetchall()
            return [_point_result(*row) for row in rows]

    def finished(self) -> set[int]:
        """Return the numbers of the points with results."""
        with self.sqlite_errors():
            return {number for (number,) in self._connection.execute("SELECT number FROM results")}

    def forget_problems(self) -> int:
        """Delete results of points that could not be computed, and return their number."""
        with self.sqlite_errors(), self._connection:
            return self._connection.execute("DELETE FROM results WHERE problem IS NOT NULL").rowcount

    def write(self, result: PointResult) -> None:
        """Write one result, whole; an earlier result of the point stays."""
        row = (
            result.number,
            None if result.metrics is None else exact_json(result.metrics),
            result.problem,
            result.seconds,
            result.worker,
            VERSION,
        )
        with self.sqlite_errors(), self._connection:
            self._connection.execute("INSERT OR IGNORE INTO results VALUES (?, ?, ?, ?, ?, ?)", row)

    @contextmanager
    def sqlite_errors(self) -> Iterator[None]:
        """Raise a ProductError where the file cannot be read or written, or its content is not that of a store."""
        try:
            yield
        except sqlite3.Error as error:
            raise _store_error(self.path, error, self.kind) from None
        except PachonError:
            raise
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError, OverflowError) as error:
            raise _damaged_error(self.path, error, self.kind) from None


def open_store(
    path: Path,
    study: StoredStudy,
    make_points: Callable[[], Iterable[SweepPoint]],
    *,
    resume: bool,
    extra: dict[str, str] | None = None,
    kind: StoreKind = SWEEP,
) -> SweepStore:
    """Open the store of a study, made with its points where missing.

    Raises
    ------
    ConfigError
        If the store is of another study, or there is one and nothing is resumed.
    """
    if not path.exists():
        create_store(path, study, make_points(), extra or {}, kind)
    elif not resume:
        raise _store_exists(path)
    store = SweepStore(path, kind)
    try:
        check_same_sweep(store, study)
    except ConfigError:
        store.close()
        raise
    return store


def create_store(
    path: Path, sweep: StoredStudy, points: Iterable[SweepPoint], extra: dict[str, str], kind: StoreKind = SWEEP
) -> None:
    """Create the file of a study with all its points and no results, whole or not at all."""
    partial = partial_path(path)
    make_folder(path.parent)
    try:
        partial.unlink(missing_ok=True)
        connection = sqlite3.connect(partial)
        try:
            connection.executescript(_TABLES)
            about = {
                "format": str(FORMAT),
                "pachon": VERSION,
                # The order of the parameters is that of the sweep file.
                "sweep": json.dumps(sweep.model_dump(mode="json"), ensure_ascii=False, allow_nan=False),
                "digest": sweep.digest,
                **extra,
            }
            with connection:
                connection.executemany("INSERT INTO about VALUES (?, ?)", about.items())
                rows = ((p.number, exact_json(p.parameters), p.seed) for p in points)
                connection.executemany("INSERT INTO points VALUES (?, ?, ?)", rows)
            # Readers do not wait for the writer, and a point costs one write.
            connection.execute("PRAGMA journal_mode = WAL")
        finally:
            connection.close()
        publish_new(partial, path)
        # Of a store that was removed; nobody has opened the new one yet.
        for leftover in _sqlite_companions(path):
            leftover.unlink(missing_ok=True)
    except FileExistsError:
        raise _store_exists(path) from None
    except sqlite3.Error as error:
        raise _store_error(path, error, kind) from None
    except OSError as error:
        raise ProductError(f"cannot write {path}: {error.strerror or error}") from None
    finally:
        with suppress(OSError):
            for leftover in (partial, *_sqlite_companions(partial)):
                leftover.unlink(missing_ok=True)


def _store_exists(path: Path) -> ConfigError:
    """Return the error for a new study whose store is there already."""
    return ConfigError(f"{path} exists: go on with it by --resume, or give another -o")


def readable_rows(path: Path) -> Iterator[tuple[int, str, str | None]]:
    """Yield number, parameters and metrics (JSON) of every readable point of a damaged store."""
    try:
        connection = sqlite3.connect(f"file:{path}?mode=ro", uri=True)
    except sqlite3.Error:
        return
    try:
        last = next(iter(connection.execute("SELECT max(number) FROM points")), (None,))[0]
    except (sqlite3.Error, ValueError):
        last = None
    # A damaged number may be any; a row takes more than a byte.
    for number in range(min(last + 1, path.stat().st_size) if isinstance(last, int) else 0):
        with suppress(sqlite3.Error, ValueError):
            yield from connection.execute(
                "SELECT number, parameters, metrics FROM results JOIN points USING (number) WHERE number = ?", (number,)
            )
    connection.close()


def check_same_sweep(store: SweepStore, sweep: StoredStudy) -> None:
    """Refuse another study than that of the store, in one line with the differences."""
    if store.about.get("digest") == sweep.digest:
        return
    changed = differences(json.loads(store.about["sweep"]), sweep.model_dump(mode="json"))
    shown = "; ".join(changed[:4]) + (f"; and {len(changed) - 4} more" if len(changed) > 4 else "")
    raise ConfigError(
        f"{store.path}: store of another {store.kind.name} ({shown or 'other file contents'}); give another -o"
    )


def exact_json(value: Any) -> str:
    """Return canonical JSON in which every double keeps all its digits; not-a-number becomes null."""
    plain = plain_values(value, digits=None)
    return json.dumps(plain, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)


def _point_result(number: int, metrics: str | None, problem: str | None, seconds: float, worker: str) -> PointResult:
    values = None if metrics is None else {k: float("nan") if v is None else v for k, v in json.loads(metrics).items()}
    return PointResult(number, values, problem, seconds, worker)


def _sqlite_companions(path: Path) -> Sequence[Path]:
    """Return the files that SQLite keeps beside a store."""
    return [path.with_name(path.name + ending) for ending in ("-wal", "-shm", "-journal")]


def _store_error(path: Path, error: sqlite3.Error, kind: StoreKind) -> ProductError:
    """Return an error of SQLite as one line with the remedy."""
    text = str(error)
    if "full" in text or "disk I/O" in text:
        return ProductError(f"cannot write {path}: {text}; what was computed before is kept, go on with --resume")
    if "readonly" in text or "unable to open" in text:
        return ProductError(f"cannot write {path}: {text}; expected a file and a folder that can be written")
    if "locked" in text:
        return ProductError(f"cannot write {path}: {text}; is another {kind.name} writing to it?")
    if "malformed" in text or "not a database" in text or "no such table" in text:
        return _damaged_error(path, error, kind)
    return ProductError(text, file=path)


def _damaged_error(path: Path, error: Exception, kind: StoreKind) -> DamagedStoreError:
    text = cut_short(" ".join(str(error).split()), 120)
    return DamagedStoreError(f"damaged, or no store of {kind.article} ({text}); {kind.rescue}", file=path)
