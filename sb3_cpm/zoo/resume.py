"""
Runs of rl_zoo3 that can be continued with ``-i``.

Beside ``ENV.zip`` rl_zoo3 writes ``replay_buffer.pkl`` (with ``--save-replay-buffer``), which holds D, I, coefficients,
tolerances and reward memory. We add ``challenger.pt``; beside a checkpoint ``rl_model_N_steps.zip`` (``--save-freq``) it is
``rl_model_challenger_N_steps.pt``, and with ``--save-replay-buffer`` the buffer is brought up to date then too. Models and
buffers are rl_zoo3's to read: they are pickles, which can execute anything, so ``-i`` is for files that you trust.

rl_zoo3 starts ``-i`` at step 0, so it would repeat the random actions of ``learning_starts``; here the count goes on. The
continued run has a folder of its own; its ``evaluations.npz`` begins with those of the run that it continues. A buffer that is
loaded takes the place of the one that was made after the configuration: what can be changed in it is, the rest is told.
"""

import contextlib
import inspect
import pickle
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.utils import get_latest_run_id
from stable_baselines3.common.vec_env import VecEnv

from sb3_cpm.callbacks import ChallengerCallback
from sb3_cpm.files import NotFiniteError, NotWrittenError, replacing

CHALLENGER, BUFFER = "challenger.pt", "replay_buffer.pkl"

#: Arguments of a CPMBuffer that one with transitions can change: it reads the attribute whenever it samples.
LIVE = ("challenge_ratio", "demonstration_ratio", "mix", "terminal_goals", "refresh_every")


@contextlib.contextmanager
def loading(manager: Any, env: VecEnv) -> Iterator[None]:
    """
    Around ``ExperimentManager._load_pretrained_agent``: what pickle says of a damaged buffer names no file.

    :param manager: rl_zoo3's ``ExperimentManager``
    :param env: the training environments, closed if there will be no model to do so
    :raises ValueError: if the buffer is not complete
    """
    try:
        yield
    except BaseException as error:
        env.close()
        if not isinstance(error, (pickle.UnpicklingError, EOFError)):
            raise
        path = Path(manager.trained_agent).with_name(BUFFER)
        raise ValueError(
            f"{path} is no complete replay buffer ({error}). It may have been cut off while it was written: put an earlier "
            "one in its place, or move it away to go on with an empty buffer."
        ) from error


@contextlib.contextmanager
def kept(manager: Any, model: BaseAlgorithm) -> Iterator[Any]:
    """
    Around ``ExperimentManager.learn``: whatever ends it, the challenger is saved in the run's folder.

    :param manager: rl_zoo3's ``ExperimentManager``
    :param model: as it was made or loaded
    :return: what to train in its place
    """
    folder = Path(manager.save_path)
    learning_starts: Any = getattr(model, "learning_starts", None)
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
        if isinstance(model, OffPolicyAlgorithm):
            model.learning_starts = learning_starts  # _go_on may have moved it, which the next run must not add to
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
        """As SB3's, with ``reset_num_timesteps=False``, and a folder of its own for TensorBoard."""
        if self._model.tensorboard_log is not None:
            # SB3 goes on in the newest folder there is, whosever that may be: let it be one of ours
            name = inspect.signature(self._model.learn).parameters["tb_log_name"].default
            run_id = get_latest_run_id(self._model.tensorboard_log, name) + 1
            Path(self._model.tensorboard_log, f"{name}_{run_id}").mkdir(parents=True, exist_ok=True)
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
        try:
            _save_challengers(self.folder / f"rl_model_challenger_{self._due}_steps.pt", self.challengers)
            if self.with_buffer and isinstance(self.model, OffPolicyAlgorithm):
                with replacing(self.folder / BUFFER) as unfinished:
                    self.model.save_replay_buffer(unfinished)
        except (NotWrittenError, NotFiniteError) as error:
            _say(f"WARNING: {error}. The run goes on, and tries again at the next checkpoint")
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
        if saved is not None:
            _say(f"Loading challenger {saved}")
            callback.load_path = saved
        else:
            start = "anew" if callback.load_path is None else f"from {callback.load_path}"
            _say(f"WARNING: there is no {CHALLENGER} in {trained_agent.parent}: the challenger starts {start}")
    if isinstance(model, OffPolicyAlgorithm) and model.replay_buffer is not None:
        if _filled(model):
            _update_buffer(trained_agent, model)
        else:
            _say(
                f"WARNING: there is no {BUFFER} in {trained_agent.parent} (train with --save-replay-buffer): the buffer, its "
                f"challenges and coefficients start empty, and the {model.learning_starts} random steps of learning_starts "
                "are repeated to fill it"
            )
            model.learning_starts += model.num_timesteps
    newest = [CHALLENGER] if challengers and saved == trained_agent.with_name(CHALLENGER) else []
    if isinstance(model, OffPolicyAlgorithm) and _filled(model):
        newest.append(BUFFER)
    if newest and trained_agent.name.startswith(("best_model", "rl_model_")):
        _say(
            f"{trained_agent.name} is of step {model.num_timesteps}, and goes on with the run's newest {' and '.join(newest)}"
        )


def _update_buffer(trained_agent: Path, model: OffPolicyAlgorithm) -> None:
    """The loaded buffer does what the configuration says, as far as it can; the model knows what holds."""
    buffer = model.replay_buffer
    saved, _, _ = load_from_zip_file(trained_agent, device="cpu")
    assert saved is not None and buffer is not None
    before, now = saved["replay_buffer_kwargs"] or {}, dict(model.replay_buffer_kwargs or {})
    defaults = {name: one.default for name, one in inspect.signature(type(buffer).__init__).parameters.items()}
    fixed = {}
    for name in sorted({*before, *now}):
        was, wanted = before.get(name, defaults.get(name)), now.get(name, defaults.get(name))
        if was == wanted:
            continue
        if name in LIVE and hasattr(buffer, name):
            _say(f"{name} of the replay buffer is {wanted} from here on, it was {was}")
            setattr(buffer, name, wanted)
        else:
            fixed[f"replay_buffer_kwargs {name}"] = was, wanted
            now[name] = was
    if model.buffer_size != saved["buffer_size"]:
        fixed["buffer_size"] = saved["buffer_size"], model.buffer_size
    model.replay_buffer_kwargs, model.buffer_size = now, saved["buffer_size"]
    for name, (was, wanted) in fixed.items():
        _say(f"WARNING: {name} stays {was}, not {wanted}: it is fixed in {trained_agent.with_name(BUFFER)}")


def _remember_evaluations(trained_agent: Path, model: BaseAlgorithm, callbacks: Sequence[BaseCallback]) -> None:
    """So that plots show the whole curve."""
    path = trained_agent.with_name("evaluations.npz")
    if not path.is_file():
        return
    try:
        with path.open("rb") as file, np.load(file) as log:
            known = log["timesteps"] <= model.num_timesteps
            past = {name: log[name][known].tolist() for name in log.files if len(log[name]) == len(known)}
        results, lengths = past["results"], past["ep_lengths"]
    except Exception as error:  # of a file that is cut off, NumPy, zipfile and zlib each complain in their own way
        _say(f"WARNING: {path} cannot be read ({type(error).__name__}: {error}): the evaluations before are left out")
        return
    for callback in callbacks:
        if not isinstance(callback, EvalCallback):
            continue
        # a table: evaluations of other lengths do not fit into it
        if any(len(row) != callback.n_eval_episodes for row in results):
            _say(
                f"WARNING: {path} has evaluations of {len(results[0])} episodes, now it is {callback.n_eval_episodes} "
                "(--eval-episodes): the evaluations before are left out"
            )
            continue
        callback.evaluations_timesteps += past["timesteps"]
        callback.evaluations_results += results
        callback.evaluations_length += lengths
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
