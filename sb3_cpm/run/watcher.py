"""What happens beside training: evaluation, tables, checkpoints."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.vec_env import VecEnv

from sb3_cpm import checkpoint as checkpoints
from sb3_cpm.agents import Built
from sb3_cpm.callbacks import ChallengerCallback
from sb3_cpm.files import DamagedFileError, DamagedRunError, NotFiniteError, NotWrittenError
from sb3_cpm.run.diagnostics import DiagnosticsWriter
from sb3_cpm.run.evaluation import evaluate, means
from sb3_cpm.run.player_losses import log_player_losses
from sb3_cpm.run.recorder import Recorder
from sb3_cpm.run.specification import RunSpec
from sb3_cpm.run.tables import COLUMNS, Table
from sb3_cpm.stopwatch import Stopwatch
from sb3_cpm.training_env import success_of

#: How often diagnostics are written in a run.
N_DUMPS = 50


class Watcher(BaseCallback):
    """
    Evaluates, writes tables and makes checkpoints while a model learns.

    Everything happens before a rollout: there the last one has been stored and trained on. A run that goes on from a
    checkpoint is the same as one that was never cut off, because that begins new episodes and draws new random numbers after
    each checkpoint, too. Evaluations change nothing.

    :param spec: the run
    :param folder: of the run
    :param built: model, callbacks, environments
    :param eval_env: for evaluations; closed by the caller
    :param found: the checkpoint that the model was loaded from
    :param tell: is given a line after each evaluation
    :param with_gallery: whether proposals and coefficients are recorded, where there is a challenger
    :param with_player_losses: whether the player's losses on trajectories and on challenges are logged
    :raises DamagedRunError: if the tables are not those that belong to the checkpoint
    """

    def __init__(
        self,
        spec: RunSpec,
        folder: Path,
        built: Built,
        eval_env: VecEnv,
        found: Path | None,
        tell: Callable[[str], None] = lambda news: None,
        with_gallery: bool = False,
        with_player_losses: bool = False,
    ) -> None:
        super().__init__()
        self.with_player_losses = with_player_losses
        self.spec, self.folder, self.built, self.found, self.tell = spec, folder, built, found, tell
        self.eval_env = eval_env
        self.challenger = next((one for one in built.callbacks if isinstance(one, ChallengerCallback)), None)
        self.stopwatch = Stopwatch() if self.challenger is None else self.challenger.stopwatch
        state: dict[str, Any] = {} if found is None else checkpoints.load_extra(found)
        self.recorder: Recorder | None = None
        try:
            tables = state.get("tables", {})
            self.tables = {name: Table(folder / f"{name}.csv", one, **tables.get(name, {})) for name, one in COLUMNS.items()}
            if with_gallery and self.challenger is not None:
                self.recorder = Recorder(folder, self.challenger, spec.steps, state.get("recorder"))
        except DamagedFileError as error:
            raise DamagedRunError(f"{error} Remove {folder} to run it again.") from error
        #: Wall-clock seconds of earlier processes.
        self.seconds_before: float = state.get("seconds", 0.0)
        self.n_episodes: int = state.get("n_episodes", 0)
        self._started = time.perf_counter()
        self._next_evaluation: int = state.get("next_evaluation", 0)
        self._next_checkpoint: int = state.get("next_checkpoint", 0)
        self._next_dump: int = state.get("next_dump", 0)
        self._goes_on = found is not None
        self._succeeded: list[bool | None] = []

    @property
    def seconds(self) -> float:
        """Wall-clock seconds of the run so far, those of earlier processes included."""
        return self.seconds_before + time.perf_counter() - self._started

    def callbacks(self) -> list[BaseCallback]:
        """:return: all of the run in the order that they need: what one reads of another must have happened"""
        return [*self.built.callbacks, *([self.recorder] if self.recorder else []), self]

    def learn(self, outputs: list[KVWriter], others: list[BaseCallback]) -> None:
        """
        Train from where the model is to the end of the run, and evaluate there.

        :param outputs: of the logger, beside ``diagnostics.csv``
        :param others: callbacks that are none of the run's own, called after these
        """
        model, spec = self.built.model, self.spec
        model.set_logger(Logger(None, [DiagnosticsWriter(self.tables["diagnostics"]), *outputs]))
        if self.found is not None:
            checkpoints.restore(self.found, model, self.built.callbacks)
        model.learn(
            spec.steps - model.num_timesteps,
            callback=[*self.callbacks(), *others],
            log_interval=None,  # type: ignore[arg-type]
            reset_num_timesteps=False,
        )
        if spec.eval_every:
            self._evaluate()
        self._dump()

    def close(self) -> None:
        """:raises NotWrittenError: if rows of a table are still missing on the disk"""
        for table in self.tables.values():
            table.close()
        if self.recorder is not None:
            self.recorder.close()

    # ------------------------------------------------------------------ SB3's hooks

    def _on_training_start(self) -> None:
        self._succeeded = [None] * self.training_env.num_envs

    def _on_rollout_start(self) -> None:
        if self._goes_on:  # what comes now came after this checkpoint in the first try, too
            self._goes_on = False
            self._start_afresh()
        spec, now = self.spec, self.num_timesteps
        evaluation_due = bool(spec.eval_every) and self._next_evaluation <= now < spec.steps
        checkpoint_due = evaluation_due if spec.checkpoint_every is None else self._next_checkpoint <= now < spec.steps
        if evaluation_due:
            self._evaluate()
            self._next_evaluation += spec.eval_every
        # before a checkpoint, too: what the logger has gathered is not part of it
        if now >= self._next_dump or evaluation_due or checkpoint_due:
            self._dump()
        if checkpoint_due:
            if spec.checkpoint_every is not None:
                self._next_checkpoint = (now // spec.checkpoint_every + 1) * spec.checkpoint_every
            with self.stopwatch.section("pictures and saving"):
                self._save()
            self._start_afresh()

    def _on_rollout_end(self) -> None:
        if self.challenger is not None:  # it comes before this one
            for _, proposal in self.challenger.proposals:
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
                self.n_episodes += 1
                self.tables["training"].add(
                    (self.num_timesteps, env_idx, float(episode["r"]), int(episode["l"]), once, success)
                )
        return True

    # ------------------------------------------------------------------ what it does

    def _dump(self) -> None:
        every = max(self.spec.steps // N_DUMPS, 1)
        self._next_dump = (self.num_timesteps // every + 1) * every
        if self.with_player_losses:
            log_player_losses(self.model)
        if self.num_timesteps:
            self.model.dump_logs()
        else:
            self.logger.dump(0)  # of the first evaluation

    def _start_afresh(self) -> None:
        checkpoints.fresh_start(self.model, self.spec.seed, self.built.callbacks)
        self._succeeded = [None] * len(self._succeeded)

    def _evaluate(self) -> None:
        spec, step = self.spec, self.built.model.num_timesteps
        with self.stopwatch.section("evaluation"):
            outcomes = evaluate(self.built.model, self.eval_env, spec.eval_episodes, spec.eval_seed)
        mean_return, success = means(outcomes)
        self.logger.record("eval/mean_reward", mean_return)
        if success is not None:
            self.logger.record("eval/success_rate", success)
        for index, outcome in enumerate(outcomes):
            self.tables["evaluations"].add((spec.experiment, spec.agent, spec.env, spec.seed, step, index, *outcome))
        self.tell(self._news(step, mean_return, success))

    def _news(self, step: int, mean_return: float, success: float | None) -> str:
        told = "" if success is None else f", success at end {success:.0%}"
        minutes = self.seconds * max(self.spec.steps - step, 0) / max(step, 1) / 60  # rollouts may go beyond the last step
        left = f", about {minutes:.1f} min left" if step else ""
        return f"{self.spec.name}: step {step}/{self.spec.steps}, return {mean_return:.2f}{told}{left}"

    def _save(self) -> None:
        try:
            self._save_checkpoint()
        except (NotWrittenError, NotFiniteError) as error:
            self.tell(f"{self.spec.name}: no checkpoint at step {self.num_timesteps}, the run goes on. {error}")

    def _save_checkpoint(self) -> None:
        state = {
            "tables": {name: table.state() for name, table in self.tables.items()},
            "seconds": self.seconds,
            "n_episodes": self.n_episodes,
            "next_evaluation": self._next_evaluation,
            "next_checkpoint": self._next_checkpoint,
            "next_dump": self._next_dump,
        }
        if self.recorder is not None:
            state["recorder"] = self.recorder.state()
        checkpoints.save_checkpoint(self.folder, self.model, self.built.callbacks, state)
