"""Options of visit lists, and the night that ``pachon visits --list`` computes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Option

from ..core.errors import ConfigError
from ..core.number_text import NumberText, counted
from ..core.terminal import print_line
from . import completion
from .choices import names
from .tables import Rows, print_json, write_rows

if TYPE_CHECKING:
    from ..pipeline.config import Configuration
    from ..pipeline.experiment import Experiment
    from ..sky.visit_list.visit_list import ListedVisit
    from ..studies.night.config import NightConfig
    from ..studies.night.night import NightResult

ListFile = Annotated[
    Path | None,
    Option("--list", metavar="FILE", help="List of visits: a database of a scheduler, a table, or a catalogue."),
]
Where = Annotated[str | None, Option(metavar="CONDITION", help="Of a list: condition on its columns, in SQL.")]
Bands = Annotated[
    str | None,
    names(
        completion.words("u", "g", "r", "i", "z", "y"),
        "--band",
        listed=True,
        metavar="BAND,...",
        help="Of a list: bands to take, as r,i.",
    ),
]
Night = Annotated[int | None, Option(min=0, help="Of a list: night to take, YYYYMMDD or its number.")]
VisitNumber = Annotated[int | None, Option("--visit", min=0, help="Of a list: number of the visit.")]

_CAPTION = (
    "Medians over visits and CCDs: rms width and effective area of the PSF, limiting magnitude (S/N 5), effective "
    "time. Last, rms of the ellipticity that the PSF models leave where no star is."
)


def part_of(text: str | None) -> tuple[int, int]:
    """Return the two numbers of a part such as 3/8; all is 1/1."""
    try:
        number, parts = (1, 1) if text is None else (int(word) for word in text.split("/"))
    except ValueError:
        raise ConfigError(f"--part = {text}: expected I/N, such as 3/8") from None
    return number, parts


def require_list(*options: tuple[str, object]) -> None:
    """Raise ConfigError if an option of a list is given without one."""
    for option, value in options:
        if value is not None:
            raise ConfigError(f"{option}: expected --list with it, the list of visits")


def names_list(config: Path) -> bool:
    """Return whether a configuration of visits names a list of them."""
    from ..core.yaml_reader import read_mapping

    visits = read_mapping(config, ConfigError).get("visits")
    return isinstance(visits, dict) and "list" in visits


def night_settings(config: Path | None, set_texts: Sequence[str] | None, **options: object) -> NightConfig:
    """Return the settings of a night from a file, values of `--set` and options by key, None where not given."""
    from ..core.set_keys import with_set_keys
    from ..pipeline.config import with_options
    from ..studies.night.config import NightConfig, load_night_configuration

    base = NightConfig() if config is None else load_night_configuration(config)
    return with_options(with_set_keys(base, set_texts or ()), **options)


def listed_visit(
    config: Configuration,
    path: Path,
    number: int | None,
    where: str | None,
    band: str | None,
    night: int | None,
    folder: Path | None = None,
) -> ListedVisit:
    """Return the visit of a number of a list, or the only one of a selection.

    Relative paths in the configuration start from the folder, that of the list from the current one.
    """
    from ..core.errors import DomainError
    from ..studies.night.config import ListSection, read_section

    section = ListSection(list=str(path.absolute()), where=where, band=band, night=night)
    visits = read_section(section, config, folder)
    for remark in visits.remarks:
        print_line(f"pachon: {path.name}: {remark}", error=True)
    if number is not None:
        return visits.of_visit(number)
    if len(visits) > 1:
        text = f"{len(visits)} visits: expected one, by --visit or by --where, such as --visit {visits.visit[0]}"
        raise DomainError(text, file=path)
    return visits[0]


def listed_experiment(config: Configuration, visit: ListedVisit, folder: Path | None) -> Experiment:
    """Return the experiment of a visit of a list."""
    from ..core.errors import HeightWarning
    from ..pipeline.listed_visit import visit_experiment
    from .inputs import warnings_shown

    with warnings_shown(HeightWarning):
        return visit_experiment(config, visit, folder)


def show_night(result: NightResult, out: Path, table: Path | None, *, quiet: bool, as_json: bool) -> None:
    """Show what the visits of a list have given."""
    from ..studies.night.report import REPORT_NAME

    if quiet:  # the reporter has printed nothing
        for visit, reason in result.left_out.items():
            print_line(f"pachon: visit {visit} is left out: {reason}", error=True)
    rows = _band_rows(result)
    write_rows(rows, table)
    if as_json:
        print_json(result.summary)
        return
    if quiet:
        return
    rows.show()
    if result.missing:
        print_line(
            f"{counted(len(result.missing), 'visit is', 'visits are')} missing; the last part to end has them all"
        )
    if result.left_out:
        print_line(f"{counted(len(result.left_out), 'visit is', 'visits are')} left out, summary.json has the reasons")
    print_line(f"night: {out.resolve()}")
    print_line(f"report: {(out / REPORT_NAME).resolve()}")


def _band_rows(result: NightResult) -> Rows:
    """Return medians over the visits and CCDs of each band."""
    from ..studies.night.report import verdict

    columns = {
        "psfSigma [pixel]": ("median_psfSigma", ".3f"),
        "psfArea [pixel²]": ("median_psfArea", ".1f"),
        "magLim": ("median_magLim", ".2f"),
        "effTime [s]": ("median_effTime", ".1f"),
        "e1, model": ("rms_modelDeltaE1", ".1e"),
        "e2, model": ("rms_modelDeltaE2", ".1e"),
    }
    rows = [
        (
            band,
            NumberText(metrics["detectors"], ".0f"),
            *(NumberText(metrics.get(key, float("nan")), form) for key, form in columns.values()),
        )
        for band, metrics in result.summary["bands"].items()
    ]
    return Rows(("band", "visits x CCDs", *columns), rows, _CAPTION, verdict=verdict(result.summary))
