"""All modules of kernels of the package, found by the names of their files."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import warp as wp

from .stability import PACKAGES

#: The folder that holds all others of the package.
_ROOT = Path(__file__).parents[1]


def kernels_by_module() -> dict[str, wp.Kernel]:
    """Return one kernel of each of Warp's modules by the module's name; loading it compiles the whole module."""
    package = __name__.rpartition(".core.")[0]
    modules: dict[str, wp.Kernel] = {}
    for name in _kernel_files():
        for value in vars(import_module(f"{package}.{name}")).values():
            modules |= {kernel.module.name: kernel for kernel in _kernels(value)}
    return dict(sorted(modules.items()))


def _kernel_files() -> list[str]:
    """Return the dotted names of the files that Warp compiles."""
    paths = [path for folder in ("core", *PACKAGES) for path in (_ROOT / folder).rglob("*.py")]
    kernels = [p for p in paths if p.stem.endswith("_kernels") or p.parent == _ROOT / "raytrace" / "kernels"]
    return sorted(".".join(p.relative_to(_ROOT).with_suffix("").parts) for p in kernels if p.stem != "__init__")


def _kernels(value: Any) -> Iterator[wp.Kernel]:
    """Yield the kernels that a name of a module stands for: one, or its variants."""
    if isinstance(value, wp.Kernel):
        yield value
    elif is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            yield from _kernels(getattr(value, field.name))
