"""Domain randomization: masses, friction, motors, encoders, delays. The config has the ranges, KINDS their meaning.

A value is drawn when the environment is made, or at every reset of its world (``redraw_at_reset``). All values are
columns of one matrix, which the critic, logs and exams read. Model fields are written through ``Simulation.field``. A
range that changes nothing is ignored: it allocates and computes nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
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
    """The meaning of one range of the config."""

    per: str  # values per world: "world" 1, "axis" 3, "joint" D, "link" 1 + D (root, then joints)
    neutral: float | None  # value without effect; None: the value replaces the first one of the field, on ground geoms
    mirror: str  # its mirror image, a kind of envs/mirror.py
    fields: tuple[str, ...] = ()  # model fields that it writes; for FACTORS see motors.factor_fields
    whole: bool = False  # integers, both ends included


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
# Constants of the model depend on these. A draw must compute them again, which a recorded step cannot do.
ONLY_AT_START = tuple(name for name, kind in KINDS.items() if {*kind.fields} & {*CONSTANTS_READ})


def active(cfg: RobotTaskCfg, law: str = "") -> dict[str, tuple[Kind, float, float]]:
    """Name -> kind, low, high of each range with an effect. ``law``: by default ``control.actuator``."""
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
    """Model fields with a value per world. All ``model_factors`` are included: the simulator rejects unknown fields."""
    factors = cfg.domain_rand.model_factors if cfg.domain_rand.enable else {}
    written = [field for kind, _, _ in active(cfg, law).values() for field in kind.fields]
    return list(dict.fromkeys([*written, *factors]))


def check_draws(cfg: RobotTaskCfg, law: str = "") -> None:
    """Raise ConfigError for a range that cannot be drawn at a reset, and for two ranges that write the same field."""
    for name in cfg.domain_rand.redraw_at_reset:
        if name in ONLY_AT_START:
            what = f"domain_rand.redraw_at_reset has '{name}', which constants of the model depend on"
            raise ConfigError(f"{what}: it can be drawn at the start, and every domain_rand.redraw_iterations")
        if name not in KINDS:
            raise ConfigError(f"domain_rand.redraw_at_reset: {unknown('range', name, KINDS, 'domain_rand')}")
    for name in cfg.domain_rand.model_factors:
        writers = [kind for kind, (what, *_) in active(cfg, law).items() if kind != name and name in what.fields]
        if writers:
            what = f"domain_rand.{writers[0]} writes that field; leave one of them out ([])"
            raise ConfigError(f"domain_rand.model_factors.{name}: {what}")


class DomainRand:
    """Draws the values of N worlds and writes them to the model. ``values[name]`` (N, width) has the config's unit."""

    written = ("_draws", "gravity_dir")

    def __init__(self, cfg: RobotTaskCfg, robot: RobotModel, sim: Simulation, law: str = "") -> None:
        self._sim, self._substep_ms, self._curves = sim, 1e3 * cfg.sim.dt, "stall_torque" in robot.tables
        kinds = active(cfg, law)
        again = [name for name in kinds if name in cfg.domain_rand.redraw_at_reset]
        order = [name for name in kinds if name not in again] + again  # a reset draws only the last columns
        joints = len(robot.joint_names)
        count = {"world": 1, "axis": 3, "joint": joints, "link": 1 + joints}
        self.widths = {name: count[kind.per] for name, kind in KINDS.items()}  # width of each kind, active or not
        widths = [count[kinds[name][0].per] for name in order]
        self._first_again = sum(widths[: len(order) - len(again)])
        self._draws = torch.zeros(sim.num_envs, sum(widths), device=sim.device)
        views = self._draws.split(widths, dim=1) if order else ()
        self.values: dict[str, Tensor] = dict(zip(order, views, strict=True))
        self.mirrors = {name: kinds[name][0].mirror for name in order}
        bounds = [kinds[name][1:] for name, width in zip(order, widths, strict=True) for _ in range(width)]
        spans = torch.tensor(bounds, dtype=torch.float, device=sim.device).view(-1, 2)
        self._low, self._high = spans.T.contiguous()
        self._whole = [name for name in order if kinds[name][0].whole]
        self._least_contact_time = robot.least_contact_time  # [s]
        self._nominal = {field: sim.field(field)[:1].clone() for field in world_fields(cfg, law)}
        _check_mass(cfg, robot)
        gravity = robot.physics.opt.gravity
        self._gravity = math.hypot(*gravity) or 1.0  # [m/s^2]
        down = torch.tensor(gravity / self._gravity, dtype=torch.float, device=sim.device)
        self.gravity_dir = down.repeat(sim.num_envs, 1)  # (N, 3) unit, world frame
        self._root, self._ground = robot.id("body", robot.root), robot.ground_geoms()
        self._link_of_body = _links(robot).to(sim.device)
        writers = {name: self._writer(name, field) for name in order for field in kinds[name][0].fields[:1]}
        self._writers = list(dict.fromkeys(writers.values()))
        self._writers_again = list(dict.fromkeys(writers[name] for name in again if name in writers))

    def redraw(self) -> None:
        """Draw all values in all worlds and compute the model's constants. Do not call it in a recorded step."""
        everywhere = torch.ones(self._sim.num_envs, dtype=torch.bool, device=self._sim.device)
        self._draw(everywhere, 0)
        for write in self._writers:
            write(everywhere)
        if {*self._nominal} & {*CONSTANTS_READ}:
            self._sim.set_constants()

    def reset(self, mask: Tensor) -> None:
        """Draw the ranges of ``redraw_at_reset`` again where ``mask`` (N,) is true."""
        if self._first_again < self._draws.shape[1]:
            self._draw(mask, self._first_again)
            for write in self._writers_again:
                write(mask)

    def _draw(self, mask: Tensor, first: int) -> None:
        """Draw the columns from ``first`` on, from uniform distributions."""
        draws, low, high = self._draws[:, first:], self._low[first:], self._high[first:]
        if not draws.shape[1]:
            return
        share = torch.rand_like(draws)
        fresh = torch.lerp(low, high, share)
        for name, drawn in self.values.items():
            column = drawn.storage_offset() - first
            if name == "delay_ms" and column >= 0:
                fresh[:, column] = round_delay(fresh[:, column], self._substep_ms)
            if name == "contact_time" and column >= 0:
                fresh[:, column].clamp_(min=self._least_contact_time)
            if name in self._whole and column >= 0:
                among = high[column] - low[column] + 1.0
                fresh[:, column] = (low[column] + share[:, column] * among).floor_().minimum(high[column])
        assign(draws, mask, fresh)

    def _writer(self, name: str, field: str) -> Callable[[Tensor], None]:
        """The function that writes the draw ``name`` to the model where a mask is true. ``field``: its first field."""
        special = {
            "body_mass": self._write_masses,
            "body_ipos": self._write_com,
            "actuator_gainprm": self._write_gains,
            GRAVITY: self._write_gravity,
        }
        if name in KINDS and field in special:
            return special[field]
        to_ground = name in KINDS and KINDS[name].neutral is None
        return partial(self._write_ground if to_ground else self._scale, name, field)

    def _write_ground(self, name: str, field: str, mask: Tensor) -> None:
        assign(self._sim.field(field)[:, self._ground, 0], mask, self.values[name])

    def _scale(self, name: str, field: str, mask: Tensor) -> None:
        factor, nominal = self.values[name], self._nominal[field]
        first = nominal.shape[1] - factor.shape[1] if name in KINDS else 0  # skip the six of the free joint
        nominal = nominal[:, first:]
        scaled = nominal * factor.view(*factor.shape, *[1] * (nominal.dim() - 2))
        assign(self._sim.field(field)[:, first:], mask, scaled)

    def _write_masses(self, mask: Tensor) -> None:
        """Write masses, and inertias proportional to them [ours]."""
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
        place = self._nominal["body_ipos"][:, self._root] + self.values["base_com"]
        assign(self._sim.field("body_ipos")[:, self._root], mask, place)

    def _write_gains(self, mask: Tensor) -> None:
        """Write motor gains and torque-speed curves."""
        for field, place, gains in scaled_gains(self._nominal, self.values, self._curves):
            assign(self._sim.field(field)[:, :, place], mask, gains)

    def _write_gravity(self, mask: Tensor) -> None:
        """Tilt gravity towards x, which is downhill. Random headings give all directions in the body frame."""
        angle = torch.deg2rad(self.values["slope"])
        assign(self.gravity_dir, mask, torch.cat([angle.sin(), torch.zeros_like(angle), -angle.cos()], dim=1))
        assign(self._sim.field(GRAVITY), mask, self._gravity * self.gravity_dir)


def _check_mass(cfg: RobotTaskCfg, robot: RobotModel) -> None:
    """Raise ConfigError if the drawn mass of the root can be 0 or negative."""
    kinds, nominal = active(cfg), float(robot.physics.body_mass[robot.id("body", robot.root)])
    lightest = nominal * kinds.get("link_mass", (0, 1.0))[1] + kinds.get("base_mass", (0, 0.0))[1]
    if lightest <= 0.0:
        root = f"the root '{robot.root}' has {nominal:g} kg, which leaves some with none"
        raise ConfigError(f"domain_rand.base_mass is {cfg.domain_rand.base_mass!r}: {root}")


def _links(robot: RobotModel) -> Tensor:
    """The column of "link_mass" for each body: 0 root, 1 + j link of joint j, 1 + D not part of the robot."""
    model = robot.physics
    weld = {int(model.body_weldid[robot.id("body", robot.root)]): 0}
    for column, name in enumerate(robot.joint_names, start=1):
        weld[int(model.body_weldid[model.joint(name).bodyid[0]])] = column
    outside = 1 + len(robot.joint_names)
    return torch.tensor([weld.get(int(w), outside) for w in model.body_weldid])
