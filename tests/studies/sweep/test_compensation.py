import numpy as np
import pytest

from pachon.core.errors import PachonError
from pachon.pipeline.config import configuration_of, with_options
from pachon.pipeline.experiment import Experiment
from pachon.raytrace.launch import launch_rays
from pachon.raytrace.trace import trace
from pachon.studies.sweep.compensation import compensated
from pachon.wavefront.chief_rays import fields_at
from pachon.wavefront.silicon_focus import focus_height

#: All of them need a finished study, of seconds.
pytestmark = pytest.mark.long

NAMES = ("Camera.dz_um", "Camera.rx_urad", "Camera.ry_urad")
#: Corners and middle of the focal plane, so that tilts have a lever.
CCDS = ("R01_S11", "R10_S11", "R22_S11", "R34_S11", "R43_S11")


def experiment(changes=None, **focal_plane):
    content = {"ccds": list(CCDS), "wavelengths_nm": [624], "changes": changes or {}}
    return Experiment.from_config(
        configuration_of(content | {"focal_plane": focal_plane or {"budget": "flat"}}, "test")
    )


def mean_square(at, motion):
    """Mean square spot radius at centre and quarters of the CCDs, by tracing to detectors moved to each height."""
    total = []
    centers = at.camera.centers[[at.camera.ccd_index(name) for name in CCDS]]
    within = 0.5 * np.array([[0, 0], [1, 1], [1, -1], [-1, 1], [-1, -1]]) * (0.5 * at.camera.shortest_side)
    places = (centers[:, None] + within).reshape(-1, 2)
    fields = fields_at(at.telescope, places, 624e-9)
    heights = at.focal_plane.height(*places.T)
    dz, rx, ry = motion
    moved = at.telescope.perturbed("Camera", shift=(0, 0, dz * 1e-6), tilt=(rx * 1e-6, ry * 1e-6, 0))
    rng = np.random.default_rng(2)
    r, angle = np.sqrt(rng.uniform(2.6**2, 4.15**2, 400)), rng.uniform(0, 2 * np.pi, 400)
    for field, height in zip(fields, heights, strict=True):
        seen = moved.perturbed("Detector", shift=(0, 0, height))
        end = trace(seen, launch_rays(seen, field, 624e-9, (r * np.cos(angle), r * np.sin(angle))))
        spot = end.position[~end.vignetted, :2]
        total.append(((spot - spot.mean(axis=0)) ** 2).sum(axis=1).mean())
    return float(np.mean(total))


def test_a_planted_motion_of_the_camera_is_undone():
    best, still = compensated(experiment(), NAMES)
    _, moved = compensated(experiment({"Camera.dz_um": 20.0, "Camera.rx_urad": 30.0, "Camera.ry_urad": -10.0}), NAMES)
    # The camera goes back to the place that is best without the motion; 1e-3 of it is where the solver stops.
    assert moved["Camera.dz_um"] - still["Camera.dz_um"] == pytest.approx(-20.0, abs=0.02)
    assert moved["Camera.rx_urad"] - still["Camera.rx_urad"] == pytest.approx(-30.0, abs=0.05)
    assert moved["Camera.ry_urad"] - still["Camera.ry_urad"] == pytest.approx(10.0, abs=0.05)
    assert best.telescope != experiment().telescope


def test_heights_count_and_no_neighbouring_place_is_better():
    at = experiment(budget="simulated", global_um=40.0)
    _, found = compensated(at, NAMES)
    best = np.array([found[name] for name in NAMES])
    least = mean_square(at, best)
    assert least < mean_square(at, (0.0, 0.0, 0.0))
    for step in np.vstack([np.diag([2.0, 6.0, 6.0]), -np.diag([2.0, 6.0, 6.0])]):
        assert least < mean_square(at, best + step)


def test_nothing_to_solve_changes_nothing():
    at = experiment()
    assert compensated(at, ()) == (at, {})


def test_unknown_compensators_are_refused():
    with pytest.raises(PachonError, match="M7"):
        compensated(experiment(), ("M7.dz_um",))


def test_silicon_is_focused_where_light_turns_into_charge():
    with_silicon = configuration_of(
        {
            "band": "y",
            "ccds": ["R22_S11"],
            "wavelengths_nm": [970],
            "focal_plane": {"budget": "flat"},
            "detector": {"silicon": True},
        },
        "test",
    )
    in_silicon = Experiment.from_config(with_silicon)
    at_surface = Experiment.from_config(with_options(with_silicon, detector__silicon=False))
    (_, deep), (_, still) = (compensated(e, ["Detector.dz_um"]) for e in (in_silicon, at_surface))
    found = (deep["Detector.dz_um"] - still["Detector.dz_um"]) * 1e-6
    # Nothing but the detector moves, so this is the height itself; the design's own focus varies over a CCD.
    assert found == pytest.approx(focus_height(in_silicon.telescope, in_silicon.silicon, 970e-9), rel=0.01)
