import numpy as np
import pytest
from astropy import units as u

import pachon
from pachon.core.errors import DomainError, UnknownNameError
from pachon.models import OpticsState, apply_changes


def test_a_state_moves_bodies_in_um_and_arcsec():
    telescope = pachon.load_telescope("lsst_v3.3_r")
    state = OpticsState({"M2_dz": 12.0, "Camera_rx": 3.0 * u.arcsec, "M2_dx": 0.0})
    moved, expected = state.telescope(telescope), apply_changes(telescope, {"M2.dz_um": 12.0, "Camera.rx_arcsec": 3.0})
    for surface, other in zip(moved.surfaces, expected.surfaces, strict=True):
        # An arcsec is a rounded number there.
        np.testing.assert_allclose(surface.vertex, other.vertex, rtol=0, atol=1e-12)
        np.testing.assert_allclose(surface.matrix, other.matrix, rtol=0, atol=1e-12)
    assert state.values == {"M2_dz": 12.0, "Camera_rx": 3.0}
    assert state.quantity("M2_dz") == 12.0 * u.um
    assert state.quantity("M1M3_B1") == 0.0 * u.um
    assert state.vector.shape == (50,)
    assert OpticsState().telescope(telescope) is telescope


def test_a_bending_mode_adds_its_term_to_both_surfaces_of_the_casting():
    telescope = pachon.load_telescope("lsst_v3.3_r")
    bent = OpticsState().with_values({"M1M3_B1": 0.5}).telescope(telescope)
    # Z4 over the annulus from 0.55 to 4.18 m: sqrt 3 (2 r^2 - 1 - e^2) / (1 - e^2), r in outer radii.
    x, e = 3.0, 0.55 / 4.18
    z4 = np.sqrt(3.0) * (2.0 * (x / 4.18) ** 2 - 1.0 - e**2) / (1.0 - e**2)
    for name in ("M1", "M3"):
        before, after = (t.surface(name).shape.sag(np.array([x]), np.array([0.0])) for t in (telescope, bent))
        assert (after - before)[0] == pytest.approx(0.5e-6 * z4, rel=1e-6)


def test_what_is_no_state_is_refused():
    with pytest.raises(UnknownNameError, match="M9_dz"):
        OpticsState({"M9_dz": 1.0})
    with pytest.raises(DomainError, match="M2_dz"):
        OpticsState({"M2_dz": 1.0 * u.arcsec})
    with pytest.raises(DomainError, match="M2_dz = nan"):
        OpticsState().with_values({"M2_dz": float("nan")})
