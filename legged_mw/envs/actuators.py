"""From actions to motor commands, with what stands between a policy and its motors: scale, delays, encoders that are off.

The laws of the motors: ``control.actuator``, or a task's own ``_compute_torques``. Servos, DC motors and plain torques are MuJoCo's
actuators. What changes within a control step goes through ``Actuators.before``.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from legged_mw.envs.domain_rand import DomainRand
from legged_mw.envs.robot_task_config import RobotTaskCfg
from legged_mw.sim.model import RobotModel
from legged_mw.sim.motor_network import make_motor_network
from legged_mw.sim.simulation import Simulation
from legged_mw.utils.config import ConfigError
from legged_mw.utils.files import digest, find_file
from legged_mw.utils.math import assign
from legged_mw.utils.motor_network import read_network

OWN = "own"  # the law of a class with a _compute_torques of its own


class TorqueLaw:
    """The place for a motor law of one's own: what overrides ``_compute_torques`` makes the joints' torques itself."""

    cfg: RobotTaskCfg
    actuators: Actuators
    default_dof_pos: Tensor  # (D,) [rad]
    dof_pos: Tensor  # (N, D) [rad]
    dof_vel: Tensor  # (N, D) [rad/s]

    def _compute_torques(self, actions: Tensor) -> Tensor:
        """Torques (N, D) [N m] from ``actions`` (N, D), clipped and delayed; held to the force limits afterwards.

        An override is called before every simulation step and is recorded with it. This one is legged_gym's position law.
        """
        target = self.default_dof_pos + self.actuators.scale * actions
        return self.p_gains * (target - self.dof_pos) - self.d_gains * self.dof_vel

    @property
    def motor_law(self) -> str:
        """``control.actuator``, or OWN."""
        control, task = self.cfg.control, type(self)
        if task._compute_torques is TorqueLaw._compute_torques:
            return control.actuator
        for field, default in (("actuator", "servo"), ("action_origin", "default")):
            if (value := getattr(control, field)) != default:
                raise ConfigError(
                    f"control.{field} is {value!r}, but {task.__name__}._compute_torques is a motor law of its own: "
                    f"leave control.{field} out, or remove the method"
                )
        return OWN

    @property
    def p_gains(self) -> Tensor:
        """``control.stiffness`` as drawn, (D,) or (N, D) [N m/rad]."""
        return self.actuators.gain("stiffness")

    @property
    def d_gains(self) -> Tensor:
        """``control.damping`` as drawn, (D,) or (N, D) [N m s/rad]."""
        return self.actuators.gain("damping")


def note_network(cfg: RobotTaskCfg) -> None:
    """Write into the config which file its motors' network is; what a run was trained with stays."""
    control = cfg.control
    if control.actuator == "network" and control.network and control.network not in control.network_digest:
        control.network_digest = {control.network: digest(find_file(cfg, "control.network"))}


def find_network(cfg: RobotTaskCfg) -> Path:
    """The file ``control.network``. Raises ConfigError if it has changed since the training that the config is of."""
    control, file = cfg.control, find_file(cfg, "control.network")
    if control.network_digest.get(control.network) not in (None, found := digest(file)):
        was = control.network_digest[control.network]
        raise ConfigError(
            f"control.network: {file} is not the file of that name that this run was trained with (SHA-256 {found[:8]}..., then "
            f"{was[:8]}...); bring that one back, or take this one with --set control.network_digest={{}}"
        )
    return file


class Actuators:
    """Motors of N robots with D joints. An action means a target, origin + scale * action, or under the law "torque" scale * action.

    ``control.action_origin`` is the origin: "default" the default pose, "joints" the measured joint angles, "targets" the last targets;
    with "speed" there is none, and targets are speeds [rad/s].
    """

    written = ("targets", "_sent", "_delay", "_late", "_network")
    # what ``Simulation.step`` calls before each substep; None: nothing changes within a step
    before: Callable[[int], None] | None = None

    def __init__(self, task: TorqueLaw, robot: RobotModel, sim: Simulation, rand: DomainRand) -> None:
        cfg = task.cfg
        self._origin, self._default, self._dof_pos, self._sim = (
            cfg.control.action_origin,
            task.default_dof_pos,
            task.dof_pos,
            sim,
        )
        self.law, self._rand = task.motor_law, rand
        scale = robot.tables["control.action_scale"]
        self.scale = torch.tensor(scale, device=sim.device)  # (D,) [rad], [rad/s] or [N m]
        self._gains = {
            name: torch.tensor(robot.tables[f"`{name}`"], device=sim.device) for name in ("stiffness", "damping")
        }
        self._same_scale = scale[0] if len(set(scale)) == 1 else None  # one number takes one operation less
        by_angle = self.law not in ("torque", OWN) and self._origin != "speed"
        self.encoder_offset = rand.values.get("encoder_offset")  # (N, D) [rad], measured minus true angle
        self._offset = self.encoder_offset if by_angle else None
        self._start: Tensor | float = self._default if by_angle else 0.0  # targets of a new episode
        self._delay = rand.delay("action_delay", len(robot.joint_names), start=0.0)
        self._late = rand.substep_delay(cfg.control.decimation, len(robot.joint_names))
        self._network, self._compute = None, task._compute_torques if self.law == OWN else None
        # (N, D) what is sent to the motors: targets less what their encoders are off, torques, or under OWN actions
        self._sent = sim.ctrl
        if self._late or self.law in ("network", OWN):
            self._sent, self.before = torch.zeros_like(sim.ctrl), self._before_substep
        if self.law == "network":
            self._network = make_motor_network(read_network(find_network(cfg)), sim)
        # (N, D) as the policy means them
        self.targets = self._sent if self._offset is None else torch.zeros_like(sim.ctrl)

    def sent(self) -> Tensor:
        """(N, D) what was sent to the motors last, as the policy means it."""
        return self._sent if self._offset is None else self._sent + self._offset

    def gain(self, name: str) -> Tensor:
        """ "stiffness" or "damping", (D,), or (N, D) where it is drawn."""
        return self._gains[name] * self._rand.values[name] if name in self._rand.values else self._gains[name]

    def apply(self, actions: Tensor) -> None:
        """Send the motors what ``actions`` (N, D) mean."""
        late = self._delay(actions) if self._delay else actions
        if self.law == OWN:
            self._sent.copy_(late)
        elif self.law == "torque" or self._origin == "speed":
            torch.mul(late, self.scale, out=self.targets)
        else:
            self._aim(late)
        if self._late:
            self._late(self._sent)

    def _aim(self, actions: Tensor) -> None:
        """Targets from ``actions`` (N, D)."""
        origin = self._default
        if self._origin == "targets":
            origin = self.targets
        elif self._origin == "joints":
            origin = self._dof_pos if self._offset is None else self._dof_pos + self._offset
        if self._same_scale is None:
            torch.addcmul(origin, actions, self.scale, out=self.targets)
        else:
            torch.add(origin, actions, alpha=self._same_scale, out=self.targets)
        if self._offset is not None:
            torch.sub(self.targets, self._offset, out=self._sent)

    def _before_substep(self, k: int) -> None:
        """Write ``ctrl`` for substep ``k``."""
        sent = self._late.arriving[k] if self._late else self._sent
        if self._network:
            self._network(sent)
            return
        torques = self._compute(sent) if self._compute else sent
        if not isinstance(torques, Tensor) or torques.shape != sent.shape:
            law = getattr(self._compute, "__qualname__", "_compute_torques")
            found = (*torques.shape,) if isinstance(torques, Tensor) else f"{torques!r:.40}"
            raise ConfigError(f"{law} must return a tensor {tuple(sent.shape)}, a torque a joint; it returned {found}")
        self._sim.ctrl.copy_(torques)

    def reset(self, mask: Tensor) -> None:
        """Targets at the default pose, or torques and speeds zero, where ``mask`` (N,) is true; of delays and networks nothing is left."""
        assign(self.targets, mask, self._start)
        if self._offset is not None:
            assign(self._sent, mask, self._default - self._offset)
        if self._delay:
            self._delay.restart(mask)
        if self._late:
            self._late.restart(mask, self._sent)
        if self._network:
            self._network.reset(mask)
