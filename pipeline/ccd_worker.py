"""CCDs of a run, computed in this process or by workers.

A worker keeps the phase screens of its last CCD for the next one.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from ..core.errors import ProductError
from ..core.long_work import Execution
from ..core.number_text import counted
from .experiment import Experiment
from .memory import check_memory
from .run_folder import write_ccds
from .screen_cache import with_cached_screens
from .simulate.ccd_loop import left_out_line, simulate_ccds


def compute_ccds(
    experiment: Experiment, folder: Path, names: Sequence[str], execution: Execution, *, strict: bool
) -> dict[str, str]:
    """Write the products of CCDs; return those that cannot be modelled, each with the reason.

    Raises
    ------
    PachonError
        If a CCD cannot be exposed, its product cannot be written, a worker is lost, or, with `strict`, a CCD cannot be
        modelled.
    """
    threads, reporter = execution.threads, execution.reporter
    if execution.alone:
        # Some CCDs are exposed while those before are modelled.
        with experiment.screens(threads, reporter):
            write = partial(write_ccds, experiment, folder)
            return simulate_ccds(
                experiment, write, names, strict=strict, threads=threads, reporter=reporter
            ).not_modelled
    not_modelled: dict[str, str] = {}
    with execution.results(
        partial(compute_ccd, experiment),
        [f"CCD {name}" for name in names],
        names,
        title=f"PSFs of {counted(len(names), 'CCD')}",
        folder=folder,
        check=lambda processes: check_memory(experiment, 1, copies=processes),
    ) as results:
        for name, reason in zip(names, results, strict=True):
            if reason is None:
                continue
            if strict:
                raise ProductError(reason, subject=f"CCD {name}")
            not_modelled[name] = reason
            reporter.line(left_out_line(name, reason))
    return not_modelled


def compute_ccd(experiment: Experiment, name: str, threads: int, folder: Path) -> str | None:
    """Write the product of a CCD as the job of a worker; or return the reason why it cannot be modelled."""
    experiment = with_cached_screens(experiment)
    experiment.make_screens(threads)
    write = partial(write_ccds, experiment, folder)
    return simulate_ccds(experiment, write, (name,), strict=False, threads=threads).not_modelled.get(name)
