"""Wavefronts of donuts in the conventions and frames of observatories, and motions of hexapods.

=======  =================================================================================  ======  ==================
name     Zernikes                                                                           unit    source
=======  =================================================================================  ======  ==================
pachon   annular, at the obscuration of the telescope                                       m
ts_wep   annular, at the obscuration of the telescope; the LSST's columns `zk_deviation_*`  um      ts_wep, batoid
donut    circular: the unit disc of the outer radius, obscuration 0                         waves   aaronroodman/Donut
=======  =================================================================================  ======  ==================

All three are in Noll's order, of unit rms, on the entrance pupil, and positive where the wavefront leads: a detector
behind the focus has positive Z4. ts_wep takes wavefronts of ``batoid.zernikeGQ`` (``instrument.py``) and an image at
minus their gradient (``imageMapper.py``, extra-focal images are upside down). Donut has the inverse Fourier transform
of exp(2 pi i W), W in waves of 700 nm by default, with the shadow of the prime-focus cage on the side of the star's
image (``DonutEngine.cc``, ``Zernike.cc``), so that its pupil is not turned to the image either.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np
from astropy import units as u
from astropy.table import QTable
from numpy.typing import ArrayLike

from ..core.arguments import check_arguments
from ..core.errors import ConfigError, DomainError
from ..core.number_text import counted
from ..core.plotting import axes_at, plain_text, styled
from ..core.result import Result
from ..core.units import ARCSEC, length
from ..design.metrics.field_zernikes import name_terms, wavefront_zernikes
from ..models.telescope import Telescope
from ..models.zernike_polynomials import annular_zernikes, noll_to_nm
from ..raytrace.rays import Projection
from .degrees import FreedomEstimate
from .frames import DonutFrames, FrameName, zernike_matrix

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Wavelength of the waves that Donut counts by default [m].
DONUT_WAVELENGTH = 700e-9
ZernikeConvention = Literal["pachon", "ts_wep", "donut"]
#: Names of the units of conventions, as astropy has them; waves are pure numbers.
_UNITS: dict[ZernikeConvention, str] = {"pachon": "m", "ts_wep": "um", "donut": ""}
#: Names of conventions.
CONVENTIONS = tuple(_UNITS)
#: Parameters of rigid-body motions, in the order of shifts and turns.
_MOTIONS = ("dx", "dy", "dz", "rx", "ry", "rz")


class FittedWavefronts(Protocol):
    """Wavefronts of n donuts in the telescope frame [m]; see :class:`~pachon.sensing.DonutFit`."""

    @property
    def zernikes(self) -> np.ndarray:
        """Coefficients [m], shape [n, n_noll]."""

    @property
    def covariance(self) -> np.ndarray:
        """Covariance of them [m^2], shape [n, n_noll, n_noll]."""

    @property
    def noll(self) -> np.ndarray:
        """Noll indices."""

    @property
    def fields(self) -> np.ndarray:
        """Field angles [rad], shape [n, 2]."""

    @property
    def wavelengths(self) -> np.ndarray:
        """Vacuum wavelengths [m]."""

    @property
    def obscuration(self) -> float:
        """Inner over outer radius of the annulus."""

    @property
    def projection(self) -> Projection:
        """Meaning of the field angles."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ObservatoryZernikes(Result):
    """Zernikes of n donuts in a convention and a frame of an observatory.

    Attributes
    ----------
    convention : str
        ``pachon``, ``ts_wep`` or ``donut``.
    frame : str
        ``OCS``, ``CCS``, ``DVCS``, ``ZCS`` or ``sky``.
    unit : str
        Unit of the values; empty for waves.
    wave : float
        Length of a wave, where values are in waves [m]; NaN otherwise.
    obscuration : float
        Inner over outer radius of the Zernikes.
    noll : ndarray of int, shape [n_noll]
        Noll indices.
    values : ndarray, shape [n, n_noll]
        Coefficients in the unit of the convention; NaN for donuts without a result.
    covariance : ndarray, shape [n, n_noll, n_noll]
        Covariance of them, in the square of that unit.
    fields : ndarray, shape [n, 2]
        Field angles of the light's own travel along the axes of the frame [rad].
    """

    convention: ZernikeConvention
    frame: FrameName
    unit: str
    wave: float
    obscuration: float
    noll: np.ndarray
    values: np.ndarray
    covariance: np.ndarray
    fields: np.ndarray

    @property
    def errors(self) -> np.ndarray:
        """Standard deviations of the values, shape [n, n_noll]."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))

    def _label(self) -> str:
        terms = f"Zernikes {self.noll[0]} to {self.noll[-1]}"
        return f"{counted(len(self.values), 'donut')}, {terms}, {self.convention}, {self.frame}"

    def to_table(self) -> QTable:
        """Return one row a donut: field angles, and Zernikes with their errors, in the convention's unit."""
        table = QTable()
        table["field_x"], table["field_y"] = np.rad2deg(self.fields).T * u.deg
        unit = u.Unit(self.unit)
        for k, j in enumerate(self.noll):
            table[f"Z{j}"], table[f"Z{j}_err"] = self.values[:, k] * unit, self.errors[:, k] * unit
            table[f"Z{j}"].info.description = f"Zernike term of Noll index {j}, convention {self.convention}"
            table[f"Z{j}_err"].info.description = f"standard error of Z{j}"
        for name, axis in (("field_x", "x"), ("field_y", "y")):
            table[name].info.description = f"field angle along {axis} of {self.frame}"
        table.meta.update(self.description())
        return table

    def in_table(self, table: QTable) -> QTable:
        """Return a table of the same donuts with its fields and Zernikes in this frame and convention.

        Zernikes of the convention ``pachon`` are in the unit that the table has for them.
        """
        converted = self.to_table()
        merged = table.copy()
        for name in converted.colnames:
            unit = table[name].unit if self.convention == "pachon" and name.startswith("Z") else converted[name].unit
            merged[name] = converted[name].to(unit)
            merged[name].info.description = converted[name].info.description
        merged.meta.update(converted.meta)
        if self.convention == "pachon":
            merged.meta["zernike_unit"] = str(table[f"Z{self.noll[0]}"].unit)
        return merged

    def description(self) -> dict[str, Any]:
        """Return frame, convention and unit by name, for headers of tables and JSON."""
        waves = {} if np.isnan(self.wave) else {"wave_nm": self.wave * 1e9}
        unit = self.unit or "waves"
        return {"frame": self.frame, "convention": self.convention, "zernike_unit": unit, **waves} | {
            "zernike_obscuration": self.obscuration
        }

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw the Zernikes of all donuts with their errors, in the unit of the convention."""
        with styled():
            figure, axes = axes_at(ax, 8.0, 4.0)
            steps = 0.6 * (np.arange(len(self.values)) + 0.5) / max(len(self.values), 1) - 0.3
            for step, row, errors in zip(steps, self.values, self.errors, strict=True):
                axes.errorbar(self.noll + step, row, errors, fmt="o", markersize=3)
            name_terms(axes, self.noll)
            axes.set_ylabel(f"coefficient [{self.unit or 'waves'}], {self.convention}, {self.frame}")
        return figure

    def _summary(self) -> dict[str, Any]:
        return {
            **self.description(),
            "noll": self.noll,
            "field_deg": np.rad2deg(self.fields),
            "zernikes": self.values,
            "zernike_errors": self.errors,
        }


def observatory_zernikes(
    fit: FittedWavefronts,
    convention: ZernikeConvention,
    frame: FrameName,
    frames: DonutFrames,
    design: Telescope | None,
    wave: ArrayLike | None,
) -> ObservatoryZernikes:
    """Return the wavefronts of a fit in a convention and frame; see :meth:`DonutFit.zernikes_in`."""
    if wave is not None and convention != "donut":
        raise ConfigError(f"wave and convention = {convention!r} are both given: expected waves of donut alone")
    waves = (DONUT_WAVELENGTH if wave is None else length(wave, "wave")) if convention == "donut" else np.nan
    scale = {"pachon": 1.0, "ts_wep": 1e6, "donut": 1.0 / waves}[convention]
    obscuration = 0.0 if convention == "donut" else fit.obscuration
    values = fit.zernikes.copy()
    # The design may not cover the fields of donuts without a result.
    with_result = np.isfinite(values).all(axis=1)
    if design is not None and with_result.any():
        middle, fields = float(fit.wavelengths[len(fit.wavelengths) // 2]), fit.fields[with_result]
        wavefront = wavefront_zernikes(design, fields, middle, jmax=int(fit.noll.max()), projection=fit.projection)
        values[with_result] += wavefront.coefficients[:, fit.noll - 1]
    matrix = scale * zernike_matrix(fit.noll, frames.axes(frame)[:2, :2])
    matrix = matrix @ reexpansion(fit.noll, fit.obscuration, obscuration)
    return ObservatoryZernikes(
        convention=convention,
        frame=frame,
        unit=_UNITS[convention],
        wave=float(waves),
        obscuration=obscuration,
        noll=fit.noll,
        values=values @ matrix.T,
        covariance=matrix @ fit.covariance @ matrix.T,
        fields=frames.fields_in(fit.fields, frame, projection=fit.projection),
    )


def reexpansion(noll: np.ndarray, obscuration: float, target: float) -> np.ndarray:
    """Return the matrix from annular Zernikes of one obscuration to those of another.

    A term of one is a sum of terms of the other, of the same azimuthal order and no higher degree; those that are not
    among the indices, such as piston and tilt, are left out.
    """
    if obscuration == target:
        return np.eye(len(noll))
    highest = int(noll.max())
    degree = noll_to_nm(highest)[0]
    # Gauss's rule in rho^2 and even angles: exact for products of the terms.
    nodes, weights = np.polynomial.legendre.leggauss(degree + 2)
    radius = np.sqrt(target**2 + 0.5 * (1.0 - target**2) * (nodes + 1.0))
    angle = 2.0 * np.pi * np.arange(2 * degree + 3) / (2 * degree + 3)
    x, y = radius[:, None] * np.cos(angle), radius[:, None] * np.sin(angle)
    weight = 0.5 * weights[:, None] / len(angle)
    source, result = (annular_zernikes(highest, x, y, o)[noll - 1] for o in (obscuration, target))
    return np.asarray(np.einsum("krt,jrt,rt->kj", result, source, np.broadcast_to(weight, x.shape)))


@dataclass(frozen=True, eq=False, kw_only=True)
class BodyMotions(Result):
    """Rigid-body motions of mirrors and camera in a frame of the observatory.

    Attributes
    ----------
    frame : str
        ``OCS``, ``CCS``, ``ZCS`` or ``sky``.
    body : ndarray of str, shape [n]
        Names of surfaces or groups.
    shift, shift_error : ndarray, shape [n, 3]
        Shifts along x, y, z of the frame [um].
    tilt, tilt_error : ndarray, shape [n, 3]
        Turns about x, y, z of the frame, right-handed [arcsec].
    """

    _table = ("body", "shift", "shift_error", "tilt", "tilt_error")

    frame: FrameName
    body: np.ndarray
    shift: np.ndarray
    shift_error: np.ndarray
    tilt: np.ndarray
    tilt_error: np.ndarray

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw shifts [um] and tilts [arcsec] of each body with their errors."""
        with styled():
            figure, axes = axes_at(ax, 6.0, 4.0)
            for k, body in enumerate(self.body):
                values, errors = (np.concatenate(v) for v in ((self.shift[k], self.tilt[k]), self._errors(k)))
                axes.errorbar(np.arange(6) + 0.1 * k, values, errors, fmt="o", markersize=4, label=plain_text(body))
            axes.axhline(0.0, color="0.3", linewidth=0.7)
            axes.set_xticks(range(6), ["dx", "dy", "dz", "rx", "ry", "rz"])
            axes.set_ylabel(f"correction [um, arcsec], {self.frame}")
            axes.legend()
        return figure

    def _errors(self, body: int) -> tuple[np.ndarray, np.ndarray]:
        return self.shift_error[body], self.tilt_error[body]


@check_arguments
def hexapod_corrections(
    degrees_of_freedom: FreedomEstimate, *, frame: FrameName = "OCS", frames: DonutFrames | None = None
) -> BodyMotions:
    """Return the motions of hexapods that undo the fitted ones.

    They are minus the values of the estimate, with the turns about the same points as there.

    Parameters
    ----------
    degrees_of_freedom : FreedomEstimate
        Estimate of the degrees of freedom, of :attr:`DonutFit.degrees_of_freedom`.
    frame : {"OCS", "CCS", "ZCS", "sky"}
        Frame of the motions. ``ZCS`` is that of the degrees of freedom of batoid_rubin and of earlier ts_ofc.
    frames : DonutFrames, optional
        Angles of rotator and sky; zero by default.

    Returns
    -------
    BodyMotions

    Raises
    ------
    ConfigError
        If the frame is unknown, is ``DVCS``, which has no z, or lacks the parallactic angle.
    DomainError
        If no degree of freedom moves a body as a whole.
    """
    if frame == "DVCS":
        raise ConfigError("frame = DVCS: expected OCS, CCS, ZCS or sky, as DVCS is one of images", key="frame")
    axes = (frames or DonutFrames()).axes(frame)
    freedoms = degrees_of_freedom.freedoms
    rows: dict[str, np.ndarray] = {}
    for column, (member, size) in enumerate(zip(freedoms.members, freedoms.unit_sizes, strict=True)):
        for address, weight in member.of.items():
            body, _, parameter = address.rpartition(".")
            if parameter in _MOTIONS:
                motion = rows.setdefault(body, np.zeros((6, len(freedoms))))
                motion[_MOTIONS.index(parameter), column] += weight * size
    if not rows:
        raise DomainError("no degree of freedom moves a body: expected names such as M2.dx among them")
    turn = -np.kron(np.eye(2), axes)
    scale = np.repeat([1e6, 1.0 / ARCSEC], 3)
    motions = {body: scale[:, None] * (turn @ matrix) for body, matrix in rows.items()}
    values = np.array([motion @ degrees_of_freedom.values for motion in motions.values()])
    errors = np.array([np.sqrt(np.diag(m @ degrees_of_freedom.covariance @ m.T)) for m in motions.values()])
    return BodyMotions(
        frame=frame,
        body=np.array(list(motions)),
        shift=values[:, :3],
        shift_error=errors[:, :3],
        tilt=values[:, 3:],
        tilt_error=errors[:, 3:],
    )
