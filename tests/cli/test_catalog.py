"""Listing and running examples by name."""

import subprocess
import sys

import pytest

from diffsim import cli
from diffsim.cli import examples
from tests import warm


def test_every_example_opens_with_a_question():
    found = examples.examples()
    assert {"routing_tendon", "muscle_arm", "amplifier"} <= set(found)
    for example in found.values():
        assert example.question.endswith(("?", ".")), example


def test_scripts_of_training_have_their_short_version():
    """Its option is one that they share: it stands in their docstrings only."""
    trainers = {n: e for n, e in examples.examples().items() if n.startswith("train_")}
    assert len(trainers) > 5
    assert {e.quick for e in trainers.values()} == {"--quick"}


def test_names_are_unique():
    paths = [p for p in examples.FOLDER.glob("*/*.py") if "__main__" in p.read_text()]
    assert len({p.stem for p in paths}) == len(paths)


def test_list_shows_names(capsys):
    assert cli.main(["examples", "list"]) == 0
    assert "routing_tendon" in capsys.readouterr().out


def test_unknown_name_gets_the_closest(capsys):
    assert cli.main(["examples", "run", "routing_tendom"]) == 2
    assert "routing_tendon" in capsys.readouterr().err


def test_folder_without_examples_says_how_to_mend_it(tmp_path):
    with pytest.raises(FileNotFoundError, match="clone the repository"):
        examples.examples(tmp_path / "none")


@pytest.fixture
def warmly(monkeypatch):
    """Scripts run in the warm process, and say what they would have said."""

    def run(command, **options):
        assert command[0] == sys.executable and options == {"check": False}
        done = warm.python(*command[1:])
        sys.stdout.write(done.stdout)
        sys.stderr.write(done.stderr)
        return done

    monkeypatch.setattr(subprocess, "run", run)


@pytest.mark.example
def test_run_is_the_script(tmp_path, capsys, warmly):
    options = ["--", "--out", str(tmp_path), "--evaluations", "2", "--no-pictures"]
    assert cli.main(["examples", "run", "routing_tendon", "--quick", *options]) == 0
    assert "distance mm, optimized" in capsys.readouterr().out
    assert (tmp_path / "result_projective_dynamics_quick.json").is_file()
    record = tmp_path / "projective_dynamics_quick.jsonl"
    record.write_text('{"values": [1.0], "with_gradient": true}\n')  # as earlier versions kept
    assert cli.main(["examples", "run", "routing_tendon", "--quick", *options]) != 0
    assert "older version" in capsys.readouterr().err
    assert cli.main(["examples", "run", "routing_tendon", "--quick", *options, "--fresh"]) == 0
