"""Sample systems of optiland beside optiland: first order, rays, spots, OPD, distortion, MTF and times.

Run: python benchmarks/designs_vs_optiland.py [name ...]

The systems are read from optiland's own files. Both aim their rays at the stop (optiland: "robust"). The columns are
those of sample_systems.py.
"""

import argparse
import importlib
import inspect
import math
import os
import tempfile
import warnings
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np
from sample_systems import (
    RAYS,
    ROUNDS,
    Differences,
    image_waves,
    our_first_order,
    paraxial_difference,
    show,
    show_head,
    timed,
)

import pachon

OPTILAND = (
    *("CookeTriplet", "DoubleGauss", "ReverseTelephoto", "HeliarLens", "TessarLens", "PetzvalLens", "Telephoto"),
    *("LensWithFieldCorrector", "TripletTelescopeObjective", "ObjectiveUS008879901", "InfraredTriplet"),
    *("TelescopeObjective48Inch", "WideAngle100FOV", "HubbleTelescope"),
)
MODULES = ("eyepieces", "infrared", "lithography", "microscopes", "miscellaneous", "objectives", "simple", "telescopes")


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
        except pachon.errors.DomainError:
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


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", default=OPTILAND, help="sample systems of optiland")
    names = parser.parse_args().names
    warnings.simplefilter("ignore")
    show_head("optiland")
    for name in names:
        show(name, against_optiland(name), optiland_times(name))


if __name__ == "__main__":
    main()
