"""Changes of a telescope in files and command lines, with the unit in the name: ``M2.dz_um: 10``."""

from __future__ import annotations

from collections.abc import Mapping

from ...core.arguments import check_arguments
from ...core.errors import ConfigError
from ..paraxial import following_pupil
from ..telescope import Telescope
from .parameters import Parameter, apply

#: Sizes of units in SI, by the ending of a name.
LENGTHS = {"m": 1.0, "mm": 1e-3, "um": 1e-6, "nm": 1e-9}
ANGLES = {
    "rad": 1.0,
    "mrad": 1e-3,
    "urad": 1e-6,
    "arcsec": 4.84813681109536e-06,
    "arcmin": 2.908882086657216e-04,
    "deg": 0.017453292519943295,
}


@check_arguments
def apply_changes(telescope: Telescope, changes: Mapping[str, float]) -> Telescope:
    """Return a telescope with changes applied.

    Where the stop has mirrors or lenses in front of it, the entrance pupil moves to where they image it now, along the
    axis and sideways.

    Parameters
    ----------
    telescope : Telescope
        The telescope; it stays as it is.
    changes : mapping of str to float
        Change of each parameter by its address (:mod:`.parameters`), an underscore and the unit of the value: m, mm, um
        or nm for a length, rad, mrad, urad, arcsec, arcmin or deg for an angle. Other parameters have no ending and are
        in SI: ``M2.dz_um``, ``Camera.rx_urad``, ``M1.Z5_nm``, ``M1.conic``, ``L1_entrance.n``.

    Raises
    ------
    ConfigError
        If the unit is missing, or does not fit the parameter.
    PachonError
        As :func:`~pachon.models.parameters.parameters.apply`.
    """
    values: dict[Parameter, float] = {}
    for name, value in changes.items():
        parameter, factor = parse_change(telescope, name)
        if parameter in values:
            raise ConfigError(f"changes.{name}: {parameter.address} is changed twice; expected each once")
        values[parameter] = float(value) * factor
    return following_pupil(apply(telescope, values), telescope) if values else telescope


def parse_change(telescope: Telescope, name: str, section: str = "changes") -> tuple[Parameter, float]:
    """Return the parameter of a name with a unit, and the size of that unit in SI; `section` is for messages."""
    full_name = f"{section}.{name}" if section else name
    address, _, ending = name.rpartition("_")
    if address and ending in (*LENGTHS, *ANGLES) and "." in address:
        parameter = Parameter.parse(address, telescope)
        units = _units(parameter)
        if ending not in units:
            raise ConfigError(f"{full_name}: {address} is in {parameter.unit or 'no unit'}, not in {ending}")
        return parameter, units[ending]
    parameter = Parameter.parse(name, telescope)
    units = _units(parameter)
    if units:
        raise ConfigError(f"{full_name}: expected its unit at the end, such as {name}_{list(units)[2]}")
    return parameter, 1.0


def _units(parameter: Parameter) -> dict[str, float]:
    return {"m": LENGTHS, "rad": ANGLES}.get(parameter.unit, {})
