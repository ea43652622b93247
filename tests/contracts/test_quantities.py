"""Lengths and angles of the public API are quantities as well as plain numbers."""

import inspect
import re

import numpy as np
import pytest
from astropy import units as u
from public_calls import calls
from public_names import public_objects

import pachon
from pachon.core.docstrings import described

# What is tested is made once for the file, in seconds.
pytestmark = pytest.mark.long

#: Units in which quantities are handed over, by what the docstrings say.
OTHER = {"m": u.um, "rad": u.arcmin}
#: Names of arguments that are lengths or angles, whatever the docstring says.
LENGTHS = re.compile(
    r"^(wavelengths?|pixel|pixel_size|pixel_scale|radius(_[xy])?|diameter|field|fields|shift|tilt|angle|width|height"
    r"|outer_scale|r0|thickness|period|half_size|position_angle|weight_fwhm|sphere_radius|field_radius)$"
)
#: Of those, the ones that are no lengths or angles: radii and widths in pixels of an image.
PIXELS = {"match_positions", "Window", "energy_curve", "GridSag", "ZernikeSag"}


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    return calls(tmp_path_factory.mktemp("calls"))


def owner(label, function):
    """Object with the docstring of a call: the class of a constructor, or the function."""
    return public_objects().get(label, function)


def test_plain_numbers_may_be_quantities(table):
    tried = 0
    for label, (function, arguments) in table.items():
        for name, value in arguments.items():
            kind = str(inspect.signature(function).parameters[name].annotation)
            unit = described(owner(label, function), name).unit
            if "float" not in kind or value is None or unit not in OTHER:
                continue
            quantity = u.Quantity(value, unit).to(OTHER[unit])
            if inspect.isclass(function):
                made = getattr(function(**arguments | {name: quantity}), name)
                np.testing.assert_allclose(made, value, rtol=1e-12, err_msg=f"{label}({name})")
                tried += 1
            with pytest.raises(pachon.PachonError, match=name.rstrip("s")):
                function(**arguments | {name: u.Quantity(value, u.kg)})
    assert tried > 40


def test_lengths_and_angles_say_their_unit(table):
    silent = [
        f"{label}({name})"
        for label, (function, arguments) in table.items()
        for name in arguments
        if LENGTHS.match(name) and label.partition(".")[0] not in PIXELS
        if "float" in str(inspect.signature(function).parameters[name].annotation)
        and not described(owner(label, function), name).unit
    ]
    assert silent == []


def test_units_of_arguments_in_docstrings():
    assert described(pachon.models.Circle, "x").unit == "m"
    assert described(pachon.paul_baker, "field_radius").unit == "rad"
    assert described(pachon.models.Biconic, "radius_x").unit == "m"
    assert described(pachon.models.Weather, "pressure_mmhg").unit == ""
    assert described(pachon.models.EvenAsphere, "coefficients").unit == ""
    assert pachon.models.Circle(250.0 * u.mm, x=1.0 * u.cm) == pachon.models.Circle(0.25, 0.01, 0.0)
    assert pachon.models.Polygon([[0, 0], [1, 0], [0, 1]] * u.km) == pachon.models.Polygon(
        ((0.0, 0.0), (1e3, 0.0), (0.0, 1e3))
    )
    with pytest.raises(pachon.errors.DomainError, match=r"^conic = 1\.0 m: expected a number"):
        pachon.Conic(5.0, 1.0 * u.m)
