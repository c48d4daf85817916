"""Robots posed by `qpos` alone: one as its own model shows it, or many as marionettes in one model made from its parts.

Kinematics and no dynamics. Opens no window, no file and no OpenGL context.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

import math
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from legged_mw.view.hills import Hills, height_fields
from legged_mw.view.stage import FloatArray

GROUPS_SHOWN = 3  # geom groups 0 ground, 1 and 2 what is meant to be seen; from 3 on collision shapes
SHADOW_MAX, SHADOW_SIZE = 8.0, 4096  # [extent] half-width of the shadow map, [px] its edge: 4 mm a pixel at the most
SPACING = 3.0  # [robot radius] between robots that stand side by side
_SHAPES = {  # what a marionette can wear; skins, flexes and signed distance fields stay at home
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}"))
    for name in ("PLANE", "HFIELD", "SPHERE", "CAPSULE", "ELLIPSOID", "CYLINDER", "BOX", "MESH")
}


class Anchor(NamedTuple):
    """Where a robot is in the picture, for what is drawn around it."""

    position: FloatArray  # of its base (3,) [m]
    heading: float  # where its x axis points on the ground [rad]
    radius: float  # how large it is [m]
    top: float  # height above its base [m]


class Puppet:
    """One robot. `radius` and `top` measure it in its first pose."""

    def __init__(self, model: mujoco.MjModel) -> None:
        if model.njnt == 0 or model.jnt_type[0] != mujoco.mjtJoint.mjJNT_FREE:
            first = "no joint at all" if model.njnt == 0 else f"{model.joint(0).name!r}, which is not one"
            raise ValueError(f"A viewer follows the robot's free joint, which must be the model's first joint; found {first}.")
        self.model = model
        self.data = mujoco.MjData(model)
        self.base = int(model.jnt_bodyid[0])
        self._forward()
        self.radius, self.top = self._measure()

    def pose(self, qpos: ArrayLike) -> None:
        """Copy `qpos` (nq,) and place every body, light and camera accordingly."""
        array = np.asarray(qpos, dtype=np.float64)
        if array.shape != (self.model.nq,):
            raise ValueError(f"qpos has shape {array.shape}; this model has nq = {self.model.nq}, so ({self.model.nq},) is needed.")
        if not np.isfinite(array).all():
            raise ValueError(f"qpos[{int(np.flatnonzero(~np.isfinite(array))[0])}] is not finite: the simulation diverged.")
        self.data.qpos[:] = array
        self._forward()

    @property
    def position(self) -> FloatArray:
        """Base position (3,) [m], world frame, a copy."""
        return np.array(self.data.xpos[self.base])

    @property
    def heading(self) -> float:
        """Direction in which the base's x axis points on the ground [rad]."""
        rotation = self.data.xmat[self.base]
        return math.atan2(rotation[3], rotation[0])

    def _forward(self) -> None:
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)  # tracking cameras and lights aim at the centre of mass
        mujoco.mj_camlight(self.model, self.data)

    def _measure(self) -> tuple[float, float]:
        """Largest distance of the robot's shown geometry from its base, and its height above the base [m]."""
        model, data, radius, top = self.model, self.data, 0.0, 0.0
        robot = model.body_rootid[model.geom_bodyid] == model.body_rootid[self.base]
        for geom in np.flatnonzero(robot & (model.geom_group < GROUPS_SHOWN)):
            rotation = data.geom_xmat[geom].reshape(3, 3)
            centre = data.geom_xpos[geom] + rotation @ model.geom_aabb[geom, :3] - data.xpos[self.base]
            half = np.abs(rotation) @ model.geom_aabb[geom, 3:]
            radius = max(radius, float(np.linalg.norm(np.abs(centre) + half)))
            top = max(top, float(centre[2] + half[2]))
        return (radius or 0.5), top  # a robot without geometry still needs a camera distance


class Cast:
    """All robots of one picture: `model` and `data` are what to draw, `base` is the body that a camera tracks.

    One robot is shown by its own model. Several are marionettes: a mocap body for each of their bodies, so that the
    picture has no joint and nothing to solve, and a state of seven numbers a body. They stand side by side, `offsets`
    (N, 3) apart; where a terrain gives places a meaning, each stays where it is.
    """

    def __init__(self, model: mujoco.MjModel, count: int = 1) -> None:
        self.count = count
        self.puppet = Puppet(model)
        self.radius = self.puppet.radius
        self.feet = contact_geoms(model)
        self.offsets = np.zeros((count, 3)) if has_places(model) else side_by_side(count, SPACING * self.radius)
        self._feet_at = np.zeros((count, len(self.feet), 3))
        self.anchors = [self._anchor(world) for world in range(count)]
        if count == 1:
            self.model, self.data, self.base = model, self.puppet.data, self.puppet.base
        else:
            self.model, self._bodies = marionettes(model, count)
            self.data = mujoco.MjData(self.model)
            self.base = self.model.body("focus").id
        self.pose(np.tile(model.qpos0, (count, 1)))  # a window may draw before it is shown anything
        self.hills = Hills(self.model, self.data) if len(height_fields(model)) else None

    def pose(self, qpos: ArrayLike, world: int = 0) -> None:
        """Place all robots, rows of `qpos` (N, nq); lights and tracking cameras go with `world`."""
        rows = np.atleast_2d(np.asarray(qpos, dtype=np.float64))
        for index in range(self.count):
            self.puppet.pose(rows[index])
            self.anchors[index] = self._anchor(index)
            self._feet_at[index] = self.puppet.data.geom_xpos[self.feet] + self.offsets[index]
            if self.count > 1:
                chosen = slice(index * len(self._bodies), (index + 1) * len(self._bodies))
                self.data.mocap_pos[chosen] = self.puppet.data.xpos[self._bodies] + self.offsets[index]
                self.data.mocap_quat[chosen] = self.puppet.data.xquat[self._bodies]
        if self.count > 1:
            self.data.mocap_pos[-1] = self.anchors[world].position
            mujoco.mj_kinematics(self.model, self.data)
            mujoco.mj_comPos(self.model, self.data)
            mujoco.mj_camlight(self.model, self.data)

    def standing(self, contacts: ArrayLike) -> FloatArray:
        """Where the feet are (M, 3) that `contacts` (N, F) says touch the ground; they are the first geoms with a contact sensor."""
        touching = np.asarray(contacts, dtype=bool)[: self.count]
        feet = self._feet_at[:, : touching.shape[1]]
        if touching.shape != feet.shape[:2]:
            return np.zeros((0, 3))  # a model that does not say where its feet are
        return feet[touching]

    def foot_radius(self) -> float:
        """Of the first foot [m]."""
        return float(self.puppet.model.geom_rbound[self.feet[0]]) if len(self.feet) else 0.0

    def _anchor(self, world: int) -> Anchor:
        return Anchor(self.puppet.position + self.offsets[world], self.puppet.heading, self.puppet.radius, self.puppet.top)


def contact_geoms(model: mujoco.MjModel) -> list[int]:
    """The geoms of the model's contact sensors, in the sensors' order."""
    geom = int(mujoco.mjtObj.mjOBJ_GEOM)
    contact = int(mujoco.mjtSensor.mjSENS_CONTACT)
    return [int(model.sensor_objid[i]) for i in range(model.nsensor) if model.sensor_type[i] == contact and model.sensor_objtype[i] == geom]


def has_places(model: mujoco.MjModel) -> bool:
    """Whether it matters where a robot is: there is more ground than planes."""
    fixed = model.body_weldid[model.geom_bodyid] == 0
    return bool((fixed & (model.geom_group < GROUPS_SHOWN) & (model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE)).any())


def side_by_side(count: int, spacing: float) -> FloatArray:
    """Places (N, 3) on a square grid [m], the first at the origin, the others ahead of it and to its left."""
    columns = math.ceil(math.sqrt(count))
    index = np.arange(count)
    return np.stack([index // columns, index % columns, np.zeros(count)], axis=1).astype(np.float64) * spacing


def marionettes(model: mujoco.MjModel, count: int) -> tuple[mujoco.MjModel, list[int]]:
    """A model with `count` copies of all moving bodies as mocap bodies, and the indices of those bodies in `model`.

    Last comes a mocap body "focus", which carries the lights that followed the robot. Only what is seen is copied.
    """
    spec = mujoco.MjSpec()
    moving = [body for body in range(1, model.nbody) if model.body_weldid[body] != 0]
    _copy_visuals(spec, model)
    apart = has_places(model)  # too far for one shadow map
    wide = 0.0 if apart else math.ceil(math.sqrt(count)) * SPACING * 0.5 / max(model.stat.extent, 1e-6)
    spec.visual.map.shadowclip = min(max(model.vis.map.shadowclip, wide), SHADOW_MAX)
    spec.visual.quality.shadowsize = max(model.vis.quality.shadowsize, 0 if apart else SHADOW_SIZE)
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
    """Textures, materials, meshes and height fields under their number as their name."""
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
        vertices, faces = (slice(adr[i], adr[i] + num[i]) for adr, num in _mesh_spans(model))
        spec.add_mesh(name=str(i), uservert=model.mesh_vert[vertices].ravel(), userface=model.mesh_face[faces].ravel())
    for i in range(model.nhfield):
        count = int(model.hfield_nrow[i]) * int(model.hfield_ncol[i])
        data = model.hfield_data[model.hfield_adr[i] : model.hfield_adr[i] + count]
        spec.add_hfield(
            name=str(i), size=model.hfield_size[i], nrow=int(model.hfield_nrow[i]), ncol=int(model.hfield_ncol[i]), userdata=data
        )


def _mesh_spans(model: mujoco.MjModel) -> list[tuple[Any, Any]]:
    return [(model.mesh_vertadr, model.mesh_vertnum), (model.mesh_faceadr, model.mesh_facenum)]


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
