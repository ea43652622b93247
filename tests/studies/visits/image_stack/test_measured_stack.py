"""Figures of tiles: counts and slopes known beforehand, and a small stack with noise."""

import json
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from pachon.commands.cli import main
from pachon.core.errors import DomainError
from pachon.core.units import ARCMIN
from pachon.measure.catalogue.objects import DetectedObjects
from pachon.measure.shear.shear_shapes import ShearShapes
from pachon.pipeline.run_folder import CONFIG_NAME
from pachon.studies.visits.galaxy_shapes import GalaxyShapes
from pachon.studies.visits.image_stack.measure import MeasuredTile, null_tests, selected_stars, tile_metrics
from pachon.studies.visits.null_result import null_metrics
from pachon.studies.visits.visits import stack_path

RNG = np.random.default_rng(4)


def shapes(index, e, usable):
    n = len(index)
    e = np.asarray(e)
    nothing = np.zeros(n)
    flags = np.asarray(usable, dtype=bool)
    shear = ShearShapes(e.real, e.imag, flags + 0.0, nothing, flags + 0.0, flags + 0.0, nothing)
    return GalaxyShapes(
        np.asarray(index),
        nothing,
        nothing,
        nothing,
        e.real,
        e.imag,
        nothing,
        flags,
        e.real,
        e.imag,
        flags,
        shear,
        shear,
    )


def test_figures_of_known_galaxies():
    n = 4000
    reference = RNG.normal(0.0, 0.2, n) + 1j * RNG.normal(0.0, 0.2, n)
    noise = [0.05 * (RNG.normal(size=n) + 1j * RNG.normal(size=n)) for _ in range(2)]
    # Of 4000 galaxies the last 100 are not detected, the 200 before not usable; 50 objects are no galaxies.
    index = np.concatenate([np.arange(n - 100), np.full(50, -1)])
    usable = np.ones(len(index), dtype=bool)
    usable[n - 300 : n - 100] = False
    measured = 0.9 * reference + 0.01 - 0.02j + noise[0]
    image = shapes(index, np.concatenate([measured[: n - 100], np.zeros(50)]), usable)
    stamps = shapes(np.arange(n), reference + noise[1], np.ones(n))
    tile = MeasuredTile(image, stamps, shapes(np.arange(n), reference, np.ones(n)), 100.0, {})
    found = tile_metrics([tile, tile])
    assert found["usable_per_arcmin2"] == pytest.approx(37.5)
    assert found["usable_per_arcmin2_stamps"] == pytest.approx(40.0)
    assert found["usable_without_match"] == pytest.approx(0.5)
    assert found["stamps_not_detected"] == pytest.approx(1.0)
    assert found["stamps_detected_not_usable"] == pytest.approx(2.0)
    assert found["pairs"] == 2 * 3700
    # Noise of 0.05 and 0.05, and the ellipticities that a response of 0.9 leaves, 0.02, of 3700 galaxies twice.
    error = np.sqrt(2.0 * 0.05**2 + 0.02**2) / np.sqrt(2 * 3700)
    assert found["mean_difference_error"] == pytest.approx(error, rel=0.03)
    assert found["mean_difference_e1"] == pytest.approx(0.01, abs=5.0 * error)
    assert found["mean_difference_e2"] == pytest.approx(-0.02, abs=5.0 * error)
    # Both components of 3700 galaxies, known to 0.07 of a spread of 0.2.
    assert found["response_difference"] == pytest.approx(-0.1, abs=5.0 * 0.07 / 0.2 / np.sqrt(2 * 3700))
    assert found["response_difference_error"] == pytest.approx(0.0707 / 0.2 / np.sqrt(4 * 3700), rel=0.05)


def test_no_galaxies_have_no_figures():
    nothing = shapes(np.zeros(0, dtype=int), np.zeros(0, dtype=complex), [])
    found = tile_metrics([MeasuredTile(nothing, nothing, nothing, 1.0, {})])
    assert found["usable_per_arcmin2"] == 0.0
    assert found["mean_difference_e1"] is None
    assert found["response_difference"] is None


def test_null_tests_of_tiles_correlate_what_is_common_to_their_galaxies():
    """Ellipticities that are equal everywhere have their square as correlation, at all separations."""
    common, added = 0.03 - 0.01j, 0.002 + 0.004j

    def tile(corner):
        x, y = ARCMIN * (RNG.uniform(0.0, 13.0, (2, 300)) + np.array(corner)[:, None])
        e = np.full(300, common)
        usable = np.arange(300) > 50
        galaxies = replace(shapes(np.arange(300), e, usable), x=x, y=y, e1=(e + added).real, e2=(e + added).imag)
        nothing = shapes(np.zeros(0, dtype=int), np.zeros(0, dtype=complex), [])
        return MeasuredTile(galaxies, nothing, nothing, 169.0, {})

    found = null_tests(
        {1: [tile((0.0, 0.0)), tile((13.0, 0.0))], 10: [MeasuredTile(*[tile((0, 0)).stamps] * 3, 1.0, {})]}
    )
    assert list(found) == [1]
    assert found[1].density == pytest.approx(249 / 169)
    for kind, e in (("model", common + added), ("true", common), ("difference", added)):
        np.testing.assert_allclose(found[1].correlations[kind].xi_plus, abs(e) ** 2, rtol=1e-6)
    assert null_metrics(found[1])["xi_plus_difference_short"] == pytest.approx(abs(added) ** 2)


def test_few_stars_are_found_where_the_psfs_say():
    """Seven stars among more bright galaxies, ten of which are equally large."""
    n = 30
    snr = np.full(n, 200.0)
    radius = np.concatenate([RNG.normal(1.7, 0.01, 7), RNG.normal(3.0, 0.01, 10), RNG.uniform(2.0, 4.0, n - 17)])
    x = y = np.linspace(40.0, 960.0, n)
    nothing, flags = np.zeros(n), np.zeros(n, dtype=int)
    objects = DetectedObjects(
        x=x,
        y=y,
        flux=snr,
        flux_error=nothing + 1.0,
        half_light_radius=radius,
        fwhm=2.0 * radius,
        a=radius,
        b=radius,
        theta=nothing,
        peak=snr,
        neighbour_distance=nothing + 30.0,
        flags=flags,
        background=np.zeros((1000, 1000)),
        segmentation=np.zeros((1000, 1000), dtype=int),
    )
    image = SimpleNamespace(image=np.ones((1000, 1000)), mask=np.zeros((1000, 1000), dtype=int))
    # A Gaussian has half of its light within 1.177 sigma.
    place = np.arange(31) - 15.0
    psf = np.exp(-0.5 * (place[:, None] ** 2 + place**2) / (1.69 / 1.1774) ** 2)
    stars = selected_stars(objects, image, (psf / psf.sum())[None], 30.0, 9)
    assert stars.half_light_radius == pytest.approx(1.7, abs=0.02)
    assert list(stars.index) == list(range(7))
    wrong = np.exp(-0.5 * (place[:, None] ** 2 + place**2) / 4.0**2)
    with pytest.raises(DomainError, match="no stellar locus: 0 bright objects"):
        selected_stars(objects, image, (wrong / wrong.sum())[None], 30.0, 9)


@pytest.mark.slow
def test_a_small_stack_is_measured(visit_products, small_visits, tmp_path, capsys):
    section = small_visits.visits.model_copy(update={"snapshots": (2,)})
    last = small_visits.model_copy(update={"visits": section})
    (tmp_path / CONFIG_NAME).write_text(last.resolved(last.experiment()).to_yaml())
    stack_path(tmp_path, 2).write_bytes(stack_path(visit_products, 2).read_bytes())
    command = ["stack-images", str(tmp_path), "--side", "1280", "--faintest", "22", "--json", "--quiet"]
    assert main(command) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["stacks"] == json.loads((tmp_path / "images" / "images.json").read_text())["stacks"]
    assert list(printed["stacks"]) == ["2"]
    for figures in printed["stacks"].values():
        assert figures["stars"][0]["true"] >= 10
        # PSFs and stars of one image: sizes agree to their noise.
        assert abs(figures["stars"][0]["size_difference"]) < 0.03
        assert 0.5 < figures["usable_per_arcmin2"] / figures["usable_per_arcmin2_stamps"] < 1.5
        # Shot noise of what is left of one image and of its PSF.
        test = figures["null_test"]
        assert 0.1 < test["mean_abs_xi_plus"] / test["shot_noise_xi_plus"] < 5.0
    for name in ("images.png", "null_test.png", "null_test_density.png"):
        assert (tmp_path / "images" / name).stat().st_size > 10000


@pytest.mark.slow
def test_images_with_too_few_stars_are_kept(visit_products, small_visits, tmp_path, capsys):
    section = small_visits.visits.model_copy(update={"snapshots": (2,)})
    last = small_visits.model_copy(update={"visits": section})
    (tmp_path / CONFIG_NAME).write_text(last.resolved(last.experiment()).to_yaml())
    stack_path(tmp_path, 2).write_bytes(stack_path(visit_products, 2).read_bytes())
    command = ["stack-images", str(tmp_path), "--side", "96", "--faintest", "20.5", "--quiet"]
    assert main(command) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    folder = tmp_path / "images"
    assert "2 visits, tile " in error
    assert f"the stacked images are kept in {folder}" in error
    kept = {path.name: path.read_bytes() for path in folder.glob("*.fits")}
    assert any(name.startswith("stack") for name in kept)
    assert (folder / "images.png").exists()
    assert main([*command, "--resume", "--no-measure"]) == 0
    assert {path.name: path.read_bytes() for path in folder.glob("*.fits")} == kept


def test_examples_of_help_measure_no_tiles_with_too_few_stars(capsys, monkeypatch):
    """A tile without a stellar locus, of five bright stars, ends the command; a CCD has forty stars by default."""
    monkeypatch.setenv("COLUMNS", "200")
    assert main(["stack-images", "--help"]) == 0
    examples = re.findall(r"pachon stack-images .*--side (\d+)(.*)", capsys.readouterr().out)
    assert examples
    for side, others in examples:
        assert 40 * (int(side) / 4000) ** 2 > 5 or "--no-measure" in others
