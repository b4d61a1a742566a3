"""The benchmark of the swimmers' recipe: each variant leaves out what it says, and no more."""

import pytest

pytest.importorskip("gymnasium", reason="learning needs the extra 'rl'")

from benchmarks.swim_recipe import RECORD, VARIANTS, _read, main, plan, table
from diffsim.core.paths import PROJECT


def differences(name: str) -> dict:
    """Fields of set-up and options in which a variant differs from the recipe."""
    (base, base_options), (setup, options) = (
        plan("SharkSwim", VARIANTS[variant], 1) for variant in ("recipe", name)
    )
    out = {k: v for k, v in vars(setup).items() if v != vars(base)[k]}
    return out | {k: v for k, v in options.items() if v != base_options[k]}


def test_a_variant_leaves_out_one_part() -> None:
    coarse = {"coarse": True}
    assert differences("no clock") == {"task_options": {"clock": (), "robot": coarse}}
    assert differences("quiet clock") == {"balance_clock": False}
    assert differences("gain 0.01") == {"output_gain": 0.01}
    assert differences("no decay") == {"last_rate": 1.0}


def test_other_methods_have_the_same_task_and_first_network() -> None:
    (base, _), (setup, _) = (plan("SharkSwim", VARIANTS[v], 0) for v in ("recipe", "sac"))
    assert setup.task_options == base.task_options
    assert (setup.output_gain, setup.balance_clock) == (base.output_gain, base.balance_clock)


def test_the_table_counts_runs_that_swim() -> None:
    def rows(reward: float) -> list:
        times = ((0, 0.0, 0.0), (600, 5.0, 0.5 * reward), (1200, 10.0, reward))
        return [{"steps": n, "seconds": s, "reward": r} for n, s, r in times]

    said = table("SharkSwim", {("recipe", 0): rows(0.5), ("recipe", 1): rows(0.16)})
    line = said.splitlines()[-1]
    assert "| recipe | 1,200 | 10 | 1 of 2 | 2 of 2 | 0.33 | 0.50, 0.16 |" in line


@pytest.mark.parametrize("task", ["SharkSwim", "StarfishSwim"])
def test_the_published_table_is_that_of_the_records(task: str, capsys) -> None:
    main(["--task", task, "--report"])
    printed = capsys.readouterr().out.strip()
    page = (PROJECT / "studies" / "records" / "learning.md").read_text()
    assert printed in page
    assert all(rows[-1]["finished"] for rows in _read(RECORD / f"{task}.jsonl").values())
