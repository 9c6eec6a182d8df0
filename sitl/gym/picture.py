"""A picture of the world by MuJoCo's own renderer."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

_ARM_RGBA, _BASE_RGBA = (0.9, 0.45, 0.1, 1.0), (0.2, 0.3, 0.5, 1.0)
_BASE_SIZE_M = (0.22, 0.22, 0.04)


def picture(renderer: mujoco.Renderer, model: mujoco.MjModel, data: mujoco.MjData) -> Any:
    """Return a picture (height, width, 3) that follows the first body: a box for it, and lines to the bodies after it."""
    camera = mujoco.MjvCamera()
    camera.lookat[:], camera.distance, camera.azimuth, camera.elevation = data.xpos[1], 2.5, 120.0, -15.0
    renderer.update_scene(data, camera)
    scene = renderer.scene
    _add(scene, mujoco.mjtGeom.mjGEOM_BOX, np.array(_BASE_SIZE_M), data.xpos[1], data.xmat[1], _BASE_RGBA)
    for body, parent in enumerate(model.body_parentid):
        if parent > 0:
            geom = _add(scene, mujoco.mjtGeom.mjGEOM_CAPSULE, np.ones(3), np.zeros(3), np.eye(3).ravel(), _ARM_RGBA)
            mujoco.mjv_connector(geom, mujoco.mjtGeom.mjGEOM_CAPSULE, 0.015, data.xpos[parent], data.xpos[body])
    return renderer.render()


def _add(scene: Any, kind: Any, size_m: Any, position_m: Any, rotation: Any, rgba: Any) -> Any:
    geom = scene.geoms[scene.ngeom]
    mujoco.mjv_initGeom(geom, kind, size_m, position_m, rotation, np.array(rgba, np.float32))
    scene.ngeom += 1
    return geom
