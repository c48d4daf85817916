"""The robots, one per file: the config that all tasks of a robot share. The bases of a task are a robot and a skill."""
