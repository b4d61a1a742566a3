"""What a run is: commit, master seed, effort; drawn once, and gone on with afterwards."""

from __future__ import annotations

import argparse
import datetime
import json
import os
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from diffsim.core.files import write_json_atomic
from labs.machine import machine
from labs.rates.domains import DOMAINS, missing_package

ROOT = Path(__file__).resolve().parents[2]
CODE = ("diffsim", "labs", "csrc", "pyproject.toml")  # what decides an answer
PLAN_FILE = "plan.json"
FACTS = ("cpu", "cores", "instruction_set", "torch", "numpy", "system")


def planned(args: argparse.Namespace) -> dict[str, Any]:
    """The plan of a run in ``--out``: the one that is there, or a new one.

    A run is sealed where the command draws the seed itself, after the code is frozen: from a clean
    tree, and never for another commit than the one it began with.

    Raises:
        ValueError: ``--out`` holds a run of another commit, seed or effort.
    """
    path = args.out / PLAN_FILE
    commit, changed = head()
    if path.is_file():
        plan: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        wanted = {"commit": commit, "effort": args.effort}
        wanted |= {} if args.master is None else {"master": args.master}
        wanted |= {"far": True} if getattr(args, "far", False) else {}
        differs = [f"{k} {plan.get(k)}, not {v}" for k, v in wanted.items() if plan.get(k) != v]
        if plan["sealed"] and changed:
            differs.append(f"a clean tree, and {changed} differs")
        if differs:
            raise ValueError(f"--out {args.out} holds a run of {'; '.join(differs)}")
        return plan
    master = int.from_bytes(os.urandom(6), "big") if args.master is None else args.master
    why = "the seed was given." if args.master is not None else ""
    why = f"{changed} was changed and not committed." if changed else why
    made = machine()
    plan = {
        "master": master,
        "commit": commit,
        "effort": args.effort,
        **({"far": True} if getattr(args, "far", False) else {}),
        "sealed": not why,
        "why_not_sealed": why,
        "date": datetime.date.today().isoformat(),
        "machine": {name: made[name] for name in FACTS},
        "left_out": left_out(args.domain),
    }
    write_json_atomic(path, plan)
    return plan


def head() -> tuple[str, str]:
    """The commit of the code, and a file of it that differs from that; empty: none does.

    Raises:
        ValueError: the code is in no git repository, so nobody could make a case again.
    """
    try:
        commit = _git("rev-parse", "HEAD").strip()
        changes = _git("status", "--porcelain", "--", *CODE).splitlines()
    except (OSError, subprocess.CalledProcessError) as error:
        raise ValueError(f"rates need the commit of the code, and git fails: {error}") from error
    return commit, changes[0][3:] if changes else ""


def _git(*words: str) -> str:
    return subprocess.run(
        ["git", *words], cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout


def left_out(domains: tuple[str, ...]) -> list[str]:
    """Rigs whose package is not installed, with the package."""
    rigs = [rig for domain in domains for rig in DOMAINS[domain]]
    packages = {rig.name: missing_package(rig) for rig in rigs}
    return [f"{name} ({package})" for name, package in packages.items() if package]


def items(plan: Mapping[str, Any], wanted: Mapping[str, list[int]]) -> dict[str, dict[str, Any]]:
    """Cases by name, each with all that makes it."""
    same = {name: plan[name] for name in ("master", "commit", "effort", "far") if name in plan}
    return {
        f"{domain}_{index:04d}": {**same, "domain": domain, "index": index}
        for domain, numbers in wanted.items()
        for index in numbers
    }
