"""Names that shells complete: models, cameras, CCDs, surfaces, operands, keys. Nothing here starts Warp.

Each function takes the context of the command, which holds the values given so far. One that fails says nothing: a
shell shows what it prints.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core.errors import PachonError

if TYPE_CHECKING:
    from ..models.camera.camera import Camera

Source = Callable[[Any], Iterable[str]]
#: Endings of YAML files.
YAML = (".yaml", ".yml")
#: Endings of files of telescopes.
LENSES = (*YAML, ".zmx", ".zar", ".seq", ".len", ".json", ".roa")
#: Endings of tables of heights.
HEIGHTS = (".ecsv", ".fits", ".csv", ".txt", ".dat")
#: Motions of surfaces in addresses, such as M2.dx.
MOTIONS = ("dx", "dy", "dz", "rx", "ry", "rz")
#: Motions and values of surfaces in addresses.
_ADDRESSES = (*MOTIONS, "radius", "conic")


def _quiet(source: Source) -> Source:
    """Return the source without its errors."""

    @wraps(source)
    def quiet(ctx: Any) -> list[str]:
        try:
            return list(source(ctx))
        except (PachonError, OSError, ValueError, KeyError, TypeError, AttributeError):
            return []

    return quiet


def files(*endings: str) -> Source:
    """Return the source of the files of the current folder with some endings."""

    @_quiet
    def named(ctx: Any) -> Iterable[str]:
        return sorted(path.name for path in Path().iterdir() if path.suffix.lower() in endings)

    return named


def either(*sources: Source) -> Source:
    """Return the source of the names of several."""

    def named(ctx: Any) -> Iterable[str]:
        return [name for source in sources for name in source(ctx)]

    return named


def words(*names: str) -> Source:
    """Return the source of some words."""

    def named(ctx: Any) -> Iterable[str]:
        return names

    return named


def bundled_models(ctx: Any) -> Iterable[str]:
    """Return the bundled telescopes."""
    from ..models.io.bundled import BUNDLED

    return BUNDLED


#: Source of bundled telescopes and files of telescopes.
models = either(bundled_models, files(*LENSES))


def cameras(ctx: Any) -> Iterable[str]:
    """Return the bundled cameras, and the heights as built."""
    from ..models.camera.cameras import CAMERAS
    from ..models.io.heights.zernike_table import AS_MEASURED

    return (*CAMERAS, *AS_MEASURED)


def heights(ctx: Any) -> Iterable[str]:
    """Return the names of heights as built, and the files of heights."""
    from ..models.io.heights.zernike_table import AS_MEASURED

    return (*AS_MEASURED, *files(*HEIGHTS)(ctx))


def degrees_of_freedom(ctx: Any) -> Iterable[str]:
    """Return the bundled degrees of freedom, and files."""
    from ..models.parameters.degrees_of_freedom_file import BUNDLED

    return (*BUNDLED, *files(*YAML)(ctx))


def sites(ctx: Any) -> Iterable[str]:
    """Return the bundled sites."""
    from ..models.io.site_file import BUNDLED

    return (*BUNDLED, *files(*YAML)(ctx))


@_quiet
def ccds(ctx: Any) -> Iterable[str]:
    """Return rafts and CCDs of the camera of the configuration; of the LSST where there is none."""
    camera = _camera(ctx)
    return (*camera.raft_names, *camera.ccd_names)


@_quiet
def rafts(ctx: Any) -> Iterable[str]:
    """Return the rafts of the camera of the configuration; of the LSST where there is none."""
    return _camera(ctx).raft_names


@_quiet
def surfaces(ctx: Any) -> Iterable[str]:
    """Return the surfaces of the telescope that the command names, where it has names."""
    return _surface_names(ctx)


@_quiet
def addresses(ctx: Any) -> Iterable[str]:
    """Return motions, radius and conic constant of the surfaces and groups of the telescope that the command names."""
    return [f"{name}.{value}" for name in _surface_names(ctx, groups=True) for value in _ADDRESSES]


@_quiet
def coated_surfaces(ctx: Any) -> Iterable[str]:
    """Return the surfaces of the telescope that the command names, each with the sign behind which its value stands."""
    return [f"{name}=" for name in _surface_names(ctx)]


@_quiet
def motions(ctx: Any) -> Iterable[str]:
    """Return the motions of surfaces and groups of the telescope of an option, that of the LSST by default."""
    names = _surface_names(ctx, groups=True, model=ctx.params.get("telescope") or "lsst_v3.3_r")
    return [f"{name}.{motion}=" for name in names for motion in MOTIONS]


def metrics(ctx: Any) -> Iterable[str]:
    """Return the kinds of metrics of baselines."""
    from .stored_names import stored_names

    return stored_names()["metrics"]


def causes(ctx: Any) -> Iterable[str]:
    """Return the causes of ellipticity."""
    from .stored_names import stored_names

    return stored_names()["causes"]


def figures(ctx: Any) -> Iterable[str]:
    """Return the figures and tables of the paper, and the word for all."""
    from .stored_names import stored_names

    return (*stored_names()["figures"], "all")


def operands(ctx: Any) -> Iterable[str]:
    """Return the operands by their names in Zemax and CODE V."""
    from .stored_names import stored_names

    return stored_names()["operands"]


def config_keys(ctx: Any) -> Iterable[str]:
    """Return the keys of all configurations, behind the kind."""
    from .stored_names import stored_names

    return [name for kind, keys in stored_names()["keys"].items() for name in (kind, *(f"{kind}.{k}" for k in keys))]


def key_values(kind: str) -> Source:
    """Return the source of the keys of a kind of configuration as ``key=value``, with the words that it takes."""

    def named(ctx: Any) -> Iterable[str]:
        from .stored_names import stored_names

        keys = stored_names()["keys"][kind]
        return [f"{key}={word}" for key, choices in keys.items() for word in choices or ("",)]

    return named


def _content(path: Any) -> dict[str, Any]:
    from ..core.yaml_reader import read_mapping

    return read_mapping(Path(path))


def _camera(ctx: Any) -> Camera:
    """Return the camera of the configuration of a command, or of the telescope that it names."""
    from ..models.camera.cameras import load_camera

    config = ctx.params.get("config")
    content = {} if config is None else _content(config)
    run = content.get("run", content)
    run = _content(Path(config).parent / run) if isinstance(run, str) else run
    return load_camera(run.get("camera") or _telescope(run.get("telescope") or "lsst_v3.3_r")["camera"])


def _telescope(model: str) -> dict[str, Any]:
    """Return the content of the prescription of a bundled telescope, or of a YAML file."""
    from ..models.io.bundled import BUNDLED, bundled_file

    return _content(bundled_file(model) if model in BUNDLED else model)


def _surface_names(ctx: Any, groups: bool = False, model: str | None = None) -> list[str]:
    """Return the names of surfaces in a prescription, by default the MODEL of a command, and those of its groups."""
    content = _telescope(model or ctx.params["model"])
    listed_surfaces = [str(surface["name"]) for surface in content["surfaces"] if "name" in surface]
    return listed_surfaces + ([str(name) for name in content.get("groups", ())] if groups else [])
