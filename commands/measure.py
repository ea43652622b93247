"""The command ``pachon measure``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from .interrupt import interruptible
from .options import Json, Quiet, Threads
from .tables import Rows, print_json

app = typer.Typer()

_CAPTION = "Completeness and purity of the stars; magnitude at which half of the objects are found; purity of all."


@app.command("measure")
def measure_command(
    images: Annotated[list[Path], Argument(metavar="IMAGE.fits ...", help="Images of pachon images.")],
    out: Annotated[
        Path | None, Option("--out", "-o", help="Folder of the catalogues; by default that of each.")
    ] = None,
    order: Annotated[int, Option(min=0, max=6, help="Order of the PSF's polynomials over the image.")] = 1,
    min_snr: Annotated[float, Option(help="Least S/N of stars.")] = 30.0,
    threads: Threads = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Detect objects on images, select stars, model the PSF from them, and fit the shapes of galaxies.

    Each image.fits leaves image_galaxies.fits, a table with sky positions, magnitudes and ellipticities before the PSF,
    and image_psf.fits, the PSF model. Simulated images know the truth: completeness and purity are printed.

    **Examples**

    - `pachon measure pachon_images/image_R22_S11.fits`
    - `pachon measure pachon_images/image_*.fits -o catalogues --order 2`
    """
    from ..core.files import make_folder
    from ..core.table_files import write_table
    from ..imaging.image_file import CcdImage
    from ..imaging.measure import measure_image

    if out is not None:
        make_folder(out)
    found = {}
    with (
        interruptible(quiet, "catalogues that are written stay") as reporter,
        reporter.stage(f"objects of {len(images)} images", total=len(images)) as stage,
    ):
        for number, path in enumerate(images, start=1):
            catalogue = measure_image(CcdImage.read(path), order=order, min_snr=min_snr, threads=threads)
            folder = path.parent if out is None else out
            catalogue.psf.write(folder / f"{path.stem}_psf.fits")
            write_table(folder / f"{path.stem}_galaxies.fits", catalogue.table())
            found[path.name] = catalogue.metrics()
            stage.advance()
            stage.step(path.name, number, len(images))
    if as_json:
        print_json({"images": found})
    elif not quiet:
        rows = [
            (
                name,
                str(m["objects"]),
                str(m["stars"]),
                f"{m.get('star_completeness', float('nan')):.2f}, {m.get('star_purity', float('nan')):.2f}",
                str(m.get("magnitude_half_complete", "")),
                f"{m.get('purity', float('nan')):.3f}",
                f"{m['usable_per_arcmin2']:.1f}",
            )
            for name, m in found.items()
        ]
        headings = ("image", "objects", "stars", "complete, pure", "half [mag]", "purity", "usable/arcmin²")
        caption = (
            "Completeness and purity of the stars; magnitude at which half of the objects are found; purity of all."
        )
        Rows(headings, rows, caption).show()
