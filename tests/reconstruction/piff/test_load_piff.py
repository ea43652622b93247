"""Piff's files: drawn as Piff draws them, without Piff and without pickle; what is unknown is named."""

import pickle
import sys
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS

import pachon
from pachon.core.errors import DomainError, PachonError, ProductError
from pachon.reconstruction.piff.given_world import GivenWorld
from pachon.reconstruction.piff.profiles import Gaussian, Kolmogorov, Moffat, lanczos
from pachon.reconstruction.piff.world import StarWorld

DATA = Path(__file__).parents[2] / "data" / "piff"
DES = Path(__file__).parents[4] / "shared/data/real/D00232418_i_c19_r5006p01_piff-model.fits"
#: Largest difference from what Piff draws, as a fraction of the peak. GalSim convolves profiles with pixels by
#: FFT, and stores the Gaussian of no pixel as it is; the WCS of chips of the sky is a polynomial through 16 stars here.
TOLERANCES = {"grid_color": 1e-12, "grid_chips": 1e-6, "moffat": 1e-5, "kolmogorov": 1e-5, "gaussian": 1e-12}


def expected(name):
    with fits.open(DATA / f"{name}.fits") as hdus:
        return hdus[0].data.astype(np.float64), hdus[1].data


@pytest.mark.parametrize("name", TOLERANCES)
def test_images_are_those_of_piff(name, monkeypatch):
    # The files hold a pickled WCS: nothing may decode it.
    monkeypatch.setattr(pickle, "loads", None)
    monkeypatch.setitem(sys.modules, "piff", None)
    psf = pachon.load_piff(DATA / f"{name}.piff")
    images, table = expected(name)
    for i, row in enumerate(table):
        properties = {key: [row[key]] for key in psf.property_names}
        drawn = psf.at([[row["x"], row["y"]]], chip=int(row["chip"]), size=11, properties=properties)[0]
        assert np.abs(drawn - images[i]).max() < TOLERANCES[name] * images[i].max()
    assert psf.property_names == (("ri_color",) if name == "grid_color" else ())


def test_stars_of_the_fit_are_told_from_reserved_ones():
    psf = pachon.load_piff(DATA / "grid_chips.piff")
    assert list(psf.chips) == [1, 2]
    assert [int((psf.stars["chip"] == n).sum()) for n in (1, 2)] == [16, 16]
    assert int((~psf.stars["used"]).sum()) == 4
    assert repr(psf) == "<PiffPsf: 2 chips, 28 of 32 stars used, Piff 1.7.0>"


def test_draw_is_one_of_at():
    psf = pachon.load_piff(DATA / "moffat.piff")
    assert np.array_equal(psf.draw(100.0, 200.0, size=9), psf.at([[100.0, 200.0]], size=9)[0])
    assert psf.at(np.empty((0, 2)), size=9).shape == (0, 9, 9)


def test_a_lanczos_function_keeps_constants_constant():
    x = np.linspace(-0.5, 0.5, 21)
    for n in (3, 5, 7):
        total = sum(lanczos(x - k, n, conserve=True) for k in range(-n, n + 1))
        plain = sum(lanczos(x - k, n, conserve=False) for k in range(-n, n + 1))
        # What is left are harmonics above the fifth (1e-7 to 5e-6), of deviations without it of 5e-4 to 6e-3.
        assert np.abs(total - 1.0).max() < 0.003 * np.abs(plain - 1.0).max()


@pytest.mark.parametrize("profile", [Gaussian(True, False, True), Moffat(True, False, True, beta=2.5)])
def test_profiles_have_unit_flux_and_the_moments_of_their_shear(profile):
    jacobian = np.array([[0.2, 0.02], [-0.01, 0.21]])
    image = profile.draw(np.array([0.6, 0.2, -0.1]), jacobian, 121)
    y, x = np.indices(image.shape) - 60
    u, v = (jacobian @ np.stack([x.ravel(), y.ravel()])).reshape(2, *image.shape)
    if isinstance(profile, Moffat):
        # (1 + r^2/a^2)^-1.5 of the light lies beyond r; r = 12 arcsec, along an ellipse of axes 1.25 to 0.8.
        assert 1.0 - image.sum() == pytest.approx((1 + (12.0 / 0.6) ** 2 * 0.587) ** -1.5, rel=0.35)
        return
    assert image.sum() == pytest.approx(1.0, abs=1e-9)
    # A Gaussian of sigma 0.6 sheared by S has covariance 0.36 S S^T; the pixel adds a twelfth of its square.
    shear = np.array([[1.2, -0.1], [-0.1, 0.8]]) / np.sqrt(1 - 0.05)
    covariance = 0.36 * shear @ shear.T + jacobian @ jacobian.T / 12.0
    found = [[(image * a * b).sum() for b in (u, v)] for a in (u, v)]
    assert np.allclose(found, covariance, rtol=1e-8)


def test_a_kolmogorov_profile_holds_half_of_its_light_in_its_half_light_radius():
    profile = Kolmogorov(True, False, False)
    nodes, weights = np.polynomial.legendre.leggauss(60)
    inner, outer = 0.5 * (nodes + 1.0), 1.0 + 14.5 * (nodes + 1.0)
    light = [
        scale * float((weights * 2.0 * np.pi * r * profile.brightness(r**2)).sum())
        for scale, r in ((0.5, inner), (14.5, outer))
    ]
    assert light[0] == pytest.approx(0.5, abs=1e-9)
    # Beyond 30 radii r^(-11/3) leaves 2 pi I(30) 30^2 (3/5).
    beyond = 2.0 * np.pi * 900.0 * 0.6 * float(profile.brightness(np.array([900.0]))[0])
    assert sum(light) + beyond == pytest.approx(1.0, abs=1e-5)


class FewStars:
    """Stand-in for the tables of a file: stars of a curved world."""

    path = Path("few.piff")

    def __init__(self, n, noise=0.0):
        rng = np.random.default_rng(n)
        x, y = rng.uniform(0.0, 4000.0, (2, n))
        x, y = x - 0.0, y - 0.0
        bend = 1e-7
        self.columns = {
            "x": x,
            "y": y,
            "u": 0.2 * (x + bend * x**2 * y / 4000.0),
            "v": 0.2 * y,
            "dudx": 0.2 * (1.0 + 2.0 * bend * x * y / 4000.0),
            "dudy": 0.2 * bend * x**2 / 4000.0,
            "dvdx": np.zeros(n),
            "dvdy": 0.2 + noise * rng.normal(size=n),
        }

    def table(self, name):
        return type("Table", (), {"names": list(self.columns)})

    def column(self, name, column):
        return self.columns[column]

    def error(self, text):
        return ProductError(text, file="few.piff")


def test_world_coordinates_follow_the_stars():
    world = StarWorld.fit(FewStars(30), None)
    assert (world.order, world.error < 1e-10) == (3, True)
    field, jacobian = world.at(np.array([[1234.0, 3210.0]]))
    assert field[0, 0] == pytest.approx(0.2 * (1234.0 + 1e-7 * 1234.0**2 * 3210.0 / 4000.0), rel=1e-10)
    assert jacobian[0, 0, 0] == pytest.approx(0.2 * (1.0 + 2e-7 * 1234.0 * 3210.0 / 4000.0), rel=1e-10)


def test_too_few_stars_have_no_world_coordinates():
    with pytest.raises(ProductError, match=r"few\.piff: 5 stars, which have the world coordinates: expected at least"):
        StarWorld.fit(FewStars(5), None)
    with pytest.raises(ProductError, match=r"its 12 stars have the world coordinates with errors of 0\.\d+: expected"):
        StarWorld.fit(FewStars(12, noise=0.01), None)


def test_small_scale_structure_of_world_coordinates_is_told():
    with pytest.warns(pachon.errors.WcsWarning, match=r"few\.piff: world coordinates with errors of .* %, and so"):
        world = StarWorld.fit(FewStars(60, noise=2e-4), None)
    # A scatter of 0.1 % of the scale, the largest of sixty and the error of the fit itself.
    assert 0.002 < world.error < 0.02


def given_wcs():
    """A TAN projection about (150, 2) degrees, and the chip of a file in its tangent plane."""
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    wcs.wcs.crval, wcs.wcs.crpix = [150.0, 2.0], [-3000.0, 1500.0]
    wcs.wcs.cd = np.array([[-7.3e-5, 1e-6], [2e-6, 7.3e-5]])
    stars = FewStars(20)
    x, y = stars.columns["x"], stars.columns["y"]
    # The pointing is elsewhere than the reference of the WCS: GalSim's projection about it is the oracle.
    return wcs, stars, x, y


def test_world_coordinates_that_are_given():
    galsim = pytest.importorskip("galsim")
    wcs, stars, x, y = given_wcs()
    pointing = galsim.CelestialCoord(150.4 * galsim.degrees, 1.7 * galsim.degrees)
    theirs = galsim.AstropyWCS(wcs=wcs)

    def project(x, y):
        u, v = pointing.project(theirs.toWorld(galsim.PositionD(x, y)))
        return u / galsim.arcsec, v / galsim.arcsec

    stars.columns["u"], stars.columns["v"] = np.array([project(*place) for place in zip(x, y, strict=True)]).T
    world = GivenWorld.fit(stars, None, wcs)
    assert world.error < 1e-6
    assert np.rad2deg(world.pointing) == pytest.approx([150.4, 1.7], abs=1e-8)
    field, jacobian = world.at(np.array([[1234.0, 321.0]]))
    assert field[0] == pytest.approx(project(1234.0, 321.0), abs=1e-6)
    expected_jacobian = np.array(
        [
            (np.array(project(1234.0 + dx, 321.0 + dy)) - project(1234.0 - dx, 321.0 - dy)) / 2e-2
            for dx, dy in ((1e-2, 0.0), (0.0, 1e-2))
        ]
    ).T
    # The quotient of the oracle has the rounding of u and v over its step.
    assert jacobian[0] == pytest.approx(expected_jacobian, abs=1e-7)
    stars.columns["u"] = stars.columns["u"] + 30.0 * np.arange(20)
    with pytest.raises(ProductError, match=r"few\.piff: wcs: puts stars \d+ arcsec from their u, v in the file"):
        GivenWorld.fit(stars, None, wcs)


@pytest.mark.parametrize(("ra", "dec"), [(0.0, -30.0), (0.0, 0.0), (359.9, 60.0), (120.0, 89.0)])
def test_given_world_coordinates_where_right_ascension_begins(ra, dec):
    """The mean of right ascensions on both sides of zero lies on the other side of the sky: images were refused."""
    wcs, tangent = WCS(naxis=2), WCS(naxis=2)
    for projection, at in ((wcs, (ra, dec)), (tangent, (ra + 0.02, dec + 0.01))):
        projection.wcs.ctype, projection.wcs.crval = ["RA---TAN", "DEC--TAN"], at
    wcs.wcs.crpix, wcs.wcs.cd = [2000.0, 2000.0], np.array([[-7.3e-5, 1e-6], [2e-6, 7.3e-5]])
    # Pixels of a TAN projection about the pointing, of an arcsecond, are u and v.
    tangent.wcs.cd = np.diag([-1.0, 1.0]) / 3600.0
    stars = FewStars(20)
    sky = wcs.pixel_to_world_values(stars.columns["x"] - 1.0, stars.columns["y"] - 1.0)
    stars.columns["u"], stars.columns["v"] = np.array(tangent.world_to_pixel_values(*sky)) + 1.0
    world = GivenWorld.fit(stars, None, wcs)
    assert world.error < 1e-6
    difference = np.rad2deg(world.pointing) - tangent.wcs.crval
    assert (difference[0] + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=1e-8 / np.cos(np.deg2rad(dec)))
    assert difference[1] == pytest.approx(0.0, abs=1e-8)


def test_chips_without_a_given_wcs_are_named():
    with pytest.raises(DomainError, match="wcs has chips 7: expected chip 1 of the file too"):
        pachon.load_piff(DATA / "grid_chips.piff", wcs={7: given_wcs()[0]})


def test_the_format_of_old_files_is_named(tmp_path):
    """A DES model of 2018 has three parameters less than pixels."""
    with fits.open(DATA / "grid_chips.piff") as hdus:
        for name in ("psf_1_interp_solution", "psf_2_interp_solution"):
            hdus[name] = fits.BinTableHDU(hdus[name].data[3:], name=name)
        hdus.writeto(tmp_path / "old.piff")
    with pytest.raises(ProductError, match=r"old\.piff: an old format: its PixelGrid of \d+ x \d+ pixels has"):
        pachon.load_piff(tmp_path / "old.piff")


@pytest.mark.skipif(not DES.exists(), reason="no DES model")
@pytest.mark.filterwarnings("error")
def test_a_model_of_des_has_the_error_of_its_world_coordinates_said():
    with pytest.warns(
        pachon.errors.WcsWarning, match=r"piff-model\.fits: world coordinates .* errors of 0\.4 %, and so"
    ):
        psf = pachon.load_piff(DES)
    assert psf.draw(1000.0, 2000.0).sum() == pytest.approx(1.0, abs=0.02)


@pytest.mark.slow
@pytest.mark.skipif(not DES.exists(), reason="no DES model")
@pytest.mark.filterwarnings("ignore::pachon.errors.WcsWarning")
def test_a_model_of_des_is_within_half_a_percent_of_piff():
    """Piff draws each star with the Jacobian and the place that the file has for it: its WCS needs pixmappy."""
    # The folder of these tests passes for an empty package of that name.
    pytest.importorskip("piff.simplepsf")
    import piff

    galsim = pytest.importorskip("galsim")
    psf = pachon.load_piff(DES)
    with fits.open(DES) as hdus:
        stars, q = hdus["psf_stars"].data, np.array(hdus["psf_interp_solution"].data["q"][0])
    theirs = piff.SimplePSF(piff.PixelGrid(0.3, 17, interp=galsim.Lanczos(3)), piff.BasisPolynomial(3))
    theirs.interp.q = q.reshape(289, -1)
    for row in stars[::5]:
        wcs = galsim.JacobianWCS(*(row[name] for name in ("dudx", "dudy", "dvdx", "dvdy")))
        place = {"x": round(row["x"]), "y": round(row["y"]), "u": row["u"], "v": row["v"]}
        star = theirs.interp.interpolate(piff.Star.makeTarget(wcs=wcs, stamp_size=25, **place))
        image = theirs.model.draw(star).image.array
        ours = psf.draw(place["x"], place["y"], size=25)
        ours, image = ours / ours.sum(), image / image.sum()
        assert np.abs(ours - image).max() < 0.005 * image.max()


def changed(tmp_path, name, table, column, value):
    """A bundled file with another value in a table."""
    path = tmp_path / "changed.piff"
    with fits.open(DATA / f"{name}.piff") as hdus:
        columns = fits.ColDefs(
            [
                fits.Column(c.name, f"{len(value)}A", array=[value]) if c.name == column else c
                for c in hdus[table].columns
            ]
        )
        hdus[table] = fits.BinTableHDU.from_columns(columns, name=table)
        hdus.writeto(path)
    return path


@pytest.mark.parametrize(
    ("name", "table", "column", "value", "text"),
    [
        ("moffat", "psf", "type", "Sum", "type = Sum: expected one of Simple, SingleChip"),
        (
            "moffat",
            "psf_model",
            "type",
            "Optical",
            "model = Optical: expected one of PixelGrid, Gaussian, Moffat, Kolm",
        ),
        ("moffat", "psf_interp", "type", "GP", "interp = GP: expected one of BasisPolynomial, Polynomial, Mean"),
        ("grid_color", "psf_model", "interp", "galsim.Quintic()", "model interp = galsim.Quintic(): expected Lanczos"),
        ("moffat", "psf_model", "type", "Gaussian", None),
        ("gaussian", "psf_model", "type", "PixelGrid", "model size = None: expected a whole number"),
        ("moffat", "psf_interp", "poly_type", "bessel", "interp poly_type = bessel: expected one of poly, chebyshev"),
    ],
)
def test_what_is_unknown_is_named(tmp_path, name, table, column, value, text):
    path = changed(tmp_path, name, table, column, value)
    if text is None:
        assert pachon.load_piff(path).draw(1.0, 1.0).shape == (25, 25)
        return
    with pytest.raises(ProductError) as error:
        pachon.load_piff(path)
    assert str(path) in str(error.value)
    assert text in str(error.value)


def test_other_files_are_refused(tmp_path):
    (tmp_path / "old.piff").write_bytes(pickle.dumps({"psf": 1}))
    (tmp_path / "text.piff").write_text("psf")
    fits.HDUList([fits.PrimaryHDU()]).writeto(tmp_path / "empty.piff")
    for name, text in (
        ("old.piff", "a pickle, which is never read"),
        ("text.piff", "damaged or no FITS file of Piff"),
        ("empty.piff", "no table psf: expected a file that Piff 1.4 or later wrote"),
        ("none.piff", "no such file"),
    ):
        with pytest.raises(PachonError, match=text):
            pachon.load_piff(tmp_path / name)


def test_wrong_places_chips_and_properties_are_named():
    chips, color = (pachon.load_piff(DATA / f"{name}.piff") for name in ("grid_chips", "grid_color"))
    with pytest.raises(DomainError, match="chip = None: expected one of 1, 2"):
        chips.draw(1.0, 1.0)
    with pytest.raises(DomainError, match="chip = 3: expected one of 1, 2"):
        chips.draw(1.0, 1.0, chip=3)
    with pytest.raises(DomainError, match="properties: expected values of ri_color"):
        color.draw(1.0, 1.0)
    with pytest.raises(DomainError, match=r"properties\['ri_color'\] has shape \(2,\): expected \[1\]"):
        color.at([[1.0, 1.0]], properties={"ri_color": [1.0, 2.0]})


@pytest.mark.slow
def test_fresh_files_of_piff_are_read_too(tmp_path):
    pytest.importorskip("piff.simplepsf")
    sys.path.insert(0, str(Path(__file__).parents[2] / "peers"))
    from piff_files import PLACES, write_files

    write_files(tmp_path)
    import piff

    for name in ("grid_chips", "gaussian"):
        ours, theirs = pachon.load_piff(tmp_path / f"{name}.piff"), piff.read(str(tmp_path / f"{name}.piff"))
        for chip in ours.chips:
            for x, y in PLACES:
                image = theirs.draw(x, y, chipnum=chip, center=True, stamp_size=15).array
                assert np.abs(ours.draw(x, y, chip=chip, size=15) - image).max() < 1e-6 * image.max()
