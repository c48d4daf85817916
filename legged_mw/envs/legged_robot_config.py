"""The fields of walking by command, in addition to RobotTask's, with type, unit and source.

Sources: [P] MuJoCo Playground's Go1 joystick task; [L] legged_gym; [ours] with the reason.
"""

from __future__ import annotations

from typing import Annotated, Literal

from legged_mw.envs.robot_task_config import RobotTaskCfg
from legged_mw.sim.terrain import KINDS
from legged_mw.utils.bounds import (
    PAIR,
    SOME,
    THREE,
    Bound,
    Count,
    Duration,
    Height,
    NonNegative,
    NonNegativeInt,
    Positive,
    PositiveShare,
    Range,
    Share,
    Sign,
    above,
    at_least,
    or_empty,
)
from legged_mw.utils.commands import HEADING
from legged_mw.utils.config import ConfigError, fit
from legged_mw.utils.errors import unknown

Points = Annotated[list[Annotated[float, at_least(-100, 100, "m")]], SOME]
Difficulties = Annotated[list[Annotated[float, at_least(0, 2)]], PAIR]
Swing = Annotated[float, above(0, 10, "m")]  # height of a foot in its swing
Probabilities = Annotated[list[Share], Bound("three numbers, and more for further commands", lambda v: len(v) >= 3)]
Stance = Annotated[float, Bound("above 0 and below 1", lambda v: 0 < v < 1)]
_CELL = Bound("above 0 and at most 0.25 m, or a cell would be wider than a step of stairs", lambda v: 0 < v <= 0.25)
CellSize = Annotated[float, _CELL]
Border = Annotated[float, Bound("1 m or more, for a robot that leaves the tiles to turn back", lambda v: v >= 1)]
Marks = Annotated[list[Positive], or_empty(THREE)]


class LeggedRobotCfg(RobotTaskCfg):
    """Walking by command. Defaults are the joystick task's [P]. A robot's names and numbers are in configs/."""

    class asset(RobotTaskCfg.asset):
        foot_names: list[str] = []  # names of sites, and of geoms without foot_geoms, in the order of observations
        foot_geoms: dict[str, list[str]] = {}  # foot -> its geoms, names or patterns; else the geom with its name

    class observations(RobotTaskCfg.observations):
        foot_height: bool = False  # add a row to `privileged_state`: height of each foot above the ground under it [m]
        contact_forces: bool = False  # add a row to `privileged_state`: each foot's ground force, world [N] [ours: off]

    class commands:
        resampling_time: Duration = 5.0  # mean of an exponential timer in each world [s]; 0: never [P]
        change_probability: Share = 0.5  # probability that a command changes when the timer ends [P]
        # probability, per command, that a changed one is not its default; 1 beyond the list [P]
        keep_probability: Probabilities = [0.9, 0.25, 0.5]
        end_probability: Share = 0.0  # probability that a new value is an end of its range [go2_rl_gym 0.2]

        curriculum: bool = False  # start with a share of the ranges, increase it while velocity is tracked well [L]
        curriculum_start: PositiveShare = 0.4  # the share at the start [-] [ours]
        # growth, where worlds' last episodes have 0.8 of the best tracking_lin_vel [L, ours]
        curriculum_step: PositiveShare = 0.1

        heading_command: bool = False  # the yaw rate steers to a heading, which is drawn instead [L]
        heading_gain: Positive = 0.5  # yaw rate per heading error, within its range [1/s] [L]
        units: dict[str, str] = {}  # of your own commands, by name
        mirror: dict[str, Sign] = {}  # of your own commands: 1.0, or -1.0 if mirroring changes the sign
        default: dict[str, float] = {}  # of your own commands: value at rest; else the nearest to 0

        class ranges:
            """Lowest and highest value of each command, in the policy's order. A task may add its own after these."""

            lin_vel_x: Range = [-1.5, 1.5]  # [m/s] [P]
            lin_vel_y: Range = [-0.8, 0.8]  # [m/s] [P]
            ang_vel_yaw: Range = [-1.2, 1.2]  # [rad/s] [P]
            heading: Range = [-3.14, 3.14]  # [rad], world; only for heading_command, not observed by the policy [L]

    class gait:
        """A clock for the steps of each foot (legged_mw/envs/feet.py), for the policy, feet_phase and contact_phase."""

        period: Duration = 0.0  # duration of a step of both legs [s]; 0: no clock [unitree_rl_gym: 0.8]
        offsets: list[Share] = []  # phase of each foot at clock 0, share of the period; empty: [0.0, 0.5] for two feet
        stance: Stance = 0.55  # share of the period in which a foot stands, from its phase 0 [unitree_rl_gym]
        random_start: bool = True  # start at a random phase: each leg learns to lead; False: at 0, as deploy

    class rewards(RobotTaskCfg.rewards):
        tracking_sigma: Positive = 0.25  # tracking = exp(-error^2 / sigma) [P, L]
        tracking_sigma_end: NonNegative = 0.0  # its value at max_iterations, reached linearly; 0: constant [ours]
        # kind of ground -> share of tracking_sigma added per level [go2_rl_gym: with the speed, too]
        tracking_sigma_growth: dict[str, NonNegative] = {}
        swing_height: Swing = 0.1  # target height of a swinging foot [m] [P]
        min_air_time: NonNegative = 0.1  # shorter steps are penalised [s] [P]
        min_command: NonNegative = 0.01  # norm of (vx, vy, yaw rate) below which the command is to stand [P]
        min_feet_distance: Height = 0.2  # of `feet_distance`: sideways between left and right feet [m] [P: T1, G1]
        max_contact_force: NonNegative = 100.0  # of `feet_contact_forces`: larger forces on a foot count [N] [L]
        max_single_stance: Positive = 0.4  # of `single_stance`: time on one foot that pays most [s] [Isaac Lab: G1]

        class scales(RobotTaskCfg.rewards.scales):
            """All [P]."""

            tracking_lin_vel: float = 1.0
            tracking_ang_vel: float = 0.5
            lin_vel_z: float = -0.5
            ang_vel_xy: float = -0.05
            orientation: float = -5.0
            dof_pos_limits: float = -1.0
            pose: float = 0.5
            termination: float = -1.0
            stand_still: float = -1.0
            torques: float = -0.0002
            action_rate: float = -0.01
            energy: float = -0.001
            feet_clearance: float = -2.0
            feet_height: float = -0.2
            feet_slip: float = -0.1
            feet_air_time: float = 0.1  # [P]
            collision: float = 0.0  # of asset.penalize_contacts_on [L]

    class noise(RobotTaskCfg.noise):
        class scales(RobotTaskCfg.noise.scales):
            height_scan: NonNegative = 0.1  # [m] [L]

    class terrain(RobotTaskCfg.terrain):
        mesh_type: Literal["plane", "heightfield"] = "plane"  # heightfield: a grid of tiles, with the fields below
        num_rows: Count = 10  # levels of difficulty, along x [L]
        num_cols: Count = 20  # number of tiles along y; each column has one kind [L]
        tile_size: Positive = 8.0  # edge of a tile [m] [L]
        horizontal_scale: CellSize = 0.05  # distance of heights [m] [ours: L 0.1 makes a stair a slope of 50 degrees]
        border_size: Border = 5.0  # flat ground around the tiles; beyond its middle an episode times out [m] [L 25]
        difficulty: Difficulties = [0.0, 1.0]  # of the first row and of the last: 0 easy, 1 hard, 2 at most [L]
        # kind (legged_mw/sim/terrain.py) -> share of the columns [ours]
        terrain_proportions: dict[str, NonNegative] = {
            **{"flat": 0.05, "smooth_slope": 0.1, "rough_slope": 0.15, "stairs_up": 0.25, "stairs_down": 0.15},
            **{"obstacles": 0.15, "waves": 0.05, "low_random": 0.1},
        }
        seed: NonNegativeInt = 1  # seed of the terrain
        curriculum: bool = True  # change levels by success; False: a random level at each reset [L]
        max_init_terrain_level: NonNegativeInt = 5  # highest level at the start of training, or the last one [L]
        measured_points_x: Points = [i / 10 for i in range(-8, 9)]  # of the height scan, ahead of the root [m] [L]
        measured_points_y: Points = [i / 10 for i in range(-5, 6)]  # of the height scan, to the left [m] [L]
        height_scan: list[Literal["state", "privileged_state"]] = []  # observation groups with this row

    class exam:
        """The walking exam of --eval and of training (docs/grading.md); all [ours]."""

        ranges: dict[str, Range] = {}  # lin_vel_x, lin_vel_y, ang_vel_yaw -> low, high; others: commands.ranges
        push_speeds: list[Positive] = []  # jumps of velocity [m/s]; empty: 0.5 1 1.5 2 3, and 4 5 6 if not on two feet
        push_vx: float = 0.0  # vx during pushes [m/s]; 0: half of the highest
        transport_vx: float = 0.0  # vx for the cost of transport [m/s]; 0: half of the highest
        # highest errors or offsets of a walk: vx, vy [m/s], yaw rate [rad/s]; empty: errors 0.06 of the highest vx,
        # 0.06, 0.1 of the highest yaw rate, or offsets 0.06, 0.06, 0.12
        marks: Marks = []
        # offset: error of the mean velocity; empty: offset on two feet, which sway, else error
        marks_of: Literal["", "error", "offset"] = ""
        push_mark: NonNegative = 0.0  # a walk survives all pushes of this speed [m/s]; 0: 1 on two feet, else 2
        peer: str = ""  # go1, go2, g1: compare with its published policies in resources/peers.yaml; empty: none

    def check(self) -> None:
        super().check()
        feet, commands = self.asset.foot_names, self.commands
        if not feet or "*" in "".join(feet) or len({*feet}) < len(feet):
            expected = "a list of at least one name, one for each foot and each once (patterns are for foot_geoms)"
            raise ConfigError(f"asset.foot_names is {feet!r}; it must be {expected}")
        for name, span in vars(commands.ranges).items():  # a task may have declared its own
            fit(span, Range, f"commands.ranges.{name}")
        names = [name for name in vars(commands.ranges) if name != HEADING]
        if len(commands.keep_probability) > len(names):
            what = f"{len(commands.keep_probability)} numbers, but there are {len(names)} commands: {', '.join(names)}"
            raise ConfigError(f"commands.keep_probability has {what}")
        for foot, geoms in self.asset.foot_geoms.items():
            if foot not in feet:
                raise ConfigError(f"asset.foot_geoms: {unknown('foot', foot, feet, 'asset.foot_names')}")
            if not geoms:
                raise ConfigError(f"asset.foot_geoms: foot '{foot}' has no geom; name the geoms that touch the ground")
        for kind in self.rewards.tracking_sigma_growth:
            if kind not in KINDS:
                named = unknown("kind of terrain", kind, KINDS, "the table of kinds")
                raise ConfigError(f"rewards.tracking_sigma_growth: {named}")
        if commands.curriculum and not self.to_dict()["rewards"]["scales"].get("tracking_lin_vel", 0.0) > 0:
            mend = "give rewards.scales.tracking_lin_vel a number above 0"
            raise ConfigError(f"commands.curriculum goes by how well tracking_lin_vel is met: {mend}")
