"""Options that commands share, and the values in their texts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

from typer import Argument, Option

from ..core.errors import ConfigError
from . import completion
from .choices import choice, names

if TYPE_CHECKING:
    import numpy as np

    from ..models.telescope import Telescope
    from ..reconstruction.psf_model.recipe import Recipe as PsfRecipe
    from ..reconstruction.psf_model.recipe import RecipeName


def set_option(kind: str) -> Any:
    """Return the option `--set`, for the keys of a kind of configuration."""
    return names(
        completion.key_values(kind),
        "--set",
        metavar="KEY=VALUE",
        help=f"Value of a key of the configuration, once for each. `pachon config {kind}` explains all keys.",
    )


def yaml_file(metavar: str, help: str, **settings: Any) -> Any:
    """Return an option, or argument by ``kind=Argument``, whose value is a YAML file; shells complete its name."""
    return names(completion.files(*completion.YAML), metavar=metavar, help=help, **settings)


def ccd_list(help: str) -> Any:
    """Return an option whose value is names of CCDs with commas; shells complete each."""
    return names(completion.ccds, listed=True, metavar="CCD,...", help=help)


#: Words of options that several commands have.
BANDS = ("u", "g", "r", "i", "z", "y")
PROJECTIONS = ("zemax", "gnomonic", "postel")
Config = Annotated[Path | None, yaml_file("CONFIG.yaml", "Configuration; all has a default.", kind=Argument)]
Settings = Annotated[list[str] | None, set_option("run")]
Ccds = Annotated[str | None, ccd_list("CCDs, separated by commas: R22_S11,R22_S12.")]
Raft = Annotated[
    str | None, names(completion.rafts, listed=True, metavar="RAFT,...", help="All CCDs of rafts: R22 or R22,R23.")
]
AllCcds = Annotated[bool, Option("--all", help="All CCDs of the camera.")]
TruthStars = Annotated[int | None, Option(help="Noise-free PSFs on each CCD.")]
ObservedStars = Annotated[int | None, Option(help="Observed stars on each CCD.")]
Model = Annotated[
    str,
    names(
        completion.models,
        metavar="MODEL",
        help="Bundled model (pachon info lists them), or path of a prescription.",
        kind=Argument,
    ),
]
Lenient = Annotated[bool, Option("--lenient", help="Lens or batoid file: warn about unknown parts, go on.")]
Configuration = Annotated[
    int | None,
    Option(help="Number of one of several configurations of a Zemax file; by default the one it was saved in."),
]
GlassCatalogues = Annotated[
    list[Path] | None,
    Option("--glass-catalogue", metavar="FILE.agf", help="Glass catalogue of a lens file, once for each."),
]
Aiming = Annotated[
    str | None,
    choice(
        ("off", "paraxial", "real"),
        help="Rays fill the entrance pupil (off), or the stop (paraxial, real); as the file says.",
    ),
]
WavelengthNm = Annotated[float | None, Option("--wavelength-nm", help="Wavelength [nm]; the model's own by default.")]
FieldsDeg = Annotated[
    list[str] | None,
    Option(
        "--field-deg",
        metavar="X,Y | R",
        help="Field angle [deg], or a distance from the axis along +y; once for each field. "
        "By default those of the file, or five from the axis to the edge.",
    ),
]
WavelengthsNm = Annotated[
    list[float] | None, Option("--wavelength-nm", help="Wavelength [nm], once for each; the model's own by default.")
]
AcrossBand = Annotated[
    int | None, Option("--across-band", min=2, max=99, metavar="N", help="In their place: wavelengths across the band.")
]
Projection = Annotated[str, choice(PROJECTIONS, help="Meaning of the field angles.")]
Picture = Annotated[
    Path | None,
    Option(
        "--picture",
        metavar="FILE",
        help="Picture to write, .png, .pdf or .svg; by default named after command and model.",
    ),
]
NoPicture = Annotated[bool, Option("--no-picture", help="Draw no picture.")]
TableFile = Annotated[
    Path | None,
    Option("--table", metavar="FILE", help="Table to write, with units: .ecsv, .csv, .fits or .parquet."),
]
StarX = Annotated[str, Option("--x", help="Column of x; names of SExtractor and LSST are known.")]
StarY = Annotated[str, Option("--y", help="Column of y.")]
StarStamp = Annotated[str, Option("--stamp", help="Column of the stamps [ny, nx].")]
StarWeight = Annotated[
    str | None, Option("--weight", help="Column of weights of pixels; WEIGHT, VIGNET_WEIGHT, ... by default.")
]
StarMask = Annotated[
    str | None, Option("--mask", help="Column of masks of pixels, 0 where good; MASK, VIGNET_MASK, ... by default.")
]
FlagMask = Annotated[
    int | None,
    Option(
        min=0,
        help="Bits of a column FLAGS that leave a star out; 254 by default, as PSFEx: all but 1. 0 keeps all stars.",
    ),
]
ColourColumn = Annotated[
    str | None, Option(help="Column of colours of stars, such as g_i; teff [K] counts as g - i of blackbodies.")
]
StarImages = Annotated[Path | None, Option("--images", help="FITS cube of the stamps, where the table has none.")]
MinSnr = Annotated[float, Option(help="Least S/N of a star.")]
Gain = Annotated[float, Option(help="Electrons in a unit of the stamps.")]
Recipe = Annotated[
    str | None,
    choice(
        ("kriging", "paper"),
        help="Model of the CCD: kriging (of pixels, default), paper (20 eigen-PSFs, cubic polynomials).",
    ),
]
Basis = Annotated[
    str | None, choice(("pixels", "pca", "shapelets"), help="Of the recipe: what stars are described in.")
]
Interpolation = Annotated[str | None, choice(("kriging", "polynomial"), help="Of the recipe, between the stars.")]
Components = Annotated[int | None, Option(min=1, help="Components of pca and shapelets.")]
Weights = Annotated[str | None, choice(("equal", "snr", "softened", "noise"), help="Of the stars in polynomials.")]
Order = Annotated[int | None, Option(min=0, max=6, help="Of polynomials over the image, or of the trend in kriging.")]
Threads = Annotated[int | None, Option(min=1, help="Threads; all processors by default. No byte depends on it.")]
Quiet = Annotated[bool, Option("--quiet", help="No progress, no table.")]
Json = Annotated[bool, Option("--json", help="Print metrics as JSON on standard output, and nothing else there.")]


def recipe_of_options(
    recipe: str | None,
    basis: str | None,
    interpolation: str | None,
    components: int | None,
    weights: str | None,
    order: int | None,
) -> PsfRecipe | None:
    """Return the recipe of the options of a PSF model; None where none is given."""
    from ..reconstruction.psf_model.recipe import Recipe as PsfRecipe

    if all(value is None for value in (recipe, basis, interpolation, components, weights, order)):
        return None
    # Another name is refused there.
    return PsfRecipe.of(
        cast("RecipeName | None", recipe),
        basis=basis,
        interpolation=interpolation,
        n_components=components,
        weights=weights,
        order=order,
    )


def name_list(text: str, option: str, example: str = "R22_S11,R22_S12") -> tuple[str, ...]:
    """Return the names in a text with commas; there must be one, such as in the example."""
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    if not names:
        raise ConfigError(f"{option} = {text!r}: expected names separated by commas, such as {example}")
    return names


def chosen_ccds(ccds: str | None, raft: str | None, all_ccds: bool) -> tuple[str, ...] | None:
    """Return the CCDs of the one option of :data:`Ccds`, :data:`Raft` and :data:`AllCcds` that is given, if any."""
    return one_name_list(ccds=ccds, raft=raft, all="all" if all_ccds else None)


def one_name_list(**options: str | None) -> tuple[str, ...] | None:
    """Return the names in the one option that is given; None where none is."""
    stated_options = [(f"--{name}", text) for name, text in options.items() if text is not None]
    if len(stated_options) > 1:
        *first, last = (f"--{name}" for name in options)
        raise ConfigError(f"{', '.join(first)} and {last}: expected one of them")
    return name_list(stated_options[0][1], stated_options[0][0]) if stated_options else None


def degrees_pair(text: str, option: str) -> tuple[float, float]:
    """Return the two angles [deg] in a text such as ``0,1.2``, or ``1.2``, a distance from the axis along +y."""
    try:
        x, y = (float(angle) for angle in (text if "," in text else f"0,{text}").split(","))
    except ValueError:
        raise ConfigError(
            f"{option} = {text!r}: expected two numbers in degrees, such as 0,1.2, or one along +y, such as 1.2"
        ) from None
    return x, y


def field_list(texts: Sequence[str] | None) -> np.ndarray | None:
    """Return the field angles [rad], shape [n, 2], of options such as ``0.3,1.2`` or ``1.75``; None without any."""
    import numpy as np

    if not texts:
        return None
    return np.deg2rad([degrees_pair(t, "--field-deg") for t in texts])


def wavelength_list(
    telescope: Telescope, wavelengths_nm: Sequence[float] | None, across_band: int | None
) -> np.ndarray | None:
    """Return the wavelengths [m] of the options; None without any."""
    import numpy as np

    if wavelengths_nm and across_band:
        raise ConfigError("--wavelength-nm and --across-band: expected one of them")
    if across_band:
        return np.linspace(*(telescope.band or telescope.wavelength_range), across_band)
    return np.array(wavelengths_nm) * 1e-9 if wavelengths_nm else None


def refuse_stated(options: Mapping[str, object], text: str) -> None:
    """Raise a ConfigError of the first of some options that is stated, its name and a text; None and False are not."""
    for name, value in options.items():
        if value is not None and value is not False:
            raise ConfigError(f"{name}{text}")


def picture_kind(picture: Path | None, no_picture: bool = False) -> str:
    """Return the format of a picture by the end of its name; png where there is no name."""
    if picture is not None and no_picture:
        raise ConfigError("--picture and --no-picture: expected one of them")
    kind = "png" if picture is None else picture.suffix.lower().removeprefix(".")
    if kind not in ("png", "pdf", "svg"):
        raise ConfigError(f"--picture = {picture}: expected a name that ends in .png, .pdf or .svg")
    return kind


def check_table(table: Path) -> None:
    """Check the ending of a table's name."""
    from ..core.table_files import FORMATS

    if table.suffix.lower() not in FORMATS:
        raise ConfigError(f"--table = {table}: expected a name that ends in {', '.join(FORMATS)}")
