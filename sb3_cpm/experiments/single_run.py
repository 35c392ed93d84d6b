"""One run of an experiment: train, evaluate, leave tidy CSV; go on where a killed run ended."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecEnv

from sb3_cpm import __version__
from sb3_cpm import checkpoint as checkpoints
from sb3_cpm.callbacks import ChallengerCallback
from sb3_cpm.experiments import run_folder
from sb3_cpm.experiments.diagnostics import DiagnosticsWriter
from sb3_cpm.experiments.evaluation import evaluate, success_of
from sb3_cpm.experiments.player_losses import log_player_losses
from sb3_cpm.experiments.specification import RunResult, RunSpec
from sb3_cpm.experiments.stored_run import read_run
from sb3_cpm.experiments.tables import COLUMNS, Table
from sb3_cpm.experiments.twins import find_twin, take_over
from sb3_cpm.files import DamagedFileError, DamagedRunError, NotFiniteError, NotWrittenError, locked
from sb3_cpm.seeds import check_seed
from sb3_cpm.zoo.agents import Built, load_agent

#: How often diagnostics are written in a run.
N_DUMPS = 50


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
    th.set_num_threads(1)
    th.set_flush_denormal(True)  # Adam's averages of units that are off decay to numbers that cost CPUs a tenth of an update
    with locked(folder):
        note = run_folder.check_belongs(folder, config)
        if run_folder.is_finished(folder):
            _check_whole(folder)
            run_folder.remove_crashed(folder)  # of a try that ended before it saw that
            return RunResult(spec, "skipped", note or "its result is there", folder)
        started = time.perf_counter()
        found = checkpoints.find_checkpoint(folder)
        if found is not None and note is not None:
            raise run_folder.OtherResultError(f"{folder} holds an unfinished run {note}: finish it there, or remove it.")
        if found is not None and not (folder / run_folder.CONFIG).exists():
            raise DamagedRunError(
                f"{folder} holds a checkpoint, but no {run_folder.CONFIG} that says of what run. Remove it to run it again."
            )
        twin = None if found is not None else find_twin(spec, config, results)
        if twin is not None:
            return RunResult(spec, "skipped", f"taken from {take_over(spec, config, twin, results)}", folder)
        built = agent.build(spec.seed, device=device, load_path=None if found is None else found / "model.zip")
        try:
            run_folder.write_config(folder, config)
            watcher = Watcher(spec, folder, built, found, tell)
            watcher.learn()
            seconds = watcher.seconds_before + time.perf_counter() - started
        finally:
            built.env.close()
        facts = {"steps": built.model.num_timesteps, "seconds": round(seconds, 1), "sb3_cpm": __version__}
        run_folder.write_finished(folder, facts)
        checkpoints.remove_checkpoints(folder)
    return RunResult(spec, "finished", f"{seconds:.0f} s", folder)


def _check_whole(folder: Path) -> None:
    try:
        read_run(folder)
    except DamagedRunError as error:
        raise DamagedRunError(f"{folder} is damaged: {error}. Remove it to run it again.") from error


class Watcher(BaseCallback):
    """
    Evaluates, writes tables and makes checkpoints while a model learns.

    Everything happens before a rollout: there the last one has been stored and trained on.

    :param spec: the run
    :param folder: of the run
    :param built: model, callbacks, environments
    :param found: the checkpoint that the model was loaded from
    :param tell: is given a line after each evaluation
    """

    def __init__(
        self, spec: RunSpec, folder: Path, built: Built, found: Path | None, tell: Callable[[str], None] = lambda news: None
    ) -> None:
        super().__init__()
        self.spec, self.folder, self.built, self.found, self.tell = spec, folder, built, found, tell
        self.eval_env: VecEnv = built.make_eval_env()
        state: dict[str, Any] = {} if found is None else checkpoints.load_extra(found)
        self.tables = self._open_tables(state.get("tables", {}))
        #: Wall-clock seconds of earlier processes.
        self.seconds_before: float = state.get("seconds", 0.0)
        self._started = time.perf_counter()
        self._next_evaluation: int = state.get("next_evaluation", 0)
        self._next_dump: int = state.get("next_dump", 0)
        self._goes_on = found is not None
        self._succeeded: list[bool | None] = []

    def _open_tables(self, states: dict[str, Any]) -> dict[str, Table]:
        try:
            return {name: Table(self.folder / f"{name}.csv", one, **states.get(name, {})) for name, one in COLUMNS.items()}
        except DamagedFileError as error:
            raise DamagedRunError(f"{error} Remove {self.folder} to run it again.") from error

    def learn(self) -> None:
        """Train from where the model is to the end of the run."""
        model, spec = self.built.model, self.spec
        model.set_logger(Logger(None, [DiagnosticsWriter(self.tables["diagnostics"])]))
        callbacks = [*self.built.callbacks, self]
        if self.found is not None:
            checkpoints.restore(self.found, model, self.built.callbacks)
        try:
            model.learn(
                spec.steps - model.num_timesteps,
                callback=callbacks,
                log_interval=None,  # type: ignore[arg-type]
                reset_num_timesteps=False,
            )
            self._dump()
            self._evaluate()
        finally:
            self.eval_env.close()
            for table in self.tables.values():
                table.close()

    # ------------------------------------------------------------------ SB3's hooks

    def _on_training_start(self) -> None:
        self._succeeded = [None] * self.training_env.num_envs

    def _on_rollout_start(self) -> None:
        if self._goes_on:  # what comes now came after this checkpoint in the first try, too
            self._goes_on = False
            self._start_afresh()
        evaluation_due = self._next_evaluation <= self.num_timesteps < self.spec.steps
        # before a checkpoint, too: what the logger has gathered is not part of it
        if self.num_timesteps >= self._next_dump or evaluation_due:
            self._dump()
        if evaluation_due:
            self._evaluate()
            self._next_evaluation += self.spec.eval_every
            self._save()
            self._start_afresh()

    def _on_rollout_end(self) -> None:
        for callback in self.built.callbacks:  # they come before this one
            if isinstance(callback, ChallengerCallback):
                for _, proposal in callback.proposals:
                    self.logger.record_mean("challenge/mean_reward", proposal.rewards[proposal.first :].mean())

    def _on_step(self) -> bool:
        for env_idx, info in enumerate(self.locals["infos"]):
            success = success_of(info)
            if success is not None:
                self._succeeded[env_idx] = bool(self._succeeded[env_idx]) or success
            if "episode" in info:
                once = self._succeeded[env_idx]
                self._succeeded[env_idx] = None
                episode = info["episode"]
                self.tables["training"].add(
                    (self.num_timesteps, env_idx, float(episode["r"]), int(episode["l"]), once, success)
                )
        return True

    # ------------------------------------------------------------------ what it does

    def _dump(self) -> None:
        every = max(self.spec.steps // N_DUMPS, 1)
        self._next_dump = (self.num_timesteps // every + 1) * every
        log_player_losses(self.model)
        if self.num_timesteps:
            self.model.dump_logs()

    def _start_afresh(self) -> None:
        checkpoints.fresh_start(self.model, self.spec.seed, self.built.callbacks)
        self._succeeded = [None] * len(self._succeeded)

    def _evaluate(self) -> None:
        spec = self.spec
        outcomes = evaluate(self.built.model, self.eval_env, spec.eval_episodes, spec.eval_seed)
        step = self.built.model.num_timesteps
        for index, outcome in enumerate(outcomes):
            self.tables["evaluations"].add((spec.experiment, spec.agent, spec.env, spec.seed, step, index, *outcome))
        self.tell(self._news(step, outcomes))

    def _news(self, step: int, outcomes: list[Any]) -> str:
        told = [outcome.success_at_end for outcome in outcomes if outcome.success_at_end is not None]
        success = f", success at end {np.mean(told):.0%}" if told else ""
        seconds = self.seconds_before + time.perf_counter() - self._started
        left = f", about {seconds * (self.spec.steps - step) / step / 60:.1f} min left" if step else ""
        mean = float(np.mean([outcome.episode_return for outcome in outcomes]))
        return f"{self.spec.name}: step {step}/{self.spec.steps}, return {mean:.2f}{success}{left}"

    def _save(self) -> None:
        try:
            self._save_checkpoint()
        except (NotWrittenError, NotFiniteError) as error:
            self.tell(f"{self.spec.name}: no checkpoint at step {self.num_timesteps}, the run goes on. {error}")

    def _save_checkpoint(self) -> None:
        state = {
            "tables": {name: table.state() for name, table in self.tables.items()},
            "seconds": self.seconds_before + time.perf_counter() - self._started,
            "next_evaluation": self._next_evaluation,
            "next_dump": self._next_dump,
        }
        checkpoints.save_checkpoint(self.folder, self.model, self.built.callbacks, state)
