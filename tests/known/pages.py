"""Numbers that a page shows: its sentences and tables, and what its charts and views draw."""

import base64
import html
import json
import re
from collections.abc import Iterator
from typing import Any

import numpy as np

from tests.known.fingerprint import numbers_in

CHART = re.compile(r'Plotly\.newPlot\(\s*"[^"]*",\s*')
VIEW = re.compile(r'<script type="application/json"[^>]*>(.*?)</script>', re.DOTALL)
UNSHOWN = re.compile(r"<(script|style|svg)\b.*?</\1>|<[^>]*>", re.DOTALL)
DRAWN = {"triangles": "<u2", "levels": "<u2", "poses": "<f4"}  # of a view that moves
LEFT_OUT = ("template", "color", "colorscale")  # of a chart: how it looks


def parts_of_page(text: str) -> Iterator[tuple[str, Any]]:
    """Numbers of each section, each chart and each view, without those of the machine."""
    main = text.partition("<main>")[2] or text
    shown = main.partition("<h2>Made with</h2>")[0]
    for k, section in enumerate(re.split(r"<section>|<footer>", shown)):
        for n, chart in enumerate(CHART.finditer(section)):
            yield f"{k} chart {n}", _chart_at(section, chart.end())
        for n, view in enumerate(VIEW.finditer(section)):
            yield f"{k} view {n}", _drawn(json.loads(view[1]))
        yield str(k), numbers_in(html.unescape(UNSHOWN.sub(" ", section)))


def _chart_at(text: str, at: int) -> list[Any]:
    """Traces and layout of a chart whose traces begin at a place."""
    decoder, out = json.JSONDecoder(), []
    for _ in range(2):
        value, end = decoder.raw_decode(text, at)
        out.append(_drawn(value))
        at = end + re.match(r"\s*,\s*", text[end:]).end()
    return out


def _drawn(value: Any) -> Any:
    """Numbers of a chart or a view; texts give those that they say."""
    if isinstance(value, dict) and "bdata" in value:
        return np.frombuffer(base64.b64decode(value["bdata"]), value["dtype"])
    if isinstance(value, dict):
        return {
            key: np.frombuffer(base64.b64decode(v), _kind_of(key, value))
            if key in DRAWN
            else _drawn(v)
            for key, v in value.items()
            if key not in LEFT_OUT
        }
    if isinstance(value, list):
        return [_drawn(part) for part in value]
    return numbers_in(value) if isinstance(value, str) else value


def _kind_of(key: str, part: dict[str, Any]) -> str:
    return "<u4" if key == "triangles" and part["wide"] else DRAWN[key]
