"""Sphinx configuration: ``sphinx-build docs docs/_build`` with the ``docs`` extra installed."""

project = "pachon"
copyright = "2026, the pachon developers"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
html_theme = "furo"
exclude_patterns = ["_build"]
