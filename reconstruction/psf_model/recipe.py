"""Recipes of PSF models: basis, interpolation, weights and colours of the stars; the tables of all kinds by name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, TypedDict, TypeVar, get_args

import numpy as np

from ...core.errors import ConfigError, DomainError, shown
from .basis import Basis
from .checks import snr_weights
from .colour import ColourTerm
from .interpolation import FittedInterpolation, Interpolation
from .kriging import Kriging
from .pixels import Pixels
from .polynomial_fit import Polynomial
from .principal_components import PrincipalComponents
from .retired_process import FittedGaussianProcess
from .shapelets import Shapelets

_Kind = TypeVar("_Kind", Basis, Interpolation)

BasisName = Literal["pca", "pixels", "shapelets"]
#: Kinds of bases and interpolations by name. A new kind is its file and its entry here.
BASES: Mapping[str, type[Basis]] = {"pca": PrincipalComponents, "pixels": Pixels, "shapelets": Shapelets}
InterpolationName = Literal["polynomial", "kriging"]
INTERPOLATIONS: Mapping[str, type[Interpolation]] = {"polynomial": Polynomial, "kriging": Kriging}
#: Interpolations in FITS files, retired ones too.
FITTED_INTERPOLATIONS: tuple[type[FittedInterpolation], ...] = (
    *(kind.fitted for kind in INTERPOLATIONS.values()),
    FittedGaussianProcess,
)
#: Names of weights of the stars: equal, by S/N (:func:`~.checks.snr_weights`), or by noise (:mod:`~.shape_noise`).
WeightsName = Literal["equal", "snr", "softened", "noise"]
WEIGHTS: tuple[WeightsName, ...] = get_args(WeightsName)


RecipeName = Literal["kriging", "paper"]
if TYPE_CHECKING:
    BasisKey: TypeAlias = BasisName
    InterpolationKey: TypeAlias = InterpolationName
else:
    # At run time names are looked up in the tables, which say what replaced a retired one.
    BasisKey = InterpolationKey = str


class RecipeKeys(TypedDict, total=False):
    """Keys of a recipe that :meth:`~.PsfModel.fit` changes alone; None changes nothing."""

    basis: BasisKey | Basis | None
    interpolation: InterpolationKey | Interpolation | None
    n_components: int | Literal["auto"] | None
    order: int | Literal["auto"] | None
    scale: float | None


@dataclass(frozen=True)
class Recipe:
    """How a PSF model is made of stars: its basis, its interpolation over the CCD, and weights of the stars.

    Parameters
    ----------
    basis : Basis
        What stars are described in, with its options.
    interpolation : Interpolation
        Between the stars, with its options.
    weights : str
        Of the stars in polynomials, one of :data:`WEIGHTS`.
    colour : ColourTerm or None
        Dependence on the colours of stars that have one; None to ignore them.
    """

    basis: Basis
    interpolation: Interpolation
    weights: WeightsName = "equal"
    colour: ColourTerm | None = field(default_factory=ColourTerm)

    def __post_init__(self) -> None:
        for key, kind in (("basis", Basis), ("interpolation", Interpolation)):
            if not isinstance(getattr(self, key), kind):
                raise DomainError(f"{key} = {shown(getattr(self, key))}: expected a {kind.__name__}", key=key)
        if self.colour is not None and not isinstance(self.colour, ColourTerm):
            raise DomainError(f"colour = {shown(self.colour)}: expected a ColourTerm or None", key="colour")
        if not isinstance(self.weights, str) or self.weights not in WEIGHTS:
            raise ConfigError(f"weights = {shown(self.weights)}: expected one of {', '.join(WEIGHTS)}")
        if self.interpolation.needs_noise and self.weights != "equal":
            raise ConfigError(
                f"weights = {self.weights}: expected equal with interpolation = {self.interpolation.name}"
            )

    @classmethod
    def of(cls, recipe: RecipeName | Recipe | None = None, **keys: Any) -> Recipe:
        """Return a recipe or the one of a name, by default :data:`DEFAULT`, with some of its keys changed.

        With `n_components` but neither recipe nor basis it is the paper's, since pixels have none to choose. Keys are
        those of :meth:`changed`. ConfigError for a name that is none.
        """
        if recipe is None and keys.get("basis") is None and keys.get("n_components") is not None:
            recipe = "paper"
        if isinstance(recipe, str):
            if recipe not in RECIPES:
                raise ConfigError(f"recipe = {recipe!r}: expected one of {', '.join(RECIPES)}")
            recipe = RECIPES[recipe]
        return (DEFAULT if recipe is None else recipe).changed(**keys)

    def changed(
        self,
        *,
        basis: BasisKey | Basis | None = None,
        interpolation: InterpolationKey | Interpolation | None = None,
        weights: WeightsName | None = None,
        n_components: Any = None,
        scale: float | None = None,
        order: Any = None,
    ) -> Recipe:
        """Return the recipe with those keys changed that are given, and no others.

        Another kind of basis or interpolation comes with its own number of components, scale or order. ConfigError if
        a basis has no such option.
        """
        new_basis = _of_kind(self.basis, "basis", basis, BASES)
        if scale is not None and "scale" not in {field.name for field in fields(new_basis)}:
            raise ConfigError(f"scale = {scale}: expected a positive number of pixels, for shapelets only")
        options = {"n_components": n_components, "scale": scale}
        new_interpolation = _of_kind(self.interpolation, "interpolation", interpolation, INTERPOLATIONS)
        return Recipe(
            replace(new_basis, **{key: value for key, value in options.items() if value is not None}),
            new_interpolation if order is None else replace(new_interpolation, order=order),
            self.weights if weights is None else weights,
            self.colour,
        )

    def keys(self) -> dict[str, Any]:
        """Return the recipe as keys and plain values."""
        basis = {field.name: getattr(self.basis, field.name) for field in fields(self.basis)}
        return {
            "basis": self.basis.name,
            **basis,
            "interpolation": self.interpolation.name,
            "order": self.interpolation.order,
            "weights": self.weights,
            **({} if self.colour == ColourTerm() else {"colour": None if self.colour is None else self.colour.order}),
        }

    def star_weights(self, snr: np.ndarray | None = None) -> np.ndarray | Literal["noise"] | None:
        """Return the weights of stars for :meth:`~.PsfModel.fit` from their S/N [n]; ConfigError where it is needed."""
        if self.weights == "noise":
            return "noise"
        if snr is None and self.weights != "equal":
            raise ConfigError(f"weights = {self.weights!r}: expected equal, noise, or those of the stars' S/N")
        return None if snr is None else snr_weights(self.weights, snr)


#: The recipe where nothing is said: the best that knows nothing of the PSF (docs/howto/psf_models.md).
DEFAULT = Recipe(Pixels(), Kriging())
#: Recipes by name; ``paper`` is that of Jee & Tyson 2011, sec. 3.
RECIPES: Mapping[str, Recipe] = {"kriging": DEFAULT, "paper": Recipe(PrincipalComponents(), Polynomial())}


def _of_kind(present: _Kind, key: str, name: str | _Kind | None, table: Mapping[Any, type[_Kind]]) -> _Kind:
    """Return what is present where it is of that name, else the kind of the name with its own options."""
    if name is None or name == present.name:
        return present
    if not isinstance(name, str):
        return name
    if name not in table:
        raise ConfigError(f"{key} = {name!r}: expected {names_of(table, name)}")
    return table[name]()


def names_of(table: Mapping[Any, Any], name: object = None) -> str:
    """Return the names of a table in words, with what replaced a retired one."""
    replaced = ", which replaced gp" if name == FittedGaussianProcess.kind.name else ""
    return f"one of {', '.join(table)}{replaced}"
