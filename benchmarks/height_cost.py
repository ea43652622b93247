"""Effect of CCD heights on the long-exposure PSF: FWHM against height, shear correlations before and after models.

Run: python benchmarks/height_cost.py [--bands r y]

No turbulence and no noise: all is due to the optics, in silicon, at the seeing of Cerro Pachon. First FWHM and
size of plane CCDs at several heights and distances from the axis: best focus, and the slope with height off it. Then
planes, LSSTCam as built and the simulated budget of Jee & Tyson (2011), each at its best focus as a whole: mean FWHM,
rms e, xi+ of e, and of what polynomials of order 2 and 4 of each CCD leave, fitted to the very places (no noise).
"""

import argparse

import numpy as np
import treecorr

import pachon
from pachon import measure_shapes
from pachon.core.units import ARCMIN, ARCSEC
from pachon.measure.shapes import fwhm
from pachon.models import Silicon
from pachon.reconstruction import Instrument
from pachon.reconstruction.focal_plane_psf.height_series import level_plane

_HEIGHTS = np.arange(-30.0, 31.0, 5.0)
_OFF_FOCUS = (5.0, 10.0, 15.0, 20.0)
_PLACES = 8


def stars(instrument, fields, plane):
    """Return FWHM [arcsec], e1, e2 and size [arcsec] of long-exposure PSFs on a plane."""
    found = []
    for first in range(0, len(fields), 2048):
        psfs = pachon.make_psfs(
            instrument.telescope,
            fields[first : first + 2048],
            instrument.wavelengths,
            focal_plane=plane,
            atmosphere=instrument.atmosphere,
            engine="long_exposure",
            stamps=pachon.Stamps(silicon=Silicon()),
        )
        shapes = measure_shapes(psfs.image, psfs.pixel_scale, instrument.weight_fwhm)
        widths = fwhm(psfs.image, psfs.pixel_scale) / ARCSEC, shapes.size / ARCSEC
        found.append(np.stack([widths[0], shapes.e1, shapes.e2, widths[1]], axis=1))
    return np.concatenate(found)


def against_height(instrument, camera) -> float:
    """Print FWHM against height; return the best focus over the field [um]."""
    flat, radius, foci = pachon.FocalPlane.flat(camera), np.hypot(*camera.centers.T), []
    for distance in (0.0, 0.1, 0.2, 0.3):
        fields = instrument.fields(camera.centers[np.argsort(np.abs(radius - distance))[:4]])
        measured = np.array([stars(instrument, fields, level_plane(flat, h * 1e-6)).mean(axis=0) for h in _HEIGHTS])
        line = f"  {np.degrees(np.hypot(*fields.T)).mean():5.2f} deg"
        for label, width in (("FWHM", measured[:, 0]), ("size", measured[:, 3])):
            fit = np.polynomial.Polynomial.fit(_HEIGHTS, np.square(width), 4)
            fine = np.linspace(_HEIGHTS[0], _HEIGHTS[-1], 1201)
            values = np.sqrt(fit(fine))
            best = fine[values.argmin()]
            slopes = np.interp(best + np.array(_OFF_FOCUS), fine, np.gradient(values, fine))
            line += f"   {label} {values.min():.4f} at {best:6.1f} um, slope ["
            line += ", ".join(f"{1e3 * s:.1f} mas/um at {o:g} um" for s, o in zip(slopes, _OFF_FOCUS, strict=True))
            line += "]"
            foci.append(best)
        print(line, flush=True)
    # Those of the FWHM.
    return float(np.mean(foci[::2]))


def correlations(instrument, camera, focus) -> None:
    """Print what three focal planes cost."""
    axis = (np.arange(_PLACES) + 0.5) / _PLACES * 2.0 - 1.0
    v, u = (a.ravel() for a in np.meshgrid(axis, axis, indexing="ij"))
    xy = camera.from_uv(np.arange(len(camera))[:, None], np.stack([u, v], axis=1)).reshape(-1, 2)
    fields, ccd = instrument.fields(xy), np.repeat(np.arange(len(camera)), len(u))
    for label, plane in (
        ("plane", pachon.FocalPlane.flat(camera)),
        ("budget, seed 1", pachon.FocalPlane.from_budget(camera, seed=1)),
        ("as built", pachon.FocalPlane.as_measured("lsstcam")),
    ):
        moved = plane
        for raft in camera.raft_names:
            moved = moved.with_moved(raft, dz=1e-6 * focus - plane.height(*xy.T).mean())
        found = stars(instrument, fields, moved)
        print(
            f"  {label:16s} FWHM {found[:, 0].mean():.4f}   rms e {1e3 * np.sqrt((found[:, 1:3] ** 2).mean()):.2f}e-3"
        )
        for name, left in [("e", found[:, 1:3])] + [(f"order {n}", residual(found[:, 1:3], u, v, n)) for n in (2, 4)]:
            catalogue = treecorr.Catalog(x=fields[:, 0], y=fields[:, 1], g1=left[:, 0], g2=left[:, 1], patch=ccd)
            pairs = treecorr.GGCorrelation(
                bin_type="Log", min_sep=1.5 * ARCMIN, max_sep=180.0 * ARCMIN, nbins=5, cross_patch_weight="match"
            )
            pairs.process(catalogue)
            values = "  ".join(f"{r / ARCMIN:.0f}': {x:8.1e}" for r, x in zip(pairs.rnom, pairs.xip, strict=True))
            print(f"    {name:8s} rms {1e3 * np.sqrt((left**2).mean()):5.2f}e-3   xi+ {values}")


def residual(values, u, v, order):
    """Return what polynomials of each CCD leave."""
    terms = np.stack([u**i * v**j for i in range(order + 1) for j in range(order + 1 - i)], axis=1)
    left = values.reshape(-1, len(u), 2)
    keep = np.eye(len(u)) - terms @ np.linalg.pinv(terms)
    return np.einsum("pq,cqk->cpk", keep, left).reshape(values.shape)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bands", nargs="+", default=["r", "y"])
    options = parser.parse_args()
    print(f"pachon {pachon.__version__}, treecorr {treecorr.__version__}")
    for band in options.bands:
        print(f"{band} band")
        instrument = Instrument.of(pachon.load_telescope(f"lsst_v3.3_{band}"))
        camera = pachon.FocalPlane.flat("lsst").camera
        correlations(instrument, camera, against_height(instrument, camera))


if __name__ == "__main__":
    main()
