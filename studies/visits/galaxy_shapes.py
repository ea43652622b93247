"""Shapes of galaxies under the PSF of a stack, measured with the true PSF and with that of the models.

Each galaxy stands on a stamp of its own, with the true PSF of the nearest place where no star is, and the noise of the
stack; neighbours are left out. It is measured twice, with the true PSF and with that of the models at that place: the
difference is the systematic error of the PSF models, without the noise of galaxies and pixels. Each time in two ways:
by an elliptical Gaussian, as in the paper, and by the functionals of :class:`pachon.ShearEstimator`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from scipy import fft
from scipy.spatial import cKDTree

from ...core.random_streams import stream
from ...imaging.draw import Sources
from ...imaging.exposure import Exposure
from ...measure.catalogue.fit_galaxies import fit_galaxy_stamps
from ...measure.catalogue.galaxy_fits import GalaxyFits, usable_galaxies
from ...measure.catalogue.levenberg_marquardt import LevenbergMarquardt
from ...measure.shapes import half_light_radii
from ...measure.shear.estimator import LEAST_SIDE, ShearEstimator
from ...measure.shear.shear_shapes import ShearShapes
from ...measure.shear.weight import weight_sigma
from .stack import PsfStack

#: Fits with errors of the Fisher matrix, by which the paper chooses galaxies (sec. 4.2), and which are quicker.
SOLVER = LevenbergMarquardt(whole_errors=False)
#: S/N of the weighted flux from which galaxies have a weight in the shear.
SHEAR_MIN_SNR = 10.0
#: Sides of stamps [pixel], each drawn on a grid of twice the side: the first that the weight of the shear allows.
_SIDES = (32, 40, 48, 64, 96, 128)
#: Least side for large galaxies [pixel].
_LARGE_SIDE = 64
#: Half-light radius on the image over which a stamp of the first side is too small [pixel].
_LARGE = 5.0
#: Galaxies that are drawn and measured at a time, which bounds the memory.
_BLOCK = 2048


@dataclass(frozen=True, eq=False)
class GalaxyShapes:
    """Galaxies of a part of the sky, and their shapes along the axes of the stack.

    Attributes
    ----------
    index : ndarray of int, shape [n]
        Number of each galaxy among those given.
    x, y : ndarray, shape [n]
        Position along the axes of the stack [rad].
    magnitude : ndarray, shape [n]
        AB.
    e1, e2, error : ndarray, shape [n]
        Ellipticity measured with the PSF of the models, and standard error of a component.
    usable : ndarray of bool, shape [n]
        Whether it is fit for shear.
    true_e1, true_e2, true_usable : ndarray, shape [n]
        The same, measured with the true PSF.
    shear, true_shear : ShearShapes
        Ellipticities and responses of the functionals, with the PSF of the models and with the true one.
    """

    index: np.ndarray
    x: np.ndarray
    y: np.ndarray
    magnitude: np.ndarray
    e1: np.ndarray
    e2: np.ndarray
    error: np.ndarray
    usable: np.ndarray
    true_e1: np.ndarray
    true_e2: np.ndarray
    true_usable: np.ndarray
    shear: ShearShapes
    true_shear: ShearShapes

    def __len__(self) -> int:
        return len(self.x)

    @property
    def usable_twice(self) -> np.ndarray:
        """Whether each galaxy is fit for shear with either PSF, bool [n]."""
        return self.usable & self.true_usable

    @classmethod
    def joined(cls, parts: list[GalaxyShapes]) -> GalaxyShapes:
        """Return the galaxies of several parts."""
        columns: dict[str, Any] = {f.name: [getattr(shapes, f.name) for shapes in parts] for f in fields(cls)}
        shear, true_shear = (ShearShapes.joined(columns.pop(name)) for name in ("shear", "true_shear"))
        arrays: dict[str, Any] = {name: np.concatenate(values) for name, values in columns.items()}
        return cls(**arrays, shear=shear, true_shear=true_shear)


def measure_galaxies(
    stack: PsfStack,
    axes: np.ndarray,
    galaxies: Sources,
    exposure: Exposure,
    seed: int,
    *key: str | int,
    reach: float,
    sigma: float | None = None,
    threads: int | None = None,
) -> GalaxyShapes:
    """Draw galaxies, each on a stamp of its own, and measure them twice.

    Parameters
    ----------
    stack : PsfStack
        PSFs.
    axes : ndarray, shape [2, 2]
        d(x, y of the stack [pixel])/d(xi, eta).
    galaxies : Sources
        Galaxies about the common pointing.
    exposure : Exposure
        Depth and noise of the stack.
    seed, *key
        Random stream of the noise.
    reach : float
        Largest distance of galaxies from the nearest position with a known PSF [rad].
    sigma : float, optional
        rms width of the weight of the shear [rad]: parts of the sky with other ones have other responses. By default
        wide enough for the PSFs of the stack.
    threads : int, optional
        Number of threads; all processors by default. No byte depends on it.
    """
    places = np.flatnonzero(~stack.star)
    tree = cKDTree(np.stack([stack.x, stack.y], axis=1)[places])
    pixels = np.stack([galaxies.xi, galaxies.eta], axis=1) @ axes.T
    distance, nearest = tree.query(pixels * exposure.pixel_scale, distance_upper_bound=reach)
    near = np.flatnonzero(np.isfinite(distance))
    psf = places[nearest[near]]
    widths = half_light_radii(stack.true[places])
    width = widths[nearest[near]]
    on_image = np.hypot(galaxies.radius[near] / exposure.pixel_scale, width)
    electrons = exposure.electrons(galaxies.magnitude[near])
    # Between pixels, as the sky is to the pixels of the stack.
    offset = pixels[near] - np.rint(pixels[near])
    block_fits: list[tuple[np.ndarray, GalaxyFits, GalaxyFits]] = []
    rng = stream(seed, *key)
    sigma = weight_sigma(sigma, stack.true[places], exposure.pixel_scale)
    sides = stamp_sides(sigma / exposure.pixel_scale)
    shear_parts: list[tuple[np.ndarray, ShearShapes, ShearShapes]] = []
    for side, rows in zip(sides, (on_image <= _LARGE, on_image > _LARGE), strict=True):
        for number, block in enumerate(_row_blocks(np.flatnonzero(rows))):
            size = 2 * side
            used, index = np.unique(psf[block], return_inverse=True)
            spectra = galaxies.transform(
                near[block], np.broadcast_to(axes, (len(block), 2, 2)), offset[block], size, threads=threads
            )
            spectra *= _psf_transforms(stack.true[used], size)[index]
            images = fft.irfft2(spectra, s=(size, size), workers=1)[:, side // 2 : -side // 2, side // 2 : -side // 2]
            images *= electrons[block, None, None].astype(np.float32)
            variance = exposure.noise_rms**2
            if exposure.noise:
                images += np.sqrt(variance + np.maximum(images, 0.0)) * rng.standard_normal(images.shape, np.float32)
            variances = np.full(images.shape, variance)
            options: dict[str, Any] = {"psf_index": index, "solver": SOLVER, "threads": threads}
            by_model = fit_galaxy_stamps(images, variances, stack.model[used], **options)
            by_true = fit_galaxy_stamps(images, variances, stack.true[used], start=by_model, **options)
            block_fits.append((block, by_model, by_true))
            shear_pair: list[ShearShapes] = []
            for psf_images in (stack.model[used], stack.true[used]):
                estimator = ShearEstimator(psf_images, exposure.pixel_scale, exposure.noise_rms, sigma=sigma, side=side)
                # Galaxies stand about the pixel of number side / 2, half a pixel from the centre of the stamp.
                moments = estimator.moments(images, offset[block] + 0.5, psf_index=index, threads=threads)
                shear_pair.append(
                    estimator.ellipticity_and_response(
                        moments,
                        psf_index=index,
                        seed=seed if exposure.noise else None,
                        key=(*key, "moments", side, number),
                        min_snr=SHEAR_MIN_SNR,
                    )
                )
            shear_parts.append((block, shear_pair[0], shear_pair[1]))
    return _joined_shapes(galaxies, near, pixels * exposure.pixel_scale, width, block_fits, shear_parts)


def stamp_sides(sigma: float) -> tuple[int, int]:
    """Return the sides of stamps of small and of large galaxies for a weight of an rms width, all in pixels."""
    fitting = [side for side in _SIDES if side >= LEAST_SIDE * sigma] or [_SIDES[-1]]
    return fitting[0], max(fitting[0], _LARGE_SIDE)


def _row_blocks(rows: np.ndarray) -> Iterator[np.ndarray]:
    return (rows[i : i + _BLOCK] for i in range(0, len(rows), _BLOCK))


def _psf_transforms(psfs: np.ndarray, size: int) -> np.ndarray:
    """Return the transforms of PSFs [n, m, m] centred on pixel ``size // 2``, complex64 [n, size, size // 2 + 1]."""
    wide = np.zeros((len(psfs), size, size), dtype=np.float32)
    first = size // 2 - psfs.shape[1] // 2
    wide[:, first : first + psfs.shape[1], first : first + psfs.shape[2]] = psfs
    return fft.rfft2(wide, workers=1)


def _joined_shapes(
    galaxies: Sources,
    near: np.ndarray,
    positions: np.ndarray,
    width: np.ndarray,
    block_fits: list[tuple[np.ndarray, GalaxyFits, GalaxyFits]],
    shear_parts: list[tuple[np.ndarray, ShearShapes, ShearShapes]],
) -> GalaxyShapes:
    """Return the shapes of the fits of blocks of galaxies, in the order of the galaxies."""
    columns = {name: np.full(len(near), np.nan) for name in ("e1", "e2", "error", "true_e1", "true_e2")}
    usable = {name: np.zeros(len(near), dtype=bool) for name in ("usable", "true_usable")}
    for block, *fit_pair in block_fits:
        for fits, prefix in zip(fit_pair, ("", "true_"), strict=True):
            columns[f"{prefix}e1"][block], columns[f"{prefix}e2"][block] = fits.e1, fits.e2
            # Half-light radius on the image, of the fitted Gaussian under the PSF.
            on_image = np.hypot(fits.half_light_radius, width[block])
            usable[f"{prefix}usable"][block] = usable_galaxies(fits, on_image, width)
            if not prefix:
                columns["error"][block] = fits.ellipticity_error
    x, y = positions[near].T
    order = np.argsort(np.concatenate([np.zeros(0, dtype=np.int64), *(block for block, _, _ in shear_parts)]))
    shear = ShearShapes.joined([by_model for _, by_model, _ in shear_parts]).take(order)
    true_shear = ShearShapes.joined([by_true for _, _, by_true in shear_parts]).take(order)
    return GalaxyShapes(
        index=near,
        x=x,
        y=y,
        magnitude=galaxies.magnitude[near],
        **columns,
        **usable,
        shear=shear,
        true_shear=true_shear,
    )
