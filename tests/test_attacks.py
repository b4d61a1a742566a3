"""Attacks that belong to no room: a full disk, saved states in a fresh process, devices.

Others stand where they belong: files in tests/test_strangers_files.py and
tests/data/test_hostile_recordings.py, pages in tests/viz/test_serve_attacks.py, derivatives in
tests/test_derivatives.py, units and formulas in tests/core.
"""

import os
import resource
import signal
import subprocess
import sys

import pytest
import torch

from diffsim import mesh, soft


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
    )
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert str(tmp_path / "fly" / "flight.csv") in done.stderr
    assert [name for _, _, names in os.walk(tmp_path) for name in names] == []


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
