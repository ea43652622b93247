"""The command ``pachon donuts``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from ..core.errors import PrescriptionWarning
from ..core.number_text import counted
from ..core.terminal import print_line, print_warning
from .donut_fit import DonutWork, oriented
from .donut_options import (
    FitOptions,
    FrameOptions,
    OutputOptions,
    SimulationOptions,
    StampOptions,
    TelescopeOptions,
)
from .donut_report import observatory_summary, orientation_text, show_fit
from .donut_simulation import simulate_file
from .inputs import warnings_shown
from .interrupt import InterruptedRunError, interruptible
from .option_groups import require_defaults, with_option_groups
from .tables import print_json

if TYPE_CHECKING:
    from ..sensing.frames import DonutFrames
    from ..sensing.observatory_zernikes import BodyMotions, ObservatoryZernikes
    from ..sensing.orientation import OrientationCheck
    from ..sensing.result import DonutFit

app = typer.Typer()


@app.command("donuts")
@with_option_groups
def donuts_command(
    telescope: TelescopeOptions,
    stamps: StampOptions,
    fit_options: FitOptions,
    frames: FrameOptions,
    simulation: SimulationOptions,
    output: OutputOptions,
) -> None:
    """Measure the wavefront of out-of-focus stars (donuts): annular Zernikes beyond those of the telescope.

    A file holds a cube of stamps and a table with their fields (field_x, field_y [deg], defocus_um), one stamp an
    extension with keywords FIELD_X, FIELD_Y and DEFOC_UM, or the image of a CCD, with --positions. Of LSSTCam, ComCam,
    LATISS and DECam, and of ts_wep's DonutStamps, headers give camera, detector, pixel, angles, band and gain, and
    extensions MASK, VARIANCE (DQ, WEIGHT, ERR) are read. Stamps have x and y along those of the camera, unless
    --stamp-axes or the header's detector says otherwise. A defocus moves what --moved, a keyword MOVED or a column
    moved names, or the header's camera: Camera (full-array mode of LSSTCam), M2 (AuxTel), DECam, else the detector.
    Bad donuts are flagged with the reason. Two donuts or more are taken to be of one exposure, or of both sides of
    focus: they are fitted together (--each-alone: not).

    **Examples**

    - `pachon donuts donuts.fits --defocus-um 1500 -o wavefronts.ecsv --picture donuts.png`
    - `pachon donuts full_array.fits --moved Camera --defocus-um 1500`
    - `pachon donuts try.fits --simulate --moved Camera --defocus-um 1500 --perturb M2.dx=200um --set stars=8`, then
      `pachon donuts try.fits`: without data of your own; true_Z4 ... stand in the file's table
    - `pachon donuts corner_*.fits -t rubin_v3.14_i --degrees-of-freedom lsst --json`
    - `pachon donuts ccd.fits --positions stars.ecsv --stamp 200 --defocus-um -1500`
    - `pachon donuts donutStamps.fits --frame CCS --convention ts_wep` (as LSST's zk_deviation_CCS)
    - `pachon donuts DECam_*.stamp.fits --defocus-um 1650 --convention donut`
    - `pachon donuts stamps.fits --stamp-axes DVCS --rotator-deg 12.3 --degrees-of-freedom lsst --frame ZCS`
    """
    if simulation.simulate:
        require_defaults("expected without --simulate", stamps, fit_options, frames, output)
        simulate_file(telescope, simulation)
        return
    require_defaults("expected with --simulate alone", simulation)
    fit_options.check()
    kind = output.kind_of_picture()
    work = DonutWork.of(telescope, stamps, frames, fit_options)
    if not telescope.quiet and work.remark:
        print_line(work.remark, error=True)
    if telescope.defocus_um and work.inputs.defocus.any():
        of_files = ", ".join(f"{shift:.4g}" for shift in sorted({1e6 * float(shift) for shift in work.inputs.defocus}))
        print_warning(f"--defocus-um = {telescope.defocus_um:g} is added to the defocus of the files, {of_files} um")
    fit, orientation, interrupted = _fitted(work, telescope.quiet, orientation_check=fit_options.orientation_check)
    converted = fit.zernikes_in(frames.zernike_convention, frames.names[1], frames=work.frames)
    motions = _hexapod_corrections(fit, frames, work.frames)
    _write(fit, converted, output, kind)
    if output.as_json:
        print_json(fit.summary() | observatory_summary(work.frames, converted, motions, orientation))
    elif not telescope.quiet:
        show_fit(fit, converted, motions)
    if interrupted:
        raise InterruptedRunError(_interrupted_text(fit, output.out))


def _fitted(work: DonutWork, quiet: bool, *, orientation_check: bool) -> tuple[DonutFit, OrientationCheck | None, bool]:
    """Fit donuts, check their orientation, and warn of what is wrong with them all.

    The third value is whether Ctrl-C ended it; the fit has the donuts that were finished then.
    """
    from ..sensing.flags import DonutFlag
    from ..sensing.interrupted_fit import InterruptedFitError

    count = len(work.inputs.images)
    fit = orientation = None
    try:
        with (
            warnings_shown(PrescriptionWarning),
            interruptible(quiet, "no donut was finished") as reporter,
            reporter.stage(f"wavefronts of {counted(count, 'donut')}", total=count) as stage,
        ):
            try:
                fit = work.fit(stage.advance)
            except InterruptedFitError as stopped:
                fit = stopped.fit
                raise
            orientation = work.orientation(fit) if orientation_check else None
    except InterruptedRunError:
        if fit is None:
            raise
        return fit, None, True
    if not work.is_defocused(fit):
        print_warning(
            "defocus is 0 um, that of the files and --defocus-um together: stars are fitted as in focus. Of donuts, "
            "give --defocus-um, DEFOC_UM or a column defocus_um"
        )
    if orientation is not None and orientation.doubtful:
        fit = replace(fit, flags=fit.flags | oriented(fit) * int(DonutFlag.ORIENTATION))
        print_warning(orientation_text(orientation, work.inputs))
    return fit, orientation, False


def _interrupted_text(fit: DonutFit, out: Path | None) -> str:
    """Return how many donuts an interrupted fit has, and where they are."""
    from ..sensing.flags import DonutFlag

    lost = int((fit.flags & int(DonutFlag.INTERRUPTED) > 0).sum())
    return f"interrupted; {len(fit) - lost} of {counted(len(fit), 'donut')} fitted" + (f", in {out}" if out else "")


def _hexapod_corrections(fit: DonutFit, options: FrameOptions, frames: DonutFrames) -> BodyMotions | None:
    """Return the motions that undo the degrees of freedom of a fit, where it has any."""
    from ..sensing.observatory_zernikes import hexapod_corrections

    if fit.degrees_of_freedom is None:
        return None
    frame = options.names[1]
    return hexapod_corrections(fit.degrees_of_freedom, frame="OCS" if frame == "DVCS" else frame, frames=frames)


def _write(fit: DonutFit, converted: ObservatoryZernikes, output: OutputOptions, kind: str) -> None:
    """Write the table and the picture of a fit, where they are asked for."""
    from ..core.files import write_bytes
    from ..core.plotting import picture_bytes
    from ..core.table_files import in_format_of, write_table

    if output.out is not None:
        # The default is a table without a word of frames.
        plain = converted.convention == "pachon" and converted.frame == "OCS"
        wavefronts = fit.to_table() if plain else converted.in_table(fit.to_table())
        write_table(output.out, in_format_of(output.out, wavefronts))
    if output.picture_path is not None:
        write_bytes(output.picture_path, picture_bytes(fit.plot(), kind))
