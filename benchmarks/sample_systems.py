"""Differences of a design from a peer's, as the benchmarks beside optiland and ray-optics print them.

Columns are the largest differences over the fields of the file at its primary wavelength: focal length, F-number and
pupil diameter (relative) with the places of the pupils (relative to the focal length); landing points; rms radii of
spots of the same rays; OPD on the sphere through the exit pupil, by the peer's formula and (path) by sums of the
segments of its rays; foci of rays close to the chief ray; distortion in percent; contrast at frequencies below 0.9 of
the cut-off, against the peer's and (Huygens) against the sum of plane waves of its rays at the edge of the field.
Times are of a million rays without aiming, launch included, one thread, by processor time, taken in turns; the peers
trace fewer, scaled up.
"""

import math
import time
from dataclasses import dataclass

import numpy as np

import pachon
from pachon import Request

RAYS, ROUNDS = 1_000_000, 3


@dataclass(frozen=True)
class Differences:
    """Largest differences of one system from a peer."""

    paraxial: float  #: relative
    ray: float  #: landing points, m
    spot: float  #: rms radii, m
    opd: float  #: waves
    focus: float = math.nan  #: tangential and sagittal foci, m
    distortion: float = math.nan  #: percent
    mtf: float = math.nan  #: contrast by the peer's FFT of the pupil
    huygens: float = math.nan  #: contrast by the sum of plane waves of the peer's rays
    path: float = math.nan  #: OPD by the sum of segments of the peer's rays, waves


COLUMNS = {
    "paraxial": ("paraxial", 1.0),
    "ray": ("rays nm", 1e9),
    "spot": ("spots nm", 1e9),
    "opd": ("OPD waves", 1.0),
    "path": ("path waves", 1.0),
    "focus": ("focus um", 1e6),
    "distortion": ("distort %", 1.0),
    "mtf": ("its MTF", 1.0),
    "huygens": ("Huygens", 1.0),
}


def paraxial_difference(ours, theirs):
    """Largest relative difference of focal length, F-number, pupil diameter; of places, over the focal length."""
    scale = abs(theirs["focal_length"])
    ratios = [ours[k] / theirs[k] - 1 for k in ("focal_length", "f_number", "entrance_pupil_diameter")]
    places = [(ours[k] - theirs[k]) / scale for k in ("entrance_pupil", "exit_pupil", "back_focus")]
    return float(np.abs([*ratios, *places]).max())


def our_first_order(telescope):
    """Return first-order data [m]; places along the light from the first surface and from the image."""
    found, image = pachon.first_order(telescope), telescope.surfaces[-1].vertex[2]
    # Along the light, which reverses at each mirror.
    after = -1.0 if sum(s.interaction == pachon.Interaction.MIRROR for s in telescope.surfaces) % 2 else 1.0
    return {
        "focal_length": found.focal_length,
        "f_number": found.f_number,
        "entrance_pupil_diameter": found.entrance_pupil_diameter,
        "entrance_pupil": telescope.surfaces[0].vertex[2] - found.entrance_pupil_z,
        "exit_pupil": after * (image - found.exit_pupil_z),
        "back_focus": after * (image - found.focus_z),
    }


def image_waves(telescope, field, wavelength, radius, points):
    """Return landing points [m] and OPD [waves] of pupil points [n, 2] in units of the radius of the pupil."""
    request = Request.of(telescope, field, wavelength, sampling="square", n_pupil=4)
    bundles = request.bundles(wavelength, points * 0.5 * telescope.pupil_diameter)
    return bundles.landing()[0], bundles.opd(radius)[0] / wavelength


def timed(work):
    start = time.process_time()
    work()
    return time.process_time() - start


def show_head(peer):
    heads = " ".join(f"{title:>10s}" for title, _ in COLUMNS.values())
    print(f"{peer:40s} {heads} {'peer s':>8s} {'ours':>6s} {'ratio':>7s}")


def show(name, found, times):
    numbers = " ".join(f"{getattr(found, key) * scale:10.1e}" for key, (_, scale) in COLUMNS.items())
    print(f"{name:40s} {numbers} {times[0]:8.2f} {times[1]:6.3f} {times[0] / times[1]:7.1f}", flush=True)
