"""Scraper of sphinx-gallery: pictures that a program has saved, as its figures are none of pyplot."""

from __future__ import annotations

import shutil
from pathlib import Path

from sphinx_gallery.scrapers import figure_rst


def saved_pictures(block: object, variables: dict[str, object], settings: dict[str, object]) -> str:
    """Move the pictures that a block of the gallery has saved into its page."""
    pictures = sorted(Path(variables["src_file"]).parent.glob("*.png"), key=lambda path: path.stat().st_mtime)
    targets = [target for _, target in zip(pictures, variables["image_path_iterator"], strict=False)]
    for picture, target in zip(pictures, targets, strict=True):
        shutil.move(picture, target)
    return figure_rst(targets, settings["src_dir"])
