"""
Draw a telescope
================

``layout`` traces fans of rays through the section of a telescope. The summary is a plain dictionary; ``print`` of any
result is a line.
"""

import pachon

telescope = pachon.load_telescope("lsst_v3.3_r")
drawing = pachon.layout(telescope)
print(telescope)
print(drawing)
print(f"surfaces drawn: {', '.join(drawing.summary()['surface'])}")
drawing.plot().savefig("layout.png")

# %%
# The command: ``pachon draw lsst_v3.3_r``. Any YAML, Zemax, CODE V or batoid file stands in for the name.
