"""A whole run: CCDs, correlations, focal plane, report."""

from __future__ import annotations

import os
import platform
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ..core.arguments import check_arguments
from ..core.errors import DomainError
from ..core.files import write_bytes, write_json
from ..core.long_work import Execution
from ..core.number_text import counted
from ..core.progress import Reporter
from ..core.second_process import Submit, second_process
from ..core.threads import thread_count
from ..core.version import VERSION
from ..reconstruction.ccd_product import MOMENTS, product_path, read_product
from .ccd_worker import compute_ccds
from .config import Configuration
from .experiment import Experiment
from .focal_plane_stage import apply_focal_plane_model, write_focal_plane_model
from .memory import check_memory
from .report.focal_plane_files import write_focal_plane
from .report.report import build_report
from .run_folder import SUMMARY_NAME, claim_run, finished_ccds, read_reasons, stamp_of, write_reasons
from .simulate.ccd_loop import check_catalogue
from .summary import correlations, run_metrics

REPORT_NAME = "report.html"


@dataclass(frozen=True)
class RunResult:
    """Result of a run.

    Attributes
    ----------
    folder : Path
        Folder of the products.
    report : Path or None
        Path of the report; None while CCDs of other parts are missing.
    summary : dict
        The content of ``summary.json``; empty without a report.
    kept, computed : tuple of str
        CCDs that were done before, and those done now.
    not_modelled : dict of str to str
        CCDs whose PSF cannot be modelled, each with the reason. They enter no metric.
    missing : tuple of str
        CCDs of other parts of the run that are not finished.
    """

    folder: Path
    report: Path | None
    summary: dict[str, Any]
    kept: tuple[str, ...]
    computed: tuple[str, ...]
    not_modelled: dict[str, str]
    missing: tuple[str, ...] = ()


@check_arguments
def run(
    config: Configuration | Experiment,
    folder: Path,
    *,
    strict: bool = False,
    part: tuple[int, int] = (1, 1),
    execution: Execution | None = None,
) -> RunResult:
    """Simulate the CCDs of a configuration, model their PSFs and write the report.

    Every product but ``timings.json`` has the same bytes whenever, wherever on one machine, with however many threads
    and by whatever workers the configuration is run; those of a CCD do not depend on the other CCDs of the run.

    Parameters
    ----------
    config : Configuration or Experiment
        Configuration, or the experiment made from it.
    folder : Path
        Folder of the products, made where missing.
    strict : bool
        Whether a CCD whose PSF cannot be modelled ends the run, which keeps what is finished; else it is reported and
        left out.
    part : (i, n)
        Compute the i-th of n parts of the CCDs, of 1 to n; parts run side by side, on several machines, in one folder.
        Finished CCDs are kept, as on resuming, and the part that ends last writes the report. Parts beyond the number
        of CCDs have nothing to compute. Files not_modelled_CCD.json tell parts of CCDs that cannot be modelled.
    execution : Execution, optional
        Workers that compute the CCDs, threads, whether to keep finished CCDs and add to them, and progress display.

    Raises
    ------
    PachonError
        If the configuration does not hold together, a product cannot be written, or no CCD can be modelled; with
        `strict`, if one of them cannot.
    """
    execution = execution or Execution()
    threads, reporter = execution.threads, execution.reporter
    experiment = config if isinstance(config, Experiment) else Experiment.from_config(config)
    names = experiment.config.ccds or ()
    number, parts = part
    if not 1 <= number <= parts:
        raise DomainError(f"part = {number}/{parts}: expected i/n with i from 1 to n")
    # Before the screens, which take longer than all of the checks.
    check_catalogue(experiment, names, strict=strict)
    if parts > 1:
        execution = replace(execution, resume=True)
    finished_names = finished_ccds(folder, experiment) if execution.resume else ()
    unfinished_ccds = tuple(name for name in names[number - 1 :: parts] if name not in finished_names)
    # The report of a finished run needs no screens.
    if unfinished_ccds and execution.alone:
        check_memory(experiment, threads)
    with second_process(threads) as submit:
        claim_run(folder, experiment, resume=execution.resume)
        if experiment.star_list is not None:
            reporter.line(experiment.star_list.text)
        if finished_names:
            reporter.line(f"{len(finished_names)} of {counted(len(names), 'CCD is', 'CCDs are')} finished already")
        focal_plane = submit(write_focal_plane, experiment, folder)
        submit(_load_plots)
        failed: dict[str, str] = {}
        if unfinished_ccds:
            failed = compute_ccds(experiment, folder, unfinished_ccds, execution, strict=strict)
        computed = tuple(name for name in unfinished_ccds if name not in failed)
        if parts > 1:
            # Other parts may have ended meanwhile.
            other_ccds = [name for name in names if name not in (*finished_names, *unfinished_ccds)]
            finished = finished_ccds(folder, experiment, other_ccds)
            write_reasons(folder, experiment, unfinished_ccds, failed)
            other_failures = read_reasons(folder, experiment, set(other_ccds).difference(finished))
            unfinished = tuple(name for name in other_ccds if name not in (*finished, *other_failures))
            failed = {name: reason for name in names if (reason := (failed | other_failures).get(name)) is not None}
            if unfinished:
                return RunResult(folder, None, {}, finished_names, computed, failed, unfinished)
        with reporter.stage("focal plane"):
            focal_plane()
        summary = _summarize(experiment, folder, failed, submit, threads, reporter)
    write_json(folder / "timings.json", _timings(reporter, threads))
    return RunResult(folder, folder / REPORT_NAME, summary, finished_names, computed, failed)


def _summarize(
    experiment: Experiment,
    folder: Path,
    failed: dict[str, str],
    submit: Submit,
    threads: int | None,
    reporter: Reporter,
) -> dict[str, Any]:
    """Write the summary and the report of the CCDs that are finished, all but the failed ones; return the summary."""
    names = [name for name in experiment.config.ccds or () if name not in failed]
    if not names:
        name, reason = next(iter(failed.items()))
        raise DomainError(f"none of {counted(len(failed), 'CCD')} can be modelled; CCD {name}: {reason}")
    with reporter.stage("products"):
        stamp = stamp_of(experiment)
        # Plots and metrics need no noise-free PSF again, and 189 CCDs of 800 are half a gigabyte.
        products = [read_product(product_path(folder, name), stamp, holdout_images=False) for name in names]
    chi2: dict[str, float] = {}
    warnings: tuple[str, ...] | None = None
    if experiment.config.reconstruction.model == "focal_plane":
        products, model = apply_focal_plane_model(experiment, products, threads=threads, reporter=reporter)
        with reporter.stage("products with the focal-plane PSF model"):
            write_focal_plane_model(folder, products, model, stamp)
        warnings, chi2 = model.warnings, {f"chi2_left_out_{name.split()[-1]}": v for name, v in model.chi2.items()}
        for warning in warnings:
            reporter.line(warning)
    with reporter.stage("correlations"):
        correlated, correlated_g = (correlations(products, moments=moments) for moments in MOMENTS)
        origin = {**stamp.meta(), "configuration": experiment.config.as_dict()}
        metrics = run_metrics(products, correlated, correlated_g)
        metrics["all"] |= chi2
        summary = {**origin, **metrics, "not_modelled": failed}
        if experiment.star_list is not None:
            summary["catalogue"] = experiment.star_list.counts
        if warnings is not None:
            summary["warnings"] = list(warnings)
        write_json(folder / SUMMARY_NAME, summary)
    with reporter.stage("report"):
        from .report.pictures import draw_pictures  # matplotlib takes half a second

        pictures = draw_pictures(experiment, products, correlated, correlated_g, submit)
        write_bytes(folder / REPORT_NAME, build_report(experiment, summary, pictures).encode())
    return summary


def _load_plots() -> None:
    """Import the plotting modules, which takes half a second, in the process that draws."""
    from .report import pictures  # noqa: F401


def _timings(reporter: Reporter, threads: int | None) -> dict[str, Any]:
    """Return times and machine, which differ between runs and are therefore in a separate file."""
    return {
        "pachon": VERSION,
        "seconds": reporter.seconds,
        "peak_memory_gib": _peak_memory() / 2**30,
        "threads": thread_count(threads),
        "processors": os.cpu_count(),
        "machine": platform.machine(),
        "python": platform.python_version(),
    }


def _peak_memory() -> float:
    """Return the peak memory of this process [bytes]; NaN where it is unknown."""
    if sys.platform == "win32":
        return float("nan")
    import resource

    # Linux counts kibibytes, macOS bytes.
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1.0 if sys.platform == "darwin" else 1024.0)
