"""Scales of the reproduced figures, and the telescope, run and settings that they share."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from ...core.long_work import Execution
from ...core.products import Stamp
from ...core.progress import Reporter
from ...measure.correlation import Correlation
from ...pipeline.config import Configuration, digest, with_options
from ...pipeline.experiment import Experiment
from ...pipeline.run import run
from ...pipeline.run_folder import stamp_of
from ...pipeline.summary import correlations, run_metrics
from ...reconstruction.ccd_product import CcdProduct, product_path, read_product
from ...wavefront.psf.engines import EngineName
from ..visits.config import VisitsConfig
from ..visits.null_result import NullTest
from ..visits.null_test import null_test
from ..visits.visits import StackResult, stack_visits


@dataclass(frozen=True)
class Scale:
    """Sizes of the figures: those of the paper, or enough for the same conclusions."""

    name: str
    #: Field radii of the encircled energy (Fig. 2).
    field_points: int
    #: Samples on a side of the screens of 1.3 km (Figs. 4, 6 and the run).
    screen_size: int
    #: Samples on a side of the screens of the speckles (Fig. 5), and their side [m].
    speckle_screen: tuple[int, float]
    #: Time step of the speckles [s], and spacing of their pupil points [m].
    speckle_step: float
    speckle_spacing: float
    #: Stars on the CCD of Fig. 6a.
    whisker_stars: int
    #: Stars of each exposure, and exposures, that are correlated for Fig. 6b.
    pair_stars: int
    pair_seeds: int
    #: Stars along the side of a CCD without an atmosphere (Fig. 8).
    optics_grid: int
    #: Spacing of the pupil points without an atmosphere [m] (Figs. 2 and 8).
    optics_spacing: float
    #: Borders between CCDs at which the jump of the ellipticity is measured (Fig. 8).
    borders: int
    #: CCDs of the run of Figs. 9 and 11 to 14, and noise-free and observed stars on each.
    ccds: tuple[str, ...]
    truth: int
    observed: int
    #: Time step of that run, and of Fig. 6 [s].
    time_step: float
    #: Visits of Figs. 15 to 18 and their CCDs, and stars and places per area of a CCD.
    visits: int
    visit_ccds: tuple[str, ...]
    visit_points: tuple[int, int]
    #: Tiles of the sky, of the size of a CCD, whose galaxies are measured, and rings of the shear calibration.
    tiles: int | None
    rings: int


#: The middle CCD of each raft, and a neighbour of it in the rafts R20 to R24: pairs from within a CCD to 3 degrees.
_SOME_CCDS = tuple(f"R{a}{b}_S11" for a in range(5) for b in range(5) if {a, b} - {0, 4}) + tuple(
    f"R2{b}_S12" for b in range(5)
)

SMALL = Scale(
    name="small",
    field_points=8,
    screen_size=2048,
    speckle_screen=(1024, 400.0),
    speckle_step=0.1,
    speckle_spacing=0.04,
    whisker_stars=600,
    pair_stars=200,
    pair_seeds=3,
    optics_grid=1,
    optics_spacing=0.08,
    borders=12,
    ccds=_SOME_CCDS,
    truth=60,
    observed=40,
    time_step=0.1,
    visits=3,
    visit_ccds=("R22",),
    visit_points=(40, 12),
    tiles=1,
    rings=300,
)
PAPER = Scale(
    name="paper",
    field_points=36,
    screen_size=8192,
    speckle_screen=(4096, 650.0),
    speckle_step=0.01,
    speckle_spacing=0.02,
    whisker_stars=4000,
    pair_stars=400,
    pair_seeds=20,
    optics_grid=4,
    optics_spacing=0.04,
    borders=60,
    ccds=("all",),
    truth=800,
    observed=40,
    time_step=0.05,
    visits=100,
    visit_ccds=("all",),
    visit_points=(40, 20),
    tiles=None,
    rings=5000,
)
SCALES = {"small": SMALL, "paper": PAPER}


@dataclass(frozen=True)
class PipelineRun:
    """Run of the pipeline of Figs. 9 and 11 to 14: CCDs without noise-free stamps, correlations by kind, metrics."""

    experiment: Experiment
    products: list[CcdProduct]
    correlated: dict[str, Correlation]
    summary: dict[str, Any]


@dataclass(eq=False)
class Bench:
    """Settings of the figures, and objects that they share, each made at its first use.

    The run of the pipeline is in the sub-folder ``run`` of that of the figures, the visits are in ``visits``. Both, and
    the galaxies in the stacks, are computed by the workers of `execution`, on which no result depends.
    """

    scale: Scale
    folder: Path
    seed: int = 1
    execution: Execution = field(default_factory=Execution)
    engine: EngineName = "fast"  #: of the PSFs of the run and of the visits

    @property
    def threads(self) -> int | None:
        """Number of threads; all processors by default."""
        return self.execution.threads

    @property
    def reporter(self) -> Reporter:
        """Progress display."""
        return self.execution.reporter

    @property
    def _resumed(self) -> Execution:
        return replace(self.execution, resume=True)

    @cached_property
    def stamp(self) -> Stamp:
        """Origin, for the headers of FITS files."""
        other_engine = {} if self.engine == "fast" else {"engine": self.engine}
        return Stamp(digest({**asdict(self.scale), "seed": self.seed, **other_engine}), self.seed)

    @cached_property
    def optics(self) -> Experiment:
        """Telescope (r band), camera and CCD heights, without an atmosphere."""
        quiet = with_options(
            Configuration(), ccds=("all",), seed=self.seed, atmosphere__enabled=False, wavelengths_nm=[624.0]
        )
        return Experiment.from_config(quiet)

    @cached_property
    def stack(self) -> StackResult:
        """Stacks of visits, in the sub-folder ``visits``: those that are there already are used."""
        stars, places = self.scale.visit_points
        options = {
            "run__ccds": self.scale.visit_ccds,
            "run__seed": self.seed,
            "run__psf__engine": self.engine,
            "run__atmosphere__screen_size": self.scale.screen_size,
            "run__atmosphere__time_step_s": self.scale.time_step,
            "run__reconstruction__recipe": "paper",
            "visits__count": self.scale.visits,
            "visits__stars": stars,
            "visits__places": places,
        }
        config = with_options(VisitsConfig(), **options)
        return stack_visits(config, self.folder / "visits", execution=self._resumed)

    @cached_property
    def galaxies(self) -> dict[int, NullTest]:
        """Null tests of the stacks, in the same folder."""
        folder, scale = self.stack.folder, self.scale
        return null_test(folder, tiles=scale.tiles, rings=scale.rings, execution=self._resumed)

    @cached_property
    def pipeline(self) -> PipelineRun:
        """Run of the pipeline, which goes on from what its folder has."""
        folder = self.folder / "run"
        options = {
            "ccds": self.scale.ccds,
            "seed": self.seed,
            "psf__engine": self.engine,
            "stars__truth": self.scale.truth,
            "stars__observed": self.scale.observed,
            "atmosphere__screen_size": self.scale.screen_size,
            "atmosphere__time_step_s": self.scale.time_step,
            "reconstruction__recipe": "paper",
        }
        experiment = Experiment.from_config(with_options(Configuration(), **options))
        names = experiment.config.ccds or ()
        # What is whole stays; a run that was killed, or whose files are damaged, is made whole.
        run(experiment.config, folder, strict=True, execution=self._resumed)
        stamp = stamp_of(experiment)
        products = [read_product(product_path(folder, name), stamp, holdout_images=False) for name in names]
        correlated = correlations(products)
        return PipelineRun(experiment, products, correlated, run_metrics(products, correlated))
