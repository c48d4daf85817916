"""Every field of the learner, typed, with its source. Tasks override them in configs/. None is the environment's.

Sources: [P] MuJoCo Playground's learner settings for its Go1 joystick task; [R] rsl-rl's defaults; [ours] with the
reason.
"""

from __future__ import annotations

import copy
import importlib.util
import inspect
from collections.abc import Iterator
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Any, Literal

from legged_mw.utils.bounds import (
    SOME,
    Bound,
    Count,
    NonNegative,
    NonNegativeInt,
    Positive,
    PositiveRange,
    PositiveShare,
    Share,
    SmallInt,
    Threads,
    at_least,
)
from legged_mw.utils.config import Config, ConfigError
from legged_mw.utils.files import MOST_LETTERS, wrong_name
from legged_mw.utils.machine import require_memory
from legged_mw.utils.task import LoadedTask

if TYPE_CHECKING:
    from legged_mw.envs.robot_task import RobotTask

MAX_RATE = 1e-2  # upper bound of rsl-rl's adaptive learning rate
Iterations = Annotated[int, at_least(0, 1_000_000)]
Seed = Annotated[int, Bound("a whole number below 2^63", lambda value: abs(value) < 2**63)]
Sizes = Annotated[list[Count], SOME]  # of hidden layers
FolderPart = Annotated[
    str, Bound(f"a plain name such as wide_net, of {MOST_LETTERS} bytes at most", lambda v: not wrong_name(v))
]
# [R]
Activation = Literal[
    "elu", "selu", "relu", "crelu", "lrelu", "tanh", "sigmoid", "softplus", "gelu", "swish", "mish", "identity"
]


class RobotTaskCfgPPO(Config):
    """The learner. Keys below actor, critic and algorithm are rsl-rl's own and pass through untranslated.

    What is marked [ours] was found by measurement: docs/lab.md.
    """

    seed: Seed = 1

    class runner:
        num_steps_per_env: Count = 24  # control steps per world between two updates [P]
        max_iterations: Count = 300  # [ours: enough to see whether a new robot learns]
        save_interval: Count = 50  # [iterations] between checkpoints
        keep_checkpoints: NonNegativeInt = 0  # number of newest checkpoints that are kept; 0: all [ours]
        # [iterations] between short exams, with one at the end; 0, or over max_iterations: no exams [ours]
        exam_interval: NonNegativeInt = 200
        experiment_name: str = ""  # folder below logs/; empty: the task's name
        run_name: FolderPart = ""  # appended to the run folder's time stamp
        logger: Literal["tensorboard", "wandb"] = "tensorboard"
        wandb_project: str = "legged_mw"
        export: bool = True  # a finished training writes <run folder>/export/, as play.py --export does [ours]
        # of the networks on a GPU: highest is float32, high TF32; with bf16 the hidden layers of a plain MLP of ELUs
        # learn and act in bfloat16, on a CPU too, and everything else (memory, estimator, concurrent student, other
        # activations) in TF32
        matmul_precision: Literal["highest", "high", "bf16"] = "high"

    class obs_groups:
        actor: list[str] = ["state"]
        critic: list[str] = ["privileged_state"]

    class actor:
        class_name: str = "MLPModel"  # or "RNNModel": a GRU or LSTM before the MLP, a memory (docs/training.md)
        hidden_dims: Sizes = [512, 256, 128]  # [P]
        activation: Activation = "elu"  # [P]
        obs_normalization: bool = True  # [P]
        # only of RNNModel, as the next two fields [ours: three quarters of the cost of an LSTM; R lstm]
        rnn_type: Literal["gru", "lstm"] = "gru"
        rnn_hidden_dim: Count = 256  # size of a layer's hidden state [R]
        rnn_num_layers: SmallInt = 1  # [R]

        class distribution_cfg:
            class_name: str = "GaussianDistribution"
            init_std: Positive = 0.6  # [ours: with 1.0 the robot thrashes, with 0.4 it may never walk]
            std_type: Literal["scalar", "log"] = "scalar"  # [R]
            std_range: PositiveRange = [1e-6, 1e6]  # [R]

        class estimator:
            """A network that estimates rows which the actor does not read, for the actor (students/estimator.py)."""

            # rows of the critic's groups: ["base_lin_vel", "foot_contact"]; empty: no estimator
            targets: list[str] = []
            hidden_dims: Sizes = [256, 128]  # [genesis_lr's explicit estimator of a Go2]
            activation: Activation = "elu"
            learning_rate: PositiveShare = 1e-3  # fixed [HIMLoco]

        class concurrent:
            """The actor reads its newest frame and a latent, of a teacher or a student (students/concurrent.py)."""

            # groups that the teacher's encoder reads: ["privileged_state"]; empty: no teacher [CTS, arXiv 2405.10830]
            groups: list[str] = []
            teacher_share: PositiveShare = 0.75  # share of the worlds that act by the teacher's latent [CTS]
            latent_dim: Count = 32  # size of the latent, which has norm 1 [go2_rl_gym]
            hidden_dims: Sizes = [512, 256]  # of both encoders [go2_rl_gym]
            activation: Activation = "elu"
            learning_rate: PositiveShare = 1e-3  # of the student's encoder, fixed [go2_rl_gym]

    class critic:
        class_name: str = "MLPModel"
        hidden_dims: Sizes = [512, 256, 128]  # [P]
        activation: Activation = "elu"  # [P]
        obs_normalization: bool = True  # [P]
        rnn_type: Literal["gru", "lstm"] = "gru"  # as the actor's
        rnn_hidden_dim: Count = 256
        rnn_num_layers: SmallInt = 1

    class algorithm:
        class_name: str = "legged_mw.rl.ppo:GraphedPPO"  # or "PPO": rsl-rl's own, same results, slower on a GPU
        num_learning_epochs: SmallInt = 5  # [P]
        num_mini_batches: Count = 4  # [P]
        clip_param: Positive = 0.2  # [P]
        gamma: Share = 0.99  # [P]
        lam: Share = 0.95  # [P]
        value_loss_coef: NonNegative = 1.0  # [P]
        entropy_coef: NonNegative = 0.005  # [ours; P 0.001]
        learning_rate: PositiveShare = 1e-3  # at the start [R; P 3e-4]
        max_grad_norm: Positive = 1.0  # [P]
        optimizer: str = "adam"  # [P]
        use_clipped_value_loss: bool = True  # [P]
        schedule: Literal["adaptive", "fixed"] = "adaptive"  # fixed: `learning_rate` throughout [R; P fixed]
        desired_kl: Positive = 0.01  # between updates, for the adaptive schedule [R]
        # upper bound of the adaptive schedule [R]; for a recurrent network 1e-3: docs/training.md
        max_learning_rate: PositiveShare = MAX_RATE
        normalize_advantage_per_mini_batch: bool = False  # [R]

    class distillation:
        """Replaces `algorithm` if there is a teacher, which the actor imitates. From class_name on rsl-rl's keys."""

        # its run, checkpoint or export, or a task for its last or shipped policy (train.py --teacher)
        teacher: str = ""
        init_std: Positive = 0.1  # of the student's noise during distillation, constant [Isaac Lab]
        # or "Distillation": rsl-rl's own, same results, slower
        class_name: str = "legged_mw.rl.students.distillation:GraphedDistillation"
        num_learning_epochs: SmallInt = 5  # [R 1; ours: docs/lab.md]
        gradient_length: Count = 4  # steps per gradient; divides num_steps_per_env [ours: R 15 leaves 9 of 24 unused]
        learning_rate: PositiveShare = 1e-3  # [R]
        max_grad_norm: NonNegative = 1.0  # 0: no bound [R none; ours: as in PPO]
        loss_type: Literal["mse", "huber"] = "mse"  # [R]
        optimizer: str = "adam"  # [R]

    class warm_start:
        """Training that starts from the actor of another run: `train.py --init`."""

        policy: str = ""  # the run, checkpoint or export, or a task for its last or shipped policy
        init_std: Positive = 0.2  # of exploration at the start [ours: less than without a policy, because it can walk]
        # [iterations] at the start in which only the critic learns, because it starts untrained [ours]
        critic_warmup: Iterations = 20

    class anneal:
        """End values of numbers of `algorithm`, linear over max_iterations or --max_time; 0: it stays [ours]."""

        entropy_coef: NonNegative = 0.0
        desired_kl: NonNegative = 0.0

    class cpu:
        """Values that train.py takes on a CPU; flags override them [ours: docs/lab.md]."""

        enable: bool = True
        envs_per_core: Count = 256  # worlds per core; the task's number of worlds if that is less
        num_steps_per_env: Count = 16
        num_learning_epochs: SmallInt = 5
        num_mini_batches: Count = 4
        desired_kl: Positive = 0.02
        hidden_dims: Sizes = [128, 64, 32]  # of actor and critic
        rnn_hidden_dim: Count = 64  # likewise
        max_iterations: Count = 2600
        overrides: dict[str, Any] = {}  # any field of the task: dotted path -> value
        # torch's threads in an update; 0: one per core, or one if that is faster. Everything else has one
        update_threads: Threads = 0

    class symmetry:
        """Left-right symmetry in the update, as in Mittal et al. 2024. How rows mirror: envs/mirror.py."""

        use_data_augmentation: bool = False  # also learn from the mirror image of each sample: twice the batch [R]
        use_mirror_loss: bool = False  # penalise mean actions that differ between a state and its mirror image [R]
        mirror_loss_coeff: NonNegative = 0.0  # weight of this loss, the mean square over actions [-] [R]

    def check(self, num_envs: int) -> None:
        """Raise ConfigError for values that do not fit each other, or the number of worlds."""
        samples = num_envs * self.runner.num_steps_per_env
        if samples < self.algorithm.num_mini_batches:
            raise ConfigError(
                f"an iteration has {samples} samples ({num_envs} worlds x {self.runner.num_steps_per_env} steps), "
                f"fewer than algorithm.num_mini_batches = {self.algorithm.num_mini_batches}; "
                "raise one of the former or lower the latter"
            )
        steps, length = self.runner.num_steps_per_env, self.distillation.gradient_length
        if self.distillation.teacher and steps % length:
            divisors = ", ".join(str(i) for i in range(1, steps + 1) if steps % i == 0)
            raise ConfigError(
                f"distillation.gradient_length is {length}, which leaves {steps % length} of "
                f"runner.num_steps_per_env = {steps} steps "
                f"unused; take one of {divisors}"
            )
        if self.symmetry.use_mirror_loss and not self.symmetry.mirror_loss_coeff:
            raise ConfigError(
                "symmetry.use_mirror_loss is on, but symmetry.mirror_loss_coeff is 0: "
                "set the loss's weight, or switch it off"
            )


class LeggedRobotCfgPPO(RobotTaskCfgPPO):
    """The learner of a walking task."""

    class cpu(RobotTaskCfgPPO.cpu):
        overrides = {
            "commands.keep_probability": [0.7, 0.25, 0.5],  # otherwise turns on the spot are rare and learned late
            "perturbation.curriculum": True,  # an untrained robot does not learn to walk under the strongest kicks
        }


def fit_cpu(task: LoadedTask, cores: int) -> None:
    """Apply the section ``cpu`` of the learner's config, for ``cores`` cores."""
    train, few = task.train, task.train.cpu
    task.cfg.env.num_envs = min(task.cfg.env.num_envs, few.envs_per_core * cores)
    train.runner.num_steps_per_env, train.runner.max_iterations = few.num_steps_per_env, few.max_iterations
    train.algorithm.num_learning_epochs = few.num_learning_epochs
    train.algorithm.num_mini_batches = few.num_mini_batches
    train.algorithm.desired_kl = few.desired_kl
    train.actor.hidden_dims = train.critic.hidden_dims = few.hidden_dims
    train.actor.rnn_hidden_dim = train.critic.rnn_hidden_dim = few.rnn_hidden_dim
    for path, value in few.overrides.items():
        task.set(path, value, where="cpu.overrides")


# ---- the form that rsl-rl takes -------------------------------------------------------------------------------------


def rsl_rl_config(cfg: RobotTaskCfgPPO, env: RobotTask | None = None) -> dict[str, Any]:
    """The learner's config as rsl-rl's flat dict: a deep copy, because rsl-rl writes into it. Raises ConfigError.

    ``env``: needed only if ``actor.estimator`` or ``actor.concurrent`` is set.
    """
    check_classes(cfg)
    sections = copy.deepcopy(cfg.to_dict())
    sections["actor"] = actor_settings(sections, env)
    runner = sections.pop("runner")
    logger = runner["logger"]
    if logger == "wandb":
        if importlib.util.find_spec("wandb") is None:
            raise ConfigError("runner.logger is wandb, but wandb is not installed: pip install wandb")
        logger = {"class_name": "WandbLogWriter", "project_name": runner["wandb_project"]}
    keys = ("num_steps_per_env", "save_interval", "keep_checkpoints", "exam_interval", "experiment_name", "run_name")
    symmetry = sections.pop("symmetry")
    mirrors = symmetry["use_data_augmentation"] or symmetry["use_mirror_loss"]
    symmetry_cfg = {"data_augmentation_func": "legged_mw.rl.ppo:mirror", **symmetry} if mirrors else None
    algorithm = {"rnd_cfg": None, "symmetry_cfg": symmetry_cfg, **sections.pop("algorithm")}
    _check_bound(algorithm)
    anneal = {name: (algorithm[name], end) for name, end in sections.pop("anneal").items()}
    flat = {key: runner[key] for key in keys} | {name: network_section(sections[name]) for name in ("actor", "critic")}
    return {**sections, **flat, "algorithm": algorithm, "anneal": anneal, "logger": logger, "check_for_nan": False}


def _check_bound(algorithm: dict[str, Any]) -> None:
    """Remove ``max_learning_rate`` if it is rsl-rl's default. Raises ConfigError if no class would use it."""
    if algorithm["max_learning_rate"] == MAX_RATE:
        del algorithm["max_learning_rate"]
        return
    name, rate, bound = (algorithm[key] for key in ("class_name", "learning_rate", "max_learning_rate"))
    if name in spellings(_PPO):
        raise ConfigError(
            f"algorithm.max_learning_rate: rsl-rl's own {name} goes up to {MAX_RATE:g}; GraphedPPO takes another"
        )
    if algorithm["schedule"] == "fixed":
        raise ConfigError(
            f"algorithm.max_learning_rate is {bound:g}, but algorithm.schedule is 'fixed', which has no bound: "
            f"the rate is algorithm.learning_rate throughout. Leave the bound at {MAX_RATE:g}, "
            "or take the schedule 'adaptive'"
        )
    if rate > bound:
        raise ConfigError(
            f"algorithm.learning_rate is {rate:g}, above algorithm.max_learning_rate, {bound:g}; begin at or below it"
        )


# ---- classes --------------------------------------------------------------------------------------------------------


# Strings ``module:name``, so that loading or listing tasks does not import rsl-rl.
_PPO = "rsl_rl.algorithms.ppo:PPO"
_RNN = "rsl_rl.models.rnn_model:RNNModel"
_NETWORKS = ("rsl_rl.models.mlp_model:MLPModel", "rsl_rl.models.cnn_model:CNNModel", _RNN)
_DISTRIBUTIONS = (
    "rsl_rl.modules.distribution:GaussianDistribution",
    "rsl_rl.modules.distribution:HeteroscedasticGaussianDistribution",
)
ALLOWED: dict[str, tuple[str, ...]] = {
    "actor.class_name": _NETWORKS,
    "critic.class_name": _NETWORKS,
    "actor.distribution_cfg.class_name": _DISTRIBUTIONS,
    "critic.distribution_cfg.class_name": _DISTRIBUTIONS,
    "algorithm.class_name": ("legged_mw.rl.ppo:GraphedPPO", _PPO),
    "distillation.class_name": (
        "legged_mw.rl.students.distillation:GraphedDistillation",
        "rsl_rl.algorithms.distillation:Distillation",
    ),
}
_RECURRENT = "legged_mw.rl.students.recurrent:RecurrentModel"  # replaces rsl-rl's RNNModel
# field of section `actor` that selects a network -> network, imported only if selected
_ESTIMATOR, _CONCURRENT = "actor.estimator.targets", "actor.concurrent.groups"
_STUDENTS = {
    _ESTIMATOR: "legged_mw.rl.students.estimator:EstimatingModel",
    _CONCURRENT: "legged_mw.rl.students.concurrent:ConcurrentModel",
}
_IMPORTED = ("class_name", "data_augmentation_func")  # rsl-rl imports and calls the values of these keys


def check_classes(cfg: Config) -> None:
    """Raise ConfigError for a class that is neither in the task's Python file nor in ``ALLOWED``. Imports nothing.

    rsl-rl imports and calls the value of ``class_name``. A run folder may come from a stranger, so its config.yaml must
    not choose code.
    """
    own = dict(_class_names(type(cfg)().to_dict()))
    for path, name in _class_names(cfg.to_dict()):
        if path in own and name == own[path]:
            continue
        allowed = [spelling for kind in ALLOWED.get(path, ()) for spelling in spellings(kind)]
        if name not in allowed:
            shortest = [spellings(kind)[0] for kind in ALLOWED.get(path, ())]
            raise ConfigError(
                f"{path} is {name!r}: only the task's own Python file, which --task names, may choose that; "
                f"a run's config.yaml, --set and --override may name {', '.join(shortest) or 'nothing else there'}"
            )


def actor_settings(sections: dict[str, Any], env: RobotTask | None, learns: bool = True) -> dict[str, Any]:
    """Section ``actor`` in rsl-rl's form, with the class that its subsections select. Raises ConfigError.

    ``sections``: the learner's config. ``learns``: False for an actor that only acts; ``env`` may then lack the rows
    that only learning needs.
    """
    actor = {name: value for name, value in sections["actor"].items() if name not in ("estimator", "concurrent")}
    parts = sections["actor"]
    named = {_ESTIMATOR: parts["estimator"]["targets"], _CONCURRENT: parts["concurrent"]["groups"]}
    fields = [field for field, names in named.items() if names]
    if not fields:
        return actor
    if len(fields) > 1:
        raise ConfigError(f"{' and '.join(fields)} are both set: the actor reads an estimate or a latent; empty one")
    if actor["class_name"] != "MLPModel":
        raise ConfigError(f"{fields[0]}: that goes with actor.class_name 'MLPModel', not '{actor['class_name']}'")
    assert env is not None
    from rsl_rl.utils import resolve_callable

    name = _STUDENTS[fields[0]]
    model: Any = resolve_callable(name)
    return {**actor, **model.settings(sections, env, learns), "class_name": name}


def network_section(section: dict[str, Any]) -> dict[str, Any]:
    """The section of a network in rsl-rl's form, without the fields ``rnn_...`` if its class has none.

    It imports the class, so call ``check_classes`` first.
    """
    from rsl_rl.utils import resolve_class

    if section["class_name"] in spellings(_RNN):
        section = {**section, "class_name": _RECURRENT}
    taken = inspect.signature(resolve_class(section)[0]).parameters
    return {name: value for name, value in section.items() if name in taken or not name.startswith("rnn_")}


def spellings(kind: str) -> list[str]:
    """All names by which rsl-rl finds the class ``module:name``, shortest first."""
    module, name = kind.split(":")
    long = [f"{module}:{name}", f"{module}.{name}"]
    if not module.startswith("rsl_rl."):
        return long
    package = module.rpartition(".")[0]
    return [name, f"{package}:{name}", f"{package}.{name}", *long]


def _class_names(values: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """(dotted path, value) of each class name in nested mappings and lists."""
    items = values.items() if isinstance(values, dict) else enumerate(values) if isinstance(values, list) else ()
    for key, value in items:
        here = f"{path}.{key}" if path else str(key)
        if key in _IMPORTED:
            yield here, value
        yield from _class_names(value, here)


# ---- memory ---------------------------------------------------------------------------------------------------------


_FLOAT = 4  # [byte]


def check_room(sections: dict[str, Any], env: RobotTask, learns: bool = True) -> None:
    """Raise UserError, with the largest field, if networks and rollout do not fit the memory.

    ``sections``: the learner's config. ``learns``: False for an actor that only acts.
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
    copies = 4 if learns else 1  # weights, gradients, two moments of Adam
    require_memory(
        _FLOAT * copies * sum(counts.values()), device, f"{field} = {value}", "fewer values a layer need less"
    )
    if learns:
        steps, worlds = sections["runner"]["num_steps_per_env"], env.num_envs
        # action, mean, std; reward, done, value, return, advantage
        sample = sum(sizes.values()) + 3 * env.num_actions + 5
        what = f"runner.num_steps_per_env = {steps} with env.num_envs = {worlds}"
        require_memory(_FLOAT * steps * worlds * sample, device, what, "fewer steps or worlds need less")


def _weights(sections: dict[str, Any], name: str, seen: int) -> dict[str, int]:
    """Field -> number of weights of the network ``name`` with ``seen`` inputs."""
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
