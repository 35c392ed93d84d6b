"""Your own environment with a challenger: a pendulum that pays only near the top. `python examples/own_environment.py`"""

import argparse

import gymnasium as gym
import numpy as np
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_cpm import ChallengerCallback, CPMBuffer
from sb3_cpm.envs import DictObservation


class SparsePendulum(gym.Wrapper):
    """Pendulum-v1 whose reward is 1 while it stands, and 0 otherwise."""

    def step(self, action):
        observation, _, terminated, truncated, info = self.env.step(action)
        reward = float(observation[0] > 0.95 and abs(observation[2]) < 1.0)
        return observation, reward, terminated, truncated, info


def make_env() -> gym.Env:
    env = gym.wrappers.RescaleAction(gym.make("Pendulum-v1"), np.float32(-1), np.float32(1))
    return DictObservation(SparsePendulum(env))  # the challenger reads Dicts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=6000)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()

    env = make_vec_env(make_env, n_envs=1, seed=args.seed)
    model = SAC(
        "MultiInputPolicy",
        env,
        replay_buffer_class=CPMBuffer,
        learning_starts=400,  # more than one episode of 200 steps
        learning_rate=1e-3,
        buffer_size=20_000,
        seed=args.seed,
    )
    model.learn(args.steps, callback=ChallengerCallback())
    mean, _ = evaluate_policy(model, make_vec_env(make_env, n_envs=1, seed=1_000_000), n_eval_episodes=5)
    print(f"it stands for {mean:.0f} of 200 steps")


if __name__ == "__main__":
    main()
