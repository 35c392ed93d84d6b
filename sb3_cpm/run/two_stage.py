"""
Training in two stages (Gao et al. 2023, ManiSkill2's winners on rigid bodies): a first one with evaluations, a second one that
goes on from its best checkpoint, optimizer included, with shorter rounds and smaller batches. The best of all checkpoints is
the result, evaluated once more on episodes that chose nothing.

``folder/checkpoint`` is where the training is, ``folder/best`` the best so far. One that was cut off goes on when the same is
called again, and ends as an unbroken one would (:mod:`sb3_cpm.checkpoint`).
"""

import json
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecEnv

from sb3_cpm import checkpoint as checkpoints
from sb3_cpm.agents import load_agent
from sb3_cpm.agents.tasks import imported, task_id
from sb3_cpm.arguments import check, check_each, integer, number
from sb3_cpm.files import locked, write_text
from sb3_cpm.imitation import DAPG
from sb3_cpm.run.evaluation import Outcome, evaluate
from sb3_cpm.run.execution import check_device
from sb3_cpm.seeds import FIRST_SEED, check_seed

#: Of the first episode that checkpoints are chosen by; the result is that of the episodes from ``FIRST_SEED`` on.
SELECTION_SEED = 2_000_000
#: What the second stage's rounds and batches are, as shares of the first's: 17,500 of 20,000 steps, 297 of 330 rows.
ROUND_SHARE, BATCH_SHARE = 0.875, 0.9
RESULT = "result.json"

#: As :func:`~sb3_cpm.run.evaluation.evaluate`: of a model, an environment, a number of episodes, the first one's seed.
Evaluation = Callable[[BaseAlgorithm, VecEnv, int, int], Sequence[Outcome]]


class Rated(NamedTuple):
    """
    A checkpoint and what it has reached on the selection's episodes.

    :param stage: 1 or 2
    :param step: environment steps of its model
    :param success: rate at the end of episodes; 0 where the environment tells none
    :param mean_return: of the task's own rewards
    """

    stage: int
    step: int
    success: float
    mean_return: float

    def better_than(self, other: "Rated | None") -> bool:
        """By success, then by return; of equals the earlier stays."""
        return other is None or (self.success, self.mean_return) > (other.success, other.mean_return)


class TwoStageResult(NamedTuple):
    """
    What :func:`train_two_stages` has found.

    :param best: the checkpoint that was chosen
    :param success: its success rate on test episodes, which selection never saw
    :param mean_return: its return there
    :param table: every evaluation of both stages
    :param checkpoint: folder of the checkpoint, whose ``model.zip`` the algorithm's ``load`` reads
    """

    best: Rated
    success: float
    mean_return: float
    table: list[Rated]
    checkpoint: Path


def train_two_stages(
    make_model: Callable[[int], BaseAlgorithm],
    make_eval_env: Callable[[], VecEnv],
    total_timesteps: int,
    folder: str | Path,
    seed: int = 0,
    second: Mapping[str, Any] | None = None,
    callback: Sequence[BaseCallback] = (),
    eval_every: int = 20_000,
    eval_episodes: int = 100,
    split: float = 0.5,
    patience: int | None = None,
    test_episodes: int = 100,
    evaluation: Evaluation = evaluate,
    tell: Callable[[str], None] = lambda news: None,
) -> TwoStageResult:
    """
    Train, choose, train on from what was chosen, and choose again. Called again after it was cut off, it goes on.

    :param make_model: gives the first stage's model with its environments, from the seed
    :param make_eval_env: gives one environment for evaluations, with the same wrappers
    :param total_timesteps: environment steps of both stages together
    :param folder: for checkpoints and result
    :param seed: rules both stages
    :param second: attributes of the second stage's model that are others than the first's, as ``load()`` takes them, for
        instance ``{"n_steps": 4375, "batch_size": 297}``; of off-policy models ``train_freq``, ``gradient_steps`` and
        ``batch_size``. None: the paper's shares of the first stage's rounds and batches
    :param callback: of both stages; a :class:`~sb3_cpm.imitation.CloneCallback` clones before the first
    :param eval_every: environment steps between two evaluations
    :param eval_episodes: episodes of each
    :param split: share of the steps that are the first stage's
    :param patience: evaluations without a new best after which the first stage ends; None: at its share of the steps
    :param test_episodes: episodes of the last evaluation
    :param evaluation: plays the episodes
    :param tell: is given a line now and then
    :return: the best of all checkpoints
    :raises ValueError: for arguments that cannot work, a second stage that its first round does not fit, and a folder of other
        settings
    :raises LockedError: while another process trains there
    """
    check_each(integer(1), total_timesteps=total_timesteps, eval_every=eval_every, eval_episodes=eval_episodes)
    check("test_episodes", test_episodes, integer(1))
    check("split", split, number("a number between 0 and 1", lambda value: 0.0 < value < 1.0))
    if patience is not None:
        check("patience", patience, integer(1))
    if FIRST_SEED + test_episodes > SELECTION_SEED:
        raise ValueError(
            f"test_episodes={test_episodes} reach into the episodes of the selection: {SELECTION_SEED - FIRST_SEED}."
        )
    settings = {
        **{"total_timesteps": total_timesteps, "seed": seed, "second": None if second is None else dict(second)},
        **{"eval_every": eval_every, "eval_episodes": eval_episodes, "split": split, "patience": patience},
        **{"test_episodes": test_episodes},
    }
    folder = Path(folder)
    with locked(folder):
        training = _Training(folder, make_model(seed), make_eval_env(), settings, callback, evaluation, tell)
        try:
            return training.run()
        finally:
            training.close()


def two_stage_agent(
    agent: str,
    env: str,
    steps: int | None = None,
    folder: str | None = None,
    seed: int = 0,
    second: Mapping[str, Any] | None = None,
    overrides: Mapping[str, Any] | None = None,
    device: str = "auto",
    tell: Callable[[str], None] = lambda news: None,
    **settings: Any,
) -> TwoStageResult:
    """
    :func:`train_two_stages` with an agent of ``zoo_configs/``: what ``python -m sb3_cpm two-stage`` does.

    :param agent: the name of a file, or the path of one
    :param env: a task, as for :func:`~sb3_cpm.run.train`
    :param steps: of both stages together; None: as the agent's file says
    :param folder: for checkpoints and result; None: below ``runs/``, named after agent, task and seed
    :param seed: rules both stages
    :param second: see there
    :param overrides: entries that win over those of the file
    :param device: PyTorch device
    :param tell: is given a line now and then
    :param settings: further ones of :func:`train_two_stages`
    :return: the best of all checkpoints
    :raises ValueError: for an unknown agent, task or hyperparameter, and see there
    """
    check_device(device)
    module, _, name = env.rpartition(":")
    imported(module, name)
    env_id = task_id(name)
    loaded = load_agent(agent, env_id, overrides)
    check_seed(seed, loaded.n_envs)
    built = loaded.build(seed, device=device, vec_env_type="robust" if loaded.n_envs > 1 else "dummy")
    built.model.set_logger(Logger(None, []))
    return train_two_stages(
        lambda seed: built.model,
        built.make_eval_env,
        steps or loaded.n_timesteps,
        folder or f"runs/{env_id.replace('/', '-')}-{loaded.name}-two-stage-seed{seed}",
        seed,
        second,
        built.callbacks,
        tell=tell,
        **settings,
    )


class _Training:
    """
    :param folder: of checkpoints and result
    :param model: as it begins
    :param eval_env: for evaluations
    :param settings: arguments of :func:`train_two_stages` that checkpoints must agree with
    :param callback: of both stages
    :param evaluation: plays episodes
    :param tell: is given a line now and then
    """

    def __init__(
        self,
        folder: Path,
        model: BaseAlgorithm,
        eval_env: VecEnv,
        settings: dict[str, Any],
        callback: Sequence[BaseCallback],
        evaluation: Evaluation,
        tell: Callable[[str], None],
    ) -> None:
        self.folder, self.model, self.eval_env, self.settings = folder, model, eval_env, settings
        self.callbacks, self.evaluation, self.tell = list(callback), evaluation, tell
        assert model.env is not None
        self.env = model.env
        self.stage, self.table = 1, list[Rated]()
        self.best: Rated | None = None
        self.stale = 0
        self.next_evaluation = 0
        self.end = int(settings["split"] * settings["total_timesteps"])
        self.seeds = {1: settings["seed"], 2: checkpoints.seed_at(2, settings["seed"], model.n_envs)}
        self.second = _second_settings(model) if settings["second"] is None else dict(settings["second"])

    def close(self) -> None:
        self.env.close()
        self.eval_env.close()

    def run(self) -> TwoStageResult:
        """Both stages, or what is left of them."""
        check_seed(self.settings["seed"], self.model.n_envs)
        _check_second(self.model, self.second)
        if (self.folder / RESULT).exists():
            self._check_same(json.loads((self.folder / RESULT).read_text())["settings"])
            return _read_result(self.folder)
        found = checkpoints.find_checkpoint(self.folder)
        if found is not None:
            self._go_on(found)
        if self.stage == 1:
            self._learn(goes_on=found is not None)
            self._begin_second()
            self._learn(goes_on=True, saved=False)
        else:
            self._learn(goes_on=True)
        return self._finish()

    def _learn(self, goes_on: bool, saved: bool = True) -> None:
        stage = _Stage(self, goes_on, saved)
        if self.model.num_timesteps < self.end and not self._has_enough():
            self.model.learn(
                self.end - self.model.num_timesteps,
                callback=[*self.callbacks, stage],
                log_interval=None,  # type: ignore[arg-type]
                reset_num_timesteps=False,
            )
        if not self._has_enough() and (self.table[-1].stage, self.table[-1].step) != (self.stage, self.model.num_timesteps):
            self.rate()

    def _has_enough(self) -> bool:
        """Whether patience is at its end."""
        patience = self.settings["patience"]
        return self.stage == 1 and patience is not None and self.stale >= patience

    def _begin_second(self) -> None:
        """The best checkpoint of the first stage becomes the second's model."""
        taken = self.table[-1].step
        best = checkpoints.find_checkpoint(self.folder / "best")
        assert best is not None and self.best is not None
        self.tell(f"Stage 2 begins with the best of stage 1, that of step {self.best.step}: {_setting_words(self.second)}")
        self._load(best, seed=self.seeds[2], **self.second)
        self.stage, self.stale = 2, 0
        self.end = self.best.step + self.settings["total_timesteps"] - taken
        self.next_evaluation = self.best.step + self.settings["eval_every"]

    def _load(self, checkpoint: Path, **changes: Any) -> None:
        model = self.model
        if isinstance(model, DAPG) and model.demo_coef:  # an expert has been asked already
            changes["demonstrations"] = model.demonstration_episodes()
        logger = model.logger if model._custom_logger else None
        self.model = type(model).load(checkpoint / checkpoints.MODEL, self.env, device=model.device, **changes)
        if logger is not None:
            self.model.set_logger(logger)
        checkpoints.restore(checkpoint, self.model, self.callbacks)

    def _go_on(self, found: Path) -> None:
        state = checkpoints.load_extra(found)
        self._check_same(state["settings"])
        self._load(found)
        self.stage, self.stale, self.end = state["stage"], state["stale"], state["end"]
        self.next_evaluation = state["next_evaluation"]
        self.table = [Rated(*row) for row in state["table"]]
        self.best = Rated(*state["best"]) if state["best"] else None
        self.tell(f"Goes on in stage {self.stage} at step {self.model.num_timesteps}")

    def _check_same(self, theirs: Mapping[str, Any]) -> None:
        changed = [
            f"{name}: there {theirs.get(name)!r}, here {value!r}"
            for name, value in self.settings.items()
            if theirs.get(name) != value
        ]
        if changed:
            raise ValueError(
                f"{self.folder} holds a training with other settings ({'; '.join(changed)}). Choose another folder, or give "
                "the same settings to go on with it."
            )

    def save(self) -> None:
        """Where the training is, for when it is cut off."""
        state = {
            **{"settings": self.settings, "stage": self.stage, "stale": self.stale, "end": self.end},
            **{"next_evaluation": self.next_evaluation, "table": [list(row) for row in self.table]},
            "best": None if self.best is None else list(self.best),
        }
        checkpoints.save_checkpoint(self.folder, self.model, self.callbacks, state)

    def rate(self) -> None:
        """Evaluate the model as it is, and keep it if it is the best so far."""
        settings = self.settings
        outcomes = self.evaluation(self.model, self.eval_env, settings["eval_episodes"], SELECTION_SEED)
        rated = Rated(self.stage, self.model.num_timesteps, *_means(outcomes))
        self.table.append(rated)
        self.stale += 1
        if rated.better_than(self.best):
            self.best, self.stale = rated, 0
            (self.folder / "best").mkdir(exist_ok=True)
            checkpoints.save_checkpoint(self.folder / "best", self.model, self.callbacks, {"rated": list(rated)})
        marked = ", the best so far" if self.best is rated else ""
        self.tell(
            f"Stage {rated.stage}, step {rated.step}: success {rated.success:.0%}, return {rated.mean_return:.2f}{marked}"
        )

    def _finish(self) -> TwoStageResult:
        best = checkpoints.find_checkpoint(self.folder / "best")
        assert best is not None and self.best is not None
        self._load(best)
        outcomes = self.evaluation(self.model, self.eval_env, self.settings["test_episodes"], FIRST_SEED)
        success, mean_return = _means(outcomes)
        content = {
            **{"settings": self.settings, "best": self.best._asdict(), "success": success, "mean_return": mean_return},
            "table": [row._asdict() for row in self.table],
        }
        write_text(self.folder / RESULT, json.dumps(content, indent=2) + "\n")
        checkpoints.remove_checkpoints(self.folder)
        self.tell(
            f"The best is that of stage {self.best.stage}, step {self.best.step}: on other episodes success {success:.0%}"
        )
        return _read_result(self.folder)


class _Stage(BaseCallback):
    """
    Evaluates and saves before rollouts, as :class:`~sb3_cpm.run.watcher.Watcher` does: what comes after a checkpoint is the
    same whether it was gone on from or not.

    :param training: that it is a stage of
    :param goes_on: whether the model comes from a checkpoint
    :param saved: whether that is this stage's
    """

    def __init__(self, training: _Training, goes_on: bool, saved: bool) -> None:
        super().__init__()
        self.training, self.goes_on, self.saved = training, goes_on, saved

    def _on_rollout_start(self) -> None:
        training = self.training
        due = training.next_evaluation <= self.num_timesteps
        if due:
            training.rate()
            training.next_evaluation = self.num_timesteps + training.settings["eval_every"]
        if due or not self.saved:
            training.save()
            self.saved = True
        if due or self.goes_on:
            checkpoints.fresh_start(self.model, training.seeds[training.stage], training.callbacks)
        self.goes_on = False

    def _on_step(self) -> bool:
        return not self.training._has_enough()


def _means(outcomes: Sequence[Outcome]) -> tuple[float, float]:
    told = [outcome.success_at_end for outcome in outcomes if outcome.success_at_end is not None]
    return float(np.mean(told)) if told else 0.0, float(np.mean([outcome.episode_return for outcome in outcomes]))


def _second_settings(model: BaseAlgorithm) -> dict[str, Any]:
    """The paper's shares of what the model has."""
    shares = {"n_steps": ROUND_SHARE, "batch_size": BATCH_SHARE}
    on_policy = hasattr(model, "rollout_buffer")
    names = [name for name in shares if hasattr(model, name) and (on_policy or name == "batch_size")]
    return {name: max(round(shares[name] * getattr(model, name)), 1) for name in names}


def _check_second(model: BaseAlgorithm, second: Mapping[str, Any]) -> None:
    for name in second:
        if not hasattr(model, name):
            raise ValueError(f"second: {type(model).__name__} has no {name!r}.")
    n_steps, batch_size = (second.get(name, getattr(model, name, None)) for name in ("n_steps", "batch_size"))
    if hasattr(model, "rollout_buffer") and batch_size is not None and n_steps * model.n_envs < batch_size:
        raise ValueError(
            f"second: a round of {n_steps} steps in {model.n_envs} environments has less than a batch of {batch_size}. Give "
            "it more n_steps, or a smaller batch_size."
        )
    if batch_size is not None and batch_size >= model.batch_size:  # type: ignore[attr-defined]
        warnings.warn(
            f"second: its batch_size={batch_size} is not below the first stage's {model.batch_size}, "  # type: ignore[attr-defined]
            "as the paper's is.",
            stacklevel=3,
        )


def _setting_words(settings: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} {value}" for name, value in settings.items())


def _read_result(folder: Path) -> TwoStageResult:
    content = json.loads((folder / RESULT).read_text())
    best = checkpoints.find_checkpoint(folder / "best")
    assert best is not None
    table = [Rated(**row) for row in content["table"]]
    return TwoStageResult(Rated(**content["best"]), content["success"], content["mean_return"], table, best)
