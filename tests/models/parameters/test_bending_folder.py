"""Bending modes in the files of batoid_rubin, against batoid's surfaces made of the same numbers."""

import numpy as np
import pytest
import yaml
from astropy.io import fits

import pachon
from pachon.core.errors import PrescriptionError

batoid = pytest.importorskip("batoid")

# Radius of the Zernikes, and half the side of the grid: rays stay out of its outermost cells, whose differences are
# one-sided.
MIRRORS = {"M1": (4.18, 4.8), "M2": (1.71, 2.0), "M3": (4.18, 2.9)}


def made(folder, modes=3):
    """Write a folder of modes: quadratic maps, whose central differences are their slopes; Zernikes of 11 terms."""
    rng = np.random.default_rng(4)
    content, arrays = {}, {}
    shared = rng.normal(0.0, 1e-7, (modes, 12))
    for mirror, (outer, side) in MIRRORS.items():
        nodes = np.linspace(-side, side, 41)
        x, y = np.meshgrid(nodes, nodes)
        a, b, c, d = rng.normal(0.0, 1e-8, (4, modes, 1, 1))
        maps = np.stack([a + b * x**2 + c * x * y + d * y**2, 2 * b * x + c * y, c * x + 2 * d * y, c + 0 * x])
        zernikes = rng.normal(0.0, 1e-7, (modes, 12)) if mirror == "M2" else shared
        names = {"zk": f"{mirror}_zk.fits.gz", "grid": f"{mirror}_grid.fits.gz", "coords": f"{mirror}_coords.fits.gz"}
        for key, data in (("zk", zernikes), ("grid", maps), ("coords", np.stack([nodes, nodes]))):
            fits.PrimaryHDU(data).writeto(folder / names[key])
        content[mirror] = {
            "zk": {"file": names["zk"], "R_outer": outer},
            "grid": {"file": names["grid"], "coords": names["coords"]},
        }
        arrays[mirror] = zernikes, nodes, maps
    content |= {"use_m1m3_modes": [2, 0], "use_m2_modes": [1]}
    (folder / "bend.yaml").write_text(yaml.safe_dump(content))
    return content, arrays


def test_rays_off_bent_mirrors_are_batoids(tmp_path, lsst_r, annulus_points):
    _, arrays = made(tmp_path)
    dof = pachon.load_degrees_of_freedom(tmp_path / "bend.yaml")
    assert dof.names[:2] == ("M2_dz", "M2_dx")
    assert dof.names[10:] == ("M1M3_B1", "M1M3_B2", "M2_B1")
    amounts = {"M1M3_B1": 0.7, "M1M3_B2": -0.4, "M2_B1": 1.3}  # um
    telescope = dof.apply(lsst_r, amounts)
    optic = batoid.Optic.fromYaml("LSST_r.yaml")
    chosen = {"M1": {2: 0.7, 0: -0.4}, "M3": {2: 0.7, 0: -0.4}, "M2": {1: 1.3}}
    for mirror, modes in chosen.items():
        zernikes, nodes, maps = arrays[mirror]
        coefficients = sum(a * zernikes[k] for k, a in modes.items())
        grids = sum(a * maps[:, k] for k, a in modes.items())
        bent = [
            optic[mirror].surface,
            batoid.Zernike(coefficients, MIRRORS[mirror][0]),
            batoid.Bicubic(nodes, nodes, *grids),
        ]
        optic = optic.withSurface(mirror, batoid.Sum(bent))
    field, pupil = (0.01, -0.005), annulus_points(200)
    ours = pachon.trace(telescope, pachon.launch_rays(telescope, field, 620e-9, pupil))
    plain = pachon.trace(lsst_r, pachon.launch_rays(lsst_r, field, 620e-9, pupil))
    theirs = batoid.RayVector.fromStop(
        *pupil, optic=optic, wavelength=620e-9, theta_x=field[0], theta_y=field[1], projection="zemax"
    )
    optic.trace(theirs)
    position = theirs.toCoordSys(batoid.CoordSys()).r
    # 1e-11 m: rounding of maps in metres per metre. The bends move rays by micrometres.
    assert np.abs(ours.position - position).max() < 1e-11
    assert np.abs(ours.position - plain.position).max() > 1e-6


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"use_m2_modes": [7]}, "M2.*use_m2_modes = 7: expected modes from 0 to 2"),
        ({"use_m1m3_modes": ["x"]}, r"use_m1m3_modes\[0\] = 'x': expected a whole number"),
        ({"M2": {"zk": {"file": "no.fits", "R_outer": 1.7}, "grid": {"file": "a", "coords": "b"}}}, r"no\.fits"),
        ({"M3": {"zk": {"file": "M3_zk.fits.gz"}}}, r"M3\.zk\.R_outer is missing"),
        ({"M1": {"zk": {"file": "M1_zk.fits.gz", "R_outer": 4.18},
                 "grid": {"file": "M1_zk.fits.gz", "coords": "M1_coords.fits.gz"}}}, "image of four dimensions"),
    ],
)  # fmt: skip
def test_wrong_folders_are_refused_in_one_line(tmp_path, change, message):
    content, _ = made(tmp_path)
    (tmp_path / "bend.yaml").write_text(yaml.safe_dump(content | change))
    with pytest.raises(PrescriptionError, match=message) as caught:
        pachon.load_degrees_of_freedom(tmp_path / "bend.yaml")
    assert "\n" not in str(caught.value)
