"""Files of ray-optics beside ray-optics: first order, rays, spots, OPD, distortion and times.

Run: python benchmarks/designs_vs_rayoptics.py [file ...]

Files are those that ray-optics installs. It traces the rays that pachon aims at the stop. The columns are those of
sample_systems.py; ray-optics has no MTF.
"""

import argparse
import math
import os
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

RAYOPTICS = (
    *("models/Cassegrain.roa", "models/Ritchey_Chretien.roa", "models/Sasian Triplet.roa", "models/TwoMirror.roa"),
    *("models/Dall_Kirkham.roa", "models/singlet_f5.roa", "models/telephoto.roa", "models/f2 focuser.roa"),
    *("optical/tests/cell_phone_camera.roa", "optical/tests/Nikon Nikkor Z 14-30mm f-4 S.roa"),
    *("optical/tests/US007277232_Example04P.roa", "zemax/models/PhotoPrime/US05331467-1_asm.roa"),
)
#: Rays that ray-optics traces, one by one in Python.
FEW = 1000


def rayoptics_folder():
    import rayoptics

    return Path(rayoptics.__file__).parent


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


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", default=RAYOPTICS, help="files that ray-optics installs")
    names = parser.parse_args().names
    warnings.simplefilter("ignore")
    show_head("ray-optics")
    for name in names:
        path = rayoptics_folder() / name
        show(path.stem, against_rayoptics(path), rayoptics_times(path))


if __name__ == "__main__":
    main()
