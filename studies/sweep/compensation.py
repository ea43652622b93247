"""Compensators of an experiment: focus, tilt and the like, solved for the smallest spots before it is measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ...design.optimize.merit import SpotMerit
from ...design.optimize.optimize import beams, optimize
from ...design.parameters.changes import parse_change
from ...pipeline.experiment import Experiment
from ...wavefront.chief_rays import fields_at

# Places on each CCD at which spots count, in units of half its side: the centre, and where CCDs are few also the
# middles of its quarters.
_PLACES = np.array([[0.0, 0.0], [0.5, 0.5], [0.5, -0.5], [-0.5, 0.5], [-0.5, -0.5]])
_FEW = 40
# Rings of pupil points: the mean square radius of a spot is exact to the aberrations that they can tell apart.
_RINGS = 4
#: Relative change of the mean square radius at which the solver stops: figures of a sweep then stand to six digits.
_TOLERANCE = 1e-9


def compensated(
    experiment: Experiment, names: Sequence[str], threads: int | None = None
) -> tuple[Experiment, dict[str, float]]:
    """Return the experiment with compensators at their best, and their values.

    Best is the smallest mean square spot radius over the CCDs of the configuration, on their surfaces, at the middle
    wavelength.

    Parameters
    ----------
    experiment : Experiment
        The experiment; it stays as it is.
    names : sequence of str
        Changes of the prescription with their units, such as Camera.dz_um and Camera.rx_urad.
    threads : int, optional
        Number of threads; no byte depends on it.

    Returns
    -------
    tuple of Experiment and dict
        The values by name, in the unit of the name.

    Raises
    ------
    PachonError
        If there is no such parameter, or one has no effect.
    """
    if not names:
        return experiment, {}
    telescope, camera = experiment.telescope, experiment.camera
    chosen = [parse_change(telescope, name) for name in names]
    centers = camera.centers[[camera.ccd_index(name) for name in experiment.config.ccds or ()]]
    each = _PLACES if len(centers) <= _FEW else _PLACES[:1]
    places = (centers[:, None] + each * camera.half_size).reshape(-1, 2)
    wavelength = float(experiment.wavelengths[len(experiment.wavelengths) // 2])
    fields = fields_at(telescope, places, wavelength, threads=threads)
    rays = beams(telescope, fields, [wavelength], count=_RINGS, threads=threads)
    merit = SpotMerit(telescope, rays, heights=experiment.focal_plane.height(*places.T))
    found = optimize(
        telescope, [p for p, _ in chosen], merit, fields, [wavelength], tolerance=_TOLERANCE, threads=threads
    )
    values = {name: float(v / factor) for name, v, (_, factor) in zip(names, found.changes, chosen, strict=True)}
    return replace(experiment, telescope=found.telescope), values
