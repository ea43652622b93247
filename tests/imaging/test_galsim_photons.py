"""Photons through the telescope, PSFs and world coordinates as objects of GalSim."""

import math
import pickle
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy import units as u

import pachon
from pachon.core.errors import DomainError, UnknownNameError
from pachon.core.units import ARCSEC
from pachon.imaging.wcs import ccd_wcs
from pachon.models.camera.silicon import Silicon
from pachon.models.shapes.grid import GridSag
from pachon.models.shapes.polynomial import ZernikeSag
from pachon.models.surface import Interaction
from pachon.reconstruction.focal_plane_psf.model import FocalPlanePsf

galsim = pytest.importorskip("galsim")

POINTING = (1.0, -0.5)
ANGLE = 0.4
# 0.1 nm, as for rays; both trace in double precision.
NEAR = 1e-10


def photons(n=4000, seed=1, band=(550.0, 700.0)):
    """Photons of a seeing disc [arcsec] with pupil coordinates and wavelengths."""
    rng = np.random.default_rng(seed)
    radius, angle = np.sqrt(rng.uniform(2.4**2, 4.3**2, n)), rng.uniform(0, 2 * np.pi, n)
    return galsim.PhotonArray(
        n,
        x=rng.normal(0.0, 0.3, n),
        y=rng.normal(0.0, 0.3, n),
        flux=np.ones(n),
        wavelength=rng.uniform(*band, n),
        pupil_u=radius * np.cos(angle),
        pupil_v=radius * np.sin(angle),
    )


def copied(photon_array):
    out = galsim.PhotonArray(len(photon_array))
    out.copyFrom(photon_array)
    return out


def traced(op, given, local_wcs=None, rng=None):
    out = copied(given)
    op.applyTo(out, local_wcs, rng)
    return out


def west_and_north(to_object):
    """Unit vectors in the frame of a telescope that points to the equator, its +y to the north."""
    west = np.cross(to_object, [0.0, 1.0, 0.0])
    west /= np.linalg.norm(west)
    return west, np.cross(west, to_object)


def celestial(wcs, pixel):
    """Celestial coordinates of a pixel, counted from 1."""
    ra, dec = wcs.to_celestial(wcs.to_sky(np.subtract(pixel, 1.0)))[0]
    return galsim.CelestialCoord(ra * galsim.radians, dec * galsim.radians)


def screened(telescope):
    """The telescope with a deformed M2, and a phase screen in glass, where it depends on the wavelength."""
    bent = telescope.with_deformation("M2", GridSag(np.linspace(-2, 2, 9), np.linspace(-2, 2, 9), 1e-6 * np.eye(9)))
    entrance = bent.surface("L1_entrance")
    screen = replace(
        entrance, name="screen", interaction=Interaction.PHASE, vertex=(0.0, 0.0, entrance.vertex[2] + 0.01),
        shape=ZernikeSag((0.0, 1e-5, 2e-5, 5e-6), 0.8), aperture=None,
    )  # fmt: skip
    place = bent.surfaces.index(entrance) + 1
    return replace(bent, surfaces=(*bent.surfaces[:place], screen, *bent.surfaces[place:]))


# The kernel for unusual surfaces takes several seconds to compile.
SPECIAL = pytest.mark.slow


@pytest.mark.parametrize(
    "change", [lambda telescope: telescope, pytest.param(screened, marks=SPECIAL)], ids=["plain", "special"]
)
def test_photons_land_where_single_rays_do(lsst_r, change):
    # Every ray launched and traced on its own, at its own wavelength and field.
    telescope, given, field = change(lsst_r), photons(60), (0.004, -0.007)
    out = traced(pachon.galsim.PachonOptics(telescope, field, pixel_size=1.0), given)
    chief = pachon.trace(telescope, pachon.launch_rays(telescope, field, 624e-9, ([0.0], [0.0]))).position[0]
    # At a pointing on the equator west and north of the object; the light goes the opposite way.
    slopes = np.tan(field)
    to_object = np.array([-slopes[0], -slopes[1], 1.0])
    to_object /= np.linalg.norm(to_object)
    west, north = west_and_north(to_object)
    for i in range(60):
        ray = -(to_object + ARCSEC * (given.x[i] * west + given.y[i] * north))
        start = pachon.launch_rays(
            telescope,
            (ray[0] / -ray[2], ray[1] / -ray[2]),
            given.wavelength[i] * 1e-9,
            ([given.pupil_u[i]], [given.pupil_v[i]]),
            projection="gnomonic",
        )
        end = pachon.trace(telescope, start)
        assert bool(out.flux[i]) is not bool(end.vignetted[0])
        if out.flux[i]:
            assert np.abs(end.position[0, :2] - chief[:2] - [out.x[i], out.y[i]]).max() < NEAR
            slope = end.direction[0, :2] / end.direction[0, 2]
            assert np.abs(slope - [out.dxdz[i], out.dydz[i]]).max() < 1e-12
    assert 0 < out.flux.sum() < 60


@pytest.mark.parametrize("name", ["LSST_r", pytest.param("HSC", marks=SPECIAL)])
def test_photons_land_where_batoids_rays_do(name):
    batoid = pytest.importorskip("batoid")
    telescope = pachon.load_telescope(Path(batoid.datadir) / name.split("_")[0] / f"{name}.yaml")
    optic = batoid.Optic.fromYaml(f"{name}.yaml")
    given, field = photons(2000), (0.0008, -0.001)
    scale = 0.5 * telescope.pupil_diameter / 4.2
    given.pupil_u *= scale
    given.pupil_v *= scale
    out = traced(pachon.galsim.PachonOptics(telescope, field, projection="gnomonic", pixel_size=1.0), given)
    axis = np.array([-field[0], -field[1], 1.0])
    axis /= np.linalg.norm(axis)
    west, north = west_and_north(axis)
    ray = -(axis[:, None] + ARCSEC * (west[:, None] * given.x + north[:, None] * given.y))
    ray /= np.linalg.norm(ray, axis=0)
    z = np.full(2000, optic.stopSurface.coordSys.origin[2])
    rays = batoid.RayVector(given.pupil_u, given.pupil_v, z, *ray, t=0.0, wavelength=given.wavelength * 1e-9)
    optic.trace(rays)
    lit = out.flux > 0
    assert np.array_equal(lit, ~(rays.vignetted | rays.failed))
    assert lit.sum() > 500
    origin = batoid.RayVector.fromStop(
        0.0, 0.0, optic=optic, wavelength=telescope.default_wavelength, theta_x=field[0], theta_y=field[1],
        projection="gnomonic",
    )  # fmt: skip
    optic.trace(origin)
    assert np.abs(rays.x - origin.x - out.x)[lit].max() < NEAR
    assert np.abs(rays.y - origin.y - out.y)[lit].max() < NEAR
    assert np.abs(rays.vx / np.abs(rays.vz) - out.dxdz)[lit].max() < 1e-12


def test_results_do_not_depend_on_threads_or_on_how_photons_are_split(lsst_r):
    given = photons(1000)
    op = pachon.galsim.PachonOptics(lsst_r, (0.002, 0.001), threads=1)
    whole = traced(op, given)
    threaded = traced(pachon.galsim.PachonOptics(lsst_r, (0.002, 0.001), threads=3), given)
    assert whole == threaded
    first = galsim.PhotonArray(333)
    first.copyFrom(given, target_indices=slice(0, 333), source_indices=slice(0, 333))
    op.applyTo(first)
    assert np.array_equal(first.x, whole.x[:333])
    assert np.array_equal(first.dydz, whole.dydz[:333])


def test_offsets_are_pixels_of_the_image_and_sky_offsets_by_its_wcs(lsst_r, wcs):
    # A star at a pixel of a CCD, by its celestial coordinates: photons on its chief ray land on the pixel.
    world = pachon.galsim.galsim_wcs(wcs)
    pixel = galsim.PositionD(3000.25, 411.5)
    sky = celestial(wcs, (pixel.x, pixel.y))
    assert sky.distanceTo(world.toWorld(pixel)) < 1e-6 * galsim.arcsec
    op = pachon.galsim.PachonOptics(
        lsst_r, sky_pos=sky, pointing=POINTING, position_angle=ANGLE, ccd="R22_S12", image_pos=pixel
    )
    # Photons about the star in pixels: through the centre of the pupil they keep their offsets, by the local WCS.
    grid = np.array([(0, 0), (20, 0), (0, 20), (-20, 10)], dtype=float)
    given = galsim.PhotonArray(4, x=grid[:, 0], y=grid[:, 1], flux=np.ones(4))
    given.pupil_u, given.pupil_v = np.zeros(4), np.zeros(4)
    # The chief ray is blocked on the LSST: without its apertures it is not.
    clear = replace(lsst_r, surfaces=tuple(replace(s, aperture=None) for s in lsst_r.surfaces))
    op.telescope = clear
    out = traced(op, given, world.local(pixel))
    # The fit of the WCS is good to 0.3 mas, 1.5e-3 pixel; the local WCS leaves the distortion over 20 pixels.
    assert np.abs(np.stack([out.x, out.y], axis=1) - grid).max() < 3e-3
    assert out.flux.sum() == 4.0


def test_a_rotated_camera_turns_the_offsets(lsst_r):
    given, angle = photons(300), 0.6
    plain = traced(pachon.galsim.PachonOptics(lsst_r, (0.002, 0.001)), given)
    turned = traced(pachon.galsim.PachonOptics(lsst_r.with_rotator(angle), (0.002, 0.001)), given)
    back = (turned.x + 1j * turned.y) * np.exp(1j * angle)
    # Rounding of 2 cm in pixels of 10 um.
    assert np.abs(back - plain.x - 1j * plain.y).max() < 1e-9


def test_field_and_sky_position_are_two_names_of_a_place(lsst_r, wcs):
    sky = celestial(wcs, (1000.0, 2000.0))
    op = pachon.galsim.PachonOptics(lsst_r, sky_pos=sky, pointing=POINTING * u.rad, position_angle=ANGLE * u.rad)
    same = pachon.galsim.PachonOptics(lsst_r, op.field, pointing=POINTING, position_angle=ANGLE)
    given = photons(500)
    one, other = traced(op, given), traced(same, given)
    # 1e-16 rad of rounding is 1e-10 pixel at a focal length of 10 m.
    assert np.abs(one.x - other.x).max() < 1e-8
    assert np.abs(one.y - other.y).max() < 1e-8


def test_heights_defocus_the_photons(lsst_r):
    given, field, lift = photons(2000), (0.001, 0.0012), 30e-6
    flat = pachon.FocalPlane.flat("lsst")
    high = flat.with_moved("R22_S11", dz=lift)
    on_flat, on_high = (
        traced(pachon.galsim.PachonOptics(lsst_r, field, focal_plane=plane, pixel_size=1.0), given)
        for plane in (flat, high)
    )
    nominal = traced(pachon.galsim.PachonOptics(lsst_r, field, pixel_size=1.0), given)
    lit = nominal.flux > 0
    # 1e-14 m: a flat CCD is the nominal surface, but for rounding.
    assert np.abs(on_flat.x - nominal.x)[lit].max() < 1e-14
    # Rays go on straight; the chief ray, from which offsets count, nearly along the axis.
    expected = lift * nominal.dxdz[lit]
    moved = (on_high.x - on_flat.x)[lit]
    assert np.abs(moved - expected - (moved - expected).mean()).max() < 1e-12
    # Between two CCDs, 20.5 to 21.8 mm from the axis, the light is lost.
    assert traced(pachon.galsim.PachonOptics(lsst_r, (0.00205, 0.0), focal_plane=flat), given).flux.sum() == 0


def test_photons_land_on_uneven_ccds_where_rays_do(lsst_r):
    plane, field = pachon.FocalPlane.from_budget("lsst", seed=3), (0.0035, -0.0012)
    given = photons(500, band=(620.0, 620.0))
    given.x, given.y = np.zeros(500), np.zeros(500)
    out = traced(pachon.galsim.PachonOptics(lsst_r, field, focal_plane=plane, pixel_size=1.0), given)
    start = pachon.launch_rays(lsst_r, field, 620e-9, (given.pupil_u, given.pupil_v))
    rays = pachon.trace(lsst_r, start, focal_plane=plane)
    blue = pachon.launch_rays(lsst_r, field, lsst_r.default_wavelength, ([0.0], [0.0]))
    chief = pachon.trace(lsst_r, blue, focal_plane=plane).position[0]
    lit = out.flux > 0
    assert np.array_equal(lit, ~rays.vignetted)
    assert lit.sum() > 300
    assert np.abs(np.stack([out.x, out.y], axis=1) - (rays.position - chief)[:, :2])[lit].max() < 1e-13


def test_silicon_absorbs_at_depth_and_loses_red_light(lsst_r):
    silicon = Silicon(thickness=100e-6, temperature=173.0)
    wavelength, n = 980e-9, 40000
    given = photons(n, band=(wavelength * 1e9, wavelength * 1e9))
    at_surface = traced(pachon.galsim.PachonOptics(lsst_r, (0.0, 0.0), pixel_size=1.0), given)
    op = pachon.galsim.PachonOptics(lsst_r, (0.0, 0.0), pixel_size=1.0, silicon=silicon, diffusion=0.0)
    out = traced(op, given, rng=galsim.BaseDeviate(5))
    lit, kept = at_surface.flux > 0, out.flux > 0
    # Binomial: three standard deviations.
    part = silicon.absorbed(wavelength)
    assert kept.sum() / lit.sum() == pytest.approx(part, abs=3 * math.sqrt(part * (1 - part) / lit.sum()))
    # Displacements over slopes of the ray are depths over the index; their mean is the equivalent defocus.
    steep = kept & (np.abs(out.dxdz) > 0.2)
    inside = (out.x - at_surface.x)[steep] * np.sqrt(1 + out.dxdz**2 + out.dydz**2)[steep] / out.dxdz[steep]
    mean, rms = silicon.defocus(wavelength)
    assert inside.mean() == pytest.approx(mean, abs=4 * rms / math.sqrt(steep.sum()))
    assert inside.std() == pytest.approx(rms, rel=0.03)
    spread = traced(pachon.galsim.PachonOptics(lsst_r, (0.0, 0.0), pixel_size=1.0, silicon=silicon, diffusion=5e-6), given, rng=galsim.BaseDeviate(5))  # fmt: skip # noqa: E501
    # The depths are those of the same random numbers, so the rest is diffusion: sigma^2 = s^2 (1 - d/t).
    depth = (out.x - at_surface.x)[steep] / out.dxdz[steep] * np.sqrt(1 + out.dxdz**2 + out.dydz**2)[steep]
    depth *= silicon.index(wavelength)
    variance = np.mean(25e-12 * (1 - depth / 100e-6))
    assert np.var((spread.x - out.x)[steep]) == pytest.approx(variance, rel=5 * math.sqrt(2 / steep.sum()))


def test_the_operator_is_pickled_compared_and_shown(lsst_r):
    plane = pachon.FocalPlane.from_budget("lsst", seed=1)
    op = pachon.galsim.PachonOptics(lsst_r, (0.001, 0.0015), focal_plane=plane)
    again = pickle.loads(pickle.dumps(op))
    assert again == op
    assert hash(again) == hash(op)
    given = photons(100)
    assert traced(again, given) == traced(op, given)
    assert op != pachon.galsim.PachonOptics(lsst_r, (0.001, 0.0015))
    assert op != pachon.galsim.PachonOptics(lsst_r, (0.001, 0.0016), focal_plane=plane)
    assert len(repr(op)) < 120


def test_an_image_is_drawn_through_the_telescope(lsst_r, wcs):
    # A star by photons: as sharp as its seeing and the telescope, on the pixel that its sky coordinates say.
    world, pixel = pachon.galsim.galsim_wcs(wcs), galsim.PositionD(1203.0, 807.0)
    op = pachon.galsim.PachonOptics(
        lsst_r, sky_pos=world.toWorld(pixel), pointing=POINTING, position_angle=ANGLE, ccd="R22_S12", image_pos=pixel
    )
    image = galsim.Image(galsim.BoundsI(1180, 1226, 784, 830), wcs=world)
    star = galsim.Gaussian(fwhm=0.7, flux=2e5)
    star.drawImage(
        image,
        center=pixel,
        method="phot",
        rng=galsim.BaseDeviate(3),
        photon_ops=[galsim.PupilAnnulusSampler(4.18, 2.558), op],
    )
    y, x = np.indices(image.array.shape)
    total = image.array.sum()
    centre = np.array([(image.array * x).sum(), (image.array * y).sum()]) / total
    # The light's centroid is not where the chief ray is: coma moves it, by as much as that of traced rays.
    radius, angle = np.sqrt(np.linspace(2.558**2, 4.18**2, 5000)), 2.399963 * np.arange(5000)
    pupil = (radius * np.cos(angle), radius * np.sin(angle))
    rays = pachon.trace(lsst_r, pachon.launch_rays(lsst_r, op.field, 624e-9, pupil))
    chief = pachon.trace(lsst_r, pachon.launch_rays(lsst_r, op.field, 624e-9, ([0.0], [0.0])))
    # x and y of the pixels are y and x of the telescope.
    coma = (rays.position[~rays.vignetted].mean(axis=0) - chief.position[0])[1::-1] / 10e-6
    # Four standard deviations of 2e5 photons.
    assert np.abs(centre - 23.0 - coma).max() < 4 * 1.52 / math.sqrt(2e5)
    assert np.abs(coma).max() > 0.05
    lost = 1 - total / 2e5
    assert 0 < lost < 0.03
    sigma = galsim.hsm.FindAdaptiveMom(image).moments_sigma
    # 0.7 arcsec of seeing, 0.1 of optics, a pixel of 0.2: 1.50 to 1.54 pixels.
    assert 1.49 < sigma < 1.56


@pytest.mark.parametrize(
    ("arguments", "options", "message"),
    [
        ((), {}, "field and sky_pos: expected one of them"),
        (((0.0, 0.0),), {"sky_pos": galsim.CelestialCoord(0 * galsim.degrees, 0 * galsim.degrees)}, "expected one"),
        (((0.0, 0.0),), {"ccd": "R22_S11"}, "ccd and image_pos: expected both"),
        (((0.5, 0.0),), {}, "expected within 2.5 deg"),
        (((0.0, 0.0),), {"pixel_size": 0.0}, "pixel_size = .*expected a positive"),
        (((0.0, 0.0),), {"pointing": 3.0}, "expected right ascension and declination, finite angles"),
        ((), {"sky_pos": galsim.CelestialCoord(180 * galsim.degrees, 0 * galsim.degrees)}, "in front of the telescope"),
    ],
)
def test_bad_arguments_are_refused(lsst_r, arguments, options, message):
    with pytest.raises(DomainError, match=message):
        pachon.galsim.PachonOptics(lsst_r, *arguments, **options)


def test_what_is_missing_is_named(lsst_r):
    with pytest.raises(UnknownNameError, match="CCD of lsst 'R99'"):
        pachon.galsim.PachonOptics(lsst_r, (0, 0), ccd="R99", image_pos=galsim.PositionD(1, 1))
    with pytest.raises(DomainError, match="paul_baker has no camera: expected a pixel_size"):
        pachon.galsim.PachonOptics(pachon.paul_baker(), (0.0, 0.0))
    with pytest.raises(DomainError, match="without pupil coordinates"):
        pachon.galsim.PachonOptics(lsst_r, (0.0, 0.0)).applyTo(galsim.PhotonArray(3))
    with pytest.raises(DomainError, match="wavelength = 5000 nm"):
        pachon.galsim.PachonOptics(lsst_r, (0.0, 0.0)).applyTo(photons(10, band=(5000.0, 5000.0)))
    lens = pachon.load_telescope(Path(__file__).parents[1] / "data" / "zmx" / "US05831776-1.zmx")
    with pytest.raises(DomainError, match="object at"):
        pachon.galsim.PachonOptics(lens, (0.0, 0.0), pixel_size=1e-5)


def test_without_galsim_one_line_says_what_to_install():
    code = (
        "import sys; sys.modules['galsim'] = None\n"
        "import pachon\n"
        "try: pachon.galsim.PachonOptics\n"
        "except pachon.errors.ConfigError as error: print(error)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "pachon.galsim.PachonOptics needs GalSim: pip install 'pachon[galsim]'\n"


@pytest.mark.long
def test_a_configuration_file_draws_a_ccd(tmp_path):
    path = Path(__file__).parents[2] / "docs" / "examples" / "galsim_lsst_ccd.yaml"
    [config] = galsim.config.ReadConfig(str(path))
    side = {"type": "Random", "min": 1, "max": 200}
    for key in ("xsize", "ysize"):
        del config["image"][key]
    config["image"].update(size=200, nobjects=6, image_pos={"type": "XY", "x": side, "y": side}, noise=None)
    config["image"]["sky_level_pixel"] = 0.0
    del config["image"]["noise"]
    galsim.config.ImportModules(config)
    image = galsim.config.BuildImage(config)
    assert image.array.shape == (200, 200)
    assert image.array.sum() > 5000
    # The same CCD by the function that pachon's own images have their WCS from.
    pointing = np.deg2rad([53.1, -27.8])
    ours = ccd_wcs(pachon.load_telescope("lsst_v3.3_r"), pachon.lsst_camera(), "R22_S11", pointing=pointing)
    sky = celestial(ours, (150.0, 20.0))
    assert image.wcs.toWorld(galsim.PositionD(150.0, 20.0)).distanceTo(sky) < 1e-6 * galsim.arcsec


def covariance(image):
    """Centroid [pixel, from 0] and second moments [pixel^2] of an image [ny, nx]."""
    y, x = np.indices(image.shape)
    points, weights = np.stack([x.ravel(), y.ravel()]), image.ravel() / image.sum()
    centre = points @ weights
    return centre, (weights * (points - centre[:, None])) @ (points - centre[:, None]).T


@pytest.fixture
def stamp(gaussian):
    """An elongated Gaussian, off the middle of its stamp."""
    return gaussian(41, np.array([[9.0, 2.0], [2.0, 5.0]]), center=(0.3, -0.2))


def psfs_of(stamp, scale=0.2 * ARCSEC):
    one = np.zeros((1, 2))
    return pachon.wavefront.psf.psf.Psfs(
        stamp[None].astype(np.float32), scale, one, np.array([6e-7]), np.zeros((1, 3)), np.array([[0.3, -0.2]]),
        np.ones((1, 1)), np.ones(1), np.zeros(1, dtype=int),
    )  # fmt: skip


def test_a_stamp_becomes_an_object_of_the_same_moments_and_flux(stamp):
    psf = pachon.galsim.psf_object(psfs_of(stamp), flux=250.0)
    assert psf.flux == pytest.approx(250.0)
    image = psf.drawImage(nx=61, ny=61, scale=0.2, method="no_pixel").array
    centre, moments = covariance(image)
    # The reference point of the star comes to the centre. 1e-3: what float32 and the interpolation leave.
    assert centre == pytest.approx([30.0, 30.0], abs=2e-3)
    assert moments == pytest.approx(np.array([[9.0, 2.0], [2.0, 5.0]]), abs=5e-2)
    assert image.sum() == pytest.approx(250.0, rel=1e-3)


def test_a_stamp_is_turned_by_the_wcs_of_its_ccd(stamp, wcs):
    local = pachon.galsim.galsim_wcs(wcs).local(galsim.PositionD(1000.0, 3000.0)).jacobian()
    psf = pachon.galsim.psf_object(psfs_of(stamp), wcs=local)
    # On the pixels of the CCD it is the stamp again; on the sky its second moments are J M J^T.
    on_ccd = psf.drawImage(nx=41, ny=41, wcs=local, method="no_pixel", offset=(0.3, -0.2)).array
    assert np.abs(on_ccd - stamp).max() < 2e-3 * stamp.max()
    sky = psf.drawImage(nx=61, ny=61, scale=0.2, method="no_pixel").array
    jacobian = local.getMatrix()
    expected = jacobian @ np.array([[9.0, 2.0], [2.0, 5.0]]) @ jacobian.T / 0.2**2
    assert covariance(sky)[1] == pytest.approx(expected, abs=6e-2)


def test_models_of_psfs_become_objects(gaussian):
    rng = np.random.default_rng(2)
    places = rng.uniform(-1, 1, (40, 2))
    stamps = np.array([gaussian(31, np.array([[4 + x, 0.5 * y], [0.5 * y, 4.0]])) for x, y in places])
    model = pachon.PsfModel.fit(stamps, places, n_components=3, order=2)
    psf = pachon.galsim.psf_object(model, x=0.5, y=-0.4, wcs=0.2)
    _, moments = covariance(psf.drawImage(nx=31, ny=31, scale=0.2, method="no_pixel").array)
    assert moments == pytest.approx(np.array([[4.5, -0.2], [-0.2, 4.0]]), abs=0.05)
    model = pachon.PsfModel.fit(stamps, places, n_components=3, order=0, colour=places[:, 0])
    psf = pachon.galsim.psf_object(model, x=0.5, y=-0.4, colour=0.7, wcs=0.2)
    drawn = psf.drawImage(nx=31, ny=31, scale=0.2, method="no_pixel").array
    # The interpolant passes through the pixels.
    np.testing.assert_allclose(drawn, model.draw(0.5, -0.4, colour=0.7), atol=1e-5 * drawn.max())
    for options, message in (({}, "x and y: expected the place"), ({"x": 0.0, "y": 0.0}, "wcs = None")):
        with pytest.raises(DomainError, match=message):
            pachon.galsim.psf_object(model, **options)
    with pytest.raises(DomainError, match=r"star = 3: expected 0 to 0"):
        pachon.galsim.psf_object(psfs_of(stamps[0]), star=3)


def test_the_psf_of_the_focal_plane_becomes_an_object(gaussian, monkeypatch):
    covariance_of = {"R22_S11": np.array([[4.0, 0.0], [0.0, 3.0]])}

    def draw(self, ccd, x, y, *, threads=None):
        assert (x, y) == (1e-3, -2e-3)
        return gaussian(31, covariance_of[ccd])[None]

    monkeypatch.setattr(FocalPlanePsf, "draw", draw)
    model = object.__new__(FocalPlanePsf)
    object.__setattr__(model, "pixel_scale", 0.2 * ARCSEC)
    psf = pachon.galsim.psf_object(model, ccd="R22_S11", x=1e-3, y=-2e-3)
    _, moments = covariance(psf.drawImage(nx=31, ny=31, scale=0.2, method="no_pixel").array)
    assert moments == pytest.approx(covariance_of["R22_S11"], abs=0.03)
    with pytest.raises(DomainError, match="ccd, x and y: expected the place"):
        pachon.galsim.psf_object(model, x=1e-3, y=0.0)


@pytest.mark.parametrize(
    ("telescope", "ccd"), [("lsst_v3.3_r", "R22_S12"), ("comcam_r", "R22_S01"), ("hsc", "hsc074"), ("hsc", "hsc101")]
)
def test_a_stamp_along_the_focal_plane_is_turned_onto_the_pixels_as_photons_are(stamp, telescope, ccd):
    model = pachon.load_telescope(telescope)
    camera = pachon.load_camera(model.camera)
    middle = 0.5 * (camera.pixels[camera.ccd_index(ccd)] - 1.0)
    field = pachon.fields_at(model, camera.from_pixel(camera.ccd_index(ccd), middle)[None])[0]
    axes = ({}, {"ccd": ccd, "image_pos": galsim.PositionD(*(middle + 1.0))})
    ends = [photons(60, band=(620.0, 621.0)) for _ in axes]
    for landed, options in zip(ends, axes, strict=True):
        pachon.galsim.PachonOptics(model, field, **options).applyTo(landed)
    along = [np.stack([p.x - p.x.mean(), p.y - p.y.mean()]) for p in ends]
    turn = np.round(along[1] @ np.linalg.pinv(along[0]), 6)

    local = pachon.galsim.galsim_wcs(ccd_wcs(model, camera, ccd, pointing=POINTING)).local(
        galsim.PositionD(*(middle + 1.0))
    )
    psf = pachon.galsim.psf_object(psfs_of(stamp), camera=model.camera, ccd=ccd, wcs=local)
    _, moments = covariance(psf.drawImage(nx=61, ny=61, wcs=local, method="no_pixel").array)
    assert moments == pytest.approx(turn @ np.array([[9.0, 2.0], [2.0, 5.0]]) @ turn.T, abs=5e-2)
    for options in ({"ccd": ccd}, {"wcs": local}, {"ccd": ccd, "wcs": 0.2}):
        with pytest.raises(DomainError, match=r"camera = .*: expected ccd and the local WCS of its pixels beside it"):
            pachon.galsim.psf_object(psfs_of(stamp), camera=camera, **options)
