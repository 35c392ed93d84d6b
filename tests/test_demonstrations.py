"""Demonstrations: never overwritten, sampled at their own ratio, read from ManiSkill's trajectory files."""

import json
import os
import subprocess
import sys
import types

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_cpm.buffers import CPMBuffer, Demonstration
from sb3_cpm.dreamer import Dreamer
from sb3_cpm.type_aliases import Evaluation

h5py = pytest.importorskip("h5py", reason="h5py comes with mani_skill")

SPACE = spaces.Dict({"state": spaces.Box(-np.inf, np.inf, (2,), np.float32)})
ACTIONS = spaces.Box(-2, 2, (1,), np.float32)


def make(size=30, **kwargs):
    return CPMBuffer(size, SPACE, ACTIONS, device="cpu", **{"challenge_ratio": 0, **kwargs})


def demonstration(number, length, terminated=True):
    state = np.stack([np.full(length + 1, number), np.arange(length + 1)], axis=1).astype(np.float32)
    return Demonstration({"state": state}, np.full((length, 1), 1.0), np.arange(length) + 1.0, terminated)


def play(buffer, length):
    for step in range(length):
        obs, next_obs = ({"state": np.array([[0, s]], np.float32)} for s in (step, step + 1))
        buffer.add(obs, next_obs, np.zeros((1, 1)), np.zeros(1), np.array([step == length - 1]), [{}])


@pytest.mark.parametrize("mix", ["batch", "row"])
def test_share_of_demonstrations(mix):
    np.random.seed(0)
    buffer = make(mix=mix, demonstration_ratio=0.3)
    assert buffer.add_demonstrations([demonstration(1, 4), demonstration(2, 6, terminated=False)]) == 2
    assert set(buffer.sample(100).observations["state"][:, 0].tolist()) == {1.0, 2.0}, "D is empty still"
    for _ in range(5):
        play(buffer, 20)  # D is overwritten more than once
    assert buffer.add_demonstrations([demonstration(3, 5)]) == 1
    assert [episode.length for episode in buffer.demonstrations.episodes] == [4, 6, 5]
    shares = [(buffer.sample(20).observations["state"][:, 0] > 0).float().mean().item() for _ in range(1000)]
    assert np.mean(shares) == pytest.approx(0.3, abs=0.05)
    assert set(np.round(shares, 5)) == ({0.0, 1.0} if mix == "batch" else {0.3})
    batch = buffer.sample_sequences(2000, 3)
    assert (batch.observations["state"][0, :, 0] > 0).mean() == pytest.approx(0.3, abs=0.05)


def test_actions_and_ends_are_stored_as_in_d():
    np.random.seed(0)
    buffer = make()
    buffer.add_demonstrations([demonstration(1, 4), demonstration(2, 4, terminated=False)])
    samples = buffer.sample(200)
    assert (samples.actions == 0.5).all(), "scaled to [-1, 1]"
    last = samples.observations["state"][:, 1] == 3
    assert (samples.dones.flatten() == (last & (samples.observations["state"][:, 0] == 1))).all()
    assert (samples.next_observations["state"][:, 1] == samples.observations["state"][:, 1] + 1).all()
    assert (samples.rewards.flatten() == samples.observations["state"][:, 1] + 1).all()


@pytest.mark.parametrize(
    "changes, message",
    [
        (dict(rewards=np.zeros(0)), "at least one step"),
        (dict(rewards=np.array([1.0, np.nan, 1.0])), "finite"),
        (dict(actions=np.full((3, 1), 2.5)), "outside of"),
        (dict(actions=np.zeros((3, 2))), r"shape \(3, 2\)"),
        (dict(observations={"state": np.zeros((3, 2))}), r"shape \(4, 2\).*got \(3, 2\)"),
        (dict(observations={"stat": np.zeros((4, 2))}), "lacks the observations"),
    ],
)
def test_bad_demonstrations_add_nothing(changes, message):
    buffer = make()
    buffer.add_demonstrations([demonstration(1, 4)])
    good = demonstration(2, 3)
    bad = Demonstration(**{**vars(good), **changes})
    with pytest.raises(ValueError, match=message):
        buffer.add_demonstrations([good, bad])
    assert [episode.length for episode in buffer.demonstrations.episodes] == [4]
    with pytest.raises(ValueError, match="No demonstrations"):
        buffer.add_demonstrations([])


@pytest.mark.parametrize("mix", ["batch", "row"])
def test_shares_that_exceed_one(mix):
    with pytest.raises(ValueError, match="not exceed 1 together"):
        make(challenge_ratio=0.7, demonstration_ratio=0.5)
    buffer = make(challenge_ratio=0.95, mix=mix)  # fine, as long as there are no demonstrations
    with pytest.raises(ValueError, match=r"challenge_ratio=0.95 and demonstration_ratio=0.1 .* not exceed 1 together"):
        buffer.add_demonstrations([demonstration(1, 4)])
    assert buffer.demonstrations is None
    make(challenge_ratio=0.9, mix=mix).add_demonstrations([demonstration(1, 4)])


@pytest.mark.parametrize("challenges, demonstrations, batch_size", [(0.5, 0.5, 255), (0.75, 0.25, 10), (0.35, 0.65, 10)])
def test_rounded_shares_never_exceed_the_batch(challenges, demonstrations, batch_size):
    """Half a row more for each would be one too many."""
    buffer = make(mix="row", challenge_ratio=challenges, demonstration_ratio=demonstrations, warmup_steps=2)
    buffer.attach_challenger()
    buffer.add_demonstrations([demonstration(1, 4)])
    play(buffer, 10)
    episode = buffer.episodes[0]
    uncertainty = np.linspace(0.1, 1, 10)
    evaluation = Evaluation(uncertainty, uncertainty, np.ones((11, 2), np.float32))
    assert buffer.propose(episode, evaluation).accepted
    n_imaginary, n_demonstrated = buffer._shares(batch_size)
    assert n_imaginary == round(challenges * batch_size) and n_imaginary + n_demonstrated <= batch_size
    assert len(buffer.sample(batch_size).rewards) == batch_size


def test_demonstrations_move_to_the_device_of_the_buffer():
    """SB3 gives a loaded buffer the device of its model; "meta" stands for another one than the CPU."""
    buffer = make(mix="row", demonstration_ratio=0.5)
    buffer.add_demonstrations([demonstration(1, 4)])
    play(buffer, 10)
    buffer.device = th.device("meta")
    samples = buffer.sample(8)
    assert samples.rewards.device == samples.observations["state"].device == th.device("meta")


# ---------------------------------------------------------------------- files


class CounterEnv(gym.Env):
    """The state is (seed, sum of the actions); success when the sum reaches 3."""

    def __init__(self):
        self.observation_space, self.action_space = SPACE, ACTIONS

    def reset(self, *, seed=None, options=None):
        self.state = np.array([seed, 0], np.float32)
        return {"state": self.state.copy()}, {}

    def step(self, action):
        self.state[1] += action[0]
        return {"state": self.state.copy()}, float(self.state[1]), False, False, {"is_success": bool(self.state[1] >= 3)}


def write(folder, lengths, obs=None, rewards=False, actions_shape=(1,), **index):
    """What ManiSkill's RecordEpisode writes, as far as it is read here."""
    episodes = []
    with h5py.File(folder / "demos.h5", "w") as file:
        for number, length in enumerate(lengths):
            group = file.create_group(f"traj_{number}")
            group.create_dataset("actions", data=np.ones((length, *actions_shape), np.float32))
            group.create_dataset("terminated", data=np.arange(length) == length - 1)
            group.create_dataset("truncated", data=np.zeros(length, bool))
            if obs == "dict":
                group.create_group("obs").create_dataset("state", data=demonstration(number, length).observations["state"])
            elif obs == "flat":
                group.create_dataset("obs", data=demonstration(number, length).observations["state"])
            elif obs == "other":
                group.create_dataset("obs", data=np.zeros((length + 1, 42)))
            if rewards:
                group.create_dataset("rewards", data=np.ones(length, np.float32))
            episodes.append(dict(episode_id=number, episode_seed=10 + number, control_mode="pd_ee_delta_pos", success=True))
    index = {"env_info": {"env_id": "Counter-v1", "env_kwargs": {"obs_mode": "state"}}, "episodes": episodes, **index}
    (folder / "demos.json").write_text(json.dumps(index))
    return folder / "demos.h5"


@pytest.mark.parametrize("obs", ["dict", "flat"])
def test_observations_of_the_file_are_taken_where_they_fit(obs, tmp_path):
    buffer = make()
    assert buffer.add_demonstrations(write(tmp_path, [4, 5], obs, rewards=True)) == 2
    episode = buffer.demonstrations.episodes[1]
    np.testing.assert_array_equal(buffer.demonstrations.episode_observations(episode)["state"][:, 1], np.arange(6))


def test_otherwise_the_actions_are_replayed(tmp_path, caplog):
    buffer = make()
    path = write(tmp_path, [4, 2, 3], "other")
    with pytest.raises(ValueError, match=r"obs_mode is 'state'.*env=make_maniskill_env\('Counter-v1'"):
        buffer.add_demonstrations(path)
    assert buffer.demonstrations is None
    assert buffer.add_demonstrations(str(path), env=CounterEnv()) == 2
    assert "1 of 3 episodes did not succeed" in caplog.text
    _, third = buffer.demonstrations.episodes
    np.testing.assert_array_equal(buffer.demonstrations.episode_observations(third)["state"], [[12, i] for i in range(4)])


class PhotographedEnv(CounterEnv):
    """As cameras give images: the channels last."""

    def __init__(self):
        super().__init__()
        self.observation_space = spaces.Dict({**SPACE.spaces, "camera": spaces.Box(0, 255, (36, 48, 3), np.uint8)})

    def photographed(self, observation):
        picture = np.arange(36 * 48 * 3, dtype=np.int64).reshape(36, 48, 3) + int(self.state[1])
        return {**observation, "camera": (picture % 256).astype(np.uint8)}

    def reset(self, *, seed=None, options=None):
        observation, info = super().reset(seed=seed)
        return self.photographed(observation), info

    def step(self, action):
        observation, *rest = super().step(action)
        return self.photographed(observation), *rest


@pytest.mark.parametrize("where", ["replayed", "in the file"])
def test_images_as_environments_give_them(where, tmp_path):
    """SB3 puts the channels first around the training environment: neither files nor the single environment know of it."""
    env = PhotographedEnv()
    arguments = dict(replay_buffer_class=CPMBuffer, replay_buffer_kwargs=dict(challenge_ratio=0), buffer_size=100)
    buffer = SAC("MultiInputPolicy", env, policy_kwargs=dict(net_arch=[8]), device="cpu", **arguments).replay_buffer
    assert buffer.observation_space["camera"].shape == (3, 36, 48)
    path = write(tmp_path, [4], "dict", rewards=True)
    pictures = np.stack([env.reset(seed=10)[0]["camera"], *(env.step([1.0])[0]["camera"] for _ in range(4))])
    if where == "in the file":
        with h5py.File(path, "a") as file:
            file["traj_0/obs"].create_dataset("camera", data=pictures)
        env = None
    assert buffer.add_demonstrations(path, env=env) == 1
    stored = buffer.demonstrations.episode_observations(buffer.demonstrations.episodes[0])["camera"]
    np.testing.assert_array_equal(stored, pictures.transpose(0, 3, 1, 2))
    buffer.sample(4)


class FlatEnv(CounterEnv):
    """With a Box observation, as Dreamer takes it."""

    def __init__(self):
        super().__init__()
        self.observation_space = SPACE["state"]

    def reset(self, *, seed=None, options=None):
        observation, info = super().reset(seed=seed)
        return observation["state"], info

    def step(self, action):
        observation, *rest = super().step(action)
        return observation["state"], *rest


def test_replayed_where_observations_are_no_dict(tmp_path):
    buffer = Dreamer("MlpPolicy", FlatEnv(), buffer_size=100, device="cpu").replay_buffer
    assert buffer.add_demonstrations(write(tmp_path, [4]), env=FlatEnv()) == 1
    stored = buffer.demonstrations.episode_observations(buffer.demonstrations.episodes[0])["state"]
    np.testing.assert_array_equal(stored, [[10, i] for i in range(5)])


def test_a_vec_env_is_refused(tmp_path):
    with pytest.raises(ValueError, match="replayed in a single environment"):
        make().add_demonstrations(write(tmp_path, [4]), env=DummyVecEnv([CounterEnv]))


@pytest.mark.parametrize("broken", ["no json", "json", "truncated", "no file", "actions", "other json", "start"])
def test_files_that_cannot_be_read(broken, tmp_path):
    path = write(tmp_path, [4], "flat", rewards=True, actions_shape=(8,) if broken == "actions" else (1,))
    env, messages = (
        CounterEnv(),
        {"actions": "replay_trajectory", "other json": "don't belong together", "start": "starts elsewhere"},
    )
    if broken == "no json":
        path.with_suffix(".json").unlink()
    elif broken == "json":
        path.with_suffix(".json").write_text("{")
    elif broken == "truncated":
        path.write_bytes(path.read_bytes()[:500])
    elif broken == "no file":
        path.unlink()
    elif broken == "other json":
        path.with_suffix(".json").write_text(json.dumps({"episodes": [{"episode_id": 7}]}))
    elif broken == "start":
        path = write(tmp_path, [4])
        with h5py.File(path, "a") as file:
            file["traj_0"].create_dataset("env_states/actors/cube", data=np.ones((5, 13)))
        cube = types.SimpleNamespace(cpu=lambda: np.zeros((1, 13)))
        env.get_state_dict = lambda: {"actors": {"cube": cube}}
    messages |= {
        "no json": "there is no",
        "json": "does not list episodes",
        "truncated": "HDF5",
        "no file": "There is no file",
    }
    buffer = make()
    with pytest.raises(ValueError, match=messages[broken]):
        buffer.add_demonstrations(path, env=env)
    assert buffer.demonstrations is None


@pytest.mark.slow
@pytest.mark.maniskill
def test_states_are_recorded_without_a_renderer(tmp_path):
    environment = os.environ | dict.fromkeys(("VK_DRIVER_FILES", "VK_ICD_FILENAMES"), "/nonexistent.json")
    command = [sys.executable, "-m", "sb3_cpm", "demonstrate", "--env", "PickCubeState-v1", "--episodes", "1"]
    child = subprocess.run(
        [*command, "--output", str(tmp_path / "cube.h5")], env=environment, capture_output=True, text=True, timeout=600
    )
    assert child.returncode == 0 and (tmp_path / "cube.h5").exists(), child.stderr


def record_with_maniskill(folder, n_episodes):
    """By ManiSkill's own wrapper, in state mode, as its demonstrations are."""
    import mani_skill.envs  # noqa: F401
    from mani_skill.utils.wrappers.record import RecordEpisode

    from sb3_cpm.envs.maniskill.checks import choose_renderer
    from sb3_cpm.envs.maniskill.experts import make_expert

    kwargs = dict(obs_mode="state", control_mode="pd_ee_delta_pose", robot_uids="panda_wristcam", sim_backend="physx_cpu")
    env = gym.make("PickCube-v1", render_backend=choose_renderer("PickCube-v1", "state").backend, **kwargs)
    env = RecordEpisode(env, str(folder), trajectory_name="expert", save_video=False, record_reward=True)
    for seed in range(n_episodes):
        env.reset(seed=seed)
        expert, success = make_expert("PickCube-v1", env.unwrapped, 0), False
        while not success:
            *_, info = env.step(expert.act())
            success = bool(info["success"].all())
        env.flush_trajectory()
    env.close()
    return folder / "expert.h5"


@pytest.mark.slow
@pytest.mark.maniskill
def test_episodes_of_maniskill_are_replayed(tmp_path):
    """Recorded in state mode, replayed with images and clouds."""
    from sb3_cpm.envs import make_maniskill_env

    path = record_with_maniskill(tmp_path, 3)
    with h5py.File(path) as file:
        assert all(file[name]["success"][-1] for name in file)
    env = make_maniskill_env("PickCube-v1", n_points=32, goal_points=8)
    buffer = CPMBuffer(100, env.observation_space, env.action_space, device="cpu", challenge_ratio=0)
    assert buffer.add_demonstrations(path, env=env) == 3
    for episode in buffer.demonstrations.episodes:
        observations = buffer.demonstrations.episode_observations(episode)
        assert observations["hand_camera"].shape[0] == episode.length + 1 <= 51
    samples = buffer.sample(64)
    assert samples.observations["pointcloud"].shape == (64, 40, 6)
    assert samples.rewards.max() == 1.0, "success"
    other = make_maniskill_env("PickCube-v1", obs_mode="state", control_mode="pd_joint_delta_pos")
    with pytest.raises(ValueError, match=r"actions of shape \(7,\) \(controller pd_ee_delta_pose\).*replay_trajectory"):
        CPMBuffer(100, other.observation_space, other.action_space, device="cpu").add_demonstrations(path, env=other)
    other.close()
    env.close()
