"""Files that Piff writes, and what it draws from them.

The bundled ones are made by ``python tests/peers/piff_files.py tests/data/piff``.

Stars are small so that files are: 16 a chip, stamps and grids of a few pixels. Each file of a name has beside it
``NAME.fits`` with the images that Piff draws from what it has read back, at places and properties in the table.
"""

import sys
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.table import Table

SIZE = 11
#: Places [pixel], some away from the stars' places, and colours.
PLACES = np.array([[200.3, 180.7], [1015.0, 40.4], [1900.6, 1950.2]])
COLORS = np.array([0.1, 0.4, 0.9])


def star_list(piff, galsim, wcs, pointing, chip):
    rng = np.random.default_rng(chip + 1)
    stars = []
    for i in range(16):
        x, y = rng.uniform(50.0, 2000.0, 2)
        image = galsim.Image(17, 17, dtype=float)
        image.setCenter(round(x), round(y))
        image.wcs = wcs
        profile = galsim.Moffat(beta=3, half_light_radius=0.5 + 5e-5 * x).shear(g1=2e-5 * x, g2=-1e-5 * y)
        (profile * 2e4).drawImage(image, center=(x, y))
        image.addNoise(galsim.GaussianNoise(galsim.BaseDeviate(100 * chip + i + 1), sigma=2.0))
        weight = galsim.Image(image.bounds, init_value=0.25, dtype=float)
        properties = {"chipnum": chip, "ri_color": rng.uniform(0.0, 1.0), "is_reserve": i >= 14}
        data = piff.StarData(image, galsim.PositionD(x, y), weight=weight, pointing=pointing, properties=properties)
        stars.append(piff.Star(data, None))
    return stars


def models(piff, galsim):
    """PSFs by name, with their WCS by chip and pointing."""
    affine = {0: galsim.AffineTransform(0.26, 0.01, -0.02, 0.25, origin=galsim.PositionD(1000, 1000))}
    aim = galsim.CelestialCoord(30.2 * galsim.degrees, -41.0 * galsim.degrees)
    # Half a degree from the pointing, as the chips of a wide camera lie.
    celestial = {
        chip: galsim.TanWCS(
            galsim.AffineTransform(-0.01, 0.26, 0.26, 0.02, origin=galsim.PositionD(1000, 1000)),
            galsim.CelestialCoord((29.5 + chip) * galsim.degrees, -40.8 * galsim.degrees),
        )
        for chip in (1, 2)
    }
    grid = piff.PixelGrid(0.3, 9, interp="Lanczos(5)")
    color = piff.BasisPolynomial([1, 1, 1], keys=["u", "v", "ri_color"])
    return {
        "grid_color": (piff.SimplePSF(grid, color), affine, None),
        "grid_chips": (piff.SingleChipPSF(piff.SimplePSF(piff.PixelGrid(0.3, 8), piff.Mean())), celestial, aim),
        "moffat": (piff.SimplePSF(piff.Moffat(beta=3.0), piff.Polynomial(1, poly_type="chebyshev")), affine, None),
        "kolmogorov": (piff.SimplePSF(piff.Kolmogorov(), piff.Mean()), affine, None),
        "gaussian": (piff.SimplePSF(piff.Gaussian(include_pixel=False, centered=False), piff.Mean()), affine, None),
    }


def draw(galsim, psf, name, place, color, chip):
    """Draw the profile of Piff with GalSim, centred on the middle pixel.

    Tight accuracy: pixels are convolved by FFT, by default good to 5e-4 of the peak of a Moffat function.
    """
    extra = {"ri_color": float(color)} if name == "grid_color" else {}
    profile, method = psf.get_profile(*map(float, place), chipnum=chip, **extra)
    tight = galsim.GSParams(folding_threshold=1e-4, maxk_threshold=1e-5, maximum_fft_size=16384)
    image = galsim.Image(SIZE, SIZE, dtype=float)
    image.setCenter(*(round(v) for v in place))
    image.wcs = psf.wcs[chip]
    return profile.withGSParams(tight).drawImage(image, method=method, center=image.true_center).array


def write_files(folder):
    import galsim
    import piff

    for name, (psf, wcs, pointing) in models(piff, galsim).items():
        psf.set_context(wcs, pointing)
        psf.fit([star for chip in wcs for star in star_list(piff, galsim, wcs[chip], pointing, chip)])
        path = Path(folder) / f"{name}.piff"
        psf.write(str(path))
        read = piff.read(str(path))
        rows = [(chip, *place, color) for chip in wcs for place, color in zip(PLACES, COLORS, strict=True)]
        images = [draw(galsim, read, name, row[1:3], row[3], row[0]) for row in rows]
        table = Table(rows=rows, names=("chip", "x", "y", "ri_color"))
        parts = [fits.PrimaryHDU(np.stack(images)), fits.table_to_hdu(table)]
        parts[0].header["PIFF"] = piff.__version__
        parts[0].header["GALSIM"] = galsim.__version__
        fits.HDUList(parts).writeto(path.with_suffix(".fits"), overwrite=True)


if __name__ == "__main__":
    write_files(sys.argv[1])
