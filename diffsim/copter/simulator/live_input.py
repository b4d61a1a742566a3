"""A pilot at the keyboard or at a gamepad, through pygame (an optional package)."""

from __future__ import annotations

import os
import sys
from types import ModuleType

from diffsim.copter.simulator.sticks import Sticks
from diffsim.core.check import require_choice, require_number
from diffsim.core.errors import DiffsimError
from diffsim.core.optional import optional

DEVICES = ("keyboard", "gamepad")
HELP = "W/S up and down, A/D turn, arrow keys move over ground; Escape ends the flight"


class NoInputError(DiffsimError):
    """There is no display, or no gamepad."""


class LiveSticks:
    """Sticks read while the flight goes on; a ``Transmitter``.

    A small window takes the keys. Escape, or closing it, raises KeyboardInterrupt, which ends a
    flight as Ctrl-C does.

    Args:
        device: "keyboard", or "gamepad" (mode 2: left stick throttle and yaw, right stick the
            rest).
        dead_zone: Deflections of a gamepad up to this count as none.

    Raises:
        ImportError: pygame is not installed.
        NoInputError: no display, or no gamepad.
    """

    duration: float | None = None

    def __init__(self, device: str = "keyboard", *, dead_zone: float = 0.06):
        self.device = require_choice("device", device, DEVICES)
        self._dead_zone = require_number("dead_zone", dead_zone, at_least=0.0, below=1.0)
        self._pygame = _pygame()
        _require_display()
        self._pygame.init()
        self._pygame.display.set_mode((520, 60))
        self._pygame.display.set_caption(HELP if device == "keyboard" else "Escape ends the flight")
        if device == "gamepad":
            if self._pygame.joystick.get_count() == 0:
                self._pygame.quit()
                raise NoInputError("no gamepad found; plug one in, or fly with the keyboard")
            self._pad = self._pygame.joystick.Joystick(0)

    def sticks(self, time: float) -> Sticks:
        """What is pressed now."""
        pygame = self._pygame
        for event in pygame.event.get():
            escape = event.type == pygame.KEYDOWN and event.key == pygame.K_ESCAPE
            if event.type == pygame.QUIT or escape:
                pygame.quit()
                raise KeyboardInterrupt
        return self._from_keys() if self.device == "keyboard" else self._from_pad()

    def _from_keys(self) -> Sticks:
        pygame = self._pygame
        down = pygame.key.get_pressed()

        def axis(plus: int, minus: int) -> float:
            return float(bool(down[plus])) - float(bool(down[minus]))

        return Sticks(
            roll=axis(pygame.K_RIGHT, pygame.K_LEFT),
            pitch=axis(pygame.K_UP, pygame.K_DOWN),
            yaw=axis(pygame.K_d, pygame.K_a),
            throttle=axis(pygame.K_w, pygame.K_s),
        )

    def _from_pad(self) -> Sticks:
        yaw, throttle, roll, pitch = (self._axis(k) for k in (0, 1, 2, 3))
        return Sticks(roll=roll, pitch=-pitch, yaw=yaw, throttle=-throttle)  # down is positive

    def _axis(self, k: int) -> float:
        value = float(self._pad.get_axis(k)) if k < self._pad.get_numaxes() else 0.0
        return 0.0 if abs(value) <= self._dead_zone else max(-1.0, min(1.0, value))


def _pygame() -> ModuleType:
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    return optional(
        "pygame",
        purpose="flying by keyboard or gamepad",
        otherwise="fly a recorded stick file or a mission",
    )


def _require_display() -> None:
    if sys.platform.startswith("linux") and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    ):
        raise NoInputError(
            "keyboard and gamepad need a display, and there is none (DISPLAY is not set); fly a "
            "recorded stick file or a mission"
        )
