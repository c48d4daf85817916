"""A long run with resets, redraws, commands, kicks and one broken world a second: does anything grow, and do other worlds notice?

    python benchmarks/soak.py                                          # ten million world-steps on a CPU, about half an hour
    python benchmarks/soak.py --device cuda:0 --num_envs 4096 --steps 1e9 --seconds 300

The same worlds run twice from one seed: once with worlds that break (a state or an action that is not finite, or too fast), once
without. Only worlds of the first half break. Memory, open files and the device's memory must stay as they are after the first
fifth, each break must be counted once and end one episode, and the worlds of the second half must not notice: on a CPU their
observations, rewards and resets are the same bit for bit, on a GPU finite, and their mean reward within five standard errors.
The exit code is 1 if one of these fails.

Worlds share one stream of random numbers, and each draws whether it needs one or not. Only a CPU's step leaves the draws of a reset
out where no world ends; here it does not, so that a break moves nobody else's draws. (A recorded step never does.)
"""

from __future__ import annotations

import argparse
import gc
import json
import math
import os
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import torch

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from legged_mw.utils.cli import pick_device
from legged_mw.utils.task import load_task

BUSY = {  # everything that happens to a world, often
    "perturbation.kick": True,
    "perturbation.push": True,
    "perturbation.push_interval_s": 1.0,
    "domain_rand.enable": True,
    "commands.resampling_time": 0.5,
    "env.episode_length_s": 4.0,
}
GROWS = 16 << 20  # [bytes] of memory, or a fiftieth, that is no leak
RESTART = 97  # steps between two resets from outside
KINDS = ("position", "speed", "too fast", "action")  # of a break, in turn


class Held(NamedTuple):
    """What a process holds."""

    memory: int  # [bytes] of this process
    files: int
    device: int  # [bytes] taken on the GPU, by all
    pool: int  # [bytes] of torch's own allocator, recorded graphs included

    @classmethod
    def now(cls, device: str) -> Held:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        free, all_ = torch.cuda.mem_get_info(device) if device != "cpu" else (0, 0)
        pool = torch.cuda.memory_reserved(device) if device != "cpu" else 0
        return cls(pages * os.sysconf("SC_PAGE_SIZE"), len(os.listdir("/proc/self/fd")), all_ - free, pool)

    def grown(self, before: Held) -> list[str]:
        """What is more than it was, in words."""
        most = {name: max(GROWS, getattr(before, name) // 50) if name != "files" else 0 for name in self._fields}
        return [
            f"{name} grew from {getattr(before, name)} to {now}"
            for name, now in self._asdict().items()
            if now - getattr(before, name) > most[name]
        ]


def who_ask() -> list[Any]:
    """Modules of environments that ask on a CPU whether there is a world to draw for."""
    return [
        each for name, each in sys.modules.items() if name.startswith("legged_mw.envs") and hasattr(each, "maybe_any")
    ]


class Soak:
    """One run."""

    def __init__(self, args: argparse.Namespace, breaks: bool) -> None:
        task = load_task(args.task)
        for path, value in {"env.num_envs": args.num_envs, "sim.engine": args.engine, **BUSY}.items():
            task.set(path, value)
        torch.manual_seed(args.seed)
        self.env = task.env_class(task.cfg, args.device)
        self.device, self.breaks, self.count = args.device, breaks, args.num_envs
        self.every = round(1.0 / self.env.dt)  # steps between two breaks
        self.random = torch.Generator(args.device).manual_seed(args.seed)
        self.digest = torch.zeros(args.num_envs, dtype=torch.long, device=args.device)  # of all that a world handed out
        self.reward = torch.zeros(args.num_envs, dtype=torch.double, device=args.device)
        self.totals = torch.zeros(5, dtype=torch.long, device=args.device)  # ended, broken, fell, timed out, not finite
        self.broke = self.done = 0

    def step(self) -> None:
        """Draw actions, maybe break a world, step, add up."""
        env, draw = self.env, {"generator": self.random, "device": self.device}
        actions = 0.3 * torch.randn(self.count, env.num_actions, **draw)
        again = torch.rand(self.count, **draw) < 0.1
        if self.done % RESTART == RESTART - 1:
            env.restart(again)
        if self.breaks and self.done % self.every == self.every - 1:
            self._break(actions)
        seen, reward, ended, _ = env.step(actions)
        parts = [*seen.values(), reward[:, None], ended[:, None].float()]
        bits = torch.cat(parts, dim=1).contiguous().view(torch.int32).long()
        self.digest.mul_(6364136223846793005).add_(
            (bits * torch.arange(1, 2 * bits.shape[1], 2, device=self.device)).sum(dim=1)
        )
        self.reward += reward
        wild = (~torch.cat(parts, dim=1).isfinite()).sum()
        self.totals += torch.stack([ended.sum(), env.broken.sum(), env.fell.sum(), env.time_out_buf.sum(), wild])
        self.done += 1

    def _break(self, actions: torch.Tensor) -> None:
        """One world of the first half, each in turn, and each kind of break."""
        world, kind, sim = self.broke % (self.count // 2), KINDS[self.broke % len(KINDS)], self.env.sim
        if kind == "position":
            sim.qpos[world, 2] = math.nan
        elif kind == "speed":
            sim.qvel[world, -1] = math.nan
        elif kind == "too fast":
            sim.qvel[world, -1] = 1e20
        else:
            actions[world, 0] = math.nan
        self.broke += 1

    def run(self, steps: int, seconds: float) -> tuple[Held, Held, float]:
        """Until ``steps`` or ``seconds`` are over. What it holds after a fifth and at the end, and world-steps a second."""
        start, said, before = time.monotonic(), 0, None
        while self.done < steps and (seconds is math.inf or self.done % 50 or time.monotonic() - start < seconds):
            self.step()
            part = max(self.done / steps, (time.monotonic() - start) / seconds) if self.done % 50 == 0 else said / 10
            if part * 10 >= said + 1:
                said = int(part * 10)
                held, rate = Held.now(self.device), self.done * self.count / (time.monotonic() - start)
                print(
                    f"  {self.done * self.count:,} world-steps, {rate:,.0f} a second, {self.broke} breaks, {held}",
                    flush=True,
                )
                before = before or (held if part >= 0.2 else None)
        gc.collect()
        end = Held.now(self.device)
        return before or end, end, self.done * self.count / (time.monotonic() - start)

    def faults(self, before: Held, end: Held) -> list[str]:
        """What is not as it must be, in words."""
        ended, broken, fell, late, wild = self.totals.tolist()
        wrong = end.grown(before)
        if ended != broken + fell + late:
            wrong.append(f"{ended} episodes ended, but {broken} broke, {fell} fell and {late} timed out")
        if broken != self.broke:
            wrong.append(f"{self.broke} worlds were broken, {broken} counted")
        return [*wrong, f"{wild} values handed out are not finite"] if wild else wrong


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="go1_flat")
    parser.add_argument("--num_envs", type=int, default=1024)
    parser.add_argument("--steps", type=float, default=1e7, help="world-steps of the run with breaks")
    parser.add_argument("--seconds", type=float, default=math.inf, help="at most, for both runs together")
    parser.add_argument("--device")
    parser.add_argument("--engine", default="auto")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    args.device = pick_device(args.device)
    if args.device == "cpu":
        torch.set_num_threads(1)
    load_task(args.task)
    for module in who_ask():
        vars(module)["maybe_any"] = lambda _: True
    broken, steps = Soak(args, breaks=True), math.ceil(args.steps / args.num_envs)
    before, end, rate = broken.run(steps, args.seconds / 2)
    wrong = broken.faults(before, end)
    print("and without breaks", flush=True)
    whole = Soak(args, breaks=False)
    wrong += whole.faults(*whole.run(broken.done, math.inf)[:2])
    others = slice(args.num_envs // 2, None)
    same = broken.digest[others] == whole.digest[others]
    means = [(soak.reward[others] / soak.done) for soak in (broken, whole)]
    spread = math.sqrt(sum(float(mean.var()) / len(mean) for mean in means)) or math.inf
    away = abs(float(means[0].mean() - means[1].mean())) / spread
    if args.device == "cpu" and not bool(same.all()):
        wrong.append(
            f"{int((~same).sum())} of {len(same)} worlds that never broke are not what they were without breaks"
        )
    if not away < 5.0:
        wrong.append(f"the mean reward of worlds that never broke is {away:.1f} standard errors away")
    figures: dict[str, Any] = {"world_steps": broken.done * args.num_envs, "rate": round(rate), "breaks": broken.broke}
    figures |= {
        "ended, broken, fell, timed out, not finite": broken.totals.tolist(),
        "after a fifth": before._asdict(),
        "end": end._asdict(),
    }
    figures |= {
        "other worlds bit-equal": f"{int(same.sum())} of {len(same)}",
        "standard errors": round(away, 3),
        "wrong": wrong,
    }
    print(json.dumps(figures, indent=1))
    raise SystemExit(bool(wrong))


if __name__ == "__main__":
    main()
