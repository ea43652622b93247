"""Spheroids, discs with bulges, and irregular galaxies as Sersic components, from uniform random numbers."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

#: Spheroids among all galaxies.
SPHEROIDS = 0.1
#: Irregular galaxies among all: magnitudes, fractions; constant outside.
IRREGULAR = ((20.0, 24.0), (0.2, 0.5))
#: Most clumps of an irregular galaxy.
MOST_CLUMPS = 6
#: Random numbers of a galaxy, and of each of its clumps.
ATTRIBUTES = ("kind", "irregular_kind", "axis_ratio", "angle", "index", "bulge", "clumps")
CLUMP_ATTRIBUTES = ("distance", "direction", "light", "size", "ellipticity", "angle")
#: Kind of spheroids.
SPHEROID = 0
#: Kind of discs.
DISC = 1
#: First of the irregular kinds, which follow in the order of ``IRREGULAR_KINDS``.
FIRST_IRREGULAR = 2


class IrregularKind(NamedTuple):
    """A kind of galaxy that consists of clumps in an envelope. Lengths are in half-light radii of the envelope."""

    name: str
    number: int  #: of 515 in the Ultra Deep Field (Elmegreen et al. 2005)
    axis_ratio: tuple[float, float]  #: of the envelope, uniform between the two
    clumps: tuple[int, int]  #: fewest and most
    light: float  #: fraction of the light in clumps
    spot: float  #: distance from the centre of where clumps lie, by turns at both ends of the major axis
    spread: float  #: radius of the ellipse over which they are spread there
    size: tuple[float, float]  #: half-light radii of clumps over the semi-major axis, least and greatest


IRREGULAR_KINDS = (
    IrregularKind("clump cluster", 178, (0.5, 1.0), (4, MOST_CLUMPS), 0.4, 0.0, 1.5, (0.12, 0.3)),
    IrregularKind("chain", 114, (0.2, 0.4), (4, MOST_CLUMPS), 0.4, 0.0, 1.7, (0.1, 0.2)),
    IrregularKind("double", 126, (0.5, 0.9), (2, 2), 0.7, 0.8, 0.3, (0.25, 0.45)),
    IrregularKind("tadpole", 97, (0.2, 0.5), (1, 1), 0.45, 1.1, 0.2, (0.15, 0.3)),
)
# Sersic index of envelopes and clumps, which are flat and have no exponential disc.
_ENVELOPE_INDEX = 0.7
# Sersic index of bulges (Miller et al. 2013).
_BULGE_INDEX = 4.0
# Medians and scatter of ln n of discs and spheroids, and their ranges.
_INDICES = {DISC: (1.0, 0.25, 0.6, 2.0), SPHEROID: (3.5, 0.3, 1.5, 6.0)}
# Sigma of the bulge-to-total ratio (Miller et al. 2013).
_BULGE_RATIO = 0.1
# Half-light radius of a bulge over that of its disc: 0.6 scale lengths (Miller et al. 2013) over 1.678.
_BULGE_RADIUS = 0.6 / 1.678
# Scatter of the logarithm of the light of clumps.
_CLUMP_SCATTER = 0.5
# Greatest ellipticity of clumps.
_CLUMP_ELLIPTICITY = 0.3


class Components(NamedTuple):
    """Components of galaxies in units of the half-light radius of each whole galaxy."""

    first: np.ndarray  #: first component of each galaxy, [n + 1]
    axis_ratio: np.ndarray  #: of the main component of each galaxy, [n]
    spheroid: np.ndarray  #: whether each galaxy is a spheroid, [n]
    dx: np.ndarray  #: [m], as in ``Galaxies``
    dy: np.ndarray
    fraction: np.ndarray
    radius: np.ndarray
    e1: np.ndarray
    e2: np.ndarray
    sersic: np.ndarray


def irregular_fraction(magnitude: np.ndarray) -> np.ndarray:
    """Return the fraction of irregular galaxies at a magnitude."""
    return np.interp(magnitude, *IRREGULAR)


def galaxy_kinds(magnitude: np.ndarray, kind: np.ndarray, irregular_kind: np.ndarray) -> np.ndarray:
    """Return 0 for a spheroid, 1 for a disc, 2 and more for the irregular kinds, from two uniform numbers each, [n]."""
    share = np.cumsum([k.number for k in IRREGULAR_KINDS])
    irregular_index = np.searchsorted(share[:-1], irregular_kind * share[-1], side="right")
    regular = np.where(kind < SPHEROIDS, SPHEROID, DISC)
    return np.where(kind >= 1.0 - irregular_fraction(magnitude), FIRST_IRREGULAR + irregular_index, regular)


@lru_cache(maxsize=2)
def _ellipticity_quantiles(spheroid: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return cumulative probabilities of ellipticities (Miller et al. 2013, appendix B), and the ellipticities."""
    if spheroid:
        e = np.linspace(0.0, 1.0, 1001)[:-1]
        density = e * np.exp(-2.368 * e - 6.691 * e**2)
    else:
        e = np.linspace(0.0, 0.804, 1001)
        density = e * (1.0 - np.exp((e - 0.804) / 0.2539)) / ((1.0 + e) * np.sqrt(e**2 + 0.0256**2))
    total = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]))])
    return total / total[-1], e


def draw_ellipticity(uniform: np.ndarray, *, spheroid: bool) -> np.ndarray:
    """Return (a - b)/(a + b) of spheroids or discs, from uniform numbers."""
    return np.interp(uniform, *_ellipticity_quantiles(spheroid))


def make_components(magnitude: np.ndarray, uniform: np.ndarray, clump_uniform: np.ndarray) -> Components:
    """Return the components of galaxies.

    Parameters
    ----------
    magnitude : ndarray, shape [n]
        AB magnitudes in i.
    uniform : ndarray, shape [n, 7]
        Uniform random numbers, in the order of ``ATTRIBUTES``.
    clump_uniform : ndarray, shape [n, 6, 6]
        Likewise of every clump, in the order of ``CLUMP_ATTRIBUTES``.
    """
    u = dict(zip(ATTRIBUTES, uniform.T, strict=True))
    kind = galaxy_kinds(magnitude, u["kind"], u["irregular_kind"])
    n = len(magnitude)
    # Column 0: disc, spheroid or envelope. Then the bulge, or clumps; those without light are left out below.
    fraction = np.zeros((n, 1 + MOST_CLUMPS))
    place = np.zeros((n, 1 + MOST_CLUMPS), dtype=complex)
    radius = np.ones((n, 1 + MOST_CLUMPS))
    ellipticity = np.zeros((n, 1 + MOST_CLUMPS), dtype=complex)
    sersic = np.full((n, 1 + MOST_CLUMPS), _ENVELOPE_INDEX)
    fraction[:, 0] = 1.0
    direction = np.exp(2j * np.pi * u["angle"])

    for regular in (SPHEROID, DISC):
        of = kind == regular
        median, scatter, least, greatest = _INDICES[regular]
        sersic[of, 0] = np.clip(median * np.exp(scatter * ndtri(u["index"][of])), least, greatest)
        ellipticity[of, 0] = direction[of] * draw_ellipticity(u["axis_ratio"][of], spheroid=regular == SPHEROID)
    discs = kind == DISC
    fraction[discs, 1] = _BULGE_RATIO * ndtri(0.5 + 0.5 * u["bulge"][discs])
    fraction[discs, 0] -= fraction[discs, 1]
    radius[discs, 1] = _BULGE_RADIUS
    sersic[discs, 1] = _BULGE_INDEX
    ellipticity[discs, 1] = ellipticity[discs, 0]

    for number, traits in enumerate(IRREGULAR_KINDS, start=FIRST_IRREGULAR):
        of = kind == number
        axis_ratio = traits.axis_ratio[0] + (traits.axis_ratio[1] - traits.axis_ratio[0]) * u["axis_ratio"][of]
        e = direction[of] * (1.0 - axis_ratio) / (1.0 + axis_ratio)
        ellipticity[of, 0] = e
        _add_clumps(traits, of, e, u["clumps"][of], clump_uniform[of], fraction, place, radius, ellipticity)

    place -= np.sum(fraction * place, axis=1, keepdims=True)
    # Half-light radius of a sum of round Gaussians about one centre, to first order in their differences.
    galaxy_radius = np.sqrt(np.sum(fraction * (radius**2 + np.log(2.0) * np.abs(place) ** 2), axis=1, keepdims=True))
    present = fraction > 0.0
    main = np.abs(ellipticity[:, 0])
    return Components(
        first=np.concatenate([[0], np.cumsum(present.sum(axis=1))]),
        axis_ratio=(1.0 - main) / (1.0 + main),
        spheroid=kind == SPHEROID,
        dx=(place / galaxy_radius).real[present],
        dy=(place / galaxy_radius).imag[present],
        fraction=fraction[present],
        radius=(radius / galaxy_radius)[present],
        e1=ellipticity.real[present],
        e2=ellipticity.imag[present],
        sersic=sersic[present],
    )


def _add_clumps(
    traits: IrregularKind,
    of: np.ndarray,
    envelope: np.ndarray,
    count: np.ndarray,
    clump_uniform: np.ndarray,
    fraction: np.ndarray,
    place: np.ndarray,
    radius: np.ndarray,
    ellipticity: np.ndarray,
) -> None:
    """Put clumps into the galaxies of one kind, whose envelopes have the given complex ellipticities."""
    u = dict(zip(CLUMP_ATTRIBUTES, np.moveaxis(clump_uniform, 2, 0), strict=True))
    low, high = traits.clumps
    number = low + np.floor((high - low + 1) * count)
    order = np.arange(MOST_CLUMPS)
    light = np.where(order < number[:, None], np.exp(_CLUMP_SCATTER * ndtri(u["light"])), 0.0)
    light *= traits.light / light.sum(axis=1, keepdims=True)
    # On the unit circle of the envelope, along its major axis; then as the envelope is stretched.
    e = envelope[:, None]
    along = traits.spot * np.where(order % 2, -1.0, 1.0) * np.sqrt(e / np.abs(e))
    circle = along + traits.spread * np.sqrt(u["distance"]) * np.exp(2j * np.pi * u["direction"])
    least, greatest = traits.size
    semi_major = np.sqrt((1.0 + np.abs(e)) / (1.0 - np.abs(e)))
    fraction[of, 0] -= traits.light
    fraction[of, 1:] = light
    place[of, 1:] = (circle + e * np.conj(circle)) / np.sqrt(1.0 - np.abs(e) ** 2)
    radius[of, 1:] = (least + (greatest - least) * u["size"]) * semi_major
    ellipticity[of, 1:] = _CLUMP_ELLIPTICITY * np.sqrt(u["ellipticity"]) * np.exp(2j * np.pi * u["angle"])
