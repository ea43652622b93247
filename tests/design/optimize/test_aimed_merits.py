"""Merits, operands and sensitivities of lenses whose rays are aimed at the stop, against rays traced one by one."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import pachon
from pachon.design.optimize.merit import Beams, SpotMerit
from pachon.design.optimize.ray_operands import RmsWavefront
from pachon.design.optimize.targets import ChiefRay
from pachon.models.io.prescription import load_telescope
from pachon.models.parameters.parameters import apply
from pachon.models.shapes.shape import Plane
from pachon.models.surface import Interaction

DATA = Path(__file__).parents[2] / "data" / "zmx"


@pytest.fixture(scope="module")
def wide():
    return load_telescope(DATA / "circular_aperture_example_with_aperture.zmx")


def wavefront(telescope, rays, chief):
    """Path of the chief ray minus that of each ray [m], to a sphere about the chief ray's image point."""
    paths, center = [], pachon.trace(telescope, chief, threads=1).position[0]
    for some in (rays, chief):
        end = pachon.trace(telescope, some, threads=1)
        away = end.position - center
        along = (away * end.direction).sum(axis=1)
        radius = telescope.reference_sphere_radius
        # The intersection in front of the image or behind it: the one that the light meets last.
        ahead = -along + np.sqrt(along**2 - (away**2).sum(axis=1) + radius**2)
        paths.append(end.path_length + ahead)
    return paths[1] - paths[0]


def launched(telescope, field, points):
    return pachon.launch_rays(telescope, field, telescope.default_wavelength, tuple(np.transpose(points)))


@pytest.mark.long
@pytest.mark.parametrize("kind", ["wide", "finite"])
def test_sensitivities_are_differences_of_wavefronts_of_aimed_rays(wide, kind):
    """Brute force: lenses with one change, whose rays are aimed at their own stop and traced."""
    if kind == "finite":
        near = replace(load_telescope(DATA / "lens1.zmx"), object_distance=0.3)
        telescope, field = near.with_design(aiming="real"), (0.0, 0.1)
    else:
        telescope, field = wide, np.deg2rad((10.0, 45.0))
    stop = telescope.design_data.stop
    name = next(s.name for s in telescope.surfaces if s.interaction == Interaction.REFRACT and s.shape != Plane())
    some = (f"{name}.dz", f"{stop}.dx", f"{name}.curvature") if kind == "wide" else (f"{name}.ry", f"{stop}.dz")
    steps = dict.fromkeys(some, 2e-5)
    found = pachon.sensitivity(telescope, list(steps), [field], n_zernike=11, n_pupil=6, threads=1)
    points = found.request.pupil.points
    lit = pachon.trace(telescope, launched(telescope, field, points), threads=1).status == 0
    assert lit.sum() > 30
    x, y = points.T / (0.5 * telescope.pupil_diameter)
    # Annular Zernikes are those of the disk here: no obscuration.
    assert telescope.pupil_obscuration == 0.0
    terms = pachon.models.annular_zernikes(11, x, y, 0.0)
    root = np.sqrt(np.where(lit, found.request.pupil.weights, 0.0))
    for i, (address, step) in enumerate(steps.items()):
        sides = {}
        for times in (1, -1, 2, -2):
            moved = apply(telescope, {address: times * step})
            rays, chief = launched(moved, field, points), launched(moved, field, np.zeros((1, 2)))
            sides[times] = wavefront(moved, rays, chief)
        # Differences without their error of third order.
        change = (8 * (sides[1] - sides[-1]) - (sides[2] - sides[-2])) / (12 * step)
        expected = np.linalg.lstsq((terms * root).T, np.where(lit, change, 0.0) * root, rcond=None)[0]
        # Paths of ten metres, rounded to 1e-16 of them, over the steps.
        assert found.matrix[0, 1:, i] == pytest.approx(expected[1:], abs=1e-10, rel=1e-7)


def test_the_wavefront_of_a_merit_is_that_of_the_opd(wide):
    field = tuple(np.deg2rad((0.0, 40.0)))
    request = Beams.of(wide, field, wide.default_wavelength, n_pupil=6).request
    value = pachon.wavefront_opd(wide, field, wide.default_wavelength, tuple(request.pupil.points.T), threads=1).value
    lit = np.isfinite(value)
    root = np.sqrt(request.pupil.weights[lit] / request.pupil.weights[lit].sum())
    x, y = request.pupil.points[lit].T
    tilts = root[:, None] * np.stack([np.ones_like(x), x, y], axis=-1)
    rest = root * value[lit] - tilts @ np.linalg.lstsq(tilts, root * value[lit], rcond=None)[0]
    # Paths of 0.1 m, rounded to 1e-16 of them.
    assert RmsWavefront(field, (wide.default_wavelength,), value=0.0).measure(wide) == pytest.approx(
        np.linalg.norm(rest), abs=1e-15
    )


def test_chief_rays_of_operands_pass_the_middle_of_the_stop(wide):
    field = tuple(np.deg2rad((0.0, 50.0)))
    end = pachon.trace(wide, launched(wide, field, np.zeros((1, 2))))
    expected = wide.surfaces[-1].to_local(end.position)[0, 1]
    assert ChiefRay(field, wavelength=wide.default_wavelength, value=0.0).measure(wide) == pytest.approx(
        expected, abs=1e-15
    )
    plain = ChiefRay(field, wavelength=wide.default_wavelength, value=0.0).measure(wide.with_design(aiming="off"))
    assert not abs(plain - expected) < 1e-4  # another ray, or none


@pytest.mark.slow
def test_the_optimum_is_that_of_lenses_whose_rays_fill_their_own_stop(wide):
    """Brute force: lenses of other curvatures in front of the stop, each with rays of its own, are worse."""
    fields, address = np.deg2rad([[0.0, 0.0], [0.0, 35.0]]), "S4.curvature"
    found = pachon.optimize(wide, [address], "spots", fields, n_pupil=2, threads=1)

    def rms(change):
        lens = apply(wide, {address: change})
        return float(np.linalg.norm(SpotMerit(lens, Beams.of(lens, fields, n_pupil=2)).residuals(lens)))

    step = 1e-3
    below, at, above = (rms(found.changes[0] + sign * step) for sign in (-1.0, 0.0, 1.0))
    assert found.merits[1] == pytest.approx(at, rel=1e-9)
    # The vertex of the parabola through the three, to what its third order moves it.
    assert abs(0.5 * (below - above) / (below - 2.0 * at + above)) < 1e-2


@pytest.mark.long
def test_an_optimum_keeps_its_stop(wide, tmp_path):
    """Its pupil moves to where the stop is imaged: a file keeps stop and aiming, and has the rays of the optimum."""
    where = {"fields": np.deg2rad([[0.0, 0.0], [0.0, 20.0]]), "wavelengths": wide.default_wavelength}
    names = [s.name for s in wide.surfaces if s.interaction == Interaction.REFRACT and s.shape != Plane()]
    before = [name for name in names if name < wide.design_data.stop] or names
    found = pachon.optimize(
        wide, [f"{before[0]}.curvature"], **where, n_pupil=6, solver=pachon.design.LeastSquares(max_steps=3)
    )
    after = found.telescope
    assert after.design_data.stop == wide.design_data.stop
    assert after.design_data.aiming == wide.design_data.aiming
    assert after.stop_z != wide.stop_z
    pachon.save_telescope(after, tmp_path / "after.zmx")
    again = pachon.load_telescope(tmp_path / "after.zmx")
    assert again.design_data.stop == after.design_data.stop
    sizes = pachon.spots(again, **where, sampling="gauss", n_pupil=6).rms_radius
    assert np.sqrt((sizes**2).mean()) == pytest.approx(found.merits[1], rel=1e-6)
