"""Renames and links as network file systems do them: refused, done twice, or not seen at once; writers that race."""

import errno
import multiprocessing
import os
import shutil

import pytest

from pachon.core import files
from pachon.core.errors import ProductError
from pachon.core.files import make_folder, write_bytes, write_new_bytes
from pachon.core.long_work import claim_folder

#: Errors of renames: a handle that the server no longer has, a file in use, another file system, a lost server.
ERRORS = (errno.ESTALE, errno.EBUSY, errno.EXDEV, errno.EIO, errno.ETIMEDOUT)
#: Writers that race, and files that each writes.
WRITERS = 4
ROUNDS = 60


def failing(number):
    def fail(*_):
        raise OSError(number, os.strerror(number))

    return fail


@pytest.mark.parametrize("number", ERRORS, ids=lambda number: errno.errorcode[number])
def test_a_rename_that_fails_leaves_the_old_file(tmp_path, monkeypatch, number):
    path = tmp_path / "product.fits"
    write_bytes(path, b"old")
    monkeypatch.setattr(files.os, "replace", failing(number))
    with pytest.raises(ProductError) as caught:
        write_bytes(path, b"new")
    assert str(caught.value) == f"cannot write {path}: {os.strerror(number)}"
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == {"product.fits": b"old"}


@pytest.mark.parametrize("number", ERRORS, ids=lambda number: errno.errorcode[number])
def test_a_claim_whose_link_fails_is_made_otherwise_and_once(tmp_path, monkeypatch, number):
    monkeypatch.setattr(files.os, "link", failing(number))
    assert write_new_bytes(tmp_path / "config.yaml", b"first")
    assert not write_new_bytes(tmp_path / "config.yaml", b"second")
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == {"config.yaml": b"first"}


def test_a_rename_whose_answer_is_lost_is_done(tmp_path, monkeypatch):
    replace = os.replace

    def repeated(*names):
        replace(*names)
        replace(*names)

    monkeypatch.setattr(files.os, "replace", repeated)
    write_bytes(tmp_path / "product.fits", b"new")
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == {"product.fits": b"new"}


def test_a_rename_of_a_file_that_is_gone_is_an_error(tmp_path, monkeypatch):
    write_bytes(tmp_path / "product.fits", b"old")

    def gone(partial, path):
        os.unlink(partial)
        failing(errno.ENOENT)()

    monkeypatch.setattr(files.os, "replace", gone)
    with pytest.raises(ProductError, match="No such file"):
        write_bytes(tmp_path / "product.fits", b"new")
    assert (tmp_path / "product.fits").read_bytes() == b"old"


def test_a_claim_whose_answer_is_lost_is_ours(tmp_path, monkeypatch):
    link = os.link

    def repeated(*names):
        link(*names)
        link(*names)

    monkeypatch.setattr(files.os, "link", repeated)
    assert write_new_bytes(tmp_path / "config.yaml", b"ours")
    assert not write_new_bytes(tmp_path / "config.yaml", b"ours too")
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == {"config.yaml": b"ours"}


def test_a_claim_without_links_on_a_full_disk_leaves_no_half_file(tmp_path, monkeypatch):
    monkeypatch.setattr(files.os, "link", failing(errno.EPERM))
    monkeypatch.setattr(files.Path, "read_bytes", failing(errno.ENOSPC))
    with pytest.raises(ProductError, match="No space left"):
        write_new_bytes(tmp_path / "config.yaml", b"first")
    assert os.listdir(tmp_path) == []


def test_a_claim_that_is_not_seen_at_once_is_refused(tmp_path):
    """Products are seen before the configuration of those who write them."""
    (tmp_path / "ccd_1.fits").write_bytes(b"of another")
    with pytest.raises(ProductError, match=r"holds ccd_1.fits but no config.yaml; choose another --out"):
        claim_folder(tmp_path / "config.yaml", b"x", products="*.fits", noun="products", now={}, read=lambda _: {})
    assert os.listdir(tmp_path) == ["ccd_1.fits"]


def _write_often(folder, number, links, won):
    if not links:
        files.os.link = failing(errno.EPERM)
    make_folder(folder)
    for round_number in range(ROUNDS):
        write_bytes(folder / "product", bytes([number]) * 100_000)
        if write_new_bytes(folder / f"claim_{round_number}", bytes([number]) * 100):
            won.put((round_number, number))
    won.put(None)


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="renames over open files")
@pytest.mark.parametrize("links", [True, False], ids=["links", "no links"])
def test_writers_that_race_leave_whole_files_and_one_owner_of_each_claim(tmp_path, links):
    context = multiprocessing.get_context("spawn")
    folder, won = tmp_path / "out", context.Queue()
    processes = [context.Process(target=_write_often, args=(folder, n, links, won)) for n in range(1, WRITERS + 1)]
    for process in processes:
        process.start()
    owners, ended, reads = [], 0, 0
    while ended < WRITERS:
        if (folder / "product").exists():
            data = (folder / "product").read_bytes()
            assert len(data) == 100_000
            assert len(set(data)) == 1
            reads += 1
        while not won.empty():
            word = won.get()
            ended += word is None
            owners += [] if word is None else [word]
    for process in processes:
        process.join()
    assert sorted(number for number, _ in owners) == list(range(ROUNDS))
    for number, owner in owners:
        assert (folder / f"claim_{number}").read_bytes() == bytes([owner]) * 100
    assert not list(folder.glob(".*.partial"))
    assert reads > 0
    shutil.rmtree(folder)
