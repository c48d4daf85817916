"""All fields of RobotTask, with type, unit and source. Tasks override them in configs/.

Sources: [P] MuJoCo Playground's Go1 joystick task; [L] legged_gym; [ours] with the reason.
"A table a joint" maps keys to values. A joint has that of its exact name, else of the longest key in it, or of "".
"""

from __future__ import annotations

from typing import Annotated, Literal

from legged_mw.utils.bounds import (
    PAIR,
    THREE,
    Angle,
    Bound,
    Count,
    Gain,
    Height,
    Names,
    NonNegative,
    NonNegativeInt,
    Positive,
    PositiveRange,
    PositiveShare,
    Range,
    Scale,
    Seconds,
    Share,
    SmallInt,
    Speed,
    Threads,
    above,
    at_least,
    or_empty,
)
from legged_mw.utils.config import Config, ConfigError

# Ranges to draw from; an empty one draws nothing.
Factors = Annotated[list[Annotated[float, above(0, 1000)]], or_empty(PAIR)]
_FRICTION = Bound("from 1e-05, as which MuJoCo takes all below it, to 1000", lambda value: 1e-5 <= value <= 1000)
Frictions = Annotated[list[Annotated[float, _FRICTION]], or_empty(PAIR)]
Places = Annotated[list[Annotated[float, at_least(-10, 10, "m")]], or_empty(PAIR)]
ContactTimes = Annotated[list[Annotated[float, at_least(1e-4, 10, "s")]], or_empty(PAIR)]
Offsets = Annotated[list[float], or_empty(PAIR)]
Shares = Annotated[list[Share], or_empty(PAIR)]
Delays = Annotated[list[NonNegative], or_empty(PAIR)]
StepDelays = Annotated[list[NonNegativeInt], or_empty(PAIR)]
Place = Annotated[list[Annotated[float, at_least(-1000, 1000, "m")]], or_empty(THREE)]
_CAMERA = Bound("three numbers, not straight above or below", lambda v: len(v) == 3 and any(v[:2]))
Camera = Annotated[list[float], or_empty(_CAMERA)]
_PAIRS = Bound("pairs: lists of two names or patterns each", lambda v: all(len(pair) == 2 for pair in v))
Pairs = Annotated[list[list[str]], _PAIRS]
Kicks = Annotated[list[Annotated[float, at_least(-1000, 1000, "m/s")]], PAIR]
Tilt = Annotated[float, above(0, 180, "degrees")]
Slope = Annotated[float, at_least(-60, 60, "degrees")]
Slopes = Annotated[list[Slope], or_empty(PAIR)]
TimeStep = Annotated[float, at_least(1e-4, 0.1, "s")]
Pixels = Annotated[int, at_least(1, 8192)]


class RobotTaskCfg(Config):
    """The environment of any robot in any task."""

    class env:
        num_envs: Count = 4096  # worlds stepped together
        episode_length_s: Seconds = 20.0  # [s], then the episode times out [P]

    class asset:
        file: str = ""  # MJCF or URDF; relative to the folder of the config file, or to the repository
        imu_site: str = ""  # site or body fixed to the root; empty: "imu" if it is one, else the root's origin [ours]
        # geoms by name or pattern, or bodies by name (their colliding geoms), that touch the ground
        colliders: Names = ["*"]  # of those that collide in the file
        self_collisions: bool = False  # among the colliders
        penalize_contacts_on: list[str] = []  # as colliders: `collision` counts their bodies on the ground [L]
        terminate_after_contacts_on: list[str] = []  # as colliders: ground contact of one of them is a fall [L]
        # values to sense for your code, read by `env.sensor(name)`: contact_forces, self_contacts, angular_momentum,
        # com_velocity, or a sensor of the file by name; active reward terms add theirs
        sense: list[str] = []
        held_joints: list[str] = []  # names or patterns of joints that are welded at their default angle
        # tables a joint; joints without a key keep the file's
        effort: dict[str, Positive] = {}  # largest torque of the servo, in both directions [N m]
        armature: dict[str, Gain] = {}  # inertia of the rotor at the joint [kg m^2]
        frictionloss: dict[str, Gain] = {}  # dry friction [N m]
        joint_speed_limits: dict[str, Positive] = {}  # the motor's highest speed, for report and rewards only [rad/s]

    class init_state:
        # root at reset [m]; empty: feet as high as in the keyframe "home" (or the only one), or on the ground
        pos: Place = []
        # table a joint: the pose of action 0 [rad]; joints without a key have the angle of that keyframe
        default_joint_angles: dict[str, Angle] = {}
        dof_pos_range: Range = [1.0, 1.0]  # each joint at reset: default * U(low, high) [-] [P; L 0.5 to 1.5]
        dof_pos_offset: Range = [0.0, 0.0]  # added to each joint at reset, U(low, high), within its range [rad]
        dof_vel_range: Speed = 0.0  # each joint's velocity at reset, U(-range, range) [rad/s]
        pos_xy_range: NonNegative = 0.5  # root x and y + U(-range, range) [m] [P]
        yaw_range: NonNegative = 3.141592653589793  # U(-range, range) [rad] [P]
        lin_vel_range: Speed = 0.5  # root velocity, world frame, each axis U(-range, range) [m/s] [P]
        ang_vel_range: Speed = 0.5  # root angular velocity, body frame, each axis U(-range, range) [rad/s] [P]

    class control:
        # servo: kp (target - angle), damped in the joint; dc_motor: kp (target - angle) - kd speed, in a torque-speed
        # curve; torque: scale * action; network: torque from the weights in a file (docs/motors.md)
        actuator: Literal["servo", "dc_motor", "torque", "network"] = "servo"  # [P]
        stiffness: dict[str, Gain] = {}  # table a joint: position gain [N m/rad]
        damping: dict[str, Gain] = {}  # table a joint: passive damping; of a dc_motor its velocity gain [N m s/rad]
        # tables a joint of a torque-speed curve: dc_motor needs it; torque, network and a law in code may have it.
        # Torque at speed w: -stall_torque (1 + w / no_load_speed) to stall_torque (1 - w / no_load_speed), within
        # asset.effort
        stall_torque: dict[str, Positive] = {}  # [N m]
        no_load_speed: dict[str, Positive] = {}  # [rad/s]
        gear: dict[str, Positive] = {"": 1.0}  # motor speed / joint speed; 1: the curve is at the joint
        network: str = ""  # of `network`: an .npz, as `python -m legged_mw.robot.actuator_net` writes it
        network_digest: dict[str, str] = {}  # name -> SHA-256, by train.py; a changed file raises an error
        action_scale: Scale | dict[str, Scale] = 0.5  # target = origin + scale * action [rad, rad/s]; or a table [P]
        # the default pose, the measured angles or the last targets [P]; "speed", of a dc_motor: targets are speeds
        action_origin: Literal["default", "joints", "targets", "speed"] = "default"
        decimation: SmallInt = 5  # simulation steps per control step [P]

    class ratings:
        """Ratings of motors and battery, for heat and power in the exam and for `motor_heat`; empty: unknown.

        Tables a joint that may omit joints. All values are at the joint (docs/heat.md).
        """

        continuous_torque: dict[str, Positive] = {}  # RMS torque without a time limit [N m]
        # torque per root of the heat in the winding: torque constant * gear / sqrt(resistance) [N m/W^0.5]
        motor_constant: dict[str, Positive] = {}
        thermal_resistance: dict[str, Positive] = {}  # from the winding to the ambient air [K/W]
        thermal_time: dict[str, Positive] = {}  # time constant of the winding [s]
        peak_torque: dict[str, Positive] = {}  # up to knee_speed; unknown: the servo's largest torque [N m]
        knee_speed: dict[str, Positive] = {}  # speed from which the largest torque decreases to 0 at top_speed [rad/s]
        top_speed: dict[str, Positive] = {}  # without load [rad/s]
        battery_power: NonNegative = 0.0  # largest power of the battery; 0: unknown [W]

    class observations:
        leave_out: dict[str, list[str]] = {}  # group -> rows of the table to drop: {"state": ["base_lin_vel"]}
        history: dict[str, Count] = {}  # group, or "group.row" -> frames of each row, oldest first: {"state": 5}

    class termination:
        max_tilt: Tilt = 90.0  # [deg] between the root's z axis and the vertical; more is a fall [P]
        min_base_height: Height = 0.0  # [m] of the root above the ground under it; less is a fall; 0: no limit [ours]
        max_speed: Positive = 1.0e4  # [m/s, rad/s] of any degree of freedom; more counts as not finite [ours]

    class rewards:
        only_positive_rewards: bool = True  # clip the sum at 0: without it the robot learns to stand still [P, L]
        clip_termination: bool = False  # True: clip `termination` too: a fall costs nothing [P]; False [L]
        max_reward: Positive = 10000.0  # upper bound of the sum in a step [P]
        # share of a joint's range, about its middle [ours: P scales each bound, which can loosen it]
        soft_dof_pos_limit: PositiveShare = 0.95
        pose_weights: dict[str, NonNegative] = {"": 1.0}  # table a joint: weight in `pose` [-]
        base_height_target: Height = 0.0  # of `base_height`: of the root above the ground under it [m]
        hip_joints: list[str] = []  # of `hip_pos`: joints' names, patterns, or parts of names
        mirror_joints: Pairs = []  # of `joint_mirror`: pairs of joints, likewise: [["FR_", "RL_"], ["FL_", "RR_"]]
        deviation_weights: dict[str, NonNegative] = {"": 1.0}  # table a joint: weight in `joint_deviation` [-]
        soft_torque_limit: Positive = 0.9  # share of the force limit, of `torque_limits` [L: Cassie; L 1.0]
        soft_dof_vel_limit: Positive = 0.9  # share of asset.joint_speed_limits, of `dof_vel_limits` [L: Cassie; L 1.0]
        torques_as: Literal["norms", "squares"] = "norms"  # `torques`: 2-norm plus 1-norm [P], or sum of squares [L]

        class scales:
            """Reward terms: a number switches on the method _reward_<name>. A step's reward is number * dt * term."""

            _open = True

    class normalization:
        clip_actions: Positive = 2.0  # bound of the action that is applied, penalised and observed [ours: P has none]

    class noise:
        level: NonNegative = 1.0  # multiplies every scale; 0: no noise [P]

        class scales:
            """Half width of uniform noise on a row of `state`. All [P]."""

            lin_vel: NonNegative = 0.1  # [m/s]
            ang_vel: NonNegative = 0.2  # [rad/s]
            gravity: NonNegative = 0.05  # [-]
            dof_pos: NonNegative = 0.03  # [rad]
            dof_vel: NonNegative = 1.5  # [rad/s]

    class perturbation:
        """A kick is a force on the root, a half sine over the duration: one of dv changes its velocity by dv / pi.

        A push sets the velocity at once.
        """

        kick: bool = False  # [P]
        interval: PositiveRange = [1.0, 3.0]  # pause between kicks [s] [P]
        duration: PositiveRange = [0.05, 0.2]  # [s], at least two control steps [P]
        velocity: Kicks = [0.0, 3.0]  # dv in force = 0.5 sin(pi t / T) * mass * dv / T [m/s] [P]
        curriculum: bool = False  # dv of a world increases from 0 with the survived share of its episodes [ours]
        curriculum_rate: PositiveShare = 0.5  # change of that level per episode, as a share of the difference [ours]
        growth: Shares = []  # dv increases from 0 to full between these shares of a training; empty: always full [ours]
        push: bool = False  # set the root's horizontal velocity to a random one; with or without kicks [L]
        push_interval_s: Seconds = 15.0  # between pushes, with a separate clock in each world [s] [L]
        max_push_vel_xy: Speed = 1.0  # each axis U(-max, max) [m/s] [L]
        max_push_ang_vel: Speed = 0.0  # angular velocity, each axis U(-max, max); 0: none [rad/s] [humanoid-gym]

    class domain_rand:
        """What differs between worlds: ends of uniform distributions; an empty list leaves the model's value."""

        enable: bool = False  # [P]
        link_mass: Factors = [0.9, 1.1]  # factor on each link's mass and inertia [P; inertia ours]
        base_mass: Offsets = [-1.0, 1.0]  # added to the root's mass [kg]; inertia is proportional [P; inertia ours]
        base_com: Places = [-0.05, 0.05]  # added to the place of the root's centre of mass, each axis [m] [P]
        armature: Factors = [1.0, 1.05]  # factor on each joint's armature [P]
        friction: Frictions = [0.4, 1.0]  # sliding friction of the ground [-] [P]
        # time constant of ground contacts (solref), two simulation steps at least [s]: longer is softer; MuJoCo 0.02
        contact_time: ContactTimes = []
        frictionloss: Factors = [0.9, 1.1]  # factor on each joint's dry friction [P]
        stiffness: Factors = []  # factor on each servo's position gain
        damping: Factors = []  # factor on each joint's damping
        strength: Factors = []  # factor on each motor's force limit, asset.effort or the file's
        encoder_offset: Offsets = [-0.05, 0.05]  # each encoder's reading minus the true angle [rad] [P]
        stall_torque: Factors = []  # factor on each motor's control.stall_torque
        no_load_speed: Factors = []  # factor on each motor's control.no_load_speed
        action_delay: StepDelays = []  # control steps from an action to its servo, whole numbers, both ends included
        delay_ms: Delays = []  # from an action to its motor [ms], rounded to the nearest simulation step, halves up
        observation_delay: StepDelays = []  # age of the measured rows of `state`, in control steps
        slope: Slopes = []  # [deg] of the plane, downhill along x, in place of terrain.slope; headings are random
        model_factors: dict[str, Factors] = {}  # any other field of the model: a factor per world on all of it
        redraw_at_reset: list[str] = [  # drawn at every reset of a world; others are drawn once, at the start
            *["friction", "contact_time", "frictionloss", "stiffness", "damping", "strength", "stall_torque"],
            *["no_load_speed", "encoder_offset", "action_delay", "delay_ms", "observation_delay", "slope"],
        ]
        redraw_iterations: NonNegativeInt = 0  # [iterations] between draws of all values; a resume also draws; 0: never
        observe: bool = False  # add the drawn values as rows to `privileged_state`

    class terrain:
        friction: NonNegative = 0.6  # sliding friction of the ground, used instead of the robot's [-] [P]
        condim: Literal[1, 3, 4, 6] = 3  # contact dimensions: 3 is sliding without torsion [P]
        contact_time: NonNegative = 0.0  # [s] of its contacts (solref): longer is softer; 0: MuJoCo's 0.02 [ours]
        slope: Slope = 0.0  # [deg] of the plane, downhill along x: gravity leans, the plane and heights above it do not

    class sim:
        engine: Literal["auto", "mujoco_warp", "mujoco"] = "auto"  # auto: mujoco_warp on a GPU, MuJoCo's own on a CPU
        threads: Threads = 0  # of MuJoCo's own engine; 0: one per core
        dt: TimeStep = 0.004  # simulation step [s] [P]
        iterations: SmallInt = 1  # Newton iterations [P]
        ls_iterations: SmallInt = 5  # line-search iterations [P]
        integrator: Literal["euler", "implicitfast"] = "euler"  # [P]; implicitfast: any joint damping is stable
        fuse: bool = True  # compile the step's small operations into few kernels, equal to rounding [ours: docs/lab.md]
        nconmax: NonNegativeInt = 0  # contacts per world (mujoco_warp); 0: by the model [ours: sim/capacity.py]
        njmax: NonNegativeInt = 0  # constraint rows per world: friction, limits, contacts; more need memory and time

    class viewer:
        width: Pixels = 1280  # [pixel]
        height: Pixels = 720  # [pixel]
        camera: Camera = []  # camera "track", from the robot, world axes [m]; empty: by its size, Go1's is 0.9 -1.1 0.6
        fps: SmallInt = 25  # of videos [1/s]; the nearest rate that divides the control rate is taken

    def check(self) -> None:
        """Raise ConfigError for values that contradict each other. Types check single values."""
        self._check_motors()
        length, step = self.env.episode_length_s, self.sim.dt * self.control.decimation
        if length < step:
            raise ConfigError(f"env.episode_length_s is {length:g}, shorter than a control step of {step:g} s")

    def _check_motors(self) -> None:
        control, curve = self.control, self.control.stall_torque or self.control.no_load_speed
        law, origin = control.actuator, control.action_origin
        if law == "network" and not control.network:
            what = "but control.network names no file of weights (docs/motors.md)"
            raise ConfigError(f"control.actuator is 'network', {what}")
        if law != "dc_motor" and origin == "speed":
            mend = "only a 'dc_motor' is driven by a speed: name that one, or leave action_origin out"
            raise ConfigError(f"control.action_origin is 'speed', but control.actuator is {law!r}: {mend}")
        if law == "torque" and origin != "default":
            what = "an origin of angles, but under control.actuator 'torque' an action is a torque"
            raise ConfigError(f"control.action_origin is {origin!r}, {what}: leave action_origin out")
        for name, unit in (("stall_torque", "N m"), ("no_load_speed", "rad/s")):
            needed = law == "dc_motor" or (law != "servo" and curve)
            if needed and not getattr(control, name):
                what = f"control.actuator is {law!r} with a torque-speed curve, but control.{name} is empty"
                raise ConfigError(f"{what}: fill the table [{unit}] a joint, '' for all (docs/motors.md)")
            if self.domain_rand.enable and getattr(self.domain_rand, name) not in ([], [1.0, 1.0]) and not curve:
                what = f"domain_rand.{name} is a factor on control.{name}, which is empty"
                raise ConfigError(f"{what}: fill it, or leave the range out ([])")
