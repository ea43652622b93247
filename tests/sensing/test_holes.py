"""Donuts whose hole is not that of the telescope: a warning with both obscurations."""

import re
import warnings
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

import pachon
from pachon.errors import PrescriptionWarning
from pachon.sensing import hole

FIELDS = np.zeros((1, 2))
MODEL = pachon.DonutModel(detector=pachon.DonutDetector(20e-6, defocus=8e-3), neighbours=False, diffraction=False)


def telescope(folder, inner, obscuration):
    """A paraboloid of 0.5 m, f/8, with a hole of an inner radius [m]."""
    content = {
        "name": "newton",
        "source": "a closed form",
        "version": "1",
        "units": {"length": "m", "angle": "deg", "wavelength": "um"},
        "stop": {"z": 0.0},
        "pupil": {"diameter": 0.5, "obscuration": obscuration},
        "launch_distance": 6.0,
        "reference_sphere_radius": 4.0,
        "field": {"radius": 0.1, "limit": 1.0},
        "wavelengths": {"range": [0.3, 1.2], "default": 0.5},
        "surfaces": [
            {"name": "M1", "type": "mirror", "shape": "conic", "z": 0.0, "radius": 8.0, "conic": -1.0}
            | {"annulus": [inner, 0.25]},
            {"name": "Detector", "type": "detector", "shape": "plane", "z": 4.0, "circle": 0.1},
        ],
    }
    path = folder / "telescope.yaml"
    path.write_text(yaml.safe_dump(content))
    return pachon.load_telescope(path)


@pytest.mark.parametrize("stated", [0.0, 0.4])
def test_the_obscuration_of_the_light_is_that_of_its_apertures(tmp_path, stated):
    # To half of one of 96 cells across the pupil.
    assert hole.lit_obscuration(telescope(tmp_path, 0.1, stated), 500e-9) == pytest.approx(0.4, abs=0.5 / 48)


@pytest.mark.long
@pytest.mark.parametrize("unit", [1.0, 1e-3])
def test_donuts_of_another_hole_are_said_to_have_it(tmp_path, unit):
    """The engine that draws the donuts diffracts light, and knows nothing of the fit nor of the units of images."""
    true = telescope(tmp_path, 0.1, 0.4)
    air = pachon.Atmosphere.from_site("cerro_pachon", 3, exposure=30.0)
    donuts = pachon.draw_donuts(true, FIELDS, 500e-9, model=MODEL, electrons=1e6, sky=100.0, seed=1, atmosphere=air)

    def fit(believed):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", PrescriptionWarning)
            pachon.fit_donuts(believed, unit * donuts.images, FIELDS, 500e-9, model=MODEL, noll=range(4, 12))
        return [str(warning.message) for warning in caught]

    assert fit(true) == []
    (message,) = fit(telescope(tmp_path, 0.125, 0.5))
    shown, lit = (float(text) for text in re.findall(r"0\.\d+", message))
    assert "\n" not in message
    # The wrong telescope makes the seeing of the fit too wide, which moves the edges a little.
    assert (shown, lit) == (pytest.approx(0.4, abs=0.03), pytest.approx(0.5, abs=0.01))


@pytest.mark.parametrize(("count", "said"), [(1, True), (2, True), (10, False)])
def test_one_donut_of_a_crowd_does_not_speak_for_all(tmp_path, monkeypatch, count, said):
    """Of many donuts with neighbours one that seems to have none may have some too."""
    monkeypatch.setattr(hole, "_brightest_ratios", lambda *_: (np.full((1, 4), 0.2), np.full((1, 4), 0.4)))
    instrument = SimpleNamespace(telescope=telescope(tmp_path, 0.1, 0.4), middle=500e-9)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", PrescriptionWarning)
        hole.warn_of_other_hole(instrument, dict.fromkeys(range(count)), None)
    assert bool(caught) == said


@pytest.mark.parametrize(("donut", "said"), [(0.06, False), (0.6, True)])
def test_a_hole_that_the_seeing_fills_says_nothing(tmp_path, monkeypatch, donut, said):
    """A donut of f/6.3, 1.5 mm out of focus, is three times as wide as the seeing: its own image has hardly a hole."""
    model = np.array([[0.0, 0.0, 0.07, 0.0]])
    monkeypatch.setattr(hole, "_brightest_ratios", lambda *_: (np.full((1, 4), donut), model))
    instrument = SimpleNamespace(telescope=telescope(tmp_path, 0.1, 0.4), middle=500e-9)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", PrescriptionWarning)
        hole.warn_of_other_hole(instrument, {0: None}, None)
    assert bool(caught) == said
