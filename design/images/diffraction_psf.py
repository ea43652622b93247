"""Diffraction images of several field points, their sizes and their plot."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from scipy.ndimage import zoom

from ...core.plotting import figure_at, round_length, styled
from ...core.units import arcseconds
from .. import drawing
from ..result import FieldResult

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

#: Interpolated samples across the bright part of an image, on which widths are measured.
_SAMPLES = 512
#: Irradiance over that of the peak down to which an image is interpolated; the peak may be between pixels.
_BRIGHT = 0.3
#: Pixels beyond the bright ones, for the splines.
_RIM = 8
#: Width [pixels] below which that of an image of coarse pixels is not known.
_NARROW = 2.5
#: Coarse pixels over wavelength times focal ratio.
_COARSE = 0.75
#: Decades below the brightest pixel that the plot shows.
_DECADES = 4.0
#: Images whose cuts are drawn.
_CUTS = 5


#: Fourier sum over a lattice of cosines, or sum of Huygens' wavelets.
DiffractionMethod = Literal["fft", "huygens"]


@dataclass(frozen=True)
class DiffractionPsf(FieldResult):
    """Diffraction images of several field points, all wavelengths together.

    Attributes
    ----------
    method : {"fft", "huygens"}
        Fourier sum or Huygens' wavelets.
    image : ndarray, shape [n_field, ny, nx]
        Fraction of the light of the image on each pixel, sampled at its centre or, where pixels are larger than
        wavelength times focal ratio, at several places; [y, x], y up. The sum is less than 1 by the light outside.
    pixel : float
        Distance of pixel centres [m].
    reference_point : ndarray, shape [n_field, 2]
        Middle of the images on the detector [m].
    lit_fraction : ndarray, shape [n_field]
        Fraction of the entrance pupil that is lit, mean over the wavelengths.
    strehl : ndarray, shape [n_field]
        Peak of the image over that of the same light with perfect wavefronts.
    airy_radius : ndarray, shape [n_field]
        Radius of the first dark ring of a clear circular pupil, 1.22 wavelengths times the focal ratio [m].
    plate_scale : ndarray, shape [n_field]
        Angle on the sky over length on the detector [rad/m].
    n_pupil : int
        Points across the pupil.
    """

    _table = (
        "fields",
        "strehl",
        "fwhm",
        "rms_radius",
        "airy_radius",
        "inside",
        "lit_fraction",
        "centroid",
        "reference_point",
        "plate_scale",
    )
    _images = ("image",)
    _on_image = ("fwhm", "rms_radius", "airy_radius", "centroid", "reference_point", "plate_scale", "pixel", "axis")

    method: DiffractionMethod
    image: np.ndarray
    pixel: float
    reference_point: np.ndarray
    lit_fraction: np.ndarray
    strehl: np.ndarray
    airy_radius: np.ndarray
    plate_scale: np.ndarray
    n_pupil: int

    @property
    def axis(self) -> np.ndarray:
        """Coordinates of pixel centres along either axis from the middle of the image [m]."""
        return pixel_axis(self.pixel, self.image.shape[-1])

    @property
    def inside(self) -> np.ndarray:
        """Fraction of the light within each image, shape [n_field]."""
        return self.image.sum(axis=(1, 2))

    @property
    def centroid(self) -> np.ndarray:
        """Centroid of each image relative to its middle [m], x and y, shape [n_field, 2]."""
        x, y = self.image.sum(axis=1) @ self.axis, self.image.sum(axis=2) @ self.axis
        return np.stack([x, y], axis=-1) / self.inside[:, None]

    @property
    def rms_radius(self) -> np.ndarray:
        """Root mean square distance of the light within each image from its centroid [m], shape [n_field].

        It grows with the size of the image, as the wings fall off with the cube of the distance.
        """
        square = np.add.outer(self.axis**2, self.axis**2)
        mean = np.einsum("fyx,yx->f", self.image, square) / self.inside
        return np.sqrt(mean - (self.centroid**2).sum(axis=1))

    @property
    def undersampled(self) -> np.ndarray:
        """Whether pixels are larger than half of wavelength times focal ratio, shape [n_field] bool."""
        return self.pixel > self.airy_radius / 2.44

    @property
    def fwhm(self) -> np.ndarray:
        """Diameter of a disc with the area above half the peak of each image [m], shape [n_field].

        NaN of an image narrower than two and a half pixels of more than three quarters of wavelength times focal ratio.
        """
        width = np.array([_width(image) for image in self.image])
        coarse = self.pixel > _COARSE * self.airy_radius / 1.22
        return self.pixel * np.where(coarse & (width < _NARROW), np.nan, width)

    def _summary(self) -> dict[str, Any]:
        """Return the results by name and unit; lists run over the fields."""
        arcsec, fwhm = arcseconds(self.plate_scale), self.fwhm
        return {
            "telescope": self.telescope,
            "method": self.method,
            "wavelength_nm": self.wavelengths * 1e9,
            "pupil_points": self.n_pupil,
            **self.on_image({"pixel_um": self.pixel * 1e6}),
            "pixels": self.image.shape[-1],
            **self.field_items(),
            **self.on_image({"reference_mm": self.reference_point * 1e3}),
            "strehl": self.strehl,
            **self.on_image({"fwhm_um": fwhm * 1e6}),
            **self.of_sky({"fwhm_arcsec": fwhm * arcsec}),
            **self.on_image({"centroid_um": self.centroid * 1e6, "airy_radius_um": self.airy_radius * 1e6}),
            **self.of_sky({"airy_radius_arcsec": self.airy_radius * arcsec}),
            "light_inside": self.inside,
            "lit_fraction": self.lit_fraction,
            **self.on_image(self.of_sky({"plate_scale_arcsec_per_um": arcsec * 1e-6})),
        }

    def plot(self, ax: Axes | Figure | None = None) -> Figure:
        """Draw each image on a logarithmic scale, and cuts through the first ones."""
        rows, columns = drawing.grid_shape(len(self.fields))
        with styled():
            figure = figure_at(ax, max(2.3 * columns + 0.9, 6.4), 2.95 * rows + 2.9)
            parts: Any = figure.subfigures(2, 1, height_ratios=[2.8 * rows + 0.4, 2.6])
            above, below = parts
            panels = drawing.panels_of(above, len(self.fields), rows, columns)
            image: Any = None
            for i, (axes, fwhm) in enumerate(zip(panels, self.fwhm, strict=True)):
                image = _draw_image(axes, self, i, float(fwhm))
            half = 0.5e6 * self.pixel * self.image.shape[-1]
            bar = round_length(0.6 * half)
            drawing.draw_scale_bar(panels[0], bar, self.size_text(bar * 1e-6, float(self.plate_scale[0])))
            bar_and_label: Any = (*panels[0].lines, *panels[0].texts)
            for artist in bar_and_label:
                artist.set_color("white")
            key = above.colorbar(image, ax=above.axes, shrink=0.85, pad=0.015, aspect=30)
            key.set_label("light over that of\nthe brightest pixel")
            way = "Fourier sum" if self.method == "fft" else "Huygens' wavelets"
            _draw_cuts(below.subplots(1, 2, sharey=True), self)
            return self._titled(figure, f"diffraction images, {self._nanometres()} ({way})")


def pixel_axis(pixel: float, pixels: int) -> np.ndarray:
    """Return coordinates of pixel centres from the middle of the image [m], shape [pixels]."""
    # The reference point lies on the middle pixel, as on the stamps of the PSF engines.
    return (np.arange(pixels) - pixels // 2) * pixel


def _width(image: np.ndarray) -> float:
    """Return the diameter of a disc with the area above half the peak of an image [pixel]."""
    bright = image > _BRIGHT * image.max()
    bright_image = image[_range_of(bright.any(axis=1)), _range_of(bright.any(axis=0))]
    factor = max(1, -(-_SAMPLES // max(bright_image.shape)))
    finer = zoom(bright_image, factor, order=5, mode="mirror")
    # The first and the last samples are pixel centres.
    area = (bright_image.shape[0] - 1) / (finer.shape[0] - 1) * (bright_image.shape[1] - 1) / (finer.shape[1] - 1)
    return float(2.0 * np.sqrt((finer > 0.5 * finer.max()).sum() * area / np.pi))


def _range_of(bright: np.ndarray) -> slice:
    """Return the rows or columns from the first to the last bright one, with the pixels beyond."""
    places = np.flatnonzero(bright)
    return slice(max(int(places[0]) - _RIM, 0), int(places[-1]) + _RIM + 1)


def _draw_image(axes: Axes, psf: DiffractionPsf, i: int, fwhm: float) -> AxesImage:
    from matplotlib.colors import LogNorm

    image = psf.image[i] / psf.image[i].max()
    low, high = (psf.axis[k] * 1e6 + s * 0.5e6 * psf.pixel for k, s in ((0, -1.0), (-1, 1.0)))
    shown = axes.imshow(
        np.maximum(image, 10.0**-_DECADES),
        extent=(low, high, low, high),
        cmap="inferno",
        norm=LogNorm(10.0**-_DECADES, 1.0),
    )
    drawing.draw_circle(axes, psf.airy_radius[i] * 1e6, color="white", style=(0, (3, 2)))
    axes.set(xticks=[], yticks=[])
    axes.set_title(psf.field_labels()[i], fontsize=9.5)
    lit = "" if psf.lit_fraction[i] > 0.995 else f"lit {100 * psf.lit_fraction[i]:.1f} % of the pupil"
    width = psf.size_text(fwhm, float(psf.plate_scale[i])) if np.isfinite(fwhm) else "within some pixels"
    axes.set_xlabel(
        f"Strehl {psf.strehl[i]:.3g}\nFWHM {width}\n{lit}",
        fontsize=7.5,
    )
    return shown


def _draw_cuts(panels: Any, psf: DiffractionPsf) -> None:
    colors = drawing.field_colors(min(len(psf.fields), _CUTS))
    for axes, name in zip(panels, "xy", strict=True):
        for i, color in enumerate(colors):
            density = psf.image[i] / psf.pixel**2 * 1e-12
            row, column = np.unravel_index(int(np.argmax(density)), density.shape)
            cut = density[row] if name == "x" else density[:, column]
            axes.plot(psf.axis * 1e6, cut, color=color, linewidth=1.2, label=psf.field_labels()[i])
        label = psf.image_text(f"{name} from the middle of the image [µm]")
        drawing.finish_axes(axes, xlabel=label, xlim=(psf.axis[0] * 1e6, psf.axis[-1] * 1e6), ylim=(0.0, None))
    panels[0].set_ylabel(psf.image_text("part of the light per µm²\n(through the brightest pixel)"))
    panels[1].legend(loc="upper right")
