"""Builder of design commands, with the options, tables and pictures that all of them have.

A command is one function that takes the options of all design commands as :class:`SharedOptions`, has the command's own
options as further parameters, and returns a result with ``summary()`` and ``plot()``. Its name and docstring are those
of the command; :func:`design_command` adds the shared options, and the columns of the table.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypedDict

import typer

from ...core.errors import PachonError
from ...core.file_names import file_name
from ...core.terminal import print_line
from .. import options
from ..imports import import_modules
from ..inputs import load_model, print_doubts
from ..interrupt import interruptible
from ..tables import Column, Rows, numbers_of, print_json

if TYPE_CHECKING:
    import numpy as np
    from matplotlib.figure import Figure

    from ...models.telescope import Telescope
    from ...raytrace.rays import Projection
    from ...wavefront.request import Request

app = typer.Typer()

#: Arguments of functions whose option has another name.
_ARGUMENTS = {"pupil_points": "n_pupil", "rays": "n_pupil"}
#: Modules that every design command imports: prescriptions, the trace and its Warp, pictures.
_NEEDED = (
    "pachon.models.io.prescription",
    "pachon.wavefront.request",
    "matplotlib.figure",
    "matplotlib.backends.backend_agg",
)


class Study(Protocol):
    """The result of a design command."""

    def summary(self) -> dict[str, Any]:
        """Return the metrics by name, units in the names."""

    def plot(self) -> Figure:
        """Draw the picture."""

    def write(self, path: str | Path) -> None:
        """Write the numbers as a table with units."""


@dataclass(frozen=True)
class Outcome:
    """A result with more to show than its command's table."""

    result: Study
    table: Callable[[Any], Rows] | None = None  #: function from the result to a table, in place of the columns
    stem: str | None = None  #: name of the picture without its end; by default those of command and telescope
    notes: Sequence[str] = ()  #: lines below the table
    verdict: str = ""  #: result in one sentence, above the table; that of the table where empty


class TraceOptions(TypedDict):
    """Keyword arguments of every function that traces."""

    projection: Projection
    threads: int | None


@dataclass(frozen=True)
class SharedOptions:
    """The options that design commands share; files are read when they are first used."""

    model: str
    field_deg: Sequence[str] | str | None = None
    wavelength_nm: float | Sequence[float] | None = None
    across_band: int | None = None
    projection: Projection = "zemax"
    aiming: str | None = None
    glass_catalogue: Sequence[Path] | None = None
    lenient: bool = False
    threads: int | None = None
    configuration: int | None = None

    @cached_property
    def telescope(self) -> Telescope:
        """The telescope."""
        telescope = load_model(self.model, self.lenient, self.glass_catalogue or (), self.configuration)
        if self.aiming is not None:
            telescope = telescope.with_design(aiming=self.aiming)
        print_doubts(telescope)
        return telescope

    @cached_property
    def stem(self) -> str:
        """Last part of the names of pictures and files."""
        return file_name(self.telescope.name)

    @cached_property
    def fields(self) -> np.ndarray | None:
        """Field angles [rad], shape [n, 2]; None where none are given."""
        return options.field_list([self.field_deg] if isinstance(self.field_deg, str) else self.field_deg)

    @cached_property
    def wavelength(self) -> float | np.ndarray | None:
        """The wavelength or wavelengths [m]; None where none is given."""
        if isinstance(self.wavelength_nm, float):
            return self.wavelength_nm * 1e-9
        return options.wavelength_list(self.telescope, self.wavelength_nm, self.across_band)

    @property
    def first_arguments(self) -> tuple[Telescope, np.ndarray | None, float | np.ndarray | None]:
        """Telescope, field angles and wavelengths: the first arguments of most functions."""
        return self.telescope, self.fields, self.wavelength

    @property
    def trace_options(self) -> TraceOptions:
        """Projection and threads, as keyword arguments."""
        return {"projection": self.projection, "threads": self.threads}

    @cached_property
    def request(self) -> Request:
        """Telescope, field angles, wavelengths, projection and threads, with their defaults."""
        from ...wavefront.request import Request

        return Request.of(*self.first_arguments, **self.trace_options)

    @property
    def images(self) -> int:
        """The number of images, over fields and wavelengths."""
        return len(self.request.fields) * len(self.request.wavelengths)

    @contextmanager
    def stage(self, title: str, total: int | None) -> Iterator[Callable[[int], None]]:
        """Show progress, and yield the callback that takes the number of items done since the last call."""
        with interruptible(False) as reporter, reporter.stage(title, total) as stage:
            yield stage.advance


def design_command(
    *columns: Column,
    caption: str | Callable[[dict[str, Any]], str] = "",
    left: int = 1,
    band: bool = False,
    most: int | None = None,
    verdict: str | Callable[[dict[str, Any]], str] = "",
) -> Callable[[Callable[..., Study | Outcome]], Callable[..., Study | Outcome]]:
    """Make a command of a function, with the columns of its table, and add it to :data:`app`.

    The caption is a text, with fields of the summary in braces, or a function of the summary; `left` is the number of
    columns of names. With `band` the command takes several wavelengths or the pass band, not one wavelength. Of a
    longer table `most` rows are shown. Above it stands the verdict, a text or function like the caption, or the range
    of a column with a subject.
    """

    def rows(result: Study) -> Rows:
        summary = numbers_of(result.summary())
        # A result has no arc seconds, for example, where there is no sky.
        shown = [column for column in columns if column.key(summary) is not None]
        cells = [column.texts(result, summary) for column in shown]
        text = caption.format_map(summary) if isinstance(caption, str) else caption(summary)
        lines = [*zip(*cells, strict=True)]
        if most is not None and len(lines) > most:
            text += f" Shown are the first {most}, {len(lines) - most} more follow them: --json has all."
        sentence = verdict.format_map(summary) if isinstance(verdict, str) else verdict(summary)
        headlines = [column.verdict(result, summary) for column in shown if column.subject]
        headings = [column.title(summary) for column in shown]
        return Rows(headings, lines[:most], text, left, " ".join(filter(None, (sentence, *headlines))))

    def build(compute: Callable[..., Study | Outcome]) -> Callable[..., Study | Outcome]:
        name = compute.__name__.replace("_", "-")
        parameters, option_names = _parameters(compute, band)

        def command(picture: Path | None, no_picture: bool, table: Path | None, as_json: bool, **values: Any) -> None:
            kind = options.picture_kind(picture, no_picture)
            import_modules(_NEEDED)
            shared = SharedOptions(**{f.name: values[f.name] for f in fields(SharedOptions) if f.name in values})
            try:
                result = compute(shared, **{key: values[key] for key in option_names})
            except PachonError as error:
                option = next((key for key in option_names if error.key == _ARGUMENTS.get(key, key)), None)
                raise error if option is None else error.renamed(f"--{option.replace('_', '-')}") from None
            outcome = result if isinstance(result, Outcome) else Outcome(result)
            path = picture or Path(f"{outcome.stem or f'{name}_{shared.stem}'}.png")
            drawn = not no_picture and (picture is not None or not as_json)
            _deliver(outcome, outcome.table or rows, path if drawn else None, kind, table, as_json)

        # Typer reads the options of a command from its signature.
        command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        command.__annotations__ = {p.name: p.annotation for p in parameters}
        command.__doc__ = inspect.getdoc(compute)
        app.command(name)(command)
        return compute

    return build


def _parameters(compute: Callable[..., Any], band: bool) -> tuple[list[inspect.Parameter], list[str]]:
    """Return the parameters of a command, shared and own, and the names of its own."""
    _, *command_parameters = inspect.signature(compute, eval_str=True).parameters.values()
    single = {"wavelength_nm": (options.WavelengthNm, None)}
    several = {"wavelength_nm": (options.WavelengthsNm, None), "across_band": (options.AcrossBand, None)}
    option_table: dict[str, tuple[Any, Any]] = {
        "model": (options.Model, inspect.Parameter.empty),
        "field_deg": (options.FieldsDeg, None),
        **(several if band else single),
        **{p.name: (p.annotation, p.default) for p in command_parameters},
        "projection": (options.Projection, "zemax"),
        "aiming": (options.Aiming, None),
        "glass_catalogue": (options.GlassCatalogues, None),
        "lenient": (options.Lenient, False),
        "configuration": (options.Configuration, None),
        "picture": (options.Picture, None),
        "no_picture": (options.NoPicture, False),
        "table": (options.TableFile, None),
        "threads": (options.Threads, None),
        "as_json": (options.Json, False),
    }
    # Keyword-only, so that an option without a default may follow one that has a default.
    kind = inspect.Parameter.KEYWORD_ONLY
    parameters = [inspect.Parameter(key, kind, annotation=a, default=d) for key, (a, d) in option_table.items()]
    return parameters, [p.name for p in command_parameters]


def _deliver(
    outcome: Outcome, rows: Callable[[Any], Rows], picture: Path | None, kind: str, table: Path | None, as_json: bool
) -> None:
    """Save picture and table where they have paths, and print the metrics as JSON or as a table."""
    from ...core.files import write_bytes
    from ...core.plotting import picture_bytes

    written = {}
    if picture is not None:
        write_bytes(picture, picture_bytes(outcome.result.plot(), kind))
        written["picture"] = str(picture)
    if table is not None:
        outcome.result.write(table)
        written["table"] = str(table)
    if as_json:
        print_json({**outcome.result.summary(), **written})
        return
    table_rows = rows(outcome.result)
    (replace(table_rows, verdict=outcome.verdict) if outcome.verdict else table_rows).show()
    for note in outcome.notes:
        print_line(note)
    for name, path in written.items():
        print_line(f"{name}: {Path(path).resolve()}")
