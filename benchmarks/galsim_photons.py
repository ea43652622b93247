"""Time of photons through the LSST by ``pachon.galsim.PachonOptics``, beside batoid's as imSim uses it.

Run: python benchmarks/galsim_photons.py [photons [threads]]

The same photons of GalSim, with pupil coordinates and a wavelength each, go through the same telescope. batoid's are
turned into rays as by imSim's RubinOptics: velocities from the offsets on the sky, divided by the index of the medium,
from the surface of the stop; then ``Optic.trace``, positions in pixels and slopes. Its camera and its projection from
the sky, which cost imSim time too, are replaced by two lines of algebra. Both take turns in one process, on the same
number of threads; one thread is timed by processor time, which other work on the machine hardly changes, several by
the clock. The first call, which compiles or loads the kernels, is timed apart.
"""

import argparse
import os
import time

PARSER = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
PARSER.add_argument("photons", type=int, nargs="?", default=1_000_000, help="photons of GalSim")
PARSER.add_argument("threads", type=int, nargs="?", default=1, help="threads of each side")
ARGUMENTS = PARSER.parse_args()
PHOTONS = ARGUMENTS.photons
THREADS = ARGUMENTS.threads
# batoid reads it when it is imported.
os.environ["OMP_NUM_THREADS"] = str(THREADS)

import batoid  # noqa: E402
import galsim  # noqa: E402
import numpy as np  # noqa: E402

import pachon  # noqa: E402

ROUNDS = 7
FIELD, PIXEL = (0.012, -0.009), 10e-6
ARCSEC = np.pi / 648000


def photons() -> galsim.PhotonArray:
    """Return photons of a seeing disc [arcsec], sampled by GalSim."""
    rng = galsim.BaseDeviate(1)
    found = galsim.Kolmogorov(fwhm=0.65).shoot(PHOTONS, rng=rng)
    galsim.PupilAnnulusSampler(4.18, 2.558).applyTo(found, rng=rng)
    found.wavelength = np.random.default_rng(1).uniform(552.0, 691.0, PHOTONS)
    return found


def copied(given):
    out = galsim.PhotonArray(PHOTONS)
    out.copyFrom(given)
    return out


class BatoidOptics(galsim.PhotonOp):
    """Photon operator with batoid."""

    def __init__(self, optic, field):
        self.optic = optic
        to_source = np.array([-field[0], -field[1], 1.0])
        to_source /= np.linalg.norm(to_source)
        west = np.cross(to_source, [0.0, 1.0, 0.0])
        west /= np.linalg.norm(west)
        self.axes = np.stack([to_source, ARCSEC * west, ARCSEC * np.cross(west, to_source)])
        chief = batoid.RayVector.fromStop(
            0.0, 0.0, optic=optic, wavelength=624e-9, theta_x=field[0], theta_y=field[1], projection="gnomonic"
        )
        optic.trace(chief)
        self.origin = chief.x[0], chief.y[0]

    def applyTo(self, photon_array, local_wcs=None, rng=None):  # noqa: N802 - GalSim's name
        wavelength = photon_array.wavelength * 1e-9
        ones = np.ones(len(photon_array))
        v = -(self.axes.T @ np.stack([ones, photon_array.x, photon_array.y]))
        v /= np.linalg.norm(v, axis=0) * self.optic.inMedium.getN(624e-9)
        x, y = photon_array.pupil_u, photon_array.pupil_v
        rays = batoid.RayVector._directInit(
            x,
            y,
            self.optic.stopSurface.surface.sag(x, y),
            *v,
            t=np.zeros_like(x),
            wavelength=wavelength,
            flux=photon_array.flux,
            vignetted=np.zeros_like(x, dtype=bool),
            failed=np.zeros_like(x, dtype=bool),
            coordSys=self.optic.stopSurface.coordSys,
        )
        self.optic.trace(rays)
        photon_array.x = (rays.x - self.origin[0]) / PIXEL
        photon_array.y = (rays.y - self.origin[1]) / PIXEL
        photon_array.dxdz = rays.vx / rays.vz
        photon_array.dydz = rays.vy / rays.vz
        photon_array.flux *= ~(rays.vignetted | rays.failed)


def timed(op, given):
    out = copied(given)
    clock = time.process_time if THREADS == 1 else time.perf_counter
    start = clock()
    op.applyTo(out)
    return clock() - start, out


def main() -> None:
    print(
        f"pachon {pachon.__version__}, batoid {batoid.__version__}, GalSim {galsim.__version__}, "
        f"{PHOTONS} photons, threads: {THREADS}"
    )
    given, telescope = photons(), pachon.load_telescope("lsst_v3.3_r")
    ours = pachon.galsim.PachonOptics(telescope, FIELD, projection="gnomonic", threads=THREADS)
    plane = pachon.FocalPlane.as_measured("lsstcam")
    heights = pachon.galsim.PachonOptics(telescope, FIELD, projection="gnomonic", focal_plane=plane, threads=THREADS)
    theirs = BatoidOptics(batoid.Optic.fromYaml("LSST_r.yaml"), FIELD)
    print(f"first call (kernels compiled or loaded): {timed(ours, given)[0]:.2f} s")
    seconds = {"batoid": [], "pachon": [], "pachon, heights of CCDs": []}
    for _ in range(ROUNDS):
        for name, op in zip(seconds, (theirs, ours, heights), strict=True):
            spent, out = timed(op, given)
            seconds[name].append(spent)
            if name == "batoid":
                peer = out
            elif name == "pachon":
                found = out
    best = {name: min(values) for name, values in seconds.items()}
    for name, values in seconds.items():
        each, median = (1e9 * v / PHOTONS for v in (best[name], np.median(values)))
        times = best["batoid"] / best[name]
        print(f"{name:>24}: {each:6.0f} ns a photon (median {median:.0f}), {times:.1f} times as fast as batoid")
    pairs = np.array(seconds["batoid"]) / np.array(seconds["pachon"])
    lit = found.flux > 0
    apart = max(np.abs(found.x - peer.x)[lit].max(), np.abs(found.y - peer.y)[lit].max()) * PIXEL
    print(f"pair by pair {pairs.min():.1f} to {pairs.max():.1f} times")
    print(f"positions differ by at most {apart:.1e} m; {int((lit != (peer.flux > 0)).sum())} photons lost by one alone")


if __name__ == "__main__":
    main()
