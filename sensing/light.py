"""Light of single stars at their detectors: telescope with the detector in place, size of the image, rays."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from ..core.errors import ConfigError, DomainError
from ..models.telescope import Telescope
from ..raytrace.launch import launch_bundles
from ..raytrace.rays import RayStatus
from ..raytrace.spot_parabola import lowest_height, spot_parabola
from ..raytrace.trace import TraceResult, trace
from ..wavefront.chief_rays import image_jacobians
from ..wavefront.psf.light import Light
from ..wavefront.psf.pupil_rims import PIECES, PupilRims, pupil_rims
from ..wavefront.request import relative_weights, wavelength_points
from .donut_rays import ZernikeRays, chief_landing
from .image_model import STRENGTH, ImageGrid
from .likelihood import Stamp
from .model import DonutModel
from .moving_rims import FreeRims, rims_of_other_size
from .pupil_cells import PupilCells
from .response_slope import cells_with_response
from .rim_outlines import concentric
from .seeing import Seeing, StrengthPrior
from .shared_air import SHARED_SPREAD, shared_air
from .stamps import Pixels
from .terms import WavefrontTerms
from .vignetting import MovableRim, cells_with_rims, movable_rims, shift_spread

#: Images wider than this are donuts [pixels].
_SMALLEST_DONUT = 24.0
#: Points across the pupil for the size of an image.
_SURVEY = 48
#: The same for the distance to its focus.
_FEW = 16
#: Cells across the pupil of sharp images over those of :data:`_SPACING` where errors are large, and the error of the
#: photons [m] from which on they are: such cells leave 4 to 8 nm.
_COARSER = 0.7
_LARGE_ERROR = 2e-8
#: Least number of cells across the pupil for the model of an image.
_FEWEST = 48
#: Largest number of cells across the pupil that a model takes by itself: 0.5 million of them.
_MOST = 800
#: Error that 60 cells across the pupil leave in a wavefront [m]; 120 leave 0.9 nm (LSST, 1.5 mm, 0.8").
_CELLS_LEAVE = 2.9e-9
#: FWHM of the blur in pixels below which an image has none.
_BARE = 0.25
#: Error that more cells are taken for in an image without blur [m]: cells of half a pixel leave 1.6 nm.
_BARE_LEAVE = 1e-9
#: The same in one that is blurred and sharper than its pixels resolve: the first cells leave 0.5 nm.
_SHARP_LEAVE = 0.2e-9
#: Error of the photons [m] below which cells of such images become no smaller.
_SHARP_ERROR = 0.5e-9
#: Fraction of the error of the photons that the error by the cells may be.
_SMALL = 0.2
#: Power of the error by which the number of cells goes, from the two figures of :data:`_CELLS_LEAVE`.
_FALL = 0.55
#: Error of the photons [m] below which cells become no smaller.
_LEAST_ERROR = 1.5e-9
#: Spacing of landing points over the FWHM of the blur, which smooths what cells on rims leave.
_SPACING = 0.5
#: FWHM of the blur in pixels beyond which the pixels resolve it.
_RESOLVED = 1.9
#: Shift of a body over the distance of the focus from the detector, by which its effect on the focus is measured.
_PROBE = 1e-2
#: Least motion of the focus over that of a body that counts as one that focuses: a filter's is 0.
_RESPONSE = 0.05
#: FWHM of the blur in binned pixels.
_BINNED = 1.95
#: Most pixels along a binned one.
_MOST_BINNED = 4
#: Least fraction of the pixels in use that binning keeps.
_KEPT = 0.95
#: Pieces of a diffracting rim over the diameter of the donut in pixels, and the least number of them.
_PIECES_A_PIXEL = 1.6
_FEWEST_PIECES = 64
#: Shift of a rim that is free by itself, over that of others.
_HELD = 1e-3
#: Full width at half maximum of a Gaussian over its rms.
_FWHM_PER_RMS = 2.354820045


@dataclass(frozen=True)
class Instrument:
    """Telescope and model of its images, common to all stars of a fit.

    Attributes
    ----------
    telescope : Telescope
        Telescope as it is believed to be.
    model : DonutModel
        What the images are made of.
    terms : WavefrontTerms
        Terms of the wavefront and their priors.
    wavelengths, wavelength_weights : ndarray, shape [n_wave]
        Vacuum wavelengths [m] and fractions of the light.
    pixel : float
        Side of a pixel [m].
    seeing : Seeing
        The long exposure.
    diffusion : float
        Rms of the charge diffusion along each axis [m].
    free_rims : FreeRims
        Rims that are free in the fits of all stars, and where these begin.
    """

    telescope: Telescope
    model: DonutModel
    terms: WavefrontTerms
    wavelengths: np.ndarray
    wavelength_weights: np.ndarray
    pixel: float
    seeing: Seeing
    diffusion: float
    free_rims: FreeRims = field(default_factory=FreeRims)

    @classmethod
    def of(cls, telescope: Telescope, model: DonutModel, terms: WavefrontTerms) -> Instrument:
        """Return the instrument of a model; light that the telescope does not cover is a DomainError."""
        light, detector = model.light or Light(telescope.default_wavelength), model.detector
        detector.body(telescope)
        if light.dispersion is not None:
            raise ConfigError("dispersion of the light: expected none in fits of donuts")
        waves = wavelength_points(telescope, light.wavelengths)
        weights = relative_weights(light.weights, len(waves), "weights")
        seeing = model.air.seeing(float(waves[len(waves) // 2]))
        return cls(telescope, model, terms, waves, weights, detector.pixel(), seeing, detector.blur())

    @property
    def noll(self) -> np.ndarray:
        """Noll indices of all terms of the wavefront."""
        return self.terms.every

    def is_donut(self, light: StarLight) -> bool:
        """Return whether the image of a star is large enough for a donut."""
        return light.diameter > _SMALLEST_DONUT * self.pixel

    @property
    def known_seeing(self) -> bool:
        """Whether the strengths of the turbulence are held."""
        return self.model.air.fwhm is not None

    @property
    def strength_prior(self) -> StrengthPrior | None:
        """Prior of the strengths of the turbulence; None where these are held."""
        return None if self.known_seeing else StrengthPrior(self.seeing.usual_strength)

    def prior(
        self, light: StarLight, unknowns: np.ndarray, wave: np.ndarray, weight: float = 1.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return inverse variances of the priors of a star's unknowns and its wavefront, and deviations from means.

        Those of the wavefront have a factor, the weight of a solution.
        """
        count = len(unknowns)
        precision = np.concatenate([np.zeros(count), weight * self.terms.precision, light.shift_precision])
        deviation = np.concatenate([np.zeros(count), wave])
        deviation[len(deviation) - len(light.shift_mean) :] -= light.shift_mean
        if (of_strength := self.strength_prior) is not None:
            strength = float(unknowns[STRENGTH])
            precision[STRENGTH], deviation[STRENGTH] = of_strength.precision(strength), of_strength.deviation(strength)
        return precision, deviation

    @property
    def shared_air(self) -> float:
        """Part of the variance of the air's mean wavefront that donuts of an exposure share, likely or known."""
        air = self.model.air
        return shared_air(self.telescope, air.layers(self.telescope)) if air.shared is None else float(air.shared)

    @property
    def shared_air_spread(self) -> float:
        """Standard deviation of the logarithm of that part over the other; 0 where it is known."""
        return SHARED_SPREAD if self.model.air.shared is None else 0.0

    @property
    def slope_spreads(self) -> np.ndarray:
        """Standard deviations of the slopes of the response along x and y [1/pixel], if these are unknown."""
        spread = self.model.detector.response_slope
        return np.full(2, spread) if spread else np.zeros(0)

    @property
    def middle(self) -> float:
        """Wavelength in the middle of the list [m]."""
        return float(self.wavelengths[len(self.wavelengths) // 2])

    def light(self, direction: np.ndarray, defocus: float) -> StarLight:
        """Return the light of a star that travels along a direction [3], with a defocus [m] of the body that it moves.

        A chief ray that reaches no CCD, and a dark pupil, are a DomainError.
        """
        return self._through(self._with_detector(direction, defocus), direction)

    def mirrored(self, light: StarLight, *, exact: bool = True) -> StarLight:
        """Return the light with what a defocus moves where the best focus is as far on the detector's other side.

        Diameter, vignetting and rims are those of the light that was given unless they are to be `exact`.
        """
        telescope, detector = light.telescope, light.telescope.surfaces[-1]
        name, axis = self.model.detector.body(telescope)
        if name != detector.name:
            step = _PROBE * light.depth
            depths = [
                self._depth(t, light.direction) for t in (telescope, telescope.perturbed(name, shift=step * axis))
            ]
            response = (depths[1] - depths[0]) / step
            if abs(response) > _RESPONSE:
                moved = telescope.perturbed(name, shift=-2.0 * light.depth / response * axis)
                if not exact:
                    return replace(light, telescope=moved, depth=-light.depth)
                # The unknown shifts of rims stay those of the light that was given.
                return replace(self._through(moved, light.direction), rims=light.rims)
        moved = telescope.perturbed(detector.name, shift=2.0 * light.depth * detector.matrix[:, 2])
        return replace(light, telescope=moved, depth=-light.depth)

    def _through(self, telescope: Telescope, direction: np.ndarray) -> StarLight:
        """Return the light of a star through a telescope with its detector in place."""
        points = _survey(telescope, _SURVEY)
        ends = trace(telescope, launch_bundles(telescope, direction[None], self.middle, points), "all", threads=1)
        place, depth = _landing(telescope, ends[-1])
        jacobian = image_jacobians(telescope, direction[None], self.middle, 1)[0]
        # Light passes up to half a cell beyond the outermost points.
        diameter = 2.0 * float(np.hypot(*place.T).max()) * (1.0 + 1.0 / _SURVEY)
        rims = movable_rims(telescope, points, ends)
        light = StarLight(telescope, direction, diameter, depth, jacobian, rims, slope_spreads=self.slope_spreads)
        light = self.diffracted(light) if self.model.diffraction else light
        if self.free_rims.bodies:
            return light.with_free_rims(self.free_rims, self.middle)
        if not self.model.rims.size:
            return light
        free = rims_of_other_size(telescope, direction, self.middle, _FEWEST, self.model.rims.size)
        return light.with_free_rims(free, self.middle)

    def diffracted(self, light: StarLight) -> StarLight:
        """Return the light with the rims of the pupil at which it is diffracted."""
        pieces = diffracting_pieces(light.diameter / self.pixel)
        return replace(light, pupil_rims=pupil_rims(light.telescope, light.direction, self.middle, pieces))

    def _depth(self, telescope: Telescope, direction: np.ndarray) -> float:
        """Return the distance from the detector to the best focus [m], from few rays."""
        rays = launch_bundles(telescope, direction[None], self.middle, _survey(telescope, _FEW))
        return _landing(telescope, trace(telescope, rays, threads=1))[1]

    def _with_detector(self, direction: np.ndarray, defocus: float) -> Telescope:
        """Return the telescope with a defocus, its detector in the tangent plane of the chief ray's CCD."""
        telescope, height, tilt = self.telescope, defocus, (0.0, 0.0, 0.0)
        if self.model.detector.body(telescope)[0] != telescope.surfaces[-1].name:
            telescope, height = self.model.detector.defocused(telescope, defocus), 0.0
        detector = telescope.surfaces[-1]
        place = chief_landing(telescope, direction, self.middle)
        focal_plane = self.model.detector.focal_plane
        if focal_plane is not None:
            rays = launch_bundles(telescope, direction[None], self.middle, np.zeros((1, 2)))
            chief = trace(telescope, rays, focal_plane=focal_plane, threads=1)
            if chief.ccd is None or chief.ccd[0] < 0:
                raise DomainError("the chief ray lands between the CCDs")
            *on_ccd, rise = detector.to_local(chief.position)[0]
            along_x, along_y = focal_plane.gradient(*on_ccd)
            # The CCD's plane where the chief ray of the unmoved detector lands.
            height += float(rise + (place - on_ccd) @ (along_x, along_y))
            tilt = (float(along_y), -float(along_x), 0.0)
        if height == 0.0 and not any(tilt):
            return telescope
        about = np.asarray(detector.vertex) + detector.matrix @ [*place, 0.0]
        return telescope.perturbed(detector.name, shift=height * detector.matrix[:, 2], tilt=tilt, about=about)

    def sampling(self, light: StarLight, pixels: Pixels, fwhm: float, error: float = math.inf) -> Sampling:
        """Return how finely images of a star in a seeing [rad] are sampled on given pixels.

        A wavefront known to an error [m] that the cells would add to has more of them.
        """
        width = self._width(light, pixels, fwhm)
        distance = pixels.side * self.pixel
        spacing = _SPACING * (math.hypot(width, distance) if width < _RESOLVED * distance else width)
        sharp = width < _RESOLVED * distance
        leave, least = _CELLS_LEAVE, _LEAST_ERROR
        if sharp:
            leave, least = _BARE_LEAVE if width < _BARE * distance else _SHARP_LEAVE, _SHARP_ERROR
        finer = max((leave / (_SMALL * max(error, least))) ** _FALL, 1.0)
        if sharp and _LARGE_ERROR < error < math.inf:
            finer = _COARSER
        across = self.model.n_pupil or min(max(math.ceil(finer * light.diameter / spacing), _FEWEST), _MOST)
        return Sampling(sharp, across)

    def may_merge(self, light: StarLight, pixels: Pixels, rays: ZernikeRays) -> bool:
        """Return whether smoothed pixels blur images so much that larger cells of the pupil are fine enough."""
        cell = math.sqrt(abs(float(np.linalg.det(rays.footprint))))
        return pixels.blur > 0.0 and 2.0 * cell < _SPACING * self._width(light, pixels, 0.0)

    def binning(self, light: StarLight, pixels: Pixels, fwhm: float) -> int:
        """Return how many pixels along each axis are summed for the fit of a star in a seeing [rad].

        Pixels of half the width of the blur leave the errors as they are to a hundredth.
        """
        largest = min(int(self._width(light, pixels, fwhm) / (_BINNED * self.pixel)), _MOST_BINNED)
        if pixels.used.all():
            return max(largest, 1)
        used = int(pixels.used.sum())
        for side in range(max(largest, 1), 1, -1):
            if side**2 * int(pixels.binned(side).used.sum()) > _KEPT * used:
                return side
        return 1

    def _width(self, light: StarLight, pixels: Pixels, fwhm: float) -> float:
        """Return the FWHM of what blurs the images of a star in a seeing [rad], before the pixels [m]."""
        rms = math.hypot(self.diffusion, pixels.blur * self.pixel)
        return math.hypot(fwhm * light.scale, _FWHM_PER_RMS * rms)

    def rays(self, light: StarLight, across: int) -> ZernikeRays:
        """Return the light of a star through so many cells across the pupil."""
        cells = cells_with_rims(light.telescope, light.direction, self.middle, across, light.rims, light.free_rims)
        return self.rays_of(light, self.with_response(light, light.telescope, cells))

    def with_response(self, light: StarLight, telescope: Telescope, cells: PupilCells) -> PupilCells:
        """Return the cells of a star's light through a telescope with slopes of the response, if these are unknown."""
        if not len(light.slope_spreads):
            return cells
        return cells_with_response(telescope, light.direction, self.middle, cells, self.pixel, 2 * len(light.rims))

    def rays_of(self, light: StarLight, cells: PupilCells) -> ZernikeRays:
        """Return the light of a star through given cells of the pupil."""
        return ZernikeRays(
            light.telescope, light.direction, self.wavelengths, self.wavelength_weights, cells, self.noll
        )

    def stamp(self, light: StarLight, pixels: Pixels, rays: ZernikeRays, sharp: bool, reach: float = 0.0) -> Stamp:
        """Return a stamp with its model: light within a reach [m] beside it does not wrap around."""
        blur = math.hypot(self.diffusion, pixels.blur * self.pixel)
        grid = ImageGrid(
            pixels, self.pixel, self.seeing, light.jacobian, blur, rays.footprint, sharp, reach, light.pupil_rims
        )
        return Stamp(pixels.image, pixels.variance, pixels.used, grid, rays)


def diffracting_pieces(pixels: float) -> int:
    """Return into how many pieces the diffracting rims of a donut of so many pixels across are divided."""
    return min(max(math.ceil(_PIECES_A_PIXEL * pixels), _FEWEST_PIECES), PIECES)


def _survey(telescope: Telescope, across: int) -> np.ndarray:
    """Return points of a square about the pupil [m], shape [across**2, 2]."""
    along = (np.arange(across) - 0.5 * (across - 1)) * telescope.pupil_diameter / across
    return np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)


def _landing(telescope: Telescope, end: TraceResult) -> tuple[np.ndarray, float]:
    """Return landing points of lit rays from their mean [m], and the distance from there to the best focus [m]."""
    detector, lit = telescope.surfaces[-1], end.status == RayStatus.OK
    if not lit.any():
        raise DomainError("no light passes the telescope")
    place, travel = detector.to_local(end.position[lit])[:, :2], detector.along(end.direction[lit])
    parabola = spot_parabola(place, travel[:, :2] / travel[:, 2:], np.ones(len(place)))
    # A single ray has no focus.
    return place - place.mean(axis=0), float(np.nan_to_num(lowest_height(parabola)))


@dataclass(frozen=True)
class Sampling:
    """Whether the image is sharper than its pixels resolve, and cells of the pupil across its diameter."""

    sharp: bool
    across: int

    def finer_than(self, other: Sampling) -> bool:
        """Return whether this one has more detail of the image or of the pupil."""
        return self.sharp > other.sharp or self.across > other.across


@dataclass(frozen=True)
class StarLight:
    """Light of one star at its detector.

    Attributes
    ----------
    telescope : Telescope
        Telescope with the detector where the light meets it.
    direction : ndarray, shape [3]
        Unit vector along which the light travels.
    diameter : float
        Diameter of the geometric image [m].
    depth : float
        Distance from the detector to the best focus along the detector's z [m].
    jacobian : ndarray, shape [2, 2]
        Derivative of the chief ray's landing point by direction cosines [m].
    rims : tuple of MovableRim
        Rims that stand aside by an unknown amount.
    pupil_rims : PupilRims or None
        Rims of the clear pupil, where they diffract.
    free_rims : FreeRims
        Rims that are free beside these, and where the telescope has them.
    prescribed : Telescope or None
        The telescope with these where the prescription has them; None where none is free.
    slope_spreads : ndarray, shape [0] or [2]
        Standard deviations of the slopes of the response along x and y [1/pixel], if these are unknown.
    """

    telescope: Telescope
    direction: np.ndarray
    diameter: float
    depth: float
    jacobian: np.ndarray
    rims: tuple[MovableRim, ...]
    pupil_rims: PupilRims | None = None
    free_rims: FreeRims = field(default_factory=FreeRims)
    prescribed: Telescope | None = None
    slope_spreads: np.ndarray = field(default_factory=lambda: np.zeros(0))

    @property
    def before_free_rims(self) -> int:
        """Number of unknowns of the light before the motions of free rims: shifts of others, slopes of the response."""
        return 2 * len(self.rims) + len(self.slope_spreads)

    @property
    def shift_precision(self) -> np.ndarray:
        """Inverse variances of shifts of rims, slopes of the response and motions of free rims, shape [n_shift]."""
        names = self.free_rims.surfaces(self.telescope)
        # A rim that is free by itself has no further shift.
        spreads = [shift_spread(self.telescope) * (_HELD if rim.name in names else 1.0) for rim in self.rims]
        shifts = np.repeat(spreads, 2) ** -2.0
        return np.concatenate([shifts, self.slope_spreads**-2.0, self.free_rims.spreads**-2.0])

    @property
    def shift_mean(self) -> np.ndarray:
        """Means of the priors of the shifts, from where the telescope has the rims, shape [n_shift]."""
        return np.concatenate([np.zeros(self.before_free_rims), self.free_rims.means])

    @property
    def shift_limit(self) -> np.ndarray:
        """Largest distances of the shifts from these means, shape [n_shift]: sizes are within what is said of them."""
        return np.concatenate([np.full(self.before_free_rims, np.inf), self.free_rims.limits])

    def with_free_rims(self, rims: FreeRims, wavelength: float) -> StarLight:
        """Return the light of the telescope with rims where these stand; its middle wavelength [m]."""
        prescribed = self.prescribed or self.telescope
        telescope = rims.applied(prescribed)
        diffracting = self.pupil_rims
        if diffracting is not None:
            # Rings alone diffract: a hole that stands aside does so about the centre, a part of a pixel away.
            rings = tuple(replace(s, aperture=concentric(s.aperture)) for s in telescope.surfaces)
            outlines = replace(telescope, surfaces=rings)
            diffracting = pupil_rims(outlines, self.direction, wavelength, diffracting.pieces)
        return replace(self, telescope=telescope, pupil_rims=diffracting, free_rims=rims, prescribed=prescribed)

    @property
    def scale(self) -> float:
        """Distance on the detector over angle on the sky [m]."""
        return math.sqrt(abs(float(np.linalg.det(self.jacobian))))
