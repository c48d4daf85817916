"""Read a plain MJCF, such as those in ``resources/robots``; ``legged_mw.robot`` reads all other files of robots."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree.ElementTree import XML, Element, ParseError, tostring

import mujoco
import numpy as np

from legged_mw.utils.errors import ModelError

# What a plain MJCF consists of: one body with a free joint, no other file, numbers that a machine may have.
_SECTIONS = {"compiler", "option", "default", "asset", "worldbody", "keyframe"}
_IN_ASSET = {"material", "mesh"}
_IN_COMPILER = {"angle", "autolimits"}
_IN_DEFAULT = {"default", "joint"}  # other defaults would apply to elements that are added
_IN_BODY = {"body", "freejoint", "joint", "inertial", "geom", "site"}
_NOT_NEGATIVE = {"mass", "density", "diaginertia", "armature", "frictionloss"}
_MOST_BYTES, _LARGEST = 1 << 20, 1e5  # of a plain file; of its numbers, in any unit, and of the mass [kg]
# names of the ground and of a scene, which are added around a robot
SCENE = re.compile(r"(floor|ground|around|relief|sky)(/.*)?")

Range = tuple[float, float]
SCALAR_JOINTS = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
UPRIGHT = 0.5  # [degrees] less tilt is rounding


@dataclass(frozen=True)
class Keyframe:
    """A pose that the file holds."""

    name: str
    height: float | None  # of the upright root [m]; None: the file has no free joint, or tilts it
    angles: dict[str, float]  # joint -> [rad]


@dataclass(frozen=True)
class RobotFile:
    """A robot alone: one root with a free joint, named joints, no actuators, few of its own sensors."""

    spec: mujoco.MjSpec
    model: mujoco.MjModel  # the same, compiled
    where: str  # the file's name
    notes: list[str]  # a line for each thing that was dropped, added or renamed
    limits: dict[str, Range]  # joint -> lowest and highest force [N m], where the file limits it
    speeds: dict[str, float]  # joint -> highest speed [rad/s], likewise
    keyframe: Keyframe | None  # "home", or the only one
    sensors: tuple[str, ...] = ()  # names of the file's sensors, kept or dropped
    # geom or body with a collider that is left out, as its mesh cannot be read -> an error for who needs it
    lost: dict[str, str] = field(default_factory=dict)

    @property
    def root(self) -> str:
        """Name of the body that carries the free joint."""
        return self.spec.joints[0].parent.name

    @property
    def joints(self) -> list[mujoco.MjsJoint]:
        """The scalar joints, in order of qpos[7:]."""
        return list(self.spec.joints)[1:]


def read_plain(file: Path) -> RobotFile | None:
    """Read a plain MJCF. None if ``file`` is not plain: ``legged_mw.robot.vendor`` reads it or says why not."""
    try:
        if not file.is_file() or file.stat().st_size > _MOST_BYTES:
            return None
        text, notes, keyframe = file.read_text(encoding="utf-8"), list[str](), None
        if "<!DOCTYPE" in text or not _is_plain(root := XML(text)):
            return None
        spec = mujoco.MjSpec.from_string(tostring(root, encoding="unicode"))
        limits, joints = joint_limits(spec), list(spec.joints)[1:]
        if not joints or not all(joint.type in SCALAR_JOINTS and joint.name for joint in joints):
            return None
        for key in list(spec.keys):  # its size would not fit the motors that are added
            qpos, names = list(key.qpos), [joint.name for joint in joints]
            if len(qpos) != 7 + len(names) or tilt(qpos[3:7]) > UPRIGHT:
                return None
            keyframe = Keyframe(key.name, qpos[2], dict(zip(names, qpos[7:], strict=True)))
            notes.append(f"keyframe '{key.name}' read: pose and height of the root, where nothing else states them")
            spec.delete(key)
        spec.nkey = 0
        with warnings.catch_warnings(record=True) as said:
            model = compile_copy(spec)
    except (OSError, ValueError, ParseError, RecursionError):
        return None
    if said or not model.body_mass.sum() <= _LARGEST:
        return None
    return RobotFile(spec, model, file.name, notes, limits, {}, keyframe)


def _is_plain(root: Element) -> bool:
    """Decided by elements and attributes alone, before MuJoCo reads the file."""
    bodies = root.findall("worldbody/*")
    if root.tag != "mujoco" or len(bodies) != 1 or not bodies[0].get("name"):
        return False
    return (
        _tags(root) <= _SECTIONS
        and {name for compiler in root.findall("compiler") for name in compiler.attrib} <= _IN_COMPILER
        and not any({"gravity", "timestep"} & option.attrib.keys() for option in root.findall("option"))
        and all(_tags(asset) <= _IN_ASSET for asset in root.findall("asset"))
        and all(_tags(default) <= _IN_DEFAULT for default in root.findall("default"))
        and bodies[0].find("freejoint") is not None
        and {element.tag for element in bodies[0].iter()} <= _IN_BODY
        and len(root.findall("keyframe/key")) <= 1
        and not any(SCENE.fullmatch(element.get("name", "")) for element in root.iter())
        and all(_is_plain_attribute(*item) for element in root.iter() for item in element.items())
    )


def _is_plain_attribute(name: str, value: str) -> bool:
    """It names no file; its numbers, if it has any, are finite and of a size that machines have."""
    if name.startswith("file"):
        return False
    lowest = 0.0 if name in _NOT_NEGATIVE else -_LARGEST
    try:
        numbers = [float(part) for part in value.split()]
    except ValueError:  # text
        return True
    in_order = not name.endswith("range") or numbers == sorted(numbers)
    return in_order and all(lowest <= number <= _LARGEST for number in numbers)


def _tags(element: Element) -> set[str]:
    return {child.tag for child in element}


def joint_limits(spec: mujoco.MjSpec) -> dict[str, Range]:
    """Joint -> lowest and highest force [N m], of joints with an actuatorfrcrange (in a URDF: effort)."""
    return {
        joint.name: tuple(joint.actfrcrange)
        for joint in spec.joints
        if is_limited(joint.actfrclimited, joint.actfrcrange)
    }


def is_limited(switch: int, span: np.ndarray) -> bool:
    """Whether a limit with this switch and range is in force."""
    return bool(switch != mujoco.mjtLimited.mjLIMITED_FALSE and span[1] > span[0])


def compile_copy(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile a copy of ``spec``. Visual geoms are slow: compile them only to find mistakes in files of theirs."""
    copy = spec.copy()
    copy.compiler.discardvisual = not any(item.file for item in (*spec.meshes, *spec.textures))
    return copy.compile()


@contextmanager
def naming(file: Path) -> Iterator[None]:
    """Turn MuJoCo's errors into one line with the file's name."""
    try:
        yield
    except ModelError:
        raise
    except RecursionError:
        raise ModelError(f"{file.name} is not a valid {kind_of(file)}: it is nested too deeply") from None
    except ValueError as error:
        why = str(error).partition("The visual elements of the spec")[0]
        raise ModelError(f"{file.name} is not a valid {kind_of(file)}: {' '.join(why.split())}") from None


def kind_of(file: Path) -> str:
    """The format that its name states."""
    return "URDF" if file.suffix == ".urdf" else "MJCF"


def tilt(quat: Sequence[float] | np.ndarray) -> float:
    """Angle between the root's z axis and the vertical [degrees]; ``quat`` wxyz."""
    w, x, y, z = np.array(quat) / (np.linalg.norm(quat) or 1.0)
    return float(np.degrees(np.arccos(np.clip(w * w - x * x - y * y + z * z, -1.0, 1.0))))
