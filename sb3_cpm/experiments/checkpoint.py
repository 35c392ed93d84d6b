"""
Checkpoints from which a killed run goes on as if nothing had happened.

SB3 restores neither random states nor environments. So a run makes a fresh start at every checkpoint, whether it was killed or
not: all random generators are seeded from (seed, step), and the environments begin new episodes. What a resumed run does from
there on is then the same as what an unbroken one does.
"""

import os
import pickle
import shutil
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_cpm.callbacks import ChallengerCallback
from sb3_cpm.run.evaluation import FIRST_SEED

NAME = "checkpoint"


def save_checkpoint(folder: Path, model: BaseAlgorithm, callbacks: list[BaseCallback], extra: dict[str, Any]) -> None:
    """
    Write a complete checkpoint, then let it take the place of the last one.

    :param folder: of the run
    :param model: with its replay buffer, where it has one
    :param callbacks: challengers among them are saved
    :param extra: plain data to be given back by :func:`load_extra`
    """
    new, current, old = (folder / f"{NAME}{suffix}" for suffix in (".new", "", ".old"))
    shutil.rmtree(new, ignore_errors=True)
    new.mkdir()
    model.save(new / "model.zip")
    if isinstance(model, OffPolicyAlgorithm):
        model.save_replay_buffer(new / "replay_buffer.pkl")
    normalize = model.get_vec_normalize_env()
    if normalize is not None:
        normalize.save(str(new / "vecnormalize.pkl"))
    next_training = {}
    for index, callback in enumerate(callbacks):
        if isinstance(callback, ChallengerCallback) and callback.challenger is not None:
            callback.save(new / f"challenger{index}.pt")
            next_training[index] = callback._next_training
    (new / "state.pkl").write_bytes(pickle.dumps({"next_training": next_training, **extra}))
    shutil.rmtree(old, ignore_errors=True)
    if current.exists():
        os.replace(current, old)
    os.replace(new, current)
    shutil.rmtree(old, ignore_errors=True)


def find_checkpoint(folder: Path) -> Path | None:
    """:return: the newest complete checkpoint of a run folder"""
    for name in (NAME, f"{NAME}.old"):
        if (folder / name / "state.pkl").exists():
            return folder / name
    return None


def remove_checkpoints(folder: Path) -> None:
    for suffix in ("", ".new", ".old"):
        shutil.rmtree(folder / f"{NAME}{suffix}", ignore_errors=True)


def load_extra(checkpoint: Path) -> dict[str, Any]:
    """
    :return: what was given to :func:`save_checkpoint`, and ``next_training`` of the challengers
    :raises ValueError: if the file is damaged
    """
    path = checkpoint / "state.pkl"
    try:
        return pickle.loads(path.read_bytes())
    except (pickle.UnpicklingError, EOFError, AttributeError, ValueError) as error:
        raise ValueError(f"{path} is damaged ({error}). Remove the folder {checkpoint} to begin the run anew.") from error


def restore_buffer(checkpoint: Path, model: BaseAlgorithm) -> None:
    """:param model: loaded from ``model.zip`` of this checkpoint; gets its replay buffer and normalization back"""
    if isinstance(model, OffPolicyAlgorithm):
        model.load_replay_buffer(checkpoint / "replay_buffer.pkl", truncate_last_traj=False)
    normalize = model.get_vec_normalize_env()
    if normalize is not None:
        from stable_baselines3.common.vec_env import VecNormalize

        saved = VecNormalize.load(str(checkpoint / "vecnormalize.pkl"), normalize.venv)
        normalize.obs_rms, normalize.ret_rms = saved.obs_rms, saved.ret_rms


class ChallengerRestorer(BaseCallback):
    """
    Gives challengers their state back once ``learn()`` has made them; to be listed after them.

    :param checkpoint: where it comes from
    :param callbacks: of the run
    """

    def __init__(self, checkpoint: Path, callbacks: list[BaseCallback]) -> None:
        super().__init__()
        self.checkpoint, self.callbacks = checkpoint, callbacks
        extra = load_extra(checkpoint)
        if "next_training" not in extra:
            raise ValueError(f"{checkpoint} was written by an earlier sb3_cpm: finish the run with that, or delete it.")
        self.next_training: dict[int, int] = extra["next_training"]

    def _on_training_start(self) -> None:
        for index, step in self.next_training.items():
            callback = self.callbacks[index]
            assert isinstance(callback, ChallengerCallback) and callback.challenger is not None
            callback.challenger.load_state(self.checkpoint / f"challenger{index}.pt")
            callback._next_training = step

    def _on_step(self) -> bool:
        return True


def fresh_start(model: BaseAlgorithm, seed: int, callbacks: Sequence[BaseCallback] = ()) -> None:
    """
    Seed everything from (seed, number of steps so far) and begin new episodes.

    :param model: before a rollout
    :param seed: of the run
    :param callbacks: of the run; what a challenger among them has put around the environments begins anew, too
    """
    wrappers = [
        callback._env for callback in callbacks if isinstance(callback, ChallengerCallback) and callback._env is not None
    ]
    env = wrappers[-1] if wrappers else model.env
    assert env is not None
    words = np.random.SeedSequence([seed, model.num_timesteps]).generate_state(1)
    model.set_random_seed(int(words[0]) % (FIRST_SEED - model.n_envs))  # evaluation has the seeds from there on
    buffer = getattr(model, "replay_buffer", None)
    if isinstance(buffer, HerReplayBuffer):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that it is cut is what we want
            buffer.truncate_last_trajectory()
    noise = getattr(model, "action_noise", None)
    if noise is not None:
        noise.reset()
    model._last_obs = env.reset()  # type: ignore[assignment]
    model._last_episode_starts = np.ones(model.n_envs, dtype=bool)
    normalize = model.get_vec_normalize_env()
    if normalize is not None:
        model._last_original_obs = normalize.get_original_obs()
    if model.use_sde:  # SB3 has drawn the noise of the rollout that begins, before it told anybody
        noisy = model.policy if isinstance(model, OnPolicyAlgorithm) else model.policy.actor
        noisy.reset_noise(model.n_envs)  # type: ignore[operator, union-attr]
