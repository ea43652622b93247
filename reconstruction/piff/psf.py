"""PSFs of a Piff file: the model of each chip, drawn at any place of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy.wcs.wcsapi import BaseLowLevelWCS
from numpy.typing import ArrayLike

from ...core.arguments import check_arguments
from ...core.errors import DomainError, ProductError, shown
from ...core.files import parsing
from ...core.units import ARCSEC, pure_numbers, require_count
from ..psf_model.polynomial import as_positions
from .given_world import GivenWorld
from .interpolants import Interpolant, read_interpolant
from .profiles import PixelGrid, Profile, read_profile
from .tables import PiffTables
from .world import StarWorld

#: Properties of a star that its place gives.
_OF_PLACE = ("x", "y", "u", "v")
#: Parameters of a PixelGrid that old files lack: one that the flux determines, and two that the centre does.
_CONSTRAINED = (1, 3)


@dataclass(frozen=True, eq=False)
class PiffChip:
    """Model, interpolant and world coordinates of one chip."""

    profile: Profile
    interpolant: Interpolant
    world: StarWorld | GivenWorld


@check_arguments
@dataclass(frozen=True, eq=False)
class PiffPsf:
    """PSF model of Piff, without Piff.

    Attributes
    ----------
    chips : dict of int to PiffChip
        Models by the number of the chip.
    version : str
        Version of Piff that wrote the file.
    stars : dict of str to ndarray
        Stars of the file: ``x``, ``y`` [pixel, the first one is 1], ``chip``, and ``used``, whether the fit used the
        star: neither reserved nor flagged.
    """

    chips: Mapping[int, PiffChip]
    version: str
    stars: Mapping[str, Any]

    def __repr__(self) -> str:
        count, used = len(self.stars["used"]), int(self.stars["used"].sum())
        chips = f"{len(self.chips)} chip{'s' * (len(self.chips) != 1)}"
        return f"<PiffPsf: {chips}, {used} of {count} stars used, Piff {self.version}>"

    @property
    def property_names(self) -> tuple[str, ...]:
        """Properties other than its place that a star needs, such as a colour."""
        keys = [key for chip in self.chips.values() for key in chip.interpolant.keys]
        return tuple(dict.fromkeys(key for key in keys if key not in _OF_PLACE))

    @check_arguments
    def at(
        self,
        positions: ArrayLike,
        *,
        chip: int | None = None,
        size: int = 25,
        properties: Mapping[str, ArrayLike] | None = None,
    ) -> np.ndarray:
        """Draw the PSF at positions, each centred on the middle pixel ``[size // 2, size // 2]`` of its stamp.

        Parameters
        ----------
        positions : array
            Pixels (x, y) as Piff counts them, the centre of the first one at (1, 1), [n, 2].
        chip : int, optional
            Number of the chip; may be left out where there is one.
        size : int
            Pixels along a side of a stamp.
        properties : mapping of str to array, optional
            Values [n] of :attr:`property_names`.

        Returns
        -------
        ndarray, shape [n, size, size]
            Unit flux, of which some lies outside the stamp.

        Raises
        ------
        DomainError
            If there is no such chip, or a property is missing.
        """
        places, side = as_positions(positions), require_count(size, "size", 1, 10_000)
        model = self._chip(chip)
        if not len(places):
            return np.empty((0, side, side))
        field, jacobians = model.world.at(places)
        property_values = {"x": places[:, 0], "y": places[:, 1], "u": field[:, 0], "v": field[:, 1]}
        for key in self.property_names:
            if properties is None or key not in properties:
                raise DomainError(f"properties: expected values of {', '.join(self.property_names)}")
            values = pure_numbers(properties[key], f"properties[{key!r}]")
            if values.shape != (len(places),):
                raise DomainError(f"properties[{key!r}] has shape {values.shape}: expected [{len(places)}]")
            property_values[key] = values
        keys = model.interpolant.keys
        at = np.stack([property_values[key] for key in keys], axis=1) if keys else np.empty((len(places), 0))
        parameters = model.interpolant.parameters(at)
        return np.stack([model.profile.draw(p, j, side) for p, j in zip(parameters, jacobians, strict=True)])

    @check_arguments
    def draw(self, x: float, y: float, *, chip: int | None = None, size: int = 25) -> np.ndarray:
        """Draw the PSF at one position; arguments as of :meth:`at`."""
        return self.at(np.array([[x, y]]), chip=chip, size=size)[0]

    @check_arguments
    def pixel_scale(self, position: ArrayLike, *, chip: int | None = None) -> float:
        """Return the side of a square as large as a pixel at a position (x, y) [rad]."""
        jacobian = self._chip(chip).world.at(as_positions(position))[1][0]
        return float(np.sqrt(abs(np.linalg.det(jacobian))) * ARCSEC)

    def _chip(self, chip: int | None) -> PiffChip:
        chip_numbers = tuple(self.chips)
        number = chip_numbers[0] if chip is None and len(chip_numbers) == 1 else chip
        if number is None or number not in chip_numbers:
            raise DomainError(f"chip = {shown(chip)}: expected one of {', '.join(map(str, chip_numbers))}")
        return self.chips[number]


@check_arguments
def load_piff(path: str | Path, *, wcs: BaseLowLevelWCS | Mapping[int, BaseLowLevelWCS] | None = None) -> PiffPsf:
    """Read a PSF model of Piff from its FITS file, without Piff and without pickle.

    Types Simple and SingleChip, models PixelGrid (Lanczos), Gaussian, Moffat and Kolmogorov, and interpolants
    BasisPolynomial, Polynomial and Mean are read. Piff pickles the WCS of a chip; in its place stand polynomials
    through the world coordinates of the chip's stars, which have columns of their own. A :class:`~pachon.WcsWarning`
    says their error where that is above 0.1 %, as of coordinates with small-scale structure (pixmappy's, of DES).

    Parameters
    ----------
    path : str or Path
        The file.
    wcs : WCS or mapping of int to WCS, optional
        Celestial world coordinates of the image, such as an :class:`astropy.wcs.WCS`, of each chip by number where
        there are several. The tangent point is the one that puts the file's stars at their u and v.

    Raises
    ------
    ProductError
        If the file is a pickle or no file of Piff, or its type, model or interpolant is another: one line that names
        it; or if its stars are too few to show the world coordinates, or are not where `wcs` puts them.
    """
    tables = PiffTables.read(Path(path))
    with parsing(tables.path, "damaged or no FITS file of Piff", ProductError):
        return _psf_of(tables, wcs)


def _psf_of(tables: PiffTables, wcs: Any) -> PiffPsf:
    settings = tables.settings()
    kind = str(settings.get("type")).removesuffix("PSF")
    if kind not in ("Simple", "SingleChip"):
        raise tables.error(f"type = {kind}: expected one of Simple, SingleChip")
    names = tables.table("stars").names
    stars = {name: tables.column("stars", name) for name in ("x", "y")}
    of_chip = tables.column("stars", "chipnum") if "chipnum" in names else np.zeros(len(stars["x"]))
    stars["chip"] = of_chip.astype(np.int64)
    out = [tables.column("stars", name) != 0 for name in ("reserve", "flag_psf") if name in names]
    stars["used"] = ~np.any([np.zeros(len(of_chip), dtype=bool), *out], axis=0)
    if kind == "SingleChip":
        numbers = [int(n) for n in tables.column("chipnums", "chipnums")]
        chips = {n: _chip_of(tables.below(str(n)), tables, n, wcs) for n in numbers}
    else:
        numbers = sorted(set(stars["chip"].tolist()))
        chips = {n: _chip_of(tables, tables, n, wcs) for n in numbers}
    return PiffPsf(chips, str(settings.get("piff_version", "unknown")), stars)


def _chip_of(tables: PiffTables, all_stars: PiffTables, number: int, wcs: Any) -> PiffChip:
    profile, interpolant = read_profile(tables), read_interpolant(tables)
    count = len(interpolant.coefficients)
    if isinstance(profile, PixelGrid) and profile.n_parameters - count in _CONSTRAINED:
        raise tables.error(
            f"an old format: its PixelGrid of {profile.size} x {profile.size} pixels has {count} parameters; Piff "
            "before 1.0 left out those that flux and centre determine. Expected a file that Piff 1.0 or later wrote"
        )
    if count != profile.n_parameters:
        raise tables.error(f"interp has {count} parameters: expected {profile.n_parameters}, those of the model")
    chip_wcs = wcs
    if isinstance(wcs, Mapping):
        if number not in wcs:
            raise DomainError(
                f"wcs has chips {', '.join(map(str, wcs))}: expected chip {number} of the file too", key="wcs"
            )
        chip_wcs = wcs[number]
    world = StarWorld.fit(all_stars, number) if chip_wcs is None else GivenWorld.fit(all_stars, number, chip_wcs)
    return PiffChip(profile, interpolant, world)
