"""Nothing that the library answers moves unseen: every public call, every cause of every kind,
every environment, design and device, and what the shell says and writes (``tests.known``)."""

import pytest

pytest.importorskip("gymnasium", reason="environments need the extra 'rl'")

from tests.known.fingerprint import fingerprint, is_close
from tests.known.populations import POPULATIONS
from tests.known.renew import found_of, read

KNOWN = read()


SAID = [name for name in POPULATIONS if name.startswith("shell")]


@pytest.mark.parametrize("name", [name for name in POPULATIONS if name not in SAID])
def test_numbers_are_those_that_are_known(name, tmp_path):
    check(name, tmp_path)


@pytest.mark.cpu(10)  # a device's whole design, small
@pytest.mark.parametrize("name", SAID)
def test_what_commands_say_and_write_is_known(name, tmp_path):
    check(name, tmp_path)


def check(name, folder):
    found, known = found_of(name, folder), KNOWN[name]
    moved = [
        f"{part}: {known[part]} became {found.get(part)}"
        for part in known
        if part not in found or not is_close(found[part], known[part], POPULATIONS[name].share)
    ]
    assert not moved, "\n".join(
        [f"{len(moved)} of {len(known)} moved; if meant: python -m tests.known.renew", *moved[:20]]
    )


def test_a_small_change_of_one_value_is_seen():
    values = [0.0, 1e-9, -3e4, 2.5, float("nan")]
    known = fingerprint(values)
    assert is_close(fingerprint(values), known, 1e-7)
    for k, other in enumerate([1e-6, -1e-9, 3e4, 2.6, float("inf")]):
        changed = [*values[:k], other, *values[k + 1 :]]
        assert not is_close(fingerprint(changed), known, 1e-7), (k, other)
    assert not is_close(fingerprint(values[::-1]), known, 1e-7)
    assert not is_close(fingerprint(values[:-1]), known, 1e-7)
