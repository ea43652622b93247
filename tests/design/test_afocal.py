"""Afocal telescopes in angles: beam expanders of two confocal paraboloids, whose figures have closed forms."""

from dataclasses import replace

import numpy as np
import pytest

import pachon
from pachon.core.errors import DomainError
from pachon.models.design_data import DesignData
from pachon.models.first_order import first_order
from pachon.models.shapes.shape import Conic, Plane
from pachon.models.surface import Interaction, Surface
from pachon.models.telescope import VACUUM, Telescope
from pachon.pipeline.report.info import describe, figure_rows

LIGHT = 500e-9
LONG, SHORT, WIDTH = 1.0, 0.2, 0.05  # focal lengths and beam [m]


def mersenne(gregorian=False, moved=0.0):
    """Two paraboloids with one focus, a beam expander of 5; the second moved up the axis."""
    sign = 1.0 if gregorian else -1.0
    second = (0.0, 0.0, LONG + sign * SHORT + moved)
    return Telescope(
        name="expander",
        surfaces=(
            Surface("M1", Interaction.MIRROR, Conic(2 * LONG, -1.0), (0.0, 0.0, 0.0), VACUUM),
            Surface("M2", Interaction.MIRROR, Conic(-sign * 2 * SHORT, -1.0), second, VACUUM),
            Surface("exit", Interaction.DETECTOR, Plane(), (0.0, 0.0, -0.1), VACUUM),
        ),
        stop_z=0.0, pupil_diameter=WIDTH, pupil_obscuration=0.0, launch_distance=2.0, reference_sphere_radius=1.0,
        field_radius=2e-3, field_limit=1e-2, wavelength_range=(4e-7, 7e-7), default_wavelength=LIGHT,
        design_data=DesignData(afocal=True),
    )  # fmt: skip


@pytest.mark.parametrize("gregorian", [False, True])
def test_first_order_is_the_angular_magnification(gregorian):
    telescope = mersenne(gregorian)
    found, power = first_order(telescope), (-1.0 if gregorian else 1.0) * LONG / SHORT
    assert found.angular_magnification == pytest.approx(power, rel=1e-12)
    assert np.isinf([found.focal_length, found.focus_z]).all()
    assert found.exit_pupil_diameter == pytest.approx(WIDTH * SHORT / LONG, rel=1e-12)
    # Directions of traced chief rays near the axis, and what the diagrams make of them.
    angle = 1e-5
    diagram = pachon.spots(telescope, [[0.0, 0.0], [0.0, angle]], threads=1)
    assert abs(diagram.reference_point[1, 1] / angle) == pytest.approx(abs(power), rel=1e-6)
    assert diagram.plate_scale[0] == pytest.approx(SHORT / LONG, rel=1e-6)
    rows = dict(figure_rows(describe(telescope)))
    assert float(rows["afocal, angular magnification"]) == pytest.approx(power, rel=1e-6)
    assert not {"focal length", "paraxial focus"} & set(rows)


def test_a_perfect_expander_has_plane_waves_and_the_airy_disc_of_its_exit_pupil():
    telescope, axis = mersenne(), [[0.0, 0.0]]
    diagram = pachon.spots(telescope, axis, threads=1)
    # Directions are good to some 1e-15.
    assert diagram.rms_radius[0] < 1e-14
    assert diagram.airy_radius[0] == pytest.approx(1.22 * LIGHT / (WIDTH * SHORT / LONG), rel=1e-4)
    opd = pachon.wavefront_opd(telescope, (0.0, 0.0), grid=16, wavelength=LIGHT, threads=1)
    assert np.nanmax(np.abs(opd.value)) < 1e-14
    transfer = pachon.mtf(telescope, axis, n_pupil=64, threads=1)
    cutoff = WIDTH * SHORT / LONG / LIGHT
    assert transfer.cutoff[0] == pytest.approx([cutoff, cutoff], rel=1e-4)
    part = np.minimum(transfer.frequency / cutoff, 1.0)
    closed = 2.0 / np.pi * (np.arccos(part) - part * np.sqrt(1.0 - part**2))
    # A lattice of 64 points across: rims.
    assert transfer.tangential[0] == pytest.approx(closed, abs=5e-3)
    table, names = transfer.to_table(), transfer.summary()
    assert str(table["frequency"].unit) == "1 / rad"
    assert {"cutoff_cycles_per_mrad", "cutoff_cycles_per_mm"} & set(names) == {"cutoff_cycles_per_mrad"}


def test_defocus_is_that_of_the_closed_form():
    """The second mirror moved by d: vergence d / f^2 behind it, so slopes h d / f^2 and a wavefront h^2 d / (2 f^2)."""
    moved = 2e-6
    telescope, radius = mersenne(moved=moved), 0.5 * WIDTH * SHORT / LONG
    vergence = moved / SHORT**2
    diagram = pachon.spots(telescope, [[0.0, 0.0]], threads=1)
    # To the next orders: the aperture over the focal length, squared, and the motion over the focal length.
    assert diagram.geometric_radius[0] < radius * vergence
    assert diagram.rms_radius[0] == pytest.approx(radius * vergence / np.sqrt(2.0), rel=2e-3)
    fans = pachon.design.opd_fans(telescope, [[0.0, 0.0]], threads=1)
    assert fans.peak_to_valley[0, 0] == pytest.approx(0.5 * radius**2 * vergence, rel=2e-3)
    # Light that still converges behind the telescope: the rim of the wavefront leads.
    assert abs(fans.value[0, 0, 0, 0] - fans.value[0, 0, 0, 32]) == pytest.approx(fans.peak_to_valley[0, 0], rel=1e-9)
    found = pachon.wavefront_zernikes(telescope, [[0.0, 0.0]], LIGHT, jmax=11, threads=1).coefficients[0]
    assert abs(found[3]) == pytest.approx(0.5 * radius**2 * vergence / (2.0 * np.sqrt(3.0)), rel=2e-3)
    # Wavefronts one by one and many at once are the same; so are those of rays turned by hand to plane waves.
    points = 0.5 * WIDTH * np.array([[0.0, 0.5, 0.0], [0.0, 0.0, 0.9]])
    field = (0.0, 1e-3)
    one = pachon.wavefront_opd(telescope, field, LIGHT, tuple(points), threads=1).value
    many = pachon.wavefront_opds(telescope, [field], LIGHT, tuple(points), threads=1).value[0]
    assert many == pytest.approx(one, abs=1e-14)
    end = pachon.trace(telescope, pachon.launch_rays(telescope, field, LIGHT, tuple(points)), threads=1)
    along = end.direction[0]
    plane = end.path_length + ((end.position[0] - end.position) @ along) / (end.direction @ along)
    # Directions of 2.5e-7 about the chief ray's: their squares over a metre.
    assert one == pytest.approx(plane[0] - plane, abs=1e-12)
    assert np.abs(one).max() > 5e-10


def test_fans_and_tables_are_in_microradians():
    telescope = mersenne(moved=1e-5)
    fans = pachon.ray_fans(telescope, [[0.0, 1e-3]], threads=1)
    assert str(fans.to_table()["along_field"].unit) == "urad"
    diagram = pachon.spots(telescope, [[0.0, 1e-3]], threads=1)
    assert str(diagram.to_table()["rms_radius"].unit) == "rad"
    assert diagram.summary()["rms_radius_urad"] == pytest.approx([1e6 * diagram.rms_radius[0]])
    end = pachon.trace(
        telescope, pachon.launch_rays(telescope, (0.0, 1e-3), LIGHT, ([0.0, 0.01], [0.0, 0.0])), threads=1
    )
    tangents = end.direction[:, :2] / -end.direction[:, 2:]
    found = pachon.Request.of(telescope, (0.0, 1e-3)).bundles(LIGHT, np.array([[0.0, 0.0], [0.01, 0.0]])).landing()[0]
    assert found == pytest.approx(tangents, abs=1e-15)


def test_what_needs_an_image_is_refused():
    telescope = mersenne()
    for name, call in {
        "a focus": lambda: pachon.through_focus(telescope),
        "a PSF": lambda: pachon.make_psfs(telescope, [[0.0, 0.0]], [LIGHT]),
        "a relative illumination": lambda: pachon.design.relative_illumination(telescope),
        "a map of ghosts": lambda: pachon.ghosts(telescope),
        "a focal plane": lambda: pachon.wavefront_opd(
            telescope, (0.0, 0.0), LIGHT, focal_plane=pachon.FocalPlane.flat("lsst")
        ),
    }.items():
        with pytest.raises(DomainError, match=f"expander is afocal, its light parallel: {name} needs an image"):
            call()
    for call in (pachon.field_curvature, pachon.design.chromatic_focus, pachon.design.spot_matrix):
        with pytest.raises(DomainError, match="expected one with a focus; its light is parallel"):
            call(telescope)
    # A telescope that is not said to be afocal keeps its own error.
    with pytest.raises(DomainError, match="expected one with a focus"):
        first_order(replace(telescope, design_data=DesignData()))
