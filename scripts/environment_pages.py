"""Write docs/environments: a page for each environment, from its class, its task and its picture.

python scripts/environment_pages.py             # the pages
python scripts/environment_pages.py --pictures  # and the pictures, two minutes
"""

from __future__ import annotations

import argparse
import inspect
import math
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    from torch import Tensor

    from diffsim.envs.task import Task

ROOT = Path(__file__).resolve().parent.parent
FOLDER = ROOT / "docs" / "environments"
IMAGES = ROOT / "docs" / "images"
MARK = "<!-- Written by scripts/environment_pages.py. -->\n"
FRAMES = 3
# without a shipped controller: frequency [Hz] of a sine for all commands, its turn from command to
# command [rad], seconds that are shown, options of the task
SHOWN: dict[str, tuple[float, float, float, dict]] = {
    "QuadrupedWalk": (4.0, 0.0, 0.5, {"robot": {"coarse": True}}),
    "CowWalk": (4.0, 0.0, 0.3, {"robot": {"coarse": True}}),
    "TorusRoll": (0.6, -0.25 * math.pi, 1.2, {"robot": {"coarse": True}}),
    "TendonReach": (0.5, 0.5 * math.pi, 0.8, {"robot": {"coarse": True}}),
    "SoftJumper": (3.0, 0.0, 0.7, {}),
}


def pages() -> dict[str, str]:
    """Text by the file's name."""
    from diffsim.envs import ENV_IDS
    from diffsim.envs.registry import short_name

    names = [short_name(full) for full in ENV_IDS]
    return {"README.md": overview(names)} | {f"{name}.md": page(name) for name in names}


def overview(names: list[str]) -> str:
    """A picture and a link for each."""
    rows = [
        f"### [{name}]({name}.md)\n\n{first_sentence(name)}\n\n"
        f"[![{name}](../images/env_{name}.png)]({name}.md)"
        for name in names
    ]
    head = (
        "# Environments\n\n"
        "Every page is the data sheet of one environment: what it commands, senses and rewards.\n"
        "What all of them share is in [learning](../learning.md#the-environments)."
    )
    return "\n\n".join([f"{MARK}\n{head}", *rows]) + "\n"


def page(name: str) -> str:
    """One environment."""
    import gymnasium

    from diffsim.envs.registry import make_task

    task, spec = make_task(name), gymnasium.spec(f"diffsim/{name}-v0")
    solved = "none was measured" if spec.reward_threshold is None else f"{spec.reward_threshold:g}"
    facts = [
        "| | |\n|---|---|",
        f"| id | `diffsim/{name}-v0` |",
        f"| actions | {task.num_actions}, each in [-1, 1] |",
        f"| observations | {task.num_observations} |",
        f"| an episode | {task.max_steps} control steps of {1e3 * task.dt:.3g} ms |",
        f"| solved | mean return above: {solved} |",
        f"| may be randomized | {', '.join(task.randomizable)} |",
    ]
    parts = [
        f"{MARK}\n# {name}",
        data_sheet(name).partition("\n\n")[0],
        f"![{name}, three moments](../images/env_{name}.png)",
        caption(name),
        "\n".join(facts),
        "## Data sheet",
        data_sheet(name).partition("\n\n")[2],
        "## Use",
        "```python\nimport gymnasium\nimport diffsim.envs\n\n"
        f'env = gymnasium.make("diffsim/{name}-v0", render_mode="rgb_array")\n'
        "observation, info = env.reset(seed=0)\n"
        "observation, reward, terminated, truncated, info = env.step(env.action_space.sample())\n"
        "picture = env.render()  # (height, width, 3)\n```",
        see_also(name),
    ]
    return "\n\n".join(parts) + "\n"


def data_sheet(name: str) -> str:
    """The class's docstring; links to other classes become links to their pages."""
    from diffsim.envs import registry

    text = inspect.getdoc(getattr(registry, f"{name}Env")) or ""
    for other in SHOWN.keys() | set(trained()) | {"CopterHover"}:
        text = text.replace(f"``{other}Env``", f"[{other}]({other}.md)")
    return text.replace("``", "`")


def first_sentence(name: str) -> str:
    """What the robot must do."""
    return " ".join(data_sheet(name).partition("\n\n")[0].split())


def trained() -> list[str]:
    """Environments that a controller is shipped for."""
    from diffsim.learn.kept_files import trained_names

    return trained_names()


def caption(name: str) -> str:
    """What the picture shows."""
    if name in trained():
        return f"*The controller that comes with the package: `diffsim play {name}` films it.*"
    return "*All commands follow a sine, with nothing learned.*"


def see_also(name: str) -> str:
    """The way on: training, and its measurements."""
    lines = [
        f"- Training: `python rl/train_gradient.py --task {name}`; [all methods](../learning.md)."
    ]
    if name in trained():
        lines.append(f"- Replay and film of a trained controller: `diffsim play {name}`.")
    lines.append(
        "- Speeds: [measured/environments](../measured/environments.md); "
        "returns: [measured/learning](../measured/learning.md)."
    )
    return "\n".join(lines)


def draw(name: str, path: Path) -> None:
    """Three moments beside each other."""
    import numpy as np
    from matplotlib.image import imsave

    imsave(path, np.concatenate([task.picture(state, 0) for task, state in moments(name)], axis=1))


def moments(name: str) -> list[tuple[Task, dict[str, Tensor]]]:
    """Task and states to be shown."""
    import numpy as np
    import torch

    task, steer, seconds = motion(name)
    steps = round(seconds / task.dt)
    at = {round(k * steps / (FRAMES - 1)) for k in range(FRAMES)}
    state, found = task.start(1, np.random.default_rng(0)), []
    with torch.no_grad():
        for k in range(steps + 1):
            if k in at:
                found.append((task, state))
            state, _ = task.step(state, steer(task.observe(state), k))
    return found


def motion(name: str) -> tuple[Task, Callable[[Tensor, int], Tensor], float]:
    """Task, controller, and for how long."""
    import torch

    from diffsim.envs.registry import make_task
    from diffsim.learn.trained import load_trained

    if name in trained():
        kept = load_trained(name)
        task = kept.make_task()
        return task, kept.controller(task), 0.75 * task.max_steps * task.dt
    hertz, turn, seconds, options = SHOWN[name]
    task = make_task(name, **options)
    phase = turn * torch.arange(task.num_actions, dtype=torch.float64)

    def steer(seen: Tensor, step: int) -> Tensor:
        angle = 2.0 * math.pi * hertz * step * task.dt + phase
        return torch.sin(angle).expand(len(seen), -1)

    return task, steer, seconds


def main() -> None:
    """Write."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--pictures", action="store_true", help="draw them anew")
    parser.add_argument("--only", nargs="+", help="pictures of these alone")
    args = parser.parse_args()
    FOLDER.mkdir(exist_ok=True)
    for file, text in pages().items():
        (FOLDER / file).write_text(text, encoding="utf-8")
        name = file.removesuffix(".md")
        if args.pictures and name != "README" and (not args.only or name in args.only):
            draw(name, IMAGES / f"env_{name}.png")
            print(name, flush=True)


if __name__ == "__main__":
    main()
