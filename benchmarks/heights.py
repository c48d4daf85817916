"""The exam's rough part on one kind of ground and many robots: how high may a step be that so large a share of them crosses?

    python benchmarks/heights.py resources/policies/go2_rough --heights 15 19.5 --engine mujoco
    python benchmarks/heights.py logs/go1_rough_student/<time> --kind stairs_down --robots 20

Ten robots a height, as the exam has, leave an uncertainty of 0.3 where half of them cross; a hundred leave 0.1.
"""

from __future__ import annotations

import argparse

from legged_mw import ROOT
from legged_mw.eval import rough
from legged_mw.eval.walking import LEVELS
from legged_mw.rl.policies import find_trained, load_policy
from legged_mw.sim.terrain import MEASURES, measure
from legged_mw.utils.cli import one_line_errors, pick_device, seed_everything


def shares(
    asked: str, kind: str, low: float, high: float, repeats: int, engine: str, device: str
) -> tuple[list[float], list[float]]:
    """What a policy is asked at ten heights, from ``low`` to ``high`` in the kind's unit, and the share of robots that cross."""
    trained = find_trained(asked, ROOT / "logs", "policy")
    task, (first, last) = trained.task, (measure(kind, difficulty)[1] for difficulty in (0.0, 1.0))
    rough.prepare(task)
    task.set("terrain.terrain_proportions", {kind: 1.0})
    task.set("terrain.difficulty", [(height - first) / (last - first) for height in (low, high)])
    task.set("sim.engine", engine)
    rough.make_room(task, repeats)
    seed_everything(1)
    env = task.env_class(task.cfg, device)
    policy = load_policy(trained.source.checkpoint, env, task.train, device)
    heights = [low + (high - low) * level / (LEVELS - 1) for level in range(LEVELS)]
    return heights, rough.run_crossing(env, policy)["kinds"][kind]["crossed"]


@one_line_errors()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policy", help="a run folder, a checkpoint or an export")
    parser.add_argument("--kind", choices=[*MEASURES], default="stairs_up")
    parser.add_argument(
        "--heights", type=float, nargs=2, default=[15.0, 19.5], metavar=("LOW", "HIGH"), help="in the kind's unit"
    )
    parser.add_argument("--robots", type=int, default=100, help="at each of ten heights; an even number")
    parser.add_argument("--engine", choices=["auto", "mujoco", "mujoco_warp"], default="auto")
    parser.add_argument("--device")
    args = parser.parse_args()
    (low, high), repeats = args.heights, max(args.robots // rough.TILES, 1)
    heights, crossed = shares(args.policy, args.kind, low, high, repeats, args.engine, pick_device(args.device))
    print(f"{MEASURES[args.kind][0]:<14}" + "".join(f"{height:>7.4g}" for height in heights))
    print(f"{'crossed':<14}" + "".join(f"{share:>7.2f}" for share in crossed))


if __name__ == "__main__":
    main()
