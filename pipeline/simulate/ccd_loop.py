"""The loop over the CCDs of an experiment: expose one CCD while the one before is modelled."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

from ...core.errors import DomainError, PachonError, ProductError, attempt
from ...core.number_text import counted
from ...core.progress import Reporter
from ...core.threads import thread_count
from ..experiment import Experiment
from ..resolved_values import least_star_count
from .ccd_exposure import CcdExposure, ccd_stars, expose_ccds
from .photometry import PROVISIONAL_FWHM
from .star_field import StarField

#: Stars of the CCDs that are exposed together, but for a CCD of more: beyond, what a call costs does not count.
_STARS_TOGETHER = 1000
_T = TypeVar("_T")


@dataclass(frozen=True)
class SimulatedCcds(Generic[_T]):
    """Results of :func:`simulate_ccds`, in the order of the CCDs."""

    results: dict[str, _T] = field(default_factory=dict)  #: by CCD
    not_modelled: dict[str, str] = field(default_factory=dict)  #: reason by CCD


def simulate_ccds(
    experiment: Experiment,
    model: Callable[[Sequence[CcdExposure]], Sequence[_T | PachonError]],
    names: Sequence[str] | None = None,
    *,
    fields: Mapping[str, StarField] | None = None,
    centered: bool = False,
    title: str | None = None,
    strict: bool = True,
    together: int | None = None,
    threads: int | None = None,
    reporter: Reporter | None = None,
) -> SimulatedCcds[_T]:
    """Expose CCDs, a few at a time, and model them beside the next exposures.

    `model` is any reduction of the exposures of a few CCDs, such as :func:`~.model_ccds`: it returns their results in
    order, with the error of a CCD in its place, and none may depend on the other CCDs. It runs on a thread of its own,
    once at a time, in the order of the CCDs; no byte depends on the number of threads. `names` are by default those of
    the configuration, `fields` are the stars of each CCD, by default drawn over it, and `title` is that of the progress
    bar. CCDs that are exposed together have `together` stars, by default as many as a run may lose when it is stopped.
    With `centered` exposures hold the observed stars centred on a pixel as well. A CCD that cannot be modelled ends the
    loop with `strict`, after the models under way; otherwise it is reported and left out.

    Raises
    ------
    PachonError
        If a CCD cannot be exposed or, with `strict`, modelled: one line that starts with the name of the CCD.
    ProductError
        If `model` writes a product and cannot.
    """
    reporter = Reporter(quiet=True) if reporter is None else reporter
    names = (experiment.config.ccds or ()) if names is None else names
    simulated: SimulatedCcds[_T] = SimulatedCcds()
    if fields is None:
        if strict:
            check_catalogue(experiment, names, strict=True)
        for name, reason in _ccds_short_of_stars(experiment, names):
            simulated.not_modelled[name] = reason
            reporter.line(left_out_line(name, reason))
        names = [name for name in names if name not in simulated.not_modelled]
        total = sum(experiment.config.stars.truth + experiment.observed_count(name) for name in names)
    else:
        total = sum(len(f.holdout) + len(f.observed) for f in fields.values())
    overlap = thread_count(threads) > 1
    bar = reporter.stage(title or f"PSFs of {counted(len(names), 'CCD')}", total=total)
    with bar as stage, ThreadPoolExecutor(1) as modeller:
        pending: list[tuple[list[str], Future[Sequence[_T | PachonError]]]] = []

        def submit(exposures: Sequence[CcdExposure]) -> None:
            ccds = [exposure.name for exposure in exposures]
            pending.append((ccds, modeller.submit(model, exposures)))

        def collect() -> None:
            for ccds, future in pending:
                for ccd, result in zip(ccds, future.result(), strict=False):
                    if not isinstance(result, PachonError):
                        simulated.results[ccd] = result
                        continue
                    if isinstance(result, ProductError):
                        raise result
                    if strict:
                        raise result.within(subject=f"CCD {ccd}") from None
                    simulated.not_modelled[ccd] = result.reason
                    reporter.line(left_out_line(ccd, result.reason))
            pending.clear()

        exposed_ccds, groups = 0, _groups(experiment, names, fields, together or _STARS_TOGETHER)
        for exposures in _exposures(experiment, groups, centered=centered, threads=threads, progress=stage.advance):
            collect()
            submit(exposures)
            if not overlap:
                collect()
            for exposure in exposures:
                exposed_ccds += 1
                stage.step(exposure.name, exposed_ccds, len(names))
        collect()
    return simulated


def one_by_one(reduce: Callable[..., _T], *columns: Sequence[Any]) -> list[_T | PachonError]:
    """Return a reduction of each CCD, whose arguments are a row of the columns, with the error of a CCD in its place.

    Nothing comes after a product that cannot be written.
    """
    results: list[_T | PachonError] = []
    for row in zip(*columns, strict=True):
        results.append(attempt(reduce, *row))
        if isinstance(results[-1], ProductError):
            break
    return results


def _groups(
    experiment: Experiment, names: Sequence[str], fields: Mapping[str, StarField] | None, most: int
) -> Iterator[dict[str, StarField]]:
    """Yield the stars of CCDs that are exposed together, by name: as many CCDs as have so many stars at most."""
    group: dict[str, StarField] = {}
    for name in names:
        stars = ccd_stars(experiment, name, PROVISIONAL_FWHM) if fields is None else fields[name]
        if group and sum(map(_star_count, group.values())) + _star_count(stars) > most:
            yield group
            group = {}
        group[name] = stars
    if group:
        yield group


def _star_count(stars: StarField) -> int:
    return len(stars.holdout) + len(stars.observed)


def _exposures(
    experiment: Experiment,
    groups: Iterable[dict[str, StarField]],
    *,
    centered: bool,
    threads: int | None,
    progress: Callable[[int], None],
) -> Iterator[list[CcdExposure]]:
    """Yield the exposures of groups of CCDs; an error starts with the name of the CCD, after the CCDs before it."""
    for group in groups:
        together = None
        if len(group) > 1:
            # An error is that of one CCD: they are then exposed one by one.
            with suppress(PachonError):
                together = expose_ccds(experiment, group, centered=centered, threads=threads, progress=progress)
        if together is not None:
            yield together
            continue
        for name, stars in group.items():
            try:
                alone = expose_ccds(experiment, {name: stars}, centered=centered, threads=threads, progress=progress)
            except PachonError as error:
                raise error.within(subject=f"CCD {name}") from None
            yield alone


def check_catalogue(experiment: Experiment, names: Sequence[str], *, strict: bool) -> None:
    """Raise DomainError if no CCD has enough stars of the catalogue for its model, or with `strict` if one has not.

    Nothing is checked where stars are drawn.
    """
    short = dict(_ccds_short_of_stars(experiment, names))
    if short and (strict or len(short) == len(names)):
        name, reason = next(iter(short.items()))
        raise DomainError(reason, subject=f"CCD {name}")


def _ccds_short_of_stars(experiment: Experiment, names: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yield the CCDs on which the catalogue of stars has too few for a PSF model, each with the reason."""
    if experiment.star_list is not None:
        least = least_star_count(experiment.config)
        for name in names:
            count = experiment.observed_count(name)
            if count < least:
                stars = counted(count, "star")
                yield name, f"{stars} of {experiment.star_list.name} on it: expected at least {least}"


def left_out_line(name: str, reason: str) -> str:
    """Return the line that reports a CCD that is left out."""
    return f"CCD {name} is left out, it cannot be modelled: {reason}"
