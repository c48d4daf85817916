"""Read a plain MJCF, such as those in ``resources/robots``; ``legged_mw.robot`` reads all other files of robots."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

import mujoco
import numpy as np

from legged_mw.utils.errors import ModelError
from legged_mw.utils.mjcf import Source, check_model

# The elements of a plain MJCF: one body with a free joint, and nothing that must be mended.
_SECTIONS = {"compiler", "option", "default", "asset", "worldbody", "keyframe"}
_IN_COMPILER = {"angle", "autolimits"}
_IN_DEFAULT = {"default", "joint"}  # other defaults would apply to elements that are added
_IN_BODY = {"body", "freejoint", "joint", "inertial", "geom", "site"}
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
    if not file.is_file():
        return None
    # after an error the vendor's reader reads the file again and reports it
    with suppress(ValueError, RecursionError), warnings.catch_warnings(record=True) as said:
        source, notes = Source(file), list[str]()
        if not _is_plain(source):
            return None
        spec, keyframe = source.spec(), None
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
        model = compile_copy(spec)
        check_model(model)
        if not said:
            return RobotFile(spec, model, file.name, notes, limits, {}, keyframe)
    return None


def _is_plain(source: Source) -> bool:
    """Decided by elements and attributes alone, before MuJoCo reads the file."""
    root, bodies = source.root, source.root.findall("worldbody/*")
    if root.tag != "mujoco" or len(bodies) != 1 or not bodies[0].get("name") or source.named:
        return False
    return (
        _tags(root) <= _SECTIONS
        and {name for compiler in root.findall("compiler") for name in compiler.attrib} <= _IN_COMPILER
        and all(_tags(default) <= _IN_DEFAULT for default in root.findall("default"))
        and bodies[0].find("freejoint") is not None
        and {element.tag for element in bodies[0].iter()} <= _IN_BODY
        and len(root.findall("keyframe/key")) <= 1
        and root.find("asset/texture[@type='skybox']") is None
        and not any(SCENE.fullmatch(element.get("name", "")) for element in root.iter())
    )


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
