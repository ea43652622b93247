import numpy as np
import pytest

import pachon
from pachon.models.first_order import chromatic_sums, first_order


def test_a_paraboloid_in_closed_form(paraboloid):
    f, radius, angle = 2.0, 0.1, 0.01
    result = pachon.design.seidel_diagram(paraboloid(f, 10.0), field=angle)
    theta = np.tan(angle)
    # Schroeder, Astronomical Optics, section 5.2: no spherical aberration; coma, astigmatism; Petzval radius f.
    expected = [0.0, theta * radius**3 / (4 * f**2), theta**2 * radius**2 / (2 * f), theta**2 * radius**2 / (4 * f)]
    assert np.abs(result.total[:4]) * 5e-7 == pytest.approx(expected, rel=1e-12, abs=1e-20)
    assert result.total[5:] == pytest.approx(0.0, abs=1e-15)


def test_a_sphere(sphere):
    # W040 = r^4 / (4 R^3) against the paraboloid, whose height differs by r^4 / (8 R^3).
    result = pachon.design.seidel_diagram(sphere(0.0), field=0.0)
    assert abs(result.total[0]) * 5e-7 == pytest.approx(0.1**4 / (4 * 4.0**3), rel=1e-12)


def test_colours_of_a_thin_lens(singlet):
    telescope = singlet(1e-9)
    sums = chromatic_sums(telescope, telescope.band, 0.05).total
    # C_L = h^2 / (f V), C_T = 0 with the stop at the lens (Welford, section 10.3); f to its 1e-9 of thickness.
    assert sums == pytest.approx([0.005**2 / (0.1 * 64.17), 0.0], rel=1e-3, abs=1e-12)
    diagram = pachon.design.seidel_diagram(telescope, field=0.05)
    assert diagram.coefficients[:, 5:].sum(axis=0) == pytest.approx(sums * [0.5, 1.0])


def test_colours_are_those_of_first_order_optics(singlet):
    telescope, angle = singlet(2e-3, stop_z=0.02), 1e-3
    axial, lateral = chromatic_sums(telescope, telescope.band, angle).total
    blue, red = (first_order(telescope, w) for w in telescope.band)
    middle = first_order(telescope)
    # W = dz u'^2 / 2 is C_L / 2; a shift dy of the image point is W = u' dy, C_T: signs of the detector's own y.
    slope = 5e-3 / middle.focal_length
    assert axial == pytest.approx((blue.focus_z - red.focus_z) * slope**2, rel=0.03)
    shift = pachon.design.lateral_color(telescope, [(0.0, angle)], telescope.band).shift[0]
    # The sum is for the Gaussian image plane, the detector 2 % off it.
    assert abs(lateral) == pytest.approx(abs(shift[0] - shift[1]) * slope, rel=0.08)


def test_the_sum_is_the_total(lsst_r):
    result = pachon.design.seidel_diagram(lsst_r)
    sums = pachon.seidel_sums(lsst_r).total / np.array([8, 2, 2, 4, 2]) / result.wavelength
    assert result.total[:5] == pytest.approx(sums)
    assert len(result.to_table()) == len(result.names) == 11


def test_the_legend_hides_no_bar():
    triplet = pachon.load_telescope("tests/data/lenses/triplet.zmx")
    figure = pachon.design.seidel_diagram(triplet).plot()
    figure.canvas.draw()
    (axes,) = figure.axes
    assert axes.get_legend().get_window_extent().y0 >= axes.get_window_extent().y1
