"""What a :class:`~sb3_cpm.buffers.CPMBuffer` cannot work with, said in words."""

import inspect
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.torch_layers import CombinedExtractor
from stable_baselines3.her.goal_selection_strategy import KEY_TO_GOAL_STRATEGY, GoalSelectionStrategy

from sb3_cpm.arguments import AT_LEAST_0, SHARE, check, check_each, integer, nearest
from sb3_cpm.spaces import is_cloud, is_vector

#: Arguments that SB3's algorithms give to their replay buffer themselves.
SET_BY_ALGORITHMS = ("buffer_size", "observation_space", "action_space", "env", "device", "n_envs", "optimize_memory_usage")


def check_spaces(observation_space: spaces.Space, n_sampled_goal: int, player_keys: Sequence[str] | None) -> None:
    """:raises ValueError: for observations that a buffer cannot hold, or that lack what its arguments ask for"""
    if not isinstance(observation_space, spaces.Dict):
        raise ValueError(
            f"CPMBuffer needs a Dict observation space, got {observation_space}. Wrap the environment in "
            'sb3_cpm.envs.DictObservation(env) and use "MultiInputPolicy" (SAC, TD3, DDPG, TQC and all of SBX have one, '
            "sb3-contrib's CrossQ has none)."
        )
    if not observation_space.spaces:
        raise ValueError("The observation space is a Dict without keys: there is nothing to learn from.")
    for key, space in observation_space.spaces.items():
        _check_part(key, space)
    check("n_sampled_goal", n_sampled_goal, AT_LEAST_0)
    missing = {"achieved_goal", "desired_goal"} - set(observation_space.spaces)
    if n_sampled_goal > 0 and missing:
        raise ValueError(
            f"n_sampled_goal={n_sampled_goal} asks for hindsight goals, but the observations have no {sorted(missing)}; "
            "use n_sampled_goal=0 on an environment without goals."
        )
    if player_keys is not None and (
        isinstance(player_keys, str) or not isinstance(player_keys, Collection) or not player_keys
    ):
        known = sorted(observation_space.spaces)
        raise ValueError(f"player_keys must be a list of observation keys, of {known}, or None for all, got {player_keys!r}.")
    unknown = {str(key) for key in player_keys or ()} - set(observation_space.spaces)
    if unknown:
        known = sorted(observation_space.spaces)
        raise ValueError(f"player_keys {sorted(unknown)} are not among the observation keys {known}")


def _check_part(key: str, space: spaces.Space) -> None:
    """:raises ValueError: for a space within a Dict of which SB3's buffers cannot hold the values"""
    if not isinstance(space, (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)):
        raise ValueError(
            f"Observation {key!r} is {space}, which is no array: a replay buffer holds Box, Discrete, MultiDiscrete and "
            "MultiBinary. Leave it out in a wrapper, or make it one (gymnasium.wrappers.FlattenObservation)."
        )
    if isinstance(space, spaces.MultiDiscrete) and len(space.shape) > 1:
        raise ValueError(f"Observation {key!r} is {space}: SB3 takes MultiDiscrete of one dimension only. Flatten it.")


#: The largest reward that a replay buffer can hold.
LARGEST = float(np.finfo(np.float32).max)

#: Pixels per side that SB3's NatureCNN needs at least; its three convolutions leave 1x1 of them.
NATURE_CNN_NEEDS = 36


def check_player_reads_images(observation_space: spaces.Dict) -> None:
    """
    SB3's algorithms make their buffer first and tell it nothing of the policy, which then fails in torch's words where an
    image is too small for it. So the model is looked for among those who are calling.

    :raises ValueError: if SB3's own features extractor is about to be made for images that it cannot read
    """
    frame = inspect.currentframe()
    while frame is not None and not (
        frame.f_code.co_name == "_setup_model" and isinstance(frame.f_locals.get("self"), OffPolicyAlgorithm)
    ):
        frame = frame.f_back
    if frame is None:
        return
    model = frame.f_locals["self"]
    given = model.policy_kwargs or {}
    default = inspect.signature(model.policy_class).parameters.get("features_extractor_class")
    extractor = given.get("features_extractor_class") or (default and default.default)
    if not (isinstance(extractor, type) and issubclass(extractor, CombinedExtractor)):
        return
    small = {
        key: space.shape
        for key, space in observation_space.spaces.items()
        if is_image_space(space, normalized_image=not given.get("normalize_images", True))
        and sorted(space.shape)[1] < NATURE_CNN_NEEDS  # type: ignore[arg-type]  # the smallest is the channels
    }
    if small:
        keys = [
            key
            for key, space in observation_space.spaces.items()
            if is_vector(space) or is_cloud(space) or is_image_space(space)
        ]
        raise ValueError(
            f"SB3's {extractor.__name__} reads images of {NATURE_CNN_NEEDS}x{NATURE_CNN_NEEDS} pixels and more, these have "
            f"{small}. Render them larger, or read them with policy_kwargs=dict(features_extractor_class=sb3_cpm."
            f"PointNetExtractor, features_extractor_kwargs=dict(keys={keys})), or leave them to the challenger with the same "
            "class and no `keys`."
        )


def check_construction(buffer_size: int, n_envs: int, optimize_memory_usage: bool, strategy: Any) -> None:
    """:raises ValueError: for arguments of SB3's buffers that it would answer with a traceback"""
    check("buffer_size", buffer_size, integer(1)._replace(words="a number of transitions, an integer of at least 1"))
    check("n_envs", n_envs, integer(1))
    if optimize_memory_usage:
        raise ValueError(
            "optimize_memory_usage=True is not for this buffer, which stores every observation once anyway: leave it out."
        )
    if not isinstance(strategy, GoalSelectionStrategy) and str(strategy).lower() not in KEY_TO_GOAL_STRATEGY:
        raise ValueError(
            f"Unknown goal_selection_strategy {strategy!r}.{nearest(str(strategy), KEY_TO_GOAL_STRATEGY)} Valid: "
            f"{', '.join(KEY_TO_GOAL_STRATEGY)}."
        )


def check_buffer_arguments(
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


def checked_rewards(reward: Any, n_envs: int) -> np.ndarray:
    """
    :param reward: of one step; a plain number will do for one environment
    :return: the rewards, shape ``(n_envs,)``
    :raises ValueError: unless they are ``n_envs`` finite numbers
    """
    array = _per_environment("Rewards", "one number", reward, n_envs)
    if array.dtype.kind not in "biuf":
        raise ValueError(f"Rewards must be numbers, got {reward!r}: give one per environment, as np.array([0.5]).")
    for env_idx, value in enumerate(array.tolist()):
        if not abs(value) <= LARGEST:  # NaN fails too
            raise ValueError(
                f"Environment {env_idx} gave a reward of {value}: rewards must be finite (as float32). "
                "stable_baselines3.common.vec_env.VecCheckNan helps to find where it comes from."
            )
    return array


def checked_dones(done: Any, n_envs: int) -> np.ndarray:
    """
    :param done: of one step; a plain truth value will do for one environment
    :return: whether the episodes ended, shape ``(n_envs,)``, bool
    :raises ValueError: unless they are ``n_envs`` truth values
    """
    array = _per_environment("Dones", "True or False", done, n_envs)
    if array.dtype.kind not in "biuf" or not all(value in (0, 1) for value in array.tolist()):
        raise ValueError(f"Dones must be True or False, got {done!r}: give one per environment, as np.array([False]).")
    return array.astype(bool)


def _per_environment(what: str, each: str, given: Any, n_envs: int) -> np.ndarray:
    try:
        array = np.asarray(given)
    except ValueError:  # lists within lists
        array = np.zeros(0, dtype=object)
    if n_envs == 1 and array.shape == ():
        array = array.reshape(1)
    if array.shape != (n_envs,):
        raise ValueError(
            f"{what} have shape {array.shape}, expected ({n_envs},): {each} per environment, as "
            f"np.array([{', '.join(['...'] * min(n_envs, 3))}])."
        )
    return array


def checked_infos(infos: Any, n_envs: int) -> Sequence[dict[str, Any]]:
    """
    :param infos: of one step; the dict by itself will do for one environment
    :return: one dict per environment
    :raises ValueError: unless there are ``n_envs``
    """
    if n_envs == 1 and isinstance(infos, Mapping):
        return [dict(infos)]
    if not isinstance(infos, (list, tuple)) or len(infos) != n_envs or not all(isinstance(one, Mapping) for one in infos):
        raise ValueError(f"infos must be a list of {n_envs} dicts, one per environment, got {infos!r:.200}.")
    return infos


def checked_actions(action: Any, n_envs: int, space: spaces.Space, action_dim: int) -> np.ndarray:
    """
    :param action: of one step, shape ``(n_envs, *action_shape)``; without the first dimension for one environment
    :param space: of the actions
    :param action_dim: numbers of one action
    :return: shape ``(n_envs, action_dim)``
    :raises ValueError: for any other shape, also one that only has as many numbers, and for NaN
    """
    array, shape = np.asarray(action), space.shape or ()
    possible = [(n_envs, *shape), (n_envs, action_dim)]
    if action_dim == 1:
        possible.append((n_envs,))
    if n_envs == 1:
        possible.append(shape)
    if array.shape not in possible or array.dtype.kind not in "biuf":
        raise ValueError(
            f"Actions have shape {array.shape} and dtype {array.dtype}, expected numbers of shape {(n_envs, *shape)}: one row "
            "per environment, scaled to [-1, 1] as policy.scale_action() does."
        )
    if isinstance(space, spaces.Box):
        # by hand they may come in the environment's units, as in SB3's own tests of its buffers
        low, high = min(-1.001, float(space.low.min())), max(1.001, float(space.high.max()))
        if not (array.min(initial=0.0) >= low and array.max(initial=0.0) <= high):  # NaN fails too
            raise ValueError(
                f"Actions must be finite and lie within [-1, 1], got {array.tolist()}: scale them from the environment's "
                "units with policy.scale_action(), as SB3 does."
            )
    elif (array != np.clip(np.trunc(array), -(2**31), 2**31)).any():  # NaN is different from itself
        raise ValueError(f"Actions of {space} must be whole numbers, got {array.tolist()}.")
    return array.reshape(n_envs, action_dim)


def checked_hindsight_rewards(rewards: Any, n: int) -> np.ndarray:
    """
    :param rewards: what the environment's ``compute_reward`` returned for a batch
    :param n: rows of the batch
    :return: shape ``(n,)``, float32
    :raises ValueError: unless they are ``n`` finite numbers
    """
    try:
        array = np.asarray(rewards)
    except ValueError:  # lists within lists
        array = np.zeros(0, dtype=object)
    if array.dtype.kind not in "biuf" and array.size:
        raise ValueError(f"compute_reward must return {n} numbers for a batch of {n} goals, got {rewards!r:.100}.")
    if array.shape not in ((n,), (n, 1)) and not (n == 1 and array.size == 1):
        raise ValueError(
            f"compute_reward returned shape {array.shape} for a batch of {n} pairs of goals. It must return one reward per "
            f"row, shape ({n},): compute along the last axis, as np.linalg.norm(achieved_goal - desired_goal, axis=-1), and "
            "compare with np.where(...) instead of if."
        )
    broken = np.flatnonzero(~(np.abs(array.reshape(-1)) <= LARGEST))
    if len(broken):
        raise ValueError(
            f"compute_reward returned {array.reshape(-1)[broken[0]]} for {len(broken)} of {n} pairs of goals: rewards must be "
            "finite. Look for divisions by zero, logarithms and NaN in the goals."
        )
    return array.reshape(-1).astype(np.float32)


def compute_reward_failed(n: int, error: Exception) -> ValueError:
    """What to say of a ``compute_reward`` that raised, or is not there, for a batch of ``n`` pairs of goals."""
    if isinstance(error, AttributeError) and "compute_reward" in str(error):
        return ValueError(
            "n_sampled_goal > 0 asks for hindsight goals, but the environment has no compute_reward(achieved_goal, "
            "desired_goal, info), which gives their rewards: add it, or use n_sampled_goal=0."
        )
    return ValueError(
        f"compute_reward failed for a batch of {n} pairs of goals ({type(error).__name__}: {error}). It is given arrays of "
        f"shape ({n}, goal size) and a list of {n} infos, and must return one reward per row, as "
        "-np.linalg.norm(achieved_goal - desired_goal, axis=-1) does; compare with np.where(...) instead of if."
    )


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
