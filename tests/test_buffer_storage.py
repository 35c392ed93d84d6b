"""Where and how CPMBuffer keeps observations, and that it is unchanged after whatever it refuses."""

import contextlib
import copy
import pickle
import resource
import signal
import types

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_cpm.buffers import CPMBuffer, Demonstration, allocation
from sb3_cpm.files import write_archive
from sb3_cpm.type_aliases import Evaluation

SPACE = spaces.Dict(
    {
        "cloud": spaces.Box(-np.inf, np.inf, (7, 6), np.float32),
        "picture": spaces.Box(0.0, 1.0, (4, 4, 3), np.float32),
        "state": spaces.Box(-np.inf, np.inf, (3,), np.float32),
    }
)
ACTIONS = spaces.Box(-1, 1, (2,), np.float32)
COMPACT = {"cloud": ["float16"] * 3 + [("uint8", 0.0, 1.0)] * 3, "picture": "uint8"}


def make(size=40, n_envs=1, space=SPACE, **kwargs):
    return CPMBuffer(size, space, ACTIONS, n_envs=n_envs, device="cpu", challenge_ratio=0, **kwargs)


def observation(step, n_envs=1):
    rng = np.random.default_rng(step)
    cloud = rng.uniform(-2, 2, (n_envs, 7, 6)).astype(np.float32)
    cloud[..., 3:] = rng.integers(0, 256, (n_envs, 7, 3)) / np.float32(255)
    picture = rng.integers(0, 256, (n_envs, 4, 4, 3)) / np.float32(255)
    return {"cloud": cloud, "picture": picture, "state": np.full((n_envs, 3), step, np.float32)}


def add(buffer, step, done=False, **changes):
    n_envs = buffer.n_envs
    arguments = dict(
        obs=observation(step, n_envs),
        next_obs=observation(step + 1, n_envs),
        action=np.zeros((n_envs, 2), np.float32),
        reward=np.ones(n_envs, np.float32),
        done=np.full(n_envs, done),
        infos=[{}] * n_envs,
    )
    buffer.add(**{**arguments, **changes})


def fill(buffer, lengths, first=0):
    for length in lengths:
        for step in range(first, first + length):
            add(buffer, step, done=step == first + length - 1)
        first += 100
    return first


def state_of(buffer):
    """Everything that is pickled, as one comparable thing."""
    return pickle.dumps(copy.deepcopy(buffer))


@pytest.mark.parametrize("kwargs", [dict(), dict(storage_dtypes=COMPACT), dict(storage_dtypes={"cloud": "float16"})])
@pytest.mark.parametrize("in_files", [False, True])
def test_what_comes_back_is_what_went_in(kwargs, in_files, tmp_path):
    buffer = make(memmap_dir=tmp_path if in_files else None, **kwargs)
    fill(buffer, [9, 12, 8, 15, 7])  # wraps
    for _ in range(2):
        for key, tolerance in (("cloud", 1e-3 if kwargs else 0), ("picture", 1e-6), ("state", 0)):
            samples = buffer.sample(100)
            for observations, ahead in ((samples.observations, 0), (samples.next_observations, 1)):
                assert observations[key].dtype == th.float32
                for row, step in zip(observations[key].numpy(), samples.observations["state"][:, 0].numpy(), strict=True):
                    np.testing.assert_allclose(row, observation(int(step) + ahead)[key][0], atol=tolerance)
            batch = buffer.sample_sequences(5, 6)
            states = batch.observations["state"][..., 0]
            for place in np.ndindex(states.shape):
                expected = observation(int(states[place]))[key][0]
                np.testing.assert_allclose(batch.observations[key][place], expected, atol=tolerance)
        episode = buffer.episodes[-1]
        assert buffer.episode_observations(episode)["cloud"].shape == (episode.length + 1, 7, 6)
        buffer = pickle.loads(pickle.dumps(buffer))  # and again after loading
        assert isinstance(buffer.observations["state"], np.memmap) == in_files
        add(buffer, 400)
    assert [type(array) for array in pickle.loads(pickle.dumps(buffer)).ring.final.arrays.values()] == (
        [np.memmap if in_files else np.ndarray] * 3
    )


def test_compact_storage_is_small_and_continues_episodes():
    plain, compact = make(), make(storage_dtypes=COMPACT)
    for buffer in (plain, compact):
        fill(buffer, [10, 10])
        assert [episode.length for episode in buffer.episodes] == [10, 10], "rounding must not look like a reset"
    assert compact.ring.observations["cloud"].nbytes == 40 * 7 * 9
    assert compact.ring.observations["picture"].nbytes * 4 == plain.ring.observations["picture"].nbytes
    add(compact, 300)
    compact = pickle.loads(pickle.dumps(compact))  # in the middle of an episode
    add(compact, 301, done=True)
    assert [episode.length for episode in compact.episodes] == [10, 10, 2]


@pytest.mark.parametrize(
    "dtype", ["uint8", "int8", "uint16", "int16", "uint32", "int32", "uint64", "int64", "float16", "float32", "float64"]
)
def test_every_dtype_is_stored_as_it_is(dtype):
    """What SB3's test_buffer_dtypes asks, of a buffer that is not empty."""
    space = spaces.Dict({"obs": spaces.Box(0, 100, (1,), dtype=np.dtype(dtype)), "number": spaces.Discrete(5)})
    buffer = CPMBuffer(10, space, ACTIONS, device="cpu", challenge_ratio=0)
    assert buffer.observations["obs"].dtype == buffer.next_observations["obs"].dtype == np.dtype(dtype)
    for step in range(3):
        obs, next_obs = ({"obs": np.full((1, 1), s, dtype), "number": np.array([s])} for s in (step, step + 1))
        buffer.add(obs, next_obs, np.zeros((1, 2)), np.ones(1), np.array([step == 2]), [{}])
    samples = buffer.sample(20)
    assert samples.observations["obs"].numpy().dtype == np.dtype(dtype)
    assert (samples.next_observations["number"] == samples.observations["number"] + 1).all()


@pytest.mark.parametrize(
    "specs, message",
    [
        ({"clod": "float16"}, "clod"),
        ({"cloud": "uint8"}, "finite bounds"),
        ({"cloud": ["float16"] * 5}, "5 features"),
        ({"cloud": "int8"}, "float16, or scaled"),
        ({"cloud": "nonsense"}, "not a dtype"),
        ({"state": ("uint8", 1.0, 1.0)}, "finite bounds"),
    ],
)
def test_storage_that_cannot_work(specs, message):
    with pytest.raises(ValueError, match=message):
        make(storage_dtypes=specs)


def test_images_are_small_already():
    with pytest.raises(ValueError, match="uint8 already"):
        make(space=spaces.Dict({"image": spaces.Box(0, 255, (8, 8, 3), np.uint8)}), storage_dtypes={"image": "float16"})


def with_value(key, value):
    changed = observation(8)
    changed[key] = np.full_like(changed[key], value)
    return changed


@pytest.mark.parametrize(
    "changes, message",
    [
        (dict(reward=np.array([np.nan])), "reward of nan"),
        (dict(reward=np.array([-np.inf])), "reward of -inf"),
        (dict(reward=np.ones(2)), r"shape \(2,\)"),
        (dict(next_obs={**observation(8), "state": np.zeros((1, 4))}), r"'state' has shape \(1, 4\), expected \(1, 3\)"),
        (dict(obs={**observation(7), "cloud": np.zeros((2, 7, 6))}), "'cloud' has shape"),
        (dict(next_obs={"state": np.zeros((1, 3))}), "lack 'cloud'"),
        (dict(next_obs=with_value("cloud", 1e6)), "too large for float16"),
        (dict(next_obs=with_value("picture", 1.5)), "declares"),
        (dict(next_obs=with_value("picture", np.nan)), "declares"),
    ],
)
def test_nothing_is_stored_of_bad_input(changes, message):
    specs = {"cloud": "float16", "picture": "uint8"}
    buffer = make(storage_dtypes=specs)
    fill(buffer, [5])
    for step in range(3, 7):
        add(buffer, step)
    before = state_of(buffer)
    with pytest.raises(ValueError, match=message):
        add(buffer, 7, **changes)
    assert state_of(buffer) == before
    add(buffer, 7, done=True)
    assert [episode.length for episode in buffer.episodes] == [5, 5]


def test_an_episode_longer_than_the_buffer_changes_nothing():
    buffer = make(size=6)
    for step in range(6):
        add(buffer, step)
    before = state_of(buffer)
    with pytest.raises(ValueError, match="longer than the 6 transitions"):
        add(buffer, 6)
    assert state_of(buffer) == before
    with pytest.warns(UserWarning, match="truncated"):
        buffer.truncate_last_trajectory()
    assert [episode.length for episode in buffer.episodes] == [6]


def test_more_than_the_machine_has_is_refused_before_it_is_taken(monkeypatch, tmp_path):
    with pytest.raises(ValueError, match=r"will take .* GB .* this machine has .* of memory.*storage_dtypes"):
        make(size=10**12)
    with pytest.raises(ValueError, match=r"GB of it in files in .* are free there"):
        make(size=10**12, memmap_dir=tmp_path)
    assert not list(tmp_path.iterdir())
    monkeypatch.setattr(allocation, "memory_of_machine", lambda: (10**12, 10))
    with pytest.warns(UserWarning, match="available now"):
        make()


def test_it_says_how_much_memory_it_will_take(caplog, monkeypatch):
    with caplog.at_level("INFO", logger="sb3_cpm.buffers.allocation"):
        make(size=1000)
    assert "CPMBuffer of 1,000 transitions will take" in caplog.text and "picture" in caplog.text
    assert caplog.records[0].levelname == "INFO"
    monkeypatch.setattr(allocation, "memory_of_machine", lambda: (10**6, 10**6))
    make(size=500)
    assert caplog.records[-1].levelname == "WARNING", "a tenth of the memory is worth being told without asking"


@contextlib.contextmanager
def full_disk():
    """
    Inside, no file can grow beyond 3 kB. Not for longer than the lines that need it: pytest's own output may go to a file.
    """
    previous = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (3_000, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, previous)


def test_a_full_disk_at_construction(tmp_path):
    with full_disk(), pytest.raises(ValueError, match=r"Cannot reserve .* for 'cloud' .* are free there"):
        make(size=1000, memmap_dir=tmp_path)


def test_a_full_disk_under_a_memory_map(tmp_path):
    """The blocks are taken at construction; only the last observations of episodes need more, and are asked for in advance."""
    buffer = make(size=2000, memmap_dir=tmp_path)
    first = fill(buffer, [3])
    while len(buffer.ring.final._free) > 2:
        first = fill(buffer, [3], first)
    buffer.ring.final._free.clear()
    before = [(episode.start, episode.length) for episode in buffer.episodes], buffer.pos
    with full_disk(), pytest.raises(ValueError, match="Cannot reserve"):
        add(buffer, first, done=True)
    assert ([(episode.start, episode.length) for episode in buffer.episodes], buffer.pos) == before
    assert buffer.sample(50).rewards.shape == (50, 1)


def test_no_folder_to_write_to(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="is not a folder that can be written to"):
        make(memmap_dir=tmp_path / "file")


# ---------------------------------------------------------------------- saving and loading


@pytest.mark.parametrize(
    "how, message",
    [
        ("truncated", "is damaged or no saved replay buffer"),
        ("empty", "is damaged or no saved replay buffer"),
        ("text", "is damaged or no saved replay buffer"),
        ("archive", "is no saved replay buffer: it has no digest"),
        ("other", "is no saved replay buffer"),
        ("version", "has version 2, this version of sb3_cpm reads version 3"),
        ("kind", "holds a EpisodeBuffer, not a CPMBuffer"),
        ("pickle", "is a pickle.*can execute anything.*allow_pickle=True"),
        ("missing", "There is no file"),
    ],
)
def test_what_cannot_be_loaded(how, message, tmp_path):
    path = tmp_path / "buffer.npz"
    buffer = make()
    fill(buffer, [5])
    buffer.save(path)
    whole = path.read_bytes()
    content, arrays = buffer._state()
    content = {"kind": "CPMBuffer", "version": 3, **content}
    if how == "archive":
        np.savez(path, **arrays)
    elif how in ("other", "version", "kind"):
        changed = {"other": {"a": 1}, "version": {**content, "version": 2}, "kind": {**content, "kind": "EpisodeBuffer"}}
        write_archive(path, changed[how], arrays)
    elif how == "missing":
        path.unlink()
    else:
        texts = {"truncated": whole[: len(whole) // 2], "empty": b"", "text": b"hello", "pickle": pickle.dumps(buffer)}
        path.write_bytes(texts[how])
    with pytest.raises(ValueError, match=message):
        CPMBuffer.load(path)
    path.write_bytes(whole)
    assert CPMBuffer.load(path).episodes == buffer.episodes
    assert [file.name for file in tmp_path.iterdir()] == ["buffer.npz"]


def test_a_pickle_is_read_by_who_trusts_it(tmp_path):
    path = tmp_path / "buffer.pkl"
    buffer = make()
    fill(buffer, [5])
    path.write_bytes(pickle.dumps(buffer))
    assert CPMBuffer.load(path, allow_pickle=True).episodes == buffer.episodes
    for content, message in (
        (pickle.dumps({"not": "a buffer"}), "holds a dict, not a CPMBuffer"),
        (pickle.dumps(buffer)[:-100], "not a complete saved CPMBuffer"),
        (pickle.dumps(buffer).replace(b"format", b"formax"), "reads format 2"),
    ):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=message):
            CPMBuffer.load(path, allow_pickle=True)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # SB3 doesn't close the file then
def test_a_failed_load_leaves_the_models_buffer_alone(tmp_path):
    env = make_vec_env(lambda: BitFlippingEnv(continuous=True), 1)
    model = SAC(
        "MultiInputPolicy", env, replay_buffer_class=CPMBuffer, replay_buffer_kwargs=dict(challenge_ratio=0), buffer_size=100
    )
    path = tmp_path / "buffer.pkl"
    model.save_replay_buffer(path)
    path.write_bytes(path.read_bytes()[:-100])
    buffer = model.replay_buffer
    with pytest.raises(Exception, match="truncated|Ran out of input"):
        model.load_replay_buffer(path)
    assert model.replay_buffer is buffer


def test_a_buffer_of_another_environment_is_refused():
    buffer = pickle.loads(pickle.dumps(make(n_envs=2)))
    env = types.SimpleNamespace(observation_space=SPACE, action_space=ACTIONS, num_envs=2)
    for change, message in (
        (dict(num_envs=3), "filled by 2 parallel environments, now there are 3"),
        (dict(action_space=spaces.Box(-1, 1, (7,))), "another environment or controller"),
        (dict(observation_space=spaces.Dict({"state": SPACE["state"]})), "another environment"),
    ):
        with pytest.raises(ValueError, match=message):
            buffer.set_env(types.SimpleNamespace(**{**vars(env), **change}))
    buffer.set_env(env)


class PointEnv(gym.Env):
    """A point that moves as it is told, and a goal; episodes of ten steps."""

    def __init__(self):
        box = spaces.Box(-np.inf, np.inf, (2,), np.float32)
        self.observation_space = spaces.Dict({"observation": box, "achieved_goal": box, "desired_goal": box})
        self.action_space = ACTIONS

    def observation(self):
        return {"observation": self.point * 100, "achieved_goal": self.point, "desired_goal": np.ones(2, np.float32)}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.point, self.n_steps = np.zeros(2, np.float32), 0
        return self.observation(), {}

    def step(self, action):
        self.point = self.point + action
        self.n_steps += 1
        observation = self.observation()
        reward = self.compute_reward(observation["achieved_goal"], observation["desired_goal"], {})
        return observation, float(reward), False, self.n_steps == 10, {}

    def compute_reward(self, achieved, desired, infos):
        return -np.abs(achieved - desired).sum(axis=-1)


def test_vec_normalize_normalizes_all_shares():
    venv = VecNormalize(DummyVecEnv([PointEnv, PointEnv]), norm_obs_keys=["observation"])
    buffer = CPMBuffer(
        200, venv.observation_space, ACTIONS, venv, "cpu", n_envs=2, n_sampled_goal=3, challenge_ratio=0.5, mix="row"
    )
    buffer.attach_challenger()
    venv.reset()
    obs = venv.get_original_obs()
    for _ in range(90):  # 18 episodes: filters may refuse a few in a row
        action = np.stack([ACTIONS.sample() for _ in range(2)])
        _, _, dones, infos = venv.step(action)
        next_obs = {key: array.copy() for key, array in venv.get_original_obs().items()}
        stored = {key: array.copy() for key, array in next_obs.items()}
        for env_idx in np.flatnonzero(dones):
            last = venv.unnormalize_obs(infos[env_idx]["terminal_observation"])
            for key in stored:
                stored[key][env_idx] = last[key]
        buffer.add(obs, stored, action, venv.get_original_reward(), dones, infos)
        obs = next_obs
    for episode in buffer.pop_completed():
        rng = np.random.default_rng(0)
        n = episode.length
        assert buffer.propose(episode, Evaluation(rng.random(n), rng.random(n), rng.random((n + 1, 2)))) is not None
    buffer.add_demonstrations(
        [Demonstration(buffer.episode_observations(episode), buffer.episode_actions(episode), np.ones(10))]
    )
    assert buffer.challenges
    raw, normalized = buffer.sample(600), buffer.sample(600, venv)
    assert raw.observations["observation"].abs().max() > 20
    assert normalized.observations["observation"].abs().max() < 10
    assert normalized.rewards.dtype == normalized.observations["observation"].dtype == th.float32
    for samples in (raw, normalized):
        goals, wanted = samples.next_observations["achieved_goal"], samples.observations["desired_goal"]
        assert th.equal(wanted, samples.next_observations["desired_goal"])
        assert (wanted[:220] == 1).all(dim=1).float().mean() < 0.5, "three of four in D's share have other goals"
        assert goals.abs().max() > 1, "keys that are not normalized stay"


@pytest.mark.parametrize("strategy", ["future", "final", "episode"])
def test_hindsight_goals_are_uniform(strategy):
    """Chi-square of the step that a goal was achieved in, for the transitions of one step of an episode of ten."""
    np.random.seed(0)
    venv = DummyVecEnv([PointEnv])
    buffer = CPMBuffer(
        35, venv.observation_space, ACTIONS, venv, "cpu", n_sampled_goal=9, goal_selection_strategy=strategy, challenge_ratio=0
    )
    for step in range(40):  # wraps
        obs, next_obs = (
            {key: np.full((1, 2), step + ahead, np.float32) for key in venv.observation_space.spaces} for ahead in (0, 1)
        )
        buffer.add(obs, next_obs, np.zeros((1, 2)), np.zeros(1), np.array([step % 10 == 9]), [{}])
    samples = buffer.sample(100_000)
    virtual = samples.observations["desired_goal"][:90_000, 0].numpy()
    steps = samples.observations["observation"][:90_000, 0].numpy()
    at_four = virtual[steps == 34] - 30  # goals are what step + 1 achieved
    expected = {"future": range(5, 11), "final": [10], "episode": range(1, 11)}[strategy]
    goals, counts = np.unique(at_four, return_counts=True)
    assert goals.tolist() == list(expected)
    mean = counts.mean()
    assert ((counts - mean) ** 2 / mean).sum() < len(counts) + 4 * np.sqrt(2 * len(counts))
    np.testing.assert_allclose(
        samples.rewards[:90_000, 0].numpy(),
        -2 * np.abs(samples.next_observations["achieved_goal"][:90_000, 0].numpy() - virtual),
    )
