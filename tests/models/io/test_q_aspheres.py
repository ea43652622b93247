"""Q-type aspheres of Zemax files: Qcon terms as an even asphere, against Jacobi polynomials; Qbfs terms."""

from pathlib import Path

import numpy as np
import pytest
from scipy.special import eval_jacobi

import pachon
from pachon.core.errors import PrescriptionError, PrescriptionWarning
from pachon.models.shapes.qbfs import QbfsAsphere
from pachon.models.shapes.shape import Conic, EvenAsphere

LENS = (Path(__file__).parents[2] / "data" / "lenses" / "doublet.zmx").read_text()
RADIUS, CURVATURE, CONIC = 14.0, 1 / 61.47, -0.4


def loaded(folder, terms, kind=1, radius=RADIUS, count=None, **options):
    """Write a doublet whose first surface has Q-type terms [mm], and read it."""
    data = [kind, len(terms) if count is None else count, radius, *terms]
    lines = "\n".join(f"  XDAT {i} {v!r} 0 0 1 0 0" for i, v in enumerate(data, start=1))
    first, rest = LENS.split("SURF 2")
    first = first.replace(
        "COMM crown\n  STOP\n  TYPE STANDARD", f"COMM crown\n  STOP\n  TYPE QED_TYPE\n  CONI {CONIC}\n{lines}"
    )
    assert "QED_TYPE" in first
    (folder / "lens.zmx").write_text(f"{first}SURF 2{rest}")
    return pachon.load_telescope(folder / "lens.zmx", **options)


@pytest.mark.parametrize("count", [1, 2, 6, 10])
def test_qcon_terms_are_those_of_jacobi(tmp_path, count):
    terms = np.random.default_rng(count).normal(0, 1e-2, count)
    shape = loaded(tmp_path, terms.tolist()).surfaces[0].shape
    assert isinstance(shape, EvenAsphere)
    r = np.linspace(0.0, RADIUS, 101)
    u = r / RADIUS
    # Forbes (2007, Opt. Express 15, 5218), equation 3 with Q_m the Jacobi polynomial P^(0, 4)(2 u^2 - 1).
    expected = CURVATURE * r**2 / (1 + np.sqrt(1 - (1 + CONIC) * CURVATURE**2 * r**2))
    expected = expected + u**4 * sum(a * eval_jacobi(m, 0, 4, 2 * u**2 - 1) for m, a in enumerate(terms))
    # The axes of the telescope are the other way round.
    found = shape.sag(1e-3 * r * 0.6, 1e-3 * r * 0.8)
    # Powers of r cancel: to a few units in the last place of the largest of them.
    largest = sum(abs(a) * (1e-3 * RADIUS) ** (2 * i + 4) for i, a in enumerate(shape.coefficients)) + 2e-3
    assert np.abs(found + 1e-3 * expected).max() < 4e-16 * largest
    assert largest < 0.05 * 7.0**count


def test_no_terms_are_a_conic(tmp_path):
    shape = loaded(tmp_path, []).surfaces[0].shape
    assert isinstance(shape, Conic)
    assert (shape.radius, shape.conic) == (pytest.approx(-61.47e-3, rel=1e-14), CONIC)


def test_qbfs_terms_are_those_of_forbes(tmp_path):
    """On a sphere; beside a conic constant they are refused by name."""
    with pytest.raises(PrescriptionError, match=r"surface 1: CONI -0.4: expected 0 beside Qbfs terms"):
        loaded(tmp_path, [1e-3], kind=0)
    with pytest.warns(PrescriptionWarning, match=r"CONI -0.4: expected 0 beside Qbfs terms; taken as the conic under"):
        shape = loaded(tmp_path, [1e-3, 0.0], kind=0, lenient=True).surfaces[0].shape
    assert isinstance(shape, QbfsAsphere)
    assert (shape.radius, shape.norm_radius) == (pytest.approx(-61.47e-3), pytest.approx(1e-3 * RADIUS))
    assert (shape.conic, shape.coefficients) == (CONIC, (-1e-6,))


def test_what_is_refused(tmp_path):
    with pytest.raises(PrescriptionError, match=r"XDAT 1 2 .*expected 0 .Qbfs. or 1 .Qcon. as XDAT 1"):
        loaded(tmp_path, [1e-3], kind=2)
    with pytest.raises(PrescriptionError, match="expected up to 10 Qcon terms as XDAT 2, not 11"):
        loaded(tmp_path, [1e-3] * 11)
    with pytest.raises(PrescriptionError, match="expected a positive normalisation radius as XDAT 3"):
        loaded(tmp_path, [1e-3], radius=0.0)
