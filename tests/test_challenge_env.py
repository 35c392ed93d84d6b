"""The player is told which challenge it plays."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from sb3_contrib import TQC
from stable_baselines3 import DDPG, SAC, TD3
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_cpm import ChallengerCallback, ChallengeVecEnv, CPMBuffer
from sb3_cpm.agents import load_agent
from sb3_cpm.challenge_env import without_challenge
from sb3_cpm.envs import DictObservation, ToyEnv
from sb3_cpm.packing import unpack


def pendulum(n_envs: int = 1, normalize: bool = False) -> ChallengeVecEnv:
    venv = make_vec_env("Pendulum-v1", n_envs=n_envs, seed=0, wrapper_class=DictObservation)
    return ChallengeVecEnv(VecNormalize(venv) if normalize else venv)


def trained(env: Any, algorithm: Any = SAC, steps: int = 900, callbacks: Any = (), **buffer_kwargs: Any) -> Any:
    model = algorithm(
        "MultiInputPolicy",
        env,
        replay_buffer_class=CPMBuffer,
        replay_buffer_kwargs=buffer_kwargs,
        policy_kwargs={"net_arch": [16]},
        learning_starts=400,
        batch_size=32,
        train_freq=50,
        seed=0,
        device="cpu",
    )
    return model.learn(steps, callback=[ChallengerCallback(train_freq=100), *callbacks])


@pytest.mark.parametrize("normalize", [False, True])
def test_rows_of_challenges_have_their_goal_and_rows_of_the_task_have_zeros(normalize: bool) -> None:
    model = trained(pendulum(2, normalize), mix="row", challenge_ratio=0.5)
    buffer = model.replay_buffer
    assert buffer.challenges and "challenge" not in buffer.observations
    batch = buffer.sample(64, model.get_vec_normalize_env())
    posed = batch.observations["challenge"].numpy()
    assert posed.shape == (64, 4) and (posed == batch.next_observations["challenge"].numpy()).all()
    assert (posed[:32] == 0).all() and (posed[32:, 0] == 1).all()
    goals = []
    for challenge in buffer.challenges:
        goal = buffer.episode_observations(challenge.episode)["state"][challenge.goal + 1]
        goals.append(model.get_vec_normalize_env().normalize_obs({"state": goal})["state"] if normalize else goal)
    assert all(np.isclose(row, goals, atol=1e-6).all(axis=1).any() for row in posed[32:, 1:])
    assert len({tuple(row) for row in posed[32:, 1:].round(5).tolist()}) == len(goals)


def test_the_challenger_never_reads_it_and_nothing_of_it_is_stored() -> None:
    told, plain = (
        SAC("MultiInputPolicy", env, replay_buffer_class=CPMBuffer, learning_starts=400, device="cpu")
        for env in (pendulum(), pendulum().venv)
    )
    assert told.replay_buffer.nbytes == plain.replay_buffer.nbytes
    callback = ChallengerCallback()
    told.learn(10, callback=callback)
    assert callback.challenger is not None and callback.challenger.keys == ("state",)


@pytest.mark.parametrize("algorithm", [TD3, DDPG, TQC])
def test_other_algorithms(algorithm: Any) -> None:
    model = trained(pendulum(), algorithm, steps=450)
    assert model.predict(pendulum().reset())[0].shape == (1, 1)


def test_goals_of_the_keys_that_are_named() -> None:
    env = ChallengeVecEnv(DummyVecEnv([ToyEnv]), goal=["state"])
    assert env.observation_space["challenge"].shape == (1 + env.observation_space["state"].shape[0],)
    buffer = CPMBuffer(1000, env.observation_space, env.action_space, env, "cpu", challenge_ratio=0)
    assert buffer.challenge_keys == ("state",)


def test_save_and_load(tmp_path: Path) -> None:
    model = trained(pendulum(), mix="row", challenge_ratio=0.5)
    model.save(tmp_path / "model")
    model.replay_buffer.save(tmp_path / "buffer.npz")
    model.save_replay_buffer(tmp_path / "buffer.pkl")
    loaded = SAC.load(tmp_path / "model", env=pendulum(), device="cpu")
    loaded.replay_buffer = CPMBuffer.load(tmp_path / "buffer.npz", env=loaded.get_env())
    again = SAC.load(tmp_path / "model", env=pendulum(), device="cpu")
    again.load_replay_buffer(tmp_path / "buffer.pkl", truncate_last_traj=False)
    batches = []
    for one in (model, loaded, again):
        np.random.seed(0)
        batches.append(one.replay_buffer.sample(32).observations["challenge"])
    assert (batches[0] == batches[1]).all() and (batches[0] == batches[2]).all() and batches[0][-1, 0] == 1


def test_evaluation_and_plain_observations(tmp_path: Path) -> None:
    evaluation = EvalCallback(pendulum(), n_eval_episodes=1, eval_freq=200, log_path=str(tmp_path), verbose=0)
    model = trained(pendulum(), steps=450, callbacks=[evaluation])
    assert np.isfinite(evaluation.last_mean_reward)
    observation, _ = DictObservation(gym.make("Pendulum-v1")).reset(seed=0)
    action, _ = model.predict(without_challenge(observation, model.observation_space), deterministic=True)
    several = {"state": np.stack([observation["state"]] * 3)}
    actions, _ = model.predict(without_challenge(several, model.observation_space), deterministic=True)
    assert action.shape == (1,) and np.allclose(actions, action, atol=1e-6)
    with pytest.raises(ValueError, match="no key 'challenge'"):
        without_challenge(observation, spaces.Dict({"state": model.observation_space["state"]}))


def test_last_observations_have_the_key() -> None:
    env = pendulum()
    env.reset()
    for _ in range(200):
        _, _, dones, infos = env.step(np.zeros((1, 1)))
    assert dones[0] and (infos[0]["terminal_observation"]["challenge"] == 0).all()


def test_agents_of_files() -> None:
    agent = load_agent("cpm_sac", "CPMToy-v0", {"vec_env_wrapper": "sb3_cpm.ChallengeVecEnv"})
    built = agent.build(seed=0, device="cpu")
    assert built.model.replay_buffer.challenge_keys == ("state",)
    assert "challenge" in built.make_eval_env().observation_space.spaces
    assert unpack(built.model.replay_buffer._state()[0]["arguments"]["challenge_keys"]) == ("state",)


def make(**kwargs: Any) -> ChallengeVecEnv:
    return ChallengeVecEnv(make_vec_env("Pendulum-v1", wrapper_class=DictObservation), **kwargs)


@pytest.mark.parametrize(
    "wrong, message",
    [
        (lambda: ChallengeVecEnv(gym.make("Pendulum-v1")), "is put around a VecEnv, not around .*make_vec_env"),
        (lambda: ChallengeVecEnv(make_vec_env("Pendulum-v1")), "needs Dict observations.*DictObservation"),
        (lambda: ChallengeVecEnv(make()), "have a key 'challenge' already"),
        (lambda: make(goal=["stat"]), "names 'stat', which is no vector.*'state'"),
        (lambda: make(goal="state"), r"a list of keys: goal=\['state'\]"),
        (lambda: ChallengeVecEnv(DummyVecEnv([lambda: ToyEnv(keys=("camera",))])), "there are none among"),
        (lambda: trained(VecNormalize(make())), "put ChallengeVecEnv around VecNormalize"),
    ],
)
def test_bad_input(wrong: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        wrong()
