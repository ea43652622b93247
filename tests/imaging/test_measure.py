"""From a simulated image to a catalogue: stars, the PSF from them and galaxies against the truth of the image."""

import json
from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table

from pachon.commands.cli import main
from pachon.core.errors import PachonError
from pachon.core.long_work import Execution
from pachon.core.units import ARCSEC
from pachon.imaging.draw import Window
from pachon.imaging.exposure import Exposure
from pachon.imaging.exposure_psf import fit_exposure_psf
from pachon.imaging.image_file import CcdImage
from pachon.imaging.image_stars import focal_plane_stars, regular_shapes
from pachon.imaging.measure import measure_image
from pachon.imaging.measure_files import measure_files
from pachon.imaging.scene import draw_ccd
from pachon.measure.catalogue.matching import match_positions
from pachon.pipeline.experiment import Experiment
from pachon.reconstruction.focal_plane_psf.model import FocalPlanePsf
from pachon.reconstruction.psf_model.recipe import Recipe
from pachon.sky.galaxies import Galaxies

pytestmark = pytest.mark.long


def gaussian_galaxies(xi, eta):
    """Galaxies that an elliptical Gaussian fits, on a grid 22 arcsec apart."""
    places = [np.arange(low, high, 22.0 * ARCSEC) for low, high in (xi, eta)]
    x, y = (v.ravel() for v in np.meshgrid(*places))
    rng = np.random.default_rng(5)
    e, magnitude = rng.uniform(-0.3, 0.3, x.size), rng.uniform(20.5, 22.0, x.size)
    radius = rng.uniform(0.5, 1.2, x.size)
    # Half-light radii of many values: stars alone have one.
    return Galaxies.single(x, y, magnitude, radius * ARCSEC, e1=e, e2=0.1, sersic=0.5)


@pytest.fixture(scope="module")
def scene(tiny):
    run = tiny(ccds=("R22_S11",), psf__engine="long_exposure", psf__n_pupil=300, psf__stamp=63, stars__truth=24)
    run = run.model_copy(update={"stars": run.stars.model_copy(update={"observed": 1500})})
    window, deep = Window(1200, 1100, 1200, 1100), Exposure("r", 15.0, 100)
    return draw_ccd(Experiment.from_config(run), "R22_S11", gaussian_galaxies, window=window, exposure=deep)


@pytest.fixture(scope="module")
def image(scene):
    return scene.exposed()


def on_image(truth):
    """Pixels of the image of the objects of its table, which counts those of the CCD."""
    return truth["X"] - 1200, truth["Y"] - 1100


@pytest.fixture(scope="module")
def catalogue(image):
    return measure_image(image, threads=1)


def test_stars_and_objects_against_the_truth(catalogue):
    metrics = catalogue.metrics()
    assert metrics["stars"] >= 15
    assert metrics["star_purity"] > 0.95
    assert metrics["purity"] > 0.95
    # The Gaussian of the long exposure is near 2 pixels of half-light radius.
    assert 1.5 < metrics["star_half_light_radius_pixel"] < 3.0


@pytest.fixture(scope="module")
def focal_plane_psf(image):
    return FocalPlanePsf.fit(focal_plane_stars([image]), camera="lsst", ccds=["R22_S11"], threads=1)


@pytest.fixture(scope="module", params=["kriging", pytest.param("paper", marks=pytest.mark.slow), "focal plane"])
def any_catalogue(image, request):
    if request.param == "kriging":
        return request.getfixturevalue("catalogue")
    if request.param == "paper":
        return measure_image(image, recipe=Recipe.of("paper", order=1), threads=1)
    return measure_image(image, psf=request.getfixturevalue("focal_plane_psf"), threads=1)


def test_stars_of_images_have_honest_noise(image, catalogue, scene):
    stars = focal_plane_stars([image])
    assert set(stars.ccd) == {"R22_S11"}
    assert stars.pixels
    # The image begins at the pixel (1200, 1100) of the CCD.
    at = {(x + 1200, y + 1100) for x, y in catalogue.stars.positions}
    assert at >= set(zip(stars.x, stars.y, strict=True))
    assert len(stars) > 0.9 * len(at)
    # About a cubic trend stars scatter by their noise: the PSF of a long exposure is smooth on 0.3 of a CCD, but for
    # the CCD's height, which adds a fifth to the scatter of sizes about a quadratic one.
    scatter = []
    for seed in range(2, 8):
        stars = focal_plane_stars([replace(scene, seed=seed).exposed()])
        u, v = (stars.x - 1800.0) / 600.0, (stars.y - 1650.0) / 600.0
        terms = np.stack([u**i * v**j for i in range(4) for j in range(4 - i)], axis=1)
        for values, noise in zip(stars.values.T, stars.noise.T, strict=True):
            trend = terms @ np.linalg.lstsq(terms / noise[:, None], values / noise, rcond=None)[0]
            scatter.append((((values - trend) / noise) ** 2).sum() / (len(values) - terms.shape[1]))
    # One image tells a tenth, six of them a twentieth.
    np.testing.assert_allclose(np.sqrt(np.mean(np.reshape(scatter, (6, 3)), axis=0)), 1.0, atol=0.12)


def test_blends_within_the_stellar_locus_are_no_stars():
    rng = np.random.default_rng(4)
    positions, snr = rng.uniform(0.0, 4096.0, (40, 2)), rng.uniform(30.0, 300.0, 40)
    values = 1e-5 * positions[:, :1] * [1.0, -1.0, 0.5] + rng.normal(size=(40, 3)) * 0.5 / snr[:, None]
    assert regular_shapes(values, snr, positions).sum() >= 38
    values[7, 1] += 0.06
    assert not regular_shapes(values, snr, positions)[7]
    # Too few to tell.
    assert regular_shapes(values[:11], snr[:11], positions[:11]).all()


def test_gaussian_galaxies_have_their_own_ellipticity(any_catalogue, image):
    truth, catalogue = image.objects, any_catalogue
    rows = catalogue.galaxies
    match = match_positions(catalogue.objects.x[rows], catalogue.objects.y[rows], *on_image(truth), 1.0)
    good = (match >= 0) & catalogue.usable
    good[good] &= ~truth["STAR"][match[good]].astype(bool)
    assert good.sum() > 80
    # On the sky: the truth is along east, which the axes of the pixels are not.
    deviation = np.array(catalogue.table()["g1_sky"])[good] - truth["E1"][match[good]]
    error = catalogue.fits.e1_error[good]
    # Stars and galaxies overlap here and there: the median is robust.
    assert abs(np.median(deviation)) < 5e-3
    assert 1.4826 * np.median(np.abs(deviation / error)) == pytest.approx(1.0, abs=0.3)


def test_the_table_has_sky_positions(catalogue, image):
    table = catalogue.table()
    truth = image.objects
    match = match_positions(table["x"], table["y"], *on_image(truth), 1.0)
    own = match >= 0
    apart = 3600.0 * np.hypot(
        (table["ra"][own] - truth["RA"][match[own]] + 180.0) % 360.0 - 180.0,
        table["dec"][own] - truth["DEC"][match[own]],
    )
    assert np.median(apart) < 0.02
    assert table["ra"].unit == "deg"


def test_the_command_writes_catalogue_and_psf(image, catalogue, tmp_path, capsys, monkeypatch):
    image.write(tmp_path / "image.fits")
    assert main(["measure", str(tmp_path / "image.fits"), "--json", "--quiet", "-o", str(tmp_path / "out")]) == 0
    found = json.loads(capsys.readouterr().out)["images"]["image.fits"]
    assert found["stars"] == len(catalogue.stars)
    table = Table.read(tmp_path / "out" / "image_galaxies.fits")
    np.testing.assert_array_equal(table["e1"], catalogue.fits.e1)
    assert fits.getheader(tmp_path / "out" / "image_psf.fits")["SIMPLE"]
    # Products beside the images, which image*.fits finds too, are no images.
    for name in ("image_galaxies.fits", "image_psf.fits"):
        (tmp_path / name).write_bytes((tmp_path / "out" / name).read_bytes())
    given = [str(path) for path in sorted(tmp_path.glob("image*.fits"))]
    monkeypatch.setattr("pachon.imaging.measure_files.measure_image", lambda read, **_: replace(catalogue, image=read))
    assert main(["measure", *given, "--json", "--quiet", "-o", str(tmp_path / "again")]) == 0
    assert list(json.loads(capsys.readouterr().out)["images"]) == ["image.fits"]


@pytest.mark.slow
def test_images_side_by_side_have_the_same_products(image, tmp_path, capsys):
    for name in ("a", "b"):
        image.write(tmp_path / f"{name}.fits")
    images = [str(tmp_path / name) for name in ("a.fits", "b.fits", "a.fits")]
    for folder, options in (("one", ()), ("two", ("--processes", "2"))):
        assert main(["measure", *images, "--json", "--quiet", "-o", str(tmp_path / folder), *options]) == 0
        assert list(json.loads(capsys.readouterr().out)["images"]) == ["a.fits", "b.fits"]
    one, two = ({path.name: path.read_bytes() for path in (tmp_path / folder).iterdir()} for folder in ("one", "two"))
    assert sorted(one) == ["a_galaxies.fits", "a_psf.fits", "b_galaxies.fits", "b_psf.fits"]
    assert one == two
    # One catalogue is of another image, one is damaged; the third is kept.
    image.write(tmp_path / "c.fits")
    assert main(["measure", str(tmp_path / "c.fits"), "--quiet", "-o", str(tmp_path / "two")]) == 0
    kept = (tmp_path / "two" / "c_galaxies.fits").stat().st_mtime_ns
    capsys.readouterr()
    (tmp_path / "two" / "a_galaxies.fits").write_bytes(one["a_galaxies.fits"][:5000])
    replace(image, image=image.image + 1.0).write(tmp_path / "b.fits")
    images = [str(tmp_path / name) for name in ("a.fits", "b.fits", "c.fits")]
    assert main(["measure", *images, "--json", "--quiet", "--resume", "-o", str(tmp_path / "two")]) == 0
    metrics = json.loads(capsys.readouterr().out)["images"]
    assert metrics["a.fits"] == metrics["c.fits"]
    assert (tmp_path / "two" / "a_galaxies.fits").read_bytes() == one["a_galaxies.fits"]
    assert (tmp_path / "two" / "b_galaxies.fits").read_bytes() != one["b_galaxies.fits"]
    assert (tmp_path / "two" / "c_galaxies.fits").stat().st_mtime_ns == kept


def flipped(data, place):
    """Bytes of which one has a bit flipped, at a fraction of their length."""
    i = min(int(place * len(data)), len(data) - 1)
    return data[:i] + bytes([data[i] ^ 0x10]) + data[i + 1 :]


#: What happens to a file: functions of its bytes, and those of the same product of another image.
DAMAGES = {
    "deleted": lambda data, other: None,
    "empty": lambda data, other: b"",
    "cut to a half": lambda data, other: data[: len(data) // 2],
    "cut to whole blocks": lambda data, other: data[: len(data) // 5760 * 2880],
    "without its last block": lambda data, other: data[:-2880],
    "without its last byte": lambda data, other: data[:-1],
    "a block longer": lambda data, other: data + bytes(2880),
    "a few bytes longer": lambda data, other: data + b"more",
    "zeros from the middle on": lambda data, other: data[: len(data) // 2] + bytes(len(data) - len(data) // 2),
    "a text": lambda data, other: b"this is no FITS file\n" * 200,
    "that of another image": lambda data, other: other,
    **{
        f"a bit flipped at {place:.4f}": lambda data, other, place=place: flipped(data, place)
        for place in (0.0, 0.0004, 0.1, 0.77, 1.0)
    },
}

#: Damages of each kind, of files, of blocks and of bits; the others are slow.
QUICK = {
    "deleted",
    "cut to a half",
    "cut to whole blocks",
    "a text",
    "that of another image",
    "a bit flipped at 0.7700",
}


@pytest.fixture(scope="module")
def measured(image, catalogue, tmp_path_factory):
    """A folder with two images and their products, and the bytes of these; neither image is measured anew."""
    folder = tmp_path_factory.mktemp("measured")
    image.write(folder / "a.fits")
    replace(image, image=image.image + 1.0).write(folder / "b.fits")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pachon.imaging.measure_files.measure_image", lambda read, **_: replace(catalogue, image=read))
        measure_files([folder / "a.fits", folder / "b.fits"], folder, execution=Execution(threads=1))
    return folder, {path.name: path.read_bytes() for path in folder.glob("*_*.fits")}


@pytest.mark.parametrize("damage", [pytest.param(d, marks=[pytest.mark.slow] * (d not in QUICK)) for d in DAMAGES])
@pytest.mark.parametrize("product", [pytest.param("psf", marks=pytest.mark.slow), "galaxies"])
def test_a_damaged_product_is_made_again_to_the_same_bytes(measured, monkeypatch, catalogue, product, damage):
    folder, whole = measured
    damaged = DAMAGES[damage](whole[f"a_{product}.fits"], whole[f"b_{product}.fits"])
    if damaged == whole[f"a_{product}.fits"]:
        # Both images have the PSF model of one catalogue here: the catalogue of the other is what can be told.
        assert (product, damage) == ("psf", "that of another image")
        return
    path = folder / f"a_{product}.fits"
    path.unlink() if damaged is None else path.write_bytes(damaged)
    measured_images = []

    def measure_once(image, **options):
        # Measuring takes seconds, and gives the same bytes (see above).
        measured_images.append(image)
        return replace(catalogue, image=image)

    monkeypatch.setattr("pachon.imaging.measure_files.measure_image", measure_once)
    found = measure_files([folder / "a.fits", folder / "b.fits"], folder, execution=Execution(resume=True, threads=1))
    assert len(measured_images) == 1
    assert {path.name: path.read_bytes() for path in folder.glob("*_*.fits")} == whole
    assert list(found.metrics) == ["a.fits", "b.fits"]
    # Whole ones stay.
    measure_files([folder / "a.fits", folder / "b.fits"], folder, execution=Execution(resume=True, threads=1))
    assert len(measured_images) == 1


@pytest.mark.slow
def test_images_of_one_name_have_no_common_folder(image, tmp_path, capsys):
    images = [tmp_path / folder / "image.fits" for folder in ("first", "second")]
    for path in images:
        path.parent.mkdir()
        image.write(path)
    given = ["measure", *map(str, images), "--json", "--quiet"]
    assert main([*given, "-o", str(tmp_path / "out")]) == 2
    assert "two images are called image.fits; expected different names, or no --out" in capsys.readouterr().err
    assert main(given) == 0
    assert list(json.loads(capsys.readouterr().out)["images"]) == [str(path) for path in images]
    assert all(path.with_name("image_galaxies.fits").exists() for path in images)


@pytest.mark.slow
def test_the_command_fits_one_psf_to_all_images(image, focal_plane_psf, tmp_path, capsys):
    image.write(tmp_path / "image.fits")
    command = ["measure", str(tmp_path / "image.fits"), "--model", "focal_plane", "--json", "--quiet"]
    assert main([*command, "--telescope", "lsst_v3.3_r"]) == 0
    assert json.loads(capsys.readouterr().out)["images"]["image.fits"]["usable"] > 80
    product = tmp_path / "image_galaxies.fits"
    before = product.read_bytes()
    assert main([*command, "--telescope", "lsst_v3.3_r", "--processes", "2"]) == 0
    assert product.read_bytes() == before
    capsys.readouterr()
    found = FocalPlanePsf.read(tmp_path / "focal_plane_psf.fits")
    assert found.field.optics is not None
    own = fit_exposure_psf([tmp_path / "image.fits"], found.field.optics.instrument.telescope)
    np.testing.assert_array_equal(own.draw("R22_S11", 0.0, 0.0), found.draw("R22_S11", 0.0, 0.0))
    assert not (tmp_path / "image_psf.fits").exists()


def test_kinds_of_models_that_do_not_go_together(image, focal_plane_psf, tmp_path, capsys):
    with pytest.raises(PachonError, match="recipe is of a model of the CCD"):
        measure_image(image, psf=focal_plane_psf, recipe="paper")
    with pytest.raises(PachonError, match="no stars on the images: there are no images"):
        focal_plane_stars([])
    image.write(tmp_path / "image.fits")
    for options, expected in (
        (("--model", "raft"), "--model = 'raft': expected one of ccd, focal_plane"),
        (("--telescope", "lsst_v3.3_r"), "--telescope: expected with --model focal_plane alone"),
        (("--basis", "wavelets"), "basis = 'wavelets'"),
        (("--model", "focal_plane"), "images.yaml for the focal-plane model; expected a telescope"),
    ):
        assert main(["measure", str(tmp_path / "image.fits"), *options]) == 2
        error = capsys.readouterr().err
        assert expected in error
        assert error.count("\n") == 1


def test_what_cannot_be_measured(image, catalogue, tmp_path, capsys, monkeypatch):
    empty = CcdImage(image.name, 0.0 * image.image, image.variance, image.mask, image.header, image.objects)
    with pytest.raises(PachonError, match="CCD R22_S11: "):
        measure_image(empty)
    empty.write(tmp_path / "empty.fits")
    assert main(["measure", str(tmp_path / "empty.fits"), "--quiet"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    # The others go on; the good one has been measured above.
    image.write(tmp_path / "image.fits")
    monkeypatch.setattr(
        "pachon.imaging.measure_files.measure_image",
        lambda read, **options: replace(catalogue, image=read) if read.image.any() else measure_image(read, **options),
    )
    assert main(["measure", str(tmp_path / "empty.fits"), str(tmp_path / "image.fits"), "--json", "--quiet"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert list(found["images"]) == ["image.fits"]
    assert found["left_out"]["empty.fits"].startswith("CCD R22_S11: ")
    (tmp_path / "text.fits").write_text("no image")
    assert main(["measure", str(tmp_path / "text.fits")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
