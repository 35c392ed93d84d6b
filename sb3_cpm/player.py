"""
The player, any off-policy algorithm of SB3 with a :class:`~sb3_cpm.buffers.CPMBuffer`: what must hold before it learns beside
a challenger, and what there is to know about it.
"""

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.torch_layers import CombinedExtractor
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv

from sb3_cpm.buffers import CPMBuffer
from sb3_cpm.challenge_env import check_outermost
from sb3_cpm.spaces import CHALLENGE


def check_model(model: Any) -> None:
    """Everything that must hold before the first step is taken."""
    name = type(model).__name__
    if not isinstance(model, OffPolicyAlgorithm):
        raise ValueError(
            f"ChallengerCallback needs an off-policy algorithm with a CPMBuffer (SAC, TD3, DDPG, TQC), got {name}"
        )
    if not isinstance(model.observation_space, spaces.Dict):
        raise ValueError(
            f"ChallengerCallback needs a Dict observation space, got {model.observation_space}. Wrap the environment in "
            f'sb3_cpm.envs.DictObservation(env) and use {name}("MultiInputPolicy", ...): SAC, TD3, DDPG, TQC and all of SBX '
            "have such a policy, sb3-contrib's CrossQ has none."
        )
    if not isinstance(model.action_space, spaces.Box):
        raise ValueError(f"ChallengerCallback needs continuous actions (a Box action space), got {model.action_space}")
    if not isinstance(model.replay_buffer, CPMBuffer):
        raise ValueError(
            f"ChallengerCallback needs a CPMBuffer, but {name} has a {type(model.replay_buffer).__name__}: make it with "
            f'{name}("MultiInputPolicy", env, replay_buffer_class=CPMBuffer)'
        )
    check_outermost(model.env)
    given = model.replay_buffer.player_keys
    if given is None:
        return
    for extractor in _features_extractors(model):
        reads = extractor.extractors if isinstance(extractor, CombinedExtractor) else getattr(extractor, "player_keys", ())
        missing = sorted(set(reads) - set(given))
        if missing:
            raise ValueError(
                f"The buffer's player_keys {list(given)} lack {missing}, which the player's {type(extractor).__name__} "
                "reads: add them, or leave `player_keys` out of replay_buffer_kwargs."
            )


def check_learning_starts(model: OffPolicyAlgorithm) -> None:
    """P can only sample once an episode has ended; say so now instead of in the middle of the run."""
    assert model.env is not None and isinstance(model.replay_buffer, CPMBuffer)
    longest = max_episode_steps(model.env)
    if longest is None or model.replay_buffer.episodes_ended:
        return
    needed = longest * model.n_envs
    if model.learning_starts - model.num_timesteps < needed:
        if model.num_timesteps:
            raise ValueError(
                f"The model has made {model.num_timesteps} steps, but its replay buffer has no complete episode: that is in a "
                "file of its own. Call model.load_replay_buffer(path) before learn(), with what "
                "model.save_replay_buffer(path) saved; or begin with new experience: learning_starts="
                f"{model.num_timesteps + needed} (it counts from the first step, and episodes last up to {longest} steps)."
            )
        raise ValueError(
            f"learning_starts={model.learning_starts} ends before the first episode may: episodes last up to {longest} steps "
            f"in each of {model.n_envs} environments. Set learning_starts={needed} or more."
        )
    if model.buffer_size < 2 * needed:
        raise ValueError(
            f"buffer_size={model.buffer_size} is too small: while an episode of up to {longest} steps is written in each of "
            f"{model.n_envs} environments, a complete one must remain to learn from. Set buffer_size={2 * needed} or more."
        )


def max_episode_steps(env: VecEnv) -> int | None:
    """:return: the time limit of the environments, None where there is none or none can be known"""
    limits: list[int | None] = []
    if not isinstance(env.unwrapped, SubprocVecEnv):  # not every spec can be pickled, and a worker that cannot send one dies
        try:
            limits = [spec.max_episode_steps for spec in env.get_attr("spec") if spec is not None]
        except AttributeError:  # VecEnvs that are not made of gymnasium environments
            return None
    if not limits and env.has_attr("_max_episode_steps"):  # TimeLimit's, also around environments that are not registered
        limits = env.get_attr("_max_episode_steps")
    return max((limit for limit in limits if limit is not None), default=None)


def player_keys(model: OffPolicyAlgorithm) -> tuple[str, ...] | None:
    """Keys that P's features extractors read, where they tell; images that only C looks at need not be moved for P."""
    keys = [getattr(extractor, "player_keys", None) for extractor in _features_extractors(model)]
    if not keys or any(read is None for read in keys):
        return None
    wanted = set().union(*keys)  # type: ignore[arg-type]
    return tuple(key for key in model.observation_space.spaces if key in wanted)  # type: ignore[attr-defined]


def _features_extractors(model: OffPolicyAlgorithm) -> list[th.nn.Module]:
    modules = (getattr(model, name, None) for name in ("policy", "actor", "critic"))
    extractors = (getattr(module, "features_extractor", None) for module in modules)
    return [extractor for extractor in extractors if extractor is not None]


def original_space(model: BaseAlgorithm) -> spaces.Dict:
    """
    What the environment gives, which is what C reads: where VecNormalize also normalizes images, it declares them anew, in
    SB3's own space (uint8 from 0 to 255 only; a CPMBuffer then stores them as float32).
    """
    space, env = model.observation_space, model.get_vec_normalize_env()
    assert isinstance(space, spaces.Dict)
    if getattr(getattr(model, "replay_buffer", None), "challenge_keys", None) is not None:  # that is between P and its buffer
        space = spaces.Dict({key: part for key, part in space.spaces.items() if key != CHALLENGE})
    if env is None or not env.norm_obs:
        return space
    given: Any = env.get_original_obs()
    images = {
        key: spaces.Box(0, 255, space[key].shape, np.float32)
        for key in env.norm_obs_keys or ()
        if given[key].dtype == np.uint8 and space[key].dtype != np.uint8
    }
    return spaces.Dict({**space.spaces, **images}) if images else space
