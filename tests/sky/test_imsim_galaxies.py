"""Galaxies of skyCatalogs and of instance catalogues, against GalSim's own Sersic profiles sheared and lensed."""

import gzip

import numpy as np
import pytest

from pachon.core import fits_files
from pachon.core.errors import DomainError, ProductError
from pachon.core.units import ARCSEC
from pachon.sky.catalogue import read_galaxies

POINTING = np.deg2rad([53.0, -27.8])
TABLE = {
    "galaxy_id": [11, 12],
    "ra": [53.01, 52.99],
    "dec": [-27.81, -27.79],
    "shear_1": [0.02, -0.01],
    "shear_2": [0.03, 0.02],
    "convergence": [0.05, -0.02],
    "size_bulge_true": [0.4, 0.3],
    "size_minor_bulge_true": [0.3, 0.3],
    "sersic_bulge": [4.0, 4.0],
    "ellipticity_1_bulge_true": [0.1, 0.0],
    "ellipticity_2_bulge_true": [-0.1, 0.0],
    "size_disk_true": [0.9, 0.8],
    "size_minor_disk_true": [0.4, 0.7],
    "sersic_disk": [1.0, 1.0],
    "ellipticity_1_disk_true": [0.2, 0.05],
    "ellipticity_2_disk_true": [0.25, -0.04],
    "sed_val_bulge": [[1.0, 1.0], [0.0, 0.0]],
    "sed_val_disk": [[3.0, 2.0], [2.0, 5.0]],
    "sed_val_knots": [[0.0, 1.0], [1.0, 0.0]],
}


@pytest.fixture
def sky_catalogue(tmp_path):
    parquet, pyarrow = pytest.importorskip("pyarrow.parquet"), pytest.importorskip("pyarrow")
    parquet.write_table(pyarrow.table(TABLE), tmp_path / "galaxy_10067.parquet")
    # The fluxes of another order.
    fluxes = {"galaxy_id": [12, 11], "lsst_flux_r": [2e-4, 1e-3], "lsst_flux_i": [4e-4, 2e-3]}
    parquet.write_table(pyarrow.table(fluxes), tmp_path / "galaxy_flux_10067.parquet")
    return tmp_path / "galaxy_10067.parquet"


def moments(profile):
    """Adaptive moments of a GalSim profile on the sky, x to the west: (a - b)/(a + b), and the size."""
    galsim = pytest.importorskip("galsim")
    image = profile.drawImage(nx=401, ny=401, scale=0.02, method="no_pixel")
    shape = galsim.hsm.FindAdaptiveMom(image)
    return shape.observed_shape.g1, shape.observed_shape.g2, shape.moments_sigma * 0.02


def drawn(sersic, radius, e1, e2):
    """The component as GalSim draws it: its axes are x to the west, y to the north."""
    galsim = pytest.importorskip("galsim")
    return galsim.Sersic(n=sersic, half_light_radius=radius / ARCSEC).shear(g1=e1, g2=-e2)


@pytest.mark.long
def test_components_are_those_of_skycatalogs(sky_catalogue):
    """The lines of skyCatalogs' GalaxyObject.get_gsobject_components, with GalSim."""
    galsim = pytest.importorskip("galsim")
    galaxies = read_galaxies(sky_catalogue, pointing=POINTING)
    assert np.diff(galaxies.first).tolist() == [2, 1]  # the second has no light of a bulge
    assert galaxies.fraction.tolist() == pytest.approx([0.25, 0.75, 1.0])
    for component, (row, name) in enumerate(((0, "bulge"), (0, "disk"), (1, "disk"))):
        value = {key: values[row] for key, values in TABLE.items()}
        radius = (value[f"size_{name}_true"] * value[f"size_minor_{name}_true"]) ** 0.5
        sersic = 1.0  # quick to draw; the index has no part in shapes
        shear = galsim.Shear(g1=-value[f"ellipticity_1_{name}_true"], g2=-value[f"ellipticity_2_{name}_true"])
        kappa, gamma1, gamma2 = value["convergence"], value["shear_1"], value["shear_2"]
        mu = 1 / ((1 - kappa) ** 2 - gamma1**2 - gamma2**2)
        profile = galsim.Sersic(n=sersic, half_light_radius=radius)._shear(shear)
        expected = moments(profile._lens(gamma1 / (1 - kappa), gamma2 / (1 - kappa), mu))
        c = component
        # Where north is along eta.
        aimed = read_galaxies(sky_catalogue, pointing=np.deg2rad([value["ra"], value["dec"]]))
        ours = moments(drawn(sersic, galaxies.component_radius[c], aimed.e1[c], aimed.e2[c]))
        np.testing.assert_allclose(ours, expected, atol=2e-5)


def test_magnitudes_are_those_of_the_fluxes(sky_catalogue):
    """A star of magnitude 28.36 gives one electron a second in r over 6.423 m (SMTN-002)."""
    area = np.pi / 4 * 642.3**2
    galaxies = read_galaxies(sky_catalogue, pointing=POINTING)
    np.testing.assert_allclose(galaxies.magnitude, 28.36 - 2.5 * np.log10(np.array([1e-3, 2e-4]) * area))
    in_i = read_galaxies(sky_catalogue, pointing=POINTING, band="i")
    np.testing.assert_allclose(in_i.magnitude, 28.17 - 2.5 * np.log10(np.array([2e-3, 4e-4]) * area))


def test_fluxes_are_needed(sky_catalogue):
    with pytest.raises(ProductError, match="lsst_flux_u"):
        read_galaxies(sky_catalogue, pointing=POINTING, band="u")
    (sky_catalogue.parent / "galaxy_flux_10067.parquet").unlink()
    with pytest.raises(ProductError, match=r"no file galaxy_flux_10067.parquet beside it"):
        read_galaxies(sky_catalogue, pointing=POINTING)


@pytest.fixture
def instance_catalogue(tmp_path):
    sersic = "object 7 53.01 -27.81 21.5 sed 0.3 0.02 0.03 0.05 0 0 sersic2d 0.9 0.4 35 1 none none"
    knots = "object 9 52.99 -27.79 22.5 sed 0.3 0 0 0 0 0 knots 0.8 0.7 110 20 none none"
    star = "object 8 53.02 -27.8 18 sed 0 0 0 0 0 0 point none none"
    invalid = "object 6 53.02 -27.8 60 sed 0 0 0 0 0 0 sersic2d 0.9 0.4 35 1 none none"
    with gzip.open(tmp_path / "gal.txt.gz", "wt") as stream:
        stream.write(f"{knots}\n")
    path = tmp_path / "instcat.txt"
    path.write_text(f"rightascension 53\n{sersic}\n{star}\n{invalid}\nincludeobj gal.txt.gz\n")
    return path


def test_objects_are_those_of_imsim(instance_catalogue):
    """The lines of imSim's InstCatalog.getObj, with GalSim."""
    galsim = pytest.importorskip("galsim")
    galaxies = read_galaxies(instance_catalogue, pointing=np.deg2rad([53.01, -27.81]))
    assert len(galaxies) == 2
    kappa, gamma1, gamma2 = 0.05, 0.02, -0.03  # flip_g2
    mu = 1 / ((1 - kappa) ** 2 - gamma1**2 - gamma2**2)
    shear = galsim.Shear(q=0.4 / 0.9, beta=(90 - 35) * galsim.degrees)
    profile = galsim.Sersic(n=1, half_light_radius=0.6)._shear(shear)
    expected = moments(profile._lens(gamma1 / (1 - kappa), gamma2 / (1 - kappa), mu))
    ours = moments(drawn(1.0, galaxies.component_radius[0], galaxies.e1[0], galaxies.e2[0]))
    np.testing.assert_allclose(ours, expected, atol=2e-5)
    # withFlux, the last of them, undoes the magnification.
    assert galaxies.magnitude.tolist() == [21.5, 22.5]


def test_instance_catalogues_that_cannot_be(instance_catalogue, tmp_path):
    with pytest.raises(DomainError, match="expected pointing"):
        read_galaxies(instance_catalogue)
    (tmp_path / "loop.txt").write_text("includeobj loop.txt\n")
    with pytest.raises(ProductError, match="includes itself"):
        read_galaxies(tmp_path / "loop.txt", pointing=POINTING)
    (tmp_path / "short.txt").write_text("object 7 53.01 -27.81 21.5 sed 0.3 0 0 0 0 0 sersic2d 0.9\n")
    with pytest.raises(ProductError, match="line 1"):
        read_galaxies(tmp_path / "short.txt", pointing=POINTING)


def test_a_catalogue_that_unpacks_to_far_more_is_refused(tmp_path, monkeypatch):
    """A few bytes can stand for gigabytes: the limit is that of all compressed files."""
    monkeypatch.setattr(fits_files, "_UNPACKED", 2**20)
    path = tmp_path / "gal.txt.gz"
    path.write_bytes(gzip.compress(b"# nothing\n" * 400_000))
    with pytest.raises(ProductError, match=r"gal\.txt\.gz: compressed file of .* unpacks to more than 1\.0 MB"):
        read_galaxies(path, pointing=POINTING)


def test_shapes_follow_the_meridians(sky_catalogue, instance_catalogue):
    """1.4 degrees east of the pointing north is 0.75 degrees off eta: all shapes turn by that."""
    aside = np.deg2rad([51.4, -27.8])
    for path in (sky_catalogue, instance_catalogue):
        near, far = (read_galaxies(path, pointing=pointing) for pointing in (POINTING, aside))
        turns = 0.5 * np.angle((far.e1 + 1j * far.e2) / (near.e1 + 1j * near.e2))
        meridians = (POINTING - aside)[0] * np.sin(aside[1])
        np.testing.assert_allclose(turns, meridians, atol=1e-3)  # the plane is 3e-4 longer outwards
