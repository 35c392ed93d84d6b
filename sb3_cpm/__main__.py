"""
The command line: ``python -m sb3_cpm COMMAND``, of demo, train, two-stage, demonstrate, watch, reproduce, export,
doctor, setup-rendering and assets.

Everything heavy is imported by the command that needs it, so that ``--help`` and ``doctor`` answer at once and work on a
machine where something is missing.
"""

import argparse
import os
import sys
import textwrap
from collections.abc import Sequence
from dataclasses import MISSING, Field, fields
from typing import Any

from sb3_cpm import __version__
from sb3_cpm.extras import config_folder, install_command, needed
from sb3_cpm.run.settings import TrainSettings, field_documentation

EPILOG = """examples:
  python -m sb3_cpm train --agent cpm_rlpd_quick                PickCube-v1 from demonstrations, in minutes without a GPU
  python -m sb3_cpm train --agent cpm_sac_quick                 CPM-SAC on PickCube-v1 without, in half an hour
  python -m sb3_cpm train --env CPMToy-v0 --steps 3000          a small task that needs no renderer
  python -m sb3_cpm train --env Pendulum-v1 --agent cpm_td3     any gymnasium task with continuous actions
  python -m sb3_cpm train --env-kwargs image_size=64 cameras=[base_camera]
  python -m sb3_cpm train --resume runs/CPMToy-v0-cpm_sac-seed0 go on with a run that was cut off
  python -m sb3_cpm watch runs/CPMToy-v0-cpm_sac-seed0          what the world model of a run believes it will see
  python -m sb3_cpm reproduce --figure 4 --quick                an experiment of the report
"""
OVERVIEW = """sb3_cpm: a curious challenger beside your Stable-Baselines3 agent.

  python -m sb3_cpm demo                          plain SAC and the same with a challenger, one picture, a minute or two
  python -m sb3_cpm train --env CPMToy-v0         a small task, a folder of curves, challenges and a video (minutes)
  python -m sb3_cpm train --agent cpm_rlpd_quick  a robot that picks up a cube, from demonstrations (minutes)
  python -m sb3_cpm train --resume runs/FOLDER    go on with a run that was cut off
  python -m sb3_cpm watch runs/FOLDER             what its world model expects to see, beside what happened
  python -m sb3_cpm demonstrate --env PickCube-v1 episodes of a scripted expert in a file
  python -m sb3_cpm reproduce --list              all experiments and figures, with their cost
  python -m sb3_cpm doctor                        what works on this machine, and the cure for what does not

Agents ({agents}): zoo_configs/.
In your own code it is two lines: docs/quickstart.md. All options of a command: python -m sb3_cpm COMMAND --help
"""
CHOICES = {"unit": ("step", "segment", "episode")}
#: Of settings without a default.
TYPES = {
    **dict.fromkeys(("challenge_ratio", "learning_rate", "gamma", "tau"), float),
    **dict.fromkeys(("steps", "n_envs", "buffer_size", "batch_size", "train_freq", "gradient_steps", "learning_starts"), int),
    **dict.fromkeys(("challenger_train_freq", "challenger_gradient_steps"), int),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """
    Run a command.

    :param arguments: of the command line, without the program's name; None for those of this process
    :return: exit status: 0 if all is well (without arguments it shows what there is), 1 for errors that a message explains,
        130 after Ctrl-C
    """
    given = sys.argv[1:] if arguments is None else arguments
    options = vars(make_parser().parse_args(given)) if given else {"command": _overview}
    command = options.pop("command")
    try:
        return command(**options)
    except BrokenPipeError:  # whoever reads our lines, as `head`, has enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except KeyboardInterrupt:
        return 130
    except (ValueError, RuntimeError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        from sb3_cpm.files import NotWrittenError

        if not isinstance(error, NotWrittenError):
            raise
        print(f"error: {error}", file=sys.stderr)
        return 1


def _overview() -> int:
    """What one can do, on one screen."""
    names = sorted(path.stem for path in config_folder().glob("*.yml"))
    print(OVERVIEW.format(agents=textwrap.fill(", ".join(names), 110, subsequent_indent="  ")).rstrip())
    return 0


def make_parser() -> argparse.ArgumentParser:
    """:return: the parser of all commands"""
    parser = argparse.ArgumentParser(prog="sb3-cpm", description="CPM: a challenger and a player for Stable-Baselines3.")
    parser.add_argument("--version", action="version", version=f"sb3_cpm {__version__}")
    commands = parser.add_subparsers(required=True, metavar="command")

    demo = commands.add_parser(
        "demo",
        help="plain SAC and the same with a challenger on a sparse task: one picture, two minutes, no renderer",
        description="Train plain SAC and the same SAC with a challenger on MountainCarContinuous-v0, side by side, and draw "
        "where both have been and who has found the reward.",
    )
    demo.add_argument("--folder", default="runs/demo", help="for demo.png and demo.json (default: runs/demo)")
    demo.add_argument("--steps", type=int, default=5000, help="environment steps of each (default: 5000)")
    demo.add_argument("--seed", type=int, default=0, help="of both (default: 0)")
    demo.set_defaults(command=_demo)

    train = commands.add_parser(
        "train",
        help="train on a task and leave a folder of results",
        description="Train a player and its challenger, and leave a folder with models, curves, gallery and video.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    train.set_defaults(command=_train)
    documentation = field_documentation()
    for setting in fields(TrainSettings):
        _add_option(train, setting, documentation[setting.name].replace("%", "%%"))

    two_stage = commands.add_parser(
        "two-stage",
        help="train an agent in two stages, the second from the first's best checkpoint",
        description="Train an agent with evaluations, go on from the best checkpoint with shorter rounds and smaller batches, "
        "and take the best of all. The same command goes on where it was cut off.",
    )
    two_stage.add_argument("agent", metavar="AGENT", help="the name of a file in zoo_configs/, or the path of one")
    two_stage.add_argument("--env", required=True, help="a task, as for train")
    two_stage.add_argument("--steps", type=int, help="of both stages together (default: as the agent's file says)")
    two_stage.add_argument("--seed", type=int, default=0, help="rules both stages (default: 0)")
    two_stage.add_argument("--folder", help="for checkpoints and result.json (default: below runs/)")
    two_stage.add_argument("--split", type=float, default=0.5, help="share of the steps that are stage one's (default: 0.5)")
    two_stage.add_argument("--patience", type=int, help="evaluations without a new best that end stage one (default: none)")
    two_stage.add_argument("--eval-every", type=int, default=20_000, help="steps between evaluations (default: 20000)")
    two_stage.add_argument("--eval-episodes", type=int, default=100, help="episodes of each (default: 100)")
    two_stage.add_argument("--test-episodes", type=int, default=100, help="episodes of the last one (default: 100)")
    two_stage.add_argument("--device", default="auto", help="PyTorch device (default: auto)")
    changes = "what differs in stage two, as n_steps=4375 batch_size=297 (default: 7/8 of n_steps, 9/10 of batch_size)"
    _add_key_values(two_stage, "--second", changes)
    _add_key_values(two_stage, "--overrides", "entries that win over those of the agent's file")
    two_stage.set_defaults(command=_two_stage)

    demonstrate = commands.add_parser(
        "demonstrate",
        help="record demonstrations of a task's scripted expert",
        description="Let the scripted expert of a task play, and write what an agent's training will see (cameras, cloud, "
        "state) with actions and rewards into a file as ManiSkill has them, for add_demonstrations, clone and agents.",
    )
    demonstrate.add_argument("--env", required=True, help="a task, as for train")
    demonstrate.add_argument("--episodes", type=int, default=200, help="with a success (default: 200)")
    demonstrate.add_argument("--agent", default="bc_ppo", help="whose file says how the task is made (default: bc_ppo)")
    demonstrate.add_argument("--output", metavar="FILE", help="the .h5 file (default: named after task and number, in demos/)")
    demonstrate.add_argument("--seed", type=int, default=0, help="of the environments (default: 0)")
    demonstrate.add_argument("--n-envs", type=int, default=1, help="parallel environments (default: 1)")
    demonstrate.add_argument("--hold", action="store_true", help="go on to the end of each episode, holding what was reached")
    demonstrate.add_argument("--overwrite", action="store_true", help="replace a file that is there")
    _add_key_values(demonstrate, "--env-kwargs", "arguments of the environment")
    demonstrate.set_defaults(command=_demonstrate)

    watch = commands.add_parser(
        "watch",
        help="draw what the world model of a run believes it will see",
        description="Show episodes of a run's replay buffer to its challenger for a few frames, and draw what it imagines "
        "from there on beside the truth: film strips, animations, errors, KL, novelty. Writes RUN_FOLDER/watch.",
    )
    watch.add_argument("run_folder", metavar="RUN_FOLDER", help="of a run that has ended")
    watch.add_argument("--episodes", type=int, default=2, help="episodes, spread over the replay buffer (default: 2)")
    watch.add_argument("--context", type=int, default=5, help="states that the model is shown at first (default: 5)")
    watch.add_argument("--frames", type=int, default=50, help="states in all, at most 64 (default: 50)")
    watch.add_argument("--device", default="auto", help="PyTorch device (default: auto)")
    watch.set_defaults(command=_watch)

    reproduce = commands.add_parser(
        "reproduce",
        help="run an experiment of the report and draw its figure",
        description="Run the agents, tasks and seeds that a figure of the report needs, skip what is there, go on with what "
        "was cut off, and draw the figure from the CSV files below the folder of results.",
    )
    which = reproduce.add_mutually_exclusive_group(required=True)
    which.add_argument("--figure", metavar="N|NAME", help="number of the report's figure, or name of an experiment")
    which.add_argument("--list", action="store_true", help="all experiments with their cost")
    size = reproduce.add_mutually_exclusive_group()
    for version, text in (
        ("quick", "that takes minutes on two cores"),
        ("short", "on the same tasks that two cores can bear"),
    ):
        size.add_argument(
            f"--{version}", dest="version", action="store_const", const=version, default="full", help=f"a version {text}"
        )
    reproduce.add_argument("--seeds", type=int, help="how many (default: as planned)")
    reproduce.add_argument("--agents", nargs="+", metavar="NAME", help="run only these, as the figure names them")
    reproduce.add_argument("--tasks", nargs="+", metavar="NAME", help="run only these, as the figure names them")
    reproduce.add_argument("--steps", type=int, help="of each run, to try something; kept apart (default: as planned)")
    reproduce.add_argument("--jobs", type=int, default=1, help="processes at a time; 0: in this process (default: 1)")
    reproduce.add_argument("--results", default="results", help="folder of all results (default: results)")
    reproduce.add_argument("--draw-only", action="store_true", help="run nothing, draw what is there")
    reproduce.add_argument("--device", default="cpu", help="PyTorch device (default: cpu)")
    reproduce.set_defaults(command=_reproduce)

    export = commands.add_parser(
        "export",
        help="write the player of a run as an ONNX graph",
        description="Write the way from observations to the deterministic action of a run's player as an ONNX graph, "
        "statistics of a VecNormalize included: for robots and programs that have no PyTorch.",
    )
    export.add_argument("run_folder", metavar="RUN_FOLDER", help="of a run of train")
    export.add_argument("--output", metavar="FILE", help="the .onnx file (default: player.onnx in the folder)")
    export.set_defaults(command=_export)

    doctor = commands.add_parser("doctor", help="what works on this machine, and the cure for what doesn't")
    doctor.set_defaults(command=_doctor)

    rendering = commands.add_parser(
        "setup-rendering",
        help="find a Vulkan device that can render, or install software Vulkan",
        description="Find a Vulkan device that ManiSkill can render with; where there is none, install software Vulkan into "
        "a folder of this user's, or for the whole machine. Can be repeated.",
    )
    where = rendering.add_mutually_exclusive_group()
    where.add_argument("--private", action="store_true", help="install privately even where the machine's own driver works")
    where.add_argument(
        "--system",
        action="store_true",
        help="install for the whole machine, as root: packages with apt and, on Debian 12, its backports suite as a new "
        "source of packages in /etc/apt/sources.list.d",
    )
    rendering.set_defaults(command=_setup_rendering)

    assets = commands.add_parser(
        "assets",
        help="the files that ManiSkill's tasks need: whether they are there, and how to get them",
        description="List the tasks of the report (or those named), the files that they need, whether these are there and "
        "complete, and the command that gets them. Exit status 1 if something is wanting.",
    )
    assets.add_argument("env_ids", nargs="*", metavar="TASK", help="for instance PickSingleYCB-v1; by default the report's")
    assets.add_argument("--download", action="store_true", help="get what is missing or damaged first; asks nothing")
    assets.set_defaults(command=_assets)
    return parser


def _add_option(parser: argparse.ArgumentParser, setting: "Field[Any]", text: str) -> None:
    """An option for a setting of :class:`TrainSettings`, with its documentation."""
    flag = "--" + setting.name.replace("_", "-")
    if setting.default_factory is not MISSING:  # the dicts
        _add_key_values(parser, flag, text)
        return
    default = setting.default
    shown = "" if default is None else f" (default: {default})"
    if isinstance(default, bool) or setting.name == "progress_bar":
        parser.add_argument(flag, action=argparse.BooleanOptionalAction, default=default, help=text + shown)
        return
    kind = TYPES.get(setting.name, str if default is None else type(default))
    choices = CHOICES.get(setting.name)
    metavar = None if choices else kind.__name__.upper()
    parser.add_argument(flag, type=kind, default=default, choices=choices, metavar=metavar, help=text + shown)


def _add_key_values(parser: argparse.ArgumentParser, flag: str, text: str) -> None:
    """An option that makes a dict."""
    parser.add_argument(flag, nargs="+", default={}, metavar="NAME=VALUE", action=_KeyValues, help=text)


class _KeyValues(argparse.Action):
    """``a=1 b=[x,y]`` becomes ``{"a": 1, "b": ["x", "y"]}``; values are read as YAML."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: str | Sequence[Any] | None,
        option_string: str | None = None,
    ) -> None:
        import yaml

        found = dict(getattr(namespace, self.dest))
        for pair in values or ():
            name, sign, value = str(pair).partition("=")
            if not sign or not name:
                parser.error(f"{option_string} {pair}: expected NAME=VALUE")
            try:
                found[name] = yaml.safe_load(value)
            except yaml.YAMLError as error:
                parser.error(f"{option_string} {pair}: the value is not YAML ({error})")
        setattr(namespace, self.dest, found)


def _demo(**arguments: Any) -> int:
    with needed("The demo", "run"):
        from rich.console import Console

        from sb3_cpm.run.demo import demo
    demo(**arguments, tell=lambda news: print(news, flush=True), status=Console(stderr=True).status)
    return 0


def _train(**settings: Any) -> int:
    with needed("Runs", "run"):
        from sb3_cpm.run.training import train
    train(TrainSettings(**settings))
    return 0


def _two_stage(agent: str, env: str, second: dict[str, Any], **arguments: Any) -> int:
    with needed("Runs", "run"):
        from sb3_cpm.run.signals import sigterm_raises
        from sb3_cpm.run.two_stage import two_stage_agent
    with sigterm_raises():
        result = two_stage_agent(agent, env, second=second or None, tell=print, **arguments)
    print(f"The model is {result.checkpoint / 'model.zip'}")
    return 0


def _demonstrate(**arguments: Any) -> int:
    with needed("Recording", "run"):
        from sb3_cpm.run.demonstrate import demonstrate
    demonstrate(**arguments, progress_bar=sys.stderr.isatty(), tell=print)
    return 0


def _watch(**arguments: Any) -> int:
    with needed("Pictures of dreams", "run"):
        from sb3_cpm.run.watch import watch
    watched = watch(**arguments)
    print(watched.text)
    print("\nDrawn: " + ", ".join(str(file) for file in watched.files))
    return 0


def _reproduce(figure: str | None, list: bool, **arguments: Any) -> int:
    try:
        # also what only the runs need: they are counted before anything else is done
        with needed("Experiments", "experiments"):
            from sb3_cpm import experiments
            from sb3_cpm.run.signals import sigterm_raises

            if list or figure is None:
                print(experiments.listing())
                return 0
            if arguments["device"] != "cpu":
                from sb3_cpm.run.execution import check_device

                check_device(arguments["device"])
            with sigterm_raises():
                return experiments.reproduce(figure, **arguments)
    except BrokenPipeError:
        raise
    except (KeyboardInterrupt, SystemExit):
        print("Cut off. The same command goes on: with what is unfinished, from its newest checkpoint.", file=sys.stderr)
        raise
    except OSError as error:  # a disk that is full or must not be written; what was written before stays
        raise RuntimeError(
            f"{error}. What is finished is kept: free the disk or choose another --results, then call it again."
        ) from error


def _export(run_folder: str, output: str | None) -> int:
    with needed("Runs", "run"):
        from sb3_cpm.run.export import export_run
    path, inputs = export_run(run_folder, output)
    shapes = ", ".join(f"{name} {('batch', *shape)}" for name, shape in inputs.items()).replace("'", "")
    print(f"{path}: {shapes} -> action")
    return 0


def _doctor() -> int:
    from sb3_cpm.machine.doctor import run_doctor

    return run_doctor()


def _setup_rendering(private: bool, system: bool) -> int:
    from sb3_cpm.machine.rendering import setup_rendering

    return setup_rendering(private=private, system=system)


def _assets(env_ids: list[str], download: bool) -> int:
    try:
        from sb3_cpm.envs.maniskill import assets
        from sb3_cpm.machine import vulkan

        vulkan.activate_private()  # libraries that SAPIEN and OpenCV need
        if download:
            for line in assets.download(env_ids):
                print(line, flush=True)
        rows = list(assets.report(env_ids))
    except ImportError as error:
        cure = install_command("maniskill")
        raise RuntimeError(f"The tasks need a package that is missing ({error}): {cure}") from error
    for _, line in rows:
        print(line)
    return 0 if all(ready for ready, _ in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
