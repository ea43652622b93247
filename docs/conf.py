"""Sphinx configuration: ``sphinx-build -W docs docs/_build`` with the ``docs`` extra installed."""

import sys
from pathlib import Path

# The checkout itself is documented, installed or not; and the extension that makes pages stands beside this file.
sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parent)]

project = "pachon"
copyright = "2026, the pachon developers"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode", "pages"]
html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["narrow.css"]
exclude_patterns = ["_build", "gallery/made"]
# What is typed stays: --resume can be copied, and 0.7" are arc seconds, not a closing quotation mark.
smartquotes = False
# Anchors of headings, so that pages link to sections of others.
myst_heading_anchors = 3
autodoc_member_order = "bysource"
autodoc_typehints = "none"
napoleon_google_docstring = False
# Attributes of dataclasses are documented in their class's list.
napoleon_use_ivar = True
# Many classes have a `size` or a `wavelength`; texts that name one mean that of their own class.
suppress_warnings = ["ref.python"]
