"""Two learners with equal parameters and equal experience: rsl-rl's own PPO, and the recorded one."""

from __future__ import annotations

import copy
from typing import Any

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from tensordict import TensorDict

from legged_mw.rl.learner_config import network_section
from legged_mw.rl.students.concurrent import ConcurrentModel
from legged_mw.rl.students.estimator import EstimatingModel

WORLDS, STEPS, ACTIONS = 32, 6, 4
MODEL: type[MLPModel] = MLPModel
SIZES = {"state": 7, "privileged_state": 11}
TARGETS = [("speed", "privileged_state", 2, [1.0, 1.0]), ("height", "privileged_state", 6, [2.0])]
ESTIMATOR: dict[str, Any] = {"targets": TARGETS, "hidden_dims": [24, 12], "activation": "elu", "learning_rate": 3e-3}
CONCURRENT: dict[str, Any] = {
    **{"groups": ["privileged_state"], "teacher_share": 0.75, "newest": [(2, 4), (5, 7)]},
    **{"latent_dim": 5, "hidden_dims": [24, 12], "activation": "elu", "learning_rate": 3e-3},
}


class Env:
    num_envs, num_actions = WORLDS, ACTIONS


def turned(
    env: object, obs: TensorDict | None, actions: torch.Tensor | None
) -> tuple[TensorDict | None, torch.Tensor | None]:
    """A stand-in for a mirror: everything changes sign."""
    both = (
        None if obs is None else TensorDict({k: torch.cat([obs[k], -obs[k]]) for k in list(obs.keys())}, [2 * len(obs)])
    )
    return both, None if actions is None else torch.cat([actions, -actions])


def observations(generator: torch.Generator, device: str) -> TensorDict:
    values = {name: torch.randn(WORLDS, size, generator=generator).to(device) * 2 + 1 for name, size in SIZES.items()}
    return TensorDict(values, [WORLDS], device=device)


def make(
    kind: type[PPO],
    device: str = "cpu",
    distribution: dict[str, Any] | None = None,
    estimator: dict[str, Any] | None = None,
    memory: dict[str, dict[str, Any]] | None = None,
    concurrent: dict[str, Any] | None = None,
    multi_gpu: dict[str, int] | None = None,
    **settings: Any,
) -> Any:
    """A learner whose networks come from a fixed seed.

    ``estimator``, ``concurrent``: what an actor that has one differs in from ESTIMATOR or CONCURRENT; ``memory``: what makes "actor" or
    "critic" recurrent; ``multi_gpu``: rsl-rl's word for this rank among several.
    """
    torch.manual_seed(1)
    distribution = {"class_name": "GaussianDistribution", "init_std": 0.7} | (distribution or {})
    if distribution["class_name"] == "BetaDistribution":
        del distribution["init_std"]
    network = {"class_name": MODEL, "hidden_dims": [32, 16], "activation": "elu", "obs_normalization": True}
    more = {} if estimator is None else {"class_name": EstimatingModel, "estimator": {**ESTIMATOR, **estimator}}
    more |= {} if concurrent is None else {"class_name": ConcurrentModel, "concurrent": {**CONCURRENT, **concurrent}}
    cfg = {
        "obs_groups": {"actor": ["state"], "critic": ["state", "privileged_state"]},
        "actor": network_section(
            {**network, "distribution_cfg": distribution, **more, **(memory or {}).get("actor", {})}
        ),
        "critic": network_section(network | (memory or {}).get("critic", {})),
        "algorithm": {"class_name": kind, "rnd_cfg": None, "symmetry_cfg": None, **settings},
        "num_steps_per_env": STEPS,
        "multi_gpu": multi_gpu,
    }
    obs = observations(torch.Generator().manual_seed(0), device)
    alg = kind.construct_algorithm(obs, Env(), copy.deepcopy(cfg), device)  # type: ignore[arg-type]
    alg.train_mode()
    return alg


def collect(alg: PPO, device: str = "cpu", seed: int = 2) -> None:
    """Fill the storage with actions of its own and made-up rewards, ends and time outs; then the returns."""
    generator = torch.Generator().manual_seed(seed)
    torch.manual_seed(seed)
    obs = observations(generator, device)
    with torch.inference_mode():
        for _ in range(STEPS):
            actions = alg.act(obs)
            reward = torch.randn(WORLDS, generator=generator).to(device) - 0.1 * actions.square().sum(dim=1)
            ended = torch.rand(WORLDS, generator=generator).to(device) < 0.2
            obs = observations(generator, device)
            alg.process_env_step(obs, reward, ended, {"time_outs": ended & (reward > 0.0)})
        alg.compute_returns(obs)


@torch.inference_mode()
def share_experience(source: PPO, target: PPO) -> None:
    """Let ``target`` learn from what ``source`` has seen.

    The policy that acted is moved a little first: else the first minibatch's KL divergence is rounding noise about 0, whose
    sign decides whether the adaptive rate grows.
    """
    ours, theirs = target.storage, source.storage
    assert theirs.distribution_params is not None
    theirs.distribution_params[0].add_(0.02)
    for name in ("observations", "actions", "rewards", "dones", "values", "actions_log_prob", "returns", "advantages"):
        getattr(ours, name).copy_(getattr(theirs, name))
    if ours.distribution_params is None:
        ours.distribution_params = tuple(p.clone() for p in theirs.distribution_params)
    for mine, other in zip(ours.distribution_params or (), theirs.distribution_params or (), strict=True):
        mine.copy_(other)


def parameters(alg: PPO) -> dict[str, torch.Tensor]:
    """All that a checkpoint holds of the networks."""
    return {
        f"{which}.{k}": v.clone() for which in ("actor", "critic") for k, v in getattr(alg, which).state_dict().items()
    }


def difference(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> float:
    """Largest difference of any parameter, as a share of the parameter's own largest value."""
    return max(
        float((a[k].double() - b[k].double()).abs().max() / a[k].double().abs().max().clamp(min=1e-3)) for k in a
    )


def apart(before: dict[str, torch.Tensor], a: PPO, b: PPO) -> float:
    """Distance of the networks of two learners, as a share of the way that the first one's went since ``before``."""
    ways = [torch.cat([(p - before[k]).flatten() for k, p in parameters(alg).items() if "mlp" in k]) for alg in (a, b)]
    return float((ways[1] - ways[0]).norm() / ways[0].norm())


@torch.no_grad()
def take_over(target: PPO, source: PPO) -> None:
    """``target`` gets the networks, Adam's memory and the rate of ``source``, in place: what is recorded stays recorded."""
    for which in ("actor", "critic"):
        for mine, other in zip(
            getattr(target, which).state_dict().values(), getattr(source, which).state_dict().values(), strict=True
        ):
            mine.copy_(other)
        for mine, other in zip(getattr(target, which).parameters(), getattr(source, which).parameters(), strict=True):
            for name, memory in target.optimizer.state[mine].items():
                memory.copy_(source.optimizer.state[other][name])
    target.learning_rate = source.learning_rate
