"""
A prescription of your own
==========================

A Newtonian written down surface by surface, checked against the thin-mirror formulas, saved as YAML and as a Zemax
file.
"""

from pathlib import Path

import pachon

Path("newton.yaml").write_text("""
name: newton
source: written by hand
version: "1"
units: {length: m, angle: deg, wavelength: um}
stop: {z: 0.0}
pupil: {diameter: 0.5, obscuration: 0.2}
launch_distance: 5.0
reference_sphere_radius: 2.0
field: {radius: 0.2, limit: 0.5}
wavelengths: {range: [0.3, 1.0], default: 0.55}
surfaces:
  - {name: M1, type: mirror, shape: paraboloid, z: 0.0, radius: 4.0, annulus: [0.05, 0.26]}
  - {name: Detector, type: detector, shape: plane, z: 2.0, circle: 0.02}
""")
telescope = pachon.load_telescope("newton.yaml")
paraxial = pachon.first_order(telescope)
print(f"focal length {paraxial.focal_length:.4f} m, half the radius; f/{paraxial.f_number:.2f}")
seidel = pachon.seidel_sums(telescope, field=0.004)
print(f"spherical aberration {seidel.total[0]:.1e} m, coma {seidel.total[1]:.2e} m")
pachon.save_telescope(telescope, "newton.zmx")
print(pachon.load_telescope("newton.zmx"))
pachon.layout(telescope).plot().savefig("newton.png")

# %%
# Every key: :doc:`the YAML format <../reference/prescriptions>`.
