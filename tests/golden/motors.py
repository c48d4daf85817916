"""Networks of motors: their files, and what becomes one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from test_motors import DC, Anydrive, Springs, mlp
from torch import Tensor, nn
from worlds import make_env

from golden.table import Run, Table
from legged_mw.robot import actuator_net
from legged_mw.utils.motor_network import read_network


class Rates(Anydrive):
    def forward(self, x: Tensor, memory: tuple[Tensor, Tensor]) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        return x[:, 0, :1] ** 2, memory


def changed_arrays(**changes: Any) -> dict[str, Any]:
    arrays = mlp()[1].to_arrays() | changes
    return {name: value for name, value in arrays.items() if value is not None}


ARRAYS = {
    "frames less": lambda: changed_arrays(frames=np.array([0, 1])),
    "layers that do not join": lambda: changed_arrays(weight1=np.zeros((30, 31))),
    "a bias more": lambda: changed_arrays(bias2=np.zeros(2)),
    "no bias": lambda: changed_arrays(bias0=None),
    "no last layer": lambda: changed_arrays(weight2=None),
    "another activation": lambda: changed_arrays(activation="swish"),
    "frames backwards": lambda: changed_arrays(frames=np.array([2, 1])),
    "no frames": lambda: changed_arrays(frames=np.array([])),
    "a memory that does not join": lambda: changed_arrays(
        weight_ih_l0=np.zeros((32, 2)), weight_hh_l0=np.zeros((32, 8))
    ),
    "two scales": lambda: changed_arrays(torque_scale=np.ones(2)),
    "NaN": lambda: changed_arrays(bias1=np.full(30, np.nan)),
}
FIELDS: dict[str, dict[str, Any]] = {
    "no speed": {"control.no_load_speed": {"": 0.0}},
    "a gear backwards": {"control.gear": {"": -1.0}},
    "a torque of hips alone": {"control.stall_torque": {"hip": 20.0}},
    "no torques": {"control.stall_torque": {}},
    "no speeds": {"control.actuator": "torque", "control.no_load_speed": {}},
    "another joint": {"control.no_load_speed": {"": 20.0, "knee": 1.0}},
    "an origin of angles": {"control.actuator": "torque", "control.action_origin": "joints"},
    "speeds of a servo": {"control.actuator": "servo", "control.action_origin": "speed"},
    "no network": {"control.actuator": "network"},
    "no network's file": {"control.actuator": "network", "control.network": "no.npz"},
    "another law": {"control.actuator": "motor"},
}


def scripted(module: Any) -> Run:
    return lambda root: torch.jit.script(module).save(str(root / "net.pt"))


def saved(make: Any) -> Run:
    return lambda root: np.savez(root / "net.npz", **make())


def table() -> Table:
    made = Table()
    for name, make in ARRAYS.items():
        made.add(f"file with {name}", lambda root: read_network(Path("net.npz")), saved(make))
    for name, given in {
        "of text": lambda root: (root / "net.pt").write_bytes(b"PK no"),
        "of nothing": lambda root: (root / "net.pt").touch(),
        "of one array": lambda root: np.save((root / "net.pt").open("wb"), np.zeros(3)),
        "of TorchScript": scripted(nn.Linear(2, 1)),
        "of weights": lambda root: torch.save(nn.Linear(2, 1).state_dict(), root / "net.pt"),
    }.items():
        made.add(f"file {name}", lambda root: read_network(Path("net.pt")), given)
    made.add(
        "weights without code",
        lambda root: actuator_net.convert(Path("net.pt")),
        lambda root: torch.save(mlp()[0].state_dict(), root / "net.pt"),
    )
    for name, (module, flags) in {
        "layers of squares": (Rates(), ()),
        "frames of others": (mlp()[0], ("--frames", "0", "1")),
        "two values": (nn.Linear(2, 2), ()),
    }.items():
        made.add(
            f"torchscript of {name}",
            lambda root, flags=flags: actuator_net.main(["net.pt", "net.npz", *flags]),
            scripted(module),
        )
    made.add(
        "another network than in training",
        lambda root: make_env(
            1,
            {
                "control.actuator": "network",
                "control.network": "net.npz",
                "control.network_digest": {"net.npz": "0" * 64},
            },
        ),
        saved(lambda: mlp()[1].to_arrays()),
    )
    for name, fields in FIELDS.items():
        made.add(f"go1_flat with {name}", lambda root, fields=fields: make_env(2, {**DC, **fields}))
    made.add("two laws", lambda root: make_env(2, DC, env_class=Springs))
    made.add("an origin beside a law", lambda root: make_env(2, {"control.action_origin": "joints"}, env_class=Springs))
    return made
