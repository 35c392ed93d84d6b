"""
ONE run, for everybody who makes runs: ``train``, ``reproduce``, benchmarks.

A folder that holds a checkpoint of the run is gone on with; tables then end as an unbroken run's do, bit for bit. Whatever
ends a run (the last step, Ctrl-C, SIGTERM, an exception), what was written stays whole, and the environments are closed.
"""

import contextlib
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch as th
from gymnasium.error import DependencyNotInstalled
from stable_baselines3.common.callbacks import BaseCallback, ProgressBarCallback
from stable_baselines3.common.logger import KVWriter, make_output_format
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_cpm import __version__
from sb3_cpm import checkpoint as checkpoints
from sb3_cpm.agents import Agent, Built
from sb3_cpm.buffers import CPMBuffer
from sb3_cpm.files import DamagedRunError, NotFiniteError, NotWrittenError, disk_errors_named, replacing
from sb3_cpm.run import folder as run_folder
from sb3_cpm.run.signals import TERMINATED, sigterm_raises, undisturbed
from sb3_cpm.run.specification import RunSpec
from sb3_cpm.run.summary import NOT_TRAINING, Summary, complete_times, evaluated, peak_memory_gb
from sb3_cpm.run.watcher import Watcher


@dataclass(frozen=True)
class RunOptions:
    """
    What a run does that does not change its tables.

    :param device: PyTorch device; small networks are fastest on the CPU
    :param player_losses: log what the player's losses are on trajectories and on challenges, see
        :mod:`~sb3_cpm.run.player_losses`; each time it rates 512 transitions
    :param keep_models: leave model, challenger and replay buffer behind
    :param pictures: leave learning curve, coefficients and challenge gallery behind, and a summary
    :param video: film an episode at the end
    :param tensorboard: log for TensorBoard, too
    :param progress_bar: None: where the terminal can show one
    :param processes: parallel environments in processes of their own; one that dies is replaced, its episode truncated: a
        simulator's crash after days costs an episode and not the run
    :param threads: of PyTorch on the CPU; more than one rarely pays at these sizes
    """

    device: str = "cpu"
    player_losses: bool = False
    keep_models: bool = False
    pictures: bool = False
    video: bool = False
    tensorboard: bool = False
    progress_bar: bool | None = False
    processes: bool = False
    threads: int = 1


class Run:
    """
    Environments, model and callbacks of one run, from its newest checkpoint where there is one.

    :param spec: the run
    :param agent: of it
    :param folder: of it; the caller has locked it, and seen that it holds nothing else
    :param options: see there
    :param tell: is given a line now and then
    :raises ValueError: for arguments that the algorithm, a wrapper or the environment refuses
    :raises DamagedRunError: if there is a checkpoint, but it is not whole
    """

    def __init__(
        self,
        spec: RunSpec,
        agent: Agent,
        folder: Path,
        options: RunOptions = RunOptions(),  # frozen
        tell: Callable[[str], None] = lambda news: None,
    ) -> None:
        self._started = time.perf_counter()
        self.spec, self.agent, self.folder, self.options, self.tell = spec, agent, folder, options, tell
        self.title = f"{agent.name} on {agent.env_id}, seed {spec.seed}"
        check_device(options.device)
        th.set_num_threads(options.threads)
        th.set_flush_denormal(True)  # Adam's averages of units that are off decay to numbers that CPUs take long for
        self.found = checkpoints.find_checkpoint(folder)
        if self.found is not None and not (folder / run_folder.CONFIG).exists():
            raise DamagedRunError(
                f"{folder} holds a checkpoint, but no {run_folder.CONFIG} that says of what run. Remove it to run it again."
            )
        with contextlib.ExitStack() as undo:
            self.built: Built = agent.build(
                spec.seed,
                device=options.device,
                vec_env_type="robust" if options.processes and agent.n_envs > 1 else "dummy",
                load_path=None if self.found is None else self.found / "model.zip",
            )
            undo.callback(self.built.env.close)
            self.model = self.built.model
            self._steps_before = self.model.num_timesteps
            self.eval_env: VecEnv = self.built.make_eval_env(render=options.video)
            undo.callback(self.eval_env.close)
            run_folder.write_config(folder, run_folder.description(spec, agent))
            self.watcher = Watcher(
                spec, folder, self.built, self.eval_env, self.found, tell, options.pictures, options.player_losses
            )
            undo.callback(self.watcher.close)
            undo.pop_all()
        self.setup_seconds = time.perf_counter() - self._started

    def execute(self, callback: BaseCallback | None = None) -> Summary:
        """
        Train, evaluate, and write everything that the options want; an exception goes on after that.

        :param callback: a further SB3 callback, called after those of the run
        :return: the numbers of the run
        """
        others = [one for one in (self._make_progress_bar(), callback) if one is not None]
        try:
            with sigterm_raises():
                self.watcher.learn(self._outputs(), others)
        except BaseException as error:
            with undisturbed():
                self._leave(_describe_end(error))
            raise
        with undisturbed():
            return self._leave("finished")

    def _make_progress_bar(self) -> ProgressBarCallback | None:
        wanted = self.options.progress_bar
        self._progress_bar = ProgressBarCallback() if (sys.stderr.isatty() if wanted is None else wanted) else None
        return self._progress_bar

    def _outputs(self) -> list[KVWriter]:
        return [_tensorboard(self.folder / "tensorboard")] if self.options.tensorboard else []

    # ------------------------------------------------------------------ what is left behind

    def _leave(self, outcome: str) -> Summary:
        """Write everything and close the environments. What fails is told and doesn't keep the rest from being written."""
        finished, begun = outcome == "finished", self.model.num_timesteps > 0
        if self._progress_bar is not None and hasattr(self._progress_bar, "pbar"):
            self._progress_bar.pbar.close()
        models: list[tuple[str, Callable[[], Any]]] = []
        if self.options.keep_models and begun:
            models += [("the model", self._save_model), ("the challenger", self._save_challenger)]
            models += [("the replay buffer", self._save_replay_buffer), ("the normalization", self._save_normalization)]
        jobs: list[tuple[str, Callable[[], Any]]] = [("the tables", self.watcher.close), ("the logs", self._close_logs)]
        if self.options.pictures and begun:
            jobs += self._drawings()
        if self.options.video and finished:
            jobs.append(("the video", self._film))
        jobs += [("the environments", self.built.env.close), ("the evaluation environment", self.eval_env.close)]
        with self.watcher.stopwatch.section("pictures and saving"):
            whole = all([_attempt(what, job) for what, job in models])
            for what, job in jobs:
                _attempt(what, job)
        summary = self.summary = self._summary(outcome)
        if self.options.pictures and begun:
            _attempt("the summary", lambda: summary.write(self.folder))
        if finished:  # last: a process that is killed before goes on
            facts = {"steps": self.model.num_timesteps, "seconds": round(self.watcher.seconds, 1), "sb3_cpm": __version__}
            run_folder.write_finished(self.folder, facts)
            if whole:  # else the last good model may be there
                checkpoints.remove_checkpoints(self.folder)
        return summary

    def _drawings(self) -> list[tuple[str, Callable[[], Any]]]:
        from sb3_cpm.run import plots
        from sb3_cpm.run.gallery import challenge_gallery

        drawings: list[tuple[str, Callable[[], Any]]] = [
            ("the learning curve", lambda: plots.learning_curve(self.folder, self.title))
        ]
        recorder = self.watcher.recorder
        if recorder is not None:
            path, title = self.folder / "challenge_gallery.png", f"Challenge gallery: {self.title}"
            drawings += [
                ("the coefficients", lambda: plots.coefficients(self.folder, self.title)),
                ("the challenge gallery", lambda: challenge_gallery(path, recorder.shots.choose(), title)),
            ]
        return drawings

    def _close_logs(self) -> None:
        with disk_errors_named(self.folder):
            self.model.logger.close()

    def _save_model(self) -> None:
        checkpoints.save_model(self.folder / "model.zip", self.model)

    def _save_challenger(self) -> None:
        callback = self.watcher.challenger
        if callback is not None and callback.challenger is not None:
            callback.save(self.folder / "challenger.pt")

    def _save_replay_buffer(self) -> None:
        buffer = getattr(self.model, "replay_buffer", None)
        if isinstance(buffer, CPMBuffer):
            buffer.save(self.folder / "replay_buffer.npz")

    def _save_normalization(self) -> None:
        normalize = self.model.get_vec_normalize_env()
        if normalize is not None:
            with disk_errors_named(self.folder), replacing(self.folder / run_folder.NORMALIZATION) as temporary:
                normalize.save(str(temporary))

    def _film(self) -> None:
        from sb3_cpm.run.evaluation import film
        from sb3_cpm.run.video import write_video

        outcome, frames = film(self.model, self.eval_env, self.spec.eval_seed)
        write_video(self.folder, "evaluation", frames)
        self.tell(f"The video shows an evaluation episode with return {outcome.episode_return:.2f}")

    def _summary(self, outcome: str) -> Summary:
        watcher, callback = self.watcher, self.watcher.challenger
        buffer, recorder = getattr(self.model, "replay_buffer", None), watcher.recorder
        counters = buffer.counters if isinstance(buffer, CPMBuffer) and callback is not None else None
        seconds = time.perf_counter() - self._started
        times = complete_times({"set-up": self.setup_seconds, **watcher.stopwatch.seconds}, seconds)
        training = seconds - sum(times.get(name, 0.0) for name in NOT_TRAINING)
        first, last = evaluated(self.folder)
        challenger = None if callback is None else callback.challenger
        return Summary(
            title=self.title,
            outcome=outcome,
            steps=self.model.num_timesteps,
            episodes=watcher.n_episodes,
            seconds=watcher.seconds_before + seconds,
            steps_per_second=(self.model.num_timesteps - self._steps_before) / max(training, 1e-9),
            first_success=first.success,
            success=last.success,
            first_return=first.mean_return,
            mean_return=last.mean_return,
            proposed=0 if counters is None else counters.proposed,
            kept=0 if counters is None else counters.kept,
            rejected_by={} if counters is None else dict(counters.rejected_by),
            explored_share=None if recorder is None else recorder.explored_share,
            challenger_updates=0 if challenger is None else challenger.trained_updates,
            player_updates=self.model._n_updates if isinstance(self.model, OffPolicyAlgorithm) else 0,
            time=times,
            peak_memory_gb=peak_memory_gb(),
            folder=str(self.folder),
        )


def check_device(device: str) -> None:
    """:raises ValueError: for a device that PyTorch does not have here: SB3 takes the CPU without a word"""
    try:
        wanted = th.device("cpu" if device == "auto" else device)
        if wanted.type != "cpu":
            th.zeros(1, device=wanted)
    except (RuntimeError, AssertionError) as error:
        told = str(error).strip().splitlines()[0]
        raise ValueError(
            f"device={device!r} cannot be used here ({told}). Take device='cpu', or 'auto', which is a GPU where there is one."
        ) from error


def _describe_end(error: BaseException) -> str:
    if isinstance(error, KeyboardInterrupt):
        return "stopped by Ctrl-C"
    if isinstance(error, SystemExit) and error.code == TERMINATED:
        return "stopped by SIGTERM"
    return f"ended by {type(error).__name__}: {error}"


def _attempt(what: str, job: Callable[[], Any]) -> bool:
    """:return: whether it succeeded; if not, that is told"""
    try:
        job()
        return True
    except (NotWrittenError, NotFiniteError, ImportError, DependencyNotInstalled) as error:
        print(f"Could not write {what}: {error}", file=sys.stderr, flush=True)
    except Exception:
        print(f"Could not write or close {what}:\n{traceback.format_exc()}", file=sys.stderr, flush=True)
    return False


def _tensorboard(folder: Path) -> KVWriter:
    """
    :param folder: where it goes
    :return: SB3's writer, which a full disk does not end the run by
    """
    with disk_errors_named(folder):
        output = make_output_format("tensorboard", str(folder))
    write, told = output.write, False

    def attempt(*args: Any) -> None:
        nonlocal told
        try:
            with disk_errors_named(folder):
                write(*args)
        except NotWrittenError as error:
            if not told:
                print(f"{error}. The run goes on; what is logged meanwhile may be missing.", flush=True)
            told = True

    output.write = attempt  # type: ignore[method-assign,assignment]
    return output
