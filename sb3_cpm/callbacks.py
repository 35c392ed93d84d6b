"""
The conductor: drives the challenger during ``model.learn()`` (Algorithm 1 of the report).

Everything goes through SB3's own seams: a callback, a replay buffer class, and a VecEnv wrapper around the model's
environment, through which ``learn()`` takes its steps.
"""

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import Schedule

from sb3_cpm.arguments import SHARE, check, check_arguments, check_names, choice, integer, names_checked
from sb3_cpm.buffers import CPMBuffer, Episode
from sb3_cpm.challenger import Challenger
from sb3_cpm.challenges import CRITERIA, REWARD_TERMS, Proposal
from sb3_cpm.exploration import Decay, ExplorationUnit, ExplorationVecEnv, make_decay, without_exploration
from sb3_cpm.player import check_learning_starts, check_model, original_space, player_keys
from sb3_cpm.presets import ENTRIES, make_preset
from sb3_cpm.stopwatch import Stopwatch
from sb3_cpm.type_aliases import Evaluation
from sb3_cpm.uncertainty import Uncertainty, choose_uncertainty
from sb3_cpm.world_model.observations import how_to_be_read, is_vector, unread

_PARENTHESES = (
    "The callback is the class ChallengerCallback instead of one of its kind: write learn(..., "
    "callback=ChallengerCallback()), with parentheses."
)

#: Episodes in a row that are too short for a challenge before that is said.
MANY_SHORT = 10


class ChallengerCallback(BaseCallback):
    """
    Lets a challenger explore beside an off-policy SB3 agent and propose challenges to its :class:`CPMBuffer`.

    ::

        model = SAC("MultiInputPolicy", env, replay_buffer_class=CPMBuffer)
        model.learn(100_000, callback=ChallengerCallback())

    After ``learn()`` the callback still holds the trained challenger; using the callback for a second ``learn()`` goes on
    with it. Logged under ``challenger/`` (losses), ``challenge/`` (coefficients, tolerances, acceptance) and
    ``rollout/exploration_rate``.

    :param preset: sizes and learning rates of the challenger, the name of one of :data:`sb3_cpm.presets.PRESETS` or a dict
    :param keys: observation keys that the challenger reads. None: all images and vectors, not point clouds (with the
        preset ``"report_images"``: all images)
    :param uncertainty_class: estimator of epistemic uncertainty, a name or a class; None: the preset's
    :param uncertainty_kwargs: its arguments
    :param challenger_kwargs: entries of the preset to override
    :param decay: decay model of the exploration probability epsilon, a name or a function of the remaining progress,
        see :func:`~sb3_cpm.exploration.make_decay`
    :param decay_kwargs: its start, floor and rate
    :param decay_steps: number of environment steps (over all environments, as ``model.num_timesteps``) that the decay takes.
        None: it runs from the beginning to the end of ``learn()``, as SB3's schedules do. Give it where training goes on in
        portions, ``learn(..., reset_num_timesteps=False)`` again and again: else the first portion holds the whole decay, and
        each further one repeats a piece of its end
    :param unit: whether P or C acts is drawn per ``"step"``, ``"segment"`` or ``"episode"``
    :param segment_length: number of steps in a segment
    :param train_freq: number of environment steps (over all environments) between the challenger's updates; those that fall
        due in a rollout are made at its end
    :param gradient_steps: number of its updates then
    :param demonstration_challenges: for each episode that ends, the probability that one of the demonstrations is proposed,
        too, as a trajectory to cut a challenge from
    :param load_path: a challenger saved by :meth:`save` to start from
    :param device: PyTorch device of the challenger; "auto": the model's
    :param verbose: as SB3's callbacks have it; this one says nothing of its own
    :raises ValueError: for arguments that cannot work, naming the nearest where one is misspelt; in ``learn()``, before any
        training, for models that this cannot work with
    """

    @names_checked()
    def __init__(
        self,
        preset: str | dict[str, Any] = "default",
        keys: Sequence[str] | None = None,
        uncertainty_class: str | type[Uncertainty] | None = None,
        uncertainty_kwargs: dict[str, Any] | None = None,
        challenger_kwargs: dict[str, Any] | None = None,
        decay: str | Schedule = "linear",
        decay_kwargs: dict[str, Any] | None = None,
        decay_steps: int | None = None,
        unit: ExplorationUnit = "segment",
        segment_length: int = 20,
        train_freq: int = 8,
        gradient_steps: int = 1,
        demonstration_challenges: float = 0.0,
        load_path: str | Path | None = None,
        device: th.device | str = "auto",
        verbose: int = 0,
    ):
        super().__init__(verbose)
        if isinstance(keys, Mapping) and isinstance(preset, Mapping) and "self" in preset:  # SB3 calls it as a function
            raise ValueError(_PARENTHESES)
        check("train_freq", train_freq, integer(1))
        check("gradient_steps", gradient_steps, integer(0))
        check("demonstration_challenges", demonstration_challenges, SHARE)
        check("unit", unit, choice("step", "segment", "episode"))
        check("segment_length", segment_length, integer(1))
        check_arguments("decay_kwargs", decay_kwargs, make_decay, excluded=("decay",))
        if decay_steps is not None:
            check("decay_steps", decay_steps, integer(1))
        if challenger_kwargs is not None:
            _check_challenger_kwargs(challenger_kwargs)
        choose_uncertainty(uncertainty_class, uncertainty_kwargs, make_preset(preset, **(challenger_kwargs or {})))
        self.preset = preset
        self.keys = keys
        self.uncertainty_class = uncertainty_class
        self.uncertainty_kwargs = uncertainty_kwargs
        self.challenger_kwargs = challenger_kwargs or {}
        if callable(decay) and decay_kwargs:
            raise ValueError(f"decay_kwargs {decay_kwargs} are for decays by name, but `decay` is a function, {decay!r}.")
        self.decay = make_decay(decay, **(decay_kwargs or {}))
        self.decay_steps = decay_steps
        self.unit = unit
        self.segment_length = segment_length
        self.train_freq = train_freq
        self.gradient_steps = gradient_steps
        self.demonstration_challenges = demonstration_challenges
        self.load_path = load_path
        self.device = device

        #: Made in the first ``learn()``, from the model's spaces.
        self.challenger: Challenger | None = None
        #: What was proposed from the episodes of the rollout that ended last.
        self.proposals: list[tuple[Episode, Proposal]] = []
        self.stopwatch = Stopwatch()
        self._env: ExplorationVecEnv | None = None
        self._learn_started = 0.0
        self._next_training = 0
        self._goes_on = False  # with the moment of the next training that load_state_dict() has set
        self._to_load: Mapping[str, Any] | None = None  # once there is a challenger
        self._n_short = 0
        #: What was warned of once already.
        self._told: set[str] = set()

    # ------------------------------------------------------------------ public

    @property
    def epsilon(self) -> float:
        """Probability that C, not P, acts now."""
        if self.decay_steps is None:
            return float(self.decay(self.model._current_progress_remaining))
        return float(self.decay(max(1.0 - self.model.num_timesteps / self.decay_steps, 0.0)))

    @property
    def buffer(self) -> CPMBuffer:
        """D and I of the model."""
        assert isinstance(self.model.replay_buffer, CPMBuffer)  # type: ignore[attr-defined]
        return self.model.replay_buffer  # type: ignore[attr-defined]

    @property
    def explored_share(self) -> float:
        """Share of the actions of this ``learn()`` that C gave; nan before the first."""
        if self._env is None or self._env.n_actions == 0:
            return float("nan")
        return self._env.n_explored / self._env.n_actions

    @property
    def exploration_env(self) -> ExplorationVecEnv | None:
        """The wrapper through which the player takes its steps in this ``learn()``; None before the first."""
        return self._env

    @property
    def arguments(self) -> dict[str, Any]:
        """What it was made with: ``ChallengerCallback(**callback.arguments)`` is one like it, with a new challenger."""
        names = (
            *("preset", "keys", "uncertainty_class", "uncertainty_kwargs", "challenger_kwargs", "decay_steps", "unit"),
            *("segment_length", "train_freq", "gradient_steps", "demonstration_challenges", "load_path", "device", "verbose"),
        )
        decay = self.decay.arguments if isinstance(self.decay, Decay) else {"decay": self.decay}
        return {**{name: getattr(self, name) for name in names}, **decay}

    def state_dict(self) -> dict[str, Any]:
        """
        What :meth:`load_state_dict` needs to go on exactly here, but for torch's random state.

        :return: ``"challenger"``: networks, optimizers and scales, tensors that are not copied (None before there is one);
            ``"progress"``: plain data
        """
        return {
            "challenger": None if self.challenger is None else self.challenger.state_dict(include_rng=False),
            "progress": {"next_training": self._next_training, "n_short": self._n_short, "told": sorted(self._told)},
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """
        Go on where another callback with the same arguments was: the next ``learn()`` trains the challenger when that one
        would have.

        :param state: of :meth:`state_dict`. Without a challenger in it, this callback's stays as it is; where this callback
            has none yet, the first ``learn()`` gives it that of the state
        :raises ValueError: if it belongs to a challenger of other sizes, naming the first mismatch; nothing is changed then
        """
        if self.challenger is None:
            self._to_load = state
        elif state["challenger"] is not None:
            self.challenger.load_state_dict(state["challenger"])
        progress = state["progress"]
        self._next_training, self._n_short, self._told = progress["next_training"], progress["n_short"], set(progress["told"])
        self._goes_on = True

    def save(self, path: str | Path) -> None:
        """
        Save the challenger, with optimizers and scales, for ``ChallengerCallback(load_path=...)``.

        :param path: file to write, replaced only once it is complete
        :raises RuntimeError: before the first ``learn()``
        """
        if self.challenger is None:
            raise RuntimeError("There is no challenger to save yet: it is made when learn() starts")
        self.challenger.save(path)

    # ------------------------------------------------------------------ SB3's hooks

    def init_callback(self, model: Any = None) -> None:
        """As the parent's, which SB3 calls on whatever stands in a list of callbacks: on the class, ``self`` is the model."""
        if not isinstance(self, ChallengerCallback):
            raise ValueError(_PARENTHESES)
        super().init_callback(model)

    def _init_callback(self) -> None:
        model = self.model
        check_model(model)
        check_learning_starts(model)  # type: ignore[arg-type]
        if self.challenger is None:
            self.challenger = self._make_challenger()
        elif (self.challenger.observation_space, self.challenger.action_space) != (original_space(model), model.action_space):
            raise ValueError(
                "This callback's challenger belongs to other spaces than the model's: it has "
                f"{self.challenger.observation_space} and {self.challenger.action_space}, the model "
                f"{original_space(model)} and {model.action_space}. Make a new ChallengerCallback."
            )

    def _make_challenger(self) -> Challenger:
        assert isinstance(self.model.action_space, spaces.Box)
        challenger = Challenger(
            original_space(self.model),
            self.model.action_space,
            device=self.model.device if self.device == "auto" else self.device,
            preset=self.preset,
            keys=self.keys,
            uncertainty_class=self.uncertainty_class,
            uncertainty_kwargs=self.uncertainty_kwargs,
            **self.challenger_kwargs,
        )
        if self.load_path is not None:
            challenger.load_state(self.load_path)
        if self._to_load is not None and self._to_load["challenger"] is not None:
            challenger.load_state_dict(self._to_load["challenger"])
        self._to_load = None
        return challenger

    def _on_training_start(self) -> None:
        model = self.model
        assert self.challenger is not None and isinstance(model, OffPolicyAlgorithm)
        taken = self.buffer.has_challenger  # of this very learn()
        self._detach()
        if taken:
            raise ValueError("There are two ChallengerCallbacks in this learn(): a player has one challenger. Leave one out.")
        self._warn_of_restarted_decay()
        self._warn_of_strange_challenges()
        env, buffer = without_exploration(model.env), self.buffer
        if buffer.player_keys is None:
            buffer.player_keys = player_keys(model)
        self._warn_of_unread_keys(buffer.player_keys)
        for d in (buffer, buffer.demonstrations):  # model.set_env() does not tell them, and HER computes rewards in theirs
            if d is not None:
                d.env = env
        # somebody may have evaluated in the environment since an earlier learn(); at a new beginning SB3 has reset it
        earlier = self._env
        moved = earlier is not None and earlier.unwrapped is env.unwrapped and earlier.moved
        moved = moved and not self.locals["reset_num_timesteps"]
        last_obs = model._last_obs if model._vec_normalize_env is None else model._last_original_obs
        self._env = ExplorationVecEnv(
            env,
            self.challenger,
            lambda: self.epsilon,
            last_obs,  # type: ignore[arg-type]
            self.unit,
            self.segment_length,
            self.stopwatch,
            on_failure=self._detach,
            on_moved=self._begin_anew,
        )
        self._env.moved = moved
        model.env = self._env
        self._learn_started = model.start_time
        buffer.attach_challenger(self._is_running, self.stopwatch)
        if not buffer.challenge_ratio and (model.replay_buffer_kwargs or {}).get("challenge_ratio", 1):
            warnings.warn(
                "The replay buffer has challenge_ratio=0, as one that Dreamer has filled: the player will be given no "
                "challenges. Set model.replay_buffer.challenge_ratio (the default is 0.25), or make the model with "
                "replay_buffer_kwargs=dict(challenge_ratio=0).",
                stacklevel=2,
            )
        if not self._goes_on:  # what came before learning_starts, and what an earlier learn() left, is no backlog
            self._next_training = max(model.num_timesteps + self.train_freq, model.learning_starts + 1)
        self._goes_on = False

    def _warn_of_restarted_decay(self) -> None:
        """Training in portions: a decay over ``learn()`` is over after the first, and C hardly ever acts from then on."""
        if self.decay_steps is not None or self.model._num_timesteps_at_start == 0 or "decay" in self._told:
            return
        before = self.epsilon  # until the first step the progress is that at the end of the last learn(), also after loading
        at_start = float(self.decay(1.0 - self.model.num_timesteps / self.model._total_timesteps))
        if at_start > before + 0.02:  # a little more of a long run is no new beginning
            self._told.add("decay")
            warnings.warn(
                f"The exploration probability had fallen to {before:.3g} and begins again at {at_start:.3g}: "
                "its decay runs within each learn(). ChallengerCallback(decay_steps=...), the number of steps of all portions "
                "together, makes it one decay.",
                stacklevel=2,
            )

    def _warn_of_strange_challenges(self) -> None:
        """What an earlier challenger found new says nothing of what this one does."""
        assert self.challenger is not None
        if self.challenger.trained_updates or not self.buffer.counters.proposed:
            return
        warnings.warn(
            f"The replay buffer holds {len(self.buffer.challenges)} challenges, coefficients and tolerances of an earlier "
            "challenger, and this callback's is new: they do not fit what it finds new. Give learn() the callback that filled "
            "the buffer, or its challenger: ChallengerCallback(load_path=...) reads what callback.save(path) wrote. "
            "CheckpointCPMCallback and resume() keep them together.",
            stacklevel=2,
        )

    def _warn_of_unread_keys(self, player_keys: Sequence[str] | None) -> None:
        """
        Of a Dict that P and C share, each leaves out what the other may read. What neither does is lost; and what P reads but
        C cannot plays no role for what is new.
        """
        if self.keys is not None or "unread" in self._told:  # the user has chosen, or knows
            return
        self._told.add("unread")
        assert self.challenger is not None
        images_only = not self.challenger.preset.read_vectors  # then vectors are left out on purpose
        for key, space in unread(self.challenger.observation_space, self.challenger.keys).items():
            if images_only and is_vector(space):
                continue
            if player_keys is None or key in player_keys:
                what = f"The challenger cannot read {key!r} ({space}), so for it no state is new because of that."
                cure = how_to_be_read(space)
            else:
                what = f"Neither player nor challenger reads {key!r} ({space})."
                cure = f"{how_to_be_read(space)} Or take MultiInputPolicy, which reads it."
            warnings.warn(f"{what} {cure} To say nothing of it, name the `keys` to read.", stacklevel=2)

    def _on_rollout_start(self) -> None:
        self.stopwatch.stop("P trains")
        self.stopwatch.start("P acts")
        if self._env is not None:
            self._env.active = True
            # SB3 has taken hold of the wrapper for this rollout. For all others the environment is as it was: EvalCallback
            # walks its wrappers, and an exception of another callback, of which we hear nothing, leaves nothing behind
            if self.model.env is self._env:
                self.model.env = self._env.venv

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        self.stopwatch.stop("P acts")
        try:
            self._propose_challenges()
            self._refresh_challenges()
            self._train_challenger()
        except BaseException:
            self._detach()
            raise
        self.logger.record("rollout/exploration_rate", self.epsilon)
        if self._env is not None:
            self._env.active = False
            if self.model.env is self._env.venv:  # else somebody has set another one
                self.model.env = self._env
        self.stopwatch.start("P trains")

    def _on_training_end(self) -> None:
        self._detach()

    # ------------------------------------------------------------------ Algorithm 1

    def _propose_challenges(self) -> None:
        """Lines 4 to 19: rate every state of the new trajectories, choose, filter, cut and relabel."""
        assert self.challenger is not None
        self.proposals = []
        episodes = self.buffer.pop_completed()
        self.buffer.remember_call(episodes)
        self._warn_of_short(episodes)
        for episode in [*episodes, *self._drawn_demonstrations(len(episodes))]:
            if self.challenger.trained_updates == 0:
                with self.stopwatch.section("bookkeeping"):
                    self.buffer.remember_reward(episode)  # what an untrained model says about novelty is noise
                continue
            evaluation = self._evaluate(episode)
            with self.stopwatch.section("bookkeeping"):
                proposal = self.buffer.propose(episode, evaluation)
                if proposal is not None:
                    self.proposals.append((episode, proposal))
                    self._log_proposal(proposal)

    def _drawn_demonstrations(self, n_episodes: int) -> list[Episode]:
        """Beyond the report: demonstrations to propose from, beside so many episodes."""
        assert self.challenger is not None
        if not self.demonstration_challenges or not self.challenger.trained_updates:
            return []
        n = np.random.binomial(n_episodes, self.demonstration_challenges)
        return [self.buffer.draw_demonstration() for _ in range(n)]

    def _warn_of_short(self, episodes: Sequence[Episode]) -> None:
        """Now and then one is no matter; where all are, there will never be a challenge, and nothing else would tell."""
        first = self.buffer.curator.warmup_steps
        for episode in episodes:  # F5: the first transition that counts is no goal
            self._n_short = self._n_short + 1 if episode.length < first + 2 else 0
            if self._n_short == MANY_SHORT and "short" not in self._told and self.buffer.challenge_ratio:
                self._told.add("short")
                warnings.warn(
                    f"{MANY_SHORT} episodes in a row had fewer than {first + 2} steps. They give no challenges: the first "
                    f"warmup_steps={first} never count, and a goal comes after at least one that does. Give "
                    "replay_buffer_kwargs a smaller warmup_steps (what C thinks of first steps is guesswork), or leave "
                    "challenges out with challenge_ratio=0.",
                    stacklevel=2,
                )

    def _evaluate(self, episode: Episode) -> Evaluation:
        """What the challenger, as it is now, thinks of an episode that is still in D, or of a demonstration."""
        assert self.challenger is not None
        with self.stopwatch.section("bookkeeping"):
            observations = self.buffer.episode_observations(episode, self.challenger.keys)
            actions = self.buffer.episode_actions(episode)
        with self.stopwatch.section("C evaluates"):
            return self.challenger.evaluate(observations, actions)

    def _refresh_challenges(self) -> None:
        """Beyond the report: what today's world model thinks of the challenges in I, every ``refresh_every`` transitions."""
        for challenge in self.buffer.due_for_refresh():
            evaluation = self._evaluate(challenge.episode)
            with self.stopwatch.section("bookkeeping"):
                change = self.buffer.refresh(challenge, evaluation)
            self.logger.record_mean("challenge/refresh_change", change)
        age = self.buffer.pop_sampled_age()
        if age is not None:
            self.logger.record_mean("challenge/sampled_age", age)

    def _train_challenger(self) -> None:
        """Line 21: train world model, ensemble, and C's actor and critic on D."""
        assert self.challenger is not None
        for _ in range(self._due_trainings() * self.gradient_steps):
            with self.stopwatch.section("buffer"):
                batch = self.buffer.sample_sequences(
                    self.challenger.batch_size, self.challenger.sequence_length, self.challenger.keys
                )
            with self.stopwatch.section("C trains"):
                metrics = self.challenger.train(batch)
            for name, value in metrics.items():
                self.logger.record_mean(f"challenger/{name}", value)
            self.logger.record("challenger/n_updates", self.challenger.trained_updates, exclude="tensorboard")

    def _due_trainings(self) -> int:
        """:return: how many times C's training has fallen due; not while there is nothing to learn from, nor later for then"""
        now = self.model.num_timesteps
        if not self.buffer.episodes_ended:
            self._next_training = max(self._next_training, now + 1)
        due = max((now - self._next_training) // self.train_freq + 1, 0)
        self._next_training += due * self.train_freq
        return due

    def _log_proposal(self, proposal: Proposal) -> None:
        for name, value in proposal.coefficients.items():
            self.logger.record(f"challenge/{name}", value)
        counters = self.buffer.counters
        self.logger.record("challenge/proposed", counters.proposed)
        self.logger.record("challenge/kept", counters.kept)
        self.logger.record("challenge/in_buffer", len(self.buffer.challenges))
        for criterion in CRITERIA:
            self.logger.record(f"challenge/acceptance_{criterion}", 1 - counters.rejected_by[criterion] / counters.proposed)
        self.logger.record_mean("challenge/uncertainty", proposal.uncertainty[proposal.first :].mean())
        self.logger.record_mean("challenge/score_goal", proposal.score[proposal.goal])
        if proposal.artificial is not None:
            self.logger.record_mean("challenge/length", len(proposal.artificial.total))
            self.logger.record_mean("challenge/reward", proposal.artificial.total.mean())
            self.logger.record_mean("challenge/reward_constant", proposal.artificial.constant)
            for term in REWARD_TERMS:
                self.logger.record_mean(f"challenge/reward_{term}", getattr(proposal.artificial, term).mean())

    # ------------------------------------------------------------------ coming and going

    def _is_running(self) -> bool:
        """Whether ``learn()`` is still the one that this callback was given to: an exception ends that without telling us."""
        return self.model.start_time == self._learn_started

    def _begin_anew(self) -> None:
        """
        Somebody has used the training environment, to evaluate in it, say: SB3 would take what comes next for the
        continuation of what it saw last. D ends the running episodes there, as it finds that they are not gone on with.
        """
        model = self.model
        assert self._env is not None
        model._last_obs = self._env.reset()  # type: ignore[assignment]
        model._last_episode_starts = np.ones(self._env.num_envs, dtype=bool)
        if model._vec_normalize_env is not None:
            model._last_original_obs = model._vec_normalize_env.get_original_obs()

    def _detach(self) -> None:
        """Take the wrapper off the model's environment. Harmless when it is not there."""
        for section in ("P trains", "P acts"):
            self.stopwatch.stop(section)
        if self._env is not None:
            self._env.active = False
        self.model.env = without_exploration(self.model.env)
        buffer = self.model.replay_buffer  # type: ignore[attr-defined]
        if isinstance(buffer, CPMBuffer):
            buffer.detach_challenger()

    def __getstate__(self) -> dict[str, Any]:
        """A callback is not part of a saved model, but checkpointing tools may pickle what refers to it."""
        return {**self.__dict__, "_env": None}  # of a running learn()


def _check_challenger_kwargs(given: Any) -> None:
    for name in ("preset", "keys", "uncertainty_class", "uncertainty_kwargs", "device"):
        if isinstance(given, Mapping) and name in given:
            raise ValueError(f"challenger_kwargs are entries of the preset: give {name!r} to ChallengerCallback itself.")
    check_names("challenger_kwargs", given, ENTRIES)
