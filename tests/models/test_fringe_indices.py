import numpy as np
import pytest

import pachon
from pachon.core.errors import DomainError
from pachon.models.fringe_indices import FRINGE_TERMS, fringe_to_nm

#: Polynomials of the published table (Wyant & Creath 1992, table III), by index.
TABLE = {
    2: lambda r, t: r * np.cos(t),
    3: lambda r, t: r * np.sin(t),
    4: lambda r, t: 2 * r**2 - 1,
    5: lambda r, t: r**2 * np.cos(2 * t),
    6: lambda r, t: r**2 * np.sin(2 * t),
    7: lambda r, t: (3 * r**3 - 2 * r) * np.cos(t),
    8: lambda r, t: (3 * r**3 - 2 * r) * np.sin(t),
    9: lambda r, t: 6 * r**4 - 6 * r**2 + 1,
    10: lambda r, t: r**3 * np.cos(3 * t),
    12: lambda r, t: (4 * r**4 - 3 * r**2) * np.cos(2 * t),
    15: lambda r, t: (10 * r**5 - 12 * r**3 + 3 * r) * np.sin(t),
    16: lambda r, t: 20 * r**6 - 30 * r**4 + 12 * r**2 - 1,
    18: lambda r, t: r**4 * np.sin(4 * t),
    25: lambda r, t: 70 * r**8 - 140 * r**6 + 90 * r**4 - 20 * r**2 + 1,
    27: lambda r, t: r**5 * np.sin(5 * t),
    36: lambda r, t: 252 * r**10 - 630 * r**8 + 560 * r**6 - 210 * r**4 + 30 * r**2 - 1,
    37: lambda r, t: 924 * r**12 - 2772 * r**10 + 3150 * r**8 - 1680 * r**6 + 420 * r**4 - 42 * r**2 + 1,
}


def test_the_published_polynomials():
    radius, angle = np.random.default_rng(1).uniform([0, -np.pi], [1, np.pi], (40, 2)).T
    terms = pachon.models.fringe_zernikes(FRINGE_TERMS, radius * np.cos(angle), radius * np.sin(angle))
    for j, polynomial in TABLE.items():
        assert terms[j - 1] == pytest.approx(polynomial(radius, angle), abs=1e-11), j
    assert len({fringe_to_nm(j) for j in range(1, FRINGE_TERMS + 1)}) == FRINGE_TERMS


def test_conversion_there_and_back():
    noll = np.arange(1.0, 22.0)
    fringe = pachon.models.fringe_from_noll(noll)
    x, y = np.random.default_rng(2).uniform(-0.7, 0.7, (2, 30))
    wavefront = noll @ pachon.models.annular_zernikes(21, x, y)
    assert fringe @ pachon.models.fringe_zernikes(37, x, y) == pytest.approx(wavefront, abs=1e-10)
    assert pachon.models.noll_from_fringe(fringe)[:21] == pytest.approx(noll)
    assert not pachon.models.noll_from_fringe(fringe)[21:].any()
    with pytest.raises(DomainError, match="Noll term 27"):
        pachon.models.fringe_from_noll(np.ones(28))


def test_the_wavefront_of_a_lens_in_both_orders():
    telescope = pachon.paul_baker()
    fields = [(0.0, 0.003)]
    fringe = pachon.wavefront_zernikes(telescope, fields, jmax=37, ordering="fringe")
    noll = pachon.wavefront_zernikes(telescope, fields, jmax=66)
    # The same wavefront to what neither holds.
    assert fringe.rms == pytest.approx(noll.rms, rel=1e-3)
    assert fringe.summary()["ordering"] == "fringe"
    with pytest.raises(DomainError, match="jmax = 38"):
        pachon.wavefront_zernikes(telescope, fields, jmax=38, ordering="fringe")


def test_no_coefficients_are_refused():
    for convert in (pachon.models.fringe_from_noll, pachon.models.noll_from_fringe):
        with pytest.raises(DomainError, match="coefficients"):
            convert([])
