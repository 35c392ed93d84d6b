"""ONNX graphs: onnxruntime gives the actions that model.predict() gives."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import DQN, PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import sb3_cpm.envs.toy  # noqa: F401  (registers CPMToy-v0)
from sb3_cpm import PointNetExtractor, PointNetPolicy
from sb3_cpm.__main__ import main
from sb3_cpm.envs import DictObservation
from sb3_cpm.export import export_onnx
from sb3_cpm.policies import RLPDPolicy, SimbaPolicy
from sb3_cpm.run import train

pytest.importorskip("onnxscript", reason='needs the extra "onnx"')
ort = pytest.importorskip("onnxruntime", reason='needs the extra "onnx"')
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]  # torch's exporter warns of its own parts

EVERYTHING = {
    "features_extractor_class": PointNetExtractor,
    "features_extractor_kwargs": {"keys": ["camera", "pointcloud", "state"]},
}
TINY: dict[str, Any] = {"buffer_size": 300, "learning_starts": 100, "seed": 0, "device": "cpu"}


def toy() -> gym.Env:
    return gym.make("CPMToy-v0")


def actions_of(path: Path, observations: dict[str, np.ndarray]) -> np.ndarray:
    return ort.InferenceSession(str(path)).run(["action"], observations)[0]


def normalized() -> BaseAlgorithm:
    env = VecNormalize(DummyVecEnv([lambda: gym.make("Pendulum-v1")]), norm_reward=False)
    return SAC("MlpPolicy", env, **TINY).learn(110)


@pytest.mark.parametrize(
    "make",
    [
        lambda: SAC(PointNetPolicy, toy(), policy_kwargs={"critics_extractor": True}, **TINY),
        lambda: SAC(RLPDPolicy, toy(), **TINY),
        lambda: SAC(SimbaPolicy, gym.make("Pendulum-v1"), **TINY),
        lambda: TD3("MultiInputPolicy", toy(), policy_kwargs=EVERYTHING, **TINY),
        lambda: PPO("MultiInputPolicy", toy(), policy_kwargs=EVERYTHING, seed=0, device="cpu"),
        lambda: PPO("MlpPolicy", gym.make("Pendulum-v1"), seed=0, device="cpu"),
        normalized,
    ],
    ids=["SAC-cloud", "RLPD", "SimBa", "TD3-all", "PPO-all", "PPO-vector", "VecNormalize"],
)
def test_actions_are_equal(make: Any, tmp_path: Path) -> None:
    model = make()
    inputs = export_onnx(model, tmp_path / "player.onnx")
    space = model.observation_space
    space.seed(0)
    for n in (1, 5):
        samples = [space.sample() for _ in range(n)]
        if isinstance(space, gym.spaces.Dict):
            observations: Any = {key: np.stack([one[key] for one in samples]) for key in space.spaces}
            given = {key: observations[key] for key in inputs}
        else:
            observations = np.stack(samples)
            given = {"observation": observations}
        normalize = model.get_vec_normalize_env()
        seen = observations if normalize is None else normalize.normalize_obs(observations)
        expected, _ = model.predict(seen, deterministic=True)
        np.testing.assert_allclose(actions_of(tmp_path / "player.onnx", given), expected, atol=1e-5)


def test_a_run_is_exported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    kwargs = {"normalize": {"norm_obs": True, "norm_reward": False}, "learning_starts": 250}
    settings: dict[str, Any] = {"env": "Pendulum-v1", "agent": "sac", "steps": 300, "evaluations": 0, "video": False}
    train(run_folder=str(tmp_path / "run"), model_kwargs=kwargs, **settings)
    assert main(["export", str(tmp_path / "run")]) == 0
    said = capsys.readouterr().out
    assert f"{tmp_path / 'run' / 'player.onnx'}: state (batch, 3) -> action" in said
    env = VecNormalize.load(
        str(tmp_path / "run" / "vecnormalize.pkl"), DummyVecEnv([lambda: DictObservation(gym.make("Pendulum-v1"))])
    )
    model = SAC.load(tmp_path / "run" / "model.zip", device="cpu")
    observation = np.array([[0.3, -0.4, 2.0]], np.float32)
    expected, _ = model.predict(env.normalize_obs({"state": observation}), deterministic=True)
    given = actions_of(tmp_path / "run" / "player.onnx", {"state": observation})
    np.testing.assert_allclose(given, expected, atol=1e-5)


def test_bad_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ValueError, match="for continuous actions.*Discrete"):
        export_onnx(DQN("MlpPolicy", gym.make("CartPole-v1"), buffer_size=10), tmp_path / "player.onnx")
    assert main(["export", str(tmp_path)]) == 1
    assert "there is no config.yml. Expected the folder of a run" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
