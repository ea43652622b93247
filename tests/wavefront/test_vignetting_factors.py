"""Vignetting factors of clear apertures: closed form of two discs, and an optimisation that makes them anew."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import pachon
from pachon.core.errors import DomainError
from pachon.models.aperture import Circle
from pachon.models.shapes.shape import Plane
from pachon.models.surface import Interaction, Surface

FILE = Path(__file__).parents[1] / "data" / "lensfiles" / "stop_inside.zmx"
ANGLE = 0.1


@pytest.fixture
def discs():
    """A disc of 4 mm radius 10 mm behind the entrance pupil of 5 mm, and a detector."""
    lens = pachon.load_telescope(FILE)
    names = [("Disc", Interaction.PASS, -0.01), ("Image", Interaction.DETECTOR, -0.02)]
    surfaces = tuple(Surface(n, kind, Plane(), (0.0, 0.0, z), lens.medium_before) for n, kind, z in names)
    surfaces = (replace(surfaces[0], aperture=Circle(4e-3)), surfaces[1])
    data = pachon.models.DesignData(fields=((0.0, 0.0), (0.0, ANGLE)))
    return replace(lens, surfaces=surfaces, groups={}, group_frames={}, stop_z=0.0, design_data=data)


def test_factors_of_two_discs(discs):
    """Light of the field crosses the disc beside the point of the pupil by 10 mm times the tangent."""
    axis, field = np.array(pachon.wavefront.with_vignetting_factors(discs).design_data.vignetting)
    assert axis == pytest.approx([0.0, 0.0, 0.2, 0.2, 0.0], abs=1e-7)
    beside = 10.0 * np.tan(ANGLE)
    # From the rim of the disc on one side to the rim of the pupil, or of the disc, on the other.
    low, high = max(-5.0, -4.0 - beside), min(5.0, 4.0 - beside)
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    chord = np.sqrt(4.0**2 - (middle + beside) ** 2)
    assert abs(field[1]) == pytest.approx(abs(middle) / 5.0, abs=1e-7)
    assert field[[0, 2, 3, 4]] == pytest.approx([0.0, 1.0 - chord / 5.0, 1.0 - half / 5.0, 0.0], abs=1e-7)
    # All rays of the field arrive, on the axes of the pupil at least.
    factored = pachon.wavefront.with_vignetting_factors(discs)
    points = pachon.wavefront.PupilSampling(
        0.99999 * 5e-3 * np.array([[0.0, 1.0], [0.0, -1.0], [1.0, 0.0], [-1.0, 0.0]]), np.ones(4)
    )
    assert pachon.Request.of(factored, sampling=points).bundles(discs.default_wavelength).lit.all()


def test_factors_are_made_anew_where_it_is_asked(discs):
    asked = discs.with_design(remake_vignetting=True)
    expected = np.array(pachon.wavefront.with_vignetting_factors(discs).design_data.vignetting)
    assert pachon.Request.of(asked).vignetting == pytest.approx(expected)
    wider = replace(asked, surfaces=(replace(asked.surfaces[0], aperture=Circle(0.1)), asked.surfaces[1]))
    assert pachon.Request.of(wider).vignetting == pytest.approx(np.zeros((2, 5)), abs=1e-12)
    assert pachon.Request.of(discs).vignetting is None
    assert pachon.Request.of(asked, [0.0, 0.0]).vignetting is None


@pytest.mark.slow
def test_an_optimum_has_the_factors_of_its_own_apertures(tmp_path):
    lens = pachon.load_telescope(FILE)
    rims = {"S1": 5.5e-3, "S6": 5e-3}
    surfaces = tuple(replace(s, aperture=Circle(rims[s.name])) if s.name in rims else s for s in lens.surfaces)
    lens = replace(lens, surfaces=surfaces).with_design(remake_vignetting=True)
    solver = pachon.design.LeastSquares(max_steps=4)
    found = pachon.optimize(lens, ["S1.radius", "S2.thickness", "S6.thickness"], n_pupil=3, solver=solver)
    pachon.save_telescope(found.telescope, tmp_path / "found.zmx")
    again = pachon.load_telescope(tmp_path / "found.zmx")
    aimed = found.telescope.with_design(aiming="real", remake_vignetting=False)
    expected = pachon.wavefront.with_vignetting_factors(aimed).design_data.vignetting
    assert again.design_data.vignetting[2][3] > 0.05
    assert np.array(again.design_data.vignetting) == pytest.approx(np.array(expected), abs=1e-6)
    radii = pachon.spots(again.with_design(aiming="real"), n_pupil=3).rms_radius
    assert found.merits[1] == pytest.approx(float(np.sqrt(np.mean(radii**2))), rel=1e-6)


def test_factors_need_fields_and_light(discs):
    with pytest.raises(DomainError, match="expected fields in its design data"):
        pachon.wavefront.with_vignetting_factors(discs.with_design(fields=()))
    dark = replace(discs, surfaces=(replace(discs.surfaces[0], vertex=(1.0, 0.0, -0.01)), discs.surfaces[1]))
    with pytest.raises(DomainError, match=r"field = \(0, 0\) deg: no ray reaches the image"):
        pachon.wavefront.with_vignetting_factors(dark)
