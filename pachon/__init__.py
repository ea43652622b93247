"""Ray-traced telescope wavefronts, von Karman atmospheres and PSF reconstruction on the CPU.

The names of daily use are listed in ``__init__.pyi``; the others are public in the sub-packages, such as
``pachon.design``. Each is imported from its own module when it is first used, so ``import pachon`` is quick.
"""

from pathlib import Path as _Path

# In a checkout the sub-packages stand beside this folder, not in it.
_folder = _Path(__file__).parent
if not (_folder / "models").is_dir():
    __path__.append(str(_folder.parent))

from .core import deprecation as _deprecation  # noqa: E402 - found by the lines above
from .core import notebook as _notebook  # noqa: E402
from .core import stability as _stability  # noqa: E402
from .core import version as _version  # noqa: E402

__version__ = _version.VERSION
# Neither telescopes nor cameras may import the layers that draw them.
_notebook.PICTURES.update(Telescope="design.layout.layout:section", Camera="pipeline.report.camera_plot:camera_plot")

__getattr__, __dir__, __all__ = _deprecation.public_names(
    __name__, __file__, moved_to=_stability.PACKAGES, removed=_stability.REMOVED
)
