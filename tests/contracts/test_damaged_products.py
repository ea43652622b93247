"""Work that goes on verifies what it keeps: a damaged product is made again, or refused by its name or folder.

``pytest -s -m slow tests/contracts/test_damaged_products.py`` prints the counts, work by work.
"""

import shutil
from collections import Counter

import pytest
from small_work import WORK, content

pytestmark = pytest.mark.slow

#: Work that goes on from files of its own.
RESUMED = [name for name, work in WORK.items() if work.resumes]
#: Files of a kind that are damaged, one after the other.
OF_A_KIND = 1


def truncate(path):
    """Leave the first half."""
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def flip(path):
    """Change a bit in the middle."""
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(data)


DAMAGES = {"truncated": truncate, "flipped": flip, "deleted": lambda path: path.unlink()}


def products(out):
    """Return some files of each kind: of the same suffix and the same beginning of the name."""
    kinds = {}
    for path in sorted(out.rglob("*")):
        if path.is_file() and path.name != "timings.json":
            kinds.setdefault((path.parent, path.suffix, path.name.split("_")[0]), []).append(path.relative_to(out))
    return [path for paths in kinds.values() for path in paths[:OF_A_KIND]]


@pytest.mark.parametrize("name", RESUMED)
def test_no_damaged_product_passes_for_whole(name, tmp_path, capsys):
    work, here = WORK[name], tmp_path / "here"
    here.mkdir()
    work.make(here)
    whole = tmp_path / "out"
    work.begin(here, whole)
    assert work.run(here, whole) == 0
    expected, counts, silent = content(whole), Counter(), []
    kept = tmp_path / "kept"
    shutil.copytree(whole, kept)
    # Of the folder that work begins in, its configuration counts: the other files are those of work before.
    before = {name for name in (content(here / work.start) if work.start else {}) if not name.endswith(".yaml")}
    for product in (path for path in products(kept) if str(path) not in before):
        for damage, spoil in DAMAGES.items():
            shutil.rmtree(whole)
            shutil.copytree(kept, whole)
            spoil(whole / product)
            capsys.readouterr()
            status = work.run(here, whole, resume=True)
            said = capsys.readouterr().err.strip().splitlines()
            if status == 0 and content(whole) == expected:
                counts["made again"] += 1
            elif status == 2 and (product.name in said[-1] or str(whole) in said[-1]):
                counts["refused"] += 1
            else:
                silent.append((str(product), damage, status, said[-1:]))
    with capsys.disabled():
        print(f"\n{name}: {dict(counts)}")
    assert silent == [], "\n".join(map(str, silent))
