"""What a run, its outcome and an experiment are: plain data."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from sb3_cpm.arguments import nearest
from sb3_cpm.run.specification import RunSpec
from sb3_cpm.seeds import FIRST_SEED

#: How much of an experiment is run: as planned; on its own tasks, but as few steps as two cores can bear; in minutes.
VERSIONS = ("full", "short", "quick")
#: Between a version and the number of steps of a trial of it, ``"short-steps500"``.
TRIAL = "-steps"


def of_version(name: str, version: str) -> str:
    """:return: what a version's results and figure are called: as the experiment where it is the full one"""
    return name + f"-{version}".removeprefix("-full")


def options_of(version: str) -> str:
    """:return: what ``python -m sb3_cpm reproduce`` has to be given for a version, with a space before each option"""
    planned, trial, steps = version.partition(TRIAL)
    return ("" if planned == "full" else f" --{planned}") + (f" --steps {steps}" if trial else "")


class RunResult(NamedTuple):
    """
    What became of a run.

    :param spec: the run
    :param outcome: ``"finished"``, ``"skipped"`` (its result was there), ``"unchecked"`` (it was there, but what is asked for
        cannot be read, to compare them), ``"refused"`` or ``"crashed"``
    :param message: what else there is to say
    :param folder: where its results are
    """

    spec: RunSpec
    outcome: str
    message: str
    folder: Path


@dataclass(frozen=True)
class Contender:
    """
    An agent under the name that the figure's legend has.

    :param name: e.g. ``"CPM-SAC"``; also the name of a folder
    :param config: its file in ``zoo_configs/``
    :param overrides: hyperparameters that differ from the file's
    """

    name: str
    config: str
    overrides: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Task:
    """
    An environment under the name that the figure's panels have.

    :param name: also the name of a folder
    :param env_id: a gymnasium id
    :param overrides: hyperparameters that all agents get here, most often ``env_kwargs``
    """

    name: str
    env_id: str
    overrides: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Plan:
    """
    How much is run.

    :param tasks: every contender runs on each
    :param steps: environment steps of each run
    :param eval_every: steps between evaluations
    :param eval_episodes: episodes of each
    :param seeds: how many
    :param overrides: by algorithm (``"sac"``, ``"ppo"``, ...), hyperparameters that its runs get
    :param cost: what it takes, in words, measured
    :param first_seed: of the runs
    :param eval_seed: of the first evaluation episode. Where something is chosen by its results, both are others than those of
        the experiments that report what was chosen
    """

    tasks: tuple[Task, ...]
    steps: int
    eval_every: int
    eval_episodes: int = 20
    seeds: int = 3
    overrides: dict[str, dict[str, Any]] = field(default_factory=dict)
    cost: str = ""
    first_seed: int = 0
    eval_seed: int = FIRST_SEED


@dataclass(frozen=True)
class Experiment:
    """
    A question with the runs that answer it and the figure that shows it.

    :param name: e.g. ``"mountaincar"``
    :param figure: of the report, e.g. ``"4"`` or ``"B.3"``; "" where it has none
    :param title: of the figure
    :param claim: what the report says, in short
    :param contenders: the agents
    :param drawing: a name in :data:`sb3_cpm.experiments.figures.DRAWINGS`
    :param full: the whole experiment
    :param quick: a version that takes minutes on two cores
    :param source: name of the experiment whose runs it draws, where it needs none of its own
    :param short: a version for two cores on the same tasks, where the full one takes days
    """

    name: str
    figure: str
    title: str
    claim: str
    contenders: tuple[Contender, ...]
    drawing: str
    full: Plan
    quick: Plan
    source: str | None = None
    short: Plan | None = None

    @property
    def plans(self) -> dict[str, Plan]:
        """Its versions, in the order of :data:`VERSIONS`."""
        plans = {version: getattr(self, version) for version in VERSIONS}
        return {version: plan for version, plan in plans.items() if plan is not None}

    def plan(self, version: str = "full") -> Plan:
        """
        :param version: one of :data:`VERSIONS`, or a trial of it, see :meth:`trial`
        :raises ValueError: if this experiment has no such version
        """
        planned, trial, steps = version.partition(TRIAL)
        if planned not in self.plans or (trial and not steps.isdecimal()):
            raise ValueError(f"{self.name} has no version {version!r}, but: {', '.join(self.plans)}.")
        plan = self.plans[planned]
        return replace(plan, steps=int(steps), cost="a trial, apart from the experiment's results") if trial else plan

    def trial(self, version: str, steps: int | None) -> str:
        """
        Runs of other lengths than planned are a version of their own, so that they never get among the results.

        :param version: one of :data:`VERSIONS`
        :param steps: of each run; None: as planned
        :return: the name of the version: as given where the runs are as long as planned, else like ``"short-steps500"``
        :raises ValueError: for fewer steps than one, and if this experiment has no such version
        """
        if steps is None or steps == self.plan(version).steps:
            return version
        if steps < 1:
            raise ValueError(f"steps={steps}: expected 1 or more; leave it out for the plan's {self.plan(version).steps}")
        return f"{version}{TRIAL}{steps}"

    def folder_name(self, version: str = "full") -> str:
        """
        :param version: one of :data:`VERSIONS`, or a trial of it
        :return: where the results are; those of several versions are never mixed
        :raises ValueError: if this experiment has no such version
        """
        self.plan(version)
        return of_version(self.source or self.name, version)

    def runs(
        self,
        version: str = "full",
        seeds: int | None = None,
        steps: int | None = None,
        agents: Sequence[str] | None = None,
        tasks: Sequence[str] | None = None,
    ) -> Iterator[RunSpec]:
        """
        :param version: one of :data:`VERSIONS`
        :param seeds: how many, from the plan's first; None: the plan's number
        :param steps: of each run; None: the plan's number. Others are a version of their own, see :meth:`trial`
        :param agents: names of contenders; None: all
        :param tasks: names of tasks; None: all
        :return: all runs, first seeds first
        :raises ValueError: for a version that this experiment does not have, fewer seeds or steps than one, or a name, with
            the nearest
        """
        from sb3_cpm.agents.algorithms import algorithm_of

        if seeds is not None and seeds < 1:
            raise ValueError(f"seeds={seeds}: expected 1 or more")
        version = self.trial(version, steps)
        plan = self.plan(version)
        contenders = _chosen("agent", agents, self.contenders)
        chosen_tasks = _chosen("task", tasks, plan.tasks)
        for seed in range(plan.first_seed, plan.first_seed + (plan.seeds if seeds is None else seeds)):
            for task in chosen_tasks:
                for contender in contenders:
                    yield RunSpec(
                        experiment=self.folder_name(version),
                        agent=contender.name,
                        env=task.name,
                        seed=seed,
                        config=contender.config,
                        env_id=task.env_id,
                        overrides=_merged(
                            plan.overrides.get(algorithm_of(contender.config), {}), task.overrides, contender.overrides
                        ),
                        steps=plan.steps,
                        eval_every=plan.eval_every,
                        eval_episodes=plan.eval_episodes,
                        eval_seed=plan.eval_seed,
                    )


_Named = TypeVar("_Named", Contender, Task)


def _chosen(kind: str, names: Sequence[str] | None, all_of_them: Sequence[_Named]) -> list[_Named]:
    """Those with these names, in their own order; None: all."""
    valid = [one.name for one in all_of_them]
    for name in names or ():
        if name not in valid:
            hint = nearest(name, valid)
            raise ValueError(f"There is no {kind} {name!r} in this experiment.{hint} Valid: {', '.join(valid)}.")
    return [one for one in all_of_them if names is None or one.name in names]


def _merged(*overrides: dict[str, Any]) -> dict[str, Any]:
    from sb3_cpm.agents.configs import merge

    result: dict[str, Any] = {}
    for one in overrides:
        removed = {key: None for key, value in one.items() if value is None}  # for the file's entries, which come later
        result = {**merge(result, one), **removed}
    return result
