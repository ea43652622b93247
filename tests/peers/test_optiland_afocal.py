"""Wavefronts of an afocal telescope beside optiland's, which refers them to a plane too."""

import numpy as np
import pytest

import pachon
from pachon.models.media.medium import ConstantIndex
from pachon.models.shapes.shape import Conic, Plane
from pachon.models.surface import Interaction, Surface
from pachon.models.telescope import VACUUM, Telescope

WAVELENGTH, FIELD, WIDTH = 0.55e-6, 0.5, 15.0
#: Radius, thickness [mm], index behind, conic constant: a Keplerian telescope of 6.8.
ROWS = ((103.0, 4.0, 1.5168, -0.6), (None, 223.1, 1.0, 0.0), (None, 4.0, 1.5168, 0.0), (-15.0, 34.0, 1.0, -0.6))


def keplerian():
    surfaces, z = [], 0.0
    for i, (radius, thickness, index, conic) in enumerate(ROWS):
        shape = Plane() if radius is None else Conic(-1e-3 * radius, conic)
        medium = VACUUM if index == 1 else ConstantIndex(index)
        surfaces.append(Surface(f"S{i}", Interaction.REFRACT, shape, (0.0, 0.0, z), medium))
        z -= 1e-3 * thickness
    surfaces.append(Surface("exit", Interaction.DETECTOR, Plane(), (0.0, 0.0, z), VACUUM))
    angle = np.deg2rad(FIELD)
    return Telescope(
        name="keplerian", surfaces=tuple(surfaces), stop_z=0.0, pupil_diameter=1e-3 * WIDTH, pupil_obscuration=0.0,
        launch_distance=3.0, reference_sphere_radius=1.0, field_radius=angle, field_limit=2 * angle,
        wavelength_range=(0.4e-6, 0.8e-6), default_wavelength=WAVELENGTH,
    ).with_design(afocal=True)  # fmt: skip


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_wavefronts_against_plane_waves():
    materials = pytest.importorskip("optiland.materials")
    from optiland.optic import Optic
    from optiland.wavefront import OPD

    optic = Optic()
    optic.surfaces.add(index=0, radius=np.inf, thickness=np.inf)
    # The stop is a plane in front.
    optic.surfaces.add(index=1, thickness=0.0, is_stop=True)
    for i, (radius, thickness, index, conic) in enumerate(ROWS, start=2):
        glass = "air" if index == 1 else materials.IdealMaterial(n=index)
        radius = np.inf if radius is None else radius
        optic.surfaces.add(index=i, radius=radius, conic=conic, thickness=thickness, material=glass)
    optic.surfaces.add(index=len(ROWS) + 2)
    optic.set_aperture(aperture_type="EPD", value=WIDTH)
    optic.fields.set_type(field_type="angle")
    optic.fields.add(y=0)
    optic.fields.add(y=FIELD)
    optic.wavelengths.add(value=1e6 * WAVELENGTH, is_primary=True)
    telescope, height = keplerian(), 0.5e-3 * WIDTH * np.linspace(-1.0, 1.0, 17)
    # Their planes stand at another place along the chief ray, and other rays go on at other angles to it.
    for part, within in ((0.0, 1e-8), (1.0, 2e-6)):
        wave = OPD(optic, (0, part), 1e6 * WAVELENGTH, num_rays=17, distribution="line_y", afocal=True)
        (data,) = wave.data.values()
        field = (0.0, part * telescope.field_radius)
        found = pachon.wavefront_opd(telescope, field, WAVELENGTH, (np.zeros(17), height), threads=1)
        assert np.abs(found.waves).max() > 0.05
        assert found.waves == pytest.approx(np.asarray(data.opd), abs=within)
