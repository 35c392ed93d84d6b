"""Challenges that are cut from demonstrations: views like all others, of what is never overwritten."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env

from sb3_cpm import ChallengerCallback, CheckpointCPMCallback, CPMBuffer, resume
from sb3_cpm.buffers import Demonstration
from sb3_cpm.imitation import DemonstrationsCallback
from sb3_cpm.type_aliases import Evaluation

SPACE = spaces.Dict({"state": spaces.Box(-np.inf, np.inf, (2,), np.float32)})
ACTIONS = spaces.Box(-1, 1, (1,), np.float32)
LENIENT = dict(filter_kwargs=dict(novelty_tolerance=1e5, relevance_tolerance=1e5))
TINY = dict(
    batch_size=4, sequence_length=12, cnn_depth=4, vector_units=16, stoch_size=4, deter_size=16, hidden_size=16, head_units=16,
    actor_units=16, critic_units=16, horizon=4, imagination_starts=8,
)  # fmt: skip


def make(size: int = 30, **kwargs: Any) -> CPMBuffer:
    buffer = CPMBuffer(
        size, SPACE, ACTIONS, device="cpu", warmup_steps=2, **{"challenge_ratio": 0.25, "mix": "row", **LENIENT, **kwargs}
    )
    buffer.attach_challenger()
    return buffer


def demonstration(number: int, length: int) -> Demonstration:
    state = np.stack([np.full(length + 1, number), np.arange(length + 1)], axis=1).astype(np.float32)
    return Demonstration({"state": state}, np.full((length, 1), 0.5), np.arange(length) + 1.0, True)


def play(buffer: CPMBuffer, number: int, length: int) -> None:
    for step in range(length):
        obs, next_obs = ({"state": np.array([[number, s]], np.float32)} for s in (step, step + 1))
        buffer.add(obs, next_obs, np.zeros((1, 1)), np.zeros(1), np.array([step == length - 1]), [{}])


def evaluation(length: int, goal: int) -> Evaluation:
    uncertainty = np.full(length, 0.1)
    uncertainty[goal] = 100.0
    return Evaluation(uncertainty, np.full(length, 0.1), np.arange(2 * length + 2.0).reshape(-1, 2))


def test_rows_of_both_kinds_are_what_they_were_cut_from() -> None:
    np.random.seed(0)
    buffer = make(terminal_goals=True, challenge_ratio=0.5, demonstration_ratio=0.0)
    buffer.add_demonstrations([demonstration(-1, 6), demonstration(-2, 40)])  # longer than D
    play(buffer, 1, 12)
    (of_d,) = buffer.pop_completed()
    assert buffer.propose(of_d, evaluation(12, goal=8)).accepted
    drawn = {buffer.draw_demonstration() for _ in range(50)}
    assert {(one.length, one.demonstrated) for one in drawn} == {(6, True), (40, True)}
    longest = max(drawn, key=lambda one: one.length)
    memory = buffer.coefficients["reward_memory"]
    assert buffer.propose(longest, evaluation(40, goal=30)).accepted
    assert buffer.coefficients["reward_memory"] == memory, "what a demonstration earns says nothing of what P does"
    assert [challenge.episode.demonstrated for challenge in buffer.challenges] == [False, True]

    samples = buffer.sample(4000)
    number, step = samples.observations["state"].T.int()
    assert th.equal(samples.next_observations["state"][:, 1], step + 1.0)
    assert set(number.tolist()) == {1, -2}
    demonstrated = number == -2
    assert set(step[demonstrated].tolist()) == set(range(2, 31)), "first to goal"
    assert (samples.actions[demonstrated] == 0.5).all() and (samples.actions[~demonstrated] == 0).all()
    share = 29 / (29 + 7)  # uniform over all transitions of all challenges
    assert demonstrated.float().mean().item() == pytest.approx(0.5 * share, abs=0.03)
    rewards = buffer.challenges[1].rewards
    for row in th.nonzero(demonstrated).flatten()[:100].tolist():
        assert samples.rewards[row].item() == pytest.approx(rewards[step[row] - 2], rel=1e-5)
        assert samples.dones[row].item() == (step[row] == 30)
    assert samples.dones[~demonstrated].sum() > 0


def test_they_outlive_d() -> None:
    buffer = make()
    buffer.add_demonstrations([demonstration(-1, 10)])
    play(buffer, 1, 10)  # its own episode has the same environment, slot, length and number
    (of_d,) = buffer.pop_completed()
    assert buffer.propose(of_d, evaluation(10, goal=8)).accepted
    assert buffer.propose(buffer.draw_demonstration(), evaluation(10, goal=8)).accepted
    for number in range(2, 9):
        play(buffer, number, 10)
    (left,) = buffer.challenges
    assert left.episode.demonstrated
    buffer.add_demonstrations([demonstration(-2, 5)])  # the others stay where they are
    assert buffer.episode_observations(left.episode)["state"][:, 0].tolist() == [-1.0] * 11
    assert buffer.episode_rewards(left.episode).tolist() == list(range(1, 11))
    buffer.challenge_ratio = 0.9  # without rows of D
    assert (buffer.sample(10).observations["state"][:, 0] == -1).sum() >= 9


@pytest.mark.parametrize("mix", ["batch", "row"])
def test_a_batch_of_them_alone(mix: Any) -> None:
    buffer = make(mix=mix, challenge_ratio=1.0, demonstration_ratio=0.0)
    buffer.add_demonstrations([demonstration(-1, 10)])
    play(buffer, 1, 10)
    assert buffer.propose(buffer.draw_demonstration(), evaluation(10, goal=8)).accepted
    assert (buffer.sample(16).observations["state"][:, 0] == -1).all()


def test_refreshed_and_saved_like_all_others(tmp_path: Path) -> None:
    buffer = make(refresh_every=5)
    buffer.add_demonstrations([demonstration(-1, 10)])
    play(buffer, 1, 10)
    assert buffer.propose(buffer.draw_demonstration(), evaluation(10, goal=8)).accepted
    play(buffer, 2, 10)
    (due,) = buffer.due_for_refresh()
    assert buffer.refresh(due, evaluation(10, goal=3)) > 0
    buffer.save(tmp_path / "buffer.npz")
    loaded = CPMBuffer.load(tmp_path / "buffer.npz")
    assert [one.episode for one in loaded.challenges] == [one.episode for one in buffer.challenges]
    samples = []
    for one in (buffer, loaded):
        np.random.seed(0)
        samples.append(one.sample(40))
    ours, theirs = samples
    assert th.equal(ours.observations["state"], theirs.observations["state"]) and th.equal(ours.rewards, theirs.rewards)


# ---------------------------------------------------------------------- in a run


def model_and_callbacks(share: float) -> tuple[SAC, list[Any]]:
    env = make_vec_env("sb3_cpm.envs.toy:CPMToy-v0", seed=0, env_kwargs=dict(keys=("state",)))
    model = SAC(
        "MultiInputPolicy",
        env,
        replay_buffer_class=CPMBuffer,
        replay_buffer_kwargs=dict(challenge_ratio=0.25, demonstration_ratio=0.25, mix="row", warmup_steps=2, **LENIENT),
        policy_kwargs=dict(net_arch=[16]),
        **dict(learning_starts=100, batch_size=16, buffer_size=1000, seed=0, device="cpu", train_freq=10),
    )
    challenger = ChallengerCallback(train_freq=20, challenger_kwargs=TINY, decay="constant", demonstration_challenges=share)
    return model, [DemonstrationsCallback("expert", n_episodes=4, hold=True), challenger]


def demonstrated(model: SAC) -> list[int]:
    buffer: Any = model.replay_buffer
    return [one.number for one in buffer.challenges if one.episode.demonstrated]


@pytest.mark.slow
def test_a_run_that_is_resumed_goes_on_with_them(tmp_path: Path) -> None:
    """Bit for bit, as ``exact`` promises."""

    def run(folder: Path, steps: int) -> SAC:
        model, callbacks = model_and_callbacks(share=1.0)
        return model.learn(steps, callback=[*callbacks, CheckpointCPMCallback(250, folder, exact=True)])

    unbroken = run(tmp_path / "unbroken", 400)
    assert demonstrated(unbroken)
    run(tmp_path / "cut", 250)
    env = model_and_callbacks(share=1.0)[0].get_env()
    assert env is not None
    model, challenger = resume(tmp_path / "cut", env, device="cpu")
    assert challenger.demonstration_challenges == 1.0 and demonstrated(model)
    callbacks = [
        DemonstrationsCallback("expert", n_episodes=4, hold=True),
        challenger,
        CheckpointCPMCallback(250, tmp_path / "cut", exact=True),
    ]
    model.learn(150, callback=callbacks, reset_num_timesteps=False)
    assert demonstrated(model) == demonstrated(unbroken)
    for ours, theirs in zip(unbroken.policy.parameters(), model.policy.parameters(), strict=True):
        assert th.equal(ours, theirs)


def test_without_demonstrations_there_is_nothing_to_cut() -> None:
    model, (_, challenger) = model_and_callbacks(share=1.0)
    with pytest.raises(ValueError, match=r"There are no demonstrations to cut challenges from.*DemonstrationsCallback"):
        model.learn(300, callback=challenger)
    with pytest.raises(ValueError, match="demonstration_challenges must be"):
        ChallengerCallback(demonstration_challenges=1.5)
