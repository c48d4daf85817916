"""Motors: their torque-speed curve, laws of torque, networks, a law in code, delays within a control step, and what is refused."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from program import run, trained
from torch import Tensor, nn
from worlds import QUIET, make_env

from legged_mw.check.describe import describe
from legged_mw.check.recordable import recordable
from legged_mw.deploy.contract import ContractError, read_contract
from legged_mw.deploy.simulated import Fleet
from legged_mw.envs.domain_rand import KINDS
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.envs.motors import SubstepDelay
from legged_mw.envs.robot_task_config import RobotTaskCfg
from legged_mw.envs.snapshot import put_snapshot, take_snapshot
from legged_mw.export import exporter as exporting
from legged_mw.export.exporter import export
from legged_mw.rl.runner import make_runner
from legged_mw.robot import actuator_net
from legged_mw.utils.config import load_yaml, save_yaml
from legged_mw.utils.files import digest
from legged_mw.utils.motor_network import ACTIVATIONS, MotorNetwork, read_network
from legged_mw.utils.task import LoadedTask, load_task

ENGINES = ["mujoco", "mujoco_warp"]
# 20 N m, 25 rad/s
CURVE = {"control.stall_torque": {"": 10.0}, "control.no_load_speed": {"": 50.0}, "control.gear": {"": 2.0}}
DC: dict[str, Any] = {**QUIET, **CURVE, "control.actuator": "dc_motor"}
STILL = {f"init_state.{name}": 0.0 for name in ("lin_vel_range", "ang_vel_range", "yaw_range", "pos_xy_range")}


def walk(env: LeggedRobot, steps: int, guarded: bool = False) -> Tensor:
    """States after each of ``steps`` random actions (steps, N, nq); ``guarded``: as on a GPU, nothing may ask the host."""
    dice, states = torch.Generator().manual_seed(0), []
    actions = [0.3 * torch.randn(env.num_envs, env.num_actions, generator=dice) for _ in range(steps)]
    with recordable() if guarded else nullcontext():
        for action in actions:
            env.step(action)
            states.append(env.sim.qpos.clone())
    return torch.stack(states)


# ---- DC motors


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize(
    ("more", "kp", "kd"),
    [({}, 1000.0, 0.5), ({"control.action_origin": "speed"}, 0.0, 4.0), ({"control.actuator": "torque"}, 0.0, 0.0)],
    ids=["by an angle", "by a speed", "by a torque"],
)
def test_the_torque_speed_curve(engine: str, more: dict[str, Any], kp: float, kd: float) -> None:
    """Figures by hand: 20 N m at rest, none at 25 rad/s, and never more than 15 N m."""
    gains = {"control.stiffness": {"": kp or 35.0}, "control.damping": {"": kd}, "asset.effort": {"": 15.0}}
    env = make_env(1, {**DC, **STILL, **gains, **more, "sim.engine": engine})
    speeds = env.sim.actuator_velocity()
    for speed, asked, given in [
        (0.0, 12.0, 12.0),  # within the curve
        (0.0, 100.0, 15.0),  # the force limit
        (10.0, 100.0, 12.0),  # 20 (1 - 10 / 25)
        (10.0, -100.0, -15.0),  # braking, the curve would allow 28
        (25.0, 100.0, 0.0),  # as fast as it turns by itself
        (30.0, 100.0, -4.0),  # faster: it brakes
        (-20.0, -100.0, -4.0),  # the other way round
    ]:
        env.reset()
        env.dof_vel[0, 4] = speed
        by_angle = env.dof_pos[0, 4] + (asked + kd * speed) / kp if kp else None
        env.sim.ctrl[0, 4] = by_angle if by_angle is not None else asked / kd + speed if kd else asked
        env.sim.step()
        assert env.torques[0, 4].item() == pytest.approx(given, abs=2e-3), (speed, asked)
        assert speeds[0, 4].item() == pytest.approx(speed, abs=1e-5)


def test_far_from_its_limits_a_dc_motor_is_a_servo() -> None:
    strong = {"control.stall_torque": {"": 1e4}, "control.no_load_speed": {"": 1e4}, "asset.effort": {"": 1e3}}
    servo, motor = make_env(4, {**QUIET, "asset.effort": {"": 1e3}}), make_env(4, {**DC, **strong})
    torch.testing.assert_close(walk(motor, 5), walk(servo, 5), atol=2e-4, rtol=0)
    assert motor.robot.physics.dof_damping[6:].max() == 0.0 and servo.robot.physics.dof_damping[6:].min() == 0.5


@pytest.mark.parametrize("engine", ENGINES)
def test_what_is_drawn_of_a_dc_motor(engine: str) -> None:
    names = ("stiffness", "damping", "strength", "stall_torque", "no_load_speed")
    ranges = {f"domain_rand.{name}": [0.5, 1.5] for name in names}
    nothing = {
        f"domain_rand.{name}": [] for name in ("link_mass", "base_mass", "base_com", "armature", "encoder_offset")
    }
    env = make_env(3, {**DC, **nothing, **ranges, "domain_rand.enable": True, "sim.engine": engine})
    drawn, gains = env.domain_rand.values, env.sim.field("actuator_gainprm")
    torch.testing.assert_close(gains[:, :, 1], 1.0 / (25.0 * drawn["no_load_speed"]))
    torch.testing.assert_close(gains[:, :, 1] / gains[:, :, 0], 20.0 * drawn["stall_torque"])
    torch.testing.assert_close(gains[:, :, 4], 35.0 * drawn["stiffness"])
    torch.testing.assert_close(gains[:, :, 6], 0.5 * drawn["damping"])
    assert env.sim.field("actuator_forcerange")[0, 0, 1].item() == pytest.approx(
        23.7 * drawn["strength"][0, 0].item(), rel=1e-6
    )
    before = gains.clone()
    env.reset_envs(torch.tensor([True, False, False]))
    assert (gains != before).any(dim=2).any(dim=1).tolist() == [True, False, False]


def test_what_a_law_does_not_have_is_not_drawn() -> None:
    ranges = {f"domain_rand.{name}": [0.5, 1.5] for name in ("stiffness", "damping", "strength", "stall_torque")}
    for law, lacks in (("servo", {"stall_torque"}), ("torque", {"stiffness", "damping"})):
        env = make_env(2, {**DC, **ranges, "domain_rand.enable": True, "control.actuator": law})
        assert {name.removeprefix("domain_rand.") for name in ranges} - {*env.domain_rand.values} == lacks


# ---- delays


def test_a_delay_of_7_ms_by_hand() -> None:
    """In steps of 4 ms the nearest is 8 ms: the first two of five steps still use what was sent before."""
    cfg = RobotTaskCfg()
    cfg.domain_rand.delay_ms = [0.0, 32.0]
    delay = SubstepDelay(cfg, torch.tensor([[0.0], [8.0], [32.0]]), 1)
    delay.restart(torch.ones(3, dtype=torch.bool), torch.full((3, 1), -1.0))
    arriving = []
    for sent in (0.0, 1.0, 2.0):
        delay(torch.full((3, 1), sent))
        arriving.append(delay.arriving[:, :, 0].T.tolist())
    assert arriving[0] == [[0] * 5, [-1, -1, 0, 0, 0], [-1] * 5]
    assert arriving[1] == [[1] * 5, [0, 0, 1, 1, 1], [-1, -1, -1, 0, 0]]
    assert arriving[2] == [[2] * 5, [1, 1, 2, 2, 2], [0, 0, 0, 1, 1]]
    delay.restart(torch.tensor([False, True, False]), torch.full((3, 1), 9.0))
    delay(torch.full((3, 1), 3.0))
    assert delay.arriving[:, :, 0].T.tolist() == [[3] * 5, [9, 9, 3, 3, 3], [1, 1, 1, 2, 2]]


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("law", ["servo", "dc_motor"])
def test_physics_hears_a_delay_of_7_ms(engine: str, law: str) -> None:
    nothing = {
        f"domain_rand.{name}": []
        for name in ("link_mass", "base_mass", "base_com", "armature", "friction", "frictionloss")
    }
    late = {**DC, **STILL, **nothing, "control.actuator": law, "domain_rand.enable": True, "sim.engine": engine}
    env = make_env(2, {**late, "domain_rand.encoder_offset": [-0.05, 0.05], "domain_rand.delay_ms": [7.0, 7.0]})
    twin = make_env(2, {**late, "domain_rand.encoder_offset": [], "domain_rand.enable": False})
    assert env.domain_rand.values["delay_ms"].tolist() == [[8.0], [8.0]]
    twin.sim.qpos.copy_(env.sim.qpos)
    offset, target = env.domain_rand.values["encoder_offset"], env.default_dof_pos
    for _ in range(3):
        action = 0.2 * torch.randn(2, 12)
        twin.sim.ctrl.copy_(target - offset)
        twin.sim.step(2)
        target = env.default_dof_pos + 0.5 * action
        twin.sim.ctrl.copy_(target - offset)
        twin.sim.step(3)
        env.step(action)
        torch.testing.assert_close(env.sim.qpos, twin.sim.qpos, atol=2e-5, rtol=0)


@pytest.mark.parametrize("origin", ["default", "joints", "targets"])
def test_a_delay_of_a_control_step_is_one_of_as_many_milliseconds(origin: str) -> None:
    """Also where a target is made from measured angles: they are those that the policy acted on."""
    drawn = {f"domain_rand.{name}": [] for name in KINDS} | {"domain_rand.encoder_offset": [0.02, 0.02]}
    same = {**QUIET, **STILL, **drawn, "domain_rand.enable": True}
    same |= {"control.action_origin": origin, "control.action_scale": 0.1}
    env = make_env(2, {**same, "domain_rand.action_delay": [1, 1]})
    twin = make_env(2, {**same, "domain_rand.delay_ms": [1e3 * env.dt, 1e3 * env.dt]})
    twin.sim.qpos.copy_(env.sim.qpos)
    for _ in range(5):
        action = torch.randn(2, 12)
        env.step(action)
        twin.step(action)
        torch.testing.assert_close(env.sim.qpos, twin.sim.qpos, atol=2e-5, rtol=0)
    assert (env.dof_offset.abs() > 0.02).any()


def test_delays_are_rounded_to_the_nearest_simulation_step_a_half_up() -> None:
    for span, wanted in (([1.9, 1.9], {0.0}), ([2.0, 2.0], {4.0}), ([6.0, 6.0], {8.0}), ([0.0, 8.0], {0.0, 4.0, 8.0})):
        env = make_env(200, {**QUIET, "domain_rand.enable": True, "domain_rand.delay_ms": span})
        assert {*env.domain_rand.values["delay_ms"].flatten().tolist()} == wanted


def test_check_tells_what_a_delay_is_rounded_to() -> None:
    env = make_env(2, {**DC, "domain_rand.enable": True, "domain_rand.delay_ms": [3.0, 7.0]})
    said = "motors: dc_motor, delayed by 4 to 8 ms: domain_rand.delay_ms [3, 7] to the nearest simulation step, of 4 ms"
    assert said in describe(env, load_task("go1_flat"))


def test_check_tells_the_reach_of_each_action() -> None:
    reach = {"normalization.clip_actions": 2.0, "control.action_scale": {"": 0.5, "calf": 0.25}}
    for law, unit in (("servo", "rad"), ("torque", "N m")):
        lines = describe(make_env(2, {**reach, "control.actuator": law}), load_task("go1_flat")).splitlines()
        start = next(n for n, line in enumerate(lines) if line.startswith("joints:"))
        assert lines[start].endswith(f"[{unit}]")
        assert [line.split()[-1] for line in lines[start + 1 : start + 4]] == ["+-1", "+-1", "+-0.5"]


# ---- torques and a law in code


@pytest.mark.parametrize("engine", ENGINES)
def test_an_action_that_is_a_torque(engine: str) -> None:
    env = make_env(
        2,
        {**QUIET, "control.actuator": "torque", "control.action_scale": {"": 4.0, "calf": 100.0}, "sim.engine": engine},
    )
    env.step(torch.full((2, 12), 0.5))
    assert env.torques[0, :3].tolist() == pytest.approx([2.0, 2.0, 35.55]), "scaled, and held to the force limit"
    assert env.robot.physics.dof_damping[6:].max() == 0.0
    env.reset()
    assert not env.sim.ctrl.any()


class Springs(LeggedRobot):
    """legged_gym's law of its own accord, counted."""

    calls = 0

    def _compute_torques(self, actions: Tensor) -> Tensor:
        Springs.calls += 1
        return super()._compute_torques(actions)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_law_in_code_runs_in_every_simulation_step(engine: str) -> None:
    env, servo = (make_env(3, {**QUIET, "sim.engine": engine}, env_class=kind) for kind in (Springs, LeggedRobot))
    before = Springs.calls
    ours = walk(env, 5, guarded=engine == "mujoco_warp")
    assert Springs.calls - before == 25
    torch.testing.assert_close(ours, walk(servo, 5), atol=5e-4, rtol=0)


def test_a_law_in_code_has_gains_delays_and_a_curve() -> None:
    nothing = {
        f"domain_rand.{name}": [] for name in ("link_mass", "base_mass", "base_com", "armature", "encoder_offset")
    }
    drawn = {"domain_rand.stiffness": [0.5, 1.5], "domain_rand.delay_ms": [8.0, 8.0], "domain_rand.enable": True}
    env = make_env(2, {**DC, **nothing, **drawn, "control.actuator": "servo"}, env_class=Springs)
    assert torch.equal(env.p_gains, 35.0 * env.domain_rand.values["stiffness"]) and env.d_gains.tolist() == [0.5] * 12
    assert (env.robot.tables["stall_torque"], env.robot.tables["no_load_speed"]) == ([20.0] * 12, [25.0] * 12)
    arrived: list[Tensor] = []
    env.actuators._compute = lambda actions: arrived.append(actions.clone()) or torch.zeros_like(actions)
    env.step(torch.full((2, 12), 0.5))
    assert [x[0, 0].item() for x in arrived] == [0.0, 0.0, 0.5, 0.5, 0.5]


# ---- networks


def mlp(
    activation: str = "softsign", frames: tuple[int, ...] = (0, 1, 2), **more: Any
) -> tuple[nn.Module, MotorNetwork]:
    """A network as torch has it, and as ours."""
    torch.manual_seed(1)
    layers = [nn.Linear(2 * len(frames), 32), nn.Linear(32, 30), nn.Linear(30, 1)]
    kinds = {"elu": nn.ELU, "relu": nn.ReLU, "softsign": nn.Softsign, "tanh": nn.Tanh}
    module = nn.Sequential(layers[0], kinds[activation](), layers[1], kinds[activation](), layers[2])
    return module, MotorNetwork(
        [], [(x.weight.detach().numpy(), x.bias.detach().numpy()) for x in layers], activation, frames, **more
    )


def save(network: MotorNetwork, folder: Path) -> str:
    np.savez(folder / "net.npz", **network.to_arrays())
    return str(folder / "net.npz")


def tried(file: str, engine: str, steps: int = 6) -> tuple[list[Tensor], list[Tensor], list[Tensor]]:
    """Errors, speeds and torques (2, 12) of a network in an environment, at random joint states; world 1 is reset after the third."""
    env = make_env(2, {**QUIET, "control.actuator": "network", "control.network": file, "sim.engine": engine})
    errors, speeds, torques = [], [], []
    network = env.actuators._network
    assert network
    for step in range(steps):
        targets = torch.randn(2, 12)
        env.dof_pos.copy_(torch.randn(2, 12))
        env.dof_vel.copy_(3.0 * torch.randn(2, 12))
        torques.append(network(targets))
        errors.append(targets - env.dof_pos)
        speeds.append(env.dof_vel.clone())
        if step == 2:
            network.reset(torch.tensor([False, True]))
    return errors, speeds, torques


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize(("activation", "in_turns"), [(name, False) for name in ACTIVATIONS] + [("elu", True)])
def test_a_network_is_what_its_training_library_makes_of_it(
    activation: str, in_turns: bool, engine: str, tmp_path: Path
) -> None:
    scales = {"error_scale": -1.0, "speed_scale": 0.2, "torque_scale": 20.0}
    module, network = mlp(activation, (0, 1, 3), in_turns=in_turns, **scales)
    errors, speeds, torques = tried(save(network, tmp_path), engine)
    for step in range(len(torques)):
        for world in (0, 1):
            first = 3 if world == 1 and step > 2 else 0
            past = [
                [(x[step - age][world] if step - age >= first else torch.zeros(12)) for age in (0, 1, 3)]
                for x in (errors, speeds)
            ]
            # (D, frames, 2)
            rows = torch.stack([torch.stack(past[0], dim=1) * -1.0, torch.stack(past[1], dim=1) * 0.2], dim=2)
            wanted = 20.0 * module(rows.reshape(12, 6) if in_turns else rows.transpose(1, 2).reshape(12, 6))[:, 0]
            torch.testing.assert_close(torques[step][world], wanted.detach(), atol=2e-5, rtol=1e-5)


@pytest.mark.parametrize("engine", ENGINES)
def test_an_lstm_is_what_torch_makes_of_it(engine: str, tmp_path: Path) -> None:
    torch.manual_seed(2)
    lstm, head = nn.LSTM(2, 8, 2), nn.Linear(8, 1)
    layers = [
        [getattr(lstm, f"{name}_l{i}").detach().numpy() for name in ("weight_ih", "weight_hh", "bias_ih", "bias_hh")]
        for i in (0, 1)
    ]
    network = MotorNetwork(
        [(a, b, c, d) for a, b, c, d in layers],
        [(head.weight.detach().numpy(), head.bias.detach().numpy())],
        "elu",
        (0,),
    )
    errors, speeds, torques = tried(save(network, tmp_path), engine)
    rows = torch.stack([torch.stack(errors), torch.stack(speeds)], dim=-1)  # (T, N, D, 2)
    for world, spans in ((0, [slice(0, 6)]), (1, [slice(0, 3), slice(3, 6)])):
        for span in spans:
            wanted = head(lstm(rows[span, world])[0])[..., 0]
            torch.testing.assert_close(torch.stack(torques)[span, world], wanted.detach(), atol=2e-6, rtol=1e-5)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_network_in_the_step_hears_delayed_targets_by_its_encoders(engine: str, tmp_path: Path) -> None:
    """A network that is a spring: torque = 35 (target - angle)."""
    spring = MotorNetwork(
        [], [(np.array([[35.0, -0.5]], dtype=np.float32), np.zeros(1, dtype=np.float32))], "relu", (0,)
    )
    nothing = {
        f"domain_rand.{name}": []
        for name in ("link_mass", "base_mass", "base_com", "armature", "friction", "frictionloss")
    }
    late = {
        **QUIET,
        **STILL,
        **nothing,
        "domain_rand.enable": True,
        "domain_rand.delay_ms": [7.0, 7.0],
        "sim.engine": engine,
    }
    network, servo = (
        make_env(3, late | more)
        for more in ({"control.actuator": "network", "control.network": save(spring, tmp_path)}, {})
    )
    assert torch.equal(network.actuators.encoder_offset, servo.actuators.encoder_offset)  # type: ignore[arg-type]
    torch.testing.assert_close(walk(network, 5, guarded=engine == "mujoco_warp"), walk(servo, 5), atol=5e-4, rtol=0)


@pytest.mark.parametrize("engine", ENGINES)
def test_what_a_network_remembers_is_kept(engine: str, tmp_path: Path) -> None:
    """An environment goes on from the worlds of another, bit for bit."""
    fields = {**QUIET, "control.actuator": "network", "control.network": save(mlp(torque_scale=20.0)[1], tmp_path)}
    env, other = (make_env(2, {**fields, "sim.engine": engine}) for _ in range(2))
    walk(env, 3)
    assert put_snapshot(other, take_snapshot(env)) == ""
    assert torch.equal(walk(env, 3), walk(other, 3))


class Anydrive(nn.Module):
    """An actuator network as legged_gym's: (joints, 1, 2) and the memory of two layers in, torques and memory out."""

    def __init__(self) -> None:
        super().__init__()
        self.lstm, self.linear = nn.LSTM(2, 8, 2, batch_first=True), nn.Linear(8, 1)

    def forward(self, x: Tensor, memory: tuple[Tensor, Tensor]) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        x, memory = self.lstm(x * torch.tensor([5.0, 0.4]), memory)
        return 20.0 * self.linear(x)[:, :, 0], memory


def converted(module: nn.Module, folder: Path, *args: str) -> MotorNetwork:
    torch.jit.script(module).save(str(folder / "net.pt"))
    actuator_net.main([str(folder / "net.pt"), str(folder / "net.npz"), *args])
    return read_network(folder / "net.npz")


def test_torchscript_files_convert(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    module, network = mlp("softsign")
    found = converted(module, tmp_path, "--error_scale", "-1")
    assert "layers 32, 30, 1, softsign, scales -1 1/rad, 1 s/rad, 1 N m; torques differ" in capsys.readouterr().out
    assert (found.frames, found.activation, found.error_scale) == ((0, 1, 2), "softsign", -1.0)
    for ours, theirs in zip(found.linear, network.linear, strict=True):
        assert all(np.array_equal(a, b) for a, b in zip(ours, theirs, strict=True))


def test_an_lstm_of_legged_gym_converts_with_the_scales_that_are_inside(tmp_path: Path) -> None:
    torch.manual_seed(0)
    found = converted(Anydrive(), tmp_path)
    assert found.hidden == [8, 8] and found.frames == (0,)
    assert (found.error_scale, found.speed_scale, found.torque_scale) == pytest.approx((5.0, 0.4, 20.0), rel=1e-3)


# ---- exports


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an untrained policy and its export, with servos."""
    folder, task = tmp_path_factory.mktemp("made"), small_task({})
    make_runner(task.env_class(task.cfg, "cpu"), task.train, None, "cpu").save(str(folder / "model_0.pt"))
    export(task, folder / "model_0.pt", folder / "out")
    return folder


def small_task(fields: dict[str, Any]) -> LoadedTask:
    task = load_task("go1_flat")
    for path, value in {"env.num_envs": 2, **fields}.items():
        task.set(path, value)
    for part in (task.train.actor, task.train.critic):
        part.hidden_dims = [8]
    return task


@pytest.fixture
def exported(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[dict[str, Any]], Path]:
    """The same policy, exported with other motors to the folder "out"."""
    monkeypatch.setattr(
        exporting, "save_onnx", lambda _policy, _clip, path: shutil.copy(made / "out/policy.onnx", path)
    )

    def export_with(fields: dict[str, Any]) -> Path:
        export(small_task(fields), made / "model_0.pt", tmp_path / "out")
        return tmp_path / "out"

    return export_with


@pytest.mark.parametrize("law", ["dc_motor", "speed", "torque", "network"])
def test_deploys_robot_has_the_same_motors(
    law: str, exported: Callable[[dict[str, Any]], Path], tmp_path: Path
) -> None:
    """The same targets move an export's robot as they move the environment's, to float32 and six digits in an MJCF."""
    fields = {
        **DC,
        "asset.effort": {"": 15.0},
        "control.actuator": law,
        "domain_rand.delay_ms": [5.0, 9.0],
        "domain_rand.enable": True,
    }
    origin = "torque" if law == "torque" else "default"
    if law == "speed":
        law, origin = "dc_motor", "speed"
        fields |= {
            "control.actuator": law,
            "control.action_origin": origin,
            "control.action_scale": 8.0,
            "control.damping": {"": 1.0},
        }
    elif law != "dc_motor":
        fields |= (
            {"control.action_scale": 4.0}
            if law == "torque"
            else {"control.network": save(mlp(torque_scale=20.0)[1], tmp_path)}
        )
    task, folder = small_task(fields), exported(fields)
    contract = read_contract(folder)
    assert (contract.motors.law, contract.motors.stall_torque, contract.motors.no_load_speed) == (
        law,
        (20.0,) * 12,
        (25.0,) * 12,
    )
    assert load_yaml(folder / "policy.yaml")["format"] == 5 and contract.action.origin == origin
    for path, value in {
        "domain_rand.enable": False,
        "sim.engine": "mujoco",
        **STILL,
        "perturbation.kick": False,
    }.items():
        task.set(path, value)
    env, fleet = task.env_class(task.cfg, "cpu"), Fleet(folder, contract, 2)
    fleet.qpos[:] = env.sim.qpos
    for _ in range(4):
        actions = torch.randn(2, 12).clamp(-2.0, 2.0)
        env.step(actions)
        fleet.write(env.actuators.sent().double().numpy())
        np.testing.assert_allclose(fleet.qpos, env.sim.qpos, atol=3e-4)
    np.testing.assert_allclose(fleet.read().joint_torque, env.torques, atol=0.1)
    if origin == "speed":
        return  # it has no stiffness to be switched off by, and nothing that does so takes it
    fleet.set_gains(np.zeros(12), np.full(12, 3.0))  # off, damped
    fleet.write(np.ones((2, 12)))
    assert np.isfinite(fleet.qpos).all()
    if law != "dc_motor":
        assert not fleet._batch.bind("qfrc_actuator").any()
    fleet.set_gains(contract.stiffness, contract.damping)  # and on again, at their own gains
    for name in ("actuator_gainprm", "actuator_biasprm", "actuator_gear", "dof_damping"):
        np.testing.assert_array_equal(fleet._batch.expand(name), [getattr(fleet.model, name)] * 2)


def test_an_export_with_servos_is_as_it_was(made: Path) -> None:
    contract = load_yaml(made / "out/policy.yaml")
    assert contract["format"] == 5 and "motors" not in contract


def test_a_contract_with_other_motors_is_refused(exported: Callable[[dict[str, Any]], Path]) -> None:
    folder = exported(DC)
    contract = load_yaml(folder / "policy.yaml")
    for change, message in (
        ({"no_load_speed": [0.0] * 12}, "policy.yaml: motors: 'no_load_speed' is .*; it must be numbers above zero"),
        ({"stall_torque": [20.0] * 3}, "policy.yaml: motors: 'stall_torque' is .*; it must be 12 numbers, one a joint"),
        ({"stall_torque": [21.0] * 12}, "policy.yaml: motors: stall_torque is .*, but scene.xml has "),
    ):
        save_yaml(folder / "policy.yaml", contract | {"motors": contract["motors"] | change})
        with pytest.raises(ContractError, match=message):
            Fleet(folder, read_contract(folder, edited=True))


def test_networks_beside_an_export(exported: Callable[[dict[str, Any]], Path], tmp_path: Path) -> None:
    folder = exported({"control.actuator": "network", "control.network": save(mlp()[1], tmp_path)})
    contract = read_contract(folder)
    assert contract.motors.digest == digest(folder / "motors.npz")
    np.savez(folder / "motors.npz", **mlp("elu")[1].to_arrays())
    with pytest.raises(ContractError, match="SHA-256"):
        Fleet(folder, contract)
    exported({})
    assert not (folder / "motors.npz").exists(), "of the earlier export"
    with pytest.raises(ContractError, match="no motors.npz in .*, the network of its motors; export the policy again"):
        Fleet(folder, replace(read_contract(folder), motors=contract.motors))


def test_a_network_that_changed_after_training_is_refused(tmp_path: Path) -> None:
    """Under its name, by --resume, play.py and its export; the config can take it, and another name is another choice."""
    file = save(mlp()[1], tmp_path)
    folder = trained(
        tmp_path, "--set", "control.actuator=network", "--set", f"control.network={file}", "--max_iterations", "1"
    )
    known = {file: digest(Path(file))}
    assert load_yaml(folder / "config.yaml")["control"]["network_digest"] == known
    np.savez(file, **mlp("elu")[1].to_arrays())
    for program, flags in (
        ("train", ["--resume"]),
        ("play", ["--eval"]),
        ("play", ["--export", str(tmp_path / "out")]),
    ):
        result = run(program, tmp_path, "--task", "go1_flat", "--device", "cpu", *flags)
        assert result.code == 2 and f"control.network: {file} " in result.err
    assert not (tmp_path / "out").exists()
    resumed = ["--resume", "--set", "control.network_digest={}", "--max_iterations", "2"]
    result = run("train", tmp_path, "--task", "go1_flat", "--device", "cpu", *resumed)
    assert result.code == 0, result.err
    assert load_yaml(folder / "config.yaml")["control"]["network_digest"] == {file: digest(Path(file))} != known


# ---- wheels, by a law in code

CAR = """<mujoco><compiler angle="radian"/><worldbody><body name="trunk" pos="0 0 0.3"><freejoint/>
<geom name="trunk" type="box" size="0.3 0.1 0.05" mass="8"/>{}</body></worldbody></mujoco>"""
STRUT = """<body name="{0}_leg" pos="{1} {2} 0"><joint name="{0}_leg_joint" axis="0 1 0" range="-1 1" actuatorfrcrange="-40 40"/>
<geom name="{0}_leg" type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="0.5" contype="0" conaffinity="0"/>
<body name="{0}_wheel" pos="0 0 -0.2"><joint name="{0}_wheel_joint" axis="0 1 0" actuatorfrcrange="-20 20"/>
<geom name="{0}" type="cylinder" size="0.1 0.02" zaxis="0 1 0" mass="0.5"/></body></body>"""
CORNERS = {"FL": (0.25, 0.15), "FR": (0.25, -0.15), "RL": (-0.25, 0.15), "RR": (-0.25, -0.15)}


class OnWheels(LeggedRobot):
    """The class of docs/motors.md."""

    def _init_buffers(self) -> None:
        super()._init_buffers()
        self.wheels = torch.tensor(["wheel" in name for name in self.robot.joint_names], device=self.device)  # (D,)

    def _compute_torques(self, actions: Tensor) -> Tensor:
        """Legs turn to an angle, wheels turn at a speed: 20 rad/s by an action of 1."""
        return super()._compute_torques(actions) + self.wheels * self.d_gains * 20.0 * actions

    def _refresh_base(self) -> None:
        """The angle of a wheel grows without end: neither policy nor rewards read it."""
        super()._refresh_base()
        self.dof_offset.masked_fill_(self.wheels, 0.0)
        self.joint_reading.masked_fill_(self.wheels, 0.0)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_robot_rolls_on_wheels_that_a_law_in_code_drives(engine: str, tmp_path: Path) -> None:
    """Its wheels of 0.1 m are told 6 rad/s, then none, then the sides turn against each other."""
    struts = "".join(STRUT.format(name, *place) for name, place in CORNERS.items())
    (tmp_path / "car.xml").write_text(CAR.format(struts))
    gains = {
        "stiffness": {"leg": 40.0, "wheel": 0.0},
        "damping": {"leg": 2.0, "wheel": 1.0},
        "action_scale": {"": 0.25},
    }
    car = {
        **{"asset.file": str(tmp_path / "car.xml"), "asset.foot_names": [*CORNERS], "asset.imu_site": ""},
        **{"asset.colliders": [*CORNERS], "asset.joint_speed_limits": {}, "asset.effort": {}},
        "ratings.top_speed": {},
        **{
            "init_state.default_joint_angles": {"": 0.0},
            "init_state.pos": [],
            "rewards.pose_weights": {"leg": 1.0, "": 0.0},
        },
        **{f"control.{name}": value for name, value in gains.items()},
    }
    env = make_env(2, {**QUIET, **STILL, **car, "sim.engine": engine}, env_class=OnWheels)
    of_wheels = torch.tensor(["wheel" in name for name in env.robot.joint_names])
    wheels = of_wheels.float()
    sides = torch.tensor([1.0 if name[1] == "L" else -1.0 for name in env.robot.joint_names])
    for actions, forward, turns in [
        (0.3 * wheels, 0.6, False),
        (0.0 * wheels, 0.0, False),
        (-0.3 * wheels * sides, 0.0, True),
    ]:
        for _ in range(100):
            env.step(actions.repeat(2, 1))
        assert env.base_lin_vel[:, 0].tolist() == pytest.approx([forward] * 2, abs=0.05)
        assert bool((env.base_ang_vel[:, 2] > 0.1).all()) == turns
    assert not env.fell.any()
    assert not env.joint_reading[:, of_wheels].any()
    env.episode_length_buf = torch.tensor([0, env.max_episode_length - 1])  # the next step ends world 1
    seen = env.step(torch.zeros(2, env.num_actions))[0]["state"]
    assert env.reset_buf.tolist() == [False, True]
    assert (
        not env.joint_reading[:, of_wheels].any()
        and not seen[:, env.observations.span("state", "dof_pos")][:, of_wheels].any()
    )
