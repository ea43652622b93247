"""PSFs of all engines: shapes, agreement, and errors."""

import numpy as np
import pytest
from astropy import units as u
from pydantic import ValidationError

import pachon
from pachon.core.errors import ConfigError, DomainError, PachonError
from pachon.measure.shapes import fwhm
from pachon.pipeline.config import Configuration
from pachon.wavefront.atmosphere.atmosphere import Atmosphere
from pachon.wavefront.atmosphere.screen_sampling import ScreenSampling
from pachon.wavefront.chief_rays import fields_at
from pachon.wavefront.psf.engines import ENGINES, psf_engine
from pachon.wavefront.psf.psf import DARK, make_psfs
from pachon.wavefront.psf.stamps import Stamps

WAVELENGTHS = np.linspace(545e-9, 703e-9, 3)
ARCSEC = np.pi / 180 / 3600
#: Width of the weight of moments with the atmosphere [arcsec].
WEIGHT_FWHM = 0.7


def small_atmosphere(seed=4):
    return Atmosphere.from_site(
        "cerro_pachon", seed, exposure=0.2, screens=ScreenSampling(512, 81.92, fine_size=1024, fine_pixel=0.02)
    )


def moments(image, pixel_arcsec=0.2):
    """Ellipticities (a-b)/(a+b) and centroid [pixels] under a Gaussian weight of 0.7 arcsec, centroid iterated."""
    sigma = WEIGHT_FWHM / pixel_arcsec / np.sqrt(8 * np.log(2))
    grid = np.arange(image.shape[0]) - image.shape[0] // 2
    x, y = np.meshgrid(grid, grid)
    cx = cy = 0.0
    for _ in range(50):
        light = image * np.exp(-0.5 * ((x - cx) ** 2 + (y - cy) ** 2) / sigma**2)
        light = light / light.sum()
        cx, cy = (light * x).sum(), (light * y).sum()
    xx, xy, yy = ((light * a * b).sum() for a, b in ((x - cx, x - cx), (x - cx, y - cy), (y - cy, y - cy)))
    scale = xx + yy + 2 * np.sqrt(xx * yy - xy * xy)
    return np.array([(xx - yy) / scale, 2 * xy / scale]), np.array([cx, cy])


def full_width(image):
    """Full width at half maximum of a smooth fit to log-image against the distance from the centroid [pixels]."""
    _, (cx, cy) = moments(image)
    grid = np.arange(image.shape[0]) - image.shape[0] // 2
    radius = np.hypot(grid - cx, (grid - cy)[:, None])
    near = radius < 4.0
    fit = np.polynomial.Polynomial.fit(radius[near] ** 2, np.log(image[near]), 3)
    r = np.linspace(0.2, 4.0, 4000)
    return 2 * np.interp(np.log(2.0), fit(0.0) - fit(r * r), r)


@pytest.mark.long
@pytest.mark.parametrize(
    ("engine", "turbulent"),
    [
        ("fast", True),
        ("wave", False),
        pytest.param("fast", False, marks=pytest.mark.slow),
        pytest.param("wave", True, marks=pytest.mark.slow),
    ],
)
def test_what_comes_back(lsst_r, engine, turbulent):
    focal_plane = pachon.FocalPlane.from_budget("lsst", seed=1)
    fields = fields_at(lsst_r, focal_plane.camera.centers[[94, 10]])
    offsets = np.array([[0.0, 0.0], [0.4, -0.3]])
    # A small stamp holds what is sharp, and needs few points of the pupil.
    size, done = 25 if turbulent else 15, []
    psfs = make_psfs(
        lsst_r,
        fields * u.rad,
        WAVELENGTHS * 1e9 * u.nm,
        focal_plane=focal_plane,
        atmosphere=small_atmosphere() if turbulent else None,
        threads=2,
        progress=done.append,
        engine=engine,
        stamps=Stamps(size, offsets=offsets, pixel_size=10 * u.um),
    )
    assert psfs.image.shape == (2, size, size)
    assert psfs.image.dtype == np.float32
    # Single precision of up to 625 pixels.
    np.testing.assert_allclose(psfs.image.sum(axis=(1, 2)), 1.0, atol=1e-5)
    # 0.2 arcsec a pixel, to the "0.0197 arcsec/um" and 10.3 m of the LSST.
    assert psfs.pixel_scale == pytest.approx(0.2 * ARCSEC, rel=0.005)
    np.testing.assert_allclose(psfs.fields, fields, rtol=1e-12)
    np.testing.assert_allclose(psfs.wavelengths, WAVELENGTHS, rtol=1e-12)
    np.testing.assert_allclose(psfs.reference_point[:, :2], focal_plane.camera.centers[[94, 10]], atol=2e-6)
    assert np.all((psfs.lit_fraction > 0.5) & (psfs.lit_fraction <= 1.02))
    assert np.all((psfs.inside > 0.98) & (psfs.inside < 1.001))
    assert psfs.flags.tolist() == [0, 0]
    assert sum(done) == 2
    # Turbulence of 0.2 s moves a star by some 0.2 arcsec; coma on a displaced CCD near the edge does by up to 4 um.
    for image, offset in zip(psfs.image, offsets, strict=True):
        np.testing.assert_allclose(moments(image.astype(float))[1], offset, atol=1.5 if turbulent else 0.5)


@pytest.mark.long
def test_engines_agree_on_single_stars_outside_the_atmosphere(lsst_r):
    """Defocus beyond diffraction: moments in pixels of either engine's image, by ray or wave optics."""
    telescope = lsst_r.perturbed("Camera", shift=(0.0, 0.0, 30e-6))
    fields = np.radians([[0.0, 0.0], [0.8, 0.9], [-1.2, 0.3]])
    images = [
        make_psfs(telescope, fields, WAVELENGTHS, threads=2, engine=engine, stamps=Stamps(15)).image.astype(float)
        for engine in ("fast", "wave")
    ]
    for fast, wave in zip(*images, strict=True):
        (e_fast, c_fast), (e_wave, c_wave) = moments(fast), moments(wave)
        # A filter is not diffraction at an aberrated pupil: a hundredth in ellipticity and of a pixel.
        np.testing.assert_allclose(e_fast, e_wave, atol=0.01)
        np.testing.assert_allclose(c_fast, c_wave, atol=0.02)


def engines_apart(telescope, stars, *, wavelengths, threads, focal_plane=None, **atmosphere):
    """Return differences of ellipticity [n, 2] and ratios of widths [n] of the engines on the same screens."""
    fields, offsets = stars
    options = {"focal_plane": focal_plane, "stamps": Stamps(offsets=offsets), "threads": threads}
    screens = Atmosphere.from_site("cerro_pachon", **atmosphere)
    fast, wave = (
        make_psfs(telescope, fields, wavelengths, atmosphere=screens, engine=engine, **options).image.astype(float)
        for engine in ("fast", "wave")
    )
    apart = np.array([moments(a)[0] - moments(b)[0] for a, b in zip(fast, wave, strict=True)])
    ratio = np.array([full_width(a) / full_width(b) for a, b in zip(fast, wave, strict=True)])
    return apart, ratio


@pytest.mark.slow
def test_engines_agree_through_the_same_screens(lsst_r):
    rng = np.random.default_rng(3)
    apart, ratio = engines_apart(
        lsst_r,
        (rng.uniform(-0.018, 0.018, (4, 2)), rng.uniform(-0.5, 0.5, (4, 2))),
        wavelengths=np.array([620e-9]),
        threads=2,
        seed=1,
        exposure=2.0,
        time_step=0.1,
        screens=ScreenSampling(screen_size=1024, screen_length=163.84, cutoff=8.75),
    )
    # 6e-4 for 15 s; what differs is noise of the high modes, so 2.7 times as much in a seventh of the time, and some
    # more for one wavelength and a coarse time step.
    assert np.sqrt(np.mean(apart**2)) < 4e-3
    assert np.mean(ratio) == pytest.approx(1.0, abs=0.02)


@pytest.mark.long
@pytest.mark.parametrize(
    "engine", [pytest.param(e, marks=[pytest.mark.slow] * (e in ("statistical", "wave"))) for e in ENGINES]
)
def test_recentred_stars_are_those_drawn_at_the_other_place(lsst_r, engine):
    """Told where a star is seen, an engine draws it where it then is seen at the centre of a pixel."""
    # Not in the order in which engines render them.
    fields = np.radians([[1.1, 0.9], [0.3, -0.2]])
    offsets = np.array([[0.4, -0.3], [0.1, 0.2]])
    # Without screens exposures are long.
    long_air = Atmosphere.from_site("cerro_pachon", 4, exposure=15.0)
    atmosphere = long_air if engine == "statistical" else small_atmosphere()
    options = {"atmosphere": atmosphere, "engine": engine, "threads": 2}

    def centroids(images, pixel_scale):
        shapes = pachon.measure_shapes(images, pixel_scale, WEIGHT_FWHM * ARCSEC)
        return np.stack([shapes.x, shapes.y], axis=1)

    psfs = make_psfs(lsst_r, fields, WAVELENGTHS, stamps=Stamps(21, offsets=offsets, recenter=centroids), **options)
    again = make_psfs(lsst_r, fields, WAVELENGTHS, stamps=Stamps(21, offsets=psfs.offset), **options)
    # Single precision of a ramp of phase.
    np.testing.assert_allclose(psfs.image, again.image, atol=2e-6 * again.image.max())
    # The centroid of a fifth of a second in pixels of 0.2 arcsec depends a little on where in a pixel it lies.
    assert np.abs(centroids(psfs.image, psfs.pixel_scale)).max() < 5e-3
    assert np.abs(psfs.offset - offsets).max() > 0.05
    # Where they were drawn first.
    first = make_psfs(lsst_r, fields, WAVELENGTHS, stamps=Stamps(21, offsets=offsets), **options)
    assert psfs.first.tobytes() == first.image.tobytes()
    assert first.first is None
    np.testing.assert_array_equal(again.offset, psfs.offset)


@pytest.mark.slow
def test_engines_agree_over_the_field(lsst_r):
    """Two hundred stars through optics and atmosphere, 15 s, five wavelengths: half an hour on 2 cores."""
    focal_plane = pachon.FocalPlane.from_budget("lsst", seed=1)
    rng = np.random.default_rng(8)
    centers = focal_plane.camera.centers
    wavelengths = np.linspace(545e-9, 703e-9, 5)
    e = {"fast": [], "wave": [], "long_exposure": []}
    width = {"fast": [], "wave": []}
    # Stars of one exposure share the ground layer, so many exposures of few stars.
    for seed in range(25):
        ccds = rng.choice(np.flatnonzero(np.hypot(*centers.T) < 0.31), 8, replace=False)
        positions = centers[ccds] + rng.uniform(-0.018, 0.018, (8, 2))
        options = {"focal_plane": focal_plane, "stamps": Stamps(offsets=rng.uniform(-0.5, 0.5, (8, 2)))}
        screens = Atmosphere.from_site(
            "cerro_pachon", seed, screens=ScreenSampling(screen_size=4096, screen_length=650.0)
        )
        for engine, measured in e.items():
            psfs = make_psfs(
                lsst_r, fields_at(lsst_r, positions), wavelengths, atmosphere=screens, engine=engine, **options
            )
            shapes = pachon.measure_shapes(psfs.image, psfs.pixel_scale, 0.7 * ARCSEC)
            measured.append(np.stack([shapes.e1, shapes.e2], axis=1))
            if engine in width:
                width[engine].append(fwhm(psfs.image, psfs.pixel_scale))
        screens.release()
    fast, wave, mean = (np.concatenate(measured) for measured in e.values())
    apart = fast - wave
    ratio = np.concatenate(width["fast"]) / np.concatenate(width["wave"])
    # What the atmosphere adds to the mean over all exposures.
    variance = np.mean((fast - mean) ** 2) / np.mean((wave - mean) ** 2)
    rms = np.sqrt(np.mean(apart**2, axis=0))
    print(
        f"rms difference of e1, e2 {rms}, mean {apart.mean(axis=0)}, FWHM ratio {ratio.mean():.4f}, "
        f"variance of the atmosphere's e {variance:.3f}"
    )
    # The project's requirements on the fast engine.
    assert np.all(rms <= 1.2e-3)
    assert np.all(np.abs(apart.mean(axis=0)) < 2e-4)
    assert ratio.mean() == pytest.approx(1.0, abs=0.01)
    assert variance == pytest.approx(1.0, abs=0.1)


def test_no_stars_and_no_light(lsst_r):
    none = make_psfs(lsst_r, np.empty((0, 2)), WAVELENGTHS, stamps=Stamps(9))
    assert none.image.shape == (0, 9, 9)
    # Far outside the field, all is vignetted, and the chief ray still lands.
    limit = 0.9 * lsst_r.field_limit
    for engine in ("fast", "wave"):
        dark = make_psfs(lsst_r, [[limit, 0.0], [0.0, 0.0]], WAVELENGTHS, engine=engine, stamps=Stamps(9))
        assert dark.lit_fraction[0].max() == 0.0
        assert dark.flags.tolist() == [DARK, 0]
        assert not dark.image[0].any()
        assert dark.image[1].sum() == pytest.approx(1.0, abs=1e-5)


def test_configurations_offer_every_engine():
    for engine in ENGINES:
        assert Configuration.model_validate({"psf": {"engine": engine}}).psf.engine == engine
    with pytest.raises(ValidationError, match=".*".join(map(repr, ENGINES))):
        Configuration.model_validate({"psf": {"engine": "exact"}})


@pytest.mark.parametrize(
    ("options", "error", "named"),
    [
        ({"engine": "exact"}, ConfigError, "engine = 'exact': expected one of fast, wave"),
        ({"engine": 3}, ConfigError, "engine = 3: expected one of fast, .* or a PsfEngine"),
        ({"pupil_spacing": 0.1}, ConfigError, r"pupil_spacing: .* expected engine=WaveEngine\(pupil_spacing=\.\.\.\)$"),
        ({"stamp_size": 41}, ConfigError, r"stamp_size: .* expected stamps=Stamps\(size=\.\.\.\)$"),
        ({"stamps": 41}, DomainError, "stamps = 41: expected a Stamps"),
        (
            {"projection": "postel"},
            ConfigError,
            r"projection: .* expected Request.of\(telescope",
        ),
        ({"fields": None}, DomainError, "^fields, wavelengths: expected both beside a telescope"),
        ({"wavelengths": []}, DomainError, "wavelengths"),
        ({"wavelengths": [-1e-7]}, DomainError, "wavelengths"),
        ({"wavelengths": [5e-6]}, PachonError, "wavelength"),
        ({"fields": [[0.0, 0.0], [0.1, 0.0]]}, DomainError, r"field = \(5.72958, 0\) deg: expected within"),
        ({"fields": [[np.nan, 0.0]]}, DomainError, "fields"),
        ({"fields": [[0.0, 0.0, 0.0]]}, DomainError, "fields of shape"),
        ({"stamps": Stamps(offsets=[[0.0, 0.0], [1.0, 1.0]])}, DomainError, "offsets of shape"),
        # 39 pixels beside a stamp of 31 the star was drawn in its middle.
        (
            {"stamps": Stamps(offsets=[[3.0, -15.6]])},
            DomainError,
            r"offsets = -15\.6: expected .* at most 15\.5 pixels",
        ),
        ({"wavelengths": pachon.Light(WAVELENGTHS, dispersion=[[0.0, 0.0]])}, DomainError, "dispersion of shape"),
        ({"focal_plane": "flat", "fields": [[0.0020485, 0.0]]}, DomainError, "between"),
    ],
)
def test_refuses_bad_arguments(lsst_r, options, error, named):
    arguments = {"fields": [[0.0, 0.0]], "wavelengths": WAVELENGTHS} | options
    if "focal_plane" in arguments:
        arguments["focal_plane"] = pachon.FocalPlane.flat("lsst")
    with pytest.raises(error, match=named):
        make_psfs(lsst_r, arguments.pop("fields"), arguments.pop("wavelengths"), **arguments)


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: Stamps(1), "^size = 1: expected"),
        (lambda: Stamps(pixel_size=1 * u.s), "pixel_size"),
        (lambda: Stamps(diffusion=-1e-6), "diffusion"),
        (lambda: Stamps(offsets=[["left", 0.0]]), "offsets"),
        (lambda: pachon.Light(["red"]), "wavelengths"),
        (lambda: pachon.FastEngine(n_pupil=9), "n_pupil = 9"),
        (lambda: pachon.FastEngine(oversampling=33), "oversampling = 33"),
        (lambda: pachon.WaveEngine(padding=3), "padding = 3"),
        (lambda: pachon.WaveEngine(pupil_spacing=0.0), "pupil_spacing = 0"),
        (lambda: pachon.LongExposureEngine(n_pupil=9), "n_pupil = 9"),
    ],
)
def test_options_check_their_ranges(make, named):
    with pytest.raises(DomainError, match=named):
        make()


def test_names_of_engines_stand_for_their_defaults(lsst_r):
    atmosphere = small_atmosphere()
    for name, engine in ENGINES.items():
        assert psf_engine(name) == engine()
        assert engine().needs_atmosphere == (name in ("long_exposure", "statistical"))
        assert engine().with_n_pupil(600) == (engine() if name == "wave" else engine(n_pupil=600))
    fields = [[0.01, 0.005]]
    by_name = make_psfs(lsst_r, fields, WAVELENGTHS, atmosphere=atmosphere, engine="fast")
    by_object = make_psfs(
        lsst_r, fields, WAVELENGTHS, atmosphere=atmosphere, engine=pachon.FastEngine(), stamps=Stamps()
    )
    assert by_name.image.tobytes() == by_object.image.tobytes()


def test_a_request_stands_for_telescope_fields_and_wavelengths(lsst_r):
    fields, options = [[0.01, 0.005], [0.0, -0.02]], {"atmosphere": small_atmosphere(), "engine": "long_exposure"}
    request = pachon.Request.of(lsst_r, fields, WAVELENGTHS)
    by_request, by_telescope = make_psfs(request, **options), make_psfs(lsst_r, fields, WAVELENGTHS, **options)
    assert by_request.image.tobytes() == by_telescope.image.tobytes()
    weighted = pachon.Request.of(lsst_r, fields, WAVELENGTHS, wavelength_weights=[1.0, 3.0, 2.0])
    light = pachon.Light(WAVELENGTHS, [1.0, 3.0, 2.0])
    assert np.array_equal(make_psfs(weighted, **options).image, make_psfs(lsst_r, fields, light, **options).image)
    # Angles of the other projection that mean the same directions.
    slopes = pachon.Request.of(lsst_r, np.tan(fields), WAVELENGTHS, projection="gnomonic")
    assert np.abs(make_psfs(slopes, **options).image - by_telescope.image).max() < 1e-6
    with pytest.raises(ConfigError, match=r"^fields = .*: given beside a Request, which has its own$"):
        make_psfs(request, fields, **options)
