"""Sphinx configuration: ``sphinx-build -W docs docs/_build`` with the ``docs`` extra installed."""

import os
import sys
from pathlib import Path

# The checkout itself is documented, installed or not.
sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parent / "_ext")]

from importlib import import_module

from numpydoc.xref import DEFAULT_LINKS

import pachon
from pachon.core.stability import PACKAGES, PROVISIONAL

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
    "command_pages",
]
html_theme = "furo"
html_title = "pachon"
html_static_path = ["_static"]
html_css_files = ["narrow.css"]
templates_path = ["_templates"]
exclude_patterns = ["_build", "_ext", "_templates", "gallery"]
# What is typed stays: --resume can be copied, and 0.7" are arc seconds, not a closing quotation mark.
smartquotes = False
myst_enable_extensions = ["colon_fence"]
# Anchors of headings, so that pages link to sections of others.
myst_heading_anchors = 3

autodoc_member_order = "bysource"
autodoc_typehints = "none"
# A page of autosummary for each name that a module lists as public; those of pachon itself by layer.
modules = {module: import_module(module).__all__ for module in ("pachon", *(f"pachon.{name}" for name in PACKAGES))}
daily_names = {}
for name in sorted({*pachon.__all__} - {*PACKAGES, "galsim"}):
    daily_names.setdefault(getattr(pachon, name).__module__.split(".")[1], []).append(name)
full_names = {name: f"{module}.{name}" for module, names in modules.items() for name in names}
autosummary_context = {
    "names": {module: {"": names} for module, names in modules.items()} | {"pachon": dict(sorted(daily_names.items()))},
    "provisional": PROVISIONAL,
    # Classes of others whose members are not listed.
    "foreign": "tuple, IntEnum, int, Exception, BaseModel",
}
# Some file systems do not tell fast from FAST: the page of a function named as a class has a name of its own.
classes = {full_name.lower() for name, full_name in full_names.items() if name[0].isupper()}
autosummary_filename_map = {
    full_name: f"{full_name}_function" for full_name in full_names.values() if full_name in classes
}
numpydoc_show_class_members = False
# A word in the type of an argument is a link where it is a public name, and nowhere else: no "shape" to Window.shape.
DEFAULT_LINKS.clear()
numpydoc_xref_param_type = True
numpydoc_xref_ignore = "all"
numpydoc_xref_aliases = {"ndarray": "numpy.ndarray", "Figure": "matplotlib.figure.Figure"} | full_names

sphinx_gallery_conf = {
    "examples_dirs": "gallery",
    "gallery_dirs": "auto_examples",
    "filename_pattern": r"/\d\d_",
    "within_subsection_order": "FileNameSortKey",
    "image_scrapers": ("saved_pictures.saved_pictures",),
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


def public_reference(app, environment, node, content):
    """Return the link to a public name that a docstring names by its module, as in ``wavefront.opd.wavefront_opd``."""
    target = full_names.get(node.get("reftarget", "").rpartition(".")[2])
    if node.get("refdomain") != "py" or target in (None, node["reftarget"]):
        return None
    domain = environment.get_domain("py")
    return domain.resolve_xref(environment, node["refdoc"], app.builder, node["reftype"], target, node, content)


def setup(app):
    """Connect the links to a build of Sphinx."""
    app.connect("missing-reference", public_reference)
