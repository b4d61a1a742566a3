"""An MJCF file whole, as text and meshes that MuJoCo needs nothing else for.

MuJoCo itself follows every file name, wherever it leads, and quotes what it finds there. So names
are followed here, inside of the folder of the file. What has no mass is left out: mass and
inertia of a body that states them need no shapes, hence no meshes.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path, PurePosixPath

from diffsim.copter.exchange.xml_nodes import MAX_DEPTH, read_nodes
from diffsim.core.inside import inside

Element = ElementTree.Element
#: Sections that places, masses and motors at sites come from; others name what may be left out.
_SECTIONS = ("compiler", "option", "size", "default", "asset", "worldbody", "actuator")
_NO_MASS = ("camera", "light")
_SHAPES = ("geom", "flexcomp", "composite", "skin")


def whole_mjcf(path: Path) -> tuple[str, dict[str, bytes]]:
    """The text of an MJCF file with what it includes, and its meshes by name.

    Args:
        path: The file; what it names lies in its folder.

    Raises:
        ValueError: it names a file outside of its folder, or one that is not there.
    """
    root = _read(path)
    _put_includes(root, path.parent, 0)
    compiler = _compiler(root)
    for section in list(root):
        if section.tag not in _SECTIONS:
            root.remove(section)
    for actuators in root.findall("actuator"):
        for actuator in [a for a in actuators if a.get("site") is None]:
            actuators.remove(actuator)
    for world in root.findall("worldbody"):
        _drop_shapes(world, compiler.get("inertiafromgeom", "auto"), weightless=True)
    for element in root.iter():
        element.attrib.pop("material", None)
    meshes = _bring_meshes(root, compiler, path)
    return ElementTree.tostring(root, encoding="unicode"), meshes


def _read(path: Path) -> Element:
    read_nodes(path)  # refuses what is over the bounds of files of strangers
    return ElementTree.parse(path).getroot()


def _put_includes(element: Element, folder: Path, depth: int) -> None:
    """The children of the root of an included file, in its place."""
    if depth > MAX_DEPTH:
        raise ValueError(f"more than {MAX_DEPTH} files include each other")
    for k, child in reversed(list(enumerate(element))):
        if child.tag == "include":
            name = child.get("file", "")
            path = inside(folder, name, "file of <include>")
            if not path.is_file():
                raise ValueError(f"<include> names {name!r}, which is not beside it")
            brought = _read(path)
            _put_includes(brought, folder, depth + 1)
            element[k : k + 1] = list(brought)
        else:
            _put_includes(child, folder, depth)


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


def _bring_meshes(root: Element, compiler: dict[str, str], path: Path) -> dict[str, bytes]:
    """Meshes that shapes with a mass still need; all other assets are left out."""
    needed = {g.get("mesh") for g in root.iter("geom")} - {None}
    meshes: dict[str, bytes] = {}
    for assets in root.findall("asset"):
        for asset in list(assets):
            stated = asset.get("file", "")
            name = asset.get("name") or PurePosixPath(stated).stem
            if asset.tag != "mesh" or name not in needed:
                assets.remove(asset)
            elif stated:
                beside = f"mesh_{len(meshes)}{PurePosixPath(stated).suffix}"
                meshes[beside] = _mesh(stated, compiler, path)
                asset.attrib |= {"name": name, "file": beside}
    if other := [e.tag for e in root.iter() if e.get("file") not in (None, *meshes)]:
        raise ValueError(f"<{other[0]}> reads another file, which is not done here")
    return meshes


def _mesh(stated: str, compiler: dict[str, str], path: Path) -> bytes:
    if compiler.get("strippath") == "true":
        stated = PurePosixPath(stated).name
    folder = compiler.get("meshdir", compiler.get("assetdir", ""))
    file = inside(path.parent, str(PurePosixPath(folder, stated)), "file of <mesh>")
    if not file.is_file():
        raise ValueError(
            f"mesh {stated!r} is not beside it, and a body takes its mass from it; bring the mesh, "
            "or give that body <inertial>"
        )
    return file.read_bytes()
