"""Rims near the image that stand aside: rates of the pupil's cells, and wavefronts of vignetted donuts."""

from dataclasses import replace

import numpy as np
import pytest
from donut_images import PIXEL, WAVELENGTH, donut

import pachon
from pachon.models.aperture import shifted
from pachon.raytrace.rays import field_direction, parallel_rays
from pachon.sensing.pupil_cells import pupil_cells
from pachon.sensing.vignetting import cells_with_rims, movable_rims

EDGE = np.deg2rad([1.75 * 0.6, 1.75 * 0.8])


def rims_at(tel, field):
    along = 0.98 * (np.arange(60) - 29.5) / 60 * tel.pupil_diameter
    points = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
    rays = parallel_rays(tel, field_direction(*field)[None], WAVELENGTH, points)
    return {rim.name: rim for rim in movable_rims(tel, points, pachon.trace(tel, rays, "all"))}


def test_only_rims_with_a_narrow_beam_matter(behind_focus):
    """At the edge of the field the filter cuts a beam of 0.2 m; M2 and M3, metres wide, vignette far inside of it."""
    assert rims_at(behind_focus, np.deg2rad([0.0, 1.6])) == {}
    found = rims_at(behind_focus, EDGE)
    assert "Filter_entrance" in found
    assert not {"M1", "M2", "M3"} & set(found)


def test_rates_are_those_of_a_shifted_rim(behind_focus):
    direction, name, shift = field_direction(*EDGE), "Filter_entrance", 4e-4
    rims = [rims_at(behind_focus, EDGE)[name]]
    cells = cells_with_rims(behind_focus, direction, WAVELENGTH, 48, rims)
    assert cells.weights.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(cells.rates.sum(axis=0), 0.0, atol=1e-9)
    moved = replace(
        behind_focus,
        surfaces=tuple(
            replace(s, aperture=shifted(s.aperture, 0.0, shift)) if s.name == name else s for s in behind_focus.surfaces
        ),
    )
    expected = pupil_cells(moved, direction, WAVELENGTH, 48)
    before = pupil_cells(behind_focus, direction, WAVELENGTH, 48)

    def mean_squares(cells, weights):
        """Centroid and mean square of the light: of the centroids, and within the cells."""
        points = cells.points
        second = points[:, :, None] * points[:, None, :] + cells.moments
        return np.concatenate([weights @ points, np.tensordot(weights, second, axes=1).ravel()])

    predicted = mean_squares(cells, cells.weights + shift * cells.rates[:, 1])
    truth, start = mean_squares(expected, expected.weights), mean_squares(before, before.weights)
    # The change, to what its second order and rims found to a 500th of a cell leave.
    np.testing.assert_allclose(predicted - start, truth - start, atol=0.04 * np.abs(truth - start).max())


@pytest.mark.long
def test_shifted_rims_are_not_taken_for_wavefront(behind_focus):
    """The camera moved by 0.3 mm across: its coma and astigmatism are found, whatever its rims do."""
    true = behind_focus.perturbed("Camera", shift=(0.24e-3, 0.18e-3, 0.0))
    image = donut(true, EDGE, blur=1.0, rays=600)
    fit = pachon.fit_donuts(
        behind_focus,
        image[None],
        [EDGE],
        WAVELENGTH,
        sky_variance=1000.0,
        model=pachon.DonutModel(
            air=pachon.DonutAir(fwhm=0.0), detector=pachon.DonutDetector(pixel_size=PIXEL, diffusion=PIXEL)
        ),
        threads=1,
    )
    before, after = (
        pachon.wavefront_zernikes(t, [EDGE], WAVELENGTH, jmax=37).coefficients[0, 3:22] for t in (behind_focus, true)
    )
    error = fit.zernikes[0] - (after - before)
    # Terms beyond Z22 and the rays of the image; 78 nm with rims where the telescope has them.
    assert np.sqrt((error**2).sum()) < 10e-9


@pytest.mark.parametrize(
    "aperture",
    [
        pachon.models.Circle(1.0, 0.1, 0.2),
        pachon.models.Complement(pachon.models.Annulus(0.3, 1.0)),
        pachon.models.Union(
            (pachon.models.Rectangle(0.2, 3.0), pachon.models.Polygon(((0.5, 0.5), (1.5, 0.5), (1.0, 1.2))))
        ),
        pachon.models.Intersection((pachon.models.Circle(1.0), pachon.models.Vane(0.3, 0.2, -0.1, 0.7))),
    ],
)
def test_shifted_apertures_pass_shifted_points(aperture):
    x, y = np.random.default_rng(1).uniform(-2.0, 2.0, (2, 500))
    moved = shifted(aperture, 0.3, -0.4)
    np.testing.assert_array_equal(moved.contains(x + 0.3, y - 0.4), aperture.contains(x, y))
