"""What the command line of ``train`` takes: which agent on which task, and what of it is to be different."""

import re
from dataclasses import dataclass, field, fields
from typing import Any

#: Settings that the agent's file has entries for, under the same names.
_HYPERPARAMETERS = (
    *("n_envs", "buffer_size", "batch_size", "learning_rate", "gamma", "tau", "ent_coef", "train_freq", "gradient_steps"),
    "learning_starts",
)
#: Settings that are arguments of :class:`~sb3_cpm.callbacks.ChallengerCallback`, and their names there.
_CALLBACK = {
    **{name: name for name in ("preset", "decay", "unit")},
    "challenger_train_freq": "train_freq",
    "challenger_gradient_steps": "gradient_steps",
}
#: What a resumed run may be given.
WITH_RESUME = ("resume", "device", "threads", "video", "progress_bar")


@dataclass(frozen=True)
class TrainSettings:
    """
    Settings of :func:`~sb3_cpm.run.training.train`. Those without a default take what the agent's file in ``zoo_configs/`` has
    for the task; those that are given win over it.

    :param env: a task: ``CPM/PickCube-v1`` (or shorter ``PickCube-v1``), ``CPMToy-v0``, any gymnasium id with continuous
        actions, or ``MODULE:ID``, which imports first what registers it
    :param agent: what learns: the name of a file in ``zoo_configs/``, or the path of one
    :param steps: environment steps to train for, over all environments
    :param seed: rules the whole run; below 1000000, where the seeds of the evaluation begin
    :param run_folder: where the results go; None: the next free name below ``runs/``
    :param resume: the folder of a run that was cut off, which goes on from its newest checkpoint
    :param n_envs: parallel environments, in processes of their own when more than one
    :param preset: sizes of the challenger, see :mod:`sb3_cpm.presets`
    :param decay: how the exploration probability falls, see :func:`~sb3_cpm.exploration.make_decay`
    :param unit: who acts is drawn per ``"step"``, ``"segment"`` or ``"episode"``
    :param challenge_ratio: share of the player's batches that come from challenges
    :param buffer_size: transitions that D holds
    :param batch_size: of the player
    :param learning_rate: of the player
    :param gamma: discount factor of the player
    :param tau: soft update of the player's target networks
    :param ent_coef: entropy coefficient of SAC and TQC
    :param train_freq: environment steps between two updates of the player
    :param gradient_steps: updates then
    :param learning_starts: steps before the first update
    :param challenger_train_freq: environment steps between two updates of the challenger
    :param challenger_gradient_steps: updates then
    :param evaluations: how often the deterministic player is evaluated, start and end included; 0 for never
    :param eval_episodes: episodes of each evaluation, always with the same seeds, which training never uses
    :param checkpoint_freq: environment steps between two checkpoints, from which a run that was cut off goes on. Each begins
        new episodes: best is a multiple of an episode's length times the number of environments
    :param video: film an episode at the end
    :param device: PyTorch device
    :param threads: of torch on the CPU; more than one rarely pays at these sizes
    :param progress_bar: None: where the terminal can show one
    :param env_kwargs: arguments of the environment
    :param model_kwargs: further entries of the agent, such as arguments of the SB3 algorithm
    :param buffer_kwargs: further arguments of ``CPMBuffer``
    :param callback_kwargs: further arguments of ``ChallengerCallback``
    :raises ValueError: for values that cannot work
    """

    env: str = "CPM/PickCube-v1"
    agent: str = "cpm_sac"
    steps: int | None = None
    seed: int = 0
    run_folder: str | None = None
    resume: str | None = None
    n_envs: int | None = None
    preset: str | None = None
    decay: str | None = None
    unit: str | None = None
    challenge_ratio: float | None = None
    buffer_size: int | None = None
    batch_size: int | None = None
    learning_rate: float | None = None
    gamma: float | None = None
    tau: float | None = None
    ent_coef: str | None = None
    train_freq: int | None = None
    gradient_steps: int | None = None
    learning_starts: int | None = None
    challenger_train_freq: int | None = None
    challenger_gradient_steps: int | None = None
    evaluations: int = 6
    eval_episodes: int = 5
    checkpoint_freq: int = 1000
    video: bool = True
    device: str = "auto"
    threads: int = 1
    progress_bar: bool | None = None
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    model_kwargs: dict[str, Any] = field(default_factory=dict)
    buffer_kwargs: dict[str, Any] = field(default_factory=dict)
    callback_kwargs: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("steps", "n_envs", "batch_size", "train_freq", "challenger_train_freq", "checkpoint_freq", "threads"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"{name}={value}: expected 1 or more")
        if self.seed < 0:
            raise ValueError(f"seed={self.seed}: expected 0 or more")
        if self.evaluations < 0 or self.evaluations == 1 or (self.evaluations and self.eval_episodes < 1):
            raise ValueError(
                f"evaluations={self.evaluations} with eval_episodes={self.eval_episodes}: expected two evaluations or more, "
                "at the start and at the end, of at least one episode each, or evaluations=0 for none"
            )
        if self.resume is not None:
            changed = [one.name for one in fields(self) if getattr(self, one.name) != _default(one)]
            others = [name for name in changed if name not in WITH_RESUME]
            if others:
                raise ValueError(
                    f"resume={self.resume!r} goes on with that run as it is, but {', '.join(others)} came with it. Expected "
                    f"beside it only {', '.join(WITH_RESUME[1:])}: leave the others out, or begin a new run with them"
                )

    def overrides(self) -> dict[str, Any]:
        """:return: entries that win over those of the agent's file"""
        entries: dict[str, Any] = {name: getattr(self, name) for name in _HYPERPARAMETERS if getattr(self, name) is not None}
        coefficient = entries.get("ent_coef")
        if coefficient is not None and not coefficient.startswith("auto"):
            entries["ent_coef"] = float(coefficient)
        entries.update(self.model_kwargs)
        buffer = {} if self.challenge_ratio is None else {"challenge_ratio": self.challenge_ratio}
        callback = {theirs: getattr(self, ours) for ours, theirs in _CALLBACK.items() if getattr(self, ours) is not None}
        nested = {
            "env_kwargs": self.env_kwargs,
            "replay_buffer_kwargs": {**buffer, **self.buffer_kwargs},
            "callback": _of_challenger({**callback, **self.callback_kwargs}),
        }
        return {**entries, **{name: arguments for name, arguments in nested.items() if arguments}}

    def as_dict(self) -> dict[str, Any]:
        """:return: the settings by name"""
        return {one.name: getattr(self, one.name) for one in fields(self)}


def _of_challenger(arguments: dict[str, Any]) -> dict[str, Any]:
    return {"sb3_cpm.ChallengerCallback": arguments} if arguments else {}


def _default(setting: Any) -> Any:
    return setting.default_factory() if callable(setting.default_factory) else setting.default


def field_documentation() -> dict[str, str]:
    """:return: what the docstring says about every setting, for ``--help``"""
    documentation: dict[str, str] = {}
    name = ""
    for line in (TrainSettings.__doc__ or "").splitlines():
        text = line.strip()
        if text.startswith(":param "):
            name, _, text = text.removeprefix(":param ").partition(": ")
            documentation[name] = text
        elif text.startswith(":raises"):
            name = ""
        elif name and text:
            documentation[name] += " " + text
    known = {setting.name for setting in fields(TrainSettings)}
    return {name: _plain(text) for name, text in documentation.items() if name in known}


def _plain(text: str) -> str:
    """Without markup, and with "default" for None, which nobody types on a command line."""
    text = re.sub(r":\w+:`~?([^`]*)`", r"\1", text).replace("``", "")
    return re.sub(r"\bNone: ", "default: ", text)
