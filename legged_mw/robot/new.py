"""Write a first task: NAME.xml with the robot only, and NAME_flat.py with a config that is ready for training."""

from __future__ import annotations

import json
import os
import re
import shutil
import textwrap
from collections.abc import Collection, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import mujoco
import numpy as np

from legged_mw.robot.draft import Draft, parents, values
from legged_mw.robot.meshes import FACES_OF_LOOKS, matters, path_of
from legged_mw.robot.mjcf import XmlSource
from legged_mw.robot.triangles import Triangles, thinned, write_stl
from legged_mw.robot.vendor import read_robot
from legged_mw.sim.robot_file import naming
from legged_mw.utils.errors import UserError, shown

WIDTH = 140  # [columns] longest line of the config
_SHORT = 300  # faces of a mesh that stays in the text

_HEAD = '''"""{title} ({legs}, {joints} joints; {file}) follows a joystick on flat ground. Check what is marked LOOK."""

{imports}
{real}

class {name}FlatCfg({cfg}):
'''
_REAL = """
# LOOK, before a real robot, what matters most first:
# 1. asset.imu_site: place and axes of its IMU. Here: {imu}
# 2. stiffness, damping: those that its servos will have, and control.action_scale
# 3. domain_rand.delay_ms: from an action to its torque. Measure it
# 4. effort: what its motors give. Here: {effort}
# 5. domain_rand.friction of the ground and asset.frictionloss, asset.armature of its joints
# 6. domain_rand.base_mass, base_com: what it will carry
"""
_COMMENTS = {
    "foot_names": "LOOK: guessed",
    "foot_geoms": "foot -> its geoms",
    "joint_speed_limits": "[rad/s] the file's",
    "colliders": "the feet alone touch the ground",
    "pos": "[m] standing, computed",
    "damping": "[N m s/rad] LOOK: likewise",
    "armature": "[kg m^2] of the rotors, published; the file has none",
    "integrator": "explicit Euler is unstable with these gains on such light limbs",
    "iterations": "with fewer the physics of light limbs is not solved [ours: docs/your_own_robot.md]",
    "action_scale": "[rad] an action of 1 moves a joint so far",
    "clip_actions": "so that a joint is moved by 1 rad at most",
    "end_probability": "share of each command's values at the ends of its range, to learn starts at full speed",
    "period": "[s] no reward asks for it; without a clock left and right legs start alike [ours: docs/archive/drafts.md]",
    "lin_vel_x": "[m/s] LOOK: what you want of it",
    "lin_vel_y": "[m/s]",
    "ang_vel_yaw": "[rad/s]",
    "min_base_height": "[m] half of the standing height: lower, it fell",
    "swing_height": "[m] of a swinging foot",
    "friction": "[-] of the ground",
    "kick": "without kicks a push topples it [ours: docs/lab.md]",
    "velocity": "[m/s]",
    "leave_out": "the policy is told its velocity; for a real robot leave this out",
    "enable": "worlds are alike; likewise",
    "base_mass": "[kg] more or less of it",
    "push": "kicks alone; likewise",
    "delay_ms": "[ms] from an action to its torque",
    "dof_acc": "no jerks",
    "feet_impact_vel": "no stamping",
    "target_limits": "no targets beyond a joint's range",
    "termination": "a fall costs more than a faster start pays",
    "max_push_ang_vel": "[rad/s] a push turns it too",
    "feet_orientation": "soles level",
    "energy": "by its mass",
    "min_feet_distance": "[m] between the feet, sideways: less is punished",
    "pose_weights": "how near the default pose each joint is to stay",
    "contact_phase": "one foot after the other; without it and no_fly a beginner hops [ours: docs/lab.md]",
}


def targets(name: str, folder: Path, file: Path, force: bool = False, pack: bool = True) -> tuple[Path, Path]:
    """The paths of the two files of the task ``name`` for the robot in ``file``.

    Raises UserError for an invalid name, an existing file, or with ``pack`` an existing folder of its meshes; ``force``
    allows those that are not ``file``.
    """
    if not re.fullmatch(r"[A-Za-z]\w*", name):
        raise UserError(f"--new {name}: a name begins with a letter and has letters, digits and _ only")
    robot, config = folder / f"{name}.xml", folder / f"{name}_flat.py"
    with naming(file):
        is_own = robot.exists() and file.exists() and robot.samefile(file) and not stands_alone(file)
    if is_own:
        raise UserError(f"{shown(robot)} is the robot's own file and is not overwritten; use another name or --out DIR")
    parts = [folder / f"{name}_parts"] if pack and not stands_alone(file) else []
    there = [path for path in (robot, config, *parts) if path.exists()]
    if there and not force:
        raise UserError(
            f"{' and '.join(shown(path) for path in there)} exists; say another name or --out DIR, or --force to overwrite"
        )
    return robot, config


def write(
    found: Draft,
    file: Path,
    name: str,
    folder: Path,
    *,
    force: bool = False,
    mirrors: bool = False,
    pack: bool = True,
) -> list[Path]:
    """Write both files into ``folder``. With ``pack``, copy the robot's meshes and pictures into a folder there.

    ``mirrors``: the robot is symmetric, see ``has_mirror``. Returns what was written. Raises UserError.
    """
    robot, config = targets(name, folder, file, force, pack)
    parts = folder / f"{name}_parts"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if stands_alone(file):
            if not (robot.exists() and robot.samefile(file)):
                shutil.copyfile(file, robot)
        else:
            robot.write_text(as_mjcf(name, file, folder, parts if pack else None))
        config.write_text(config_text(found, file, name, mirrors))
    except OSError as error:
        raise UserError(
            f"cannot write to {shown(folder)}: {error.strerror or os.strerror(error.errno or 0)}; say --out DIR"
        ) from None
    return [robot, config, *([parts] if pack and parts.exists() else [])]


def class_name(name: str) -> str:
    """``name`` in capitals: "my_dog" becomes MyDog. An underscore between digits stays: "h1_2" becomes H1_2."""
    capitals = "_".join(part[:1].upper() + part[1:] for part in name.split("_"))
    return re.sub(r"(?<!\d)_|_(?!\d)", "", capitals)


def refuse_wheels(found: Draft, file: Path) -> None:
    """Raise UserError for a robot on wheels: a draft's servos control angles, and a wheel needs a speed."""
    if found.wheels:
        raise UserError(
            f"{shown(file)} is on wheels: {', '.join(found.wheels)} have no range and end in a round collider, and a draft "
            "has servos that turn to an angle. Write a task that drives wheels by speed (docs/motors.md#wheels), or make "
            "these joints fixed in a copy of the file: it walks on locked wheels"
        )


def config_text(found: Draft, file: Path, name: str, mirrors: bool = False) -> str:
    """The text of the config file. LOOK marks values to check."""
    feet = len(found.feet)
    legs = {2: "biped", 4: "quadruped"}.get(feet, f"{feet} feet")
    title = class_name(name)
    base, train = (parent.__name__ for parent in parents(found))
    names = {"imports": _imports(found), "cfg": base, "real": "" if found.simple else _before_a_real_robot(found)}
    lines = [
        _HEAD.format(title=name, joints=len(found.joints), legs=legs, file=file.name, name=title, **names).rstrip("\n")
    ]
    sections = values(found)
    sections["asset"] = {"file": f"{name}.xml", **sections["asset"]}
    source = found.gains_from.replace("suggested below", "computed (legged_mw/robot/measure.py)")
    comments = {
        **_COMMENTS,
        "held_joints": _held(found),
        "default_joint_angles": f"[rad] LOOK: {found.pose_from}",
        "stiffness": f"[N m/rad] LOOK: {source}",
    }
    for section, fields in sections.items():
        lines += [f"    class {section}({base}.{section}):"]
        for field, value in fields.items():
            if field in ("ranges", "scales"):
                lines += [""] * (field != next(iter(fields)))
                lines += [f"        class {field}({base}.{section}.{field}):"]
                lines += [
                    line for inner, span in value.items() for line in _field(inner, span, comments.get(inner, ""), 12)
                ]
            else:
                lines += _field(field, value, comments.get(field, ""), 8)
        if section == "asset":
            lines += _force_limits(found)
        lines.append("")
    lines += ["", f"class {title}FlatCfgPPO({train}):"]
    lines += _learner(found, train)
    if mirrors != parents(found)[1].symmetry.use_data_augmentation:
        comment = f"left and right are {'alike' if mirrors else 'not alike'}"
        lines += [
            "",
            f"    class symmetry({train}.symmetry):",
            f"        use_data_augmentation = {mirrors}  # {comment}",
        ]
    lines += ["", ""]
    return "\n".join([*lines, f"TASK = Task(LeggedRobot, {title}FlatCfg, {title}FlatCfgPPO)", ""])


def _learner(found: Draft, train: str) -> list[str]:
    """The learner's sections. Features that are difficult on a few cores are off."""
    std = f"{train}.actor.distribution_cfg"
    if found.simple:
        lines = [f"    class runner({train}.runner):", "        max_iterations = 1500"]
        if len(found.feet) == 2:
            lines += ["", f"    class actor({train}.actor):", f"        class distribution_cfg({std}):"]
            lines += [
                "            init_std = 0.6  # at 1.0 it does not learn to follow on a few cores [ours: docs/lab.md]"
            ]
        return lines
    lines = [f"    class cpu({train}.cpu):  # on a CPU worlds are alike, nobody pushes"]
    if len(found.feet) == 2:
        overrides = [
            '"commands.keep_probability": [0.7, 0.25, 0.5], "perturbation.curriculum": True,',
            '"domain_rand.enable": False, "perturbation.push": False,',
            '"actor.distribution_cfg.init_std": 0.6, "perturbation.velocity": [0.0, 4.0],',
        ]
    else:  # as configs/go1_flat.py [ours: docs/archive/drafts.md]
        lines += ["        desired_kl, max_iterations = 0.03, 1500"]
        overrides = [
            '"domain_rand.enable": False, "perturbation.push": False, "commands.end_probability": 0.0,',
            '"commands.keep_probability": [0.6, 0.25, 0.75], "perturbation.growth": [0.15, 0.4],',
            '"rewards.tracking_sigma": 0.35, "rewards.tracking_sigma_end": 0.15,',
            '"rewards.scales.tracking_ang_vel": 1.5, "algorithm.entropy_coef": 0.01,',
            '"rewards.scales.termination": -1.0,',
        ]
    return [*lines, "        overrides = {", *(f"            {line}" for line in overrides), "        }"]


def _before_a_real_robot(found: Draft) -> str:
    """Comments with the facts that a real robot needs, in order."""
    known = all(joint.effort != float("inf") for joint in found.joints)
    effort = "the file's limits" if known else "some joints have none, which no motor is"
    text = _REAL.format(imu=f"site '{found.robot.imu}' of '{found.robot.root}'", effort=effort)
    return text.rstrip("\n") + "\n"


def _imports(found: Draft) -> str:
    """The import lines of the config file, sorted."""
    cfg, train = parents(found)
    lines = ["from legged_mw.envs.legged_robot import LeggedRobot", "from legged_mw.utils.task import Task"]
    if cfg.__module__ == train.__module__:
        lines += [f"from {cfg.__module__} import {cfg.__name__}, {train.__name__}"]
    else:
        lines += [f"from {parent.__module__} import {parent.__name__}" for parent in (cfg, train)]
    return "\n".join(sorted(lines))


def _force_limits(found: Draft) -> list[str]:
    """A line for the config if the robot's file lacks force limits."""
    endless = [joint.name for joint in found.joints if joint.effort == float("inf")]
    if not endless:
        return []
    some = f"{endless[0]} and {len(endless) - 1} more" if endless[1:] else endless[0]
    some = "all joints" if len(endless) == len(found.joints) else some
    return [f'        # effort = {{"": 30.0}}  # [N m] LOOK: the file has no force limit for {some}; write yours']


def _held(found: Draft) -> str:
    every = len(found.angles)
    return f"LOOK: {len(found.held)} joints that do not walk; without this line the task has {every} actions"


def _field(name: str, value: Any, comment: str, indent: int) -> list[str]:
    """``name = value  # comment``, split into several lines if it is longer than WIDTH."""
    space, note = " " * indent, f"  # {comment}" if comment else ""
    # json writes all values except booleans as Python does, with ruff's quotes
    text = str(value) if isinstance(value, bool) else json.dumps(value)
    line = f"{space}{name} = {text}"
    if len(line + note) <= WIDTH:
        return [line + note]
    opening, closing = ("{", "}") if isinstance(value, dict) else ("[", "]")
    parts = json.dumps(value)[1:-1].replace(": ", ":\0") + ","  # keep a key and its number on one line
    lines = textwrap.wrap(parts, WIDTH - indent - 4, break_long_words=False, break_on_hyphens=False)
    return [
        f"{space}{name} = {opening}{note}",
        *(f"{space}    {line}".replace("\0", " ") for line in lines),
        space + closing,
    ]


# ---- the robot only, as MJCF text without absolute paths ------------------------------------------------------------


def stands_alone(file: Path) -> bool:
    """Whether ``file`` is an MJCF that needs no other file, so that it can be copied."""
    source = XmlSource(file)
    return source.root.tag == "mujoco" and not source.named


def as_mjcf(name: str, file: Path, folder: Path, parts: Path | None = None) -> str:
    """The robot in ``file`` as MJCF text for ``folder``, with mesh paths relative to ``folder``.

    With ``parts``, a folder in it, the files are copied there, else the text names them where they are.
    """
    robot = read_robot(file)
    spec = robot.spec
    for joint in robot.joints:
        if joint.name in robot.limits:
            joint.actfrclimited, joint.actfrcrange = True, [*robot.limits[joint.name]]
    spec.modelname = name
    spec.comment = f"\n    {name}: facts of the machine, from {file.name}. Ground, servos and sensors are added where it is loaded.\n  "
    with naming(file):
        spec.compile()
        paths = _name_files(spec, XmlSource(file).folders)
        new = {} if parts is None else _copied(spec, paths, parts)
        materials = {material.name for material in spec.materials}
        for default in [geom.classname.geom for geom in spec.geoms]:
            if default.material not in materials:  # no element uses it, because each overrides it by ""
                default.material = ""
        text = spec.to_xml()
    for path in {*paths, *new}:
        there = new.get(path, path)
        text = text.replace(f'"{escape(str(path))}"', f'"{escape(os.path.relpath(there, folder.resolve()))}"')
    return text


def _name_files(spec: mujoco.MjSpec, folders: Iterable[str]) -> set[Path]:
    """Give meshes, skins and textures absolute paths, and return these. Missing files keep their paths."""
    paths: set[Path] = set()

    def named(item: mujoco.MjsMesh | mujoco.MjsTexture | mujoco.MjsSkin, file: str) -> str:
        own = item.compiler.texturedir if isinstance(item, mujoco.MjsTexture) else item.compiler.meshdir
        places = [path_of(spec, item, file), *(Path(folder) / own / file for folder in folders)]
        path = next((place.resolve() for place in places if file and place.is_file()), None)
        paths.update([path] if path else [])
        return str(path) if path else file

    for item in (*spec.meshes, *spec.textures, *spec.skins):
        item.file = named(item, item.file)
    for texture in spec.textures:
        texture.cubefiles = [named(texture, file) for file in texture.cubefiles]
    spec.meshdir, spec.texturedir, spec.strippath = "", "", False
    return paths


def _copied(spec: mujoco.MjSpec, paths: Collection[Path], parts: Path) -> dict[Path, Path]:
    """Copy files into ``parts``, with thinned visuals. Return old -> new path. Inline meshes also become files."""
    new: dict[Path, Path] = {}
    long = [mesh for mesh in spec.meshes if len(mesh.userface) > _SHORT and not len(mesh.usertexcoord)]
    if paths or long:
        parts.mkdir(exist_ok=True)
    # files that the source names are not overwritten, nor written through a link
    own = [file for file in parts.iterdir() if file.resolve() in paths] if parts.is_dir() else []
    for mesh in long:
        place = parts.resolve() / _unused(f"{mesh.name}.stl", [*new.values(), *own])
        write_stl(Triangles(np.reshape(mesh.uservert, (-1, 3)), np.reshape(mesh.userface, (-1, 3))), place)
        mesh.file, mesh.uservert, mesh.userface, mesh.usernormal = str(place), [], [], []
        new[place] = place
    for path in sorted(paths):
        meshes = [mesh for mesh in spec.meshes if mesh.file == str(path)]
        look = None
        if meshes and all(_is_look(spec, mesh) for mesh in meshes):
            with suppress(ValueError):  # only MuJoCo can read it, such as a .msh
                look = thinned(path, FACES_OF_LOOKS)
        name = path.name if look is None else f"{path.stem}.stl"
        new[path] = parts.resolve() / _unused(name, [*new.values(), *own])
        if look is None:
            shutil.copyfile(path, new[path])
            continue
        write_stl(look, new[path])
        for mesh in meshes:
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # a thinned surface may be open
    return new


def _is_look(spec: mujoco.MjSpec, mesh: mujoco.MjsMesh) -> bool:
    """Whether a mesh is only visual and has one colour, so that its exact shape does not matter."""
    geoms = [geom for geom in spec.geoms if geom.meshname == mesh.name]
    pictured = {material.name for material in spec.materials if any(material.textures)}
    worn = {mesh.material, *(geom.material for geom in geoms)}
    return not pictured & worn and not any(matters(geom) for geom in geoms)


def _unused(name: str, taken: Iterable[Path]) -> str:
    """A file name from ``name`` that differs from all of ``taken``, also without regard to capitals."""
    name = re.sub(r"[^\w.-]", "_", name)
    names = {path.name.lower() for path in taken}
    stem, dot, ending = name.rpartition(".")
    while name.lower() in names:
        stem += "_"
        name = f"{stem}{dot}{ending}"
    return name
