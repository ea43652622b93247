"""Design data: what is checked, and the entrance pupil that a stop and an aperture make."""

import math
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import pachon
from pachon.core.errors import DomainError, PrescriptionError
from pachon.models.design_data import DesignData, vignetted
from pachon.models.io.prescription import load_telescope
from pachon.models.paraxial import stop_image

DATA = Path(__file__).parents[1] / "data" / "zmx"


@pytest.mark.parametrize(
    ("wrong", "expected"),
    [
        ({"length_unit": "furlong"}, "length_unit = 'furlong': expected one of m, cm, mm, in"),
        ({"aperture": "f_number"}, "aperture_value = None: expected a positive number, with the aperture"),
        ({"aperture_value": 4.0}, "aperture_value = 4.0: expected a positive number, with the aperture"),
        ({"aperture": "f_number", "aperture_value": -4.0}, "aperture_value = -4.0: expected a positive number"),
        ({"fields": ((0.0, 2.0),)}, "fields: expected angles within 90 degrees"),
        ({"fields": ((0.0, math.nan),)}, r"fields = \[0.0, nan\]: expected 2 finite numbers"),
        ({"fields": ((0.0, 0.1),), "field_weights": (1.0, 2.0)}, "field_weights: 2 of them: expected 1, as many"),
        ({"fields": ((0.0, 0.1),), "field_weights": (0.0,)}, "field_weights = .*: expected numbers from 0, not"),
        ({"fields": ((0, 0.1),), "vignetting": ((0, 0, 1, 0, 0),)}, "vignetting = .*: expected compressions below 1"),
        ({"wavelengths": (5e-7,), "wavelength_weights": (-1.0,)}, "wavelength_weights = .*: expected numbers from 0"),
        ({"temperature": -3.0}, "temperature = -3.0: expected a number from 0"),
        ({"telecentric": True, "aiming": "real"}, "telecentric: expected object or image heights as fields, and no"),
        ({"telecentric": True, "aperture": "f_number", "aperture_value": 4.0}, "telecentric: expected object_na"),
    ],
)  # fmt: skip
def test_wrong_data_are_refused_in_one_line(wrong, expected):
    with pytest.raises(PrescriptionError, match=rf"^(design data: )?{expected}"):
        DesignData(**wrong)


@pytest.mark.parametrize(
    ("wrong", "expected"),
    [
        ({"wavelengths": (5e-7,)}, "wavelengths: expected the primary one, 6e-07 m, among them"),
        ({"wavelengths": (5e-5, 6e-7)}, "wavelengths: 5e-05 m: expected within 3e-07 to 1.2e-06 m"),
        ({"fields": ((0.0, 0.1),), "field_type": "object_height"}, "expected an object at a finite distance"),
        ({"aperture": "object_na", "aperture_value": 0.1}, "expected an object at a finite distance"),
    ],
)
def test_data_belong_to_their_telescope(wrong, expected):
    with pytest.raises(PrescriptionError, match=expected):
        pachon.load_telescope("paul_baker").with_design(**wrong)


def test_a_telescope_with_design_data_is_pickled_and_compared():
    telescope = load_telescope(DATA / "lens1.zmx")
    assert pickle.loads(pickle.dumps(telescope)) == telescope
    assert telescope.with_design(length_unit="m") != telescope


def test_vignetting_factors_are_those_of_zemax():
    """px' = VDX + px (1 - VCX), py' = VDY + py (1 - VCY), then turned by VAN."""
    points = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, -1.0]])
    factors = np.array([[0.1, -0.2, 0.3, 0.4, 0.0], [0.1, -0.2, 0.3, 0.4, math.pi / 2]])
    expected = np.array([[0.1, -0.2], [0.8, -0.2], [0.1, -0.8]])
    found = vignetted(points, factors)
    assert found[0] == pytest.approx(expected, abs=1e-15)
    assert found[1] == pytest.approx(np.stack([-expected[:, 1], expected[:, 0]], axis=-1), abs=1e-15)


def thin_lens(telescope):
    """``lens1.zmx`` bent to twice its focal length, in its place."""
    from pachon.models.shapes.shape import Sphere

    surfaces = tuple(
        replace(s, shape=Sphere(2.0 * s.shape.radius)) if isinstance(s.shape, Sphere) else s for s in telescope.surfaces
    )
    return replace(telescope, surfaces=surfaces)


@pytest.mark.parametrize(
    ("name", "aperture"), [("lens1", "entrance_pupil"), ("HoO-V2C18Ex03", "f_number"), ("US05831776-1", "object_na")]
)
def test_the_pupil_of_a_file_is_the_one_that_its_stop_makes(name, aperture):
    telescope = load_telescope(DATA / f"{name}.zmx")
    assert telescope.design_data.aperture == aperture
    floated = pachon.models.with_floating_pupil(telescope)
    assert floated.stop_z == pytest.approx(telescope.stop_z, abs=1e-16)
    assert floated.pupil_diameter == pytest.approx(telescope.pupil_diameter, rel=1e-14)


def test_a_pupil_floats_with_the_lens():
    """At a stated focal ratio the diameter follows the focal length; a stated stop keeps its size."""
    telescope = load_telescope(DATA / "lens1.zmx")
    focal = pachon.first_order(telescope).focal_length
    by_ratio = telescope.with_design(aperture="f_number", aperture_value=3.0)
    weaker = pachon.models.with_floating_pupil(thin_lens(by_ratio))
    assert pachon.first_order(weaker).f_number == pytest.approx(3.0, rel=1e-13)
    assert weaker.pupil_diameter > 1.3 * focal / 3.0
    # The reverse: the semi-diameter that this pupil makes on the stop makes this pupil.
    radius = 0.5 * telescope.pupil_diameter * stop_image(telescope).stop_scale
    by_stop = telescope.with_design(aperture="stop", aperture_value=radius)
    assert pachon.models.with_floating_pupil(by_stop).pupil_diameter == pytest.approx(
        telescope.pupil_diameter, rel=1e-14
    )


def test_a_working_focal_ratio_is_that_of_the_cone_to_the_image():
    """1 : 1 imaging by a thin lens: the cone at the image is that at the object, so N = distance / diameter."""
    from pachon.models.media.medium import ConstantIndex
    from pachon.models.shapes.shape import Plane, Sphere
    from pachon.models.surface import Interaction, Surface

    focal, thin = 0.1, 1e-9
    glass = ConstantIndex(1.5)
    surfaces = (
        Surface("front", Interaction.REFRACT, Plane(), (0.0, 0.0, 0.0), glass),
        Surface("back", Interaction.REFRACT, Sphere(0.5 * focal), (0.0, 0.0, -thin), ConstantIndex(1.0)),
        Surface("image", Interaction.DETECTOR, Plane(), (0.0, 0.0, -2.0 * focal), ConstantIndex(1.0)),
    )
    lens = pachon.Telescope(
        name="one_to_one", surfaces=surfaces, stop_z=0.0, pupil_diameter=0.01, pupil_obscuration=0.0,
        launch_distance=1.0, reference_sphere_radius=0.2, field_radius=0.02, field_limit=0.5,
        wavelength_range=(3e-7, 1e-6), default_wavelength=5e-7, object_distance=2.0 * focal,
        design_data=DesignData(stop="front", aperture="working_f_number", aperture_value=10.0),
    )  # fmt: skip
    # Half the angle of the cone is the radius over the distance: 1 / (2 u) = 10.
    assert pachon.models.with_floating_pupil(lens).pupil_diameter == pytest.approx(2.0 * focal / 10.0, rel=1e-7)


def test_a_floating_pupil_needs_its_data():
    telescope = load_telescope(DATA / "lens1.zmx")
    with pytest.raises(DomainError, match="lens1: expected an aperture in its design data"):
        pachon.models.with_floating_pupil(telescope.with_design(aperture=None, aperture_value=None))
    with pytest.raises(DomainError, match=r"paul_baker: expected a surface that is the stop \(design data: stop\)"):
        pachon.models.with_floating_pupil(pachon.load_telescope("paul_baker"))
    with pytest.raises(DomainError, match="surface S3 of HoO-V2C18Ex46: expected one on the axis"):
        pachon.models.with_floating_pupil(load_telescope(DATA / "HoO-V2C18Ex46.zmx"))
