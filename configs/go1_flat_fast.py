"""go1_flat, ended after 400 iterations (52 M steps), with nothing annealed."""

from configs.go1_flat import Go1FlatCfg, Go1FlatCfgPPO
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.utils.task import Task


class Go1FlatFastCfgPPO(Go1FlatCfgPPO):
    class runner(Go1FlatCfgPPO.runner):
        max_iterations = 400  # 52 M steps
        save_interval = 30

    class anneal(Go1FlatCfgPPO.anneal):
        entropy_coef = 0.0  # stays
        desired_kl = 0.0  # stays


TASK = Task(LeggedRobot, Go1FlatCfg, Go1FlatFastCfgPPO)
