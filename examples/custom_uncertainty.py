"""A measure of novelty of your own: how badly an action is guessed. `python examples/custom_uncertainty.py`"""

import argparse

import gymnasium as gym
import torch as th
from stable_baselines3 import SAC

from sb3_cpm import ChallengerCallback, CPMBuffer
from sb3_cpm.envs import DictObservation
from sb3_cpm.uncertainty.base import LatentSizes, Transitions, Uncertainty
from sb3_cpm.world_model.networks import MLP


class InverseModelError(Uncertainty):
    """
    Pathak et al. (2017) turned round: where it is not known which action led from one state to the next, there is something to
    learn about what actions do.

    :param sizes: of latents and actions
    :param units: of the hidden layers
    """

    def __init__(self, sizes: LatentSizes, units: int = 64) -> None:
        super().__init__(sizes)
        self.inverse = MLP(2 * sizes.feat, 2, units, sizes.action)

    def novelty(self, transitions: Transitions) -> th.Tensor:
        guess = self.inverse(th.cat((transitions.feat, transitions.next_feat), dim=-1))
        return (guess - transitions.action).square().mean(-1)  # one number per transition, differentiable

    def loss(self, transitions: Transitions) -> th.Tensor:
        return self.novelty(transitions).mean()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=3000)
    args = parser.parse_args()

    env = DictObservation(gym.make("Pendulum-v1"))
    model = SAC("MultiInputPolicy", env, replay_buffer_class=CPMBuffer, learning_starts=300, buffer_size=20_000, seed=0)
    callback = ChallengerCallback(uncertainty_class=InverseModelError, uncertainty_kwargs={"units": 64})
    model.learn(args.steps, callback=callback)
    print(f"{type(callback.challenger.uncertainty).__name__} after {callback.challenger.trained_updates} updates")


if __name__ == "__main__":
    main()
