"""Representations of large objects name them in a line, without walls of numbers."""

import numpy as np
import pytest

import pachon


@pytest.fixture(scope="module")
def air():
    return pachon.Atmosphere.from_site("cerro_pachon", seed=2, r0=0.12, outer_scale=26.0, exposure=15.0)


def test_telescope_and_focal_plane(lsst_r):
    assert repr(lsst_r) == "<Telescope lsst_v3.3_r: 12 surfaces, pupil 8.36 m, field radius 1.75 deg>"
    assert repr(pachon.FocalPlane.from_budget("lsst", seed=7)) == "<FocalPlane of lsst: 189 CCDs, seed 7>"
    table = {"x": [0.0, 1e-3, 0.0], "y": [0.0, 0.0, 1e-3], "z": [1e-6, 2e-6, 0.0]}
    measured = pachon.FocalPlane.from_heights(table)
    assert "heights of 1 measured" in repr(measured)


def test_atmosphere_and_psfs(lsst_r, air):
    assert repr(air) == "<Atmosphere: 6 layers, r0 0.12 m, outer scale 26 m, 15 s, seed 2, epoch 0>"
    waves = np.array([550e-9, 600e-9, 650e-9, 680e-9])
    psfs = pachon.make_psfs(lsst_r, [(0.0, 0.01)], waves, atmosphere=air, engine="long_exposure")
    assert repr(psfs) == "<Psfs: images [1, 31, 31], pixels of 0.2001 arcsec, 550, 600, 650, ... nm>"


def test_psf_model():
    rng = np.random.default_rng(1)
    stamps = 1.0 + rng.uniform(size=(20, 9, 9))
    model = pachon.PsfModel.fit(stamps, rng.uniform(size=(20, 2)), n_components=3, order=1)
    assert repr(model) == "<PsfModel: 3 components (pca), order 1, 20 stars, stamps 9 x 9>"
