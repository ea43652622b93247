"""Computations leave no rings of objects with arrays, which stay until Python looks for them: gigabytes of visits."""

import gc

import numpy as np
import pytest

import pachon
from pachon.core.units import ARCSEC

pytestmark = pytest.mark.long

FIELDS, WAVELENGTH = np.deg2rad([[0.3, 0.5]]), 620e-9


def psfs(lsst_r):
    air = pachon.Atmosphere.from_site("cerro_pachon", 1, exposure=15.0)
    pachon.make_psfs(lsst_r, FIELDS, [WAVELENGTH], atmosphere=air, engine="statistical", threads=2)


def donuts(lsst_r):
    detector = pachon.DonutDetector(defocus=1.5e-3)
    model = pachon.DonutModel(air=pachon.DonutAir(fwhm=0.7 * ARCSEC), detector=detector)
    drawn = pachon.draw_donuts(lsst_r, FIELDS, [WAVELENGTH], model=model, electrons=1e6)
    model = pachon.DonutModel(detector=detector)
    pachon.fit_donuts(lsst_r, drawn.images, FIELDS, WAVELENGTH, sky_variance=drawn.sky_variance, model=model)


def psf_model(_):
    rng = np.random.default_rng(1)
    positions = rng.uniform(-0.02, 0.02, (40, 2))
    place = np.arange(-10, 11)
    size = 2.0 + 5.0 * positions[:, :1, None]
    stamps = np.exp(-(place**2 + place[:, None] ** 2) / (2.0 * size**2))
    stamps = 1e6 * stamps / stamps.sum(axis=(1, 2), keepdims=True) + 10.0 * rng.standard_normal(stamps.shape)
    pachon.PsfModel.fit(stamps, positions).draw(0.0, 0.0)


@pytest.mark.parametrize("compute", [psfs, donuts, psf_model])
def test_no_arrays_are_left_in_rings(compute, lsst_r):
    compute(lsst_r)
    gc.collect()
    before = gc.get_debug()
    gc.disable()
    try:
        compute(lsst_r)
        gc.set_debug(gc.DEBUG_SAVEALL)
        gc.collect()
        held = {id(r): r for o in gc.garbage for r in gc.get_referents(o) if isinstance(r, np.ndarray)}
    finally:
        gc.set_debug(before)
        gc.garbage.clear()
        gc.enable()
    assert sum(array.nbytes for array in held.values()) < 100_000
