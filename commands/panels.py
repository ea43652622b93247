"""Panels of ``pachon --help``: which commands stand together."""

from __future__ import annotations

import typer

from .plain_help import PlainCommand

#: Commands of each panel, in the order of the help.
PANELS = {
    "Runs and images": "run images visits null-test stack-images reproduce diagnose attribute",
    "Stars and PSF models": "measure model study",
    "Design analyses": "desk spots focus zernikes rays fans opd-fans field-curvature lateral-color focal-shift seidel "
    "spot-matrix illumination throughput strehl target distortion vignetting footprint draw psf ee mtf ghosts opd "
    "design-report",
    "Optimise, tolerance, sweep": "optimize operands sensitivity tolerance sweep baseline check",
    "Camera and alignment": "camera shim donuts align",
    "Files": "info convert new validate schema config warm-up",
}


def plain_help(app: typer.Typer) -> None:
    """Let all commands in the groups of an app write help without Python's types."""
    for command in app.registered_commands:
        command.cls = PlainCommand
    for group in app.registered_groups:
        if group.typer_instance is not None:
            plain_help(group.typer_instance)


def sort_into_panels(app: typer.Typer) -> None:
    """Set the panels of the commands and groups in the groups of an app."""
    panel_of = {name: panel for panel, names in PANELS.items() for name in names.split()}
    for group in app.registered_groups:
        if group.typer_instance is not None:
            for command in group.typer_instance.registered_commands:
                command.rich_help_panel = panel_of[str(command.name)]
            for inner in group.typer_instance.registered_groups:
                inner.rich_help_panel = panel_of[str(inner.name)]
