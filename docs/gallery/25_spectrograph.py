"""
A spectrograph
==============

A concave grating with its entrance slit on the Rowland circle: where wavelengths land and how sharp their lines are.
"""

import numpy as np
from matplotlib.figure import Figure

import pachon

radius, middle, alpha, lines = 500.0, 500e-9, np.radians(15.0), 600.0  # of the sphere [mm], wavelength, incidence, 1/mm
beta = np.arcsin(middle * 1e3 * lines - np.sin(alpha))  # the grating equation
text = f"""
name: rowland
source: a concave grating of 600 lines per mm
version: "1"
units: {{length: mm, angle: deg, wavelength: nm}}
stop: {{z: 0.0}}
pupil: {{diameter: 20.0, obscuration: 0.0}}
launch_distance: 1000.0
object_distance: {radius * np.cos(alpha)}
reference_sphere_radius: {radius * np.cos(beta)}
field: {{radius: 0.05, limit: 2.0}}
wavelengths: {{range: [300, 800], default: 500, band: [450, 550]}}
surfaces:
  - {{name: grating, type: mirror, shape: sphere, radius: {radius}, z: 0.0, tilt: [15.0, 0, 0],
      grating: {{order: 1, lines_per_mm: {lines}}}}}
  - {{name: Detector, type: detector, shape: plane, tilt: [{np.degrees(alpha - beta)}, 0, 0],
      y: {-radius * np.cos(beta) * np.sin(alpha - beta)}, z: {radius * np.cos(beta) * np.cos(alpha - beta)}}}"""
with open("rowland.yaml", "w") as file:
    file.write(text)
rowland = pachon.load_telescope("rowland.yaml")
figure = Figure(figsize=(7, 4), layout="constrained")
axes = figure.subplots()
axes.set(xlabel="along the dispersion [mm]", ylabel="along the lines [mm]")
for nm in (480, 490, 500, 510, 520):
    rays = pachon.launch_rays(rowland, (0.0, 0.0), 1e-9 * nm, np.random.default_rng(1).uniform(-7e-3, 7e-3, (2, 999)))
    landed = 1e3 * rowland.surface("Detector").to_local(pachon.trace(rowland, rays).position)
    axes.plot(landed[:, 1], landed[:, 0], ".", markersize=2)
    print(f"{nm} nm at {landed[:, 1].mean():+.3f} mm, {1e3 * landed[:, 1].std():.2f} um rms")
figure.savefig("spectrograph.png")

# %%
# A ``grating`` in a :doc:`prescription <../reference/prescriptions>` is an order, a number of grooves and their
# direction. Rays obey the grating equation in vectors, and paths grow by a wavelength and order for each groove, so
# wavefronts, spots and derivatives work as for any mirror. The lines are long along the slit: a sphere in oblique
# light is astigmatic.
