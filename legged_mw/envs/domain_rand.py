"""What differs between worlds: masses, friction, motors, encoders, delays. The config gives the ranges, KINDS what they mean.

A number is drawn once, when the environment is made, or again at every reset of its world (``redraw_at_reset``). All draws
are columns of one matrix, so that they can be read: by the critic, by a log, by who evaluates. What the model knows is
written through the simulator's seam. A range that changes nothing does not exist: no field is allocated for it and
nothing is computed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from legged_mw.envs.motors import FACTORS, factor_fields, round_delay
from legged_mw.envs.robot_task_config import RobotTaskCfg
from legged_mw.sim.model import RobotModel
from legged_mw.sim.servos import scaled_gains
from legged_mw.sim.simulation import CONSTANTS_READ, GRAVITY, Simulation
from legged_mw.utils.config import ConfigError
from legged_mw.utils.errors import unknown
from legged_mw.utils.math import assign


class Kind(NamedTuple):
    """What one range of the config means."""

    per: str  # how many numbers a world draws: "world" one, "axis" three, "joint" D, "link" 1 + D: the root's, then each joint's
    # that changes nothing; None: the number is itself the first one of the field, in the ground's geoms
    neutral: float | None
    mirror: str  # its mirror image, a kind of envs/mirror.py
    fields: tuple[str, ...] = ()  # of the model, that it writes; of motors as their law has it: motors.factor_fields
    whole: bool = False  # whole numbers, both ends included


KINDS: dict[str, Kind] = {
    "link_mass": Kind("link", 1.0, "link", ("body_mass", "body_inertia")),
    "base_mass": Kind("world", 0.0, "scalar", ("body_mass", "body_inertia")),
    "base_com": Kind("axis", 0.0, "polar", ("body_ipos",)),
    "armature": Kind("joint", 1.0, "joint_factor", ("dof_armature",)),
    "friction": Kind("world", None, "scalar", ("geom_friction",)),
    "contact_time": Kind("world", None, "scalar", ("geom_solref",)),
    "frictionloss": Kind("joint", 1.0, "joint_factor", ("dof_frictionloss",)),
    **{name: Kind("joint", 1.0, "joint_factor") for name in FACTORS},
    "encoder_offset": Kind("joint", 0.0, "joint"),
    "action_delay": Kind("world", 0.0, "scalar", whole=True),
    "delay_ms": Kind("world", 0.0, "scalar"),
    "observation_delay": Kind("world", 0.0, "scalar", whole=True),
    "slope": Kind("world", 0.0, "scalar", (GRAVITY,)),
}
# Constants of the model depend on them: derived once they are drawn, never within a recorded step.
ONLY_AT_START = tuple(name for name, kind in KINDS.items() if {*kind.fields} & {*CONSTANTS_READ})


def active(cfg: RobotTaskCfg, law: str = "") -> dict[str, tuple[Kind, float, float]]:
    """Name -> kind, lowest, highest of all that the config randomizes: what is given, is not neutral, and motors of ``law`` have.

    ``law`` is ``control.actuator``, unless said otherwise.
    """
    rand, motors = cfg.domain_rand, factor_fields(cfg, law or cfg.control.actuator)
    if not rand.enable:
        return {}
    kinds = KINDS | {name: KINDS[name]._replace(fields=fields) for name, fields in motors.items()}
    given = {name: (kind, getattr(rand, name)) for name, kind in kinds.items() if name in motors or name not in FACTORS}
    given |= {field: (Kind("world", 1.0, "scalar", (field,)), span) for field, span in rand.model_factors.items()}
    return {
        name: (kind, span[0], span[1])
        for name, (kind, span) in given.items()
        if span and not span[0] == span[1] == kind.neutral
    }


def world_fields(cfg: RobotTaskCfg, law: str = "") -> list[str]:
    """Model fields that need a value per world; and those of factors that change nothing, so that a field that is none is refused."""
    factors = cfg.domain_rand.model_factors if cfg.domain_rand.enable else {}
    return list(
        dict.fromkeys([*(field for kind, _, _ in active(cfg, law).values() for field in kind.fields), *factors])
    )


def check_draws(cfg: RobotTaskCfg, law: str = "") -> None:
    """Raise ConfigError for a redraw that cannot be, and for two ranges that write one field; ``law`` as in ``active``."""
    for name in cfg.domain_rand.redraw_at_reset:
        if name in ONLY_AT_START:
            raise ConfigError(
                f"domain_rand.redraw_at_reset has '{name}', which constants of the model depend on: it can be drawn at the start, "
                "and every domain_rand.redraw_iterations"
            )
        if name not in KINDS:
            raise ConfigError(f"domain_rand.redraw_at_reset: {unknown('range', name, KINDS, 'domain_rand')}")
    for name in cfg.domain_rand.model_factors:
        writers = [kind for kind, (what, *_) in active(cfg, law).items() if kind != name and name in what.fields]
        if writers:
            raise ConfigError(
                f"domain_rand.model_factors.{name}: domain_rand.{writers[0]} writes that field; leave one of them out ([])"
            )


class DomainRand:
    """The draws of N worlds and what they write. ``values[name]`` (N, width): the numbers drawn, in the config's units."""

    written = ("_draws", "gravity_dir")

    def __init__(self, cfg: RobotTaskCfg, robot: RobotModel, sim: Simulation, law: str = "") -> None:
        self._substep_ms, self._curves = 1e3 * cfg.sim.dt, "stall_torque" in robot.tables
        self._sim, self._mask = sim, torch.ones(sim.num_envs, dtype=torch.bool, device=sim.device)
        kinds = active(cfg, law)
        again = [name for name in kinds if name in cfg.domain_rand.redraw_at_reset]
        order = [name for name in kinds if name not in again] + again
        joints = len(robot.joint_names)
        count = {"world": 1, "axis": 3, "joint": joints, "link": 1 + joints}
        self.widths = {name: count[kind.per] for name, kind in KINDS.items()}  # of each draw, drawn here or not
        widths = [count[kinds[name][0].per] for name in order]
        self._draws = torch.zeros(sim.num_envs, sum(widths), device=sim.device)
        self.values: dict[str, Tensor] = (
            dict(zip(order, self._draws.split(widths, dim=1), strict=True)) if order else {}
        )
        self.mirrors = {name: kinds[name][0].mirror for name in order}
        self._first_again = sum(width for name, width in zip(order, widths, strict=True) if name not in again)
        bounds = [list(kinds[name][1:]) for name, width in zip(order, widths, strict=True) for _ in range(width)]
        self._low, self._high = torch.tensor(
            bounds or [[0.0, 0.0]], dtype=torch.float, device=sim.device
        ).T.contiguous()
        self._whole = [name for name in order if kinds[name][0].whole]
        self._nominal = {field: sim.field(field)[:1].clone() for field in world_fields(cfg, law)}
        _check_mass(cfg, robot)
        gravity = robot.physics.opt.gravity
        self._gravity = math.hypot(*gravity) or 1.0  # [m/s^2]
        # (N, 3)
        self.gravity_dir = torch.tensor(gravity / self._gravity, dtype=torch.float, device=sim.device).repeat(
            sim.num_envs, 1
        )
        self._root, self._ground = robot.id("body", robot.root), robot.ground_geoms()
        self._link_of_body = _links(robot).to(sim.device)
        writers = {name: self._writer(name, field) for name in order for field in kinds[name][0].fields[:1]}
        self._writers = list(dict.fromkeys(writers.values()))
        self._writers_again = list(dict.fromkeys(writers[name] for name in again if name in writers))

    def redraw(self) -> None:
        """Draw everything again in every world, and what the model derives from it. Not for inside a recorded step."""
        self._draw(self._mask, 0)
        for write in self._writers:
            write(self._mask)
        if {*self._nominal} & {*CONSTANTS_READ}:
            self._sim.set_constants()

    def reset(self, mask: Tensor) -> None:
        """Draw what is drawn at every reset, where ``mask`` (N,) is true."""
        if self._first_again < self._draws.shape[1]:
            self._draw(mask, self._first_again)
            for write in self._writers_again:
                write(mask)

    def _draw(self, mask: Tensor, first: int) -> None:
        """Uniform from column ``first`` on; whole numbers each as likely as the other."""
        draws = self._draws[:, first:]
        if not draws.shape[1]:
            return
        share = torch.rand_like(draws)
        fresh = torch.lerp(self._low[first:], self._high[first:], share)
        for name, drawn in self.values.items():
            column = drawn.storage_offset()
            if name == "delay_ms" and column >= first:
                fresh[:, column - first] = round_delay(fresh[:, column - first], self._substep_ms)
            if name in self._whole and column >= first:
                low, high = self._low[column], self._high[column]
                fresh[:, column - first] = (low + share[:, column - first] * (high - low + 1.0)).floor_().minimum(high)
        assign(draws, mask, fresh)

    # ---- what a draw writes: nominal values come from the model ------------------------------------------------------

    def _writer(self, name: str, field: str) -> Callable[[Tensor], None]:
        special = {
            "body_mass": self._write_masses,
            "body_ipos": self._write_com,
            "actuator_gainprm": self._write_gains,
            GRAVITY: self._write_gravity,
        }
        if name in KINDS and field in special:
            return special[field]
        if name in KINDS and KINDS[name].neutral is None:
            # of the ground's geoms
            return lambda mask: assign(self._sim.field(field)[:, self._ground, 0], mask, self.values[name])
        # the free joint's six come first
        first = self._nominal[field].shape[1] - self.values[name].shape[1] if name in KINDS else 0

        def scale(mask: Tensor) -> None:
            nominal, factor = self._nominal[field][:, first:], self.values[name]
            assign(
                self._sim.field(field)[:, first:],
                mask,
                nominal * factor.view(*factor.shape, *[1] * (nominal.dim() - 2)),
            )

        return scale

    def _write_masses(self, mask: Tensor) -> None:
        """Inertia goes with the mass [ours]."""
        nominal = self._nominal["body_mass"]
        mass = nominal.expand(self._sim.num_envs, -1).clone()
        if "link_mass" in self.values:
            mass *= torch.nn.functional.pad(self.values["link_mass"], (0, 1), value=1.0)[:, self._link_of_body]
        if "base_mass" in self.values:
            mass[:, self._root] += self.values["base_mass"][:, 0]
        ratio = torch.where(nominal > 0.0, mass / nominal.clamp(min=1e-9), 1.0)
        assign(self._sim.field("body_mass"), mask, mass)
        assign(self._sim.field("body_inertia"), mask, self._nominal["body_inertia"] * ratio[:, :, None])

    def _write_com(self, mask: Tensor) -> None:
        assign(
            self._sim.field("body_ipos")[:, self._root],
            mask,
            self._nominal["body_ipos"][:, self._root] + self.values["base_com"],
        )

    def _write_gains(self, mask: Tensor) -> None:
        """Of motors, and their torque-speed curve."""
        for field, place, gains in scaled_gains(self._nominal, self.values, self._curves):
            assign(self._sim.field(field)[:, :, place], mask, gains)

    def _write_gravity(self, mask: Tensor) -> None:
        """Downhill along x, which is any direction for robots with any heading."""
        angle = torch.deg2rad(self.values["slope"])
        assign(self.gravity_dir, mask, torch.cat([angle.sin(), torch.zeros_like(angle), -angle.cos()], dim=1))
        assign(self._sim.field(GRAVITY), mask, self._gravity * self.gravity_dir)


def _check_mass(cfg: RobotTaskCfg, robot: RobotModel) -> None:
    """The lightest root that can be drawn still has a mass."""
    kinds, nominal = active(cfg), float(robot.physics.body_mass[robot.id("body", robot.root)])
    lightest = nominal * (kinds["link_mass"][1] if "link_mass" in kinds else 1.0) + (
        kinds["base_mass"][1] if "base_mass" in kinds else 0.0
    )
    if lightest <= 0.0:
        span = cfg.domain_rand.base_mass
        raise ConfigError(
            f"domain_rand.base_mass is {span!r}: the root '{robot.root}' has {nominal:g} kg, which leaves some with none"
        )


def _links(robot: RobotModel) -> Tensor:
    """For each body, its column of "link_mass": 0 the root, 1 + j what moves with joint j; 1 + D what is not of the robot."""
    model = robot.physics
    weld = {int(model.body_weldid[robot.id("body", robot.root)]): 0}
    for column, name in enumerate(robot.joint_names, start=1):
        weld[int(model.body_weldid[model.joint(name).bodyid[0]])] = column
    outside = 1 + len(robot.joint_names)
    return torch.tensor([weld.get(int(w), outside) for w in model.body_weldid])
