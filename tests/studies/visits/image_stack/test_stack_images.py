"""Stacked images: stars against the stack of PSFs, positions, files, interruptions, refusals."""

import numpy as np
import pytest
from astropy.wcs import WCS

from pachon.commands.cli import main
from pachon.core.errors import DomainError, ProductError
from pachon.core.long_work import Execution
from pachon.core.units import ARCSEC
from pachon.imaging.image_file import CcdImage
from pachon.measure.shapes import measure_shapes
from pachon.studies.visits.image_stack import stack_images as module
from pachon.studies.visits.image_stack.config import ImageStackConfig, load_image_stack_configuration
from pachon.studies.visits.image_stack.stack_images import ImageStack, stack_images
from pachon.studies.visits.image_stack.tiles import TileSums, choose_tiles
from pachon.studies.visits.image_stack.transfer import broadened, mean_transfer
from pachon.studies.visits.psf_visit import visit_experiment

SMALL = ImageStackConfig(faintest=21.5, side=128)


def isolated(objects, star, distance):
    """Objects at least so far from all others and from the edges of the tile of 1024 pixels [pixel]."""
    at = np.stack([objects["X"], objects["Y"]], axis=1)
    apart = np.hypot(*(at[:, None] - at).transpose(2, 0, 1)) + 1e9 * np.eye(len(at))
    inside = ((at > distance) & (at < 1023.0 - distance)).all(axis=1)
    return np.flatnonzero((objects["STAR"] == star) & inside & (apart.min(axis=1) > distance)), at


def cutout(image, at, half):
    """The pixels around a place, and the distances of the middle one from it."""
    x, y = np.rint(at).astype(int)
    return image[y - half : y + half + 1, x - half : x + half + 1].astype(float), at - (x, y)


def moved(stamp, by):
    """A stamp moved by its Fourier transform."""
    fy, fx = np.fft.fftfreq(len(stamp))[:, None], np.fft.fftfreq(len(stamp))
    return np.fft.ifft2(np.fft.fft2(stamp) * np.exp(-2j * np.pi * (fx * by[0] + fy * by[1]))).real


@pytest.mark.long
@pytest.mark.parametrize(("visits", "tolerance"), [(1, 4e-3), (2, 2e-2)])
def test_stars_are_the_psfs_of_the_stack(noise_free, visits, tolerance):
    stack, psfs = noise_free
    tile, psf = stack.tiles[0], psfs[visits]
    image = stack.image(visits, tile)
    ccds = [ccd for _, wcs in stack.wcs(stack.plan[:visits]) for ccd in wcs.values()]
    transfer = mean_transfer(tile, stack.frame, ccds)
    stars, at = isolated(image.objects, True, 60.0)
    assert len(stars) >= 6
    for i in stars:
        k = np.hypot(psf.xi - image.objects["XI"][i], psf.eta - image.objects["ETA"][i]).argmin()
        # Stamps of PSFs are centred on a pixel. Stars are not: in each visit interpolation lowers their peaks by up to
        # 6 % (FWHM of 2.6 pixels), by how far they are from the centre of a pixel. The transfer function has the mean
        # of that over the tile: of the first visit, without roll, all stars are at the centres, as the PSF is; of each
        # rolled one the rest is a few per cent of the peak, and falls with the number of visits.
        expected = broadened(psf.true[k : k + 1], transfer)[0]
        stamp, offset = cutout(image.image, at[i], 24)
        stamp = moved(stamp, -offset)[9:-9, 9:-9]
        assert np.abs(stamp / stamp.sum() - expected).max() < tolerance * expected.max()


@pytest.mark.long
def test_fluxes_and_positions_of_stars_are_the_true_ones(noise_free):
    stack, _ = noise_free
    image = stack.image(2, stack.tiles[0])
    stars, at = isolated(image.objects, True, 62.0)
    # The brightest, since neighbours have light within the stamps of others.
    stars = stars[np.argsort(image.objects["FLUX"][stars])[-2:]]
    assert len(stars) == 2
    for i in stars:
        # Stamps of stars have 113 pixels, all their light within.
        stamp, _ = cutout(image.image, at[i], 59)
        assert stamp.sum() == pytest.approx(image.objects["FLUX"][i], rel=1e-3)
        stamp, offset = cutout(image.image, at[i], 15)
        shapes = measure_shapes(stamp[None], stack.exposure().pixel_scale, stack.experiment.weight_fwhm)
        assert np.hypot(shapes.x[0] - offset[0], shapes.y[0] - offset[1]) < 0.02


@pytest.mark.long
def test_galaxies_are_where_the_header_says(noise_free):
    stack, _ = noise_free
    image = stack.image(2, stack.tiles[0])
    objects = image.objects
    sky = WCS(image.header).all_pix2world(np.stack([objects["X"], objects["Y"]], axis=1), 0)
    assert np.allclose((sky[:, 0] + 180.0) % 360.0 - 180.0, (objects["RA"] + 180.0) % 360.0 - 180.0, rtol=0, atol=1e-9)
    assert np.allclose(sky[:, 1], objects["DEC"], rtol=0, atol=1e-9)
    galaxies, at = isolated(objects, False, 30.0)
    assert len(galaxies) >= 8
    for i in galaxies:
        stamp, offset = cutout(image.image, at[i], 15)
        shapes = measure_shapes(stamp[None], stack.exposure().pixel_scale, stack.experiment.weight_fwhm)
        assert np.hypot(shapes.x[0] - offset[0], shapes.y[0] - offset[1]) < 0.02


def files(folder):
    return {path.name: path.read_bytes() for path in sorted(folder.glob("images/*.fits"))}


@pytest.mark.slow
def test_an_interrupted_stack_ends_with_the_same_bytes(visits_folder, backwards, monkeypatch, tmp_path_factory):
    settings = SMALL.model_copy(update={"tiles": 2})
    whole = tmp_path_factory.mktemp("whole")
    (whole / "config.yaml").write_bytes((visits_folder / "config.yaml").read_bytes())
    stack_images(whole, settings, execution=Execution(threads=1))

    write, calls = TileSums.write, []

    def interrupted(sums, path, stamp):
        calls.append(path)
        # After the first of two tiles of the second visit.
        if len(calls) == 4:
            raise KeyboardInterrupt
        write(sums, path, stamp)

    monkeypatch.setattr(TileSums, "write", interrupted)
    with pytest.raises(KeyboardInterrupt):
        stack_images(visits_folder, settings, execution=Execution(threads=2))
    monkeypatch.undo()
    assert files(visits_folder) != files(whole)
    stack_images(visits_folder, settings, execution=Execution(resume=True, threads=2))
    assert files(visits_folder) == files(whole)
    assert len(files(whole)) == 6
    others = tmp_path_factory.mktemp("workers")
    (others / "config.yaml").write_bytes((whole / "config.yaml").read_bytes())
    stack_images(others, settings, execution=Execution(workers=backwards))
    assert files(others) == files(whole)
    (whole / "images" / "stack_0001_tile_+00_+00.fits").unlink()
    with pytest.raises(ProductError, match=r"no image of 1 visit of tile \+00_\+00, and has gone on"):
        stack_images(whole, settings, execution=Execution(resume=True))


@pytest.mark.long
def test_a_tile_alone_has_the_noise_that_it_has_among_others(visits_folder):
    """Of tiles of which one was written before an interruption, only the other is due."""
    stack = ImageStack.of(visits_folder, SMALL.model_copy(update={"tiles": 2}))
    ((visit, wcs),) = stack.wcs(stack.plan[:1])
    experiment = visit_experiment(stack.experiment, visit)
    both = module.draw_visit(stack, None, (visit, experiment, wcs, stack.tiles), 1)
    for tile in stack.tiles:
        alone = module.draw_visit(stack, None, (visit, experiment, wcs, [tile]), 1)
        np.testing.assert_array_equal(alone[tile].data, both[tile].data)


def test_images_of_several_tiles_are_found_again(visits_folder):
    settings = SMALL.model_copy(update={"tiles": 2, "noise": False})
    stack = ImageStack.of(visits_folder, settings)
    (visits_folder / "images").mkdir()
    (visits_folder / "images" / "images.yaml").write_text(stack.settings.to_yaml())
    found = ImageStack.of(visits_folder)
    assert (found.settings, found.stamp, len(found.tiles)) == (stack.settings, stack.stamp, 2)


@pytest.mark.long
def test_an_image_is_one_of_a_ccd(visits_folder):
    stack = stack_images(visits_folder, SMALL)
    image = CcdImage.read(stack.path(2, stack.tiles[0]))
    assert image.header["EXPTIME"] == 4.0
    assert image.image.shape == image.variance.shape == image.mask.shape == (128, 128)
    assert not image.mask.any()
    # Two visits, of which the first is not resampled, and the other to (57/70)^2 of its variance on average.
    rms = stack.exposure(2).noise_rms
    sky = image.image[np.abs(image.image) < 4.0 * rms]
    assert np.median(image.variance) == pytest.approx(rms**2 * 0.5 * (1.0 + (57.0 / 70.0) ** 2), rel=0.03)
    assert 1.4826 * np.median(np.abs(sky - np.median(sky))) == pytest.approx(
        np.sqrt(np.median(image.variance)), rel=0.03
    )


def test_tiles_go_outwards_and_are_seen(visits_folder):
    stack = ImageStack.of(visits_folder, SMALL)
    tiles = choose_tiles(stack.experiment, stack.frame, 1024, 9, stack.visits)
    assert [(t.column, t.row) for t in tiles[:5]] == [(0, 0), (-1, 0), (0, -1), (0, 1), (1, 0)]
    with pytest.raises(DomainError, match="no tile of 20000 pixels"):
        choose_tiles(stack.experiment, stack.frame, 20000, 1, stack.visits)


def test_the_settings_in_the_folder_have_every_default_written_out(visits_folder, tmp_path_factory, monkeypatch):
    folder = tmp_path_factory.mktemp("visits")
    (folder / "config.yaml").write_bytes((visits_folder / "config.yaml").read_bytes())

    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(module, "_sums_so_far", stop)
    settings = ImageStackConfig(side=128)
    with pytest.raises(KeyboardInterrupt):
        stack_images(folder, settings)
    assert settings.faintest is None
    written = load_image_stack_configuration(folder / "images" / "images.yaml")
    assert written.faintest == ImageStack.of(folder, settings).settings.faintest


def test_refusals(visits_folder, tmp_path_factory, monkeypatch, capsys):
    assert main(["stack-images", str(tmp_path_factory.mktemp("nothing"))]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert "no visits" in err
    assert main(["stack-images", str(visits_folder), "--faintest", "nan"]) == 2
    assert capsys.readouterr().err == "pachon: error: command line: faintest = NaN: expected a number from 15\n"
    with pytest.raises(ProductError, match="no images"):
        ImageStack.of(visits_folder)
    monkeypatch.setattr(module.shutil, "disk_usage", lambda _: type("Usage", (), {"free": 1000}))
    folder = tmp_path_factory.mktemp("visits")
    (folder / "config.yaml").write_bytes((visits_folder / "config.yaml").read_bytes())
    with pytest.raises(DomainError, match="of disk"):
        stack_images(folder, SMALL)
    # Settings that were refused are not left behind.
    assert [path.name for path in folder.iterdir()] == ["config.yaml"]
    monkeypatch.undo()
    (folder / "images").mkdir()
    (folder / "images" / "images.yaml").write_text(ImageStack.of(folder, SMALL).settings.to_yaml())
    with pytest.raises(ProductError, match="go on with --resume"):
        stack_images(folder, SMALL)
    with pytest.raises(ProductError, match="images of another configuration"):
        stack_images(folder, SMALL.model_copy(update={"noise": False}), execution=Execution(resume=True))


def test_the_limit_of_the_galaxies_follows_the_depth_and_then_stays(visits_folder, small_visits):
    stack = ImageStack.of(visits_folder, ImageStackConfig(side=128))
    # A square of the area of a CCD of 4096 x 4004 pixels.
    assert ImageStack.of(visits_folder, ImageStackConfig()).settings.side == 4050
    (visits_folder / "images").mkdir()
    (visits_folder / "images" / "images.yaml").write_text(stack.settings.to_yaml())
    more = small_visits.model_copy(update={"visits": small_visits.visits.model_copy(update={"count": 32})})
    (visits_folder / "config.yaml").write_text(more.resolved(more.experiment()).to_yaml())
    assert ImageStack.of(visits_folder, ImageStackConfig()).settings == stack.settings
    (visits_folder / "images" / "images.yaml").unlink()
    # Sixteen times the visits: four times the S/N, 1.5 magnitudes.
    deeper = ImageStack.of(visits_folder, ImageStackConfig()).settings.faintest
    assert deeper == pytest.approx(stack.settings.faintest + 2.5 * np.log10(4.0), abs=0.011)


def test_the_frame_has_the_scale_of_the_camera(visits_folder):
    stack = ImageStack.of(visits_folder, SMALL)
    assert stack.exposure().pixel_scale == pytest.approx(0.2 * ARCSEC, rel=1e-3)
