"""
Runs of rl_zoo3 that can be continued with ``-i``.

Beside ``ENV.zip`` rl_zoo3 writes ``replay_buffer.pkl`` (with ``--save-replay-buffer``), which holds D, I, coefficients,
tolerances and reward memory. We add ``challenger.pt``; beside a checkpoint ``rl_model_N_steps.zip`` (``--save-freq``) it is
``rl_model_challenger_N_steps.pt``, and with ``--save-replay-buffer`` the buffer is brought up to date then too.

rl_zoo3 starts ``-i`` at step 0, so it would repeat the random actions of ``learning_starts``; here the count goes on. The
continued run has a folder of its own; its ``evaluations.npz`` begins with those of the run that it continues.
"""

import contextlib
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_cpm.callbacks import ChallengerCallback

CHALLENGER, BUFFER = "challenger.pt", "replay_buffer.pkl"


@contextlib.contextmanager
def kept(manager: Any, model: BaseAlgorithm) -> Iterator[Any]:
    """
    Around ``ExperimentManager.learn``: whatever ends it, the challenger is saved in the run's folder.

    :param manager: rl_zoo3's ``ExperimentManager``
    :param model: as it was made or loaded
    :return: what to train in its place
    """
    folder = Path(manager.save_path)
    challengers = [callback for callback in manager.callbacks if isinstance(callback, ChallengerCallback)]
    if manager.continue_training:
        _go_on(Path(manager.trained_agent), model, challengers)
        _remember_evaluations(Path(manager.trained_agent), model, manager.callbacks)
        # not once more the start states and random numbers that the first run began with
        model.set_random_seed((manager.seed + model.num_timesteps) % 2**31)
    if manager.save_freq > 0:
        manager.callbacks.append(_Checkpoints(folder, manager.save_freq, challengers, manager.save_replay_buffer))
    try:
        yield _Continued(model) if manager.continue_training else model
    finally:
        _save_challengers(folder / CHALLENGER, challengers)


class _Continued:
    """
    A model whose ``learn`` goes on counting; everything else is the model's.

    :param model: the model
    """

    def __init__(self, model: BaseAlgorithm) -> None:
        self._model = model

    def __getattr__(self, name: str) -> Any:
        return getattr(self._model, name)

    def learn(self, total_timesteps: int, **kwargs: Any) -> BaseAlgorithm:
        """As SB3's, with ``reset_num_timesteps=False``."""
        return self._model.learn(total_timesteps, reset_num_timesteps=False, **kwargs)


class _Checkpoints(BaseCallback):
    """
    Beside the checkpoints of SB3's ``CheckpointCallback``: what else a continued run needs.

    The model is saved in ``on_step``, before its last transition is stored; these are saved when the rollout has ended.

    :param folder: of the run
    :param save_freq: calls of ``on_step`` between two checkpoints
    :param challengers: callbacks that have one
    :param with_buffer: whether the replay buffer is saved
    """

    def __init__(self, folder: Path, save_freq: int, challengers: Sequence[ChallengerCallback], with_buffer: bool) -> None:
        super().__init__()
        self.folder = folder
        self.save_freq = save_freq
        self.challengers = challengers
        self.with_buffer = with_buffer
        self._due: int | None = None

    def _on_step(self) -> bool:
        if self.n_calls % self.save_freq == 0:
            self._due = self.num_timesteps
        return True

    def _on_rollout_end(self) -> None:
        if self._due is None:
            return
        _save_challengers(self.folder / f"rl_model_challenger_{self._due}_steps.pt", self.challengers)
        if self.with_buffer and isinstance(self.model, OffPolicyAlgorithm):
            unfinished = self.folder / f"unfinished_{BUFFER}"
            self.model.save_replay_buffer(unfinished)
            unfinished.replace(self.folder / BUFFER)
        self._due = None


def _save_challengers(path: Path, challengers: Sequence[ChallengerCallback]) -> None:
    for callback in challengers:
        if callback.challenger is not None:
            callback.save(path)


def _go_on(trained_agent: Path, model: BaseAlgorithm, challengers: Sequence[ChallengerCallback]) -> None:
    """Give the callbacks what the stopped run had learnt, and say what could not be found."""
    _say(f"Going on at step {model.num_timesteps}")
    saved = challenger_file(trained_agent)
    for callback in challengers:
        if saved is None:
            _say(f"WARNING: there is no {CHALLENGER} in {trained_agent.parent}: the challenger starts anew")
        else:
            _say(f"Loading challenger {saved}")
            callback.load_path = saved
    if isinstance(model, OffPolicyAlgorithm) and model.replay_buffer is not None and not _filled(model):
        _say(
            f"WARNING: there is no {BUFFER} in {trained_agent.parent} (train with --save-replay-buffer): the buffer, its "
            f"challenges and coefficients start empty, and the {model.learning_starts} random steps of learning_starts are "
            "repeated to fill it"
        )
        model.learning_starts += model.num_timesteps


def _remember_evaluations(trained_agent: Path, model: BaseAlgorithm, callbacks: Sequence[BaseCallback]) -> None:
    """So that plots show the whole curve."""
    path = trained_agent.with_name("evaluations.npz")
    if not path.is_file():
        return
    with np.load(path) as log:
        known = log["timesteps"] <= model.num_timesteps
        past = {name: log[name][known].tolist() for name in log.files if len(log[name]) == len(known)}
    for callback in callbacks:
        # a table: evaluations of other lengths do not fit into it
        if isinstance(callback, EvalCallback) and all(len(row) == callback.n_eval_episodes for row in past["results"]):
            callback.evaluations_timesteps += past["timesteps"]
            callback.evaluations_results += past["results"]
            callback.evaluations_length += past["ep_lengths"]
            callback.evaluations_successes += past.get("successes", [])


def _filled(model: OffPolicyAlgorithm) -> bool:
    return model.replay_buffer is not None and model.replay_buffer.size() > 0


def challenger_file(trained_agent: Path) -> Path | None:
    """
    :param trained_agent: the model that ``-i`` names
    :return: the challenger that was saved with it, None if there is none
    """
    checkpoint = trained_agent.name.replace("rl_model_", "rl_model_challenger_").replace(".zip", ".pt")
    candidates = [trained_agent.with_name(checkpoint), trained_agent.with_name(CHALLENGER)]
    return next((path for path in candidates if path.is_file()), None)


def _say(text: str) -> None:
    sys.stdout.write(f"{text}\n")  # beside what rl_zoo3 prints
