"""GAIL beside stock agents: discriminators, the expert's rings, and rewards that are computed when the player samples."""

import copy
import dataclasses
import pickle
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
import torch.nn.functional as F
from file_helpers import StopsAt
from gymnasium import spaces
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_cpm import ChallengerCallback, CheckpointCPMCallback, CPMBuffer, resume
from sb3_cpm.agents import load_agent
from sb3_cpm.buffers import Demonstration
from sb3_cpm.envs import DictObservation, ToyEnv
from sb3_cpm.envs.reach import SUCCESS_DISTANCE
from sb3_cpm.imitation import (
    GAILCallback,
    InstanceBuffer,
    ProgressiveDiscriminator,
    VectorDiscriminator,
    record_demonstrations,
)
from sb3_cpm.run import TrainSettings, train
from sb3_cpm.training_env import begin_episodes

N_POINTS = 40
CLOUDS = spaces.Dict(
    {"pointcloud": spaces.Box(-np.inf, np.inf, (N_POINTS, 7), np.float32), "state": spaces.Box(-1, 1, (3,), np.float32)}
)
ACTIONS = spaces.Box(-1, 1, (2,), np.float32)
SMALL: dict[str, Any] = {"sizes": (16, 32), "embed": 32, "head_size": 8, "blocks": 1}


def clouds(n: int, shift: float = 0.0) -> tuple[dict[str, th.Tensor], th.Tensor]:
    """:return: clouds of three parts, of which part 1 is shifted, and noise for actions"""
    points = th.randn(n, N_POINTS, 7) * 0.1
    points[..., 6] = th.arange(N_POINTS) % 4 - 1  # -1 (no part), 0, 1, 2
    points[..., 0] += shift * (points[..., 6] == 1)
    return {"pointcloud": points, "state": th.rand(n, 3)}, th.rand(n, 2)


def fit(net: Any, updates: int = 100) -> None:
    optimizer = th.optim.Adam(net.parameters(), 3e-3)
    for _ in range(updates):
        (expert, a), (player, b) = clouds(32, 0.3), clouds(32)
        loss = F.softplus(-net(expert, a)).mean() + F.softplus(net(player, b)).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()


# ---------------------------------------------------------------------- discriminators


@pytest.mark.parametrize("grow", [(1000, 0), (0, 0), "half"])
def test_the_growing_discriminator_separates_parts_that_are_elsewhere(grow: Any) -> None:
    net = ProgressiveDiscriminator(CLOUDS, ACTIONS, grow=(0, 10) if grow == "half" else grow, **SMALL)
    net.updates.fill_(5 if grow == "half" else 0)
    assert net.alpha == {(1000, 0): 0.0, (0, 0): 1.0, "half": 0.5}[grow]
    fit(net)
    net.eval()
    (expert, a), (player, b) = clouds(200, 0.3), clouds(200)
    with th.no_grad():
        right = ((net(expert, a) > 0).float().mean() + (net(player, b) < 0).float().mean()) / 2
        assert F.softplus(net(expert, a)).mean() > F.softplus(net(player, b)).mean()
    assert right > 0.95


def test_points_have_no_order_and_labels_matter() -> None:
    net = ProgressiveDiscriminator(CLOUDS, ACTIONS, grow=(0, 0), **SMALL).eval()
    (cloud, action) = clouds(4)
    order = th.randperm(N_POINTS)
    shuffled = {**cloud, "pointcloud": cloud["pointcloud"][:, order]}
    assert th.allclose(net(cloud, action), net(shuffled, action), atol=1e-5)
    relabelled = {**cloud, "pointcloud": cloud["pointcloud"].clone()}
    relabelled["pointcloud"][:, 0, 6] = 2
    assert not th.allclose(net(cloud, action), net(relabelled, action), atol=1e-5)


@pytest.mark.parametrize("labels", [th.full((N_POINTS,), 1.0), th.full((N_POINTS,), -1.0), (th.arange(N_POINTS) == 0) * 2.0])
def test_empty_parts_are_no_matter(labels: th.Tensor) -> None:
    net = ProgressiveDiscriminator(CLOUDS, ACTIONS, grow=(0, 2), **SMALL)
    net.updates.fill_(1)
    cloud, action = clouds(3)
    cloud["pointcloud"][..., 6] = labels
    logits = net(cloud, action)
    logits.sum().backward()
    assert th.isfinite(logits).all()
    assert all(one.grad is None or th.isfinite(one.grad).all() for one in net.parameters())


def test_growth_by_updates_and_by_shares() -> None:
    net = ProgressiveDiscriminator(CLOUDS, ACTIONS, **SMALL)
    alphas = []
    for updates in (0, 2000, 3500, 5000, 9999):
        net.updates.fill_(updates)
        alphas.append(net.alpha)
    assert alphas == [0.0, 0.0, 0.5, 1.0, 1.0]
    net.updates.fill_(0)
    cloud, action = clouds(2)
    net(cloud, action).sum().backward()
    assert all(one.grad is None for one in net.strong.parameters())
    shares = ProgressiveDiscriminator(CLOUDS, ACTIONS, grow=(0.2, 0.3), **SMALL)
    shares.plan(100)
    shares.updates.fill_(35)
    assert shares.alpha == pytest.approx(0.5)


def test_scales_are_those_of_the_expert() -> None:
    net = VectorDiscriminator(CLOUDS, ACTIONS, sizes=(8,))
    assert net.keys == ("state",)
    state = 5 + 3 * th.randn(1000, 3)
    net.observe({"state": state})
    assert th.allclose(net.scale(state).mean(0), th.zeros(3), atol=1e-5)
    assert th.allclose(net.scale(state).std(0), th.ones(3), atol=1e-3)


@pytest.mark.parametrize(
    "kwargs, message",
    [
        ({"grow": (2000, 0.3)}, "mixes updates and shares"),
        ({"grow": 3}, "expected two numbers"),
        ({"keys": ["stat"]}, "'stat', which is not among the observations"),
        ({"keys": ["state"]}, "there is none among.*discriminator_class='vector'"),
    ],
)
def test_bad_discriminators(kwargs: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ProgressiveDiscriminator(CLOUDS, ACTIONS, **kwargs)


def test_clouds_without_labels_are_refused() -> None:
    env = ToyEnv()
    with pytest.raises(ValueError, match="without the label of their part.*point_labels=True"):
        ProgressiveDiscriminator(env.observation_space, env.action_space)
    with pytest.raises(ValueError, match="there are none among"):
        VectorDiscriminator(spaces.Dict({"pointcloud": CLOUDS["pointcloud"]}), ACTIONS)


# ---------------------------------------------------------------------- the expert's rings

STATE = spaces.Dict({"state": spaces.Box(-np.inf, np.inf, (1,), np.float32)})


def episode(length: int, value: float) -> tuple[dict[str, np.ndarray], np.ndarray]:
    return {"state": np.full((length + 1, 1), value, np.float32)}, np.full((length, 2), 0.5, np.float32)


def test_every_instance_has_a_ring_of_its_own() -> None:
    rings = InstanceBuffer(STATE, ACTIONS, quota=50)
    for number in range(100):
        rings.add("easy", *episode(10, 1))
        if number in (10, 20):
            rings.add("rare", *episode(7, 2))
            rings.add("rarest", *episode(5, 3)) if number == 20 else None
    assert rings.sizes() == {"easy": 50, "rare": 14, "rarest": 5}
    observations, actions = rings.sample(32)
    values, counts = observations["state"][:, 0].unique(return_counts=True)
    assert values.tolist() == [1, 2, 3] and counts.tolist() == [10, 10, 10] and len(actions) == 30
    before = rings.sizes()
    rings.add("easy", *episode(10, 1))
    assert rings.sizes() == before
    together = InstanceBuffer(STATE, ACTIONS, quota=50, balance=False)
    for name in ("a", "b"):
        together.add(name, *episode(10, 1))
    assert together.instances == ["any"]


def test_demonstrations_may_be_kept() -> None:
    for share, expected in ((0.0, {1.0}), (0.5, {1.0, 9.0})):
        rings = InstanceBuffer(STATE, ACTIONS, quota=40, keep_demonstrations=share)
        rings.add("a", *episode(10, 9), demonstration=True)
        for _ in range(10):
            rings.add("a", *episode(10, 1))
        assert set(rings.sample(200)[0]["state"][:, 0].tolist()) == expected


def test_what_rings_refuse() -> None:
    rings = InstanceBuffer(STATE, ACTIONS, quota=5, max_instances=1)
    with pytest.raises(RuntimeError, match="no expert transition"):
        rings.sample(3)
    with pytest.raises(ValueError, match="6 transitions does not fit into the ring of instance 'a', which holds 5"):
        rings.add("a", *episode(6, 0))
    rings.add("a", *episode(2, 0))
    with pytest.raises(ValueError, match=r"'b' would be number 2, and max_instances is 1. They are \['a'\]"):
        rings.add("b", *episode(2, 0))


# ---------------------------------------------------------------------- the callback


def reach(n_envs: int = 1) -> DummyVecEnv:
    return make_vec_env("CPMReach-v0", n_envs=n_envs, seed=0)


@pytest.fixture(scope="module")
def demonstrations() -> list[Demonstration]:
    return record_demonstrations(reach(), 6, seed=1, hold=True)


def make(env: Any, algorithm: Any = SAC, **buffer_kwargs: Any) -> Any:
    kwargs = {"challenge_ratio": 0, "mix": "row", "demonstration_ratio": 0.25, **buffer_kwargs}
    return algorithm(
        "MultiInputPolicy",
        env,
        replay_buffer_class=CPMBuffer,
        replay_buffer_kwargs=kwargs,
        learning_starts=100,
        batch_size=32,
        buffer_size=2000,
        train_freq=10,
        policy_kwargs={"net_arch": [16]},
        seed=0,
        device="cpu",
    )


def gail(demonstrations: Any, **kwargs: Any) -> GAILCallback:
    small = {"discriminator_class": "vector", "discriminator_kwargs": {"sizes": (16,)}, "preset": "small"}
    return GAILCallback(demonstrations, n_episodes=None, **{**small, "episodes_per_round": 2, **kwargs})


class Look(BaseCallback):
    """Calls a function in a rollout's beginning, late in the run."""

    def __init__(self, function: Any, at: int = 300) -> None:
        super().__init__()
        self.function, self.at = function, at

    def _on_rollout_start(self) -> None:
        if self.num_timesteps >= self.at and self.function is not None:
            self.function(self.model)
            self.function = None

    def _on_step(self) -> bool:
        return True


def test_rewards_are_never_stale_and_never_stored(demonstrations: Any) -> None:
    callback = gail(demonstrations)
    seen: list[Any] = []

    def look(model: Any) -> None:
        stored = model.replay_buffer.rewards.copy()
        for _ in range(2):
            np.random.seed(3)
            batch = model.replay_buffer.sample(64)
            callback.discriminator.eval()
            expected = F.softplus(callback.discriminator(batch.observations, batch.actions)).unsqueeze(1)
            assert th.allclose(batch.rewards, expected, atol=1e-6)
            seen.append(batch)
            recent = {"state": np.random.rand(8, 6).astype(np.float32)}, np.random.rand(8, 2).astype(np.float32)
            rows = {"state": th.as_tensor(recent[0]["state"])}, th.as_tensor(recent[1])
            callback._update(callback.expert.sample(8), rows)
        assert (model.replay_buffer.rewards == stored).all()

    model = make(reach())
    model.learn(400, callback=[callback, Look(look)])
    assert th.equal(seen[0].observations["state"], seen[1].observations["state"])
    assert not th.equal(seen[0].rewards, seen[1].rewards)
    assert set(np.unique(model.replay_buffer.rewards)) <= {0.0, 1.0}
    assert model.replay_buffer.reward_of is None and model.replay_buffer.demonstrations.size() == 180
    assert b"discriminator" not in pickle.dumps(model.replay_buffer)


def test_the_environments_reward_alone_is_sac_bit_for_bit(demonstrations: Any) -> None:
    players = []
    for callback in (None, gail(demonstrations, env_reward=1.0, expert_reward=0.0, demonstrations_for_player=False)):
        model = make(reach())
        model.learn(300, callback=callback)
        players.append([*model.policy.parameters(), th.from_numpy(model.replay_buffer.actions[:300])])
    assert callback is not None and int(callback.discriminator.updates) == 25  # type: ignore[arg-type]
    assert all(th.equal(a, b) for a, b in zip(*players, strict=True))


def test_an_exception_ends_it(demonstrations: Any) -> None:
    def fail(model: Any) -> None:
        assert model.replay_buffer.reward_of is not None
        raise KeyError("somebody else's")

    model = make(reach())
    with pytest.raises(KeyError):
        model.learn(400, callback=[gail(demonstrations), Look(fail)])
    assert model.replay_buffer.reward_of is None and model.replay_buffer.demonstrations.reward_of is None
    assert set(np.unique(model.replay_buffer.sample(100).rewards)) <= {0.0, 1.0}


def test_the_newest_transitions_of_a_round_are_learnt_from(demonstrations: Any) -> None:
    callback, ages = gail(demonstrations, episodes_per_round=3, recent_transitions=40), []

    def recent() -> Any:
        observations, actions = GAILCallback._recent(callback)
        books, buffer = callback.buffer.books, callback.buffer
        steps = np.arange(books.n_steps - 40, books.n_steps) % buffer.buffer_size
        ages.append((actions == buffer.actions[steps, 0]).all() and len(observations["state"]) == 40)
        return observations, actions

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(callback, "_recent", recent)
        make(reach()).learn(300, callback=callback)
    assert ages == [True, True, True]


def test_learning_in_portions_that_end_amid_episodes(demonstrations: Any) -> None:
    callback, model = gail(demonstrations), make(reach())
    for steps, reset in ((110, True), (100, False), (110, True)):  # the last one begins new episodes
        model.learn(steps, callback=callback, reset_num_timesteps=reset)
    assert int(callback.discriminator.updates) == 5 * 5  # 30 x 3 + 20 (goes on), 10 (goes on) + 30 x 3; cut; 30 x 3
    assert len(callback._round) == 0
    model.learn(20, callback=callback, reset_num_timesteps=False)
    assert len(callback._round) == 1
    other = make(reach())
    with pytest.warns(UserWarning, match="none of the demonstrations that the discriminator knows"):
        other.learn(40, callback=callback)  # the episode of another player's buffer is none of this round
    assert len(callback._round) == 1 and callback._round[0] in other.replay_buffer.episodes


def test_a_buffer_that_loses_episodes_before_they_are_learnt_from(demonstrations: Any) -> None:
    model = make(reach())
    model.replay_buffer = CPMBuffer(40, model.observation_space, model.action_space, challenge_ratio=0)
    model.train_freq = model.train_freq._replace(frequency=100)
    with pytest.raises(ValueError, match="40 transitions per environment, has lost an episode.*smaller train_freq"):
        model.learn(400, callback=gail(demonstrations))


def test_successes_join_the_expert_up_to_the_first_successful_step() -> None:
    env = reach(2)
    demonstrations = record_demonstrations(env, 6, seed=1, hold=True)
    callback = gail(demonstrations, quota=500)
    model = make(reach(2))
    added: list[tuple[Any, int]] = []
    add = InstanceBuffer.add

    def noted(self: Any, instance: Any, observations: Any, actions: Any, demonstration: bool = False) -> None:
        if not demonstration:
            added.append((instance, len(actions)))
            point, goal = observations["state"][-1][:2], observations["state"][-1][2:4]
            assert np.hypot(*(point - goal)) < SUCCESS_DISTANCE  # what the last action led to
            earlier = observations["state"][1:-1]
            assert (np.hypot(*(earlier[:, :2] - earlier[:, 2:4]).T) >= SUCCESS_DISTANCE).all()
        add(self, instance, observations, actions, demonstration)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(InstanceBuffer, "add", noted)
        model.learn(1500, callback=callback)
    assert callback.n_successes == len(added) > 0 and {name for name, _ in added} <= {"strong", "medium", "weak"}
    assert sum(callback.expert.sizes().values()) == 180 + sum(n for _, n in added)


def test_episodes_that_are_cut_off_between_rollouts_are_nobodys(demonstrations: Any) -> None:
    callback, model = gail(demonstrations), make(reach())
    model.learn(400, callback=[callback, Look(begin_episodes, at=200), Look(begin_episodes, at=300)])
    lengths = [episode.length for episode in model.replay_buffer.episodes]
    assert 20 in lengths and 10 in lengths  # cut off at steps 200 and 300
    assert all(episode.length == 30 for episode in callback._round)
    assert int(callback.discriminator.updates) == 5 * (lengths.count(30) // 2)


def test_the_newest_of_a_round_come_last(demonstrations: Any) -> None:
    callback = gail(demonstrations, episodes_per_round=100)
    make(reach()).learn(200, callback=callback)
    assert [episode.ordinal for episode in callback._round] == list(range(6))


@pytest.mark.parametrize("algorithm", [SAC, TD3])
def test_one_seed_is_one_run(demonstrations: Any, algorithm: Any) -> None:
    finals = []
    for _ in range(2):
        model, callback = make(reach(), algorithm), gail(demonstrations)
        model.learn(300, callback=callback)
        finals.append([*model.policy.parameters(), *callback.discriminator.parameters()])
    assert all(th.equal(a, b) for a, b in zip(*finals, strict=True))


def test_save_and_load(demonstrations: Any, tmp_path: Path) -> None:
    first = gail(demonstrations)
    make(reach()).learn(300, callback=first)
    first.save(tmp_path / "gail.npz")
    second = gail(demonstrations, load_path=tmp_path / "gail.npz")
    second.init_callback(make(reach()))
    assert all(
        th.equal(a, b) for a, b in zip(first.discriminator.parameters(), second.discriminator.parameters(), strict=True)
    )
    assert first.expert.sizes() == second.expert.sizes() and second.n_successes == first.n_successes
    losses = []
    for callback in (first, second):
        th.manual_seed(0)
        np.random.seed(0)
        rows = {"state": th.rand(16, 6)}, th.rand(16, 2)
        callback.logger.name_to_value.clear() if callback is first else callback.model.set_logger(first.logger)
        callback._update(callback.expert.sample(16), rows)
        losses.append([one.detach().clone() for one in callback.discriminator.parameters()])
    assert all(th.equal(a, b) for a, b in zip(*losses, strict=True))
    with pytest.raises(ValueError, match="other sizes"):
        gail(demonstrations, discriminator_kwargs={"sizes": (8,)}, load_path=tmp_path / "gail.npz").init_callback(
            make(reach())
        )


def kept(callback: GAILCallback) -> list[Any]:
    """What of it must be the same in two runs."""
    assert callback.discriminator is not None and callback.expert is not None and callback.optimizer is not None
    moments = [one for entry in callback.optimizer.state_dict()["state"].values() for one in entry.values()]
    rings = [array for _, array in sorted(callback.expert.state("")[1].items()) if array.dtype.kind == "f"]
    return [*callback.discriminator.state_dict().values(), *moments, *(th.from_numpy(one.copy()) for one in rings)]


@pytest.mark.parametrize("stop", [200, 350])
def test_a_killed_run_that_goes_on_is_the_unbroken_one(stop: int, demonstrations: Any, tmp_path: Path) -> None:
    """
    Checkpoints at 100, 200, ... cut episodes of 30 steps, in the unbroken run as well. 200: learn() came to its end there;
    350: killed, and all is lost back to 300.
    """

    def callbacks(folder: str, callback: GAILCallback) -> list[BaseCallback]:
        return [callback, CheckpointCPMCallback(50, tmp_path / folder, exact=True)]

    first, unbroken = gail(demonstrations, episodes_per_round=3), make(reach(2))
    unbroken.learn(500, callback=callbacks("unbroken", first))
    broken = callbacks("broken", gail(demonstrations, episodes_per_round=3))
    if stop % 100:
        with pytest.raises(InterruptedError):
            make(reach(2)).learn(500, callback=[*broken, StopsAt(stop)])
    else:
        make(reach(2)).learn(stop, callback=broken)
    again = gail(demonstrations, episodes_per_round=3)
    model, same = resume(tmp_path / "broken", reach(2), callback=again)
    assert same is again and model.num_timesteps == stop // 100 * 100
    model.learn(500 - model.num_timesteps, callback=callbacks("broken", again), reset_num_timesteps=False)
    assert int(first.discriminator.updates) >= 10
    ours, theirs = kept(again), kept(first)
    assert len(ours) == len(theirs) and all(th.equal(a, b) for a, b in zip(ours, theirs, strict=True))
    assert all(th.equal(a, b) for a, b in zip(model.policy.parameters(), unbroken.policy.parameters(), strict=True))
    for wrong in (None, ChallengerCallback()):
        with pytest.raises(ValueError, match=r"was made with a GAILCallback.*callback=GAILCallback\(...\)"):
            resume(tmp_path / "unbroken", reach(2), callback=wrong)


@pytest.mark.slow
def test_train_goes_on_where_it_was_cut_off(tmp_path: Path) -> None:
    pytest.importorskip("rl_zoo3")
    few = {"n_episodes": 6, "discriminator_class": "vector", "preset": "small", "episodes_per_round": 2}
    settings: dict[str, Any] = {
        **{"agent": "gail_sac", "env": "CPMReach-v0", "steps": 600, "evaluations": 2, "eval_episodes": 5, "video": False},
        **{"checkpoint_freq": 100, "device": "cpu"},
        "model_kwargs": {"callback": [{"sb3_cpm.imitation.GAILCallback": few}]},
    }
    train(run_folder=str(tmp_path / "unbroken"), **settings)
    with pytest.raises(InterruptedError):
        train(run_folder=str(tmp_path / "broken"), callback=StopsAt(350), **settings)
    assert train(TrainSettings(resume=str(tmp_path / "broken"))).outcome == "finished"
    for table in (tmp_path / "unbroken").glob("*.csv"):
        assert table.read_bytes() == (tmp_path / "broken" / table.name).read_bytes()


def test_the_agent_learns_clouds_and_grows(tmp_path: Path) -> None:
    built = load_agent("gail_sac", "CPMToy-v0").build(seed=0, device="cpu")
    (callback,) = built.callbacks
    callback.n_episodes, callback.episodes_per_round = 4, 1
    built.model.learn(400, callback=callback)
    assert callback.discriminator.alpha == 1.0 and int(callback.discriminator.updates) == 40
    assert callback.expert.instances == ["any"]


# ---------------------------------------------------------------------- learning


def without_information(demonstrations: list[Demonstration]) -> list[Demonstration]:
    """Each number of states and actions is shuffled among rows: all have the distributions that they had, and nothing to do
    with each other."""
    generator = np.random.default_rng(0)
    actions = generator.permuted(np.concatenate([one.actions for one in demonstrations]), axis=0)
    states = generator.permuted(np.concatenate([one.observations["state"] for one in demonstrations]), axis=0)
    return [
        dataclasses.replace(one, actions=actions[30 * i : 30 * i + 30], observations={"state": states[31 * i : 31 * i + 31]})
        for i, one in enumerate(demonstrations)
    ]


def success_at_end(choose: Any) -> float:
    """:return: share of 50 episodes"""
    env, found = make_vec_env("CPMReach-v0", n_envs=10, seed=3_000_000), []
    obs: Any = env.reset()
    while len(found) < 50:
        obs, _, dones, infos = env.step(choose(obs))
        found += [info["is_success"] for info, done in zip(infos, dones, strict=True) if done]
    return float(np.mean(found))


@pytest.mark.slow
def test_it_learns_from_demonstrations_alone_and_not_from_noise() -> None:
    found = {}
    recorded = record_demonstrations(reach(), 20, seed=7, hold=True)
    for name, episodes in (("demonstrations", recorded), ("noise", without_information(recorded))):
        built = load_agent("gail_sac", "CPMReach-v0").build(seed=7, device="cpu")
        (callback,) = built.callbacks
        callback.demonstrations, callback.n_episodes = episodes, None
        built.model.learn(5000, callback=callback)
        model = built.model
        found[name] = success_at_end(lambda obs, model=model: model.predict(obs, deterministic=True)[0])
    generator = np.random.default_rng(0)
    found["random"] = success_at_end(lambda obs: generator.uniform(-1, 1, (10, 2)))
    assert found["demonstrations"] > 0.5 and found["random"] < 0.1 and found["noise"] < 0.3, found


# ---------------------------------------------------------------------- bad input


def learn(model: Any, *callbacks: Any) -> None:
    model.learn(100, callback=list(callbacks))


@pytest.mark.parametrize(
    "wrong, message",
    [
        (lambda d: GAILCallback(d, env_reward=0.0, expert_reward=0.0), "both 0"),
        (lambda d: GAILCallback(d, env_reward=-1.0), "env_reward must be"),
        (lambda d: GAILCallback(d, label_smoothing=0.5), "label_smoothing must be a number from 0 up to"),
        (lambda d: GAILCallback(d, discriminator_class="vectors"), "'vectors'.*'vector'"),
        (lambda d: GAILCallback(d, discriminator_kwargs={"size": 3}), "size"),
        (
            lambda d: learn(PPO("MultiInputPolicy", reach(), device="cpu"), gail(d)),
            "relabels a replay buffer, and PPO has none",
        ),
        (lambda d: learn(SAC("MultiInputPolicy", reach(), device="cpu"), gail(d)), "needs a CPMBuffer, SAC has a DictReplay"),
        (lambda d: learn(make(reach(), challenge_ratio=0.2), gail(d)), "challenge_ratio=0.2, and challenges have rewards"),
        (lambda d: learn(make(reach()), ChallengerCallback(), gail(d)), "ChallengerCallback beside GAILCallback"),
        (lambda d: learn(make(reach()), gail(d), ChallengerCallback()), "ChallengerCallback beside GAILCallback"),
        (lambda d: learn(make(reach()), gail(d), gail(d)), "two GAILCallbacks"),
        (lambda d: learn(make(VecNormalize(reach())), gail(d)), "norm_reward=False"),
        (lambda d: learn(make(reach()), gail([])), "No demonstrations"),
        (lambda d: learn(make(reach()), gail(d, quota=10)), "does not fit into the ring"),
        (lambda d: learn(make(DummyVecEnv([lambda: DictObservation(gym.make("Pendulum-v1"))])), gail(d)), "state"),
    ],
)
def test_bad_input(demonstrations: Any, wrong: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        wrong(copy.copy(demonstrations))


def test_arguments_in_a_file_are_checked_before_anything_is_built() -> None:
    with pytest.raises(ValueError, match=r"CPMReach-v0, callback .*GAILCallback: gradient_steps must be"):
        load_agent("gail_sac", "CPMReach-v0", {"callback": {"sb3_cpm.imitation.GAILCallback": {"gradient_steps": 0}}})


def test_an_environment_that_does_not_tell_success() -> None:
    class Silent(gym.Wrapper):
        def step(self, action: Any) -> Any:
            return *self.env.step(action)[:4], {}

    demonstrations = record_demonstrations(reach(), 2, seed=1, hold=True)
    env = DummyVecEnv([lambda: Silent(gym.make("CPMReach-v0"))])
    with pytest.raises(ValueError, match="neither 'is_success' nor 'success'"):
        learn(make(env), gail(demonstrations))
    learn(make(env), gail(demonstrations, self_imitation=False, balance=False))


def renamed(demonstrations: list[Demonstration], name: str | None) -> list[Demonstration]:
    return [dataclasses.replace(one, instance=name) for one in demonstrations]


@pytest.mark.parametrize(
    "name, balance, message",
    [
        (None, True, "names an object, '(strong|medium|weak)', and demonstrations name none.*balance=False"),
        ("broken", True, "In 10 episodes the environment has not shown broken, of which there are demonstrations"),
        (None, False, None),
    ],
)
def test_instances_that_the_environment_does_not_have(
    demonstrations: Any, name: str | None, balance: bool, message: str | None
) -> None:
    callback = gail(renamed(demonstrations, name), balance=balance)
    model = make(reach())
    if message is None:
        model.learn(400, callback=callback)
    else:
        with pytest.warns(UserWarning, match=message) as caught:
            model.learn(400, callback=callback)
        assert len(caught) == 1


def test_demonstrations_of_instances_where_the_environment_names_none(demonstrations: Any) -> None:
    class Nameless(gym.Wrapper):
        def step(self, action: Any) -> Any:
            *outcome, info = self.env.step(action)
            return *outcome, {"is_success": info["is_success"]}

    with pytest.warns(UserWarning, match="names none .* and demonstrations name .*medium"):
        make(DummyVecEnv([lambda: Nameless(gym.make("CPMReach-v0"))])).learn(100, callback=gail(demonstrations))


def test_parts_that_no_point_has() -> None:
    net = ProgressiveDiscriminator(CLOUDS, ACTIONS, parts=(0, 7), **SMALL)
    with pytest.raises(ValueError, match=r"parts=\[0, 7\]: no point .* has the label 7, theirs are \[-1, 0, 1, 2\]"):
        net.observe(clouds(5)[0])


def test_a_loss_that_is_not_finite(demonstrations: Any) -> None:
    with pytest.raises(ValueError, match="loss is nan in its update 2.*lower learning_rate"):
        make(reach()).learn(300, callback=gail(demonstrations, learning_rate=1e30))


def test_episodes_that_end_early_are_told() -> None:
    env = DummyVecEnv([lambda: gym.wrappers.TimeLimit(ToyEnv(keys=("state",), terminate_on_success=True), 50)])
    demonstrations = record_demonstrations(env, 2, seed=1)
    with pytest.warns(UserWarning, match="ending early a loss"):
        learn(make(env), gail(demonstrations))
