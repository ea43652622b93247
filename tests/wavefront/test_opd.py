"""The OPD against Zemax, and against the rays that it belongs to."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits

import pachon
from pachon.core.errors import ConfigError, DomainError
from pachon.wavefront.zernike import fit_zernikes

ZEMAX = Path(__file__).parents[1] / "data" / "zemax"


@pytest.fixture(scope="module")
def zemax_map():
    # Rows are listed from the top of the map.
    return np.loadtxt(ZEMAX / "lsst_v3.3_opd_500nm_field_0.000_1.225.txt")[::-1]


@pytest.fixture(scope="module")
def zemax_lattice():
    axis = (np.arange(32) - 16) / 15 * 4.18
    return np.meshgrid(axis, axis)


def test_zemax_map(zemax_lsst, zemax_map, zemax_lattice):
    opd = pachon.wavefront_opd(zemax_lsst, (0, 1.225) * u.deg, 500 * u.nm, zemax_lattice)
    both = (zemax_map != 0) & opd.lit
    assert both.sum() > 0.95 * (zemax_map != 0).sum()
    # 10 pm: the listing has seven digits (0.3 pm) and Zemax refers to the exit pupil, 2.7 m from the image, not 5 m.
    assert np.abs(opd.value - zemax_map * 500e-9)[both].max() < 10e-12


def test_zemax_map_on_the_sphere_of_the_exit_pupil(zemax_lsst, zemax_map, zemax_lattice):
    # Exit pupil of diameter 2189.7 mm at f/1.23: 2.7 m. What remains is the rounding of the listing.
    opd = pachon.wavefront_opd(
        replace(zemax_lsst, reference_sphere_radius=2.7), (0, 1.225) * u.deg, 500e-9, zemax_lattice
    )
    both = (zemax_map != 0) & opd.lit
    assert np.abs(opd.value - zemax_map * 500e-9)[both].max() < 0.5e-12


@pytest.mark.parametrize("height_um", [0.0, 10.0])
def test_transverse_aberration_is_the_gradient_of_the_opd(lsst_r, height_um):
    """X = dW/du, with u the exit direction cosines: the ray meets the image where its wavefront points."""
    camera = pachon.lsst_camera()
    table = {
        "x": (camera.centers[:, :1] + [0.0, 0.01, 0.0]).ravel(),
        "y": (camera.centers[:, 1:] + [0.0, 0.0, 0.01]).ravel(),
        "z": np.full(3 * 189, height_um * 1e-6),
    }
    focal_plane = pachon.FocalPlane.from_heights(table)
    field = pachon.fields_at(lsst_r, [[0.15, 0.21]])[0]
    n, h = 40, 0.02
    rng = np.random.default_rng(1)
    radius, angle = np.sqrt(rng.uniform(2.7**2, 4.0**2, n)), rng.uniform(0, 2 * np.pi, n)
    px, py = radius * np.cos(angle), radius * np.sin(angle)
    # Each point with its neighbours: derivatives over the entrance pupil by fourth-order central differences.
    cross = h * np.array([[0, 0], [1, 0], [-1, 0], [2, 0], [-2, 0], [0, 1], [0, -1], [0, 2], [0, -2]])
    opd = pachon.wavefront_opd(
        lsst_r, field, 620e-9, (px[:, None] + cross[:, 0], py[:, None] + cross[:, 1]), focal_plane=focal_plane
    )
    lit = opd.lit.all(axis=1)
    assert lit.sum() > 20

    def slopes(values):
        first, second = values[:, [1, 5]] - values[:, [2, 6]], values[:, [3, 7]] - values[:, [4, 8]]
        return (8 * first - second) / (12 * h)

    # Exactly, on a sphere at a finite distance: dW = X . ds / t, with s the point of the ray on the sphere and t its
    # distance from the landing point (d path = d . ds, and d = (s - c - X) / t, where s - c is normal to ds).
    offset = opd.landing - opd.center
    along = np.einsum("ijk,ijk->ij", offset, opd.exit_direction)
    t = np.sqrt(along**2 - np.einsum("ijk,ijk->ij", offset, offset) + opd.radius**2) - along
    sphere = opd.landing + opd.exit_direction * t[..., None]
    gradient = slopes(opd.value)
    predicted = sum(offset[:, 0, k, None] * slopes(sphere[..., k]) for k in range(3)) / t[:, :1]
    # Paths good to 1e-14 m over differences of 80 mm: slopes good to 1e-12, of 6e-7 and more.
    scale = np.abs(gradient[lit]).max()
    assert scale > 5e-7
    assert np.abs(gradient - predicted)[lit].max() < 3e-6 * scale


def test_defocus_has_the_size_and_sign_of_the_height(lsst_r):
    """Raising the CCD by h moves the image point along the light: the OPD gains -h cos(angle of the ray)."""
    height = 5e-6
    raised = lsst_r.perturbed("Detector", shift=(0, 0, height))
    x = np.array([2.7, 3.4, 4.1])
    there, here = (pachon.wavefront_opd(t, (0, 0), 620e-9, (x, 0 * x)) for t in (raised, lsst_r))
    cosine = here.exit_direction[:, 2]
    change = there.value - here.value
    # Path to a sphere about a point h further on is longer by h cos(theta); the chief ray's by h. The sphere's finite
    # radius enters at h^2/R = 5e-12 m.
    assert np.abs(change - (height - height * cosine)).max() < 1e-11


def test_the_mean_reference(lsst_r):
    opd = pachon.wavefront_opd(lsst_r, (0.02, 0.0), 620e-9, grid=32, reference="mean")
    # Rounding of 30 m of path.
    assert abs(opd.value[opd.lit].mean()) < 2e-14
    assert np.abs(opd.landing[opd.lit].mean(axis=0) - opd.center).max() < 1e-15


def test_mirror_symmetry(lsst_r):
    opd = pachon.wavefront_opd(lsst_r, (0.0, 0.02), 620e-9, grid=24)
    # The telescope and the field are symmetric in x: rounding only.
    assert np.nanmax(np.abs(opd.value - opd.value[:, ::-1])) < 1e-13
    assert np.array_equal(opd.lit, opd.lit[:, ::-1])


def test_waves_and_statistics(lsst_r):
    opd = pachon.wavefront_opd(lsst_r, (0.0, 0.02), 620e-9, grid=24)
    lit = opd.value[opd.lit]
    assert np.allclose(opd.waves[opd.lit], lit / 620e-9)
    assert np.isclose(opd.rms, np.sqrt(np.mean((lit - lit.mean()) ** 2)))
    assert np.isclose(opd.peak_to_valley, lit.max() - lit.min())
    assert np.isnan(opd.value[~opd.lit]).all()
    same = pachon.wavefront_opd(lsst_r, (0.0, 0.02) * u.rad, 620 * u.nm, grid=24)
    assert np.array_equal(same.value, opd.value, equal_nan=True)
    assert same.field == opd.field == (0.0, 0.02)
    degrees = pachon.wavefront_opd(lsst_r, (0.0, 1.0) * u.deg, 620e-9, grid=24)
    assert degrees.field == pytest.approx((0.0, np.deg2rad(1.0)))


def test_a_dark_map_has_no_rms(lsst_r):
    # In the shadow of the hole of M1 no light passes at all.
    opd = pachon.wavefront_opd(lsst_r, (0.0, 0.01), 620e-9, ([0.0, 0.5], [0.1, 0.0]))
    assert not opd.lit.any()
    assert np.isnan(opd.rms)
    with pytest.raises(DomainError, match="no light passes"):
        _ = opd.without_tilt


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        (dict(reference="axis"), ConfigError, "chief"),
        (dict(grid=0), DomainError, "grid"),
        (dict(grid=8, pupil=([3.0], [0.0])), ConfigError, "one of them"),
        (dict(grid=8, sphere_radius=1.0), ConfigError, "telescope=replace.telescope, reference_sphere_radius="),
        (dict(grid=8, field=(0.1, 0.0)), DomainError, "2.5 deg"),
        (dict(grid=8, field=[[0.0, 0.0], [0.0, 0.01]]), DomainError, "expected two angles"),
        (dict(grid=8, projection="tan"), ConfigError, "expected one of zemax, gnomonic, postel"),
    ],
)
def test_bad_arguments(lsst_r, change, error, words):
    with pytest.raises(error, match=words):
        pachon.wavefront_opd(lsst_r, **(dict(field=(0.0, 0.0), wavelength=620e-9) | change))


TELECENTRIC = """VERS 190513 30 123457 L123457
MODE SEQ
UNIT MM X W X CM MR CPMM
ENPD 40
FTYP 0 0 1 1 0 0 0
XFLN 0
YFLN 8
WAVM 1 0.55 1
PWAV 1
SURF 0
  TYPE STANDARD
  CURV 0.0
  DISZ INFINITY
SURF 1
  STOP
  TYPE STANDARD
  CURV 0.0
  DISZ {stop!r}
SURF 2
  TYPE STANDARD
  CURV -0.005
  DISZ -100
  GLAS MIRROR 0 0
SURF 3
  TYPE STANDARD
  CURV 0.0
  DISZ 0
"""


def test_the_opd_does_not_jump_where_the_exit_pupil_goes_to_infinity(tmp_path):
    angle = np.arange(40) * 2.4
    radius = 0.0198 * np.sqrt(np.arange(40) / 39)
    pupil = radius * np.cos(angle), radius * np.sin(angle)
    field, waves = (0.0, np.deg2rad(8.0)), {}
    for distance in (9e3, 9.99e3, 1.001e4, 1.1e4, 1e6, np.inf, -1e6, -1.001e4, -9.99e3):
        # Newton: a stop f^2 / distance beyond the front focus of a mirror of f = 100 mm.
        (tmp_path / "mirror.zmx").write_text(TELECENTRIC.format(stop=100.0 + 1e4 / (1e3 * distance)))
        mirror = pachon.load_telescope(tmp_path / "mirror.zmx")
        # The file has a resolution of 1e-14 m in f^2 / distance, of 1e-6 m.
        assert mirror.reference_sphere_radius == pytest.approx(min(abs(distance), 1e4), rel=1e-7)
        opd = pachon.wavefront_opd(mirror, field, 550e-9, pupil)
        rays = pachon.trace(mirror, pachon.launch_rays(mirror, field, 550e-9, pupil))
        # The limit of a plane wave: paths to the foot of the perpendicular from the image point, which the chief ray,
        # the first one, meets.
        away = rays.position - rays.position[0]
        path = rays.path_length - (away * rays.direction).sum(axis=1)
        blur = np.linalg.norm(np.cross(away, rays.direction), axis=1).max()
        # A sphere of R differs by blur^2 / 2R; paths of 1e4 m and back have a rounding of 2e-12 m.
        assert np.abs(opd.value - (path[0] - path)).max() < blur**2 / (2 * 9e3) + 4e-12
        waves[distance] = np.ptp(opd.value) / 550e-9
    assert waves[np.inf] > 10.0
    # The stop moves by 2 um in all, over f = 100 mm.
    assert np.ptp(list(waves.values())) < 1e-4 * waves[np.inf]
    # On a sphere of the focal length it is another wavefront.
    short = (
        np.ptp(pachon.wavefront_opd(replace(mirror, reference_sphere_radius=0.1), field, 550e-9, pupil).value) / 550e-9
    )
    assert abs(short - waves[np.inf]) > 0.1


def test_fits_files_have_the_pixel_scale_that_poppy_reads(lsst_r, tmp_path):
    opd = pachon.wavefront_opd(lsst_r, (0.0, 0.01), 620e-9, grid=32)
    opd.write(tmp_path / "opd.fits")
    with fits.open(tmp_path / "opd.fits") as hdus:
        for name in ("VALUE", "LIT"):
            header = hdus[name].header
            # Points of the grid are pixels of the pupil.
            assert header["PUPLSCAL"] == header["PIXELSCL"] == pytest.approx(opd.x[0, 1] - opd.x[0, 0], rel=1e-12)
            assert (header["PIXUNIT"], header["WAVELEN"]) == ("meter", 620e-9)
        assert hdus["VALUE"].header["BUNIT"] == "m"
        poppy = pytest.importorskip("poppy")
        light, path = (
            fits.PrimaryHDU(np.nan_to_num(hdus[n].data.astype(float)), hdus[n].header) for n in ("LIT", "VALUE")
        )
        optic = poppy.FITSOpticalElement(transmission=fits.HDUList([light]), opd=fits.HDUList([path]))
    assert optic.pixelscale.to_value("m/pix") == pytest.approx(lsst_r.pupil_diameter / 31, rel=0.05)
    assert optic.planetype.name == "pupil"


def test_points_that_are_no_grid_have_no_pixel_scale(lsst_r, tmp_path):
    pachon.wavefront_opd(lsst_r, (0.0, 0.0), 620e-9, pupil=([3.0, 3.1, 3.3], [0.0, 0.1, 0.0])).write(
        tmp_path / "a.fits"
    )
    with fits.open(tmp_path / "a.fits") as hdus:
        assert "PIXELSCL" not in hdus["VALUE"].header
        assert hdus["VALUE"].header["WAVELEN"] == 620e-9


@pytest.mark.long
def test_ticks_of_the_bars_of_zernikes_do_not_overlap():
    """On the axis of HSC the largest term is 86 nm; the linear part of the scale reached to 0.86 nm, beyond a tick."""
    hsc = pachon.load_telescope("hsc")
    opd = pachon.wavefront_opd(hsc, (0.0, 0.0), grid=64)
    figure = opd.plot(fit_zernikes(opd, 0.5 * hsc.pupil_diameter, hsc.pupil_obscuration, 28))
    figure.canvas.draw()
    bars = next(axes for axes in figure.axes if axes.get_yscale() == "symlog")
    low, high = bars.get_window_extent().intervaly
    boxes = sorted((label.get_window_extent() for label in bars.get_yticklabels()), key=lambda box: box.y0)
    boxes = [box for box in boxes if low < 0.5 * (box.y0 + box.y1) < high]
    assert len(boxes) > 3
    assert all(lower.y1 < upper.y0 for lower, upper in pairwise(boxes))
