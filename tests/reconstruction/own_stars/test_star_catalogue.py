import re
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import MaskedColumn, Table

from pachon.core.errors import ProductError
from pachon.reconstruction.own_stars.star_catalogue import load_stars
from pachon.reconstruction.psf_model.model import PsfModel


def stars(count=14):
    rng = np.random.default_rng(1)
    y, x = np.mgrid[:9, :11] - np.array([4, 5])[:, None, None]
    positions = rng.uniform(0.0, 4000.0, (count, 2))
    width = 1.5 + 0.1 * positions[:, 0, None, None] / 4000.0
    return 1e4 * np.exp(-0.5 * (x**2 + y**2) / width**2), positions


def catalogue(path, stamps, positions, names=("x", "y", "stamp"), **more):
    table = Table({names[0]: positions[:, 0], names[1]: positions[:, 1], **more})
    if len(names) > 2:
        table[names[2]] = stamps
    table.write(path, overwrite=True)
    return path


@pytest.mark.parametrize("kind", ["fits", "ecsv"])
def test_tables_give_what_was_put_in(tmp_path, kind):
    stamps, positions = stars()
    found, places = load_stars(catalogue(tmp_path / f"stars.{kind}", stamps, positions))
    assert found.dtype == places.dtype == np.float64
    assert found.dtype.isnative
    np.testing.assert_array_equal(found, stamps)
    np.testing.assert_array_equal(places, positions)
    model = PsfModel.fit(found, places, n_components=2, order=1)
    assert model.draw(2000.0, 2000.0).shape == (9, 11)


def test_names_of_columns(tmp_path):
    stamps, positions = stars()
    path = catalogue(tmp_path / "stars.fits", stamps, positions, ("XPOS", "YPOS", "CUTOUT"))
    np.testing.assert_array_equal(load_stars(path, x="xpos", y="YPOS", stamp="cutout").stamps, stamps)


def test_image_cubes(tmp_path):
    stamps, positions = stars()
    cube = fits.ImageHDU(stamps.astype(np.float32))
    fits.HDUList([fits.PrimaryHDU(), cube]).writeto(tmp_path / "cube.fits")
    path = catalogue(tmp_path / "stars.ecsv", stamps, positions, ("x", "y"))
    found = load_stars(path, images=tmp_path / "cube.fits")
    np.testing.assert_array_equal(found.stamps, stamps.astype(np.float32))
    # In the same file, beside the table.
    table = fits.BinTableHDU(Table({"x": positions[:, 0], "y": positions[:, 1]}))
    fits.HDUList([fits.PrimaryHDU(), table, cube]).writeto(tmp_path / "both.fits")
    np.testing.assert_array_equal(load_stars(tmp_path / "both.fits").stamps, found.stamps)
    fits.HDUList([fits.PrimaryHDU(stamps[:5])]).writeto(tmp_path / "few.fits")
    with pytest.raises(ProductError, match="14 stars in the table, 5 stamps"):
        load_stars(path, images=tmp_path / "few.fits")
    fits.HDUList([fits.PrimaryHDU(stamps[0])]).writeto(tmp_path / "one.fits")
    with pytest.raises(ProductError, match=r"one\.fits: has no image of three axes"):
        load_stars(path, images=tmp_path / "one.fits")


def test_files_that_cannot_be_used(tmp_path):
    stamps, positions = stars()

    def refused(match, path=None, **options):
        with pytest.raises(ProductError, match=match) as caught:
            load_stars(path or tmp_path / "stars.fits", **options)
        assert "\n" not in str(caught.value)

    refused(r"stars\.fits: no such file")
    path = catalogue(tmp_path / "stars.fits", stamps, positions, ("ra", "y"), magnitude=np.zeros(14))
    refused(r"stars\.fits: no column 'x', 'stamp' and no image of three axes; its columns are ra, y, magnitude")
    refused(
        "columns are ra, y, magnitude; looked for x: xwin_image, x_image, .*; looked for stamp: vignet, .*; stamps are"
    )
    refused("no column 'dec'", x="ra", y="dec", stamp="y")
    refused("column 'magnitude' has shape .14,. and type .*, expected an image", x="ra", stamp="magnitude")
    whole = path.read_bytes()
    for end in (40, 2000, len(whole) - 2000):
        path.write_bytes(whole[:end])
        refused(r"stars\.fits: (damaged|cut short)")
    path.write_bytes(b"")
    refused(r"stars\.fits: neither FITS nor ECSV")
    path.write_text("x,y\n1,2\n")
    refused(r"stars\.fits: neither FITS nor ECSV")
    fits.HDUList([fits.PrimaryHDU(stamps)]).writeto(path, overwrite=True)
    refused("has no table, expected one of stars with columns x, y and their stamps, stamp")
    ecsv = catalogue(tmp_path / "stars.ecsv", stamps, positions, ("x", "flux"))
    refused("no column 'y', 'stamp'; its columns are x, flux", ecsv)
    ecsv.write_text("".join(ecsv.read_text().splitlines(keepends=True)[:6]))
    refused(r"stars\.ecsv: damaged or no ECSV", ecsv)


def bad_pixels(count, seed=3):
    bad = np.zeros((count, 9, 11), dtype=bool)
    bad[np.arange(count), np.random.default_rng(seed).integers(0, 9, count), 2] = True
    return bad


@pytest.mark.parametrize("name", ["WEIGHT", "VIGNET_WEIGHT", "VARIANCE", "MASK", "masks", "weights", "wgt", "flagged"])
def test_pixels_without_weight_are_no_numbers(tmp_path, name):
    stamps, positions = stars()
    bad = bad_pixels(len(stamps))
    values = {"VARIANCE": np.where(bad, np.inf, 4.0), "MASK": 8 * bad, "flagged": bad.astype(np.uint8)}
    values |= {"masks": bad, "weights": ~bad}
    column = values.get(name, np.where(bad, 0.0, 0.25))
    options = {"wgt": {"weight": "WGT"}, "flagged": {"mask": "flagged"}}.get(name, {})
    path = catalogue(tmp_path / "stars.fits", stamps, positions, **{name: column})
    np.testing.assert_array_equal(load_stars(path, **options).stamps, np.where(bad, np.nan, stamps))


@pytest.mark.parametrize("ending", ["fits", "ecsv"])
def test_flags_that_are_masked_or_floats_are_read(tmp_path, ending):
    stamps, positions = stars()
    table = Table({"x": positions[:, 0], "y": positions[:, 1], "stamp": stamps})
    flags = np.arange(len(stamps))
    for column, expected in (
        (flags.astype(float), flags),
        (np.where(flags == 2, np.nan, flags), np.where(flags == 2, 0, flags)),
        (flags + 0.5, None),
        *([(MaskedColumn(flags, mask=flags == 2), np.where(flags == 2, 0, flags))] if ending == "ecsv" else []),
    ):
        table["FLAGS"] = column
        table.write(tmp_path / f"stars.{ending}", overwrite=True)
        np.testing.assert_array_equal(load_stars(tmp_path / f"stars.{ending}").flags, expected)


def test_all_stars_in_one_row_as_in_files_of_piff(tmp_path):
    stamps, positions = stars()
    bad = bad_pixels(len(stamps))
    columns = {"IMAGE": stamps, "WEIGHT": np.where(bad, 0.0, 1.0), "X": positions[:, 0], "Y": positions[:, 1]}
    Table({name: values[None] for name, values in columns.items()}).write(tmp_path / "stars.fits")
    loaded, places = load_stars(tmp_path / "stars.fits")
    np.testing.assert_array_equal(loaded, np.where(bad, np.nan, stamps))
    np.testing.assert_array_equal(places, positions)


def test_cubes_of_weights_and_planes_of_masks(tmp_path):
    stamps, positions = stars()
    bad = bad_pixels(len(stamps))
    detected = np.hypot(*(np.mgrid[:9, :11] - np.array([4, 5])[:, None, None])) < 3.0
    masks = (np.where(bad, 1 << 3, 0) | np.where(detected, 1 << 5, 0)).astype(np.int32)
    table = fits.table_to_hdu(Table({"x": positions[:, 0], "y": positions[:, 1]}))
    cubes = [fits.ImageHDU(stamps, name="STAMPS"), fits.ImageHDU(np.where(bad, 0.0, 1.0), name="WEIGHT")]
    fits.HDUList([fits.PrimaryHDU(), cubes[1], cubes[0], table]).writeto(tmp_path / "cubes.fits")
    np.testing.assert_array_equal(load_stars(tmp_path / "cubes.fits").stamps, np.where(bad, np.nan, stamps))
    table = fits.table_to_hdu(Table({"x": positions[:, 0], "y": positions[:, 1], "deblended": stamps, "mask": masks}))
    table.header.update({"MP_CR": 3, "HIERARCH MP_DETECTED": 5})
    fits.HDUList([fits.PrimaryHDU(), table]).writeto(tmp_path / "planes.fits")
    np.testing.assert_array_equal(load_stars(tmp_path / "planes.fits").stamps, np.where(bad, np.nan, stamps))
    table.header["MP_CR"] = "three"
    fits.HDUList([fits.PrimaryHDU(), table]).writeto(tmp_path / "planes.fits", overwrite=True)
    with pytest.raises(ProductError, match=r"planes\.fits: MP_CR = 'three': expected the number of a bit of the mask"):
        load_stars(tmp_path / "planes.fits")


@pytest.mark.parametrize("apart", [False, True])
def test_image_of_masks_has_its_planes_in_its_own_header(tmp_path, apart):
    stamps, positions = stars()
    bad = bad_pixels(len(stamps))
    detected = np.hypot(*(np.mgrid[:9, :11] - np.array([4, 5])[:, None, None])) < 3.0
    masks = fits.ImageHDU((np.where(bad, 1 << 3, 0) | np.where(detected, 1 << 5, 0)).astype(np.int32), name="MASK")
    masks.header.update({"MP_CR": 3, "HIERARCH MP_DETECTED": 5})
    table = fits.table_to_hdu(Table({"x": positions[:, 0], "y": positions[:, 1]}))
    images = [fits.ImageHDU(stamps, name="STAMPS"), masks]
    fits.HDUList([fits.PrimaryHDU(), table, *([] if apart else images)]).writeto(tmp_path / "stars.fits")
    fits.HDUList([fits.PrimaryHDU(), *images]).writeto(tmp_path / "stamps.fits")
    loaded = load_stars(tmp_path / "stars.fits", images=tmp_path / "stamps.fits" if apart else None).stamps
    np.testing.assert_array_equal(loaded, np.where(bad, np.nan, stamps))


def test_files_of_lsst_stamps(tmp_path):
    stamps, _ = stars()
    bad = bad_pixels(len(stamps))
    corners = np.random.default_rng(5).integers(0, 4000, (len(stamps), 2))
    hdus, names = [fits.PrimaryHDU()], ("IMAGE", "MASK", "VARIANCE")
    for i, (stamp, mask, corner) in enumerate(zip(stamps, bad, corners, strict=True), start=1):
        variance = np.where(mask & (i % 2 == 0), np.nan, 9.0)
        bits = np.where(mask & (i % 2 == 1), 1 << 8, 1 << 5).astype(np.int32)
        image, planes, noise = (
            fits.ImageHDU(data, name=name, ver=i) for name, data in zip(names, (stamp, bits, variance), strict=True)
        )
        image.header.update(LTV1=-float(corner[0]), LTV2=-float(corner[1]))
        planes.header["HIERARCH MP_NO_DATA"] = 8
        planes.header["HIERARCH MP_DETECTED"] = 5
        hdus += [image, planes, noise]
    fits.HDUList(hdus).writeto(tmp_path / "stamps.fits")
    loaded, places = load_stars(tmp_path / "stamps.fits")
    np.testing.assert_array_equal(loaded, np.where(bad, np.nan, stamps))
    np.testing.assert_array_equal(places, corners + np.array([5.0, 4.0]))
    del hdus[1].header["LTV1"]
    fits.HDUList(hdus).writeto(tmp_path / "stamps.fits", overwrite=True)
    with pytest.raises(ProductError, match=r"stamps\.fits: IMAGE 1 has LTV1, LTV2 = None, -\d+\.0: expected numbers"):
        load_stars(tmp_path / "stamps.fits")


@pytest.mark.parametrize(
    ("columns", "options", "message"),
    [
        ({"weight": np.zeros((14, 9, 11))}, {}, r"stars\.fits: no pixel of its 14 stamps has weight: weight is zero"),
        ({"weight": np.full((14, 9, 11), -1.0)}, {}, r"stars\.fits: weight holds -1: expected weights of zero or more"),
        (
            {"mask": np.ones((14, 9, 9))},
            {},
            r"stars\.fits: mask has shape \(14, 9, 9\): expected \(14, 9, 11\), that of",
        ),
        ({"weight": np.ones(14)}, {"weight": "weight"}, r"column 'weight' has shape \(14,\) .* expected an image"),
        ({}, {"mask": "flags"}, r"stars\.fits: no column 'flags'; its columns are x, y, stamp"),
    ],
)
def test_weights_that_cannot_be_used(tmp_path, columns, options, message):
    stamps, positions = stars()
    path = catalogue(tmp_path / "stars.fits", stamps, positions, **columns)
    with pytest.raises(ProductError, match=message):
        load_stars(path, **options)


def test_a_place_that_is_no_number_is_named(tmp_path):
    stamps, positions = stars()
    positions[4, 1] = np.nan
    path = catalogue(tmp_path / "stars.fits", stamps, positions)
    with pytest.raises(ProductError, match=r"stars\.fits: x, y of row 5 are [\d.]+, nan: expected numbers"):
        load_stars(path)


def test_the_example_of_the_documentation_runs(tmp_path, monkeypatch):
    rng = np.random.default_rng(2)
    positions = rng.uniform(0.0, 4000.0, (30, 2))
    y, x = np.mgrid[:31, :31] - 15.0
    moved = rng.uniform(-0.5, 0.5, (30, 2, 1, 1))
    width = 1.7 + 0.1 * positions[:, 0, None, None] / 4000.0
    stamps = 1e4 * np.exp(-0.5 * ((x - moved[:, 0]) ** 2 + (y - moved[:, 1]) ** 2) / width**2)
    stamps += rng.normal(0.0, 22.0, stamps.shape) + rng.normal(0.0, 1.0, stamps.shape) * np.sqrt(stamps)
    stamps[3, 4:8, 20] += 5000.0
    catalogue(tmp_path / "my_stars.fits", stamps, positions)
    monkeypatch.chdir(tmp_path)
    page = (Path(__file__).parents[3] / "docs" / "howto" / "psf_models.md").read_text(encoding="utf-8")
    names = {}
    for block in re.findall(r"```python\n(.*?)```", page, flags=re.S):
        exec(compile(block, "psf_models.md", "exec"), names)
    assert names["psf"].shape == (21, 21)
    assert not names["keep"][3]
    y, x = np.mgrid[:21, :21] - 10.0
    truth = np.exp(-0.5 * (x**2 + y**2) / (1.7 + 0.1 * 1024.0 / 4000.0) ** 2)
    # Thirty stars of S/N above 200: two per cent of the peak.
    np.testing.assert_allclose(names["psf"], truth / truth.sum(), atol=0.02 * truth.max() / truth.sum())


def test_stars_of_several_ccds_are_refused(tmp_path):
    """As SExtractor writes for an exposure: those of its first CCD were taken, without a word."""
    stamps, positions = stars()
    table = fits.BinTableHDU(Table({"XWIN_IMAGE": positions[:, 0], "YWIN_IMAGE": positions[:, 1], "VIGNET": stamps}))
    path = tmp_path / "ccds.cat"
    fits.HDUList([fits.PrimaryHDU(), table, table.copy()]).writeto(path)
    with pytest.raises(ProductError, match=r"ccds\.cat: has 2 tables of stars, .* several CCDs: expected that of one"):
        load_stars(path)
