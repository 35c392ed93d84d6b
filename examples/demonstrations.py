"""From a scripted expert to a player that improves on its own: clone, then RLPD. `python examples/demonstrations.py`"""

import argparse

from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env

import sb3_cpm.envs.reach  # noqa: F401  (registers CPMReach-v0, whose expert is its method expert_action())
from sb3_cpm import CPMBuffer, RLPDPolicy
from sb3_cpm.imitation import BCLossCallback, CloneCallback
from sb3_cpm.run.evaluation import evaluate, means


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=2000)
    args = parser.parse_args()

    model = SAC(
        RLPDPolicy,  # ten critics with layer normalisation
        make_vec_env("CPMReach-v0", seed=0),
        policy_kwargs={"net_arch": [64, 64]},
        replay_buffer_class=CPMBuffer,
        # half of each batch from demonstrations, no challenges
        replay_buffer_kwargs={"challenge_ratio": 0, "demonstration_ratio": 0.5, "mix": "row"},
        learning_starts=100,
        buffer_size=10_000,
        gamma=0.9,
        ent_coef=0.001,
        seed=0,
    )
    evaluation = make_vec_env("CPMReach-v0")
    print("untrained: success {1:.0%}".format(*means(evaluate(model, evaluation, 20))))
    # records, clones, and gives the buffer the same episodes; the loss keeps the player near them
    clone = CloneCallback("expert", n_episodes=20, hold=True, log_std=-2.5, n_updates=1500, batch_size=64, verbose=1)
    model.learn(args.steps, callback=[clone, BCLossCallback(weight=1.0)])
    print("trained: success {1:.0%}".format(*means(evaluate(model, evaluation, 20))))


if __name__ == "__main__":
    main()
