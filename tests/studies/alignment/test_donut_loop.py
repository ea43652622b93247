"""The active-optics loop on images of donuts, which take seconds a visit."""

import numpy as np
import pytest

from pachon.studies.alignment.config import AlignConfig
from pachon.studies.alignment.exposure import expose, fit
from pachon.studies.alignment.loop import align
from pachon.studies.alignment.product import alignment_summary
from pachon.studies.alignment.scene import AlignmentScene


@pytest.mark.slow
def test_donuts_of_images_align_the_telescope():
    found = align(AlignConfig(visits=3))
    summary = alignment_summary(found)
    assert summary["first_visit_within_1.2_floors"] <= 2
    assert summary["first_added_nm"] > 600.0
    # Turbulence of 15 s and one seed: the mean of three visits scatters by a third.
    assert found.visits[2].added < 1.6 * found.expected[2]


@pytest.mark.slow
def test_ignored_heights_shift_the_wavefront():
    # Sensors 4 um off in the mean make that much of defocus: 16 nm of Z4 rms a um.
    settings = AlignConfig(
        visits=1,
        air={"wavefront": False},
        errors={"initial": 0.0},
        donuts={"heights": "lsstcam", "believed_heights": "nominal"},
    )
    scene = AlignmentScene.of(settings)
    zernikes = fit(scene, expose(scene, scene.telescope, 0)).zernikes
    expected = 15.8e-3 * (scene.stars.heights - scene.believed.heights)
    assert zernikes[:, 0] == pytest.approx(expected, abs=30e-9)
    assert np.abs(expected).max() > 100e-9
