"""Fixtures of images of other programs."""

import pytest
from drawn_fields import draw_field


@pytest.fixture(scope="session")
def field():
    return draw_field(30, 60)
