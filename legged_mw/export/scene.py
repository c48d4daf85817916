"""Write a robot with ground, servos and named sensors as one MJCF text that needs no other file.

It adds sensors and a keyframe, and writes meshes from files into the text. A check compares the physics with that of
the trained model.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from xml.etree import ElementTree
from xml.sax.saxutils import quoteattr

import mujoco
import numpy as np

from legged_mw.drawing.scene import with_scene
from legged_mw.drawing.terrain_look import STEEP_LIGHT
from legged_mw.sim.ground import GROUND, MOST_BOXES, Box, add_ground_box, as_boxes, feel_all_ground
from legged_mw.sim.model import RobotModel
from legged_mw.sim.terrain import Terrain
from legged_mw.utils.errors import ModelError

AROUND = 1000.0  # [m] width of the level ground around the steps
HOME = "home"  # keyframe with the start pose and its servo targets
MODEL_TOLERANCE = 1e-5  # relative, absolute if below 1; MuJoCo writes MJCF with six digits
_OPTION = (
    *("timestep", "integrator", "cone", "solver", "iterations", "ls_iterations", "tolerance"),
    *("disableflags", "enableflags", "gravity", "impratio"),
)
_FIELDS = (
    *("qpos0", "body_parentid", "body_mass", "body_inertia", "body_pos", "body_quat", "body_ipos", "body_iquat"),
    *("jnt_type", "jnt_axis", "jnt_pos", "jnt_range", "jnt_limited", "jnt_stiffness", "jnt_solref", "jnt_solimp"),
    *("dof_armature", "dof_damping", "dof_frictionloss", "dof_solref", "dof_solimp"),
    *("actuator_dyntype", "actuator_gaintype", "actuator_biastype", "actuator_ctrlspec"),
    *(
        "actuator_gainprm",
        "actuator_biasprm",
        "actuator_ctrlrange",
        "actuator_forcerange",
        "actuator_gear",
        "actuator_trnid",
    ),
    *("actuator_ctrllimited", "actuator_forcelimited", "jnt_actfrclimited", "jnt_actfrcrange"),
)
_CONTACT = (
    *("type", "bodyid", "size", "pos", "quat", "solmix", "contype", "conaffinity", "condim", "priority"),
    *("friction", "solref", "solimp", "margin", "gap"),
)


@dataclass(frozen=True)
class Scene:
    """A scene as text, and its sensors."""

    xml: str
    sensors: dict[str, list[str]]  # quantity -> sensors; their concatenated values are the quantity


def standalone(
    robot: RobotModel,
    imu: str,
    qpos: Sequence[float],
    ctrl: Sequence[float],
    camera: Sequence[float] = (),
    source: str = "",
) -> Scene:
    """Return ``robot`` as MJCF text, with sensors for a controller, and ``qpos`` and ``ctrl`` as keyframe "home".

    ``source``: the text of the robot's file. It shows which meshes MuJoCo builds; others must be written as vertices.
    Raises ModelError if the text cannot be made, or if its physics differs from the trained model's.
    """
    spec = with_scene(robot, camera)
    if files := [field.name for field in spec.hfields if field.file]:
        raise ModelError(
            f"height field '{files[0]}' comes from a file; an export must need no other file, so build it from numbers"
        )
    what = "robot, ground, servos, sensors. Self-contained; written by legged_mw from the model that was trained."
    spec.comment = f"\n    {spec.modelname}: {what}\n  "
    for geom in spec.geoms:  # a height scan's rays hit group 0 only, which is the ground
        if geom.group == 0 and geom.parent.name != "world":
            geom.group = 1
    sensors = _add_sensors(spec, robot.joint_names, imu)
    spec.add_key(name=HOME, qpos=list(qpos), ctrl=list(ctrl))
    try:
        _write_out_files(spec)
        spec.compile()
        xml = shorten(spec.to_xml(), source)
        model = mujoco.MjModel.from_xml_string(xml)
    except ValueError as error:
        raise ModelError(f"the robot cannot be written as one MJCF: {' '.join(str(error).split())}") from None
    if wrong := differences(robot.physics, model):
        raise ModelError(
            f"the robot written as one MJCF has other physics: {', '.join(wrong)} differ from the trained model"
        )
    return Scene(xml, sensors)


def among_steps(xml: str, terrain: Terrain, start: Sequence[float]) -> str:
    """The scene of ``standalone`` on boxes, the level pieces of ``terrain``. The robot starts at ``start`` [m].

    Level ground of width ``AROUND`` surrounds them. Raises ModelError for slopes and noise, which are not level, and
    for too many pieces. A height field as text would have several megabytes.
    """
    spec = mujoco.MjSpec.from_string(xml)
    floor, (boxes, _, left) = spec.geom(GROUND), as_boxes(terrain)
    if left:
        raise ModelError(f"tiles of {', '.join(left)} are not level pieces, or more than {MOST_BOXES} of them")
    x, y = (AROUND - corner for corner in terrain.corner)
    inner_x, inner_y = terrain.levels * terrain.tile / 2, len(terrain.kinds) * terrain.tile / 2
    border = [
        ((-x, -y), (x, -inner_y)),
        ((-x, inner_y), (x, y)),
        ((-x, -inner_y), (-inner_x, inner_y)),
        ((inner_x, -inner_y), (x, inner_y)),
    ]
    bottom = terrain.span()[0] - 1.0
    pieces = [*boxes, *(Box(low, high, 0.0) for low, high in border)]
    tiles = [terrain.tile_at((low[0] + high[0]) / 2, (low[1] + high[1]) / 2) for low, high, _ in pieces]
    tops = {
        tile: sorted({piece.top for piece, where in zip(pieces, tiles, strict=True) if where == tile}) for tile in tiles
    }
    for (low, high, top), tile in zip(pieces, tiles, strict=True):
        box = add_ground_box(spec, np.array([*low, bottom]), np.array([*high, top]))
        tone = (1.0, 0.7)[tops[tile].index(top) % 2]  # neighbouring steps have different tones
        box.material, box.rgba = floor.material, [tone, tone, tone, 1.0]
        box.classname = _class_of(spec, "light_step" if tone == 1.0 else "dark_step", box)
    floor.pos = [0.0, 0.0, bottom]
    for light in spec.lights:
        light.dir = STEEP_LIGHT
    feel_all_ground(spec)
    for key in spec.keys:
        key.qpos = [*start, *list(key.qpos)[3:]]
    spec.compile()
    return shorten(spec.to_xml(), xml)


def _class_of(spec: mujoco.MjSpec, name: str, box: mujoco.MjsGeom) -> mujoco.MjsDefault:
    """The default class ``name``, made from its first box without place and size. Defaults halve the file's size."""
    default = spec.find_default(name)
    if not default:
        default = spec.add_default(name, spec.default)
        for field in ("type", "conaffinity", "priority", "friction", "material", "rgba"):
            setattr(default.geom, field, getattr(box, field))
    return default


def _add_sensors(spec: mujoco.MjSpec, joints: Sequence[str], imu: str) -> dict[str, list[str]]:
    """Quantity -> sensors. Adds sensors of values that training computes from the state; keeps contact sensors."""
    kinds, objects = mujoco.mjtSensor, mujoco.mjtObj
    taken = {sensor.name for sensor in spec.sensors}

    def add(kind: str, name: str, sensor: mujoco.mjtSensor, obj: mujoco.mjtObj, **more: object) -> str:
        full = f"{kind}/{name}"
        if full not in taken:
            spec.add_sensor(name=full, type=sensor, **{"objtype": obj, "objname": name, **more})
        return full

    site, joint = objects.mjOBJ_SITE, objects.mjOBJ_JOINT
    # the world's z axis in the IMU's frame; gravity has the opposite direction
    up = {"objtype": objects.mjOBJ_BODY, "objname": "world", "reftype": site, "refname": imu}
    return {
        "lin_vel": [add("velocimeter", imu, kinds.mjSENS_VELOCIMETER, site)],
        "ang_vel": [add("gyro", imu, kinds.mjSENS_GYRO, site)],
        "up": [add("up", imu, kinds.mjSENS_FRAMEZAXIS, site, **up)],
        "acceleration": [add("accelerometer", imu, kinds.mjSENS_ACCELEROMETER, site)],
        "joint_pos": [add("jointpos", name, kinds.mjSENS_JOINTPOS, joint) for name in joints],
        "joint_vel": [add("jointvel", name, kinds.mjSENS_JOINTVEL, joint) for name in joints],
        "joint_torque": [add("torque", name, kinds.mjSENS_ACTUATORFRC, objects.mjOBJ_ACTUATOR) for name in joints],
    }


def _write_out_files(spec: mujoco.MjSpec) -> None:
    """Replace meshes from files by vertices in the text, and remove textures, which do not affect physics."""
    pictures = {t.name for t in spec.textures if t.file or any(t.cubefiles)}
    for material in spec.materials:
        material.textures = ["" if name in pictures else name for name in material.textures]
    for texture in [t for t in spec.textures if t.name in pictures]:
        spec.delete(texture)
    model = spec.copy().compile()
    for mesh in spec.meshes:
        if mesh.file:
            view, rotation = model.mesh(mesh.name), np.zeros(9)
            vertices, faces = (
                slice(start[0], start[0] + count[0])
                for start, count in ((view.vertadr, view.vertnum), (view.faceadr, view.facenum))
            )
            mujoco.mju_quat2Mat(rotation, model.mesh_quat[view.id])  # a compiled mesh is in its principal axes
            places = model.mesh_vert[vertices] @ rotation.reshape(3, 3).T + model.mesh_pos[view.id]
            mesh.file, mesh.scale, mesh.refpos, mesh.refquat = "", [1, 1, 1], [0, 0, 0], [1, 0, 0, 0]
            mesh.uservert, mesh.userface = places.ravel(), model.mesh_face[faces].ravel()
    spec.meshdir = spec.texturedir = ""


def differences(trained: mujoco.MjModel, model: mujoco.MjModel) -> list[str]:
    """Names of the physical fields that differ. Visual geoms, sensors and keyframes are not compared."""
    wrong = [f"option {name}" for name in _OPTION if not _close(getattr(trained.opt, name), getattr(model.opt, name))]
    wrong += [name for name in _FIELDS if not _close(getattr(trained, name), getattr(model, name))]
    colliding = [np.flatnonzero(m.geom_contype | m.geom_conaffinity) for m in (trained, model)]
    for name in _CONTACT:
        here, there = (getattr(m, f"geom_{name}")[geoms] for m, geoms in zip((trained, model), colliding, strict=True))
        if not _close(here, there):
            wrong.append(f"geom_{name}")
    return wrong


def _close(a: object, b: object) -> bool:
    a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    return a.shape == b.shape and bool(np.all(np.abs(a - b) <= MODEL_TOLERANCE * np.maximum(1.0, np.abs(a))))


# ---- meshes that MuJoCo builds from some numbers, written as those numbers: as text, their vertices are most of an MJ

_BUILT = ("vertex", "normal", "texcoord", "face", "facenormal", "facetexcoord")  # computed from the parameters
_PLACES = ("mesh_vertnum", "mesh_facenum", "mesh_vert", "mesh_pos", "mesh_quat", "geom_pos", "geom_quat", "geom_size")
PLACE_TOLERANCE = 1e-5  # of positions [m] and quaternions; MuJoCo writes six digits


def shorten(xml: str, source: str) -> str:
    """Replace meshes that MuJoCo builds by their parameters from ``source``. ``xml``: as MuJoCo wrote it.

    Returns ``xml`` unchanged if the result is another model: a mesh may be renamed, or come from a file that ``source``
    includes.
    """
    short = xml
    for name, numbers in built_meshes(source).items():
        start = f"<mesh name={quoteattr(name)}"
        element = re.search(rf"{re.escape(start)}[^>]*>", short)
        if element and " vertex=" in element[0]:
            left = re.sub(rf' ({"|".join(_BUILT)})="[^"]*"', "", element[0])
            short = short.replace(element[0], left.replace(start, f"{start} {numbers}", 1), 1)
    return short if short == xml or _same(short, xml) else xml


def built_meshes(source: str) -> dict[str, str]:
    """Mesh -> the attributes from which MuJoCo builds it, in the MJCF ``source``; empty if it is not an MJCF."""
    try:
        meshes = [
            mesh for mesh in ElementTree.fromstring(source).iter("mesh") if mesh.get("name") and mesh.get("builtin")
        ]
    except ElementTree.ParseError:
        return {}
    attributes = ("builtin", "params")
    return {
        mesh.attrib["name"]: " ".join(
            f"{key}={quoteattr(mesh.attrib[key])}" for key in attributes if key in mesh.attrib
        )
        for mesh in meshes
    }


def _same(short: str, xml: str) -> bool:
    try:
        new, old = (mujoco.MjModel.from_xml_string(text) for text in (short, xml))
    except ValueError:
        return False
    pairs = [(getattr(new, field), getattr(old, field)) for field in _PLACES]
    return all(a.shape == b.shape and np.allclose(a, b, rtol=0.0, atol=PLACE_TOLERANCE) for a, b in pairs)
