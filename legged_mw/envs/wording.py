"""The config's words for what the simulator takes: its errors name parameters in backticks, a user knows fields."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from legged_mw.sim.simulation import Simulation
from legged_mw.utils.errors import UserError

FIELDS = {
    "engine": "sim.engine",
    "num_envs": "env.num_envs",
    "nconmax": "sim.nconmax",
    "njmax": "sim.njmax",
    "integrator": "sim.integrator",
    "stiffness": "control.stiffness",
    **{name: f"control.{name}" for name in ("damping", "stall_torque", "no_load_speed", "gear")},
    "colliders": "asset.colliders",
    "proportions": "terrain.terrain_proportions",
    "levels": "terrain.num_rows",
    "columns": "terrain.num_cols",
    "tile": "terrain.tile_size",
    "cell": "terrain.horizontal_scale",
    "border": "terrain.border_size",
    "pose": "init_state.default_joint_angles",
    "sites": "asset.foot_names or foot_geoms",
    "contact_geoms": "asset.penalize_contacts_on or terminate_after_contacts_on",
    **{
        name: f"asset.{name}"
        for name in ("imu_site", "held_joints", "effort", "armature", "frictionloss", "joint_speed_limits")
    },
}


def config_words(text: str) -> str:
    """``text`` with the fields that the parameters in it come from."""
    for parameter, field in FIELDS.items():
        text = text.replace(f"`{parameter}`", field)
    return text


def overflow_note(sim: Simulation, what: str) -> str:
    """A line for who looks at ``what`` if contacts or constraints of ``sim`` did not fit, ''. Reads the device."""
    report = config_words(sim.overflow_report())
    return f"WARNING: {what} is not to be trusted: {report}" if report else ""


def say_overflow(sim: Simulation, what: str) -> bool:
    """Print that line; returns whether there was one."""
    if note := overflow_note(sim, what):
        print(note, flush=True)
    return bool(note)


@contextmanager
def in_config_words() -> Iterator[None]:
    """An error of the simulator, raised inside, names the fields that its parameters come from."""
    try:
        yield
    except UserError as error:
        text = config_words(str(error))
        if text == str(error):
            raise
        raise type(error)(text) from None
