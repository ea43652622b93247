"""Compensators of an experiment, such as focus and tilt, solved for the smallest spots."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from ...design.optimize.merit import Beams, SpotMerit
from ...design.optimize.merit_function import MeritName
from ...design.optimize.optimize import optimize
from ...design.optimize.solver import LeastSquares
from ...models.parameters.changes import parse_change
from ...models.telescope import Telescope
from ...pipeline.experiment import Experiment
from ...wavefront.chief_rays import fields_at
from ...wavefront.silicon_focus import focus_height

# Positions of the spots on each CCD, in units of half its side: the centre and, for few CCDs, the middles of its
# quarters.
_PLACES = np.array([[0.0, 0.0], [0.5, 0.5], [0.5, -0.5], [-0.5, 0.5], [-0.5, -0.5]])
_FEW = 40
# Rings of pupil points: the mean square radius of a spot is exact for the aberrations that they resolve.
_RINGS = 4
#: Relative change of the mean square radius at which the solver stops: metrics of a sweep then have six digits.
_TOLERANCE = 1e-9


def compensated(
    experiment: Experiment, names: Sequence[str], threads: int | None = None
) -> tuple[Experiment, dict[str, float]]:
    """Return the experiment with compensators at their best, and their values in the units of their names.

    `names` are changes of the prescription, such as Camera.dz_um. The mean square spot radius is minimized on the
    surfaces of the CCDs of the configuration, at the middle wavelength. A compensator without effect is a PachonError.
    """
    if not names:
        return experiment, {}
    telescope, camera = experiment.telescope, experiment.camera
    ccds = np.array([camera.ccd_index(name) for name in experiment.config.ccds or ()])
    field_places = _PLACES if len(ccds) <= _FEW else _PLACES[:1]
    places = camera.from_uv(ccds[:, None], field_places).reshape(-1, 2)
    wavelength = float(experiment.wavelengths[len(experiment.wavelengths) // 2])
    fields = fields_at(telescope, places, wavelength, threads=threads)
    rays = Beams.of(telescope, fields, [wavelength], n_pupil=_RINGS, threads=threads)
    heights = experiment.focal_plane.height(*places.T)
    if experiment.silicon is not None:
        # Spots are smallest where the light turns into charge.
        heights = heights - focus_height(telescope, experiment.silicon, wavelength, threads)
    merit = SpotMerit(telescope, rays, heights=heights)
    optimized, values = solved_compensators(telescope, names, merit, fields, [wavelength], threads)
    return replace(experiment, telescope=optimized), values


def solved_compensators(
    telescope: Telescope,
    names: Sequence[str],
    merit: SpotMerit | MeritName,
    fields: np.ndarray | None,
    wavelengths: ArrayLike | None,
    threads: int | None,
) -> tuple[Telescope, dict[str, float]]:
    """Return the telescope with compensators at the smallest merit, and their values in the units of their names."""
    changes = [parse_change(telescope, name, "compensators") for name in names]
    parameters, solver = [parameter for parameter, _ in changes], LeastSquares(_TOLERANCE)
    optimum = optimize(
        telescope, parameters, merit, fields, wavelengths, n_pupil=_RINGS, solver=solver, threads=threads
    )
    sizes = (size for _, size in changes)
    return optimum.telescope, {n: float(v / size) for n, v, size in zip(names, optimum.changes, sizes, strict=True)}
