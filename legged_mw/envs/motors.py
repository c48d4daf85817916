"""From an action to a motor torque: action scale, delays, encoder offsets and motor laws.

The law is ``control.actuator``, or a task's own ``_compute_torques``. Servos, DC motors and plain torques are MuJoCo's
actuators: ``sim/servos.py`` writes their gains, curves and force limits into the model. ``Actuators.before`` computes
networks, laws in code and delayed commands before each substep. Shapes: N robots, D joints.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from legged_mw.envs.robot_task_config import RobotTaskCfg
from legged_mw.sim.model import RobotModel
from legged_mw.sim.servos import Drive
from legged_mw.sim.simulation import Simulation
from legged_mw.utils.config import ConfigError
from legged_mw.utils.files import digest, find_file
from legged_mw.utils.machine import require_memory
from legged_mw.utils.math import assign
from legged_mw.utils.motor_network import MotorNetwork, read_network

OWN = "own"  # law of a class that overrides _compute_torques; the other names are those of ``control.actuator``
FACTORS = ("stiffness", "damping", "strength", "stall_torque", "no_load_speed")  # of motors, in ``domain_rand``


def own_law(cfg: RobotTaskCfg, task: str) -> str:
    """OWN, for a class ``task`` with its own ``_compute_torques``. Raises ConfigError if the config also sets a law."""
    for field, default in (("actuator", "servo"), ("action_origin", "default")):
        if (value := getattr(cfg.control, field)) != default:
            what = f"control.{field} is {value!r}, but {task}._compute_torques is a motor law of its own"
            raise ConfigError(f"{what}: leave control.{field} out, or remove the method")
    return OWN


def has_curve(cfg: RobotTaskCfg, law: str) -> bool:
    """Whether motors of ``law`` have a torque-speed curve: ``dc_motor`` always, servo never, others if configured."""
    return law == "dc_motor" or (law != "servo" and bool(cfg.control.stall_torque or cfg.control.no_load_speed))


def motor_drive(cfg: RobotTaskCfg, law: str) -> Drive:
    """The input of the simulated motors for ``law``."""
    if law not in ("servo", "dc_motor"):
        return "torque"
    return "speed" if cfg.control.action_origin == "speed" else "angle"


def motor_gains(cfg: RobotTaskCfg, law: str) -> dict[str, Mapping[str, float]]:
    """The tables "stiffness" and "damping"; zeros if the config has none and ``law`` does not need it."""
    control, none = cfg.control, {"": 0.0} if law in ("torque", "network") else {}
    stiffness = {"": 0.0} if motor_drive(cfg, law) == "speed" else control.stiffness or none
    return {"stiffness": stiffness, "damping": control.damping or none}


def motor_curves(cfg: RobotTaskCfg, law: str) -> Mapping[str, Mapping[str, float]]:
    """The tables of the torque-speed curve, or {} without a curve."""
    tables = ("stall_torque", "no_load_speed", "gear") if has_curve(cfg, law) else ()
    return {name: getattr(cfg.control, name) for name in tables}


def factor_fields(cfg: RobotTaskCfg, law: str) -> dict[str, tuple[str, ...]]:
    """Factor of FACTORS that applies to ``law`` -> model fields that it scales; () if a law in code reads the gain."""
    fields: dict[str, tuple[str, ...]] = {"strength": ("actuator_forcerange",)}
    if law == "servo":
        fields |= {"stiffness": ("actuator_gainprm", "actuator_biasprm"), "damping": ("dof_damping",)}
    elif law == "dc_motor":
        fields |= dict.fromkeys(("stiffness", "damping"), ("actuator_gainprm",))
    elif law == OWN:
        fields |= {"stiffness": (), "damping": ()}
    if has_curve(cfg, law):
        fields |= dict.fromkeys(("stall_torque", "no_load_speed"), ("actuator_gainprm",))
    if cfg.control.action_origin == "speed":
        fields.pop("stiffness", None)
    return fields


def note_network(cfg: RobotTaskCfg) -> None:
    """Write the digest of the file ``control.network`` into the config, unless it is already there."""
    control = cfg.control
    if control.actuator == "network" and control.network and control.network not in control.network_digest:
        control.network_digest = {control.network: digest(find_file(cfg, "control.network"))}


def find_network(cfg: RobotTaskCfg) -> Path:
    """The file ``control.network``. Raises ConfigError if it has changed since the training."""
    file = find_file(cfg, "control.network")
    now = digest(file)
    then = cfg.control.network_digest.get(cfg.control.network, now)
    if now != then:
        digests = f"(SHA-256 {now[:8]}..., then {then[:8]}...)"
        what = f"{file} is not the file of that name that this run was trained with {digests}"
        mend = "bring that one back, or take this one with --set control.network_digest={}"
        raise ConfigError(f"control.network: {what}; {mend}")
    return file


class Actuators:
    """Motors of N robots with D joints. The target is origin + scale * action; with "torque" it is scale * action.

    ``control.action_origin`` is the origin: "default" the default pose, "joints" the measured joint angles, "targets"
    the last targets. With "speed" there is no origin, and targets are speeds [rad/s].
    """

    written = ("targets", "_sent", "_delay", "_late", "_network")
    # ``Simulation.step`` calls it before each substep; None: ``ctrl`` is constant within a step
    before: Callable[[int], None] | None = None

    def __init__(
        self,
        cfg: RobotTaskCfg,
        law: str,
        robot: RobotModel,
        sim: Simulation,
        drawn: Mapping[str, Tensor],  # ``DomainRand.values``
        default: Tensor,  # (D,) the default pose [rad]
        compute: Callable[[Tensor], Tensor],  # the task's ``_compute_torques``, for the law OWN
    ) -> None:
        self.law, self._origin, self._sim, self._drawn = law, cfg.control.action_origin, sim, drawn
        self._default, self._dof_pos, self._compute = default, sim.qpos[:, 7:], compute
        scale = robot.tables["control.action_scale"]
        self.scale = torch.tensor(scale, device=sim.device)  # (D,) [rad], [rad/s] or [N m]
        self._gains = {name: torch.tensor(robot.tables[name], device=sim.device) for name in ("stiffness", "damping")}
        by_angle = law not in ("torque", OWN) and self._origin != "speed"
        self.encoder_offset = drawn.get("encoder_offset")  # (N, D) [rad], measured minus true angle
        self._offset = self.encoder_offset if by_angle else None
        self._start: Tensor | float = default if by_angle else 0.0  # targets at the start of an episode
        self._delay: Delay | None = None
        if "action_delay" in drawn:
            start = default if self._origin == "joints" else 0.0
            self._delay = Delay(cfg, "action_delay", drawn["action_delay"], len(scale), start)
        self._late = SubstepDelay(cfg, drawn["delay_ms"], len(scale)) if "delay_ms" in drawn else None
        # (N, D) sent to the motors: targets minus encoder offsets, torques, or actions for OWN
        self._sent = sim.ctrl
        if self._late or law in ("network", OWN):
            self._sent, self.before = torch.zeros_like(sim.ctrl), self._before_substep
        self._network: NetworkLaw | None = None
        if law == "network":
            self._network = NetworkLaw(read_network(find_network(cfg)), self._dof_pos, sim.qvel[:, 6:])
        # (N, D) in encoder angles, as the policy commands them
        self.targets = self._sent if self._offset is None else torch.zeros_like(sim.ctrl)

    def sent(self) -> Tensor:
        """(N, D) The last motor commands in encoder angles, as the policy commands them."""
        return self._sent if self._offset is None else self._sent + self._offset

    def gain(self, name: str) -> Tensor:
        """The gain "stiffness" or "damping": (D,), or (N, D) if it is randomized."""
        return self._gains[name] * self._drawn[name] if name in self._drawn else self._gains[name]

    def apply(self, actions: Tensor) -> None:
        """Compute the motor commands of ``actions`` (N, D)."""
        if self._delay and self._origin != "joints":
            actions = self._delay(actions)
        if self.law == OWN:
            self._sent.copy_(actions)
        elif self.law == "torque" or self._origin == "speed":
            torch.mul(actions, self.scale, out=self.targets)
        else:
            torch.addcmul(self._origin_angles(), actions, self.scale, out=self.targets)
            if self._delay and self._origin == "joints":  # late as a whole: the policy acted on the angles of then
                self.targets.copy_(self._delay(self.targets))
            if self._offset is not None:
                torch.sub(self.targets, self._offset, out=self._sent)
        if self._late:
            self._late(self._sent)

    def _origin_angles(self) -> Tensor:
        """The origin of the targets, (D,) or (N, D) [rad]."""
        if self._origin == "targets":
            return self.targets
        if self._origin == "joints":
            return self._dof_pos if self._offset is None else self._dof_pos + self._offset
        return self._default

    def _before_substep(self, k: int) -> None:
        """Write ``ctrl`` for substep ``k``. Raises ConfigError unless a law in code returns one torque per joint."""
        sent = self._late.arriving[k] if self._late else self._sent
        if self._network:
            sent = self._network(sent)
        elif self.law == OWN:
            torques: Any = self._compute(sent)
            if not isinstance(torques, Tensor) or torques.shape != sent.shape:
                name = getattr(self._compute, "__qualname__", "_compute_torques")
                shape = (*torques.shape,) if isinstance(torques, Tensor) else f"{torques!r:.40}"
                what = f"must return a tensor {tuple(sent.shape)}, a torque a joint"
                raise ConfigError(f"{name} {what}; it returned {shape}")
            sent = torques
        self._sim.ctrl.copy_(sent)

    def reset(self, mask: Tensor) -> None:
        """Where ``mask`` (N,) is true, reset targets to the default pose or 0, and clear delays and networks."""
        assign(self.targets, mask, self._start)
        if self._offset is not None:
            assign(self._sent, mask, self._default - self._offset)
        if self._delay:
            self._delay.restart(mask)
        if self._late:
            self._late.restart(mask, self._sent)
        if self._network:
            self._network.reset(mask)


_ACTIVATIONS: dict[str, Callable[[Tensor], Tensor]] = {
    "elu": torch.nn.functional.elu,
    "relu": torch.relu,
    "softsign": torch.nn.functional.softsign,
    "tanh": torch.tanh,
}


class NetworkLaw:
    """A network as the motor model of all joints: ``law(targets)`` is called before each substep, in the recorded step.

    It always computes in float32; ``runner.matmul_precision`` does not change it.
    """

    written = ("_past", "_memory")

    def __init__(self, network: MotorNetwork, angle: Tensor, speed: Tensor) -> None:
        """``angle`` [rad] and ``speed`` [rad/s] of the joints (N, D) are read in each call."""
        self._network, self._angle, self._speed, (robots, joints) = network, angle, speed, angle.shape

        def tensor(weights: Any) -> Tensor:
            return torch.tensor(weights, device=angle.device)

        self._recurrent = [[tensor(weights) for weights in layer] for layer in network.recurrent]
        self._linear = [(tensor(weight), tensor(bias)) for weight, bias in network.linear]
        self._frames = tensor(network.frames)
        # scaled position errors and speeds of the last simulation steps, newest first
        self._past = torch.zeros(network.frames[-1] + 1, 2, robots, joints, device=angle.device)
        # hidden state h and cell state c of each LSTM layer
        self._memory = [torch.zeros(2, robots * joints, units, device=angle.device) for units in network.hidden]

    def __call__(self, targets: Tensor) -> Tensor:
        """Torques (N, D) [N m] from ``targets`` (N, D) [rad]."""
        past, network = self._past, self._network
        past[1:] = past[:-1].clone()
        past[0, 0] = network.error_scale * (targets - self._angle)
        past[0, 1] = network.speed_scale * self._speed
        frames = past.index_select(0, self._frames).permute(2, 3, 1, 0)  # (N, D, 2, F)
        x = (frames.mT if network.in_turns else frames).flatten(2).flatten(0, 1)  # (N D, 2 F)
        precision = torch.get_float32_matmul_precision()
        torch.set_float32_matmul_precision("highest")
        torque = self._evaluate(x)
        torch.set_float32_matmul_precision(precision)
        return (network.torque_scale * torque).view_as(targets)

    def _evaluate(self, x: Tensor) -> Tensor:
        for memory, weights in zip(self._memory, self._recurrent, strict=True):
            memory.copy_(torch.stack(torch.lstm_cell(x, memory.unbind(), *weights)))
            x = memory[0]
        for layer, (weight, bias) in enumerate(self._linear):
            x = torch.nn.functional.linear(x, weight, bias)
            if layer < len(self._linear) - 1:
                x = _ACTIVATIONS[self._network.activation](x)
        return x

    def reset(self, mask: Tensor) -> None:
        """Clear past errors, speeds and hidden states where ``mask`` (N,) is true."""
        self._past.masked_fill_(mask[:, None], 0.0)
        for memory in self._memory:
            memory.unflatten(1, (len(mask), -1)).masked_fill_(mask[:, None, None], 0.0)


class Delay:
    """``delay(now)``, called once per step with values (N, width), returns those of d steps ago; d is per world."""

    written = ("past", "_new")

    def __init__(
        self, cfg: RobotTaskCfg, name: str, steps: Tensor, width: int, start: Tensor | float | None = None
    ) -> None:
        """``steps`` (N, 1), drawn by ``domain_rand.<name>``, is read in each call. ``start``: value before the start of
        an episode, one or (width,); None: the first value of the episode.
        """
        self.steps, self.start, longest = steps, start, int(getattr(cfg.domain_rand, name)[1])
        _require_memory(cfg, name, steps, longest + 1, width)
        self.past = torch.zeros(len(steps), longest + 1, width, device=steps.device)  # newest first
        self._new = torch.ones(len(steps), dtype=torch.bool, device=steps.device)

    def restart(self, mask: Tensor) -> None:
        """Start an episode where ``mask`` (N,) is true."""
        if self.start is None:
            self._new.logical_or_(mask)
        else:
            assign(self.past, mask, self.start)

    def __call__(self, now: Tensor) -> Tensor:
        self.past[:, 1:] = self.past[:, :-1].clone()
        self.past[:, 0] = now
        if self.start is None:
            self.past.copy_(torch.where(self._new[:, None, None], now[:, None], self.past))
            self._new.fill_(False)
        index = self.steps.long()[:, :, None].expand(-1, 1, now.shape[1])
        return self.past.gather(1, index)[:, 0]


class SubstepDelay:
    """Delays the motor commands of each control step by whole simulation steps. Each world has its own delay.

    A command with a delay of d steps arrives d substeps after it was sent. For example, 7 ms with substeps of 4 ms is
    d = 2: physics uses the command of time t from t + 8 ms on.
    """

    written = ("_past", "arriving")

    def __init__(self, cfg: RobotTaskCfg, delay: Tensor, width: int) -> None:
        """``delay`` (N, 1) [ms], whole simulation steps within ``domain_rand.delay_ms``, is read in each call."""
        self._delay, self._step_ms, substeps = delay, 1e3 * cfg.sim.dt, cfg.control.decimation
        longest = round_delay(cfg.domain_rand.delay_ms[1], self._step_ms) / self._step_ms  # [simulation steps]
        _require_memory(cfg, "delay_ms", delay, longest / substeps + 1, width)
        frames = math.ceil(round(longest) / substeps) + 1
        self._past = torch.zeros(frames, len(delay), width, device=delay.device)  # newest first
        self._substep = torch.arange(substeps, device=delay.device)[:, None, None]
        self.arriving = torch.zeros(substeps, len(delay), width, device=delay.device)  # commands of each substep

    def restart(self, mask: Tensor, sent: Tensor) -> None:
        """Set all past commands to ``sent`` (N, width) where ``mask`` (N,) is true."""
        self._past.copy_(torch.where(mask[:, None], sent, self._past))

    def __call__(self, sent: Tensor) -> None:
        """Fill ``arriving`` for the control step with command ``sent`` (N, width)."""
        self._past[1:] = self._past[:-1].clone()
        self._past[0] = sent
        steps, count = torch.round(self._delay / self._step_ms).long(), len(self._substep)
        # age of the arriving command [control steps], (substeps, N, 1)
        age = (steps - self._substep + count - 1).clamp_(min=0) // count
        torch.gather(self._past, 0, age.expand_as(self.arriving), out=self.arriving)


def round_delay(delay: Any, step_ms: float) -> Any:
    """``delay`` [ms], a number or a tensor, rounded to whole simulation steps; half steps are rounded up."""
    return (delay / step_ms + 0.5) // 1.0 * step_ms


def _require_memory(cfg: RobotTaskCfg, name: str, delays: Tensor, frames: float, width: int) -> None:
    what = f"domain_rand.{name} = {[*getattr(cfg.domain_rand, name)]}"
    need = 4 * frames * len(delays) * width
    require_memory(need, str(delays.device), what, "every step of it keeps a frame of each world")
