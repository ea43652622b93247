"""Lenses of public collections with inner stops: what `optimize` reports is what the saved files do, in each format."""

import re
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import pachon
from pachon.core.errors import PrescriptionError, PrescriptionWarning
from pachon.design.optimize.aimed_rays import AimedRays
from pachon.design.optimize.jacobian import ParameterColumns
from pachon.models.io.prescription import WRITTEN
from pachon.models.parameters.parameters import apply, parse_parameters
from pachon.models.paraxial import following_stop
from pachon.models.surface import Interaction
from pachon.raytrace.adjoint.backward_pass import image_gradient

DATA = Path(__file__).parents[2] / "data"
LENSES = [
    "lensfiles/stop_inside.zmx",
    "lensfiles/double_gauss.json",
    "lensfiles/telephoto.json",
    "lensfiles/cooke_triplet.json",
    "lensfiles/sasian_triplet.roa",
    "zmx/lens1.zmx",
    "zmx/US05831776-1.zmx",
    "lenses/relay.zmx",
]
#: What formats of files cannot hold, as they say it.
UNHELD = (
    r"telecentric object space: .* has no place for it|.* means 0, 0.7 and 1 times it along y|"
    r"glass .* has no place for its formula|aperture = .* has no place for it|real_image_height|"
    r"fields = .*: an? .* file has no place for them"
)


def rms_of_spots(telescope, **options):
    """Rms spot radius over the fields [m], as ``pachon spots --aiming real`` has it."""
    if not telescope.design_data.telecentric:
        telescope = telescope.with_design(aiming="real")
    radii = pachon.spots(telescope, **options).rms_radius
    weights = np.array(telescope.design_data.field_weights or [1.0] * len(radii))
    return float(np.sqrt(weights @ radii**2 / weights.sum()))


def curved(telescope):
    return [s for s in telescope.surfaces if s.interaction == Interaction.REFRACT and any(s.shape.curvatures)]


def written(telescope, path):
    """Write a telescope, or return why its format cannot hold it."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", PrescriptionWarning)
            pachon.save_telescope(telescope, path)
    except PrescriptionError as error:
        return str(error)
    return None


def load(name):
    """The lens of a file; fields of the relay are heights of the object, not of an image whose size may change."""
    telescope = pachon.load_telescope(DATA / name)
    if telescope.design_data.field_type != "paraxial_image_height":
        return telescope
    return telescope.with_design(field_type="object_height", fields=((0.0, 0.0), (0.0, 0.004)), field_weights=())


@pytest.mark.slow
@pytest.mark.parametrize("name", LENSES)
def test_the_reported_merit_is_that_of_every_saved_file(name, tmp_path):
    start = load(name)
    variables = [*(f"{s.name}.radius" for s in curved(start)[:8]), f"{start.surfaces[-2].name}.thickness"]
    # Field angles of a near object, and so scales by them, change with the pupil.
    far = np.isinf(start.object_distance)
    targets = [pachon.design.FocalLength(pachon.design.FocalLength(1.0).measure(following_stop(start)))] if far else []
    optimum = pachon.optimize(
        start, variables, targets=targets, solver=pachon.design.LeastSquares(max_steps=15, tolerance=1e-4)
    )
    assert optimum.merits[0] == pytest.approx(rms_of_spots(start), rel=1e-2)
    assert optimum.is_better
    assert optimum.operands_not_held == ()
    read = 0
    for ending in WRITTEN:
        path = tmp_path / f"better{ending}"
        problem = written(optimum.telescope, path)
        if problem is not None:
            assert re.search(UNHELD, problem), problem
            continue
        again = pachon.load_telescope(path)
        read += 1
        assert again.design_data.stop == start.design_data.stop
        # More pupil points than those of the optimisation.
        assert optimum.merits[1] == pytest.approx(rms_of_spots(again), rel=1e-2)
    assert read >= 3


@pytest.mark.slow
@pytest.mark.parametrize("name", LENSES)
def test_a_stop_stays_on_its_surface_in_every_format(name, tmp_path):
    start = load(name)
    first = curved(start)[0].name
    for lens in (start, pachon.models.apply_changes(start, {f"{first}.curvature": 1.0, f"{first}.dz_um": 20.0})):
        for ending in WRITTEN:
            path = tmp_path / f"lens{ending}"
            problem = written(lens, path)
            if problem is not None:
                assert re.search(UNHELD, problem), problem
                continue
            again = pachon.load_telescope(path)
            assert again.design_data.stop == start.design_data.stop
            assert "pachon entrance pupil" not in path.read_text()
            size = max(lens.pupil_diameter, abs(lens.stop_z))
            shift = again.surfaces[0].vertex[2] - lens.surfaces[0].vertex[2]
            # Glass formulas that are fitted for a file have other last digits.
            assert again.stop_z - shift == pytest.approx(lens.stop_z, abs=1e-6 * size)


@pytest.mark.slow
@pytest.mark.parametrize("name", LENSES)
def test_exact_derivatives_are_differences_of_lenses_with_pupils_of_their_own(name):
    """Central differences of landing points of aimed rays, each lens with a new search, to 1e-6 of the largest."""
    start = following_stop(load(name))
    front = curved(start)[0].name
    steps = {f"{front}.curvature": 1e-2, f"{front}.dz": 1e-5, f"{front}.dy": 1e-5, f"{front}.rx": 1e-4}
    request = pachon.Request.of(start, n_pupil=2)
    light, points = start.default_wavelength, request.pupil.points

    def landing(lens):
        own = pachon.Request.of(lens, request.fields, n_pupil=2)
        aimed = AimedRays(ParameterColumns.at(lens, ()), own, light, points)
        return aimed.forward().image

    columns = ParameterColumns.at(start, parse_parameters(steps, start))
    aimed = AimedRays(columns, request, light, points)
    exact = aimed.derivatives(aimed.forward(), image_gradient(aimed.forward()))
    for column, (address, step) in enumerate(steps.items()):
        sides = {k: landing(apply(start, {address: k * step})) for k in (1, -1, 2, -2)}
        # Differences without their error of third order; landing points are found to 1e-13 m.
        numeric = (8 * (sides[1] - sides[-1]) - (sides[2] - sides[-2])) / (12 * step)
        largest = np.abs(numeric).max()
        assert np.abs(exact[..., column] - numeric).max() < 1e-6 * largest + 1e-13 / step, address


@pytest.mark.slow
def test_positions_of_a_zoom_lens_have_a_pupil_each(tmp_path):
    """Radii are shared, a thickness in front of the stop is that of one position."""
    near = load("lensfiles/stop_inside.zmx")
    far = replace(pachon.models.apply_changes(near, {"S2.thickness_mm": 2.0}), name="far")
    variables = ["S1.radius", "S6.radius", "stop_inside:S2.thickness", "far:S6.thickness", "stop_inside:S6.thickness"]
    found = pachon.optimize([near, far], variables, n_pupil=4, solver=pachon.design.LeastSquares(max_steps=8))
    squares, planes = [], []
    for position in found.telescopes:
        path = tmp_path / f"{position.name}.zmx"
        pachon.save_telescope(position, path)
        again = pachon.load_telescope(path)
        assert again.design_data.stop == "S4"
        squares.append(rms_of_spots(again, n_pupil=4) ** 2)
        planes.append(again.stop_z)
    assert found.merits[1] == pytest.approx(np.sqrt(np.mean(squares)), rel=1e-8)
    assert found.is_better
    assert abs(planes[0] - planes[1]) > 1e-5
