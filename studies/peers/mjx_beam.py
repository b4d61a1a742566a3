"""The beam by MJX: does it take a soft body at all?"""

import json

import mujoco
import scene
from mujoco import mjx

MODEL = f"""
<mujoco><worldbody><body name="beam">
  <flexcomp name="beam" type="grid" count="{" ".join(str(n + 1) for n in scene.CELLS)}" dim="3" mass="3"
            spacing="{scene.SIDE} {scene.SIDE} {scene.SIDE}" radius="0.001">
    <elasticity young="{scene.YOUNGS_MODULUS}" poisson="{scene.POISSONS_RATIO}"/>
  </flexcomp>
</body></worldbody></mujoco>
"""

try:
    mjx.put_model(mujoco.MjModel.from_xml_string(MODEL))
    print(
        json.dumps(
            {"version": mujoco.__version__, "refused": "takes the model; steps were not tried"}
        )
    )
except NotImplementedError as error:
    print(json.dumps({"version": mujoco.__version__, "refused": str(error)}))
