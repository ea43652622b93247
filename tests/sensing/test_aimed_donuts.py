"""Donuts of a wide-angle lens whose rays are aimed at the stop, against a dense lattice of rays."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import pachon
from pachon.models.aperture import Circle
from pachon.models.io.prescription import load_telescope
from pachon.models.zernike_polynomials import annular_zernikes
from pachon.raytrace.aiming import stop_of
from pachon.raytrace.rays import Rays, field_direction
from pachon.sensing.donut_rays import ZernikeRays
from pachon.sensing.pupil_cells import pupil_cells

WIDE = Path(__file__).parents[1] / "data" / "zmx" / "circular_aperture_example_with_aperture.zmx"
FIELD = np.deg2rad((0.0, 40.0))


@pytest.fixture(scope="module")
def defocused():
    """The lens, its stop a diaphragm, its detector half a millimetre behind focus."""
    telescope = load_telescope(WIDE)
    diaphragm = replace(telescope.surface(telescope.design_data.stop), aperture=Circle(stop_of(telescope).radius))
    surfaces = tuple(diaphragm if s.name == diaphragm.name else s for s in telescope.surfaces)
    telescope = replace(telescope, surfaces=surfaces)
    return telescope.perturbed("Image", shift=(0.0, 0.0, -5e-4))


def rays_through(telescope, points, direction):
    position = np.column_stack([points, np.full(len(points), telescope.stop_z)]) - 0.5 * direction
    return Rays(
        position, np.broadcast_to(direction, position.shape).copy(), np.zeros(len(points)), telescope.default_wavelength
    )


def at_stop(telescope, points, direction):
    """Where rays through points of the plane of the entrance pupil meet the stop, over its radius."""
    index = telescope.surface_names.index(telescope.design_data.stop)
    met = pachon.trace(telescope, rays_through(telescope, points, direction), "all", threads=1)[index]
    return telescope.surfaces[index].to_local(met.position)[:, :2] / stop_of(telescope).radius


@pytest.mark.long
def test_the_light_of_a_donut_is_what_the_stop_lets_through(defocused):
    """Brute force: rays all over the plane of the pupil, of which the diaphragm and the lens keep some."""
    direction, light = field_direction(*FIELD), defocused.default_wavelength
    cells = pupil_cells(defocused, direction, light, 40)
    side = np.linspace(-1.0, 1.0, 501) * 4.0 * defocused.pupil_diameter
    points = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    end = pachon.trace(defocused, rays_through(defocused, points, direction), threads=2)
    lit = end.status == 0
    assert 1000 < lit.sum() < 0.2 * len(points)
    place = defocused.surfaces[-1].to_local(end.position)[lit, :2]
    rays = ZernikeRays(defocused, direction, np.array([light]), np.ones(1), cells, np.arange(4, 7))
    landing = rays.landing(np.zeros(3))
    mean = cells.weights @ landing
    spread = ((landing - mean).T * cells.weights) @ (landing - mean)
    chief = defocused.surfaces[-1].to_local(
        pachon.trace(defocused, pachon.launch_rays(defocused, FIELD, light, (0.0, 0.0)), threads=1).position
    )[0, :2]
    size = np.sqrt(np.trace(np.cov(place.T)))
    assert mean == pytest.approx(place.mean(axis=0) - chief, abs=3e-3 * size)
    # Rims of the lattice of rays: a thousand rays around some thousands; cells lack their own spread, 1 / 40 squared.
    assert spread == pytest.approx(np.cov(place.T), abs=1e-2 * size**2)


def test_a_wavefront_over_the_stop_turns_the_light_by_its_gradient(defocused):
    """Brute force: Zernikes of the coordinates at the stop, differentiated along the plane of the entrance pupil."""
    direction, light = field_direction(*FIELD), defocused.default_wavelength
    cells = pupil_cells(defocused, direction, light, 12)
    terms, amplitudes, step = np.arange(4, 9), 1e-6 * np.array([0.3, -0.5, 0.2, 0.4, -0.1]), 1e-6

    def wavefront(points):
        return amplitudes @ annular_zernikes(8, *at_stop(defocused, points, direction).T, 0.0)[3:]

    slopes = np.stack(
        [(wavefront(cells.points + a) - wavefront(cells.points - a)) / (2 * step) for a in step * np.eye(2)], axis=-1
    )
    cosines = direction[:2] - slopes
    turned = np.column_stack([cosines, -np.sqrt(1.0 - (cosines**2).sum(axis=1))])
    # Rays turn about their points of the plane of the entrance pupil.
    position = np.column_stack([cells.points, np.full(len(cells), defocused.stop_z)]) - 0.5 * turned
    end = pachon.trace(defocused, Rays(position, turned, np.zeros(len(cells)), light), threads=1)
    rays = ZernikeRays(defocused, direction, np.array([light]), np.ones(1), cells, terms)
    moved = rays.landing(amplitudes) - rays.landing(np.zeros(5))
    straight = pachon.trace(defocused, rays_through(defocused, cells.points, direction), threads=1).position
    expected = defocused.surfaces[-1].to_local(end.position) - defocused.surfaces[-1].to_local(straight)
    size = np.abs(expected[:, :2]).max()
    assert size > 1e-7
    # Differences over a micrometre in a beam of millimetres.
    assert moved == pytest.approx(expected[:, :2], abs=1e-5 * size)
