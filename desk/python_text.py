"""A state as a Python program that uses the public names alone."""

from __future__ import annotations

from ..sky.visit_list.seeing import KOLMOGOROV_WIDTH, WAVELENGTH
from .bench import Bench, height_factors
from .state import DeskState
from .views import JMAX, RINGS, SITE


def python_text(bench: Bench, state: DeskState) -> str:
    """Return a program that makes the telescope and the CCDs of a state, and prints its numbers."""
    optics = {name: value for name, value in state.total_optics.items() if value}
    lines = ["import numpy as np", "", "import pachon", "from pachon import models", ""]
    lines.append(f"nominal = pachon.load_telescope({state.model!r})")
    if bench.is_lsst:
        lines.append(f"telescope = models.OpticsState({optics!r}).telescope(nominal)")
    else:
        lines.append(f"telescope = models.apply_changes(nominal, {_changes(bench, optics)!r})")
    lines.append(f"wavelength = {state.wavelength_nm!r} * 1e-9")
    lines.append(f"star = np.deg2rad({list(state.field_deg)!r})")
    lines.append("focal_plane = None")
    if bench.focal_plane(state) is not None:
        lines.append("focal_plane = pachon.FocalPlane.flat(nominal.camera)")
        if state.heights:
            factors = height_factors(state.heights)
            lines.append(f"focal_plane = pachon.FocalPlane.from_budget(nominal.camera, seed={state.seed})")
            lines.append(f"focal_plane = focal_plane.scaled({factors!r})")
        for name, lift in state.lifts.items():
            lines.append(f"focal_plane = focal_plane.with_moved({name!r}, dz={lift!r} * 1e-6)")
    lines.append("atmosphere = None")
    if state.seeing_arcsec > 0:
        r0 = f"{KOLMOGOROV_WIDTH} * {WAVELENGTH} / np.deg2rad({state.seeing_arcsec!r} / 3600)"
        lines.append(f"atmosphere = pachon.Atmosphere.from_site({SITE!r}, 1, r0={r0})")
    unit = "urad" if bench.nominal.design_data.afocal else "um"
    rings = f"n_pupil={RINGS}, focal_plane=focal_plane"
    lines += [
        "",
        f"spots = pachon.spots(telescope, star, wavelength, {rings})",
        f"print('rms radius of the spot [{unit}]:', spots.rms_radius * 1e6)",
        "request = pachon.Request.of(telescope, star, wavelength).on(focal_plane)",
        f"zernikes = pachon.wavefront_zernikes(request, jmax={JMAX})",
        "print('Zernikes from Z4 [nm]:', zernikes.coefficients[0, 3:] * 1e9)",
    ]
    return "\n".join(lines) + "\n"


def _changes(bench: Bench, optics: dict[str, float]) -> dict[str, float]:
    """Return degrees of freedom of one address each as changes with units in their names."""
    changes = {}
    for name, value in optics.items():
        member = bench.freedoms.members[bench.freedoms.index(name)]
        [address] = member.of
        changes[f"{address}_{member.unit}"] = value
    return changes
