"""Files of ray-optics against its own rays."""

from pathlib import Path

import numpy as np
import pytest

import pachon

rayoptics = pytest.importorskip("rayoptics")

# Each ray is traced by Python there.
pytestmark = pytest.mark.slow
ROOT = Path(rayoptics.__file__).parent
FILES = [
    *(
        f"models/{name}.roa"
        for name in ("Cassegrain", "Dall_Kirkham", "Ritchey_Chretien", "Sasian Triplet", "TwoMirror")
    ),
    *("models/double2frelay.roa", "models/f2 focuser.roa", "models/singlet_f5.roa", "models/telephoto.roa"),
    *("optical/tests/cell_phone_camera.roa", "optical/tests/Nikon Nikkor Z 14-30mm f-4 S.roa"),
    *("optical/tests/US007277232_Example04P.roa", "optical/tests/US007277232_Example04P_hikari_glasses.roa"),
    *("gui/tests/cell_phone_camera_old.roa", "zemax/models/PhotoPrime/US05331467-1_asm.roa"),
]
UNITS = {"mm": 1e3, "cm": 1e2, "m": 1.0}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", FILES)
def test_rays_of_a_file(name):
    from rayoptics.gui.appcmds import open_model
    from rayoptics.raytr import trace

    if not (ROOT / name).is_file():
        pytest.skip(f"this ray-optics has no {name}")
    telescope, model = pachon.load_telescope(ROOT / name), open_model(str(ROOT / name))
    sequence, unit = model["seq_model"], UNITS[model.system_spec.dimensions.lower()]
    # The object a millimetre in front of the first surface: rays of any direction from any point of its plane.
    sequence.gaps[0].thi = 1.0
    sequence.update_model()
    wavelength = telescope.default_wavelength
    # It looks for wavelengths of its own by their exact numbers.
    nm = min(model["optical_spec"].spectral_region.wavelengths, key=lambda w: abs(w - wavelength * 1e9))
    assert nm == pytest.approx(wavelength * 1e9, rel=1e-12)
    rng = np.random.default_rng(4)
    radius, angle = 0.5 * telescope.pupil_diameter * np.sqrt(rng.uniform(size=8)), rng.uniform(0, 2 * np.pi, 8)
    points = (radius * np.cos(angle), radius * np.sin(angle))
    image, first = telescope.surfaces[-1], telescope.surfaces[0].vertex[2]
    for fraction in (0.0, 0.5):
        field = (0.2 * fraction * telescope.field_radius, fraction * telescope.field_radius)
        rays = pachon.launch_rays(telescope, field, wavelength, points, projection="zemax")
        traced = pachon.trace(telescope, rays)
        local = (np.array(traced.position) - image.vertex) @ image.matrix * [-unit, unit, -unit]
        for place, along, ours in zip(np.array(rays.position), np.array(rays.direction), local, strict=True):
            x, y, z = (place - [0.0, 0.0, first]) * [-unit, unit, -unit]
            direction = along * [-1.0, 1.0, -1.0]
            start = np.array([x, y, z]) - direction * (z + 1.0) / direction[2]
            start[2] = 0.0
            ray = trace.trace(sequence, start, direction, nm)[0]
            # 1 nm is what was asked for, 4e-14 m what is found.
            assert np.allclose(ours, ray[-1][0], rtol=0, atol=1e-12 * unit)
