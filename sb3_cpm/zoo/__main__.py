"""
rl_zoo3's commands, with our algorithms among the choices of ``--algo`` and our environments registered::

    python -m sb3_cpm.zoo train --algo dreamer --env CPM/PickCube-v1
    python -m sb3_cpm.zoo train --agent cpm_sac --env CPM/PickCube-v1
    python -m sb3_cpm.zoo enjoy --algo dreamer --env CPM/PickCube-v1 --no-render
    python -m sb3_cpm.zoo train --agent sac_her --env PointMaze_UMaze-v3      gymnasium-robotics is imported

All options are rl_zoo3's own but one: ``--agent NAME`` stands for ``--algo ALGO --conf-file zoo_configs/NAME.yml``. And
``train --algo dreamer`` (or another of our algorithms) without ``--conf-file`` takes the file of that name: rl_zoo3 has none.
"""

import importlib
import sys
import traceback
from collections.abc import Sequence

from sb3_cpm.extras import needed

#: Commands, and the module and function where rl_zoo3 has them; a module without a function is a script.
COMMANDS = {
    "train": "rl_zoo3.train:train",
    "enjoy": "rl_zoo3.enjoy:enjoy",
    "record_video": "rl_zoo3.record_video:",
    "plot_train": "rl_zoo3.plots:plot_train",
    "plot_from_file": "rl_zoo3.plots:plot_from_file",
    "all_plots": "rl_zoo3.plots:all_plots",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """
    Run a command.

    :param arguments: of the command line, without the program's name; None for those of this process
    :return: exit status: 0 if all is well, 1 for errors that a message explains, 2 for a wrong command
    """
    command, *rest = list(sys.argv[1:] if arguments is None else arguments) or [""]
    if command not in COMMANDS:
        wants_help = command in ("", "-h", "--help")
        usage = f"usage: python -m sb3_cpm.zoo COMMAND ..., one of: {', '.join(COMMANDS)}\n"
        (sys.stdout if wants_help else sys.stderr).write(usage)
        return 0 if wants_help else 2
    from sb3_cpm.envs.suites import register_suite

    try:
        with needed("rl_zoo3's commands", "zoo"):
            import rl_zoo3  # noqa: F401

        rest = complete(command, rest)
        sys.argv = [f"{sys.argv[0]} {command}", *rest]
        register_suite(_option("--env", rest))
        _run(COMMANDS[command])
    except ValueError as error:
        if not _explains_itself(error):
            raise
        sys.stderr.write(f"error: {error}\n")
        return 1
    return 0


def _explains_itself(error: ValueError) -> bool:
    """Whether rl_zoo3 or we have refused what was asked for; whatever else a run fails of needs its traceback."""
    frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
    package = frames[-1].f_globals.get("__name__", "").partition(".")[0]
    return package in ("rl_zoo3", "sb3_cpm") and all(frame.f_code.co_name != "collect_rollouts" for frame in frames)


def _run(place: str) -> None:
    module_name, _, function = place.partition(":")
    if function:
        getattr(importlib.import_module(module_name), function)()
    else:  # a script
        import runpy

        runpy.run_module(module_name, run_name="__main__")


def _option(name: str, arguments: Sequence[str]) -> str:
    """What follows an option, "" where nothing does."""
    places = [place for place, argument in enumerate(arguments[:-1]) if argument == name]
    return arguments[places[0] + 1] if places else ""


def _names_config(argument: str) -> bool:
    """Whether it is rl_zoo3's option for the configuration, written out or in one of the short forms that argparse takes."""
    option = argument.partition("=")[0]
    return option.strip("-") != "" and any(name.startswith(option) for name in ("-conf", "--conf-file"))


def complete(command: str, arguments: Sequence[str]) -> list[str]:
    """
    :param command: one of :data:`COMMANDS`
    :param arguments: of the command line
    :return: the same with what rl_zoo3 needs in place of what we allow, ``--option=value`` as two
    :raises ValueError: for an agent that does not exist
    """
    from sb3_cpm.agents.algorithms import ALGORITHMS, algorithm_of
    from sb3_cpm.agents.configs import find_config

    completed = [part for argument in arguments for part in (argument.split("=", 1) if argument[:2] == "--" else [argument])]
    if "--agent" in completed:
        at = completed.index("--agent")
        if at + 1 == len(completed):
            raise ValueError("--agent needs the name of a file in zoo_configs/, or a path.")
        path = find_config(completed[at + 1])
        of_agent = ["--algo", algorithm_of(path.stem)]
        completed[at : at + 2] = [*of_agent, "--conf-file", str(path)] if command == "train" else of_agent
    algo = _option("--algo", completed)
    if command == "train" and algo in ALGORITHMS and not any(map(_names_config, completed)):
        completed += ["--conf-file", str(find_config(algo))]
    return completed


if __name__ == "__main__":
    sys.exit(main())
