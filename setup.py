"""Build the compiled core: the same sources once per instruction set, chosen at import.

One extension per instruction set keeps dispatch out of the kernels and rules out that an inline
function compiled for AVX-512 is picked by the linker on behalf of the baseline build.
"""

import copy
import hashlib
import os
import platform
import re
import runpy
import shutil
import sys
import sysconfig
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import nanobind
from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext
from setuptools.command.build_py import build_py

ROOT = Path(__file__).resolve().parent
# What each needs of the processor, and what this one has: the file that the import reads as well.
PROCESSOR = runpy.run_path(str(ROOT / "diffsim" / "core" / "processor.py"))
# From 3.12 on one library serves all later Pythons: nanobind needs no more than their stable ABI.
STABLE_ABI = (
    sys.version_info >= (3, 12)
    and platform.python_implementation() == "CPython"
    and not sysconfig.get_config_var("Py_GIL_DISABLED")
)
# What one Python adds to its compiler and another does not; kernels know nothing of Python.
PYTHONS_OWN = ("-Wno-unused-result", "-fno-strict-overflow", "-fwrapv")
# Scripts that the checkout keeps beside the package, and the wheel in it.
SCRIPTS = ("examples", "labs/balls", "labs/loop", "rl")
# Bindings convert arguments and compute nothing; -O3 makes them larger and slower to compile.
BINDINGS_LEVEL = "-Os"
# Kernels of these folders are compiled together, this many lines at a time: what they include is
# then read once. Where a function is inlined, a product and a sum may become one instruction that
# rounds once: a folder stands here if all reference numbers stay as they are. Those of
# csrc/kernels/stokes do not. DIFFSIM_UNITY=0 compiles each file by itself.
UNIT_FOLDERS = ("kernels/linalg", "kernels/soft", "kernels/soft/contact")
UNIT_LINES = 800
UNITY = os.environ.get("DIFFSIM_UNITY", "1") != "0"
# name -> compiler flags; diffsim/core/compiled.py picks the best one the processor has.
PREFIX = "diffsim._core_"
# Sanitizers, say; tests/test_sanitizers.py builds with them.
MORE_FLAGS = os.environ.get("DIFFSIM_BUILD_FLAGS", "").split()
INSTRUCTION_SETS: dict[str, list[str]] = {"baseline": []}
if platform.machine().lower() in ("x86_64", "amd64"):
    INSTRUCTION_SETS["avx2"] = ["-march=x86-64-v3"]
    INSTRUCTION_SETS["avx512"] = ["-march=x86-64-v4", "-mprefer-vector-width=512"]


def eigen_include() -> str:
    """Folder of the Eigen headers: the cmeel wheel, then EIGEN3_INCLUDE_DIR, then the system."""
    candidates = [Path(p) / "cmeel.prefix/include/eigen3" for p in sys.path]
    candidates += [Path(p) for p in [os.environ.get("EIGEN3_INCLUDE_DIR", "")] if p]
    candidates += [Path("/usr/include/eigen3"), Path("/usr/local/include/eigen3")]
    for path in candidates:
        if (path / "Eigen/Core").is_file():
            return str(path)
    raise SystemExit(
        "Eigen headers not found: pip install cmeel-eigen, or set EIGEN3_INCLUDE_DIR to the "
        "folder that holds Eigen/Core"
    )


def eigen_version() -> str:
    """Version as the headers state it, such as '3.4.0'; Eigen 5 keeps it in another file."""
    util = Path(eigen_include()) / "Eigen"
    files = [util / "Version", util / "src/Core/util/Macros.h"]
    text = "".join(p.read_text() for p in files if p.is_file())
    return ".".join(re.findall(r"define EIGEN_(?:WORLD|MAJOR|MINOR|PATCH)_VERSION (\d+)", text))


def extensions() -> list[Extension]:
    nb = Path(nanobind.include_dir()).parent
    sources = sorted(str(p.relative_to(ROOT)) for p in (ROOT / "csrc").rglob("*.cpp"))
    headers = sorted(str(p.relative_to(ROOT)) for p in (ROOT / "csrc").rglob("*.h"))
    flags = [
        *("-std=c++17", "-O3", "-g0", "-DNDEBUG", "-fvisibility=hidden", "-fno-strict-aliasing"),
        *(
            "-fno-math-errno",
            "-fno-trapping-math",
            "-Wall",
            "-Wextra",
            "-Wno-psabi",
            "-Wno-maybe-uninitialized",
        ),
        *MORE_FLAGS,
    ]
    return [
        Extension(
            f"{PREFIX}{name}",
            sources=sources,
            depends=headers,
            include_dirs=[
                "csrc",
                *(str(nb / part) for part in ("include", "src", "ext/robin_map/include")),
                eigen_include(),
            ],
            define_macros=[
                ("DIFFSIM_MODULE", f"_core_{name}"),
                ("NB_DOMAIN", f"diffsim_{name}"),
                ("NB_COMPACT_ASSERTIONS", None),
            ],
            extra_compile_args=[*flags, *arch],
            extra_link_args=["-pthread", *(f for f in MORE_FLAGS if f.startswith("-fsanitize"))],
            language="c++",
            py_limited_api=STABLE_ABI,
        )
        for name, arch in INSTRUCTION_SETS.items()
    ]


NO_COMPILER = """{name!r} is missing: diffsim needs a C++17 compiler (GCC >= 12 or Clang >= 12).
  Debian, Ubuntu:  sudo apt-get install g++ python3-dev
  Fedora:          sudo dnf install gcc-c++ python3-devel
  macOS:           xcode-select --install
  or name one:     CXX=clang++ pip install .
"""


def chosen(wanted: str, here: str) -> set[str]:
    """Names of the instruction sets to build.

    Args:
        wanted: comma-separated names; ``native`` is this machine's best, ``all`` is all, ``none``
            leaves the compiled core to another command.
        here: this machine's best.
    """
    names = {here if name == "native" else name for name in wanted.split(",") if name}
    if names == {"none"}:
        return set()
    if "all" in names:
        return set(INSTRUCTION_SETS)
    if unknown := names - set(INSTRUCTION_SETS):
        raise SystemExit(
            f"DIFFSIM_BUILD_ISA={wanted!r}: {sorted(unknown)} unknown; "
            f"choose from native, all, none, {', '.join(INSTRUCTION_SETS)}"
        )
    return names


def of_kernels(command: list[str]) -> list[str]:
    """The compiler's command with one set of flags under every Python, as 3.11 orders them."""
    own = [word for word in command if word not in PYTHONS_OWN]
    if own:
        own.insert(own.index("-g") + 1 if "-g" in own else len(own), "-fwrapv")
    return own


def folder_of(key: list[object]) -> Path:
    """Where objects are kept that were made with such tools."""
    return ROOT / "build" / "objects" / hashlib.sha256(repr(key).encode()).hexdigest()[:12]


def read(path: Path) -> str:
    """Text of a file, empty where there is none."""
    return path.read_text() if path.is_file() else ""


def includes_eigen(source: str) -> bool:
    """Whether a file of csrc includes Eigen, itself or through our own headers."""
    todo, seen = [source], {source}
    while todo:
        text = read(Path(todo.pop()))
        if "#include <Eigen/" in text:
            return True
        found = {f"csrc/{name}" for name in re.findall(r'^#include "([^"]+)"', text, re.M)} - seen
        seen |= found
        todo += found
    return False


def even_shares(sources: list[str], limit: int) -> list[list[str]]:
    """The sources in their order, cut into shares of about as many lines, at most ``limit``."""
    lines = [read(Path(source)).count("\n") + 1 for source in sources]
    count = -(-sum(lines) // limit)
    shares: list[list[str]] = [[] for _ in range(count)]
    before = 0
    for source, own in zip(sources, lines, strict=True):
        middle = before + own / 2
        shares[int(middle * count / sum(lines))].append(source)
        before += own
    return [share for share in shares if share]


def groups_of(sources: list[str]) -> dict[str, list[str]]:
    """Name of each unit to compile, and its sources; every source is in one unit.

    Those that include Eigen, which takes 1.2 s to read, stand together and apart from the others.
    """
    folders: dict[str, list[str]] = {}
    units = {}
    for source in sources:
        folder = Path(source).parent.relative_to("csrc").as_posix()
        if UNITY and folder in UNIT_FOLDERS:
            name = folder.replace("/", "-") + "-eigen" * includes_eigen(source)
            folders.setdefault(name, []).append(source)
        else:
            units[source] = [source]
    for folder, members in folders.items():
        for i, share in enumerate(even_shares(members, UNIT_LINES)):
            name = share[0] if len(share) == 1 else f"build/units/{folder}-{i}.cpp"
            units[name] = share
    return units


def unit_text(members: list[str]) -> str:
    """A unit that includes its members; GCC takes what they define locally for a header's."""
    includes = [f'#include "{name.removeprefix("csrc/")}"' for name in members]
    guard = ["#if !defined(__clang__)", '#pragma GCC diagnostic ignored "-Wsubobject-linkage"']
    return "\n".join([*guard, "#endif", *includes, ""])


def write_units(units: dict[str, list[str]]) -> None:
    """Write the units of several members where they do not stand already."""
    for name, members in units.items():
        path, text = Path(name), unit_text(members)
        if [name] != members and read(path) != text:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)


def is_kernel(unit: str) -> bool:
    """Whether a unit knows nothing of Python: a kernel, or several."""
    return unit.startswith(("csrc/kernels/", "build/units/"))


def sources_of(rule: Path) -> list[Path]:
    """Files of csrc that an object was made of, by the rule that the compiler wrote.

    The unit is one of them: who joins or leaves it changes the object.
    """
    files = re.split(r"[\s\\]+", read(rule).partition(":")[2])
    return [Path(name) for name in sorted(set(files)) if name.startswith(("csrc/", "build/units/"))]


def newest(rule: Path) -> float:
    """Time of the last change of what an object was made of."""
    return max((p.stat().st_mtime for p in sources_of(rule) if p.is_file()), default=0.0)


def content_hash(rule: Path) -> str:
    """Hash of the files of csrc that an object was made of, by the rule that the compiler wrote.

    Contents, not times: a fresh checkout beside old objects compiles what differs and no more.
    """
    ours = [str(path) for path in sources_of(rule)]
    parts = [f"{name} {hashlib.sha256(read(Path(name)).encode()).hexdigest()}" for name in ours]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


class BuildExt(build_ext):
    """Compile every (instruction set, unit) pair in parallel, and only what changed.

    An object is current while its sources and the headers they include read as they did.

    Objects are kept in build/objects/<key> (pip's own build folder is gone after each run); the key
    holds all that changes an object besides the sources: compiler, flags and Eigen; for bindings
    nanobind and Python as well. So a wheel for another Python compiles the bindings alone.

    An editable install is for this machine: it gets this machine's instruction set. What may be
    carried elsewhere (wheels) gets all; ``DIFFSIM_BUILD_ISA`` says otherwise.
    """

    def finalize_options(self) -> None:
        super().finalize_options()
        here = self.inplace or getattr(self, "editable_mode", False)
        wanted = os.environ.get("DIFFSIM_BUILD_ISA", "native" if here else "all")
        names = chosen(wanted, PROCESSOR["supported"]()[0])
        self.extensions = [e for e in self.extensions if e.name.removeprefix(PREFIX) in names]

    def build_extensions(self) -> None:
        self.check_extensions_list(self.extensions)
        if self.compiler.compiler_type != "unix":
            raise SystemExit("diffsim builds with GCC or Clang on Linux and macOS (Windows: WSL)")
        names = [n for n in ("compiler_so", "compiler_so_cxx") if hasattr(self.compiler, n)]
        compiler = [word for n in names for word in getattr(self.compiler, n)]
        self.kernel_compiler = copy.copy(self.compiler)
        for n in names:
            setattr(self.kernel_compiler, n, of_kernels(getattr(self.compiler, n)))
        name = getattr(self.compiler, "compiler_so_cxx", self.compiler.compiler_so)[0]
        if shutil.which(name) is None:
            raise SystemExit(NO_COMPILER.format(name=name))
        shared = [word for n in names for word in getattr(self.kernel_compiler, n)]
        self.kernels = folder_of([shared, eigen_version()])
        self.bindings = folder_of([compiler, eigen_version(), nanobind.__version__, sys.version])
        jobs = self._jobs()
        with ThreadPoolExecutor(max_workers=self.parallel or os.cpu_count()) as pool:
            objects = list(pool.map(lambda job: self._compile(*job), jobs))
        for ext in self.extensions:
            print(f"linking {ext.name}", flush=True)
            target = self.get_ext_fullpath(ext.name)
            Path(target).parent.mkdir(parents=True, exist_ok=True)
            self.compiler.link_shared_object(
                [obj for (owner, _), obj in zip(jobs, objects, strict=True) if owner is ext],
                target,
                extra_postargs=ext.extra_link_args,
                target_lang="c++",
            )

    def _jobs(self) -> list[tuple[Extension, str]]:
        """What to compile: kernels first, for the linker takes the first of equal inline functions.

        Those of most lines begin, so that no long one is left when the others are done.
        """
        jobs = []
        for ext in self.extensions:
            units = groups_of(ext.sources)
            write_units(units)
            lines = {n: sum(read(Path(p)).count("\n") for p in m) for n, m in units.items()}
            order = sorted(units, key=lambda n: (not is_kernel(n), -lines[n], n))
            jobs += [(ext, name) for name in order]
        return jobs

    def _compile(self, ext: Extension, source: str) -> str:
        args = list(ext.extra_compile_args)
        if not is_kernel(source):
            args = [BINDINGS_LEVEL if flag == "-O3" else flag for flag in args]
        flags = repr([args, ext.define_macros])
        folder = self.kernels if is_kernel(source) else self.bindings
        compiler = self.kernel_compiler if is_kernel(source) else self.compiler
        macros = list(ext.define_macros)
        if STABLE_ABI and not is_kernel(source):
            macros.append(("Py_LIMITED_API", "0x030C0000"))
        out = folder / f"{ext.name}-{hashlib.sha256(flags.encode()).hexdigest()[:8]}"
        obj = Path(self.compiler.object_filenames([source], output_dir=str(out))[0])
        made_of = obj.with_suffix(".sha256")
        if self.force or not obj.is_file() or read(made_of) != content_hash(obj.with_suffix(".d")):
            sys.stdout.write(f"compiling {source} for {ext.name}\n")  # one write: threads
            sys.stdout.flush()
            made_of.unlink(missing_ok=True)
            began = time.time()
            compiler.compile(
                [source],
                output_dir=str(out),
                macros=macros,
                include_dirs=ext.include_dirs,
                extra_postargs=[*args, "-MMD", "-MF", str(obj.with_suffix(".d"))],
            )
            if newest(obj.with_suffix(".d")) < began:  # else one changed meanwhile: compile again
                made_of.write_text(content_hash(obj.with_suffix(".d")))
        return str(obj)


class BuildPy(build_py):
    """The package, and in a wheel the scripts that stand beside it in a checkout.

    A wheel has ``diffsim/_scripts/examples`` and ``diffsim/_scripts/rl``, without kept results, and
    of ``labs`` what examples need; ``diffsim.core.paths`` finds them there or in the checkout.
    """

    def run(self) -> None:
        super().run()
        if getattr(self, "editable_mode", False):
            return
        target = Path(self.build_lib) / "diffsim" / "_scripts"
        shutil.rmtree(target, ignore_errors=True)
        for name in SCRIPTS:
            ignored = shutil.ignore_patterns("__pycache__", "results", "*.pyc")
            shutil.copytree(ROOT / name, target / name, ignore=ignored)
            if "/" in name:
                above = Path(name).parent / "__init__.py"
                shutil.copyfile(ROOT / above, target / above)


setup(
    ext_modules=extensions(),
    cmdclass={"build_ext": BuildExt, "build_py": BuildPy},
    options={"bdist_wheel": {"py_limited_api": "cp312"}} if STABLE_ABI else {},
)
