"""Ideal telescopes: what they keep of the telescope that they stand for."""

from dataclasses import replace

import numpy as np
import pytest

import pachon
from pachon.models.ideal_telescope import ideal_telescope


@pytest.mark.parametrize("changes", [{}, {"pupil_center": (0.01, 0.0)}, {"aiming": "real"}])
def test_telescopes_in_air_or_with_a_stop_have_one(changes):
    """The mirrors of auxtel are in air, where one in vacuum is refused; rays of a lens may be aimed at its stop."""
    telescope = pachon.load_telescope("tests/data/zmx/lens1.zmx" if changes else "auxtel")
    if "aiming" in changes:
        changes = {"design_data": replace(telescope.design_data, **changes)}
    telescope = replace(telescope, **changes)
    ideal = ideal_telescope(telescope)
    fields = [[0.0, 0.0], [0.0, np.deg2rad(0.01)]]
    diagram = pachon.spots(ideal, fields)
    assert ideal.pupil_diameter == telescope.pupil_diameter
    assert diagram.lit_fraction == pytest.approx(1.0)
    assert (diagram.rms_radius * diagram.plate_scale).max() < 1e-9
