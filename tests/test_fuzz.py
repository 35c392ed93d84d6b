"""
Random spaces, dtypes, shapes, rewards and configurations: what comes in comes back with the same values, or an error of ours
says what is wrong. 100 examples of each kind; ``SB3_CPM_FUZZ=2000 pytest tests/test_fuzz.py`` for more.
"""

import contextlib
import os
import traceback
import warnings
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from sb3_cpm import ChallengerCallback, CPMBuffer, PointNetExtractor
from sb3_cpm.agents.checks import check_hyperparameters
from sb3_cpm.buffers import Demonstration
from sb3_cpm.dreamer.spaces import as_dict_space
from sb3_cpm.presets import ENTRIES, make_preset
from sb3_cpm.spaces import looks_like_cloud
from sb3_cpm.world_model.networks import Encoder
from sb3_cpm.world_model.observations import ObservationSpec, is_rangeless_image, unread

FUZZ = settings(
    max_examples=int(os.environ.get("SB3_CPM_FUZZ", "100")),
    deadline=None,
    derandomize="SB3_CPM_FUZZ" not in os.environ,  # CI shall not fail at random
    suppress_health_check=list(HealthCheck),
    report_multiple_bugs=False,
    phases=[phase for phase in Phase if phase is not Phase.explain],
    database=None,
)
INTEGERS = (np.uint8, np.int8, np.int16, np.uint16, np.int32, np.uint32, np.int64)
FLOATS = (np.float16, np.float32, np.float64)


@contextlib.contextmanager
def explained():
    """An exception must be one that our code has raised on purpose, with more than a word."""
    try:
        yield
    except (ValueError, RuntimeError) as error:
        frames = [frame.f_globals.get("__name__", "") for frame, _ in traceback.walk_tb(error.__traceback__)]
        if frames[-1].split(".")[0] != "sb3_cpm" or len(str(error)) < 30:
            raise
        raise Refused from error


class Refused(Exception):
    pass


# ---- spaces and what is in them ----------------------------------------------------------------------------------------


@st.composite
def boxes(draw):
    shape = draw(
        st.one_of(
            st.lists(st.integers(1, 5), max_size=4).map(tuple),
            st.tuples(st.integers(8, 40), st.integers(8, 40), st.sampled_from([1, 3, 4])),  # images
            st.tuples(st.sampled_from([1, 3]), st.integers(8, 40), st.integers(8, 40)),
            st.tuples(st.integers(2, 50), st.integers(1, 8)),  # clouds and stacks
        )
    )
    dtype = draw(st.sampled_from(INTEGERS + FLOATS))
    if np.issubdtype(dtype, np.integer):
        limits = np.iinfo(dtype)
        low, high = draw(st.sampled_from([(limits.min, limits.max), (0, limits.max), (0, 100), (0, 1), (3, 3)]))
    else:
        low, high = draw(st.sampled_from([(-np.inf, np.inf), (0.0, np.inf), (-1.0, 1.0), (0.0, 255.0), (-1000.0, 1.0)]))
    return spaces.Box(low, high, shape, dtype)


parts = st.one_of(
    boxes(),
    boxes(),
    st.builds(spaces.Discrete, st.integers(1, 9), start=st.integers(-3, 3)),
    st.lists(st.integers(1, 9), min_size=1, max_size=3).map(spaces.MultiDiscrete),
    st.just(spaces.MultiDiscrete([[2, 3], [4, 5]])),
    st.sampled_from([spaces.MultiBinary(3), spaces.MultiBinary((2, 2))]),
    st.sampled_from([spaces.Text(4), spaces.Tuple([spaces.Discrete(2)]), spaces.Dict(a=spaces.Discrete(2))]),
)
dicts = st.dictionaries(st.sampled_from(["a", "camera", "state", "é.1"]), parts, max_size=3).map(spaces.Dict)
seeds = st.integers(0, 2**16)


def sample(space: spaces.Space, rng: np.random.Generator, n: int) -> Any:
    """Finite values of a space, stacked, as VecEnvs give them."""
    if isinstance(space, spaces.Box):
        low, high = float(max(space.low.min(initial=0), -1e4)), float(min(space.high.max(initial=0), 1e4))
        return rng.uniform(low, high, (n, *space.shape)).astype(space.dtype)
    space.seed(int(rng.integers(2**31)))
    values = [space.sample() for _ in range(n)]
    return values if isinstance(space, (spaces.Text, spaces.Tuple, spaces.Dict)) else np.stack(values)


#: How an array may come that is not what the space says. All but the first few have to be refused, or change no value.
SLIPS = {
    "as it is": lambda array: array,
    "other dtype": lambda array: array.astype(np.float64),
    "integers": lambda array: array.astype(np.int64),
    "list": lambda array: array.tolist(),
    "flat": lambda array: array.reshape(len(array), -1),
    "channels moved": lambda array: np.moveaxis(array, 1, -1) if array.ndim > 2 else array,
    "transposed": lambda array: array.T,
    "without environment": lambda array: array[0],
    "environments last": lambda array: np.moveaxis(array, 0, -1),
    "scaled": lambda array: array / 255.0,
    "huge": lambda array: array.astype(np.float64) * 1e300 + 1e300,
    "one more": lambda array: np.concatenate([array, array]),
    "read-only": lambda array: np.broadcast_to(array, array.shape),
    "reversed memory": lambda array: np.asfortranarray(array),
    "text": lambda array: array.astype(str),
    "none": lambda array: None,
}
REWARDS = {
    "array": lambda reward: reward,
    "integers": lambda reward: reward.astype(int),
    "list": lambda reward: reward.tolist(),
    "number": lambda reward: float(reward[0]),
    "column": lambda reward: reward[:, None],
    "nan": lambda reward: reward * np.nan,
    "inf": lambda reward: reward + np.inf,
    "text": lambda reward: reward.astype(str),
    "none": lambda reward: None,
    "huge": lambda reward: reward * 1e300,
}
ACTIONS = (
    spaces.Box(-1, 1, (2,), np.float32),
    spaces.Box(-3, 5, (2, 1), np.float64),
    spaces.Box(np.array([0.0, -2.0], np.float32), np.array([0.5, 9.0], np.float32)),
    spaces.Discrete(3),
)


# ---- the buffer --------------------------------------------------------------------------------------------------------


@FUZZ
@given(
    space=dicts,
    action_space=st.sampled_from(ACTIONS),
    n_envs=st.integers(1, 3),
    seed=seeds,
    slip=st.sampled_from(list(SLIPS)),
    slip_of_actions=st.sampled_from(["as it is", "as it is", *SLIPS]),
    reward_kind=st.sampled_from(["array", "array", *REWARDS]),
    compact=st.booleans(),
)
def test_what_is_added_comes_back(space, action_space, n_envs, seed, slip, slip_of_actions, reward_kind, compact):
    rng = np.random.default_rng(seed)
    dtypes = {
        key: "float16" for key, part in space.items() if compact and isinstance(part, spaces.Box) and part.dtype.kind == "f"
    }
    with contextlib.suppress(Refused):
        with explained():
            buffer = CPMBuffer(
                20 * n_envs, space, action_space, device="cpu", n_envs=n_envs, challenge_ratio=0, storage_dtypes=dtypes
            )
        states = [{key: sample(part, rng, n_envs) for key, part in space.items()} for _ in range(4)]
        given_states = [{key: SLIPS[slip](array) for key, array in state.items()} for state in states]
        actions = rng.integers(0, 3, n_envs) if isinstance(action_space, spaces.Discrete) else None
        rewards = rng.normal(size=(3, n_envs))
        stored_actions = []
        for step in range(3):
            action = actions
            if action is None:
                action = rng.uniform(-1, 1, (n_envs, *action_space.shape)).astype(action_space.dtype)
            stored_actions.append(action)
            before = buffer.n_added
            try:
                with explained():
                    buffer.add(
                        given_states[step],
                        given_states[step + 1],
                        SLIPS[slip_of_actions](action),
                        REWARDS[reward_kind](rewards[step]),
                        np.full(n_envs, step == 2),
                        [{}] * n_envs,
                    )
            except Refused:
                assert buffer.n_added == before, "nothing is stored of what is refused"
                raise
        if slip_of_actions in ("as it is", "list", "flat", "other dtype", "read-only", "reversed memory"):
            expected = np.stack([action.reshape(n_envs, -1) for action in stored_actions])
            assert np.allclose(buffer.actions[:3], expected)
        assert reward_kind in ("array", "list", "integers", "number")
        sent = [np.reshape(REWARDS[reward_kind](reward), -1) for reward in rewards]
        assert np.allclose(buffer.rewards[:3], np.stack(sent), rtol=1e-6)
        for episode in buffer.episodes:
            for key, array in buffer.episode_observations(episode).items():
                told = np.stack([np.asarray(state[key])[episode.env_idx] for state in given_states])
                told = told.reshape(array.shape)  # a missing last dimension
                tolerance = 1e-3 if key in dtypes else 1e-6
                assert np.allclose(array, told, rtol=tolerance, atol=tolerance), key
                if space[key].dtype.kind in "iu":
                    assert np.array_equal(array, told), key


# ---- hindsight and demonstrations ----------------------------------------------------------------------------------------

COMPUTED = {
    "rows": lambda distance: -distance,
    "column": lambda distance: -distance[:, None],
    "list": lambda distance: (-distance).tolist(),
    "one": lambda distance: -distance.sum(),
    "square": lambda distance: distance[:, None] - distance,
    "nan": lambda distance: distance * np.nan,
    "short": lambda distance: distance[1:],
    "none": lambda distance: None,
    "condition": lambda distance: 0.0 if distance < 1 else -1.0,
    "text": lambda distance: distance.astype(str),
}


class Goals:
    """What a buffer asks of an environment."""

    def __init__(self, kind):
        self.kind = kind

    def env_method(self, name, achieved, desired, infos, indices):
        return [COMPUTED[self.kind](np.linalg.norm(achieved - desired, axis=-1))]


@FUZZ
@given(
    kind=st.sampled_from(list(COMPUTED)), batch=st.integers(1, 40), n_sampled_goal=st.integers(1, 9), size=st.integers(1, 3)
)
def test_rewards_in_hindsight(kind, batch, n_sampled_goal, size):
    box = spaces.Box(-np.inf, np.inf, (size,), np.float32)
    space = spaces.Dict(achieved_goal=box, desired_goal=box)
    buffer = CPMBuffer(20, space, ACTIONS[0], env=Goals(kind), device="cpu", challenge_ratio=0, n_sampled_goal=n_sampled_goal)
    for step in range(10):
        here, there = ({key: np.full((1, size), at, np.float32) for key in space} for at in (step, step + 1))
        buffer.add(here, there, np.zeros((1, 2)), 7.0, step == 9, {})
    with contextlib.suppress(Refused), explained():
        samples = buffer.sample(batch)
        n = int(buffer.her_ratio * batch)
        if n == 1 and kind in ("one", "square", "condition"):  # of one row nobody can tell
            return
        distance = (samples.next_observations["achieved_goal"] - samples.observations["desired_goal"]).norm(dim=1)[:n]
        assert th.allclose(samples.rewards[:n, 0], -distance, atol=1e-5) and (samples.rewards[n:] == 7).all()


@FUZZ
@given(
    action_space=st.sampled_from(ACTIONS),
    seed=seeds,
    n_steps=st.integers(0, 4),
    spread=st.sampled_from([0.3, 1.0, 1.5, 100.0]),
    slips=st.tuples(*[st.sampled_from(["as it is", "as it is", *SLIPS])] * 3),
)
def test_demonstrations(action_space, seed, n_steps, spread, slips):
    rng = np.random.default_rng(seed)
    space = spaces.Dict(state=spaces.Box(-np.inf, np.inf, (2,), np.float32), camera=spaces.Box(0, 255, (1, 8, 9), np.uint8))
    if isinstance(action_space, spaces.Box):
        half = (action_space.high - action_space.low) / 2
        actions = action_space.low + half * (1 + spread * rng.normal(size=(n_steps, *action_space.shape)))
    else:
        actions = rng.integers(0, 3, n_steps)
    states = {
        "state": rng.normal(size=(n_steps + 1, 2)).astype(np.float32),
        "camera": rng.integers(0, 256, (n_steps + 1, 1, 8, 9), dtype=np.uint8),
    }
    rewards = rng.normal(size=n_steps)
    with contextlib.suppress(Refused), explained(), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Actions of demonstrations outside of")
        given_states = {key: SLIPS[slips[0]](array) for key, array in states.items()}
        try:
            episode = Demonstration(given_states, SLIPS[slips[1]](actions), SLIPS[slips[2]](rewards))
        except (IndexError, ValueError):  # the slip itself, of nothing
            return
        buffer = CPMBuffer(20, space, action_space, device="cpu", challenge_ratio=0)
        buffer.add_demonstrations([episode])
        stored = buffer.demonstrations
        expected = np.asarray(episode.actions)  # what slips make of it may be possible, too
        if isinstance(action_space, spaces.Box):
            expected = np.clip((expected - action_space.low) / half - 1, -1, 1)
        assert np.allclose(stored.actions[:n_steps], expected.reshape(n_steps, 1, -1), atol=1e-5)
        assert np.allclose(stored.rewards[:n_steps, 0], episode.rewards, atol=1e-6)
        for key, array in stored.episode_observations(stored.episodes[0]).items():
            told = np.asarray(given_states[key])
            told = told if told.shape == array.shape else np.moveaxis(told, -1, 1)
            assert np.allclose(array, told, atol=1e-6), key


# ---- challenger's and player's eyes --------------------------------------------------------------------------------------


@FUZZ
@given(space=dicts, name_all=st.booleans(), seed=seeds, slip=st.sampled_from(["as it is", "as it is", *SLIPS]))
def test_what_the_challenger_reads_is_what_was_given(space, name_all, seed, slip):
    rng = np.random.default_rng(seed)
    with contextlib.suppress(Refused), warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with explained():
            spec = ObservationSpec(space, list(space) if name_all else None, squash=False)
        left_out = set(space) - set(spec.keys)
        told = {key for key in left_out if any(repr(key) in str(one.message) for one in caught)}
        assert left_out == told | set(unread(space, spec.keys)) | {key for key in left_out if looks_like_cloud(space[key])}
        assert all(key in told for key in left_out if is_rangeless_image(space[key]))
        observations = {key: sample(space[key], rng, 2) for key in spec.keys}
        sent = {key: SLIPS[slip](array) for key, array in observations.items()}
        if any(not isinstance(array, np.ndarray) or array.dtype.kind not in "biuf" for array in sent.values()):
            return  # the buffer is what refuses these
        with explained():
            inputs = spec.preprocess(sent, th.device("cpu"))
        rows = len(next(part for part in inputs if part is not None))
        if inputs.images is not None:
            assert inputs.images.abs().max() <= 0.5
        for key, array in spec.split(inputs, (rows,)).items():
            low, high = spec.ranges.get(key, (0.0, 0.0))
            given_values = sent[key].reshape(rows, *spec.shapes[key]).astype(np.float64)
            if key in spec.image_keys:  # a little outside of the bounds is clipped
                given_values = given_values.clip(low, high)
            assert np.allclose(array.numpy(), given_values, rtol=1e-5, atol=1e-5 * max(high - low, 1.0)), key
        with explained():
            encoder = Encoder(spec, depth=2, layers=4, vector_layers=1, vector_units=4)
            assert encoder(inputs).shape == (rows, encoder.output_dim)


@FUZZ
@given(space=dicts, name_all=st.booleans(), seed=seeds)
def test_what_the_player_reads(space, name_all, seed):
    rng = np.random.default_rng(seed)
    with contextlib.suppress(Refused), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*as a point cloud")
        warnings.filterwarnings("ignore", message="Treating image space as channels-last")
        with explained():
            extractor = PointNetExtractor(space, keys=list(space) if name_all else None)
        observations = {
            key: th.as_tensor(sample(space[key], rng, 2).astype(np.float32)) / 255.0 for key in extractor.player_keys
        }
        features = extractor(observations)
        assert features.shape == (2, extractor.features_dim) and th.isfinite(features).all()


@FUZZ
@given(space=parts)
def test_spaces_that_dreamer_takes(space):
    with contextlib.suppress(Refused), explained():
        assert isinstance(as_dict_space(space), spaces.Dict)


# ---- configurations ------------------------------------------------------------------------------------------------------

anything = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-5, 10**6),
    st.floats(width=32, allow_subnormal=False),  # another test of this process may have them flushed to zero
    st.sampled_from(["", "1e3", "3e-4", "0.5", "auto", "report", "tuned", "episode", "row", "exponential", "linera"]),
    st.lists(st.integers(0, 3), max_size=2),
    st.dictionaries(st.sampled_from(["start", "scale", "rate", "x", "horizon", "heads"]), st.integers(-1, 9), max_size=2),
)
OF_CALLBACK = [
    *("preset", "keys", "uncertainty_class", "uncertainty_kwargs", "challenger_kwargs", "decay", "decay_kwargs", "unit"),
    *("segment_length", "train_freq", "gradient_steps", "load_path", "trian_freq"),
]
OF_BUFFER = [
    *(
        "n_sampled_goal",
        "goal_selection_strategy",
        "challenge_ratio",
        "mix",
        "max_challenges",
        "terminal_goals",
        "warmup_steps",
    ),
    *("kl_ratio", "reward_ratio", "filter_kwargs", "reward_kwargs", "coefficient_kwargs", "refresh_every"),
    *(
        "demonstration_ratio",
        "storage_dtypes",
        "player_keys",
        "n_steps",
        "optimize_memory_usage",
        "buffer_size",
        "n_envs",
        "mixx",
    ),
]
OF_ENTRY = [
    *("n_timesteps", "n_envs", "buffer_size", "learning_starts", "learning_rate", "gamma", "tau", "batch_size", "train_freq"),
    *("gradient_steps", "noise_std", "ent_coef", "callback", "replay_buffer_kwargs", "policy_kwargs", "policy", "env_kwargs"),
]


@FUZZ
@given(given=st.dictionaries(st.sampled_from(OF_CALLBACK), anything, max_size=3))
def test_arguments_of_the_callback(given):
    with contextlib.suppress(Refused), explained():
        ChallengerCallback(**given)


@FUZZ
@given(given=st.dictionaries(st.sampled_from(sorted(ENTRIES)), anything, max_size=3))
def test_entries_of_presets(given):
    with contextlib.suppress(Refused), explained():
        complete = make_preset(given)
        assert all(getattr(complete, key) == value for key, value in given.items())


@FUZZ
@given(given=st.dictionaries(st.sampled_from(OF_BUFFER), anything, max_size=3))
def test_arguments_of_the_buffer(given):
    space = spaces.Dict(state=spaces.Box(-1, 1, (2,), np.float32))
    with contextlib.suppress(Refused), explained():
        CPMBuffer(**{"buffer_size": 20, "observation_space": space, "action_space": ACTIONS[0], "device": "cpu", **given})


@FUZZ
@given(given=st.dictionaries(st.sampled_from(OF_ENTRY), anything, max_size=3))
def test_entries_of_configurations(given):
    entry = {"policy": "MultiInputPolicy", "n_timesteps": 1000, "replay_buffer_class": "CPMBuffer", **given}
    with contextlib.suppress(Refused), explained():
        check_hyperparameters(entry, "sac", "CPMToy-v0", "own.yml")
        for key in ("n_timesteps", "buffer_size", "gamma", "tau", "batch_size"):
            assert not isinstance(given.get(key), str), key
