"""Optional packages: imported when needed, asked for before work starts, named as pip knows them.

The advice names the packages themselves, which works for every way of installing; the extra of
diffsim that has them stands beside.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import re
from collections.abc import Sequence
from types import ModuleType

DISTRIBUTION = "diffsim-robot"
# Modules whose distribution has another name.
_NAMES = {
    "cv2": "opencv-python-headless",
    "elastica": "pyelastica",
    "mcap_ros2": "mcap-ros2-support",
    "pxr": "usd-core",
    "rerun": "rerun-sdk",
}


def requirement(module: str) -> str:
    """What pip calls the distribution of a module, with the versions diffsim works with.

    Args:
        module: name as it is imported, such as ``"osqp"`` or ``"stable_baselines3.common"``.

    Returns:
        Such as ``"osqp>=0.6.7"``; the bare name where diffsim's own metadata is not installed.
    """
    top = module.partition(".")[0]
    name = _NAMES.get(top, top).replace("_", "-")
    try:
        lines = importlib.metadata.requires(DISTRIBUTION) or []
    except importlib.metadata.PackageNotFoundError:
        return name
    for line in lines:
        wanted = line.partition(";")[0].strip()
        if re.split(r"[<>=!~\[ ]", wanted)[0].replace("_", "-").lower() == name:
            return wanted
    return name


def extras() -> dict[str, list[str]]:
    """Requirements of each extra, by its name; none where diffsim's metadata is not installed."""
    try:
        lines = importlib.metadata.requires(DISTRIBUTION) or []
    except importlib.metadata.PackageNotFoundError:
        return {}
    found: dict[str, list[str]] = {}
    for line in lines:
        wanted, _, condition = line.partition(";")
        if (extra := re.search(r"extra == ['\"](\w+)['\"]", condition)) and "[" not in wanted:
            found.setdefault(extra[1], []).append(wanted.strip())
    return found


def lacking(requirements: Sequence[str]) -> list[str]:
    """Names of the distributions among requirements that are not installed."""
    lacks = []
    for name in (re.split(r"[<>=!~\[ ]", wanted)[0] for wanted in requirements):
        try:
            importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            lacks.append(name)
    return lacks


def advice(modules: Sequence[str]) -> str:
    """The command that installs such modules.

    Args:
        modules: names as they are imported.

    Returns:
        Such as ``pip install 'osqp>=0.6.7' 'cvxpy>=1.5' (extra opt of diffsim-robot)``.
    """
    wanted = dict.fromkeys(requirement(module) for module in modules)
    offered = {name: has for name, has in extras().items() if name != "all"}
    whole = [name for name, has in offered.items() if set(wanted) <= set(has)][:1]
    each = [next((n for n, has in offered.items() if one in has), "") for one in wanted]
    names = whole or (list(dict.fromkeys(each)) if all(each) else [])
    where = f" (extra{'s' * (len(names) > 1)} {', '.join(names)} of {DISTRIBUTION})" * bool(names)
    command = " ".join(f"'{r}'" if re.search(r"[<>=]", r) else r for r in wanted)
    return f"pip install {command}{where}"


def optional(module: str, *, purpose: str, otherwise: str = "") -> ModuleType:
    """Import an optional module, or say what it is for and how to get it.

    Args:
        purpose: what needs it, as the subject of the sentence.
        otherwise: what works without it, for the end of the sentence.

    Returns:
        The module.

    Raises:
        ImportError: the package is not installed, or does not import.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        top = module.partition(".")[0]
        lacks = f"which does not import ({error})" if present(top) else "which is not installed"
        text = f"{purpose} needs {top}, {lacks}: {advice([module])}"
        raise ImportError(f"{text}; or {otherwise}" if otherwise else text) from error


def present(module: str) -> bool:
    """Whether a module is installed; nothing of it is imported.

    Args:
        module: name of a top-level module.
    """
    return importlib.util.find_spec(module) is not None


def ask_for(modules: Sequence[str], *, purpose: str) -> None:
    """Say what is missing before work starts that needs it at its end.

    Args:
        modules: names of top-level modules.
        purpose: what needs them, as the subject of the sentence.

    Raises:
        ImportError: one or more are not installed; all are named, with the command.
    """
    missing = [module for module in modules if not present(module)]
    if missing:
        listed = " and ".join([", ".join(missing[:-1]), missing[-1]] if missing[1:] else missing)
        verb = "is" if len(missing) == 1 else "are"
        raise ImportError(
            f"{purpose} needs {listed}, which {verb} not installed: {advice(missing)}"
        )
