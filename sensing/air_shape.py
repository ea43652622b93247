r"""Shape of the covariance of the wavefront that turbulence leaves in an exposure of unknown length.

The mean over an exposure much longer than the wind needs to cross the pupil keeps of a spatial frequency
:math:`\kappa` a power that goes as :math:`1 / (\kappa v T)`, whatever the winds, if they blow from everywhere: that of
von Karman's spectrum becomes :math:`\kappa^{-1} (\kappa^2 + \kappa_0^2)^{-11/6}`. Its Zernikes have a covariance whose
shape depends on the pupil and the outer scale alone; :mod:`~pachon.wavefront.atmosphere.mean_wavefront` is that of
given winds.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.special import jv

from ..models.zernike_polynomials import annular_zernikes, noll_to_nm

#: Points of the radius and of the spatial frequency in the integrals.
_RADII = 40
_FREQUENCIES = 240
#: Largest frequency [rad per radius of the pupil]: terms of the eleventh degree have their power below 20.
_HIGHEST = 60.0
#: Lowest frequency in the same unit.
_LOWEST = 1e-2


@lru_cache(maxsize=16)
def air_shape(last: int, obscuration: float, outer_scale: float) -> np.ndarray:
    """Return the covariance of Z4 to a last term, of unit trace from Z4 to Z22, shape [last - 3, last - 3].

    Parameters
    ----------
    last : int
        Highest Noll index, from 22.
    obscuration : float
        Linear obscuration of the pupil.
    outer_scale : float
        Outer scale over the radius of the pupil; may be infinite.
    """
    degrees = [noll_to_nm(j) for j in range(4, last + 1)]
    nodes, weights = np.polynomial.legendre.leggauss(_RADII)
    radii = 0.5 * (1.0 + obscuration + (1.0 - obscuration) * nodes)
    frequencies = np.geomspace(_LOWEST, _HIGHEST, _FREQUENCIES)
    bessel = {m: jv(m, np.outer(frequencies, radii)) for m in {abs(m) for _, m in degrees}}
    # Terms of the sine have the radial profile of those of the cosine, one of which may come after the last term.
    values = annular_zernikes(last + 1, radii, np.zeros_like(radii), obscuration)
    profiles = {noll_to_nm(j): values[j - 1] for j in range(4, last + 2)}
    transforms = np.array([bessel[abs(m)] @ (profiles[n, abs(m)] * radii * weights) for n, m in degrees])
    # An interval of the logarithm of the frequency has kappa^2 d(ln kappa), of which the exposure leaves one power.
    power = frequencies * (frequencies**2 + (2.0 * np.pi / outer_scale) ** 2) ** (-11.0 / 6.0)
    covariance = (transforms * power) @ transforms.T
    same = np.array([[a[1] == b[1] for b in degrees] for a in degrees])
    covariance = np.where(same, covariance, 0.0)
    # A term of the axis fills all directions, one of a cosine half of them.
    halves = np.array([1.0 if m == 0 else 0.5 for _, m in degrees])
    covariance *= np.sqrt(np.outer(halves, halves))
    return np.asarray(covariance / np.trace(covariance[:19, :19]))
