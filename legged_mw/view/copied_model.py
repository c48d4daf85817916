"""Many robots as one model without joints, for viewers that draw no meshes beside a model's own: MuJoCo's web page.

A picture's state is then seven numbers a body, where `mjv_addGeoms` would send some 250 bytes a geom.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from legged_mw.view.posed_robot import GROUPS_SHOWN, PosedRobot, PosedRobots
from legged_mw.view.stage import FloatArray

_SHAPES = {  # geoms that are copied; skins, flexes and signed distance fields are not
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}"))
    for name in ("PLANE", "HFIELD", "SPHERE", "CAPSULE", "ELLIPSOID", "CYLINDER", "BOX", "MESH")
}


class CopiedRobots(PosedRobots):
    """All robots of one picture, in `model` and `data`: a mocap body for each of their bodies."""

    def __init__(self, model: mujoco.MjModel, count: int) -> None:
        super().__init__(model, count)
        single = self.model  # its shadows are wide enough for all
        self.model, self._bodies = copied_model(single, count)
        self.data, self.base = mujoco.MjData(self.model), self.model.body("focus").id
        self.pose(self._qpos)

    def pose(self, qpos: ArrayLike, world: int = 0) -> None:
        super().pose(qpos, world)
        if self.model.nmocap:
            self.data.mocap_pos[-1] = self.placements[world].position
            mujoco.mj_kinematics(self.model, self.data)
            mujoco.mj_comPos(self.model, self.data)
            mujoco.mj_camlight(self.model, self.data)

    def _place(self, index: int, robot: PosedRobot) -> None:
        super()._place(index, robot)
        if self.model.nmocap:
            chosen = slice(index * len(self._bodies), (index + 1) * len(self._bodies))
            self.data.mocap_pos[chosen], self.data.mocap_quat[chosen] = robot.data.xpos[self._bodies], robot.data.xquat[self._bodies]

    def add_others(self, scene: mujoco.MjvScene, option: mujoco.MjvOption) -> None:
        """Nothing: the model has all robots."""


def copied_model(model: mujoco.MjModel, count: int) -> tuple[mujoco.MjModel, list[int]]:
    """A model with `count` copies of all moving bodies as mocap bodies, and the indices of those bodies in `model`.

    Its last body, "focus", carries the lights that followed the robot. Only visible geoms are copied.
    """
    spec = mujoco.MjSpec()
    moving = [body for body in range(1, model.nbody) if model.body_weldid[body] != 0]
    _copy_visuals(spec, model)
    _copy_assets(spec, model)
    for body in range(model.nbody):
        if model.body_weldid[body] == 0:
            _copy_geoms(spec.worldbody.add_body(pos=_world_place(model, body)[0], quat=_world_place(model, body)[1]), model, body)
    for world in range(count):
        for body in moving:
            _copy_geoms(spec.worldbody.add_body(name=f"{world}/{body}", mocap=True), model, body)
    focus = spec.worldbody.add_body(name="focus", mocap=True)
    for light in range(model.nlight):
        _copy_light(focus if model.light_bodyid[light] in moving else spec.worldbody, model, light)
    return spec.compile(), moving


def _world_place(model: mujoco.MjModel, body: int) -> tuple[FloatArray, FloatArray]:
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return np.array(data.xpos[body]), np.array(data.xquat[body])


def _copy_visuals(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    for section in ("global_", "quality", "headlight", "map"):
        ours, theirs = getattr(spec.visual, section), getattr(model.vis, section)
        for name in dir(theirs):
            if not name.startswith("_"):
                setattr(ours, name, getattr(theirs, name))
    spec.visual.rgba.fog, spec.visual.rgba.haze = model.vis.rgba.fog, model.vis.rgba.haze
    spec.stat.extent, spec.stat.center, spec.stat.meansize = model.stat.extent, model.stat.center, model.stat.meansize


def _copy_assets(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """Textures, materials, meshes and height fields, each named by its number."""
    for i in range(model.ntex):
        size = int(model.tex_height[i]) * int(model.tex_width[i]) * int(model.tex_nchannel[i])
        texture = spec.add_texture(name=str(i), type=model.tex_type[i], width=int(model.tex_width[i]), height=int(model.tex_height[i]))
        texture.nchannel, texture.colorspace = int(model.tex_nchannel[i]), model.tex_colorspace[i]
        texture.data = model.tex_data[model.tex_adr[i] : model.tex_adr[i] + size].tobytes()
    for i in range(model.nmat):
        material = spec.add_material(name=str(i), rgba=model.mat_rgba[i])
        for name in ("emission", "specular", "shininess", "reflectance", "metallic", "roughness", "texrepeat", "texuniform"):
            setattr(material, name, getattr(model, f"mat_{name}")[i])
        for role, texture in enumerate(model.mat_texid[i]):
            if texture >= 0:
                material.textures[role] = str(texture)
    for i in range(model.nmesh):
        vertices = model.mesh_vert[model.mesh_vertadr[i] :][: model.mesh_vertnum[i]]
        faces = model.mesh_face[model.mesh_faceadr[i] :][: model.mesh_facenum[i]]
        spec.add_mesh(name=str(i), uservert=vertices.ravel(), userface=faces.ravel())
    for i in range(model.nhfield):
        count = int(model.hfield_nrow[i]) * int(model.hfield_ncol[i])
        data = model.hfield_data[model.hfield_adr[i] : model.hfield_adr[i] + count]
        spec.add_hfield(
            name=str(i), size=model.hfield_size[i], nrow=int(model.hfield_nrow[i]), ncol=int(model.hfield_ncol[i]), userdata=data
        )


def _copy_geoms(target: mujoco.MjsBody, model: mujoco.MjModel, body: int) -> None:
    for geom in range(model.body_geomadr[body], model.body_geomadr[body] + model.body_geomnum[body]):
        kind = int(model.geom_type[geom])
        if model.geom_group[geom] >= GROUPS_SHOWN or kind not in _SHAPES:
            continue
        copy = target.add_geom(type=kind, size=model.geom_size[geom], pos=model.geom_pos[geom], quat=model.geom_quat[geom])
        copy.rgba, copy.group = model.geom_rgba[geom], int(model.geom_group[geom])
        copy.contype = copy.conaffinity = 0
        copy.castshadow = bool(model.geom_castshadow[geom])
        if model.geom_matid[geom] >= 0:
            copy.material = str(model.geom_matid[geom])
        if kind == mujoco.mjtGeom.mjGEOM_MESH:
            copy.meshname = str(model.geom_dataid[geom])
        elif kind == mujoco.mjtGeom.mjGEOM_HFIELD:
            copy.hfieldname = str(model.geom_dataid[geom])


def _copy_light(target: mujoco.MjsBody, model: mujoco.MjModel, light: int) -> None:
    copy = target.add_light(pos=model.light_pos[light], dir=model.light_dir[light], mode=model.light_mode[light])
    colour = ("ambient", "diffuse", "specular", "intensity")
    for name in ("type", "active", "attenuation", "cutoff", "exponent", "castshadow", "range", *colour):
        setattr(copy, name, getattr(model, f"light_{name}")[light])
