"""Shared parts of the plots of design studies."""

import numpy as np
import pytest

from pachon.design.drawing import wavelength_colors


@pytest.mark.parametrize("order", [(0, 1, 2), (1, 0, 2), (2, 1, 0)])
def test_the_shortest_wavelength_is_blue_and_the_longest_red_in_any_order(order):
    """Lens files list the d line first."""
    waves = np.array([486.1e-9, 587.6e-9, 656.3e-9])[list(order)]
    colors = dict(zip(waves, wavelength_colors(waves), strict=True))
    shortest, middle, longest = (colors[wave][:3] for wave in sorted(waves))
    assert np.argmax(shortest) == 2
    assert np.argmax(middle) == 1
    assert np.argmax(longest) == 0
