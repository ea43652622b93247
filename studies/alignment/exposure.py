"""Donuts of one visit: exposed through the telescope as it is, and fitted with the telescope as it should be."""

from __future__ import annotations

import numpy as np

from ...core.random_streams import stream
from ...models.telescope import Telescope
from ...pipeline.simulate.donuts import draw_donuts
from ...pipeline.simulate.star_defects import StarDefects
from ...sensing.fit import fit_donuts
from ...sensing.model import DonutAir, DonutDetector, DonutModel
from ...sensing.result import DonutFit
from ...sensing.wavefront_fits import SingleDonuts
from ...wavefront.aberration import StarWavefronts
from ...wavefront.psf.stamps import Stamps
from .scene import NOLL, AlignmentScene

#: Rms of the charge diffusion [m].
_DIFFUSION = 4e-6


def expose(scene: AlignmentScene, telescope: Telescope, visit: int, threads: int | None = None) -> np.ndarray:
    """Return the donuts of a visit through a telescope [electrons], shape [n_star, ny, nx]."""
    donuts, stars, seed = scene.config.donuts, scene.stars, scene.config.seed
    drawn = stream(seed, "alignment", "turbulence", visit).standard_normal(len(scene.turbulence))
    # Eigenvectors, since far terms of neighbouring stars make the matrix nearly singular.
    values, vectors = np.linalg.eigh(scene.turbulence)
    wavefronts = (vectors @ (np.sqrt(np.maximum(values, 0.0)) * drawn)).reshape(len(stars), len(NOLL))

    aberration = StarWavefronts(
        coefficients=np.zeros(len(NOLL)),
        pupil_diameter=telescope.pupil_diameter,
        pupil_obscuration=telescope.pupil_obscuration,
        stars=wavefronts,
        slopes=np.tan(stars.fields),
    )
    return draw_donuts(
        telescope,
        stars.fields,
        scene.wavelengths,
        focal_plane=stars.focal_plane,
        atmosphere=scene.atmosphere,
        aberration=aberration if scene.config.air.wavefront else None,
        electrons=donuts.electrons,
        sky=donuts.sky,
        read_noise=donuts.read_noise,
        defects=StarDefects(donuts.second_stars, donuts.cosmic_rays),
        stamps=Stamps(donuts.stamp, diffusion=_DIFFUSION),
        seed=int(stream(seed, "alignment", "donuts", visit).integers(2**31)),
        threads=threads,
    ).images


def fit(scene: AlignmentScene, images: np.ndarray, threads: int | None = None) -> DonutFit:
    """Return the wavefronts of donuts beyond those of the telescope as designed."""
    donuts, stars = scene.config.donuts, scene.believed
    model = DonutModel(
        air=DonutAir(outer_scale=scene.atmosphere.outer_scale),
        detector=DonutDetector(diffusion=_DIFFUSION, focal_plane=stars.focal_plane),
        diffraction=True,
    )
    return fit_donuts(
        scene.telescope,
        images,
        stars.fields,
        scene.wavelengths,
        sky_variance=donuts.sky + donuts.read_noise**2,
        model=model,
        fit=SingleDonuts(NOLL, higher_order=0.0),
        threads=threads,
    )
