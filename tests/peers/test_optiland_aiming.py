"""Rays that are aimed at the stop, against optiland's "robust" aiming, on optiland's own sample systems."""

import math

import numpy as np
import pytest

import pachon
from pachon.models.design_data import DesignData
from pachon.models.media.medium import ConstantIndex
from pachon.models.shapes.shape import Conic, EvenAsphere, Plane
from pachon.models.surface import Interaction, Surface
from pachon.models.telescope import Telescope

pytest.importorskip("optiland")
objectives = pytest.importorskip("optiland.samples.objectives")
telescopes = pytest.importorskip("optiland.samples.telescopes")

SAMPLES = {
    name: getattr(objectives, name)
    for name in (
        "CookeTriplet", "DoubleGauss", "ReverseTelephoto", "HeliarLens", "TessarLens", "PetzvalLens", "Telephoto",
        "LensWithFieldCorrector", "TripletTelescopeObjective", "WideAngle100FOV", "ProjectionLens120FOV",
        "ProjectionLens160FOV", "WideAngle170FOV",
    )
}  # fmt: skip
PUPIL = np.array([[0.0, 0.0], [0.0, 1.0], [0.0, -1.0], [0.7, 0.0], [-0.5, 0.6]])


def converted(optic):
    """A telescope of the surfaces of an optiland system [mm], with its indices at the primary wavelength."""
    wavelength = float(optic.primary_wavelength)
    index, rows, medium = 1.0, [], ConstantIndex(1.0)
    own = list(optic.surfaces)[1:]
    for number, surface in enumerate(own):
        geometry = surface.geometry
        radius, conic = float(geometry.radius), float(getattr(geometry, "k", 0.0))
        terms = [float(c) for c in getattr(geometry, "coefficients", getattr(geometry, "c", []))]
        assert not terms[:1] or terms[0] == 0.0, "no term of second order"
        # Light travels along -z here: the sag changes its sign, and so do lengths in millimetres become metres.
        shape = Plane() if math.isinf(radius) else Conic(-1e-3 * radius, conic)
        if any(terms):
            scaled = tuple(-a * 1e3 ** (3 + 2 * i) for i, a in enumerate(terms[1:]))
            shape = EvenAsphere(-1e-3 * radius, conic, scaled)
        last = number == len(own) - 1
        index = float(np.ravel(surface.material_post.n(wavelength))[0]) if not last else index
        after = medium if last else ConstantIndex(index)
        kind = Interaction.DETECTOR if last else Interaction.PASS if after == medium else Interaction.REFRACT
        z = -1e-3 * float(np.ravel(geometry.cs.z)[0])
        rows.append(Surface(f"S{number + 1}", kind, shape, (0.0, 0.0, z), after))
        medium = after
    stop = optic.surfaces.stop_index
    largest = max(math.hypot(f.x, f.y) for f in optic.fields.fields)
    return Telescope(
        name=type(optic).__name__, surfaces=tuple(rows),
        stop_z=rows[0].vertex[2] - 1e-3 * float(np.ravel(optic.paraxial.EPL())[0]),
        pupil_diameter=1e-3 * float(np.ravel(optic.paraxial.EPD())[0]), pupil_obscuration=0.0,
        launch_distance=20.0 * max(abs(s.vertex[2]) for s in rows), reference_sphere_radius=1.0,
        field_radius=math.radians(largest),
        field_limit=math.radians(89.0), wavelength_range=(1e-7, 2e-5), default_wavelength=wavelength * 1e-6,
        design_data=DesignData(stop=f"S{stop}", aiming="real"),
    ), wavelength, largest  # fmt: skip


@pytest.mark.filterwarnings("ignore:Material")  # glasses that two makers have
@pytest.mark.slow
@pytest.mark.parametrize("name", SAMPLES)
def test_aimed_rays_land_where_those_of_optiland_do(name):
    optic = SAMPLES[name]()
    optic.ray_tracer.set_aiming("robust", max_iter=100, tol=1e-11)
    telescope, wavelength, largest = converted(optic)
    radius, detector = 0.5 * telescope.pupil_diameter, telescope.surfaces[-1]
    compared = 0
    for field in {f.y for f in optic.fields.fields} | {0.7 * largest}:
        for px, py in PUPIL:
            try:
                theirs = optic.trace_generic(Hx=0.0, Hy=field / largest, Px=px, Py=py, wavelength=wavelength)
            except ValueError:
                continue  # optiland finds none
            there = np.array([-float(theirs.x[0]), float(theirs.y[0])]) * 1e-3
            rays = pachon.launch_rays(
                telescope, (0.0, math.radians(field)), telescope.default_wavelength, ([-px * radius], [py * radius])
            )
            here = detector.to_local(pachon.trace(telescope, rays).position)[0, :2]
            # A nanometre.
            if np.isfinite(there).all():
                compared += 1
                assert here == pytest.approx(there, abs=1e-9)
    assert compared >= 10
