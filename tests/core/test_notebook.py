"""HTML of telescopes and cameras, and what it says where there is no picture."""

import base64
import re

import pytest

import pachon
from pachon.core.errors import DomainError
from pachon.core.notebook import html_picture


def picture(html):
    """The PNG file in HTML."""
    return base64.b64decode(re.search(r'src="data:image/png;base64,([^"]+)"', html).group(1))


@pytest.mark.parametrize("name", ["hsc", "paul_baker"])
def test_a_telescope_is_shown_with_its_section(name):
    html = pachon.load_telescope(name)._repr_html_()
    assert f"&lt;Telescope {pachon.load_telescope(name).name}" in html
    assert picture(html).startswith(b"\x89PNG")


def test_cameras_are_shown_with_their_ccds():
    shown = {name: picture(pachon.load_camera(name)._repr_html_()) for name in ("lsst", "comcam")}
    assert shown["lsst"] != shown["comcam"]


def test_a_picture_that_cannot_be_drawn_is_a_line():
    def draw():
        raise DomainError("no <light>")

    assert html_picture(draw, "Telescope") == "<p>No picture: no &lt;light&gt;</p>"
