"""Cases of the study of PSF models: the parameters of each, and the combinations that are tried."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import cast

from ...core.errors import ConfigError
from ...pipeline.config import Configuration
from ...reconstruction.psf_model.basis import COMPONENTS
from ...reconstruction.psf_model.polynomial import term_count
from ...reconstruction.psf_model.polynomial_fit import Polynomial
from ...reconstruction.psf_model.recipe import BASES, DEFAULT, INTERPOLATIONS, Recipe, WeightsName

#: Weights of the stars in the polynomials, as of a recipe (equal in the paper).
POLYNOMIALS = ("equal", "snr", "softened")
#: Models of the shapes on all CCDs together in place of one of each CCD, without the telescope and with it, in words.
FOCAL_PLANE = {"no_telescope": "focal plane, no telescope", "focal_plane": "focal plane"}
#: Signal-to-noise ratio, or stars without noise.
NOISE_FREE = math.inf
#: Interpolations with the noise of each star, whose order is fixed here, and their names.
PROCESSES = {name: kind.label for name, kind in INTERPOLATIONS.items() if kind.needs_noise}


@dataclass(frozen=True)
class Case:
    """Parameters of a PSF model."""

    stars: int  #: stars of a CCD
    snr: float = 30.0  #: S/N of the faintest star; :data:`NOISE_FREE` for stars without noise
    basis: str = "pca"  #: one of :data:`~pachon.reconstruction.psf_model.recipe.BASES`; moments of a focal-plane model
    interpolation: str = "equal"  #: one of :data:`POLYNOMIALS`, :data:`PROCESSES`, :data:`FOCAL_PLANE`
    order: int = 3  #: of the polynomials, or the trend under a process
    components: int = 20  #: of the basis; 0 for pixels, which are all used

    @property
    def terms(self) -> int:
        """Number of terms of a polynomial."""
        return term_count(self.order)

    @property
    def noise_text(self) -> str:
        """Noise of the stars, in words."""
        return "without noise" if self.snr == NOISE_FREE else f"of S/N {self.snr:g} and more"

    def normalised(self) -> Case:
        """Return the case as it is fitted: parameters without effect have one value."""
        if self.interpolation in FOCAL_PLANE:
            return replace(self, basis="moments", order=0, components=3)
        basis = BASES[self.basis]
        # Variations of pixels, which have no number of components, have the default one.
        components = (self.components or COMPONENTS) if basis.has_components else 0
        if basis.ordered:
            components = min(components, self.stars - 1)
        fitted = replace(self, components=components)
        order = self.order if self.interpolation in POLYNOMIALS else fitted.recipe().interpolation.fixed_order or 0
        interpolation = self.interpolation
        if self.snr == NOISE_FREE and interpolation in POLYNOMIALS:
            interpolation = "equal"
        return replace(fitted, order=order, interpolation=interpolation)

    @classmethod
    def of_recipe(cls, stars: int, snr: float, recipe: Recipe) -> Case:
        """Return the case of a recipe."""
        keys, interpolation = recipe.keys(), recipe.interpolation
        how = interpolation.name if interpolation.needs_noise else recipe.weights
        return cls(stars, snr, recipe.basis.name, how, keys["order"], keys["n_components"] or 0).normalised()

    def recipe(self) -> Recipe:
        """Return the recipe of the case, with the order of the interpolation itself under a process."""
        basis = BASES[self.basis]() if not self.components else BASES[self.basis](self.components)
        if self.interpolation in PROCESSES:
            return Recipe(basis, INTERPOLATIONS[self.interpolation]())
        return Recipe(basis, Polynomial(self.order), cast("WeightsName", self.interpolation))

    def __str__(self) -> str:
        if self.interpolation in FOCAL_PLANE:
            return FOCAL_PLANE[self.interpolation]
        how = PROCESSES.get(self.interpolation, f"order {self.order}, {self.interpolation} weights")
        description = f"{self.components} components of {self.basis}" if self.components else self.basis
        return f"{description}, {how}"


@dataclass(frozen=True)
class Plan:
    """Values of the parameters of a study, ascending, with those of the base, whose other parameters do not vary."""

    base: Case
    stars: tuple[int, ...]
    orders: tuple[int, ...]
    components: tuple[int, ...]
    snrs: tuple[float, ...]
    draws: int = 4  #: of the noise
    focal_plane: bool = False  #: whether there are models of the whole focal plane

    @property
    def without_polynomials(self) -> tuple[str, ...]:
        """Interpolations that have no order: processes on each CCD, and models of the whole focal plane."""
        return (*PROCESSES, *(FOCAL_PLANE if self.focal_plane else ()))

    @property
    def default(self) -> Case:
        """The base's stars under the recipe where nothing is said."""
        return Case.of_recipe(self.base.stars, self.base.snr, DEFAULT)

    def cases(self) -> tuple[Case, ...]:
        """Return the cases of the study, each once.

        All combinations would be thousands. Each parameter has an axis through the base, and parameters that depend on
        each other have a plane: stars and order, order and components.
        """
        base = self.base
        polynomials, without_order = POLYNOMIALS, self.without_polynomials
        all_cases: list[Case] = []

        def sweep(**axes: Sequence[object]) -> None:
            for values in product(*axes.values()):
                all_cases.append(replace(base, **dict(zip(axes, values, strict=True))).normalised())  # type: ignore[arg-type]

        sweep(stars=self.stars, snr=(base.snr, NOISE_FREE), interpolation=polynomials, order=self.orders)
        sweep(order=self.orders, components=self.components, interpolation=polynomials)
        sweep(stars=self.stars, components=self.components, interpolation=polynomials)
        sweep(snr=(NOISE_FREE,), order=self.orders, components=self.components)
        sweep(snr=self.snrs, order=self.orders, interpolation=polynomials)
        sweep(basis=tuple(BASES), stars=self.stars, snr=(base.snr, NOISE_FREE), interpolation=polynomials)
        sweep(basis=tuple(BASES), order=self.orders, interpolation=polynomials)
        sweep(basis=tuple(BASES), components=self.components, interpolation=polynomials)
        all_cases += [replace(self.default, stars=n, snr=snr) for n in self.stars for snr in (base.snr, NOISE_FREE)]
        sweep(stars=self.stars, snr=(base.snr, NOISE_FREE), interpolation=without_order)
        sweep(components=self.components, interpolation=without_order)
        sweep(snr=self.snrs, interpolation=without_order)
        return tuple(dict.fromkeys(all_cases))


def make_plan(
    config: Configuration,
    *,
    stars: Iterable[int] = (10, 20, 40, 80, 160),
    orders: Iterable[int] = (1, 2, 3, 4, 5, 6),
    components: Iterable[int] = (5, 10, 20, 40),
    snrs: Iterable[float] = (30.0, 100.0, 300.0),
    draws: int = 4,
) -> Plan:
    """Return a plan around the observed stars, S/N and reconstruction of a configuration.

    Its base is the configuration's model of a CCD. Models of the whole focal plane are added if the configuration has
    one.
    """
    fit = config.reconstruction
    base = Case.of_recipe(config.stars.observed, config.stars.snr_min, fit.psf_recipe())

    def values(name: str, given: Iterable[float], own: float, least: float) -> tuple[float, ...]:
        for value in (*given, own):
            if not (math.isfinite(value) and value >= least):
                raise ConfigError(f"{name} = {value:g}: expected finite numbers from {least:g}")
        return tuple(sorted({*given, own}))

    if draws < 1:
        raise ConfigError(f"draws = {draws}: expected at least 1")
    return Plan(
        base,
        tuple(int(n) for n in values("stars", tuple(stars), base.stars, 2)),
        tuple(int(n) for n in values("orders", tuple(orders), base.order, 0)),
        tuple(int(n) for n in values("components", tuple(components), base.components or COMPONENTS, 1)),
        values("snr", tuple(snrs), base.snr, 1.0),
        draws,
        fit.model == "focal_plane",
    )
