"""One run of an experiment: skip it where its result is there, take it from another experiment, or make it."""

from collections.abc import Callable
from pathlib import Path

from sb3_cpm.agents import load_agent
from sb3_cpm.experiments.shared_runs import find_same_run, take_over
from sb3_cpm.experiments.specification import RunResult
from sb3_cpm.files import DamagedRunError, locked
from sb3_cpm.run import folder as run_folder
from sb3_cpm.run.execution import Run, RunOptions
from sb3_cpm.run.specification import RunSpec
from sb3_cpm.run.stored_run import read_run
from sb3_cpm.seeds import check_seed


def perform(spec: RunSpec, results: Path, tell: Callable[[str], None] = lambda news: None, device: str = "cpu") -> RunResult:
    """
    Make a run, unless its result is there, if only under the name of another experiment.

    :param spec: the run
    :param results: folder of all results
    :param tell: is given a line now and then
    :param device: PyTorch device; small networks are fastest on the CPU
    :raises LockedError: while another process makes the same run
    :raises DamagedRunError: if the result is there, but files of it are missing or were cut off
    :raises ValueError: for an unknown agent or environment, for wrong hyperparameters, for a seed that evaluation may have,
        and if the folder holds a run with other hyperparameters
    """
    folder = spec.folder(results)
    agent = load_agent(spec.config, spec.env_id, spec.overrides)
    check_seed(spec.seed, agent.n_envs)
    config = run_folder.description(spec, agent)
    with locked(folder):
        note = run_folder.check_belongs(folder, config)
        if run_folder.is_finished(folder):
            _check_whole(folder)
            run_folder.remove_crashed(folder)  # of a try that ended before it saw that
            return RunResult(spec, "skipped", note or "its result is there", folder)
        run_folder.check_may_go_on(folder, note)
        other = None if run_folder.has_checkpoint(folder) else find_same_run(spec, config, results)
        if other is not None:
            return RunResult(spec, "skipped", f"taken from {take_over(spec, config, other, results)}", folder)
        summary = Run(spec, agent, folder, RunOptions(device=device, player_losses=True), tell).execute()
    return RunResult(spec, "finished", f"{summary.seconds:.0f} s", folder)


def _check_whole(folder: Path) -> None:
    try:
        read_run(folder)
    except DamagedRunError as error:
        raise DamagedRunError(f"{folder} is damaged: {error}. Remove it to run it again.") from error
