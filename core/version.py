"""Version of pachon, and the header card that records it."""

#: Version of pachon, that of pyproject.toml; reading the metadata of the installed package would take 30 ms.
VERSION = "1.0.0rc1"
#: Header card of the program, in every FITS file.
CREATOR = ("CREATOR", f"pachon {VERSION}", "program and version")
