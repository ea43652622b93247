"""The twenty donuts of danish's own tests: their wavefronts by pachon and by danish, one by one and together.

Run: python benchmarks/danish_donuts.py FOLDER [--no-danish] [--no-joint] [--detector]

FOLDER is that of danish's tests (``danish-1.3.0/tests`` of the source distribution). ``data/test_kolm_donuts.pkl`` and
``data/test_atm_donuts.pkl`` have ten donuts each of one LSST (i band) whose M2, camera and mirrors are off, its camera
moved 1.5 mm out of focus: rays of batoid through GalSim's Kolmogorov profile, and through its turbulent screens. The
errors are the root of the sum of squares over Z4 to Z22 against the file's own Zernikes of the true telescope less
those of the design (``z_actual - z_ref``). danish is given the file's ``z_ref``, pachon its own bundled LSST in the air
that batoid had when the donuts were made (``z_ref`` is its design within 0.5 nm; in vacuum Z11 is off by 4 nm, coma by
up to 9); both see the same images, in turns, on one thread, with the settings of danish's tests and of ``pachon donuts
--no-diffraction --moved Camera`` (the rays have no diffraction). Together: danish's double Zernikes
(``DZMultiDonutModel``, the terms of its tests), pachon's field terms (1, 2, 3 over the field, times Z4 to Z22) and
degrees of freedom (``lsst``). Times are processor time of the fits. With --detector pachon takes the detector for what
moved, which these images are not.
"""

from __future__ import annotations

import argparse
import os
import pickle
import time
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

import pachon

PIXEL = 10e-6
OUTER, INNER = 4.18, 2.5498
NOLL = np.arange(4, 23)
AIR = pachon.Air(69328.0, 293.15, 1067.0, formula="filippenko")
#: Double Zernikes of danish's tests: term over the field, term over the pupil.
DOUBLE = ((1, 4), (2, 4), (3, 4), (2, 5), (3, 5), (2, 6), (3, 6), *((1, j) for j in range(7, 23)))
#: Geometry of the obstructions that danish's tests take for each set.
MASKS = {"kolm": "RubinObsc_v3.14_r_rtpp0_azp45_pp0d0.yaml", "atm": "RubinObsc.yaml"}


@dataclass(frozen=True)
class DonutSet:
    """Donuts of one telescope: images [electrons], fields [rad], wavefronts [m]."""

    name: str
    images: np.ndarray
    fields: np.ndarray
    references: np.ndarray  #: Zernikes of the design, from j = 0
    truth: np.ndarray  #: Z4 to Z22 beyond the design
    wavelength: float
    defocus: float
    sky: float

    @classmethod
    def read(cls, folder: Path, name: str) -> DonutSet:
        """Read a set from danish's tests."""
        with (folder / "data" / f"test_{name}_donuts.pkl").open("rb") as file:
            head, *donuts = pickle.load(file)
        wavelength = head["wavelength"]
        references, actual = (wavelength * np.array([d[key] for d in donuts]) for key in ("z_ref", "z_actual"))
        return cls(
            name,
            np.array([d["arr"] for d in donuts], dtype=np.float64),
            np.array([(d["thx"], d["thy"]) for d in donuts]),
            references,
            (actual - references)[:, NOLL],
            wavelength,
            head["defocus"],
            head["sky_level"],
        )


def fit_pachon(donuts: DonutSet, moved: str, which: slice = slice(None), fit=None) -> np.ndarray:
    """Return Zernikes [m] by pachon, of some donuts."""
    return pachon.fit_donuts(
        pachon.load_telescope("lsst_v3.3_i").in_medium(AIR),
        donuts.images[which],
        donuts.fields[which],
        donuts.wavelength,
        sky_variance=donuts.sky,
        moved=moved,
        model=pachon.DonutModel(detector=pachon.DonutDetector(PIXEL, defocus=donuts.defocus), diffraction=False),
        fit=fit or pachon.sensing.SingleDonuts(NOLL, higher_order=10e-9),
        projection="postel",
        threads=1,
    ).zernikes


class Danish:
    """Fits of danish with the settings of its tests."""

    def __init__(self, donuts: DonutSet) -> None:
        import danish
        import yaml

        self._danish, self._donuts = danish, donuts
        mask = yaml.safe_load((Path(danish.datadir) / MASKS[donuts.name]).read_text())
        self._factory = danish.DonutFactory(
            R_outer=OUTER, R_inner=INNER, mask_params=mask, focal_length=10.31, pixel_scale=PIXEL
        )

    def single(self, index: int) -> np.ndarray:
        """Return Zernikes [m] of a donut."""
        from scipy.optimize import least_squares

        donuts, image = self._donuts, self._donuts.images[index]
        thx, thy = donuts.fields[index]
        model = self._danish.SingleDonutModel(
            self._factory, z_ref=donuts.references[index], z_terms=NOLL, thx=thx, thy=thy, bkg_order=0
        )
        start = [image.sum(), 0.0, 0.0, 0.7, *[0.0] * len(NOLL), 0.0]
        end = {"ftol": 1e-3, "xtol": 1e-3, "gtol": 1e-3, "max_nfev": 20, "x_scale": "jac"}
        best = least_squares(model.chi, start, jac=model.jac, args=(image, donuts.sky), **end)
        return np.array(model.unpack_params(best.x)["z_fit"])

    def together(self) -> np.ndarray:
        """Return Zernikes [m] of all donuts by double Zernikes."""
        from galsim.zernike import DoubleZernike
        from scipy.optimize import least_squares

        donuts = self._donuts
        count, radius = len(donuts.images), np.deg2rad(1.8)
        model = self._danish.DZMultiDonutModel(
            self._factory,
            z_refs=donuts.references,
            dz_terms=DOUBLE,
            field_radius=radius,
            thxs=list(donuts.fields[:, 0]),
            thys=list(donuts.fields[:, 1]),
            bkg_order=0,
        )
        start = [*donuts.images.sum(axis=(1, 2)), *[0.0] * (2 * count), 0.7, *[0.0] * (len(DOUBLE) + count)]
        lowest = np.full(len(start), -np.inf)
        lowest[3 * count] = 0.3
        end = {"ftol": 1e-3, "xtol": 1e-3, "gtol": 1e-3, "max_nfev": 20, "x_scale": "jac"}
        data = list(donuts.images), [donuts.sky] * count
        best = least_squares(model.chi, start, jac=model.jac, bounds=(lowest, np.inf), args=data, **end)
        double = np.zeros((4, NOLL[-1] + 1))
        for (k, j), value in zip(DOUBLE, model.unpack_params(best.x)["wavefront_params"], strict=True):
            double[k, j] = value
        terms = DoubleZernike(double, uv_outer=radius, xy_outer=OUTER, xy_inner=INNER)
        return np.array([terms(*field).coef[NOLL] for field in donuts.fields])


def report(label: str, values: np.ndarray, truth: np.ndarray, seconds: float) -> None:
    """Print the errors of a fit of ten donuts and its time."""
    errors = 1e9 * np.linalg.norm(values - truth, axis=1)
    common = 1e9 * np.linalg.norm((values - truth).mean(axis=0))
    print(
        f"  {label:32} {np.median(errors):7.1f} {errors.max():7.1f} {common:7.1f} {seconds / len(errors):9.3f}",
        flush=True,
    )


def timed(call, *arguments) -> tuple[np.ndarray, float]:
    """Return a result and its processor time [s]."""
    start = time.process_time()
    result = call(*arguments)
    return result, time.process_time() - start


def parsed() -> argparse.Namespace:
    """Return the options of the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="danish's tests, with data/test_kolm_donuts.pkl")
    parser.add_argument("--no-danish", action="store_true")
    parser.add_argument("--no-joint", action="store_true")
    parser.add_argument("--detector", action="store_true", help="take the detector for what moved")
    return parser.parse_args()


def main() -> None:
    options = parsed()
    moved = "Detector" if options.detector else "Camera"
    versions = [f"pachon {pachon.__version__}"]
    if not options.no_danish:
        import batoid
        import danish
        import galsim

        versions += [f"{m.__name__} {m.__version__}" for m in (danish, batoid, galsim)]
    print(f"{', '.join(versions)}; {moved.lower()} moved")
    freedoms = pachon.load_degrees_of_freedom("lsst")
    for name in MASKS:
        donuts = DonutSet.read(options.folder, name)
        count = len(donuts.images)
        fit_pachon(donuts, moved, slice(1))  # compiles
        peer = None if options.no_danish else Danish(donuts)
        rows: dict[str, list[tuple[np.ndarray, float]]] = {"pachon": [], "danish": []}
        for i in range(count):
            rows["pachon"].append(timed(fit_pachon, donuts, moved, slice(i, i + 1)))
            if peer is not None:
                rows["danish"].append(timed(peer.single, i))
        injected = 1e9 * np.linalg.norm(donuts.truth, axis=1)
        print(f"{name}: {count} donuts of {injected.min():.0f} to {injected.max():.0f} nm; nm and s a donut")
        print(f"  {'':32} {'median':>7} {'worst':>7} {'common':>7} {'time':>9}")
        for label, fits in rows.items():
            if fits:
                values = np.array([zernikes.reshape(-1, len(NOLL))[0] for zernikes, _ in fits])
                report(f"{label}, one by one", values, donuts.truth, sum(seconds for _, seconds in fits))
        if peer is not None:
            ratios = [b / a for (_, a), (_, b) in zip(rows["pachon"], rows["danish"], strict=True)]
            print(f"  danish takes {np.median(ratios):.1f} times as long (median of {count})")
        if options.no_joint:
            continue
        joint = {"field terms": pachon.sensing.FieldTerms([1, 2, 3], NOLL), "degrees of freedom": None}
        joint["degrees of freedom"] = pachon.sensing.TelescopeFreedoms(freedoms, noll=NOLL)
        for label, fit in joint.items():
            report(f"pachon, {label}", *_with_truth(timed(fit_pachon, donuts, moved, slice(None), fit), donuts))
        if peer is not None:
            report("danish, double Zernikes", *_with_truth(timed(peer.together), donuts))


def _with_truth(result: tuple[np.ndarray, float], donuts: DonutSet) -> tuple[np.ndarray, np.ndarray, float]:
    return result[0], donuts.truth, result[1]


if __name__ == "__main__":
    main()
