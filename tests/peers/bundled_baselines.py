"""Write the bundled baselines anew: ``python tests/peers/bundled_baselines.py``.

What their figures were checked against stands here; test_baselines.py computes it. After a change that is meant,
``pachon baseline update`` suffices: this is for a new plan, or new kinds of figures.
"""

from pathlib import Path

import numpy as np

from pachon.studies.baseline import baseline
from pachon.studies.baseline.file import write_baseline

FOLDER = Path(baseline.__file__).parent / "bundled"
BATOID = {
    "opd": "batoid within 0.001 nm",
    "landing": "batoid within 1e-9 mm",
    "zernike": "batoid's rays and GalSim's annular Zernikes within 0.001 nm",
    "spot": "batoid within 1e-6 um",
    "ee80": "Huygens integral over batoid's rays within 0.005 um",
    "distortion focal length": "batoid within 1e-9 m",
    "distortion axis focal length": "batoid within 3e-8 m",
    "distortion largest": "batoid within 1e-6 percent",
    "distortion rms": "batoid within 1e-5 um",
    "vignetting": "batoid within 1e-6",
    "defocus": "batoid within 0.05 nm",
    "psf fwhm": "batoid's wavefronts and GalSim's von Karman turbulence within 0.0005 arcsec",
    "psf e": "batoid's wavefronts and GalSim's von Karman turbulence within 0.0001",
}
ZEMAX = {
    "opd 500 nm field (0, 1.225) pupil (0.5, 0.5)": BATOID["opd"],
    "opd 500 nm field (0, 1.225)": f"Zemax's listing within 0.01 nm; {BATOID['opd']}",
    "landing x field (1.75, 0) pupil (0, 0)": f"Zemax's listing within 2e-8 mm; {BATOID['landing']}",
    "landing y field (1.75, 0) pupil (0, 0)": f"Zemax's listing within 2e-8 mm; {BATOID['landing']}",
    "landing x field (0.875, 0.875) pupil (0.5, 0.5)": f"Zemax's listing within 2e-8 mm; {BATOID['landing']}",
    "landing y field (0.875, 0.875) pupil (0.5, 0.5)": f"Zemax's listing within 2e-8 mm; {BATOID['landing']}",
    **BATOID,
}
# Points of the lattice of Zemax's map, and that of its skew ray.
PUPIL = ((0.8, 0.2), (-0.6, 0.6), (0.2, -0.8), (-0.8, -0.4), (0.0, 0.8), (0.5, 0.5))


def main() -> None:
    zemax, left_out = baseline.make_baseline(
        "lsst_v3.3_g_vacuum_zemax_check",
        FOLDER,
        fields=np.deg2rad([(0.0, 1.225), (1.75, 0.0), (0.875, 0.875)]),
        wavelengths=[500e-9],
        pupil=PUPIL,
    )
    assert not left_out, left_out
    write_baseline(FOLDER / f"lsst_v3.3_g_vacuum_zemax_check{baseline.SUFFIX}", zemax.with_sources(ZEMAX))
    lsst, left_out = baseline.make_baseline("lsst_v3.3_r", FOLDER, FOLDER / "lsst_v3.3_r.yaml")
    assert not left_out, left_out
    write_baseline(FOLDER / f"lsst_v3.3_r{baseline.SUFFIX}", lsst.with_sources(BATOID))


if __name__ == "__main__":
    main()
