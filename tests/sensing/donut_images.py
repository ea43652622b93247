"""Donuts by brute force: a dense lattice of rays, turned by a wavefront, binned finely and blurred."""

import numpy as np
from scipy.ndimage import gaussian_filter

import pachon
from pachon.models.zernike_polynomials import annular_zernike_gradients

WAVELENGTH = 622e-9
#: Pixels of 20 um keep the tests quick.
PIXEL, SIZE = 20e-6, 91
#: Bins along a pixel, so that the blur is nearly that of a continuous image.
FINE = 4
#: Pixels around a stamp from which light is blurred into it.
MARGIN = 8


def donut(
    tel,
    field,
    *,
    zernikes=(),
    blur=1.0,
    flux=5e6,
    shift=(0.0, 0.0),
    rays=400,
    size=SIZE,
    pixel=PIXEL,
    extra_sky=0,
):
    """Image of a star [electrons]: rays through a turned square lattice, with a Gaussian blur [pixels].

    ``zernikes`` are coefficients [m] from j = 1 of a wavefront that leads: an incoming ray turns by minus its gradient.
    """
    return blurred(fine_bins(tel, field, zernikes, shift, rays, size, pixel), blur, flux)


def fine_bins(tel, field, zernikes, shift, rays, size, pixel, fine=FINE):
    """Fraction of the light in each of ``fine`` x ``fine`` bins of every pixel of a stamp with a margin."""
    radius = 0.5 * tel.pupil_diameter
    angle, half = 0.4567, 1.45
    u = ((np.arange(rays * half) + 0.5) / (rays * half) * 2.0 - 1.0) * half * radius
    chief = pachon.trace(tel, pachon.launch_rays(tel, field, WAVELENGTH, (0.0, 0.0)))
    detector = tel.surfaces[-1]
    n = size + 2 * MARGIN
    edges = (np.arange(n * fine + 1) / fine) - 0.5 * n
    bins, count = np.zeros((n * fine, n * fine)), 0
    # Some rows of the lattice at a time.
    for rows in np.array_split(u, max(rays // 100, 1)):
        x, y = (v.ravel() for v in np.meshgrid(u, rows))
        x, y = x * np.cos(angle) - y * np.sin(angle), x * np.sin(angle) + y * np.cos(angle)
        near = np.hypot(x, y) < 1.02 * radius
        x, y = x[near], y[near]
        if not len(x):
            continue
        end = pachon.trace(tel, _light(tel, field, x, y, zernikes))
        place = (detector.to_local(end.position) - detector.to_local(chief.position))[:, :2] / pixel + np.asarray(shift)
        place = place[end.status == 0]
        count += len(place)
        bins += np.histogram2d(place[:, 1], place[:, 0], [edges, edges])[0]
    return bins / count


def blurred(bins, blur, flux, fine=FINE):
    """Image [electrons] of the light in fine bins, with a Gaussian blur [pixels]."""
    # The bins blur too, by a twelfth of their square.
    left = np.sqrt(max(blur**2 * fine**2 - 1.0 / 12.0, 0.0))
    image = gaussian_filter(bins, left, mode="constant", truncate=6.0) if blur else bins
    n = len(bins) // fine
    image = image.reshape(n, fine, n, fine).sum(axis=(1, 3))[MARGIN:-MARGIN, MARGIN:-MARGIN]
    return flux * image


def _light(tel, field, x, y, zernikes):
    """Rays of a star through points of the entrance pupil, turned by a wavefront."""
    radius = 0.5 * tel.pupil_diameter
    slope = np.tan(np.asarray(field))
    light = np.array([*slope, -1.0]) / np.sqrt(1.0 + slope @ slope)
    cosines = np.tile(light[:2], (len(x), 1))
    if len(zernikes):
        terms = annular_zernike_gradients(len(zernikes), x / radius, y / radius, tel.pupil_obscuration)
        cosines = cosines - np.tensordot(zernikes, terms, axes=1).T / radius
    direction = np.column_stack([cosines, -np.sqrt(1.0 - (cosines**2).sum(axis=1))])
    point = np.column_stack([x, y, np.full(len(x), tel.stop_z)])
    back = (point * direction).sum(axis=1) + tel.launch_distance
    return pachon.Rays(point - direction * back[:, None], direction, np.zeros(len(x)), WAVELENGTH)


def noisy(image, sky, seed):
    """Poisson noise of star and sky, sky subtracted."""
    return np.random.default_rng(seed).poisson(np.maximum(image, 0.0) + sky) - float(sky)
