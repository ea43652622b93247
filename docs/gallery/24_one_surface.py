"""
One surface
===========

Rays through single surfaces, without a telescope: the focus of a sphere and of a paraboloid, and Snell's law at a
lens.
"""

import numpy as np
from matplotlib.figure import Figure

import pachon

x = np.linspace(-1.0, 1.0, 9)
down = np.tile([0.0, 0.0, -1.0], (9, 1))
rays = pachon.Rays(np.stack([x, 0 * x, 0 * x + 3.0], axis=1), down, np.zeros(9), 620e-9)
vacuum = pachon.ConstantIndex(1.0)
focus = pachon.Surface("focus", pachon.Interaction.DETECTOR, pachon.Plane(), (0.0, 0.0, 2.0), vacuum)
figure = Figure(figsize=(8, 4.5), layout="constrained")
for axes, mirror in zip(figure.subplots(1, 2), (pachon.Sphere(4.0), pachon.Conic(4.0, -1.0)), strict=True):
    reflected = pachon.reflect(mirror, rays)
    end = pachon.intersect(focus, reflected)
    print(f"{type(mirror).__name__}: largest ray error {1e3 * np.ptp(end.position[:, 0]) / 2:.3f} mm")
    axes.plot(x, mirror.sag(x, 0.0), color="black")
    path = np.stack([rays.position, reflected.position, end.position])
    axes.plot(path[..., 0], path[..., 2], color="tab:blue", linewidth=0.8)
    axes.set(title=type(mirror).__name__, xlabel="x [m]", ylabel="z [m]", aspect="equal")
figure.savefig("one_surface.png")

lens = pachon.Sphere(-2.0)
glass = pachon.refract(lens, rays, 1.0, 1.5)
normal = lens.normal(*glass.position[:, :2].T)
sines = [n * np.linalg.norm(np.cross(v, normal), axis=1) for n, v in ((1.0, down), (1.5, glass.direction))]
print("n sin(angle) before:", sines[0][:4].round(6))
print("n sin(angle) after: ", sines[1][:4].round(6))

# %%
# These functions take a :doc:`surface <../reference/prescriptions>` at its place, or a shape with its vertex at the
# origin, and run the kernel that traces telescopes. A result goes into the next call, and its rays keep their status.
