"""
What Dreamer and Plan2Explore share: SB3's off-policy loop around a challenger that acts by itself.

The latent state follows every step of ``learn()``, the random ones at the beginning included, with the action that was really
executed. What the world model learns from are the episodes in a :class:`~sb3_cpm.buffers.CPMBuffer` without challenges: true
last observations, a row for every reset (see :class:`~sb3_cpm.type_aliases.SequenceBatch`).
"""

import io
import pathlib
import warnings
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.save_util import load_from_pkl, load_from_zip_file
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, RolloutReturn, Schedule
from stable_baselines3.common.utils import configure_logger
from stable_baselines3.common.vec_env import VecEnv
from typing_extensions import Self

from sb3_cpm.buffers import CPMBuffer
from sb3_cpm.buffers.checks import check_environment
from sb3_cpm.buffers.episode_buffer import EpisodeBuffer
from sb3_cpm.challenger import Challenger, choose_device, rate_entry
from sb3_cpm.challenger.file import state_to_check
from sb3_cpm.dreamer.policies import DreamerPolicy, RecurrentState
from sb3_cpm.dreamer.spaces import OBSERVATION, Keyed, as_dict, as_dict_space
from sb3_cpm.dreamer.start import StartFrom, model_file, read_challenger, take_over_uncertainty
from sb3_cpm.files import check_finite, verify, write_sealed
from sb3_cpm.presets import Preset, PresetLike, make_preset
from sb3_cpm.randomness import RandomState, random_state, restore_random_state
from sb3_cpm.training_env import WatchedVecEnv
from sb3_cpm.type_aliases import SequenceBatch
from sb3_cpm.world_model.correlated_noise import CorrelatedNoise
from sb3_cpm.world_model.observations import check_action_space, how_to_be_read, unread

#: Arguments of the constructors that SB3's ``load`` would only set as attributes, which nobody reads.
_OF_CONSTRUCTOR = ("preset", "keys", "start_from", "uncertainty_class", "uncertainty_kwargs", "train_task_behavior")


class DreamerAlgorithm(OffPolicyAlgorithm):
    """
    Base of :class:`~sb3_cpm.dreamer.Dreamer` and :class:`~sb3_cpm.dreamer.Plan2Explore`, which document the arguments.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": DreamerPolicy,
        "CnnPolicy": DreamerPolicy,
        "MultiInputPolicy": DreamerPolicy,
    }
    #: which behaviour acts
    behavior: ClassVar[str]
    default_preset: ClassVar[str]
    policy: DreamerPolicy

    def __init__(
        self,
        policy: str | type[DreamerPolicy],
        env: GymEnv | str,
        *,
        learning_rate: float | Schedule | None,
        buffer_size: int,
        learning_starts: int,
        train_freq: int | tuple[int, str],
        gradient_steps: int,
        pretrain_steps: int,
        action_noise: ActionNoise | None,
        replay_buffer_class: type[ReplayBuffer] | None,
        replay_buffer_kwargs: dict[str, Any] | None,
        preset: PresetLike | None,
        entries: Mapping[str, Any],
        keys: Sequence[str] | None,
        start_from: StartFrom | None,
        policy_kwargs: dict[str, Any] | None,
        stats_window_size: int,
        tensorboard_log: str | None,
        verbose: int,
        seed: int | None,
        device: Any,
        _init_setup_model: bool,
    ):
        source = None if start_from is None else read_challenger(start_from, choose_device(device))
        if source is not None:
            keys = source.keys if keys is None else keys
            preset = preset if isinstance(preset, (str, Preset)) else {**asdict(source.preset), **(preset or {})}
        sizes = make_preset(self.default_preset if preset is None else preset, self.default_preset, **entries)
        if learning_rate is not None and sizes.model_lr == 0.0:
            raise ValueError(
                f"The preset entry 'model_lr' is 0, which keeps the world model from learning, and `learning_rate`, "
                f"{learning_rate}, is the world model's too: leave one of them out. The other rates are preset entries."
            )
        policy_kwargs = {"preset": asdict(sizes), "keys": keys, **(policy_kwargs or {}), "behavior": self.behavior}
        if sizes.train_exploration_behavior:
            policy_kwargs.update(take_over_uncertainty(source, sizes, policy_kwargs))
        super().__init__(
            policy,
            env,
            sizes.model_lr if learning_rate is None else learning_rate,
            buffer_size,
            learning_starts,
            sizes.batch_size,
            gamma=sizes.gamma,
            train_freq=train_freq,
            gradient_steps=gradient_steps,
            action_noise=action_noise,
            replay_buffer_class=replay_buffer_class,
            replay_buffer_kwargs=replay_buffer_kwargs,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=choose_device(device),
            support_multi_env=True,
            seed=seed,
            sde_support=False,
        )
        self.pretrain_steps = pretrain_steps
        #: Recurrent state after the last action of ``learn()``; None before the first.
        self._state: RecurrentState | None = None
        self._noise: CorrelatedNoise | None = None
        self._random_state: RandomState | None = None
        self._watched: WatchedVecEnv | None = None
        if _init_setup_model:
            self._setup_model()
            if policy_kwargs["keys"] is None:
                self._warn_of_unread_keys()
            if source is not None:
                self.challenger.adopt(source)

    # ------------------------------------------------------------------ making

    @property
    def challenger(self) -> Challenger:
        """World model, behaviours, uncertainty and optimizers."""
        return self.policy.challenger

    def _setup_model(self) -> None:
        as_dict_space(self.observation_space)
        check_action_space(self.action_space)
        if self.replay_buffer is None:
            self.replay_buffer = self._make_replay_buffer()
        self.policy_kwargs["device"] = str(self.device)
        super()._setup_model()
        self._check_normalized_images()

    def _warn_of_unread_keys(self) -> None:
        """Beside a player the challenger may leave things out; here nobody else reads them."""
        for key, space in unread(as_dict_space(self.observation_space), self.challenger.keys).items():
            warnings.warn(
                f"{type(self).__name__} reads images and vectors, so it leaves out {key!r} ({space}). {how_to_be_read(space)} "
                "To say nothing of it, name the `keys` to read.",
                stacklevel=4,
            )

    def _check_normalized_images(self) -> None:
        """
        VecNormalize declares what it returns for uint8 from 0 to 255 only; other images would leave the range they declare.

        :raises ValueError: naming the images, and what to do
        """
        env, spec = self._vec_normalize_env, self.challenger.spec
        if env is None or not env.norm_obs:
            return
        keys = list(spec.keys) if env.norm_obs_keys is None else env.norm_obs_keys  # None: the observation is a Box
        clip = float(np.float32(env.clip_obs))  # as a space declares it
        moved = {
            key: f"{low:g} to {high:g}"
            for key, (low, high) in spec.ranges.items()
            if key in keys and not low <= -clip < clip <= high
        }
        if moved:
            others = [key for key in keys if key not in moved]
            raise ValueError(
                f"VecNormalize turns images into values within +-{env.clip_obs:g}, where their space declares {moved}. The "
                "model scales images by these bounds, so leave them as they are: VecNormalize(..., "
                f"{f'norm_obs_keys={others}' if others else 'norm_obs=False'})."
            )

    def _make_replay_buffer(self) -> EpisodeBuffer:
        kind: Any = self.replay_buffer_class or CPMBuffer
        if not (isinstance(kind, type) and issubclass(kind, EpisodeBuffer)):
            raise ValueError(
                f"{type(self).__name__} learns from sequences, which {kind} does not give. Leave `replay_buffer_class` away, "
                "or use sb3_cpm.CPMBuffer or a subclass."
            )
        arguments = dict(self.replay_buffer_kwargs)
        if issubclass(kind, CPMBuffer) and arguments.setdefault("challenge_ratio", 0) != 0:
            raise ValueError(
                f"replay_buffer_kwargs has challenge_ratio={arguments['challenge_ratio']}, but {type(self).__name__} has no "
                "player to challenge: leave it away."
            )
        self.replay_buffer_class = kind
        return kind(
            self.buffer_size,
            as_dict_space(self.observation_space),
            self.action_space,
            device=self.device,
            n_envs=self.n_envs,
            **arguments,
        )

    # ------------------------------------------------------------------ acting

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        if self._random_state is not None and not reset_num_timesteps:
            restore_random_state(self._random_state, self.action_space)
            if self._last_obs is None and self.seed is not None and self.env is not None:
                # the start states that come next, not once more those that the first run began with
                self.env.seed(int(np.random.randint(2**31 - 1)))
        self._random_state = None
        goes_on = not reset_num_timesteps and self._last_obs is not None
        result = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)
        if self._watched is not None and not goes_on:  # SB3 itself has reset the environment
            self._watched.moved = False
        return result

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        """:return: actions in the environment's units, and within [-1, 1] for the buffer"""
        assert self._last_obs is not None and self._last_episode_starts is not None
        assert isinstance(self.action_space, spaces.Box)
        if self._watched is not None and self._watched.moved:
            self._begin_anew()
        if self._state is None or len(self._state[0]) != n_envs:
            self._state, self._noise = self.policy.initial_state(n_envs), self._make_noise()
        if self._noise is not None:
            self._noise.restart(np.flatnonzero(self._last_episode_starts))
        latent = self.policy.follow(self._last_obs, self._state, self._last_episode_starts)
        if self.num_timesteps < learning_starts:
            actions = np.array([self.action_space.sample() for _ in range(n_envs)])
            scaled = self.policy.scale_action(actions).reshape(n_envs, -1)
        else:
            scaled = self.policy.act(latent, noise=None if self._noise is None else self._noise.draw(np.arange(n_envs)))
        if action_noise is not None:
            scaled = np.clip(scaled + np.reshape(action_noise(), (-1, scaled.shape[1])), -1.0, 1.0)
        if not np.isfinite(scaled).all():
            self._refuse_nan()
        self._state = self.policy.recurrent_state(latent, scaled)
        shaped = scaled.reshape(n_envs, *self.action_space.shape)
        # rounding must not leave the space
        return np.clip(self.policy.unscale_action(shaped), self.action_space.low, self.action_space.high), shaped

    def _make_noise(self) -> CorrelatedNoise | None:
        """What exploration is made of; a behaviour that is to solve the task has white noise, which it learns with."""
        if self.behavior != "exploration":
            return None
        return CorrelatedNoise(self.challenger.preset.noise_memory, self.challenger.action_dim, self.challenger.device)

    def collect_rollouts(self, env: VecEnv, *args: Any, **kwargs: Any) -> RolloutReturn:
        """As SB3's, through an environment that keeps last observations as they were, and sees whether others use it."""
        if self._watched is None or self._watched.venv is not env:
            self._watched = WatchedVecEnv(env)
        return super().collect_rollouts(self._watched, *args, **kwargs)

    def _begin_anew(self) -> None:
        """Somebody has used the training environment, to evaluate in it, say: what was seen last lies in the past."""
        assert self._watched is not None
        self._last_obs = self._watched.reset()  # type: ignore[assignment]
        self._last_episode_starts = np.ones(self.n_envs, dtype=bool)
        if self._vec_normalize_env is not None:
            self._last_original_obs = self._vec_normalize_env.get_original_obs()

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_watched"]

    def _refuse_nan(self) -> None:
        assert self._last_obs is not None
        for key, value in as_dict(self._last_obs).items():
            if not np.isfinite(value).all():
                raise ValueError(
                    f"The environment gave NaN or infinite values in observation {key!r} at step {self.num_timesteps}. "
                    "stable_baselines3.common.vec_env.VecCheckNan helps to find where they come from."
                )
        raise RuntimeError("The policy gave NaN for finite observations: its weights, or the action noise, are not finite.")

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        buffer: Any = replay_buffer if isinstance(self.observation_space, spaces.Dict) else Keyed(replay_buffer)
        super()._store_transition(buffer, buffer_action, new_obs, reward, dones, infos)
        self._last_episode_starts = dones

    # ------------------------------------------------------------------ learning

    def train(self, gradient_steps: int, batch_size: int | None = None) -> None:
        """
        Update world model and behaviours from the replay buffer. SB3's loop calls it; called directly, it learns offline from
        whatever the buffer holds. Before the end of the first episode there is nothing to learn from, and nothing happens.

        :param gradient_steps: number of updates
        :param batch_size: sequences per update; the preset's by default
        :raises RuntimeError: if a loss is not finite, naming the term
        """
        buffer = self.replay_buffer
        assert isinstance(buffer, EpisodeBuffer)
        if not buffer.episodes_ended:
            return
        if not hasattr(self, "_logger"):  # offline, before any learn()
            self._logger = configure_logger(verbose=0)
        self.policy.set_training_mode(True)
        self._adapt_learning_rates()
        if self.challenger.trained_updates == 0:
            gradient_steps += self.pretrain_steps
        for _ in range(gradient_steps):
            batch = buffer.sample_sequences(
                batch_size or self.batch_size, self.challenger.sequence_length, self.challenger.keys
            )
            for name, value in self.challenger.train(self._normalized(batch)).items():
                self.logger.record_mean(f"train/{name}", value)
        self._n_updates += gradient_steps
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")

    def _adapt_learning_rates(self) -> None:
        """
        The world model's follows the schedule, all others keep the preset's ratio to it. Where the preset freezes the world
        model there is no such ratio, and the others keep the preset's rates.
        """
        rate = self.lr_schedule(self._current_progress_remaining)
        preset = self.challenger.preset
        frozen = preset.model_lr == 0.0
        self.logger.record("train/learning_rate", 0.0 if frozen else rate)
        for name, optimizer in self.challenger.optimizers.items():
            own = getattr(preset, rate_entry(name))
            optimizer.learning_rate = own if frozen else rate * own / preset.model_lr

    def _normalized(self, batch: SequenceBatch) -> SequenceBatch:
        """The buffer holds what the environment gave; behind a VecNormalize, what acts sees normalized observations."""
        env = self._vec_normalize_env
        if env is None:
            return batch
        observations: Any = batch.observations
        normalized: Any
        if isinstance(self.observation_space, spaces.Dict):
            # it wants to see every key that it normalizes, sampled are those that are read
            rest = {key: statistics.mean for key, statistics in env.obs_rms.items()} if env.norm_obs else {}
            every: Any = env.normalize_obs({**rest, **observations})
            normalized = {key: every[key] for key in observations}
        else:
            normalized = {OBSERVATION: env.normalize_obs(observations[OBSERVATION])}
        return batch._replace(observations=normalized, rewards=env.normalize_reward(batch.rewards))

    # ------------------------------------------------------------------ saving and loading

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", *(f"policy.{name}" for name in self.policy.optimizer_names)], []

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """
        As SB3's, and a file that is there already is replaced only by a complete one with finite weights.

        :param path: of the file; ".zip" is appended to a name without extension
        :param exclude: names of attributes to leave out, on top of SB3's
        :param include: names of attributes to save although SB3 leaves them out
        :raises RuntimeError: if a weight is not finite; the last good file is kept then
        :raises OSError: if the disk does not take it; the last good file is kept then, too
        """
        check_finite(str(path), "model", state_to_check(self.challenger.state_dict(include_rng=False)))
        self._random_state = random_state(self.action_space)
        try:
            if not isinstance(path, (str, pathlib.Path)):
                super().save(path, exclude, include)
                return
            target = pathlib.Path(path)
            target = target if target.suffix else target.with_name(f"{target.name}.zip")
            write_sealed(target, partial(super().save, exclude=exclude, include=include))
        finally:
            self._random_state = None

    @classmethod
    def load(
        cls,
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GymEnv | None = None,
        device: Any = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> Self:
        """
        As SB3's. A preset that is given changes rates and constants of the saved model; its networks keep their sizes.

        :param path: of the file
        :param env: to go on in
        :param device: PyTorch device
        :param custom_objects: saved attributes to replace
        :param print_system_info: of the saved model and of this machine
        :param force_reset: reset ``env`` before training
        :param kwargs: arguments of the constructor to change; ``preset`` is a name, or the entries that differ from the saved
            ones. ``start_from`` and ``pretrain_steps`` mean nothing to a model that has learnt, and are told with a warning
        :raises ValueError: for damaged files, for arguments that ask for other networks than the saved ones, and for a model
            of the other algorithm, which would go on acting as that one does
        """
        if isinstance(path, (str, pathlib.Path)):
            verify(model_file(path), "model")
        given = {name: kwargs.pop(name) for name in _OF_CONSTRUCTOR if kwargs.get(name) is not None}
        if given.pop("start_from", None) is not None:
            warnings.warn(f"`start_from` plays no role any more: the model goes on from {path}.", stacklevel=2)
        objects, changes = dict(custom_objects or {}), {}
        if given:
            data, _, _ = load_from_zip_file(path, custom_objects=custom_objects, device="cpu")
            assert data is not None
            saved, wanted = data["policy_kwargs"], _changed(data["policy_kwargs"], given)
            preset = make_preset(wanted["preset"])
            changes = {name: value for name, value in wanted.items() if name != "preset" and value != saved[name]}
            before = make_preset(saved["preset"])  # of an earlier version it may lack entries
            changes |= {name: value for name, value in asdict(preset).items() if value != getattr(before, name)}
            objects["policy_kwargs"] = wanted
            kwargs = {"batch_size": preset.batch_size, "gamma": preset.gamma, **kwargs}
            if "model_lr" in changes:
                kwargs = {"learning_rate": preset.model_lr, **kwargs}
        try:
            model = super().load(path, env, device, objects, print_system_info, force_reset, **kwargs)
        except (RuntimeError, TypeError, ValueError) as error:
            if not changes:
                raise
            reason = str(error).rpartition("\n")[2].strip()  # torch has a line for every weight that does not fit
            raise ValueError(
                f"{path} cannot be loaded with {changes}; a saved model keeps its networks, rates and constants may change: "
                f"{reason}"
            ) from error
        if model.policy.behavior != cls.behavior:
            raise ValueError(
                f"{path} is no model of {cls.__name__}: the behaviour that acts is {model.policy.behavior!r}, not "
                f"{cls.behavior!r}. {cls.__name__}(..., start_from={str(path)!r}) starts from what it has learnt."
            )
        if "adam_eps" in changes:  # the optimizers' saved states have the saved one
            for optimizer in model.challenger.optimizers.values():
                for group in optimizer.adam.param_groups:
                    group["eps"] = changes["adam_eps"]
        if kwargs.get("pretrain_steps") and model.challenger.trained_updates:
            warnings.warn(f"`pretrain_steps` plays no role any more: {path} has learnt already.", stacklevel=2)
        return model

    def load_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase, truncate_last_traj: bool = True) -> None:
        """
        Load what ``save_replay_buffer`` or ``CPMBuffer.save`` saved, of this model or of another one in the same environment.
        The former is a pickle, which can execute anything when it is read: only load such a file if you trust it.

        :param path: of the file
        :param truncate_last_traj: end an unfinished episode; False if the same episode goes on in the same environment
        :raises ValueError: if it is no buffer of sequences, or belongs to another environment
        """
        if isinstance(path, (str, pathlib.Path)) and zipfile.is_zipfile(path):  # of CPMBuffer.save
            buffer: Any = CPMBuffer.load(path)
        else:
            buffer = load_from_pkl(path, self.verbose)
        if not isinstance(buffer, EpisodeBuffer):
            raise ValueError(f"{path} holds a {type(buffer).__name__}, {type(self).__name__} learns from a CPMBuffer.")
        _check_buffer(buffer, self)
        if truncate_last_traj:
            buffer.truncate_last_trajectory()
        buffer.device = self.device
        if isinstance(buffer, CPMBuffer):
            buffer.challenge_ratio = 0.0  # challenges are for a player
        self.replay_buffer = buffer


def _changed(saved: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """
    :param saved: arguments that a model's policy was made with
    :param given: arguments of the constructor that replace them
    :return: arguments for the policy
    """
    preset = given.get("preset", {})
    entries = {name: saved["preset"][name] for name in ("train_task_behavior", "train_exploration_behavior")}
    entries.update((name, given[name]) for name in ("train_task_behavior",) if name in given)
    complete = make_preset(preset if isinstance(preset, (str, Preset)) else {**saved["preset"], **preset}, **entries)
    rest = {name: given[name] for name in ("keys", "uncertainty_class", "uncertainty_kwargs") if name in given}
    return {**saved, **rest, "preset": asdict(complete)}


class _Spaces:
    """What the buffer's check reads of an environment."""

    def __init__(self, model: BaseAlgorithm) -> None:
        self.observation_space, self.action_space = as_dict_space(model.observation_space), model.action_space
        self.num_envs = model.n_envs


def _check_buffer(buffer: EpisodeBuffer, model: BaseAlgorithm) -> None:
    """:raises ValueError: if the buffer was filled in environments of another kind or number"""
    assert isinstance(buffer.observation_space, spaces.Dict)
    check_environment(_Spaces(model), buffer.observation_space, buffer.action_space, buffer.n_envs)
