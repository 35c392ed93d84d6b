"""Point clouds for the player: one PointNet for actor and critic. `python examples/clouds.py`"""

import argparse

import gymnasium as gym
from stable_baselines3 import SAC
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

import sb3_cpm.envs.toy  # noqa: F401  (registers CPMToy-v0: a camera of 32x32, a point cloud, a state)
from sb3_cpm import ChallengerCallback, CPMBuffer, PointNetPolicy
from sb3_cpm.run.evaluation import evaluate, means


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=2000)
    args = parser.parse_args()

    # the robot's own: make_maniskill_env("PickCube-v1", point_frame="end_effector")
    model = SAC(
        PointNetPolicy,
        gym.make("CPMToy-v0"),
        policy_kwargs={"critics_extractor": True, "features_extractor_kwargs": {"sizes": (32, 64, 128)}},
        replay_buffer_class=CPMBuffer,
        replay_buffer_kwargs={"storage_dtypes": {"pointcloud": "float16"}},  # a third of the memory
        learning_starts=200,
        buffer_size=10_000,
        batch_size=64,
        gamma=0.9,
        seed=0,
    )
    model.learn(args.steps, callback=ChallengerCallback(), progress_bar=False)
    env = DummyVecEnv([lambda: Monitor(gym.make("CPMToy-v0"))])
    mean_return, success = means(evaluate(model, env, 20))
    print(f"return {mean_return:.1f}, success {success:.0%}")


if __name__ == "__main__":
    main()
