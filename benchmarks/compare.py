"""Training throughput beside mjlab and MuJoCo Playground: whole iterations, rollout and update, of Go1 on flat or rough ground.

    python benchmarks/compare.py --num_envs 4096 16384
    python benchmarks/compare.py --num_envs 4096 --ground rough
    python benchmarks/compare.py --python-mjlab ~/mjlab/bin/python --python-playground ~/playground/bin/python

The two are no dependencies of this project: one that is not installed is listed as that. Their pins of mujoco clash with
ours and with each other's, so each may live in an environment of its own, named by its interpreter. Playground fetches
its meshes with git when it first runs.

Each framework runs its own default task and learner; only the number of worlds is set. One after the other, each in a
process of its own, so that device memory, settings and crashes stay apart. What differs is printed under the table.
--verbose shows what the frameworks print, tracebacks too.
"""

# The peers are imported only where they are installed, and the child may run where this project's packages are not:
# outside of functions, only the standard library.
# pyright: reportMissingImports=false
from __future__ import annotations

import argparse
import functools
import importlib.metadata
import importlib.util
import itertools
import json
import math
import os
import platform
import signal
import statistics
import subprocess
import sys
import textwrap
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
WARM_UP = 5  # iterations, in which kernels are compiled and graphs recorded; of Playground, two rounds
ROUNDS = 3  # the median of which is reported


QUIET = "mujoco-warp's messages from within kernels, one a world and step when its solver runs to the end, are off, as in legged_mw"
TORCH_STACK = ("mujoco", "mujoco-warp", "warp-lang", "torch", "rsl-rl-lib")


class Framework(NamedTuple):
    package: str  # what is imported
    install: str
    tasks: dict[str, str]  # by ground
    versions: tuple[str, ...]  # distributions whose versions are reported


FRAMEWORKS = {
    "legged_mw": Framework("legged_mw", "pip install -e .", {"flat": "go1_flat", "rough": "go1_rough"}, TORCH_STACK),
    "mjlab": Framework(
        "mjlab",
        "pip install mjlab",
        {"flat": "Mjlab-Velocity-Flat-Unitree-Go1", "rough": "Mjlab-Velocity-Rough-Unitree-Go1"},
        ("mjlab", *TORCH_STACK),
    ),
    "playground": Framework(
        "mujoco_playground",
        'pip install playground "jax[cuda12]<0.10" "mujoco-mjx[warp]"',  # brax 0.14.2 calls what jax 0.10 dropped
        {"flat": "Go1JoystickFlatTerrain", "rough": "Go1JoystickRoughTerrain"},
        ("playground", "mujoco", "mujoco-mjx", "warp-lang", "jax", "brax"),
    ),
}


# ---- the child: one framework, one number of worlds; answers with one line of JSON -------------------------------------


class Order(NamedTuple):
    """What a child is to measure."""

    framework: str
    num_envs: int
    iterations: int  # a round
    device: str  # cpu or cuda:0: a child sees one GPU
    impl: str  # Playground's physics: MJX in jax or in warp
    ground: str = "flat"


class Measured(NamedTuple):
    """What a child found."""

    seconds: list[float]  # an iteration, one figure a round
    steps: int  # environment steps an iteration
    minibatch: int  # samples
    machine: str
    facts: dict[str, str]  # the conditions, the same for any number of worlds
    notes: list[str]


def child(order: Order) -> None:
    """Measure, and answer on what was standard output; whatever a framework prints goes to standard error."""
    answer = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    framework = FRAMEWORKS[order.framework]
    try:
        if importlib.util.find_spec(framework.package) is None:
            reply: dict[str, Any] = {"missing": True}
        else:
            measured = MEASURE[order.framework](order)
            versions = {
                "python": platform.python_version(),
                **{name: importlib.metadata.version(name) for name in framework.versions},
            }
            reply = {"measured": measured._asdict(), "versions": versions}
    except Exception as error:
        traceback.print_exc()
        message = next((line for line in str(error).splitlines() if line.strip()), "")
        reply = {"error": f"{type(error).__name__}: {message}"}
    print(json.dumps(reply), file=answer, flush=True)
    os._exit(0)  # MJX in warp may hang when Python tears it down


def measure_legged_mw(order: Order) -> Measured:
    """This project's task with its learner's defaults, as train.py runs it, without a log folder."""
    import torch

    from legged_mw.rl.runner import make_runner
    from legged_mw.utils.cli import seed_everything
    from legged_mw.utils.task import load_task

    if order.device == "cpu":
        torch.set_num_threads(1)  # as train.py does
    task = load_task(FRAMEWORKS["legged_mw"].tasks[order.ground])
    task.cfg.env.num_envs = order.num_envs
    seed_everything(task.train.seed)
    env = task.env_class(task.cfg, order.device)
    runner = make_runner(env, task.train, None, order.device)
    cfg = task.train.to_dict()
    cfg["num_steps_per_env"] = cfg["runner"]["num_steps_per_env"]
    sizes = {role: sum(env.obs_buf[group].shape[1] for group in groups) for role, groups in cfg["obs_groups"].items()}
    facts = {**physics_facts(env.robot.physics, task.cfg.control.decimation), "rewards": f"{len(env.reward_names)}"}
    mirrored = "it learns from the mirror image of every sample too: twice the minibatch shown"
    return measure_runner(
        runner, cfg, sizes, order, facts, [mirrored] if task.train.symmetry.use_data_augmentation else []
    )


def measure_mjlab(order: Order) -> Measured:
    """mjlab's task with its learner, put together as its training script does, without a log folder."""
    os.environ["GIT_PYTHON_REFRESH"] = "quiet"  # rsl-rl asks for a git executable otherwise
    import mjlab.tasks  # noqa: F401 (registers the tasks)
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.rl import MjlabOnPolicyRunner, RslRlVecEnvWrapper
    from mjlab.tasks.registry import load_env_cfg, load_rl_cfg, load_runner_cls
    from mjlab.utils.torch import configure_torch_backends

    task = FRAMEWORKS["mjlab"].tasks[order.ground]
    env_cfg, learner = load_env_cfg(task), load_rl_cfg(task)
    env_cfg.scene.num_envs = order.num_envs
    env_cfg.seed = learner.seed
    configure_torch_backends()
    env = ManagerBasedRlEnv(cfg=env_cfg, device=order.device)
    notes = ["no log is written, so rsl-rl's statistics, which read the device every step, are off"]
    # which it does not ask for, but runs with
    if int(importlib.metadata.version("mujoco-warp").partition(".")[0]) >= 4:
        # else each world that needs all solver iterations prints a line from its kernel
        env.sim.wp_model.opt.warn_overflow = 0
        env.sim.create_graph()
        notes.append(QUIET)
    wrapped = RslRlVecEnvWrapper(env, clip_actions=learner.clip_actions)
    runner = (load_runner_cls(task) or MjlabOnPolicyRunner)(wrapped, asdict(learner), None, order.device)
    sizes = {role: value.shape[1] for role, value in wrapped.get_observations().items()}
    rewards = {"rewards": f"{len(env.reward_manager.active_terms)}"}
    return measure_runner(
        runner, asdict(learner), sizes, order, {**physics_facts(env.sim.mj_model, env_cfg.decimation), **rewards}, notes
    )


def measure_runner(
    runner: Any, cfg: dict[str, Any], sizes: dict[str, int], order: Order, facts: dict[str, str], notes: list[str]
) -> Measured:
    """Time `learn` of a runner with rsl-rl's interface; `cfg` has rsl-rl's keys, `sizes` are of the observations."""
    import torch

    gpu, algorithm = order.device != "cpu", cfg["algorithm"]
    facts = {
        "learner": f"rsl-rl, {algorithm['class_name'].rpartition(':')[2]}",
        "rollout": f"{cfg['num_steps_per_env']} steps a world",
        "update": f"{algorithm['num_learning_epochs']} epochs x {algorithm['num_mini_batches']} minibatches",
        **{role: network(sizes[role], cfg[role]["hidden_dims"]) for role in ("actor", "critic")},
        "matrix products": getattr(torch.backends.cuda.matmul, "fp32_precision", "?"),
        **facts,
    }
    runner.learn(WARM_UP, init_at_random_ep_len=True)
    seconds = []
    wait = torch.cuda.synchronize if gpu else lambda: None
    for _ in range(ROUNDS):
        wait()
        start = time.perf_counter()
        runner.learn(order.iterations, init_at_random_ep_len=False)
        wait()
        seconds.append((time.perf_counter() - start) / order.iterations)
    steps = cfg["num_steps_per_env"] * order.num_envs
    machine = torch.cuda.get_device_name() if gpu else cpu_name()
    return Measured(seconds, steps, steps // algorithm["num_mini_batches"], machine, facts, notes)


def measure_playground(order: Order) -> Measured:
    """Playground's task with brax's PPO under its tuned figures, put together as its training script does."""
    # what its training script sets
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_gpu_triton_gemm_any=True"
    os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"
    import jax
    from mujoco_playground.config import locomotion_params

    task = FRAMEWORKS["playground"].tasks[order.ground]
    # fails here without a GPU build of jax
    machine = jax.devices()[0].device_kind if order.device != "cpu" else cpu_name()
    env, rewards, changed = load_playground(task, order)
    params = locomotion_params.brax_ppo_config(task, order.impl).to_dict()
    layers = params.pop("network_factory")
    sizes = env.observation_size
    facts = {
        "learner": "brax, PPO",
        "rollout": f"{params['unroll_length']} steps a world",
        "update": f"{params['num_updates_per_batch']} epochs x {params['num_minibatches']} minibatches",
        "actor": network(sizes[layers["policy_obs_key"]][0], layers["policy_hidden_layer_sizes"]),
        "critic": network(sizes[layers["value_obs_key"]][0], layers["value_hidden_layer_sizes"]),
        "matrix products": "jax's default, tf32",
        **physics_facts(env.mj_model, env.n_substeps),
        "rewards": f"{rewards}",
    }
    seconds, steps = time_brax(env, params, layers, order)
    notes = [
        f"MJX in {order.impl} (--playground-impl; its task says warp, its training script jax)",
        *changed,
        "an update takes its default of 8192 rollouts; beyond 8192 worlds one of each, and its buffer for contacts grows",
        "its resets of all worlds and its evaluations, now and then between updates, are left out",
    ]
    return Measured(seconds, steps, steps // params["num_minibatches"], machine, facts, notes)


def load_playground(task: str, order: Order) -> tuple[Any, int, list[str]]:
    """Its environment, how many reward terms that has, and a note on what is changed of it, if anything is."""
    from mujoco_playground import registry

    cfg = registry.get_default_config(task)
    contacts = cfg.naconmax * math.ceil(order.num_envs / 8192)  # the default's buffer is for 8192 worlds
    env = registry.load(task, config=cfg, config_overrides={"impl": order.impl, "naconmax": contacts})
    rewards = sum(scale != 0 for scale in cfg.reward_config.scales.values())
    if order.impl == "warp" and hasattr(env.mjx_model.opt._impl, "warn_overflow"):
        env._mjx_model = env.mjx_model.tree_replace({"opt._impl.warn_overflow": 0})  # as for mjlab
        return env, rewards, [QUIET]
    return env, rewards, []


def time_brax(env: Any, params: dict[str, Any], layers: dict[str, Any], order: Order) -> tuple[list[float], int]:
    """Train with brax's PPO: seconds an iteration, one figure a round, and environment steps an iteration."""
    import jax
    from brax.training.agents.ppo import networks
    from brax.training.agents.ppo import train as ppo
    from mujoco_playground import wrapper

    if not hasattr(jax, "device_put_replicated"):  # jax 0.10 dropped it, brax 0.14.2 calls it once, at the start
        jax.device_put_replicated = lambda tree, devices: jax.tree.map(
            lambda x: jax.numpy.stack([x] * len(devices)), tree
        )
    rollouts = order.num_envs * max(1, params["batch_size"] * params["num_minibatches"] // order.num_envs)
    if rollouts % params["num_minibatches"]:
        raise ValueError(
            f"{rollouts} rollouts are not {params['num_minibatches']} minibatches; take a power of two for --num_envs"
        )
    steps = rollouts * params["unroll_length"]
    marks: list[float] = []  # ends of epochs: the first two compile, each further one is a round
    asked = {
        "num_envs": order.num_envs,
        "num_evals": 3 + ROUNDS,
        "num_timesteps": (2 + ROUNDS) * order.iterations * steps,
    }
    ppo.train(
        env,
        **{**params, **asked, "batch_size": rollouts // params["num_minibatches"], "num_resets_per_eval": 0},
        run_evals=False,
        network_factory=functools.partial(networks.make_ppo_networks, **layers),
        wrap_env_fn=wrapper.wrap_for_brax_training,
        progress_fn=lambda *_: marks.append(time.perf_counter()),  # called with the device idle
    )
    return [(end - start) / order.iterations for start, end in itertools.pairwise(marks[1:])], steps


MEASURE: dict[str, Callable[[Order], Measured]] = {
    "legged_mw": measure_legged_mw,
    "mjlab": measure_mjlab,
    "playground": measure_playground,
}


def physics_facts(model: Any, substeps: int) -> dict[str, str]:
    """What a control step asks of the physics, from a mujoco.MjModel."""
    colliding = int(((model.geom_contype | model.geom_conaffinity) != 0).sum())
    return {
        "control step": f"{substeps} x {1e3 * model.opt.timestep:g} ms",
        "solver": f"{model.opt.iterations} iterations, {model.opt.ls_iterations} in line search",
        "friction cone": ("pyramidal", "elliptic")[int(model.opt.cone)],
        "geoms that collide": f"{colliding}",
    }


def network(observation: int, hidden: Sequence[int]) -> str:
    return " ".join(map(str, (observation, *hidden)))


def cpu_name() -> str:
    return f"CPU, {os.cpu_count()} cores"


# ---- the parent: asks the children one by one, prints ------------------------------------------------------------------


class Row(NamedTuple):
    """A child's answer: either figures or, in words, why there are none."""

    framework: str
    num_envs: int
    measured: Measured | None = None
    versions: dict[str, str] | None = None
    failure: str = ""

    @property
    def speed(self) -> float:
        """Environment steps a second."""
        return self.measured.steps / statistics.median(self.measured.seconds) if self.measured else math.nan


def ask(python: str, order: Order, env: dict[str, str], timeout: float, verbose: bool) -> Row:
    """Run a child to its end, however it ends."""
    command = [python, str(Path(__file__).resolve()), "--child", json.dumps(order)]
    failed = functools.partial(Row, order.framework, order.num_envs)
    print(f"measuring {order.framework} at {order.num_envs} worlds ...", file=sys.stderr, flush=True)
    errors = None if verbose else subprocess.PIPE
    try:
        ended = subprocess.run(
            command, env=env, timeout=timeout, text=True, errors="replace", stdout=subprocess.PIPE, stderr=errors
        )
    except OSError as error:
        return failed(failure=f"failed: no interpreter {python} ({error.strerror})")
    except subprocess.TimeoutExpired:
        return failed(failure=f"failed: not done after {timeout:g} s (--timeout)")
    try:
        reply = json.loads(ended.stdout.strip().rpartition("\n")[2])
    except ValueError:
        lines = [line for line in (ended.stderr or "").splitlines() if line.strip()]
        how = f"exit status {ended.returncode}" if ended.returncode >= 0 else signal.Signals(-ended.returncode).name
        return failed(failure=f"failed: {lines[-1].strip() if lines else 'no word'} ({how})")
    if reply.get("missing"):
        return failed(failure=f"not installed: {FRAMEWORKS[order.framework].install}")
    if "error" in reply:
        return failed(failure=f"failed: {reply['error']}")
    return failed(measured=Measured(**reply["measured"]), versions=reply["versions"])


def child_environment(device: str) -> dict[str, str]:
    """A child sees the one device, whichever framework asks for it, and draws nothing: a machine without OpenGL will do."""
    base = {"MUJOCO_GL": "disable", **os.environ}
    if device == "cpu":
        return {**base, "CUDA_VISIBLE_DEVICES": "", "JAX_PLATFORMS": "cpu"}
    index = int(device.partition(":")[2])
    visible = [name for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name]
    return {**base, "CUDA_VISIBLE_DEVICES": visible[index] if visible else str(index), "JAX_PLATFORMS": "cuda"}


def results(rows: list[Row]) -> str:
    """The table: a line a framework and number of worlds."""
    columns = f"{'steps/s':>12}{'spread':>8}{'legged_mw / it':>16}{'[s] an iteration':>18}{'steps an iteration':>20}{'minibatch':>11}"
    lines = [f"{'worlds':>8}  {'framework':<12}{columns}"]
    ours = {row.num_envs: row.speed for row in rows if row.framework == "legged_mw" and row.measured}
    for row in rows:
        if m := row.measured:
            ratio = f"{ours[row.num_envs] / row.speed:.2f}" if row.num_envs in ours else "-"
            median, spread = statistics.median(m.seconds), max(m.seconds) / min(m.seconds) - 1
            text = f"{row.speed:>12,.0f}{spread:>8.1%}{ratio:>16}{median:>18.4f}{m.steps:>20,}{m.minibatch:>11,}"
        else:
            text = f"  {textwrap.shorten(row.failure, 160)}"
        lines.append(f"{row.num_envs:>8}  {row.framework:<12}{text}")
    return "\n".join(lines)


def conditions(rows: list[Row], ground: str) -> str:
    """What was measured under which conditions, a column a framework; then versions and what else differs."""
    last = {row.framework: row for row in rows if row.measured and row.versions}
    facts = {
        name: {"task": FRAMEWORKS[name].tasks[ground], **row.measured.facts}
        for name, row in last.items()
        if row.measured
    }
    keys = dict.fromkeys(key for column in facts.values() for key in column)
    lines = [f"{'':<20}" + "".join(f"{name:<34}" for name in facts)]
    lines += [f"{key:<20}" + "".join(f"{column.get(key, ''):<34}" for column in facts.values()) for key in keys]
    lines += [
        "",
        "Each task and learner is the framework's own default; only the number of worlds is set. Logging is off.",
    ]
    for name, row in last.items():
        lines.append(
            f"{name}: " + ", ".join(f"{package} {version}" for package, version in (row.versions or {}).items())
        )
        lines += [f"  - {note}" for note in (row.measured.notes if row.measured else [])]
    return "\n".join(line.rstrip() for line in lines)


def parse() -> argparse.Namespace:
    from legged_mw.utils.cli import Parser, positive

    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False)
    parser.add_argument(
        "--num_envs", type=positive, nargs="+", metavar="N", help="worlds (default: 4096 16384; on a CPU 16)"
    )
    parser.add_argument("--device", metavar="D", help="cuda:0, cpu, ... (default: the GPU if there is one)")
    parser.add_argument(
        "--ground", choices=("flat", "rough"), default="flat", help="which of each framework's tasks (default: flat)"
    )
    parser.add_argument(
        "--iterations", type=positive, metavar="N", help=f"in each of {ROUNDS} rounds (default: 10; on a CPU 1)"
    )
    parser.add_argument(
        "--only", nargs="+", choices=tuple(FRAMEWORKS), default=list(FRAMEWORKS), help="frameworks to measure"
    )
    for peer in ("mjlab", "playground"):
        parser.add_argument(
            f"--python-{peer}", default=sys.executable, metavar="PATH", help=f"interpreter of {peer}'s environment"
        )
    parser.add_argument(
        "--playground-impl", choices=("warp", "jax"), help="its physics (default: warp; on a CPU jax, the faster one)"
    )
    parser.add_argument(
        "--timeout", type=float, default=1800, metavar="S", help="seconds that one measurement may take"
    )
    return parser.parse_args()


def main() -> None:
    from legged_mw.utils.cli import one_line_errors, pick_device

    args = parse()
    with one_line_errors("compare.py"):
        device = pick_device(args.device)
    cpu = device == "cpu"
    sizes, iterations = args.num_envs or ([16] if cpu else [4096, 16384]), args.iterations or (1 if cpu else 10)
    pythons = {"legged_mw": sys.executable, "mjlab": args.python_mjlab, "playground": args.python_playground}
    environment, impl = child_environment(device), args.playground_impl or ("jax" if cpu else "warp")
    rows = []
    for num_envs in sizes:
        for name in (name for name in FRAMEWORKS if name in args.only):
            order = Order(name, num_envs, iterations, "cpu" if cpu else "cuda:0", impl, args.ground)
            rows.append(ask(pythons[name], order, environment, args.timeout, args.verbose))
    machines = ", ".join(dict.fromkeys(row.measured.machine for row in rows if row.measured)) or device
    print(
        f"Go1 on {args.ground} ground, training on {machines}: median of {ROUNDS} rounds of {iterations} iterations after a warm-up\n"
    )
    print(results(rows), end="\n\n")
    if any(row.measured for row in rows):
        print(conditions(rows, args.ground))
    sys.exit(any(row.framework == "legged_mw" and row.measured is None for row in rows))


if __name__ == "__main__":
    if sys.argv[1:2] == ["--child"]:
        child(Order(*json.loads(sys.argv[2])))
    else:
        main()
