"""
Behaviour cloning: an actor of Stable-Baselines3 learns to do what demonstrations do.

The model keeps its policy as it is; what is trained is whatever its deterministic action depends on, found by asking
autograd. So critics, standard deviations and entropy coefficients stay as they are, bit for bit, and features extractors are
trained where the actor reads through them.
"""

import math
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, unwrap_vec_normalize
from torch import nn

from sb3_cpm.arguments import ABOVE_0, check, check_each, choice, integer, names_checked, number
from sb3_cpm.buffers import CPMBuffer, Demonstration
from sb3_cpm.buffers.demonstrations import as_arrays
from sb3_cpm.dreamer.spaces import OBSERVATION
from sb3_cpm.imitation.callback import demonstrations_for
from sb3_cpm.imitation.loading import Source
from sb3_cpm.imitation.progress import progress

#: Evaluations on held-out episodes over all updates.
N_EVALUATIONS = 50
#: Rows that go through the network at once where nothing is learned.
EVALUATION_ROWS = 1024
#: A squashed Gaussian gives 1 and -1 no finite likelihood: these are as near as demonstrated actions come to them.
LARGEST_SQUASHED = 0.999
#: Attribute of a model that was cloned by :class:`CloneCallback`, saved with it: rounds of PPO in which only the value learns.
WARMUP_LEFT = "critic_warmup_left"

#: Observations and actions of a demonstration.
Arrays = tuple[dict[str, np.ndarray], np.ndarray]


class CloneResult(NamedTuple):
    """
    What :func:`clone` has done.

    :param updates: how many were made
    :param best_update: the one whose parameters the model has
    :param n_episodes: demonstrations that were learned from
    :param n_transitions: their transitions
    :param n_held_out: transitions of the demonstrations that were held out
    :param loss: mean training loss of the last updates up to ``best_update``
    :param validation_loss: there, on the episodes that were held out; None where none were
    :param curve: of every evaluation its update, training and validation loss
    :param seconds: wall-clock time of the updates
    """

    updates: int
    best_update: int
    n_episodes: int
    n_transitions: int
    n_held_out: int
    loss: float
    validation_loss: float | None
    curve: list[tuple[int, float, float | None]]
    seconds: float

    def scalars(self) -> dict[str, float]:
        """:return: what one seed decides, by name, for a logger"""
        given = {**self._asdict(), "seconds": None}
        return {name: value for name, value in given.items() if isinstance(value, (int, float))}


def clone(
    model: BaseAlgorithm,
    demonstrations: Sequence[Demonstration],
    env: VecEnv | None = None,
    n_updates: int = 50_000,
    batch_size: int = 256,
    learning_rate: float = 3e-4,
    loss: str = "mse",
    anneal: bool = True,
    keep_best: bool = True,
    validation: float = 0.1,
    patience: int | None = None,
    seed: int | None = None,
    callback: Callable[[int, float, float | None], bool | None] | None = None,
    progress_bar: bool = False,
) -> CloneResult:
    """
    Train the actor of a model on demonstrated actions. Defaults: ManiSkill2 (Gu et al. 2023), 50,000 updates of 256.

    ``"mse"`` is between the deterministic action and the demonstrated one, both scaled to [-1, 1]; ``"nll"`` the negative log
    likelihood under the policy's distribution, whose standard deviation stays (that of SAC follows its features). Target
    networks that follow the actor slowly in training get its parameters at once.

    Where a ``VecNormalize`` counts observations, it counts those of the demonstrations first, as if they had been seen in
    training, and the actor learns from what it makes of them.

    :param model: PPO, A2C, SAC, TQC, TD3, DDPG or one like them, with continuous actions
    :param demonstrations: of its environment, observations as this gives them, un-normalized
    :param env: environments whose ``VecNormalize`` is to be used; None: the model's
    :param n_updates: at most
    :param batch_size: rows of an update, drawn with replacement
    :param learning_rate: of an Adam of its own
    :param loss: ``"mse"`` or ``"nll"``
    :param anneal: let the learning rate fall to 0 as a cosine
    :param keep_best: end with the parameters that did best on held-out episodes
    :param validation: share of the episodes that are held out; with less than two episodes none is
    :param patience: evaluations, of which there are 50 over all updates, without a new best before it ends; None: never
    :param seed: of what is held out, and of the batches; None: the model's
    :param callback: is given number of updates, training and validation loss at every evaluation; False ends the clone there
    :param progress_bar: show one
    :return: what came of it
    :raises ValueError: for models and demonstrations that cannot be, and if the loss is not finite; the model is as it was
    """
    _check_arguments(n_updates, batch_size, learning_rate, loss, validation, patience)
    policy = _actor_policy(model, loss)
    generator = np.random.default_rng(model.seed if seed is None else seed)
    episodes = read_arrays(model, demonstrations)
    normalize = model.get_vec_normalize_env() if env is None else unwrap_vec_normalize(env)
    if normalize is not None and normalize.norm_obs and normalize.training:
        _count(normalize, episodes)
    out = _held_out(len(episodes), validation, generator)
    learned = [one for i, one in enumerate(episodes) if i not in out]
    training = make_rows(policy, learned, normalize)
    held_out = make_rows(policy, [episodes[i] for i in sorted(out)], normalize) if out else None
    learner = _Learner(policy, training, held_out, loss)
    try:
        policy.set_training_mode(True)
        seeds = int(generator.integers(2**31))
        result = learner.learn(
            n_updates, batch_size, learning_rate, anneal, keep_best, patience, seeds, callback, progress_bar
        )
    finally:
        policy.set_training_mode(False)
    _let_targets_follow(policy, learner.parameters)
    return result._replace(n_episodes=len(learned))


def _check_arguments(
    n_updates: int, batch_size: int, learning_rate: float, loss: str, validation: float, patience: int | None
) -> None:
    check_each(integer(1), n_updates=n_updates, batch_size=batch_size)
    check("learning_rate", learning_rate, ABOVE_0)
    check("loss", loss, choice("mse", "nll"))
    check("validation", validation, number("a number from 0 up to, but without 1", lambda value: 0.0 <= value < 1.0))
    if patience is not None:
        check("patience", patience, integer(1))


def _actor_policy(model: BaseAlgorithm, loss: str) -> BasePolicy:
    """:raises ValueError: for a model whose actor cannot be trained on actions"""
    policy, name = model.policy, type(model).__name__
    if not isinstance(model.action_space, spaces.Box):
        raise ValueError(f"clone() needs continuous actions (a Box), the action space of this {name} is {model.action_space}.")
    recurrent = hasattr(policy, "lstm_actor")
    if recurrent or not (isinstance(policy, ActorCriticPolicy) or isinstance(getattr(policy, "actor", None), BasePolicy)):
        raise ValueError(
            f"clone() trains actors that see one observation, of PPO, A2C, SAC, TQC, TD3 or DDPG; the policy of this {name} "
            f"is {type(policy).__name__}."
        )
    if loss == "nll" and not (isinstance(policy, ActorCriticPolicy) or hasattr(policy.actor, "action_dist")):
        raise ValueError(f"loss='nll' needs a policy with a distribution of actions; {name} has none: take loss='mse'.")
    return policy


# ---------------------------------------------------------------------- data


class DemonstratedRows:
    """
    Transitions on the device of a policy, so that a batch is one gather of each array.

    :param policy: that reads them
    :param observations: by key, shape ``(n, ...)``; as the policy's ``observation_space`` has them
    :param actions: within [-1, 1], shape ``(n, action_dim)``
    """

    def __init__(self, policy: BasePolicy, observations: dict[str, np.ndarray], actions: np.ndarray) -> None:
        self.is_dict = isinstance(policy.observation_space, spaces.Dict)
        self.observations = {key: th.as_tensor(rows, device=policy.device) for key, rows in observations.items()}
        self.actions = th.as_tensor(actions, device=policy.device)

    def __len__(self) -> int:
        return len(self.actions)

    def batch(self, rows: th.Tensor | slice) -> tuple[PyTorchObs, th.Tensor]:
        """:return: observations as the policy takes them, and actions"""
        observations = {key: one[rows] for key, one in self.observations.items()}
        return observations if self.is_dict else observations[OBSERVATION], self.actions[rows]


def read_arrays(model: BaseAlgorithm, demonstrations: Sequence[Demonstration]) -> list[Arrays]:
    """
    :param model: that is to learn from them
    :param demonstrations: of its environment
    :return: observations by key (:data:`OBSERVATION` where there are none), shape ``(T + 1, ...)``, and actions within [-1, 1]
    :raises ValueError: if there are none, or they do not fit
    """
    demonstrations = list(demonstrations)
    if not demonstrations:
        raise ValueError(
            f"{type(model).__name__} got no demonstrations to learn from: record some, record_demonstrations(env, "
            "n_episodes=200), or read a file with load_demonstrations(path, env)."
        )
    space = model.observation_space
    if not isinstance(space, spaces.Dict):
        space = spaces.Dict({OBSERVATION: space})
    return [(one, actions) for one, actions, _ in as_arrays(demonstrations, space, model.action_space)]


def make_rows(policy: BasePolicy, episodes: Sequence[Arrays], normalize: VecNormalize | None) -> DemonstratedRows:
    """
    :param policy: whose actor reads them
    :param episodes: of :func:`read_arrays`
    :param normalize: what the observations go through first, as it is now
    :return: their transitions
    """
    observations = _stacked(episodes, _keys_of_actor(policy))
    if normalize is not None and normalize.norm_obs:
        statistics = _statistics(normalize)
        observations = {
            key: normalize._normalize_obs(rows, statistics[key]) if key in statistics else rows
            for key, rows in observations.items()
        }
    return DemonstratedRows(policy, observations, np.concatenate([actions for _, actions in episodes]))


def _stacked(episodes: Sequence[Arrays], keys: Iterable[str]) -> dict[str, np.ndarray]:
    """Observations that an action was taken in, by key."""
    return {key: np.concatenate([observations[key][:-1] for observations, _ in episodes]) for key in keys}


def _statistics(normalize: VecNormalize) -> dict[str, RunningMeanStd]:
    found = normalize.obs_rms
    return found if isinstance(found, dict) else {OBSERVATION: found}


def _count(normalize: VecNormalize, episodes: Sequence[Arrays]) -> None:
    """As though the observations had been seen in training."""
    statistics = _statistics(normalize)
    for key, rows in _stacked(episodes, statistics).items():
        statistics[key].update(rows)


def _held_out(n_episodes: int, share: float, generator: np.random.Generator) -> set[int]:
    """:return: which episodes are held out: at least one, where there is one to spare"""
    n = min(math.ceil(share * n_episodes), n_episodes - 1)
    return set(generator.permutation(n_episodes)[:n].tolist())


def _keys_of_actor(policy: BasePolicy) -> list[str]:
    """What the actor's features extractor reads, where it tells, else everything."""
    space = policy.observation_space
    if not isinstance(space, spaces.Dict):
        return [OBSERVATION]
    actor = policy if isinstance(policy, ActorCriticPolicy) else policy.actor
    extractor = getattr(actor, "pi_features_extractor", getattr(actor, "features_extractor", None))
    read = getattr(extractor, "player_keys", None)
    return [key for key in space.spaces if read is None or key in read]


# ---------------------------------------------------------------------- learning


def actor_parameters(policy: BasePolicy, observations: PyTorchObs) -> list[nn.Parameter]:
    """
    :param policy: of any of SB3's actor-critics
    :param observations: some
    :return: the parameters that the deterministic action depends on, a features extractor's among them, in the policy's order
    """
    parameters = [one for one in policy.parameters() if one.requires_grad]
    action = policy._predict(observations, deterministic=True)
    if not action.requires_grad:
        return []
    gradients = th.autograd.grad(action.sum(), parameters, allow_unused=True)
    return [one for one, gradient in zip(parameters, gradients, strict=True) if gradient is not None]


class ActionLoss:
    """
    How far a policy is from demonstrated actions.

    :param policy: whose actions are continuous and bounded
    """

    def __init__(self, policy: BasePolicy) -> None:
        assert isinstance(policy.action_space, spaces.Box)
        low, high = (
            th.as_tensor(bound.reshape(-1), dtype=th.float32, device=policy.device)
            for bound in (policy.action_space.low, policy.action_space.high)
        )
        self.policy, self.middle, self.half = policy, (high + low) / 2, (high - low) / 2
        #: SAC, TD3 and their like give actions within [-1, 1], PPO and A2C in the environment's units.
        self.squashed = policy.squash_output

    def mse(self, observations: PyTorchObs, actions: th.Tensor) -> th.Tensor:
        """
        :param observations: as the policy takes them
        :param actions: the demonstrated ones, within [-1, 1], shape ``(batch, action_dim)``
        :return: mean square of the difference to the deterministic action, there
        """
        given = self.policy._predict(observations, deterministic=True).flatten(1)
        return nn.functional.mse_loss(given if self.squashed else (given - self.middle) / self.half, actions)

    def nll(self, observations: PyTorchObs, actions: th.Tensor) -> th.Tensor:
        """
        :param observations: as the policy takes them
        :param actions: the demonstrated ones, within [-1, 1], shape ``(batch, action_dim)``
        :return: mean of their negative log likelihoods
        """
        policy = self.policy
        if self.squashed:
            wanted = actions.clamp(-LARGEST_SQUASHED, LARGEST_SQUASHED)
        else:
            wanted = self.middle + self.half * actions
        if isinstance(policy, ActorCriticPolicy):
            distribution = policy.get_distribution(observations)
        else:
            actor: Any = policy.actor
            mean, log_std, more = actor.get_action_dist_params(observations)
            distribution = actor.action_dist.proba_distribution(mean, log_std, **more)
        return -distribution.log_prob(wanted).mean()


class _Learner:
    """
    :param policy: whose actor learns
    :param training: rows to learn from
    :param held_out: rows to judge by
    :param loss: ``"mse"`` or ``"nll"``
    """

    def __init__(self, policy: BasePolicy, training: DemonstratedRows, held_out: DemonstratedRows | None, loss: str) -> None:
        self.policy, self.training, self.held_out = policy, training, held_out
        self.loss = getattr(ActionLoss(policy), loss)
        policy.set_training_mode(False)
        self.parameters = actor_parameters(policy, training.batch(slice(0, 2))[0])

    def learn(
        self,
        n_updates: int,
        batch_size: int,
        learning_rate: float,
        anneal: bool,
        keep_best: bool,
        patience: int | None,
        seed: int,
        callback: Callable[[int, float, float | None], bool | None] | None,
        progress_bar: bool,
    ) -> CloneResult:
        """See :func:`clone`."""
        device = self.policy.device
        optimizer = th.optim.Adam(self.parameters, lr=learning_rate)
        generator = th.Generator(device).manual_seed(seed)
        every = max(n_updates // N_EVALUATIONS, 1)
        beginning = best = self._state()
        best_entry: tuple[int, float, float | None] | None = None
        curve: list[tuple[int, float, float | None]] = []
        total, counted, started = th.zeros((), device=device), 0, time.perf_counter()
        with progress(n_updates, "update", progress_bar) as show:
            for update in range(1, n_updates + 1):
                if anneal:
                    optimizer.param_groups[0]["lr"] = learning_rate * (1 + math.cos(math.pi * (update - 1) / n_updates)) / 2
                rows = th.randint(len(self.training), (batch_size,), generator=generator, device=device)
                loss = self.loss(*self.training.batch(rows))
                gradients = th.autograd.grad(loss, self.parameters)
                for parameter, gradient in zip(self.parameters, gradients, strict=True):
                    parameter.grad = gradient
                optimizer.step()
                total += loss.detach()
                counted += 1
                if update % every and update != n_updates:
                    continue
                entry = (update, float(total) / counted, self._validate())
                total.zero_()
                counted = 0
                if not all(math.isfinite(value) for value in entry[1:] if value is not None):
                    self._restore(beginning)
                    raise ValueError(
                        f"The clone's loss is {entry[1]:.4g} by update {update}. The model is as it was: lower learning_rate "
                        f"({learning_rate})."
                    )
                curve.append(entry)
                show(every)
                if best_entry is None or not keep_best or entry[2] is None or entry[2] < best_entry[2]:  # type: ignore[operator]
                    best_entry, best = entry, self._state()
                stale = (update - best_entry[0]) // every
                if (callback is not None and callback(*entry) is False) or (patience is not None and stale >= patience):
                    break
        assert best_entry is not None
        self._restore(best)
        for parameter in self.parameters:
            parameter.grad = None
        n_held_out = 0 if self.held_out is None else len(self.held_out)
        return CloneResult(
            updates=curve[-1][0],
            best_update=best_entry[0],
            n_episodes=0,
            n_transitions=len(self.training),
            n_held_out=n_held_out,
            loss=best_entry[1],
            validation_loss=best_entry[2],
            curve=curve,
            seconds=time.perf_counter() - started,
        )

    def _validate(self) -> float | None:
        if self.held_out is None:
            return None
        self.policy.set_training_mode(False)
        total, n = 0.0, len(self.held_out)
        with th.no_grad():
            for first in range(0, n, EVALUATION_ROWS):
                rows = slice(first, min(first + EVALUATION_ROWS, n))
                total += float(self.loss(*self.held_out.batch(rows))) * (rows.stop - rows.start)
        self.policy.set_training_mode(True)
        return total / n

    def _tensors(self) -> list[th.Tensor]:
        """What updates change: parameters, and what layers count (batch normalization)."""
        return [*self.parameters, *self.policy.buffers()]

    def _state(self) -> list[th.Tensor]:
        return [one.detach().clone() for one in self._tensors()]

    def _restore(self, state: list[th.Tensor]) -> None:
        with th.no_grad():
            for one, saved in zip(self._tensors(), state, strict=True):
                one.copy_(saved)


def _let_targets_follow(policy: BasePolicy, trained: Sequence[nn.Parameter]) -> None:
    """Targets get what was trained, too: TD3's actor, and of a critic the features extractor that the actor shares."""
    ids = {id(one) for one in trained}
    with th.no_grad():
        for name in ("actor", "critic"):
            net, target = getattr(policy, name, None), getattr(policy, f"{name}_target", None)
            if net is None or target is None:
                continue
            for one, follower in zip(net.parameters(), target.parameters(), strict=True):
                if id(one) in ids:
                    follower.copy_(one)
            for counted, follower_counted in zip(net.buffers(), target.buffers(), strict=True):
                follower_counted.copy_(counted)


def _set_trainable(parameters: Sequence[nn.Parameter], trainable: bool) -> None:
    for one in parameters:
        one.requires_grad_(trainable)


def policy_gradient_parameters(policy: ActorCriticPolicy) -> list[nn.Parameter]:
    """:return: what PPO's policy loss trains: the actor's parameters, and its standard deviations"""
    sample = {key: np.zeros((2, *space.shape), space.dtype) for key, space in _spaces(policy).items()}
    tensors = {key: th.as_tensor(one, device=policy.device) for key, one in sample.items()}
    policy.set_training_mode(False)
    is_dict = isinstance(policy.observation_space, spaces.Dict)
    found = actor_parameters(policy, tensors if is_dict else tensors[OBSERVATION])
    log_std = getattr(policy, "log_std", None)
    return [*found, log_std] if isinstance(log_std, nn.Parameter) and log_std.requires_grad else found


def _spaces(policy: BasePolicy) -> dict[str, Any]:
    space = policy.observation_space
    return dict(space.spaces) if isinstance(space, spaces.Dict) else {OBSERVATION: space}


class CloneCallback(BaseCallback):
    """
    :func:`clone` when ``learn()`` begins, once in a model's life: a run that is resumed, and a further ``learn()``, go on with
    what there is.

    What PPO learns next would erase the clone as long as its value is a random network's (and also where its actions are much
    noisier than the clone's: give it ``log_std_init=-2.5`` and a learning rate of 1e-4). ``critic_warmup`` rounds train the
    value alone: what the actor reads, and its standard deviation, get no gradient meanwhile, so that neither Adam nor the norm
    that gradients are clipped to know of them. Where both share a features extractor, that belongs to the actor:
    ``policy_kwargs: {share_features_extractor: false}`` gives the value one of its own that learns from the beginning.

    A :class:`~sb3_cpm.buffers.CPMBuffer` with a ``demonstration_ratio`` and no demonstrations gets the same ones.

    In a configuration::

        callback:
          - sb3_cpm.imitation.CloneCallback: {demonstrations: expert, n_episodes: 200, critic_warmup: 4}

    :param demonstrations: ``"expert"``, a file, or a list, see :func:`~sb3_cpm.imitation.load_demonstrations`; None: those
        that the model itself has (:class:`~sb3_cpm.imitation.DAPG`)
    :param n_episodes: how many; None: all that there are
    :param hold: whether an expert goes on to the end of the episode
    :param after_steps: environment steps before the clone, in the first rollout that begins then: evaluations until there show
        the model as it was
    :param critic_warmup: rounds of PPO or A2C at first that train the value alone
    :param log_std: logarithm of the standard deviation that SAC or TQC goes on with, in all states; None: what it has, about 0
        for a new model, and so much noise erases the clone. -2.5 is where the default target entropy leads to. PPO and A2C
        have ``policy_kwargs: {log_std_init: -2.5}``
    :param n_updates: of :func:`clone`, as are the following
    :param batch_size: see there
    :param learning_rate: see there
    :param loss: see there
    :param anneal: see there
    :param keep_best: see there
    :param validation: see there
    :param patience: see there
    :param progress_bar: see there
    :param seed: of the expert and of the clone; None: the model's
    :param verbose: as SB3's callbacks have it; 1: say what the clone has reached
    :raises ValueError: for arguments that cannot work; in ``learn()`` see :func:`clone`
    """

    @names_checked()
    def __init__(
        self,
        demonstrations: Source | None = "expert",
        n_episodes: int | None = 200,
        hold: bool = False,
        after_steps: int = 0,
        critic_warmup: int = 0,
        log_std: float | None = None,
        n_updates: int = 3000,
        batch_size: int = 256,
        learning_rate: float = 1e-3,
        loss: str = "mse",
        anneal: bool = True,
        keep_best: bool = True,
        validation: float = 0.1,
        patience: int | None = None,
        progress_bar: bool = False,
        seed: int | None = None,
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        if n_episodes is not None:
            check("n_episodes", n_episodes, integer(1))
        check_each(integer(0), after_steps=after_steps, critic_warmup=critic_warmup)
        if log_std is not None:
            check("log_std", log_std, number("a number from -20 to 2, as SAC's are", lambda value: -20.0 <= value <= 2.0))
        self.demonstrations = demonstrations
        self.n_episodes = n_episodes
        self.hold = hold
        self.after_steps = after_steps
        self.critic_warmup = critic_warmup
        self.log_std = log_std
        self.seed = seed
        #: Of :func:`clone`.
        self.clone_kwargs: dict[str, Any] = {
            **{"n_updates": n_updates, "batch_size": batch_size, "learning_rate": learning_rate, "loss": loss},
            **{"anneal": anneal, "keep_best": keep_best, "validation": validation, "patience": patience},
            **{"progress_bar": progress_bar, "seed": seed},
        }
        _check_arguments(n_updates, batch_size, learning_rate, loss, validation, patience)
        #: What the clone has reached; None where the model had been cloned before.
        self.result: CloneResult | None = None
        self._episodes: list[Demonstration] = []  # that are yet to be cloned
        self._actor: list[nn.Parameter] = []

    def _on_training_start(self) -> None:
        model = self.model
        if self.critic_warmup and not isinstance(model, OnPolicyAlgorithm):
            raise ValueError(
                f"critic_warmup={self.critic_warmup} counts rounds of PPO or A2C, {type(model).__name__} has none: leave it "
                "out."
            )
        if self.log_std is not None and not isinstance(_log_std_layer(model), nn.Linear):
            raise ValueError(
                f"log_std={self.log_std} is for SAC and TQC without gSDE; {type(model).__name__} has no layer that says its "
                "standard deviation: leave it out, or for PPO and A2C give policy_kwargs=dict(log_std_init=...)."
            )
        if not hasattr(model, WARMUP_LEFT):
            self._episodes = self._find()
            buffer = getattr(model, "replay_buffer", None)
            if isinstance(buffer, CPMBuffer) and buffer.demonstration_ratio and buffer.demonstrations is None:
                buffer.add_demonstrations(self._episodes)
        if model.num_timesteps >= self.after_steps:
            self._clone()

    def _find(self) -> list[Demonstration]:
        if self.demonstrations is None:
            if not hasattr(self.model, "demonstration_episodes"):
                raise ValueError(
                    f"CloneCallback(demonstrations=None) takes those of the model, {type(self.model).__name__} has none: name "
                    "a source, for instance 'expert'."
                )
            return self.model.demonstration_episodes()
        return demonstrations_for(self.model, self.demonstrations, self.n_episodes, self.seed, self.hold)

    def _clone(self) -> None:
        """Once in a model's life; and what follows it."""
        model = self.model
        if not hasattr(model, WARMUP_LEFT):
            self.result = clone(model, self._episodes, **self.clone_kwargs)
            self._episodes = []
            if self.log_std is not None:
                layer = _log_std_layer(model)
                with th.no_grad():
                    layer.weight.zero_()
                    layer.bias.fill_(self.log_std)
            setattr(model, WARMUP_LEFT, self.critic_warmup)
            for name, value in self.result.scalars().items():
                self.logger.record(f"clone/{name}", value)
            if self.verbose:
                print(_news(self.result), flush=True)  # noqa: T201
        if getattr(model, WARMUP_LEFT):
            assert isinstance(model.policy, ActorCriticPolicy)
            self._actor = policy_gradient_parameters(model.policy)

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        left = getattr(self.model, WARMUP_LEFT, 0)
        if left:
            setattr(self.model, WARMUP_LEFT, left - 1)
            _set_trainable(self._actor, False)  # in the update that follows

    def _on_rollout_start(self) -> None:
        if self._episodes and self.num_timesteps >= self.after_steps:
            self._clone()
        _set_trainable(self._actor, True)

    def _on_training_end(self) -> None:
        _set_trainable(self._actor, True)


def _log_std_layer(model: BaseAlgorithm) -> Any:
    return getattr(getattr(model.policy, "actor", None), "log_std", None)


def _news(result: CloneResult) -> str:
    held_out = "" if result.validation_loss is None else f", {result.validation_loss:.4f} on held-out episodes"
    return (
        f"Cloned {result.n_episodes} demonstrations ({result.n_transitions} transitions) in {result.seconds:.0f} s: loss "
        f"{result.loss:.4f}{held_out} after {result.best_update} updates."
    )
