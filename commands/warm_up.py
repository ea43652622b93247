"""The command ``pachon warm-up``."""

from __future__ import annotations

import typer

from ..core.terminal import print_line
from .interrupt import interruptible
from .options import Quiet

app = typer.Typer()


@app.command("warm-up")
def warm_up_command(quiet: Quiet = False) -> None:
    """Compile what pachon computes with, once on a machine, so that nothing waits for it later.

    Compiled code is kept for all later processes of the same version; each part takes some seconds. Without this
    command each is compiled when it is first used.

    **Examples**

    - `pachon warm-up`
    - `pachon warm-up --quiet`: in the image of a container
    """
    from time import perf_counter

    from ..core.kernel_modules import kernels_by_module
    from ..core.launch import load_kernels, start_warp

    start_warp()
    start = perf_counter()
    kernels = kernels_by_module()
    with interruptible(quiet) as reporter, reporter.stage("compiling", len(kernels)) as stage:
        for count, (name, kernel) in enumerate(kernels.items(), start=1):
            load_kernels(kernel)
            stage.advance()
            stage.step(name.rpartition(".")[2], count, len(kernels))
    if not quiet:
        print_line(f"{len(kernels)} modules of kernels are ready ({perf_counter() - start:.1f} s)")
