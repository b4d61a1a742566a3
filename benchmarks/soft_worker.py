"""Measurements that are made in a process of their own, so that peak memory is theirs alone."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from benchmarks.harness import Seconds, cores, repeat_for, spread, timed
from benchmarks.processes import memory, reset_peak_memory
from benchmarks.soft_cantilever import options, phase_times
from benchmarks.soft_scenes import Pass, cantilever, one_pass, rollout_loss
from diffsim import soft


def scaling(settings: dict[str, Any]) -> dict[str, Any]:
    """Preparation, one step forward and backward, and peak memory, of one method and mesh."""
    warm_up_torch()
    with cores(settings["threads"]):
        return _scaling(settings)


def warm_up_torch() -> None:
    """A few steps of one cell: torch loads parts of itself when an op is first called."""
    torch.set_num_threads(1)
    one_pass(cantilever("hex", (1, 1, 1)), 2)


def _scaling(settings: dict[str, Any]) -> dict[str, Any]:
    start = reset_peak_memory()
    num_steps, seconds, degrees = (settings[k] for k in ("num_steps", "seconds", "degrees"))
    body, prepare = timed(lambda: cantilever(settings["kind"], settings["cells"]))
    still = body.physics(gravity=(0.0, 0.0, 0.0))
    with torch.no_grad():
        # A step that starts at its answer costs a factorization where that is new, little else.
        first, second = (timed(lambda: body(body.rest_state(), physics=still))[1] for _ in "12")
    body.solver = options(settings["method"], 0.5, settings["threads"])
    one_pass(
        body, 1, degrees=degrees
    )  # loose, not counted: the tangent's pattern is analyzed when first needed
    body.solver = options(settings["method"], settings["rtol"], settings["threads"])
    passes = [one_pass(body, num_steps, degrees=degrees)]
    peak = memory("VmHWM") - start
    while sum(p.total for p in passes) < seconds and len(passes) < 20:
        passes.append(one_pass(body, num_steps, degrees=degrees))
    heavier = body.physics(gravity=(0.0, 0.0, 0.0), density=1001.0)
    with torch.no_grad():
        _, other = timed(lambda: body(body.rest_state(), physics=heavier))
    return {
        **phase_times(passes, num_steps),
        "pass_s": spread([run.forward.cpu + run.backward.cpu for run in passes])["median"],
        "num_elements": body.mesh.num_elements,
        "converged": passes[-1].converged,
        "factorized": passes[-1].factorized,
        **passes[-1].counts(),
        "prepare_mesh_s": prepare.cpu,
        "analyze_and_factor_s": first.cpu - second.cpu,
        "factor_s": other.cpu - second.cpu,
        "memory_start_B": start,
        "memory_peak_B": peak,
    }


def rollout_memory(settings: dict[str, Any]) -> dict[str, Any]:
    """Time and memory of one rollout with its gradient, of one integrator."""
    warm_up_torch()
    body = cantilever(
        "hex", settings["cells"], dt=settings["dt"], integrator=settings["integrator"]
    )
    body.solver = options("auto", settings["rtol"])
    every, num_steps = settings["checkpoint_every"], settings["num_steps"]
    one_pass(body, 2, checkpoint_every=every)  # what is in memory whatever the number of steps
    start = reset_peak_memory()
    loss, _ = rollout_loss(body, num_steps, checkpoint_every=every)
    loss.backward()
    peak = memory("VmHWM") - start
    runs: list[Pass] = []
    repeat_for(
        lambda: runs.append(one_pass(body, num_steps, checkpoint_every=every)),
        seconds=settings["seconds"],
    )

    def times(phase: Callable[[Pass], Seconds]) -> dict[str, float]:
        return spread([phase(run).cpu for run in runs[1:]])

    return {
        "memory_peak_B": peak,
        "saved_B": saved_bytes(body, num_steps, every),
        "forward_s": times(lambda run: run.forward),
        "backward_s": times(lambda run: run.backward),
        "loss": runs[0].loss,
        "grad_norm": float(runs[0].grad.norm()),
    }


def saved_bytes(body: soft.SoftBody, num_steps: int, checkpoint_every: int | None) -> int | None:
    """Memory of all tensors that autograd keeps for the backward pass, each counted once [byte].

    None with checkpoints: what they compute twice cannot be told from what they keep.
    """
    if checkpoint_every is not None:
        return None
    kept: dict[int, int] = {}

    def pack(tensor: torch.Tensor) -> torch.Tensor:
        storage = tensor.untyped_storage()
        kept[storage.data_ptr()] = storage.nbytes()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
        one_pass(body, num_steps)
    return sum(kept.values())
