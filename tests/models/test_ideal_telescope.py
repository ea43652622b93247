"""Ideal telescopes of telescopes in air, with stop, fields and obstructions of their own."""

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
