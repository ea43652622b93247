"""Ray-traced telescope wavefronts, von Karman atmospheres and PSF reconstruction on the CPU.

The public names are listed in ``__init__.pyi``. Each is imported from its own module when it is first used, so
``import pachon`` is quick.
"""

from pathlib import Path as _Path

import lazy_loader as _lazy

# In a checkout the sub-packages stand beside this folder, not in it.
_folder = _Path(__file__).parent
if not (_folder / "models").is_dir():
    __path__.append(str(_folder.parent))

from .core import version as _version  # noqa: E402 - found by the line above

__version__ = _version.VERSION

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
