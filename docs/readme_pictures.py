"""Small pictures of the README's doors, from those of the pages: ``python docs/readme_pictures.py``."""

from pathlib import Path

from PIL import Image

IMAGES = Path(__file__).parent / "images"
#: Width of a small picture [pixels].
WIDTH = 560
#: Part of each picture of the pages (left, top, right, bottom as fractions), by the name of the small one.
DOORS = {
    "door_design": ("design_layout.png", (0.0, 0.14, 0.482, 0.88)),
    "door_survey": ("reproduction_fig10.png", (0.3812, 0.112, 0.6675, 0.882)),
    "door_donuts": ("alignment_donuts.png", (0.0, 0.0, 0.502, 1.0)),
}

for name, (source, (left, top, right, bottom)) in DOORS.items():
    picture = Image.open(IMAGES / source).convert("RGB")
    width, height = picture.size
    part = picture.crop((int(left * width), int(top * height), int(right * width), int(bottom * height)))
    small = part.resize((WIDTH, WIDTH * part.height // part.width), Image.Resampling.LANCZOS)
    small.quantize(128).save(IMAGES / f"{name}.png", optimize=True)
