"""Bias of the shear of the population of the sky, by the benchmarks: isolated galaxies, detection, blends."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[3] / "benchmarks"
NUMBER = r"([+-][\d.e+-]+) \+- ([\d.]+(?:e-\d+)?)"


def biases(script, *options):
    """m, c1, c2 and their errors of each line that has them."""
    command = [sys.executable, BENCHMARKS / script, *map(str, options)]
    text = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return [
        {name: (float(value), float(error)) for name, value, error in re.findall(rf"\b(m|c1|c2) = {NUMBER}", line)}
        for line in text.splitlines()
        if re.search(f"m = {NUMBER}", line)
    ]


@pytest.mark.slow
def test_isolated_galaxies_at_the_depth_of_a_hundred_visits():
    """With noise, and with a selection at S/N 10 too."""
    all_and_bright = biases("shear_estimator.py", "--galaxies", 16384, "--realisations", 16, "--seed", 4)
    assert len(all_and_bright) == 2
    for m, error in (line["m"] for line in all_and_bright):
        assert error < 4e-4
        assert abs(m) < 1e-3 + 2.0 * error


@pytest.mark.slow
def test_selection_adds_no_ellipticity_of_the_psf():
    """Of four PSFs with g of 0.004 to 0.03, at S/N 10, whose M0 is correlated with M1 and M2 by up to 0.015."""
    options = ("--galaxies", 8192, "--realisations", 512, "--noise", "functionals", "--min-snr", 10)
    for line in biases("shear_estimator.py", *options):
        for c, error in (line["c1"], line["c2"]):
            assert error < 4e-5
            assert abs(c) < 1e-4


@pytest.mark.slow
def test_correlated_noise_leaves_no_bias():
    """Noise of pixels that are resampled by half a pixel along both axes: neighbours are correlated by 0.38."""
    options = ("--galaxies", 8192, "--realisations", 8, "--noise", "resampled", "--min-snr", 10, "--seed", 4)
    for m, error in (line["m"] for line in biases("shear_estimator.py", *options)):
        assert error < 1.5e-3
        assert abs(m) < 1e-3 + 2.0 * error


@pytest.mark.slow
def test_isolated_galaxies_without_noise():
    """The second order of a shear of 0.01 is all that is left: 0.5 g^2."""
    m, _ = biases("shear_estimator.py", "--galaxies", 2048, "--realisations", 0)[0]["m"]
    assert 2e-5 < m < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("radius", [0, 44])
def test_detected_galaxies(radius):
    """Detection alone, and discs of the sky with blends."""
    options = ("--images", 6, "--discs", 24 if radius == 0 else 14, "--realisations", 2, "--shear", 0.02)
    # The last of those after every second image.
    m, error = biases("shear_of_images.py", "--radius", radius, *options)[-1]["m"]
    assert error < 0.01
    assert abs(m) < 0.003 + 3.0 * error
