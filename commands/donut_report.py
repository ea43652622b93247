"""Frames, conventions, hexapod corrections and orientation of a fit of donuts, as text and JSON."""

from __future__ import annotations

from math import degrees
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ..sensing.frames import DonutFrames
    from ..sensing.observatory_zernikes import BodyMotions, ObservatoryZernikes
    from ..sensing.orientation import OrientationCheck
    from .donut_inputs import DonutInputs


def orientation_text(check: OrientationCheck, inputs: DonutInputs) -> str:
    """Return the warning of a check that another orientation fits better, with the option that gives it."""
    from ..sensing.frames import stamp_axes_text, stamp_matrix

    better = float(check.chi2.min())
    quality = f"chi-square a pixel {better:.3g} for {check.chi2[0]:.3g}"
    option = ""
    if all((axes == inputs.axes[0]).all() for axes in inputs.axes):
        option = f": try --stamp-axes={stamp_axes_text(inputs.axes[0] @ stamp_matrix(check.best))}"
    return f"stamps fit better mirrored or turned by quarters, {quality} of {len(check.donuts)} donuts{option}"


def observatory_summary(
    frames: DonutFrames,
    converted: ObservatoryZernikes,
    motions: BodyMotions | None,
    orientation: OrientationCheck | None,
) -> dict[str, Any]:
    """Return results in the frame and the convention asked for, by name."""
    import numpy as np

    from ..core.files import plain_values

    angles = {"rotator_deg": frames.rotator, "parallactic_deg": frames.parallactic_angle}
    summary: dict[str, Any] = {
        "observatory": converted.summary()
        | {
            name: None if angle is None else degrees(float(np.asarray(angle, dtype=np.float64)))
            for name, angle in angles.items()
        }
    }
    if motions is not None:
        summary["hexapod_corrections"] = {
            "frame": motions.frame,
            "body": motions.body.tolist(),
            "shift_um": motions.shift.tolist(),
            "shift_error_um": motions.shift_error.tolist(),
            "tilt_arcsec": motions.tilt.tolist(),
            "tilt_error_arcsec": motions.tilt_error.tolist(),
        }
    if orientation is not None:
        summary["orientation"] = {
            "doubtful": orientation.doubtful,
            "decided": orientation.decided,
            "stamp_axes": orientation.stamp_axes.tolist(),
            "chi2_a_pixel": orientation.chi2.tolist(),
        }
    plain: dict[str, Any] = plain_values(summary, digits=None)
    return plain


def motion_rows(motions: BodyMotions) -> tuple[tuple[str, ...], list[tuple[str, ...]], str]:
    """Return headings, rows and caption of the table of hexapod corrections."""
    rows = []
    for body, *values in zip(
        motions.body, motions.shift, motions.shift_error, motions.tilt, motions.tilt_error, strict=True
    ):
        shift, shift_error, tilt, tilt_error = values
        cells = [f"{v:+.2f} +- {e:.2f}" for v, e in zip((*shift, *tilt), (*shift_error, *tilt_error), strict=True)]
        rows.append((str(body), *cells))
    headings = ("body", "dx [um]", "dy [um]", "dz [um]", "rx [arcsec]", "ry [arcsec]", "rz [arcsec]")
    return (
        headings,
        rows,
        f"Hexapod corrections, which undo the motions fitted, along and about axes of {motions.frame}.",
    )
