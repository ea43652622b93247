from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.table import MaskedColumn, Table

from pachon.core.errors import DomainError, PachonError, ProductError
from pachon.measure.shapes import measure_shapes
from pachon.reconstruction.focal_plane_psf.model import FocalPlanePsf
from pachon.reconstruction.focal_plane_psf.stars import FocalPlaneStars, noise_per_snr, photon_noise, stars_of

ARCSEC = np.pi / 648000
PIXEL, WEIGHT = 0.2 * ARCSEC, 0.7 * ARCSEC
SIZE = 25


def star():
    """A Moffat star of 0.7 arcsec, sheared, of unit sum."""
    y, x = np.mgrid[:SIZE, :SIZE] - SIZE // 2.0
    image = (1 + (0.95 * x**2 + 1.05 * y**2 - 0.1 * x * y) / 8.0) ** -3.5
    return image / image.sum()


def noisy(electrons, level, n, seed):
    """Stamps of unit sum of stars of so many electrons over a background that is subtracted."""
    rng = np.random.default_rng(seed)
    image = rng.poisson(electrons * star(), (n, SIZE, SIZE)) + rng.normal(0.0, np.sqrt(level), (n, SIZE, SIZE))
    return image / electrons


def scatter(stamps):
    found = measure_shapes(stamps, PIXEL, WEIGHT)
    return np.std([found.e1, found.e2, np.log(found.size)], axis=1)


@pytest.mark.long
@pytest.mark.parametrize(("electrons", "level"), [(2e5, 100.0), (5e4, 1500.0)])
def test_photon_noise_is_the_scatter_of_measured_shapes(electrons, level):
    stamps = noisy(electrons, level, 400, 1)
    found = photon_noise(stamps, np.full(400, electrons), np.full(400, level), PIXEL, WEIGHT)
    assert found.shape == (400, 3)
    # A standard deviation of 400 draws is known to 1 / sqrt(800) = 3.5 %: 10 % is 2.8 sigma.
    np.testing.assert_allclose(found.mean(axis=0), scatter(stamps), rtol=0.1)
    # Four times the electrons and sixteen times the variance of the background leave twice... of the noise only the
    # part of the photons falls: it stays between 1/2 and 1 of what it was.
    more = photon_noise(stamps, np.full(400, 4 * electrons), np.full(400, 16 * level), PIXEL, WEIGHT)
    assert ((more < found) & (more > 0.5 * found)).all()


def test_masked_pixels_count_in_the_noise():
    masks = np.zeros((3, SIZE, SIZE), dtype=bool)
    masks[1, :, : SIZE // 2] = True
    masks[2, :, SIZE // 2] = True
    found = photon_noise(np.repeat(star()[None], 3, axis=0), np.full(3, 1e5), np.full(3, 9.0), PIXEL, WEIGHT, masks)
    np.testing.assert_allclose(found[0], photon_noise(star()[None], np.full(1, 1e5), np.full(1, 9.0), PIXEL, WEIGHT)[0])
    # Without one half of the star half of what is known is left; the middle column is in neither half.
    lost = 1.0 - (found[0] / found[1:]) ** 2
    np.testing.assert_allclose(lost[0] + 0.5 * lost[1], 0.5, rtol=0.02)


@pytest.mark.long
def test_noise_per_snr_is_the_scatter_of_faint_stars():
    electrons, level = 2e4, 2000.0
    stamps = noisy(electrons, level, 400, 2)
    # Signal to noise of PSF photometry in white noise: F sqrt(sum I^2 / V).
    snr = electrons * np.sqrt((star() ** 2).sum() / level)
    found = noise_per_snr(stamps, np.full(400, snr), PIXEL, WEIGHT) / snr
    # 3.5 % of the draws; photons of the star add 5 % to the variance of the brightest pixels (700 to 2000 at most,
    # near the centre, where the derivatives are small).
    np.testing.assert_allclose(found, scatter(stamps), rtol=0.15)


N = 12
RNG = np.random.default_rng(5)
COLUMNS = {
    "ccd": np.array(["R22_S11"] * 7 + ["R22_S12"] * 5),
    "x": RNG.uniform(-0.02, 0.02, N),
    "y": RNG.uniform(-0.02, 0.02, N),
    "e1": RNG.normal(0.0, 0.01, N),
    "e2": RNG.normal(0.0, 0.01, N),
    "size": RNG.uniform(0.25, 0.3, N) * ARCSEC,
    "e1_noise": RNG.uniform(0.001, 0.002, N),
    "e2_noise": RNG.uniform(0.001, 0.002, N),
    "size_noise": RNG.uniform(0.001, 0.002, N),
}


def check(stars, rtol=0.0):
    assert stars.ccd == tuple(COLUMNS["ccd"])
    expected = np.stack([COLUMNS["e1"], COLUMNS["e2"], np.log(COLUMNS["size"])], axis=1)
    noise = np.stack([COLUMNS[f"{n}_noise"] for n in ("e1", "e2", "size")], axis=1)
    # Rounding of a conversion of units where there is one.
    for found, truth in ((stars.x, COLUMNS["x"]), (stars.y, COLUMNS["y"]), (stars.values, expected)):
        np.testing.assert_allclose(found, truth, rtol=rtol)
    np.testing.assert_array_equal(stars.noise, noise)
    assert stars.usable.all()
    assert not stars.pixels


def with_units():
    table = Table(COLUMNS)
    table["x"] = 1e3 * COLUMNS["x"] * u.mm
    table["y"] = 1e6 * COLUMNS["y"] * u.um
    table["size"] = COLUMNS["size"] / ARCSEC * u.arcsec
    return table


def test_mappings_tables_and_arrays_are_the_same():
    check(FocalPlaneStars.from_table(COLUMNS))
    check(FocalPlaneStars.from_table(Table(COLUMNS)))
    check(FocalPlaneStars.from_table(Table(COLUMNS).as_array()))
    check(stars_of(COLUMNS))
    stars = FocalPlaneStars.from_table(COLUMNS)
    assert stars_of(stars) is stars


def test_units_are_honoured():
    check(FocalPlaneStars.from_table(with_units()), rtol=1e-14)


def test_columns_in_upper_case_as_in_the_products_of_a_run():
    table = with_units()
    for name in table.colnames:
        table.rename_column(name, name.upper())
    table["USED"] = np.arange(N) != 3
    table["MAG"] = 20.0
    found = FocalPlaneStars.from_table(table)
    assert len(found) == N - 1
    np.testing.assert_array_equal(found.values[:, 0], np.delete(COLUMNS["e1"], 3))


@pytest.mark.parametrize("name", ["stars.fits", "stars.ecsv"])
def test_files_are_read(tmp_path, name):
    path = tmp_path / name
    with_units().write(path)
    check(FocalPlaneStars.read(path), rtol=1e-14)
    check(stars_of(str(path)), rtol=1e-14)


def test_positions_in_pixels():
    table = Table(COLUMNS)
    table["x"], table["y"] = np.arange(N) * 100.0 * u.pix, np.arange(N) * 50.0 * u.pix
    found = FocalPlaneStars.from_table(table)
    assert found.pixels
    np.testing.assert_array_equal(found.x, 100.0 * np.arange(N))


@pytest.mark.parametrize("name", ["stars.ecsv", "stars.fits"])
@pytest.mark.parametrize("pixels", [False, True])
def test_written_stars_are_read_as_they_were(tmp_path, name, pixels):
    """Pixels had metres as their unit, and e1 and e2 the radians of sizes; the columns were no others' to read."""
    given = replace(FocalPlaneStars.from_table(COLUMNS, weight_fwhm=1.1 * ARCSEC), pixels=pixels)
    given.write(tmp_path / name)
    table = Table.read(tmp_path / name)
    assert [str(table[c].unit or "") for c in ("x", "e1", "size", "size_noise")] == [
        "pix" if pixels else "m",
        "",
        "rad",
        "",
    ]
    read = FocalPlaneStars.read(tmp_path / name)
    assert (read.ccd, read.pixels) == (given.ccd, pixels)
    assert read.weight_fwhm == pytest.approx(given.weight_fwhm, rel=1e-8)
    for key in ("x", "y", "values", "noise"):
        np.testing.assert_allclose(getattr(read, key), getattr(given, key), rtol=1e-15)


def test_another_weight_than_that_of_the_stars_gives_one_clear_line(tmp_path):
    """Shapes under the one were taken for those under the other: sizes were wrong by a fifth."""
    line = r"weight_fwhm = 1\.2 arcsec: expected 0\.7, under which the stars were measured$"
    table = without("e1") | {"snr": np.full(N, 100.0), "stamp": STAMPS}
    stars = FocalPlaneStars.from_table(table, pixel_scale=PIXEL)
    with pytest.raises(DomainError, match=f"^{line}"):
        FocalPlanePsf.fit(stars, camera="lsst", weight_fwhm=1.2 * ARCSEC)
    with pytest.raises(DomainError, match=r"^weight_fwhm = 1\.2 arcsec: expected 0\.9, "):
        stars_of(replace(stars, stamps=None, weight_fwhm=0.9 * ARCSEC), 1.2 * ARCSEC)
    # Tables of shapes need not say theirs.
    assert stars_of(COLUMNS, 1.2 * ARCSEC).weight_fwhm == pytest.approx(1.2 * ARCSEC)
    fits.PrimaryHDU(header=fits.Header({"WFWHM": 0.7})).writeto(tmp_path / "ccd_A.fits")
    with pytest.raises(ProductError, match=rf"ccd_A\.fits: {line}"):
        FocalPlaneStars.read(tmp_path, weight_fwhm=1.2 * u.arcsec)


def test_stamps_are_measured_and_scaled_to_unit_sum():
    columns = {k: COLUMNS[k] for k in ("ccd", "x", "y")} | {"snr": np.full(N, 100.0)}
    stamps = np.stack([(1.0 + i) * star() for i in range(N)])
    truth = measure_shapes(star(), PIXEL, WEIGHT)
    for found in (
        FocalPlaneStars.from_table(columns, stamps=stamps, pixel_scale=PIXEL),
        FocalPlaneStars.from_table(columns | {"stamp": stamps}, pixel_scale=PIXEL),
    ):
        np.testing.assert_allclose(found.stamps.sum(axis=(1, 2)), 1.0, rtol=1e-13)
        # Rounding: the same image but for a factor.
        np.testing.assert_allclose(found.values[:, 0], truth.e1[0], atol=1e-12)
        np.testing.assert_allclose(found.values[:, 2], np.log(truth.size[0]), atol=1e-12)


def test_noise_of_a_signal_to_noise_falls_as_its_inverse():
    columns = {k: COLUMNS[k] for k in ("ccd", "x", "y", "e1", "e2", "size")} | {"snr": 50.0 * 2.0 ** np.arange(N)}
    found = FocalPlaneStars.from_table(columns).noise
    np.testing.assert_allclose(found[0] / found[1:], (2.0 ** np.arange(1, N))[:, None] * np.ones(3), rtol=1e-14)


def test_masked_and_infinite_stars_are_not_usable():
    table = Table(COLUMNS)
    table["e1"] = MaskedColumn(COLUMNS["e1"], mask=np.arange(N) == 2)
    table["size"][4] = -1.0
    table["e2_noise"][5] = 0.0
    table["x"][6] = np.inf
    found = FocalPlaneStars.from_table(table)
    np.testing.assert_array_equal(np.flatnonzero(~found.usable), [2, 4, 5, 6])
    assert len(found.chosen(found.usable)) == N - 4


def without(name):
    return {k: v for k, v in COLUMNS.items() if k != name}


def in_unit(name, unit):
    table = Table(COLUMNS)
    table[name] = COLUMNS[name] * unit
    return table


STAMPS = np.broadcast_to(star(), (N, SIZE, SIZE))


@pytest.mark.parametrize(
    ("bad", "options", "words"),
    [
        *((without(name), {}, [name]) for name in COLUMNS),
        (in_unit("x", u.s), {}, ["x", "s", "m"]),
        (in_unit("y", u.pix), {}, ["x and y", "both in pixels"]),
        (in_unit("size", u.m), {}, ["size", "rad"]),
        (COLUMNS | {"x": ["a"] * N}, {}, ["x", "numbers"]),
        (COLUMNS | {"y": np.zeros((N, 2))}, {}, ["y", str((N, 2))]),
        (COLUMNS, {"stamps": STAMPS}, ["pixel_scale"]),
        (COLUMNS, {"stamps": STAMPS[:5], "pixel_scale": PIXEL}, ["5", "12"]),
        (COLUMNS, {"stamps": STAMPS.reshape(N, -1), "pixel_scale": PIXEL}, ["stamps", str((N, SIZE * SIZE))]),
        (COLUMNS, {"stamps": STAMPS[:, :, 1:], "pixel_scale": PIXEL}, ["stamps", str((N, SIZE, SIZE - 1))]),
        (COLUMNS | {"stamp": ["R22"] * N}, {"pixel_scale": PIXEL}, ["stamps", "numbers"]),
        ({}, {}, ["ccd"]),
        (17, {}, ["int"]),
    ],
)
def test_bad_tables_give_one_clear_line(bad, options, words):
    with pytest.raises(DomainError) as raised:
        FocalPlaneStars.from_table(bad, **options)
    text = str(raised.value)
    assert "\n" not in text
    for word in words:
        assert word in text


@pytest.mark.parametrize(
    "bad",
    [
        COLUMNS | {"y": np.zeros(N - 1)},
        COLUMNS | {"e1": np.zeros(N + 3)},
        COLUMNS | {"ccd": COLUMNS["ccd"][:4]},
        COLUMNS | {"used": np.ones(N - 2, dtype=bool)},
    ],
    ids=["y", "e1", "ccd", "used"],
)
def test_columns_of_different_lengths_give_one_clear_line(bad):
    with pytest.raises(PachonError) as raised:
        FocalPlaneStars.from_table(bad)
    assert "\n" not in str(raised.value)


def test_no_stars_and_only_nan_stars_give_one_clear_line():
    nothing = {k: v[:0] for k, v in COLUMNS.items()}
    for bad in (nothing, COLUMNS | {"e1": np.full(N, np.nan)}):
        with pytest.raises(DomainError, match=r"^0 of ") as raised:
            FocalPlanePsf.fit(bad, camera="lsst")
        assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    "name",
    [
        "notes.ecsv",
        "short.fits",
        "lacks.ecsv",
        "none.fits",
        "folder",
    ],
)
def test_bad_files_give_one_clear_line_with_their_name(tmp_path, name):
    (tmp_path / "notes.ecsv").write_text("no table\n")
    (tmp_path / "short.fits").write_bytes(b"SIMPLE  =")
    (tmp_path / "folder").mkdir()
    Table(without("x")).write(tmp_path / "lacks.ecsv")
    with pytest.raises(ProductError) as raised:
        FocalPlaneStars.read(tmp_path / name)
    assert "\n" not in str(raised.value)
    assert name in str(raised.value)


def test_noise_of_wide_stamps_needs_little_memory(monkeypatch):
    """All pixels were changed at once: 8 GB of stamps of 181 pixels."""
    counts, wide = [], np.pad(star(), 12)

    def counted(images, *arguments):
        counts.append(len(images))
        return measure_shapes(images, *arguments)

    monkeypatch.setattr("pachon.reconstruction.focal_plane_psf.stars.measure_shapes", counted)
    found, narrow = (photon_noise(i[None], np.full(1, 1e5), np.full(1, 9.0), PIXEL, WEIGHT) for i in (wide, star()))
    # Beyond the narrow stamp the weight is 1e-7.
    np.testing.assert_allclose(found, narrow, rtol=1e-5)
    assert sum(counts) == wide.size + star().size + 2
    assert max(counts) <= 1024
