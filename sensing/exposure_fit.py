"""Fit of all donuts of an exposure: the telescope's wavefront over the field, and each donut's own about it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from ..core.arguments import check_arguments
from ..core.errors import DomainError
from ..design.metrics.field_zernikes import wavefront_zernikes
from ..models.parameters.degrees_of_freedom import DegreesOfFreedom
from ..models.parameters.tolerances import Tolerance
from ..models.telescope import Telescope
from ..wavefront.atmosphere.atmosphere import Atmosphere
from .contradicting_donuts import Consistent, fit_consistently, without
from .degrees import FreedomEstimate, annulus_response, prior_spreads, stated_spreads
from .exposure import ExposureWavefront
from .fit_star import StarFit
from .hierarchy import Basis, ExposureAir, Observations, fit_hierarchy, star_numbers
from .image_model import STRENGTH
from .inputs import noll_indices, small_length
from .light import Instrument
from .moving_rims import FreeRims
from .shared_rims import shared_rims
from .sided_stars import FIELD_NOLL, SAME_STAR, field_basis, sided_stars
from .sides import SideAgreement, pair_agreement
from .star_errors import StarErrors, air_losses, air_of, exposure_air, further_strength, star_errors
from .star_fitter import StarSolution
from .terms import WavefrontTerms
from .wavefront_fits import NOLL, FittedStar, FittedStars, UsableStars, WavefrontFit

#: Terms up to the eleventh radial degree, which the air has beside those asked for.
_AIR_TERMS = 78
#: Rms of terms up to Z22 that are left out, as in single fits [m].
_LEFT_OUT = 200e-9
#: Least rms of the air's wavefront, Z4 to Z22 together, whose higher terms are fitted [m]: they raise the noise.
_SLIGHT_AIR = 60e-9
#: Largest rms of the air's wavefront of the prior of its higher terms [m].
_MOST_AIR = 400e-9
#: Root of the summed squares of the donuts' own wavefronts beyond which they are of no one exposure [m].
_UNLIKE = 500e-9


@check_arguments
@dataclass(frozen=True, eq=False)
class ExposureDonuts(WavefrontFit):
    """Fit of the donuts of an exposure: the telescope's wavefront, and the air's of each about it.

    For :func:`~pachon.fit_donuts`. Each donut is fitted by itself; what their wavefronts have in common over the field
    is the telescope's, and their scatter about it is the air's. Variances of both are fitted (empirical Bayes), and
    where the air has much, each donut is fitted once more with the higher terms that such air has. Results are the
    telescope's wavefront at each donut, with errors that have the air's part; the light's own wavefronts stand in
    ``fit.exposure``. Donuts of one star on both sides of focus are two exposures and share what the telescope has
    there. The side of focus is decided by all donuts of a side together.

    Attributes
    ----------
    field_noll : iterable of int
        Noll indices of terms over the field, from 1, whose radius is that of the telescope: those up to the second
        degree by default. Variances of all but the uniform one are fitted.
    noll : iterable of int
        Noll indices of the wavefront, from 4.
    higher_order : float or Quantity
        Rms of each further Zernike [m], beside the air's, as in :class:`SingleDonuts`.
    freedoms : DegreesOfFreedom, optional
        Degrees of freedom of the telescope in place of terms over the field.
    prior : array_like, mapping or tolerances, optional
        Their standard deviations, as in :class:`TelescopeFreedoms`.
    stars : sequence of int, optional
        A number for each image, the same for donuts of one star; those within 36 arcsec are of one by default.

    Raises
    ------
    ConfigError, DomainError
        If indices repeat or are too low, a number is outside its range, or there is a prior without freedoms.
    """

    joint: ClassVar[bool] = False

    field_noll: Iterable[int] = FIELD_NOLL
    noll: Iterable[int] = NOLL
    higher_order: ArrayLike = 10e-9
    freedoms: DegreesOfFreedom | None = None
    prior: ArrayLike | Mapping[str, Any] | Sequence[Tolerance] | None = None
    stars: Sequence[int] | None = None

    def __post_init__(self) -> None:
        for name, least in (("field_noll", 1), ("noll", 4)):
            object.__setattr__(self, name, tuple(noll_indices(getattr(self, name), name, least)))
        small_length(self.higher_order, "higher_order")
        if self.prior is not None:
            if self.freedoms is None:
                raise DomainError("prior: expected together with freedoms")
            stated_spreads(self.freedoms, self.prior)

    def terms(self, telescope: Telescope, atmosphere: Atmosphere | None) -> WavefrontTerms:
        """Return the terms of the wavefront of each star, those of :class:`SingleDonuts`."""
        spread, requested = small_length(self.higher_order, "higher_order"), np.array(self.noll)
        terms = WavefrontTerms.of(requested, _LEFT_OUT, spread, telescope, atmosphere)
        # The air's part is shared, and is added to the errors of all stars together.
        return replace(terms, air=np.zeros_like(terms.air))

    def refined(self, instrument: Instrument, stars: Sequence[StarSolution], fitted: FittedStars) -> Instrument | None:
        """Return terms with the higher ones of the air, if there is some, and rims that stand elsewhere for any star.

        Such a rim is then free for all stars, where they have it together, unless these contradict it.
        """
        terms, rims = self._terms_with_air(instrument, stars, fitted), FreeRims()
        if any(body.moved for star in stars for body in star.light.free_rims.bodies):
            rims = shared_rims(instrument, stars)
        if terms is None and not rims.bodies:
            return None
        return replace(instrument, terms=terms or instrument.terms, free_rims=rims)

    def _terms_with_air(
        self, instrument: Instrument, stars: Sequence[StarSolution], fitted: FittedStars
    ) -> WavefrontTerms | None:
        """Return terms with the higher ones of the air where the scatter of the stars says that there is some."""
        exposure, known = fitted.exposure, instrument.model.air.atmosphere is not None
        if known or exposure is None or exposure.air_rms < _SLIGHT_AIR:
            return None
        terms = instrument.terms
        noll = np.arange(4, max(_AIR_TERMS, int(terms.every.max())) + 1)
        further = np.concatenate([terms.further, np.setdiff1d(noll, terms.every)])
        variance = np.diag(air_of(instrument, int(noll[-1])))
        variance = min(exposure.air_rms, _MOST_AIR) ** 2 * variance[further - 4]
        strength = further_strength(instrument, stars, exposure.air_rms)
        of_telescope = np.where(terms.higher, strength, 1.0) * terms.figure
        variance[: len(terms.further)] += of_telescope[len(terms.requested) :]
        precision = np.concatenate([np.zeros(len(terms.requested)), 1.0 / variance])
        figure = np.concatenate([of_telescope, np.zeros(len(precision) - len(of_telescope))])
        losses = air_losses(instrument, stars)
        return WavefrontTerms(terms.requested, further, precision, figure, terms.air, air_losses=losses)

    def sided(self, instrument: Instrument, stars: Sequence[StarFit], fields: np.ndarray) -> list[StarFit]:
        """Return the stars with flags by the side of focus that all of them together say."""
        return sided_stars(instrument, stars, fields, self._stars(fields), self.field_noll)

    def solved(self, usable: UsableStars, pool: Executor) -> FittedStars:
        """Return the telescope's wavefront at each star, with what the scatter of all says of the air."""
        instrument = usable.instrument
        n, count = len(instrument.terms.requested), len(usable.stars)
        zernikes = np.array([star.solution.shared[:n] for star in usable.stars]).reshape(count, n)
        errors = [star_errors(instrument, star) for star in usable.stars]
        covariance = np.array([star.of_light for star in errors]).reshape(count, n, n)
        if count < 2 and (self.freedoms is None or not count):
            return FittedStars(_results(usable, errors, zernikes, np.array([star.parts.total for star in errors])))
        behind = np.array([star.light.depth > 0.0 for star in usable.stars])
        star = self._stars(usable.every_field)[usable.index]
        paired = [len(set(behind[star == number])) > 1 for number in np.unique(star)]
        exposure = behind.astype(np.int64) if any(paired) else np.zeros(count, dtype=np.int64)
        observations = Observations(zernikes, covariance, star, exposure)
        no_air = instrument.known_seeing and not any(s.solution.stars[0][STRENGTH] for s in usable.stars)
        air = exposure_air(instrument, 1e-12 if no_air else None, air_losses(instrument, usable.stars))
        freedoms = None
        double: tuple[np.ndarray | None, np.ndarray | None] = (None, None)
        if self.freedoms is None:
            basis = field_basis(instrument, usable.fields, self.field_noll)
            consistent = fit_consistently(observations, basis, air)
            hierarchy = consistent.hierarchy
            double = hierarchy.terms.reshape(-1, n), hierarchy.term_covariance
        else:
            consistent, basis, freedoms = self._freedoms(usable, observations, air)
            hierarchy = consistent.hierarchy
        sides = None
        if behind.any() and not behind.all():
            sizes, good = hierarchy.sizes, ~consistent.left_out
            of_air = sizes.air**2 * air.shape
            sides = pair_agreement(zernikes[good], covariance[good], star[good], behind[good], sizes.noise, of_air)
            sides = sides or _sides_apart(without(observations, consistent.left_out), basis, air, behind)
        strength = further_strength(instrument, usable.stars, hierarchy.sizes.air)
        figure = np.array([star.figure + strength * star.higher for star in errors])
        exposure_result = ExposureWavefront(
            instrument.terms.requested,
            hierarchy.total,
            hierarchy.total_covariance + figure,
            hierarchy.total - hierarchy.telescope,
            0.0 if no_air else hierarchy.sizes.air,
            hierarchy.sizes.shared,
            hierarchy.sizes.noise,
            sides,
            _notices(consistent, zernikes, usable.index, sides),
        )
        return FittedStars(
            _results(usable, errors, hierarchy.telescope, hierarchy.telescope_covariance + figure),
            *double,
            degrees_of_freedom=freedoms,
            exposure=exposure_result,
        )

    def _stars(self, fields: np.ndarray) -> np.ndarray:
        """Return the numbers of the stars of all images."""
        if self.stars is not None and len(self.stars) != len(fields):
            raise DomainError(f"stars of length {len(self.stars)}: expected a number for each of {len(fields)} images")
        return star_numbers(fields, SAME_STAR, self.stars)

    def _freedoms(
        self, usable: UsableStars, observations: Observations, air: ExposureAir
    ) -> tuple[Consistent, Basis, FreedomEstimate]:
        """Return the wavefronts where the telescope's is made by degrees of freedom, linear about their estimate."""
        assert self.freedoms is not None
        instrument, freedoms = usable.instrument, self.freedoms
        telescope, wavelength, noll = instrument.telescope, instrument.middle, instrument.terms.requested
        spreads = prior_spreads(freedoms, self.prior, telescope, wavelength)
        last, fields = int(noll.max()), usable.fields
        values = np.zeros(len(freedoms))
        believed, made = None, np.zeros_like(observations.zernikes)
        for _ in range(2):
            state = freedoms.apply(telescope, values)
            response = annulus_response(state, freedoms, fields, wavelength, last, usable.projection)
            columns = response[:, noll - 1] * spreads
            coefficients = wavefront_zernikes(
                state, fields, wavelength, jmax=last, pupil="full", projection=usable.projection
            ).coefficients
            believed = coefficients if believed is None else believed
            made = (coefficients - believed)[:, noll - 1] - columns @ (values / spreads)
            basis = Basis(columns, variance=np.ones(len(spreads)))
            consistent = fit_consistently(replace(observations, zernikes=observations.zernikes - made), basis, air)
            hierarchy = consistent.hierarchy
            values = hierarchy.terms * spreads
        hierarchy = replace(hierarchy, telescope=hierarchy.telescope + made, total=hierarchy.total + made)
        covariance = hierarchy.term_covariance * np.outer(spreads, spreads)
        return replace(consistent, hierarchy=hierarchy), basis, FreedomEstimate(freedoms, values, covariance, spreads)


def _results(
    usable: UsableStars, errors: Sequence[StarErrors], zernikes: np.ndarray, covariance: np.ndarray
) -> list[FittedStar]:
    """Return the results of stars whose images are those of their single fits."""
    return [
        FittedStar(
            star.full, star.model, star.solution.stars[0], alone.covariance, values, alone.parts.divided(wavefront)
        )
        for star, alone, values, wavefront in zip(usable.stars, errors, zernikes, covariance, strict=True)
    ]


def _sides_apart(observations: Observations, basis: Basis, air: ExposureAir, behind: np.ndarray) -> SideAgreement:
    """Return the agreement of donuts of different stars on both sides, by a step between them beside the basis."""
    n = observations.zernikes.shape[1]
    step = np.where(behind, 0.5, -0.5)[:, None, None] * np.eye(n)
    columns = np.concatenate([basis.columns, step], axis=2)
    if basis.variance is not None:
        wider = Basis(columns, variance=np.concatenate([basis.variance, np.full(n, 1e-6**2)]))
    else:
        assert basis.field_degree is not None
        assert basis.pupil_degree is not None
        field_degree = np.concatenate([basis.field_degree, np.zeros(n, dtype=np.int64)])
        wider = Basis(columns, field_degree, np.concatenate([basis.pupil_degree, basis.pupil_degree[:n]]))
    hierarchy = fit_hierarchy(observations, wider, air)
    difference, spread = hierarchy.terms[-n:], hierarchy.term_covariance[-n:, -n:]
    chi2 = float(difference @ np.linalg.solve(spread, difference)) / n
    return SideAgreement(0, float(np.linalg.norm(difference)), np.nan, chi2)


def _notices(
    consistent: Consistent, zernikes: np.ndarray, index: np.ndarray, sides: SideAgreement | None
) -> tuple[str, ...]:
    """Return what a user should know of the exposure; ``index`` has the numbers of the donuts among all."""
    hierarchy, left_out = consistent.hierarchy, consistent.left_out
    differences = np.linalg.norm(zernikes - hierarchy.telescope, axis=1)
    notices = [
        f"donut {number} (from 0) differs by {1e9 * nm:.0f} nm from what the others say of the telescope there: the "
        "wavefront of the exposure is without it"
        for number, nm in zip(index[left_out], differences[left_out], strict=True)
    ]
    own = float(np.sqrt(np.mean(((hierarchy.total - hierarchy.telescope) ** 2).sum(axis=1))))
    if own > _UNLIKE:
        notices.append(
            f"the donuts scatter by {1e9 * own:.0f} nm about a wavefront that is smooth over the field, more than air "
            "does: they may not be of one exposure, and belong fitted each alone then"
        )
    if sides is not None:
        notices.append(str(sides))
    return tuple(notices)
