"""A policy between two trainings, as a run: python benchmarks/mean_policy.py FROM/model_750.pt TO/model_2590.pt 0.7 logs/g1_12dof_flat/mean

Each weight is FROM + share * (TO - FROM). It works where TO began with FROM, or both with one policy (train.py --init).
The config and the critic are TO's. Without an optimizer the run can be played and exported, not resumed.
Source: Wortsman et al. 2022, Robust fine-tuning of zero-shot models.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path
from typing import Any

import torch

from legged_mw.rl.run_folder import load_tensors


def between(before: dict[str, Any], after: dict[str, Any], share: float) -> dict[str, Any]:
    """Floating-point tensors are mixed; what else a model holds, such as counts, is ``after``'s."""
    if {name: value.shape for name, value in before.items()} != {name: value.shape for name, value in after.items()}:
        raise SystemExit(
            "the two checkpoints hold networks of different sizes or names; the second must begin with the first, or both with one policy"
        )
    return {
        name: torch.lerp(before[name], value, share) if value.is_floating_point() else value
        for name, value in after.items()
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path, help="a checkpoint, model_*.pt")
    parser.add_argument("after", type=Path, help="a checkpoint of a training that began with it")
    parser.add_argument("share", type=float, help="0: before, 1: after")
    parser.add_argument("out", type=Path, help="the run's folder, which must not exist")
    args = parser.parse_args()
    before, after = (load_tensors(path, "cpu") for path in (args.before, args.after))
    actor = between(before["actor_state_dict"], after["actor_state_dict"], args.share)
    args.out.mkdir(parents=True)
    kept = {name: after[name] for name in ("iter", "infos", "critic_state_dict")}
    torch.save({**kept, "actor_state_dict": actor}, args.out / args.after.name)
    shutil.copy(args.after.with_name("config.yaml"), args.out)
    print(f"{args.out}: {args.share:g} of the way from {args.before} to {args.after}")


if __name__ == "__main__":
    main()
