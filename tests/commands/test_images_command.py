"""``pachon images``: products, bytes, going on, and one line for bad input."""

import json

import numpy as np
import pytest
import yaml
from astropy.io import fits
from astropy.table import Table
from PIL import Image

from pachon import PachonError
from pachon.commands.cli import main
from pachon.imaging.image_file import CcdImage

RUN = {
    "ccds": ["R22_S11", "R22_S12"],
    "wavelengths_nm": [620.0],
    "stars": {"truth": 14, "observed": 12},
    "atmosphere": {"screen_size": 1024, "screen_length_m": 560.0, "exposure_s": 2.0, "time_step_s": 0.5},
    "psf": {"engine": "long_exposure", "n_pupil": 300},
    "reconstruction": {"components": 4, "order": 1, "truth_order": 2},
}
SMALL = {"run": RUN, "galaxies": {"faintest": 24.0}, "image": {"side": 256}}


@pytest.fixture
def settings(tmp_path):
    """``settings(image__side=64)``: path of a small configuration."""

    def make(**options):
        content = json.loads(json.dumps(SMALL))
        for dotted, value in options.items():
            section, key = dotted.split("__")
            content.setdefault(section, {})[key] = value
        path = tmp_path / "images.yaml"
        path.write_text(yaml.safe_dump(content))
        return str(path)

    return make


def run(*arguments):
    return main(["images", *arguments])


@pytest.mark.long
def test_a_configuration_gives_images_pictures_and_a_configuration_that_gives_them_again(settings, tmp_path, capsys):
    one, two = tmp_path / "one", tmp_path / "two"
    assert run(settings(), "-o", str(one), "--threads", "1", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert set(found["images"]) == {"R22_S11", "R22_S12"}
    names = sorted(path.name for path in one.iterdir())
    assert names == sorted(["images.yaml", *(f"{kind}_{ccd}.{end}" for ccd in found["images"] for kind, end in KINDS)])
    image = CcdImage.read(one / "image_R22_S11.fits")
    assert len(image.objects["ID"]) == found["objects"]["R22_S11"] > 3
    assert image.image.shape == (256, 256)
    # The bright half is sources: the median is that of the noise alone, which the background is subtracted from.
    assert abs(np.median(image.image)) < 3.0 * np.sqrt(np.median(image.variance) / 256)
    for path in one.glob("*.png"):
        with Image.open(path) as picture:
            assert np.asarray(picture.convert("L")).std() > 5.0
    # The configuration in the folder, another number of threads, and one of the CCDs.
    assert run(str(one / "images.yaml"), "-o", str(two), "--ccds", "R22_S12", "--threads", "2", "--quiet") == 0
    for path in two.glob("*R22_S12*"):
        assert path.read_bytes() == (one / path.name).read_bytes(), path.name


KINDS = (("image", "fits"), ("image", "png"), ("cutouts", "png"))


@pytest.mark.long
@pytest.mark.usefixtures("empty_pictures")
def test_going_on_keeps_what_is_whole(settings, tmp_path, capsys):
    out = tmp_path / "out"
    plain = settings(image__preview=False, image__cutouts=False)
    assert run(plain, "-o", str(out), "--quiet") == 0
    first, second = out / "image_R22_S11.fits", out / "image_R22_S12.fits"
    bytes_of, age = second.read_bytes(), first.stat().st_mtime_ns
    second.write_bytes(bytes_of[: len(bytes_of) // 2])
    capsys.readouterr()
    assert run(plain, "-o", str(out), "--resume", "--json", "--quiet") == 0
    assert json.loads(capsys.readouterr().out)["kept"] == ["R22_S11"]
    assert (second.read_bytes(), first.stat().st_mtime_ns) == (bytes_of, age)
    assert run(plain, "-o", str(out), "--exposures", "3", "--resume") == 2
    assert "image.exposures: 1 -> 3" in capsys.readouterr().err


@pytest.mark.long
@pytest.mark.usefixtures("empty_pictures")
def test_both_ways_and_no_noise_from_options(settings, tmp_path):
    images = []
    for way in ("direct", "eigen"):
        out = tmp_path / way
        config = settings(image__preview=False, image__cutouts=False)
        assert run(config, "-o", str(out), "--ccds", "R22_S11", "--way", way, "--no-noise", "--quiet") == 0
        images.append(CcdImage.read(out / "image_R22_S11.fits"))
    assert not images[0].header["NOISE"]
    # A hundredth of the noise of a pixel is left out where a galaxy's grid ends, on four sides at most.
    noise = np.sqrt(np.median(images[0].variance))
    assert 0.0 < np.abs(images[0].image - images[1].image).max() < 0.04 * noise


@pytest.mark.long
@pytest.mark.usefixtures("empty_pictures")
def test_galaxies_of_a_catalogue_stand_where_it_says(settings, tmp_path):
    # Three on the image, by celestial coordinates, and one on the other side of the field.
    pointing = {"ra_deg": 150.0, "dec_deg": 2.0}
    offsets = np.array([[5.0, 3.0], [-8.0, 10.0], [0.0, -12.0], [5000.0, 0.0]]) / 3600.0
    table = Table(
        {
            "ra": 150.0 + offsets[:, 0] / np.cos(np.deg2rad(2.0)),
            "dec": 2.0 + offsets[:, 1],
            "mag": [20.0, 21.0, 22.0, 18.0],
            "half_light_radius": [0.5, 0.4, 0.3, 1.0],
        }
    )
    table.write(tmp_path / "galaxies.ecsv", format="ascii.ecsv")
    config = settings(galaxies__catalogue="galaxies.ecsv", run__ccds="R22_S11", image__noise=False)
    content = yaml.safe_load((tmp_path / "images.yaml").read_text()) | {"pointing": pointing}
    (tmp_path / "images.yaml").write_text(yaml.safe_dump(content))
    assert run(config, "-o", str(tmp_path / "out"), "--quiet") == 0
    image = CcdImage.read(tmp_path / "out" / "image_R22_S11.fits")
    galaxies = ~image.objects["STAR"]
    assert image.objects["MAG"][galaxies].tolist() == [20.0, 21.0, 22.0]
    celestial = np.stack([image.objects["RA"], image.objects["DEC"]], axis=1)[galaxies]
    assert np.allclose(celestial, np.stack([table["ra"], table["dec"]], axis=1)[:3], rtol=0, atol=1e-8)
    for x, y in image.wcs.all_world2pix(celestial[:2], 0):
        stamp = image.image[round(y) - 7 : round(y) + 8, round(x) - 7 : round(x) + 8]
        row, column = np.unravel_index(stamp.argmax(), stamp.shape)
        assert abs(row - 7) <= 1
        assert abs(column - 7) <= 1


@pytest.mark.long
@pytest.mark.usefixtures("empty_pictures")
def test_galaxies_of_a_mosaic_are_planted(settings, tmp_path, capsys):
    rng = np.random.default_rng(4)
    y, x = np.indices((400, 400))
    image = rng.normal(0.0, 0.01, (400, 400))
    for cx, cy in rng.uniform(40, 360, (12, 2)):
        image += 2.0 * np.exp(-np.hypot(x - cx, y - cy) / 5.0)
    header = fits.Header(
        {"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRVAL1": 0.0, "CRVAL2": 0.0, "CRPIX1": 200.0, "CRPIX2": 200.0}
        | {"CD1_1": -0.05 / 3600, "CD1_2": 0.0, "CD2_1": 0.0, "CD2_2": 0.05 / 3600, "MAGZPT": 28.0}
    )
    fits.PrimaryHDU(image.astype(np.float32), header).writeto(tmp_path / "mosaic.fits")
    config = settings(
        galaxies__mosaic="mosaic.fits",
        galaxies__mosaic_psf_arcsec=0.05,
        galaxies__density=0.2,
        run__ccds="R22_S11",
        image__preview=False,
    )
    assert run(config, "-o", str(tmp_path / "out"), "--quiet") == 0
    objects = CcdImage.read(tmp_path / "out" / "image_R22_S11.fits").objects
    # Twelve galaxies in 400 arcsec^2, a fifth of that on 51.2^2 arcsec^2: sixteen, five standard deviations of them.
    assert abs((~objects["STAR"]).sum() - 12 / 400 * 0.2 * 51.2**2) < 5.0 * 4.0
    assert np.isnan(objects["E1"][~objects["STAR"]]).all()
    crowded = settings(galaxies__mosaic="mosaic.fits", galaxies__mosaic_psf_arcsec=0.05, galaxies__density=300.0)
    capsys.readouterr()
    assert run(crowded, "-o", str(tmp_path / "crowd"), "--quiet") == 2
    assert "density = 300" in capsys.readouterr().err


def test_the_run_may_be_a_file(settings, tmp_path, capsys):
    (tmp_path / "run.yaml").write_text(yaml.safe_dump(RUN | {"seed": "x"}))
    (tmp_path / "of_file.yaml").write_text("run: run.yaml\n")
    assert run(str(tmp_path / "of_file.yaml")) == 2
    assert "run.seed" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "arguments", "text"),
    [
        ({"image__exposures": 0}, [], "image.exposures = 0: expected"),
        ({"image__gain": -2.0}, [], "image.gain = -2.0: expected"),
        ({"image__sky_mag": 8.0}, [], "image.sky_mag = 8.00"),
        ({"image__side": 5000}, [], "image.side = 5000: expected at most 4004"),
        ({"image__wey": "direct"}, [], "unknown key image.wey"),
        ({"galaxies__faintest": 12.0}, [], "galaxies.faintest = 12"),
        ({"galaxies__faintest": 19.0}, [], "galaxies.faintest = 19"),
        ({"galaxies__density": 0.0}, [], "galaxies.density = 0"),
        ({"galaxies__density": 1e5}, [], "bury the sky"),
        ({"galaxies__catalogue": "none.ecsv"}, [], "galaxies.catalogue = none.ecsv: no such file"),
        ({"galaxies__mosaic": "none.fits"}, [], "galaxies.mosaic = none.fits: no such file"),
        ({"pointing__dec_deg": 91.0}, [], "pointing.dec_deg = 91"),
        ({}, ["--ccds", "R22_S44"], "R22_S44"),
        ({}, ["--way", "fast"], "--way = 'fast'"),
        ({"run__atmosphere": {"enabled": False}, "run__psf": {}}, [], "atmosphere.enabled = false"),
        ({}, ["--set", "telescope=lsst_v3.3_r"], "did you mean run.telescope?"),
    ],
)
def test_bad_input_is_one_line(settings, tmp_path, capsys, options, arguments, text):
    assert run(settings(**options), "-o", str(tmp_path / "out"), "--quiet", *arguments) == 2
    error = capsys.readouterr().err
    assert text in error
    assert len(error.splitlines()) == 1


def test_help_teaches_by_example(capsys):
    assert run("--help") == 0
    assert "pachon images --ccds R22_S11 --quick" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(("arguments", "side"), [([], 500), (["--set", "image.side=200"], 200)])
def test_a_quick_look_fits_the_camera_and_gives_way_to_what_is_set(tmp_path, monkeypatch, arguments, side):
    ccds = "[{name: A, x_mm: 0, y_mm: 0}]"
    (tmp_path / "own.yaml").write_text(f"name: own\nsource: test\npixel_um: 10\npixels: [500, 600]\nccds: {ccds}\n")
    drawn = []

    def simulated(config, *_, **__):
        drawn.append(config)
        raise PachonError("far enough")

    monkeypatch.setattr("pachon.imaging.simulate.simulate_images", simulated)
    camera = ["--set", f"run.camera={tmp_path / 'own.yaml'}"]
    assert run("--quick", *camera, *arguments, "-o", str(tmp_path / "out"), "--quiet") == 2
    assert drawn[0].image.side == side
    assert drawn[0].run.psf.engine == "long_exposure"
