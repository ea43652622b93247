"""The OPD in silicon, against Snell's law ray by ray, and against a detector moved by the equivalent defocus."""

import numpy as np
import pytest

import pachon
from pachon.core.errors import DomainError
from pachon.models.camera.silicon import Silicon

WAVELENGTH = 970e-9


@pytest.fixture(scope="module")
def lsst_y():
    return pachon.load_telescope("lsst_v3.3_y")


@pytest.mark.parametrize("field", [(0.0, 0.0), (0.021, 0.016)])
def test_against_refracted_rays(lsst_y, field):
    """Optical paths from the surface to a point at the mean depth, along the refracted chief ray."""
    silicon = Silicon()
    index, length, thickness = silicon.index(WAVELENGTH), silicon.absorption_length(WAVELENGTH), silicon.thickness
    depth = length - thickness / np.expm1(thickness / length)
    before = pachon.wavefront_opd(lsst_y, field, WAVELENGTH, grid=24)
    after = pachon.wavefront_opd(lsst_y, field, WAVELENGTH, grid=24, silicon=silicon)

    def refracted(direction):
        inside = direction / index
        inside[..., 2] = np.sqrt(1.0 - inside[..., 0] ** 2 - inside[..., 1] ** 2)
        return inside

    center = pachon.wavefront_opd(lsst_y, field, WAVELENGTH, ([0.0], [0.0]))
    chief = center.exit_direction[0]
    deep = refracted(chief.copy()) * depth
    # Plane waves about the focus: from the point on the surface to that in silicon, path falls along each direction.
    moved = index * refracted(before.exit_direction.copy()) @ deep - index * refracted(chief.copy()) @ deep
    lit = before.lit
    change = (after.value - before.value)[lit]
    # The fourth order in the direction cosines, u^4 s / 8 n^3, is 3 nm on the axis and 7 nm off it.
    np.testing.assert_allclose(change, -moved[lit], atol=8e-9)
    assert np.ptp(change) == pytest.approx(660e-9, rel=0.05)


def test_is_a_detector_moved_along_the_light(lsst_y):
    silicon = Silicon()
    shift = silicon.defocus(WAVELENGTH)[0] * 0.94
    moved = lsst_y.perturbed("Detector", shift=(0.0, 0.0, shift))
    still, deep, far = (
        pachon.wavefront_opd(telescope, (0.0, 0.0), WAVELENGTH, grid=24, reference="mean", silicon=s)
        for telescope, s in ((lsst_y, None), (lsst_y, silicon), (moved, None))
    )
    lit = still.lit
    change, defocus = (deep.value - still.value)[lit], (far.value - still.value)[lit]
    # Spherical aberration is that of a plate of silicon against one of vacuum.
    np.testing.assert_allclose(change, defocus, atol=0.02 * np.ptp(defocus))


def test_many_fields_and_the_mean_as_reference(lsst_y):
    silicon, fields = Silicon(), [(0.0, 0.0), (0.02, -0.01)]
    maps = pachon.wavefront_opds(lsst_y, fields, WAVELENGTH, grid=16, silicon=silicon)
    for field, value in zip(fields, maps.value, strict=True):
        one = pachon.wavefront_opd(lsst_y, field, WAVELENGTH, grid=16, silicon=silicon)
        np.testing.assert_allclose(value, one.value, atol=1e-12)
        mean = pachon.wavefront_opd(lsst_y, field, WAVELENGTH, grid=16, silicon=silicon, reference="mean")
        plain = pachon.wavefront_opd(lsst_y, field, WAVELENGTH, grid=16, reference="mean")
        assert np.nanmean(mean.value) == pytest.approx(0.0, abs=1e-14)
        # From one reference to the other it differs by a tilt and a constant.
        terms = np.stack([np.ones(one.lit.sum()), one.x[one.lit], one.y[one.lit]], axis=1)
        difference = (mean.value - plain.value - value + maps_without(lsst_y, field))[one.lit]
        left = difference - terms @ np.linalg.lstsq(terms, difference, rcond=None)[0]
        assert np.abs(left).max() < 1e-10


def maps_without(telescope, field):
    """The OPD without silicon."""
    return pachon.wavefront_opd(telescope, field, WAVELENGTH, grid=16).value


def test_transparent_silicon_is_one_clear_line(lsst_y):
    with pytest.raises(DomainError, match=r"^temperature = 90"):
        pachon.wavefront_opd(lsst_y, (0.0, 0.0), WAVELENGTH, silicon=Silicon(temperature=90.0))
