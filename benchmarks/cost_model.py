"""Cost of a run: seconds and bytes against CCDs, stars, wavelengths, time steps, layers and screens.

    python benchmarks/cost_model.py [--rounds 3]

Times stars over the field with one quantity changed at a time, screens with some and with all of their rows, and the
modelling of one CCD with two numbers of stars, all in seconds of processor time on one thread; fits by least squares
(relative errors)

    star   = base + wave * W + read * T * P * L + bin * T * P * W        (T time steps, P pupil points, L layers)
    screen = (modes + rows * f) * N^2                       (N samples on a side, a fraction f of the rows is made)
    model  = base + star * S                                             (S noise-free stars of one CCD)

prints each measurement beside the fit, compares the prediction with the stages of two runs that it did not fit, and
predicts the cost of the paper's simulation and of a survey.
"""

import argparse
import json
import tempfile
import time
from functools import partial
from pathlib import Path

import numpy as np

import pachon
from pachon import Configuration, Experiment
from pachon.pipeline.config import with_options
from pachon.pipeline.run_folder import stamp_of, write_ccds
from pachon.pipeline.simulate.ccd_exposure import expose_ccd
from pachon.pipeline.simulate.ccd_loop import simulate_ccds
from pachon.pipeline.simulate.ccd_model import model_ccd
from pachon.pipeline.simulate.screen_cover import corner_fields
from pachon.raytrace.rays import field_direction
from pachon.reconstruction.ccd_product import product_path, write_product

LAYERS = {
    n: pachon.models.load_site("cerro_pachon").with_layers(a, w, s)
    for n, a, w, s in (
        (1, [5000.0], [1.0], [10.0]),
        (3, [0.0, 5000.0, 15000.0], [0.5, 0.3, 0.2], [5.0, 10.0, 20.0]),
    )
}
# wavelengths, time steps, pupil points (requested), layers
STARS = [
    (5, 300, 334, 6),
    (1, 300, 334, 6),
    (5, 60, 334, 6),
    (1, 60, 334, 6),
    (5, 300, 334, 1),
    (5, 300, 334, 3),
    (5, 300, 188, 6),
    (3, 600, 334, 6),
]
#: Pupil points that the engine takes for those requested.
POINTS = {334: 332, 188: 160}
SURVEY_DEG2, FIELD_DEG2, CCDS, NOISE_FREE, OBSERVED = 20_000.0, 9.6, 189, 800, 40


def time_stars(telescope, rounds, count=96):
    """Return seconds of a star for each entry of STARS: the least of some rounds, taken in turns."""
    rng = np.random.default_rng(2)
    radius, angle = 0.028 * np.sqrt(rng.random(count)), 2 * np.pi * rng.random(count)
    fields = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    atmospheres = {}
    for _, steps, _, layers in STARS:
        site = LAYERS.get(layers, "cerro_pachon")
        atmospheres[steps, layers] = pachon.Atmosphere.from_site(
            site, 1, time_step=15.0 / steps, screens=pachon.ScreenSampling(screen_size=4096, screen_length=650.0)
        )
    least = np.full(len(STARS), np.inf)
    for _ in range(rounds + 1):
        for i, (waves, steps, points, layers) in enumerate(STARS):
            atmosphere = atmospheres[steps, layers]
            atmosphere.screens("slopes")
            start = time.process_time()
            pachon.make_psfs(
                telescope,
                fields,
                np.linspace(545e-9, 703e-9, waves),
                atmosphere=atmosphere,
                threads=1,
                engine=pachon.FastEngine(n_pupil=points),
            )
            least[i] = min(least[i], (time.process_time() - start) / count)
    return least


def fit_stars(seconds):
    """Return the four coefficients [s] and the fitted seconds of each measurement."""
    waves, steps, points, layers = np.array([(w, t, POINTS[p], n) for w, t, p, n in STARS], dtype=float).T
    terms = np.stack([np.ones(len(STARS)), waves, steps * points * layers, steps * points * waves], axis=1)
    coefficients = np.linalg.lstsq(terms / seconds[:, None], np.ones(len(STARS)), rcond=None)[0]
    return coefficients, terms @ coefficients


def time_screens(rounds, size=4096):
    """Return seconds of a sample for the modes of slope screens, and for their rows."""
    least = {}
    for fraction in (0.1, 1.0) * rounds:
        atmosphere = pachon.Atmosphere.from_site(
            "cerro_pachon",
            3,
            screens=pachon.ScreenSampling(screen_size=size, screen_length=size * 1300 / 8192),
            exposure=5.0,
        )
        rows = np.broadcast_to(np.arange(size) < fraction * size, (6, size))
        start = time.process_time()
        atmosphere.screens("slopes", 1, rows)
        seconds = (time.process_time() - start) / (6 * size**2)
        least[fraction] = min(least.get(fraction, np.inf), seconds)
    rows = (least[1.0] - least[0.1]) / 0.9
    return least[1.0] - rows, rows


def time_models():
    """Return seconds to model a CCD and bytes of its product for two numbers of noise-free stars."""
    cost = {}
    exposed = {}
    for n_star in (100, 400):
        options = {
            "ccds": ("R22_S11",),
            "stars__truth": n_star,
            "atmosphere__exposure_s": 1.0,
            "atmosphere__screen_size": 2048,
            "atmosphere__screen_length_m": 325.0,
        }
        experiment = Experiment.from_config(with_options(Configuration(), **options))
        exposed[n_star] = experiment, expose_ccd(experiment, "R22_S11")
    # The first compiles kernels, or reads them.
    model_ccd(*exposed[100])
    for n_star, (experiment, exposure) in exposed.items():
        start = time.process_time()
        product = model_ccd(experiment, exposure)
        with tempfile.TemporaryDirectory() as folder:
            write_product(Path(folder), product, stamp_of(experiment), [])
            seconds = time.process_time() - start
            cost[n_star] = seconds, product_path(Path(folder), "R22_S11").stat().st_size
    (s1, b1), (s2, b2) = cost.values()
    return {"seconds": (s1 - (s2 - s1) / 3, (s2 - s1) / 300), "bytes": (b1 - (b2 - b1) / 3, (b2 - b1) / 300)}


def cost_of(experiment, coefficients, screens, models):
    """Return the seconds of screens, and those of PSFs and models, that the fits predict for an experiment."""
    (base, wave, read, binned), (modes, rows), (model_base, model_star) = coefficients, screens, models
    config, air = experiment.config, experiment.atmosphere
    waves, steps, layers = len(experiment.wavelengths), len(air.times), air.layer_count
    star = base + wave * waves + steps * POINTS[334] * (read * layers + binned * waves)
    stars = config.stars.truth + config.stars.observed
    return air.screen_size**2 * (modes * layers + rows * layers * fraction_of(experiment)), len(config.ccds) * (
        stars * star + model_base + model_star * config.stars.truth
    )


def fraction_of(experiment):
    """Return the fraction of the rows of its screens that an experiment makes."""
    fields = corner_fields(experiment.telescope, experiment.camera, experiment.config.ccds)
    directions = field_direction(*fields.T)
    return experiment.atmosphere.rows_under(directions, experiment.telescope.pupil_diameter).mean()


def check(coefficients, screens, models):
    """Print the predicted and the measured processor time of runs on one thread."""
    runs = {
        "default": {},
        "one raft, one wavelength": {
            "ccds": ("R22",),
            "wavelengths_nm": (620.0,),
            "stars__truth": 200,
            "atmosphere__screen_size": 4096,
            "atmosphere__screen_length_m": 650.0,
        },
    }
    for name, options in runs.items():
        experiment = Experiment.from_config(with_options(Configuration(), **options))
        predicted = cost_of(experiment, coefficients, screens, models)
        start = time.process_time()
        experiment.make_screens(1)
        middle = time.process_time()
        with tempfile.TemporaryDirectory() as folder:
            simulate_ccds(experiment, partial(write_ccds, experiment, Path(folder)), threads=1)
        measured = middle - start, time.process_time() - middle
        for part, mine, real in zip(("screens", "PSFs and models"), predicted, measured, strict=True):
            print(f"check, {name}: {part} predicted {mine:.2f} s, measured {real:.2f} s, ratio {mine / real:.2f}")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    telescope = pachon.load_telescope("lsst_v3.3_r")
    print(f"pachon {pachon.__version__}, processor time on one thread")
    seconds = time_stars(telescope, options.rounds)
    (base, wave, read, binned), fitted = fit_stars(seconds)
    print("stars: W  T   P   L   measured  fitted [ms]")
    for (w, t, p, n), measured, model in zip(STARS, seconds, fitted, strict=True):
        print(f"       {w}  {t:3d} {POINTS[p]} {n}   {1e3 * measured:7.2f}  {1e3 * model:7.2f}")
    print(
        f"star = {1e3 * base:.2f} ms + {1e3 * wave:.3f} ms W + {1e9 * read:.2f} ns T P L + {1e9 * binned:.2f} ns T P W"
    )
    modes, rows = time_screens(options.rounds)
    print(f"screen = {1e9 * modes:.1f} ns N^2 + {1e9 * rows:.1f} ns f N^2, 4 f N^2 bytes")
    models = time_models()
    (model_base, model_star), (file_base, file_star) = models["seconds"], models["bytes"]
    print(f"model of a CCD = {model_base:.2f} s + {1e3 * model_star:.2f} ms S (one thread)")
    print(f"product of a CCD = {file_base / 1e6:.2f} MB + {file_star / 1e3:.2f} kB S")
    check((base, wave, read, binned), (modes, rows), models["seconds"])
    star = base + 5 * wave + 300 * 332 * (6 * read + 5 * binned)
    exposure = 6 * 8192**2 * (modes + rows) + CCDS * (NOISE_FREE + OBSERVED) * star
    modelling = CCDS * (model_base + NOISE_FREE * model_star)
    size = CCDS * (file_base + NOISE_FREE * file_star)
    fields = SURVEY_DEG2 / FIELD_DEG2
    print(f"paper's size, {CCDS} CCDs x ({NOISE_FREE} + {OBSERVED}) stars:")
    print(f"  {exposure:.0f} s of PSFs and screens + {modelling:.0f} s of models")
    print(f"  {size / 1e9:.2f} GB of products, {6 * 8192**2 * 4 / 2**30:.2f} GiB of screens")
    core_hours = (exposure + modelling) / 3600
    print(f"one exposure of each of {fields:.0f} fields ({SURVEY_DEG2:.0f} square degrees):")
    print(f"  {fields * core_hours:.0f} core hours, {fields * size / 1e12:.1f} TB")
    print(
        json.dumps(
            {
                "star_s": [base, wave, read, binned],
                "screen_s": [modes, rows],
                "model_s": models["seconds"],
                "product_bytes": models["bytes"],
            }
        )
    )


if __name__ == "__main__":
    main()
