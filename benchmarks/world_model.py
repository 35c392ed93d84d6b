"""
What the challenger costs: its world model, imagination and ensemble beside sheeprl's, whole updates beside r2dreamer's, its
two kinds of latents beside each other, and its share of a run.

::

    pip install -c constraints.txt -e ".[run,maniskill]" sheeprl==0.8.4     # the peer; rows run without it, too
    OMP_NUM_THREADS=1 python benchmarks/world_model.py                      # all rows, 15 minutes
    OMP_NUM_THREADS=1 python benchmarks/world_model.py --rows model32 ensemble --threads 1 --repeats 7
    python benchmarks/world_model.py --device cuda                          # also with `compile` and bfloat16, 3 minutes

    pip install tensordict hydra-core==1.3.2                                # the second peer, which is no package
    git clone https://github.com/NM512/r2dreamer PATH_OF_A_CHECKOUT
    OMP_NUM_THREADS=1 python benchmarks/world_model.py --r2dreamer PATH_OF_A_CHECKOUT --rows r2dreamer32 --threads 1

sheeprl's own compiler takes more than 200 seconds for sequences of 50 steps, so that on a GPU ours with ``compile`` meets its
plain code, unless ``--compile-peer`` is given (with ``--length 8`` it takes a minute). Without ManiSkill (which GPU machines
may lack) a step of the simulator counts as 13 ms and the whole run is that of a task of PickCube's sizes that costs nothing.

On a busy machine set ``OMP_WAIT_POLICY=PASSIVE GOMP_SPINCOUNT=0``: two threads that wait by spinning take it from each other.

Contestants live in one process and take turns on the same batches, so that what else the machine does disturbs both alike;
every number is the median over the turns, every ratio the median of the turns' ratios, after one turn that warms up. Ratios
are of CPU seconds with one thread, and of wall time with more or on a GPU. Prints markdown tables; exits with 1 if a target is
missed.

Sizes: batches of 16 x 50, 7-dimensional actions, a 29-dimensional state beside the images, and the entries of
:data:`CATEGORICAL`; the numbers of parameters are printed. sheeprl's sizes are ours. r2dreamer is a DreamerV3 (categorical
latents, block GRU, RMSNorm, convolutions of stride 1 with pooling, two-hot heads, an actor that learns by REINFORCE, LaProp)
with our sizes only where its configuration can say them, so its rows inform; :mod:`peers.r2dreamer` lists what differs. They
are measured on the CPU, without its compiler and its autocast to float16.
"""

import argparse
import importlib.metadata
import importlib.util
import platform
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple
from unittest.mock import patch

import gymnasium
import numpy as np
import torch
from clock import Clock, Enough, Lap, clocked, median, timed
from gymnasium import spaces

from sb3_cpm.challenger import Challenger
from sb3_cpm.presets import make_preset
from sb3_cpm.type_aliases import SequenceBatch

if TYPE_CHECKING:  # earlier versions, which benchmarks are run against, have none
    from sb3_cpm.presets import Preset

ACTION_DIM, STATE_DIM = 7, 29
STEP_SECONDS = 0.013  # of PickCube-v1 with light rendering on one core
PEER = importlib.util.find_spec("sheeprl") is not None
SIMULATOR = importlib.util.find_spec("mani_skill") is not None
#: DreamerV2's latents, everything else as in the report; 3 convolutions make 4x4 feature maps of 32x32 images
CATEGORICAL: dict[str, Any] = {"latent": "categorical", "stoch_size": 32, "stoch_classes": 32}


class Options(NamedTuple):
    """
    :param repeats: turns of every contestant
    :param threads: numbers of torch threads
    :param device: of the challenger and its peer
    :param steps: of each run of the player
    :param length: of sequences
    :param compile_peer: also its losses
    :param r2dreamer: folder of its repository, None to leave its rows out
    """

    repeats: int
    threads: list[int]
    device: str
    steps: int
    length: int = 50
    compile_peer: bool = False
    r2dreamer: Path | None = None


class Pair(NamedTuple):
    """
    What one row compares, measured turn by turn.

    :param measure: what is measured
    :param ours: laps of all turns
    :param other: laps of all turns; empty if there is no peer
    :param target: "at least so many times faster than the other", or with ``at_most`` the greatest share of it; None for
        rows that inform
    :param at_most: see ``target``
    :param threads: torch threads
    """

    measure: str
    ours: list[Lap]
    other: list[Lap]
    target: float | None
    at_most: bool = False
    threads: int = 1


# ---------------------------------------------------------------------- contestants
def make_space(size: int, cameras: int, state_dim: int = STATE_DIM) -> spaces.Dict:
    """So many cameras of ``size`` x ``size``, and a state vector."""
    images = {f"camera{i}": spaces.Box(0, 255, (size, size, 3), np.uint8) for i in range(cameras)}
    return spaces.Dict({**images, "state": spaces.Box(-np.inf, np.inf, (state_dim,), np.float32)})


def make_batch(space: spaces.Dict, shape: tuple[int, int], action_dim: int = ACTION_DIM) -> SequenceBatch:
    """
    Whole sequences of noise; what is in them does not change what they cost.

    :param space: observation space
    :param shape: rows per sequence, sequences
    :param action_dim: size of the action
    """
    rng = np.random.default_rng(0)
    observations = {
        key: rng.integers(0, 256, (*shape, *sub.shape), dtype=np.uint8)
        if sub.dtype == np.uint8
        else rng.normal(size=(*shape, *sub.shape)).astype(np.float32)
        for key, sub in space.items()
        if sub.shape
    }
    is_first = np.zeros(shape, bool)
    is_first[0] = True
    actions = rng.uniform(-1, 1, (*shape, action_dim)).astype(np.float32) * ~is_first[..., None]
    rewards = rng.uniform(size=shape).astype(np.float32) * ~is_first
    return SequenceBatch(observations, actions, rewards, is_first, np.zeros(shape, bool), np.ones(shape, bool))


class Ours:
    """
    A challenger whose updates are clocked as the peer's are: at the end of every optimizer's step, and of what follows the
    ensemble's.

    :param space: observation space
    :param preset: complete preset
    :param device: where it trains
    """

    def __init__(self, space: spaces.Dict, preset: "Preset", device: str) -> None:
        torch.manual_seed(0)
        box = spaces.Box(-1.0, 1.0, (ACTION_DIM,), np.float32)
        self.challenger = Challenger(space, box, device, preset)

    def train(self, batch: SequenceBatch, phases: int | None = None) -> list[Lap]:
        """
        One update, or its first phases.

        :return: laps of the world model, then with an explorer of the ensemble's step, its scale, actor and critic, then with
            a task those of actor and critic
        """
        laps: list[Lap] = []
        ends: list[tuple[Any, str]] = [(optimizer, "step") for optimizer in self.challenger.optimizers.values()]
        if self.challenger.explores:
            ends.append((self.challenger.uncertainty, "adapt"))
        clock = Clock(self.challenger.device)
        with ExitStack() as stack, suppress(Enough):
            for owner, name in ends:
                stack.enter_context(patch.object(owner, name, clocked(getattr(owner, name), clock, laps, phases)))
            self.challenger.train(batch)
        return laps

    def parameters(self) -> dict[str, int]:
        """Numbers of parameters by the peer's names."""
        parts: dict[str, torch.nn.Module] = {"world model": self.challenger.world_model}
        if self.challenger.task is not None:
            parts |= {"actor": self.challenger.task.actor, "critic": self.challenger.task.critic}
        if self.challenger.explores:
            parts["ensemble"] = self.challenger.uncertainty
        return {name: sum(parameter.numel() for parameter in part.parameters()) for name, part in parts.items()}


def make_peer(preset: "Preset", space: spaces.Dict, **kwargs: Any) -> Any:
    """sheeprl at the sizes of a preset; None if it is not installed."""
    if not PEER:
        return None
    from peers.sheeprl_dreamer import SheeprlDreamer

    return SheeprlDreamer(asdict(preset), space, ACTION_DIM, **kwargs)


def print_sizes(what: str, ours: dict[str, int], peer: Any) -> None:
    """
    Print both sides' numbers of parameters.

    :raises RuntimeError: if they differ by more than 0.1%: the comparison would not be fair
    """
    if peer is None:
        return
    print(f"{what}: parameters (sheeprl) " + ", ".join(f"{k} {ours[k]:,} ({n:,})" for k, n in peer.parameters.items()))
    for name, number in peer.parameters.items():
        if abs(ours[name] / number - 1.0) > 1e-3:
            raise RuntimeError(f"{name}: {ours[name]:,} parameters against {number:,}")


class Variant(NamedTuple):
    """
    :param name: of the row
    :param switches: preset entries
    :param other: arguments of the peer
    """

    name: str
    switches: dict[str, bool]
    other: dict[str, Any]

    def target(self, options: Options, on_cpu: float) -> float | None:
        """On a GPU three times, but only with the switches that are meant for it."""
        return on_cpu if options.device == "cpu" else 3.0 if self.switches else None


def variants(options: Options) -> Iterator[Variant]:
    """What is measured: on GPUs also with the switches for speed."""
    common: dict[str, Any] = {"device": options.device}
    yield Variant("", {}, common)
    if options.device != "cpu":
        compiled = common | {"compiled": options.compile_peer}
        yield Variant(", compile", {"compile": True}, compiled)
        yield Variant(", bf16 + compile", {"amp": True, "compile": True}, compiled | {"amp": True})


def warm_up(ours: "Ours", batch: SequenceBatch, phases: int | None = None) -> None:
    """CUDA graphs are recorded at the third call."""
    for _ in range(3 if ours.challenger.compiled else 0):
        ours.train(batch, phases)


def take_turns(
    options: Options, ours: Callable[[], list[Lap]], other: Callable[[], list[Lap]] | None
) -> Iterator[tuple[int, list[list[Lap]], list[list[Lap]]]]:
    """
    Let contestants work in turns, one more than asked for, to warm up.

    :return: number of threads, then laps of all turns of ours, and of the other
    """
    found: dict[int, tuple[list[list[Lap]], list[list[Lap]]]] = {n: ([], []) for n in options.threads}
    for turn in range(options.repeats + 1):
        for threads, (mine, others) in found.items():
            torch.set_num_threads(threads)
            laps = [] if other is None else other(), ours()
            if turn:
                mine.append(laps[1])
                others.extend([laps[0]] if other is not None else [])
    torch.set_num_threads(1)
    for threads, (mine, others) in found.items():
        yield threads, mine, others


def total(turns: list[list[Lap]], first: int, last: int | None = None) -> list[Lap]:
    """Sum of some phases, of every turn."""
    return [sum(laps[first:last][1:], laps[first:last][0]) for laps in turns]


# ---------------------------------------------------------------------- rows
def make_dreamer_preset(options: Options, size: int, **switches: bool) -> "Preset":
    """DreamerV2 for images of ``size`` x ``size``: world model, and actor and critic for the task."""
    layers = {"cnn_layers": 3 if size == 32 else 4, "sequence_length": options.length}
    dreamer = {"train_task_behavior": True, "train_exploration_behavior": False}
    return make_preset("report", **CATEGORICAL, **switches, **layers, **dreamer)


def measure_dreamer(options: Options, size: int, cameras: int, target: float, behavior: bool, own: bool = False) -> list[Pair]:
    """World model, and with ``behavior`` imagination with actor and critic."""
    pairs = []
    space = make_space(size, cameras)
    for variant in variants(options):
        preset = make_dreamer_preset(options, size, **variant.switches)
        ours, batch = Ours(space, preset, options.device), make_batch(space, (preset.sequence_length, preset.batch_size))
        peer = make_peer(preset, space, own_convolutions=own, **variant.other)
        if not own:
            print_sizes(f"{size}x{size}x{3 * cameras}", ours.parameters(), peer)
        phases = None if behavior else 1
        warm_up(ours, batch, phases)
        turns = take_turns(options, partial(ours.train, batch, phases), peer and partial(peer.train, batch, phases))
        convolutions = ", sheeprl's own convolutions" if own else ""
        for threads, mine, others in turns:
            what = f"world model, {size}x{size}x{3 * cameras} + state{convolutions}{variant.name}"
            goal = None if own else variant.target(options, target)
            pairs.append(Pair(what, total(mine, 0, 1), total(others, 0, 1), goal, threads=threads))
            if behavior:
                what = f"imagination + actor-critic, 15 steps from {16 * options.length} states{variant.name}"
                goal = variant.target(options, 1.4)
                pairs.append(Pair(what, total(mine, 1), total(others, 1), goal, threads=threads))
    return pairs


def measure_model32(options: Options) -> list[Pair]:
    return measure_dreamer(options, 32, 2, 1.7, behavior=True)


def measure_model64(options: Options) -> list[Pair]:
    return measure_dreamer(options, 64, 1, 1.6, behavior=False)


def measure_own64(options: Options) -> list[Pair]:
    """As it comes: convolutions without padding, fewer operations in the encoder and an embedding of 1024 instead of 4096."""
    return measure_dreamer(options, 64, 1, 1.6, behavior=False, own=True) if PEER else []


def measure_r2dreamer(options: Options, size: int, cameras: int) -> list[Pair]:
    """World model, actor and critic in one: its losses share a backward pass, so that phases cannot be told apart."""
    assert options.r2dreamer is not None
    from peers.r2dreamer import R2Dreamer

    space, preset = make_space(size, cameras), make_dreamer_preset(options, size)
    ours, batch = Ours(space, preset, "cpu"), make_batch(space, (preset.sequence_length, preset.batch_size))
    peer = R2Dreamer(options.r2dreamer, asdict(preset), space, ACTION_DIM)
    what = f"{size}x{size}x{3 * cameras} + state"
    numbers = ours.parameters()
    print(f"{what}: parameters (r2dreamer) " + ", ".join(f"{k} {numbers[k]:,} ({n:,})" for k, n in peer.parameters.items()))
    what = f"full update, {what}, against r2dreamer"
    turns = take_turns(options, partial(ours.train, batch), partial(peer.train, batch))
    return [Pair(what, total(mine, 0), total(others, 0), None, threads=threads) for threads, mine, others in turns]


def measure_ensemble(options: Options) -> list[Pair]:
    """Ten heads that predict the stochastic part, as sheeprl's do; ours with the adaptation of the scale that follows."""
    pairs = []
    space = make_space(32, 2)
    heads = {"plan2explore": {"heads": 10, "layers": 4, "units": 400, "target": "stoch", "metric": "exp"}}
    for variant in variants(options):
        preset = make_preset("report", **CATEGORICAL, **variant.switches, cnn_layers=3, uncertainty=heads)
        ours, batch = Ours(space, preset, options.device), make_batch(space, (preset.sequence_length, preset.batch_size))
        peer = make_peer(preset, space, ensemble=True, **variant.other)
        print_sizes("ensemble", ours.parameters(), peer)
        warm_up(ours, batch, 3)
        turns = take_turns(options, partial(ours.train, batch, 3), peer and partial(peer.train, batch, 2))
        for threads, mine, others in turns:
            what = f"ensemble, 10 x (4 x 400){variant.name}"
            pairs.append(Pair(what, total(mine, 1, 3), total(others, 1, 2), variant.target(options, 1.4), threads=threads))
    return pairs


def measure_latents(options: Options) -> list[Pair]:
    """
    The whole update (world model, ensemble, explorer): the report's Gaussian latents beside our categorical ones.

    At full speed of both the ratio is that of their operations, 1.9: most are those of the ten heads, whose middle layers do
    not depend on the latent. The target dates from categorical latents that lost time elsewhere. On a GPU both take as many
    launches, and the ratio informs.
    """
    pairs = []
    space = make_space(32, 2)
    for name, switches, _ in variants(options):
        gaussian, categorical = make_preset("report", **switches), make_preset("report", **CATEGORICAL, **switches)
        ours, other = Ours(space, gaussian, options.device), Ours(space, categorical, options.device)
        batch = make_batch(space, (gaussian.sequence_length, gaussian.batch_size))
        for one in (ours, other):
            warm_up(one, batch)
        target = 2.5 if options.device == "cpu" else None
        for threads, mine, others in take_turns(options, partial(ours.train, batch), partial(other.train, batch)):
            what = f"full update, Gaussian latents against categorical{name}"
            pairs.append(Pair(what, total(mine, 0), total(others, 0), target, threads=threads))
    return pairs


class Episode(NamedTuple):
    """
    :param observation_space: of PickCube-v1 with two cameras
    :param action_space: of it
    :param states: of one episode
    :param simulate: goes through the episode
    :param close: to be called in the end
    """

    observation_space: spaces.Dict
    action_space: spaces.Box
    states: list[dict[str, np.ndarray]]
    simulate: Callable[[], None]
    close: Callable[[], None]


def make_episode(actions: np.ndarray) -> Episode:
    """In the simulator, and without ManiSkill of noise and as slow as the simulator is."""
    if not SIMULATOR:
        space = make_space(32, 2)
        space.seed(0)
        states = [space.sample() for _ in range(len(actions) + 1)]
        wait = partial(keep_busy, len(actions) * STEP_SECONDS)
        return Episode(space, spaces.Box(-1.0, 1.0, (ACTION_DIM,), np.float32), states, wait, lambda: None)
    from sb3_cpm.envs import make_maniskill_env

    env = make_maniskill_env("PickCube-v1")
    states = []

    def simulate() -> None:
        states[:] = [env.reset(seed=0)[0]]
        states.extend(env.step(action)[0] for action in actions)

    assert isinstance(env.observation_space, spaces.Dict) and isinstance(env.action_space, spaces.Box)
    return Episode(env.observation_space, env.action_space, states, simulate, env.close)


def keep_busy(seconds: float) -> None:
    end = time.perf_counter() + seconds
    while time.perf_counter() < end:
        pass


def measure_acting(options: Options) -> list[Pair]:
    """C's share of a step, and what it takes to judge an episode, beside the simulator's steps with light rendering."""
    torch.set_num_threads(1)
    n_steps = 50
    actions = np.random.default_rng(0).uniform(-1, 1, (n_steps, ACTION_DIM)).astype(np.float32)
    space, action_space, episode, simulate, close = make_episode(actions)
    laps: dict[str, list[Lap]] = {}
    challengers = {preset: Challenger(space, action_space, options.device, preset) for preset in ("default", "report")}
    for turn in range(options.repeats + 1):
        found = {"simulate": timed(simulate)}
        for preset, challenger in challengers.items():
            arrays = {key: np.stack([state[key] for state in episode]) for key in challenger.keys}
            found[f"{preset} judge"] = timed(partial(challenger.evaluate, arrays, actions), options.device)
            for n in (1, 8):
                act = _acting(challenger, arrays, actions, n)
                found[f"{preset} act {n}"] = timed(act, options.device)
        for key, lap in found.items() if turn else ():
            laps.setdefault(key, []).append(lap)
    close()
    step = [Lap(cpu / n_steps, wall / n_steps) for cpu, wall in laps["simulate"]]
    pairs = []
    for preset in challengers:
        informs = preset != "default"
        for n in (1, 8):
            mine = [Lap(cpu / n_steps, wall / n_steps) for cpu, wall in laps[f"{preset} act {n}"]]
            what = f"C acts in {n} environment(s) at once, preset {preset}, against one environment's step"
            pairs.append(Pair(what, mine, step, None if informs else 0.25, at_most=True))
        what = f"C judges an episode of {n_steps} steps, preset {preset}, against the steps"
        pairs.append(Pair(what, laps[f"{preset} judge"], laps["simulate"], None if informs else 0.05, at_most=True))
    return pairs


def _acting(challenger: Challenger, arrays: dict[str, np.ndarray], actions: np.ndarray, n: int) -> Callable[[], None]:
    """An episode in ``n`` environments at once: encode, follow, act, step by step."""
    rows = [{key: np.stack([value[t]] * n)[None] for key, value in arrays.items()} for t in range(len(actions))]
    first = np.zeros((1, n), bool)

    def run() -> None:
        state = challenger.initial_state(n)
        action = np.zeros((n, challenger.action_dim), np.float32)
        for row in rows:
            state = challenger.follow(state, row, action[None], first)
            action = challenger.act(state)

    return run


class Vectors(gymnasium.Env):
    """PickCube's state vector and actions without a simulation: what a run costs beside it."""

    def __init__(self) -> None:
        self.observation_space = spaces.Dict({"state": spaces.Box(-np.inf, np.inf, (42,), np.float32)})
        self.action_space = spaces.Box(-1.0, 1.0, (ACTION_DIM,), np.float32)
        self.steps = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.steps = 0
        return self._state(), {}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        return self._state(), float(action[0]), False, self.steps == 50, {}

    def _state(self) -> dict[str, np.ndarray]:
        return {"state": self.np_random.normal(size=42).astype(np.float32)}


def make_run_env() -> tuple[str, gymnasium.Env]:
    """Name and environment of the row that measures whole runs."""
    if not SIMULATOR:
        return "vectors without a simulation", Vectors()
    from sb3_cpm.envs import make_maniskill_env

    return "PickCube-v1 state", make_maniskill_env("PickCube-v1", obs_mode="state")


def measure_run(options: Options) -> list[Pair]:
    """PickCube-v1 on state vectors: SAC with SB3's own settings, an update per step, and the same with a challenger."""
    from stable_baselines3 import SAC

    from sb3_cpm import ChallengerCallback, CPMBuffer

    torch.set_num_threads(1)
    pairs = []
    for name, switches, _ in list(variants(options))[:2]:
        laps: dict[bool, list[Lap]] = {True: [], False: []}
        for turn in range(options.repeats + 1):
            for cpm, found in laps.items():
                task, env = make_run_env()
                kwargs: dict[str, Any] = {"replay_buffer_class": CPMBuffer} if cpm else {}
                model = SAC("MultiInputPolicy", env, learning_starts=100, seed=turn, device=options.device, **kwargs)
                steps = options.steps if turn else 150
                callback = ChallengerCallback(challenger_kwargs=switches) if cpm else None
                lap = timed(partial(model.learn, steps, callback=callback), options.device)
                found.extend([Lap(lap.cpu / steps, lap.wall / steps)] if turn else [])
                env.close()
        what = f"a step of CPM-SAC, {task}, {options.steps} steps and updates, against SAC{name}"
        target = 1.5 if task.startswith("PickCube") else None
        pairs.append(Pair(what, laps[True], laps[False], target, at_most=True))
    return pairs


ROWS: dict[str, Callable[[Options], list[Pair]]] = {
    "model32": measure_model32,
    "model64": measure_model64,
    "own64": measure_own64,
    "ensemble": measure_ensemble,
    "latents": measure_latents,
    "r2dreamer32": partial(measure_r2dreamer, size=32, cameras=2),
    "r2dreamer64": partial(measure_r2dreamer, size=64, cameras=1),
    "acting": measure_acting,
    "run": measure_run,
}


# ---------------------------------------------------------------------- report
def print_pair(pair: Pair, by_wall: bool) -> bool:
    """
    :param pair: a row
    :param by_wall: judge wall time instead of CPU time
    :return: whether the target is met
    """
    mine = median(pair.ours)
    if not pair.other:
        print(f"| {pair.measure} | {pair.threads} | {_seconds(mine.cpu)} | | | {_seconds(mine.wall)} | | | | not compared |")
        return True
    other = median(pair.other)
    ratios = Lap(
        *(
            statistics.median(a[i] / b[i] if pair.at_most else b[i] / a[i] for a, b in zip(pair.ours, pair.other, strict=True))
            for i in range(2)
        )
    )
    judged = ratios.wall if by_wall or pair.threads > 1 else ratios.cpu
    met = pair.target is None or (judged <= pair.target if pair.at_most else judged >= pair.target)
    form: Callable[[float], str] = "{:.1%}".format if pair.at_most and pair.target != 1.5 else "{:.2f}".format
    target = "" if pair.target is None else f"{'at most' if pair.at_most else 'at least'} {pair.target:g}"
    verdict = "" if pair.target is None else "met" if met else "MISSED"
    cells = [pair.measure, str(pair.threads), _seconds(mine.cpu), _seconds(other.cpu), form(ratios.cpu)]
    cells += [_seconds(mine.wall), _seconds(other.wall), form(ratios.wall), target, verdict]
    print("| " + " | ".join(cells) + " |", flush=True)
    return met


def _seconds(value: float) -> str:
    return f"{value:.2f} s" if value >= 1.0 else f"{1e3 * value:.3g} ms"


def check_r2dreamer(parser: argparse.ArgumentParser, arguments: argparse.Namespace) -> None:
    """End with what is wrong where its rows cannot be measured."""
    path = arguments.r2dreamer
    if path is None:
        if needy := [row for row in arguments.rows or () if row.startswith("r2dreamer")]:
            parser.error(f"--rows {' '.join(needy)}: needs --r2dreamer PATH, a checkout of github.com/NM512/r2dreamer")
    elif not (path / "dreamer.py").is_file():
        parser.error(f"--r2dreamer {path}: no dreamer.py there; expected a checkout of github.com/NM512/r2dreamer")
    elif arguments.device != "cpu":
        parser.error(f"--r2dreamer is measured on the CPU, not on {arguments.device}: leave one of the two out")


def main() -> int:
    """:return: exit status, 1 if a target is missed"""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", nargs="+", choices=list(ROWS), help="all, r2dreamer's with its path")
    parser.add_argument("--repeats", type=int, default=5, help="turns of every contestant, after one that warms up")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2], help="numbers of torch threads")
    parser.add_argument("--steps", type=int, default=500, help="environment steps of each turn of a run")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--length", type=int, default=50, help="of the sequences in the rows of the world model")
    parser.add_argument("--compile-peer", action="store_true", help="let sheeprl compile, too")
    parser.add_argument("--r2dreamer", type=Path, metavar="PATH", help="a checkout of NM512/r2dreamer; CPU only")
    arguments = parser.parse_args()
    check_r2dreamer(parser, arguments)
    threads = arguments.threads if arguments.device == "cpu" else [1]
    entries = ("repeats", "device", "steps", "length", "compile_peer", "r2dreamer")
    options = Options(threads=threads, **{entry: getattr(arguments, entry) for entry in entries})
    torch.set_float32_matmul_precision("high")  # sheeprl's default, for both

    peer = f"sheeprl {importlib.metadata.version('sheeprl')}" if PEER else "sheeprl is not installed (see --help)"
    if options.r2dreamer is not None:
        from peers.r2dreamer import commit

        peer += f", r2dreamer {commit(options.r2dreamer)}"
    where = platform.processor() or platform.machine()
    where = where if options.device == "cpu" else torch.cuda.get_device_name(options.device)
    print(f"Peer: {peer}; torch {torch.__version__}; {where}; medians of {options.repeats} turns\n")
    known = [row for row in ROWS if options.r2dreamer is not None or not row.startswith("r2dreamer")]
    pairs = [pair for row in arguments.rows or known for pair in ROWS[row](options)]
    print("\n| measure | threads | CPU ours | other | ratio | wall ours | other | ratio | target | |")
    print("| --- " * 10 + "|")
    met = [print_pair(pair, by_wall=options.device != "cpu") for pair in pairs]
    if options.device != "cpu":
        print("\nUpdates per second: " + "; ".join(f"{pair.measure} {1 / median(pair.ours).wall:.1f}" for pair in pairs))
    return int(not all(met))


if __name__ == "__main__":
    sys.exit(main())
