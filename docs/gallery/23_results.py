"""
What every result can do
========================

One line of text, a summary for JSON, a table with units, files, a picture where you want it; notebooks show table and
picture by themselves.
"""

import json

import numpy as np
from astropy.table import QTable
from matplotlib.figure import Figure

import pachon

telescope = pachon.load_telescope("lsst_v3.3_r")
fields = np.deg2rad([[0.0, 0.0], [0.0, 1.0], [0.0, 1.7]])
spots, light = pachon.spots(telescope, fields), pachon.vignetting(telescope, n_pupil=1024)
print(spots)
print(json.dumps(light.summary())[:70], "...")
spots.write("spots.ecsv")  # or .fits, .csv, .parquet
print(QTable.read("spots.ecsv").colnames)
figure = Figure(figsize=(15, 4.2), layout="constrained")
left, right = figure.subfigures(1, 2)
spots.plot(ax=left)
light.plot(ax=right)
figure.savefig("results.png")

# %%
# The rules: :doc:`results <../explanation/conventions>`.
