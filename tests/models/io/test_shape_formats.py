"""Shapes written as lens files and read again: Qbfs aspheres, toroids with powers, Fringe sags."""

import warnings

import numpy as np
import pytest

import pachon
from pachon.core.errors import PrescriptionError, PrescriptionWarning
from pachon.models.media.medium import ConstantIndex
from pachon.models.telescope import VACUUM

SHAPES = {
    "toroid": pachon.Toroid(0.3, -0.2, 0.4, (0.2, -30.0, 100.0)),
    "qbfs": pachon.QbfsAsphere(0.2, 0.0, 0.02, (2e-5, -1e-5, 0.0, 3e-6)),
    "flat qbfs": pachon.QbfsAsphere(np.inf, 0.0, 0.02, (2e-5, -1e-5)),
}


def singlet(shape):
    surfaces = (
        pachon.Surface("front", pachon.Interaction.REFRACT, shape, (0.0, 0.0, 0.0), ConstantIndex(1.5)),
        pachon.Surface("back", pachon.Interaction.REFRACT, pachon.Plane(), (0.0, 0.0, -0.005), VACUUM),
        pachon.Surface("Detector", pachon.Interaction.DETECTOR, pachon.Plane(), (0.0, 0.0, -0.1), VACUUM),
    )
    return pachon.Telescope(
        "singlet", surfaces, stop_z=0.0, pupil_diameter=0.02, pupil_obscuration=0.0, launch_distance=1.0,
        reference_sphere_radius=0.1, field_radius=0.02, field_limit=0.2, wavelength_range=(4e-7, 8e-7),
        default_wavelength=5.5e-7, band=(5e-7, 6e-7),
    )  # fmt: skip


def landing(telescope):
    x, y = np.meshgrid(np.linspace(-0.009, 0.009, 7), np.linspace(-0.009, 0.009, 7))
    rays = pachon.launch_rays(telescope, (0.01, -0.02), 5.5e-7, (x.ravel(), y.ravel()))
    end = pachon.trace(telescope, rays)
    assert (end.status == pachon.RayStatus.OK).all()
    return telescope.surfaces[-1].to_local(end.position)


@pytest.mark.parametrize("ending", ["zmx", "json"])
@pytest.mark.parametrize("name", SHAPES)
def test_written_and_read_again(name, ending, tmp_path):
    telescope, path = singlet(SHAPES[name]), tmp_path / f"lens.{ending}"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PrescriptionWarning)
        pachon.save_telescope(telescope, path)
        back = pachon.load_telescope(path)
    assert type(back.surfaces[0].shape) is type(SHAPES[name])
    # Rounding of coefficients in millimetres.
    assert np.abs(landing(telescope) - landing(back)).max() < 1e-15


@pytest.mark.parametrize("ending", ["seq", "len", "roa"])
@pytest.mark.parametrize(("name", "message"), [("toroid", "toroid with powers of y"), ("qbfs", "shape QbfsAsphere")])
def test_formats_without_them_say_so(name, message, ending, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PrescriptionWarning)
        with pytest.raises(PrescriptionError, match=f"surface front: {message}"):
            pachon.save_telescope(singlet(SHAPES[name]), tmp_path / f"lens.{ending}")
