"""Ghosts against closed forms: Fresnel's equations, a plane-parallel plate, energy."""

from dataclasses import replace

import numpy as np
import pytest

import pachon
from pachon.core.errors import DomainError, UnknownNameError
from pachon.design.analyses.coatings import Coatings
from pachon.design.analyses.fresnel import fresnel_reflectivity, refracted_reflectivity
from pachon.design.metrics.ghost_paths import (
    GhostTrace,
    Reflectivities,
    ghost_pairs,
)
from pachon.design.metrics.ghosts import Reflectivity, ghosts
from pachon.models.aperture import Circle
from pachon.models.layer_stack import LayerStack
from pachon.models.media.medium import ConstantIndex
from pachon.models.shapes.shape import Conic, Plane
from pachon.models.surface import Interaction, Surface
from pachon.models.telescope import VACUUM, Telescope
from pachon.raytrace.rays import RayStatus

GLASS = ConstantIndex(1.5)
FOCAL, F_NUMBER, THICKNESS = 2.0, 20.0, 0.01


@pytest.fixture(scope="module")
def with_plate():
    """A paraboloid with a plane-parallel plate 0.2 m in front of its focus; the detector where the light comes to."""
    front = FOCAL - 0.2
    # A plate shifts the focus by t (1 - 1/n), but for a thousandth of it at f/20.
    focus = FOCAL + THICKNESS * (1.0 - 1.0 / 1.5)
    surfaces = (
        Surface("mirror", Interaction.MIRROR, Conic(2.0 * FOCAL, -1.0), (0.0, 0.0, 0.0), VACUUM),
        Surface("front", Interaction.REFRACT, Plane(), (0.0, 0.0, front), GLASS),
        Surface("back", Interaction.REFRACT, Plane(), (0.0, 0.0, front + THICKNESS), VACUUM),
        Surface("detector", Interaction.DETECTOR, Plane(), (0.0, 0.0, focus), VACUUM),
    )
    return Telescope(
        name="plate",
        surfaces=surfaces,
        stop_z=0.0,
        pupil_diameter=FOCAL / F_NUMBER,
        pupil_obscuration=0.0,
        launch_distance=5.0,
        reference_sphere_radius=FOCAL,
        field_radius=0.01,
        field_limit=0.02,
        wavelength_range=(3e-7, 1e-6),
        default_wavelength=5e-7,
    )


def test_fresnel():
    # Normal incidence; Brewster's angle, where only the polarisation across the plane is reflected; beyond the limit.
    assert fresnel_reflectivity(np.array(1.0), 1.0, 1.5) == pytest.approx(0.04)
    brewster = np.arctan(1.5)
    across = np.cos(2.0 * brewster) ** 2
    assert fresnel_reflectivity(np.cos(brewster), 1.0, 1.5) == pytest.approx(0.5 * across)
    # The same from inside, at the angle that Snell's law gives.
    inside = np.sqrt(1.0 - (np.sin(0.7) / 1.5) ** 2)
    assert fresnel_reflectivity(inside, 1.5, 1.0) == pytest.approx(float(fresnel_reflectivity(np.cos(0.7), 1.0, 1.5)))
    assert fresnel_reflectivity(np.cos(0.8), 1.5, 1.0) == 1.0
    assert fresnel_reflectivity(np.array(0.3), 1.2, 1.2) == pytest.approx(0.0)


@pytest.mark.parametrize(("before", "after"), [(1.0, 1.5), (1.8, 1.0), (1.45, 1.46)])
def test_reflectivity_from_the_angle_of_turn(before, after):
    # Snell's law in the plane, and Fresnel's equations in sines and tangents of sums and differences of the angles.
    incidence = np.linspace(0.02, 0.97, 40) * np.arcsin(min(1.0, after / before))
    refraction = np.arcsin(before / after * np.sin(incidence))
    across = np.sin(incidence - refraction) / np.sin(incidence + refraction)
    along = np.tan(incidence - refraction) / np.tan(incidence + refraction)
    found = refracted_reflectivity(np.cos(incidence - refraction), before, after)
    # Cancellation of cosines near 1: 1e-16 over the square of the difference of the indices.
    assert found == pytest.approx(0.5 * (across**2 + along**2), rel=1e-9, abs=1e-12)
    assert refracted_reflectivity(np.array([0.9, 1.0]), 1.2, 1.2).tolist() == [0.0, 0.0]


def test_the_ghost_of_a_plate(with_plate):
    found = ghosts(with_plate, (0.0, 0.0), reflectivity=Reflectivity(detector=0.0))
    plate = next(g for g in found.ghosts if (g.first, g.second) == ("back", "front"))
    # Twice more through the glass: the focus is 2 t / n nearer.
    assert plate.focus == pytest.approx(-2.0 * THICKNESS / 1.5, rel=3e-3)
    # 98 % of an even disc is a circle of 99 % of its radius.
    assert plate.diameter == pytest.approx(0.99 * 2.0 * THICKNESS / 1.5 / F_NUMBER, rel=5e-3)
    # Two reflections of 4 %; both ways cross both surfaces once more.
    assert plate.flux == pytest.approx(0.04**2, rel=1e-3)
    area = 0.25 * np.pi * (2.0 * THICKNESS / 1.5 / F_NUMBER) ** 2
    assert plate.peak == pytest.approx(plate.flux / area, rel=0.08)
    assert plate.centroid == pytest.approx([0.0, 0.0], abs=1e-6)


def test_the_ghost_of_a_coated_plate(with_plate):
    """A quarter wave of MgF2 on both sides, by its closed form at normal incidence."""
    film = LayerStack((1.38,), (5e-7 / 4 / 1.38,))
    found = ghosts(
        with_plate,
        (0.0, 0.0),
        reflectivity=Reflectivity(detector=0.0, coatings=Coatings({"front": film, "back": film})),
    )
    quarter = ((1.5 - 1.38**2) / (1.5 + 1.38**2)) ** 2
    # Rays of a slow cone: the square of some degrees.
    assert found.ghosts[0].flux == pytest.approx(quarter**2, rel=5e-3)
    with pytest.raises(UnknownNameError, match="nowhere"):
        ghosts(with_plate, reflectivity=Reflectivity(coatings=Coatings({"nowhere": film})))


def test_ghosts_by_the_detector(with_plate):
    found = ghosts(with_plate, (0.0, 0.005), reflectivity=Reflectivity({"front": 0.01, "back": 0.03}, 0.2))
    light = {(g.first, g.second): g.flux for g in found.ghosts}
    assert light.keys() == {("back", "front"), ("detector", "front"), ("detector", "back")}
    assert light["detector", "back"] == pytest.approx(0.2 * 0.03)
    # To the front and back again through the back.
    assert light["detector", "front"] == pytest.approx(0.2 * 0.97 * 0.01 * 0.97)
    assert light["back", "front"] == pytest.approx(0.03 * 0.01)
    assert found.flux == pytest.approx(sum(light.values()))
    assert [g.peak for g in found.ghosts] == sorted((g.peak for g in found.ghosts), reverse=True)
    # A mirror image of the converging light about the back of the plate: twice the way from there to the detector.
    back = next(g for g in found.ghosts if g.second == "back")
    way = with_plate.surfaces[3].vertex[2] - with_plate.surfaces[2].vertex[2]
    assert back.focus == pytest.approx(-2.0 * way, rel=3e-3)


def test_the_map_of_a_ghost_far_larger_than_the_field_is_even(with_plate):
    """An even disc: fewer than one ray falls into ten cells of the map."""
    small = replace(with_plate, field_radius=1e-3)
    found = ghosts(small, (0.0, 0.0), reflectivity=Reflectivity({"front": 0.0, "back": 0.01}, 0.2))
    way = with_plate.surfaces[3].vertex[2] - with_plate.surfaces[2].vertex[2]
    disc = 0.25 * np.pi * (2.0 * way / F_NUMBER) ** 2
    # Three standard deviations of ten rays at random.
    assert found.irradiance == pytest.approx(np.full_like(found.irradiance, 0.2 * 0.01 / disc), rel=1.0)
    assert found.irradiance.mean() == pytest.approx(0.2 * 0.01 / disc, rel=0.02)


def test_only_the_brightest(with_plate):
    everything = ghosts(with_plate, (0.0, 0.0), n_pupil=4000)
    assert len(everything.ghosts) == 3
    one = ghosts(with_plate, (0.0, 0.0), n_pupil=4000, brightest=1)
    assert [(g.first, g.second) for g in one.ghosts] == [(everything.ghosts[0].first, everything.ghosts[0].second)]
    assert one.ghosts[0].peak == everything.ghosts[0].peak
    assert one.flux == one.ghosts[0].flux < everything.flux
    with pytest.raises(DomainError, match="brightest"):
        ghosts(with_plate, (0.0, 0.0), brightest=0)
    several = pachon.Request.of(with_plate, [[0.0, 0.0], [0.0, 1e-3]])
    with pytest.raises(DomainError, match=r"^field: 2 fields are given; expected one$"):
        ghosts(several, n_pupil=4000)


def test_a_ghost_of_too_few_rays_has_no_irradiance(with_plate):
    # The beam is 5 mm in radius at the plate: of 400 rays a hole of 0.5 mm leaves four.
    plate = replace(with_plate.surfaces[2], aperture=Circle(5e-4))
    few = replace(with_plate, surfaces=(*with_plate.surfaces[:2], plate, with_plate.surfaces[3]))
    found = ghosts(few, (0.0, 0.0), n_pupil=400, reflectivity=Reflectivity(detector=0.0))
    assert np.isnan(found.ghosts[0].peak)
    assert found.ghosts[0].flux > 0.0


@pytest.mark.long
def test_the_maps_hold_the_light(lsst_r):
    found = ghosts(lsst_r, n_pupil=4000)
    cell = np.diff(found.edges)[0] ** 2
    sharp = [g for g in found.ghosts if g.diameter < 0.1]
    for ghost in sharp:
        own = (ghost.irradiance * np.outer(np.diff(ghost.edges[1]), np.diff(ghost.edges[0]))).sum()
        # 2 % of the light, the outermost, is left out, but for what lies in the corners of the map.
        assert 0.979 * ghost.flux < own <= ghost.flux * (1 + 1e-9)
    assert len(sharp) >= 4
    assert 0.8 * sum(g.flux for g in sharp) < (found.irradiance * cell).sum() <= found.flux


@pytest.mark.long
def test_the_ghosts_of_the_lsst(lsst_r):
    found = ghosts(lsst_r, reflectivity=Reflectivity(detector=0.3), n_pupil=10000)
    assert len(ghost_pairs(lsst_r)) == 36
    summary = found.summary()
    brightest = next(g for g in found.ghosts if g.first.startswith("Filter") and g.second.startswith("Filter"))
    # The filter is 17.9 mm thick; its surfaces are not quite parallel, so this holds to a tenth.
    index = float(lsst_r.surface("Filter_entrance").medium_after.index(found.wavelength))
    assert brightest.focus == pytest.approx(-2.0 * 17.9e-3 / index, rel=0.15)
    assert sum(summary["flux"]) == pytest.approx(summary["total_flux"])
    assert summary["peak_magnitudes_per_arcsec2"][0] < summary["peak_magnitudes_per_arcsec2"][-1]
    assert found.plot().get_size_inches()[0] > 5


def whole_path(telescope, first, second):
    """The surfaces of one ghost in the order in which the light meets them, as one telescope; where each stands."""
    turn = 2 * first - second
    places = [*range(first), *range(first, second, -1), *range(second, len(telescope.surfaces))]
    before = [telescope.medium_before, *(s.medium_after for s in telescope.surfaces)]
    met = [
        replace(
            telescope.surfaces[place],
            name=f"{k}",
            interaction=Interaction.MIRROR if k in (first, turn) else telescope.surfaces[place].interaction,
            medium_after=before[place] if first <= k < turn else before[place + 1],
        )
        for k, place in enumerate(places)
    ]
    return replace(telescope, surfaces=tuple(met), groups={}, group_frames={}), places, (first, turn)


def brute_force(telescope, rays, first, second, detector):
    """Landing points and light of one ghost: all its surfaces in one trace, angles from the normals of the surfaces."""
    whole, places, mirrors = whole_path(telescope, first, second)
    before = [telescope.medium_before, *(s.medium_after for s in telescope.surfaces)]
    index = [float(m.index(rays.wavelength)) for m in before]
    coming, light, here = rays.direction, np.ones(len(rays)), index[0]
    for k, (met, place) in enumerate(zip(pachon.trace(whole, rays, "all"), places, strict=True)):
        surface = telescope.surfaces[place]
        behind = float(whole.surfaces[k].medium_after.index(rays.wavelength))
        x, y, _ = surface.to_local(met.position).T
        slopes = surface.shape.gradient(x, y)
        normal = np.stack([-slopes[0], -slopes[1], np.ones_like(x)], axis=-1) @ surface.matrix.T
        cosine = np.abs((coming * normal).sum(axis=-1)) / np.linalg.norm(normal, axis=-1)
        if k in mirrors:
            # The other side of the surface.
            (beyond,) = {index[place], index[place + 1]} - {here} or {here}
            bounced = fresnel_reflectivity(cosine, here, beyond)
            light = light * (detector if surface.interaction == Interaction.DETECTOR else bounced)
        elif surface.interaction == Interaction.REFRACT:
            light = light * (1.0 - fresnel_reflectivity(cosine, here, behind))
        coming, here = met.direction, behind
    lit = (met.status == RayStatus.OK) & (light > 0.0)
    return telescope.surfaces[-1].to_local(met.position[lit])[:, :2], light[lit]


def test_stretches_of_a_path_are_the_path(lsst_r):
    # Nothing is centred; what several ghosts share is traced once, and is the same for each.
    telescope = lsst_r.perturbed("Filter", tilt=(2e-3, -1e-3, 0.0)).perturbed("L2", shift=(1e-3, 2e-3, 0.0))
    rng = np.random.default_rng(1)
    rays = pachon.launch_rays(telescope, np.deg2rad([0.4, -0.9]), 622e-9, rng.uniform(-4.0, 4.0, (2, 300)))
    traced = GhostTrace(telescope, rays, Reflectivities(telescope, None, 0.2, Coatings(), rays.wavelength), None)
    found = list(traced.ghosts(ghost_pairs(telescope)))
    pairs = ghost_pairs(telescope)
    assert len(found) == len(pairs) == 36
    landed = 0
    for ghost, (first, second) in zip(found, pairs, strict=True):
        assert (ghost.first, ghost.second) == tuple(telescope.surface_names[i] for i in (first, second))
        position, light = brute_force(telescope, rays, first, second, 0.2)
        np.testing.assert_allclose(ghost.position, position, atol=1e-11)
        np.testing.assert_allclose(ghost.weight, light, rtol=1e-9)
        landed += len(light)
    assert landed > 2000
    star = traced.star()
    # Eight surfaces of silica; incidence is within 25 degrees, where reflectivity hardly changes.
    n = float(telescope.surface("L1_entrance").medium_after.index(622e-9))
    np.testing.assert_allclose(star.weight, (1.0 - ((n - 1.0) / (n + 1.0)) ** 2) ** 8, rtol=5e-3)
    end = pachon.trace(telescope, rays)
    np.testing.assert_allclose(star.position, end.position[~end.vignetted][:, :2], atol=1e-15)


def test_obstructions_lie_on_their_stretch_of_the_path(with_plate):
    # A wall over half of the beam, between mirror and plate: the star loses half of its rays, and so do its ghosts.
    wall = np.array(
        [[[0.0, -1.0, 1.0], [1.0, -1.0, 1.0], [0.0, 1.0, 1.0]], [[1.0, 1.0, 1.0], [1.0, -1.0, 1.0], [0.0, 1.0, 1.0]]]
    )
    rays = pachon.launch_rays(with_plate, (0.0, 0.0), 5e-7, np.random.default_rng(1).uniform(-0.03, 0.03, (2, 400)))
    blocked = with_plate.with_obstructions(pachon.models.Obstruction("wall", wall, ("front",)))
    bare = (None, 0.1, Coatings(), rays.wavelength)
    lights = [GhostTrace(t, rays, Reflectivities(t, *bare), None) for t in (with_plate, blocked)]
    free, half = (len(light.star().weight) for light in lights)
    assert free == 400
    assert 150 < half < 250
    assert [len(g.weight) for g in lights[1].ghosts(ghost_pairs(blocked))] == [half] * 3


def test_what_cannot_be_had_is_an_error(lsst_r, with_plate, paraboloid):
    with pytest.raises(DomainError, match="lens surface"):
        ghosts(paraboloid())
    with pytest.raises(UnknownNameError, match="did you mean L3_exit"):
        ghosts(lsst_r, reflectivity={"L3_exxit": 0.01})
    with pytest.raises(DomainError, match=r"reflectivity of the lenses = 1\.5"):
        ghosts(with_plate, reflectivity=1.5)
    with pytest.raises(DomainError, match="n_pupil = 10"):
        ghosts(with_plate, n_pupil=10)
