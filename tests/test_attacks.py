"""Attacks that belong to no room: a full disk, saved states in a fresh process, devices.

Others stand where they belong: keys that name files in tests/test_stated_paths.py, counts and
widths in tests/test_hostile_counts.py, other files in tests/test_strangers_files.py and
tests/data/test_hostile_recordings.py, meshes in tests/mesh/test_vtu_size.py and
tests/mesh/test_surface_files.py, pages in tests/viz/test_serve_attacks.py, derivatives in
tests/test_derivatives.py, spoiled arguments in tests/test_arguments.py, tests/test_fuzz.py and
tests/test_signatures.py, units, formulas and Ctrl-C within kernels in tests/core; errors drawn at
random are planted by benchmarks.planted_errors.
"""

import os
import resource
import signal
import subprocess
import sys
from contextlib import contextmanager

import numpy as np
import pytest
import torch

from diffsim import mesh, soft
from diffsim.data.formats import write_columns


def make_body():
    box = mesh.hex_box((2, 1, 1), (0.1, 0.05, 0.05))
    return soft.SoftBody(
        box,
        dt=0.01,
        youngs_modulus=2e5,
        poissons_ratio=0.4,
        density=1000.0,
        fixed=box.nodes_near_plane("x", 0.0),
    )


def test_a_disk_that_gets_full_is_named_and_leaves_no_half_file(tmp_path):
    def limited():
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # a write then fails, as on a full disk
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))

    fly = ["fly", "pentacopter", "--seconds", "1", "--out", str(tmp_path / "fly")]
    done = subprocess.run(
        [sys.executable, "-m", "diffsim", *fly],
        preexec_fn=limited,
        capture_output=True,
        text=True,
        timeout=300,
        env=os.environ | {"PYTHONDONTWRITEBYTECODE": "1"},  # it would cut compiled modules short
    )
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert str(tmp_path / "fly" / "flight.csv") in done.stderr
    assert [name for _, _, names in os.walk(tmp_path) for name in names] == []


@contextmanager
def full_disk(room):
    """Files of this process cannot grow beyond ``room`` bytes, as on a disk that gets full.

    Compiled modules are not written meanwhile: Python 3.11 leaves them cut short without a word,
    and every later import of such a module fails.
    """
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    bytecode, sys.dont_write_bytecode = sys.dont_write_bytecode, True
    soft_limit, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft_limit, hard))
        signal.signal(signal.SIGXFSZ, before)
        sys.dont_write_bytecode = bytecode


def write_scene(path):
    from diffsim.viz.scene import write_recording

    points = np.random.default_rng(0).normal(size=(5_000, 3))
    return write_recording(path, "points", lambda rr, to: to.log("p", rr.Points3D(points)))


def write_table(path):
    return write_columns(path, {"time_s": np.arange(2_000.0), "q": np.arange(2_000.0) ** 0.5})


NEEDS = {".rrd": "rerun", ".h5": "h5py", ".parquet": "pyarrow"}


@pytest.mark.parametrize("suffix", [".rrd", ".h5", ".parquet", ".mat", ".vtu"])
def test_writers_end_in_a_sentence_where_a_disk_gets_full(tmp_path, suffix):
    """HDF5's own writer ended the process there, and rerun's waited for ever."""
    pytest.importorskip(NEEDS.get(suffix, "scipy"))
    path = tmp_path / f"it{suffix}"
    writers = {".rrd": write_scene, ".vtu": lambda path: mesh.save(mesh.hex_box((9, 9, 9)), path)}
    write = writers.get(suffix, write_table)
    with full_disk(4_096), pytest.raises(OSError, match=path.name):
        write(path)
    assert os.listdir(tmp_path) == []
    assert write(path) is None or path.stat().st_size > 4_096


def test_saved_states_are_read_by_a_fresh_process(tmp_path):
    path = tmp_path / "state.pt"
    torch.save(make_body().rest_state(), path)
    code = "import sys, torch, diffsim.soft; print(type(torch.load(sys.argv[1])).__name__)"
    done = subprocess.run([sys.executable, "-c", code, path], capture_output=True, text=True)
    assert done.stdout.strip() == "State", done.stderr


@pytest.mark.parametrize(
    "change", [lambda b: b.to("meta"), lambda b: b.half(), lambda b: b.float()]
)
def test_a_body_stays_what_it_is_and_says_so(change):
    body = make_body()
    expected = body(body.rest_state()).x
    with pytest.warns(UserWarning, match="stays in float64 on the CPU"):
        body = change(body)
    assert torch.equal(body(body.rest_state()).x, expected)


def test_another_default_device_is_refused_in_a_sentence():
    with (
        torch.device("meta"),
        pytest.raises(TypeError, match="computes on the CPU"),
    ):
        make_body()


@pytest.mark.parametrize("mode", ["grad", "jacrev", "jacfwd"])
def test_a_body_may_be_made_where_a_derivative_is_asked_for(mode):
    """Within ``torch.func`` not even a plain tensor's memory can be read: the mesh's was."""
    box = mesh.hex_box((2, 1, 1), (0.1, 0.05, 0.05))

    def energy(youngs_modulus):
        body = soft.SoftBody(box, dt=0.01, youngs_modulus=youngs_modulus, poissons_ratio=0.4)
        return body.elastic_energy(1.01 * box.x_rest)

    modulus = torch.tensor(2e5, dtype=torch.float64)
    slope = getattr(torch.func, mode)(energy)(modulus)
    torch.testing.assert_close(slope, energy(modulus) / modulus)  # it is linear in the modulus
