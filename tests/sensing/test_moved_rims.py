"""Rims and spiders elsewhere than the prescription has them: moved apertures, lines of light, fits that find them."""

from dataclasses import replace

import numpy as np
import pytest
from donut_images import PIXEL, WAVELENGTH, donut, noisy

import pachon
from pachon.core.errors import DomainError
from pachon.raytrace.rays import field_direction
from pachon.sensing.moving_rims import FreeRims, PupilShadows
from pachon.sensing.pupil_cells import pupil_cells
from pachon.sensing.rim_outlines import RimMotion, moved_aperture
from pachon.sensing.solve import Solution
from pachon.sensing.star_errors import by_rivals
from pachon.sensing.star_fitter import Rival, StarSolution

MODEL = pachon.DonutModel(
    air=pachon.DonutAir(fwhm=0.0), detector=pachon.DonutDetector(pixel_size=PIXEL, diffusion=PIXEL)
)
FILTER, SPIDERS = ("Filter_entrance", "Filter_exit"), ("CenterPlateAndSpiderTop", "UpperTEABaffleAndSpiderBottom")


def field_at(degrees):
    return np.deg2rad([0.6 * degrees, 0.8 * degrees])


def with_apertures(tel, changes):
    """Telescope with other apertures, by the name of the surface."""
    return replace(
        tel,
        surfaces=tuple(
            replace(s, aperture=changes[s.name](s.aperture)) if s.name in changes else s for s in tel.surfaces
        ),
    )


def larger(names, by):
    """Change of apertures: discs larger by a length [m]."""
    return dict.fromkeys(names, lambda disc: replace(disc, radius=disc.radius + by))


def other_spider(turn=0.0, shift=0.0, thicker=1.0):
    """Change of apertures: long rectangles turned about the axis [rad], shifted along x [m] and thicker."""

    def vanes(region):
        if isinstance(region, pachon.models.Complement):
            return pachon.models.Complement(vanes(region.part))
        if isinstance(region, pachon.models.Union):
            return pachon.models.Union(tuple(map(vanes, region.parts)))
        if not isinstance(region, pachon.models.Rectangle) or region.width != 0.05:
            return region
        place = np.exp(1j * turn) * (region.x + 1j * region.y) + shift
        return replace(region, width=0.05 * thicker, x=place.real, y=place.imag, angle=region.angle + turn)

    return dict.fromkeys(SPIDERS, vanes)


@pytest.mark.parametrize(
    "aperture",
    [
        pachon.models.Circle(1.0, 0.1, 0.2),
        pachon.models.Complement(pachon.models.Annulus(0.3, 1.0)),
        pachon.models.Union(
            (
                pachon.models.Rectangle(0.2, 3.0, 0.3, 0.1, 0.2),
                pachon.models.Polygon(((0.5, 0.5), (1.5, 0.5), (1.0, 1.2))),
            )
        ),
        pachon.models.Intersection(
            (
                pachon.models.Ellipse(1.0, 0.5, angle=0.3),
                pachon.models.Complement(pachon.models.Vane(0.3, 0.2, -0.1, 0.7)),
            )
        ),
    ],
)
def test_apertures_that_are_turned_and_shifted_pass_such_points(aperture):
    x, y = np.random.default_rng(1).uniform(-2.0, 2.0, (2, 500))
    motion = RimMotion(0.3, -0.4, 0.0, 0.5)
    moved = moved_aperture(aperture, dict.fromkeys(range(3), motion))
    place = np.exp(0.5j) * (x + 1j * y) + (0.3 - 0.4j)
    np.testing.assert_array_equal(moved.contains(place.real, place.imag), aperture.contains(x, y))


def test_the_hole_of_a_ring_moves_alone():
    ring = pachon.models.Annulus(0.5, 1.0)
    assert moved_aperture(ring, {1: RimMotion(growth=0.1)}) == pachon.models.Annulus(0.6, 1.0)
    off_centre = moved_aperture(ring, {1: RimMotion(x=0.1)})
    np.testing.assert_array_equal(off_centre.contains([0.95, -0.45, 0.55], [0.0] * 3), [True, True, False])


@pytest.mark.parametrize("motion", [0, 2])
def test_lines_of_light_are_the_change_of_the_pupil(behind_focus, motion):
    """Area, centroid and mean square of the light beyond a rim that moves, by cells on both sides of it."""
    direction, across = field_direction(*field_at(1.78)), 96
    cells = pupil_cells(behind_focus, direction, WAVELENGTH, across)
    bodies, lines = PupilShadows(behind_focus, direction, WAVELENGTH, cells).candidates()
    number = next(k for k, b in enumerate(bodies) if behind_focus.surface_names[b.members[0][0]] == FILTER[0])
    area = np.where(lines.body == number, lines.across[:, motion] * lines.lengths, 0.0)
    square = (lines.points**2).sum(axis=1) + lines.lengths**2 / 12.0
    predicted = np.array([area.sum(), *(area @ lines.points), area @ square])

    def moments(step):
        values = np.zeros((1, 4))
        values[0, motion] = step
        moved = FreeRims((bodies[number],), values).applied(behind_focus)
        c = pupil_cells(moved, direction, WAVELENGTH, across)
        light = c.area * c.side**2 * c.weights
        return np.array(
            [light.sum(), *(light @ c.points), light @ ((c.points**2).sum(axis=1) + c.moments.trace(0, 1, 2))]
        )

    step = 2e-4
    difference = (moments(step) - moments(-step)) / (2.0 * step)
    # Ends of the chord, known to half a piece of 40.
    np.testing.assert_allclose(predicted, difference, atol=0.03 * np.abs(difference).max())


def end_of_the_light(tel, field):
    """Landing point [m] of the first ray that passes the filter, along the field's direction on the pupil."""
    along = np.linspace(4.2, -4.2, 20_001)
    points = along[:, None] * field / np.hypot(*field)
    end = pachon.trace(tel, pachon.launch_rays(tel, field, WAVELENGTH, points.T))
    return tel.surfaces[-1].to_local(end.position)[np.flatnonzero(end.status == 0)[0], :2]


def assert_found(believed, changes, degrees, wave, *, nanometres=60e-9, noise=1000.0, model=MODEL):
    """Fit of a donut of another telescope: within 60 nm, errors as claimed, and flagged."""
    field = field_at(degrees)
    image = noisy(donut(with_apertures(believed, changes), field, zernikes=wave, rays=700), noise, 5)
    fit = pachon.fit_donuts(
        believed, image[None], [field], WAVELENGTH, sky_variance=noise, model=model, pixel_size=PIXEL, threads=1
    )
    assert fit.reasons[0] in ("rim moved", "clipped, rim moved")
    error = fit.zernikes[0] - wave[3:]
    assert np.sqrt((error**2).sum()) < nanometres
    # Of 19 degrees of freedom: 2.6 is five standard deviations.
    assert error @ np.linalg.solve(fit.covariance[0], error) / 19 < 2.6
    return fit.rims


@pytest.fixture(scope="module")
def wave():
    """Coefficients from j = 1 within the span of Z4 to Z22 [m], 100 nm rms."""
    values = np.zeros(22)
    values[3:] = np.random.default_rng(8).normal(size=19)
    return 100e-9 * values / np.linalg.norm(values)


@pytest.fixture(scope="module")
def obstructed():
    return pachon.load_telescope("lsst_v3.3_r_obstructed").perturbed("Detector", shift=(0.0, 0.0, 1.5e-3))


# 0.9 mm of the filter is a pixel of 10 um of the donut.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("degrees", "shift"),
    [
        pytest.param(1.79, 5.3e-3, marks=pytest.mark.long),
        *(pytest.param(*v, marks=pytest.mark.slow) for v in [(1.79, -5.3e-3), (1.79, 8.5e-3), (1.79, -8.5e-3)]),
        *(pytest.param(*v, marks=pytest.mark.slow) for v in [(1.79, 2.1e-3), (1.79, -2.1e-3), (1.77, -5.3e-3)]),
    ],
)
def test_filter_of_another_size(behind_focus, wave, degrees, shift):
    """1.2 um wrong with rims where they are believed to be."""
    (rim,) = assert_found(behind_focus, larger(FILTER, shift), degrees, wave)
    assert rim["rim"] == "Filter_entrance, Filter_exit"
    assert rim["outward"].to_value("m") == pytest.approx(shift, rel=0.1)
    ends = [
        end_of_the_light(t, field_at(degrees))
        for t in (behind_focus, with_apertures(behind_focus, larger(FILTER, shift)))
    ]
    if abs(shift) < 6e-3:
        # Beyond, the middle of the chord is in the hole. Towards the ends of the chord the shift is smaller.
        pixels = np.copysign(np.hypot(*(ends[1] - ends[0])) / PIXEL, shift)
        assert rim["pixels"].to_value("pix") == pytest.approx(0.85 * pixels, rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("shift", [-0.066, -0.165, -0.264])
def test_smaller_third_mirror(behind_focus, wave, shift):
    """Rim of M3, 33 mm a pixel of 10 um of the donut."""
    changes = {"M3": lambda ring: replace(ring, outer=ring.outer + shift)}
    (rim,) = assert_found(behind_focus, changes, 1.75, wave)
    assert rim["rim"] == "M3"
    assert rim["outward"].to_value("m") == pytest.approx(shift, rel=0.2)


@pytest.mark.slow
def test_larger_hole(behind_focus, wave):
    """Hole of M1 larger by 2 %; by 1 % one donut tells no radius."""
    changes = {"M1": lambda ring: replace(ring, inner=1.02 * ring.inner)}
    assert_found(behind_focus, changes, 1.0, wave)


@pytest.mark.slow
def test_claims_cover_the_wrong_rim(behind_focus, wave):
    """Hole of M1 larger by 2 %: half of the noise draws fit that of M2 better, which makes 180 nm of errors."""
    field = field_at(1.0)
    larger_hole = with_apertures(behind_focus, {"M1": lambda ring: replace(ring, inner=1.02 * ring.inner)})
    image = donut(larger_hole, field, zernikes=wave, rays=700)
    images = np.array([noisy(image, 1000.0, 20 + seed) for seed in range(8)])
    fit = pachon.fit_donuts(
        behind_focus, images, np.tile(field, (8, 1)), WAVELENGTH, sky_variance=1000.0, model=MODEL, pixel_size=PIXEL
    )
    errors = fit.zernikes - wave[3:]
    squares = [e @ np.linalg.solve(c, e) / 19 for e, c in zip(errors, fit.covariance, strict=True)]
    assert max(squares) < 2.6
    # Eight draws of which of two rims it is: chance makes a half.
    assert 0.5 < np.mean(errors**2) / np.mean(np.diagonal(fit.covariance, axis1=1, axis2=2)) < 1.5


def test_rims_that_explain_a_donut_alike_are_in_its_claim():
    """Mean square of a wavefront that is 3 or 0, by two fits of one likelihood; one of none changes nothing."""
    solution = Solution((np.zeros(7),), np.array([1.0, 0.0]), (), np.eye(9), np.zeros(1), 0.0, True)
    alike = Rival(FreeRims(), np.array([4.0, 0.0]), 0.0)
    worse = Rival(FreeRims(), np.array([0.0, 9.0]), 1e3)
    star = StarSolution(None, None, None, solution, np.zeros((2, 2)), rivals=(alike, worse))
    np.testing.assert_allclose(by_rivals(star, 2), [[4.5, 0.0], [0.0, 0.0]], atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("degrees", [0.5, 1.5])
def test_hole_of_a_size_that_is_not_trusted(behind_focus, wave, degrees):
    """Hole of M1 larger by 1 %: claimed errors are those made."""
    model = replace(MODEL, rims=pachon.sensing.DonutRims(search=False, size=0.01))
    changes = {"M1": lambda ring: replace(ring, inner=1.01 * ring.inner)}
    field = field_at(degrees)
    image = noisy(donut(with_apertures(behind_focus, changes), field, zernikes=wave, rays=700), 1000.0, 5)
    fit = pachon.fit_donuts(
        behind_focus, image[None], [field], WAVELENGTH, sky_variance=1000.0, model=model, pixel_size=PIXEL, threads=1
    )
    error = fit.zernikes[0] - wave[3:]
    assert error @ np.linalg.solve(fit.covariance[0], error) / 19 < 2.6


@pytest.mark.slow
def test_spider_turned_and_thicker(obstructed, wave):
    (rim,) = assert_found(obstructed, other_spider(turn=np.deg2rad(1.0)), 1.0, wave)
    assert rim["rim"].startswith("spider")
    assert rim["rotation"].to_value("deg") == pytest.approx(1.0, rel=0.2)
    assert_found(obstructed, other_spider(thicker=1.3), 1.0, wave)


def test_sizes_of_rims_are_checked():
    with pytest.raises(DomainError, match=r"size = -0\.1: expected 0 to 0\.1"):
        pachon.sensing.DonutRims(size=-0.1)


def test_rims_of_hsc_are_where_its_light_is():
    """Rays that its apertures stop pass later lenses up to 80 mm beside the light: maps of them were 0.7 mm off."""
    hsc = pachon.load_telescope("hsc")
    direction = field_direction([0.0], [0.9 * hsc.field_radius])[0]
    shadows = PupilShadows(hsc, direction, 770e-9, pupil_cells(hsc, direction, 770e-9, 64))
    lit = shadows._ends[-1].status == 0
    for number, surface in enumerate(hsc.surfaces[:-1]):
        smooth, coefficients, _ = shadows._smooth(number)
        places = smooth.sums(shadows._survey.points[lit], coefficients)[0]
        off = np.abs(places - shadows._places(number, shadows._ends)[lit])
        assert off.max() < 0.1e-3, surface.name


@pytest.mark.long
def test_donuts_of_hsc_whose_rays_are_no_start():
    """Fits with diffraction began from those of rays, 290 nm off, and ended 750 nm off with 1.2 times the loss."""
    hsc = pachon.load_telescope("hsc").perturbed("Detector", shift=(0.0, 0.0, 0.8e-3))
    fields = np.deg2rad([[-0.10693917, 0.67602943]])
    aberration = pachon.wavefront.ResidualWavefront.draw(hsc, 200e-9, 2, 0)
    air = pachon.Atmosphere.from_site("cerro_pachon", seed=2, r0=0.2)
    light = {"electrons": 3e6, "sky": 300.0, "read_noise": 5.0, "stamps": pachon.Stamps(91, pixel_size=15e-6)}
    for seed in (1, 3):
        drawn = pachon.draw_donuts(
            hsc, fields, [770e-9], atmosphere=air, seed=seed, aberration=aberration, threads=1, **light
        )
        fit = pachon.fit_donuts(
            hsc, drawn.images, fields, 770e-9, pixel_size=15e-6, sky_variance=drawn.sky_variance, threads=1
        )
        assert np.linalg.norm(fit.zernikes - aberration.at(np.tan(fields))) < 100e-9
