"""An experiment from start to figure, and its numbers as a table: what notebooks and the command line call."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import pandas as pd

from sb3_cpm.experiments.catalog import EXPERIMENTS, find_experiment
from sb3_cpm.experiments.collect import collect, has_data
from sb3_cpm.experiments.grid import perform_all
from sb3_cpm.experiments.specification import Experiment, RunResult, of_version
from sb3_cpm.experiments.statistics import estimate, per_seed

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RESULTS = "results"
SUMMARY_SCORES = ("success_at_end", "success_once", "return")


def run_experiment(
    name: str,
    version: str = "quick",
    results: str | Path = RESULTS,
    seeds: int | None = None,
    jobs: int = 1,
    tell: Callable[[str], None] = print,
    steps: int | None = None,
    device: str = "cpu",
    agents: Sequence[str] | None = None,
    tasks: Sequence[str] | None = None,
) -> list[RunResult]:
    """
    Make the runs of an experiment that are not there yet.

    :param name: of an experiment, or a figure's number
    :param version: "full", "short" or "quick"; their results are kept apart
    :param results: folder of all results
    :param seeds: how many; None: as planned
    :param jobs: processes at a time; 0: in this process
    :param tell: is given lines about the progress
    :param steps: of each run, to try something; None: as planned. Trials go to a folder of their own, ``NAME-stepsN``
    :param device: PyTorch device of the runs
    :param agents: only these, by name
    :param tasks: only these, by name
    :return: what became of each run; a crashed one does not stop the others
    :raises ValueError: for an unknown name, with the nearest, for a version that the experiment does not have, and for fewer
        seeds or steps than one
    """
    experiment = find_experiment(name)
    specs = list(experiment.runs(version, seeds, steps, agents, tasks))
    return perform_all(specs, Path(results), jobs, tell, device)


def ensure_data(
    name: str,
    results: str | Path = RESULTS,
    seeds: int | None = None,
    steps: int | None = None,
    jobs: int = 0,
    tell: Callable[[str], None] = print,
) -> str:
    """
    Make sure that there is something to draw: for notebooks.

    :param name: of an experiment, or a figure's number
    :param results: folder of all results
    :param seeds: of the quick version, where it has to be run
    :param steps: likewise; to be given together with a folder of results of its own
    :param jobs: likewise; 0: in this process
    :param tell: is given lines about the progress
    :return: the version for :func:`draw`: "full" or "short" where there are results of it, else "quick", which has then been
        run as far as it was missing
    :raises RuntimeError: if one of its runs crashed or was refused
    """
    best = find_data([name], results).get(name, "quick")
    if best != "quick":
        return best
    experiment = find_experiment(name)
    folder = experiment.folder_name("quick")  # of trials, too: notebooks draw one version
    specs = [replace(spec, experiment=folder) for spec in experiment.runs("quick", seeds, steps)]
    for outcome in perform_all(specs, Path(results), jobs, tell):
        if outcome.outcome in ("crashed", "refused"):
            raise RuntimeError(f"{outcome.spec.name} {outcome.outcome}: {outcome.message}")
    return "quick"


def find_data(names: Iterable[str], results: str | Path = RESULTS) -> dict[str, str]:
    """
    What else there is to draw.

    :param names: of experiments
    :param results: folder of all results
    :return: the best version that there are results of, for those that have any
    """
    best = {}
    for name in names:
        experiment = find_experiment(name)
        best[name] = next((version for version in experiment.plans if has_data(experiment, results, version)), None)
    return {name: version for name, version in best.items() if version is not None}


def draw(
    name: str,
    results: str | Path = RESULTS,
    version: str = "full",
    source: str | None = None,
    task: str | None = None,
) -> "Figure":
    """
    :param name: of an experiment, or a figure's number
    :param results: folder of all results
    :param version: "full", "short" or "quick"
    :param source: name of another experiment whose runs are drawn in this figure's way
    :param task: only the runs on this one; for the figures of logged numbers where an experiment has several
    :return: the figure, from the CSV files alone
    :raises ValueError: where there is no data, with the version that there is data of, and the command that makes it
    """
    from sb3_cpm.experiments.figures import add_note, draw_experiment

    other = None if source is None else find_experiment(source)
    figure, notes = draw_experiment(find_experiment(name), results, version, other, task)
    if notes:
        add_note(figure, "Note: " + "; ".join(notes))
    return figure


def summary_table(name: str, results: str | Path = RESULTS, version: str = "full", task: str | None = None) -> pd.DataFrame:
    """
    The last evaluation that all seeds have, in numbers.

    :param name: of an experiment, or a figure's number
    :param results: folder of all results
    :param version: "full", "short" or "quick"
    :param task: only this one
    :return: a row per task and agent: seeds, step, and per score the interquartile mean with its 95% interval as text,
        which one seed does not have; ``to_markdown()`` makes text of it
    :raises ValueError: where there is no data, with the command that makes it
    """
    experiment = find_experiment(name)
    table = collect(experiment, results, version, task).tables["evaluations"]
    rows = []
    for task in dict.fromkeys(table["env"]):
        for contender in experiment.contenders:
            part = table[(table["env"] == task) & (table["agent"] == contender.name)]
            if len(part):
                rows.append({"task": task, "agent": contender.name, **_last(part)})
    return pd.DataFrame(rows)


def _last(part: pd.DataFrame) -> dict[str, object]:
    returns = per_seed(part, "return")
    step = int(returns.index[-1]) if len(returns) else None
    row: dict[str, object] = {"seeds": part["seed"].nunique(), "step": "-" if step is None else step}
    for score in SUMMARY_SCORES:
        scores = per_seed(part[part["step"] == step], score)
        if len(scores):
            last = estimate(scores)
            interval = f" [{last.low[0]:.2f}, {last.high[0]:.2f}]" if last.n_seeds > 1 else ""  # as the figures
            row[score] = f"{last.iqm[0]:.2f}{interval}"
        else:
            row[score] = "-"
    return row


def figure_path(experiment: Experiment, results: str | Path, version: str) -> Path:
    """:return: where :func:`reproduce` saves the figure"""
    number = f"figure_{experiment.figure}_" if experiment.figure else ""
    return Path(results) / "figures" / f"{number}{of_version(experiment.name, version)}.png"


def reproduce(
    name: str,
    version: str = "full",
    seeds: int | None = None,
    jobs: int = 1,
    results: str | Path = RESULTS,
    draw_only: bool = False,
    tell: Callable[[str], None] = print,
    steps: int | None = None,
    device: str = "cpu",
    agents: Sequence[str] | None = None,
    tasks: Sequence[str] | None = None,
) -> int:
    """
    Run what is missing, draw the figure, print the table: what ``python -m sb3_cpm reproduce`` does.

    Of what is drawn, ``agents`` and ``tasks`` change nothing: all results that are there are. With other ``steps`` than
    planned it is a trial, whose runs and figure are kept apart from the experiment's.

    :return: exit status: 1 if a run crashed or was refused, or its result is there and could not be checked
    :raises ValueError: as :func:`run_experiment` and :func:`draw`
    """
    from sb3_cpm.run.plots import save_figure  # first: nobody wants to hear after the runs that matplotlib is missing

    experiment = find_experiment(name)
    version = experiment.trial(version, steps)
    if Path(results).exists() and not Path(results).is_dir():
        raise ValueError(f"--results {results} is no folder")
    n_runs = len(list(experiment.runs(version, seeds, None, agents, tasks)))  # what there is not is refused here
    failed: list[RunResult] = []
    if not draw_only:
        plan = experiment.plan(version)
        tell(f"{experiment.name}: {n_runs} runs of {plan.steps} steps ({plan.cost}); what is there is skipped")
        outcomes = run_experiment(name, version, results, seeds, jobs, tell, None, device, agents, tasks)
        failed = [outcome for outcome in outcomes if outcome.outcome in ("crashed", "refused", "unchecked")]
        for outcome in failed:
            tell(f"{outcome.outcome}: {outcome.spec.name}: {outcome.message}")
        if len(failed) == len(outcomes) and not has_data(experiment, results, version):
            raise RuntimeError(f"None of the {len(outcomes)} runs of {experiment.name} could be made; see above.")
    path = figure_path(experiment, results, version)
    figure = draw(name, results, version)
    path.parent.mkdir(parents=True, exist_ok=True)
    save_figure(figure, path)
    tell(summary_table(name, results, version).to_string(index=False))
    for note in collect(experiment, results, version).notes:
        tell(f"note: {note}")
    tell(f"Drawn: {path}")
    return 1 if failed else 0


def listing() -> str:
    """:return: all experiments with their figures and costs, as text"""
    lines = []
    for experiment in EXPERIMENTS.values():
        number = f"figure {experiment.figure}" if experiment.figure else "no figure of the report"
        source = f" (draws the runs of {experiment.source})" if experiment.source else ""
        lines.append(f"{experiment.name}: {experiment.title} [{number}]{source}")
        for version, plan in experiment.plans.items():
            runs = plan.seeds * len(plan.tasks) * len(experiment.contenders)
            lines.append(f"    {version:<5} {runs:>3} runs of {plan.steps} steps; {plan.cost}")
    return "\n".join(lines)
