"""Unitree's robots in their messages: the motor of each joint, and the required values of their commands."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from legged_mw.deploy.contract import CONTRACT_FILE
from legged_mw.deploy.robot import RobotError


def _legs(names: Sequence[str], parts: Sequence[str]) -> list[str]:
    return [f"{name}_{part}_joint" for name in names for part in parts]


def _named(joints: Sequence[str], first: int = 0) -> dict[str, int]:
    return {joint: first + i for i, joint in enumerate(joints)}


_G1_LEG = ("hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll")
_G1_ARM = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow", "wrist_roll", "wrist_pitch", "wrist_yaw")
_H1_ARM = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow")
_H1_BODY = (  # slot 9 has no motor
    *("right_hip_roll", "right_hip_pitch", "right_knee", "left_hip_roll", "left_hip_pitch", "left_knee"),
    *("torso", "left_hip_yaw", "right_hip_yaw", "", "left_ankle", "right_ankle"),
)


@dataclass(frozen=True)
class Machine:
    """One kind of robot."""

    name: str
    package: str  # of its messages
    motors: dict[str, int]  # joint -> slot in LowCmd_ and LowState_ [unitree_sdk2's headers and examples]
    modes: dict[int, int] = field(default_factory=dict)  # slot -> motor mode, if not 1
    feet: tuple[str, ...] = ()  # order of foot_force
    lies_down: bool = False  # True if the robot's own program can lie down
    cells: int = 0  # battery cells in series [Unitree's data sheets]; 0: unknown

    @property
    def limits(self) -> dict[str, float]:
        """This machine's safety limits: 3 V per cell, at which a lithium battery is empty."""
        return {"voltage": 3.0 * self.cells} if self.cells else {}

    @property
    def slots(self) -> int:
        return {"unitree_go": 20, "unitree_hg": 35}[self.package]

    def feet_of(self, names: Iterable[str]) -> list[int]:
        """Index in foot_force of each foot, by the leg that begins its name (FR, FR_foot). Empty if one has none."""
        legs = [[i for i, leg in enumerate(self.feet) if name.upper().startswith(leg)] for name in names]
        return [leg[0] for leg in legs] if all(legs) and len({leg[0] for leg in legs}) == len(legs) else []


GO2 = Machine(
    "go2",
    "unitree_go",
    _named(_legs(("FR", "FL", "RR", "RL"), ("hip", "thigh", "calf"))),
    feet=("FR", "FL", "RR", "RL"),
    lies_down=True,
    cells=8,
)
G1 = Machine(
    "g1",
    "unitree_hg",
    _named(
        [
            *_legs(("left", "right"), _G1_LEG),
            *_legs(("waist",), ("yaw", "roll", "pitch")),
            *_legs(("left", "right"), _G1_ARM),
        ]
    ),
    cells=13,
)
H1 = Machine(
    "h1",
    "unitree_go",
    {f"{name}_joint": i for i, name in enumerate(_H1_BODY) if name} | _named(_legs(("right", "left"), _H1_ARM), 12),
    modes={i: 0x0A if i < 10 else 0x01 for i in range(20)},  # strong motors, then weak ones
)
MACHINES = {machine.name: machine for machine in (GO2, G1, H1)}
_LACKS = {23: (13, 14, 20, 21, 27, 28)}  # number of joints of a G1 -> slots without a motor [unitree_sdk2's example]
BODIES = {1: 23, 4: 23, 2: 29, 3: 29, 5: 29, 6: 29, 9: 14}  # mode_machine -> joints of a G1 [unitree_rl_lab]


def machine_of(joints: Sequence[str]) -> Machine:
    """The robot with these joints, in any order. Raises RobotError that lists the joints."""
    for machine in MACHINES.values():
        if set(joints) == set(machine.motors):
            return machine
    nearest = max(MACHINES.values(), key=lambda m: (len(set(joints) & set(m.motors)), m.name))
    only = (
        [name for name in joints if name not in nearest.motors],
        [name for name in nearest.motors if name not in joints],
    )
    raise RobotError(
        f"{CONTRACT_FILE} has the joints of no known robot ({', '.join(MACHINES)}); the nearest is {nearest.name}. "
        f"Only in the contract: {', '.join(only[0]) or 'none'}; only on {nearest.name}: {', '.join(only[1]) or 'none'}. "
        f"The contract has: {', '.join(joints)}; {nearest.name} has: {', '.join(nearest.motors)}"
    )


def order(machine: Machine, joints: Sequence[str]) -> np.ndarray:
    """Slot of each joint (D,)."""
    return np.array([machine.motors[name] for name in joints])


def known_motors(package: str) -> str:
    """The robots with messages of ``package``, and the joints of each."""
    return (
        "; ".join(f"{m.name} has {', '.join(m.motors)}" for m in MACHINES.values() if m.package == package)
        or f"{package} is not known"
    )


def check_slots(machine: Machine, answers: np.ndarray) -> None:
    """Raise RobotError for answers (slots,) of motors that the machine lacks, as of an H1 with a Go2's contract.

    Fewer answers are allowed, because some simulators fill only a part of a motor's answer.
    """
    if machine.package == "unitree_go" and (
        more := sorted({*np.flatnonzero(answers).tolist()} - {*machine.motors.values()})
    ):
        raise RobotError(
            f"motors answer at {', '.join(map(str, more))}, where a {machine.name} has none: it is not the contract's robot. "
            f"Known are: {known_motors(machine.package)}"
        )


def check_body(machine: Machine, mode_machine: int) -> None:
    """Raise RobotError for a G1 whose motors are not the contract's.

    A simulation without mode_machine sends 0, which is allowed.
    """
    if machine is G1 and mode_machine and BODIES.get(mode_machine) != len(machine.motors):
        count = BODIES.get(mode_machine)
        has = f"{count} joints" if count else "an unknown body"
        lacks = ", ".join(name for name, slot in machine.motors.items() if slot in _LACKS.get(count or 0, ()))
        raise RobotError(
            f"this {machine.name} has {has} (mode_machine {mode_machine}{f': no {lacks}' if lacks else ''}), "
            f"the contract {len(machine.motors)}: {', '.join(machine.motors)}; use a policy for this robot"
        )
