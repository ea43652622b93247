"""Random galaxies with the counts, sizes and shapes of the Hubble Ultra Deep Field in i (F775W).

Quantities and their sources, in the order in which a galaxy is made:

counts
    N(< i) = 46 x 10^(0.31 (i - 25)) per square arcminute (LSST Science Book 2009, eq. 3.7): 8800 galaxies to 29.0 in
    the 11 square arcminutes of the Ultra Deep Field, where Coe et al. 2006 (AJ 132, 926) detect 8042 at 10 sigma.
irregular fraction
    Rising steeply to half at I = 22 (Glazebrook et al. 1995, MNRAS 275, L19) and on to I = 25 (Abraham et al. 1996,
    MNRAS 279, L47); 515 of the 884 resolved galaxies of the Ultra Deep Field (Elmegreen et al. 2005, ApJ 631, 85). Here
    it rises from 0.2 at 20 to 0.5 at 24 and stays.
kinds of irregular galaxies
    178 clump clusters, 114 chains, 126 doubles, 97 tadpoles (Elmegreen et al. 2005).
clumps
    5 to 10 with 40 % of the light (Elmegreen & Elmegreen 2005, ApJ 627, 632), 2 on the average and 8 at most in the
    ultraviolet (Soto et al. 2017, ApJ 837, 6). Here 4 to 6, so that a galaxy costs no more than seven transforms.
spheroids
    One galaxy in ten (Miller et al. 2013, MNRAS 429, 2858; 8 % to 26 by Marleau & Simard 1998, ApJ 507, 585).
scale lengths
    Median ln(r_d / arcsec) = -1.145 - 0.269 (i - 23) along the major axis of discs (Miller et al. 2013), whose
    half-light radii are 1.678 r_d. Spheroids have half those of discs (van der Wel et al. 2014, ApJ 788, 28). The
    scatter of 0.4 in the natural logarithm is theirs for late types of one mass.
ellipticities
    Of discs and of spheroids, the two priors of Miller et al. 2013, appendix B: 0.256 and 0.224 a component. Envelopes
    of irregular galaxies have axis ratios by kind, chosen to look like them, with the dispersion of all near 0.26.
bulges
    Bulge-to-total ratios are half a Gaussian of sigma 0.1; bulges have index 4 and half-light radii of 0.6 r_d (Miller
    et al. 2013).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtri

from ..core.arguments import check_arguments
from ..core.errors import DomainError, shown
from ..core.memory import require_bytes
from ..core.units import ARCMIN, ARCSEC, radians, require_positive
from .cells import SIDE, Cell, Region, poisson_arrivals
from .galaxies import Galaxies
from .morphology import ATTRIBUTES, CLUMP_ATTRIBUTES, MOST_CLUMPS, make_components

#: Galaxies brighter than 25 [1/arcmin^2] (LSST Science Book 2009, eq. 3.7).
COUNT = 46.0
#: Slope of the decimal logarithm of the counts per magnitude (ibid.).
SLOPE = 0.31
#: Median of ln(disc scale length / arcsec) at magnitude 23 (Miller et al. 2013).
LOG_LENGTH = -1.145
#: Slope of that median per magnitude (ibid.).
LENGTH_SLOPE = -0.269
#: Scatter of ln(scale length): that of late types of one mass (van der Wel et al. 2014).
LENGTH_SCATTER = 0.4
#: Half-light radius of an exponential disc over its scale length.
DISC_RADIUS = 1.678
#: Half-light radius of spheroids over the scale length of discs of the same median: half that of discs (van der
#: Wel et al. 2014).
SPHEROID_RADIUS = 0.839


def counts(magnitude: Any) -> np.ndarray:
    """Return the number of galaxies brighter than a magnitude in i per square arcminute."""
    return COUNT * 10.0 ** (SLOPE * (np.asarray(magnitude, dtype=np.float64) - 25.0))


@check_arguments
@dataclass(frozen=True)
class GalaxyPopulation:
    """Random galaxies over the whole tangent plane, the same in every region that is drawn.

    The plane is cut into cells of one arcminute, each with random streams of its own. A fainter limit adds galaxies and
    leaves the brighter ones as they were. Galaxies are not clustered.

    Parameters
    ----------
    faintest : float
        Magnitude limit in i, AB.
    seed : int
        Seed of the random numbers.
    brightest : float
        Magnitude above which there are none. The counts are a power law: brighter than 20 there are fewer galaxies than
        it has, and fewer kinds than there are.
    density : float
        Factor of the counts.
    """

    faintest: float
    seed: int
    brightest: float = 20.0
    density: float = 1.0

    def __post_init__(self) -> None:
        if not (np.isfinite([self.faintest, self.brightest]).all() and self.brightest < self.faintest <= 32.0):
            text = "expected brightest < faintest, and faintest at most 32"
            raise DomainError(f"brightest = {self.brightest}, faintest = {self.faintest}: {text}")
        require_positive(self.density, "density")
        if self.seed < 0:
            raise DomainError(f"seed = {self.seed}: expected a number that is not negative")

    @property
    def surface_density(self) -> float:
        """Mean number of galaxies per rad^2."""
        return self.density * float(counts(self.faintest) - counts(self.brightest)) / ARCMIN**2

    def galaxies_in(self, xi: ArrayLike, eta: ArrayLike) -> Galaxies:
        """Return the galaxies whose centres lie in a rectangle of the tangent plane, cell by cell.

        Parameters
        ----------
        xi, eta : (float, float) or Quantity
            Least and greatest coordinate [rad], within 20 degrees of the pointing.
        """
        region = Region.between(xi, eta)
        # A galaxy has some four components: 450 bytes, twice while they are joined.
        expected = 900 * region.area * self.surface_density
        if not np.isfinite(expected):
            raise DomainError(f"density = {self.density!r}: expected a number of galaxies that is finite")
        require_bytes(int(expected), "galaxies of this region")
        return Galaxies.concatenate([self._galaxies_of(cell, region) for cell in region.cells()])

    def _galaxies_of(self, cell: Cell, region: Region) -> Galaxies:
        """Return the galaxies of one cell that lie in a region."""
        scale = self.density * (SIDE / ARCMIN) ** 2
        bright = counts(self.brightest)
        rank = poisson_arrivals(cell.stream(self.seed, "galaxies", "magnitude"), self.surface_density * SIDE**2)
        magnitude = 25.0 + np.log10((rank / scale + bright) / COUNT) / SLOPE
        n = len(magnitude)
        # One row a galaxy, so that the first rows do not depend on how many follow.
        x, y, size, *traits = cell.stream(self.seed, "galaxies", "traits").random((n, 3 + len(ATTRIBUTES))).T
        clumps = cell.stream(self.seed, "galaxies", "clumps").random((n, MOST_CLUMPS, len(CLUMP_ATTRIBUTES)))
        xi, eta = cell.place(x, y)
        inside = region.contains(xi, eta)
        magnitude, size = magnitude[inside], size[inside]
        uniform = np.stack(traits, axis=1)[inside]
        parts = make_components(magnitude, uniform, clumps[inside])
        ratio = np.where(parts.spheroid, SPHEROID_RADIUS, DISC_RADIUS)
        length = np.exp(LOG_LENGTH + LENGTH_SLOPE * (magnitude - 23.0) + LENGTH_SCATTER * ndtri(size))
        radius = ARCSEC * ratio * length * np.sqrt(parts.axis_ratio)
        unit = np.repeat(radius, np.diff(parts.first))
        return Galaxies(
            xi[inside],
            eta[inside],
            magnitude,
            radius,
            parts.first,
            unit * parts.dx,
            unit * parts.dy,
            parts.fraction,
            unit * parts.radius,
            parts.e1,
            parts.e2,
            parts.sersic,
        )


@check_arguments
def draw_galaxies(
    region: ArrayLike, faintest: float, seed: int, *, brightest: float = 20.0, density: float = 1.0
) -> Galaxies:
    """Draw galaxies like those of the Hubble Ultra Deep Field over a part of the sky.

    Half of the faint ones are irregular: clumps in an envelope, chains, doubles, tadpoles. The module lists counts,
    sizes and shapes with their sources, :class:`GalaxyPopulation` the arguments.

    Parameters
    ----------
    region : float, Quantity, or pair of pairs
        Half-width of a square around the pointing, or the rectangle ((xi, xi), (eta, eta)) [rad].
    faintest : float
        Magnitude limit in i, AB.
    seed : int
        Seed of the random numbers: the same seed gives the same galaxies in every region.
    brightest : float
        Magnitude above which there are none.
    density : float
        Factor of the counts.

    Returns
    -------
    Galaxies

    Raises
    ------
    DomainError
        If the region, a magnitude, the seed or the density is out of range, or memory does not suffice.
    """
    population = GalaxyPopulation(faintest, seed, brightest, density)
    ends = radians(region, "region")
    if ends.shape not in ((), (2, 2)):
        raise DomainError(f"region = {shown(region)}: expected a half-width or ((xi, xi), (eta, eta))")
    if ends.shape == ():
        require_positive(ends, "region", "radians")
    square = Region.around(region) if ends.shape == () else Region.between(*ends)
    return population.galaxies_in(square.xi, square.eta)
