"""Commands on light and images of targets: ``illumination``, ``throughput``, ``strehl`` and ``target``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Option

from ...core.errors import ConfigError
from ..options import degrees_pair
from ..tables import FIELD, Column, Rows, range_text
from .command import Outcome, SharedOptions, Study, design_command

if TYPE_CHECKING:
    import numpy as np

    from ...design.analyses.target_image import TargetImage
    from ...design.analyses.throughput import Throughput

_Coatings = Annotated[Path | None, Option(metavar="FILE.yaml", help="Coatings of surfaces and absorption of glasses.")]


@design_command(
    FIELD,
    Column("relative illumination [%]", lambda r: 100 * r.relative, ".3f", subject="The relative illumination"),
    Column("lit part of the pupil [%]", lambda result: 100 * result.lit_fraction, ".3f"),
    caption="By the projected solid angle of the exit pupil; a uniform source.",
)
def illumination(
    shared: SharedOptions,
    rays: Annotated[int, Option(min=16, max=10**6, help="Rays of each field.")] = 2000,
    coatings: _Coatings = None,
) -> Study:
    """Draw the relative illumination of the detector against the field, vignetting included.

    **Examples**

    - `pachon illumination my_lens.zmx`
    - `pachon illumination lsst_v3.3_r --field-deg 0 --field-deg 1.75 --rays 20000`
    """
    from ...design.analyses.illumination import relative_illumination

    return relative_illumination(*shared.first_arguments, coatings=coatings, n_pupil=rays, **shared.trace_options)


@design_command(band=True)
def throughput(shared: SharedOptions, coatings: _Coatings = None) -> Outcome:
    """Draw the throughput against the wavelength: bare or coated surfaces, absorption, vignetting.

    Lens surfaces without a coating reflect after Fresnel; mirrors without one are perfect.

    **Examples**

    - `pachon throughput my_lens.zmx`
    - `pachon throughput lsst_v3.3_r --coatings coatings.yaml --field-deg 0`
    """
    from ...design.analyses.throughput import throughput as compute

    return Outcome(compute(*shared.first_arguments, coatings=coatings, **shared.trace_options), _throughput_rows)


def _throughput_rows(result: Throughput) -> Rows:
    headings = ("wavelength [nm]", *result.field_labels())
    rows = [
        (f"{w * 1e9:.6g}", *(f"{100 * v:.3f}" for v in column))
        for w, column in zip(result.wavelengths, result.value.T, strict=True)
    ]
    caption = f"{result.telescope}: light on the detector over light on the annular pupil [%]."
    verdict = f"The throughput is {range_text(100.0 * result.value, '.3g', '%')} over fields and wavelengths."
    return Rows(headings, rows, caption, left=0, verdict=verdict)


@design_command(
    FIELD,
    Column("rms wavefront [nm]", "rms_wavefront_nm", ".3f"),
    Column("of the rms", "strehl_of_rms", ".4f"),
    Column("of the wavefront", "strehl_of_wavefront", ".4f", subject="The Strehl ratio of the wavefront"),
    Column("of the PSF", lambda result: result.psf, ".4f"),
    caption="Piston and tilt removed; a number for each wavelength; a dash: too steep for the points of the pupil.",
    band=True,
)
def strehl(
    shared: SharedOptions, psf: Annotated[bool, Option("--psf/--no-psf", help="Diffraction images too.")] = True
) -> Study:
    """Compute Strehl ratios from the rms wavefront, from the wavefront, and from the diffraction image.

    **Examples**

    - `pachon strehl my_lens.zmx`
    - `pachon strehl lsst_v3.3_r --across-band 3 --no-psf`
    """
    from ...design.analyses.strehl import strehl as compute

    return compute(*shared.first_arguments, from_psf=psf, **shared.trace_options)


@design_command(band=True)
def target(
    shared: SharedOptions,
    field_deg: Annotated[
        str, Option(metavar="X,Y | R", help="Field angle of the middle of the target [deg], or a distance along +y.")
    ] = "0,0",
    image: Annotated[
        Path | None, Option(metavar="PICTURE", help="Picture to image, .png, in place of bars; its grey values.")
    ] = None,
    width_arcsec: Annotated[
        float | None, Option(min=1e-9, help="Width of the target; 60 Airy radii by default.")
    ] = None,
    bars: Annotated[int, Option(min=1, max=12, help="Bars of each kind.")] = 3,
    rays: Annotated[int, Option(min=1, max=100_000, help="Rays of each pixel of the target.")] = 400,
) -> Outcome:
    """Draw the geometric image of a bar target, or of a small picture.

    **Examples**

    - `pachon target my_lens.zmx`
    - `pachon target lsst_v3.3_r --field-deg 0,1.7 --width-arcsec 20 --bars 5`
    """
    import numpy as np

    from ...core.units import ARCSEC
    from ...design.analyses.target_image import bar_target, target_image

    picture = bar_target(bars=bars) if image is None else _grey(image)
    middle = np.deg2rad(degrees_pair(field_deg, "--field-deg"))
    width = None if width_arcsec is None else width_arcsec * ARCSEC
    result = target_image(
        shared.telescope,
        picture,
        width=width,
        field=middle,
        wavelengths=shared.wavelength,
        n_rays=rays,
        **shared.trace_options,
    )
    return Outcome(result, _target_rows)


def _grey(path: Path) -> np.ndarray:
    """Return a picture as brightness, rows upwards."""
    from matplotlib.image import imread

    from ...core.files import parsing

    with parsing(path, "--image: expected a picture, .png", ConfigError):
        values = imread(path)
    return (values if values.ndim == 2 else values[..., :3].mean(axis=-1))[::-1].astype(float)


def _target_rows(result: TargetImage) -> Rows:
    s = result.summary()
    rows = [
        ("pixel of the target", f"{s['target_pixel_arcsec']:.5g} arcsec"),
        ("pixel of the image", f"{s['pixel_um']:.5g} µm"),
        ("light on the image", f"{100 * s['light_inside']:.3f} %"),
    ]
    light = f"{100 * s['light_inside']:.3f} %"
    verdict = f"The image has {light} of the target's light, on pixels of {s['pixel_um']:.5g} µm."
    return Rows(("metric", "value"), rows, f"{s['telescope']}: diffraction is left out.", verdict=verdict)
