"""CPMBuffer against a plain list of episodes, and each of its promises by itself."""

import pickle

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

import sb3_cpm.envs.toy  # noqa: F401  (registers CPMToy-v0)
from sb3_cpm import ChallengerCallback
from sb3_cpm.buffers import EXECUTED_ACTION, CPMBuffer
from sb3_cpm.type_aliases import Evaluation

OBSERVATION_SPACE = spaces.Dict(
    {"state": spaces.Box(-np.inf, np.inf, (3,), np.float32), "camera": spaces.Box(0, 255, (2, 2, 3), np.uint8)}
)
ACTION_SPACE = spaces.Box(-1, 1, (2,), np.float32)


def reward_of(episode, step):
    return 1 + episode / 100 + step / 10_000


# Criteria that keep nearly every candidate, for tests of what happens to challenges once they are kept
LENIENT = dict(novelty_tolerance=1e5, relevance_tolerance=1e5, highlight_tolerance=1e-5)


class Played:
    """
    Plays numbered episodes into a buffer and keeps them in plain lists.

    The state is (environment, episode, step), the action that leaves it (episode, step) / 1000 and the reward for it
    1 + episode / 100 + step / 10000, so that any row of any batch can be checked by itself.
    """

    def __init__(self, n_envs=1, size=50, has_challenger=True, **kwargs):
        self.n_envs, self.size = n_envs, size
        self.buffer = CPMBuffer(size * n_envs, OBSERVATION_SPACE, ACTION_SPACE, n_envs=n_envs, device="cpu", **kwargs)
        if has_challenger:
            self.buffer.attach_challenger()
        self.episode, self.step = np.zeros(n_envs, int), np.zeros(n_envs, int)
        self.n_steps = 0
        self.complete = []  # (env, episode, number of the step it began with, length, terminated)
        self.began = np.zeros(n_envs, int)

    def observation(self):
        state = np.stack([np.arange(self.n_envs), self.episode, self.step], axis=1).astype(np.float32)
        return {"state": state, "camera": np.repeat(self.step % 256, 12).reshape(self.n_envs, 2, 2, 3).astype(np.uint8)}

    def play(self, done, terminated=None):
        """One step of all environments; ``done`` says which episodes end with it."""
        done = np.broadcast_to(done, self.n_envs)
        terminated = done if terminated is None else np.broadcast_to(terminated, self.n_envs)
        obs = self.observation()
        action = np.stack([self.episode, self.step], axis=1) / 1000
        reward = reward_of(self.episode, self.step)
        self.step = self.step + 1
        infos = [{"TimeLimit.truncated": bool(d and not t)} for d, t in zip(done, terminated, strict=True)]
        self.buffer.add(obs, self.observation(), action, reward, done, infos)
        self.n_steps += 1
        for env_idx in np.flatnonzero(done):
            self.complete.append(
                (env_idx, self.episode[env_idx], self.began[env_idx], self.step[env_idx], terminated[env_idx])
            )
            self.episode[env_idx] += 1
            self.step[env_idx] = 0
            self.began[env_idx] = self.n_steps

    def play_episode(self, length, terminated=True):
        for step in range(length):
            self.play(step == length - 1, terminated and step == length - 1)

    def present(self):
        """Complete episodes that no later step has overwritten, not even partly."""
        return [(env, ep, length, term) for env, ep, began, length, term in self.complete if began >= self.n_steps - self.size]

    def evaluate(self, episode, seed=0, goal=None):
        rng = np.random.default_rng(seed)
        evaluation = Evaluation(
            0.1 * rng.random(episode.length), rng.random(episode.length), rng.random((episode.length + 1, 4))
        )
        if goal is not None:
            evaluation.disagreement[goal] = 50.0
        return evaluation


def check_transitions(samples, present):
    """Every row is a transition of a present episode, as it was played."""
    terminated = {(env, ep): (length, term) for env, ep, length, term in present}
    for obs, next_obs, action, done in zip(
        samples.observations["state"].numpy(),
        samples.next_observations["state"].numpy(),
        samples.actions.numpy(),
        samples.dones.numpy(),
        strict=True,
    ):
        env, ep, step = obs
        length, term = terminated[env, ep]
        assert tuple(next_obs) == (env, ep, step + 1)
        assert action == pytest.approx([ep / 1000, step / 1000])
        assert done == (term and step + 1 == length)
    assert (samples.next_observations["camera"][:, 0, 0, 0] == samples.next_observations["state"][:, 2] % 256).all()


def check_sequences(batch, present):
    """Rows follow each other within an episode and from its last state to the next episode's first."""
    episodes = {(env, ep): (length, term) for env, ep, length, term in present}
    length, n = batch.mask.shape
    for column in range(n):
        for row in range(length):
            if not batch.mask[row, column]:
                assert not batch.mask[row:, column].any(), "padding comes last"
                break
            env, ep, step = batch.observations["state"][row, column]
            n_steps, terminated = episodes[env, ep]
            assert batch.is_first[row, column] == (step == 0)
            assert batch.is_terminal[row, column] == (terminated and step == n_steps)
            if step == 0:
                assert not batch.actions[row, column].any() and batch.rewards[row, column] == 0
            else:
                assert batch.actions[row, column] == pytest.approx([ep / 1000, (step - 1) / 1000])
                assert batch.rewards[row, column] == pytest.approx(reward_of(ep, step - 1))
            if row > 0:
                before = batch.observations["state"][row - 1, column]
                expected = (env, ep, step - 1) if step > 0 else (env, ep - 1, episodes[env, ep - 1][0])
                assert tuple(before) == expected


@given(
    n_envs=st.sampled_from([1, 3]),
    size=st.integers(8, 40),
    end_probability=st.floats(0.08, 0.9),
    mix=st.sampled_from(["batch", "row"]),
    seed=st.integers(0, 2**31 - 1),
)
@settings(max_examples=40, deadline=None)
def test_against_a_list_of_episodes(n_envs, size, end_probability, mix, seed):
    """Random episode lengths, wrapping the ring many times, challenges on the way: SPEC's invariants after every step."""
    rng = np.random.default_rng(seed)
    np.random.seed(seed)
    played = Played(n_envs, size, mix=mix, max_challenges=4, warmup_steps=2, challenge_ratio=0.5)
    buffer = played.buffer
    for _ in range(6 * size):
        done = (rng.random(n_envs) < end_probability) | (played.step >= size - 2)
        played.play(done, done & (rng.random(n_envs) < 0.5))
        rewards_of_d = buffer.rewards.copy()
        for episode in buffer.pop_completed():
            buffer.propose(episode, played.evaluate(episode, seed=int(rng.integers(2**31))))
        np.testing.assert_array_equal(buffer.rewards, rewards_of_d, "rewards in D are never changed")

        present = played.present()
        assert [(e.env_idx, e.length) for e in buffer.episodes] == [(env, n) for env, _, n, _ in sorted(present)]
        assert len(buffer.challenges) <= 4
        for challenge in buffer.challenges:
            assert challenge.episode in buffer.episodes
            assert 2 <= challenge.proposal.first < challenge.proposal.goal < challenge.episode.length
        if rng.random() < 0.2 and present:
            check_transitions(buffer.sample(8), present)
            check_sequences(buffer.sample_sequences(3, length=int(rng.integers(1, 12))), present)
            if buffer.challenges:
                check_transitions(buffer._sample_own(0, 8, None), present)
            if rng.random() < 0.3:
                buffer = played.buffer = pickle.loads(pickle.dumps(buffer))
                buffer.attach_challenger()


def test_samples_are_uniform_over_complete_episodes():
    np.random.seed(0)
    played = Played(n_envs=3, size=30, challenge_ratio=0)
    rng = np.random.default_rng(0)
    for _ in range(100):
        played.play((rng.random(3) < 0.2) | (played.step >= 20))
    expected = {(env, ep, step) for env, ep, n, _ in played.present() for step in range(n)}
    rows, counts = np.unique(
        played.buffer.sample(200 * len(expected)).observations["state"].numpy(), axis=0, return_counts=True
    )
    assert {tuple(row) for row in rows} == expected
    chi_square = ((counts - 200) ** 2 / 200).sum()
    assert chi_square < len(expected) + 4 * np.sqrt(2 * len(expected))


def test_sequence_starts_are_uniform():
    np.random.seed(0)
    played = Played(n_envs=2, size=60)
    for length in (10, 15, 12):
        played.play_episode(length)
    batch = played.buffer.sample_sequences(12_000, length=20)
    assert batch.mask.all()
    starts, counts = np.unique(batch.observations["state"][0], axis=0, return_counts=True)
    assert len(starts) == 2 * (37 - 20 + 1)
    assert counts.min() > 0.8 * counts.mean() and counts.max() < 1.2 * counts.mean()


def test_a_sequence_as_long_as_the_only_episode_and_longer():
    played = Played()
    played.play_episode(9)
    batch = played.buffer.sample_sequences(2, length=10)
    assert batch.mask.all() and batch.is_terminal[-1].all() and batch.is_first[0].all()
    batch = played.buffer.sample_sequences(2, length=13)
    assert batch.mask[:10].all() and not batch.mask[10:].any()
    assert batch.observations["camera"].shape == (13, 2, 2, 2, 3) and batch.observations["camera"].dtype == np.uint8
    assert set(played.buffer.sample_sequences(2, 3, keys=["state"]).observations) == {"state"}


@pytest.mark.parametrize("mix", ["batch", "row"])
def test_share_of_challenges(mix):
    np.random.seed(1)
    played = Played(mix=mix, challenge_ratio=0.25)
    played.play_episode(20)
    task_rewards = reward_of(0, np.arange(20)).astype(np.float32)
    assert np.isin(played.buffer.sample(640).rewards, task_rewards).all(), "while I is empty all comes from D"
    (episode,) = played.buffer.pop_completed()
    proposal = played.buffer.propose(episode, played.evaluate(episode, goal=15))
    assert proposal.accepted
    artificial = set(proposal.artificial.total.astype(np.float32).tolist())
    shares = []
    for _ in range(2000):
        rewards = played.buffer.sample(16).rewards.flatten().tolist()
        shares.append(np.mean([reward in artificial for reward in rewards]))
    assert np.mean(shares) == pytest.approx(0.25, abs=0.03)
    assert set(shares) == ({0.0, 1.0} if mix == "batch" else {0.25})


@pytest.mark.parametrize("terminal_goals", [False, True])
def test_the_cut_is_a_truncation_unless_asked_otherwise(terminal_goals):
    played = Played(challenge_ratio=1.0, terminal_goals=terminal_goals)
    played.play_episode(20)
    (episode,) = played.buffer.pop_completed()
    assert played.buffer.propose(episode, played.evaluate(episode, goal=12)).goal == 12
    samples = played.buffer.sample(300)
    steps = samples.observations["state"][:, 2]
    assert steps.min() == 5 and steps.max() == 12
    assert (samples.dones.flatten() == ((steps == 12) & terminal_goals)).all()
    assert (samples.next_observations["state"][steps == 12][:, 2] == 13).all()


@pytest.mark.parametrize("terminated", [False, True])
def test_a_true_termination_inside_a_challenge_stays_one(terminated):
    played = Played(challenge_ratio=1.0)
    played.play_episode(20, terminated=terminated)
    (episode,) = played.buffer.pop_completed()
    assert played.buffer.propose(episode, played.evaluate(episode, goal=19)).accepted
    samples = played.buffer.sample(300)
    last = samples.observations["state"][:, 2] == 19
    assert last.any() and (samples.dones.flatten() == (last & terminated)).all()


def test_a_challenge_ends_with_its_episode_and_the_oldest_makes_room():
    played = Played(size=60, max_challenges=2, filter_kwargs=LENIENT)
    for length in (15, 15, 15):
        played.play_episode(length)
    for number, episode in enumerate(played.buffer.pop_completed()):
        assert played.buffer.propose(episode, played.evaluate(episode, goal=10)).accepted
        assert len(played.buffer.challenges) == min(number + 1, 2)
    assert [challenge.episode.ordinal for challenge in played.buffer.challenges] == [1, 2]
    played.play_episode(31)
    assert [challenge.episode.ordinal for challenge in played.buffer.challenges] == [2], "D has overwritten episode 1"
    assert played.buffer.counters.proposed == 3 and played.buffer.counters.kept == 3


def test_executed_actions_are_stored():
    buffer = CPMBuffer(20, OBSERVATION_SPACE, ACTION_SPACE, n_envs=2, device="cpu")
    buffer.attach_challenger()
    obs = OBSERVATION_SPACE.sample()
    obs = {key: np.stack([value, value]) for key, value in obs.items()}
    asked = np.full((2, 2), 0.5, dtype=np.float32)
    buffer.add(obs, obs, asked, np.zeros(2), np.zeros(2), [{}, {EXECUTED_ACTION: np.array([-0.25, 0.75])}])
    np.testing.assert_array_equal(buffer.actions[0], [[0.5, 0.5], [-0.25, 0.75]])
    np.testing.assert_array_equal(asked, 0.5)


def test_an_environment_reset_from_outside_ends_the_episode():
    """A second learn() resets the environment: the last transition must not lead to the new episode's first state."""
    played = Played()
    played.play_episode(6)
    for _ in range(4):
        played.play(False)
    played.complete.append((0, played.episode[0], played.began[0], 4, False))
    played.episode[0], played.step[0], played.began[0] = 2, 0, played.n_steps
    played.play_episode(5)
    assert [episode.length for episode in played.buffer.episodes] == [6, 4, 5]
    check_transitions(played.buffer._sample_own(200, 0, None), played.present())
    check_sequences(played.buffer.sample_sequences(50, 8), played.present())


def test_an_episode_that_fills_the_buffer_exactly_and_one_that_does_not_fit():
    played = Played(size=12)
    played.play_episode(12)
    check_transitions(played.buffer._sample_own(100, 0, None), played.present())
    played.play_episode(12)
    check_sequences(played.buffer.sample_sequences(10, 13), played.present())
    with pytest.raises(ValueError, match="longer than the 12 transitions .* buffer_size"):
        for _ in range(13):
            played.play(False)


def test_episode_observations_and_actions():
    played = Played(size=25)
    for length in (10, 10, 10):
        played.play_episode(length)
    second, third = played.buffer.pop_completed()  # the first one is overwritten already
    observations = played.buffer.episode_observations(third)
    np.testing.assert_array_equal(observations["state"][:, 2], np.arange(11))
    assert (observations["state"][:, 1] == 2).all() and observations["camera"].shape == (11, 2, 2, 3)
    np.testing.assert_allclose(played.buffer.episode_actions(third)[:, 1], np.arange(10) / 1000, rtol=1e-6)
    played.play_episode(20)
    with pytest.raises(ValueError, match="no longer in the buffer"):
        played.buffer.episode_observations(second)


def test_save_and_load_keep_everything(tmp_path):
    played = Played(n_envs=2, size=40)
    for _ in range(3):
        played.play_episode(12)
        for episode in played.buffer.pop_completed():
            played.buffer.propose(episode, played.evaluate(episode, goal=8))
    played.play(False)
    loaded = pickle.loads(pickle.dumps(played.buffer))
    assert loaded.coefficients == played.buffer.coefficients and loaded.counters == played.buffer.counters
    assert len(loaded.challenges) == len(played.buffer.challenges) > 0
    for challenge, original in zip(loaded.challenges, played.buffer.challenges, strict=True):
        assert challenge.episode == original.episode
        np.testing.assert_array_equal(challenge.proposal.artificial.total, original.proposal.artificial.total)
    for seed in range(20):
        np.random.seed(seed)
        expected = played.buffer.sample(16)
        np.random.seed(seed)
        found = loaded.sample(16)
        assert th.equal(expected.rewards, found.rewards)
        assert th.equal(expected.next_observations["state"], found.next_observations["state"])
    with pytest.warns(UserWarning, match="truncated"):
        loaded.truncate_last_trajectory()
    assert [episode.length for episode in loaded.episodes] == [12, 12, 12, 1] * 2


def test_a_pickle_from_before_the_books_were_an_object_goes_on():
    played = Played(n_envs=2, size=30)
    for step in range(70):
        played.play([step % 5 == 4, step % 7 == 6])
    state = played.buffer.__getstate__()
    books = state.pop("books")
    state |= {f"_{name}": getattr(books, name) for name in ("n_steps", "current_ep_start", "n_episodes", "n_valid", "began")}
    state |= {f"_{name}": getattr(books, f"_{name}") for name in ("episodes", "starts", "valid_ends", "earliest_began")}
    played.buffer, old = CPMBuffer.__new__(CPMBuffer), played.buffer
    played.buffer.__setstate__(pickle.loads(pickle.dumps(state)))
    assert played.buffer.episodes == old.episodes and pickle.dumps(played.buffer.books) == pickle.dumps(books)
    played.buffer.attach_challenger()
    for step in range(70):
        played.play([step % 5 == 4, step % 7 == 6])
    check_transitions(played.buffer.sample(200), played.present())


def test_a_pickle_of_another_format_is_refused():
    state = Played().buffer.__getstate__()
    state["format"] = 0
    with pytest.raises(ValueError, match="format 0"):
        CPMBuffer.__new__(CPMBuffer).__setstate__(state)


def test_player_keys_leave_the_images_where_they_are():
    played = Played(player_keys=["state"])
    played.play_episode(10)
    samples = played.buffer.sample(8)
    assert set(samples.observations) == set(samples.next_observations) == {"state"}


def test_buffer_size_one_can_be_constructed():
    """rl_zoo3's enjoy loads models with buffer_size=1."""
    assert CPMBuffer(1, OBSERVATION_SPACE, ACTION_SPACE, device="cpu").buffer_size == 1


def test_observations_take_half_of_the_memory():
    sizes = {}
    for name, buffer_class in (("cpm", CPMBuffer), ("her", HerReplayBuffer)):
        buffer = buffer_class(1000, OBSERVATION_SPACE, ACTION_SPACE, env=None, device="cpu")
        arrays = [buffer.observations] if name == "cpm" else [buffer.observations, buffer.next_observations]
        sizes[name] = sum(array.nbytes for part in arrays for array in part.values())
    assert sizes["cpm"] * 2 == sizes["her"]


@pytest.mark.parametrize(
    "kwargs, message",
    [
        (dict(challenge_ratio=1.1), r"challenge_ratio .* \[0, 1\], got 1.1"),
        (dict(challenge_ratio=-0.1), "challenge_ratio"),
        (dict(mix="rows"), 'mix must be "batch" or "row"'),
        (dict(max_challenges=0), "max_challenges"),
        (dict(warmup_steps=-1), "warmup_steps"),
        (dict(challenge_ratio="quarter"), "challenge_ratio must be .* got 'quarter'"),
        (dict(max_challenges=2.5), "max_challenges must be an integer"),
        (dict(refresh_every=20.5), "refresh_every must be .* got 20.5"),
        (dict(warmup_steps=2.5), "warmup_steps must be an integer"),
        (dict(kl_ratio=-1), "kl_ratio must be a finite number above 0"),
        (dict(filter_kwargs=dict(toleranc=1)), "filter_kwargs: .*Did you mean 'novelty_tolerance'"),
        (dict(filter_kwargs=dict(reward_ratio=1)), "filter_kwargs: 'reward_ratio' is set elsewhere"),
        (dict(reward_kwargs=dict(scal=1)), "reward_kwargs: .*Did you mean 'scale'"),
        (dict(reward_kwargs=dict(scale=-1)), "reward_kwargs: scale must be a finite number above 0, got -1"),
        (dict(coefficient_kwargs=dict(foo=1)), "coefficient_kwargs: unknown key 'foo'"),
        (dict(storage_dtypes=["state"]), r"storage_dtypes must say how .* got \['state'\]"),
        (dict(n_sampled_goal=4), "achieved_goal"),
        (dict(n_sampled_goal=-4), "n_sampled_goal must be a finite number of at least 0, got -4"),
        (dict(player_keys=["stat"]), "stat"),
        (dict(observation_space=spaces.Box(-1, 1, (3,))), "sb3_cpm.envs.DictObservation"),
        (dict(action_space=spaces.Discrete(3)), "continuous actions"),
    ],
)
def test_bad_arguments(kwargs, message):
    arguments = dict(observation_space=OBSERVATION_SPACE, action_space=ACTION_SPACE, device="cpu")
    with pytest.raises(ValueError, match=message):
        CPMBuffer(10, **{**arguments, **kwargs})


def test_without_a_challenger_it_says_so():
    with pytest.raises(ValueError, match="callback=ChallengerCallback()"):
        Played(has_challenger=False).play(False)
    Played(has_challenger=False, challenge_ratio=0).play(False)


def test_sampling_too_early_says_what_to_set():
    played = Played()
    played.play(False)
    with pytest.raises(RuntimeError, match="learning_starts"):
        played.buffer.sample(4)
    with pytest.raises(RuntimeError, match="No complete episode"):
        played.buffer.sample_sequences(4, 4)


def test_refresh_gives_todays_rewards_to_the_challenges_that_are_due():
    played = Played(size=100, refresh_every=20, filter_kwargs=LENIENT)
    played.play_episode(15)
    (episode,) = played.buffer.pop_completed()
    assert played.buffer.propose(episode, played.evaluate(episode, goal=10)).accepted
    played.play_episode(19)
    assert played.buffer.due_for_refresh() == []
    played.play(False)
    (challenge,) = played.buffer.due_for_refresh()
    assert challenge.age == 20 and challenge.added_at == 15
    np.random.seed(0)
    while played.buffer.pop_sampled_age() is None:
        played.buffer.sample(8)
    coefficients, rewards_of_d = played.buffer.coefficients, played.buffer.rewards.copy()
    before = pickle.dumps(played.buffer.challenges)
    with pytest.raises(ValueError, match="kl has shape"):
        played.buffer.refresh(challenge, played.evaluate(episode)._replace(kl=np.zeros(3)))
    assert pickle.dumps(played.buffer.challenges) == before

    assert played.buffer.refresh(challenge, played.evaluate(episode, seed=0, goal=10)) < 0.5
    change = played.buffer.refresh(challenge, played.evaluate(episode, seed=1))
    assert change > 0
    (refreshed,) = played.buffer.challenges
    assert refreshed.age == 0 and refreshed.goal == challenge.goal and played.buffer.due_for_refresh() == []
    assert not np.array_equal(refreshed.rewards, challenge.rewards)
    np.testing.assert_array_equal(refreshed.terms["extrinsic"], challenge.terms["extrinsic"])
    np.testing.assert_array_equal(refreshed.terms["step"], challenge.terms["step"])
    assert played.buffer.coefficients == coefficients and played.buffer.counters.refreshed == 2
    np.testing.assert_array_equal(played.buffer.rewards, rewards_of_d)
    played.play_episode(90)
    with pytest.raises(ValueError, match="no longer in the buffer"):
        played.buffer.refresh(challenge, played.evaluate(episode))


def test_what_is_in_the_buffer_can_be_looked_at():
    played = Played(n_envs=2, size=60, filter_kwargs=LENIENT)
    played.play_episode(20)
    for episode in played.buffer.pop_completed():
        played.buffer.propose(episode, played.evaluate(episode, goal=12))
    played.play_episode(10)
    first, second = played.buffer.challenges
    assert (first.environment, second.environment) == (0, 1)
    assert (first.start, first.goal, first.age) == (5, 12, 20) and first.score > 10
    assert set(first.terms) == {"extrinsic", "exploration", "embedding", "step"}
    assert all(term.shape == first.rewards.shape == (8,) for term in first.terms.values())
    assert [(e.env_idx, e.start, e.length, e.ordinal) for e in played.buffer.episodes] == [
        (0, 0, 20, 0), (0, 20, 10, 1), (1, 0, 20, 0), (1, 20, 10, 1),
    ]  # fmt: skip
    assert played.buffer.counters.proposed == 2


@pytest.mark.parametrize("rewards", [0.0, -1.0])
@pytest.mark.parametrize("length", [1, 5, 6, 20])
def test_degenerate_episodes_have_documented_outcomes(rewards, length):
    """One step, exactly the warm-up, one counted step; rewards all zero or negative; all scores equal."""
    buffer = CPMBuffer(50, OBSERVATION_SPACE, ACTION_SPACE, device="cpu")
    buffer.attach_challenger()
    obs = {"state": np.zeros((1, 3), np.float32), "camera": np.zeros((1, 2, 2, 3), np.uint8)}
    for step in range(length):
        buffer.add(obs, obs, np.zeros((1, 2)), np.array([rewards]), np.array([step == length - 1]), [{}])
    (episode,) = buffer.pop_completed()
    proposal = buffer.propose(episode, Evaluation(np.full(length, 0.5), np.full(length, 0.5), np.zeros((length + 1, 2))))
    assert (proposal is None) == (length <= 5)
    assert proposal is None or (not proposal.accepted and not proposal.verdicts["not_first"])
    assert np.isfinite([value for name, value in buffer.coefficients.items()]).all() and not buffer.challenges
    assert buffer.sample(10).rewards.unique().tolist() == [rewards]


TINY = dict(
    batch_size=4, sequence_length=12, cnn_depth=4, vector_units=16, stoch_size=4, deter_size=16, hidden_size=16, head_units=16,
    actor_units=16, critic_units=16, horizon=4, imagination_starts=8,
)  # fmt: skip


def test_the_callback_refreshes_and_logs_it(tmp_path):
    env = make_vec_env("sb3_cpm.envs.toy:CPMToy-v0", seed=0, env_kwargs=dict(keys=("state",)))
    model = SAC(
        "MultiInputPolicy",
        env,
        replay_buffer_class=CPMBuffer,
        replay_buffer_kwargs=dict(refresh_every=100, filter_kwargs=LENIENT, storage_dtypes={"state": "float16"}),
        learning_starts=100,
        batch_size=16,
        buffer_size=2000,
        seed=0,
        device="cpu",
        policy_kwargs=dict(net_arch=[16]),
    )
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(600, callback=ChallengerCallback(train_freq=10, challenger_kwargs=TINY), log_interval=1)
    model.logger.close()
    buffer = model.replay_buffer
    assert buffer.counters.refreshed > 0
    assert all(challenge.age < 100 + 50 for challenge in buffer.challenges)
    lines = (tmp_path / "progress.csv").read_text().splitlines()
    columns = dict(zip(lines[0].split(","), zip(*(line.split(",") for line in lines[1:]), strict=True), strict=True))
    changes, ages = columns["challenge/refresh_change"], columns["challenge/sampled_age"]
    assert any(float(change) > 0 for change in changes if change) and any(0 <= float(age) < 200 for age in ages if age)
