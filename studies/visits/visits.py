"""Stack of the PSFs of many visits: the loop over the visits, and its products."""

from __future__ import annotations

import shutil
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ...core.arguments import check_arguments
from ...core.errors import DomainError, PachonError, ProductError
from ...core.files import make_folder, write_bytes, write_json
from ...core.long_work import Execution, claim_folder
from ...core.memory import readable
from ...core.number_text import counted
from ...core.products import Stamp, write_ecsv
from ...core.progress import Reporter
from ...core.units import ARCSEC
from ...pipeline.experiment import Experiment
from ...pipeline.memory import check_memory
from ...pipeline.run_folder import CONFIG_NAME, SUMMARY_NAME
from ..night.config import read_section, require_same_list
from .config import LIST_KEYS, STACK_STAMP, VisitsConfig, load_visits_configuration
from .plan import Visit
from .plots import correlation_picture, ellipticity_picture
from .psf_visit import (
    StackFrame,
    VisitPsfs,
    check_rotators,
    magnitude_limits,
    stack_weight,
    visit_experiment,
    visit_psfs,
)
from .sky_points import SkyPoints, draw_points
from .stack import PsfStack, PsfSums
from .stack_metrics import StackCorrelations, stack_correlations, stack_metrics
from .visit_figures import VisitFigures, figure_columns

#: Sums of the visits so far, from which the stack goes on.
SUMS_NAME = "sums.fits"


@dataclass(frozen=True, eq=False)
class StackResult:
    """Products of :func:`stack_visits`.

    Attributes
    ----------
    folder : Path
        Its products.
    stacks : dict of int to PsfStack
        Stacks by number of visits.
    correlations : dict of int to StackCorrelations
        Their correlations.
    figures : tuple of VisitFigures
        Ellipticities and sizes of each visit.
    summary : dict
        Content of ``summary.json``.
    """

    folder: Path
    stacks: dict[int, PsfStack]
    correlations: dict[int, StackCorrelations]
    figures: tuple[VisitFigures, ...]
    summary: dict[str, Any]


def stack_path(folder: Path, visits: int) -> Path:
    """Return the path of the stack of a number of visits."""
    return folder / f"stack_{visits:04d}.fits"


@check_arguments
def stack_visits(
    config: VisitsConfig,
    folder: Path,
    *,
    experiment: Experiment | None = None,
    execution: Execution | None = None,
) -> StackResult:
    """Visit a field many times, and stack true PSFs and those of the models of each visit's stars.

    Telescope, camera and heights stay; turbulence, residual aberration, noise and roll are each visit's own, and the
    stars of the sky fall where the roll puts them (Jee & Tyson 2011, sec. 6.1). Models are resampled onto the axes of
    the stack as the true PSFs are. Every product has the same bytes on any number of threads, by whatever workers, and
    after any number of interruptions.

    Parameters
    ----------
    config : VisitsConfig
        Configuration.
    folder : Path
        Folder of the products, made where missing.
    experiment : Experiment, optional
        Experiment of the configuration, where it is made already.
    execution : Execution, optional
        Workers that compute the visits; threads; progress display; and whether to go on after the visits that the
        folder has, with more of them than asked for before too.

    Raises
    ------
    PachonError
        If the configuration does not hold together, the folder holds other visits or has no room, or a visit fails.
    """
    execution = execution or Execution()
    threads, reporter = execution.threads, execution.reporter
    experiment = config.experiment() if experiment is None else experiment
    config = config.resolved(experiment)
    stamp = Stamp(config.digest(experiment), experiment.config.seed)
    frame = StackFrame.of(experiment, STACK_STAMP)
    points = sky_points_of(experiment, config, frame)
    visits = config.plan(experiment.config.seed)
    if config.visits.from_list is not None:
        # A star has one magnitude in all visits.
        visits = tuple(replace(visit, star_limits=magnitude_limits(experiment)) for visit in visits)
        listed = read_section(config.visits.from_list, config.run)
        for remark in listed.remarks:
            execution.reporter.line(f"{listed.source}: {remark}")
    check_rotators(experiment, visits)
    make_folder(folder)
    _check_room(folder, points, frame, len(config.kept))
    claim_visits(folder, config, resume=execution.resume)
    sums = _sums_so_far(folder, stamp, PsfSums.empty(len(points), frame.size), execution.resume)
    if sums.visits > len(visits):
        stacked = counted(sums.visits, "visit")
        raise ProductError(f"{folder} holds {stacked}: expected at most {len(visits)}; choose another --out")
    gone = [n for n in config.kept if n <= sums.visits and not stack_path(folder, n).exists()]
    if gone:
        stacked = counted(gone[0], "visit")
        raise ProductError(f"{folder} kept no stack of {stacked}, and has gone on; choose another --out")
    if sums.visits:
        reporter.line(f"{sums.visits} of {counted(len(visits), 'visit is', 'visits are')} stacked already")
    due = visits[sums.visits :]
    # In this process each visit shows its own stages.
    alone = execution.alone
    with execution.results(
        partial(compute_visit, points, frame, reporter if alone else None),
        [visit.label for visit in due],
        ((visit_experiment(experiment, visit), visit) for visit in due),
        title=None if alone else counted(len(due), "visit"),
        check=lambda processes: check_memory(experiment, threads, copies=processes),
    ) as results:
        for visit, psfs in zip(due, results, strict=True):
            if psfs.left_out:
                reporter.line(f"{visit.label}: {_left_out_line(psfs.left_out)}")
            sums.add(psfs)
            if sums.visits in config.kept:
                stack = PsfStack.of(
                    sums, points.sky, points.star, frame.matrix, frame.pixel_scale, experiment.weight_fwhm
                )
                stack.write_product(stack_path(folder, sums.visits), stamp)
            # Written last, so that all visits that it counts are in the stack.
            sums.write(folder / SUMS_NAME, stamp)
    stacks = {n: PsfStack.read(stack_path(folder, n), stamp) for n in config.kept}
    with reporter.stage("correlations"):
        correlated = {n: stack_correlations(stack, cell_of(experiment, frame)) for n, stack in stacks.items()}
    summary = _write_products(folder, config, experiment, stamp, visits, sums.figures, stacks, correlated)
    return StackResult(folder, stacks, correlated, tuple(sums.figures), summary)


def compute_visit(
    points: SkyPoints, frame: StackFrame, reporter: Reporter | None, job: tuple[Experiment, Visit], threads: int
) -> VisitPsfs:
    """Compute the PSFs of one visit with its experiment; workers have no reporter."""
    experiment, visit = job
    if reporter is not None:
        reporter.line(f"{visit.label}, {visit}")
    return visit_psfs(experiment, visit, points, frame, threads=threads, reporter=reporter)


def _left_out_line(reasons: dict[str, str]) -> str:
    """Return one line on the CCDs of a visit that cannot be modelled, such as those at the edge of the stars."""
    (name, reason), *other_reasons = reasons.items()
    if not other_reasons:
        return f"CCD {name} is left out, it cannot be modelled: {reason}"
    return f"{len(reasons)} CCDs are left out, they cannot be modelled; CCD {name}: {reason}"


def cell_of(experiment: Experiment, frame: StackFrame) -> float:
    """Return the angle that the shortest side of a CCD has in the middle of the field [rad]."""
    return float(experiment.camera.shortest_side / experiment.pixel_size * frame.pixel_scale)


def sky_points_of(experiment: Experiment, config: VisitsConfig, frame: StackFrame) -> SkyPoints:
    """Return stars and positions of the sky within reach of the CCDs of a visit."""
    camera, names = experiment.camera, experiment.config.ccds or ()
    corners = camera.corners(camera.ccd_index(name) for name in names)
    reach = min(float(np.hypot(*corners.T).max()), experiment.field_radius_on_detector)
    radius = reach / experiment.pixel_size * frame.pixel_scale + np.deg2rad(config.visits.dither_deg)
    settings = config.visits
    return draw_points(experiment.config.seed, radius, cell_of(experiment, frame), settings.stars, settings.places)


def claim_visits(folder: Path, config: VisitsConfig, *, resume: bool) -> None:
    """Write the configuration, or check that the folder is of the same, but for galaxies and number of visits."""

    def plain(settings: VisitsConfig) -> dict[str, Any]:
        return settings.model_dump(mode="json", by_alias=True)

    path = folder / CONFIG_NAME
    before: VisitsConfig | None = None
    if resume and path.is_file():
        with suppress(PachonError):  # claim_folder says what is wrong with the file
            before = load_visits_configuration(path)
    require_same_list(folder, "visits", None if before is None else before.visits.from_list, config.visits.from_list)
    claim_folder(
        path,
        config.to_yaml().encode(),
        products="stack_*.fits",
        noun="visits",
        now=plain(config),
        read=lambda path: plain(load_visits_configuration(path)),
        # The digest tells the visits of a list, wherever its file lies now.
        free_keys=("galaxies", "visits.count", "visits.snapshots", *LIST_KEYS),
        wanted=resume,
    )


def _sums_so_far(folder: Path, stamp: Stamp, empty: PsfSums, resume: bool) -> PsfSums:
    path = folder / SUMS_NAME
    return PsfSums.read(path, stamp) if resume and path.exists() else empty


def _check_room(folder: Path, points: SkyPoints, frame: StackFrame, stacks: int) -> None:
    """Raise DomainError where the disk cannot hold the sums, twice while they are replaced, and the stacks."""
    needed = 2 * 4 * frame.size**2 * len(points) * (2 + stacks)
    free = shutil.disk_usage(folder).free
    if needed > free:
        raise DomainError(f"{folder}: the stacks need {readable(needed)} of disk, {readable(free)} are free")


def _write_products(
    folder: Path,
    config: VisitsConfig,
    experiment: Experiment,
    stamp: Stamp,
    visits: tuple[Visit, ...],
    figures: list[VisitFigures],
    stacks: dict[int, PsfStack],
    found: dict[int, StackCorrelations],
) -> dict[str, Any]:
    columns = {
        "visit": (np.array([v.number for v in visits]), "", "number of the visit"),
        "epoch": (np.array([v.epoch for v in visits]), "", "of turbulence, residual aberration and noise"),
        "roll": (np.rad2deg([v.roll for v in visits]), "deg", "position angle of the telescope's +y"),
        "xi": (np.array([v.pointing[0] for v in visits]) / ARCSEC, "arcsec", "pointing towards east, gnomonic"),
        "eta": (np.array([v.pointing[1] for v in visits]) / ARCSEC, "arcsec", "pointing towards north"),
    }
    if any(v.rotator_deg is not None for v in visits):
        run = config.run.rotator_deg
        angles = np.array([run if v.rotator_deg is None else v.rotator_deg for v in visits])
        columns["rotator"] = (angles, "deg", "of the camera, from +x towards +y of the telescope")
    listed = [v.listed for v in visits if v.listed is not None]
    if listed:
        weights = [stack_weight(visit_experiment(experiment, v), v) for v in visits]
        columns["visitId"] = (np.array([visit.visit for visit in listed]), "", "number of the visit in the list")
        columns["weight"] = (np.array(weights), "nJy-2", "of its PSFs in the stack, by an inverse variance")
    columns |= figure_columns(figures)
    write_ecsv(folder / "visits.ecsv", columns, {"what": "visits in the order of the stack", **stamp.meta()})
    summary = {
        **stamp.meta(),
        "configuration": config.model_dump(mode="json", by_alias=True),
        "stacks": {str(n): stack_metrics(stacks[n], found[n]) for n in stacks},
    }
    write_json(folder / SUMMARY_NAME, summary)
    write_bytes(folder / "ellipticity.png", ellipticity_picture(stacks))
    write_bytes(folder / "correlation.png", correlation_picture(found))
    write_bytes(folder / "correlation_g.png", correlation_picture(found, "g"))
    return summary
