"""Maximum-likelihood fits of PSF-convolved elliptical Gaussians to galaxies (Jee et al. 2009; Jee & Tyson 2011)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core.arguments import check_arguments, removed_arguments
from ...core.errors import DomainError
from ...core.number_text import counted
from ...core.threads import one_blas_thread
from ...core.units import pure_numbers, real_array
from .cutouts import cut_out, first_pixel
from .galaxy_fits import GalaxyFits, GalaxyFlag, joined
from .gaussian_model import PARAMETERS, SIDE_STEP, GaussianStamps
from .levenberg_marquardt import Bounds, LevenbergMarquardt
from .pixel_checks import check_pixels

#: Sides of the stamps of galaxies in images [pixel]; a galaxy gets the smallest that reaches over
#: :data:`STAMP_RADII` half-light radii to either side, at least the first.
STAMP_SIDES = (32, 48, 64, 96, 128)
STAMP_RADII = 4.0
#: A fit is flagged where a larger fraction of the pixels in the inner half of its stamp is masked.
MOST_MASKED = 0.25
# Least eigenvalue of the covariance over the variance of the PSF: noise may make the image of a point sharper.
_LEAST_MOMENT = -0.25
# Largest rms width of a galaxy, over the side of its stamp.
_MOST_WIDTH = 0.5
# Largest shift of the centre along an axis, over the side of the stamp.
_REACH = 0.25
# Numbers of stamps, weights and transforms held at a time: 64 MB.
_BATCH_NUMBERS = 1 << 23
# Largest deviation of the sum of a PSF from 1.
_PSF_SUM_TOLERANCE = 1e-4


@removed_arguments(
    max_evaluations="solver=LevenbergMarquardt(max_evaluations=...)",
    tolerance="solver=LevenbergMarquardt(tolerance=...)",
)
@check_arguments
def fit_galaxies(
    image: ArrayLike,
    variance: ArrayLike,
    x: ArrayLike,
    y: ArrayLike,
    psf_images: ArrayLike,
    *,
    half_light_radius: ArrayLike,
    psf_index: ArrayLike | None = None,
    mask: ArrayLike | NDArray[np.bool_] | None = None,
    segmentation: ArrayLike | None = None,
    solver: LevenbergMarquardt | None = None,
    threads: int | None = None,
) -> GalaxyFits:
    r"""Fit PSF-convolved elliptical Gaussians to the galaxies of an image by maximum likelihood.

    Minimizes the sum over pixels of (data - model)^2 / variance by Levenberg-Marquardt, without priors, with analytic
    derivatives. The parameters are flux, centre and the covariance matrix of the Gaussian *before* the PSF:
    the model is smooth where that goes through zero, so the fit of a point-like galaxy stays regular and its
    errors Gaussian, where the logarithm of the size runs away and the ellipticity has no meaning.

    Every galaxy is fitted on its own: the same bytes on any number of threads and from any part of the catalogue.

    Parameters
    ----------
    image : array
        [ny, nx], background subtracted, in any unit.
    variance : array
        Of the pixels, in the square of that unit, [ny, nx].
    x, y : array
        Approximate centres, pixel centres at integers [pixel], [n].
    psf_images : array
        PSF at each galaxy, [n, m, m], or one for all, [m, m]: unit sum, m odd, centred on a pixel, pixel included.
    half_light_radius : float or array
        Of the galaxies on the image [pixel], which determines their stamps: :data:`STAMP_RADII` of them to either side.
        NaN, as of an object without flux, for the smallest stamp.
    psf_index : array of int, optional
        Index into `psf_images` of each galaxy's PSF, [n]: quicker than an image for each where galaxies share one.
    mask : array, optional
        [ny, nx], not zero for pixels to ignore, besides those that are not finite, or -1e29 or less, or of a variance
        that is not finite.
    segmentation : array of int, optional
        [ny, nx], 0 for sky, otherwise the number of an object: pixels of objects other than the one at (x, y) are
        ignored.
    solver : LevenbergMarquardt, optional
        When a fit ends, and its errors; 30 models at most, a change of 1e-5, whole errors by default.
    threads : int, optional
        All processors by default.

    Returns
    -------
    GalaxyFits
        In the order of x and y.

    Raises
    ------
    DomainError
        If shapes differ, a pixel that is not masked has no positive variance, a position lies outside the image, or a
        PSF has an even side or no unit sum.
    """
    solver = solver or LevenbergMarquardt()
    pixels, variances, ignored = check_pixels(image, variance, mask)
    places = _checked_positions(x, y, pixels.shape)
    count = len(places)
    radii = pure_numbers(half_light_radius, "half_light_radius")
    try:
        radius = np.broadcast_to(radii, (count,))
    except (TypeError, ValueError) as error:
        raise DomainError(f"half_light_radius: expected one number or {count}") from error
    radius = np.where(np.isnan(radius), 0.5 * STAMP_SIDES[0] / STAMP_RADII, radius)
    if not (np.isfinite(radius).all() and (radius > 0.0).all()):
        raise DomainError("half_light_radius: expected positive, finite numbers of pixels")
    psfs, templates = _checked_psfs(psf_images, psf_index, count)
    labels = None if segmentation is None else np.asarray(segmentation)
    if labels is not None and (labels.shape != pixels.shape or labels.dtype.kind not in "iub"):
        raise DomainError(
            f"segmentation has shape {labels.shape} and type {labels.dtype}: expected integers {pixels.shape}"
        )
    weight = np.where(ignored, 0.0, 1.0 / np.where(ignored, 1.0, variances))
    data = np.where(ignored, 0.0, pixels)
    side_index = np.searchsorted(STAMP_SIDES, 2.0 * STAMP_RADII * radius)
    choice = np.minimum(side_index, len(STAMP_SIDES) - 1)
    parts, members = [_no_fits()], [np.empty(0, dtype=np.int64)]
    for k, side in enumerate(STAMP_SIDES):
        batch = _batch_size(side, psfs.shape[-1])
        for group in _index_chunks(np.flatnonzero(choice == k), batch):
            px, py = places[group].T
            corner = np.stack([first_pixel(px, side), first_pixel(py, side)], axis=1)
            stamps, weights = (cut_out(values, px, py, side, 0.0) for values in (data, weight))
            if labels is not None:
                stamp_labels = cut_out(labels, px, py, side, 0)
                galaxy_labels = labels[np.rint(py).astype(np.int64), np.rint(px).astype(np.int64)]
                weights[(stamp_labels != 0) & (stamp_labels != galaxy_labels[:, None, None])] = 0.0
            middle = corner + 0.5 * (side - 1)
            beyond = (corner < 0).any(axis=1) | (corner + side > np.array(pixels.shape[::-1])).any(axis=1)
            flags = np.where(beyond, GalaxyFlag.EDGE, 0)
            flags[side_index[group] == len(STAMP_SIDES)] |= GalaxyFlag.CUT_OFF
            parts.append(
                _fit_stamps(
                    stamps, weights, middle, places[group], psfs, templates[group], flags, None, solver, threads
                )
            )
            members.append(group)
    return joined(parts, members)


@removed_arguments(
    max_evaluations="solver=LevenbergMarquardt(max_evaluations=...)",
    tolerance="solver=LevenbergMarquardt(tolerance=...)",
)
@check_arguments
def fit_galaxy_stamps(
    stamps: ArrayLike,
    variance: ArrayLike,
    psf_images: ArrayLike,
    *,
    psf_index: ArrayLike | None = None,
    mask: ArrayLike | NDArray[np.bool_] | None = None,
    start: GalaxyFits | None = None,
    solver: LevenbergMarquardt | None = None,
    threads: int | None = None,
) -> GalaxyFits:
    """Fit galaxies on given stamps, otherwise as :func:`fit_galaxies`.

    Parameters
    ----------
    stamps, variance : array
        [n, ny, nx] pixels, background subtracted, and their variance; one variance may stand for all.
    psf_images : array
        [n, m, m], or one for all, [m, m].
    psf_index : array of int, optional
        Index into `psf_images` of each galaxy's PSF, [n].
    mask : array, optional
        [n, ny, nx], not zero for pixels to ignore, besides those of :func:`fit_galaxies`.
    start : GalaxyFits, optional
        Earlier fits of the same galaxies, such as with other PSFs, near which to begin; by default moments of the
        stamps.

    Returns
    -------
    GalaxyFits
        Centres from the centre of the stamp, ``((ny - 1)/2, (nx - 1)/2)``.

    Raises
    ------
    DomainError
        As of :func:`fit_galaxies`.
    """
    solver = solver or LevenbergMarquardt()
    pixels, variances, ignored = check_pixels(stamps, variance, mask, axes="[n, ny, nx]", name="stamps")
    count, ny, nx = pixels.shape
    psfs, templates = _checked_psfs(psf_images, psf_index, count)
    if start is not None and len(start) != count:
        raise DomainError(f"start: {len(start)} fits of {counted(count, 'galaxy', 'galaxies')}")
    side = -(-max(ny, nx) // SIDE_STEP) * SIDE_STEP
    first_row, first_column = (side - ny) // 2, (side - nx) // 2
    parts, members = [_no_fits()], [np.empty(0, dtype=np.int64)]
    for group in _index_chunks(np.arange(count), _batch_size(side, psfs.shape[-1])):
        data, weights = np.zeros((2, len(group), side, side))
        inside = np.s_[:, first_row : first_row + ny, first_column : first_column + nx]
        good = ~ignored[group]
        data[inside][good] = pixels[group][good]
        weights[inside][good] = 1.0 / variances[group][good]
        # The centre of a stamp of an odd side is half a pixel from that of an even one.
        offset = np.array([first_column + 0.5 * (nx - 1), first_row + 0.5 * (ny - 1)]) - 0.5 * (side - 1)
        middle, place = np.broadcast_to(-offset, (len(group), 2)), np.zeros((len(group), 2))
        flags = np.zeros(len(group), dtype=np.int32)
        earlier_params = None if start is None else _fit_parameters(start)[group]
        parts.append(
            _fit_stamps(data, weights, middle, place, psfs, templates[group], flags, earlier_params, solver, threads)
        )
        members.append(group)
    return joined(parts, members)


def _fit_parameters(fits: GalaxyFits) -> np.ndarray:
    return np.column_stack([fits.flux, fits.x, fits.y, fits.moments])


def _fit_stamps(
    data: np.ndarray,
    weight: np.ndarray,
    middle: np.ndarray,
    place: np.ndarray,
    psfs: np.ndarray,
    templates: np.ndarray,
    flags: np.ndarray,
    earlier_params: np.ndarray | None,
    solver: LevenbergMarquardt,
    threads: int | None,
) -> GalaxyFits:
    """Fit stamps [n, side, side] with middles at `middle` and galaxies near `place`, both [n, 2], and add to flags.

    `earlier_params` [n, 6] are parameters of earlier fits.
    """
    center = place - middle
    side = data.shape[-1]
    used, psf_index = np.unique(templates, return_inverse=True)
    # Of round Gaussians with the same peaks: the scale of the start and of the bounds, no more.
    psf_variance = (0.5 / (np.pi * psfs[used].max(axis=(1, 2))))[psf_index]
    fitter = GaussianStamps(psfs[used], psf_index, data, weight, threads)
    bounds = Bounds(center, _REACH * side, _LEAST_MOMENT * psf_variance, (_MOST_WIDTH * side) ** 2)
    start = _moment_estimates(data, weight, center, psf_variance)
    if earlier_params is not None:
        shifted = np.concatenate(
            [earlier_params[:, :1], earlier_params[:, 1:3] - middle, earlier_params[:, 3:]], axis=1
        )
        usable = np.isfinite(shifted).all(axis=1)
        start[usable] = shifted[usable]
    # Steps are solved by LAPACK, whose result must not depend on its threads.
    with one_blas_thread():
        minimum = solver.minimize(fitter, start, bounds)
        covariance = solver.covariance(fitter, minimum)
    inner = np.s_[:, side // 4 : side - side // 4, side // 4 : side - side // 4]
    n_pixels = (weight > 0.0).sum(axis=(1, 2))
    flags = flags.astype(np.int32)
    flags[~minimum.converged | ~np.isfinite(covariance).all(axis=(1, 2))] |= GalaxyFlag.NOT_CONVERGED
    flags[minimum.at_bounds] |= GalaxyFlag.AT_BOUNDS
    flags[(weight[inner] == 0.0).mean(axis=(1, 2)) > MOST_MASKED] |= GalaxyFlag.MASKED
    xx, xy, yy = minimum.params[:, 3:].T
    flags[(xx * yy <= xy**2) | (xx <= 0.0)] |= GalaxyFlag.UNRESOLVED
    flags[minimum.params[:, 0] <= 0.0] |= GalaxyFlag.NO_FLUX
    return GalaxyFits(
        flux=minimum.params[:, 0],
        x=minimum.params[:, 1] + middle[:, 0],
        y=minimum.params[:, 2] + middle[:, 1],
        moments=minimum.params[:, 3:],
        covariance=covariance,
        chi2=minimum.equations.chi2,
        pixels=n_pixels.astype(np.int32),
        evaluations=minimum.evaluations,
        flags=flags,
    )


def _moment_estimates(data: np.ndarray, weight: np.ndarray, center: np.ndarray, psf_variance: np.ndarray) -> np.ndarray:
    """Return approximate parameters [n, 6] from moments under a round Gaussian twice as wide as the PSF."""
    side = data.shape[-1]
    width = 4.0 * psf_variance
    x, y = (np.arange(side) - 0.5 * (side - 1) - center[:, k, None] for k in range(2))
    window_x, window_y = (np.exp(-0.5 * v**2 / width[:, None]) for v in (x, y))
    light = np.where(weight > 0.0, data, 0.0) * window_y[:, :, None] * window_x[:, None, :]
    along_x, along_y = light.sum(axis=1), light.sum(axis=2)
    total = along_x.sum(axis=1)
    positive = total > 0.0
    safe = np.where(positive, total, 1.0)
    spread = 0.5 * ((along_x * x**2).sum(axis=1) + (along_y * y**2).sum(axis=1)) / safe
    # The inverse variances of a Gaussian and of its window add up.
    windowed_variance = np.clip(spread, 0.25 * width, 0.9 * width)
    variance = 1.0 / (1.0 / windowed_variance - 1.0 / width)
    galaxy_variance = np.maximum(np.where(positive, variance, 2.0 * psf_variance) - psf_variance, 0.3 * psf_variance)
    flux = np.where(positive, total, np.abs(light).sum(axis=(1, 2))) * (1.0 + variance / width)
    return np.stack([flux, center[:, 0], center[:, 1], galaxy_variance, np.zeros(len(data)), galaxy_variance], axis=1)


def _checked_psfs(psf_images: ArrayLike, psf_index: ArrayLike | None, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the PSFs [m, side, side] and the index [n] of each galaxy's."""
    psfs = real_array(psf_images, "psf_images: expected real numbers [n, m, m] or [m, m]")
    shared = psfs.ndim == 2
    psfs = psfs[None] if shared else psfs
    if psfs.ndim != 3 or psfs.shape[1] != psfs.shape[2] or psfs.shape[1] % 2 == 0:
        raise DomainError(f"psf_images have shape {psfs.shape}: expected [n, m, m] or [m, m] with an odd m")
    if psf_index is not None:
        index = np.asarray(psf_index)
        if index.dtype.kind not in "iu" or index.shape != (count,):
            text = f"psf_index has shape {index.shape} and type {index.dtype}: expected {count} integers"
            raise DomainError(text)
        if count and not (index.min() >= 0 and index.max() < len(psfs)):
            raise DomainError(f"psf_index: {index.min()} to {index.max()}, expected 0 to {len(psfs) - 1}")
    elif not shared and len(psfs) != count:
        raise DomainError(f"psf_images: {len(psfs)} for {counted(count, 'galaxy', 'galaxies')}")
    sums = psfs.sum(axis=(1, 2))
    wrong = ~(np.abs(sums - 1.0) < _PSF_SUM_TOLERANCE)
    if wrong.any():
        i = int(wrong.argmax())
        raise DomainError(f"psf_images[{i}] has a sum of {sums[i]:.6g}: expected 1 within {_PSF_SUM_TOLERANCE:g}")
    if psf_index is not None:
        return psfs, index.astype(np.int64)
    return psfs, np.zeros(count, dtype=np.int64) if shared else np.arange(count)


def _checked_positions(x: ArrayLike, y: ArrayLike, shape: tuple[int, ...]) -> np.ndarray:
    """Return the positions [n, 2]."""
    px, py = (real_array(v, f"{name}: expected real numbers [n]") for v, name in ((x, "x"), (y, "y")))
    if px.ndim != 1 or px.shape != py.shape:
        raise DomainError(f"x and y have shapes {px.shape} and {py.shape}: expected [n] twice")
    inside = (px >= -0.5) & (px < shape[1] - 0.5) & (py >= -0.5) & (py < shape[0] - 0.5)
    if not inside.all():
        i = int(np.argmin(inside))
        raise DomainError(f"x, y [{i}] = ({px[i]:.6g}, {py[i]:.6g}): expected a position in the image of {shape[::-1]}")
    return np.stack([px, py], axis=1)


def _batch_size(side: int, psf_side: int) -> int:
    """Return how many galaxies are held at a time."""
    return max(1, _BATCH_NUMBERS // (4 * side**2 + (side + psf_side) ** 2))


def _index_chunks(indices: np.ndarray, size: int) -> list[np.ndarray]:
    """Return indices in parts of a size."""
    return [indices[i : i + size] for i in range(0, len(indices), size)]


def _no_fits() -> GalaxyFits:
    """Return the fits of no galaxies."""
    empty_floats, count = np.empty(0), len(PARAMETERS)
    empty_ints = np.empty(0, dtype=np.int32)
    return GalaxyFits(
        empty_floats,
        empty_floats,
        empty_floats,
        np.empty((0, 3)),
        np.empty((0, count, count)),
        empty_floats,
        empty_ints,
        empty_ints,
        empty_ints,
    )
