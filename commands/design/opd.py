"""The command ``pachon opd``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Option

from ..options import degrees_pair
from ..tables import Column
from .command import Outcome, SharedOptions, design_command
from .metrics import term_labels

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ...models.telescope import Telescope
    from ...wavefront.opd import OpdMap
    from ...wavefront.zernike import ZernikeFit


@dataclass(frozen=True)
class FittedOpd:
    """An OPD map and its Zernike terms."""

    telescope: Telescope
    field_deg: tuple[float, float]
    opd: OpdMap
    fit: ZernikeFit

    def summary(self) -> dict[str, Any]:
        """Return the metrics by name, units in the names."""
        import numpy as np

        opd, fit, telescope = self.opd, self.fit, self.telescope
        radius_squared = (opd.x**2 + opd.y**2) / (0.5 * telescope.pupil_diameter) ** 2
        annulus = (radius_squared <= 1.0) & (radius_squared >= telescope.pupil_obscuration**2)
        return {
            "model": telescope.name,
            "field_deg": list(self.field_deg),
            "wavelength_nm": opd.wavelength * 1e9,
            "rms_nm": opd.rms * 1e9,
            "rms_waves": opd.rms / opd.wavelength,
            "peak_to_valley_nm": opd.peak_to_valley * 1e9,
            "rms_without_tilt_nm": float(np.nanstd(opd.without_tilt)) * 1e9,
            "lit_fraction": float(opd.lit.sum() / int(annulus.sum())),
            "reference_sphere_m": {"center": opd.center, "radius": opd.radius},
            "obscuration": fit.obscuration,
            "zernike_nm": fit.coefficients * 1e9,
            "residual_rms_nm": fit.residual_rms * 1e9,
        }

    def write(self, path: str | Path) -> None:
        """Write the Zernike terms as a table with units."""
        self.fit.write(path)

    def plot(self) -> Figure:
        """Draw the map and the terms."""
        return self.opd.plot(self.fit, self.telescope.name)


@design_command(
    Column("Noll term", lambda result: term_labels(len(result.fit.coefficients))),
    Column("[nm]", "zernike_nm", ".3f"),
    Column("[waves]", lambda result: result.fit.coefficients / result.opd.wavelength, ".5f"),
    caption=lambda s: (
        f"{s['model']} at field ({s['field_deg'][0]:g}, {s['field_deg'][1]:g}) deg, {s['wavelength_nm']:g} nm: peak to "
        f"valley {s['peak_to_valley_nm']:.1f} nm; rms without tilt {s['rms_without_tilt_nm']:.2f} nm; rms residual of "
        f"the terms {s['residual_rms_nm']:.3f} nm."
    ),
    verdict="The wavefront has {rms_nm:.2f} nm rms, {rms_waves:.4f} waves.",
)
def opd(
    shared: SharedOptions,
    field_deg: Annotated[
        str | None,
        Option(
            metavar="X,Y | R",
            help="Field angle [deg], or a distance from the axis along +y; "
            "by default the first of the file, or the axis.",
        ),
    ] = None,
    grid: Annotated[int, Option(min=8, max=4096, help="Points across the pupil.")] = 256,
    zernikes: Annotated[int, Option(min=4, max=500, help="Highest Noll index to fit.")] = 28,
) -> Outcome:
    """Draw and save the optical path difference of a telescope at one field point, with its Zernike terms.

    Path of the chief ray minus path of each ray, to a sphere about where the chief ray meets the detector.

    **Examples**

    - `pachon opd lsst_v3.3_r --field-deg 0,1.225 --wavelength-nm 622`
    - `pachon opd paul_baker --field-deg 0.3,0.3 --zernikes 11 --picture coma.png`
    - `pachon opd my_telescope.yaml --json`: metrics only, on standard output
    """
    import numpy as np

    from ...wavefront.opd import wavefront_opd
    from ...wavefront.request import field_points
    from ...wavefront.zernike import fit_zernikes

    telescope = shared.telescope
    if field_deg is None:
        x, y = np.rad2deg(field_points(telescope, projection=shared.projection)[0]).tolist()
    else:
        x, y = degrees_pair(field_deg, "--field-deg")
    wavelength = telescope.default_wavelength if shared.wavelength is None else shared.wavelength
    wavefront = wavefront_opd(telescope, tuple(np.deg2rad([x, y])), wavelength, grid=grid, **shared.trace_options)
    fit = fit_zernikes(wavefront, 0.5 * telescope.pupil_diameter, telescope.pupil_obscuration, zernikes)
    stem = f"opd_{shared.stem}_{x:g}_{y:g}_{wavefront.wavelength * 1e9:g}nm"
    return Outcome(FittedOpd(telescope, (x, y), wavefront, fit), stem=stem)
