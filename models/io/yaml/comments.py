"""Comments in prescription files: what each key is, and where the numbers come from."""

from __future__ import annotations

import textwrap

from ....core.files import text_lines

#: What a key of the header is, for somebody who sees such a file for the first time.
KEYS = {
    "units": "of all numbers in this file",
    "stop": "height of the plane of the entrance pupil",
    "pupil": "outer diameter of the entrance pupil, inner over outer",
    "launch_distance": "rays start so far above the origin",
    "reference_sphere_radius": "of the sphere that the wavefront is measured on",
    "field": "radius of the field of view, and of what the model covers",
    "wavelengths": "covered, default, and edges of the band",
    "media": "glasses by name; vacuum, of index 1, needs none",
    "groups": "surfaces that move together",
    "surfaces": "in the order of the light",
}
FRAME = (
    "Telescope frame: right-handed, +z along the optical axis towards the sky; light comes down. z is the height of a "
    "vertex, a positive radius has its centre on the +z side."
)
#: Length of a line of comment.
_WIDTH = 118


def with_comments(text: str, *paragraphs: str) -> str:
    """Return the text of a prescription file with paragraphs at its head, and a comment at each key of its header."""
    head = [f"# {line}" for p in (*paragraphs, FRAME) for line in textwrap.wrap(p, _WIDTH)]
    body = []
    for line in text_lines(text):
        note = KEYS.get(line.partition(":")[0])
        body.append(f"{line}  # {note}" if note else line)
    return "\n".join([*head, *body]) + "\n"
