"""World coordinates against traced chief rays, and against astropy."""

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.wcs import WCS

import pachon
from pachon.core.errors import ConfigError, DomainError, UnknownNameError
from pachon.core.units import ARCSEC
from pachon.imaging.wcs import TOLERANCE, ccd_wcs
from pachon.models.camera.cameras import load_camera
from pachon.raytrace.rays import field_direction
from pachon.sky.pointing import Pointing
from pachon.wavefront.chief_rays import fields_at

CAMERA = pachon.lsst_camera()
RA, DEC, ROLL = 1.0, -0.5, 0.4
#: Centre of the field, its edge, and the corner of the camera farthest from the axis.
CCDS = ("R22_S11", "R24_S12", "R41_S20")
#: Pixels that are not those of the fit, the very corners among them.
PIXELS = np.concatenate(
    [np.random.default_rng(2).uniform(-0.5, 3999.5, (40, 2)), [[-0.5, -0.5], [4071.5, -0.5], [-0.5, 3999.5]]]
)
#: Pixels along x and y of CCDs of ITL, and of E2V.
SIZES = {"itl": (4072, 4000), "e2v": (4096, 4004)}


@pytest.fixture(
    params=[
        {},
        {"rotator": 0.6},
        {"M2": {"shift": (2e-3, -1e-3, 0.0), "tilt": (3e-4, 2e-4, 0.0)}},
    ],
    ids=["as designed", "rotated", "perturbed"],
)
def telescope(request, lsst_r):
    if "rotator" in request.param:
        return lsst_r.with_rotator(request.param["rotator"])
    for name, motion in request.param.items():
        return lsst_r.perturbed(name, **motion)
    return lsst_r


def celestial(slopes):
    """Right ascension and declination [rad] of the source of light, by the basis vectors of the sky at the pointing."""
    outwards = np.array([np.cos(DEC) * np.cos(RA), np.cos(DEC) * np.sin(RA), np.sin(DEC)])
    east = np.array([-np.sin(RA), np.cos(RA), 0.0])
    north = np.cross(outwards, east)
    # The telescope's +y lies ROLL from north towards east, its +z points to the sky, and its axes are right-handed.
    y = np.cos(ROLL) * north + np.sin(ROLL) * east
    x = np.cross(y, outwards)
    source = -field_direction(*slopes.T, "gnomonic") @ np.stack([x, y, outwards])
    return np.stack([np.arctan2(source[:, 1], source[:, 0]), np.arcsin(source[:, 2])], axis=1)


def places(ccd):
    """Places of the pixels on the detector [m]: the pixels' x runs along y of the telescope, their y along x."""
    index = CAMERA.ccd_index(ccd)
    from_middle = PIXELS - 0.5 * (np.array(SIZES[CAMERA.vendors[index]]) - 1)
    return CAMERA.centers[index] + from_middle[:, ::-1] * CAMERA.pixel_size


def traced(telescope, ccd):
    """Celestial coordinates [rad] of the pixels, by chief rays."""
    return celestial(fields_at(telescope, places(ccd), projection="gnomonic"))


def separation(a, b):
    """Largest distance on the sky [rad]."""
    d = np.abs(a - b) * np.stack([np.cos(b[:, 1]), np.ones(len(b))], axis=1)
    return np.hypot(*d.T).max()


@pytest.mark.parametrize("ccd", CCDS)
def test_both_directions_of_astropy_agree_with_the_rays(telescope, ccd):
    wcs = ccd_wcs(telescope, CAMERA, ccd, pointing=(RA, DEC), position_angle=ROLL)
    expected = traced(telescope, ccd)
    header = wcs.astropy()
    # FITS counts pixels from 1.
    assert separation(np.deg2rad(header.all_pix2world(PIXELS + 1.0, 1)), expected) < TOLERANCE
    back = header.all_world2pix(np.rad2deg(expected), 0, tolerance=1e-6)
    assert np.abs(back - PIXELS).max() * 0.2 * ARCSEC < TOLERANCE


def test_the_inverse_polynomials_of_the_header_are_good_to_a_milliarcsecond(telescope):
    # Programs that do not iterate use AP and BP, here as the SIP paper writes them.
    wcs = ccd_wcs(telescope, CAMERA, "R41_S20", pointing=(RA, DEC), position_angle=ROLL)
    header = wcs.to_header()
    cd = np.array([[header[f"CD{i}_{j}"] for j in (1, 2)] for i in (1, 2)])
    # Gnomonic projection about CRVAL (Calabretta & Greisen 2002, sec. 5.1.3).
    (ra, dec), (ra0, dec0) = traced(telescope, "R41_S20").T, np.deg2rad([header["CRVAL1"], header["CRVAL2"]])
    depth = np.sin(dec0) * np.sin(dec) + np.cos(dec0) * np.cos(dec) * np.cos(ra - ra0)
    north = np.cos(dec0) * np.sin(dec) - np.sin(dec0) * np.cos(dec) * np.cos(ra - ra0)
    u, v = np.linalg.solve(cd, np.rad2deg([np.cos(dec) * np.sin(ra - ra0) / depth, north / depth]))
    powers = [(i, j) for i in range(wcs.order + 1) for j in range(wcs.order + 1)]
    for axis, (name, linear) in enumerate((("AP", u), ("BP", v))):
        distortion = sum(header.get(f"{name}_{i}_{j}", 0.0) * u**i * v**j for i, j in powers)
        pixel = linear + distortion + header[f"CRPIX{axis + 1}"] - 1.0
        assert np.abs(pixel - PIXELS[:, axis]).max() * 0.2 < 1e-3


@pytest.mark.parametrize("ccd", CCDS)
def test_our_own_directions_agree_with_the_rays_and_each_other(telescope, ccd):
    wcs = ccd_wcs(telescope, CAMERA, ccd, pointing=(RA, DEC), position_angle=ROLL)
    sky = wcs.to_sky(PIXELS)
    assert separation(wcs.to_celestial(sky), traced(telescope, ccd)) < TOLERANCE
    # Newton's method ends at rounding.
    assert np.abs(wcs.to_pixel(sky) - PIXELS).max() < 1e-8


@pytest.mark.parametrize("dec", [0.5 * np.pi, -0.5 * np.pi])
def test_headers_at_the_poles(telescope, dec):
    """A reference at exactly 90 degrees has another default of LONPOLE, by which images stood upside down."""
    wcs = ccd_wcs(telescope, CAMERA, "R22_S11", pointing=(RA, dec), position_angle=ROLL)
    in_header = np.deg2rad(wcs.astropy().all_pix2world(PIXELS, 0))
    assert separation(in_header, wcs.to_celestial(wcs.to_sky(PIXELS))) < TOLERANCE


def test_corners_of_hsc_in_blue_light():
    """0.87 degrees from the axis no order of SIP leaves 3e-4 arcsec: four CCDs had no images in g."""
    hsc, camera = pachon.load_telescope("hsc"), load_camera("hsc")
    wcs = ccd_wcs(hsc, camera, "hsc102", wavelength=403e-9)
    assert (wcs.order, TOLERANCE < wcs.error < 6e-4 * ARCSEC) == (9, True)
    corner = np.array([[0.0, 0.0], [2047.0, 0.0], [0.0, 4175.0], [2047.0, 4175.0]])
    slopes = fields_at(hsc, camera.from_pixel(camera.ccd_index("hsc102"), corner), 403e-9, projection="gnomonic")
    assert (
        separation(wcs.to_celestial(wcs.to_sky(corner)), wcs.to_celestial(Pointing(0.0, 0.0).to_sky(slopes)))
        < 2e-3 * ARCSEC
    )


def test_the_order_is_the_lowest_that_is_good_enough(lsst_r):
    wcs = ccd_wcs(lsst_r, CAMERA, "R22_S11")
    assert (wcs.order, wcs.error < TOLERANCE) == (3, True)
    assert wcs.astropy().wcs.ctype[0] == "RA---TAN-SIP"


def test_a_telescope_without_distortion_needs_no_sip(lsst_r):
    from pachon.models.ideal_telescope import ideal_telescope

    # A long paraboloid: its distortion of a tangent projection is below a milliarcsecond on a small CCD on the axis.
    ideal = ideal_telescope(lsst_r, 1e5)
    small = pachon.models.Camera(
        "small", ("A_0",), ("A",), np.array([0]), np.zeros((1, 2)), np.array([512, 512]), 10e-6 * 1e5 / 1.23
    )
    wcs = ccd_wcs(ideal, small, "A_0")
    assert wcs.order == 1
    assert wcs.astropy().wcs.ctype[0] == "RA---TAN"
    assert wcs.astropy().sip is None


def test_jacobians_are_derivatives(wcs):
    step = 1e-7
    for axis in range(2):
        shift = np.eye(2)[axis] * step
        sky = wcs.to_sky(PIXELS)
        slope = (wcs.to_pixel(sky + shift) - wcs.to_pixel(sky - shift)) / (2.0 * step)
        assert np.allclose(wcs.jacobians(PIXELS)[:, :, axis], slope, rtol=1e-6, atol=1.0)


def test_at_no_roll_east_lies_towards_smaller_y_and_north_towards_smaller_x(lsst_r):
    # Light of a source in the north travels towards -y of the telescope, along which the pixels' x runs.
    cd = ccd_wcs(lsst_r, CAMERA, "R22_S11").cd / ARCSEC
    assert np.allclose(cd, [[0.0, -0.2], [-0.2, 0.0]], atol=1e-3)


def test_pixels_of_a_camera_that_is_not_transposed_are_a_mirror_image(lsst_r):
    square = pachon.models.Camera("square", ("A",), (), np.array([-1]), np.zeros((1, 2)), np.array([400, 400]), 10e-6)
    cd = ccd_wcs(lsst_r, square, "A").cd / ARCSEC
    assert np.allclose(cd, [[-0.2, 0.0], [0.0, -0.2]], atol=1e-3)


def test_the_header_of_a_part_starts_at_its_corner(wcs):
    whole, part = wcs.astropy(), wcs.astropy((100, 300))
    assert np.allclose(part.all_pix2world([[5, 7]], 0), whole.all_pix2world([[105, 307]], 0), rtol=0, atol=1e-12)
    assert part.pixel_shape == (3996, 3704)


def test_quantities_are_angles(lsst_r, wcs):
    same = ccd_wcs(
        lsst_r,
        CAMERA,
        "R22_S12",
        pointing=np.rad2deg([1.0, -0.5]) * u.deg,
        position_angle=np.rad2deg(0.4) * u.deg,
    )
    assert np.allclose(same.to_sky(PIXELS), wcs.to_sky(PIXELS), rtol=0, atol=1e-15)


@pytest.mark.parametrize(
    ("pointing", "roll"), [((0.0, 2.0), 0.0), ((np.nan, 0.0), 0.0), ((0.0, 0.0), np.inf), (1.0, 0)]
)
def test_a_pointing_that_is_none_is_refused(lsst_r, pointing, roll):
    with pytest.raises(DomainError, match=r"pointing.* expected .*finite angles"):
        ccd_wcs(lsst_r, CAMERA, "R22_S11", pointing=pointing, position_angle=roll)


def test_an_unknown_ccd_is_named(lsst_r):
    with pytest.raises(UnknownNameError, match="R22_S31"):
        ccd_wcs(lsst_r, CAMERA, "R22_S31")


@pytest.mark.parametrize("name", ["lsst_v3.3_i", "comcam_r"])
def test_the_wcs_of_astropy_is_within_a_milliarcsecond_of_the_tracer(name):
    # ComCam is raft R22 of the LSST camera, rotated; red light, another wavelength than the default.
    telescope = pachon.load_telescope(name).with_rotator(-0.3)
    light = telescope.wavelength_range[1]
    aim = SkyCoord(np.rad2deg(RA), np.rad2deg(DEC), unit="deg")
    wcs = pachon.wcs(telescope, "R22_S20", aim, ROLL * u.rad, camera="lsst", wavelength=light)
    expected = celestial(fields_at(telescope, places("R22_S20"), light, projection="gnomonic"))
    assert separation(np.deg2rad(wcs.all_pix2world(PIXELS, 0)), expected) < 1e-3 * ARCSEC


def test_a_wcs_survives_a_fits_file(lsst_r, tmp_path):
    wcs = pachon.wcs(lsst_r, "R22_S12", (RA, DEC), ROLL)
    fits.PrimaryHDU(np.zeros((4096, 4096), np.int8), wcs.to_header(relax=True)).writeto(tmp_path / "ccd.fits")
    back = WCS(fits.getheader(tmp_path / "ccd.fits"))
    # Cards hold a dozen digits of degrees.
    assert np.abs(back.all_pix2world(PIXELS, 0) - wcs.all_pix2world(PIXELS, 0)).max() * 3600.0 < 1e-6


def test_the_camera_lies_at_the_rotation_less_the_rotator(lsst_r):
    rotator = 0.25
    wcs = pachon.wcs(lsst_r.with_rotator(rotator), "R22_S11", (RA, DEC), ROLL)
    middle, right = wcs.pixel_to_world([2047.5, 2147.5], [2001.5, 2001.5])
    # The pixels' x runs along the camera's y, and the image is turned by half: away from the camera's +y on the sky.
    towards = middle.position_angle(right).rad - np.pi
    # Over 20 arcsec the direction changes by the distortion of the pixels, 1e-6.
    assert np.isclose((towards - (ROLL - rotator) + np.pi) % (2 * np.pi) - np.pi, 0.0, atol=1e-5)
    assert np.linalg.det(wcs.wcs.cd) < 0.0


def test_a_telescope_without_camera_is_one_line():
    telescope = pachon.paul_baker()
    with pytest.raises(ConfigError, match="camera = None: expected a camera for "):
        pachon.wcs(telescope, "R22_S11", (RA, DEC))
    with pytest.raises(DomainError, match=r"CCD R41_S20: .*outside the field"):
        pachon.wcs(pachon.load_telescope("hsc"), "R41_S20", (RA, DEC), camera="lsst")


@pytest.mark.slow
def test_all_ccds_of_the_lsst_are_within_a_milliarcsecond_of_the_tracer(lsst_r):
    for ccd in CAMERA.ccd_names:
        wcs = pachon.wcs(lsst_r, ccd, (RA, DEC), ROLL)
        assert separation(np.deg2rad(wcs.all_pix2world(PIXELS, 0)), traced(lsst_r, ccd)) < 1e-3 * ARCSEC, ccd


@pytest.mark.parametrize(("name", "worst"), [("lsst_v3.3_r", 0.09), ("decam", 0.17)])
def test_coma_moves_centroids_from_the_world_coordinates(name, worst):
    """The mean ray of the pupil lands beside the chief ray, whose coordinates they are, by as much as the docs say."""
    telescope = pachon.load_telescope(name)
    radius = 0.5 * telescope.pupil_diameter * np.sqrt(np.linspace(telescope.pupil_obscuration**2, 1.0, 42)[1:-1])
    angle = 2.0 * np.pi * np.arange(60) / 60
    pupil = np.append(0.0, np.outer(radius, np.cos(angle))), np.append(0.0, np.outer(radius, np.sin(angle)))
    wavelength = telescope.default_wavelength

    def moved(field):
        rays = pachon.launch_rays(telescope, field=(field, 0.0), wavelength=wavelength, pupil=pupil)
        landed = pachon.trace(telescope, rays)
        lit = landed.status[1:] == 0
        return np.hypot(*(landed.position[1:, :2][lit].mean(axis=0) - landed.position[0, :2]))

    fields = np.linspace(0.0, telescope.field_radius, 15)
    scale = 1.0 / pachon.first_order(telescope, wavelength).focal_length
    assert max(moved(field) for field in fields) * scale / ARCSEC == pytest.approx(worst, abs=0.005)
