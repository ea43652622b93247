"""Kernels in two variants: for plain telescopes and for any."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import warp as wp

from ...core.launch import FORWARD_OPTIONS


@dataclass(frozen=True)
class KernelPair:
    """A kernel in variants of one source, for plain telescopes and for any, each compiled at its first use.

    Code that a plain telescope does not need slows the loop over its surfaces even where it does not run.

    A plain variant is alone in its module: with one caller of the loop in a module the compiler inlines all of it,
    which saves a tenth of the time. The others may share a module, and so the loop, which takes 20 s to compile.
    """

    plain: wp.Kernel
    special: wp.Kernel

    def variant_for(self, surfaces: Any) -> wp.Kernel:
        """Return the variant for a telescope's ``PackedSurfaces``."""
        return self.special if surfaces.special else self.plain


def kernel_pair(
    make: Callable[[bool, wp.Module], wp.Kernel],
    *,
    shared: str | None = None,
    options: dict[str, Any] = FORWARD_OPTIONS,
) -> KernelPair:
    """Return the variants of the kernel that ``make(special, module)`` defines in a module with these `options`.

    ``special`` is False for plain telescopes, True for any. Special variants of the same name `shared` are in one
    module, and must all be defined before it is loaded.
    """

    def variant(special: bool) -> wp.Kernel:
        name = f"{shared or make.__module__}_special" if special else f"{make.__module__}_plain"
        module = wp.get_module(name)
        wp.set_module_options(options, module=module)
        return make(special, module)

    return KernelPair(variant(False), variant(True))
