"""Products: whole or absent, the same bytes for the same content, refused when damaged."""

import errno
import io
import json
import os

import numpy as np
import pytest
from astropy.io import fits

from pachon.core import files as products
from pachon.core.errors import ProductError
from pachon.core.files import json_text, read_arrays, write_bytes
from pachon.core.products import Stamp, column, image_hdu, read_fits, table_hdu, write_fits, write_hdus

STAMP = Stamp("ab" * 32, 7, "1.2.3")


def write_example(path, stamp=STAMP):
    rng = np.random.default_rng(1)
    table = table_hdu(
        "STARS",
        {
            "X": (rng.normal(size=5), "mm", "where"),
            "N": (np.arange(5), "", "which"),
            "OK": (np.array([True, False, True, True, False]), "", "whether"),
        },
    )
    image = image_hdu("STAMPS", rng.normal(size=(2, 3, 4)), "what it is")
    write_fits(path, [table, image], stamp, [("CCD", "R22_S11", "name")])


def test_a_product_reads_back_with_its_stamp_units_and_numbers(tmp_path):
    path = tmp_path / "a.fits"
    write_example(path)
    hdus = read_fits(path)
    rng = np.random.default_rng(1)
    assert np.array_equal(column(hdus["STARS"], "X"), rng.normal(size=5))
    assert hdus["STARS"].columns["X"].unit == "mm"
    assert column(hdus["STARS"], "OK").tolist() == [True, False, True, True, False]
    # Images are kept in single precision.
    assert np.array_equal(hdus["STAMPS"].data, rng.normal(size=(2, 3, 4)).astype(np.float32))
    assert hdus[0].header["CCD"] == "R22_S11"
    assert STAMP.matches(hdus[0].header)
    assert not Stamp("cd" * 32, 7, "1.2.3").matches(hdus[0].header)
    assert not Stamp("ab" * 32, 7, "1.2.4").matches(hdus[0].header)


def test_the_same_content_gives_the_same_bytes_and_standard_checksums(tmp_path):
    write_example(tmp_path / "a.fits")
    write_example(tmp_path / "b.fits")
    data = (tmp_path / "a.fits").read_bytes()
    assert data == (tmp_path / "b.fits").read_bytes()
    # astropy's own check of CHECKSUM and DATASUM warns where one is wrong, and warnings are errors here.
    with fits.open(tmp_path / "a.fits", checksum=True) as hdus:
        assert all("DATASUM" in hdu.header for hdu in hdus)


def test_a_product_written_again_keeps_its_bytes_and_a_changed_one_its_checksums(tmp_path):
    path = tmp_path / "a.fits"
    write_example(path)
    write_hdus(tmp_path / "again.fits", read_fits(path))
    assert (tmp_path / "again.fits").read_bytes() == path.read_bytes()
    hdus = read_fits(path)
    hdus[0].header["CCD"] = "R22_S12"
    write_hdus(path, hdus)
    assert read_fits(path)[0].header["CCD"] == "R22_S12"


@pytest.mark.parametrize("where", [100, 3000, -2000])
def test_one_changed_byte_is_noticed(tmp_path, where):
    path = tmp_path / "a.fits"
    write_example(path)
    data = bytearray(path.read_bytes())
    data[where] ^= 1
    path.write_bytes(data)
    with pytest.raises(ProductError, match=r"a\.fits"):
        read_fits(path)


@pytest.mark.parametrize("keep", [0, 10, 2880, 5000])
def test_a_file_cut_short_is_noticed(tmp_path, keep):
    path = tmp_path / "a.fits"
    write_example(path)
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(ProductError, match=r"a\.fits"):
        read_fits(path)


def test_a_full_disk_is_one_line_and_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "a.json"
    write_bytes(path, b"old")

    def no_space(descriptor):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(products.os, "fsync", no_space)
    with pytest.raises(ProductError, match=r"^cannot write .*a\.json: No space left on device$"):
        write_bytes(path, b"new and longer")
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]


def test_an_interrupted_write_leaves_nothing_new(tmp_path, monkeypatch):
    def interrupt(descriptor):
        raise KeyboardInterrupt

    monkeypatch.setattr(products.os, "fsync", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_bytes(tmp_path / "a.json", b"new")
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_not_there_is_named(tmp_path):
    with pytest.raises(ProductError, match="No such file or directory"):
        write_bytes(tmp_path / "none" / "a.json", b"new")


def test_json_has_plain_numbers_and_null_for_what_is_none():
    text = json_text({"b": np.float64("nan"), "a": np.arange(2), "c": np.float32(0.5), "d": (True, None)})
    assert json.loads(text) == {"a": [0, 1], "b": None, "c": 0.5, "d": [True, None]}
    assert text.index('"a"') < text.index('"b"')


@pytest.mark.parametrize("seed", range(40))
def test_arrays_of_a_damaged_file_are_refused_in_one_line(tmp_path, seed):
    content = io.BytesIO()
    np.savez(content, first=np.arange(300.0), second=np.array("text"))
    whole = content.getvalue()
    path = tmp_path / "arrays.npz"
    path.write_bytes(whole)
    arrays = read_arrays(path, "damaged", ProductError)
    np.testing.assert_array_equal(arrays["first"], np.arange(300.0))
    rng = np.random.default_rng(seed)
    data = bytearray(whole)
    if seed % 2:
        for place in rng.integers(0, len(data), 1 + seed // 8):
            data[place] ^= 1 << rng.integers(8)
    else:
        del data[int(rng.integers(len(data))) :]
    path.write_bytes(bytes(data))
    try:
        after = read_arrays(path, "damaged", ProductError)
    except ProductError as error:
        said, after = str(error), {}
    else:
        said = f"{path}: damaged ("
    assert said.startswith(f"{path}: damaged (")
    assert len(said.splitlines()) == 1
    # A flipped bit of a date or of a name that nobody asks for: what is there is what was written.
    assert all(np.array_equal(v, arrays[k]) for k, v in after.items() if k in arrays)


def test_json_keeps_the_digits_of_a_configuration():
    """Nine digits of a date, as results have, are 9 s."""
    settings = {"visit": {"mid_mjd": 61001.15034567}, "pointing": [211.123456789012]}
    content = json.loads(json_text({"configuration": settings, "fwhm": 61001.15034567}))
    assert content == {"configuration": settings, "fwhm": 61001.1503}
