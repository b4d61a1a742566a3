"""Models laid out as public collections lay them out, opened by path from any folder."""

import struct

import numpy as np
import pytest

from diffsim.copter.exchange.mjcf_text import whole_scene
from diffsim.systems.outside.mjcf import Mjcf, version_notes
from tests.systems.outside import scenes

mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed (pip install mujoco)")

CORNERS = [(0, 0, 0), (0.2, 0, 0), (0, 0.1, 0), (0, 0, 0.1)]
FACES = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
OBJ = "mtllib arm.mtl\n" + "".join(f"v {x} {y} {z}\n" for x, y, z in CORNERS)
OBJ += "".join(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in FACES)
STL = bytes(80) + struct.pack("<I", 4)
for face in FACES:
    STL += struct.pack("<12f", 0, 0, 0, *[v for c in face for v in CORNERS[c]]) + bytes(2)
JOINT = '<joint name="j" axis="0 1 0" damping=".01"/>'
DRIVE = '<actuator><motor name="m" joint="j"/></actuator>'
SENSOR = '<sensor><jointpos name="q" joint="j"/></sensor>'
BODY = f'<body name="arm">{JOINT}<geom type="mesh" mesh="arm"/></body>'
WORLD = f"<worldbody>{BODY}</worldbody>{DRIVE}{SENSOR}"
MESH = '<asset><mesh name="arm" file="{}"/></asset>'


def model(content: str, **compiler: str) -> str:
    stated = "".join(f' {k}="{v}"' for k, v in compiler.items())
    return f"<mujoco><compiler{stated}/>{content}</mujoco>"


PLAIN = model(MESH.format("arm.stl") + WORLD)
LOOKS = (
    '<asset><texture name="t" type="2d" file="skin.png"/><material name="m" texture="t"/>'
    '<texture type="skybox" fileright="r.png" fileleft="l.png"/>'
    '<mesh name="arm" file="arm.obj"/></asset>'
)
#: name -> file that is opened, and all files
LAYOUTS: dict[str, tuple[str, dict[str, str | bytes]]] = {
    "one_file_beside_its_mesh": ("arm.xml", {"arm.xml": PLAIN, "arm.stl": STL}),
    "assets_folder": (
        "arm/arm.xml",
        {
            "arm/arm.xml": model(MESH.format("arm.stl") + WORLD, meshdir="assets"),
            "arm/assets/arm.stl": STL,
        },
    ),
    "scene_that_includes_a_robot": (
        "arm/scene.xml",
        {
            "arm/scene.xml": '<mujoco><include file="arm.xml"/><statistic extent="1"/></mujoco>',
            "arm/arm.xml": model(MESH.format("arm.stl") + WORLD, meshdir="assets"),
            "arm/assets/arm.stl": STL,
        },
    ),
    "includes_beside_the_main_file": (
        "scene.xml",
        {
            "scene.xml": '<mujoco><include file="parts/arm.xml"/></mujoco>',
            "parts/arm.xml": f'<mujoco><include file="parts/mesh.xml"/>{WORLD}</mujoco>',
            "parts/mesh.xml": f"<mujocoinclude>{MESH.format('stl/arm.stl')}</mujocoinclude>",
            "stl/arm.stl": STL,
        },
    ),
    "meshes_in_a_folder_above": (
        "robots/arm/reach.xml",
        {
            "robots/arm/reach.xml": model(
                MESH.format("arm.stl") + WORLD, meshdir="../../stls/arm", texturedir="../t"
            ),
            "stls/arm/arm.stl": STL,
        },
    ),
    "pictures_that_are_not_there": (
        "arm.xml",
        {
            "arm.xml": model(LOOKS + WORLD.replace("<geom", '<geom material="m"')),
            "arm.obj": OBJ,
        },
    ),
    "model_that_is_attached": (
        "scene.xml",
        {
            "scene.xml": '<mujoco><asset><model name="robot" file="robot/arm.xml"/></asset>'
            '<worldbody><attach model="robot" body="arm" prefix=""/></worldbody></mujoco>',
            "robot/arm.xml": model(MESH.format("arm.stl") + WORLD, meshdir="assets"),
            "robot/assets/arm.stl": STL,
        },
    ),
    "names_with_paths_that_are_stripped": (
        "arm.xml",
        {
            "arm.xml": model(
                MESH.format("/home/somebody/cad/arm.STL") + WORLD, strippath="true", assetdir="cad"
            ),
            "cad/arm.STL": STL,
        },
    ),
    "mesh_named_by_its_file_and_a_class": (
        "my arm/arm.xml",
        {
            "my arm/arm.xml": model(
                '<default><default class="half"><mesh scale=".5 .5 .5"/></default></default>'
                '<asset><mesh class="half" file="arm.stl"/></asset>' + WORLD,
                meshdir="my meshes",
            ),
            "my arm/my meshes/arm.stl": STL,
        },
    ),
    "keyframes_and_defaults_in_files_of_their_own": (
        "arm/scene.xml",
        {
            "arm/scene.xml": model(
                '<include file="defaults.xml"/><include file="keys.xml"/>'
                + MESH.format("arm.stl")
                + WORLD.replace('<geom type="mesh"', '<geom class="hull"'),
                meshdir="../meshes",
            ),
            "arm/defaults.xml": "<mujocoinclude><default><default class='hull'>"
            "<geom type='mesh' density='700'/></default></default></mujocoinclude>",
            "arm/keys.xml": "<mujoco><keyframe><key name='home' qpos='1'/></keyframe></mujoco>",
            "meshes/arm.stl": STL,
        },
    ),
    "ground_of_heights": (
        "arm.xml",
        {
            "arm.xml": model(
                '<asset><hfield name="g" file="ground.bin" size="1 1 1 .1"/></asset>'
                + MESH.format("arm.stl")
                + WORLD.replace("<worldbody>", '<worldbody><geom type="hfield" hfield="g" '
                                'pos="0 0 -9"/>'),
                meshdir="a",
            ),
            "a/arm.stl": STL,
            "a/ground.bin": struct.pack("<2i4f", 2, 2, 0, 0.5, 0.5, 1),
        },
    ),
}  # fmt: skip


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_layout_of_public_collections_opens_from_any_folder(layout, tmp_path, monkeypatch):
    main, files = LAYOUTS[layout]
    for name, content in files.items():
        path = tmp_path / "study" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content.encode() if isinstance(content, str) else content)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    opened = Mjcf(str(tmp_path / "study" / main), {"a": "q"}, folder=str(tmp_path / "study"))
    arm = opened.plain.body("arm").id
    if layout != "pictures_that_are_not_there":  # those MuJoCo itself does not open
        itself = mujoco.MjModel.from_xml_path(str(tmp_path / "study" / main))
        assert opened.plain.body_mass[arm] == itself.body("arm").mass[0]
        np.testing.assert_array_equal(opened.plain.body_inertia[arm], itself.body("arm").inertia)
    assert 1e-3 < opened.plain.body_mass[arm] < 1.0, "the mass is that of the mesh"
    assert opened.plain.nu == 1


def test_includes_are_found_beside_the_file_that_includes_them(tmp_path):
    """As collections do whose robots are included by scenes of other folders."""
    (tmp_path / "robot").mkdir()
    (tmp_path / "scene.xml").write_text('<mujoco><include file="robot/arm.xml"/></mujoco>')
    (tmp_path / "robot/arm.xml").write_text('<mujoco><include file="world.xml"/></mujoco>')
    ball = WORLD.replace('type="mesh" mesh="arm"', 'size=".1"')
    (tmp_path / "robot/world.xml").write_text(f"<mujoco>{ball}</mujoco>")
    assert Mjcf(str(tmp_path / "scene.xml"), {"a": "q"}).plain.njnt == 1


@pytest.mark.parametrize(
    ("tag", "text"),
    [
        ("mesh", model(MESH.format("arm.stl") + WORLD, meshdir="../../secret")),
        ("mesh", model(MESH.format("../../../secret.stl") + WORLD, meshdir="meshes")),
        ("include", '<mujoco><include file="../../secret.xml"/></mujoco>'),
        ("model", '<mujoco><asset><model file="../../secret.xml"/></asset></mujoco>'),
    ],
)
def test_no_name_leaves_the_folder_of_the_study(tmp_path, tag, text):
    study = tmp_path / "study"
    (study / "robot").mkdir(parents=True)
    (study / "robot/arm.xml").write_text(text)
    with pytest.raises(ValueError, match=f"file of <{tag}> must stay in its folder"):
        whole_scene(study / "robot/arm.xml", study)


def test_models_that_attach_one_another_without_end_are_refused(tmp_path):
    many = "".join(f'<attach model="x" body="b" prefix="{k}"/>' for k in range(30))
    (tmp_path / "x.xml").write_text(
        f'<mujoco><worldbody><body name="b">{"<body/>" * 90}</body></worldbody></mujoco>'
    )
    bomb = '<mujoco><asset><model name="x" file="{}"/></asset><worldbody>{}</worldbody></mujoco>'
    (tmp_path / "many.xml").write_text(bomb.format("x.xml", many))
    with pytest.raises(ValueError, match="makes 2,730 bodies"):
        whole_scene(tmp_path / "many.xml")
    (tmp_path / "self.xml").write_text(bomb.format("self.xml", ""))
    with pytest.raises(ValueError, match="at most 20 models"):
        whole_scene(tmp_path / "self.xml")
    (tmp_path / "none.xml").write_text('<mujoco><worldbody><attach body="b"/></worldbody></mujoco>')
    with pytest.raises(ValueError, match="<attach> names the model ''"):
        whole_scene(tmp_path / "none.xml")


def test_what_a_file_means_otherwise_in_another_version_is_said():
    text = '<position joint="j" kp="3" dampratio="1"/>'
    (new,), (old,) = version_notes(text, "3.17.0"), version_notes(text, "3.14.1")
    assert "since MuJoCo 3.15" in new and "this is so here (3.17.0)" in new
    assert "this is not so here yet (3.14.1)" in old
    assert version_notes("<joint/>", "3.17.0") == []


def test_a_run_is_simulated_with_a_mesh(tmp_path):
    (tmp_path / "arm.xml").write_text(PLAIN)
    (tmp_path / "arm.stl").write_bytes(STL)
    out = Mjcf(str(tmp_path / "arm.xml"), {"a": "q", "b": "q"}).predict({}, scenes.run_of("sine"))
    assert np.ptp(out[:, 0]) > 0.1
