"""GalSim with the telescopes of pachon: photon operator, PSFs and world coordinates; needs ``pachon[galsim]``.

Importing it registers the types ``PachonOptics`` and ``Pachon`` for GalSim's configuration files, where it belongs
under ``modules``.
"""

from __future__ import annotations

from typing import Any

__all__ = ["PachonOptics", "galsim_wcs", "psf_object"]

try:
    import galsim as _galsim  # noqa: F401 - is it there?
except ModuleNotFoundError:

    def __getattr__(name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        from .core.errors import ConfigError

        raise ConfigError(f"pachon.galsim.{name} needs GalSim: pip install 'pachon[galsim]'") from None

else:
    from .imaging import galsim_config as _config  # noqa: F401 - registers the types
    from .imaging.galsim_optics import PachonOptics as PachonOptics
    from .imaging.galsim_psf import galsim_wcs as galsim_wcs
    from .imaging.galsim_psf import psf_object as psf_object
