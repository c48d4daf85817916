"""Get up after any fall and stay in the default pose. Episodes begin after a fall. A force helps robots learn.

Sources: [P] MuJoCo Playground's Go1 getup (commit d5e6b47); [H] HoST (OpenRobotLab), a G1; [ours] with the reason.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar

import torch
from torch import Tensor

from legged_mw.envs.observations import Row
from legged_mw.envs.robot_task import RobotTask
from legged_mw.sim.sensors import COM_VELOCITY
from legged_mw.sim.simulation import Simulation
from legged_mw.skills.drop_states import fallen
from legged_mw.skills.skill_config import SkillCfg, SkillCfgPPO
from legged_mw.utils.bounds import Count, NonNegativeInt, Positive, PositiveShare, Seconds, Share, above
from legged_mw.utils.config import ConfigError
from legged_mw.utils.errors import unknown
from legged_mw.utils.math import assign

Settling = Annotated[float, above(0, 60, "s")]

# a robot is up above this cosine of the tilt (15 degrees) and share of standing height [ours: servos alone hold 0.92]
UP_TILT, UP_HEIGHT = 0.966, 0.9
# factor: an episode that ends down raises the level by this times the decrease of one that ends up [ours]
GIVEN_BACK = 3.0


class GetupCfg(SkillCfg):
    class falls:
        share: Share = 0.75  # share of episodes that begin after a fall; the others begin standing [P 0.6]
        states: Count = 2048  # number of states after falls; at most four per world are made [ours]
        seconds: Settling = 1.0  # from the drop to the state [P 0.5; ours: a roll takes longer]
        seed: NonNegativeInt = 1  # the same seed makes the same falls; the exam has another
        again: Share = 0.0  # chance that an episode which ends down is followed by one after the same fall [ours]
        pull: Share = 0.0  # lifting force, as a share of the weight; it decreases as robots learn [H 0.6]
        pull_on: str = ""  # lifted body; empty: the root (a robot with a heavy trunk then hangs head down)
        pull_fades: PositiveShare = 0.2  # decrease of the force when every world has ended an episode up [ours]

    class env(SkillCfg.env):
        episode_length_s = 6.0  # [s] [P]

    class asset(SkillCfg.asset):
        self_collisions = True  # and all colliders touch the ground [P]

    class control(SkillCfg.control):
        # [P, H: around the default pose, noise never rolls a robot over; docs/skills.md], [rad] [P]
        action_origin, action_scale = "joints", 0.5

    class termination(SkillCfg.termination):
        max_tilt = 180.0  # [deg]: no attitude ends an episode [P, H]

    class domain_rand(SkillCfg.domain_rand):
        # [kg] [H -2 to 5], [m], [-] [H 0.1 to 1]
        base_mass, base_com, friction = [-1.0, 3.0], [-0.03, 0.03], [0.25, 1.2]
        stiffness, damping, strength = [0.9, 1.1], [0.9, 1.1], [0.9, 1.1]  # [H 0.85 to 1.15]
        slope = [0.0, 12.0]  # [deg] [ours: the exam has 10]

    class exam:
        within: Seconds = 3.0  # [s] to stand up in

    class rewards(SkillCfg.rewards):
        only_positive_rewards = False  # [ours, P True: no fall ends an episode, and thrashing would cost nothing]
        soft_power: Positive = 700.0  # of all joints together, of `power` [W] [ours: of a G1, with bursts of 3.2 kW]
        soft_acceleration: Positive = 1.5  # of `shock`: ground force, as a share of the weight [-] [ours: 1 at rest]

        class scales(SkillCfg.rewards.scales):  # [P], with our terms of the same meaning
            upright, height, posture, stand_still = 1.0, 1.0, 1.0, 1.0
            action_rate, action_smoothness, torques, dof_acc, dof_pos_limits = -0.005, -0.001, -1e-5, -1e-8, -0.1
            # [ours, P -0.1 and dof_acc -2.5e-7: at first these penalties would be ten times the rewards]
            fast_joints = -0.0003


class GetupCfgPPO(SkillCfgPPO):
    class actor(SkillCfgPPO.actor):
        class distribution_cfg(SkillCfgPPO.actor.distribution_cfg):
            # [ours: standing robots would lower the noise before the others have learned to roll over]
            init_std, std_range = 1.0, [0.2, 1e6]

    class algorithm(SkillCfgPPO.algorithm):
        gamma = 0.98  # [P 0.97]


class LiftAssist:
    """A force against gravity on one body of each robot: ``level`` () from 1 to 0, times ``force`` [N].

    It also lifts robots that stand. Otherwise they learn to rely on the force, and the level never decreases.
    """

    written = ("level",)

    def __init__(self, sim: Simulation, body: int, gravity_dir: Tensor, force: float, fades: float) -> None:
        """``gravity_dir`` (N, 3), world frame, is tilted on a slope. ``fades`` is ``falls.pull_fades``."""
        self._force, self._down, self._fades = sim.xfrc_applied[:, body, :3], gravity_dir, fades  # a view (N, 3)
        self._highest, self.level = force, torch.ones((), device=sim.device)

    def apply(self) -> None:
        """Write the force, before a step."""
        if self._highest:
            torch.mul(self._down, -self._highest * self.level, out=self._force)

    def update(self, ended: Tensor, up: Tensor) -> None:
        """Lower the level for worlds that ``ended`` (N,) an episode ``up`` (N,); raise it for the others that ended."""
        if self._highest:
            change = torch.where(up, -1.0, GIVEN_BACK).masked_fill(~ended, 0.0).mean()
            self.level.add_(change, alpha=self._fades).clamp_(0.0, 1.0)

    def statistics(self) -> dict[str, Tensor]:
        """The level, as sum and count."""
        return {"pull": torch.stack([self.level, torch.ones_like(self.level)])} if self._highest else {}


class Getup(RobotTask):
    cfg: GetupCfg
    exam = "getup"
    SENSED_FOR: ClassVar[Mapping[str, str]] = {**RobotTask.SENSED_FOR, "shock": COM_VELOCITY}
    last_com_velocity: Tensor  # (N, 3) of the previous step; only with `shock`

    def _init_buffers(self) -> None:
        super()._init_buffers()
        falls = self.cfg.falls
        states = fallen(self.robot.physics, min(falls.states, 4 * self.num_envs), falls.seed, falls.seconds)
        self.fallen_qpos, self.fallen_qvel = (self._tensor(values) for values in states)  # (P, nq), (P, nv)
        self.begun_in = self.buffer(dtype=torch.long)  # (N,) the fall that the episode began after, from 1; 0: standing
        self.up_height = 0.99 * self.start_place[2]  # [m] height of a standing root [P: 0.275 of 0.278]
        self.upright = self.buffer()  # (N,) cosine of the tilt
        self.up = self.buffer(dtype=torch.bool)  # (N,) true if the robot is as high and upright as a standing one
        self.highest_torque = self._tensor(self.robot.effort_range[:, 1])  # (D,) [N m], infinite without a limit
        force = falls.pull * 9.81 * self.total_mass
        self.pull = self.remember(LiftAssist(self.sim, self._lifted(), self.gravity_dir, force, falls.pull_fades))

    def _lifted(self) -> int:
        """The index of the body that ``falls.pull`` lifts."""
        falls, model = self.cfg.falls, self.robot.physics
        names = [model.body(i).name for i in range(1, model.nbody)]
        if falls.pull_on and falls.pull_on not in names:
            raise ConfigError(f"falls.pull_on: {unknown('body', falls.pull_on, names, self.cfg.asset.file)}")
        lifted = model.body(falls.pull_on).id if falls.pull_on else self.root_body
        if falls.pull and lifted == self.root_body and self.cfg.perturbation.kick:
            mend = "name another body in falls.pull_on"
            raise ConfigError(f"falls.pull lifts the root, which perturbation.kick pushes: {mend}")
        return lifted

    def _episode_columns(self) -> dict[str, int]:
        return super()._episode_columns() | ({"last_com_velocity": 3} if "shock" in self._active_scales() else {})

    def _reset_robots(self, mask: Tensor) -> None:
        """Start in the default pose, or with probability ``falls.share`` in a state after a fall.

        With probability ``falls.again`` a robot that did not get up starts after the same fall again.
        """
        super()._reset_robots(mask)
        falls = self.cfg.falls
        fall = mask & (torch.rand_like(self.rew_buf) < falls.share)
        pick = torch.randint(len(self.fallen_qpos), (self.num_envs,), device=self.device)
        if falls.again:
            down = (self.begun_in > 0) & ~self.up & ~self.broken
            again = mask & down & (torch.rand_like(self.rew_buf) < falls.again)
            fall, pick = fall | again, torch.where(again, self.begun_in - 1, pick)
            assign(self.begun_in, mask, torch.where(fall, pick + 1, 0))
        assign(self.sim.qpos, fall, self.fallen_qpos.index_select(0, pick))
        assign(self.sim.qvel, fall, self.fallen_qvel.index_select(0, pick))

    def _apply_actions(self) -> None:
        super()._apply_actions()
        self.pull.apply()

    def _end_step(self) -> None:
        super()._end_step()
        if "shock" in self.reward_names:
            self.last_com_velocity.copy_(self.com_velocity)

    def _update_curricula(self, mask: Tensor) -> None:
        super()._update_curricula(mask)
        self.pull.update(mask, self.up)

    def _live_statistics(self) -> dict[str, Tensor]:
        return super()._live_statistics() | self.pull.statistics()

    def training_state(self) -> dict[str, Tensor]:
        return super().training_state() | {"pull_level": self.pull.level.clone()}

    def load_training_state(self, state: dict[str, Tensor]) -> None:
        super().load_training_state(state)
        self.pull.level.copy_(state.get("pull_level", self.pull.level))

    def _refresh_base(self) -> None:
        super()._refresh_base()
        torch.neg(self.projected_gravity[:, 2], out=self.upright)
        self.up.copy_((self.upright > UP_TILT) & (self.base_height > UP_HEIGHT * self.up_height))

    def _body_rows(self) -> list[Row]:
        # above the ground [m] [P]
        return [*super()._body_rows(), Row("base_height", self.base_height[:, None], mirror="scalar")]

    def _near_upright(self) -> Tensor:
        return torch.exp(-4.0 * (1.0 - self.upright))  # exp(-2 |g + z|^2) of unit vectors [P]

    def _standing(self) -> Tensor:
        """1 for an upright robot of standing height, 0 below 0.6 of it."""
        return self._near_upright() * ((self.base_height / self.up_height - 0.6) / 0.3).clamp(0.0, 1.0)

    def _reward_upright(self) -> Tensor:
        """How upright it is. [P: the second half alone, 0 once it lies; ours: a half that is linear in the tilt]"""
        return 0.5 - torch.acos(self.upright.clamp(-1.0, 1.0)) / (2.0 * torch.pi) + 0.5 * self._near_upright()

    def _reward_height(self) -> Tensor:
        """Height of the root, as a share of standing, times uprightness. [P: exp(height) - 1; ours: 0 upside down]"""
        return (self.base_height / self.up_height).clamp(0.0, 1.0) * (0.5 + 0.5 * self.upright)

    def _reward_posture(self) -> Tensor:
        """The default pose, while upright. [P: exp(-0.5 x sum), which is flat for folded legs; ours: by the mean]"""
        return self._near_upright() * torch.exp(-2.0 * (self.dof_offset.square() * self.pose_weights).mean(dim=1))

    def _reward_stand_still(self) -> Tensor:
        """Joints at rest, while it is up. [P: small actions, all or nothing; ours: as the exam]"""
        return self._standing() * torch.exp(-0.5 * self.dof_vel.square().mean(dim=1))

    def _reward_power(self) -> Tensor:
        """Square of the sum of |joint velocity * torque| beyond ``rewards.soft_power``, as a share of it [-]. [ours]

        At most 64. A burst costs more than the same energy given evenly, which `energy` does not tell apart.
        """
        return (self._reward_energy() / self.cfg.rewards.soft_power - 1.0).clamp(0.0, 8.0).square()

    def _reward_shock(self) -> Tensor:
        """Square of the ground force beyond ``rewards.soft_acceleration``, in body weights [-]. At most 64. [ours]

        The mean of a control step (20 ms), from the velocity of the centre of mass, so that no blow is missed.
        """
        change = (self.com_velocity - self.last_com_velocity) / self.dt - 9.81 * self.gravity_dir
        return (change.norm(dim=1) / 9.81 - self.cfg.rewards.soft_acceleration).clamp(0.0, 8.0).square()

    def _reward_stand_torques(self) -> Tensor:
        """Mean square of the torques as shares of their limits, while it is up. [ours]"""
        self._need_force_limits("stand_torques")
        return self._standing() * (self.torques / self.highest_torque).square().mean(dim=1)
