"""What a checkpoint does not hold, beside the newest one: worlds, generators, memories. With it a resumed training goes on exactly.

A file of its own, since it is large and of no use to who plays the policy. It is written before its checkpoint and the one before
goes after it, so that a kill at any moment leaves the newest checkpoint with its worlds.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from legged_mw.envs.robot_task import RobotTask
from legged_mw.envs.snapshot import memory, put_snapshot, take_snapshot
from legged_mw.rl.checkpoint import damage
from legged_mw.rl.ranks import Rank
from legged_mw.rl.recorded import Memories

_MOST = 1e10  # what MuJoCo calls a state that has blown up: mjMAXVAL
_FREE = ("rewards", "noise", "viewer", "exam", "termination")  # sections that may have changed: the worlds are the same


def worlds_file(checkpoint: Path, rank: Rank) -> Path:
    """The file of the worlds of ``rank`` beside ``checkpoint``."""
    return checkpoint.with_name(f"worlds_{checkpoint.stem.removeprefix('model_')}{suffix_of(rank)}.pt")


def suffix_of(rank: Rank) -> str:
    """What tells the files of ranks apart; of a process alone ''."""
    return f"_{rank.index}of{rank.count}" if rank.count > 1 else ""


def worlds_content(runner: Any) -> dict[str, Any]:
    """What to write: tensors and plain numbers only."""
    random = random_state(runner.device)
    return {
        **_kind(runner.env),
        "random_state": random,
        "worlds": take_snapshot(runner.env),
        "memories": _memories(runner),
    }


def take_worlds(runner: Any, checkpoint: Path, rank: Rank, random: dict[str, Tensor]) -> str:
    """Put worlds and memories back as they were at ``checkpoint``, whose generators were as ``random``; returns why not, or ''."""
    file = worlds_file(checkpoint, rank)
    if not file.is_file():
        return f"there is no {file.name} beside it"
    try:
        if why := damage(written := file.read_bytes()):
            return f"{file.name} cannot be read: {why}"
        content = torch.load(io.BytesIO(written), map_location="cpu", weights_only=True)
        there, here = ({key: content[key] for key in ("engine", "device", "config")}, _kind(runner.env))
        state, worlds, memories = (dict(content[key]) for key in ("random_state", "worlds", "memories"))
    except Exception:  # a zip, pickle or tensor error, by how the file is broken
        return f"{file.name} cannot be read"
    if rank.leads and not (
        state.keys() == random.keys() and all(torch.equal(state[key], random[key].cpu()) for key in state)
    ):
        return f"{file.name} is of another checkpoint"
    if different := _first_difference(there, here):
        return different
    own = _memories(runner, copy=False)
    if own.keys() != memories.keys() or any(own[key].shape != memories[key].shape for key in own):
        return "the networks' memories are of another shape"
    if name := beyond(worlds, memory(runner.env)) or beyond(memories, own):
        return f"{file.name}: {name} is not finite, or beyond {_MOST:.0e}"
    if reason := put_snapshot(runner.env, worlds):
        return reason
    with torch.inference_mode():
        for key, value in memories.items():
            own[key].copy_(value)
    if not rank.leads:
        set_random_state(state, runner.device)
    return ""


def beyond(saved: dict[str, Tensor], own: dict[str, Tensor]) -> str:
    """The first name whose numbers are finite and no larger than ``_MOST`` in ``own``, but not as they were saved; ''."""
    return next((name for name, value in saved.items() if name in own and _sane(own[name]) and not _sane(value)), "")


def _sane(value: Tensor) -> bool:
    return not value.is_floating_point() or bool((value.abs() <= _MOST).all())


def random_state(device: str) -> dict[str, Tensor]:
    """Torch's generators of host and device."""
    state = {"cpu": torch.get_rng_state()}
    if device.startswith("cuda"):
        state["cuda"] = torch.cuda.get_rng_state(device)
    return state


def set_random_state(state: dict[str, Tensor], device: str) -> None:
    """Put back what ``random_state`` returned."""
    if "cpu" in state:
        torch.set_rng_state(state["cpu"].cpu())
    if "cuda" in state and device.startswith("cuda"):
        torch.cuda.set_rng_state(state["cuda"].cpu(), device)


def _kind(env: RobotTask) -> dict[str, Any]:
    """What must be equal for worlds to be the same."""
    config = {name: section for name, section in env.cfg.to_dict().items() if name not in _FREE}
    return {"engine": env.sim.engine, "device": str(env.device).partition(":")[0], "config": config}


def _memories(runner: Any, copy: bool = True) -> dict[str, Tensor]:
    """Hidden states of networks with a memory, by their place."""
    states: Memories | dict = getattr(runner.alg, "_memories", {})
    return {str(i): state.now.cpu().clone() if copy else state.now for i, state in enumerate(states.values())}


def _first_difference(there: Any, here: Any, path: str = "") -> str:
    """``path is A there and B here`` of the first value that differs; ''."""
    if isinstance(there, dict) and isinstance(here, dict):
        names = [*here, *(name for name in there if name not in here)]
        found = (
            _first_difference(there.get(name), here.get(name), f"{path}.{name}" if path else str(name))
            for name in names
        )
        return next((text for text in found if text), "")
    return "" if there == here else f"{path.removeprefix('config.')} was {there} and is {here}"
