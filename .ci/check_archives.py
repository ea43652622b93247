"""Check what is in the archives of a release: python .ci/check_archives.py FOLDER, from the root of a checkout."""

import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

#: Largest source archive [byte].
LARGEST_SOURCE = 5_000_000


def wheel_problems(wheel: Path, tracked: list[str]) -> list[str]:
    """Return what a wheel has or lacks against the tracked files of the checkout."""
    layout = tomllib.loads(Path("pyproject.toml").read_text(encoding="utf-8"))["tool"]["hatch"]["build"]
    folders = layout["targets"]["wheel"]["only-include"]
    product = [name for name in tracked if name.split("/")[0] in folders]
    expected = {name if name.startswith("pachon/") else f"pachon/{name}" for name in product}
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    packed = {name for name in names if ".dist-info/" not in name}
    metadata = {name.partition(".dist-info/")[2] for name in names} - {""}
    return [
        *(f"{wheel.name}: lacks {name}" for name in sorted(expected - packed)),
        *(f"{wheel.name}: has {name}, which is not tracked" for name in sorted(packed - expected)),
        *(
            f"{wheel.name}: lacks {name} of its metadata"
            for name in ("METADATA", "RECORD", "entry_points.txt", "licenses/LICENSE")
            if name not in metadata
        ),
    ]


def source_problems(source: Path, tracked: list[str]) -> list[str]:
    """Return what a source archive has or lacks; pictures of the documentation may be left out."""
    with tarfile.open(source) as archive:
        packed = {member.name.partition("/")[2] for member in archive if member.isfile()}
    lacking = {name for name in tracked if not name.startswith("docs/images/")} - packed
    size = source.stat().st_size
    return [
        *(f"{source.name}: lacks {name}" for name in sorted(lacking)),
        *(f"{source.name}: has {name}, which is not tracked" for name in sorted(packed - {*tracked, "PKG-INFO"})),
        *([f"{source.name}: {size} bytes, expected at most {LARGEST_SOURCE}"] if size > LARGEST_SOURCE else []),
    ]


def main(folder: Path) -> int:
    """Print the problems of the one wheel and the one source archive of a folder; return the exit status."""
    tracked = subprocess.run(["git", "ls-files"], capture_output=True, text=True, check=True).stdout.splitlines()
    (wheel,), (source,) = folder.glob("*.whl"), folder.glob("*.tar.gz")
    problems = [*wheel_problems(wheel, tracked), *source_problems(source, tracked)]
    print("\n".join(problems) or f"{wheel.name}, {source.name}: whole, {source.stat().st_size / 1e6:.1f} MB of source")
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
