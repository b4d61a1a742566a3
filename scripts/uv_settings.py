"""What uv has to be told so that it installs from where pip would; scripts/setup asks.

    python scripts/uv_settings.py     # one NAME=VALUE a line, for the environment of uv

uv does not read pip's configuration. The script ends with 1 where a setting of pip has no twin in
uv: then pip itself has to install.
"""

from __future__ import annotations

import ast
import subprocess
import sys

SECTIONS = ("global", "install", ":env:")  # later ones override, as in pip
# pip's setting -> uv's variable, and what uv has between several values
TWINS = {
    "index-url": ("UV_DEFAULT_INDEX", " "),
    "extra-index-url": ("UV_INDEX", " "),
    "find-links": ("UV_FIND_LINKS", ","),
    "no-index": ("UV_NO_INDEX", " "),
    "constraint": ("UV_CONSTRAINT", " "),
    "trusted-host": ("UV_INSECURE_HOST", " "),
    "cert": ("SSL_CERT_FILE", " "),
    "proxy": ("ALL_PROXY", " "),
    "timeout": ("UV_HTTP_TIMEOUT", " "),
    "default-timeout": ("UV_HTTP_TIMEOUT", " "),
    "retries": ("UV_HTTP_RETRIES", " "),
    "no-cache-dir": ("UV_NO_CACHE", " "),
}
PINS = "constraints.txt"
# These change what pip reads, says or keeps, not what is installed; versions are pinned.
OF_PIP_ALONE = {
    *("break-system-packages", "cache-dir", "config-file", "disable-pip-version-check", "no-color"),
    *("no-input", "no-warn-script-location", "prefer-binary", "progress-bar", "quiet"),
    *("require-virtualenv", "root-user-action", "verbose"),
}


def settings_of(listed: str) -> dict[str, str]:
    """Settings that ``pip install`` obeys, by name.

    Args:
        listed: What ``pip config list`` prints: ``section.name='value'``, one a line.
    """
    out = {}
    for section in SECTIONS:
        for line in listed.splitlines():
            key, _, value = line.partition("=")
            if key.startswith(f"{section}."):
                out[key.removeprefix(f"{section}.")] = str(ast.literal_eval(value))
    return out


def environment_of(settings: dict[str, str]) -> dict[str, str] | None:
    """The environment in which uv installs from where pip would; None: uv has no twin of one.

    Args:
        settings: Of pip, by name.
    """
    # pip takes the best version of all indexes; uv stops at the first that knows the name
    out = {"UV_INDEX_STRATEGY": "unsafe-best-match", "UV_CONSTRAINT": PINS}
    for name, value in settings.items():
        if name in TWINS:
            variable, between = TWINS[name]
            # constraints of pip's own hold beside the pins: --constraint would replace the variable
            own = [out[variable]] if name == "constraint" else []
            out[variable] = between.join([*own, *value.split()])
        elif name not in OF_PIP_ALONE:
            return None
    return out


def main() -> int:
    pip = [sys.executable, "-m", "pip", "config", "list"]
    listed = subprocess.run(pip, capture_output=True, text=True, check=True).stdout
    found = environment_of(settings_of(listed))
    for name, value in (found or {}).items():
        print(f"{name}={value}")
    return int(found is None)


if __name__ == "__main__":
    sys.exit(main())
