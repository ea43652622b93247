"""Wavefront error of a single donut by turbulence, through screens, against the exposure time.

Run: python benchmarks/donuts_in_turbulence.py [epochs]

Donuts of the LSST as designed (r band, 620 nm, 1.5 mm behind the focus, 5e6 electrons) are drawn by the fast engine
through six frozen screens, a pair of stars in an epoch, and fitted as a long exposure: all that is found beyond the
error of the photons is turbulence. Root of the sum of squares over Z4 to Z22, beside the closed form of
:func:`~pachon.wavefront.atmosphere.mean_wavefront.mean_wavefront_covariance` for the same winds.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

import pachon
from pachon.wavefront.atmosphere.mean_wavefront import mean_wavefront_covariance

PARSER = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
PARSER.add_argument("epochs", type=int, nargs="?", default=5, help="exposures, of two donuts each")
ARGUMENTS = PARSER.parse_args()
EPOCHS = ARGUMENTS.epochs
WAVELENGTH, NOLL = 620e-9, np.arange(4, 23)
TIMES = (3.75, 7.5, 15.0, 30.0)
FIELDS = np.deg2rad([(-1.19, -1.125), (1.125, -1.19)])
ELECTRONS, SKY, READ_NOISE = 5e6, 300.0, 9.0


def main() -> None:
    telescope = pachon.load_telescope("lsst_v3.3_r").perturbed("Detector", shift=(0.0, 0.0, 1.5e-3))
    pupil = telescope.pupil_diameter, telescope.pupil_obscuration
    found: dict[float, list[float]] = {time: [] for time in TIMES}
    expected: dict[float, list[float]] = {time: [] for time in TIMES}
    noise = 0.0
    for epoch in range(EPOCHS):
        longest = pachon.Atmosphere.from_site(
            "cerro_pachon",
            seed=1,
            epoch=epoch,
            exposure=TIMES[-1],
            screens=pachon.ScreenSampling(screen_size=4096, screen_length=650.0),
        )
        for time in TIMES:
            steps = round(time / 0.05)
            air = longest.at_times((np.arange(steps) + 0.5) * 0.05, time)
            donuts = pachon.draw_donuts(
                telescope,
                FIELDS,
                [WAVELENGTH],
                atmosphere=air,
                engine="fast",
                electrons=ELECTRONS,
                sky=SKY,
                read_noise=READ_NOISE,
                seed=epoch,
            )
            fit = pachon.fit_donuts(telescope, donuts.images, FIELDS, WAVELENGTH, sky_variance=donuts.sky_variance)
            found[time] += [1e9 * float(np.linalg.norm(z)) for z in fit.zernikes if np.isfinite(z).all()]
            noise = 1e9 * float(np.sqrt(np.trace(fit.error_parts.photons[0])))
            law = mean_wavefront_covariance(replace(air, exposure=time), FIELDS[:1], NOLL, *pupil)[0, :, 0]
            expected[time].append(1e9 * float(np.sqrt(np.trace(law))))
        longest.release()
    print(f"pachon {pachon.__version__}; {EPOCHS} epochs; photons alone {noise:.0f} nm")
    print(f"{'time [s]':>8} {'donuts':>7} {'median':>7} {'rms':>6} {'worst':>6} {'law + photons [nm]':>19}")
    for time in TIMES:
        values = np.array(found[time])
        law = np.sqrt(np.mean(np.square(expected[time])) + noise**2)
        print(
            f"{time:8.2f} {len(values):7d} {np.median(values):7.0f} {np.sqrt(np.mean(values**2)):6.0f}"
            f" {values.max():6.0f} {law:19.0f}"
        )


if __name__ == "__main__":
    main()
