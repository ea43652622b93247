"""Ten donuts of an exposure fitted alone and together: those in danish's own tests, of a moved camera.

Run: python benchmarks/exposure_donuts.py FOLDER

FOLDER holds ``test_kolm_donuts.pkl`` and ``test_atm_donuts.pkl`` of danish 1.3.0 (``tests/data`` of its source
distribution, BSD-2-Clause; pickles: only those of a source that you trust). Their donuts are rays of batoid through an
LSST (i band, in air) with bending modes and misalignments, 1.5 mm out of focus by its camera, with Kolmogorov air or
through turbulent screens. Printed: errors of Z4 to Z22 together, against the wavefronts that come with them,
chi-square of the errors a term, and processor time.
"""

from __future__ import annotations

import argparse
import pickle
import time
from pathlib import Path

import numpy as np

import pachon

NOLL = slice(4, 23)
#: Air of batoid's LSST when the donuts were made: their Z4 to Z22 of the design are those in it within 0.5 nm.
AIR = pachon.Air(69328.0, 293.15, 1067.0, formula="filippenko")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="folder of the pickles of danish")
    folder = parser.parse_args().folder
    freedoms = pachon.load_degrees_of_freedom("lsst")
    telescope = pachon.load_telescope("lsst_v3.3_i").in_medium(AIR).perturbed("Camera", shift=(0.0, 0.0, 1.5e-3))
    fits = {
        "each alone": pachon.sensing.SingleDonuts(higher_order=10e-9),
        "field terms": pachon.sensing.FieldTerms([1, 2, 3], higher_order=10e-9),
        "exposure": pachon.sensing.ExposureDonuts(),
        "exposure, degrees of freedom": pachon.sensing.ExposureDonuts(freedoms=freedoms),
    }
    for kind, outer_scale in (("kolm", np.inf), ("atm", 25.0)):
        header, *donuts = pickle.loads((folder / f"test_{kind}_donuts.pkl").read_bytes())
        wavelength = header["wavelength"]
        truth = wavelength * np.array([(d["z_actual"] - d["z_ref"])[NOLL] for d in donuts])
        for name, fit in fits.items():
            start = time.process_time()
            result = pachon.fit_donuts(
                telescope,
                np.array([d["arr"] for d in donuts], dtype=float),
                [(d["thx"], d["thy"]) for d in donuts],
                wavelength,
                sky_variance=header["sky_level"],
                model=pachon.DonutModel(air=pachon.DonutAir(outer_scale=outer_scale)),
                fit=fit,
                threads=1,
            )
            seconds = time.process_time() - start
            error = result.zernikes - truth
            size = 1e9 * np.linalg.norm(error, axis=1)
            squares = [e @ np.linalg.pinv(c) @ e for e, c in zip(error, result.covariance, strict=True)]
            quality = np.mean(squares) / truth.shape[1]
            print(f"{kind:5} {name:30} median {np.median(size):4.0f}, worst {size.max():4.0f} nm", end="")
            print(f"; chi-square {quality:5.2f} a term; {seconds:.1f} s", flush=True)


if __name__ == "__main__":
    main()
