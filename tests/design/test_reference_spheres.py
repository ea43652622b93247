"""Reference spheres that rays of a detector far from the focus would miss."""

from dataclasses import replace

import numpy as np
import pytest

import pachon
from pachon.core.errors import DomainError

LENS = """MODE SEQ
UNIT MM X W X CM MR CPMM
ENPD 80
FTYP 0 0 1 1 0 0 0
XFLN 0
YFLN 0
WAVM 1 0.5876 1
SURF 0
  TYPE STANDARD
  DISZ INFINITY
SURF 1
  STOP
  TYPE STANDARD
  CURV {curvature}
  DISZ 12
  GLAS N-BK7 0 0 1.5 40
SURF 2
  TYPE STANDARD
  CURV 0
  DISZ {distance}
SURF 3
  TYPE STANDARD
  CURV 0
"""


def lens(tmp_path, distance):
    path = tmp_path / "lens.zmx"
    path.write_text(LENS.format(curvature=1 / 500, distance=distance))
    return pachon.load_telescope(path)


def test_a_detector_close_to_the_pupil_has_a_sphere_of_the_focal_length(tmp_path):
    close, focused = lens(tmp_path, 20), lens(tmp_path, 960)
    focal_length = pachon.first_order(close).focal_length
    assert close.reference_sphere_radius == pytest.approx(focal_length)
    # At the focus it reaches the exit pupil, the image of the stop by the lens behind it.
    assert focused.reference_sphere_radius == pytest.approx(0.9679, abs=1e-3)
    assert np.isfinite(pachon.strehl(close).rms_wavefront).all()
    assert np.isfinite(pachon.sensitivity(close, ["L1.dz"]).matrix).all()


def test_rays_that_miss_a_stated_sphere_are_said(paraboloid):
    # The detector is a metre in front of the focus, where the beam of 0.2 m is half as wide.
    telescope = replace(paraboloid(2.0, 10.0, shift=-1.0), reference_sphere_radius=0.03)
    words = r"^reference sphere of 0.03 m: rays miss it"
    field = np.zeros((1, 2))
    for analysis in (
        lambda: pachon.wavefront_opd(telescope, (0.0, 0.0)),
        lambda: pachon.wavefront_zernikes(telescope, field),
        lambda: pachon.sensitivity(telescope, ["mirror.dz"], field),
        lambda: pachon.optimize(telescope, ["mirror.radius"], "wavefront", field),
    ):
        with pytest.raises(DomainError, match=words):
            analysis()
    assert np.isnan(pachon.strehl(telescope, field, from_psf=False).wavefront).all()
