"""Central obscuration of telescopes that state none, against the innermost of many real rays that arrives."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

import pachon
from pachon.commands.cli import main
from pachon.models.aperture import Annulus, Circle, Complement, Intersection, Rectangle, Union
from pachon.models.central_obscuration import central_obscuration

CASSEGRAIN = "tests/data/lenses/ritchey_chretien.zmx"
TRIPLET = "tests/data/zmx/lens1.zmx"
RAYS = 20_001


def with_aperture(telescope, name, aperture):
    surfaces = tuple(dataclasses.replace(s, aperture=aperture) if s.name == name else s for s in telescope.surfaces)
    return dataclasses.replace(telescope, surfaces=surfaces)


def innermost_lit(telescope):
    """Return the radius of the innermost ray of the axis that arrives, over that of the pupil."""
    radius = np.linspace(0.0, 1.0, RAYS)
    y = 0.5 * telescope.pupil_diameter * radius
    rays = pachon.launch_rays(telescope, (0.0, 0.0), telescope.default_wavelength, pupil=(0.0 * y, y))
    lit = pachon.trace(telescope, rays).status == 0
    return radius[lit].min()


@pytest.mark.parametrize(
    ("path", "name", "aperture"),
    [
        (CASSEGRAIN, "primary", Annulus(0.36, 1.2)),
        (CASSEGRAIN, "secondary", Complement(Circle(0.04))),
        (CASSEGRAIN, "secondary", Intersection((Circle(0.16), Complement(Annulus(0.0, 0.03))))),
        (TRIPLET, "S2", Complement(Circle(1e-3))),
        # Light comes in a fast cone to the last surfaces, where third order is not enough.
        (TRIPLET, "S6", Complement(Circle(1.5e-3))),
    ],
)
def test_against_real_rays(path, name, aperture):
    telescope = with_aperture(pachon.load_telescope(path), name, aperture)
    # The lattice of rays.
    assert central_obscuration(telescope) == pytest.approx(innermost_lit(telescope), abs=1.0 / (RAYS - 1))


@pytest.mark.parametrize(
    "aperture",
    [
        Circle(1.2),
        Complement(Annulus(0.2, 0.4)),  # its middle is clear
        Complement(Circle(0.2, 0.3, 0.0)),  # beside the axis
        Complement(Rectangle(0.2, 0.2)),
        Union((Annulus(0.4, 1.2), Circle(0.1))),
        Complement(Circle(1.3)),  # no light is left
    ],
)
def test_no_disc_in_the_middle(aperture):
    assert central_obscuration(with_aperture(pachon.load_telescope(CASSEGRAIN), "primary", aperture)) == 0.0


def test_what_is_stated_stays(lsst_r):
    assert central_obscuration(lsst_r) == 0.612


def test_information_on_a_zemax_file_with_an_obscuring_surface(tmp_path, capsys):
    """A plane in front of the primary with OBSC, as lens designs have the shadow of the secondary: 0.36 m of 1.2 m."""
    head, *parts = Path(CASSEGRAIN).read_text().split("SURF ")
    source, *surfaces = (part.split("\n", 1)[1] for part in parts)
    shadow = "  TYPE STANDARD\n  CURV 0\n  OBSC 0 0.36 0\n  DISZ 5\n"
    numbered = [f"SURF {i}\n{part}" for i, part in enumerate((source, shadow, *surfaces))]
    (tmp_path / "shadow.zmx").write_text(head + "".join(numbered))
    assert main(["info", str(tmp_path / "shadow.zmx"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["pupil_obscuration"] == pytest.approx(0.3, rel=1e-12)
    area = np.pi * (1.2**2 - 0.36**2)
    assert told["effective_area_m2"] == pytest.approx(area, rel=1e-8)  # as printed, with nine digits
    telescope = pachon.load_telescope(tmp_path / "shadow.zmx")
    assert pachon.first_order(telescope).effective_area == pytest.approx(area, rel=1e-12)
    assert pachon.mtf(telescope, n_pupil=64).obscuration == pytest.approx(0.3, rel=1e-12)
