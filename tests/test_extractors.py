"""PointNet: invariance, identity at the start, gradients, and what the player's networks never see."""

import copy
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib import TQC
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.preprocessing import preprocess_obs

from sb3_cpm.envs.toy import ToyEnv
from sb3_cpm.extractors import PointNet, PointNetExtractor, PointNetPolicy
from sb3_cpm.imitation.cloning import actor_parameters
from sb3_cpm.policies import LayerNormPolicy, RLPDPolicy

SPACE = spaces.Dict(
    {
        "camera": spaces.Box(0, 255, (3, 32, 32), np.uint8),
        "pointcloud": spaces.Box(-2, 2, (40, 6), np.float32),
        "state": spaces.Box(-1, 1, (5,), np.float32),
    }
)


def batch(n: int = 4) -> dict[str, th.Tensor]:
    return {"pointcloud": th.randn(n, 40, 6), "state": th.randn(n, 5)}


@pytest.mark.parametrize("input_transform", [False, True])
def test_order_of_points_does_not_matter(input_transform: bool) -> None:
    extractor = PointNetExtractor(SPACE, input_transform=input_transform)
    observations = batch()
    shuffled = {**observations, "pointcloud": observations["pointcloud"][:, th.randperm(40)]}
    assert th.allclose(extractor(observations), extractor(shuffled), atol=1e-6)


def test_equals_the_plain_formula_with_and_without_gradient() -> None:
    """Critical points are a shortcut: values and gradients are those of relu(max(MLP))."""
    net = PointNet(6, (8, 16))
    points = th.randn(3, 40, 6, requires_grad=True)
    plain = th.relu(net.last(net.shared(points)).amax(dim=1))
    expected = th.autograd.grad(plain.square().sum(), [points, *net.parameters()])
    result = net(points)
    found = th.autograd.grad(result.square().sum(), [points, *net.parameters()])
    assert th.allclose(result, plain, atol=1e-6)
    for one, other in zip(found, expected, strict=True):
        assert th.allclose(one, other, atol=1e-5)
    with th.no_grad():
        assert th.allclose(net(points), plain, atol=1e-6)


def test_many_clouds_go_through_in_parts_with_the_same_result() -> None:
    net = PointNet(6, (16, 512))
    clouds = th.randn(5, 200, 6)
    clouds[1, 40] = clouds[1, 17] = 9.0  # the first of equals is the critical one
    assert len(net._parts(clouds)) == 3
    with th.no_grad():
        channels = net._project(clouds)
        assert th.equal(th.cat([net._critical(part) for part in net._parts(clouds)]), channels.max(dim=1).indices)
        alone = th.cat([net(cloud.unsqueeze(0)) for cloud in clouds])
        th.testing.assert_close(net(clouds), alone, rtol=0, atol=1e-6)
    th.testing.assert_close(net(clouds), alone, rtol=0, atol=1e-6)
    clouds[3, 100, 2] = th.nan
    found = net(clouds)
    assert found[3].isnan().all() and not found[[0, 1, 2, 4]].isnan().any()


def test_input_transform_starts_as_identity_and_learns() -> None:
    net = PointNet(6, (8, 16), input_transform=True)
    assert net.transform is not None
    points = th.randn(3, 40, 6)
    assert th.allclose(net.transform(points[..., :3]), th.eye(3).expand(3, 3, 3))
    net(points).sum().backward()
    assert net.transform.matrix.weight.grad is not None
    assert net.transform.matrix.weight.grad.abs().sum() > 0


def test_one_layer_and_no_vector() -> None:
    extractor = PointNetExtractor(spaces.Dict({"cloud": SPACE["pointcloud"]}), sizes=(7,))
    assert extractor({"cloud": th.randn(2, 40, 6)}).shape == (2, extractor.features_dim) == (2, 7)


def test_size_state_arch_and_keys() -> None:
    extractor = PointNetExtractor(SPACE, sizes=(8, 16), state_arch=(12,))
    assert extractor.features_dim == 16 + 12
    assert extractor.player_keys == ("pointcloud", "state")
    assert extractor(batch()).shape == (4, 28)
    with_image = PointNetExtractor(SPACE, keys=["state", "camera"], image_size=10)
    assert with_image.player_keys == ("camera", "state")
    assert with_image({"camera": th.rand(2, 3, 32, 32), "state": th.rand(2, 5)}).shape == (2, 15)


def test_channels_last_images_can_be_read() -> None:
    """Images of two stacked cameras keep their channels last, SB3 transposes only what it recognises."""
    space = spaces.Dict({"cameras": spaces.Box(0, 255, (32, 32, 6), np.uint8)})
    extractor = PointNetExtractor(space, keys=["cameras"])
    assert extractor({"cameras": th.rand(2, 32, 32, 6)}).shape == (2, 64)


def test_every_parameter_gets_a_gradient() -> None:
    extractor = PointNetExtractor(SPACE, input_transform=True, state_arch=(8,))
    transform = extractor.clouds[0].transform
    th.nn.init.normal_(transform.matrix.weight, std=0.1)  # while it is zero, nothing below it can learn
    extractor(batch(16)).square().sum().backward()
    for name, parameter in extractor.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.abs().sum() > 0, name


def test_images_are_read_where_there_is_nothing_else() -> None:
    space = spaces.Dict({"camera": SPACE["camera"], "button": spaces.Discrete(3)})
    extractor = PointNetExtractor(space)
    assert extractor.player_keys == ("camera",)
    camera = preprocess_obs({"camera": th.as_tensor(space["camera"].sample()[None])}, spaces.Dict({"camera": space["camera"]}))
    assert extractor(camera).shape == (1, extractor.features_dim) == (1, 64)


def test_float16_clouds_through_preprocessing() -> None:
    extractor = PointNetExtractor(SPACE)
    observations = batch()
    half = {"pointcloud": observations["pointcloud"].half(), "state": observations["state"]}
    exact = {**observations, "pointcloud": half["pointcloud"].float()}
    assert th.equal(extractor(preprocess_obs(half, SPACE)), extractor(exact))
    assert th.equal(extractor(half), extractor(exact))


@pytest.mark.parametrize(
    ("space", "kwargs", "message"),
    [
        (SPACE["state"], {}, "DictObservation"),
        (
            spaces.Dict({"button": spaces.Discrete(3)}),
            {},
            "neither a point cloud.*or take the policy MultiInputPolicy",
        ),
        (SPACE, {"keys": ["lidar"]}, "lidar"),
        (SPACE, {"keys": []}, "neither a point cloud"),
        (spaces.Dict({"button": spaces.Discrete(3)}), {"keys": ["button"]}, "clouds, vectors and images"),
        (SPACE, {"sizes": (0,)}, "at least one layer"),
        (spaces.Dict({"flat": spaces.Box(-1, 1, (40, 2), np.float32)}), {"input_transform": True}, "x, y, z"),
    ],
)
def test_wrong_input(space: Any, kwargs: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PointNetExtractor(space, **kwargs)


class _Untouchable(np.ndarray):
    """Pixels that nobody may convert, copy or move."""

    def __deepcopy__(self, memo: dict) -> "_Untouchable":
        raise AssertionError("the policy touched the camera")

    def __array__(self, *args: Any, **kwargs: Any) -> np.ndarray:
        raise AssertionError("the policy touched the camera")


def test_policy_never_touches_images(tmp_path: Path) -> None:
    model = SAC(PointNetPolicy, ToyEnv(), buffer_size=100, learning_starts=10, batch_size=8, device="cpu")
    model.learn(15)
    observation, _ = ToyEnv().reset(seed=0)
    expected, _ = model.predict(observation, deterministic=True)
    observation["camera"] = np.moveaxis(observation["camera"], -1, 0).view(_Untouchable)
    action, _ = model.predict(observation, deterministic=True)
    assert np.array_equal(action, expected)
    tensors, _ = model.policy.obs_to_tensor(observation)
    assert set(tensors) == {"pointcloud", "state"}

    model.save(tmp_path / "model")
    loaded = SAC.load(tmp_path / "model", device="cpu")
    assert np.array_equal(loaded.predict(observation, deterministic=True)[0], expected)


def test_trains_on_batches_without_images() -> None:
    """CPMBuffer leaves the images out of the batches for the player."""
    model = SAC(PointNetPolicy, ToyEnv(), buffer_size=100, learning_starts=10, batch_size=8, device="cpu")
    model.learn(15)
    sample = model.replay_buffer.sample

    def without_camera(*args: Any, **kwargs: Any) -> Any:
        data = sample(*args, **kwargs)
        for observations in (data.observations, data.next_observations):
            del observations["camera"]
        return data

    model.replay_buffer.sample = without_camera
    before = model.policy.parameters_to_vector()
    model.train(2, batch_size=8)
    assert not np.allclose(before, model.policy.parameters_to_vector())


def test_thrifty_critic_trains_like_that_of_sb3(monkeypatch: pytest.MonkeyPatch) -> None:
    def parameters_after_training() -> np.ndarray:
        model = SAC(PointNetPolicy, ToyEnv(), buffer_size=100, learning_starts=10, batch_size=8, seed=1, device="cpu")
        model.learn(20)
        return model.policy.parameters_to_vector()

    thrifty = parameters_after_training()
    monkeypatch.setattr("sb3_cpm.extractors.FrugalCritic", ContinuousCritic)
    assert np.allclose(thrifty, parameters_after_training(), atol=1e-6)


@pytest.mark.parametrize("algorithm", [TD3, TQC])
def test_with_other_players(algorithm: type) -> None:
    policy_kwargs = {"features_extractor_class": PointNetExtractor}
    model = algorithm(
        "MultiInputPolicy", ToyEnv(), buffer_size=100, learning_starts=10, batch_size=8, policy_kwargs=policy_kwargs
    )
    model.learn(15)


def test_extractor_is_fast_enough() -> None:
    """An update of SAC (batch 64, 350 points) takes about 57 ms on one core; the bound leaves room for a busy machine."""
    space = spaces.Dict({"cloud": spaces.Box(-2, 2, (350, 6), np.float32), "state": spaces.Box(-1, 1, (29,), np.float32)})
    extractor = PointNetExtractor(space)
    observations = {"cloud": th.randn(64, 350, 6), "state": th.randn(64, 29)}
    extractor(observations).sum().backward()
    start = time.process_time()
    for _ in range(5):
        extractor(observations).sum().backward()
    assert (time.process_time() - start) / 5 < 0.06


@pytest.mark.parametrize("shape", [(4, 3), (8, 5), (31, 3), (40, 1), (2, 84)])
def test_stacked_states_are_told_from_clouds(shape: tuple[int, int]) -> None:
    """As a set of points, the last states would look the same forwards and backwards in time."""
    space = spaces.Dict({"stack": spaces.Box(-1, 1, shape), "state": spaces.Box(-1, 1, (2,))})
    with pytest.warns(UserWarning, match="reads 'stack' .* as a point cloud: .*FlattenObservation.*naming all `keys`"):
        PointNetExtractor(space)
    assert PointNetExtractor(space, keys=["stack", "state"]).cloud_keys == ["stack"]  # the user has said so
    PointNetExtractor(spaces.Dict({"cloud": spaces.Box(-1, 1, (32, 3)), "flat": spaces.Box(-1, 1, (64, 2))}))


@pytest.mark.parametrize("size", [(13, 40), (40, 12)])
def test_images_that_are_too_small(size: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="14x14 pixels and more.*ResizeObservation"):
        PointNetExtractor(spaces.Dict({"camera": spaces.Box(0, 255, (*size, 3), np.uint8)}))
    PointNetExtractor(spaces.Dict({"camera": spaces.Box(0, 255, (14, 14, 3), np.uint8)}))


# ---------------------------------------------------------------------- one extractor, the critic's


def sharing(policy: type = PointNetPolicy, **kwargs: Any) -> SAC:
    kwargs = {"critics_extractor": True, "net_arch": [32, 32], **kwargs}
    return SAC(policy, ToyEnv(), buffer_size=100, learning_starts=10, batch_size=8, policy_kwargs=kwargs, seed=1, device="cpu")


@pytest.mark.parametrize("policy", [PointNetPolicy, RLPDPolicy, LayerNormPolicy])
def test_the_critics_loss_alone_trains_what_the_actor_reads(policy: type, tmp_path: Path) -> None:
    model = sharing(policy)
    actor, critic = model.actor, model.critic
    assert actor.features_extractor is critic.features_extractor is not model.critic_target.features_extractor
    of_extractor = {id(one) for one in critic.features_extractor.parameters()}
    optimized = [{id(one) for group in net.optimizer.param_groups for one in group["params"]} for net in (actor, critic)]
    assert not optimized[0] & of_extractor and optimized[1] >= of_extractor
    model.learn(20)
    copy.deepcopy(model.policy)  # what is remembered between actor and critic stays behind
    observation, _ = ToyEnv().reset(seed=0)
    model.save(tmp_path / "model")
    loaded = SAC.load(tmp_path / "model", ToyEnv(), device="cpu")
    assert np.array_equal(
        loaded.predict(observation, deterministic=True)[0], model.predict(observation, deterministic=True)[0]
    )
    assert loaded.actor.features_extractor is loaded.critic.features_extractor
    loaded.learn(20)


def test_features_that_are_remembered_are_those_that_would_be_computed(monkeypatch: pytest.MonkeyPatch) -> None:
    def trained(updates: int) -> tuple[list[th.Tensor], int]:
        model, passes = sharing(), 0
        model.learn(11)
        forward = type(model.critic.features_extractor).forward

        def counted(self: Any, observations: Any) -> th.Tensor:
            nonlocal passes
            passes += 1
            return forward(self, observations)

        with monkeypatch.context() as patch:
            patch.setattr(PointNetExtractor, "forward", counted)
            model.train(updates, batch_size=8)
        return list(model.critic.parameters()), passes

    thrifty, few = trained(1)
    assert few == 3, "observations once, next ones by the actor and by the target"
    assert trained(3)[1] == 9
    monkeypatch.setattr("sb3_cpm.extractors._Remembered.recall", lambda *args: None)
    plain, many = trained(1)
    assert many == 5 and all(th.equal(a, b) for a, b in zip(thrifty, plain, strict=True))


def test_a_clone_trains_the_extractor_that_is_shared() -> None:
    model = sharing()
    names = {id(one): name for name, one in model.policy.named_parameters()}
    observation = {key: th.as_tensor(one).unsqueeze(0) for key, one in ToyEnv().reset(seed=0)[0].items() if key != "camera"}
    found = {names[id(one)].split(".")[1] for one in actor_parameters(model.policy, observation)}
    assert found == {"features_extractor", "latent_pi", "mu"}


def test_two_ways_of_sharing_are_refused() -> None:
    with pytest.raises(ValueError, match="two ways of sharing.*Leave one out"):
        sharing(share_features_extractor=True)
