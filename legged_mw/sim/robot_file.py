"""Read a plain MJCF, such as those in ``resources/robots``. ``legged_mw.robot`` reads all other robot files."""

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

# A plain MJCF has one body with a free joint, no other files, and only values that are possible for a machine.
_SECTIONS = {"compiler", "option", "default", "asset", "worldbody", "keyframe"}
_IN_ASSET = {"material", "mesh"}
_IN_COMPILER = {"angle", "autolimits"}
_IN_DEFAULT = {"default", "joint"}  # other defaults would apply to elements that are added
_IN_BODY = {"body", "freejoint", "joint", "inertial", "geom", "site"}
_NOT_NEGATIVE = {"mass", "density", "diaginertia", "armature", "frictionloss"}
_MOST_BYTES, _LARGEST = 1 << 20, 1e5  # largest size of a plain file; largest value, in any unit, and mass [kg]
# names of the ground and the scene, which are added to a robot
SCENE = re.compile(r"(floor|ground|around|relief|sky)(/.*)?")

Range = tuple[float, float]
SCALAR_JOINTS = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
UPRIGHT = 0.5  # [degrees] tilt below this is a rounding error


@dataclass(frozen=True)
class Keyframe:
    """A pose in the file."""

    name: str
    height: float | None  # of the upright root [m]; None: no free joint, or a tilted root
    angles: dict[str, float]  # joint -> [rad]


@dataclass(frozen=True)
class RobotFile:
    """A robot without ground and actuators: one root with a free joint, named joints, and the sensors that are kept."""

    spec: mujoco.MjSpec
    model: mujoco.MjModel  # the compiled ``spec``
    where: str  # name of the file
    notes: list[str]  # a line for each dropped, added or renamed thing
    limits: dict[str, Range]  # joint -> lowest and highest force [N m], if the file limits it
    speeds: dict[str, float]  # joint -> highest speed [rad/s], if the file limits it
    keyframe: Keyframe | None  # "home", or the only one
    sensors: tuple[str, ...] = ()  # names of all sensors of the file, kept or dropped
    # geom or body with a dropped collider, whose mesh cannot be read -> error text for callers that need it
    lost: dict[str, str] = field(default_factory=dict)

    @property
    def root(self) -> str:
        """Name of the body with the free joint."""
        return self.spec.joints[0].parent.name

    @property
    def joints(self) -> list[mujoco.MjsJoint]:
        """The scalar joints, in order of qpos[7:]."""
        return list(self.spec.joints)[1:]


def read_plain(file: Path) -> RobotFile | None:
    """Read a plain MJCF. None if ``file`` is not plain: then ``legged_mw.robot.vendor`` reads it or raises."""
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
        for key in list(spec.keys):  # a keyframe does not fit a model with added motors
            qpos, names = list(key.qpos), [joint.name for joint in joints]
            if len(qpos) != 7 + len(names) or tilt(qpos[3:7]) > UPRIGHT:
                return None
            keyframe = Keyframe(key.name, qpos[2], dict(zip(names, qpos[7:], strict=True)))
            notes.append(f"keyframe '{key.name}' read: pose and height of the root, where nothing else states them")
            spec.delete(key)
        spec.nkey = 0
        with warnings.catch_warnings(record=True) as caught:
            model = compile_copy(spec)
    except (OSError, ValueError, ParseError, RecursionError):
        return None
    if caught or not model.body_mass.sum() <= _LARGEST:
        return None
    return RobotFile(spec, model, file.name, notes, limits, {}, keyframe)


def _is_plain(root: Element) -> bool:
    """Whether the MJCF is plain, by its elements and attributes, before MuJoCo reads it."""
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
    """Whether the attribute names no file and its numbers, if any, are finite and possible for a machine."""
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
    """Joint -> lowest and highest force [N m], for joints with an actuatorfrcrange (URDF: effort)."""
    return {
        joint.name: tuple(joint.actfrcrange)
        for joint in spec.joints
        if is_limited(joint.actfrclimited, joint.actfrcrange)
    }


def is_limited(switch: int, span: np.ndarray) -> bool:
    """Whether a limit with this switch and range is active."""
    return bool(switch != mujoco.mjtLimited.mjLIMITED_FALSE and span[1] > span[0])


def compile_copy(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile a copy of ``spec``. Visual geoms are slow, so they are compiled only to find faults in their files."""
    copy = spec.copy()
    copy.compiler.discardvisual = not any(item.file for item in (*spec.meshes, *spec.textures))
    return copy.compile()


@contextmanager
def naming(file: Path) -> Iterator[None]:
    """A context that turns MuJoCo's errors into a ModelError of one line with the file's name."""
    try:
        yield
    except ModelError:
        raise
    except ValueError as error:
        why = str(error).partition("The visual elements of the spec")[0]
        raise ModelError(f"{file.name} is not a valid {kind_of(file)}: {' '.join(why.split())}") from None


def kind_of(file: Path) -> str:
    """The format of the file, by its name."""
    return "URDF" if file.suffix == ".urdf" else "MJCF"


def tilt(quat: Sequence[float] | np.ndarray) -> float:
    """Angle between the root's z axis and the vertical [degrees]; ``quat`` wxyz."""
    w, x, y, z = np.array(quat) / (np.linalg.norm(quat) or 1.0)
    return float(np.degrees(np.arccos(np.clip(w * w - x * x - y * y + z * z, -1.0, 1.0))))
