import numpy as np
import pytest
from astropy import units as u

from pachon.core.errors import DomainError, UnknownNameError
from pachon.models.camera.cameras import load_camera
from pachon.models.camera.lsst import lsst_camera

LSST = lsst_camera()


def test_the_lsst_has_189_ccds_in_21_rafts_in_order():
    assert len(LSST) == len(set(LSST.ccd_names)) == 189
    assert len(LSST.raft_names) == 21
    assert LSST.raft_names[:4] == ("R01", "R02", "R03", "R10")
    assert LSST.raft_names[-3:] == ("R41", "R42", "R43")
    assert not {"R00", "R04", "R40", "R44"} & set(LSST.raft_names)
    assert LSST.ccd_names[:4] == ("R01_S00", "R01_S01", "R01_S02", "R01_S10")
    assert LSST.ccd_names[-1] == "R43_S22"
    assert LSST.shortest_side == pytest.approx(40.00e-3, abs=1e-15)


@pytest.mark.parametrize("name", ["R01_S00", "R22_S11", "R34_S20", "R43_S12"])
def test_rows_run_along_x_and_columns_along_y(name):
    # R<row><column>_S<row><column>: pitches 127.0 and 42.25 mm about R22_S11.
    raft_row, raft_column, row, column = int(name[1]), int(name[2]), int(name[5]), int(name[6])
    x = (raft_row - 2) * 127.0 + (row - 1) * 42.25
    y = (raft_column - 2) * 127.0 + (column - 1) * 42.25
    # Sums of decimals in metres: rounding only.
    assert np.allclose(LSST.centers[LSST.ccd_index(name)], [x * 1e-3, y * 1e-3], rtol=0, atol=1e-16)


@pytest.mark.parametrize(
    ("name", "pixels"), [("R22_S11", (4096, 4004)), ("R43_S12", (4072, 4000)), ("R14_S02", (4096, 4004))]
)
def test_pixels_x_runs_along_y_and_y_along_x(name, pixels):
    i = LSST.ccd_index(name)
    assert tuple(LSST.pixels[i]) == pixels
    x, y = LSST.centers[i]
    last = np.array(pixels) - 1.0
    # Half the pixels less half of one from the middle.
    corner = [x + 5e-6 * last[1], y + 5e-6 * last[0]]
    assert np.allclose(LSST.from_pixel(i, last), corner, rtol=0, atol=1e-16)
    assert np.allclose(LSST.to_pixel(i, np.array(corner)), last, rtol=0, atol=1e-9)
    one_right = LSST.along_pixels(i, LSST.from_pixel(i, last) - LSST.from_pixel(i, last - [1.0, 0.0]))
    assert np.allclose(one_right, [10e-6, 0.0], rtol=0, atol=1e-16)


def test_ccd_at_equals_a_search_through_every_rectangle():
    rng = np.random.default_rng(7)
    x, y = rng.uniform(-0.36, 0.36, (2, 5000))
    half = np.array([(20.0e-3, 20.36e-3) if vendor == "itl" else (20.02e-3, 20.48e-3) for vendor in LSST.vendors])
    inside = np.all(np.abs(np.stack([x, y], -1)[:, None] - LSST.centers) <= half, axis=-1)
    expected = np.where(inside.any(axis=1), inside.argmax(axis=1), -1)
    assert np.array_equal(LSST.ccd_at(x, y), expected)
    assert 0.1 < np.mean(expected == -1) < 0.5


def test_gaps_outside_and_rubbish_are_minus_one():
    gap = 42.25e-3 / 2
    assert LSST.ccd_at(gap, 0.0) == -1
    assert LSST.ccd_at(1.0, 0.0) == -1
    assert LSST.ccd_at(-0.254, -0.254) == -1
    assert np.array_equal(LSST.ccd_at([np.nan, 0.0], [0.0, np.inf]), [-1, -1])
    assert LSST.ccd_at(0 * u.mm, 20.4 * u.mm) == LSST.ccd_index("R22_S11")
    assert LSST.ccd_at(np.zeros((2, 3)), 0.0).shape == (2, 3)


def test_rafts_know_their_ccds():
    assert LSST.ccds_of_raft("R22") == tuple(f"R22_S{r}{c}" for r in range(3) for c in range(3))
    assert LSST.raft_of[LSST.ccd_index("R14_S02")] == "R14"


def test_unknown_names_offer_the_nearest():
    with pytest.raises(UnknownNameError, match="unknown CCD of lsst 'R22_S33': did you mean R22_S"):
        LSST.ccd_index("R22_S33")
    with pytest.raises(UnknownNameError, match="unknown raft of lsst 'R00'"):
        LSST.ccds_of_raft("R00")
    with pytest.raises(UnknownNameError, match="unknown camera 'lsts': did you mean lsst"):
        load_camera("lsts")
    with pytest.raises(DomainError, match="x = "):
        LSST.ccd_at(1 * u.deg, 0.0)


def test_positions_cannot_be_changed():
    with pytest.raises(ValueError, match="read-only"):
        LSST.centers[0] = 0.0
