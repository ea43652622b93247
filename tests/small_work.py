"""The smallest work of each command, for tests that kill it, fill its disk or stop its clock."""

import shutil
import sqlite3
import sys
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

LENS = Path(__file__).parent / "data/zmx/lens1.zmx"
RUN = {
    "ccds": ["R22_S11", "R22_S12"],
    "wavelengths_nm": [620.0],
    "stars": {"truth": 14, "observed": 12},
    "psf": {"engine": "long_exposure"},
    "reconstruction": {"components": 4, "order": 1, "truth_order": 2},
}
VISITS = {
    "run": RUN
    | {
        "ccds": ["R22_S11"],
        "psf": {"engine": "long_exposure", "n_pupil": 200, "stamp": 49},
        "reconstruction": {"recipe": "paper", "basis": "pixels", "order": 1, "weights": "snr", "truth_order": 2},
    },
    "visits": {"count": 2, "stars": 60, "places": 20, "snapshots": [1]},
}
SWEEP = {
    "base": RUN | {"ccds": ["R22_S11"], "stars": {"truth": 12}},
    "parameters": {"M2.dz_um": {"nominal": 0, "range": [-10, 10]}},
    "design": {"kind": "latin_hypercube", "points": 4},
    "metrics": ["fwhm", "rms_e"],
}
TOLERANCES = {
    "surfaces": {"radius_percent": 0.2},
    "tolerances": [{"name": "S1.dz_um", "size": 10}],
    "compensators": ["Image.dz_um"],
    "draws": 20,
    "rings": 2,
}
ALIGN = {
    "visits": 3,
    "wavelengths_nm": [622.0],
    "degrees_of_freedom": "freedoms.yaml",
    "air": {"wavefront": False},
}
FREEDOMS = {"name": "two", "degrees_of_freedom": [
    {"name": name, "unit": "um", "of": f"M2.{name}"} for name in ("dz", "dx")]}  # fmt: skip
#: Modules that the work needs, which a server of forks imports once.
MODULES = [
    "pachon.commands.cli", "pachon.pipeline.run", "pachon.studies.sweep.sweep", "pachon.studies.tolerance.study",
    "pachon.studies.alignment.loop", "pachon.studies.reproduce.reproduce", "pachon.studies.shimming.shim",
    "pachon.studies.visits.image_stack.stack_images", "pachon.studies.visits.null_test", "pachon.sensing.fit",
    "pachon.imaging.measure_files", "pachon.reconstruction.focal_plane_psf.static_heights",
    "pachon.design.optimize.optimize", "matplotlib.pyplot",
]  # fmt: skip


def _write_images(here):
    """Write two images with stars and galaxies, which are all Gaussians, on a grid."""
    from astropy.io import fits

    rng = np.random.default_rng(2)
    y, x = np.indices((400, 400))
    image = np.zeros(x.shape)
    for number, (cx, cy) in enumerate((20.0 + 40.0 * i, 20.0 + 40.0 * j) for i in range(10) for j in range(10)):
        width, flux = (2.0, 5e4) if number % 2 else (rng.uniform(2.6, 4.0), rng.uniform(2e4, 5e4))
        cx, cy = cx + rng.uniform(-0.5, 0.5), cy + rng.uniform(-0.5, 0.5)
        image += flux / (2 * np.pi * width**2) * np.exp(-0.5 * ((x - cx) ** 2 + (y - cy) ** 2) / width**2)
    header = fits.Header({"GAIN": 1.0, "SATURATE": 5e4, "MAGZERO": 30.0, "EXPTIME": 90.0, "FILTER": "r"})
    for axis, kind in (("1", "RA---TAN"), ("2", "DEC--TAN")):
        header[f"CTYPE{axis}"], header[f"CRVAL{axis}"], header[f"CDELT{axis}"] = kind, 10.0, 0.2 / 3600.0
    for name in ("a", "b"):
        noisy = (rng.poisson(image + 100.0) - 100.0).astype(np.float32)
        planes = [
            fits.ImageHDU(noisy, header, name="SCI"),
            fits.ImageHDU(np.zeros(noisy.shape, np.int16), name="MSK"),
            fits.ImageHDU(np.full(noisy.shape, 0.01, np.float32), name="WGT"),
        ]
        fits.HDUList([fits.PrimaryHDU(), *planes]).writeto(here / f"{name}.fits")


def _write_stars(here):
    from astropy.table import Table

    rng = np.random.default_rng(3)
    y, x = np.mgrid[-8:9, -8:9]
    stars = 2e3 * np.exp(-0.5 * (x * x + y * y) / 1.6**2) + rng.normal(size=(30, 17, 17)) * 10.0
    places = rng.uniform(0.0, 2000.0, (2, 30))
    Table({"x": places[0], "y": places[1], "stamp": stars}).write(here / "stars.fits")


def _write_donuts(here):
    from pachon.commands.cli import main

    options = ["--simulate", "--defocus-um", "1500", "--set", "stars=1", "--pixel-um", "30", "--quiet"]
    assert main(["donuts", str(here / "donuts.fits"), *options]) == 0


def _write_visits(here):
    from pachon.commands.cli import main

    (here / "visits.yaml").write_text(yaml.safe_dump(VISITS))
    assert main(["visits", str(here / "visits.yaml"), "--out", str(here / "visits"), "--threads", "1", "--quiet"]) == 0


def _write(**contents):
    def write(here):
        for name, content in contents.items():
            (here / f"{name}.yaml").write_text(yaml.safe_dump(content))

    return write


def _few_galaxies_and_pixels():
    """Some hundred galaxies in place of ten thousand, and pictures of few pixels."""
    from pachon.core import plotting
    from pachon.studies.reproduce import visits
    from pachon.studies.visits import null_test

    plotting.picture_bytes.__defaults__ = (60,)
    null_test.FAINTEST_SNR = 60.0
    visits._FAINTEST = 25.0


def _reproduce(here, out, resume):
    from dataclasses import replace

    from pachon.core.long_work import Execution
    from pachon.studies.reproduce.bench import SMALL, Bench
    from pachon.studies.reproduce.reproduce import reproduce

    tiny = replace(
        SMALL, name="tiny", field_points=2, screen_size=1024, ccds=("R22_S11", "R22_S12"), truth=24, observed=24,
        time_step=1.0, visits=2, visit_ccds=("R22_S11",), visit_points=(24, 6), tiles=1, rings=12,
    )  # fmt: skip
    reproduce(["fig2", "fig9"], Bench(tiny, out, execution=Execution(threads=1)))


def _align(here, out, resume):
    """Align with Zernikes of traced wavefronts in place of images and fits, which take seconds a visit."""
    from types import SimpleNamespace

    from pachon.core.long_work import Execution
    from pachon.studies.alignment import loop
    from pachon.studies.alignment.config import load_align_configuration
    from pachon.studies.alignment.product import write_alignment
    from pachon.studies.alignment.scene import NOLL
    from pachon.wavefront.opd import wavefront_opd
    from pachon.wavefront.zernike import fit_zernikes

    def expose(scene, telescope, visit, threads):
        maps = [wavefront_opd(telescope, tuple(f), scene.wavelength, grid=48) for f in scene.stars.fields]
        fits = [fit_zernikes(m, 0.5 * telescope.pupil_diameter, telescope.pupil_obscuration, 28) for m in maps]
        return np.array([zernikes.coefficients[NOLL - 1] for zernikes in fits])

    def fit(scene, exposed, threads):
        count, size = exposed.shape
        stamps = np.random.default_rng(3).poisson(100.0, (count, 9, 9)).astype(float)
        return SimpleNamespace(
            zernikes=exposed - expose(scene, scene.telescope, 0, threads), usable=np.ones(count, dtype=bool),
            error_parts=SimpleNamespace(photons=np.tile(6.4e-17 * np.eye(size), (count, 1, 1))),
            images=stamps, model=np.full(stamps.shape, 100.0), residuals=stamps - 100.0,
        )  # fmt: skip

    loop.expose, loop.fit = expose, fit
    config = load_align_configuration(here / "align.yaml")
    write_alignment(loop.align(config, folder=here, store=out, execution=Execution(resume=resume, threads=1)), out)


def _static_heights(here, out, resume):
    import pachon
    from pachon.models.camera.camera import Camera
    from pachon.reconstruction.focal_plane_psf.optics_prior import OpticsPrior
    from pachon.reconstruction.focal_plane_psf.response import Instrument
    from pachon.reconstruction.focal_plane_psf.stars import FocalPlaneStars

    lsst, count = pachon.load_camera("lsst"), 2
    camera = Camera("part", lsst.ccd_names[:count], ("R",), np.zeros(count, int), lsst.centers[:count],
                    np.array([4096, 4096]), 10e-6)  # fmt: skip
    rng = np.random.default_rng(1)
    ccd = np.repeat(np.arange(count), 12)
    places = camera.centers[ccd] + 0.5 * camera.shortest_side * rng.uniform(-0.97, 0.97, (len(ccd), 2))
    instrument = Instrument.of(pachon.load_telescope("lsst_v3.3_r"), [620e-9])
    plane = pachon.FocalPlane.from_budget(camera, seed=5)
    shapes = instrument.shapes(instrument.fields(places), plane, None)
    exposures = [
        FocalPlaneStars(tuple(np.array(camera.ccd_names)[ccd]), *places.T, noise=np.full(shapes.shape, 1e-3),
                        values=shapes + 1e-3 * rng.standard_normal(shapes.shape)) for _ in range(2)
    ]  # fmt: skip
    out.mkdir(exist_ok=True)
    heights = pachon.reconstruction.fit_static_heights(
        exposures, instrument, camera=camera, prior=OpticsPrior(alignment_rms=0.0), steps=1, folder=out, threads=1
    )
    heights.write(out / "heights.fits")


def content(out):
    """Return the bytes of all files of work but its times; of stores of points their figures, in any order."""
    files = {}
    for path in sorted(out.rglob("*")):
        if not path.is_file() or path.name == "timings.json":
            continue
        data = path.read_bytes()
        if data[:15] == b"SQLite format 3":
            with closing(sqlite3.connect(path)) as connection:
                data = connection.execute("SELECT number, metrics, problem FROM results ORDER BY number").fetchall()
        files[str(path.relative_to(out))] = data
    return files


@dataclass(frozen=True)
class Work:
    """Work of a command, in few seconds."""

    words: str  #: of the command line; {here} is the folder of the inputs, {out} the folder to write to
    make: Callable[[Path], None] = lambda here: None  #: function that writes the inputs into their folder
    resumes: bool = True
    start: str | None = None  #: folder of the inputs of which the one to write to is a copy at first
    function: Callable[[Path, Path, bool], None] | None = None  #: in place of a command
    products: str = ""  #: pattern of files that are kept where the work goes on

    def begin(self, here, out):
        """Make the folder to write to, where the work needs it."""
        if self.start is not None:
            shutil.copytree(here / self.start, out)
        elif "{out}/" in self.words:
            out.mkdir(exist_ok=True)

    def run(self, here, out, resume=False):
        """Do the work in this process, and return the exit status."""
        from pachon.commands.cli import main
        from pachon.core.errors import PachonError

        _few_galaxies_and_pixels()
        if self.function is not None:
            try:
                self.function(here, out, resume)
            except PachonError as error:
                print(f"pachon: error: {error}", file=sys.stderr)
                return 2
            return 0
        words = [word.format(here=here, out=out) for word in self.words.split()]
        return main([*words, *(["--resume"] if resume and self.resumes else [])])


ON_ONE = "--threads 1 --quiet"
WORK = {
    "run": Work(f"run {{here}}/run.yaml --out {{out}} {ON_ONE}", _write(run=RUN), products="ccd_*.fits"),
    "sweep": Work(
        "sweep {here}/sweep.yaml --out {out}/s.sweep --processes 1 --quiet", _write(sweep=SWEEP)
    ),
    "tolerance": Work(f"tolerance {LENS} {{here}}/tol.yaml --out {{out}} --quiet", _write(tol=TOLERANCES)),
    "align": Work("", _write(align=ALIGN, freedoms=FREEDOMS), function=_align, products="visit_*.npz"),
    "measure": Work(f"measure {{here}}/a.fits {{here}}/b.fits --out {{out}} {ON_ONE}", _write_images,
                    products="*_galaxies.fits"),
    "null-test": Work(f"null-test {{out}} --tiles 1 --rings 10 {ON_ONE}", _write_visits, start="visits",
                      products="galaxies/*.fits"),
    "visits": Work(f"visits {{here}}/visits.yaml --out {{out}} {ON_ONE}", _write(visits=VISITS)),
    "stack-images": Work(f"stack-images {{out}} --side 256 --faintest 24 --no-measure {ON_ONE}", _write_visits,
                         start="visits"),
    "shim": Work(
        f"shim {{here}}/run.yaml --ccds R34_S00,R34_S11,R34_S20 --heights lsstcam --out {{out}} {ON_ONE}",
        _write(run=RUN), resumes=False,
    ),
    "donuts": Work(
        "donuts {here}/donuts.fits --zernikes 6 --no-diffraction --higher-order-nm 0 --each-alone"
        f" --no-orientation-check -o {{out}}/out.ecsv --picture {{out}}/donuts.png {ON_ONE}",
        _write_donuts, resumes=False,
    ),
    "model": Work("model {here}/stars.fits --pixel-arcsec 0.2 --min-snr 5 --out {out}/psf.fits --quiet", _write_stars,
                  resumes=False),
    "optimize": Work(
        f"optimize {LENS} --variables S1.radius,Image.dz --out {{out}}/best.yaml --picture {{out}}/best.png",
        resumes=False,
    ),
    "reproduce": Work("", function=_reproduce),
    "fit_static_heights": Work("", function=_static_heights, products="*.npz"),
}  # fmt: skip
