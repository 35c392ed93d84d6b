"""
One run from settings to a folder of results.

Whatever ends it (the last step, Ctrl-C, an exception), everything up to that moment is written and the environments are
closed. SB3 does the training; this module only prepares, watches and tidies up.
"""

import contextlib
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch as th
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.callbacks import BaseCallback, ProgressBarCallback
from stable_baselines3.common.logger import KVWriter, Logger, make_output_format
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import VecEnv

from sb3_cpm.arguments import check_arguments
from sb3_cpm.buffers import CPMBuffer
from sb3_cpm.buffers.checks import SET_BY_ALGORITHMS
from sb3_cpm.callbacks import ChallengerCallback
from sb3_cpm.checkpoint import save_model
from sb3_cpm.extractors import PointNetExtractor, PointNetPolicy
from sb3_cpm.extras import check_installed
from sb3_cpm.files import NotFiniteError, NotWrittenError, disk_errors_named
from sb3_cpm.player import max_episode_steps
from sb3_cpm.run import folder as run_folder
from sb3_cpm.run import plots
from sb3_cpm.run.arguments import misspelt_names_told
from sb3_cpm.run.environment import make_env, make_vec_env
from sb3_cpm.run.evaluation import Evaluator, play_episode, success_rate
from sb3_cpm.run.gallery import challenge_gallery
from sb3_cpm.run.recorder import Recorder
from sb3_cpm.run.settings import TrainSettings
from sb3_cpm.run.summary import NOT_TRAINING, Summary, complete_times, peak_memory_gb
from sb3_cpm.run.video import write_video
from sb3_cpm.seeds import FIRST_SEED

#: Trajectories in the challenge gallery.
N_SHOTS = 6
#: What ``model_kwargs`` cannot change: the run's own.
_OF_RUN = ("policy", "env", "replay_buffer_class", "replay_buffer_kwargs", "_init_setup_model")


def train(settings: TrainSettings | None = None, callback: BaseCallback | None = None, **changes: Any) -> Summary:
    """
    Train CPM on an environment and leave a folder of results.

    >>> train(env="CPMToy-v0", steps=2000, run_folder="runs/toy").success  # doctest: +SKIP
    1.0

    :param settings: of the run; None for ``TrainSettings(**changes)``
    :param callback: a further SB3 callback, called after those of the run
    :param changes: settings by name, when ``settings`` is None
    :return: the numbers of the run; they are also in its folder, as summary.json
    :raises ValueError: for settings that cannot work, before anything is trained
    """
    if settings is not None and changes:
        raise ValueError(f"Give either settings or single values, not both: {sorted(changes)}")
    settings = (settings or TrainSettings(**changes)).resolved()
    with misspelt_names_told(settings.as_dict()):
        return Run(settings).execute(callback)


class Run:
    """
    Environments, model, callbacks and folder of one run.

    :param settings: without None where a task has defaults of its own
    :raises ValueError: for settings that cannot work; nothing is left behind then
    """

    def __init__(self, settings: TrainSettings) -> None:
        self.settings = settings
        self.started = time.perf_counter()
        self.title = f"CPM-{settings.algorithm.upper()} on {settings.env}, seed {settings.seed}"
        th.set_num_threads(settings.threads)
        check_installed("Runs", ("tensorboard", *(["imageio"] if settings.video else [])), "run")
        with contextlib.ExitStack() as undo:
            self._folder = run_folder.RunFolder(settings)
            undo.callback(self._folder.discard)
            self.folder = self._folder.path
            self.env = make_vec_env(settings.env, settings.n_envs, settings.seed, **settings.env_kwargs)
            undo.callback(self.env.close)
            self.model = make_model(settings, self.env)
            _check_length(settings, self.model)
            self.evaluation_env = make_env(settings.env, render_mode="rgb_array", **settings.env_kwargs)
            undo.callback(self.evaluation_env.close)
            self.challenger = make_challenger(settings)
            self._describe()
            undo.pop_all()
        self.setup_seconds = time.perf_counter() - self.started

    def _describe(self) -> None:
        run_folder.write_yaml(self.folder / "config.yml", self.settings.as_dict())
        run_folder.write_yaml(self.folder / "versions.yml", run_folder.versions())
        formats = [("csv", self.folder), ("tensorboard", self.folder / "tensorboard")]
        self.model.set_logger(Logger(str(self.folder), [_patient_log(*one) for one in formats]))
        total = self.settings.steps or 0
        self.recorder = Recorder(self.folder, self.challenger, total)
        self.evaluator = Evaluator(
            self.evaluation_env,
            self.folder,
            self.challenger,
            total,
            self.settings.evaluations,
            self.settings.eval_episodes,
            after_each=self._checkpoint,
        )
        wanted = self.settings.progress_bar
        self.progress_bar = ProgressBarCallback() if (sys.stderr.isatty() if wanted is None else wanted) else None

    def execute(self, callback: BaseCallback | None = None) -> Summary:
        """
        Train, then write everything; an exception goes on after everything is written.

        :param callback: a further callback
        :return: the numbers of the run
        """
        # the order matters: what a callback reads of another must have happened
        callbacks = [self.challenger, self.recorder, self.evaluator, self.progress_bar, callback]
        say(f"{self.title}: {self.settings.steps} steps, results go to {self.folder}")
        try:
            self.model.learn(self.settings.steps or 0, [one for one in callbacks if one is not None], log_interval=2)
            self.evaluator.at_end()
        except BaseException as error:
            with _no_second_interrupt():
                if self.model.num_timesteps == 0:
                    self._discard()
                else:
                    self._finish(_describe_end(error)).show()
            raise
        with _no_second_interrupt():
            summary = self._finish("finished")
        summary.show()
        return summary

    def _checkpoint(self, news: str) -> None:
        """After each evaluation: should the process die without a word, this much is there."""
        if self.progress_bar is None:
            say(news)
        with self.challenger.stopwatch.section("pictures and saving"):
            for save in (self._save_model, self._save_challenger):
                try:
                    save()
                except (NotWrittenError, NotFiniteError) as error:
                    say(f"{error}. The run goes on, and tries again after the next evaluation.".replace("..", "."))

    # ------------------------------------------------------------------ what is left behind

    def _discard(self) -> None:
        """The run ended before its first step, so there is nothing to keep: no empty folder stays behind."""
        self._close()
        self._folder.discard()

    def _close(self) -> None:
        for what, close in (
            ("the progress bar", self._close_progress_bar),
            ("the logs", self.model.logger.close),
            ("the tables", self.recorder.close),
            ("the environments", self.env.close),
            ("the evaluation environment", self.evaluator.close),
        ):
            _attempt(what, close)

    def _close_progress_bar(self) -> None:
        if self.progress_bar is not None and hasattr(self.progress_bar, "pbar"):
            self.progress_bar.pbar.close()

    def _finish(self, outcome: str) -> Summary:
        """Write everything and close the environments. What fails is told and doesn't keep the rest from being written."""
        self._close_progress_bar()
        folder, finished = self.folder, outcome == "finished"
        say(f"Run {outcome}, step {self.model.num_timesteps}: writing everything to {folder}")
        jobs: list[tuple[str, Callable[[], Any]]] = [
            ("the model", self._save_model),
            ("the challenger", self._save_challenger),
            ("the replay buffer", self._save_replay_buffer),
            ("the logs", lambda: self.model.logger.dump(self.model.num_timesteps)),
            ("the learning curve", lambda: plots.learning_curve(folder, self.title)),
            ("the coefficients", lambda: plots.coefficients(folder, self.title)),
            ("the challenge gallery", self._draw_gallery),
        ]
        if self.settings.video and finished:
            jobs.append(("the video", self._film))
        with self.challenger.stopwatch.section("pictures and saving"):
            for what, job in jobs:
                _attempt(what, job)
            self._close()
        summary = self._summary(outcome)
        _attempt("the summary", lambda: summary.write(folder))
        self._folder.release()
        return summary

    def _save_model(self) -> None:
        save_model(self.folder / "model.zip", self.model)

    def _save_challenger(self) -> None:
        if self.challenger.challenger is not None:
            self.challenger.save(self.folder / "challenger.pt")

    def _save_replay_buffer(self) -> None:
        assert isinstance(self.model.replay_buffer, CPMBuffer)
        self.model.replay_buffer.save(self.folder / "replay_buffer.npz")

    def _draw_gallery(self) -> None:
        shots = self.recorder.shots.choose(N_SHOTS)
        challenge_gallery(self.folder / "challenge_gallery.png", shots, f"Challenge gallery: {self.title}")

    def _film(self) -> None:
        frames: list[Any] = []
        result = play_episode(self.model, self.evaluation_env, FIRST_SEED, frames)
        write_video(self.folder, "evaluation", frames)
        say(f"The video shows an evaluation episode with return {result.episode_return:.2f}")

    def _summary(self, outcome: str) -> Summary:
        counters = self.challenger.buffer.counters if isinstance(self.model.replay_buffer, CPMBuffer) else None
        seconds = time.perf_counter() - self.started
        times = complete_times({"set-up": self.setup_seconds, **self.challenger.stopwatch.seconds}, seconds)
        training = seconds - sum(times.get(name, 0.0) for name in NOT_TRAINING)
        results = self.evaluator.results
        first, last = (results[0][1], results[-1][1]) if results else (None, None)
        challenger = self.challenger.challenger
        return Summary(
            title=self.title,
            outcome=outcome,
            steps=self.model.num_timesteps,
            episodes=self.recorder.n_episodes,
            seconds=seconds,
            steps_per_second=self.model.num_timesteps / max(training, 1e-9),
            first_success=None if first is None else success_rate(first),
            success=None if last is None else success_rate(last),
            first_return=None if first is None else _mean_return(first),
            mean_return=None if last is None else _mean_return(last),
            proposed=0 if counters is None else counters.proposed,
            kept=0 if counters is None else counters.kept,
            rejected_by={} if counters is None else dict(counters.rejected_by),
            explored_share=self.recorder.explored_share,
            challenger_updates=0 if challenger is None else challenger.trained_updates,
            player_updates=self.model._n_updates,
            time=times,
            peak_memory_gb=peak_memory_gb(),
            folder=str(self.folder),
        )


def make_model(settings: TrainSettings, env: VecEnv) -> OffPolicyAlgorithm:
    """
    The player: an unmodified SB3 algorithm with a :class:`CPMBuffer`.

    :param settings: of the run
    :param env: the training environments
    """
    steps, episode = settings.steps or 0, _episode_steps(env)
    learning_starts, buffer_size = settings.learning_starts, settings.buffer_size
    if learning_starts is None:
        learning_starts = max(min(4 * episode, steps // 2), episode)  # the challenger needs a whole one
    if buffer_size is None:
        buffer_size = max(min(max(steps, 1000 * settings.n_envs), 20_000), 2 * episode)  # less is refused
    kwargs: dict[str, Any] = {
        "buffer_size": buffer_size,
        "batch_size": settings.batch_size,
        "learning_rate": settings.learning_rate,
        "gamma": settings.gamma,
        "tau": settings.tau,
        "train_freq": settings.train_freq,
        "gradient_steps": settings.gradient_steps,
        "learning_starts": learning_starts,
        "seed": settings.seed,
        "device": settings.device,
    }
    if settings.algorithm != "td3":
        coefficient = settings.ent_coef or "auto"
        kwargs["ent_coef"] = coefficient if coefficient.startswith("auto") else float(coefficient)
    algorithm = _algorithm(settings.algorithm)
    check_arguments("model_kwargs", settings.model_kwargs, algorithm, _OF_RUN)
    check_arguments("buffer_kwargs", settings.buffer_kwargs, CPMBuffer, SET_BY_ALGORITHMS)
    kwargs.update(settings.model_kwargs)
    kwargs["replay_buffer_class"] = CPMBuffer
    kwargs["replay_buffer_kwargs"] = {"challenge_ratio": settings.challenge_ratio, **settings.buffer_kwargs}
    policy, policy_kwargs = _policy(settings.algorithm, env)
    kwargs["policy_kwargs"] = {**policy_kwargs, **settings.model_kwargs.get("policy_kwargs", {})}
    return algorithm(policy, env, **kwargs)


def _episode_steps(env: VecEnv) -> int:
    """Steps of all environments together until each has ended an episode, 200 each where nobody knows."""
    return (max_episode_steps(env) or 200) * env.num_envs


def _check_length(settings: TrainSettings, model: OffPolicyAlgorithm) -> None:
    """A run that ends before the first update would look finished."""
    if (settings.steps or 0) <= model.learning_starts:
        episode = _episode_steps(model.env)  # type: ignore[arg-type]
        raise ValueError(
            f"steps={settings.steps} is no longer than learning_starts={model.learning_starts}, the steps before the first "
            f"update: nothing would be learned. Set steps above {model.learning_starts}"
            + (f", or learning_starts lower, to {episode} at least (an episode)" if model.learning_starts > episode else "")
            + "."
        )


def _policy(algorithm: str, env: VecEnv) -> tuple[Any, dict[str, Any]]:
    """PointNet (and vectors) for whatever has clouds or vectors; where there are only images, those are read."""
    images_only = all(is_image_space(space) for space in env.observation_space.spaces.values())  # type: ignore[attr-defined]
    extractor_kwargs = {"keys": list(env.observation_space.spaces)} if images_only else {}  # type: ignore[attr-defined]
    if algorithm == "sac":
        return PointNetPolicy, {"features_extractor_kwargs": extractor_kwargs}
    return "MultiInputPolicy", {
        "features_extractor_class": PointNetExtractor,
        "features_extractor_kwargs": extractor_kwargs,
    }


def _algorithm(name: str) -> type[OffPolicyAlgorithm]:
    if name == "sac":
        return SAC
    if name == "td3":
        return TD3
    try:
        from sb3_contrib import TQC
    except ImportError as error:
        raise ValueError('algorithm="tqc" needs sb3-contrib: pip install "sb3_cpm[contrib]"') from error
    return TQC


def make_challenger(settings: TrainSettings) -> ChallengerCallback:
    """
    :param settings: of the run
    :return: the callback that brings the challenger
    """
    kwargs = {
        "preset": settings.preset,
        "decay": settings.decay,
        "unit": settings.unit,
        "train_freq": settings.challenger_train_freq,
        "gradient_steps": settings.challenger_gradient_steps,
        **settings.callback_kwargs,
    }
    check_arguments("callback_kwargs", settings.callback_kwargs, ChallengerCallback)
    return ChallengerCallback(**kwargs)


def say(text: str) -> None:
    print(text, flush=True)


def _patient_log(kind: str, folder: Path) -> KVWriter:
    """
    :param kind: "csv" or "tensorboard"
    :param folder: where it goes
    :return: SB3's writer, which a full disk does not end the run by
    """
    with disk_errors_named(folder):
        output = make_output_format(kind, str(folder))
    write, told = output.write, False

    def attempt(*args: Any) -> None:
        nonlocal told
        try:
            with disk_errors_named(folder):
                write(*args)
        except NotWrittenError as error:
            if not told:
                say(f"{error}. The run goes on; what is logged meanwhile may be missing.")
            told = True

    output.write = attempt  # type: ignore[method-assign,assignment]
    return output


def _attempt(what: str, job: Callable[[], Any]) -> None:
    try:
        job()
    except (NotWrittenError, NotFiniteError) as error:
        print(f"Could not write {what}: {error}", file=sys.stderr, flush=True)
    except Exception:
        print(f"Could not write or close {what}:\n{traceback.format_exc()}", file=sys.stderr, flush=True)


def _describe_end(error: BaseException) -> str:
    if isinstance(error, KeyboardInterrupt):
        return "stopped by Ctrl-C"
    return f"ended by {type(error).__name__}: {error}"


@contextlib.contextmanager
def _no_second_interrupt() -> Iterator[None]:
    """An impatient second Ctrl-C must not spoil what is being written."""
    try:
        previous = signal.signal(signal.SIGINT, signal.SIG_IGN)
    except ValueError:  # not in the main thread, where no Ctrl-C arrives
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)


def _mean_return(results: list[Any]) -> float:
    return sum(result.episode_return for result in results) / len(results)
