"""Causes of soft bodies by name, for models that no study describes."""

from __future__ import annotations

from diffsim.systems import library
from diffsim.systems.soft_body.causes import body_cause

PULL_M = 0.03  # greatest command
ANY_BODY = library("soft_body", reach=PULL_M)
CAUSES = {e.name: e for e in (*ANY_BODY, body_cause("slack_string"))}
