"""Version of pachon, and the header card that records it."""

from importlib.metadata import version

#: Version of pachon.
VERSION = version("pachon")
#: Header card of the program, in every FITS file.
CREATOR = ("CREATOR", f"pachon {VERSION}", "program and version")
