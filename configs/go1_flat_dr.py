"""go1_flat in randomized worlds: masses, ground, motors, encoders, a delay of up to 20 ms; with pushes and kicks."""

from configs.go1_flat import Go1FlatCfg, Go1FlatCfgPPO
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.utils.task import Task


class Go1FlatDrCfg(Go1FlatCfg):
    class domain_rand(Go1FlatCfg.domain_rand):  # the section's own ranges are MuJoCo Playground's [P]
        enable = observe = True  # for the critic
        base_mass = [-1.0, 3.0]  # [kg] [P -1 to 1; ours: a payload]
        stiffness = damping = [0.8, 1.2]  # [ours]
        strength = [0.9, 1.1]  # [ours]
        action_delay = [0, 1]  # control steps of 20 ms [ours]

    class perturbation(Go1FlatCfg.perturbation):
        push = True  # [L]


TASK = Task(LeggedRobot, Go1FlatDrCfg, Go1FlatCfgPPO)
