"""Kernels in two variants, for plain telescopes and for any."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import warp as wp

from ...core.launch import FORWARD_OPTIONS


@dataclass(frozen=True)
class KernelPair:
    """A kernel in two variants of one source, for plain telescopes and for any, each compiled at its first use.

    Code that a plain telescope does not need slows the loop over its surfaces even where it does not run.
    """

    plain: wp.Kernel
    special: wp.Kernel

    def variant_for(self, surfaces: Any) -> wp.Kernel:
        """Return the variant for a telescope's ``PackedSurfaces``."""
        return self.special if surfaces.special else self.plain


def kernel_pair(make: Callable[[bool, wp.Module], wp.Kernel]) -> KernelPair:
    """Return both variants of the kernel that ``make(special, module)`` defines in a module."""
    variants = []
    for special in (False, True):
        module = wp.get_module(f"{make.__module__}_{'special' if special else 'plain'}")
        wp.set_module_options(FORWARD_OPTIONS, module=module)
        variants.append(make(special, module))
    return KernelPair(*variants)
