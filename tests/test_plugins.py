"""What a user's package adds by entry points is made by name, as what is shipped."""

from dataclasses import replace

import pytest

from diffsim.core import plugins
from tests.optional import needs
from tests.systems.toy_cart import cart_study

needs("gymnasium")

MODULE = '''
from dataclasses import replace

from diffsim.envs.copter_tasks import CopterHover
from diffsim.stokes.devices import funnel
from diffsim.systems.ode.description import OdeDescription


class Linger(CopterHover):
    """Hover for a second."""

    name = "Linger"

    def __init__(self, *, seconds: float = 1.0, **options):
        super().__init__(seconds=seconds, **options)


def wide_funnel(resolution=1.0):
    return replace(funnel(resolution), name="wide_funnel")


text = "no class"


class LinkageDescription(OdeDescription):
    """A linkage, which is a system of formulas with two more keys."""

    system: str = "linkage"
'''


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package of a user; called with entry points, it is installed."""

    def install(*lines):
        (tmp_path / "lingering.py").write_text(MODULE)
        info = tmp_path / "lingering-1.0.dist-info"
        info.mkdir(exist_ok=True)
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: lingering\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text("\n".join(lines))
        monkeypatch.syspath_prepend(tmp_path)
        plugins.find_plugins.cache_clear()

    yield install
    plugins.find_plugins.cache_clear()


def test_a_task_of_another_package_is_an_environment(package):
    import gymnasium

    from diffsim.envs.registry import make_vector, register

    package("[diffsim.environments]", "Linger = lingering:Linger")
    register()
    try:
        env = gymnasium.make("diffsim/Linger-v0", seconds=0.1)
        env.reset(seed=0)
        steps = 1
        while not env.step(env.action_space.sample())[3]:
            steps += 1
        assert steps == 5
        assert make_vector("Linger", 3).num_envs == 3
        with pytest.raises(ValueError, match=r"did you mean 'seconds'"):
            gymnasium.make("diffsim/Linger-v0", second=0.1)
    finally:
        del gymnasium.registry["diffsim/Linger-v0"]


def test_a_device_of_another_package_is_made_by_name(package):
    from diffsim.stokes import devices

    package("[diffsim.devices]", "wide_funnel = lingering:wide_funnel")
    made = devices.make("wide_funnel", 0.25)
    assert made.name == "wide_funnel"
    assert made.remake().name == "wide_funnel"
    with pytest.raises(ValueError, match="did you mean 'wide_funnel'"):
        devices.make("wide_funel")


def test_a_system_of_another_package_is_diagnosed_by_its_name(package):
    from diffsim.systems.registry import setup_of

    study = cart_study()
    linkage = replace(study, model={**study.model, "system": "linkage"})
    with pytest.raises(ValueError, match="'linkage'"):
        setup_of(linkage)
    package("[diffsim.systems]", "linkage = lingering:LinkageDescription")
    names = [e.name for e in setup_of(linkage).effects]
    assert names == [e.name for e in setup_of(study).effects]

    package("[diffsim.systems]", "ode = lingering:LinkageDescription")
    with pytest.raises(ValueError, match=r"'ode' is a system of diffsim already; give lingering"):
        setup_of(linkage)


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("Linger = lingering:Lingr", "Linger = lingering:Lingr of lingering cannot be imported"),
        ("Linger = nowhere:Linger", "cannot be imported: No module named 'nowhere'"),
        (
            "Linger = lingering:text",
            "must be a subclass of Task, or the path of a YAML file, got 'no class'",
        ),
        ("CopterHover = lingering:Linger", "'CopterHover' is a task of diffsim already"),
    ],
)
def test_what_cannot_be_added_is_refused_with_its_package(package, line, said):
    from diffsim.envs.registry import make_task

    package("[diffsim.environments]", line)
    with pytest.raises(ValueError, match=said):
        make_task("Linger")
