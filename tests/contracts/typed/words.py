"""Calls with words for type checkers: each comment must silence one error, or it is an error itself."""

import numpy as np

import pachon

telescope = pachon.paul_baker()
images = np.ones((12, 9, 9))
places = np.zeros((12, 2))

pachon.spots(telescope, sampling="hexapolar")  # type: ignore[arg-type]
pachon.spots(telescope, sampling="rings", reference="center")  # type: ignore[arg-type]
pachon.spots(telescope, sampling="rings", reference="centroid", projection="zemax")
pachon.spots(telescope, projection="tan")  # type: ignore[arg-type]
pachon.make_psfs(telescope, places, 5e-7, engine="quick")  # type: ignore[arg-type]
pachon.make_psfs(telescope, places, 5e-7, engine="wave")
pachon.psf_moments(telescope, places, 5e-7, engine="fast")  # type: ignore[arg-type]
pachon.wavefront_opd(telescope, (0.0, 0.0), 5e-7, grid=8, reference="middle")  # type: ignore[arg-type]
pachon.wavefront_zernikes(telescope, places, 5e-7, ordering="ansi")  # type: ignore[arg-type]
pachon.wavefront_zernikes(telescope, places, 5e-7, pupil="lit", ordering="fringe")
pachon.encircled_energy(telescope, places, 5e-7, kind="ray")  # type: ignore[arg-type]
pachon.monte_carlo(telescope, [], merit="strehl")  # type: ignore[arg-type]
pachon.optimize(telescope, ["M2.dz"], "spot")  # type: ignore[arg-type]
pachon.optimize(telescope, ["M2.dz"], "spots")
pachon.save_telescope(telescope, "lens.zmx", format="zmx")  # type: ignore[arg-type]
pachon.new_telescope("quadruplet")  # type: ignore[arg-type]
pachon.new_telescope("triplet")
pachon.PsfModel.fit(images, places, basis="eigen")  # type: ignore[arg-type]
pachon.PsfModel.fit(images, places, recipe="best")  # type: ignore[arg-type]
pachon.PsfModel.fit(images, places, recipe="paper", basis="pca", interpolation="kriging")
pachon.FocalPlane.from_budget("lsst", seed=1, budget="simulation")  # type: ignore[arg-type]
pachon.Exposure(band="v")  # type: ignore[arg-type]
pachon.Air(formula="edlen")  # type: ignore[arg-type]
pachon.models.Pickup("M2", "colour", "M1")  # type: ignore[arg-type]
pachon.models.DesignData(aiming="true")  # type: ignore[arg-type]
pachon.design.SpotSize("chief ray")  # type: ignore[arg-type]
pachon.design.SpotSize("chief")
pachon.studies.file_schema("lens")  # type: ignore[arg-type]

# Old spellings work at run time, with a warning; type checkers know the new ones alone.
pachon.Annulus(0.5, 1.0)  # type: ignore[attr-defined]
pachon.models.Annulus(0.5, 1.0)
