"""The server of a desk: on this machine alone, with a token in its address."""

from __future__ import annotations

import errno
import logging
import secrets
import webbrowser
from collections.abc import Callable

from bokeh.application import Application
from bokeh.application.handlers.function import FunctionHandler
from bokeh.document import Document
from bokeh.server.server import Server

from ..core.errors import ConfigError

#: The only address that the server listens at.
HOST = "127.0.0.1"
#: The port that is tried first, and how many after it.
PORT = 5006
_PORTS = 50
#: Largest message of a page [bytes].
_MOST_BYTES = 4 * 10**6


def open_server(show: Callable[[Document], None], port: int = PORT, token: str | None = None) -> tuple[Server, str]:
    """Start a server of documents, and return it with its address; a port that is taken gives way to the next.

    The path of the address is a token that nobody can guess. Other paths do not exist, and a page of another origin
    gets no connection.
    """
    path = f"/{token or secrets.token_urlsafe(24)}"
    # What is refused is no error of this program.
    for name, level in {"bokeh": logging.ERROR, "bokeh.server.views.ws": logging.CRITICAL}.items():
        logging.getLogger(name).setLevel(level)
    logging.getLogger("tornado.access").setLevel(logging.ERROR)
    for name in ("tornado.application", "bokeh.server.protocol_handler"):
        logging.getLogger(name).addFilter(_is_no_early_farewell)
    for number in range(port, min(port + _PORTS, 65536)):
        try:
            server = Server(
                {path: Application(FunctionHandler(show))},
                port=number,
                address=HOST,
                allow_websocket_origin=[f"{HOST}:{number}", f"localhost:{number}"],
                use_index=False,
                redirect_root=False,
                websocket_max_message_size=_MOST_BYTES,
                unused_session_lifetime=60_000,
                check_unused_sessions=10_000,
            )
        except OSError as error:
            if error.errno not in (errno.EADDRINUSE, errno.EACCES):
                raise
        else:
            server.start()
            return server, f"http://{HOST}:{number}{path}"
    raise ConfigError(f"port = {port}: expected one that is free, or one of the {_PORTS - 1} after it", key="port")


def serve(server: Server, address: str, *, browser: bool) -> None:
    """Serve until Ctrl-C, and open a browser where one is wanted."""
    if browser:
        server.io_loop.add_callback(webbrowser.open, address)
    try:
        server.io_loop.start()
    finally:
        server.stop()


def _is_no_early_farewell(record: logging.LogRecord) -> bool:
    """Leave out Bokeh's assertions about a page that is closed while messages of it are on their way."""
    return not (record.exc_info and record.exc_info[0] is AssertionError)
