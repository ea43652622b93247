"""Sphinx configuration: ``sphinx-build -W docs docs/_build`` with the ``docs`` extra installed."""

import os
import sys
from pathlib import Path

# The checkout itself is documented, installed or not; and the extension that makes pages stands beside this file.
sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parent)]

import pages
from numpydoc.xref import DEFAULT_LINKS

project = "pachon"
copyright = "2026, the pachon developers"
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "numpydoc",
    "sphinx_copybutton",
    "sphinx_design",
    "sphinx_gallery.gen_gallery",
    "pages",
]
html_theme = "furo"
html_title = "pachon"
html_static_path = ["_static"]
html_css_files = ["narrow.css"]
templates_path = ["_templates"]
exclude_patterns = ["_build", "_templates", "gallery"]
# What is typed stays: --resume can be copied, and 0.7" are arc seconds, not a closing quotation mark.
smartquotes = False
myst_enable_extensions = ["colon_fence"]
# Anchors of headings, so that pages link to sections of others.
myst_heading_anchors = 3

autodoc_member_order = "bysource"
autodoc_typehints = "none"
autosummary_context = {
    "provisional": pages.provisional(),
    # Classes of others whose members are not listed.
    "foreign": "tuple, IntEnum, int, Exception, BaseModel",
}
autosummary_filename_map = pages.file_names()
numpydoc_show_class_members = False
# A word in the type of an argument is a link where it is a public name, and nowhere else: no "shape" to Window.shape.
DEFAULT_LINKS.clear()
numpydoc_xref_param_type = True
numpydoc_xref_ignore = "all"
numpydoc_xref_aliases = {"ndarray": "numpy.ndarray", "Figure": "matplotlib.figure.Figure"} | pages.full_names()

sphinx_gallery_conf = {
    "examples_dirs": "gallery",
    "gallery_dirs": "auto_examples",
    "filename_pattern": r"/\d\d_",
    "within_subsection_order": "FileNameSortKey",
    "image_scrapers": ("pages.saved_pictures",),
    # Desks are live in notebooks alone.
    "ignore_repr_types": r"pachon\.desk",
    "show_signature": False,
    "write_computation_times": False,
}

# Links to the pages of others need the network, and a build without it is a build all the same.
if "READTHEDOCS" in os.environ:
    extensions.append("sphinx.ext.intersphinx")
    intersphinx_mapping = {
        "python": ("https://docs.python.org/3", None),
        "numpy": ("https://numpy.org/doc/stable", None),
        "matplotlib": ("https://matplotlib.org/stable", None),
        "astropy": ("https://docs.astropy.org/en/stable", None),
    }
