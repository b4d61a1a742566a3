"""An MJCF file whole, as text and files that MuJoCo needs nothing else for.

MuJoCo itself follows every file name, wherever it leads, quotes what it finds there, and makes as
many bodies as a number asks for. So names are followed here, inside of the folder of the file, and
what is made is counted. What has no mass may be left out: mass and inertia of a body that states
them need no shapes, hence no meshes.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from pathlib import Path, PurePosixPath

from diffsim.copter.exchange.stated_inertia import refuse_impossible_inertia
from diffsim.copter.exchange.xml_nodes import MAX_BYTES, parse_nodes, read_nodes
from diffsim.core.inside import inside

Element = ElementTree.Element
Files = dict[str, bytes]
MAX_BODIES = 2_000  # MuJoCo's compiler takes 4 s for so many, and grows with their square
MAX_MADE = 20_000  # elements, those counted that <replicate> and the like stand for
MAX_COUNT = 2_000  # of an attribute that asks for memory, such as nuser_body
#: Sections that places, masses and motors at sites come from; others name what may be left out.
_SECTIONS = ("compiler", "option", "size", "default", "asset", "worldbody", "actuator")
_NO_MASS = ("camera", "light")
_SHAPES = ("geom", "flexcomp", "composite", "skin")
_LOOKS = ("texture", "material", "skin")  # what only pictures show
_MAKERS = ("replicate", "composite", "flexcomp")
_COUNTS = ("nkey", "nuserdata", "nrow", "ncol", "dim", "nsample", "actdim")


def whole_mjcf(path: Path) -> tuple[str, Files]:
    """The text of an MJCF file with what it includes, for its masses, and its meshes by name.

    Args:
        path: The file; what it names lies in its folder.

    Raises:
        ValueError: it names a file outside of its folder, one that is not there, or makes too much.
    """
    root = _read_whole(path)
    compiler = _compiler(root)
    refuse_impossible_inertia(root, compiler)
    for section in list(root):
        if section.tag not in _SECTIONS:
            root.remove(section)
    for actuators in root.findall("actuator"):
        for actuator in [a for a in actuators if a.get("site") is None]:
            actuators.remove(actuator)
    for world in root.findall("worldbody"):
        _drop_shapes(world, compiler.get("inertiafromgeom", "auto"), weightless=True)
    needed = {g.get("mesh") for g in root.iter("geom")} - {None}
    for assets in root.findall("asset"):
        for asset in list(assets):
            name = asset.get("name") or PurePosixPath(asset.get("file", "")).stem
            if asset.tag != "mesh" or name not in needed:
                assets.remove(asset)
    return _with_files(root, compiler, path.parent)


def whole_scene(model: str | Path) -> tuple[str, Files]:
    """The text of an MJCF file with what it includes, for its motion, and its files by name.

    Args:
        model: The file; what it names lies in its folder. Or its text, which names no files.

    Raises:
        ValueError: as ``whole_mjcf``.
    """
    if isinstance(model, str) and model.lstrip().startswith("<"):
        parse_nodes(model.encode("utf-8"), "MJCF")
        root, folder = ElementTree.fromstring(model), None
        _put_includes(root, None, set())
        refuse_too_much(root)
    else:
        root, folder = _read_whole(Path(model)), Path(model).parent
    compiler = _compiler(root)
    refuse_impossible_inertia(root, compiler)
    for assets in root.findall("asset"):
        for asset in [a for a in assets if a.tag in _LOOKS]:
            assets.remove(asset)
    return _with_files(root, compiler, folder)


def _read_whole(path: Path) -> Element:
    root = _read(path)
    _put_includes(root, path.parent, {path.resolve()})
    refuse_too_much(root)
    return root


def _read(path: Path) -> Element:
    read_nodes(path)  # refuses what is over the bounds of files of strangers
    return ElementTree.parse(path).getroot()


def _put_includes(element: Element, folder: Path | None, seen: set[Path]) -> None:
    """The children of the root of an included file, in its place; each once, as in MuJoCo."""
    for k, child in reversed(list(enumerate(element))):
        if child.tag != "include":
            _put_includes(child, folder, seen)
            continue
        name = child.get("file", "")
        if folder is None:
            raise ValueError(f"<include> names {name!r}; give the model as a file")
        path = inside(folder, name, "file of <include>")
        if not path.is_file():
            raise ValueError(f"<include> names {name!r}, which is not beside it")
        if path.resolve() in seen:
            raise ValueError(f"{name!r} is included twice")
        seen.add(path.resolve())
        brought = _read(path)
        _put_includes(brought, folder, seen)
        element[k : k + 1] = list(brought)


def refuse_too_much(root: Element) -> None:
    """Refuse what a few letters could ask for: bodies by the million, memory by the gigabyte.

    Args:
        root: Of an MJCF or URDF file.

    Raises:
        ValueError: it makes too much; the message says of what.
    """
    made, bodies = _count_made(root)
    for what, count, most in (("elements", made, MAX_MADE), ("bodies", bodies, MAX_BODIES)):
        if count > most:
            raise ValueError(f"it makes {count:,} {what}; at most {most:,} are read")
    for element in root.iter():
        for name in element.attrib:
            if name in _COUNTS or name.startswith("nuser_"):
                _count(element, name)
        if str(element.get("memory", ""))[-1:].upper() in ("T", "P", "E"):
            raise ValueError(f"memory of <{element.tag}> must be in M or G")


def _count_made(element: Element) -> tuple[int, int]:
    """Elements and bodies that an element and those in it stand for."""
    made, bodies = 1, int(element.tag in ("body", "link"))
    for child in element:
        more = _count_made(child)
        made, bodies = made + more[0], bodies + more[1]
    if element.tag not in _MAKERS:
        return made, bodies
    times = max(_count(element, "count"), len(element.get("point", "").split()) // 3)
    return made * times, max(bodies, int(element.tag != "replicate")) * times


def _count(element: Element, name: str) -> int:
    """The product of the whole numbers of an attribute."""
    stated = element.get(name, "1")
    try:
        product = math.prod(max(int(n), 1) for n in stated.split()[:3])
    except ValueError:
        raise ValueError(f"{name} of <{element.tag}> must be whole, got {stated[:20]!r}") from None
    if product > MAX_COUNT:
        raise ValueError(
            f"{name} of <{element.tag}> must be at most {MAX_COUNT:,}, got {product:,}"
        )
    return product


def _compiler(root: Element) -> dict[str, str]:
    """Attributes of all ``<compiler>``, the last one counts; folders of files are taken out."""
    stated: dict[str, str] = {}
    for compiler in root.findall("compiler"):
        stated |= compiler.attrib
        for name in ("meshdir", "texturedir", "assetdir"):
            compiler.attrib.pop(name, None)
    return stated


def _drop_shapes(element: Element, from_shapes: str, *, weightless: bool) -> None:
    """Take out what has no mass, or whose mass the body states itself."""
    for child in list(element):
        if child.tag in _NO_MASS or (weightless and child.tag in _SHAPES):
            element.remove(child)
        elif child.tag == "body":
            states_mass = child.find("inertial") is not None and from_shapes != "true"
            _drop_shapes(child, from_shapes, weightless=states_mass or from_shapes == "false")
        else:  # such as a frame of the same body
            _drop_shapes(child, from_shapes, weightless=weightless)


def _with_files(root: Element, compiler: dict[str, str], folder: Path | None) -> tuple[str, Files]:
    """The text, and the files of its assets by the names that it now calls them."""
    files: Files = {}
    for element in root.iter():
        element.attrib.pop("material", None)
    for assets in root.findall("asset"):
        for asset in assets:
            stated = asset.get("file", "")
            if stated and asset.tag in ("mesh", "hfield"):
                beside = f"{asset.tag}_{len(files)}{PurePosixPath(stated).suffix}"
                files[beside] = _content(asset.tag, stated, compiler, folder)
                name = asset.get("name") or PurePosixPath(stated).stem
                asset.attrib |= {"name": name, "file": beside}
    for element in root.iter():
        named = [v for k, v in element.attrib.items() if k.startswith("file")]
        if any(name not in files for name in named):
            raise ValueError(f"<{element.tag}> reads another file, which is not done here")
    return ElementTree.tostring(root, encoding="unicode"), files


def _content(tag: str, stated: str, compiler: dict[str, str], folder: Path | None) -> bytes:
    if compiler.get("strippath") == "true":
        stated = PurePosixPath(stated).name
    if folder is None:
        raise ValueError(f"<{tag}> names {stated!r}; give the model as a file")
    below = compiler.get("meshdir", compiler.get("assetdir", ""))
    file = inside(folder, str(PurePosixPath(below, stated)), f"file of <{tag}>")
    if not file.is_file():
        raise ValueError(
            f"{tag} {stated!r} is not beside it, and a body takes its mass from it; bring it, "
            "or give that body <inertial>"
        )
    if (size := file.stat().st_size) > MAX_BYTES:
        raise ValueError(f"{tag} {stated!r} must have at most {MAX_BYTES:,} bytes, got {size:,}")
    return file.read_bytes()
