"""
Sizes and constants of the challenger as plain data (report, section 4.1 and B.1; docs/method.md),
and of what is made of its challenges (4.3 and B.6).

``"report"`` has the report's sizes where it names them, and DreamerV2's for continuous control elsewhere. It also reads
vectors, such as the robot's state, and has a continue head; the report has neither. ``"report_images"`` is the report's own
world model: images only, and two heads, for images and reward. Both leave out the actor-critic for the task, which the report
trains beside that for exploration (``train_task_behavior=True``), and by which C never acts. The number of ensemble heads is
not in the report; 10 is ours. ``"default"`` is small enough for two CPU cores: an update takes about 0.03 CPU seconds for
vectors and 0.06 for two 32x32 cameras. ``"report"`` takes 4 to 6 on one core, nearly all of it for ten large heads that rate
800 x 15 imagined steps: without a GPU add ``imagination_starts=256``, which needs a third of that. A preset of your own is a
dict with the entries that differ from ``"default"``; every entry can also be given to
:class:`~sb3_cpm.challenger.Challenger` as a keyword argument. :class:`Preset` says what each of them means.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, TypeAlias

import numpy as np

from sb3_cpm.arguments import AT_LEAST_0, SHARE, Rule, check, choice, integer, nearest, number


@dataclass(frozen=True, slots=True, kw_only=True)
class Preset:
    """
    Sizes and constants of a challenger. It checks itself; :func:`make_preset` makes one from a name or from the entries that
    differ.

    :raises ValueError: for values that cannot work, saying what they must be
    """

    # what train() is fed with
    batch_size: int
    """Sequences per update."""
    sequence_length: int
    """Rows per sequence."""

    # encoder and decoder
    cnn_depth: int
    """Channels of the first convolution."""
    cnn_layers: int
    """Convolutions, each halves the image; 32x32 becomes 2x2 and an embedding of 32 * cnn_depth."""
    read_vectors: bool
    """Whether vectors are read beside images, where `keys` does not say what is read."""
    vector_layers: int
    """Hidden layers of the MLPs that encode and decode vectors."""
    vector_units: int
    """Size of each of these layers."""
    symlog_vectors: bool
    """Squash vectors with symlog: robust to whatever range the environment uses."""

    # latent state
    latent: Literal["gaussian", "categorical"]
    """Kind of stochastic state, "gaussian" (report) or "categorical" (DreamerV2)."""
    stoch_size: int
    """Stochastic dimensions; number of variables if categorical (32 in DreamerV2)."""
    stoch_classes: int
    """Classes of each variable, categorical only."""
    deter_size: int
    """Deterministic dimensions, units of the GRU."""
    hidden_size: int
    """Size of the layers around the GRU."""

    # heads
    head_layers: int
    """Hidden layers of reward and continue head."""
    head_units: int
    """Size of each of these layers."""
    symlog_rewards: bool
    """Learn symlog(reward), for rewards far from [-1, 1]."""
    reward_gradient: bool
    """Let the reward shape the latents."""
    continue_head: bool
    """Learn where episodes terminate."""

    # losses
    kl_balance: float
    """Share of the prior's side of the KL."""
    kl_scale: float
    """Factor of the KL."""
    free_nats: float
    """KL (batch mean, nats) that costs nothing."""
    reward_scale: float
    """Factor of the reward loss."""
    continue_scale: float
    """Factor of the continue loss."""

    # optimisation
    model_lr: float
    """Learning rate of the world model."""
    actor_lr: float
    """Learning rate of the actors."""
    critic_lr: float
    """Learning rate of the critics."""
    uncertainty_lr: float
    """Learning rate of the ensemble."""
    adam_eps: float
    """Epsilon of Adam."""
    grad_clip: float
    """Greatest gradient norm."""
    weight_decay: float
    """Share of each weight taken away per update."""

    # behaviour in imagination
    horizon: int
    """Imagined steps."""
    imagination_starts: int | None
    """How many states of a batch imagination starts from, None for all."""
    gamma: float
    """Discount."""
    lambda_: float
    """Of the lambda-returns: 0 bootstraps after one step, 1 after all."""
    actor_gradient: Literal["dynamics", "reinforce", "both"]
    """How actors learn: "dynamics", "reinforce" or "both"."""
    reinforce_share: float
    """Share of REINFORCE in "both"."""
    actor_input_gradient: bool
    """Whether returns also reach the actor through the latents that later actions depend on."""
    entropy_scale: float
    """Reward for the entropy of the task's actor."""
    exploration_entropy_scale: float
    """Reward for the entropy of the exploration actor."""
    noise_memory: float
    """Steps that the noise of exploring actions reaches back; 0 is white noise."""
    actor_layers: int
    """Hidden layers of the actors."""
    actor_units: int
    """Size of each of these layers."""
    critic_layers: int
    """Hidden layers of the critics."""
    critic_units: int
    """Size of each of these layers."""
    slow_target: bool
    """Bootstrap from a slow copy of the critic."""
    slow_target_every: int
    """Updates between two copies."""
    train_task_behavior: bool
    """Actor-critic for the task, which the challenger beside a player does not need."""
    train_exploration_behavior: bool
    """Novelty measure and exploration actor-critic, which a plain Dreamer does not need."""

    # speed, see sb3_cpm.world_model.fast.acceleration
    amp: bool
    """Train in bfloat16 mixed precision; pays on GPUs with large images."""
    compile: bool
    """On GPUs CUDA graphs of whole updates, 5 times faster; on CPUs torch.compile, which hardly pays."""

    uncertainty_class: str
    """Name of the uncertainty class, where no `uncertainty_class` is given."""
    uncertainty: Mapping[str, Mapping[str, Any]]
    """Constructor arguments of uncertainty classes, by name; `uncertainty_kwargs` come on top."""

    def __post_init__(self) -> None:
        for key, rule in _RULES.items():
            check(f"Preset entry {key!r}", getattr(self, key), rule)

    @property
    def optimizer_kwargs(self) -> dict[str, float]:
        """What all optimizers have in common."""
        return {"eps": self.adam_eps, "clip": self.grad_clip, "weight_decay": self.weight_decay}


#: Names of a preset's entries.
ENTRIES: tuple[str, ...] = tuple(Preset.__dataclass_fields__)

#: What each of them must be.
_RULES: dict[str, Rule] = {
    **{key: choice(True, False) for key, field in Preset.__dataclass_fields__.items() if field.type is bool},
    **{key: integer(1) for key in ENTRIES if key.endswith(("_size", "_units", "_classes", "_every"))},
    **{key: integer(0) for key in ENTRIES if key.endswith("_layers")},  # an MLP may consist of its output layer
    **{key: integer(1) for key in ("cnn_depth", "cnn_layers", "horizon")},
    **{key: AT_LEAST_0 for key in ENTRIES if key.endswith(("_lr", "_scale"))},
    "noise_memory": AT_LEAST_0,
    "sequence_length": integer(2),  # a transition has two rows
    "imagination_starts": Rule(f"None or {integer(1).words}", lambda value: value is None or integer(1).holds(value)),
    "latent": choice("gaussian", "categorical"),
    "actor_gradient": choice("dynamics", "reinforce", "both"),
    **{key: SHARE for key in ("gamma", "lambda_", "kl_balance", "reinforce_share", "weight_decay")},
    "free_nats": AT_LEAST_0,
    **{key: number("a number above 0", lambda value: value > 0.0) for key in ("adam_eps", "grad_clip")},
    "uncertainty": Rule(
        "a dict of dicts of arguments, by the name of the uncertainty class",
        lambda value: isinstance(value, dict) and all(isinstance(one, dict) for one in value.values()),
    ),
}

REPORT = Preset(
    # what train() is fed with
    batch_size=16,
    sequence_length=50,
    # encoder and decoder
    cnn_depth=32,
    cnn_layers=4,
    read_vectors=True,
    vector_layers=2,
    vector_units=400,
    symlog_vectors=True,
    # latent state
    latent="gaussian",
    stoch_size=50,
    stoch_classes=32,
    deter_size=200,
    hidden_size=200,
    # heads
    head_layers=2,
    head_units=400,
    symlog_rewards=False,
    reward_gradient=True,
    continue_head=True,
    # losses
    kl_balance=0.8,
    kl_scale=1.0,
    free_nats=1.0,
    reward_scale=1.0,
    continue_scale=1.0,
    # optimisation
    model_lr=3e-4,
    actor_lr=8e-5,
    critic_lr=8e-5,
    uncertainty_lr=3e-4,
    adam_eps=1e-5,
    grad_clip=100.0,
    weight_decay=1e-6,
    # behaviour in imagination
    horizon=15,
    imagination_starts=None,
    gamma=0.99,
    lambda_=0.95,
    actor_gradient="dynamics",
    reinforce_share=0.9,
    actor_input_gradient=True,
    entropy_scale=1e-4,
    exploration_entropy_scale=1e-4,
    noise_memory=0.0,
    actor_layers=4,
    actor_units=400,
    critic_layers=3,
    critic_units=400,
    slow_target=True,
    slow_target_every=100,
    train_task_behavior=False,
    train_exploration_behavior=True,
    # speed, see sb3_cpm.world_model.fast.acceleration
    amp=False,
    compile=False,
    uncertainty_class="plan2explore",
    uncertainty={
        "plan2explore": {"heads": 10, "layers": 4, "units": 400, "target": "feat", "metric": "exp"},
        "rnd": {"layers": 3, "units": 400, "output_dim": 64},
        "prediction_error": {"layers": 2, "units": 400},
        "observation_ensemble": {"heads": 10, "layers": 2, "units": 400},
    },
)

DEFAULT = replace(
    REPORT,
    batch_size=8,
    sequence_length=16,
    cnn_depth=8,
    vector_units=128,
    stoch_size=30,
    deter_size=128,
    hidden_size=128,
    head_units=128,
    symlog_rewards=True,
    model_lr=1e-3,
    actor_lr=3e-4,
    critic_lr=3e-4,
    horizon=8,
    imagination_starts=16,
    exploration_entropy_scale=1.0,
    noise_memory=10.0,
    actor_layers=2,
    actor_units=128,
    critic_layers=2,
    critic_units=128,
    uncertainty={
        "plan2explore": {"heads": 5, "layers": 2, "units": 128, "target": "feat", "metric": "exp"},
        "rnd": {"layers": 3, "units": 128, "output_dim": 64},
        "prediction_error": {"layers": 2, "units": 128},
        "observation_ensemble": {"heads": 5, "layers": 2, "units": 128, "dims": 128},
    },
)

#: The report's own world model, of images alone and without a continue head [B.1].
REPORT_IMAGES = replace(REPORT, read_vectors=False, continue_head=False)

#: The same networks for an agent that learns from its imagination alone, as Dreamer does: larger updates.
DREAMER = replace(DEFAULT, sequence_length=32, horizon=15, imagination_starts=64)

PRESETS: dict[str, Preset] = {"default": DEFAULT, "dreamer": DREAMER, "report": REPORT, "report_images": REPORT_IMAGES}

#: What stands for a preset: its name, one, or the entries that differ from the default.
PresetLike: TypeAlias = str | Preset | Mapping[str, Any]

#: Arguments of :class:`~sb3_cpm.buffers.CPMBuffer`: how challenges are used. "report" has its constants, which are the
#: buffer's defaults, too. "tuned" makes less of challenges: on a dense reward those of the report slow the player down
#: (docs/experiments.md says on which seeds that was found).
CHALLENGES: dict[str, dict[str, Any]] = {
    "report": {
        "challenge_ratio": 0.25,  # share of I in what the player trains on
        "mix": "batch",  # a whole batch from I now and then
        "max_challenges": 10,  # size of I
        "reward_kwargs": {"exploration_ratio": 1 / 1.5, "scale": 0.5},  # uncertainty is worth two thirds of the task reward
    },
    "tuned": {
        "challenge_ratio": 0.1,
        "mix": "row",  # a tenth of every batch: none consists of ten trajectories alone
        "max_challenges": 100,
        "reward_kwargs": {"exploration_ratio": 0.1, "scale": 0.86},  # mean(r') = 0.86 * (1 + 0.1 * 1.6) * mean(r) = mean(r)
    },
}


def make_preset(preset: PresetLike = "default", base: str = "default", **overrides: Any) -> Preset:
    """
    A complete preset.

    :param preset: name of a preset, or one, or the entries that differ from ``base``
    :param base: name of the preset that entries are filled up from
    :param overrides: further entries, they win. Each replaces a whole entry, `uncertainty` too: give single arguments as
        `uncertainty_kwargs`
    :return: of plain Python numbers: NumPy's scalars would make a saved file unreadable
    :raises ValueError: for unknown names (with the nearest valid one), and values that cannot work, saying what they must be
    """
    if isinstance(preset, str):
        if preset not in PRESETS and preset in CHALLENGES:
            raise ValueError(
                f"{preset!r} is no preset of the challenger, it says what becomes of challenges: give it to the buffer, "
                f"replay_buffer_kwargs=sb3_cpm.presets.CHALLENGES[{preset!r}] (in zoo_configs/ it is cpm_sac_{preset}.yml). "
                f"Valid: {sorted(PRESETS)}."
            )
        if preset not in PRESETS:
            raise ValueError(f"Unknown preset {preset!r}.{nearest(preset, PRESETS, cutoff=0.0)} Valid: {sorted(PRESETS)}.")
        start = PRESETS[preset]
    elif isinstance(preset, Preset):
        start = preset
    elif isinstance(preset, Mapping):
        start, overrides = PRESETS[base], {**preset, **overrides}
    else:
        raise ValueError(f"`preset` must be a name ({sorted(PRESETS)}) or a dict of entries, got {preset!r}.")
    for key in overrides:
        if key not in ENTRIES:
            raise ValueError(f"Unknown preset entry {key!r}.{nearest(key, ENTRIES, cutoff=0.0)} Valid: {sorted(ENTRIES)}.")
    return Preset(**plain({**asdict(start), **overrides}))


def plain(value: Any) -> Any:
    """
    :param value: a number, or dicts, lists and tuples of them
    :return: the same with Python's numbers in place of NumPy's scalars; everything else stays what it is
    """
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Mapping):
        return {key: plain(one) for key, one in value.items()}
    if type(value) in (list, tuple):
        return type(value)(plain(one) for one in value)
    return value
