"""Kernels in variants: for plain telescopes, for any, and for any whose apertures choose between crossings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import warp as wp

from ...core.launch import FORWARD_OPTIONS


@dataclass(frozen=True)
class KernelPair:
    """A kernel in variants of one source, for plain telescopes and for any, each compiled at its first use.

    Code that a plain telescope does not need slows the loop over its surfaces even where it does not run; so does, in
    any telescope, the choice between two crossings by the aperture, which has a variant of its own.

    A plain variant is alone in its module: with one caller of the loop in a module the compiler inlines all of it,
    which saves a tenth of the time. The others may share a module, and so the loop, which takes 20 s to compile.
    """

    plain: wp.Kernel
    special: wp.Kernel
    choosing: wp.Kernel

    def variant_for(self, surfaces: Any) -> wp.Kernel:
        """Return the variant for a telescope's ``PackedSurfaces``."""
        return (self.plain, self.special, self.choosing)[surfaces.special]


def kernel_pair(
    make: Callable[[int, wp.Module], wp.Kernel], *, shared: str | None = None, chooses: bool = True
) -> KernelPair:
    """Return the variants of the kernel that ``make(special, module)`` defines in a module.

    ``special`` is 0 for plain telescopes, 1 for any, 2 for any with a choice between crossings; without `chooses` the
    last two are one. Kernels for other telescopes than plain ones are in the modules of the name `shared`; all of them
    must be defined before one is loaded.
    """

    def variant(special: int, name: str) -> wp.Kernel:
        module = wp.get_module(f"{shared if shared and special else make.__module__}_{name}")
        wp.set_module_options(FORWARD_OPTIONS, module=module)
        return make(special, module)

    plain, special = variant(0, "plain"), variant(1, "special")
    return KernelPair(plain, special, variant(2, "choosing") if chooses else special)
