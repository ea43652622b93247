"""Silicon in the PSF engines: against brute force over conversion depths, and against photons one by one."""

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest

import pachon
from pachon.core.errors import DomainError
from pachon.models.camera.silicon import Silicon
from pachon.raytrace.rays import RayStatus, field_direction, parallel_rays
from pachon.raytrace.trace import trace
from pachon.wavefront.atmosphere.atmosphere import Atmosphere
from pachon.wavefront.atmosphere.screen_sampling import ScreenSampling
from pachon.wavefront.chief_rays import fields_at
from pachon.wavefront.psf.channels import Channels
from pachon.wavefront.psf.fast import FastEngine
from pachon.wavefront.psf.image_plane import ImagePlane
from pachon.wavefront.psf.long_exposure import LongExposureEngine
from pachon.wavefront.psf.psf import make_psfs
from pachon.wavefront.psf.stamps import Stamps
from pachon.wavefront.psf.wave import WaveEngine
from pachon.wavefront.silicon_focus import focus_height

PLANE = ImagePlane(25, 10e-6, 4e-6)
STAR = np.zeros((1, 2)), np.zeros((1, 2))


def nodes(silicon, wavelength, count=12):
    """Paths [m] and weights of a rule that is exact to 1e-5, by Gauss-Legendre on the truncated exponential."""
    length = silicon.absorption_length(wavelength)
    end = min(silicon.thickness, 12.0 * length)
    node, weight = np.polynomial.legendre.leggauss(count)
    path = 0.5 * end * (node + 1.0)
    return path, 0.5 * end * weight * np.exp(-path / length) / length


def after_path(pupil, shift):
    """A tracer of the pupil's light where it has gone on in silicon by a path, given over the index [m]."""

    def traced(telescope, fields, wavelengths, points, **options):
        optics = pupil.trace(telescope, fields, wavelengths, points, **options)
        cosines = pupil.cosines - points @ np.linalg.inv(optics.jacobian[0])
        square = (cosines**2).sum(axis=1) - np.dot(pupil.cosines, pupil.cosines)
        return replace(
            optics,
            displacement=(optics.displacement + shift * cosines).astype(np.float32),
            exit_pupil_path=optics.exit_pupil_path - 0.5 * shift * square,
        )

    return traced


def summed_over_depths(engine, pupil, wavelength, silicon, **options):
    """The PSF by brute force: images of many depths, each with its own diffusion, made without silicon."""
    image = np.zeros((PLANE.size, PLANE.size))
    for path, weight in zip(*nodes(silicon, wavelength), strict=True):
        plane = replace(PLANE, diffusion=PLANE.diffusion * math.sqrt(1.0 - path / silicon.thickness))
        inputs = pupil.inputs(np.array([wavelength]), plane, **options)
        deep = replace(inputs, trace=after_path(pupil, path / silicon.index(wavelength)))
        image += weight * engine.renderer(deep).render(*STAR).image[0]
    return image


def turbulence(**options):
    small = {"exposure": 0.2, "screens": ScreenSampling(256, 40.96, fine_size=512, fine_pixel=0.02)}
    return Atmosphere.from_site("cerro_pachon", 4, **(small | options))


@pytest.mark.long
@pytest.mark.parametrize(
    ("engine", "wavelength", "atmosphere", "allowed"),
    [
        # Two depths are exact up to the third moment of the path, three up to the fifth; air blurs the rest.
        pytest.param(LongExposureEngine(), 870e-9, turbulence(), 1e-3, marks=pytest.mark.slow),
        (LongExposureEngine(), 970e-9, turbulence(), 1e-3),
        (WaveEngine(pupil_spacing=0.08), 870e-9, None, 1e-3),
        # 4 time steps, each at each depth.
        pytest.param(WaveEngine(pupil_spacing=0.08), 970e-9, turbulence(), 1e-3, marks=pytest.mark.slow),
        # Two sharp rings in place of a smooth blur, on cells of a micrometre.
        (FastEngine(n_pupil=3000, oversampling=6), 970e-9, None, 1.5e-2),
        # 134 time steps that share the depths; another ray in a cell makes 1e-2 with 4 steps.
        (FastEngine(n_pupil=1000, oversampling=4), 870e-9, turbulence(time_step=0.0015), 4e-3),
    ],
)
def test_against_brute_force_over_the_depths(polynomial_pupil, engine, wavelength, atmosphere, allowed):
    # The cone of f/1.23, its axis aslant, out of focus by 8 um and with coma.
    pupil = polynomial_pupil(defocus=0.7e-6, coma=0.3e-6, cosines=(0.05, -0.02))
    silicon = Silicon()
    inputs = pupil.inputs(np.array([wavelength]), PLANE, silicon=silicon, atmosphere=atmosphere)
    image = engine.renderer(inputs).render(*STAR).image[0]
    exact = summed_over_depths(engine, pupil, wavelength, silicon, atmosphere=atmosphere)
    without = engine.renderer(replace(inputs, silicon=None)).render(*STAR).image[0]
    assert np.abs(image - exact).max() < allowed * exact.max()
    # What silicon does to the shape is well above that.
    assert np.abs(without * (exact.sum() / without.sum()) - exact).max() > 0.04 * exact.max()


@dataclass
class Photons:
    """Photons of a star in y, one by one, at a CCD off the axis: where they land and where their charge arrives [m]."""

    landing: np.ndarray
    arrival: np.ndarray
    slope: np.ndarray  # of the light in front of the silicon
    depth: np.ndarray
    fraction: float  # that turns into charge


def photons(telescope, field, wavelength, silicon, diffusion, count, seed):
    """Trace photons through random points of the pupil, refract them by Snell's law, and stop them at random depths."""
    rng = np.random.default_rng(seed)
    outer = 0.5 * telescope.pupil_diameter
    radius = outer * np.sqrt(rng.uniform(telescope.pupil_obscuration**2, 1.0, count))
    angle = rng.uniform(0.0, 2.0 * np.pi, count)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
    direction = field_direction(field[:1], field[1:])
    end = trace(telescope, parallel_rays(telescope, direction, wavelength, points))
    passed = end.status == RayStatus.OK
    travel, landing = end.direction[passed], end.position[passed, :2]
    assert (travel[:, 2] > 0.0).all()
    sine = np.hypot(travel[:, 0], travel[:, 1])
    inside = np.tan(np.arcsin(sine / silicon.index(wavelength)))
    path = rng.exponential(silicon.absorption_length(wavelength), passed.sum())
    depth = path * np.cos(np.arctan(inside))
    kept = depth < silicon.thickness
    depth, landing, travel = depth[kept], landing[kept], travel[kept]
    aside = (inside / sine)[kept, None] * travel[:, :2]
    spread = diffusion * np.sqrt(1.0 - depth / silicon.thickness)
    arrival = landing + depth[:, None] * aside + spread[:, None] * rng.standard_normal((len(depth), 2))
    return Photons(landing, arrival, travel[:, :2] / travel[:, 2:], depth, kept.mean())


def transform(places, k):
    """Mean of exp(-i k.x) over places [n, 2], for wavenumbers [m, 2], and its standard error."""
    waves = np.exp(-1j * places @ k.T)
    return waves.mean(axis=0), np.sqrt(waves.var(axis=0) / len(places))


@pytest.mark.long
def test_against_photons_one_by_one():
    """The transfer function of the silicon, with diffraction and pixel divided out, is that of 400 000 photons."""
    telescope = pachon.load_telescope("lsst_v3.3_y").perturbed("Detector", shift=(0.0, 0.0, -6e-6))
    field, wavelength, silicon = np.deg2rad([0.9, 0.8]), 970e-9, Silicon()
    engine = FastEngine(n_pupil=10000, oversampling=4)
    with_silicon, without = (
        make_psfs(telescope, field[None], [wavelength], engine=engine, stamps=Stamps(81, 4e-6, 3e-6, silicon=s))
        for s in (silicon, None)
    )
    seen = photons(telescope, field, wavelength, silicon, 3e-6, 400_000, 1)
    # 2e-3 for three standard errors; 0.4 % for paths that the slant makes longer than the thickness.
    assert with_silicon.inside / without.inside == pytest.approx(seen.fraction, rel=6e-3)
    # Up to where seeing of 0.7 arcsec leaves a tenth.
    k = 0.09e6 * np.array([[1.0, 0.0], [0.0, 1.0], [0.7, 0.7], [0.7, -0.7], [0.4, 0.1]])
    y, x = (np.mgrid[:81, :81] - 40) * 4e-6
    pixels = np.stack([x, y], axis=-1).reshape(-1, 2)
    waves = np.exp(-1j * pixels @ k.T)
    ours = (with_silicon.image.reshape(-1) @ waves) / (without.image.reshape(-1) @ waves)
    # Without silicon, charge diffuses from the surface.
    surface, _ = transform(seen.landing, k)
    arrived, error = transform(seen.arrival, k)
    theirs = arrived / (surface * np.exp(-0.5 * (3e-6) ** 2 * (k**2).sum(axis=1)))
    assert np.abs(1.0 - theirs).max() > 0.05
    # Rays in cells of a micrometre leave 1e-3.
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=3 * error.max() + 1.5e-3)


@pytest.mark.parametrize(("band", "wavelength"), [("r", 620e-9), ("i", 754e-9), ("z", 870e-9), ("y", 970e-9)])
def test_equivalent_defocus_is_that_of_photons(band, wavelength):
    telescope, silicon = pachon.load_telescope(f"lsst_v3.3_{band}"), Silicon()
    seen = photons(telescope, np.zeros(2), wavelength, silicon, 0.0, 100_000, 2)
    # Each photon as that of a detector farther along the light.
    square = (seen.slope**2).sum(axis=1)
    shift = ((seen.arrival - seen.landing) * seen.slope).sum(axis=1) / square
    mean, rms = silicon.defocus(wavelength)
    cosine = np.mean(1.0 / np.sqrt(1.0 + square))
    assert cosine == pytest.approx(0.94, abs=3e-3)
    assert shift.mean() == pytest.approx(mean * cosine, rel=0.02)
    assert shift.std() == pytest.approx(rms * cosine, rel=0.02)
    # The detector that refocuses: that of the smallest spot.
    moved = np.polyfit(
        mean * np.array([-2.0, -1.0, 0.0]),
        [np.var(seen.arrival + h * seen.slope, axis=0).sum() for h in mean * np.array([-2.0, -1.0, 0.0])],
        2,
    )
    before = np.polyfit(
        mean * np.array([-1.0, 0.0, 1.0]),
        [np.var(seen.landing + h * seen.slope, axis=0).sum() for h in mean * np.array([-1.0, 0.0, 1.0])],
        2,
    )
    focus = -0.5 * moved[1] / moved[0] + 0.5 * before[1] / before[0]
    assert focus == pytest.approx(focus_height(telescope, silicon, wavelength), rel=0.02)
    assert focus < 0.0


def test_turns_give_each_depth_its_light():
    channels = Channels.of(Silicon(), np.array([620e-9, 870e-9, 970e-9]), 4e-6, 3)
    turns = channels.depth_schedule(300, 21)
    assert turns.time.tolist() == list(range(300))
    assert (turns.channel // 3 == np.arange(3)[:, None, None]).all()
    share = channels.weight.reshape(3, 3) / channels.weight.reshape(3, 3).sum(axis=1)[:, None]
    np.testing.assert_allclose(turns.fraction.reshape(3, 3), share, atol=3e-3)
    # Also over the moments of one group, and over the groups of one moment.
    for axis, allowed in ((1, 0.02), (2, 0.15)):
        of_depth = np.stack([(turns.channel % 3 == d).mean(axis=axis) for d in range(3)])
        assert np.abs(of_depth - share.T[:, :, None]).max() < allowed
    few = channels.depth_schedule(5, 2)
    assert few.time.tolist() == [t for t in range(5) for _ in range(3)]
    np.testing.assert_allclose(few.fraction, 1.0 / 3.0)


@pytest.mark.long
@pytest.mark.parametrize(
    "engine", [FastEngine(n_pupil=100), WaveEngine(pupil_spacing=0.08), LongExposureEngine()], ids=lambda e: e.name
)
def test_bytes_do_not_depend_on_threads(engine):
    telescope = pachon.load_telescope("lsst_v3.3_y")
    focal_plane = pachon.FocalPlane.from_budget("lsst", seed=1)
    fields = fields_at(telescope, focal_plane.camera.centers[[3, 90]])
    both = [
        make_psfs(
            telescope,
            fields,
            [960e-9, 1000e-9],
            focal_plane=focal_plane,
            atmosphere=turbulence(),
            threads=threads,
            engine=engine,
            stamps=Stamps(silicon=Silicon()),
        )
        for threads in (1, 2)
    ]
    assert both[0].image.tobytes() == both[1].image.tobytes()


def test_wavelengths_count_by_the_light_that_silicon_absorbs(polynomial_pupil):
    pupil, silicon = polynomial_pupil(), Silicon()
    wavelengths = np.array([700e-9, 1050e-9])
    options = {"silicon": silicon, "atmosphere": turbulence()}
    engine = LongExposureEngine()
    both = engine.renderer(pupil.inputs(wavelengths, PLANE, **options)).render(*STAR).image[0]
    each = [engine.renderer(pupil.inputs(wavelengths[[w]], PLANE, **options)).render(*STAR).image[0] for w in range(2)]
    np.testing.assert_allclose(both, 0.5 * (each[0] + each[1]), atol=5e-5 * both.max())
    # Most light of these images falls on them.
    assert each[1].sum() / each[0].sum() == pytest.approx(
        silicon.absorbed(1050e-9) / silicon.absorbed(700e-9), rel=5e-3
    )


def test_light_to_which_silicon_is_transparent_is_one_clear_line(lsst_r):
    telescope = pachon.load_telescope("lsst_v3.3_y")
    beyond = replace(telescope, wavelength_range=(0.9e-6, 1.2e-6))
    with pytest.raises(DomainError, match=r"^wavelength = 1120 nm: expected 300 to 1100 nm for silicon$"):
        make_psfs(beyond, [[0.0, 0.0]], [1.12e-6], stamps=Stamps(silicon=Silicon()))
