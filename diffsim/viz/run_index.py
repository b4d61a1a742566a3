"""The page that lists all runs, and the server that shows it to this machine's browser only."""

from __future__ import annotations

import io
import os
import sys
import time
from collections.abc import Sequence
from datetime import datetime
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from pathlib import Path
from threading import BoundedSemaphore, Lock
from typing import Any
from urllib.parse import quote

from diffsim.core.optional import advice, optional
from diffsim.viz.run_folders import PAGES, PICTURES, RECORDINGS, RunFolder, run_folders

LOCAL = "127.0.0.1"
_INDEX = ("/", "/index.html")
_CLIENTS = 256  # that are answered at once, and that wait for it
_SILENCE_S = 10.0  # after which a half-sent request, or an answer that nobody takes, is given up
#: Pages of runs, and built sites among them, ask no other machine and send nothing.
_HEADERS = {
    "Content-Security-Policy": "default-src 'self' 'unsafe-inline' data: blob:; "
    "connect-src 'self'; object-src 'none'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'self'",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",  # runs go on
}


def render_index(root: Path, runs: Sequence[RunFolder], viewer: str | None, base: str) -> str:
    """The page as text; names of files and folders are escaped.

    Args:
        runs: As ``run_folders`` gives them.
        viewer: Address of rerun's web viewer; None: recordings are links to the files.
        base: Address of this server.
    """
    jinja2 = optional("jinja2", purpose="the index of runs")
    source = resources.files("diffsim.viz").joinpath("templates/runs.html.j2").read_text("utf-8")
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.from_string(source).render(
        root=str(root),
        runs=[_describe_run(run, viewer, base) for run in runs],
        is_going_on=any(run.progress != "finished" for run in runs),
        has_viewer=viewer is not None,
        viewer_advice=advice(["rerun"]),
    )


def make_server(root: Path, port: int, viewer: str | None = None) -> ThreadingHTTPServer:
    """A server of the runs below a folder, on this machine's own address only.

    Args:
        port: Port; 0: any that is free.
        viewer: Address of rerun's web viewer, which may read recordings from here.

    Returns:
        The server; ``serve_forever`` runs it.

    Raises:
        OSError: the port is taken.
    """
    return _Server((LOCAL, port), partial(_Handler, root=root.resolve(), viewer=viewer))


def _describe_run(run: RunFolder, viewer: str | None, base: str) -> dict[str, Any]:
    folder = "" if run.path == "." else f"{_quote_name(run.path)}/"

    def links(endings: tuple[str, ...], through: str | None = None) -> list[dict[str, str]]:
        out = []
        for name in run.of_kind(endings):
            href = f"/{folder}{_quote_name(name)}"
            if through is not None:
                href = f"{through}/?url={quote(base + href, safe='')}"
            out.append({"name": name, "href": href})
        return out

    return {
        "path": "this folder" if run.path == "." else run.path,
        "kind": run.kind,
        "said": run.said,
        "progress": run.progress,
        "when": datetime.fromtimestamp(run.changed).strftime("%Y-%m-%d %H:%M"),
        "pages": links(PAGES),
        "pictures": links(PICTURES),
        "recordings": links(RECORDINGS, viewer),
    }


def _quote_name(name: str) -> str:
    """A name in an address; Linux has names that are no UTF-8."""
    return quote(os.fsencode(name))


class _Server(ThreadingHTTPServer):
    """A thread for each client, for so many at once; others wait in the queue of the system."""

    request_queue_size = _CLIENTS

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self._free = BoundedSemaphore(_CLIENTS)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer in a thread, once one is free."""
        self._free.acquire()
        try:
            super().process_request(request, client_address)
        except BaseException:
            self._free.release()
            raise

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answer, and let the next one in."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A browser that goes away, as of a download, is no error; others are a line."""
        error = sys.exc_info()[1]
        if not isinstance(error, (ConnectionError, TimeoutError)):
            print(f"a page could not be shown: {type(error).__name__}: {error}", file=sys.stderr)


class _RequestStream(io.RawIOBase):
    """What a client sends, until a moment: a letter a second would hold a thread for ever."""

    def __init__(self, connection: Any, until: float):
        super().__init__()
        self._connection, self._until = connection, until

    def readable(self) -> bool:
        """It is."""
        return True

    def readinto(self, buffer: Any) -> int:
        """As of a file; TimeoutError after the moment."""
        self._connection.settimeout(max(self._until - time.monotonic(), 1e-3))
        count: int = self._connection.recv_into(buffer)
        return count


class _Handler(SimpleHTTPRequestHandler):
    """Files below the folder, nothing else: no listing, no link that leads out of it."""

    timeout = _SILENCE_S
    looking = Lock()  # folders are looked through for one client after the other

    def __init__(self, *args: Any, root: Path, viewer: str | None, **kwargs: Any):
        self._root, self._viewer = root, viewer
        super().__init__(*args, directory=str(root), **kwargs)

    def setup(self) -> None:
        """All of a request comes within the time that an answer may wait."""
        super().setup()
        self.rfile = io.BufferedReader(
            _RequestStream(self.connection, time.monotonic() + self.timeout)
        )

    def parse_request(self) -> bool:
        """As above; the answer has its own time."""
        is_good = super().parse_request()
        self.connection.settimeout(self.timeout)
        return is_good

    def do_GET(self) -> None:
        """The index, or a file."""
        if not self._is_local():
            self.send_error(403, "ask by 127.0.0.1 or localhost")
        elif self.path.partition("?")[0] in _INDEX:
            self._send_index()
        elif self._is_inside():
            super().do_GET()
        else:
            self.send_error(404)

    def do_HEAD(self) -> None:
        """As ``do_GET``, without content."""
        if self._is_local() and self._is_inside():
            super().do_HEAD()
        else:
            self.send_error(404)

    def end_headers(self) -> None:
        """Recordings may be read by the viewer's page; others ask and keep nothing."""
        if self._viewer is not None:
            self.send_header("Access-Control-Allow-Origin", self._viewer)
        for name, value in _HEADERS.items():
            self.send_header(name, value)
        super().end_headers()

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing of what went well."""

    def _is_local(self) -> bool:
        """Whether the browser asked for this machine: another name might be a page's trick."""
        return (self.headers.get("Host") or "").partition(":")[0] in (LOCAL, "localhost")

    def _is_inside(self) -> bool:
        try:
            path = Path(self.translate_path(self.path)).resolve()
        except (OSError, ValueError, RuntimeError):  # a zero byte, links in a circle
            return False
        hidden = any(p[:1] == "." for p in path.parts[len(self._root.parts) :])
        return path.is_file() and path.is_relative_to(self._root) and not hidden

    def _send_index(self) -> None:
        base = f"http://{self.headers.get('Host')}"  # checked: this machine's own
        with self.looking:
            page = render_index(self._root, run_folders(self._root), self._viewer, base)
        content = page.encode("utf-8", "replace")
        self.send_response(200)
        self.send_header("Content-Type", "text/html; charset=utf-8")
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)
