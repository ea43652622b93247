"""Fit of donuts of files, and the check of their orientation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.errors import ConfigError, DomainError, PachonError, ProductError
from .donut_inputs import DonutInputs, StampFiles, donut_inputs
from .donut_options import DEFAULT_TELESCOPE
from .options import wavelength_list

if TYPE_CHECKING:
    import numpy as np

    from ..models.telescope import Telescope
    from ..raytrace.rays import Projection
    from ..sensing.frames import DonutFrames
    from ..sensing.model import DonutModel
    from ..sensing.orientation import OrientationCheck
    from ..sensing.result import DonutFit
    from ..sensing.stamp_headers import HeaderValues
    from ..sensing.wavefront_fits import WavefrontFit
    from .donut_options import FitOptions, FrameOptions, StampOptions, TelescopeOptions

#: Field angle from which on a donut tells its orientation, as a fraction of the telescope's field.
_OFF_AXIS = 0.25
#: Donuts that are enough for a check of orientation wherever they stand.
_SEVERAL = 3


@dataclass(frozen=True)
class DonutWork:
    """Donuts of files, and the model and the unknowns that are fitted to them.

    Attributes
    ----------
    inputs : DonutInputs
        Stamps, fields, defocus.
    frames : DonutFrames
        Angles of the exposure.
    believed : Telescope
        Telescope as it is believed to be, its camera at the angle of the rotator, in focus.
    light : ndarray or None
        Wavelengths [m].
    model : DonutModel
        What the images are made of.
    wavefront : WavefrontFit
        Unknowns of the wavefront.
    sky_variance : list of float or None
        Variance of sky and readout of each stamp [electron^2].
    projection : str
        Meaning of field angles.
    threads : int or None
        Number of threads.
    remark : str
        What the headers gave.
    """

    inputs: DonutInputs
    frames: DonutFrames
    believed: Telescope
    light: np.ndarray | None
    model: DonutModel
    wavefront: WavefrontFit
    sky_variance: list[float] | None
    projection: Projection
    threads: int | None
    remark: str

    @classmethod
    def of(
        cls, telescope: TelescopeOptions, stamps: StampOptions, frame_options: FrameOptions, fit: FitOptions
    ) -> DonutWork:
        """Read the files and the telescope of options."""
        from ..sensing.model import DETECTOR, DonutDetector, DonutModel

        files = StampFiles.read(telescope.files, stamps.positions, stamps.stamp, stamps.mask, stamps.variance)
        header = files.header()
        frames = frame_options.frames(header)
        _require_partners(fit.noll, frames, frame_options)
        believed = frames.telescope(_focused(telescope, header, files.paths[0]))
        inputs = donut_inputs(files, frame_options, frames, believed, stamps.electrons(), telescope.field())
        model = DonutModel(
            air=fit.air(believed, telescope.outer_scale_m),
            detector=DonutDetector(
                telescope.pixel_size(header.pixel, header.camera),
                defocus=inputs.defocus + inputs.heights + 1e-6 * telescope.defocus_um,
                moved=telescope.moved or files.moved() or DETECTOR,
                saturation=fit.saturation,
            ),
            diffraction=fit.diffraction,
        )
        light = _wavelengths(believed, telescope.wavelength_nm, header.wavelength)
        return cls(
            inputs,
            frames,
            believed,
            light,
            model,
            _unknowns(fit, len(inputs.images)),
            _sky_variances(inputs, fit.sky_variance),
            frame_options.field_projection,
            fit.threads,
            _header_remark(files.paths[0], header.text, believed, light),
        )

    @property
    def defocus(self) -> np.ndarray:
        """Distances out of focus [m], shape [n]."""
        return self.model.detector.shifts(len(self.inputs.images))

    def fit(self, progress: Callable[[int], None]) -> DonutFit:
        """Fit all donuts."""
        from ..sensing.fit import fit_donuts

        masks = self.inputs.masks
        return fit_donuts(
            self.believed,
            self.inputs.images,
            self.inputs.fields,
            self.light,
            sky_variance=self.sky_variance,
            model=self.model,
            fit=self.wavefront,
            mask=masks if any(mask.any() for mask in masks) else None,
            projection=self.projection,
            threads=self.threads,
            progress=progress,
        )

    def is_defocused(self, fit: DonutFit) -> bool:
        """Return whether there is a defocus, or a fit of donuts as large as without one."""
        from ..sensing.flags import DonutFlag

        as_expected = fit.usable & (fit.flags & int(DonutFlag.OTHER_SIZE) == 0)
        return bool(as_expected.any() or self.defocus.any())

    def orientation(self, fit: DonutFit) -> OrientationCheck | None:
        """Return the check of the orientation of the stamps, where donuts tell it."""
        from ..sensing.orientation import check_orientation

        which = [int(i) for i in oriented(fit).nonzero()[0]]
        off_axis = (abs(self.inputs.fields[which]) > _OFF_AXIS * self.believed.field_radius).any()
        if not (self.is_defocused(fit) and which and (len(which) >= _SEVERAL or off_axis)):
            return None
        return check_orientation(
            self.believed,
            [self.inputs.images[i] for i in which],
            self.inputs.fields[which],
            self.light,
            sky_variance=None if self.sky_variance is None else [self.sky_variance[i] for i in which],
            model=replace(self.model, detector=replace(self.model.detector, defocus=self.defocus[which])),
            mask=[self.inputs.masks[i] for i in which],
            projection=self.projection,
            threads=self.threads,
        )


def oriented(fit: DonutFit) -> np.ndarray:
    """Return the donuts whose orientation can be checked, bool [n].

    Stamps that are mirrored or turned may fit the other side of focus.
    """
    from ..sensing.flags import DonutFlag

    return fit.usable | (fit.flags & int(DonutFlag.DEFOCUS_SIGN) > 0)


def _focused(options: TelescopeOptions, header: HeaderValues, file: Path) -> Telescope:
    """Return the telescope in focus: of the option, or of the header of a file."""
    from ..core.files import path_beside
    from ..sensing.stamp_headers import TELESCOPE_KEY

    try:
        named = header.model if header.telescope is None else path_beside(file.parent, header.telescope)
        return options.load(named or DEFAULT_TELESCOPE)[1]
    except PachonError as error:
        if options.telescope is not None or header.telescope is None:
            raise
        text = f"{TELESCOPE_KEY} = {header.telescope!r}: {error}; give the telescope by --telescope"
        raise ProductError(text, file=file, key=TELESCOPE_KEY) from None


def _require_partners(noll: Sequence[int], frames: DonutFrames, options: FrameOptions) -> None:
    """Raise ConfigError, before a fit, for a last Zernike whose partner the frame of the results asks for."""
    from ..sensing.frames import zernike_matrix

    try:
        zernike_matrix(noll, frames.axes(options.names[1])[:2, :2])
    except DomainError as error:
        raise ConfigError(f"--zernikes = {noll[-1]}, --frame = {options.frame}: {error}") from None


def _unknowns(options: FitOptions, count: int) -> WavefrontFit:
    """Return the unknowns of the wavefronts of so many donuts."""
    from ..models.parameters.degrees_of_freedom_file import load_degrees_of_freedom
    from ..sensing.exposure_fit import ExposureDonuts
    from ..sensing.freedom_fit import TelescopeFreedoms
    from ..sensing.wavefront_fits import SingleDonuts

    if options.degrees_of_freedom is not None:
        return TelescopeFreedoms(load_degrees_of_freedom(options.degrees_of_freedom), noll=options.noll)
    higher_order = 1e-9 * options.higher_order_nm
    if options.each_alone or count < 2:
        return SingleDonuts(options.noll, higher_order=higher_order)
    return ExposureDonuts(noll=options.noll, higher_order=higher_order)


def _wavelengths(
    telescope: Telescope, wavelengths_nm: list[float] | None, of_header: float | None
) -> np.ndarray | None:
    """Return wavelengths [m]: of the option, or of the header; None for those of the telescope."""
    import numpy as np

    if wavelengths_nm is None and of_header is not None:
        return np.array([of_header])
    return wavelength_list(telescope, wavelengths_nm, None)


def _sky_variances(inputs: DonutInputs, sky_variance: float | None) -> list[float] | None:
    """Return the variance of each stamp [electron^2]: of the option, or of variance planes where all have one."""
    if sky_variance is not None:
        return [sky_variance] * len(inputs.images)
    planes = [variance for variance in inputs.variances if variance is not None]
    return planes if len(planes) == len(inputs.images) else None


def _header_remark(file: Path, text: str, telescope: Telescope, light: np.ndarray | None) -> str:
    """Return what was taken from the header of a file, in a sentence; empty where nothing was."""
    from ..wavefront.request import wavelength_points

    lengths = ", ".join(f"{1e9 * wavelength:.4g}" for wavelength in wavelength_points(telescope, light))
    return f"{file}: {text} of its header; {telescope.name} at {lengths} nm" if text else ""
