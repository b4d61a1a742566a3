"""An MJCF file whole, as text and files that MuJoCo needs nothing else for.

MuJoCo itself follows every file name, wherever it leads, quotes what it finds there, and makes as
many bodies as a number asks for. So names are followed here, inside of the folder of the file, and
what is made is counted. What has no mass may be left out: mass and inertia of a body that states
them need no shapes, hence no meshes.

Mass and moments of inertia that no body has are refused, in URDF's links, too.
"""

from __future__ import annotations

import itertools
import math
import posixpath
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath

from diffsim.copter.exchange.xml_nodes import MAX_BYTES, parse_nodes, read_nodes
from diffsim.core.inertia import ENTRIES, inertia_mistake, mass_mistake
from diffsim.core.inside import inside

Element = ElementTree.Element
Files = dict[str, bytes]
Made = tuple[int, int]  # elements and bodies
MAX_BODIES = 2_000  # MuJoCo's compiler takes 4 s for so many, and grows with their square
MAX_MADE = 20_000  # elements, those counted that <replicate> and the like stand for
MAX_ATTACHED = 20  # models that one attaches, and those that these attach
MAX_COUNT = 2_000  # of an attribute that asks for memory, such as nuser_body
#: Sections that places, masses and motors at sites come from; others name what may be left out.
_SECTIONS = ("compiler", "option", "size", "default", "asset", "worldbody", "actuator")
_NO_MASS = ("camera", "light")
_SHAPES = ("geom", "flexcomp", "composite", "skin")
_LOOKS = ("texture", "material", "skin")  # what only pictures show
_OF_MESHES = ("mesh", "hfield", "flexcomp")  # what reads a file of shapes
_MAKERS = ("replicate", "composite", "flexcomp")
_COUNTS = ("nkey", "nuserdata", "nrow", "ncol", "dim", "nsample", "actdim")


@dataclass(frozen=True)
class _Place:
    """Where an MJCF file stands."""

    root: Path  # folder that no name in the file leaves
    below: str = ""  # folder of the file, relative to the root

    @classmethod
    def of(cls, path: Path, root: Path | None) -> _Place:
        """The place of a file; without a root the file's own folder is the root."""
        if root is None:
            return cls(path.parent)
        return cls(root, path.parent.relative_to(root).as_posix())

    def find(self, stated: str, what: str, below: str = "") -> Path:
        """The path of a name, which may go up by ``..`` as far as the root."""
        if not stated or PureWindowsPath(stated).anchor:
            return inside(self.root, stated, what)
        path = posixpath.normpath(posixpath.join(self.below, below, stated))
        return inside(self.root, path, what)


def whole_mjcf(path: Path) -> tuple[str, Files]:
    """The text of an MJCF file with what it includes, for its masses, and its meshes by name.

    Args:
        path: The file; what it names lies in its folder.

    Raises:
        ValueError: it names a file outside of its folder, one that is not there, or makes too much.
    """
    place = _Place.of(path, None)
    root = _read_whole(path, place)
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
    return _with_files(root, compiler, place)


def whole_scene(model: str | Path, folder: Path | None = None) -> tuple[str, Files]:
    """The text of an MJCF file with what it includes, for its motion, and its files by name.

    Args:
        folder: Folder that holds the file and all that it names; None: that of the file.

    Raises:
        ValueError: as ``whole_mjcf``.
    """
    place: _Place | None = None
    if isinstance(model, str) and model.lstrip().startswith("<"):
        parse_nodes(model.encode("utf-8"), "MJCF")
        root = ElementTree.fromstring(model)
        _put_includes(root, None, set())
        refuse_too_much(root)
    else:
        place = _Place.of(Path(model), folder)
        root = _read_whole(Path(model), place)
    return _scene_of(root, place, itertools.count())[:2]


def _scene_of(
    root: Element, place: _Place | None, numbers: Iterator[int], prefix: str = ""
) -> tuple[str, Files, Made]:
    """Text, files and number of elements of a model; its files are called by the prefix."""
    compiler = _compiler(root)
    refuse_impossible_inertia(root, compiler)
    for section in [*root.findall("asset"), *root.findall("deformable")]:
        for element in [e for e in section if e.tag in _LOOKS]:
            section.remove(element)
    brought: Files = {}
    made: dict[str, Made] = {}
    for asset in [a for assets in root.findall("asset") for a in assets if a.tag == "model"]:
        text, files, number = _bring_model(asset, place, numbers)
        brought |= {asset.attrib["file"]: text.encode("utf-8"), **files}
        made[asset.attrib["name"]] = number
    number = refuse_too_much(root, made)
    text, files = _with_files(root, compiler, place, prefix, brought)
    return text, brought | files, number


def _bring_model(
    asset: Element, place: _Place | None, numbers: Iterator[int]
) -> tuple[str, Files, Made]:
    """The model of a file that another one attaches, under the name that it now has."""
    stated, k = asset.get("file", ""), next(numbers)
    if place is None:
        raise ValueError(f"<model> names {stated!r}; give the model as a file")
    if k == MAX_ATTACHED:
        raise ValueError(f"<model> names {stated!r}: at most {MAX_ATTACHED} models are brought")
    path = place.find(stated, "file of <model>")
    if not path.is_file():
        raise ValueError(f"<model> names {stated!r}, which is not beside it")
    own = _Place.of(path, place.root)
    asset.attrib |= {"name": asset.get("name") or path.stem, "file": f"model_{k}.xml"}
    return _scene_of(_read_whole(path, own), own, numbers, f"model_{k}_")


def _read_whole(path: Path, place: _Place) -> Element:
    root = _read(path)
    _put_includes(root, place, {path.resolve()})
    refuse_too_much(root)
    return root


def _read(path: Path) -> Element:
    read_nodes(path)  # refuses what is over the bounds of files of strangers
    return ElementTree.parse(path).getroot()


def _put_includes(element: Element, place: _Place | None, seen: set[Path], below: str = "") -> None:
    """The children of the root of an included file, in its place; each once, as in MuJoCo.

    A name is one beside the main file; where there is none, one beside the file that includes it.
    """
    for k, child in reversed(list(enumerate(element))):
        if child.tag != "include":
            _put_includes(child, place, seen, below)
            continue
        name = child.get("file", "")
        if place is None:
            raise ValueError(f"<include> names {name!r}; give the model as a file")
        path, own = place.find(name, "file of <include>"), posixpath.dirname(name)
        if not path.is_file() and below:
            own = posixpath.join(below, own)
            path = place.find(name, "file of <include>", below)
        if not path.is_file():
            raise ValueError(f"<include> names {name!r}, which is not beside it")
        if path.resolve() in seen:
            raise ValueError(f"{name!r} is included twice")
        seen.add(path.resolve())
        brought = _read(path)
        _put_includes(brought, place, seen, own)
        element[k : k + 1] = list(brought)


def refuse_too_much(root: Element, attached: Mapping[str, Made] | None = None) -> Made:
    """Refuse what a few letters could ask for: bodies by the million, memory by the gigabyte.

    Args:
        root: Of an MJCF or URDF file.
        attached: Elements and bodies of the models that it attaches, by name; None: not known yet.

    Returns:
        Elements and bodies that it makes.

    Raises:
        ValueError: it makes too much; the message says of what.
    """
    made, bodies = _count_made(root, attached)
    for what, count, most in (("elements", made, MAX_MADE), ("bodies", bodies, MAX_BODIES)):
        if count > most:
            raise ValueError(f"it makes {count:,} {what}; at most {most:,} are read")
    for element in root.iter():
        for name in element.attrib:
            if name in _COUNTS or name.startswith("nuser_"):
                _count(element, name)
        if str(element.get("memory", ""))[-1:].upper() in ("T", "P", "E"):
            raise ValueError(f"memory of <{element.tag}> must be in M or G")
    return made, bodies


def _count_made(element: Element, attached: Mapping[str, Made] | None) -> Made:
    """Elements and bodies that an element and those in it stand for."""
    made, bodies = 1, int(element.tag in ("body", "link"))
    if element.tag == "attach" and attached is not None:
        name = element.get("model", "")
        if name not in attached:
            raise ValueError(f"<attach> names the model {name!r}, which no <model> brings")
        made, bodies = attached[name]
    for child in element:
        more = _count_made(child, attached)
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


def _with_files(
    root: Element,
    compiler: dict[str, str],
    place: _Place | None,
    prefix: str = "",
    brought: Iterable[str] = (),
) -> tuple[str, Files]:
    """The text, and the files of its shapes by the names that it now calls them."""
    files: Files = {}
    for element in root.iter():
        element.attrib.pop("material", None)
        stated = element.get("file", "")
        if stated and element.tag in _OF_MESHES:
            suffix = PurePosixPath(stated).suffix
            beside = f"{prefix}{element.tag}_{len(files)}{suffix}"
            files[beside] = _content(element.tag, stated, compiler, place)
            name = element.get("name") or PurePosixPath(stated).stem
            element.attrib |= {"name": name, "file": beside}
    known = {*files, *brought}
    for element in root.iter():
        named = [v for k, v in element.attrib.items() if k.startswith("file")]
        if any(name not in known for name in named):
            raise ValueError(f"<{element.tag}> reads another file, which is not done here")
    return ElementTree.tostring(root, encoding="unicode"), files


def _content(tag: str, stated: str, compiler: dict[str, str], place: _Place | None) -> bytes:
    if compiler.get("strippath") == "true":
        stated = PurePosixPath(stated).name
    if place is None:
        raise ValueError(f"<{tag}> names {stated!r}; give the model as a file")
    below = compiler.get("meshdir", compiler.get("assetdir", ""))
    file = place.find(posixpath.join(below, stated), f"file of <{tag}>")
    if not file.is_file():
        raise ValueError(
            f"{tag} {stated!r} is not beside it, and a body takes its mass from it; bring it, "
            "or give that body <inertial>"
        )
    if (size := file.stat().st_size) > MAX_BYTES:
        raise ValueError(f"{tag} {stated!r} must have at most {MAX_BYTES:,} bytes, got {size:,}")
    return file.read_bytes()


_DIAGONAL = tuple(f"diaginertia[{k}]" for k in range(3))
_FULL = tuple(f"{name} (fullinertia[{k}])" for k, name in enumerate(ENTRIES))


def refuse_impossible_inertia(root: Element, compiler: dict[str, str] | None = None) -> None:
    """Refuse inertia that no body has, by the name of its link or body.

    Args:
        root: Of an MJCF or URDF file, included files in their places.
        compiler: Attributes of MJCF's ``<compiler>``: what it balances or computes is not asked.

    Raises:
        ValueError: with the entry, what must hold of it, and the likely slip.
    """
    stated = compiler or {}
    if stated.get("inertiafromgeom") == "true":
        return
    triangle = stated.get("balanceinertia") != "true"
    for owner in root.iter():
        inertial = owner.find("inertial") if owner.tag in ("link", "body") else None
        if inertial is None:
            continue
        try:
            mass, entries, names = _read_inertial(inertial)
        except ValueError:
            continue  # not a number: MuJoCo names it
        named = dict(zip(names, entries, strict=True))
        said = None if mass is None else mass_mistake(mass, named)
        if said is None and any(entries):
            said = inertia_mistake(entries, names, triangle=triangle)
        if said is not None:
            raise ValueError(f"{owner.tag} {owner.get('name', 'without a name')!r}: {said}")


def _read_inertial(inertial: Element) -> tuple[float | None, tuple[float, ...], tuple[str, ...]]:
    """Mass, six entries and their names in the file; zeros where nothing is stated."""
    weighs, tensor = inertial.find("mass"), inertial.find("inertia")
    mass = inertial.get("mass") if weighs is None else weighs.get("value")
    if tensor is not None:
        return _number(mass), tuple(float(tensor.get(e, "0")) for e in ENTRIES), ENTRIES
    diagonal = [float(x) for x in inertial.get("diaginertia", "").split()]
    if len(diagonal) == 3:
        return _number(mass), (*diagonal, 0.0, 0.0, 0.0), (*_DIAGONAL, *ENTRIES[3:])
    full = [float(x) for x in inertial.get("fullinertia", "").split()]
    return _number(mass), tuple(full) if len(full) == 6 else (0.0,) * 6, _FULL


def _number(text: str | None) -> float | None:
    return None if text is None else float(text)
