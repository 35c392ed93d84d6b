"""CPMBuffer against a reference model, a plain list of episodes, by a hypothesis state machine."""

import pickle
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from gymnasium import spaces
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from sb3_cpm.buffers import CPMBuffer, Demonstration
from sb3_cpm.type_aliases import Evaluation

OBSERVATIONS = spaces.Dict(
    {"state": spaces.Box(-np.inf, np.inf, (3,), np.float32), "camera": spaces.Box(0, 255, (2, 2, 3), np.uint8)}
)
ACTIONS = spaces.Box(-1, 1, (2,), np.float32)
#: Ordinals of demonstrations start here, so that a row tells where it comes from.
DEMONSTRATED = 1000


@dataclass
class Told:
    """An episode as it was told to the buffer."""

    env: int
    number: int
    steps: list[float] = field(default_factory=list)  # the rewards
    terminated: bool = False
    began: int = 0  # number of the add() that it began with
    ended: bool = False

    @property
    def length(self):
        return len(self.steps)


def reward_of(number, step):
    return np.float32(1 + number / 100 + step / 10_000)


def states(env, number, n):
    state = np.stack([np.full(n, env), np.full(n, number), np.arange(n)], axis=1).astype(np.float32)
    return {"state": state, "camera": np.repeat(np.arange(n) % 256, 12).reshape(n, 2, 2, 3).astype(np.uint8)}


class Machine(RuleBasedStateMachine):
    """
    The model keeps all episodes ever told. An episode is in D if the add() that it began with is among the last ``size``.
    """

    @initialize(
        n_envs=st.sampled_from([1, 2, 3]),
        size=st.integers(4, 20),
        mix=st.sampled_from(["batch", "row"]),
        max_challenges=st.integers(1, 4),
        compact=st.booleans(),
    )
    def start(self, n_envs, size, mix, max_challenges, compact):
        self.n_envs, self.size, self.max_challenges, self.n_adds, self.n_demonstrated = n_envs, size, max_challenges, 0, 0
        self.buffer = CPMBuffer(
            n_envs * size,
            OBSERVATIONS,
            ACTIONS,
            n_envs=n_envs,
            device="cpu",
            challenge_ratio=0.4,
            demonstration_ratio=0.3,
            mix=mix,
            max_challenges=max_challenges,
            warmup_steps=1,
            storage_dtypes={"state": "float16"} if compact else None,
            filter_kwargs=dict(novelty_tolerance=1e5, relevance_tolerance=1e5, highlight_tolerance=1e-5),
        )
        self.buffer.attach_challenger()
        self.told = [Told(env, 0) for env in range(n_envs)]
        self.current = list(self.told)
        self.demonstrations = []
        self.challenges = []  # (episode, first step, rewards)
        self.to_propose = []

    # ------------------------------------------------------------------ what can happen

    @rule(seed=st.integers(0, 10**6), n_steps=st.integers(1, 15), end_probability=st.sampled_from([0.05, 0.2, 0.5]))
    def play(self, seed, n_steps, end_probability):
        rng = np.random.default_rng(seed)
        for _ in range(n_steps):
            ended = rng.random(3) < end_probability
            self.add(np.where(ended, rng.choice(["terminated", "truncated"], 3), "no").tolist())

    def add(self, ends):
        ends = [
            "truncated" if episode.length + 1 >= self.size and end == "no" else end
            for end, episode in zip(ends, self.current, strict=False)
        ]
        rows = [(episode.env, episode.number, episode.length) for episode in self.current]
        obs, next_obs = (
            {key: np.stack([states(e, n, s + 2)[key][s + ahead] for e, n, s in rows]) for key in OBSERVATIONS}
            for ahead in (0, 1)
        )
        rewards = np.array([reward_of(n, s) for _, n, s in rows])
        infos = [{"TimeLimit.truncated": end == "truncated"} for end in ends]
        actions = np.array([[n / 1e4, s / 1e4] for _, n, s in rows], np.float32)
        self.buffer.add(obs, next_obs, actions, rewards, np.array([end != "no" for end in ends]), infos)
        self.n_adds += 1
        for env, (episode, end) in enumerate(zip(self.current, ends, strict=True)):
            episode.steps.append(rewards[env])
            if end != "no":
                self.end(episode, end == "terminated")
        self.overwrite()

    def end(self, episode, terminated):
        episode.ended, episode.terminated = True, terminated
        self.current[episode.env] = Told(episode.env, episode.number + 1, began=self.n_adds)
        self.told.append(self.current[episode.env])
        self.to_propose.append(episode)

    def overwrite(self):
        self.challenges = [challenge for challenge in self.challenges if self.present(challenge[0])]
        self.to_propose = [episode for episode in self.to_propose if self.present(episode)]

    def present(self, episode):
        return episode.ended and episode.began >= self.n_adds - self.size

    @precondition(lambda self: any(episode.length for episode in self.current))
    @rule()
    def reset_from_outside(self):
        """The next observations don't continue the episodes: they end as truncations, with the next add()."""
        self.buffer.attach_challenger()
        for episode in list(self.current):
            if episode.length:
                self.end(episode, terminated=False)
        self.add(["no"] * 3)

    @rule(seed=st.integers(0, 10**6))
    def propose(self, seed):
        rng = np.random.default_rng(seed)
        completed = self.buffer.pop_completed()
        assert sorted((e.env_idx, e.ordinal) for e in completed) == sorted((e.env, e.number) for e in self.to_propose)
        for episode in completed:
            n = episode.length
            evaluation = Evaluation(0.1 * rng.random(n), rng.random(n), rng.random((n + 1, 3)))
            evaluation.disagreement[-1] = 5.0
            proposal = self.buffer.propose(episode, evaluation)
            assert (proposal is None) == (n <= 1)
            if proposal is not None and proposal.accepted:
                (told,) = [e for e in self.to_propose if (e.env, e.number) == (episode.env_idx, episode.ordinal)]
                self.challenges.append((told, proposal.first, proposal.artificial.total))
                self.challenges = self.challenges[-self.max_challenges :]
        self.to_propose = []

    @precondition(lambda self: self.challenges)
    @rule(seed=st.integers(0, 10**6))
    def refresh(self, seed):
        rng = np.random.default_rng(seed)
        challenge = self.buffer.challenges[0]
        n = challenge.episode.length
        coefficients = self.buffer.coefficients
        change = self.buffer.refresh(challenge, Evaluation(rng.random(n), rng.random(n), rng.random((n + 1, 3))))
        assert np.isfinite(change) and self.buffer.coefficients == coefficients
        refreshed = self.buffer.challenges[0]
        assert refreshed.age == 0 and (refreshed.start, refreshed.goal) == (challenge.start, challenge.goal)
        self.challenges[0] = (*self.challenges[0][:2], refreshed.rewards)

    @rule(lengths=st.lists(st.integers(1, 6), min_size=1, max_size=3))
    def demonstrate(self, lengths):
        episodes = []
        for length in lengths:
            number = DEMONSTRATED + self.n_demonstrated
            self.n_demonstrated += 1
            rewards = [reward_of(number, step) for step in range(length)]
            self.demonstrations.append(Told(0, number, rewards, terminated=True, ended=True))
            actions = np.stack([np.full(length, number), np.arange(length)], axis=1) / 1e4
            episodes.append(Demonstration(states(0, number, length + 1), actions, np.array(rewards), terminated=True))
        self.buffer.add_demonstrations(episodes)

    @rule(in_file=st.booleans())
    def save_and_load(self, in_file):
        if in_file:
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / "buffer.pkl"
                self.buffer.save(path)
                self.buffer = CPMBuffer.load(path)
        else:
            self.buffer = pickle.loads(pickle.dumps(self.buffer))
        self.buffer.attach_challenger()

    @precondition(lambda self: self.buffer.episodes_ended)
    @rule(seed=st.integers(0, 10**6), batch_size=st.integers(1, 20))
    def sample(self, seed, batch_size):
        np.random.seed(seed)
        samples = self.buffer.sample(batch_size)
        in_challenge = {
            (told.env, told.number, first + i): np.float32(reward)
            for told, first, rewards in self.challenges
            for i, reward in enumerate(rewards)
        }
        known = {
            (e.env, e.number): e for e in [*self.told, *self.demonstrations] if self.present(e) or e.number >= DEMONSTRATED
        }
        for obs, next_obs, action, reward, done in zip(
            samples.observations["state"].numpy(),
            samples.next_observations["state"].numpy(),
            samples.actions.numpy(),
            samples.rewards.numpy(),
            samples.dones.numpy(),
            strict=True,
        ):
            env, number, step = (int(value) for value in obs)
            episode = known[env, number]
            assert tuple(next_obs) == (env, number, step + 1)
            np.testing.assert_allclose(action, [number / 1e4, step / 1e4], rtol=1e-5, atol=1e-7)
            assert reward[0] in (episode.steps[step], in_challenge.get((env, number, step)))
            assert done[0] == (episode.terminated and step + 1 == episode.length)
        assert (samples.next_observations["camera"][:, 0, 0, 0] == samples.next_observations["state"][:, 2] % 256).all()

    @precondition(lambda self: self.buffer.episodes_ended)
    @rule(seed=st.integers(0, 10**6), length=st.integers(1, 15))
    def sample_sequences(self, seed, length):
        np.random.seed(seed)
        batch = self.buffer.sample_sequences(4, length)
        known = {
            (e.env, e.number): e for e in [*self.told, *self.demonstrations] if self.present(e) or e.number >= DEMONSTRATED
        }
        for column in range(4):
            previous = None
            for row in range(length):
                if not batch.mask[row, column]:
                    assert not batch.mask[row:, column].any()
                    break
                env, number, step = (int(value) for value in batch.observations["state"][row, column])
                episode = known[env, number]
                assert batch.is_first[row, column] == (step == 0)
                assert batch.is_terminal[row, column] == (episode.terminated and step == episode.length)
                assert batch.rewards[row, column] == (episode.steps[step - 1] if step else 0)
                if previous is not None:
                    follows = (*previous[:2], previous[2] + 1)
                    begins = (env, previous[1] + 1, 0)
                    assert (env, number, step) == (begins if previous[2] == known[previous[:2]].length else follows)
                previous = (env, number, step)

    # ------------------------------------------------------------------ what always holds

    @invariant()
    def the_same_episodes_and_challenges(self):
        if not hasattr(self, "buffer"):
            return
        episodes = sorted((e.env, e.number, e.length) for e in self.told if self.present(e))
        assert [(e.env_idx, e.ordinal, e.length) for e in self.buffer.episodes] == episodes
        assert self.buffer.n_added == self.n_adds * self.n_envs
        challenges = self.buffer.challenges
        assert [(c.environment, c.episode.ordinal, c.start) for c in challenges] == [
            (told.env, told.number, first) for told, first, _ in self.challenges
        ]
        for challenge, (_, _, rewards) in zip(challenges, self.challenges, strict=True):
            np.testing.assert_array_equal(challenge.rewards, rewards)
            terms = challenge.terms
            np.testing.assert_allclose(0.5 * sum(terms.values()), challenge.rewards)
            assert challenge.age >= 0 and challenge.goal < challenge.episode.length
        demonstrations = self.buffer.demonstrations
        assert (0 if demonstrations is None else len(demonstrations.episodes)) == len(self.demonstrations)


TestMachine = Machine.TestCase
TestMachine.settings = settings(max_examples=60, stateful_step_count=40, deadline=None)
