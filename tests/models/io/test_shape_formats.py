"""Shapes written as lens files and read again: Qbfs and flat aspheres, toroids with powers, Fringe sags."""

import json
import warnings

import numpy as np
import pytest

import pachon
from pachon.core.errors import PrescriptionError, PrescriptionWarning
from pachon.models.media.medium import ConstantIndex
from pachon.models.telescope import VACUUM

SHAPES = {
    "toroid": pachon.models.Toroid(0.3, -0.2, 0.4, (0.2, -30.0, 100.0)),
    "qbfs": pachon.models.QbfsAsphere(0.2, 0.0, 0.02, (2e-5, -1e-5, 0.0, 3e-6)),
    # A Schmidt plate keeps its coefficients, which an optimisation varies by their names.
    "flat asphere": pachon.models.EvenAsphere(np.inf, 0.0, (0.2, -30.0, 400.0)),
    "flat qbfs": pachon.models.QbfsAsphere(np.inf, 0.0, 0.02, (2e-5, -1e-5)),
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


@pytest.mark.parametrize(
    ("name", "ending"),
    [*((name, "zmx") for name in SHAPES), ("toroid", "json"), *(("flat asphere", e) for e in ("seq", "json", "roa"))],
)
def test_written_and_read_again(name, ending, tmp_path):
    telescope, path = singlet(SHAPES[name]), tmp_path / f"lens.{ending}"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PrescriptionWarning)
        pachon.save_telescope(telescope, path)
        back = pachon.load_telescope(path)
    assert type(back.surfaces[0].shape) is type(SHAPES[name])
    # Rounding of coefficients in millimetres.
    assert np.abs(landing(telescope) - landing(back)).max() < 1e-15


def test_qbfs_terms_of_optiland(tmp_path):
    """Orders are texts in its JSON, which optiland itself does not read: its files are read here, and not written."""
    telescope, path = singlet(pachon.Conic(0.2, -0.5)), tmp_path / "lens.json"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PrescriptionWarning)
        pachon.save_telescope(telescope, path)
        content = json.loads(path.read_text())
        front = next(s for s in content["surface_group"]["surfaces"] if s["comment"] == "front")
        config = {"radius": 200.0, "conic": -0.5, "norm_radius": 20.0, "terms": {"0": 0.02, "2": -0.01}}
        for kind in ("ForbesQNormalSlopeGeometry", "ForbesQbfsGeometry"):
            items = {"type": kind, "surface_config": config, "solver_config": {"tol": 1e-6}}
            front["geometry"] = items | {"cs": front["geometry"]["cs"]}
            path.write_text(json.dumps(content))
            shape = pachon.load_telescope(path).surfaces[0].shape
            assert shape == pachon.models.QbfsAsphere(-0.2, -0.5, 0.02, (-2e-5, 0.0, 1e-5))
        front["geometry"]["surface_config"] = config | {"terms": {"0": 0.02, "x": -0.01}}
        path.write_text(json.dumps(content))
        with pytest.raises(PrescriptionError, match=r"terms = .*expected orders from 0 to 40"):
            pachon.load_telescope(path)
        with pytest.raises(PrescriptionError, match="surface front: Qbfs terms: optiland does not open"):
            pachon.save_telescope(singlet(SHAPES["qbfs"]), path)


@pytest.mark.parametrize("ending", ["seq", "len", "roa"])
@pytest.mark.parametrize(("name", "message"), [("toroid", "toroid with powers of y"), ("qbfs", "shape QbfsAsphere")])
def test_formats_without_them_say_so(name, message, ending, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PrescriptionWarning)
        with pytest.raises(PrescriptionError, match=f"surface front: {message}"):
            pachon.save_telescope(singlet(SHAPES[name]), tmp_path / f"lens.{ending}")
