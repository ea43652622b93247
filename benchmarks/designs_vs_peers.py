"""First-order data, rays, spots, OPD, field curvature, distortion, MTF and times beside optiland and ray-optics.

Run: python benchmarks/designs_vs_peers.py [optiland | rayoptics] [name ...]

The systems are sample designs of the peers themselves, read from the peer's own file. Both aim their rays at the stop
(optiland: "robust"). Columns are the largest differences over the fields of the file at its primary wavelength:
focal length, F-number and pupil diameter (relative) with the places of the pupils (relative to the focal length);
landing points; rms radii of spots of the same rays; OPD on the sphere through the exit pupil, by the peer's formula and
(path) by sums of the segments of its rays; foci of rays close to the chief ray; distortion in percent; contrast at
frequencies below 0.9 of the cut-off, against the peer's and (Huygens) against the sum of plane waves of its rays at the
edge of the field. ray-optics traces the rays that pachon aims. Times are of a million rays without aiming, launch
included, one thread, by processor time, taken in turns; the peers trace fewer, scaled up.
"""

import importlib
import inspect
import math
import os
import sys
import tempfile
import time
import warnings
from dataclasses import dataclass
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np

import pachon
from pachon.wavefront.request import Request

OPTILAND = (
    *("CookeTriplet", "DoubleGauss", "ReverseTelephoto", "HeliarLens", "TessarLens", "PetzvalLens", "Telephoto"),
    *("LensWithFieldCorrector", "TripletTelescopeObjective", "ObjectiveUS008879901", "InfraredTriplet"),
    *("TelescopeObjective48Inch", "WideAngle100FOV", "HubbleTelescope"),
)
MODULES = ("eyepieces", "infrared", "lithography", "microscopes", "miscellaneous", "objectives", "simple", "telescopes")
RAYOPTICS = (
    *("models/Cassegrain.roa", "models/Ritchey_Chretien.roa", "models/Sasian Triplet.roa", "models/TwoMirror.roa"),
    *("models/Dall_Kirkham.roa", "models/singlet_f5.roa", "models/telephoto.roa", "models/f2 focuser.roa"),
    *("optical/tests/cell_phone_camera.roa", "optical/tests/Nikon Nikkor Z 14-30mm f-4 S.roa"),
    *("optical/tests/US007277232_Example04P.roa", "zemax/models/PhotoPrime/US05331467-1_asm.roa"),
)
RAYS, ROUNDS = 1_000_000, 3
#: Rays that ray-optics traces, one by one in Python.
FEW = 1000


@dataclass(frozen=True)
class Differences:
    """Largest differences of one system from a peer."""

    paraxial: float  #: relative
    ray: float  #: landing points, m
    spot: float  #: rms radii, m
    opd: float  #: waves
    focus: float = math.nan  #: tangential and sagittal foci, m
    distortion: float = math.nan  #: percent
    mtf: float = math.nan  #: contrast by the peer's FFT of the pupil
    huygens: float = math.nan  #: contrast by the sum of plane waves of the peer's rays
    path: float = math.nan  #: OPD by the sum of segments of the peer's rays, waves


def optiland_sample(name):
    """Return a sample system of optiland that aims its rays at the stop."""
    for module in MODULES:
        module = importlib.import_module(f"optiland.samples.{module}")
        if name in dict(inspect.getmembers(module, inspect.isclass)):
            optic = getattr(module, name)()
            optic.ray_tracer.set_aiming("robust", max_iter=100, tol=1e-12)
            return optic
    raise SystemExit(f"this optiland has no sample {name}")


def as_ours(optic):
    """Return the telescope of an optiland system, by way of its file, aimed at the stop."""
    from optiland.fileio import save_optiland_file

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "sample.json"
        save_optiland_file(optic, str(path))
        return pachon.load_telescope(path).with_design(aiming="real")


def number(value):
    return float(np.ravel(value)[0])


def paraxial_difference(ours, theirs):
    """Largest relative difference of focal length, F-number, pupil diameter; of places, over the focal length."""
    scale = abs(theirs["focal_length"])
    ratios = [ours[k] / theirs[k] - 1 for k in ("focal_length", "f_number", "entrance_pupil_diameter")]
    places = [(ours[k] - theirs[k]) / scale for k in ("entrance_pupil", "exit_pupil", "back_focus")]
    return float(np.abs([*ratios, *places]).max())


def our_first_order(telescope):
    """Return first-order data [m]; places along the light from the first surface and from the image."""
    found, image = pachon.first_order(telescope), telescope.surfaces[-1].vertex[2]
    # Along the light, which reverses at each mirror.
    after = -1.0 if sum(s.interaction == pachon.Interaction.MIRROR for s in telescope.surfaces) % 2 else 1.0
    return {
        "focal_length": found.focal_length,
        "f_number": found.f_number,
        "entrance_pupil_diameter": found.entrance_pupil_diameter,
        "entrance_pupil": telescope.surfaces[0].vertex[2] - found.entrance_pupil_z,
        "exit_pupil": after * (image - found.exit_pupil_z),
        "back_focus": after * (image - found.focus_z),
    }


def optiland_first_order(optic):
    p = optic.paraxial
    values = {
        "focal_length": number(p.f2()),
        "f_number": number(p.FNO()),
        "entrance_pupil_diameter": number(p.EPD()),
        "entrance_pupil": number(p.EPL()),
        "exit_pupil": number(p.XPL()),
        "back_focus": number(p.F2()),
    }
    return {k: v if k == "f_number" else 1e-3 * v for k, v in values.items()}


def image_waves(telescope, field, wavelength, radius, points):
    """Return landing points [m] and OPD [waves] of pupil points [n, 2] in units of the radius of the pupil."""
    request = Request.of(telescope, field, wavelength, sampling="square", n_pupil=4)
    bundles = request.bundles(wavelength, points * 0.5 * telescope.pupil_diameter)
    return bundles.landing()[0], bundles.opd(radius)[0] / wavelength


def against_optiland(name, n_fan=65):
    """Compare a sample system of optiland with optiland itself."""
    from optiland.analysis.field_curvature import FieldCurvature
    from optiland.distribution import HexagonalDistribution
    from optiland.wavefront import Wavefront

    optic = optiland_sample(name)
    telescope = as_ours(optic)
    wavelength, image = telescope.default_wavelength, telescope.surfaces[-1].vertex[2]
    micrometres = optic.primary_wavelength
    fields = np.array(telescope.design_data.fields)
    largest = float(np.abs(fields[:, 1]).max())
    optics = pachon.first_order(telescope)
    ray = spot = opd = mtf = 0.0
    huygens = math.nan
    rings = HexagonalDistribution()
    rings.generate_points(6)
    disc = np.stack([np.asarray(rings.x), np.asarray(rings.y)], axis=-1)
    for field in fields:
        relative = (0.0, field[1] / largest)
        peer = optic.trace_generic(*relative, Px=disc[:, 0], Py=disc[:, 1], wavelength=micrometres)
        there = 1e-3 * np.stack([-np.asarray(peer.x), np.asarray(peer.y)], axis=-1)
        # Light goes along -z here: half a turn about y.
        mirrored = disc * [-1, 1]
        here, _ = image_waves(telescope, field, wavelength, 1.0, mirrored)
        ray = max(ray, np.nanmax(np.abs(here - there)))
        sizes = [np.sqrt(np.nanmean(((v - np.nanmean(v, axis=0)) ** 2).sum(axis=1))) for v in (here, there)]
        spot = max(spot, abs(sizes[0] - sizes[1]))
        wave = Wavefront(optic, [relative], [micrometres], n_fan, "cross")
        data = wave.get_data(wave.fields[0], wave.wavelengths[0])
        points = np.stack([-np.asarray(wave.distribution.x), np.asarray(wave.distribution.y)], axis=-1)
        radius = math.copysign(1e-3 * data.radius, image - optics.exit_pupil_z)
        _, waves = image_waves(telescope, field, wavelength, radius, points)
        opd = max(opd, np.nanmax(np.abs(waves - np.asarray(data.opd))))
        # The sum takes a second or more: at the edge of the field, where the pupil is a disc, or on the axis.
        summed = (field == fields[0 if hole_of(optic, (0.0, 0.0)) else -1]).all()
        one, two = contrast_differences(telescope, optic, field, relative, summed=summed)
        mtf, huygens = np.fmax(mtf, one), np.fmax(huygens, two)
    heights = np.linspace(0.0, 1.0, 9)
    line = np.stack([np.zeros(9), heights * largest], axis=-1)
    curvature = pachon.field_curvature(telescope, line, wavelength)
    ((tangential, sagittal),) = FieldCurvature(optic, [micrometres], num_points=9).data
    return Differences(
        paraxial_difference(our_first_order(telescope), optiland_first_order(optic)),
        ray,
        spot,
        opd,
        max(
            np.abs(curvature.tangential[:, 0] - 1e-3 * np.asarray(tangential)).max(),
            np.abs(curvature.sagittal[:, 0] - 1e-3 * np.asarray(sagittal)).max(),
        ),
        np.abs(curvature.distortion[1:, 0] - optiland_distortion(optic, heights[1:], largest)).max(),
        mtf,
        huygens,
    )


def optiland_distortion(optic, heights, largest):
    """Distortion [percent] of its chief rays; its own analysis scales with 1e-10 of the field, too little to aim."""

    def scale(share):
        ray = optic.trace_generic(0.0, share, 0.0, 0.0, optic.primary_wavelength)
        return number(ray.y) / math.tan(share * largest)

    # The error at a small field goes with its square, which two fields remove.
    axis = (4.0 * scale(1e-3) - scale(2e-3)) / 3.0
    return np.array([100.0 * (scale(share) / axis - 1.0) for share in heights])


def contrast_differences(telescope, optic, field, relative, *, summed):
    """Return largest differences of our contrasts below 0.9 of the cut-off: from its own, and from its rays' sum."""
    from optiland.mtf import FFTMTF

    for n_pupil in (256, 512, 1024):
        try:
            ours = pachon.mtf(telescope, field, telescope.default_wavelength, n_pupil=n_pupil)
            break
        except pachon.DomainError:
            continue  # its spots are too wide for so few points
    else:
        return math.nan, math.nan
    theirs = FFTMTF(optic, [relative], optic.primary_wavelength, n_pupil, 2 * n_pupil)
    own, of_sum = 0.0, math.nan
    for axis, (limit, curve, frequency, contrast) in enumerate(
        zip(
            (ours.tangential_limit[0], ours.sagittal_limit[0]),
            (ours.tangential[0], ours.sagittal[0]),
            (theirs.freq_tang[0], theirs.freq_sag[0]),
            theirs.mtf[0],
            strict=True,
        )
    ):
        # At our own frequencies: contrast may change faster than between two of them.
        cut = np.argmax(limit < 1e-3) or len(limit) - 1
        chosen = np.unique(np.linspace(0.05 * cut, 0.9 * cut, 35).astype(int))
        at, found = ours.frequency[chosen], curve[chosen]
        own = max(own, np.abs(found - np.interp(at, 1e3 * np.asarray(frequency), np.asarray(contrast))).max())
        if summed:
            of_sum = np.fmax(of_sum, np.abs(found - huygens_contrast(optic, relative, at * 1e-3, axis)).max())
    return own, of_sum


def optiland_waves(optic, relative, px, py):
    """Return direction cosines [n, 2], OPD [mm], amplitudes of rays as plane waves, and their reach [mm]."""
    from optiland.distribution import BaseDistribution
    from optiland.wavefront import Wavefront

    wavelength, step = optic.primary_wavelength, 1e-5

    def traced(x, y):
        rays = optic.trace_generic(*relative, Px=x, Py=y, wavelength=wavelength)
        place = np.stack([np.asarray(v) for v in (rays.x, rays.y, rays.z)], axis=-1)
        return place, np.stack([np.asarray(v) for v in (rays.L, rays.M, rays.N)], axis=-1)

    points = BaseDistribution.__new__(type("Given", (BaseDistribution,), {"generate_points": lambda self: None}))
    points.x, points.y = px, py
    wave = Wavefront(optic, [relative], [wavelength], distribution=points)
    data = wave.get_data(wave.fields[0], wave.wavelengths[0])
    place, along = traced(px, py)
    center = traced(np.zeros(1), np.zeros(1))[0]
    from_center = place - center
    miss = from_center - (from_center * along).sum(axis=-1, keepdims=True) * along
    # From the sphere through the exit pupil to plane waves at the reference point.
    radius = data.radius
    sphere = radius - math.copysign(1.0, radius) * np.sqrt(radius**2 - (miss**2).sum(axis=-1))
    opd = np.asarray(data.opd) * wavelength * 1e-3 + sphere
    right, up = (
        (traced(px + dx, py + dy)[1] - traced(px - dx, py - dy)[1])[:, :2] / (2 * step)
        for dx, dy in ((step, 0.0), (0.0, step))
    )
    area = np.abs(right[:, 0] * up[:, 1] - right[:, 1] * up[:, 0])
    return along[:, :2], opd, np.sqrt(area), np.linalg.norm(from_center, axis=-1).max()


def hole_of(optic, relative):
    """Return the inner radius of the lit pupil, over the outer."""
    shares = np.linspace(0.0, 1.0, 4001)
    rays = optic.trace_generic(*relative, Px=shares, Py=0.0 * shares, wavelength=optic.primary_wavelength)
    return float(shares[np.argmax(np.asarray(rays.i) > 0)])


def huygens_contrast(optic, relative, frequencies, axis, rings=90, spokes=360, width=60.0):
    """Return the contrast at frequencies [cycles/mm] from the sum of plane waves of optiland's rays.

    Gauss quadrature over the pupil; each ray is a plane wave whose amplitude conserves energy between the areas of the
    pupil and of its direction cosines. The irradiance is summed over a square of so many wavelengths times F-number to
    either side; what lies outside of it belongs to frequencies below those that are compared.
    """
    nodes, weights = np.polynomial.legendre.leggauss(rings)
    angle = (np.arange(spokes) + 0.5) * 2 * np.pi / spokes
    hole = hole_of(optic, relative) ** 2
    radius = np.sqrt(0.5 * (1 - hole) * nodes + 0.5 * (1 + hole))
    px, py = (radius[:, None] * np.stack([np.cos(angle), np.sin(angle)])[:, None]).reshape(2, -1)
    weight = np.repeat(0.5 * (1 - hole) * weights / spokes, spokes)
    cosine, opd, amplitude, reach = optiland_waves(optic, relative, px, py)
    wavelength = optic.primary_wavelength * 1e-3
    chief = 0.5 * (cosine.max(axis=0) + cosine.min(axis=0))
    ratio = 1.0 / np.ptp(cosine, axis=0).max()
    if reach > 0.8 * width * wavelength * ratio:
        return np.full(len(frequencies), np.nan)
    x = np.arange(-width, width + 0.2, 0.4) * wavelength * ratio
    field = np.zeros((len(x), len(x)), complex)
    weighted = weight * amplitude * np.exp(-2j * np.pi / wavelength * opd)
    for some in np.array_split(np.arange(len(px)), 8):
        waves = [np.exp(2j * np.pi / wavelength * np.outer(c, x)) for c in (cosine[some] - chief).T]
        field += waves[1].T @ (weighted[some, None] * waves[0])
    # Parseval: the light over the whole plane.
    light = (weight * math.pi).sum() * wavelength**2 / math.pi**2
    line = (np.abs(field) ** 2).sum(axis=1 if axis == 0 else 0) * (x[1] - x[0]) ** 2
    return np.abs(np.exp(-2j * np.pi * np.outer(frequencies, x)) @ line) / light


class RayOptics:
    """A file of ray-optics, and rays of ours traced through it."""

    def __init__(self, path, telescope):
        from rayoptics.gui.appcmds import open_model

        self.model = open_model(str(path))
        self.sequence = self.model["seq_model"]
        self.unit = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}[self.model.system_spec.dimensions.lower()]
        self.first_order = self.model["analysis_results"]["parax_data"].fod
        # The object a millimetre in front of the first surface: rays of any direction from any point of its plane.
        self.sequence.gaps[0].thi = 1.0
        self.sequence.update_model()
        waves = self.model["optical_spec"].spectral_region.wavelengths
        # It looks for wavelengths of its own by their exact numbers.
        self.nm = min(waves, key=lambda w: abs(w - telescope.default_wavelength * 1e9))
        self.telescope = telescope

    def trace(self, field, points):
        """Return its packages of rays through pupil points [n, 2] in units of the radius of the pupil."""
        from rayoptics.raytr import trace

        t = self.telescope
        own = (0.5 * t.pupil_diameter * points).T
        rays = pachon.launch_rays(t, tuple(field), t.default_wavelength, (own[0], own[1]))
        found = []
        for place, along in zip(np.array(rays.position), np.array(rays.direction), strict=True):
            x, y, z = (place - [0.0, 0.0, t.surfaces[0].vertex[2]]) / (np.array([-1.0, 1.0, -1.0]) * self.unit)
            direction = along * [-1.0, 1.0, -1.0]
            start = np.array([x, y, z]) - direction * (z + 1.0) / direction[2]
            start[2] = 0.0
            found.append(trace.trace(self.sequence, start, direction, self.nm))
        return found

    def landing(self, rays):
        """Return landing points [m], x and y of our detector."""
        return np.array([ray.ray[-1][0][:2] for ray in rays]) * self.unit * [-1.0, 1.0]

    def foci(self, rays):
        """Return foci [m] of pairs of rays, behind the image plane along its axis."""
        place, along = (np.array([ray.ray[-1][k] for ray in rays]) for k in (0, 1))
        half = len(rays) // 2
        moved, turned = place[:half] - place[half:], along[:half] - along[half:]
        t = -(moved * turned).sum(axis=1) / (turned**2).sum(axis=1)
        return t * 0.5 * np.abs(along[:half, 2] + along[half:, 2]) * self.unit

    def waves(self, chief, rays):
        """Return OPD [waves] of rays by its formula and by sums of its segments, and the radius of its sphere [m]."""
        from rayoptics.raytr import waveabr

        last = chief.ray[-2]
        segment = waveabr.transfer_to_exit_pupil(self.sequence.ifcs[-2], (last[0], last[1]), self.first_order.exp_dist)
        package = (chief, segment)
        sphere = waveabr.calculate_reference_sphere(self.model, None, self.nm, 0.0, package)
        rest = (None, self.nm, 0.0)
        opd = [waveabr.wave_abr_full_calc(self.first_order, *rest, ray, package, sphere) for ray in rays]
        summed = [self._path(chief, chief, sphere[2]) - self._path(ray, chief, sphere[2]) for ray in rays]
        return *(np.array(v) * self.unit / (self.nm * 1e-9) for v in (opd, summed)), sphere[2] * self.unit

    def _path(self, ray, chief, radius):
        """Return the optical path of a ray from object or incident wavefront to the sphere, segment by segment."""
        points, along, first = [p[0] for p in ray.ray], [p[1] for p in ray.ray], chief.ray[1][0]
        distance = self.telescope.object_distance / self.unit
        if math.isinf(distance):
            path = points[1] @ chief.ray[0][1]
        else:
            source = first - (first[2] + distance) / chief.ray[0][1][2] * chief.ray[0][1]
            path = np.linalg.norm(points[1] - source)
        column = self.sequence.index_for_wavelength(self.nm)
        indices = [abs(float(row[column])) for row in self.sequence.rndx]
        path += sum(indices[i] * ray.ray[i][2] for i in range(1, len(points) - 1))
        miss = points[-1] - chief.ray[-1][0]
        beyond = float(miss @ along[-1])
        return path - indices[-1] * (beyond + math.sqrt(radius**2 - miss @ miss + beyond**2))


def against_rayoptics(path):
    """Compare a file of ray-optics with ray-optics itself."""
    telescope = pachon.load_telescope(path)
    if telescope.design_data.stop is not None:
        telescope = telescope.with_design(aiming="real")
    peer, wavelength = RayOptics(path, telescope), telescope.default_wavelength
    optics, image = pachon.first_order(telescope), telescope.surfaces[-1].vertex[2]
    first, unit = peer.first_order, peer.unit
    theirs = {
        "focal_length": first.efl * unit,
        # Its fno is the working one, of finite objects too.
        "f_number": first.efl / (2.0 * first.enp_radius),
        "entrance_pupil_diameter": 2.0 * first.enp_radius * unit,
        "entrance_pupil": first.enp_dist * unit,
        # Its exp_dist is right where the image is in focus: the distance from the image plane and that of the focus.
        "exit_pupil": (first.exp_dist - first.img_dist) * unit,
        "back_focus": first.bfl * unit - peer.sequence.gaps[-1].thi * unit,
    }
    angle = np.arange(8) * np.pi / 4
    disc = np.concatenate([[r * np.cos(angle), r * np.sin(angle)] for r in (0.35, 0.7, 1.0)], axis=1).T
    ray = spot = opd = path = focus = 0.0
    chiefs = []
    for field in np.array([[0.0, 0.0], [0.0, 0.35], [0.0, 0.7]]) * telescope.field_radius:
        (chief,), rays = peer.trace(field, np.zeros((1, 2))), peer.trace(field, disc)
        there = peer.landing(rays)
        waves, summed, radius = peer.waves(chief, rays)
        here, ours = image_waves(telescope, field, wavelength, math.copysign(radius, image - optics.exit_pupil_z), disc)
        ray, opd = max(ray, np.abs(here - there).max()), max(opd, np.abs(ours - waves).max())
        path = max(path, np.abs(ours - summed).max())
        sizes = [np.sqrt(((v - v.mean(axis=0)) ** 2).sum(axis=1).mean()) for v in (here, there)]
        spot = max(spot, abs(sizes[0] - sizes[1]))
        close = 1e-3 * np.array([[0.0, 1.0], [1.0, 0.0], [0.0, -1.0], [-1.0, 0.0]])
        found = pachon.field_curvature(telescope, field, wavelength)
        both = np.array([found.tangential[0, 0], found.sagittal[0, 0]])
        focus = max(focus, np.abs(both - peer.foci(peer.trace(field, close))).max())
        chiefs.append((field[1], peer.landing([chief])[0, 1], found.distortion[0, 0]))
    # Odd aspheres have a kink on the axis: the scale there depends on the step, which is that of ours.
    near = [1e-4, 2e-4]
    slopes = [peer.landing(peer.trace((0.0, a), np.zeros((1, 2))))[0, 1] / math.tan(a) for a in near]
    scale = (4.0 * slopes[0] - slopes[1]) / 3.0
    distortion = max(abs(100.0 * (y / math.tan(a) / scale - 1.0) - ours) for a, y, ours in chiefs[1:])
    return Differences(
        paraxial_difference(our_first_order(telescope), theirs), ray, spot, opd, focus, distortion, path=path
    )


def rayoptics_times(path):
    """Return times of a million rays [s], ray-optics' scaled up from a few, and ours, launch included."""
    from rayoptics.raytr import trace

    telescope = pachon.load_telescope(path).with_design(aiming="off")
    peer, rng = RayOptics(path, telescope), np.random.default_rng(1)
    points = rng.uniform(-0.7, 0.7, (2, RAYS)) * 0.5 * telescope.pupil_diameter
    field = (0.0, 0.35 * telescope.field_radius)

    def ours():
        rays = pachon.launch_rays(telescope, field, telescope.default_wavelength, (points[0], points[1]))
        pachon.trace(telescope, rays, threads=1)

    start, along = (np.array(v) for v in peer.trace(field, np.zeros((1, 2)))[0].ray[0][:2])

    def peers():
        for _ in range(FEW):
            trace.trace(peer.sequence, start, along, peer.nm)

    ours()
    pairs = [(RAYS / FEW * timed(peers), timed(ours)) for _ in range(ROUNDS)]
    return tuple(map(min, zip(*pairs, strict=True)))


def timed(work):
    start = time.process_time()
    work()
    return time.process_time() - start


def optiland_times(name):
    """Return the best times of a million rays without aiming [s], optiland's and ours, launch included.

    optiland keeps all rays at all surfaces: a quarter of a million is traced there, for the memory, and scaled up.
    """
    optic = optiland_sample(name)
    optic.ray_tracer.set_aiming("paraxial")
    telescope = as_ours(optic).with_design(aiming="off")
    rng = np.random.default_rng(1)
    radius, angle = np.sqrt(rng.uniform(size=RAYS)), rng.uniform(0, 2 * np.pi, RAYS)
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    half = 0.5 * telescope.pupil_diameter
    field = telescope.design_data.fields[1]
    share = field[1] / max(f[1] for f in telescope.design_data.fields)

    def ours():
        rays = pachon.launch_rays(telescope, field, telescope.default_wavelength, (-x * half, y * half))
        pachon.trace(telescope, rays, threads=1)

    def peers():
        optic.trace_generic(0.0, share, x[::4], y[::4], optic.primary_wavelength)

    ours()
    pairs = [(4 * timed(peers), timed(ours)) for _ in range(ROUNDS)]
    return tuple(map(min, zip(*pairs, strict=True)))


COLUMNS = {
    "paraxial": ("paraxial", 1.0),
    "ray": ("rays nm", 1e9),
    "spot": ("spots nm", 1e9),
    "opd": ("OPD waves", 1.0),
    "path": ("path waves", 1.0),
    "focus": ("focus um", 1e6),
    "distortion": ("distort %", 1.0),
    "mtf": ("its MTF", 1.0),
    "huygens": ("Huygens", 1.0),
}


def show(name, found, times):
    numbers = " ".join(f"{getattr(found, key) * scale:10.1e}" for key, (_, scale) in COLUMNS.items())
    print(f"{name:40s} {numbers} {times[0]:8.2f} {times[1]:6.3f} {times[0] / times[1]:7.1f}", flush=True)


def main():
    warnings.simplefilter("ignore")
    chosen = sys.argv[1:]
    for peer, names, compare, times in (
        ("optiland", OPTILAND, against_optiland, optiland_times),
        ("rayoptics", RAYOPTICS, against_rayoptics, rayoptics_times),
    ):
        wanted = [n for n in names if not chosen or peer in chosen or n in chosen]
        if wanted:
            heads = " ".join(f"{title:>10s}" for title, _ in COLUMNS.values())
            print(f"{peer:40s} {heads} {'peer s':>8s} {'ours':>6s} {'ratio':>7s}")
        for name in wanted:
            where = name if peer == "optiland" else rayoptics_folder() / name
            show(Path(name).stem, compare(where), times(where))


def rayoptics_folder():
    import rayoptics

    return Path(rayoptics.__file__).parent


if __name__ == "__main__":
    main()
