"""Real donuts of one DECam exposure, its camera moved by 1.65 mm: by pachon and by danish, on the same stamps.

Run: python benchmarks/decam_donuts.py FOLDER [--no-danish]

FOLDER has ``DECam_00284696.*.stamp.fits`` (test/input of aaronroodman/Donut, MIT): stars within 16 mm of each other on
CCD S4, and one on S25. Fields, filter and pixels are those of the headers, as the command reads them. For danish the
telescope is batoid's DECam.yaml with its camera moved; each edge of it is a circle in the entrance pupil of that field,
fitted to batoid's rays, and of the filter's mechanism there is its circle alone. Both fit each donut alone; pachon all
together too, which is its default. The sky is that of the border, whose noise danish is given, an electron a unit;
pachon measures noise and gain. Nobody knows the truth, but telescope and air are common to the exposure. Printed are
the scatter of the stars of S4 about their mean, all terms together, what pachon claims of it and what is common,
residuals (rms of the stamp over its range), and processor time.
"""

from __future__ import annotations

import argparse
import os
import time
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from scipy.optimize import least_squares

import pachon
from pachon.commands.donut_fit import DonutWork
from pachon.commands.donut_options import FitOptions, FrameOptions, StampOptions, TelescopeOptions

DEFOCUS, PIXEL = 1.65e-3, 15e-6
OUTER, OBSCURATION = 1.971, 0.3
#: Pixels of a stamp's border that are sky.
BORDER = 4


def read(folder: Path) -> tuple[DonutWork, list[str]]:
    """Return stamps as the command reads them, and the names of their CCDs."""
    files = sorted(folder.glob("DECam_00284696.*.stamp.fits"))
    if not files:
        raise SystemExit(f"{folder}: expected DECam_00284696.*.stamp.fits")
    telescope = TelescopeOptions(files, defocus_um=1e6 * DEFOCUS)
    work = DonutWork.of(telescope, StampOptions(), FrameOptions(), FitOptions(each_alone=True))
    return work, [file.name.split(".")[1] for file in files]


def fit_pachon(work: DonutWork, last: int, kind: type = pachon.sensing.SingleDonuts) -> pachon.sensing.DonutFit:
    """Fit donuts by pachon as the command does."""
    wavefront = kind(noll=range(4, last + 1), higher_order=10e-9)
    return replace(work, wavefront=wavefront, threads=1).fit(lambda _: None)


def circles(shape) -> list[tuple[float, str, bool]]:
    """Return radius, name and kind (clear inside) of the circles of an obscuration of batoid."""
    import batoid

    match shape:
        case batoid.ObscCircle():
            return [(shape.radius, "inner", False)]
        case batoid.ObscAnnulus():  # a stop around the beam
            return [(shape.inner, "outer", True)]
        case batoid.ObscNegation(original=batoid.ObscCircle() as hole):
            return [(hole.radius, "outer", True)]
        case batoid.ObscNegation(original=batoid.ObscAnnulus() as mirror):
            return [(mirror.outer, "outer", True), (mirror.inner, "inner", False)]
    return []


def edges(optic, field: np.ndarray, wavelength: float) -> dict:
    """Return the edges of a pupil at a field as danish has them: circles in the entrance pupil, and vanes."""
    import batoid

    rays = batoid.RayVector.asPolar(
        optic,
        wavelength=wavelength,
        theta_x=field[0],
        theta_y=field[1],
        projection="zemax",
        outer=2.0,
        inner=0.2,
        nrad=12,
        naz=60,
    )
    stop = optic.stopSurface
    start = stop.interact(rays.copy()).toCoordSys(stop.coordSys)
    pupil = np.column_stack([np.ones(len(start)), start.x, start.y])
    angle = float(np.rad2deg(np.hypot(*field)))
    mask: dict = {}
    for traced in optic.traceFull(rays).values():
        name = traced["name"]
        shape = optic[name].obscuration
        at = traced["out"].toCoordSys(optic[name].coordSys)
        good = ~at.failed
        # Places on a surface are nearly a linear map of the pupil.
        shift, *columns = np.linalg.lstsq(pupil[good], np.stack([at.x, at.y], axis=1)[good], rcond=None)[0]
        matrix = np.array(columns).T
        center = -np.linalg.solve(matrix, shift) @ field / np.hypot(*field)
        for radius, edge, clear in circles(shape):
            mask.setdefault(name.replace(".", "_"), {})[edge] = {
                "clear": clear,
                "thetaMin": max(0.0, angle - 0.01),
                "thetaMax": angle + 0.01,
                "center": [float(center)],
                "radius": [float(radius / np.sqrt(abs(np.linalg.det(matrix))))],
            }
    height = float(optic["BlancoDECam.SPIDER"].coordSys.origin[2] - stop.coordSys.origin[2])
    vane = {"r0": [0.0, 0.0, height], "width": 0.019, "length": 5.0, "angle": 0.0}
    mask["Spider_3D"] = [vane | {"v0": [np.sqrt(0.5), sign * np.sqrt(0.5), 0.0]} for sign in (1.0, -1.0)]
    return mask


class Danish:
    """Fits of danish of a DECam whose camera has moved [m]."""

    def __init__(self, work: DonutWork, shift: float) -> None:
        import batoid

        file = Path(batoid.datadir) / "DECam" / "DECam.yaml"
        self._optic = batoid.Optic.fromYaml(str(file)).withGloballyShiftedOptic("BlancoDECam.DECam", [0.0, 0.0, shift])
        self._work = work

    def fit(self, index: int, last: int) -> tuple[np.ndarray, np.ndarray]:
        """Return Zernikes [m] of a donut, and the residuals of its stamp."""
        import batoid
        import danish

        wavelength = float(self._work.light[0])
        image = np.asarray(self._work.inputs.images[index], dtype=np.float64)
        image = image[: (len(image) - 1) | 1, : (len(image) - 1) | 1]  # an odd number of pixels
        border = np.ones(image.shape, dtype=bool)
        border[BORDER:-BORDER, BORDER:-BORDER] = False
        image, variance = image - np.median(image[border]), float(np.var(image[border]))
        field = self._work.inputs.fields[index]
        common = {"nrad": 20, "naz": 120, "reference": "chief", "eps": OBSCURATION, "projection": self._work.projection}
        reference = wavelength * batoid.zernikeTA(self._optic, *field, wavelength, jmax=max(last, 22), **common)
        factory = danish.DonutFactory(
            R_outer=OUTER,
            R_inner=OBSCURATION * OUTER,
            mask_params=edges(self._optic, field, wavelength),
            spider_angle=0.0,
            focal_length=focal_length(self._optic, wavelength),
            pixel_scale=PIXEL,
        )
        terms = np.arange(4, last + 1)
        model = danish.SingleDonutModel(
            factory, z_ref=reference, z_terms=terms, thx=field[0], thy=field[1], npix=len(image), bkg_order=0
        )
        start = [image.sum(), 0.0, 0.0, 0.7, *[0.0] * len(terms), 0.0]
        end = {"ftol": 1e-3, "xtol": 1e-3, "gtol": 1e-3, "max_nfev": 20, "x_scale": "jac"}
        best = least_squares(model.chi, start, jac=model.jac, args=(image, variance), **end)
        unknowns = model.unpack_params(best.x)
        return np.array(unknowns["z_fit"]), image - model.model(**unknowns)


def focal_length(optic, wavelength: float) -> float:
    """Return the focal length [m] on the axis."""
    import batoid

    def place(angle: float) -> float:
        return float(optic.trace(batoid.RayVector.fromFieldAngles(angle, 0.0, optic=optic, wavelength=wavelength)).x[0])

    return abs(place(1e-4) - place(-1e-4)) / 2e-4


def report(
    label: str, zernikes: np.ndarray, residuals: list[np.ndarray], stamps: list[np.ndarray], ccds: list[str],
    seconds: float,
) -> None:  # fmt: skip
    """Print the scatter of the donuts of S4, and the means of their low terms."""
    nm = 1e9 * zernikes
    near = nm[[ccd == "S4" for ccd in ccds]]
    about = (near - near.mean(axis=0)) / np.sqrt(1.0 - 1.0 / len(near))
    low, every = (float(np.sqrt((about[:, 1:count] ** 2).sum(axis=1).mean())) for count in (8, None))
    misfits = [100.0 * np.sqrt(np.mean(r**2)) / np.ptp(stamp) for r, stamp in zip(residuals, stamps, strict=True)]
    print(
        f"  {label:16} scatter of {len(near)} stars {low:.0f} nm (Z5 to Z11), {every:.0f} nm (from Z5 on); residuals "
        f"{', '.join(f'{value:.1f}' for value in misfits)} %; {seconds / len(nm):.2f} s a donut"
    )
    print(f"    mean of S4, Z4 to Z11: {', '.join(f'{value:.0f}' for value in near.mean(axis=0)[:8])}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--no-danish", action="store_true")
    options = parser.parse_args()
    peer_text = "" if options.no_danish else f", danish {version('danish')}"
    print(f"pachon {pachon.__version__}{peer_text}")
    work, ccds = read(options.folder)
    stamps = [np.asarray(image, dtype=np.float64) for image in work.inputs.images]
    fit_pachon(work, 4)  # compiles
    peer = None if options.no_danish else Danish(work, DEFOCUS)
    for last in (11, 22):
        print(f"Z4 to Z{last}")
        for label, kind in (
            ("pachon, alone", pachon.sensing.SingleDonuts),
            ("pachon, together", pachon.sensing.ExposureDonuts),
        ):
            start = time.process_time()
            fit = fit_pachon(work, last, kind)
            report(label, fit.zernikes, fit.residuals, stamps, ccds, time.process_time() - start)
            claim = 1e9 * np.sqrt([np.trace(covariance[1:, 1:]) for covariance in fit.covariance])
            print(
                f"    claimed {', '.join(f'{value:.0f}' for value in claim)} nm (from Z5 on); {'; '.join(fit.reasons)}"
            )
        if peer is not None:
            start = time.process_time()
            fits = [peer.fit(index, last) for index in range(len(ccds))]
            zernikes, residuals = zip(*fits, strict=True)
            report("danish, alone", np.array(zernikes), list(residuals), stamps, ccds, time.process_time() - start)


if __name__ == "__main__":
    main()
