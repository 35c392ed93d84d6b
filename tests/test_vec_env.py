"""
ManiSkillVecEnv: the batched code with several environments on a stand-in for the simulation (tests/batched_fake.py), and the
real one with the single environment that a CPU can simulate.
"""

import contextlib
import pickle
import warnings
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from batched_fake import FakeManiSkill
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecCheckNan, VecEnv, VecNormalize

from sb3_cpm.envs import ManiSkillVecEnv, make_maniskill_env, make_maniskill_vec_env
from sb3_cpm.envs.maniskill import simulation
from sb3_cpm.envs.maniskill.batch import ManiSkillBatch
from sb3_cpm.envs.maniskill.clouds import CloudSettings
from sb3_cpm.envs.maniskill.visuals import Visuals
from sb3_cpm.extractors import PointNetPolicy

Tree = dict[str, np.ndarray]


@pytest.fixture(params=["host", "device"])
def where(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Take the tensors of the stand-in for what they are, and for those of a GPU."""
    if request.param == "device":
        monkeypatch.setattr("sb3_cpm.envs.maniskill.observations._on_host", lambda leaf: False)


def fake(num_envs: int = 3, limit: int = 6, n_points: int = 20, **kwargs: Any) -> ManiSkillVecEnv:
    arguments: dict[str, Any] = {
        "cameras": ["camera"],
        "obs_mode": "visual",
        "cloud": CloudSettings(n_points, goal_points=4, frame="base", labels=True),
        "max_episode_steps": limit,
        "ignore_terminations": False,
        "visuals": Visuals(),
        **kwargs,
    }
    return ManiSkillVecEnv(ManiSkillBatch(FakeManiSkill(num_envs), **arguments))


def assert_equal(left: Tree, right: Tree) -> None:
    assert left.keys() == right.keys()
    for key in left:
        np.testing.assert_array_equal(left[key], right[key], err_msg=key)


def row(observations: Tree, i: int) -> Tree:
    return {key: value[i] for key, value in observations.items()}


def inner(env: VecEnv) -> FakeManiSkill:
    return env.get_attr("unwrapped")[0]


# ---------------------------------------------------------------------- several environments, fake simulation
def test_spaces_hold_the_observations_of_one() -> None:
    env = fake()
    assert {key: space.shape for key, space in env.observation_space.spaces.items()} == {  # type: ignore[attr-defined]
        "camera": (36, 36, 3),
        "pointcloud": (24, 7),
        "state": (13,),
    }
    observations = env.reset()
    assert isinstance(observations, dict)
    for i in range(3):
        assert env.observation_space.contains(row(observations, i))
    assert inner(env)._sensors == {"camera": None}  # the other one is not rendered


@pytest.mark.usefixtures("where")
def test_what_was_given_away_never_changes() -> None:
    env = fake()
    given: list[Any] = [env.reset()]
    given += [env.step(np.ones((3, 2), dtype=np.float32)) for _ in range(14)]  # over the ends of two episodes
    kept = pickle.dumps(given)
    for _ in range(14):
        env.step(-np.ones((3, 2), dtype=np.float32))
    assert str(given) == str(pickle.loads(kept))


@pytest.mark.usefixtures("where")
def test_an_episode_ends_alone_with_its_true_last_observation() -> None:
    env = fake(limit=8)
    env.seed(1)
    env.reset()
    task = inner(env)
    task.goal[1, :2] = task.place[1]  # the second environment succeeds in its first step
    observations, _, dones, infos = env.step(np.zeros((3, 2), dtype=np.float32))
    assert dones.tolist() == [False, True, False]
    terminal = infos[1]["terminal_observation"]
    # it was at its goal; the observation that comes with it is the first of the next episode
    np.testing.assert_array_equal(terminal["state"][:2], terminal["state"][9:11])
    assert not np.isclose(observations["state"][1, :2], observations["state"][1, 9:11], atol=0.01).all()  # type: ignore
    np.testing.assert_array_equal(observations["state"][:, :2], task.place)  # type: ignore[call-overload,index]
    assert infos[1]["is_success"] is True and infos[1]["TimeLimit.truncated"] is False
    assert "terminal_observation" not in infos[0] and "episode" not in infos[0] and "episode" not in infos[2]
    assert [info["elapsed_steps"] for info in env.reset_infos] == [0, 0, 0]
    # the others go on to their limit, the second for as long as its second episode lasts
    ends = [env.step(np.zeros((3, 2), dtype=np.float32))[2].tolist() for _ in range(8)]
    assert ends == [[False] * 3] * 6 + [[True, False, True], [False, True, False]]


def test_statistics_of_an_episode_are_numbers_once_per_episode() -> None:
    env = fake(num_envs=2, limit=4)
    env.reset()
    rewards, found = [], []
    for _ in range(12):
        _, reward, _, infos = env.step(np.full((2, 2), 0.3, dtype=np.float32))
        rewards.append(reward)
        found += [(i, info["episode"]) for i, info in enumerate(infos) if "episode" in info]
        for info in infos:
            assert type(info["TimeLimit.truncated"]) is bool and type(info["is_success"]) is bool
            assert type(info["elapsed_steps"]) is int and info["place"].shape == (2,)
    assert len(found) == 6
    for number, (i, episode) in enumerate(found):
        own = np.array(rewards)[4 * (number // 2) : 4 * (number // 2) + 4, i]
        assert episode["r"] == pytest.approx(own.sum(), abs=1e-5) and episode["l"] == 4
        assert {key: type(value) for key, value in episode.items()} == {"r": float, "l": int, "t": float}


def test_partial_resets_start_somewhere_new_each_time() -> None:
    """ManiSkill seeds torch with the seed of environment 0, also when that one is in the middle of its episode."""
    env = fake(limit=100)
    env.seed(0)
    env.reset()
    task, starts = inner(env), []
    for _ in range(4):
        task.goal[2, :2] = task.place[2]
        observations, *_ = env.step(np.zeros((3, 2), dtype=np.float32))
        starts.append(tuple(observations["state"][2]))  # type: ignore[call-overload,index]
    assert len(set(starts)) == 4 and len(set(task.torch_seeds)) == len(task.torch_seeds)


def test_seeds_rule_the_whole_run() -> None:
    def run(seed: int) -> list[Tree]:
        env = fake(limit=3)
        env.seed(seed)
        frames: list[Any] = [env.reset()]
        actions = np.random.default_rng(0).uniform(-1, 1, (10, 3, 2)).astype(np.float32)
        return frames + [env.step(action)[0] for action in actions]

    for one, other in zip(run(5), run(5), strict=True):
        assert_equal(one, other)
    with pytest.raises(AssertionError):
        assert_equal(run(5)[0], run(6)[0])
    # a seed with a start state rules the episodes after that one
    env = fake(limit=3)
    env.seed(5)
    env.reset()
    state = env.env_method("get_state")[0]
    seconds = []
    for seed in (8, 8, 9):
        env.seed(seed)
        env.set_options({"state": state})
        env.reset()
        seconds.append([env.step(np.zeros((3, 2), dtype=np.float32))[0] for _ in range(3)][-1])
    assert_equal(seconds[0], seconds[1])  # type: ignore[arg-type]
    assert (seconds[0]["state"] != seconds[2]["state"]).any()  # type: ignore[call-overload,index]
    # without seed(), by NumPy's generator, which set_random_seed seeds; nothing else is drawn from anybody
    env, states = fake(), []
    for _ in range(2):
        np.random.seed(0)
        env = fake()
        before = th.random.get_rng_state()
        states.append(env.reset())
        assert th.equal(before, th.random.get_rng_state())
    assert_equal(*states)  # type: ignore[arg-type]


def test_one_copy_to_the_host_per_step(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_cpm.envs.maniskill.observations._on_host", lambda leaf: False)
    env = fake(limit=5)
    env.reset()
    transfers: list[int] = []
    to_cpu = th.Tensor.cpu
    monkeypatch.setattr(th.Tensor, "cpu", lambda tensor: (transfers.append(1), to_cpu(tensor))[1])
    renders = inner(env).scene.renders
    for _ in range(4):
        env.step(np.zeros((3, 2), dtype=np.float32))
    assert len(transfers) == 4 and inner(env).scene.renders == renders + 4


def test_members_are_reached_one_by_one() -> None:
    env = fake()
    env.reset()
    assert env.get_attr("render_mode") == ["rgb_array"] * 3 and env.render_mode == "rgb_array"
    assert env.get_attr("max_episode_steps", [0, 2]) == [6, 6]
    assert [spec.max_episode_steps for spec in env.get_attr("spec")] == [6] * 3
    env.set_attr("marker", 5, indices=[1])
    assert env.get_attr("marker", 1) == [5]
    assert env.has_attr("spec") and not env.has_attr("marker") and not env.has_attr("nothing")
    with pytest.raises(AttributeError):
        env.get_attr("marker")
    assert env.env_method("render", indices=0)[0].shape == (36, 36, 3)
    assert len(env.get_images()) == 3
    frame = env.render()
    assert frame is not None and frame.shape == (72, 72, 3)
    assert env.env_is_wrapped(Monitor) == [True] * 3 and env.env_is_wrapped(gym.wrappers.TimeLimit, [0]) == [False]


@pytest.mark.usefixtures("where")
def test_stored_states_start_the_environments_they_are_meant_for() -> None:
    actions = np.random.default_rng(1).uniform(-1, 1, (6, 3, 2)).astype(np.float32)
    env = fake(limit=20)
    env.seed(0)
    env.reset()
    for action in actions[:3]:
        env.step(action)
    states = pickle.loads(pickle.dumps(env.env_method("get_state")))
    expected = [env.step(action) for action in actions[3:]]
    # in an order of their own, in another simulation; the one in the middle starts anywhere
    other = fake(limit=20)
    other.seed(77)
    other.set_options([{"state": states[2]}, {}, {"state": states[0]}])
    other.reset()
    for action, (observations, rewards, _, infos) in zip(actions[3:], expected, strict=True):
        mine = other.step(action[[2, 1, 0]])
        assert isinstance(mine[0], dict) and isinstance(observations, dict)
        for i, j in ((0, 2), (2, 0)):
            assert_equal(row(mine[0], i), row(observations, j))
            assert mine[1][i] == rewards[j] and mine[3][i]["elapsed_steps"] == infos[j]["elapsed_steps"]
    # before an episode ends: the next one starts there, the others do not notice
    other.env_method("start_next_from", states[1], indices=[1])
    inner(other).goal[1, :2] = inner(other).place[1] = inner(other).agent.target[1] = 0.5
    observations, _, dones, _ = other.step(np.zeros((3, 2), dtype=np.float32))
    assert dones.tolist() == [False, True, False] and isinstance(observations, dict)
    assert other.reset_infos[1]["elapsed_steps"] == 3
    np.testing.assert_array_equal(observations["state"][1, :2], states[1]["simulation"]["actors"]["point"])
    np.testing.assert_array_equal(inner(other).agent.target[1], states[1]["controller"]["arm"]["target"])


def test_states_that_do_not_fit() -> None:
    env = fake()
    env.reset()
    state = env.env_method("get_state")[0]
    for wrong, message in (({"x": 1}, "what get_state"), ({**state, "env_id": "Lift-v1"}, "of Lift-v1, it cannot start")):
        env.set_options([{"state": wrong}, {}, {}])
        with pytest.raises(ValueError, match=message):
            env.reset()
        with pytest.raises(ValueError, match=message):
            env.env_method("start_next_from", wrong, indices=[0])
    env.set_options([{"state": {**state, "simulation": {"actors": {"other": np.zeros(2)}}}}, {}, {}])
    with pytest.raises(ValueError, match="does not fit the scene"):
        env.reset()
    env.set_options([{"speed": 1}, {"speed": 2}, {"speed": 1}])
    with pytest.raises(ValueError, match="the same options"):
        env.reset()


def test_a_simulation_that_breaks_down_costs_one_episode() -> None:
    env = fake()
    env.reset()
    before, *_ = env.step(np.zeros((3, 2), dtype=np.float32))
    inner(env).place[1] = th.nan
    with pytest.warns(UserWarning, match="not finite in step 2 of the episode with seed"):
        observations, rewards, dones, infos = env.step(np.zeros((3, 2), dtype=np.float32))
    assert dones.tolist() == [False, True, False] and rewards[1] == 0 and np.isfinite(rewards).all()
    assert infos[1]["TimeLimit.truncated"] and infos[1]["diverged"] and "diverged" not in infos[0]
    assert isinstance(before, dict) and isinstance(observations, dict)
    assert_equal(infos[1]["terminal_observation"], row(before, 1))
    assert all(np.isfinite(value).all() for value in observations.values())
    with pytest.raises(ValueError, match="Actions must be finite"):
        env.step(np.full((3, 2), np.nan, dtype=np.float32))


def test_a_stale_grasp_is_not_seen_at_the_start() -> None:
    env = fake(limit=2)
    env.reset()
    grasp = slice(12, 13)
    for step in range(4):
        observations, _, dones, infos = env.step(np.ones((3, 2), dtype=np.float32))
        assert isinstance(observations, dict)
        assert all(info["is_grasped"] is True for info in infos)
        assert (observations["state"][:, grasp] == (0 if step % 2 else 1)).all() and dones.all() == bool(step % 2)


def test_sb3_trains_with_several_environments() -> None:
    env = VecNormalize(VecCheckNan(fake(num_envs=4), raise_exception=True), norm_obs_keys=["state"])
    model = PPO("MultiInputPolicy", env, n_steps=8, batch_size=16, n_epochs=1, device="cpu", policy_kwargs={**SMALL})
    model.learn(64)
    assert len(model.ep_info_buffer or []) == 4 * (64 // 4 // 6)


SMALL: dict[str, Any] = {"net_arch": [16]}


# ---------------------------------------------------------------------- requests that cannot be fulfilled
@pytest.mark.parametrize(
    ("num_envs", "backend", "kwargs", "message"),
    [
        (0, "auto", {}, "num_envs must be"),
        (2, "physx_cpu", {}, "one environment per process"),
        (2, "tpu", {}, "one of auto, physx_cpu, physx_cuda"),
        (2, "physx_cuda", {"reconfiguration_freq": 1}, "Leave it at 0"),
    ],
)
def test_simulations_that_cannot_be(num_envs: int, backend: str, kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        simulation.choose_simulation(num_envs, backend, kwargs)


def test_pictures_of_a_gpu_simulation_need_a_gpu_renderer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simulation, "check_gpu_simulation", lambda name: None)
    assert simulation.choose_simulation(2, "auto", {}, "cpu") == ("physx_cuda", {"reconfiguration_freq": 0})
    with pytest.raises(RuntimeError, match="no Vulkan driver of the GPU"):
        simulation.choose_simulation(2, "physx_cuda:0", {}, "cpu", visual=True)


@pytest.mark.skipif(th.cuda.is_available(), reason="there is a GPU")
@pytest.mark.maniskill
def test_without_a_gpu() -> None:
    with pytest.raises(RuntimeError, match="needs an NVIDIA GPU that PyTorch can use.*physx_cpu"):
        make_maniskill_vec_env("PickCube-v1", 8)


@pytest.mark.maniskill
def test_without_the_gpu_library(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    import requests
    import sapien

    def offline(url: str) -> None:
        raise requests.ConnectionError("no network")

    monkeypatch.setattr(th.cuda, "is_available", lambda: True)
    monkeypatch.setattr(th.cuda, "device_count", lambda: 1)
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    monkeypatch.setattr(requests, "get", offline)
    monkeypatch.setattr(sapien.physx, "is_gpu_enabled", lambda: False)
    with pytest.raises(RuntimeError, match=r"libPhysXGpu_64.so. It is not there \(no network\).*unzip .* into .*physx"):
        simulation.check_gpu_simulation()
    simulation.gpu_library().write_text("half a download")
    with pytest.raises(RuntimeError, match="It is there, but cannot be loaded.*delete it"):
        simulation.check_gpu_simulation()
    with pytest.raises(RuntimeError, match="sees 1"):
        simulation.check_gpu_simulation("physx_cuda:1")


# ---------------------------------------------------------------------- the real simulation, one environment
@pytest.fixture(scope="module")
def real() -> Iterator[ManiSkillVecEnv]:
    env = make_maniskill_vec_env("PickCube-v1", sim_backend="physx_cpu", max_episode_steps=5, n_points=64)
    yield env
    env.close()


@pytest.mark.maniskill
def test_the_same_as_the_single_environment(real: ManiSkillVecEnv) -> None:
    single = DummyVecEnv([lambda: Monitor(make_maniskill_env("PickCube-v1", max_episode_steps=5, n_points=64))])
    for env in (real, single):
        env.seed(3)
    assert_equal(real.reset(), single.reset())  # type: ignore[arg-type]
    assert real.observation_space == single.observation_space and real.action_space == single.action_space
    for action in np.random.default_rng(0).uniform(-1, 1, (12, 1, 7)).astype(np.float32):
        mine, theirs = real.step(action), single.step(action)
        assert_equal(mine[0], theirs[0])  # type: ignore[arg-type]
        assert mine[1] == theirs[1] and mine[2] == theirs[2]
        info, other = mine[3][0], theirs[3][0]
        assert info.keys() == other.keys()
        if mine[2]:
            assert_equal(info.pop("terminal_observation"), other.pop("terminal_observation"))
            episode, their_episode = info.pop("episode"), other.pop("episode")
            assert (episode["r"], episode["l"]) == (pytest.approx(their_episode["r"], abs=1e-5), their_episode["l"])
        assert info == other
    single.close()


class AsGym(gym.Env):
    """One environment of a VecEnv as gymnasium sees it, for SB3's checker."""

    def __init__(self, vec_env: VecEnv):
        self.vec_env = vec_env
        self.observation_space, self.action_space = vec_env.observation_space, vec_env.action_space
        self.render_mode = vec_env.render_mode

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Tree, dict[str, Any]]:
        if seed is not None:
            self.vec_env.seed(seed)
        return row(self.vec_env.reset(), 0), self.vec_env.reset_infos[0]  # type: ignore[arg-type]

    def step(self, action: np.ndarray) -> tuple[Tree, float, bool, bool, dict[str, Any]]:
        observations, rewards, dones, infos = self.vec_env.step(action[None])
        return row(observations, 0), float(rewards[0]), bool(dones[0]), False, infos[0]  # type: ignore[arg-type]

    def render(self) -> Any:
        return self.vec_env.render()


@pytest.mark.maniskill
def test_checker_of_sb3(real: ManiSkillVecEnv) -> None:
    with quietly():
        check_env(AsGym(real))
        check_env(AsGym(fake(num_envs=1)))


@contextlib.contextmanager
def quietly() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # that a cloud is no image, that PPO likes the CPU
        yield


def small(algorithm: type[BaseAlgorithm], policy: Any, env: VecEnv, **kwargs: Any) -> BaseAlgorithm:
    own: dict[str, Any] = {"n_steps": 8, "batch_size": 8, "n_epochs": 1}
    if algorithm is SAC:
        own = {"learning_starts": 6, "batch_size": 8, "buffer_size": 100}
    return algorithm(policy, env, device="cpu", policy_kwargs={**SMALL, **kwargs}, **own)


@pytest.mark.maniskill
@pytest.mark.parametrize("algorithm", [PPO, SAC])
@pytest.mark.parametrize("keys", ["state", "rgb", "cloud"])
def test_sb3_trains_on_every_kind_of_observation(algorithm: type[BaseAlgorithm], keys: str) -> None:
    arguments: dict[str, Any] = {
        "state": {"obs_mode": "state"},
        "rgb": {"n_points": 0, "image_size": 36},  # the smallest that SB3's own convolutions take
        "cloud": {"n_points": 32, "goal_points": 8, "cameras": ["base_camera"], "image_size": 36},
    }[keys]
    env = make_maniskill_vec_env("PickCube-v1", 1, seed=0, max_episode_steps=5, **arguments)
    with quietly():
        model = small(algorithm, "MultiInputPolicy", env)
        model.learn(16)
    assert model.num_timesteps >= 16
    assert [episode["l"] for episode in model.ep_info_buffer or []] == [5, 5, 5]
    env.close()


@pytest.mark.slow
@pytest.mark.maniskill
def test_stock_worker_processes() -> None:
    env = make_vec_env(
        make_maniskill_env,  # type: ignore[arg-type]
        n_envs=2,
        seed=10,
        env_kwargs={"env_id": "PickCube-v1", "max_episode_steps": 4, "n_points": 32},
        vec_env_cls=SubprocVecEnv,
    )
    alone = make_maniskill_vec_env("PickCube-v1", seed=11, max_episode_steps=4, n_points=32)
    mine, theirs = alone.reset(), env.reset()
    for action in np.random.default_rng(0).uniform(-1, 1, (6, 2, 7)).astype(np.float32):
        assert_equal(row(mine, 0), row(theirs, 1))  # type: ignore[arg-type]
        mine, theirs = alone.step(action[1:])[0], env.step(action)[0]
    with quietly():
        small(SAC, PointNetPolicy, env).learn(16)
    env.close(), alone.close()


@pytest.mark.maniskill
def test_points_by_role() -> None:
    env = make_maniskill_env("StackCube-v1", n_points=400, point_labels="roles", image_size=64)
    seen = env.reset(seed=1)[0]["pointcloud"]
    task: Any = env.unwrapped
    assert set(seen[:, 6]) == {0.0, 1.0, 3.0}
    for role, cube in ((1, task.cubeA), (3, task.cubeB)):
        distances = np.linalg.norm(seen[seen[:, 6] == role, :3] - cube.pose.p[0].numpy(), axis=1)
        assert (distances < 0.02 * 3**0.5 + 0.002).all(), "the cube to be moved is 1, the other one 3"
    env.close()
    with pytest.raises(ValueError, match="RollBall-v1 does not say what is to be acted on.*point_labels=True"):
        make_maniskill_env("RollBall-v1", point_labels="roles")


@pytest.mark.maniskill
@pytest.mark.parametrize("frame", ["base", "end_effector"])
def test_clouds_in_other_frames_with_labels(frame: str) -> None:
    kwargs: dict[str, Any] = {"n_points": 64, "goal_points": 4, "point_labels": True, "point_sampling": "farthest"}
    make = partial(make_maniskill_env, "PickCube-v1", **kwargs)
    world, local = make(), make(point_frame=frame)
    seen, moved = (env.reset(seed=1)[0]["pointcloud"] for env in (world, local))
    task: Any = world.unwrapped
    pose = (task.agent.robot if frame == "base" else task.agent.tcp).pose.to_transformation_matrix()[0].numpy()
    np.testing.assert_allclose(moved[:, :3] @ pose[:3, :3].T + pose[:3, 3], seen[:, :3], atol=1e-5)
    np.testing.assert_array_equal(moved[:, 3:], seen[:, 3:])
    cube = seen[seen[:, 6] == 1]
    assert set(seen[:, 6]) == {-1.0, 0.0, 1.0} and len(cube) > 3
    assert (np.linalg.norm(cube[:, :3] - task.cube.pose.p[0].numpy(), axis=1) < 0.02 * 3**0.5 + 0.002).all()
    world.close(), local.close()
