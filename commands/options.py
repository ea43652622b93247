"""What the commands share: common options, tables, Ctrl-C, and the way from a file to a configuration."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Protocol

import typer
from rich.console import Console
from rich.table import Table

from ..core.errors import ConfigError, PachonError

if TYPE_CHECKING:
    import numpy as np
    from matplotlib.figure import Figure

    from ..core.progress import Reporter
    from ..models.telescope import Telescope
    from ..pipeline.config import Configuration

Config = Annotated[Path | None, typer.Argument(metavar="CONFIG.yaml", help="Configuration; all has a default.")]
Ccds = Annotated[str | None, typer.Option(help="CCDs, separated by commas: R22_S11,R22_S12.")]
Raft = Annotated[str | None, typer.Option(help="All CCDs of rafts: R22 or R22,R23.")]
TruthStars = Annotated[int | None, typer.Option(help="Noise-free PSFs on each CCD.")]
ObservedStars = Annotated[int | None, typer.Option(help="Observed stars on each CCD.")]
Model = Annotated[str, typer.Argument(help="Bundled model, or path of a prescription.")]
Lenient = Annotated[
    bool, typer.Option("--lenient", help="Of a Zemax or CODE V file: warn about what is not understood, and go on.")
]
FieldDeg = Annotated[str, typer.Option("--field-deg", metavar="X,Y", help="Field angle [deg].")]
WavelengthNm = Annotated[
    float | None, typer.Option("--wavelength-nm", help="Wavelength [nm]; the model's own by default.")
]
FieldsDeg = Annotated[
    list[str] | None,
    typer.Option(
        "--field-deg",
        metavar="X,Y | R",
        help="Field angle [deg], or a distance from the axis along +y; once for each field. "
        "By default five from the axis to the edge.",
    ),
]
WavelengthsNm = Annotated[
    list[float] | None,
    typer.Option("--wavelength-nm", help="Wavelength [nm], once for each; the model's own by default."),
]
AcrossBand = Annotated[
    int | None,
    typer.Option("--across-band", min=2, max=99, metavar="N", help="In their place: so many across the pass band."),
]
Projection = Annotated[str, typer.Option(help="Meaning of the field angles: zemax, gnomonic or postel.")]
Picture = Annotated[
    Path | None,
    typer.Option(
        "--picture", "-o", help="Picture to write, .png, .pdf or .svg; by default named after command and model."
    ),
]
Threads = Annotated[int | None, typer.Option(min=1, help="Threads; all processors by default. No byte depends on it.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="No progress, no table.")]
Json = Annotated[bool, typer.Option("--json", help="Print figures as JSON on standard output, and nothing else there.")]


class Study(Protocol):
    """The result of a design study: figures by name, and a picture."""

    def summary(self) -> dict[str, Any]:
        """Return the figures by name, units in the names."""

    def plot(self) -> Figure:
        """Draw the picture."""


class InterruptedRunError(Exception):
    """A command that Ctrl-C ended; says where what was finished lies."""


@contextmanager
def interruptible(quiet: bool, finished: str = "") -> Iterator[Reporter]:
    """Yield the reporter of a long command, which Ctrl-C ends with one line.

    Parameters
    ----------
    quiet : bool
        Say nothing at all.
    finished : str
        Where the finished parts are, if there are any to come back to.

    Raises
    ------
    InterruptedRunError
        If Ctrl-C was pressed.
    """
    from ..core.interrupt import remembered_interrupts
    from ..core.progress import Reporter

    try:
        with remembered_interrupts() as check:
            yield Reporter(quiet, check)
    except KeyboardInterrupt:
        raise InterruptedRunError(f"interrupted; {finished}" if finished else "interrupted") from None


def resolved_configuration(config: Path | None, **options: object) -> Configuration:
    """Return what a configuration file and the options of the command line ask for, every default filled in.

    Parameters
    ----------
    config : Path, optional
        Configuration file; without one all has its default.
    **options : object
        Values by dotted key, as :func:`~pachon.pipeline.config.with_options` takes them; None where not given.

    Raises
    ------
    PachonError
        If something in the file or the options cannot be had. The line names the file where no option was given: then
        it alone can be at fault.
    """
    from ..pipeline.config import Configuration, load_configuration, with_options
    from ..pipeline.experiment import resolve

    base = Configuration() if config is None else load_configuration(config)
    settings = with_options(base, **options)
    try:
        return resolve(settings, None if config is None else config.parent)
    except PachonError as error:
        if config is None or settings is not base:
            raise
        raise error.within(file=config) from None


def load_model(model: str, lenient: bool = False, glass_catalogues: Sequence[Path] = ()) -> Telescope:
    """Return the telescope of that name or file; what a lenient reader left out goes to standard error, a line each.

    Parameters
    ----------
    model : str
        Bundled model, or path of a prescription.
    lenient : bool
        Of a Zemax or CODE V file: go on where something is not understood.
    glass_catalogues : sequence of Path
        Glass catalogues (.agf) to look glasses up in first.
    """
    from ..core.errors import PrescriptionWarning
    from ..models.io.prescription import load_telescope

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", PrescriptionWarning)
        telescope = load_telescope(model, lenient=lenient, glass_catalogues=glass_catalogues)
    for warning in caught:
        typer.echo(f"pachon: warning: {warning.message}", err=True)
    return telescope


def name_list(text: str, option: str) -> tuple[str, ...]:
    """Return the names in a text with commas.

    Raises
    ------
    ConfigError
        If there is none.
    """
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    if not names:
        raise ConfigError(f"{option} = {text!r}: expected names separated by commas, such as R22_S11,R22_S12")
    return names


def one_name_list(**options: str | None) -> tuple[str, ...] | None:
    """Return the names in the one option that is given; None where none is.

    Parameters
    ----------
    **options : str or None
        What each option says, by its name without dashes.

    Raises
    ------
    ConfigError
        If more than one is given, or if there is no name in it.
    """
    given = [(f"--{name}", text) for name, text in options.items() if text is not None]
    if len(given) > 1:
        *first, last = (f"--{name}" for name in options)
        raise ConfigError(f"{', '.join(first)} and {last}: expected one of them")
    return name_list(given[0][1], given[0][0]) if given else None


def degrees_pair(text: str, option: str) -> tuple[float, float]:
    """Return the two angles [deg] in a text such as ``0,1.2``.

    Raises
    ------
    ConfigError
        If there are not two numbers.
    """
    try:
        x, y = (float(part) for part in text.split(","))
    except ValueError:
        raise ConfigError(f"{option} = {text!r}: expected two numbers in degrees, such as 0,1.2") from None
    return x, y


def field_list(texts: Sequence[str] | None) -> np.ndarray | None:
    """Return the field angles [rad], shape [n, 2], that options such as ``0.3,1.2`` or ``1.75`` ask for.

    Raises
    ------
    ConfigError
        If one is neither one number nor two.
    """
    import numpy as np

    if not texts:
        return None
    return np.deg2rad([degrees_pair(t if "," in t else f"0,{t}", "--field-deg") for t in texts])


def wavelength_list(telescope: Telescope, wavelengths_nm: Sequence[float] | None, across_band: int | None) -> Any:
    """Return the wavelengths [m] that the options ask for; None where they ask for none.

    Raises
    ------
    ConfigError
        If single wavelengths and the band are both asked for.
    """
    import numpy as np

    if wavelengths_nm and across_band:
        raise ConfigError("--wavelength-nm and --across-band: expected one of them")
    if across_band:
        return np.linspace(*(telescope.band or telescope.wavelength_range), across_band)
    return np.array(wavelengths_nm) * 1e-9 if wavelengths_nm else None


def picture_kind(picture: Path | None) -> str:
    """Return the format of a picture by the end of its name; png where there is no name.

    Raises
    ------
    ConfigError
        If it is none that can be written.
    """
    kind = "png" if picture is None else picture.suffix.lower().removeprefix(".")
    if kind not in ("png", "pdf", "svg"):
        raise ConfigError(f"--picture = {picture}: expected a name that ends in .png, .pdf or .svg")
    return kind


def deliver(result: Study, stem: str, picture: Path | None, as_json: bool, show: Callable[[], None]) -> None:
    """Save the picture of a study's result, and print its figures.

    Parameters
    ----------
    result : Study
        What has ``summary()`` and ``plot()``.
    stem : str
        Name of the picture, without its end, where no other is asked for.
    picture : Path, optional
        Picture to write.
    as_json : bool
        Print the summary as JSON, and nothing else.
    show : callable
        Prints the figures as a table.
    """
    from ..core.files import json_text, write_bytes
    from ..core.plotting import picture_bytes

    kind = picture_kind(picture)
    path = picture or Path(f"{stem}.png")
    write_bytes(path, picture_bytes(result.plot(), kind))
    if as_json:
        print(json_text({**result.summary(), "picture": str(path)}))
        return
    show()
    print(f"picture: {path.resolve()}")


def field_texts(summary: dict[str, Any]) -> list[str]:
    """Return the fields of a summary as text in degrees."""
    return [f"{x:.4g}, {y:.4g}" for x, y in summary["field_deg"]]


def number_texts(values: Iterable[float], form: str) -> list[str]:
    """Return numbers in a format; what rounds to zero has no minus sign."""
    texts = [format(v, form) for v in values]
    return [format(0.0, form) if v == 0.0 else text for v, text in zip(map(float, texts), texts, strict=True)]


def pair_texts(values: Iterable[Iterable[float]], form: str) -> list[str]:
    """Return pairs of numbers in a format, a comma between them."""
    return [", ".join(number_texts(pair, form)) for pair in values]


def wide_console() -> Console:
    """Return a console that cuts no table short: a narrow terminal wraps its lines itself."""
    return Console(width=max(Console().width, 132))


def show_table(
    columns: Sequence[str], rows: Sequence[Sequence[str]], caption: str | None = None, left: int = 1
) -> None:
    """Print a table of figures, and its caption below.

    Parameters
    ----------
    columns : sequence of str
        Headings.
    rows : sequence of sequences of str
        What stands in each row.
    caption : str, optional
        What the columns mean.
    left : int
        How many columns hold names, on the left; the others hold numbers, which stand at the right.
    """
    console = wide_console()
    table = Table(box=None, header_style="bold", padding=(0, 2, 0, 0))
    for i, name in enumerate(columns):
        table.add_column(name.replace("[", "\\["), justify="left" if i < left else "right", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    console.print(table)
    if caption is not None:
        console.print(caption, style="dim", width=100)
