"""A file of simulated donuts with their true wavefronts, as ``pachon donuts`` reads it.

The file has a cube of stamps [electrons, sky subtracted] and the table DONUTS, one row a stamp: field angles, defocus
and what it moves, electrons, and Z4 to Z22 of the wavefront beyond the telescope as it is believed to be.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from astropy.io import fits
from astropy.table import Table
from pydantic import Field

from ...core.errors import ConfigError
from ...core.products import card_text, card_value, write_hdus
from ...core.random_streams import stream
from ...core.schema import Count, NotNegative, Positive, Section, Whole
from ...core.set_keys import with_set_keys
from ...core.units import ARCSEC, radians
from ...design.metrics.field_zernikes import wavefront_zernikes
from ...models.camera.photometry import READ_NOISE
from ...models.parameters.parameters import Parameter, apply
from ...models.telescope import Telescope
from ...sensing.model import DonutModel
from ...sensing.stamp_headers import PIXEL_KEY, TELESCOPE_KEY, WAVELENGTH_KEY
from ...wavefront.corner_stars import corner_stars
from ...wavefront.psf.stamps import Stamps
from ...wavefront.pupil_optics import trace_pupils
from ...wavefront.request import wavelength_points
from .donuts import STAMP_SIZE, draw_donuts

#: Noll indices of the true wavefront.
_NOLL = np.arange(4, 23)
#: Fraction of the radius of the field within which stars stand at random: donuts beyond lose light to rims.
_WITHIN = 0.95
#: Points of the pupil's rim whose light bounds a donut, and room beside it, in FWHM of the seeing.
_RIM_POINTS = 16
_RINGS = (0.6, 0.7, 0.8, 0.9, 1.0)
_WINGS = 1.5


class DonutScene(Section):
    """Stars of a simulated file, the air before them and their noise."""

    stars: Count = Field(6, description="number of stars, at random within 0.95 of the field's radius")
    layout: Literal["random", "corners"] = Field(
        "random",
        description="random, or corners: a star on each of the LSST's eight wavefront sensors, at their heights",
    )
    sides: Annotated[int, Field(strict=True, ge=1, le=2)] = Field(
        1, description="1, or 2: each star is exposed behind and in front of focus"
    )
    seeing_arcsec: Positive = Field(0.8, description="FWHM of the long exposure [arcsec]")
    electrons: Positive = Field(2e6, description="electrons of each star")
    sky: NotNegative = Field(300.0, description="expected electrons of the sky in a pixel, which are subtracted")
    read_noise: NotNegative = Field(READ_NOISE, description="rms noise without light [electrons]")
    stamp: Annotated[int, Field(strict=True, ge=31, le=2001)] | None = Field(
        None, description="side of a stamp [pixels]; by default 181, or what the donuts and their seeing need"
    )
    seed: Whole = Field(1, description="seed of places and noise")

    @classmethod
    def of(cls, settings: Sequence[str]) -> DonutScene:
        """Return the scene of texts such as ``stars=8``; ConfigError for one that is malformed."""
        return with_set_keys(cls(), settings)


@dataclass(frozen=True, eq=False)
class SimulatedDonuts:
    """Donuts of a telescope that is not the one believed in.

    Attributes
    ----------
    images : ndarray, shape [n, ny, nx]
        Electrons, sky subtracted.
    fields : ndarray, shape [n, 2]
        Field angles [rad].
    defocus : ndarray, shape [n]
        Shift of the body that moves [m].
    zernikes : ndarray, shape [n, 19]
        Z4 to Z22 beyond the telescope that is believed in [m].
    wavelength : float
        Mean wavelength [m].
    """

    images: np.ndarray
    fields: np.ndarray
    defocus: np.ndarray
    zernikes: np.ndarray
    wavelength: float


def changed_telescope(telescope: Telescope, changes: Sequence[str]) -> Telescope:
    """Return a telescope with changes such as ``M2.dx=200um`` or ``Camera.rx=5arcsec``.

    Raises
    ------
    ConfigError, UnknownNameError
        If a text is no change of a parameter of the telescope, or its unit is another one's.
    """
    from astropy import units as u

    values: dict[Parameter, float] = {}
    for text in changes:
        address, equals, size = text.partition("=")
        if not equals:
            raise ConfigError(f"--perturb = {text!r}: expected a parameter and its change, such as M2.dx=200um")
        parameter = Parameter.parse(address.strip(), telescope)
        try:
            change = float(u.Quantity(size.strip()).to_value(u.Unit(parameter.unit or "")))
        except (TypeError, ValueError, u.UnitConversionError):
            raise ConfigError(
                f"--perturb = {text!r}: expected a size in {parameter.unit or 'pure numbers'}, as 200um or 5arcsec"
            ) from None
        values[parameter] = values.get(parameter, 0.0) + change
    return apply(telescope, values)


def simulate_donuts(
    telescope: Telescope, true: Telescope, scene: DonutScene, model: DonutModel, field: np.ndarray | None = None
) -> SimulatedDonuts:
    """Expose the stars of a scene.

    Parameters
    ----------
    telescope, true : Telescope
        Telescope as it is believed to be and as it is, both in focus.
    scene : DonutScene
        The stars.
    model : DonutModel
        Light, pixels, one defocus and the body that it moves; the seeing is that of the scene.
    field : ndarray, shape [2], optional
        Field angles of all stars [rad]; by the layout of the scene otherwise.

    Raises
    ------
    ConfigError
        If nothing is out of focus, or the layout is not for the telescope, or excludes stars that are given.
    """
    shift = float(np.reshape(model.detector.shifts(1), ()))
    model = replace(model, air=replace(model.air, fwhm=scene.seeing_arcsec * ARCSEC))
    if scene.layout == "corners":
        _check_corners(telescope, scene, field)
        corners = corner_stars(telescope)
        fields, defocus = corners.fields, corners.heights + shift
    else:
        if not shift:
            raise ConfigError("--defocus-um = 0: expected a shift that makes donuts, such as 1500 for the LSST")
        fields = _random_fields(telescope, scene) if field is None else np.tile(field, (scene.stars, 1))
        defocus = np.full(len(fields), shift)
        if scene.sides == 2:
            fields, defocus = np.tile(fields, (2, 1)), np.concatenate([defocus, -defocus])
    furthest = model.detector.defocused(telescope, float(defocus[np.argmax(np.abs(defocus))]))
    size = scene.stamp or _stamp_size(furthest, fields, model)
    images = np.empty((len(fields), size, size), dtype=np.float32)
    for k, height in enumerate(np.unique(defocus)):
        rows = np.flatnonzero(defocus == height)
        images[rows] = draw_donuts(
            true,
            fields[rows],
            model=replace(model, detector=replace(model.detector, defocus=height)),
            electrons=scene.electrons,
            sky=scene.sky,
            read_noise=scene.read_noise,
            seed=int(stream(scene.seed, "donut file", k).integers(2**31)),
            stamps=Stamps(size),
        ).images
    waves = wavelength_points(telescope, None if model.light is None else model.light.wavelengths)
    middle, last = float(waves[len(waves) // 2]), int(_NOLL[-1])
    before = wavefront_zernikes(telescope, fields, middle, jmax=last)
    after = wavefront_zernikes(true, fields, middle, jmax=last, pupil=before.pupil)
    zernikes = (after.coefficients - before.coefficients)[:, _NOLL - 1]
    return SimulatedDonuts(images, fields, defocus, zernikes, float(waves.mean()))


def _check_corners(telescope: Telescope, scene: DonutScene, field: np.ndarray | None) -> None:
    """Raise ConfigError for another camera than the LSST's, and for stars that its wavefront sensors do not have.

    Each sensor has one star on one side of focus.
    """
    if telescope.camera not in (None, "lsst"):
        raise ConfigError(
            f"layout = corners: {telescope.name} has the camera {telescope.camera}; expected the LSST's, or random",
            key="layout",
        )
    for key in ("stars", "sides"):
        if getattr(scene, key) != getattr(DonutScene(), key):
            text = f"{key} = {getattr(scene, key)}: expected none with layout = corners, a star on each sensor"
            raise ConfigError(text, key=key)
    if field is not None:
        raise ConfigError("layout = corners: expected no field of all stars, they stand on the sensors", key="layout")


def _stamp_size(telescope: Telescope, fields: np.ndarray, model: DonutModel) -> int:
    """Return a side of stamps that holds donuts at fields, and the wings of their seeing [pixels]."""
    angle = 2.0 * np.pi * np.arange(_RIM_POINTS) / _RIM_POINTS
    rim = 0.5 * telescope.pupil_diameter * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    rings = np.multiply.outer(_RINGS, rim).reshape(-1, 2)
    optics = trace_pupils(telescope, fields, telescope.default_wavelength, rings)
    seeing = float(np.max(radians(model.air.fwhm, "fwhm"))) * float(np.abs(optics.jacobian).max())
    # Rays that apertures stop may land far off.
    landed = np.abs(optics.displacement).max(axis=-1, where=optics.lit[..., None], initial=0.0)
    reach = float(landed.max(initial=0.0)) + _WINGS * seeing
    return max(STAMP_SIZE, 2 * int(np.ceil(reach / model.detector.pixel())) + 1)


def write_donuts(path: Path, donuts: SimulatedDonuts, scene: DonutScene, model: DonutModel, telescope: str) -> None:
    """Write simulated donuts of a telescope as a FITS file that ``pachon donuts`` reads."""
    columns: dict[str, tuple[np.ndarray | list[str], str, str]] = {
        "field_x": (np.rad2deg(donuts.fields[:, 0]), "deg", "field angle along x"),
        "field_y": (np.rad2deg(donuts.fields[:, 1]), "deg", "field angle along y"),
        "defocus_um": (1e6 * donuts.defocus, "um", "shift along z of what moved"),
        "moved": ([card_text(model.detector.moved)] * len(donuts.fields), "", "what the defocus moved"),
    }
    for j, values in zip(_NOLL, donuts.zernikes.T, strict=True):
        columns[f"true_Z{j}"] = (1e9 * values, "nm", "true wavefront beyond the telescope believed in")
    table = Table({name: values for name, (values, _, _) in columns.items()})
    for name, (_, unit, meaning) in columns.items():
        table[name].unit, table[name].description = unit or None, meaning
    cube = fits.PrimaryHDU(donuts.images)
    cards: Mapping[str, tuple[object, str]] = {
        "BUNIT": ("electron", "sky subtracted"),
        TELESCOPE_KEY: (telescope, "telescope that is believed in"),
        WAVELENGTH_KEY: (round(1e9 * donuts.wavelength, 6), "mean wavelength [nm]"),
        "MOVED": (model.detector.moved, "what the defocus moved"),
        PIXEL_KEY: (round(1e6 * model.detector.pixel(), 9), "side of a pixel [um]"),
        "SKYVAR": (scene.sky + scene.read_noise**2, "variance of sky and readout [electron^2]"),
        "SEEING": (scene.seeing_arcsec, "FWHM of the long exposure [arcsec]"),
        "SEED": (scene.seed, "seed of all random numbers"),
    }
    for key, (content, comment) in cards.items():
        value = card_value(content)
        # A card has 80 characters: a path may leave none for a comment.
        room = 80 - len("KEYWORD = ' ' / ") - len(str(value))
        cube.header[key] = (value, comment) if len(comment) <= room else value
    unit = fits.BinTableHDU(table, name="DONUTS")
    write_hdus(path, fits.HDUList([cube, unit]))


def _random_fields(telescope: Telescope, scene: DonutScene) -> np.ndarray:
    """Return field angles evenly over a disc [rad], shape [n, 2]; more stars leave the first as they are."""
    radius, turn = stream(scene.seed, "donut file", "fields").random((scene.stars, 2)).T
    distance, angle = _WITHIN * telescope.field_radius * np.sqrt(radius), 2.0 * np.pi * turn
    return np.stack([distance * np.cos(angle), distance * np.sin(angle)], axis=-1)
