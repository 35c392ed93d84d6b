"""
sheeprl's DreamerV2 in the loop of ``benchmarks/dreamer_learning.py``: the same environments, random steps, buffer, updates per
step and evaluation episodes. Acting, losses and optimizers are sheeprl's own (its player, and its ``train()`` as
:mod:`peers.sheeprl_dreamer` calls it).

Its latent state is categorical, as in its DreamerV2; all other sizes and the learning rates are those of our preset. It
imagines from all states of a batch where the preset takes some, and predicts rewards and vectors as they are where the preset
squashes them.
"""

import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.utils import set_random_seed

sys.path.insert(0, str(Path(__file__).parents[1]))

from learning_curves import Table
from sheeprl.algos.dreamer_v2.agent import PlayerDV2

from peers.sheeprl_dreamer import SheeprlDreamer
from sb3_cpm.buffers import CPMBuffer
from sb3_cpm.dreamer.spaces import as_dict, as_dict_space
from sb3_cpm.seeds import FIRST_SEED


class Player:
    """
    Its acting network.

    :param peer: agent and sizes
    :param n_envs: number of environments
    """

    def __init__(self, peer: SheeprlDreamer, n_envs: int) -> None:
        world_model, algo = peer.modules["world_model"], peer.cfg.algo
        self.peer = peer
        self.player = PlayerDV2(
            world_model.encoder, world_model.rssm.recurrent_model, world_model.rssm.representation_model,
            peer.modules["actor"], (peer.action_dim,), n_envs, algo.world_model.stochastic_size,
            algo.world_model.recurrent_model.recurrent_state_size, "cpu", algo.world_model.discrete_size,
        )  # fmt: skip
        self.player.init_states()

    @th.no_grad()
    def act(self, observations: Any, first: np.ndarray, greedy: bool) -> np.ndarray:
        """:return: actions within [-1, 1], shape ``(n_envs, action_dim)``"""
        if first.any():
            self.player.init_states(np.flatnonzero(first).tolist())
        inputs = {}
        for key, value in as_dict(observations).items():
            tensor = th.as_tensor(value).float()[None]
            inputs[key] = tensor.permute(0, 1, 4, 2, 3) / 255 - 0.5 if key in self.peer.images else tensor
        return self.player.get_actions(inputs, greedy)[0][0].clamp(-1, 1).numpy()


def evaluate(peer: SheeprlDreamer, env: Any) -> tuple[list[float], list[int]]:
    """One episode in each environment, with the modes of its actions."""
    env.seed(FIRST_SEED)
    observations, first = env.reset(), np.ones(env.num_envs, dtype=bool)
    returns, lengths, running = np.zeros(env.num_envs), np.zeros(env.num_envs, dtype=int), np.ones(env.num_envs, dtype=bool)
    player = Player(peer, env.num_envs)
    while running.any():
        actions = player.act(observations, first, greedy=True)
        observations, rewards, first, _ = env.step(unscale(actions, env.action_space))
        returns += rewards * running
        lengths += running
        running &= ~first
    return returns.tolist(), lengths.tolist()


def unscale(actions: np.ndarray, space: Any) -> np.ndarray:
    return space.low + 0.5 * (actions.reshape(-1, *space.shape) + 1) * (space.high - space.low)


def set_learning_rates(peer: SheeprlDreamer, preset: dict[str, Any], share: float) -> None:
    """
    :param preset: names the rates
    :param share: what the schedule leaves of them
    """
    for name, entry in (("world_optimizer", "model_lr"), ("actor_optimizer", "actor_lr"), ("critic_optimizer", "critic_lr")):
        for group in peer.modules[name].param_groups:
            group["lr"] = share * preset[entry]


def main(env: str, id: str, seed: int, steps: int, every: int, episodes: int, path: str, **settings: Any) -> None:
    start = time.process_time()
    th.set_num_threads(1)
    set_random_seed(seed)
    train_env, test_env = (make_vec_env(id, n, seed=seed) for n in (1, episodes))
    train_env.action_space.seed(seed)
    space = as_dict_space(train_env.observation_space)
    peer = SheeprlDreamer(settings["preset"], space, train_env.action_space.shape[0])
    buffer = CPMBuffer(100_000, space, train_env.action_space, challenge_ratio=0)
    player, table, updates = Player(peer, 1), Table(Path(path)), 0

    def record(step: int) -> None:
        cpu = round(time.process_time() - start, 1)
        returns, lengths = evaluate(peer, test_env)
        for episode, (value, length) in enumerate(zip(returns, lengths, strict=True)):
            table.add(agent="sheeprl", env=env, seed=seed, step=step, episode=episode, **{"return": round(value, 4)},
                      length=length, updates=updates, cpu_seconds=cpu)  # fmt: skip
        print(f"sheeprl {env} seed {seed} step {step}: {sum(returns) / len(returns):.1f} after {cpu} CPU s", flush=True)

    record(0)
    observations, first = train_env.reset(), np.ones(1, dtype=bool)
    for step in range(1, steps + 1):
        action = player.act(observations, first, greedy=False)
        if step <= settings["learning_starts"]:
            action = np.random.uniform(-1, 1, action.shape).astype(np.float32)
            player.player.actions[:] = th.as_tensor(action)
        previous, (observations, rewards, first, infos) = observations, train_env.step(unscale(action, train_env.action_space))
        last = infos[0]["terminal_observation"] if first[0] else None
        following = as_dict(observations) if last is None else {key: value[None] for key, value in as_dict(last).items()}
        buffer.add(dict(as_dict(previous)), dict(following), action, rewards, first, infos)
        if step > settings["learning_starts"] and step % settings["train_freq"] == 0 and buffer.episodes_ended:
            set_learning_rates(
                peer, settings["preset"], 1 - (1 - settings["last_rate"] / settings["preset"]["model_lr"]) * step / steps
            )
            for _ in range(1 if updates else 1 + settings["pretrain"]):
                peer.train(buffer.sample_sequences(settings["preset"]["batch_size"], settings["preset"]["sequence_length"]))
                updates += 1
        if step % every == 0:
            record(step)
    table.complete()


if __name__ == "__main__":
    main(**json.loads(sys.argv[1]))
