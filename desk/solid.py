"""The telescope as a solid: a viewer that needs no network, and a GLB file."""

from __future__ import annotations

import base64
from collections.abc import Callable

import numpy as np
from bokeh.layouts import row
from bokeh.models import Button, CustomJS, Row, TextAreaInput
from trimesh.viewer import scene_to_html

from ..design.layout.layout import Layout

#: Light of the surfaces themselves in the viewer, over their colour.
_GLOW = 0.3
#: Shows a page in a frame above the desk, which scripts of the frame cannot reach.
_OPEN = """
if (!text.value) return;
const dialog = document.createElement('dialog'), close = document.createElement('button');
dialog.setAttribute('aria-label', 'the telescope in three dimensions');
dialog.style.cssText = 'width: 94vw; height: 94vh; max-width: none; max-height: none; padding: 8px';
close.textContent = 'Close';
close.onclick = () => dialog.close();
const hint = document.createElement('span');
hint.textContent = ' Drag to turn, wheel to zoom, right button to move';
const frame = document.createElement('iframe');
frame.title = 'the telescope in three dimensions';
frame.sandbox = 'allow-scripts';
frame.style.cssText = 'width: 100%; height: calc(100% - 34px); border: 0; margin-top: 6px';
frame.srcdoc = text.value;
dialog.append(close, hint, frame);
dialog.addEventListener('close', () => dialog.remove());
document.body.append(dialog);
dialog.showModal();
"""
#: Downloads a file in base 64.
_SAVE = """
if (!text.value) return;
const bytes = Uint8Array.from(atob(text.value), letter => letter.charCodeAt(0));
const link = document.createElement('a');
link.href = URL.createObjectURL(new Blob([bytes], {type: 'model/gltf-binary'}));
link.download = 'telescope.glb';
link.click();
URL.revokeObjectURL(link.href);
"""


def solid_page(drawing: Layout) -> str:
    """Return a page of trimesh's viewer, which holds three.js and the meshes of a layout."""
    scene = drawing.scene()
    for mesh in scene.geometry.values():
        material = mesh.visual.material
        # The viewer has no surroundings that metal would mirror, and light from the observer alone.
        material.metallicFactor = 0.0
        material.emissiveFactor = _GLOW * np.array(material.baseColorFactor[:3]) / 255.0
    return str(scene_to_html(scene))


def solid_buttons(drawing: Callable[[], Layout]) -> Row:
    """Return buttons that show a layout as a solid, and that save it."""
    page, file = (TextAreaInput(value="", visible=False) for _ in range(2))

    def send(text: TextAreaInput, content: str) -> None:
        # The same content again is a change too.
        text.value = ""
        text.value = content

    solid, save = Button(label="Solid", width=120), Button(label="Save GLB", width=120)
    solid.on_click(lambda event: send(page, solid_page(drawing())))
    save.on_click(lambda event: send(file, base64.b64encode(drawing().glb()).decode("ascii")))
    page.js_on_change("value", CustomJS(args={"text": page}, code=_OPEN))
    file.js_on_change("value", CustomJS(args={"text": file}, code=_SAVE))
    return row(solid, save, page, file)
