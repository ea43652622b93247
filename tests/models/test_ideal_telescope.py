"""Ideal telescopes of telescopes in air, with stop, fields and obstructions of their own: what they keep of these."""

from dataclasses import replace

import numpy as np
import pytest

import pachon
from pachon.models import Obstruction
from pachon.models.ideal_telescope import ideal_telescope

#: A plate in front of a part of the pupil.
PLATE = np.array([[[0.0, -9.0, 3.0], [9.0, -9.0, 3.0], [9.0, 9.0, 3.0]]])
CHANGES = {
    "air": lambda t: t.in_medium(pachon.Air(69328.0, 293.15)),
    "stop": lambda t: t.with_design(stop="M2", aiming="paraxial"),
    "obstruction of later light": lambda t: t.with_obstructions(Obstruction("plate", PLATE, ("M2",))),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_ideal_telescope_does_not_depend_on_what_is_behind_the_pupil(lsst_r, change):
    assert ideal_telescope(change(lsst_r)) == ideal_telescope(lsst_r)


def test_obstructions_of_the_incoming_light_stay(lsst_r):
    for before in (None, ("M1", "M3")):
        ideal = ideal_telescope(lsst_r.with_obstructions(Obstruction("plate", PLATE, before)))
        assert [o.before for o in ideal.obstructions] == [("M1",)]


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
