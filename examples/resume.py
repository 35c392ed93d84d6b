"""A run that can be killed at any moment: the same command goes on. `python examples/resume.py`"""

import argparse
from pathlib import Path

import gymnasium as gym
from stable_baselines3 import SAC

from sb3_cpm import ChallengerCallback, CheckpointCPMCallback, CPMBuffer, resume
from sb3_cpm.envs import DictObservation


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=3000, help="of the whole run, whatever has been done of it")
    parser.add_argument("--folder", type=Path, default=Path("runs/resumed"))
    args = parser.parse_args()

    env = DictObservation(gym.make("Pendulum-v1"))
    if args.folder.exists():
        model, challenger = resume(args.folder, env)
        print(f"going on at step {model.num_timesteps}")
    else:
        model = SAC("MultiInputPolicy", env, replay_buffer_class=CPMBuffer, learning_starts=300, buffer_size=20_000, seed=0)
        challenger = ChallengerCallback()
    # everything: model, buffer with its challenges, challenger, random numbers; exact: as an unbroken run, bit for bit
    checkpoints = CheckpointCPMCallback(200, args.folder, exact=True)
    left = args.steps - model.num_timesteps
    if left > 0:
        model.learn(left, callback=[challenger, checkpoints], reset_num_timesteps=False)
    print(f"{model.num_timesteps} steps are done")


if __name__ == "__main__":
    main()
