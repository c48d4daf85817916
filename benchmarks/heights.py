"""The exam's rough part on ground that is asked for: what share of the robots cross it, how high, how slippery, which way?

    python benchmarks/heights.py resources/policies/go2_rough --engine mujoco       # stairs up, 15 to 19.5 cm
    python benchmarks/heights.py go2_rough --ground stairs_up 13 20 --ground obstacles 24 --friction 0.3 1 --backwards

Ten robots a height, as the exam has, leave an uncertainty of 0.3 where half of them cross; a hundred leave 0.1.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import numpy as np

from legged_mw import ROOT
from legged_mw.eval import rough
from legged_mw.rl.policies import find_trained, load_policy
from legged_mw.sim.terrain import KINDS, LEVEL, MEASURES, Grid, Heights, add_kind, measure
from legged_mw.utils.cli import one_line_errors, pick_device, seed_everything
from legged_mw.utils.errors import UserError, unknown

STAIRS = ["stairs_up", *(f"{15 + 0.5 * i:g}" for i in range(10))]


def add_ground(kind: str, *heights: str) -> list[str]:
    """Kinds of ground that are ``kind`` at each of ``heights``, in its unit, whatever the level: their names."""
    if kind not in MEASURES:
        raise UserError(f"--ground: {unknown('kind of terrain', kind, MEASURES, 'those that have a measure')}")
    (what, low, unit), high = measure(kind, 0.0), measure(kind, 1.0)[1]
    names = [f"{kind}, {what} {height} {unit}" for height in heights]
    for name, height in zip(names, heights, strict=True):
        hard = (_number(height, kind) - low) / (high - low)

        def ground(grid: Grid, difficulty: float, rng: np.random.Generator, hard: float = hard) -> Heights:
            return KINDS[kind](grid, hard, rng)

        ground.__name__ = name
        add_kind(level=kind in LEVEL)(ground)
    return names


def _number(text: str, kind: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise UserError(f"--ground {kind}: '{text}' is no height; write numbers after the kind") from None


def crossed(
    asked: str, grounds: Sequence[str], friction: float, speed: float, repeats: int, engine: str, device: str
) -> list[float]:
    """The share of robots of the policy ``asked`` that cross each of ``grounds`` at ``speed`` ahead [m/s]."""
    trained = find_trained(asked, ROOT / "logs", "policy")
    task = trained.task
    rough.prepare(task)
    task.set("terrain.terrain_proportions", dict.fromkeys(grounds, 1.0))
    task.set("terrain.num_rows", 1)
    task.set("terrain.friction", friction)
    task.set("sim.engine", engine)
    rough.make_room(task, repeats)
    seed_everything(1)
    env = task.env_class(task.cfg, device)
    policy = load_policy(trained.source.checkpoint, env, task.train, device)
    kinds = rough.run_crossing(env, policy, speed)["kinds"]
    return [kinds[ground]["crossed"][0] for ground in grounds]


@one_line_errors()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policy", help="a run folder, a checkpoint or an export")
    parser.add_argument("--ground", nargs="+", action="append", metavar=("KIND", "HEIGHT"), help="in the kind's unit")
    parser.add_argument("--friction", type=float, nargs="+", default=[0.6], help="of the ground; the exam's is 0.6")
    parser.add_argument("--backwards", action="store_true", help="ask for both ways, not only ahead")
    parser.add_argument("--robots", type=int, default=100, help="at each height; an even number")
    parser.add_argument("--engine", choices=["auto", "mujoco", "mujoco_warp"], default="auto")
    parser.add_argument("--device")
    args = parser.parse_args()
    grounds = [name for asked in args.ground or [STAIRS] for name in add_ground(*asked)]
    repeats, device = max(args.robots // rough.TILES, 1), pick_device(args.device)
    columns = {}
    for way, speed in [("ahead", rough.SPEED), *([("back", -rough.SPEED)] if args.backwards else [])]:
        for friction in args.friction:
            shares = crossed(args.policy, grounds, friction, speed, repeats, args.engine, device)
            columns[f"{friction:g} {way}"] = shares
    print(
        f"share of {rough.TILES * repeats} robots that cross a tile at {rough.SPEED:g} m/s within {rough.SECONDS:g} s"
    )
    print(f"{'friction, way':<32}" + "".join(f"{head:>11}" for head in columns))
    for i, ground in enumerate(grounds):
        print(f"{ground:<32}" + "".join(f"{shares[i]:>11.2f}" for shares in columns.values()))


if __name__ == "__main__":
    main()
