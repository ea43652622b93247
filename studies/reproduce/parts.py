"""What every reproduced figure is made of: the scale it is made at, what it shares with others, and what comes out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ...core.files import write_bytes
from ...core.products import Stamp, write_ecsv, write_fits
from ...core.progress import Reporter
from ...core.version import VERSION
from ...models.camera.camera import Camera
from ...models.camera.focal_plane import FocalPlane
from ...models.telescope import Telescope
from ...pipeline.ccd_product import CcdProduct, product_path, read_product
from ...pipeline.config import Configuration, digest, with_options
from ...pipeline.experiment import Experiment
from ...pipeline.measure.correlation import Correlation
from ...pipeline.measure.summary import correlations, run_figures
from ...pipeline.run import run
from ...pipeline.run_folder import finished_ccds, stamp_of

Verdict = Literal["agrees", "differs", "cannot be compared"]
Columns = dict[str, tuple[np.ndarray, str, str]]


@dataclass(frozen=True)
class Scale:
    """How large the figures are made; what the paper used, or enough of it to see the same.

    Attributes
    ----------
    name : str
        Name of the scale.
    field_points : int
        Field radii at which the encircled energy is measured (Fig. 2).
    screen_size : int
        Samples on a side of the screens of 1.3 km (Figs. 4, 6 and the run).
    speckle_screen : tuple of int and float
        Samples on a side of the screens of the speckles (Fig. 5), and their side [m].
    speckle_step, speckle_spacing : float
        Time step of the speckles [s], and the distance of their pupil points [m].
    whisker_stars : int
        Stars on the CCD of Fig. 6a.
    pair_stars, pair_seeds : int
        Stars of each exposure, and exposures of other air, that are correlated for Fig. 6b.
    optics_grid : int
        Stars along the side of a CCD, without an atmosphere (Fig. 8).
    optics_spacing : float
        Distance of the pupil points without an atmosphere [m] (Figs. 2 and 8).
    borders : int
        Borders between CCDs at which the jump of the ellipticity is measured (Fig. 8).
    ccds : tuple of str
        CCDs of the run behind Figs. 9 and 11 to 14.
    truth, observed : int
        Noise-free and observed stars on each of them.
    time_step : float
        Time step of that run, and of Fig. 6 [s].
    """

    name: str
    field_points: int
    screen_size: int
    speckle_screen: tuple[int, float]
    speckle_step: float
    speckle_spacing: float
    whisker_stars: int
    pair_stars: int
    pair_seeds: int
    optics_grid: int
    optics_spacing: float
    borders: int
    ccds: tuple[str, ...]
    truth: int
    observed: int
    time_step: float


#: The middle CCD of each raft, and its right-hand neighbour in the middle row: pairs from within a CCD to 3 degrees.
_SOME_CCDS = tuple(f"R{row}{column}_S11" for row in range(5) for column in range(5) if {row, column} - {0, 4}) + tuple(
    f"R2{column}_S12" for column in range(5)
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
)
SCALES = {"small": SMALL, "paper": PAPER}


@dataclass(frozen=True)
class EcsvData:
    """Numbers behind a figure, as a table: columns as :func:`~pachon.core.products.write_ecsv` takes them."""

    columns: Columns
    meta: dict[str, Any]


@dataclass(frozen=True)
class FitsData:
    """Images behind a figure, as FITS extensions, with cards for the primary header."""

    hdus: list[Any]
    cards: list[tuple[str, Any, str]] = field(default_factory=list)


@dataclass(frozen=True)
class Reproduced:
    """One figure of the paper, made again.

    Attributes
    ----------
    pictures : dict of str to bytes
        PNG pictures, by what is added to the figure's name in the file name: ``""`` for the first.
    data : dict of str to EcsvData or FitsData
        Numbers behind them, named in the same way.
    paper, here : str
        What the paper says, and what came out.
    verdict : {"agrees", "differs", "cannot be compared"}
        Whether the two go together.
    why : str
        The reason of the verdict.
    measured : dict
        The figures behind ``here``; keys end in their unit.
    """

    pictures: dict[str, bytes]
    data: dict[str, EcsvData | FitsData]
    paper: str
    here: str
    verdict: Verdict
    why: str
    measured: dict[str, Any]

    def write(self, folder: Path, name: str, bench: Bench) -> list[str]:
        """Write pictures and data into a folder, each file whole or not at all; return the names of the files."""
        written = []
        origin = {"figure": name, "scale": bench.scale.name, "seed": bench.seed, "pachon": VERSION}
        for suffix, png in self.pictures.items():
            written.append(f"{name}{suffix}.png")
            write_bytes(folder / written[-1], png)
        for suffix, data in self.data.items():
            if isinstance(data, EcsvData):
                written.append(f"{name}{suffix}.ecsv")
                write_ecsv(folder / written[-1], data.columns, {**origin, **data.meta})
            else:
                written.append(f"{name}{suffix}.fits")
                cards = [("FIGURE", name, "of Jee & Tyson 2011"), ("SCALE", bench.scale.name, ""), *data.cards]
                write_fits(folder / written[-1], data.hdus, bench.stamp, cards)
        return written


@dataclass(frozen=True)
class PipelineRun:
    """The run of the pipeline that Figs. 9 and 11 to 14 show.

    Attributes
    ----------
    experiment : Experiment
        What was run.
    products : list of CcdProduct
        Its CCDs, without the noise-free PSFs themselves.
    correlated : dict of str to Correlation
        Correlations of truth, observed stars and both residuals.
    summary : dict
        Its figures, as its own ``summary.json`` has them.
    """

    experiment: Experiment
    products: list[CcdProduct]
    correlated: dict[str, Correlation]
    summary: dict[str, Any]


@dataclass(eq=False)
class Bench:
    """What figures are made with, and what they share, made when first asked for.

    Attributes
    ----------
    scale : Scale
        Size of everything.
    folder : Path
        Where the figures go; the pipeline's run goes into its sub-folder ``run``.
    seed : int
        Seed of all random numbers.
    threads : int or None
        Number of threads; no byte depends on it.
    reporter : Reporter
        Who tells how far the work is.
    """

    scale: Scale
    folder: Path
    seed: int = 1
    threads: int | None = None
    reporter: Reporter = field(default_factory=lambda: Reporter(quiet=True))

    @cached_property
    def stamp(self) -> Stamp:
        """What FITS files carry to say where they come from."""
        return Stamp(digest({**asdict(self.scale), "seed": self.seed}), self.seed)

    @cached_property
    def configuration(self) -> Configuration:
        """The resolved configuration of the pipeline's run."""
        options = {
            "ccds": self.scale.ccds,
            "seed": self.seed,
            "stars__truth": self.scale.truth,
            "stars__observed": self.scale.observed,
            "atmosphere__screen_size": self.scale.screen_size,
            "atmosphere__time_step_s": self.scale.time_step,
        }
        return Experiment.from_config(with_options(Configuration(), **options)).config

    @cached_property
    def optics(self) -> Experiment:
        """The same telescope and focal plane without an atmosphere."""
        quiet = with_options(
            Configuration(), ccds=("all",), seed=self.seed, atmosphere__enabled=False, wavelengths_nm=[624.0]
        )
        return Experiment.from_config(quiet)

    @property
    def telescope(self) -> Telescope:
        """The telescope, r band."""
        return self.optics.telescope

    @property
    def focal_plane(self) -> FocalPlane:
        """The CCD heights."""
        return self.optics.focal_plane

    @property
    def camera(self) -> Camera:
        """The camera."""
        return self.focal_plane.camera

    @property
    def field_radius(self) -> float:
        """Radius of the field of view on the detector [m]."""
        return self.optics.field_radius_on_detector

    @cached_property
    def pipeline(self) -> PipelineRun:
        """The pipeline's run: read where its folder has all of it, else begun or resumed."""
        folder = self.folder / "run"
        experiment = Experiment.from_config(self.configuration)
        names: Sequence[str] = self.configuration.ccds or ()
        if len(finished_ccds(folder, experiment)) < len(names):
            run(self.configuration, folder, resume=True, strict=True, threads=self.threads, reporter=self.reporter)
        stamp = stamp_of(experiment)
        products = [read_product(product_path(folder, name), stamp, truth_images=False) for name in names]
        correlated = correlations(products)
        return PipelineRun(experiment, products, correlated, run_figures(products, correlated))
