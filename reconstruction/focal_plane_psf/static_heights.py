r"""Heights of the CCDs from many exposures, each with turbulence, alignment and seeing of its own.

Every exposure gives the quadratic approximation of its likelihood in the height parameters, its own parameters
marginalised; these add up,

.. math:: \left(P^{-1} + \sum_v F_v\right) \delta = \sum_v g_v - P^{-1} \beta ,

so that exposures are independent jobs, and memory does not grow with their number. Gauss-Newton steps are repeated
about the new heights, and about the wavefront that each exposure had at the last step.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.linalg
from astropy.io import fits

from ...core.arguments import check_arguments, removed_arguments
from ...core.ccd_names import NAMES_CARD, refuse_mirrored_names
from ...core.errors import DomainError, ProductError, UnknownNameError
from ...core.products import read_fits, write_fits
from ...core.progress import Reporter
from ...core.result import Result
from ...core.threads import one_blas_thread
from ...core.units import ARCSEC
from ...core.version import VERSION
from ...models.camera.camera import Camera
from ...models.camera.cameras import load_camera
from ...models.camera.ccd_surfaces import CcdSurfaces
from ...models.camera.focal_plane import FocalPlane
from ...models.telescope import Telescope
from ..gaussian_field import inverse_from_cholesky
from .consistent_stars import LEAST_STARS, fit_statistics
from .fit import ExposureFit, ShapeData
from .height_equations import ExposureState, HeightEquations
from .heights import STATIC_DEGREE, HeightPrior
from .mosaic import Mosaic
from .optics_prior import OpticsPrior
from .response import Instrument
from .stars import FocalPlaneStars, places_of, same_weight, stars_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Gauss-Newton steps about the heights of all exposures.
STEPS = 3
# Steps of the covariances with which galaxies among the stars are found.
_ROUGH = 12


@dataclass(frozen=True, eq=False)
class StaticHeights(Result):
    """Heights learnt from exposures.

    Attributes
    ----------
    focal_plane : FocalPlane
        The heights.
    covariance : ndarray, shape [n_ccd, n_term, n_term]
        Covariance of the coefficients of each CCD [m^2].
    exposures : int
        Number of exposures.
    """

    _table = ("names", "sigma")

    focal_plane: FocalPlane
    covariance: np.ndarray
    exposures: int

    def plot(self, *, ax: Axes | Figure | None = None) -> Figure:
        """Draw the heights of the focal plane."""
        return self.focal_plane.plot(ax=ax)

    @property
    def camera(self) -> Camera:
        """The camera."""
        return self.focal_plane.camera

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the CCDs."""
        return self.focal_plane.names

    @property
    def sigma(self) -> np.ndarray:
        """Standard deviation of the height of each CCD, rms over its area [m], shape [n_ccd]."""
        return np.sqrt(np.einsum("cii->c", self.covariance))

    def prior(self) -> HeightPrior:
        """Return these heights as the prior for another exposure."""
        return HeightPrior.known(self.focal_plane, self.covariance)

    @check_arguments
    def write(self, path: str | Path) -> None:
        """Write a FITS file."""
        surfaces = self.focal_plane.surfaces
        hdus = [
            _image_float64("POLYNOMIAL", surfaces.polynomial, "[m] cubic of each CCD"),
            _image_float64(
                "GRID", surfaces.grid if surfaces.grid is not None else np.zeros((0, 0, 0)), "[m] B-splines"
            ),
            _image_float64("COVARIANCE", self.covariance, "[m2] of the Legendre coefficients of each CCD"),
        ]
        cards = [
            ("CAMERA", self.camera.name, "name of the camera"),
            ("NEXPOSE", self.exposures, "number of exposures"),
            NAMES_CARD,
        ]
        write_fits(Path(path), hdus, None, cards)

    @classmethod
    @check_arguments
    def read(cls, path: str | Path, camera: str | Camera | None = None) -> StaticHeights:
        """Read heights, of a camera that is not bundled with `camera`; ProductError if the file is no such product."""
        hdus = read_fits(Path(path))
        try:
            camera_of_file = load_camera(hdus[0].header["CAMERA"] if camera is None else camera)
            refuse_mirrored_names(camera_of_file.ccd_names, hdus[0].header.get(NAMES_CARD[0]), path)
            grid = _hdu_array(hdus["GRID"])
            surfaces = CcdSurfaces(
                camera_of_file.half_sizes,
                _hdu_array(hdus["POLYNOMIAL"]),
                np.zeros((len(camera_of_file), 2, 4)),
                grid if grid.size else None,
            )
            plane = FocalPlane(camera_of_file, surfaces, np.ones(len(camera_of_file), dtype=bool))
            return cls(plane, _hdu_array(hdus["COVARIANCE"]), int(hdus[0].header["NEXPOSE"]))
        except UnknownNameError:
            raise
        except KeyError as error:
            raise ProductError(f"no product with heights ({' '.join(str(error).split())})", file=path) from None


@removed_arguments(instrument="telescope=instrument")
@check_arguments
def fit_static_heights(
    exposures: Sequence[Any],
    telescope: Telescope | Instrument,
    *,
    camera: str | Camera | None = None,
    prior: OpticsPrior | None = None,
    folder: str | Path | None = None,
    steps: int = STEPS,
    threads: int | None = None,
    reporter: Reporter | None = None,
    map_jobs: Callable[..., Any] = map,
) -> StaticHeights:
    """Fit the heights of all CCDs to the stars of several exposures.

    Parameters
    ----------
    exposures : sequence
        Stars of each, as :meth:`.FocalPlanePsf.fit` takes them; paths keep the memory at that of one exposure.
    telescope : Telescope or Instrument
        The telescope; or an :class:`~pachon.Instrument`, which has wavelengths, atmosphere and detector too, and
        the weight of the moments of tables, which do not say theirs. Where its camera is not rotated, it is rotated by
        the angle that the stars of each exposure state.
    camera : str or Camera, optional
        By default the telescope's.
    prior : OpticsPrior, optional
        Prior of the heights, and of the residual wavefront of each exposure; by default simulated heights and 0.2 um.
    folder : str or path, optional
        Folder with the result of each exposure, from which an interrupted fit is resumed.
    steps : int
        Gauss-Newton steps.
    map_jobs : callable
        ``map`` of an executor over processes or of a Dask client's futures; by default one exposure after the other.

    Returns
    -------
    StaticHeights
        The mean height, and the plane of the focal plane, are degenerate with the focus of each exposure: they are
        those of the mean of all exposures, within the prior.

    Raises
    ------
    DomainError
        If there are no exposures, one has no usable star, the telescope has no camera, or stars were measured under
        another weight than that of an instrument.
    """
    reporter = Reporter(quiet=True) if reporter is None else reporter
    if not len(exposures):
        raise DomainError("exposures: expected one or more")
    prior = OpticsPrior() if prior is None else prior
    believed = telescope.telescope if isinstance(telescope, Instrument) else telescope
    camera_or_name = believed.camera if camera is None else camera
    if camera_or_name is None:
        raise DomainError(f"camera: {believed.name} names none, expected one with the heights of its CCDs")
    cam = load_camera(camera_or_name)
    degree = STATIC_DEGREE
    height_prior = (
        HeightPrior.uninformative(cam, degree=degree)
        if prior.budget is None
        else HeightPrior.from_budget(cam, prior.budget, degree)
    )
    instrument = telescope if isinstance(telescope, Instrument) else Instrument.of(telescope, camera=cam)
    heights = np.zeros(height_prior.n_parameter)
    precision = np.zeros((height_prior.n_parameter, height_prior.n_parameter))
    height_prior.add_to(precision)
    ccd_covariance: np.ndarray | None = None
    states: list[ExposureState | None] = [None] * len(exposures)
    for step in range(max(1, steps)):
        saved_in = None if folder is None else Path(folder)
        job = _ExposureJob(
            instrument,
            height_prior,
            prior.alignment_rms,
            heights,
            ccd_covariance,
            saved_in,
            threads,
            instrument is telescope,
        )
        matrix, vector = precision.copy(), -precision @ heights
        with reporter.stage(f"heights, step {step + 1} of {steps}", total=len(exposures)) as stage:
            jobs = [(step, i, exposure, states[i]) for i, exposure in enumerate(exposures)]
            for number, equations in enumerate(map_jobs(job, jobs)):
                equations.add_to(matrix, vector)
                states[number] = equations.state
                stage.advance(1)
        scale = 1.0 / np.sqrt(np.diagonal(matrix))
        with one_blas_thread():
            root = scipy.linalg.cholesky(matrix * scale[:, None] * scale, lower=True, overwrite_a=True)
            heights = heights + scale * scipy.linalg.cho_solve((root, True), scale * vector)
            full = inverse_from_cholesky(root) * scale[:, None] * scale
            ccd_covariance = height_prior.per_ccd(full)
    assert ccd_covariance is not None
    return StaticHeights(height_prior.focal_plane(heights), ccd_covariance, len(exposures))


@dataclass(frozen=True, eq=False)
class _ExposureJob:
    """Normal equations of one exposure about heights, its own parameters marginalised."""

    instrument: Instrument
    prior: HeightPrior
    alignment_rms: float
    heights: np.ndarray
    ccd_covariance: np.ndarray | None  #: of the heights by the last step, [n_ccd, n_term, n_term]
    folder: Path | None
    threads: int | None
    has_weight: bool  #: whether the weight of the moments is that of the instrument, else that of the stars

    def __call__(self, numbered: tuple[int, int, Any, ExposureState | None]) -> HeightEquations:
        step, number, exposure, state = numbered
        stars = stars_of(exposure)
        usable = stars.usable
        if not usable.any():
            raise DomainError(
                f"exposures[{number}]: 0 of {len(stars)} stars have position, shape and noise: expected one or more"
            )
        stars = stars.chosen(usable)
        instrument = self._under_weight(stars.weight_fwhm, number).with_rotator(stars.rotator)
        mosaic = Mosaic.of_camera(self.prior.camera)
        places = places_of(mosaic, stars)
        data = ShapeData(places, stars.values, stars.noise**2)
        key = self._key(data, state, instrument)
        path = None if self.folder is None else self.folder / f"exposure_{number:05d}_step_{step}.npz"
        saved_equations = None if path is None else HeightEquations.read(path, key)
        if saved_equations is not None:
            return saved_equations
        if len(data) >= LEAST_STARS:
            data = data.chosen(fit_statistics(mosaic, data, _ROUGH, self.threads)[1])
        fit = ExposureFit(data, instrument, self.prior, self.alignment_rms, self.threads, Reporter(quiet=True))
        # What heights may still be off by is no turbulence that the residuals lack.
        fit.heights, fit.ccd_covariance = self.heights.copy(), self.ccd_covariance
        if state is not None:
            fit.exposure, fit.covariances = state
        fit.linearise()
        # Parameters of the exposure follow the heights before its covariances are fitted.
        fit.fit_covariances(30 if state is None else 8)
        fit.solve_exposure()
        fit.fit_covariances(10 if state is None else 4)
        blocks = fit.solve_exposure()
        with one_blas_thread():
            equations = HeightEquations.of(fit, blocks)
        if path is not None:
            equations.write(path, key)
        return equations

    def _under_weight(self, weight_fwhm: float, number: int) -> Instrument:
        """Return the instrument whose shapes are those under the weight of stars [rad]."""
        instrument = self.instrument
        if same_weight(weight_fwhm, instrument.weight_fwhm):
            return instrument
        if not self.has_weight:
            return replace(instrument, weight_fwhm=weight_fwhm)
        # Tables do not say theirs.
        if same_weight(weight_fwhm, FocalPlaneStars.weight_fwhm):
            return instrument
        raise DomainError(
            f"exposures[{number}]: weight_fwhm of its stars is {weight_fwhm / ARCSEC:.4g} arcsec: expected that of the "
            f"instrument, {instrument.weight_fwhm / ARCSEC:.4g} arcsec"
        )

    def _key(self, data: ShapeData, state: ExposureState | None, instrument: Instrument) -> str:
        digest, places = hashlib.sha256(), data.places
        mean = np.zeros(0) if self.prior.mean is None else self.prior.mean.height(*places.xy.T)
        terms = self.prior.common_terms(places), self.prior.ccd_polynomials(places)
        for array in (data.values, data.noise, places.xy, places.ccd, self.heights, mean, *terms):
            digest.update(np.ascontiguousarray(array).tobytes())
        digest.update(repr((VERSION, self.alignment_rms, instrument.key)).encode())
        if state is not None:
            digest.update(state.exposure.tobytes())
        if self.ccd_covariance is not None:
            digest.update(self.ccd_covariance.tobytes())
        return digest.hexdigest()


def _image_float64(name: str, values: np.ndarray, comment: str) -> fits.ImageHDU:
    hdu = fits.ImageHDU(np.asarray(values, dtype=np.float64), name=name)
    hdu.header["COMMENT"] = comment
    return hdu


def _hdu_array(hdu: fits.ImageHDU) -> np.ndarray:
    if hdu.data is None:
        return np.zeros((0, 0, 0))
    return np.asarray(hdu.data, dtype=np.float64)
