"""How much memory networks and a rollout take at the least: asked before they are allocated."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

from legged_mw.envs.robot_task import RobotTask
from legged_mw.utils.machine import require_memory

_FLOAT = 4  # [byte]


def check_room(sections: dict[str, Any], env: RobotTask, learns: bool = True) -> None:
    """Refuse what memory has no room for, with the field that asks the most. Raises UserError.

    ``sections`` is the learner's config as a mapping. Without ``learns`` it is about an actor that only acts.
    """
    device, sizes = str(env.device), {group: buffer.shape[1] for group, buffer in env.obs_buf.items()}
    counts = {
        field: count
        for name in (("actor", "critic") if learns else ("actor",))
        for field, count in _weights(
            sections, name, sum(sizes.get(group, 0) for group in sections["obs_groups"][name])
        ).items()
    }
    field = max(counts, key=lambda field: counts[field])
    value = sections
    for part in field.split("."):
        value = value[part]
    copies = 4 if learns else 1  # beside the weights their gradients, and Adam's two moments
    require_memory(
        _FLOAT * copies * sum(counts.values()), device, f"{field} = {value}", "fewer values a layer need less"
    )
    if learns:
        steps, worlds = sections["runner"]["num_steps_per_env"], env.num_envs
        # action, mean, deviation; reward, done, value, return, advantage
        sample = sum(sizes.values()) + 3 * env.num_actions + 5
        what = f"runner.num_steps_per_env = {steps} with env.num_envs = {worlds}"
        require_memory(_FLOAT * steps * worlds * sample, device, what, "fewer steps or worlds need less")


def _weights(sections: dict[str, Any], name: str, seen: int) -> dict[str, int]:
    """Field -> weights that it asks for, of the network ``name``, which reads ``seen`` values."""
    section, counts = sections[name], {}
    if "RNN" in section["class_name"]:
        hidden = section["rnn_hidden_dim"]
        counts[f"{name}.rnn_hidden_dim"] = 3 * hidden * (seen + hidden * (2 * section["rnn_num_layers"] - 1))
        seen = hidden
    counts[f"{name}.hidden_dims"] = _chain([seen, *section["hidden_dims"], 1])
    if name == "actor" and section["estimator"]["targets"]:
        counts["actor.estimator.hidden_dims"] = _chain([seen, *section["estimator"]["hidden_dims"], 1])
    if name == "actor" and section["concurrent"]["groups"]:
        counts["actor.concurrent.hidden_dims"] = _chain([seen, *section["concurrent"]["hidden_dims"]])
        counts["actor.concurrent.latent_dim"] = (
            section["concurrent"]["latent_dim"] * section["concurrent"]["hidden_dims"][-1]
        )
    return counts


def _chain(sizes: list[int]) -> int:
    return sum(before * after for before, after in pairwise(sizes))
