"""All public names: those of pachon, and those of its public sub-packages."""

import importlib
import inspect

import pachon
from pachon.core.stability import PACKAGES

#: Sub-packages and modules that are public themselves; pachon.galsim needs a package that may be missing.
MODULES = {*PACKAGES, "galsim"}


def public_names():
    """Full spelling of each public name and its object, such as "pachon.design.throughput"."""
    names = {f"pachon.{name}": getattr(pachon, name) for name in pachon.__all__ if name not in MODULES}
    for package in PACKAGES:
        module = importlib.import_module(f"pachon.{package}")
        names |= {f"pachon.{package}.{name}": getattr(module, name) for name in module.__all__}
    return names


def public_objects():
    """Object of each public name, by its last part; that of one name is that of no other."""
    return {name.rpartition(".")[2]: value for name, value in public_names().items()}


def public_functions():
    return {name for name, value in public_objects().items() if inspect.isfunction(value)}
