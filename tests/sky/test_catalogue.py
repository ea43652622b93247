"""Galaxies of tables: units, defaults, coordinates, round trips, and one line for what is wrong."""

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.table import MaskedColumn, Table
from astropy.wcs import WCS

from pachon.core.errors import ConfigError, DomainError, ProductError
from pachon.core.units import ARCMIN, ARCSEC
from pachon.sky.catalogue import read_galaxies, tangent_plane, write_galaxies
from pachon.sky.galaxies import Galaxies
from pachon.sky.pointing import Pointing
from pachon.sky.population import draw_galaxies

RA = np.array([53.1, 53.3, 52.6])
DEC = np.array([-27.9, -27.2, -28.0])
POINTING = np.deg2rad([53.0, -27.8])
ENDINGS = ["ecsv", "fits", "parquet"]


def base(**columns):
    """A catalogue of three galaxies with what is required."""
    table = {"xi": [1e-4, 2e-4, -3e-4], "eta": [0.0, 1e-4, 2e-4], "mag": [24.0, 25.0, 26.0]}
    return Table(table | {"half_light_radius": [0.3, 0.2, 0.1]} | columns)


def save(table, path):
    if path.suffix == ".parquet":
        pyarrow = pytest.importorskip("pyarrow")
        from pyarrow import parquet

        parquet.write_table(pyarrow.table({name: np.asarray(table[name]) for name in table.colnames}), path)
    else:
        table.write(path, format="fits" if path.suffix == ".fits" else "ascii.ecsv")
    return path


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_catalogue_with_defaults(tmp_path, ending):
    galaxies = read_galaxies(save(base(), tmp_path / f"mine.{ending}"))
    assert np.allclose(galaxies.xi, [1e-4, 2e-4, -3e-4], rtol=1e-15)
    assert np.allclose(galaxies.radius, np.array([0.3, 0.2, 0.1]) * ARCSEC)
    assert np.array_equal(galaxies.component_radius, galaxies.radius)
    assert np.array_equal(galaxies.sersic, [1.0, 1.0, 1.0])
    assert np.array_equal(galaxies.e1, [0.0, 0.0, 0.0])


def test_units_of_the_file_are_honoured(tmp_path):
    table = base(n=[0.5, 1.0, 4.0], e1=[0.1, 0.2, 0.3], e2=[0.0, -0.1, 0.4])
    table["HALF_LIGHT_RADIUS"] = table["half_light_radius"] / 60.0
    table["HALF_LIGHT_RADIUS"].unit = u.arcmin
    table.remove_column("half_light_radius")
    table["xi"], table["eta"] = table["xi"] * u.deg, table["eta"] * u.arcmin
    for ending in ("ecsv", "fits"):
        galaxies = read_galaxies(save(table, tmp_path / f"units.{ending}"), convention="tangent_plane")
        assert np.allclose(galaxies.xi, np.deg2rad([1e-4, 2e-4, -3e-4]))
        assert np.allclose(galaxies.eta, np.array([0.0, 1e-4, 2e-4]) * ARCMIN)
        assert np.allclose(galaxies.radius, np.array([0.3, 0.2, 0.1]) * ARCSEC)
        assert np.array_equal(galaxies.sersic, [0.5, 1.0, 4.0])
        assert np.array_equal(galaxies.e2, [0.0, -0.1, 0.4])


def test_axis_ratio_and_position_angle(tmp_path):
    # Along north, along east, along north-east.
    path = save(base(q=[0.5, 0.5, 0.25], pa=[0.0, 90.0, 45.0]), tmp_path / "q.ecsv")
    galaxies = read_galaxies(path)
    assert np.allclose(galaxies.e1, [-1 / 3, 1 / 3, 0.0], atol=1e-15)
    assert np.allclose(galaxies.e2, [0.0, 0.0, 0.6], atol=1e-15)


def test_ellipticities_of_a_catalogue_are_in_a_named_convention(tmp_path):
    # Elongated from north-west to south-east: position angle 135 degrees.
    at_135 = read_galaxies(save(base(q=[0.6 / 1.4] * 3, pa=[135.0] * 3), tmp_path / "pa.ecsv"))
    path = save(base(e1=[0.0] * 3, e2=[0.4] * 3), tmp_path / "e.ecsv")
    galsim, ours = (read_galaxies(path, convention=name) for name in ("galsim", "tangent_plane"))
    assert np.allclose(galsim.e2, at_135.e2, rtol=0, atol=1e-15)
    assert np.array_equal(ours.e2, -galsim.e2)
    assert np.array_equal(ours.e1, galsim.e1)


def test_an_unknown_convention_is_asked_for(tmp_path):
    path = save(base(e1=[0.1] * 3, e2=[0.0, 0.0, 0.1]), tmp_path / "e.ecsv")
    with pytest.raises(DomainError, match=r"e\.ecsv: column 'e2' without a convention: expected convention = galsim"):
        read_galaxies(path)
    with pytest.raises(ConfigError, match=r"convention = .*des.*: expected .*galsim"):
        read_galaxies(path, convention="des")
    # Round galaxies, and those along north or east, are the same in both.
    assert read_galaxies(save(base(e1=[0.1] * 3, e2=[0.0] * 3), tmp_path / "east.ecsv")).e1[0] == 0.1


def test_positions_on_the_sky_are_those_of_a_tangent_wcs(tmp_path):
    wcs = WCS(naxis=2)
    wcs.wcs.ctype, wcs.wcs.crval = ["RA---TAN", "DEC--TAN"], np.rad2deg(POINTING)
    wcs.wcs.crpix, wcs.wcs.cdelt = [1.0, 1.0], [1.0, 1.0]
    expected = np.deg2rad(wcs.wcs_world2pix(np.stack([RA, DEC], axis=1), 0))
    xi, eta = tangent_plane(RA * u.deg, DEC * u.deg, POINTING)
    assert np.allclose(np.stack([xi, eta], axis=1), expected, atol=1e-13)
    table = base()
    table.remove_columns(["xi", "eta"])
    table["RA"], table["Dec"] = RA, np.deg2rad(DEC) * u.rad
    galaxies = read_galaxies(save(table, tmp_path / "sky.fits"), pointing=POINTING)
    assert np.allclose(galaxies.xi, expected[:, 0], atol=1e-13)
    assert np.allclose(galaxies.eta, expected[:, 1], atol=1e-13)
    # East is towards greater right ascension.
    assert galaxies.xi[1] > 0.0


@pytest.mark.parametrize("dec", [-30.0, -60.0, -87.0])
def test_position_angles_are_from_the_meridian_of_the_galaxy(tmp_path, dec):
    """At -60 degrees north is 2.6 degrees off eta where a field ends, and e wrong by 9 % if that is forgotten."""
    aim = SkyCoord(40.0, dec, unit="deg")
    place = aim.directional_offset_by(80.0 * u.deg, 1.5 * u.deg)
    along = place.directional_offset_by(20.0 * u.deg, 1.0 * u.arcsec)
    table = Table({"ra": [place.ra.deg], "dec": [place.dec.deg], "mag": [24.0], "half_light_radius": [0.3]})
    e = np.exp(2j * np.deg2rad(70.0)) / 3.0  # from east towards north
    start, end = (Pointing.of(aim).from_celestial(at.ra, at.dec) for at in (place, along))
    direction = np.arctan2(*(end - start)[::-1])
    for name, shape in (("q", {"q": [0.5], "pa": [20.0]}), ("e", {"e1": [e.real], "e2": [-e.imag]})):
        path = save(Table(dict(table.columns) | shape), tmp_path / f"{name}.ecsv")
        galaxies = read_galaxies(path, pointing=(aim.ra, aim.dec), convention="galsim")
        # The plane is longer outwards by 3.4e-4.
        assert galaxies.e1[0] + 1j * galaxies.e2[0] == pytest.approx(np.exp(2j * direction) / 3.0, abs=2e-4)


@pytest.mark.parametrize("ending", ENDINGS)
def test_components_come_back_as_they_were(tmp_path, ending):
    if ending == "parquet":
        pytest.importorskip("pyarrow")
    galaxies = draw_galaxies(0.5 * ARCMIN, 25.5, 3)
    path = tmp_path / f"components.{ending}"
    write_galaxies(path, galaxies)
    again = read_galaxies(path)
    for name in Galaxies.__dataclass_fields__:
        # Units of angle are multiplied by one.
        assert np.array_equal(getattr(again, name), getattr(galaxies, name)), name
    assert len(again.dx) > 2 * len(again)


def test_no_galaxies_come_back_too(tmp_path):
    write_galaxies(tmp_path / "none.ecsv", Galaxies.concatenate([]))
    assert len(read_galaxies(tmp_path / "none.ecsv")) == 0


def without(name):
    table = base()
    table.remove_column(name)
    return table


@pytest.mark.parametrize(
    ("table", "error", "text"),
    [
        (without("mag"), ProductError, "no column 'mag'; columns are xi, eta, half_light_radius"),
        (without("eta"), ProductError, "no column 'eta'; columns are"),
        (Table({"mag": [1.0]}), ProductError, "no columns 'ra' and 'dec', nor 'xi' and 'eta'; columns are mag"),
        (base(e1=[0.1, 0.1, 0.1]), ProductError, "no column 'e2'"),
        (base(q=[0.5, 0.5, 0.5]), ProductError, "no column 'pa'"),
        (base(q=[0.5, 0.0, 0.5], pa=[0.0, 0.0, 0.0]), DomainError, "column 'q', row 2: 0, expected an axis ratio"),
        (base(n=[1.0, 9.0, 1.0]), DomainError, "column 'n', row 2: 9, expected 0.3 to 6.2"),
        (
            base(e1=[0.9, 0.0, 0.0], e2=[0.9, 0.0, 0.0]),
            DomainError,
            "column 'e1, e2', row 1: 1.27279, expected an ellip",
        ),
        (
            base(half_light_radius=[0.4, 0.3, 0.0]),
            DomainError,
            "column 'half_light_radius', row 3: 0, expected a radius",
        ),
        (base(n=["a", "b", "c"]), DomainError, "column 'n': expected one number in every row"),
        (base(n=[1.0, 2.0, np.nan]), DomainError, "column 'n', row 3: expected a finite number"),
        (base(n=MaskedColumn([1.0, 2.0, 3.0], mask=[0, 1, 0])), DomainError, "column 'n', row 2"),
        (base(ra=[0.0] * 3)["ra", "mag", "half_light_radius"], ProductError, "no column 'dec'"),
    ],
)
def test_tables_with_something_wrong(tmp_path, table, error, text):
    path = save(table, tmp_path / "wrong.ecsv")
    with pytest.raises(error, match=text) as caught:
        read_galaxies(path, convention="tangent_plane")
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_units_that_are_no_angles(tmp_path):
    table = base()
    table["half_light_radius"].unit = u.kg
    with pytest.raises(DomainError, match="expected a unit that converts to rad"):
        read_galaxies(save(table, tmp_path / "kg.ecsv"))


def test_positions_that_need_a_pointing(tmp_path):
    table = base(ra=RA, dec=DEC)["ra", "dec", "mag", "half_light_radius"]
    path = save(table, tmp_path / "sky.ecsv")
    with pytest.raises(DomainError, match="expected pointing"):
        read_galaxies(path)
    with pytest.raises(DomainError, match="within 90 deg"):
        read_galaxies(path, pointing=(0.0, np.pi / 2))
    with pytest.raises(DomainError, match="expected right ascension and declination"):
        read_galaxies(path, pointing=0.0)


def test_files_that_are_no_tables(tmp_path):
    for name in ("a.ecsv", "a.fits", "a.parquet"):
        (tmp_path / name).write_bytes(b"nothing of the kind")
        with pytest.raises(ProductError, match="damaged or no"):
            read_galaxies(tmp_path / name)
    with pytest.raises(ProductError, match="no such file"):
        read_galaxies(tmp_path / "b.ecsv")
    with pytest.raises(ProductError, match=r"ending '\.txt': expected one of \.ecsv"):
        read_galaxies(tmp_path / "b.txt")
    with pytest.raises(ProductError, match="ending"):
        write_galaxies(tmp_path / "b.txt", Galaxies.concatenate([]))


def test_components_out_of_order(tmp_path):
    path = tmp_path / "components.ecsv"
    write_galaxies(path, draw_galaxies(0.5 * ARCMIN, 24.0, 3))
    table = Table.read(path)
    table["galaxy"] += 1
    table.write(path, overwrite=True)
    with pytest.raises(DomainError, match="column 'galaxy': expected 0, 1, 2"):
        read_galaxies(path)


def test_declinations_beyond_a_pole_are_refused(tmp_path):
    """-95 degrees was taken for -85 on the other side."""
    table = Table({"ra": [10.0, 10.0], "dec": [-85.0, -95.0], "mag": [20.0, 20.0], "half_light_radius": [1.0, 1.0]})
    with pytest.raises(DomainError, match=r"dec \[1\] = -95 deg: expected -90 to 90"):
        read_galaxies(save(table, tmp_path / "wrong.ecsv"), pointing=np.deg2rad([10.0, -85.0]))
