"""What every robot observes in every task: the table of rows and its mirror image. ``RobotTask`` inherits them.

The table is the only place that states the layout. ``Row`` and what makes buffers of a table are in ``observations``.
"""

from __future__ import annotations

from functools import cached_property

from torch import Tensor

from legged_mw.envs.domain_rand import DomainRand
from legged_mw.envs.mirror import Block, Mirror, check_pose, make_mirror, robot_blocks
from legged_mw.envs.observations import Observations, Row
from legged_mw.envs.perturbation import Perturbation
from legged_mw.envs.robot_task_config import RobotTaskCfg
from legged_mw.sim.mirror import Partners, find_partners
from legged_mw.sim.model import RobotModel


class RobotObservations:
    """Rows about the base, the joints, and what was drawn for a world."""

    # what the rows and the mirror read: RobotTask makes it
    cfg: RobotTaskCfg
    device: str
    robot: RobotModel
    domain_rand: DomainRand
    perturbation: Perturbation
    observations: Observations
    base_lin_vel: Tensor  # (N, 3) body frame [m/s]
    base_ang_vel: Tensor  # (N, 3) body frame [rad/s]
    base_ang_vel_world: Tensor  # (N, 3) [rad/s]
    projected_gravity: Tensor  # (N, 3) body frame
    accelerometer: Tensor  # (N, 3) [m/s^2]
    imu_pos: Tensor  # (N, 3) body frame [m]
    default_dof_pos: Tensor  # (D,) [rad]
    dof_offset: Tensor  # (N, D) from the default pose [rad]
    joint_reading: Tensor  # (N, D) the same, as measured
    dof_vel: Tensor  # (N, D) [rad/s]
    torques: Tensor  # (N, D) [N m]
    last_actions: Tensor  # (N, D)

    def observation_rows(self) -> dict[str, list[Row | str]]:
        """Rows of each group, in order; a name stands for a group above it. Asked once: values are buffers of the step."""
        return {
            "state": [*self._measured_rows()],
            "privileged_state": ["state", *self._body_rows(), *self._disturbance_rows()],  # first the same noisy sample
        }

    def _measured_rows(self) -> list[Row]:
        """What a robot measures or estimates of itself, with noise, and its last action."""
        noise = self.cfg.noise.scales
        return [
            # at the IMU, body frame [m/s]
            Row("base_lin_vel", self.base_lin_vel, noise.lin_vel, mirror="imu_velocity", measured=True),
            # gyro, body frame [rad/s]
            Row("base_ang_vel", self.base_ang_vel, noise.ang_vel, mirror="axial", measured=True),
            # direction, body frame
            Row("projected_gravity", self.projected_gravity, noise.gravity, mirror="polar", measured=True),
            # minus the default pose [rad]
            Row("dof_pos", self.joint_reading, noise.dof_pos, mirror="joint", measured=True),
            Row("dof_vel", self.dof_vel, noise.dof_vel, mirror="joint", measured=True),  # [rad/s]
            Row("last_actions", self.last_actions, mirror="joint"),  # a_t, clipped
        ]

    def _body_rows(self) -> list[Row]:
        """The same without noise, and more, as only a simulator knows it."""
        return [
            Row("base_ang_vel", self.base_ang_vel, mirror="axial"),
            Row("accelerometer", self.accelerometer, mirror="polar"),  # proper acceleration at the IMU [m/s^2]
            Row("projected_gravity", self.projected_gravity, mirror="polar"),
            Row("base_lin_vel", self.base_lin_vel, mirror="imu_velocity"),
            # [rad/s]; the world mirrors about its own x-z plane
            Row("base_ang_vel_world", self.base_ang_vel_world, mirror="axial"),
            Row("dof_pos", self.dof_offset, mirror="joint"),
            Row("dof_vel", self.dof_vel, mirror="joint"),
            Row("torques", self.torques, mirror="joint"),  # [N m]
        ]

    def _disturbance_rows(self) -> list[Row]:
        """Kicks, and with ``domain_rand.observe`` what was drawn, in the config's units."""
        rand = self.domain_rand
        drawn = [
            Row(name, value, mirror=rand.mirrors[name])
            for name, value in rand.values.items()
            if self.cfg.domain_rand.observe
        ]
        return [
            Row("kick_force", self.perturbation.kick_force, mirror="polar"),  # on the root, world frame [N]
            Row("kick_active", self.perturbation.kick_active[:, None], mirror="scalar"),  # 0 or 1
            *drawn,
        ]

    @cached_property
    def mirror(self) -> Mirror:
        """Observations and actions left for right, from the table; made when first asked for, and not for the step."""
        return make_mirror(self.observations.groups, self._mirror_blocks(), self._mirror_reach(), self.device)

    def _mirror_blocks(self) -> dict[str, Block]:
        """Kinds of mirror image that rows may have, by name."""
        partners = self._partners()
        check_pose(self.robot.joint_names, self.default_dof_pos.tolist(), partners)
        return robot_blocks(partners)

    def _partners(self) -> Partners:
        return find_partners(self.robot)

    def _mirror_reach(self) -> float:
        """[m] from the mirrored IMU to the IMU."""
        return 2.0 * float(self.imu_pos[0, 1])
