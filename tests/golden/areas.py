"""The areas, each a module beside this one with a function ``table``."""

AREAS = [
    "cli_deploy",
    "cli_tools",
    "cli_train",
    "config_classes",
    "contract",
    "driving",
    "exports",
    "files",
    "motions",
    "motors",
    "outputs",
    "own_code",
    "robot_files",
    "strangers",
    "terrain",
    "numbers",
    "robots",
    "tasks",
    "watching",
    "yaml_files",
]
