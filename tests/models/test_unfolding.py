"""First-order data of folded telescopes: flat mirrors that turn the axis cost nothing."""

from dataclasses import fields, replace

import numpy as np
import pytest
from test_first_order import SYSTEMS, telescope_of

import pachon
from pachon.core.errors import DomainError
from pachon.models.first_order import chromatic_sums, first_order, footprints, seidel_sums
from pachon.models.shapes.freeform import Toroid
from pachon.models.shapes.shape import Conic, Plane
from pachon.models.surface import Interaction, Surface
from pachon.models.unfolding import unfolded_axis
from pachon.pipeline.report.info import describe, figure_rows

#: Rounding of frames that were reflected a few times.
EXACT = 1e-12


def folded(telescope, place, z, normal, *, reversed_frames=False):
    """Return a telescope with a flat mirror before surface `place`, at height z of the axis of its unfolded self.

    What follows is reflected in the plane of the mirror. The frames of the shapes become right-handed by another
    direction of x or, `reversed_frames`, of z, as lens files have them.
    """
    normal = np.array(normal) / np.linalg.norm(normal)
    point = np.array([0.0, 0.0, z])
    householder = np.eye(3) - 2.0 * np.outer(normal, normal)
    side = np.cross([1.0, 0.0, 0.0], normal)
    side /= np.linalg.norm(side)
    axes = np.stack([np.cross(side, normal), side, normal], axis=1)
    before = telescope.surfaces[place - 1].medium_after if place else telescope.medium_before
    # The vertex of a plane lies anywhere on it.
    vertex = point + 0.03 * axes[:, 0]
    fold = Surface(
        f"fold {place}", Interaction.MIRROR, Plane(), tuple(vertex), before, rotation=tuple(map(tuple, axes))
    )
    moved = []
    for surface in telescope.surfaces[place:]:
        sense = np.diag([1.0, 1.0, -1.0] if reversed_frames else [-1.0, 1.0, 1.0])
        matrix = householder @ surface.matrix @ sense
        vertex = householder @ (np.array(surface.vertex) - point) + point
        shape = surface.shape
        if reversed_frames and isinstance(shape, Conic):
            shape = Conic(-shape.radius, shape.conic)
        if reversed_frames and isinstance(shape, Toroid):
            shape = Toroid(-shape.radius_x, -shape.radius_y, shape.conic_y)
        rotation = tuple(tuple(float(v) for v in row) for row in matrix)
        moved.append(replace(surface, shape=shape, vertex=tuple(float(v) for v in vertex), rotation=rotation))
    return replace(telescope, surfaces=(*telescope.surfaces[:place], fold, *moved))


@pytest.fixture
def auxtel_moved():
    return pachon.load_telescope("auxtel").perturbed("Detector", shift=(1e-4, 0.0, 0.0))


def same(one, other):
    for field in fields(one):
        assert getattr(one, field.name) == pytest.approx(getattr(other, field.name), rel=EXACT, abs=EXACT)


@pytest.mark.parametrize("reversed_frames", [False, True])
@pytest.mark.parametrize("normal", [(0.0, -1.0, 1.0), (0.3, 0.5, 0.8)])
@pytest.mark.parametrize("system", SYSTEMS)
def test_a_folded_telescope_has_the_figures_of_the_straight_one(system, normal, reversed_frames):
    rows, stop_z, diameter = SYSTEMS[system]
    straight = telescope_of(rows, stop_z=stop_z, diameter=diameter)
    bent = straight
    # Behind every surface, one fold after the other, from the last so that each is placed on the straight axis.
    for place in range(len(rows), 0, -1):
        z = rows[place - 1][0] + 0.01
        bent = folded(bent, place, z, normal, reversed_frames=reversed_frames)
    assert len(bent.surfaces) == 2 * len(rows)
    same(first_order(bent), first_order(straight))
    scale = np.abs(seidel_sums(straight).contributions).max()
    assert np.abs(seidel_sums(bent).total - seidel_sums(straight).total).max() < EXACT * scale
    acting = [not name.startswith("fold") for name in seidel_sums(bent).names]
    assert np.abs(seidel_sums(bent).contributions[acting] - seidel_sums(straight).contributions).max() < EXACT * scale
    assert not seidel_sums(bent).contributions[np.logical_not(acting)].any()
    assert np.abs(chromatic_sums(bent).total - chromatic_sums(straight).total).max() < EXACT
    assert footprints(bent, 0.01)[acting] == pytest.approx(footprints(straight, 0.01), rel=EXACT)


def test_a_toroid_behind_a_fold_keeps_its_sections():
    straight = telescope_of([(0.0, 4.0, -1.0, None), (1.0, 2.0, 0.0, None)], stop_z=0.5, diameter=0.4)
    toroid = replace(straight.surfaces[1], shape=Toroid(1.5, 2.5, 0.3))
    straight = replace(straight, surfaces=(straight.surfaces[0], toroid))
    for reversed_frames in (False, True):
        same(first_order(folded(straight, 1, 0.5, (0, 1, 2), reversed_frames=reversed_frames)), first_order(straight))


def test_a_hubble_with_a_fold():
    hubble = pachon.load_telescope("tests/data/lensfiles/hubble.json")
    optics = first_order(hubble)
    assert optics.focal_length == pytest.approx(57.6, rel=1e-4)
    place = hubble.surface_names.index(hubble.surfaces[-1].name)
    bent = folded(hubble, place, optics.focus_z + 0.5, (0.0, 1.0, 1.0))
    same(first_order(bent), optics)
    rows = dict(figure_rows(describe(bent)))
    assert rows["focal length"] == dict(figure_rows(describe(hubble)))["focal length"]
    assert "fold" in rows["heights"]
    # Real rays: the focal length over a small field, along the detector.
    step, landings = 1e-5, []
    for field in ((0.0, -step), (0.0, step)):
        end = pachon.trace(bent, pachon.launch_rays(bent, field, 5e-7, ([0.0], [0.0])))
        landings.append(bent.surfaces[-1].to_local(end.position)[0, :2])
    # The detector is at the focus to some 0.1 mm.
    assert np.linalg.norm(landings[1] - landings[0]) / (2 * step) == pytest.approx(57.6, rel=1e-4)


def test_heights_of_all_surfaces_count_on_the_unfolded_axis():
    straight = telescope_of([(0.0, 4.0, -1.0, None)], stop_z=0.5, diameter=0.4)
    detector = Surface("D", Interaction.DETECTOR, Plane(), (0.0, 0.0, 2.0), straight.surfaces[0].medium_after)
    straight = replace(straight, surfaces=(*straight.surfaces, detector))
    axis = unfolded_axis(folded(straight, 1, 1.7, (0.2, 1.0, 1.0)))
    assert axis.folded
    assert axis.heights == pytest.approx({"s0": 0.0, "fold 1": 1.7, "D": 2.0}, abs=1e-15)
    assert not unfolded_axis(straight).folded


def test_what_is_off_the_axis_is_refused():
    straight = telescope_of([(0.0, 4.0, -1.0, None), (1.0, 2.0, 0.0, None)], stop_z=0.5, diameter=0.4)
    bent = folded(straight, 1, 0.5, (0.0, 1.0, 1.0))
    with pytest.raises(DomainError, match="s1 of test: expected one on the axis behind the folds"):
        first_order(bent.perturbed("s1", shift=(1e-6, 0.0, 0.0)))
    with pytest.raises(DomainError, match="s0 of test: expected one on the axis, not perturbed"):
        first_order(bent.perturbed("s0", tilt=(1e-6, 0.0, 0.0)))
    with pytest.raises(DomainError, match="at least one mirror or lens surface"):
        first_order(replace(bent, surfaces=bent.surfaces[1:2]))
    along = folded(straight, 1, 0.5, (0.0, 1.0, 0.0))
    with pytest.raises(DomainError, match="fold 1 of test: expected a mirror that the axis meets"):
        first_order(along)


def test_tilted_windows_behind_a_fold_have_two_focal_lengths(auxtel_moved):
    """The wedges of LATISS are no surfaces of a centred system, wherever its detector is; parabasal rays serve."""
    with pytest.raises(DomainError, match=r"L1_entrance.*on the axis behind the folds; parabasal_optics serves"):
        first_order(auxtel_moved)
    # Chief rays of close fields, in the plane of the fold and across it.
    step, telescope = 1e-6, auxtel_moved
    lengths = []
    for field in ((0.0, step), (step, 0.0)):
        ends = []
        for sign in (1.0, -1.0):
            rays = pachon.launch_rays(telescope, tuple(sign * f for f in field), 620e-9, pupil=([0.0], [0.0]))
            ends.append(pachon.trace(telescope, rays))
        x, y = (telescope.surfaces[-1].to_local(end.position[0])[:2] for end in ends)
        lengths.append(np.hypot(*(x - y)) / (2.0 * np.tan(step)))
    # The detector is 0.1 mm from the foci, and the exit pupil 4.4 m from it.
    assert pachon.models.parabasal_optics(telescope, 620e-9).focal_length == pytest.approx(lengths, rel=2e-4)


@pytest.mark.parametrize("folds", [False, True])
def test_a_plane_across_the_axis_may_be_moved_in_itself(folds):
    rows = [(0.0, 4.0, -1.0, None), (1.0, np.inf, 0.0, 1.5), (1.1, np.inf, 0.0, 1.0)]
    plain = telescope_of(rows, stop_z=0.5, diameter=0.4)
    telescope = folded(plain, 1, 0.5, (0.0, 1.0, 1.0)) if folds else plain
    # The light behind the fold travels along y.
    moved = telescope.perturbed("s1", shift=(0.01, 0.0, 0.0)).perturbed("s2", shift=(0.0, 0.0, 0.02 if folds else 0.0))
    same(first_order(moved), first_order(telescope))
    with pytest.raises(DomainError, match="s1 of test: expected one on the axis"):
        first_order(telescope.perturbed("s1", tilt=(1e-6, 0.0, 0.0)))
