import numpy as np
import pytest

from pachon.core.errors import PrescriptionError
from pachon.models.aperture import Annulus, Circle
from pachon.models.media.medium import ConstantIndex
from pachon.models.shapes.shape import Conic, EvenAsphere, Plane, Sphere
from pachon.models.surface import Interaction, Surface

X, Y = np.random.default_rng(1).uniform(-1.5, 1.5, (2, 200))
R2 = X**2 + Y**2
RUBBISH = [0.0, float("nan"), float("inf")]


def test_plane_is_flat():
    assert np.array_equal(Plane().sag(X, Y), np.zeros(200))


@pytest.mark.parametrize("radius", [3.0, -3.0])
def test_sphere_is_a_sphere_about_its_centre(radius):
    z = Sphere(radius).sag(X, Y)
    # Every point lies |R| from (0, 0, R): rounding of a few ulp of 3.
    assert np.allclose(np.sqrt(R2 + (z - radius) ** 2), 3.0, rtol=0, atol=1e-14)
    assert np.all(z * radius > 0)


def test_paraboloid_is_r2_over_2r():
    assert np.allclose(Conic(5.0, -1.0).sag(X, Y), R2 / 10.0, rtol=1e-15)


@pytest.mark.parametrize("conic", [-3.0, -0.5, 0.7])
def test_conic_obeys_its_implicit_equation(conic):
    z = Conic(-7.0, conic).sag(X, Y)
    # r^2 - 2 R z + (1 + k) z^2 = 0; terms of size 10 in double precision.
    assert np.allclose(R2 + 14.0 * z + (1 + conic) * z**2, 0, atol=1e-14)


def test_even_asphere_adds_even_powers_from_the_fourth():
    shape = EvenAsphere(9.0, -1.2, (1e-3, -2e-4, 3e-5))
    added = 1e-3 * R2**2 - 2e-4 * R2**3 + 3e-5 * R2**4
    assert np.allclose(shape.sag(X, Y) - Conic(9.0, -1.2).sag(X, Y), added, rtol=0, atol=1e-16)


def test_sag_beyond_a_sphere_is_nan_without_warning():
    assert np.isnan(Sphere(1.0).sag(1.2, 0.0))
    assert np.isfinite(Conic(1.0, -1.0).sag(1.2, 0.0))


def test_sags_equal_batoids():
    batoid = pytest.importorskip("batoid")
    pairs = [
        (Plane(), batoid.Plane()),
        (Sphere(2.8), batoid.Sphere(2.8)),
        (Conic(3.169, -0.962), batoid.Quadric(3.169, -0.962)),
        (EvenAsphere(8.3, 0.155, (0.0, 4.5e-7, 8.1e-9)), batoid.Asphere(8.3, 0.155, [0.0, 4.5e-7, 8.1e-9])),
    ]
    for ours, theirs in pairs:
        # Algebraically the same: rounding of a sag of half a metre.
        assert np.allclose(ours.sag(X, Y), theirs.sag(X, Y), rtol=0, atol=1e-15)


def test_apertures_know_inside_from_outside():
    circle = Circle(2.0, x=1.0)
    assert circle.contains([1.0, 2.9, 3.1, -1.1], [0.0, 0.0, 0.0, 0.0]).tolist() == [True, True, False, False]
    ring = Annulus(1.0, 2.0, y=0.5)
    assert ring.contains([0.0, 0.0, 0.0], [0.5, 2.0, 2.6]).tolist() == [False, True, False]


def test_rims_count_as_batoid_counts_them():
    batoid = pytest.importorskip("batoid")
    ring, peer = Annulus(1.0, 2.0), batoid.ObscNegation(batoid.ObscAnnulus(inner=1.0, outer=2.0))
    disc, other = Circle(2.0), batoid.ObscNegation(batoid.ObscCircle(radius=2.0))
    for r in (0.5, 1.0, 1.5, 2.0, 2.5):
        assert bool(ring.contains(r, 0.0)) is not bool(peer.contains(r, 0.0))
        assert bool(disc.contains(r, 0.0)) is not bool(other.contains(r, 0.0))


@pytest.mark.parametrize("radius", RUBBISH)
@pytest.mark.parametrize("make", [Sphere, lambda r: Conic(r, -1.0)])
def test_impossible_radius_is_refused(make, radius):
    with pytest.raises(PrescriptionError, match="radius = "):
        make(radius)


def test_other_impossible_figures_are_refused():
    with pytest.raises(PrescriptionError, match="conic = nan"):
        Conic(1.0, float("nan"))
    with pytest.raises(PrescriptionError, match="coefficients = "):
        EvenAsphere(1.0, 0.0, (float("inf"),))
    with pytest.raises(PrescriptionError, match="circle"):
        Circle(-1.0)
    with pytest.raises(PrescriptionError, match="annulus"):
        Annulus(2.0, 1.0)
    plain = {"name": "a", "interaction": Interaction.MIRROR, "shape": Plane(), "medium_after": ConstantIndex(1.0)}
    with pytest.raises(PrescriptionError, match="vertex"):
        Surface(vertex=(0.0, 0.0, float("nan")), **plain)
    with pytest.raises(PrescriptionError, match="rotation matrix"):
        Surface(vertex=(0.0, 0.0, 0.0), rotation=((1.0, 0, 0), (0, 1.0, 0), (0, 0, -1.0)), **plain)


def test_moving_turns_about_a_point_then_shifts():
    surface = Surface("a", Interaction.MIRROR, Plane(), (1.0, 0.0, 2.0), ConstantIndex(1.0))
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    moved = surface.moved(rotation=quarter, about=(0.0, 0.0, 2.0), shift=(0.0, 0.0, 0.5))
    assert moved.vertex == (0.0, 1.0, 2.5)
    assert np.array_equal(moved.matrix, quarter)
    point = np.array([0.3, -0.2, 0.7])
    assert np.allclose(moved.to_local(moved.to_telescope(point)), point, rtol=0, atol=1e-15)
    assert np.allclose(moved.to_telescope([0.1, 0.0, 0.0]), [0.0, 1.1, 2.5], rtol=0, atol=1e-15)
    assert surface.vertex == (1.0, 0.0, 2.0)
