"""HTML of telescopes and cameras, and what it says where there is no picture."""

import base64
import pickle
import re
import struct

import numpy as np
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


@pytest.fixture
def figure():
    return pachon.spots(pachon.paul_baker(), n_pupil=3).plot()


def test_figures_are_shown_without_a_backend_of_the_notebook(figure):
    """IPython asks each object for ``_repr_png_`` where no formatter of its type is registered."""
    shown = figure._repr_png_()
    assert shown.startswith(b"\x89PNG")
    wide, high = struct.unpack(">II", shown[16:24])
    np.testing.assert_allclose((wide, high), 100 * figure.get_size_inches(), atol=1.0)


def test_figures_can_be_pickled(figure):
    assert pickle.loads(pickle.dumps(figure))._repr_png_().startswith(b"\x89PNG")


def test_ipython_shows_a_figure_as_a_picture(figure):
    formatters = pytest.importorskip("IPython.core.formatters")
    data, _ = formatters.DisplayFormatter().format(figure)
    assert data["image/png"].startswith(b"\x89PNG")
