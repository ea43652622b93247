"""
The stars of a run
==================

One CCD through the mean over all turbulence: noise-free PSFs, observed stars, and a model of their PSFs.
"""

from pathlib import Path

import pachon

config = pachon.Configuration.model_validate(
    {
        "ccds": ["R22_S11"],
        "wavelengths_nm": [620.0],
        "psf": {"engine": "long_exposure", "n_pupil": 300},
        "stars": {"truth": 30, "observed": 40},
        "reconstruction": {"components": 5, "order": 1, "truth_order": 2},
    }
)
result = pachon.run(config, Path("run"))
model = pachon.PsfModel.read(Path("run", "ccd_R22_S11.fits"))
print(model)
print(f"CCDs that were modelled: {', '.join(result.computed)}")
model.plot().savefig("run.png")

# %%
# Its stars on the :doc:`desk <../howto/desk>`, live in the notebook of this page:
pachon.open_desk("run")
