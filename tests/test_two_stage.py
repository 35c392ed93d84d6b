"""Two stages: the second goes on from the best checkpoint of the first, and the best of all is the result."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import A2C, PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize

from sb3_cpm import checkpoint as checkpoints
from sb3_cpm.run.evaluation import Outcome, evaluate
from sb3_cpm.run.two_stage import SELECTION_SEED, Rated, train_two_stages
from sb3_cpm.seeds import FIRST_SEED


class Match(gym.Env):
    """The action should be the number that is seen; a success if it nearly is in the last of five steps."""

    observation_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
    seeds: set[int] = set()  # noqa: RUF012

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        if seed is not None:
            Match.seeds.add(seed)
        self.steps, self.number = 0, self.np_random.uniform(-0.5, 0.5, 1).astype(np.float32)
        return self.number, {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        distance = float(abs(action - self.number)[0])
        return self.number, 1 - distance, False, self.steps == 5, {"is_success": distance < 0.2}


def make_env() -> VecEnv:
    return DummyVecEnv([lambda: Monitor(Match())])


def make_model(seed: int, kind: type[BaseAlgorithm] = PPO, **kwargs: Any) -> BaseAlgorithm:
    sizes = {PPO: {"n_steps": 40, "batch_size": 20, "n_epochs": 4, "learning_rate": 1e-3}, A2C: {"n_steps": 40}}.get(
        kind, {"buffer_size": 400, "batch_size": 20}
    )
    env = VecNormalize(make_env(), norm_reward=False)
    return kind("MlpPolicy", env, seed=seed, device="cpu", policy_kwargs={"net_arch": [8]}, **{**sizes, **kwargs})


class Script:
    """
    Evaluations that are given, and what they were of.

    :param rated: success and return of each; the test's last
    """

    def __init__(self, *rated: tuple[float, float]) -> None:
        self.rated = list(rated)
        self.seen: list[dict[str, Any]] = []

    def __call__(self, model: BaseAlgorithm, env: VecEnv, n_episodes: int, first_seed: int) -> list[Outcome]:
        success, mean_return = self.rated[len(self.seen)]
        weights = {name: one.detach().clone() for name, one in model.policy.state_dict().items()}
        adam = model.policy.optimizer.state_dict()["state"] if isinstance(model, PPO) else {}
        moments = [one["exp_avg"].clone() for one in adam.values()]
        self.seen.append({"weights": weights, "adam": moments, "step": model.num_timesteps, "first_seed": first_seed})
        wins = round(success * n_episodes)
        return [Outcome(mean_return, 5, index < wins, index < wins) for index in range(n_episodes)]


class Noting(BaseCallback):
    """The model at the beginning of every learn()."""

    def __init__(self) -> None:
        super().__init__()
        self.begun: list[dict[str, Any]] = []

    def _on_training_start(self) -> None:
        model: Any = self.model
        adam = model.policy.optimizer.state_dict()["state"]
        self.begun.append(
            {
                "weights": {name: one.detach().clone() for name, one in model.policy.state_dict().items()},
                "adam": [one["exp_avg"].clone() for one in adam.values()],
                **{name: getattr(model, name) for name in ("n_steps", "batch_size", "num_timesteps", "seed")},
                "round": model.rollout_buffer.buffer_size,
            }
        )

    def _on_step(self) -> bool:
        return True


def same(one: dict[str, Any], other: dict[str, Any]) -> bool:
    weights = all(th.equal(value, other["weights"][name]) for name, value in one["weights"].items())
    return weights and len(one["adam"]) == len(other["adam"]) and all(map(th.equal, one["adam"], other["adam"]))


def scripted(folder: Path, *rated: tuple[float, float], **kwargs: Any) -> tuple[Any, Script, Noting]:
    script, noting = Script(*rated), Noting()
    arguments: dict[str, Any] = {"total_timesteps": 320, "eval_every": 40, "eval_episodes": 10, "test_episodes": 10, **kwargs}
    result = train_two_stages(make_model, make_env, folder=folder, evaluation=script, callback=[noting], **arguments)
    return result, script, noting


def test_the_best_of_stage_one_begins_stage_two(tmp_path: Path) -> None:
    rated = [(0.2, 5.0), (0.7, 4.0), (0.5, 9.0), (0.7, 4.5), (0.1, 1.0), *[(0.3, 3.0)] * 3, (0.6, 1.0)]
    result, script, noting = scripted(tmp_path, *rated)
    first, second = noting.begun
    assert [one["step"] for one in script.seen[:5]] == [0, 40, 80, 120, 160]
    assert second["num_timesteps"] == 120 and same(second, script.seen[3]) and not same(second, script.seen[4])
    assert (first["n_steps"], first["batch_size"], first["round"]) == (40, 20, 40)
    assert (second["n_steps"], second["batch_size"], second["round"]) == (35, 18, 35)
    assert first["seed"] != second["seed"]
    assert result.best == Rated(1, 120, 0.7, 4.5)
    assert same(script.seen[-1], script.seen[3]), "what is tested is the best of all, not the last"
    assert (result.success, result.mean_return) == (0.6, 1.0)
    assert [row.step for row in result.table if row.stage == 2][-1] >= 120 + 160
    loaded = PPO.load(result.checkpoint / "model.zip")
    assert same({"weights": script.seen[3]["weights"], "adam": []}, {"weights": loaded.policy.state_dict(), "adam": []})


def test_of_equals_the_earlier_is_taken_and_stage_two_may_win(tmp_path: Path) -> None:
    rated = [(0.2, 5.0), (0.7, 4.0), (0.7, 4.0), (0.5, 4.0), (0.1, 1.0), (0.7, 4.0), (0.8, 1.0), *[(0.8, 1.0)] * 4]
    result, script, noting = scripted(tmp_path, *rated)
    assert noting.begun[1]["num_timesteps"] == 40
    assert result.best.stage == 2 and result.best.step == script.seen[6]["step"]
    assert not (tmp_path / "checkpoint").exists()
    # called again it has the result without training
    again, other, _ = scripted(tmp_path)
    assert again == result and other.seen == []
    with pytest.raises(ValueError, match="holds a training with other settings.*split: there 0.5, here 0.25"):
        scripted(tmp_path, split=0.25)


def test_patience_ends_stage_one_and_stage_two_gets_its_steps(tmp_path: Path) -> None:
    rated = [(0.5, 0.0), (0.9, 0.0), (0.5, 0.0), (0.5, 0.0), *[(0.1, 0.0)] * 9]
    result, _, noting = scripted(tmp_path, *rated, patience=2)
    assert [row.step for row in result.table if row.stage == 1] == [0, 40, 80, 120]
    assert noting.begun[1]["num_timesteps"] == 40
    last = result.table[-1].step
    assert 40 + 320 - 120 <= last < 40 + 320 - 120 + 35, "what stage one has left over"


class Stop(Exception):
    pass


def test_a_training_that_was_cut_off_in_stage_two_ends_as_an_unbroken_one(tmp_path: Path) -> None:
    arguments: dict[str, Any] = {"total_timesteps": 400, "eval_every": 40, "eval_episodes": 10, "test_episodes": 10}
    told: list[str] = []

    def train(folder: str, evaluation: Callable[..., Any] = evaluate) -> Any:
        return train_two_stages(
            make_model, make_env, folder=tmp_path / folder, evaluation=evaluation, tell=told.append, **arguments
        )

    unbroken = train("unbroken")
    calls = 0

    def breaking(*args: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == 8:
            raise Stop
        return evaluate(*args)

    with pytest.raises(Stop):
        train("broken", breaking)
    assert checkpoints.load_extra(tmp_path / "broken" / "checkpoint")["stage"] == 2
    told.clear()
    resumed = train("broken")
    assert told[0].startswith("Goes on in stage 2 at step ")
    assert resumed.table == unbroken.table and resumed.best == unbroken.best
    assert (resumed.success, resumed.mean_return) == (unbroken.success, unbroken.mean_return)
    one, other = (PPO.load(result.checkpoint / "model.zip").policy.state_dict() for result in (unbroken, resumed))
    assert all(th.equal(value, other[name]) for name, value in one.items())


def test_it_is_never_worse_than_stage_one_on_episodes_that_are_not_the_tests(tmp_path: Path) -> None:
    Match.seeds.clear()
    result = train_two_stages(make_model, make_env, 1600, tmp_path, seed=1, eval_every=200, eval_episodes=10, test_episodes=20)
    first = max(row.success for row in result.table if row.stage == 1)
    assert result.best.success >= first and result.best.success > result.table[0].success
    selection, test = set(range(SELECTION_SEED, SELECTION_SEED + 10)), set(range(FIRST_SEED, FIRST_SEED + 20))
    assert selection | test <= Match.seeds and not selection & test
    assert all(seed < FIRST_SEED for seed in Match.seeds - selection - test)


class Forgetting(BaseCallback):
    """After a while of stage one every update makes the policy worse: its action drifts away."""

    def __init__(self, after: int, until: int) -> None:
        super().__init__()
        self.after, self.until = after, until

    def _on_step(self) -> bool:
        if self.after < self.num_timesteps <= self.until and self.model.seed == 1:
            with th.no_grad():
                self.model.policy.action_net.bias += 0.01
        return True


def test_stage_two_starts_from_the_peak_where_stage_one_decays(tmp_path: Path) -> None:
    result = train_two_stages(
        make_model, make_env, 2400, tmp_path, seed=1, eval_every=200, eval_episodes=10, test_episodes=10, split=0.7,
        callback=[Forgetting(1000, 10_000)],
    )  # fmt: skip
    stages: dict[int, list[Rated]] = {stage: [row for row in result.table if row.stage == stage] for stage in (1, 2)}
    peak = max(stages[1], key=lambda row: (row.success, row.mean_return))
    assert stages[1][-1].mean_return < peak.mean_return - 0.5
    assert stages[2][0].mean_return > stages[1][-1].mean_return + 0.5
    assert stages[2][0].step < stages[1][-1].step


@pytest.mark.parametrize("kind", [SAC, A2C])
def test_other_algorithms(kind: type[BaseAlgorithm], tmp_path: Path) -> None:
    second = {"train_freq": 2, "batch_size": 10} if kind is SAC else None
    more = {"learning_starts": 20} if kind is SAC else {}
    models: list[Any] = []

    def play(model: Any, *args: Any) -> list[Outcome]:
        models.append(model)
        return evaluate(model, *args)

    result = train_two_stages(
        lambda seed: make_model(seed, kind, **more),
        make_env, 160, tmp_path, second=second, eval_every=40, eval_episodes=2, test_episodes=2, evaluation=play,
    )  # fmt: skip
    assert {row.stage for row in result.table} == {1, 2}
    if kind is SAC:
        assert models[0].train_freq.frequency == 1 and models[-2].train_freq.frequency == 2 and models[-2].batch_size == 10
        assert models[-2].replay_buffer.pos == models[-2].num_timesteps
    else:
        assert models[0].n_steps == 40 and models[-2].n_steps == 35


def test_settings_that_cannot_be(tmp_path: Path) -> None:
    def train(**kwargs: Any) -> Any:
        arguments: dict[str, Any] = {"total_timesteps": 80, "eval_every": 40, "eval_episodes": 2, "folder": tmp_path}
        return train_two_stages(make_model, make_env, **{**arguments, **kwargs})

    with pytest.raises(ValueError, match="a round of 5 steps in 1 environments has less than a batch of 18"):
        train(second={"n_steps": 5, "batch_size": 18})
    with pytest.raises(ValueError, match="second: PPO has no 'train_freq'"):
        train(second={"train_freq": 5})
    with pytest.warns(UserWarning, match="batch_size=20 is not below the first stage's 20"):
        train(second={"n_steps": 40}, folder=tmp_path / "warned")
    with pytest.raises(ValueError, match="seed=1000000: expected 0 or more"):
        train(seed=FIRST_SEED)
    with pytest.raises(ValueError, match="reach into the episodes of the selection"):
        train(test_episodes=FIRST_SEED + 1)
    for wrong in ({"split": 1.0}, {"patience": 0}, {"eval_every": 0}):
        with pytest.raises(ValueError, match=f"{next(iter(wrong))} must be"):
            train(**wrong)
