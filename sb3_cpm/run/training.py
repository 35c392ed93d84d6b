"""
``python -m sb3_cpm train``: an agent on a task, from settings to a folder of results, and on again where it was cut off.
"""

import inspect
import shlex
from pathlib import Path
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback

from sb3_cpm.agents import Agent, load_agent
from sb3_cpm.agents.algorithms import algorithms
from sb3_cpm.agents.tasks import imported, imported_task, task_id
from sb3_cpm.extras import check_installed
from sb3_cpm.files import locked
from sb3_cpm.run import folder as run_folder
from sb3_cpm.run.arguments import misspelt_names_told
from sb3_cpm.run.execution import Run, RunOptions
from sb3_cpm.run.settings import TrainSettings
from sb3_cpm.run.specification import RunSpec
from sb3_cpm.run.summary import Summary
from sb3_cpm.seeds import check_seed

#: What a run is called that belongs to no experiment.
EXPERIMENT = "train"


def train(settings: TrainSettings | None = None, callback: BaseCallback | None = None, **changes: Any) -> Summary:
    """
    Train an agent on a task and leave a folder of results, or go on with a run that was cut off.

    >>> train(env="CPMToy-v0", steps=2000, run_folder="runs/toy").success  # doctest: +SKIP
    1.0
    >>> train(resume="runs/toy")  # doctest: +SKIP

    :param settings: of the run; None for ``TrainSettings(**changes)``
    :param callback: a further SB3 callback, called after those of the run
    :param changes: settings by name, when ``settings`` is None
    :return: the numbers of the run; they are also in its folder, as summary.json
    :raises ValueError: for settings that cannot work, before anything is trained, and for a folder that cannot be gone on with
    """
    if settings is not None and changes:
        raise ValueError(f"Give either settings or single values, not both: {sorted(changes)}")
    settings = settings or TrainSettings(**changes)
    check_installed("Runs", ("tensorboard", "matplotlib", *(["imageio"] if settings.video else [])), "run")
    if settings.resume is not None:
        return _go_on(Path(settings.resume), settings, callback)
    with misspelt_names_told(settings.as_dict()):
        return _begin(settings, callback)


def specification(settings: TrainSettings) -> tuple[RunSpec, Agent]:
    """
    :param settings: of a new run
    :return: the run, and its agent
    :raises ValueError: for an unknown agent, task or hyperparameter (with the nearest), and a seed that evaluation has
    """
    env_id = imported_task(settings.env)
    overrides = settings.overrides()
    agent = load_agent(settings.agent, env_id, overrides)
    check_seed(settings.seed, agent.n_envs)
    steps = settings.steps or agent.n_timesteps
    spec = RunSpec(
        experiment=EXPERIMENT,
        agent=agent.name,
        env=env_id,
        seed=settings.seed,
        config=settings.agent if Path(settings.agent).suffix == "" else str(agent.path.resolve()),
        env_id=env_id,
        overrides=overrides,
        steps=steps,
        eval_every=-(-steps // (settings.evaluations - 1)) if settings.evaluations else 0,
        eval_episodes=settings.eval_episodes,
        checkpoint_every=settings.checkpoint_freq,
        module=settings.env.rpartition(":")[0],
    )
    check_length(spec, agent)
    return spec, agent


def check_length(spec: RunSpec, agent: Agent) -> None:
    """:raises ValueError: for a run that ends before the first update, and would look finished"""
    default = inspect.signature(algorithms()[agent.algo]).parameters.get("learning_starts")
    first = agent.hyperparameters.get("learning_starts", 0 if default is None else default.default)
    if spec.steps <= first:
        raise ValueError(
            f"steps={spec.steps} is no longer than learning_starts={first}, the steps before the first update: nothing would "
            f"be learned. Set steps above {first}, or learning_starts lower."
        )


def _begin(settings: TrainSettings, callback: BaseCallback | None) -> Summary:
    spec, agent = specification(settings)
    new = run_folder.NewFolder(settings.run_folder, f"{spec.env_id.replace('/', '-')}-{agent.name}-seed{spec.seed}")
    try:
        run = Run(spec, agent, new.path, _options(settings), say)
    except BaseException:
        new.discard()
        raise
    try:
        return _execute(run, callback)
    finally:
        if run.model.num_timesteps == 0:
            new.discard()
        new.release()


def _options(settings: TrainSettings) -> RunOptions:
    return RunOptions(
        device=settings.device,
        keep_models=True,
        pictures=True,
        video=settings.video,
        tensorboard=True,
        progress_bar=settings.progress_bar,
        processes=True,
        threads=settings.threads,
    )


def _go_on(folder: Path, settings: TrainSettings, callback: BaseCallback | None) -> Summary:
    """:raises ValueError: for a folder that holds no run, a finished one, one of another version or of other settings"""
    if not (folder / run_folder.CONFIG).is_file():
        what = f"it has no {run_folder.CONFIG}" if folder.is_dir() else "there is no such folder"
        raise ValueError(f"resume={str(folder)!r}: {what}. Expected the folder of a run that was cut off.")
    with locked(folder):
        stored = run_folder.read_yaml(folder / run_folder.CONFIG)
        if "run" not in stored:
            raise ValueError(
                f"resume={str(folder)!r}: its {run_folder.CONFIG} is of an earlier sb3_cpm, whose `train` wrote no "
                "checkpoints. Begin the run anew."
            )
        if run_folder.is_finished(folder):
            raise ValueError(
                f"resume={str(folder)!r}: this run has come to its end, there is nothing to go on with. A longer one is a new "
                "run: give the same settings and more steps."
            )
        spec = _stored_spec(folder, stored["run"])
        imported(spec.module, spec.env_id)
        agent = load_agent(spec.config, task_id(spec.env_id), spec.overrides)
        run_folder.check_may_go_on(folder, run_folder.check_belongs(folder, run_folder.description(spec, agent)))
        return _execute(Run(spec, agent, folder, _options(settings), say), callback)


def _stored_spec(folder: Path, stored: Any) -> RunSpec:
    """:raises ValueError: for entries that are none of a run"""
    try:
        return RunSpec(**stored)
    except TypeError as error:
        raise ValueError(
            f"resume={str(folder)!r}: its {run_folder.CONFIG} is damaged, or of another version: {error}. Begin the run anew."
        ) from error


def _execute(run: Run, callback: BaseCallback | None) -> Summary:
    begun = run.model.num_timesteps
    how = f"go on at step {begun} of" if run.found is not None else ""
    say(f"{run.title}: {how} {run.spec.steps} steps, results go to {run.folder}".replace(":  ", ": "))
    try:
        summary = run.execute(callback)
    except BaseException:
        if run.model.num_timesteps > 0:
            run.summary.show()
            how = f"python -m sb3_cpm train --resume {shlex.quote(str(run.folder))}"
            say(f"The run was cut off at step {run.model.num_timesteps}. It goes on from its newest checkpoint with: {how}")
        raise
    summary.show()
    return summary


def say(text: str) -> None:
    print(text, flush=True)
