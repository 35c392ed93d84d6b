"""Camera images for the challenger, vectors for the player. `python examples/images.py`"""

import argparse

import gymnasium as gym
from stable_baselines3 import SAC

import sb3_cpm.envs.toy  # noqa: F401  (registers CPMToy-v0: a camera of 32x32, a point cloud, a state)
from sb3_cpm import ChallengerCallback, CPMBuffer, PointNetExtractor


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=2000)
    args = parser.parse_args()

    model = SAC(
        "MultiInputPolicy",
        gym.make("CPMToy-v0"),
        replay_buffer_class=CPMBuffer,
        # what the player reads; all other keys go through none of its networks
        policy_kwargs={"features_extractor_class": PointNetExtractor, "features_extractor_kwargs": {"keys": ["state"]}},
        learning_starts=200,
        buffer_size=10_000,
        gamma=0.9,
        seed=0,
    )
    # what the challenger reads
    callback = ChallengerCallback(keys=["camera"])
    model.learn(args.steps, callback=callback, log_interval=10)
    print(f"the challenger reads {callback.challenger.keys}, the player {model.policy.actor.features_extractor.player_keys}")
    model.save("images_player")  # a plain SB3 model: the challenger is not needed to act


if __name__ == "__main__":
    main()
