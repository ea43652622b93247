"""The page of a desk: its template, and a page in a file that needs nothing else."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from bokeh.core.templates import get_env
from bokeh.document import Document
from bokeh.embed import file_html
from bokeh.resources import INLINE
from jinja2 import ChoiceLoader, Environment, FileSystemLoader, Template

from ..core.files import write_bytes
from .page_session import PageSession

_TEMPLATES = Path(__file__).parent / "templates"


def template() -> Template:
    """Return the template of a page. What it shows is escaped; Bokeh's parts are marked as safe."""
    # Bokeh's own base page stands beside ours.
    loader = ChoiceLoader([FileSystemLoader(_TEMPLATES), get_env().loader])
    return Environment(loader=loader, autoescape=True).get_template("desk.html")


def page_names(session: PageSession, *, live: bool) -> dict[str, Any]:
    """Return what the template fills in."""
    names = [str(picture.figure.name) for picture in session.pictures]
    return {
        "title": session.title,
        "subtitle": session.subtitle,
        "picture_names": names,
        "hidden_names": [str(picture.figure.name) for picture in session.pictures if not picture.figure.visible],
        "wide_names": ["stamps", "components"],
        "root_names": ["sidebar"] if live else [],
        "state_text": "" if live else session.state_words,
    }


def show_in(session: PageSession, document: Document) -> None:
    """Make a document the page of a session."""
    document.template = template()
    document.title = session.title
    document.template_variables.update(page_names(session, live=True))
    session.add_to(document)


def export_page(session: PageSession, path: Path) -> None:
    """Write the pictures and numbers of a session as one page that needs no network."""
    pictures = [picture.figure for picture in session.pictures if picture.figure.visible]
    names = page_names(session, live=False)
    names["picture_names"] = [str(figure.name) for figure in pictures]
    roots = [session.status, session.table, *pictures]
    text = file_html(
        roots,
        INLINE,
        title=names.pop("title"),
        template=template(),
        template_variables=names,
        suppress_callback_warning=True,
    )
    write_bytes(path, text.encode("utf-8"))
