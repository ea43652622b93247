"""Names that shells complete and whose own modules are slow to import: keys of configurations, operands, causes.

They stand in ``names.json``, which ``python -m pachon.commands.stored_names`` writes; a test compares them.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

_FILE = Path(__file__).parent / "names.json"


def stored_names() -> dict[str, Any]:
    """Return the names in the file: lists of them, and under `keys` the keys of each kind with their words."""
    content: dict[str, Any] = json.loads(_FILE.read_text("utf-8"))
    return content


def current_names() -> dict[str, Any]:
    """Return the names as the modules have them now."""
    from ..core.key_descriptions import describe_keys
    from ..design.optimize.operand_names import NAMES
    from ..studies.attribution.causes import CAUSES
    from ..studies.metrics.camera import CAMERA
    from ..studies.metrics.optics import OPTICS
    from ..studies.reproduce.reproduce import FIGURES
    from .config_kinds import KINDS, model_of

    words = {"true or false": ("true", "false")}
    return {
        "operands": list(NAMES),
        "causes": list(CAUSES),
        "figures": list(FIGURES),
        "metrics": [*OPTICS, *CAMERA],
        "keys": {
            kind: {key.key: list(key.choices or words.get(key.type, ())) for key in describe_keys(model_of(kind))}
            for kind in KINDS
        },
    }


def write_names() -> None:
    """Write the file."""
    _FILE.write_text(json.dumps(current_names(), indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    write_names()
