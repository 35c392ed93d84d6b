"""What a run is made of: plain data that is written into the run folder, so that the run can be repeated."""

import re
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

from sb3_cpm.seeds import check_seed

ALGORITHMS = ("sac", "td3", "tqc")

#: What differs from the defaults below, for tasks that the package knows.
TASK_DEFAULTS: dict[str, dict[str, Any]] = {
    "PickCube-v1": {
        "steps": 5000,
        "gamma": 0.8,
        "tau": 0.01,
        "ent_coef": "auto_0.01",
        # an episode goes on after success: else, with rewards above zero, hovering beside the goal pays more than success
        "env_kwargs": {"ignore_terminations": True},
    },
    "CPMToy-v0": {"steps": 2000, "gamma": 0.9, "tau": 0.01},
}


@dataclass(frozen=True)
class TrainSettings:
    """
    Settings of :func:`~sb3_cpm.run.training.train`.

    :param env: a ManiSkill task, ``CPMToy-v0``, or any gymnasium id with continuous actions; ``MODULE:ID`` imports first what
        registers it
    :param steps: environment steps to train for, over all environments; None: the task's own number, else 10000
    :param seed: rules the whole run; below 1000000, where the seeds of the evaluation begin
    :param run_folder: where the results go; None: the next free name below ``runs/``
    :param n_envs: parallel environments, in processes of their own when more than one
    :param algorithm: the player: ``"sac"``, ``"td3"`` or ``"tqc"`` (needs sb3-contrib)
    :param preset: sizes of the challenger, see :mod:`sb3_cpm.presets`
    :param decay: how the exploration probability falls, see :func:`~sb3_cpm.exploration.make_decay`
    :param unit: who acts is drawn per ``"step"``, ``"segment"`` or ``"episode"``
    :param challenge_ratio: share of the player's batches that come from challenges
    :param buffer_size: transitions that D holds; None: all of the run, 20000 at most, or two episodes of each environment if
        that is more
    :param batch_size: of the player
    :param learning_rate: of the player
    :param gamma: discount factor of the player; None: the task's own, else 0.99
    :param tau: soft update of the player's target networks; None: the task's own, else 0.005
    :param ent_coef: entropy coefficient of SAC and TQC; None: the task's own, else "auto_0.05". The rewards of normalized
        tasks are small: beside SB3's first value of 1 a short run would see nothing but entropy
    :param train_freq: environment steps between two updates of the player
    :param gradient_steps: updates then
    :param learning_starts: steps before the first update; None: four episodes, or half of the run if that is less and an
        episode fits in
    :param challenger_train_freq: environment steps between two updates of the challenger
    :param challenger_gradient_steps: updates then
    :param evaluations: how often the deterministic player is evaluated, start and end included; 0 for never
    :param eval_episodes: episodes of each evaluation, always with the same seeds, which training never uses
    :param video: film an episode at the end
    :param device: PyTorch device
    :param threads: of torch on the CPU; more than one rarely pays at these sizes
    :param progress_bar: None: where the terminal can show one
    :param env_kwargs: arguments of the environment
    :param model_kwargs: further arguments of the SB3 algorithm
    :param buffer_kwargs: further arguments of ``CPMBuffer``
    :param callback_kwargs: further arguments of ``ChallengerCallback``
    """

    env: str = "PickCube-v1"
    steps: int | None = None
    seed: int = 0
    run_folder: str | None = None
    n_envs: int = 1
    algorithm: str = "sac"
    preset: str = "default"
    decay: str = "linear"
    unit: str = "segment"
    challenge_ratio: float = 0.25
    buffer_size: int | None = None
    batch_size: int = 64
    learning_rate: float = 3e-4
    gamma: float | None = None
    tau: float | None = None
    ent_coef: str | None = None
    train_freq: int = 1
    gradient_steps: int = 1
    learning_starts: int | None = None
    challenger_train_freq: int = 8
    challenger_gradient_steps: int = 1
    evaluations: int = 6
    eval_episodes: int = 5
    video: bool = True
    device: str = "auto"
    threads: int = 1
    progress_bar: bool | None = None
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    model_kwargs: dict[str, Any] = field(default_factory=dict)
    buffer_kwargs: dict[str, Any] = field(default_factory=dict)
    callback_kwargs: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.algorithm not in ALGORITHMS:
            raise ValueError(f"algorithm={self.algorithm!r}: expected one of {ALGORITHMS}")
        for name in ("n_envs", "batch_size", "train_freq", "challenger_train_freq", "threads"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)}: expected 1 or more")
        check_seed(self.seed, self.n_envs)
        if self.steps is not None and self.steps < 1:
            raise ValueError(f"steps={self.steps}: expected 1 or more")
        if self.evaluations < 0 or (self.evaluations and self.eval_episodes < 1):
            raise ValueError(
                f"evaluations={self.evaluations} with eval_episodes={self.eval_episodes}: expected at least one episode each, "
                "or evaluations=0 for none"
            )

    def resolved(self) -> "TrainSettings":
        """:return: the same with the task's own defaults in place of None"""
        task = TASK_DEFAULTS.get(self.env.rpartition(":")[2], {})
        own = {name: value for name, value in task.items() if name != "env_kwargs" and getattr(self, name) is None}
        settings = replace(self, **own, env_kwargs={**task.get("env_kwargs", {}), **self.env_kwargs})
        steps = settings.steps or 10_000
        return replace(
            settings,
            steps=steps,
            gamma=0.99 if settings.gamma is None else settings.gamma,
            tau=0.005 if settings.tau is None else settings.tau,
            ent_coef="auto_0.05" if settings.ent_coef is None else settings.ent_coef,
        )

    def as_dict(self) -> dict[str, Any]:
        """:return: plain data, for config.yml"""
        return asdict(self)


def field_documentation() -> dict[str, str]:
    """:return: what the docstring says about every setting, for ``--help``"""
    documentation: dict[str, str] = {}
    name = ""
    for line in (TrainSettings.__doc__ or "").splitlines():
        text = line.strip()
        if text.startswith(":param "):
            name, _, text = text.removeprefix(":param ").partition(": ")
            documentation[name] = text
        elif name and text:
            documentation[name] += " " + text
    known = {setting.name for setting in fields(TrainSettings)}
    return {name: _plain(text) for name, text in documentation.items() if name in known}


def _plain(text: str) -> str:
    """Without markup, and with "default" for None, which nobody types on a command line."""
    text = re.sub(r":\w+:`~?([^`]*)`", r"\1", text).replace("``", "")
    return re.sub(r"\bNone: ", "default: ", text)
