"""Landing points by degrees of freedom of the telescope, and their estimate from all donuts of an exposure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ..core.errors import ConfigError, DomainError, PachonError
from ..core.plotting import BLUE, ORANGE, figure_at, plain_text, styled
from ..core.result import Result
from ..core.units import pure_numbers
from ..design.optimize.jacobian import ParameterColumns
from ..design.optimize.sensitivity import sensitivity
from ..models.parameters.degrees_of_freedom import DegreesOfFreedom
from ..models.parameters.parameters import apply
from ..models.parameters.tolerances import Tolerance
from ..models.telescope import Telescope
from ..raytrace.adjoint.backward_pass import landing_gradient
from ..raytrace.adjoint.forward_pass import forward_pass
from ..raytrace.launch import aimed_points
from ..raytrace.rays import Projection, parallel_rays
from ..wavefront.psf.pupil_rims import PupilRims
from .donut_rays import RimsOfCells, landing_of, spread_of
from .pupil_cells import PupilCells
from .rim_light import RimsAt

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Rms wavefront over the field that each degree of freedom may make where no prior is given [m].
DEFAULT_PRIOR = 1e-6
#: Rms wavefront of a degree of freedom in SI, in metres per unit of it, that is none but rounding.
_SILENT = 1e-12
#: Terms that are fitted at least to the response over the whole annulus, the first number that lit points tell apart.
_MANY_TERMS = (45, 37, 28)
#: Combinations drawn in a plot.
_SHOWN = 12


class FreedomRays:
    """Landing points of one star's light by degrees of freedom, each in its unit; their response is not stored.

    Unknowns are the degrees of freedom and then, where cells have rates of change by them, the shifts of rims.

    Parameters
    ----------
    telescope, direction, wavelengths, wavelength_weights, cells
        As in :class:`~pachon.sensing.donut_rays.ZernikeRays`.
    freedoms : DegreesOfFreedom
        The degrees of freedom.
    footprint : ndarray, shape [2, 2]
        Footprint of a cell in the model of the image [m].
    shifts : ndarray, shape [n_shift], optional
        Shifts of rims that the weights of the cells have in them [m]; none by default.
    """

    def __init__(
        self,
        telescope: Telescope,
        direction: np.ndarray,
        wavelengths: np.ndarray,
        wavelength_weights: np.ndarray,
        cells: PupilCells,
        freedoms: DegreesOfFreedom,
        footprint: np.ndarray,
        shifts: np.ndarray | None = None,
    ) -> None:
        self._prepared, self._parameters, self._matrix = freedoms.parameter_matrix(telescope)
        self._direction, self._wavelengths = direction, wavelengths
        self.cells, self._footprint = cells, footprint
        self._weights, self.rates = cells.at_wavelengths(wavelength_weights)
        self._count = len(freedoms)
        self._shifts = np.zeros(self.rates.shape[1]) if shifts is None else shifts
        middle = float(wavelengths[len(wavelengths) // 2])
        #: Where the chief ray crosses the plane of the entrance pupil: that of the telescope as it is believed to be.
        self._chief = np.reshape(aimed_points(telescope, direction[None], middle, np.zeros((1, 2))), (1, 2))

    @property
    def count(self) -> int:
        """Number of unknowns."""
        return self._count + self.rates.shape[1]

    def landing(self, unknowns: np.ndarray) -> np.ndarray:
        """Return landing points minus that of the chief ray [m], of the telescope with its degrees of freedom."""
        values = self._matrix @ unknowns[: self._count]
        changed = apply(self._prepared, dict(zip(self._parameters, values, strict=True)))
        places = [
            landing_of(changed, parallel_rays(changed, self._direction[None], float(w), self.cells.points))
            for w in self._wavelengths
        ]
        middle = float(self._wavelengths[len(self._wavelengths) // 2])
        chief = landing_of(changed, parallel_rays(changed, self._direction[None], middle, self._chief))
        if not np.isfinite(chief).all():
            raise DomainError("the chief ray does not reach the image")
        return np.concatenate(places) - chief

    def weights(self, unknowns: np.ndarray) -> np.ndarray:
        """Return fractions of the light of the cells."""
        return self._weights + self.rates @ (unknowns[self._count :] - self._shifts)

    def spread(self, landing: np.ndarray) -> np.ndarray:
        """Return the spread of the image of each point."""
        return spread_of(self.cells, landing, self._footprint)

    def at_rims(self, rims: PupilRims, landing: np.ndarray, response: np.ndarray | None) -> RimsAt:
        """Return rims of the telescope as it is believed to be on the detector; see :class:`LightRays`."""
        return RimsOfCells(self.cells, response).at(rims, landing)

    def response(self, unknowns: np.ndarray) -> np.ndarray:
        """Return the derivatives, shape [2, n, n_freedom]."""
        columns = ParameterColumns.at(self._prepared, self._parameters, self._matrix @ unknowns[: self._count])

        def derivatives(wavelength: float, points: np.ndarray) -> np.ndarray:
            rays = parallel_rays(columns.telescope, self._direction[None], wavelength, points)
            forward = forward_pass(columns.telescope, rays, threads=1)
            return columns.derivatives(forward, landing_gradient(forward), threads=1) @ self._matrix

        landing = [derivatives(float(w), self.cells.points) for w in self._wavelengths]
        middle = float(self._wavelengths[len(self._wavelengths) // 2])
        return np.concatenate(landing, axis=1) - derivatives(middle, self._chief)

    def release(self) -> None:
        """Free the polynomials over the pupil."""
        self.cells.release()


@dataclass(frozen=True)
class FreedomEstimate(Result):
    """Estimate of degrees of freedom from the donuts of one exposure.

    Attributes
    ----------
    freedoms : DegreesOfFreedom
        The degrees of freedom, with ``names``, ``units`` and ``apply(telescope, values)``.
    values : ndarray, shape [n]
        Maximum of likelihood times prior, each in its unit: what the telescope has beyond the one believed in.
    covariance : ndarray, shape [n, n]
        Posterior covariance, the inverse of Fisher's information plus that of the prior.
    prior : ndarray, shape [n]
        Standard deviations of the Gaussian prior about zero.
    """

    _table = ("names", "units", "values", "errors", "prior")

    freedoms: DegreesOfFreedom
    values: np.ndarray
    covariance: np.ndarray
    prior: np.ndarray

    @property
    def names(self) -> tuple[str, ...]:
        """Names in the order of the vector."""
        return self.freedoms.names

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the values."""
        return self.freedoms.units

    @property
    def errors(self) -> np.ndarray:
        """Standard deviations, shape [n]."""
        return np.sqrt(np.diag(self.covariance))

    def combinations(self) -> tuple[np.ndarray, np.ndarray]:
        """Return how well combinations of the degrees of freedom are known, best first.

        Returns
        -------
        ratio : ndarray, shape [n]
            Posterior over prior standard deviation: small where the images determine a combination, 1 where they say
            nothing about it. Square roots of the eigenvalues of the covariance in units of the prior.
        vectors : ndarray, shape [n, n]
            Combinations, one a row, of the degrees of freedom in units of their priors.
        """
        values, vectors = np.linalg.eigh(self.covariance / np.outer(self.prior, self.prior))
        return np.sqrt(np.maximum(values, 0.0)), vectors.T

    def _summary(self) -> dict[str, Any]:
        """Return the estimate by name and unit, of plain numbers and lists."""
        ratio, vectors = self.combinations()
        return {
            "names": list(self.names),
            "units": list(self.units),
            "values": self.values.tolist(),
            "errors": self.errors.tolist(),
            "prior": self.prior.tolist(),
            "combinations_posterior_over_prior": ratio.tolist(),
            "combinations": vectors.tolist(),
        }

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw the values in units of the priors, how well combinations are known, and the best and worst of these."""
        ratio, vectors = self.combinations()
        names = [plain_text(name) for name in self.names]
        n = len(names)
        with styled():
            figure = figure_at(ax, min(14.0, 6.0 + 0.16 * n), 8.0)
            grid = figure.add_gridspec(2, 2, width_ratios=(2.2, 1.0), height_ratios=(1.0, 1.2))
            bars, spectrum, table = (figure.add_subplot(grid[k]) for k in ((0, 0), (0, 1), (1, slice(None))))
            place = np.arange(n)
            bars.errorbar(place, self.values / self.prior, self.errors / self.prior, fmt="o", color=BLUE, markersize=3)
            bars.axhline(0.0, color="0.3", linewidth=0.7)
            bars.set_ylabel("value / prior")
            size = 8 if n <= 24 else 5
            bars.set_xticks(place, names, rotation=90, fontsize=size)
            spectrum.semilogy(place + 1, ratio, "o-", color=ORANGE, markersize=3.5, linewidth=0.9)
            spectrum.axhline(1.0, color="0.3", linewidth=0.7)
            spectrum.set(xlabel="combination, best known first", ylabel="posterior / prior standard deviation")
            count = min(_SHOWN, n)
            shown = np.unique(np.concatenate([np.arange((count + 1) // 2), np.arange(n - count // 2, n)]))
            image = table.imshow(vectors[shown], cmap="RdBu_r", vmin=-1.0, vmax=1.0, aspect="auto", origin="upper")
            figure.colorbar(image, ax=table, fraction=0.03, pad=0.01, label="degree of freedom / prior")
            table.set_xticks(place, names, rotation=90, fontsize=size)
            table.set_yticks(range(len(shown)), [f"{k + 1}: {ratio[k]:.2g}" for k in shown], fontsize=7)
            table.set_ylabel("combination: posterior / prior")
            return figure


def prior_spreads(
    freedoms: DegreesOfFreedom,
    prior: ArrayLike | Mapping[str, Any] | Sequence[Tolerance] | None,
    telescope: Telescope,
    wavelength: float,
) -> np.ndarray:
    """Return standard deviations of the degrees of freedom, each in its unit, shape [n].

    ``prior`` is as in :func:`stated_spreads`; by default each degree of freedom makes a wavefront of 1 um rms over the
    field, and DomainError where one makes none.
    """
    if prior is None:
        rms = sensitivity(telescope, freedoms, wavelength=wavelength).rms
        if names := silent_names(freedoms, rms):
            raise DomainError(
                f"{', '.join(names)}: no change of the wavefront; expected other freedoms, or their prior"
            )
        return np.asarray(DEFAULT_PRIOR / rms)
    return stated_spreads(freedoms, prior)


def annulus_response(
    telescope: Telescope,
    freedoms: DegreesOfFreedom,
    fields: np.ndarray,
    wavelength: float,
    last: int,
    projection: Projection,
) -> np.ndarray:
    """Return changes of Zernikes of the whole annulus up to a Noll index by degrees of freedom, [n_field, last, n].

    They are fitted to the light that passes, together with as many further terms as that tells apart: by 22 terms alone
    those of the LSST's bending modes are up to 0.4 of their size off at 1.75 degrees.
    """
    for count in (*(terms for terms in _MANY_TERMS if terms > last), last):
        try:
            response = sensitivity(telescope, freedoms, fields, wavelength, n_zernike=count, projection=projection)
        except DomainError:
            if count == last:
                raise
        else:
            break
    return response.matrix[:, :last]


def silent_names(freedoms: DegreesOfFreedom, rms: np.ndarray) -> list[str]:
    """Return the names of degrees of freedom that change no wavefront, by its rms [m] per unit of each, shape [n]."""
    return [name for name, none in zip(freedoms.names, rms < _SILENT * freedoms.unit_sizes, strict=True) if none]


def stated_spreads(
    freedoms: DegreesOfFreedom, prior: ArrayLike | Mapping[str, Any] | Sequence[Tolerance]
) -> np.ndarray:
    """Return standard deviations that are one number, a vector, by name, or of tolerances, as [n], each in its unit."""
    if isinstance(prior, Sequence) and prior and isinstance(prior[0], Tolerance):
        prior = {t.name: t.spread for t in prior if isinstance(t, Tolerance)}
    if isinstance(prior, Mapping):
        by_name: Any = prior
        try:
            spreads = freedoms.vector(by_name)
        except PachonError as error:
            raise error.within(key="prior") from None
    else:
        numbers = pure_numbers(prior, "prior")
        if numbers.shape not in ((), (1,), (len(freedoms),)):
            raise ConfigError(
                f"prior of shape {list(numbers.shape)}: expected {len(freedoms)} standard deviations, or them by name"
            )
        spreads = np.array(np.broadcast_to(numbers, (len(freedoms),)))
    for name, value in zip(freedoms.names, spreads, strict=True):
        if not (np.isfinite(value) and value > 0.0):
            raise DomainError(f"prior of {name} = {float(value)!r}: expected a positive standard deviation")
    return spreads
