"""The whole method on real PickCube-v1: camera images for the challenger, point clouds for the player."""

import numpy as np
import pytest
import torch as th
from stable_baselines3 import SAC

from sb3_cpm import ChallengerCallback, CPMBuffer, PointNetPolicy
from sb3_cpm.challenger import Challenger

pytestmark = [pytest.mark.maniskill, pytest.mark.slow]


@pytest.fixture(scope="module")
def run():
    """A short run, long enough for challenges: 12 episodes, of which C judges eight."""
    from sb3_cpm.envs import make_maniskill_env

    env = make_maniskill_env("PickCube-v1", ignore_terminations=True)
    model = SAC(
        PointNetPolicy,
        env,
        replay_buffer_class=CPMBuffer,
        replay_buffer_kwargs=dict(filter_kwargs=dict(highlight_tolerance=1.2)),
        learning_starts=200,
        batch_size=32,
        buffer_size=2000,
        train_freq=4,
        seed=0,
        device="cpu",
    )
    callback = ChallengerCallback(train_freq=10)
    model.learn(600, callback=callback)
    yield model, callback
    env.close()


def test_observations_reach_who_they_are_for(run):
    model, callback = run
    assert set(callback.challenger.keys) == {"base_camera", "hand_camera", "state"}
    samples = model.replay_buffer.sample(8)
    assert set(samples.observations) == {"pointcloud", "state"}
    stored = model.replay_buffer.observations
    assert stored["base_camera"].dtype == np.uint8 and stored["base_camera"][:600].std() > 5, "the camera saw something"
    moved = np.abs(np.diff(stored["base_camera"][:50, 0].astype(int), axis=0)).max(axis=(1, 2, 3))
    assert (moved > 0).mean() > 0.8, "and it moves"


def test_challenges_are_proposed_and_used(run):
    model, callback = run
    buffer = model.replay_buffer
    assert buffer.counters.proposed == 8
    assert 0 < buffer.counters.kept <= 8
    for challenge in buffer.challenges:
        proposal = challenge.proposal
        assert challenge.episode in buffer.episodes
        assert 5 <= proposal.first < proposal.goal < challenge.episode.length == 50
        assert (proposal.uncertainty >= 0).all()
        assert np.isfinite(proposal.artificial.total).all()
        assert proposal.artificial.total.shape == (proposal.goal - proposal.first + 1,)
    artificial, task = (
        np.concatenate([getattr(challenge.proposal.artificial, name) for challenge in buffer.challenges])
        for name in ("total", "extrinsic")
    )
    assert 0.3 < np.abs(artificial).mean() / task.mean() < 3, "artificial rewards are about as large as the task's"
    assert callback.explored_share > 0.1
    total = sum(callback.stopwatch.seconds.values())
    assert callback.stopwatch.seconds["bookkeeping"] + callback.stopwatch.seconds["buffer"] < 0.2 * total


def test_rewards_of_the_task_and_success_are_known(run):
    model, _ = run
    rewards = model.replay_buffer.rewards[:600, 0]
    assert (rewards >= 0).all() and (rewards <= 1).all() and rewards.std() > 0
    assert len(model.ep_success_buffer) == 12


def test_the_world_model_learns_to_predict_real_frames(run):
    """On episodes it never saw, what a trained model expects is nearer to the truth than what it expected untrained."""
    model, callback = run
    *training, second_last, last = model.replay_buffer.episodes
    buffer = copy_of(model.replay_buffer, training)
    challenger = Challenger(model.observation_space, model.action_space, device="cpu", keys=callback.challenger.keys)
    before = expected_error(challenger, model.replay_buffer, [second_last, last])
    th.manual_seed(0)
    np.random.seed(0)
    for _ in range(60):
        challenger.train(buffer.sample_sequences(8, 32, challenger.keys))
    after = expected_error(challenger, model.replay_buffer, [second_last, last])
    assert after < 0.7 * before and after < 0.1, (before, after)


def copy_of(buffer, episodes):
    """Some of a buffer's episodes in a buffer of their own."""
    copy = CPMBuffer(1000, buffer.observation_space, buffer.action_space, device="cpu", challenge_ratio=0)
    for episode in episodes:
        states, actions = buffer.episode_observations(episode), buffer.episode_actions(episode)
        rewards = buffer.rewards[episode.slots(buffer.buffer_size), episode.env_idx]
        for step in range(episode.length):
            now, later = ({key: array[None, step + ahead] for key, array in states.items()} for ahead in (0, 1))
            done = np.array([step == episode.length - 1])
            copy.add(now, later, actions[None, step], rewards[None, step], done, [{"TimeLimit.truncated": bool(done)}])
    assert copy.episodes_ended
    return copy


def expected_error(challenger, buffer, episodes):
    """Mean absolute pixel error, as a share of the range, of ten imagined steps after ten seen ones."""
    errors = []
    for episode in episodes:
        observations = buffer.episode_observations(episode, challenger.keys)
        actions = buffer.episode_actions(episode)
        led_here = np.concatenate([np.zeros_like(actions[:1]), actions])[:, None]
        is_first = np.zeros((11, 1), dtype=bool)
        is_first[0] = True
        seen = {key: array[:11, None] for key, array in observations.items()}
        state = challenger.follow(challenger.initial_state(1), seen, led_here[:11], is_first, np.ones((11, 1), bool), True)
        expected = challenger.world_model.open_loop(state, th.as_tensor(led_here[11:21]))
        for key in ("base_camera", "hand_camera"):
            error = expected[key][:, 0].detach().numpy().astype(np.float32) - observations[key][11:21]
            errors.append(np.abs(error).mean() / 255)
    return float(np.mean(errors))
