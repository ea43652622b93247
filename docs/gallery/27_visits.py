"""
Visits of a scheduler
=====================

Two visits of a list, each with its own pointing, time, band and air: width of the PSF and depth.
"""

from pathlib import Path

from matplotlib.figure import Figure

import pachon
from pachon.studies import NightConfig, run_night

Path("visits.csv").write_text(
    "visit,ra,dec,mjd,exp_time,band,rotTelPos,seeingFwhm500,altitude\n"
    "1001,53.1,-27.8,61001.15,30,r,-35,0.72,80\n"
    "1002,52.9,-28.1,61012.20,30,i,42.5,0.95,70\n"
)
settings = {
    "run": {"ccds": ["R22_S11"], "psf": {"engine": "long_exposure", "n_pupil": 300}, "stars": {"truth": 16}},
    "visits": {"list": "visits.csv"},
    "maps": {"nside": 0},
    "models": False,
}
night = run_night(NightConfig.model_validate(settings), Path("night"))
axes = (figure := Figure(figsize=(4, 3), layout="constrained")).subplots()
for band, metrics in night.summary["bands"].items():
    print(f"{band}: psfSigma {metrics['median_psfSigma']:.2f} pixels, magLim {metrics['median_magLim']:.2f}")
    axes.bar(band, metrics["median_magLim"])
axes.set(ylim=(20, 26), ylabel="limiting magnitude (S/N 5)")
figure.savefig("visits.png")

# %%
# The visits on the :doc:`desk <../howto/desk>`, live in the notebook of this page:
pachon.open_desk("night")
