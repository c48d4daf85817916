"""On a GPU: a fused step, shortened physics and the update's kernels do what is written, to rounding."""

from __future__ import annotations

import pytest
import torch
from learner import apart, collect, difference, make, parameters, share_experience
from test_gpu import BIPED, DEVICE, RANDOMIZED, ROUGH, make_env, roll_out, without_constraints
from test_ppo import VARIANTS, update

from legged_mw.fast import quick_start
from legged_mw.fast import skip_kernels as shortcuts
from legged_mw.fast.fused import Fused
from legged_mw.rl import networks
from legged_mw.rl.ppo import GraphedPPO

pytestmark = pytest.mark.gpu


def test_the_gpu_opens_beside_the_imports() -> None:
    assert quick_start.open_gpu(0) and not quick_start.open_gpu(torch.cuda.device_count())


@pytest.mark.parametrize(
    ("task", "settings"),
    [
        ("go1_flat", {}),
        ("go1_flat", RANDOMIZED),
        ("go1_flat", ROUGH),
        ("g1_flat", BIPED),
        ("go1_getup", {}),
        ("g1_track", {}),
    ],
    ids=["nominal", "randomized", "rough", "biped", "falls", "a motion"],
)
def test_a_fused_step_is_the_eager_one_to_rounding(
    task: str, settings: dict[str, object], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    overrides = {"perturbation__kick": True, "env__episode_length_s": 1.0, "termination__max_tilt": 10.0, **settings}
    eager, fused = (without_constraints(make_env(eager, task, **overrides)) for eager in (True, False))
    fused.fuse(steps=1_000_000)
    actions = torch.randn(40, 64, eager.num_actions, generator=torch.Generator().manual_seed(0)).to(DEVICE)
    expected, got = roll_out(eager, actions), roll_out(fused, actions)
    assert fused._graph.recorded and isinstance(fused._graph._fn, Fused)
    assert "not fused" not in capsys.readouterr().out
    for i, (a, b) in enumerate(zip(expected, got, strict=True)):
        off = ~torch.isclose(a.float(), b.float(), rtol=1e-3, atol=1e-3)
        assert off.float().mean() < 0.01, (
            f"step {i // 5}, output {i % 5}: {off.float().mean():.3f} of the values differ"
        )


@pytest.mark.parametrize("task", ["go1_flat", "g1_flat"])
def test_what_physics_leaves_out_is_missed_by_nothing(task: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Recorded, with and without: alike as two runs of the same are."""
    actions = 0.3 * torch.randn(
        8, 64, {"go1_flat": 12, "g1_flat": 29}[task], generator=torch.Generator().manual_seed(0)
    ).to(DEVICE)
    short = roll_out(make_env(False, task), actions)
    monkeypatch.setattr(shortcuts, "KNOWN", ())
    monkeypatch.setattr(shortcuts, "countable", lambda model: {})
    whole = roll_out(make_env(False, task), actions)
    # the second has an accelerometer and forces
    for group, (quantile, most) in enumerate([(0.99, 1e-3), (0.98, 1e-2)]):
        for a, b in zip(short[group::5], whole[group::5], strict=True):
            assert torch.quantile((a - b).abs(), quantile) < most


@pytest.mark.parametrize("settings", VARIANTS.values(), ids=VARIANTS.keys())
@pytest.mark.parametrize("half", [False, True], ids=["float32", "bfloat16"])
def test_kernels_of_the_update_are_torchs_own(settings: dict, half: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """One update beside one whose losses, ELUs, rate and Adam are torch's."""
    plain, fused = make(GraphedPPO, DEVICE, **settings), make(GraphedPPO, DEVICE, **settings)
    for alg in (plain, fused) if half else ():
        alg.learn_in_half()
    collect(plain, DEVICE)
    share_experience(plain, fused)
    before, got = parameters(plain), update(fused)
    monkeypatch.setattr(networks, "FUSED_ON", [])
    assert got == pytest.approx(update(plain), rel=0.05 if half else 1e-3, abs=2e-3 if half else 1e-5)
    if half:  # a product's last bits turn Adam's first steps of weights whose gradients are near 0, whatever the rate
        assert apart(before, plain, fused) < 0.15
    else:
        assert difference(parameters(plain), parameters(fused)) < 1e-4
