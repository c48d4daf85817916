"""Where a motor's torque comes from: the laws, with the scale, the delays and the encoders that stand between a policy and its motors.

``control.actuator`` is the law, or a task's own ``_compute_torques``. Servos, DC motors and plain torques are MuJoCo's actuators, with
the gains, curves and force limits that ``sim/servos.py`` writes into the model. What changes within a control step is made here, by
``Actuators.before``: networks, laws in code, and what arrives late. Shapes: N robots, D joints.
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

# ---- laws: what each has, and what a config may say of it ------------------------------------------------------------

OWN = "own"  # beside the names of ``control.actuator``: the law of a class with a _compute_torques of its own
# factors of ``domain_rand`` on what a law may have
FACTORS = ("stiffness", "damping", "strength", "stall_torque", "no_load_speed")


def own_law(cfg: RobotTaskCfg, task: str) -> str:
    """OWN, for a class ``task`` that overrides ``_compute_torques``. Raises ConfigError for a config that chose another law."""
    for field, default in (("actuator", "servo"), ("action_origin", "default")):
        if (value := getattr(cfg.control, field)) != default:
            raise ConfigError(
                f"control.{field} is {value!r}, but {task}._compute_torques is a motor law of its own: "
                f"leave control.{field} out, or remove the method"
            )
    return OWN


def has_curve(cfg: RobotTaskCfg, law: str) -> bool:
    """Whether motors of ``law`` have a torque-speed curve: ``dc_motor`` must, a servo never has one, others may."""
    return law == "dc_motor" or (law != "servo" and bool(cfg.control.stall_torque or cfg.control.no_load_speed))


def motor_drive(cfg: RobotTaskCfg, law: str) -> Drive:
    """What drives the simulated motors under ``law``."""
    if law not in ("servo", "dc_motor"):
        return "torque"
    return "speed" if cfg.control.action_origin == "speed" else "angle"


def motor_gains(cfg: RobotTaskCfg, law: str) -> tuple[Mapping[str, float], Mapping[str, float]]:
    """Stiffness and damping, tables a joint; zero where the law has none and the config is silent."""
    control, none = cfg.control, {"": 0.0} if law in ("torque", "network") else {}
    stiffness = {"": 0.0} if motor_drive(cfg, law) == "speed" else control.stiffness or none
    return stiffness, control.damping or none


def motor_curves(cfg: RobotTaskCfg, law: str) -> Mapping[str, Mapping[str, float]]:
    """The tables of the torque-speed curve, by the simulator's names for them; none without a curve."""
    control = cfg.control
    tables = {"stall_torque": control.stall_torque, "no_load_speed": control.no_load_speed, "gear": control.gear}
    return tables if has_curve(cfg, law) else {}


def factor_fields(cfg: RobotTaskCfg, law: str) -> dict[str, tuple[str, ...]]:
    """Those of FACTORS that motors of ``law`` have -> fields of the model that they scale; a law in code reads its gains itself."""
    fields: dict[str, tuple[str, ...]] = {"strength": ("actuator_forcerange",)}
    if law == "servo":
        fields |= {"stiffness": ("actuator_gainprm", "actuator_biasprm"), "damping": ("dof_damping",)}
    elif law == "dc_motor":
        fields |= {"stiffness": ("actuator_gainprm",), "damping": ("actuator_gainprm",)}
    elif law == OWN:
        fields |= {"stiffness": (), "damping": ()}
    if has_curve(cfg, law):
        fields |= {"stall_torque": ("actuator_gainprm",), "no_load_speed": ("actuator_gainprm",)}
    if cfg.control.action_origin == "speed":
        fields.pop("stiffness", None)
    return fields


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


# ---- from actions to motor commands ----------------------------------------------------------------------------------


class Actuators:
    """Motors of N robots with D joints. An action means a target, origin + scale * action, or under the law "torque" scale * action.

    ``control.action_origin`` is the origin: "default" the default pose, "joints" the measured joint angles, "targets" the last targets;
    with "speed" there is none, and targets are speeds [rad/s].
    """

    written = ("targets", "_sent", "_delay", "_late", "_network")
    # what ``Simulation.step`` calls before each substep; None: nothing changes within a step
    before: Callable[[int], None] | None = None

    def __init__(
        self,
        cfg: RobotTaskCfg,
        law: str,
        robot: RobotModel,
        sim: Simulation,
        drawn: Mapping[str, Tensor],  # of DomainRand
        default: Tensor,  # (D,) the default pose [rad]
        compute: Callable[[Tensor], Tensor],  # the task's ``_compute_torques``, for the law OWN
    ) -> None:
        self.law, self._origin, self._sim, self._drawn = law, cfg.control.action_origin, sim, drawn
        self._default, self._dof_pos = default, sim.qpos[:, 7:]
        scale = robot.tables["control.action_scale"]
        self.scale = torch.tensor(scale, device=sim.device)  # (D,) [rad], [rad/s] or [N m]
        self._same_scale = scale[0] if len(set(scale)) == 1 else None  # one number takes one operation less
        self._gains = {name: torch.tensor(robot.tables[name], device=sim.device) for name in ("stiffness", "damping")}
        by_angle = law not in ("torque", OWN) and self._origin != "speed"
        self.encoder_offset = drawn.get("encoder_offset")  # (N, D) [rad], measured minus true angle
        self._offset = self.encoder_offset if by_angle else None
        self._start: Tensor | float = default if by_angle else 0.0  # targets of a new episode
        self._delay = make_delay(cfg, "action_delay", drawn, len(scale), start=0.0)
        self._late = _make_substep_delay(cfg, drawn, len(scale))
        self._compute, self._network = compute if law == OWN else None, None
        # (N, D) what is sent to the motors: targets less what their encoders are off, torques, or under OWN actions
        self._sent = sim.ctrl
        if self._late or law in ("network", OWN):
            self._sent, self.before = torch.zeros_like(sim.ctrl), self._before_substep
        if law == "network":
            self._network = NetworkLaw(read_network(find_network(cfg)), self._dof_pos, sim.qvel[:, 6:])
        # (N, D) as the policy means them
        self.targets = self._sent if self._offset is None else torch.zeros_like(sim.ctrl)

    def sent(self) -> Tensor:
        """(N, D) what was sent to the motors last, as the policy means it."""
        return self._sent if self._offset is None else self._sent + self._offset

    def gain(self, name: str) -> Tensor:
        """ "stiffness" or "damping", (D,), or (N, D) where it is drawn."""
        return self._gains[name] * self._drawn[name] if name in self._drawn else self._gains[name]

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
            sent = self._network(sent)
        elif self._compute:
            sent = _checked(self._compute(sent), self._compute, sent)
        self._sim.ctrl.copy_(sent)

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


def _checked(torques: Any, law: Callable[[Tensor], Tensor], actions: Tensor) -> Tensor:
    """What a law in code returned for ``actions``. Raises ConfigError if it is not a torque a joint."""
    if isinstance(torques, Tensor) and torques.shape == actions.shape:
        return torques
    name = getattr(law, "__qualname__", "_compute_torques")
    found = (*torques.shape,) if isinstance(torques, Tensor) else f"{torques!r:.40}"
    raise ConfigError(f"{name} must return a tensor {tuple(actions.shape)}, a torque a joint; it returned {found}")


# ---- networks --------------------------------------------------------------------------------------------------------

_ACTIVATIONS: dict[str, Callable[[Tensor], Tensor]] = {
    "elu": torch.nn.functional.elu,
    "relu": torch.relu,
    "softsign": torch.nn.functional.softsign,
    "tanh": torch.tanh,
}


class NetworkLaw:
    """A network as the motors of all joints: ``law(targets)`` is called before each substep, and recorded with it.

    It computes in float32, however coarse the learner's matrix products are on a GPU (``runner.matmul_precision``).
    """

    written = ("_past", "_memory")

    def __init__(self, network: MotorNetwork, angle: Tensor, speed: Tensor) -> None:
        """Joint angles [rad] and speeds [rad/s] (N, D) are read at each call."""
        self._angle, self._speed, (robots, joints) = angle, speed, angle.shape
        self._activation, self._in_turns = network.activation, network.in_turns
        self._scales = network.error_scale, network.speed_scale, network.torque_scale

        def tensor(weights: Any) -> Tensor:
            return torch.tensor(weights, device=angle.device)

        self._recurrent = [[tensor(weights) for weights in layer] for layer in network.recurrent]
        self._linear = [(tensor(weight), tensor(bias)) for weight, bias in network.linear]
        self._frames = tensor(network.frames)
        # scaled errors and speeds of the last simulation steps, newest first
        self._past = torch.zeros(network.frames[-1] + 1, 2, robots, joints, device=angle.device)
        # h and c of each LSTM layer
        self._memory = [torch.zeros(2, robots * joints, units, device=angle.device) for units in network.hidden]

    def __call__(self, targets: Tensor) -> Tensor:
        """Torques (N, D) [N m] from ``targets`` (N, D) [rad]."""
        past, (error_scale, speed_scale, torque_scale) = self._past, self._scales
        past[1:] = past[:-1].clone()
        past[0, 0] = error_scale * (targets - self._angle)
        past[0, 1] = speed_scale * self._speed
        frames = past.index_select(0, self._frames).permute(2, 3, 1, 0)  # (N, D, 2, F)
        x = (frames.mT if self._in_turns else frames).flatten(2).flatten(0, 1)  # (N D, 2 F)
        precision = torch.get_float32_matmul_precision()
        torch.set_float32_matmul_precision("highest")
        torque = self._evaluate(x)
        torch.set_float32_matmul_precision(precision)
        return (torque_scale * torque).view_as(targets)

    def _evaluate(self, x: Tensor) -> Tensor:
        for memory, weights in zip(self._memory, self._recurrent, strict=True):
            memory.copy_(torch.stack(torch.lstm_cell(x, memory.unbind(), *weights)))
            x = memory[0]
        for layer, (weight, bias) in enumerate(self._linear):
            x = torch.nn.functional.linear(x, weight, bias)
            if layer < len(self._linear) - 1:
                x = _ACTIVATIONS[self._activation](x)
        return x

    def reset(self, mask: Tensor) -> None:
        """Where ``mask`` (N,) is true nothing was ever off its target."""
        self._past.masked_fill_(mask[:, None], 0.0)
        for memory in self._memory:
            memory.unflatten(1, (len(mask), -1)).masked_fill_(mask[:, None, None], 0.0)


# ---- delays ----------------------------------------------------------------------------------------------------------


class Delay:
    """``delay(now)``, called once a step with a value (N, width), returns the value of d steps ago; each world has its own d."""

    written = ("past", "_new")

    def __init__(self, steps: Tensor, longest: int, width: int, start: float | None = None) -> None:
        """``steps`` (N, 1) is read at each call. Before an episode the value was ``start``; None: the episode's first value."""
        self.steps, self.start = steps, start
        self.past = torch.zeros(len(steps), longest + 1, width, device=steps.device)  # newest first
        self._new = torch.ones(len(steps), dtype=torch.bool, device=steps.device)

    def restart(self, mask: Tensor) -> None:
        """An episode begins where ``mask`` (N,) is true."""
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
    """Motor commands, sent once a control step, arrive late by whole simulation steps; each world has its own delay.

    A command with a delay of d steps arrives before substep d of those that follow. 7 ms in steps of 4 ms, the nearest being
    d = 2: physics from t + 8 ms on uses what is sent at t.
    """

    written = ("_past", "arriving")

    def __init__(self, delay: Tensor, step_ms: float, longest: float, substeps: int, width: int) -> None:
        """``delay`` (N, 1) [ms], whole steps of ``step_ms`` and at most ``longest``, is read at each call."""
        self._delay, self._step_ms = delay, step_ms
        # newest first
        self._past = torch.zeros(
            math.ceil(round(longest / step_ms) / substeps) + 1, len(delay), width, device=delay.device
        )
        self._substep = torch.arange(substeps, device=delay.device)[:, None, None]
        self.arriving = torch.zeros(substeps, len(delay), width, device=delay.device)  # in each substep

    def restart(self, mask: Tensor, sent: Tensor) -> None:
        """Where ``mask`` (N,) is true ``sent`` (N, width) is all that was ever sent."""
        self._past.copy_(torch.where(mask[:, None], sent, self._past))

    def __call__(self, sent: Tensor) -> None:
        """Fill ``arriving`` for the control step that begins with ``sent`` (N, width)."""
        self._past[1:] = self._past[:-1].clone()
        self._past[0] = sent
        steps, count = torch.round(self._delay / self._step_ms).long(), len(self._substep)
        # control steps since it was sent, (substeps, N, 1)
        age = (steps - self._substep + count - 1).clamp_(min=0) // count
        torch.gather(self._past, 0, age.expand_as(self.arriving), out=self.arriving)


def round_delay(delay: Any, step_ms: float) -> Any:
    """[ms], a number or a tensor, to the nearest whole number of simulation steps, a half up."""
    return (delay / step_ms + 0.5) // 1.0 * step_ms


def make_delay(
    cfg: RobotTaskCfg, name: str, drawn: Mapping[str, Tensor], width: int, start: float | None = None
) -> Delay | None:
    """The delay line of ``action_delay`` or ``observation_delay`` [control steps], or None if the config has none."""
    if name not in drawn:
        return None
    longest = int(getattr(cfg.domain_rand, name)[1])
    _require_memory(cfg, name, drawn[name], longest + 1, width)
    return Delay(drawn[name], longest, width, start)


def _make_substep_delay(cfg: RobotTaskCfg, drawn: Mapping[str, Tensor], width: int) -> SubstepDelay | None:
    """Likewise of ``delay_ms``."""
    if "delay_ms" not in drawn:
        return None
    step_ms, substeps = 1e3 * cfg.sim.dt, cfg.control.decimation
    longest = round_delay(cfg.domain_rand.delay_ms[1], step_ms)
    _require_memory(cfg, "delay_ms", drawn["delay_ms"], longest / step_ms / substeps + 1, width)
    return SubstepDelay(drawn["delay_ms"], step_ms, longest, substeps, width)


def _require_memory(cfg: RobotTaskCfg, name: str, delays: Tensor, frames: float, width: int) -> None:
    what = f"domain_rand.{name} = {[*getattr(cfg.domain_rand, name)]}"
    need = 4 * frames * len(delays) * width
    require_memory(need, str(delays.device), what, "every step of it keeps a frame of each world")
