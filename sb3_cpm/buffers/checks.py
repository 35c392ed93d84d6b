"""What a :class:`~sb3_cpm.buffers.CPMBuffer` cannot work with, said in words."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_cpm.arguments import AT_LEAST_0, SHARE, check, check_each, integer

#: Arguments that SB3's algorithms give to their replay buffer themselves.
SET_BY_ALGORITHMS = ("buffer_size", "observation_space", "action_space", "env", "device", "n_envs", "optimize_memory_usage")


def check_spaces(observation_space: spaces.Space, n_sampled_goal: int, player_keys: Sequence[str] | None) -> None:
    """:raises ValueError: for observations that a buffer cannot hold, or that lack what its arguments ask for"""
    if not isinstance(observation_space, spaces.Dict):
        raise ValueError(
            f"CPMBuffer needs a Dict observation space, got {observation_space}. Wrap the environment in "
            'sb3_cpm.envs.DictObservation(env) and use "MultiInputPolicy" (SAC, TD3, DDPG and TQC have one, CrossQ has none).'
        )
    check("n_sampled_goal", n_sampled_goal, AT_LEAST_0)
    missing = {"achieved_goal", "desired_goal"} - set(observation_space.spaces)
    if n_sampled_goal > 0 and missing:
        raise ValueError(
            f"n_sampled_goal={n_sampled_goal} asks for hindsight goals, but the observations have no {sorted(missing)}; "
            "use n_sampled_goal=0 on an environment without goals."
        )
    unknown = set(player_keys or ()) - set(observation_space.spaces)
    if unknown:
        known = sorted(observation_space.spaces)
        raise ValueError(f"player_keys {sorted(unknown)} are not among the observation keys {known}")


def check_arguments(
    observation_space: spaces.Space,
    action_space: spaces.Space,
    challenge_ratio: float,
    demonstration_ratio: float,
    mix: str,
    max_challenges: int,
    refresh_every: int | None,
) -> None:
    """:raises ValueError: for arguments of CPMBuffer that cannot work"""
    check_spaces(observation_space, 0, None)
    check_values(challenge_ratio, demonstration_ratio, mix, max_challenges, refresh_every)
    if challenge_ratio > 0 and not isinstance(action_space, spaces.Box):
        raise ValueError(
            f"Challenges need continuous actions (a Box action space), got {action_space}. Use SAC, TD3, DDPG or TQC on a "
            "continuous environment, or challenge_ratio=0 to use the buffer without challenges."
        )


def check_values(
    challenge_ratio: float, demonstration_ratio: float, mix: str, max_challenges: int, refresh_every: int | None
) -> None:
    """:raises ValueError: for arguments of CPMBuffer that cannot work whatever the spaces are"""
    share = SHARE._replace(words="a share of the batches, a number in [0, 1]")
    check_each(share, challenge_ratio=challenge_ratio, demonstration_ratio=demonstration_ratio)
    # 0.1 is the default and means nothing without demonstrations
    if demonstration_ratio != 0.1:
        check_shares(challenge_ratio, demonstration_ratio)
    if mix not in ("batch", "row"):
        raise ValueError(f'mix must be "batch" or "row", got {mix!r}')
    check("max_challenges", max_challenges, integer(1)._replace(words="an integer of at least 1 (none: challenge_ratio=0)"))
    if refresh_every is not None:
        check("refresh_every", refresh_every, integer(1)._replace(words="None or a number of transitions, at least 1"))


def check_shares(challenge_ratio: float, demonstration_ratio: float) -> None:
    """:raises ValueError: for shares of a batch that leave no room for each other"""
    if challenge_ratio + demonstration_ratio > 1:
        raise ValueError(
            f"challenge_ratio={challenge_ratio} and demonstration_ratio={demonstration_ratio} are shares of the same batches "
            f"and must not exceed 1 together; demonstration_ratio={max(1 - challenge_ratio, 0):.4g} is the most that fits"
        )


def checked_rewards(reward: np.ndarray, n_envs: int) -> np.ndarray:
    """
    :return: the rewards as they are
    :raises ValueError: unless they are ``n_envs`` finite numbers
    """
    values = reward.tolist()
    if reward.shape != (n_envs,):
        raise ValueError(f"Rewards have shape {reward.shape}, expected ({n_envs},)")
    for env_idx, value in enumerate(values):
        if not math.isfinite(value):
            raise ValueError(
                f"Environment {env_idx} gave a reward of {value}: rewards must be finite. "
                "stable_baselines3.common.vec_env.VecCheckNan helps to find where it comes from."
            )
    return reward


def check_environment(env: Any, observation_space: spaces.Dict, action_space: spaces.Space, n_envs: int) -> None:
    """:raises ValueError: if a buffer of these spaces and number of environments does not belong to ``env``"""
    theirs = getattr(env, "observation_space", None)
    if isinstance(theirs, spaces.Space) and _layout(theirs) != _layout(observation_space):
        raise ValueError(
            f"This replay buffer holds observations {_layout(observation_space)}, the environment gives {_layout(theirs)}: it "
            "belongs to another environment."
        )
    actions = getattr(env, "action_space", None)
    if isinstance(actions, spaces.Space) and actions.shape != action_space.shape:
        raise ValueError(
            f"This replay buffer holds actions {action_space}, the environment takes {actions}: it belongs to another "
            "environment or controller."
        )
    n_theirs = getattr(env, "num_envs", n_envs)
    if n_theirs != n_envs:
        raise ValueError(
            f"This replay buffer was filled by {n_envs} parallel environments, now there are {n_theirs}. Load it into a model "
            f"with {n_envs}, they are its columns."
        )


def _layout(space: spaces.Space) -> Any:
    if not isinstance(space, spaces.Dict):
        return str(space)
    return {key: (part.shape, str(part.dtype)) for key, part in space.spaces.items()}


def holds_pickles(path: str | Path) -> bool:
    """
    :param path: of a file, perhaps
    :return: whether it begins as pickles do; our own files are zip archives
    """
    if not Path(path).is_file():
        return False
    with Path(path).open("rb") as file:
        return file.read(1) == b"\x80"  # pickle's protocols 2 to 5


def unreadable(path: str | Path, error: Exception) -> ValueError:
    """What to say of a file that pickle cannot read."""
    size = Path(path).stat().st_size
    return ValueError(
        f"{path} ({size:,} bytes) is not a complete saved CPMBuffer: {error or type(error).__name__}. It may have been "
        "cut off while it was written; take an earlier one. (CPMBuffer.save never leaves half a file.)"
    )
