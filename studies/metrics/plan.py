"""Plan of the metrics: fields, wavelengths, pupil points and CCDs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from ...core.errors import ConfigError, unknown_name
from ...core.schema import Positive, Real, Section
from ...models.telescope import Telescope
from ...pipeline.experiment import Experiment
from ...wavefront.request import field_points, wavelength_points

#: Fields of a plan, in units of the field's radius; no symmetry of the telescope leaves all of them as they are.
_FIELDS = ((0.0, 0.0), (0.0, 0.5), (0.7, 0.0), (-0.5, 0.6), (0.0, 1.0))
#: Points of the pupil: place between inner and outer rim, and angle [deg].
_PUPIL = ((0.95, 20.0), (0.6, 140.0), (0.9, 260.0), (0.1, 340.0))
#: Number of CCDs of a plan, evenly through the camera.
_CCDS = 5


class Plan(Section):
    """Places at which metrics of optics and camera are taken."""

    fields_deg: Annotated[tuple[tuple[Real, Real], ...], Field(min_length=1)] = Field(
        description="field angles (zemax projection) [deg]"
    )
    wavelengths_nm: Annotated[tuple[Positive, ...], Field(min_length=1)] = Field(
        description="wavelengths [nm]; monochromatic metrics take the middle one"
    )
    pupil: tuple[tuple[Real, Real], ...] = Field(description="points of the entrance pupil, in units of its radius")
    ccds: tuple[str, ...] = Field((), description="CCDs at whose centres the PSF is taken; the first is modelled")


def make_plan(
    telescope: Telescope,
    experiment: Experiment | None,
    fields: np.ndarray | None = None,
    wavelengths: Sequence[float] | None = None,
    ccds: Sequence[str] | None = None,
    pupil: Sequence[tuple[float, float]] | None = None,
) -> Plan:
    """Return a plan, with defaults for what is not given: see :func:`~pachon.studies.baseline.baseline.make_baseline`.

    A ConfigError says that CCDs need a configuration, for the focal plane that they lie in.
    """
    angles = field_points(telescope, np.array(_FIELDS) * telescope.field_radius if fields is None else fields)
    if wavelengths is None:
        wavelengths = sorted({*(telescope.band or ()), telescope.default_wavelength})
    wavelengths = wavelength_points(telescope, wavelengths).tolist()
    if pupil is None:
        inner = telescope.pupil_obscuration
        pupil = [
            ((inner + (1 - inner) * u) * np.cos(a), (inner + (1 - inner) * u) * np.sin(a))
            for u, a in ((u, np.deg2rad(degrees)) for u, degrees in _PUPIL)
        ]
    names: Sequence[str] = ()
    if experiment is not None:
        known = experiment.camera.ccd_names
        count = min(_CCDS, len(known))
        spread = [(2 * k + 1) * len(known) // (2 * count) for k in range(count)]
        # The first is modelled: neither in the middle nor where much of the pupil is vignetted.
        names = [known[i] for i in (*spread[1:], spread[0])] if ccds is None else ccds
        for name in names:
            if name not in known:
                raise unknown_name("CCD", name, known)
    elif ccds is not None:
        raise ConfigError("ccds: expected a configuration, for the focal plane that they lie in")
    return Plan(
        fields_deg=_pairs(np.rad2deg(angles), 6),
        wavelengths_nm=tuple(round(float(w) * 1e9, 4) for w in wavelengths),
        pupil=_pairs(pupil, 4),
        ccds=tuple(names),
    )


def _pairs(values: Any, digits: int) -> tuple[tuple[float, float], ...]:
    # Adding zero turns -0.0 into 0.0.
    return tuple((round(float(x), digits) + 0.0, round(float(y), digits) + 0.0) for x, y in values)
