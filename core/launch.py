"""Quiet start of Warp, and launches of its kernels in slices, one per thread."""

from __future__ import annotations

import atexit
import logging
import os
import platform
import shutil
import sys
import tempfile
import threading
from collections.abc import Callable
from concurrent.futures import wait
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import warp as wp

from .errors import ProductError
from .file_lock import file_lock
from .launch_threads import helpers
from .threads import thread_count

wp.config.log_level = wp.LOG_ERROR

#: Notices of the library: compilations at level INFO, a cache that cannot be written as a warning. Commands show both.
LOGGER = logging.getLogger("pachon")
# Without a handler of the user's, Python would print the warning.
LOGGER.addHandler(logging.NullHandler())

#: Compiler flags of every kernel module: full-width SIMD where the processor has it, and a stack on which no such
#: vector lies across two cache lines, which is worth a tenth of the time.
CPU_COMPILER_FLAGS = "-march=native" + (
    " -mprefer-vector-width=512 -mstackrealign -mstack-alignment=64"
    if platform.machine().lower() in ("x86_64", "amd64")
    else ""
)
#: Options that a forward-only kernel module sets with ``wp.set_module_options``; loops over lanes are unrolled whole.
FORWARD_OPTIONS = {"enable_backward": False, "max_unroll": 32, "cpu_compiler_flags": CPU_COMPILER_FLAGS}
#: The same where unrolled loops over lanes make a kernel no faster: it compiles in two thirds of the time.
ROLLED_OPTIONS = FORWARD_OPTIONS | {"max_unroll": 1}

_loaded: set[tuple[str, str]] = set()
_start = threading.Lock()
_loading = threading.Lock()
_started: list[bool] = []


def start_warp() -> None:
    """Initialise Warp once, without its banner and its warning that there is no CUDA driver.

    The warning comes from native code, past every Python setting, so standard error is redirected for that moment.
    """
    with _start:
        if _started:
            return
        sys.stderr.flush()
        saved_stderr = os.dup(2)
        null_device = os.open(os.devnull, os.O_WRONLY)
        try:
            os.dup2(null_device, 2)
            cache_warning = _with_kernel_cache(wp.init)
        finally:
            os.dup2(saved_stderr, 2)
            os.close(saved_stderr)
            os.close(null_device)
        if cache_warning:
            LOGGER.warning(cache_warning)
        _started.append(True)


def load_kernels(kernel: wp.Kernel, device: str = "cpu") -> None:
    """Load the module of a kernel; a compilation, once per machine and version, goes to the logger ``pachon``."""
    start_warp()
    key = (kernel.module.name, device)
    if key in _loaded:
        return
    with _loading:
        # Another thread may have loaded it while this one waited.
        if key in _loaded:
            return
        block = 1 if device == "cpu" else 256
        compiled = Path(wp.config.kernel_cache_dir) / kernel.module.get_module_identifier(block)
        with nullcontext() if compiled.exists() else file_lock(compiled.with_name(f"{compiled.name}.lock")):
            if not compiled.exists():
                name = kernel.module.name.rpartition(".")[2]
                LOGGER.info("compiling %s for this machine (once)", name)
            cache_warning = _with_kernel_cache(lambda: wp.load_module(kernel.module, device=device, block_dim=block))
        if cache_warning:
            LOGGER.warning(cache_warning)
        _loaded.add(key)


def _with_kernel_cache(use: Callable[[], Any]) -> str:
    """Call a function that writes compiled kernels, with a temporary cache if necessary; return a warning."""
    try:
        use()
    except OSError as error:
        text = f"cannot write compiled kernels to {error.filename}: {error.strerror}"
    else:
        return ""
    try:
        folder = tempfile.mkdtemp(prefix="pachon_kernels_")
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        wp.config.kernel_cache_dir = folder
        use()
    except OSError:
        raise ProductError(f"{text}; WARP_CACHE_PATH names another folder") from None
    return f"{text}; they last for this command only (WARP_CACHE_PATH names another folder)"


def launch(
    kernel: wp.Kernel, count: int, inputs: list[Any], *, threads: int | None = None, device: str = "cpu"
) -> None:
    """Run a kernel over ``count`` items, on the CPU cut into one contiguous slice per thread.

    The kernel's first argument is the index of the first item of its slice (``first: wp.int32``); item ``i`` is
    ``first + wp.tid()``. An item writes only to its own outputs, so the result does not depend on the slices.
    `inputs` are the other arguments, outputs included; `threads` are all processors by default.
    """
    if count == 0:
        return
    load_kernels(kernel, device)
    slices = min(thread_count(threads), count) if device == "cpu" and threads != 1 else 1

    def run(i: int) -> None:
        first, end = (count * k // slices for k in (i, i + 1))
        wp.launch(kernel, dim=end - first, inputs=[first, *inputs], device=device)

    others = [helpers().submit(run, i) for i in range(1, slices)]
    try:
        run(0)
    finally:
        if others:
            wait(others)
    for other in others:
        other.result()
