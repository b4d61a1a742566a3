"""``diffsim serve``: all runs in the browser, on this machine only."""

from __future__ import annotations

import argparse
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from diffsim.core.optional import ask_for, present

# Runs a command until the end of its input, then ends all processes of its group. rerun's command
# only starts the viewer's, and this process may end in ways that it cannot answer, such as kill -9.
_WHILE_READ = (
    "import os, signal, subprocess, sys; subprocess.Popen(sys.argv[1:], stdin=subprocess.DEVNULL); "
    "sys.stdin.read(); os.killpg(0, signal.SIGTERM)"
)

HELP = "show runs, their pages, recordings and progress in the browser"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``diffsim serve``."""
    parser.add_argument(
        "runs", nargs="?", type=Path, default=Path("runs"), help="folder, default: %(default)s"
    )
    parser.add_argument("--port", type=int, default=8765, help="default: %(default)s; 0: any")
    parser.add_argument("--open", action="store_true", help="open the browser")


def command(args: argparse.Namespace) -> None:
    """Serve until Ctrl-C.

    Raises:
        ValueError: RUNS is no folder, or the port is taken.
        ImportError: jinja2 is not installed.
    """
    from diffsim.viz.run_index import LOCAL, make_server

    ask_for(["jinja2"], purpose="the index of runs")
    if not args.runs.is_dir():
        raise ValueError(f"RUNS must be an existing folder, got {args.runs}")
    with _viewer(LOCAL) as viewer:
        try:
            server = make_server(args.runs, args.port, viewer)
        except (OSError, OverflowError) as error:
            raise ValueError(f"--port {args.port}: {error}; --port 0 takes a free one") from error
        address = f"http://{LOCAL}:{server.server_address[1]}/"
        print(f"runs in {args.runs}: {address} (this machine only; Ctrl-C ends)", flush=True)
        if args.open:
            import webbrowser

            webbrowser.open(address)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            print("\nended")
        finally:
            server.server_close()


@contextmanager
def _viewer(host: str) -> Iterator[str | None]:
    """Address of rerun's web viewer while it runs; None where rerun is not installed."""
    if not present("rerun"):
        yield None
        return
    with socket.socket() as free:
        free.bind((host, 0))
        port = free.getsockname()[1]
    # given an address to show, it hosts the viewer alone, without a server for data
    with subprocess.Popen(
        [
            *(sys.executable, "-c", _WHILE_READ),
            *(sys.executable, "-m", "rerun", "--serve-web", "--bind", host),
            *("--web-viewer-port", str(port), f"http://{host}/none.rrd"),
        ],
        stdin=subprocess.PIPE,  # leaving the block closes it, as does any other end of this process
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    ):
        yield f"http://{host}:{port}"
