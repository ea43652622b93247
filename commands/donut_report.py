"""Frames, conventions, hexapod corrections and orientation of a fit of donuts, as text and JSON."""

from __future__ import annotations

from math import degrees
from typing import TYPE_CHECKING, Any

from ..core.number_text import counted
from ..core.terminal import print_line
from .tables import Rows

if TYPE_CHECKING:
    from ..sensing.frames import DonutFrames
    from ..sensing.observatory_zernikes import BodyMotions, ObservatoryZernikes
    from ..sensing.orientation import OrientationCheck
    from ..sensing.result import DonutFit
    from .donut_inputs import DonutInputs

_CAPTION = (
    "Wavefront beyond the telescope's own: root of the summed squares of the Zernikes, and its error; the largest "
    "terms. Positive where the wavefront leads."
)


def orientation_text(check: OrientationCheck, inputs: DonutInputs) -> str:
    """Return the warning of a check that another orientation fits better, with the option that gives it."""
    from ..sensing.frames import stamp_axes_text, stamp_matrix

    better = float(check.chi2.min())
    quality = f"chi-square a pixel {better:.3g} for {check.chi2[0]:.3g}"
    option = ""
    if all((axes == inputs.axes[0]).all() for axes in inputs.axes):
        option = f": try --stamp-axes={stamp_axes_text(inputs.axes[0] @ stamp_matrix(check.best))}"
    if check.best == "-x,-y":
        # Beside the axis the other side of focus is much like a half turn.
        option += ", unless the defocus has the wrong sign"
    donuts = counted(len(check.donuts), "donut")
    return f"stamps fit better mirrored or turned by quarters, {quality} of {donuts}{option}"


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
        cells = [_motion(v, e) for v, e in zip((*shift, *tilt), (*shift_error, *tilt_error), strict=True)]
        rows.append((str(body), *cells))
    headings = ("body", "dx [um]", "dy [um]", "dz [um]", "rx [arcsec]", "ry [arcsec]", "rz [arcsec]")
    return (
        headings,
        rows,
        f"Hexapod corrections, which undo the motions fitted, along and about axes of {motions.frame}.",
    )


def _motion(value: float, error: float) -> str:
    """Return a motion with its error; a dash for one that is not among the degrees of freedom."""
    return f"{value:+.2f} +- {error:.2f}" if error else "-"


def show_fit(fit: DonutFit, converted: ObservatoryZernikes, motions: BodyMotions | None) -> None:
    """Print the table of a fit, that of hexapod corrections, and remarks."""
    import numpy as np

    scale, unit, form = _unit(converted)
    rows = []
    for i, (x, y) in enumerate(np.rad2deg(converted.fields)):
        if not fit.usable[i]:
            rows.append((f"{x:.4g}, {y:.4g}", fit.reasons[i], *[""] * 5))
            continue
        values, error = converted.values[i] * scale, converted.errors[i] * scale
        largest = ", ".join(f"Z{fit.noll[k]} {values[k]:+{form}}" for k in np.argsort(-np.abs(values))[:3])
        seeing = np.rad2deg(fit.fwhm[i]) * 3600.0
        quality = fit.chi2[i] / fit.n_pixels[i]
        sizes = f"{np.linalg.norm(values):{form}}", f"{np.linalg.norm(error):{form}}"
        rows.append((f"{x:.4g}, {y:.4g}", fit.reasons[i] or "ok", *sizes, largest, f"{seeing:.2f}", f"{quality:.2f}"))
    headings = (
        "field [deg]",
        "flags",
        f"rms [{unit}]",
        f"error [{unit}]",
        f"largest [{unit}]",
        'FWHM ["]',
        "chi2 a pixel",
    )
    caption = f"{_CAPTION} Frame {converted.frame}, convention {converted.convention}."
    Rows(headings, rows, caption, left=2, verdict=fit_verdict(fit, converted)).show()
    if motions is not None:
        Rows(*motion_rows(motions), left=1).show()
    for line in _remarks(fit):
        print_line(line)


def fit_verdict(fit: DonutFit, converted: ObservatoryZernikes) -> str:
    """Return the result of a fit in one sentence, in the frame and the convention of its table."""
    import numpy as np

    usable = np.flatnonzero(fit.usable)
    if not usable.size:
        return "The donut cannot be used." if len(fit) == 1 else f"None of {len(fit)} donuts can be used."
    scale, unit, form = _unit(converted)
    terms = scale * converted.values[usable]
    typical = np.median(terms, axis=0)
    largest = int(np.argmax(np.abs(typical)))
    rms = f"{np.median(np.linalg.norm(terms, axis=1)):{form}} {unit} rms"
    size = f"Z{fit.noll[largest]} ({typical[largest]:+{form}} {unit})"
    if len(fit) == 1:
        return f"The wavefront is off by {rms}, most in {size}."
    return (
        f"{usable.size} of {len(fit)} donuts can be used: by the median the wavefront is off by {rms}, most in {size}."
    )


def _unit(converted: ObservatoryZernikes) -> tuple[float, str, str]:
    """Return the factor to the unit of a table, the unit, and the format of its numbers."""
    units = {"pachon": (1e9, "nm", ".0f"), "ts_wep": (1.0, "um", ".3f")}
    return units.get(converted.convention, (1.0, "waves", ".3f"))


def _remarks(fit: DonutFit) -> list[str]:
    """Return what is to be said of all donuts together, in sentences."""
    from ..sensing.amplifier_steps import step_words
    from ..sensing.flags import DonutFlag

    remarks, exposure = [], fit.exposure
    donuts_fit = counted(len(fit), "donut fits", "donuts fit")
    wrong, ambiguous = (
        int(sum(bool(flag & bit) for flag in fit.flags)) for bit in (DonutFlag.DEFOCUS_SIGN, DonutFlag.AMBIGUOUS_SIDE)
    )
    if wrong:
        remarks.append(
            f"{wrong} of {donuts_fit} the other side of focus: the sign of the defocus is wrong, or stamps are turned "
            "or mirrored."
        )
    if ambiguous:
        remarks.append(f"{ambiguous} of {donuts_fit} both sides of focus: results are those of the side given.")
    if len(fit.amplifier_steps):
        remarks.append(f"Steps between amplifiers were fitted too: {'; '.join(step_words(fit.amplifier_steps))}.")
    if exposure is not None:
        fitted = counted(int(fit.usable.sum()), "donut is", "donuts are")
        remarks.append(
            f"{fitted} fitted as of one telescope (--each-alone: each by itself). By their scatter the air has "
            f"{1e9 * exposure.air_rms:.0f} nm rms, which the errors include, and the fits "
            f"{exposure.noise_scale:.2g} times the variance that they claim."
        )
        remarks += [notice[0].upper() + notice[1:] + "." for notice in exposure.notices]
    return remarks
