"""Each claim of the bundled baselines about the peer that their values were checked against.

batoid traces the rays here; what is made of them is restated.
"""

import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import pachon
from pachon.measure.shapes import fwhm, measure_shapes
from pachon.studies.baseline.baseline import bundled_baselines
from pachon.studies.baseline.file import read_baseline
from pachon.wavefront.chief_rays import fields_at

batoid = pytest.importorskip("batoid")
galsim = pytest.importorskip("galsim")

ZEMAX = Path(__file__).parents[1] / "data" / "zemax"
PEERS = {"lsst_v3.3_r": "LSST_r.yaml", "lsst_v3.3_g_vacuum_zemax_check": "LSST_g_500.yaml"}
RADIUS, OBSCURATION = 4.18, 0.612
ARCSEC = np.pi / 180 / 3600
BASELINES = {read_baseline(path).model: read_baseline(path) for path in bundled_baselines()}
# Kinds of figures that no peer has.
ALONE = {"height", "reconstruction"}


def numbers(text):
    return tuple(float(v) for v in text.split(", "))


def deg(field):
    return tuple(np.deg2rad(field))


class Peer:
    """Figures by batoid's rays."""

    def __init__(self, name):
        self.optic = batoid.Optic.fromYaml(PEERS[name])
        self.baseline = BASELINES[name]
        waves = self.baseline.plan.wavelengths_nm
        self.middle = waves[len(waves) // 2] * 1e-9
        self.gauss = gauss_nodes()
        self.telescope = pachon.load_telescope(name)

    def rays(self, field, wavelength, points, optic=None):
        """Rays at the detector through points [n, 2] of the unit pupil; positions in the telescope frame."""
        optic = optic or self.optic
        x, y = RADIUS * np.atleast_2d(points).T
        rays = batoid.RayVector.fromStop(
            np.append(x, 0.0),
            np.append(y, 0.0),
            optic=optic,
            wavelength=wavelength,
            theta_x=field[0],
            theta_y=field[1],
            projection="zemax",
        )
        optic.trace(rays)
        return rays.toCoordSys(batoid.CoordSys())

    def opd(self, field, wavelength, points, optic=None):
        """Path of the chief ray minus paths of the rays [m], to a sphere of 5 m; and which are vignetted."""
        rays = self.rays(field, wavelength, points, optic)
        q = rays.r - rays.r[-1]
        n = rays.v / np.linalg.norm(rays.v, axis=1, keepdims=True)
        along = (q * n).sum(axis=1)
        path = rays.t + np.sqrt(along**2 - (q * q).sum(axis=1) + 25.0) - along
        return (path[-1] - path)[:-1], rays.vignetted[:-1]

    def landing(self, field, wavelength, points):
        rays = self.rays(field, wavelength, points)
        return rays.r[:, :2], rays.vignetted

    @cache  # noqa: B019 - a handful of peers
    def zernikes(self, field):
        points, weights = self.gauss
        opd, _ = self.opd(deg(field), self.middle, points)
        return galsim.zernike.zernikeBasis(15, *points.T, R_inner=OBSCURATION) @ (weights * opd)

    @cache  # noqa: B019
    def spot(self, wavelength, field):
        points, weights = self.gauss
        landing, vignetted = self.landing(deg(field), wavelength, points)
        lit = ~vignetted[:-1]
        place, weight = landing[:-1][lit], weights[lit]
        middle = weight @ place / weight.sum()
        return np.sqrt(weight @ ((place - middle) ** 2).sum(axis=1) / weight.sum())

    def ee80(self, field, stored):
        """Radius [m] by Gauss quadrature over a disc of the square of the sum of the rays' plane waves.

        A ray of weight w that fills the solid angle a has the amplitude sqrt(a) w, and the light of the whole image is
        wavelength^2 times the sum of w (Parseval).
        """
        points = spiral(12000)
        weights = np.full(len(points), 1 / len(points))
        rays, step = self.rays(deg(field), self.middle, points), 1e-4
        turn = [
            self.rays(deg(field), self.middle, points + step * axis).v[:-1, :2]
            - self.rays(deg(field), self.middle, points - step * axis).v[:-1, :2]
            for axis in np.eye(2)
        ]
        angle = np.abs(turn[0][:, 0] * turn[1][:, 1] - turn[0][:, 1] * turn[1][:, 0]) / (2 * step) ** 2
        angle *= np.pi * (1 - OBSCURATION**2)
        opd, vignetted = self.opd(deg(field), self.middle, points)
        lit, k = ~vignetted, 2 * np.pi / self.middle
        cosines, light = rays.v[:-1, :2][lit], weights[lit]
        # About the centroid of the light.
        middle = light @ rays.r[:-1, :2][lit] / light.sum() - rays.r[-1, :2]
        wave = light * np.sqrt(angle[lit]) * np.exp(1j * k * (cosines @ middle - opd[lit]))
        nodes, shares = np.polynomial.legendre.leggauss(20)
        around = np.arange(72) * 2 * np.pi / 72
        disc = np.stack([np.cos(around), np.sin(around)])[:, None] * np.sqrt(0.5 * (1 + nodes))[:, None]

        def within(radius):
            amplitude = wave @ np.exp(1j * k * radius * (cosines @ disc.reshape(2, -1)))
            mean = 0.5 * shares @ (np.abs(amplitude) ** 2).reshape(20, 72).mean(axis=1)
            return mean * np.pi * radius**2 / (self.middle**2 * light.sum())

        low, high = (within(f * stored) for f in (0.995, 1.005))
        return stored * (1 + 0.01 * (0.8 - 0.5 * (low + high)) / (high - low))

    @cache  # noqa: B019
    def distortion(self):
        u = np.linspace(-1, 1, 21) * np.deg2rad(1.75)
        fields = [(x, y) for y in u for x in u if np.hypot(x, y) <= np.deg2rad(1.75) * (1 + 1e-9)]
        slopes = np.tan(fields)
        place = np.array([self.landing(f, self.middle, np.empty((0, 2)))[0][-1] for f in fields])
        # Of a centred telescope: no turn, no shift.
        scale = (place * slopes).sum() / (slopes**2).sum()
        near, far = (
            np.array(
                [
                    self.landing(np.arctan(step * np.array(s)), self.middle, np.empty((0, 2)))[0][-1]
                    for s in ((1, 0), (-1, 0), (0, 1), (0, -1))
                ]
            )
            for step in (1e-4, 2e-4)
        )
        # Distortion of third order, which grows with the square of the step, is removed by two of them.
        jacobian = np.stack(
            [(4.0 * near[i] - 0.5 * far[i]) - (4.0 * near[i + 1] - 0.5 * far[i + 1]) for i in (0, 2)], axis=-1
        )
        jacobian /= 6e-4
        axis = np.sqrt(np.abs(np.linalg.det(jacobian)))
        out = np.hypot(*slopes.T) > 1e-9
        radial = (place * slopes).sum(axis=1)[out] / (axis * (slopes[out] ** 2).sum(axis=1)) - 1
        return {
            "focal length": scale,
            "axis focal length": axis,
            "largest percent of axis scale": 100 * np.abs(radial).max(),
            "rms shift": 1e6 * np.sqrt(((place - scale * slopes) ** 2).sum(axis=1).mean()),
        }

    @cache  # noqa: B019
    def fields(self):
        """Field angles of the centres of all CCDs."""
        centers = pachon.lsst_camera().centers
        return dict(zip(pachon.lsst_camera().ccd_names, fields_at(self.telescope, centers, self.middle), strict=True))

    @cache  # noqa: B019
    def defocus(self, name):
        height = self.baseline.figures[f"height {name}"].value * 1e-6
        field = self.fields()[name]
        angle = np.arange(8) * np.pi / 4
        ring = 0.9 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        # A level CCD. On a tilted one the chief ray, which lands micrometres beside the centre, meets a height a tenth
        # of a nanometre or so apart: 0.03 nm in the wavefront.
        raised = self.optic.withGloballyShiftedOptic("Detector", (0, 0, height))
        return (self.opd(field, self.middle, ring, raised)[0] - self.opd(field, self.middle, ring)[0]).mean()

    @cache  # noqa: B019
    def psf(self, name):
        """Width and ellipticity of Roddier's product of transfer functions (1981, sec. 4): air, optics, detector.

        The optics' is the autocorrelation of the lit pupil with batoid's wavefront, on a square lattice.
        """
        raised = self.optic.withGloballyShiftedOptic(
            "Detector", (0, 0, self.baseline.figures[f"height {name}"].value * 1e-6)
        )
        waves = np.linspace(545e-9, 703e-9, 5)
        field = self.fields()[name]
        assert waves[2] == pytest.approx(self.middle)
        # Sampled so, the image comes round after 0.2 mm; its middle 0.17 mm hold none of its copies.
        n, keep = 256, 24
        step = 2 * RADIUS / n
        axis = (np.arange(n) - (n - 1) / 2) * step / RADIUS
        points = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
        reach = np.hypot(*points.T)
        ring = np.flatnonzero((reach <= 1) & (reach >= OBSCURATION))
        jacobian = self.jacobian(field, waves[2])
        pixels = (np.arange(17) - 8) * 10e-6
        lag = np.arange(-keep, keep + 1)
        bx, by = np.meshgrid(lag * step, lag * step)
        image = np.zeros((17, 17))
        middle = self.rays(field, waves[2], np.empty((0, 2)), raised).r[-1, :2]
        for wave in waves:
            opd, vignetted = self.opd(field, wave, points[ring], raised)
            phase = 2 * np.pi / wave
            pupil = np.zeros(n * n, dtype=complex)
            pupil[ring] = np.where(vignetted, 0.0, np.exp(1j * phase * opd))
            spectrum = np.fft.fft2(pupil.reshape(n, n), (2 * n, 2 * n))
            otf = np.fft.ifft2(np.abs(spectrum) ** 2)[np.ix_(lag, lag)] / (~vignetted).sum()
            turbulence = von_karman(wave, step, keep)
            kx, ky = phase * np.tensordot(np.linalg.inv(jacobian).T, np.stack([bx, by]), axes=1)
            shift = self.rays(field, wave, np.empty((0, 2)), raised).r[-1, :2] - middle
            detector = np.exp(-0.5 * (4e-6) ** 2 * (kx**2 + ky**2))
            detector = detector * np.sinc(kx * 5e-6 / np.pi) * np.sinc(ky * 5e-6 / np.pi)
            transfer = otf * turbulence * detector
            along, across = (
                np.exp(1j * np.outer(pixels - d, k)) for d, k in zip(shift, (kx.ravel(), ky.ravel()), strict=True)
            )
            image += ((across * transfer.ravel()) @ along.T).real / wave**2
        image /= image.sum()
        scale = 10e-6 / np.sqrt(np.linalg.det(self.jacobian((0.0, 0.0), waves[2])))
        shape = measure_shapes(image, scale, 0.7 * ARCSEC)
        return {"fwhm": fwhm(image, scale)[0] / ARCSEC, "e1": shape.e1[0], "e2": shape.e2[0]}

    def jacobian(self, field, wavelength, step=1e-4):
        """Place on the detector by direction cosine of the light from the sky, [2, 2]."""
        slopes = np.tan(field)
        cosines = slopes / np.sqrt(1 + slopes @ slopes)
        columns = []
        for axis in np.eye(2):
            ends = []
            for sign in (1, -1):
                there = cosines + sign * step * axis
                angles = np.arctan(there / np.sqrt(1 - there @ there))
                ends.append(self.landing(angles, wavelength, np.empty((0, 2)))[0][-1])
            columns.append((ends[0] - ends[1]) / (2 * step))
        return np.stack(columns, axis=-1)

    def figure(self, name, stored):
        """Return what the peer has for a figure, in its unit."""
        kind, _, rest = name.partition(" ")
        if kind == "opd":
            nm, *place = re.fullmatch(r"([\d.]+) nm field \((.*)\) pupil \((.*)\)", rest).groups()
            field, point = map(numbers, place)
            return self.opd(deg(field), float(nm) * 1e-9, point)[0][0] * 1e9
        if kind == "landing":
            axis, *place = re.fullmatch(r"([xy]) field \((.*)\) pupil \((.*)\)", rest).groups()
            field, point = map(numbers, place)
            return self.landing(deg(field), self.middle, point)[0][0]["xy".index(axis)] * 1e3
        if kind == "zernike":
            j, field = re.fullmatch(r"Z(\d+) field \((.*)\)", rest).groups()
            return self.zernikes(numbers(field))[int(j)] * 1e9
        if kind == "spot":
            nm, field = re.fullmatch(r"rms ([\d.]+) nm field \((.*)\)", rest).groups()
            return self.spot(float(nm) * 1e-9, numbers(field)) * 1e6
        if kind == "ee80":
            return self.ee80(numbers(re.fullmatch(r"field \((.*)\)", rest)[1]), stored * 1e-6) * 1e6
        if kind == "vignetting":
            field = numbers(re.fullmatch(r"lit fraction field \((.*)\)", rest)[1])
            return 1 - self.landing(deg(field), self.middle, spiral(4096))[1][:-1].mean()
        if kind == "distortion":
            return self.distortion()[rest]
        if kind == "defocus":
            return self.defocus(rest) * 1e9
        what, ccd = rest.split()
        return self.psf(ccd)[what]


@cache
def von_karman(wave, step, keep):
    """Transfer function of the long exposure by GalSim, on baselines of a square lattice."""
    air = galsim.VonKarman(lam=wave * 1e9, r0_500=0.16, L0=25.0, scale_unit=galsim.radians)
    lag = 2 * np.pi / wave * step * np.arange(-keep, keep + 1)
    return np.array([[air.kValue(x, y).real for x in lag] for y in lag])


def gauss_nodes(rings=20, spokes=80):
    """Nodes and weights of a mean over the annulus: Gauss-Legendre in the square of the radius, equal angles."""
    nodes, weights = np.polynomial.legendre.leggauss(rings)
    radius = np.sqrt(0.5 * (1 + OBSCURATION**2) + 0.5 * (1 - OBSCURATION**2) * nodes)[:, None]
    angle = (np.arange(spokes) + 0.5) * 2 * np.pi / spokes
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1).reshape(-1, 2)
    return points, np.repeat(weights, spokes) / (2 * spokes)


def spiral(count):
    k = np.arange(count)
    radius = np.sqrt(OBSCURATION**2 + (1 - OBSCURATION**2) * (k + 0.5) / count)
    angle = k * np.pi * (3 - np.sqrt(5))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)


def zemax_figure(name):
    """Return what Zemax's listings have for a figure, in its unit."""
    if name.startswith("opd 500 nm field (0, 1.225) pupil"):
        x, y = numbers(re.search(r"pupil \((.*)\)", name)[1])
        # Rows are listed from the top; points at (index - 16)/15 of the radius.
        listing = np.loadtxt(ZEMAX / "lsst_v3.3_opd_500nm_field_0.000_1.225.txt")[::-1]
        row, column = round(y * 15) + 16, round(x * 15) + 16
        assert (row - 16) / 15 == pytest.approx(y)
        assert (column - 16) / 15 == pytest.approx(x)
        assert listing[row, column] != 0
        return listing[row, column] * 500.0
    file = {
        "field (1.75, 0) pupil (0, 0)": "lsst_v3.3_ray_500nm_chief_hx1.csv",
        "field (0.875, 0.875) pupil (0.5, 0.5)": "lsst_v3.3_ray_500nm_skew_hx0.5_hy0.5_px0.5_py0.5.csv",
    }[name.partition(" ")[2].partition(" ")[2]]
    table = np.genfromtxt(ZEMAX / file, delimiter=",", comments="#", skip_header=0, dtype=None, encoding="utf-8")
    detector = table[-1]
    assert detector[-1] == "Detector"
    return float(detector[1 + "xy".index(name[len("landing ")])])


def claims(figure):
    """Yield (who, how near) of each clause of ``checked_against``."""
    for clause in figure.checked_against.split("; "):
        who, near, unit = re.fullmatch(r"(.*) within ([-\d.e]+) ?(\w*)", clause).groups()
        assert unit == figure.unit
        yield who, float(near)


@pytest.mark.parametrize("model", PEERS)
def test_every_figure_says_what_it_was_checked_against_but_for_those_that_no_peer_has(model):
    silent = {n.partition(" ")[0] for n, f in BASELINES[model].figures.items() if f.checked_against is None}
    assert silent == (ALONE if BASELINES[model].configuration else set())


def test_zemax_is_named_where_it_has_the_figure():
    named = [n for n, f in BASELINES["lsst_v3.3_g_vacuum_zemax_check"].figures.items() if "Zemax" in f.checked_against]
    assert sum(n.startswith("opd") for n in named) == 5
    assert sum(n.startswith("landing") for n in named) == 4


@pytest.mark.long
@pytest.mark.parametrize("model", PEERS)
@pytest.mark.parametrize(
    "kind",
    [
        *("opd", "landing", "zernike", "spot", "distortion", "vignetting", "defocus"),
        *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("ee80", "psf")),
    ],
)
def test_figures_are_as_near_to_the_peers_as_they_say(model, kind):
    peer = Peer(model)
    figures = {n: f for n, f in BASELINES[model].figures.items() if n.partition(" ")[0] == kind}
    assert figures or kind in ("defocus", "psf")
    for name, figure in figures.items():
        for who, near in claims(figure):
            theirs = zemax_figure(name) if "Zemax" in who else peer.figure(name, figure.value)
            assert abs(figure.value - theirs) <= near, (name, figure.value, theirs, who)
