"""Chromium without a window, driven through its DevTools protocol over a pair of pipes.

Standard library only: pipes carry JSON, ended by a zero byte (``--remote-debugging-pipe``).
"""

from __future__ import annotations

import base64
import json
import os
import select
import shutil
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")


class Browser:
    """A page of a browser. Use it as a context: the process ends with it.

    Attributes:
        complaints: Errors and warnings of the console, exceptions and failed requests.
    """

    def __init__(self, profile: Path, *, width: int = 1200, height: int = 900):
        assert CHROMIUM is not None
        to_browser, ours_out = os.pipe()
        ours_in, from_browser = os.pipe()
        flags = ["--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"]
        command = [CHROMIUM, *flags, f"--window-size={width},{height}", "--remote-debugging-pipe"]
        # the browser reads from descriptor 3 and writes to 4
        shell = 'exec 3<&"$0" 4>&"$1"; shift; exec "$@"'
        self._process = subprocess.Popen(
            ["bash", "-c", shell, str(to_browser), str(from_browser), *command,
             f"--user-data-dir={profile}", "about:blank"],
            pass_fds=(to_browser, from_browser), start_new_session=True,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        os.close(to_browser)
        os.close(from_browser)
        self._out, self._in = ours_out, ours_in
        self._rest, self._count = b"", 0
        self._session: str | None = None
        self.complaints: list[str] = []
        targets = self.call("Target.getTargets")["targetInfos"]
        page = next(t["targetId"] for t in targets if t["type"] == "page")
        self._session = self.call("Target.attachToTarget", targetId=page, flatten=True)["sessionId"]
        for domain in ("Runtime", "Log", "Page"):
            self.call(f"{domain}.enable")

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *_: object) -> None:
        os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        os.close(self._out)
        os.close(self._in)

    def call(self, method: str, **parameters: Any) -> Any:
        """Result of a method of the protocol."""
        self._count += 1
        message = {"id": self._count, "method": method, "params": parameters}
        if self._session is not None:
            message["sessionId"] = self._session
        os.write(self._out, json.dumps(message).encode() + b"\0")
        until = time.monotonic() + 60.0
        while True:
            answer = self._read(until - time.monotonic())
            if answer is None:
                raise TimeoutError(f"the browser does not answer {method}")
            if answer.get("id") == self._count:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']}")
                return answer["result"]
            self._note(answer)

    def open(self, path: Path | str) -> None:
        """Go to a page and wait until it is loaded."""
        uri = path.as_uri() if isinstance(path, Path) else path
        self.call("Page.navigate", url=uri)
        self.until("document.readyState === 'complete' && location.href !== 'about:blank'")

    def js(self, code: str) -> Any:
        """Value of an expression in the page."""
        said = self.call("Runtime.evaluate", expression=code, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in said:
            raise RuntimeError(f"{code}: {said['exceptionDetails']}")
        return said["result"].get("value")

    def until(self, code: str, seconds: float = 60.0) -> None:
        """Wait until an expression holds."""
        end = time.monotonic() + seconds
        while not self.js(code):
            if time.monotonic() > end:
                raise TimeoutError(f"{code} does not become true; {self.complaints}")
            time.sleep(0.1)

    def middle(self, selector: str) -> tuple[float, float]:
        """Scroll an element into view; the center of its box."""
        found = f"document.querySelector({json.dumps(selector)})"
        self.js(f"{found}.scrollIntoView({{block: 'center', behavior: 'instant'}})")
        box = self.js(f"(() => {{ const b = {found}.getBoundingClientRect();"
                      "return [b.x + b.width / 2, b.y + b.height / 2] })()")  # fmt: skip
        return box[0], box[1]

    def click(self, selector: str) -> None:
        """Press and release on an element."""
        x, y = self.middle(selector)
        self.drag((x, y), (x, y))

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        """Press at one place, move in steps, release at another."""

        def mouse(kind: str, x: float, y: float, pressed: int) -> None:
            button = {"button": "left", "buttons": pressed, "clickCount": 1}
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **button)

        mouse("mouseMoved", *start, 0)
        mouse("mousePressed", *start, 1)
        for k in (0.3, 0.6, 1.0):
            if start != end:
                place = [a + k * (b - a) for a, b in zip(start, end, strict=True)]
                mouse("mouseMoved", place[0], place[1], 1)
        mouse("mouseReleased", *end, 0)

    def picture(self, path: Path) -> Path:
        """Write what is seen as PNG."""
        shot = self.call("Page.captureScreenshot", format="png")["data"]
        path.write_bytes(base64.b64decode(shot))
        return path

    def _read(self, seconds: float) -> dict[str, Any] | None:
        end = time.monotonic() + seconds
        while b"\0" not in self._rest:
            ready, _, _ = select.select([self._in], [], [], max(0.0, end - time.monotonic()))
            if not ready:
                return None
            part = os.read(self._in, 1 << 16)
            if not part:
                raise EOFError("the browser ended")
            self._rest += part
        line, self._rest = self._rest.split(b"\0", 1)
        answer: dict[str, Any] = json.loads(line)
        return answer

    def _note(self, event: dict[str, Any]) -> None:
        method, said = event.get("method"), event.get("params", {})
        if method == "Runtime.exceptionThrown":
            self.complaints.append(str(said["exceptionDetails"]))
        elif method == "Runtime.consoleAPICalled" and said["type"] in ("error", "warning"):
            self.complaints.append(str(said["args"]))
        elif method == "Log.entryAdded" and said["entry"]["level"] in ("error", "warning"):
            self.complaints.append(str(said["entry"]))
