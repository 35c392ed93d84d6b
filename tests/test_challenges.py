"""The arithmetic of SPEC sections 3 to 6 against values worked out by hand, and what must hold for any input."""

import inspect
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_cpm import CPMBuffer
from sb3_cpm.challenges import ChallengeCurator, ChallengeFilter, ChallengeQuality, DynamicCoefficient, RewardOrigin
from sb3_cpm.challenges.filters import CandidateStatistics, Tolerance
from sb3_cpm.challenges.quality import best_goal
from sb3_cpm.challenges.rewards import ArtificialReward, embedding_progress, step_progress
from sb3_cpm.presets import CHALLENGES
from sb3_cpm.type_aliases import Evaluation

# ---------------------------------------------------------------------- targeting (Algorithm 2)


def test_coefficient_moves_by_one_factor_when_outside_the_tolerance():
    c = DynamicCoefficient(target_ratio=0.5, low=0.8, high=1.25, factor=1.1, initial=1.0, calibrate=False)
    assert c.update([1.0, 3.0], [10.0]) == pytest.approx(1.1)  # 1 * 2 < 0.8 * 0.5 * 10 = 4
    assert c.update([20.0], [10.0]) == pytest.approx(1.0)  # 1.1 * 20 > 1.25 * 5
    assert c.update([5.5], [10.0]) == pytest.approx(1.0)  # 5.5 lies within [4, 6.25]


def test_coefficient_calibrates_once():
    c = DynamicCoefficient(target_ratio=0.3)
    assert c.update([200.0], [0.1]) == pytest.approx(0.3 * 0.1 / 200)
    assert c.update([400.0], [0.1]) == pytest.approx(0.3 * 0.1 / 200 / c.factor)


def test_statistics_are_means_of_magnitudes():
    c = DynamicCoefficient(target_ratio=1.0)
    assert c.update([-2.0, 2.0], [-1.0, 1.0]) == pytest.approx(0.5)


@pytest.mark.parametrize(
    "values, reference", [([0.0, 0.0], [1.0]), ([1.0], [0.0]), ([np.nan], [1.0]), ([1.0], [np.inf]), ([], [1.0]), ([1.0], [])]
)
def test_unusable_statistics_leave_the_coefficient_alone(values, reference):
    c = DynamicCoefficient(target_ratio=1.0, initial=3.0, calibrate=False)
    assert c.update(values, reference) == 3.0
    calibrating = DynamicCoefficient(target_ratio=1.0, initial=3.0)
    assert calibrating.update(values, reference) == 3.0
    assert calibrating.update([2.0], [4.0]) == 2.0, "an unusable call must not use the calibration up"


@pytest.mark.parametrize(
    "kwargs",
    [
        dict(low=0.9, high=1.1, factor=1.2),
        dict(low=1.1, high=1.0),
        dict(factor=1.0),
        dict(low=0.0),
        dict(initial=0.0),
        dict(high="x"),
    ],
)
def test_settings_that_cannot_settle_are_refused(kwargs):
    with pytest.raises(ValueError):
        DynamicCoefficient(target_ratio=1.0, **kwargs)
    with pytest.raises(ValueError, match="oscillate"):
        DynamicCoefficient(1.0, low=0.9, high=1.1, factor=1.2)


@given(value=st.floats(1e-6, 1e6), reference=st.floats(1e-6, 1e6), initial=st.floats(1e-6, 1e6))
@settings(max_examples=50, deadline=None)
def test_coefficient_settles_inside_the_tolerance_and_stays(value, reference, initial):
    c = DynamicCoefficient(target_ratio=0.75, initial=initial, calibrate=False)
    if not 1e-7 < 0.75 * reference / value < 1e7:
        return  # beyond what a coefficient may become
    for _ in range(1000):
        c.update([value], [reference])
    assert c.low <= c.value * value / (0.75 * reference) <= c.high
    assert c.update([value], [reference]) == c.value


def test_coefficients_stay_within_bounds():
    c = DynamicCoefficient(target_ratio=1.0)
    assert c.update([1e-200], [1e200]) == 1e8
    assert DynamicCoefficient(target_ratio=1.0).update([1e200], [1e-200]) == 1e-8


# ---------------------------------------------------------------------- quality S


def test_uncertainty_and_score_by_hand():
    quality = ChallengeQuality()
    disagreement, kl = np.array([9.0, 1.0, 3.0]), np.array([7.0, 4.0, 4.0])
    u = quality.uncertainty(disagreement, kl, first=1)
    # the first transition doesn't count: mean DISAG = 2, mean KL = 4, c1 = 0.1 * 2 / 4 = 0.05
    np.testing.assert_allclose(u, [9.35, 1.2, 3.2])
    s = quality.score(np.array([5.0, 0.5, 0.6]), u, first=1)
    # mean u = 2.2, mean r = 0.55, c = 0.75 * 2.2 / 0.55 = 3
    np.testing.assert_allclose(s, [24.35, 2.7, 5.0])
    assert best_goal(s, first=1) == 2


def test_the_first_of_several_best_goals_is_chosen_and_warm_up_never_is():
    assert best_goal(np.array([9.0, 9.0, 1.0, 5.0, 5.0]), first=2) == 3


# ---------------------------------------------------------------------- filter F


def statistics(**changes):
    values = dict(mean_reward=1.0, scaled_reward=1.0, mean_uncertainty=1.0, mean_score=1.0, goal_score=2.5, goal=9, first=5)
    return CandidateStatistics(**{**values, **changes})


def test_novelty_follows_the_prose_of_the_report():
    keep = ChallengeFilter()  # c * r_bar <= 2 * 0.75 * u_bar
    assert keep.verdicts(statistics(scaled_reward=1.49, mean_uncertainty=1.0))["novel"]
    assert not keep.verdicts(statistics(scaled_reward=1.51, mean_uncertainty=1.0))["novel"]


@pytest.mark.parametrize("memory, bound", [(8.0, 1.0), (-8.0, -15.0), (0.0, 0.0)])
def test_relevance_for_positive_and_negative_memory(memory, bound):
    keep = ChallengeFilter()  # r_bar >= r_mem - (1 - 1/8) * |r_mem|
    keep.reward_memory = memory
    assert keep.verdicts(statistics(mean_reward=bound + 0.01))["relevant"]
    assert keep.verdicts(statistics(mean_reward=bound))["relevant"]
    assert not keep.verdicts(statistics(mean_reward=bound - 0.01))["relevant"]


@pytest.mark.parametrize("mean_score, bound", [(2.0, 4.0), (-2.0, 0.0)])
def test_highlight_for_positive_and_negative_scores(mean_score, bound):
    keep = ChallengeFilter()  # S_g - S_bar >= (2 - 1) * |S_bar|
    assert keep.verdicts(statistics(mean_score=mean_score, goal_score=bound))["highlight"]
    assert not keep.verdicts(statistics(mean_score=mean_score, goal_score=bound - 0.01))["highlight"]


def test_hard_criteria_and_majority():
    novel_no = dict(scaled_reward=100.0)
    highlight_no = dict(goal_score=1.5)
    assert ChallengeFilter().judge(statistics())[0]
    assert ChallengeFilter().judge(statistics(**novel_no))[0], "two of the first three are enough"
    assert not ChallengeFilter().judge(statistics(**novel_no, **highlight_no))[0]
    assert not ChallengeFilter().judge(statistics(goal=5))[0], "the first counted transition is no goal"
    accepted, verdicts = ChallengeFilter().judge(statistics(goal_score=0.0, mean_score=-1.0))
    assert not accepted and verdicts["highlight"] and not verdicts["sane"]


def test_tolerances_move_by_their_own_criterion():
    keep = ChallengeFilter(gamma=1.21, target_acceptance=0.5)
    keep.judge(statistics(scaled_reward=100.0))  # novel: no, relevant: yes, highlight: yes
    assert keep.w1.value == pytest.approx(2.0 * 1.1)  # looser: larger
    assert keep.w2.value == pytest.approx(8.0 / 1.1)  # stricter: smaller
    assert keep.w3.value == pytest.approx(2.0 * 1.1)  # stricter: larger


def test_reward_memory():
    keep = ChallengeFilter()
    keep.remember(2.0)
    assert keep.reward_memory == 2.0
    keep.remember(3.0)
    assert keep.reward_memory == pytest.approx(0.99 * 2.0 + 0.01 * 3.0)


@pytest.mark.parametrize("share", [0.3, 0.5, 0.8])
@pytest.mark.parametrize("looser", [+1, -1])
def test_a_filter_settles_at_its_target_acceptance(share, looser):
    rng = np.random.default_rng(0)
    tolerance = Tolerance(20.0, looser=looser, gamma=1.02, target_acceptance=share)
    accepted = []
    for value in rng.lognormal(size=6000):
        verdict = value <= tolerance.value if looser > 0 else value >= tolerance.value
        tolerance.update(verdict)
        accepted.append(verdict)
    assert np.mean(accepted[2000:]) == pytest.approx(share, abs=0.03)


def test_a_tolerance_that_always_rejects_stays_finite():
    tolerance = Tolerance(2.0, looser=+1)
    for _ in range(10_000):
        tolerance.update(False)
    assert tolerance.value == Tolerance.MAX


@pytest.mark.parametrize(
    "kwargs",
    [
        dict(gamma=1.0),
        dict(target_acceptance=0.0),
        dict(target_acceptance=1.0),
        dict(novelty_tolerance=-1),
        dict(reward_memory_decay=1.0),
        dict(relevance_tolerance="8"),
        dict(target_acceptance="half"),
    ],
)
def test_filter_arguments(kwargs):
    with pytest.raises(ValueError):
        ChallengeFilter(**kwargs)


# ---------------------------------------------------------------------- artificial reward R


@pytest.mark.parametrize("name", ["scale", "exploration_ratio", "embedding_ratio", "step_ratio"])
@pytest.mark.parametrize("value", [-1, 0, np.nan, np.inf, "large", True])
def test_rewards_that_would_teach_something_else_are_refused(name, value):
    """A negative scale turns every reward around, and nothing else would tell."""
    with pytest.raises(ValueError, match=f"{name} must be a finite number above 0"):
        ArtificialReward(**{name: value})


def test_embedding_progress_by_hand():
    embeddings = np.array([[0.0, 0.0], [1.0, -1.0], [2.0, 2.0]])
    np.testing.assert_allclose(embedding_progress(embeddings), [4.0 - 4.0, 4.0])


@given(st.integers(1, 20), st.integers(1, 5), st.integers(0, 2**31))
@settings(max_examples=30, deadline=None)
def test_embedding_progress_sums_to_the_distance_of_start_and_goal(n_steps, dim, seed):
    embeddings = np.random.default_rng(seed).normal(size=(n_steps + 1, dim))
    assert embedding_progress(embeddings).sum() == pytest.approx(np.abs(embeddings[-1] - embeddings[0]).sum())


def test_step_progress():
    np.testing.assert_allclose(step_progress(4), [0.25, 0.5, 0.75, 1.0])


def test_artificial_reward_by_hand():
    reward = ArtificialReward()
    terms = reward(np.array([1.0, 2.0]), np.array([3.0, 3.0]), np.array([[0.0], [1.0], [4.0]]))
    # c_expl = 1.5 / 1.5 / 3 = 1/3; d_emb = (1, 3), c_emb = 0.3 * 1 / 2; d_step = (0.5, 1), c_step = 0.3 * 1 / 0.75
    np.testing.assert_allclose(terms.exploration, [1.0, 1.0])
    np.testing.assert_allclose(terms.embedding, [0.15, 0.45])
    np.testing.assert_allclose(terms.step, [0.2, 0.4])
    np.testing.assert_allclose(terms.total, [0.5 * (1 + 1 + 0.15 + 0.2), 0.5 * (2 + 1 + 0.45 + 0.4)])
    assert terms.total.mean() / 1.5 == pytest.approx(0.5 * (1 + 2 / 3 + 0.2 + 0.2))


@pytest.mark.parametrize("calibrate", [True, False])
def test_settled_coefficients_meet_the_targets_of_the_report(calibrate):
    rng = np.random.default_rng(1)
    curator = ChallengeCurator(
        coefficient_kwargs=dict(calibrate=calibrate), filter_kwargs=dict(novelty_tolerance=1e5, relevance_tolerance=1e5)
    )
    ratios = []
    for round_ in range(800):
        evaluation = Evaluation(
            rng.gamma(4.0, 0.01, 50), rng.gamma(4.0, 2.0, 50), np.linspace(0, 30, 51)[:, None] * np.ones((1, 8))
        )
        p = curator.propose(rng.gamma(4.0, 0.1, 50), evaluation)
        if p.accepted and round_ > 400:
            a, counted = p.artificial, slice(p.first, None)
            ratios.append([
                p.coefficients["c1"] * p.kl[counted].mean() / p.disagreement[counted].mean() / 0.1,
                p.coefficients["c"] * p.rewards[counted].mean() / p.uncertainty[counted].mean() / 0.75,
                a.exploration.mean() / a.extrinsic.mean() * 1.5,
                a.embedding.mean() / a.exploration.mean() / 0.3,
                a.step.mean() / a.exploration.mean() / 0.3,
                a.total.mean() / a.extrinsic.mean() / (0.5 * (1 + 2 / 3 + 0.4)),
            ])  # fmt: skip
    assert len(ratios) > 50
    assert np.all(np.abs(np.log(np.median(ratios, axis=0))) < np.log(1.34)), np.median(ratios, axis=0)
    assert np.median(ratios, axis=0)[-1] == pytest.approx(1.0, abs=0.15)


# ---------------------------------------------------------------------- curator


def evaluation_of(n_steps, seed=0, dim=3):
    rng = np.random.default_rng(seed)
    return Evaluation(rng.random(n_steps), rng.random(n_steps), rng.random((n_steps + 1, dim)))


def test_a_challenge_starts_after_the_warm_up_and_ends_with_its_goal():
    curator = ChallengeCurator(filter_kwargs=dict(novelty_tolerance=100.0, relevance_tolerance=100.0))
    evaluation = evaluation_of(20)
    evaluation.disagreement[12] = 10.0
    evaluation.disagreement[2] = 99.0  # within the warm-up: doesn't count
    proposal = curator.propose(np.ones(20), evaluation)
    assert proposal.accepted and proposal.first == 5 and proposal.goal == 12
    assert proposal.artificial.total.shape == (8,)
    total = proposal.artificial.embedding.sum() / proposal.coefficients["c_emb"]
    assert total == pytest.approx(np.abs(evaluation.embeddings[13] - evaluation.embeddings[5]).sum())


@pytest.mark.parametrize("n_steps, counts", [(0, False), (1, False), (5, False), (6, True)])
def test_short_trajectories_have_no_challenge(n_steps, counts):
    curator = ChallengeCurator()
    proposal = curator.propose(np.ones(n_steps), evaluation_of(n_steps))
    assert (proposal is not None) == counts
    if counts:  # its only counted transition is the first one: F5
        assert not proposal.accepted and not proposal.verdicts["not_first"]
    assert (curator.filter.reward_memory is not None) == (n_steps > 0)


def test_equal_scores_and_zero_rewards_are_no_highlight():
    curator = ChallengeCurator()
    flat = Evaluation(np.full(20, 0.5), np.full(20, 0.5), np.zeros((21, 2)))
    proposal = curator.propose(np.zeros(20), flat)
    assert not proposal.accepted and proposal.goal == 5
    assert proposal.coefficients["c"] == 1.0, "a reward of zero must not move its coefficient"


def test_negative_rewards_work():
    curator = ChallengeCurator()
    for seed in range(50):
        proposal = curator.propose(-np.random.default_rng(seed).random(30), evaluation_of(30, seed))
        assert np.isfinite(list(proposal.coefficients.values())).all()


@pytest.mark.parametrize("broken", ["shape", "nan", "embeddings", "rewards"])
def test_a_broken_evaluation_is_refused_and_changes_nothing(broken):
    curator = ChallengeCurator()
    curator.propose(np.ones(20), evaluation_of(20))
    before = pickle.dumps(curator)
    rewards, evaluation = np.ones(20), evaluation_of(20)
    if broken == "shape":
        evaluation = evaluation._replace(kl=evaluation.kl[:-1])
    elif broken == "nan":
        evaluation.disagreement[3] = np.nan
    elif broken == "embeddings":
        evaluation = evaluation._replace(embeddings=evaluation.embeddings[:-1])
    else:
        rewards[4] = np.inf
    with pytest.raises(ValueError, match="20-step trajectory"):
        curator.propose(rewards, evaluation)
    assert pickle.dumps(curator) == before


# ---------------------------------------------------------------------- rewards that are not positive


def trajectory(rng, n_steps=50):
    """Positive rewards and an evaluation, both larger in some trajectories than in others."""
    rewards = rng.gamma(4.0, 0.1, n_steps) * rng.lognormal(0.0, 0.3)
    disagreement = rng.gamma(4.0, 0.01, n_steps) * rng.lognormal(0.0, 0.3)
    embeddings = np.linspace(0, 30, n_steps + 1)[:, None] + rng.normal(0.0, 0.3, (n_steps + 1, 4))
    return rewards, Evaluation(disagreement, rng.gamma(4.0, 2.0, n_steps), embeddings)


def proposals(change, n=300, seed=0, **kwargs):
    """
    :param change: makes a trajectory's rewards of (positive rewards, number of the trajectory)
    :return: the curator, and what it said of n trajectories
    """
    rng, curator, result = np.random.default_rng(seed), ChallengeCurator(**kwargs), []
    for number in range(n):
        rewards, evaluation = trajectory(rng)
        result.append(curator.propose(change(rewards, number), evaluation))
    return curator, result


def mountain_car(rewards, number):
    """Actions cost up to 0.1; from the 50th trajectory on every fourth one reaches the goal at its end."""
    costs = -0.1 * np.minimum(rewards, 1.0)
    costs[-1] += 100.0 * (number >= 50 and number % 4 == 0)
    return costs


SIGNS = {
    "positive": lambda r, number: r,
    "shifted": lambda r, number: r - 1.0,
    "shifted far": lambda r, number: r - 1000.0,
    "shifted to a mean of zero": lambda r, number: r - 0.418,
    "mirrored": lambda r, number: -r,
    "mirrored and large": lambda r, number: -50.0 * r,
    "of both signs in turn": lambda r, number: r if number % 2 else -r,
    "action costs and rare success": mountain_car,
    "rising from below zero": lambda r, number: r - 8.0 * np.exp(-number / 60),
}


@pytest.mark.parametrize("kind", SIGNS)
def test_novelty_settles_at_its_target_acceptance_whatever_the_sign(kind):
    _, found = proposals(SIGNS[kind])
    w1 = [p.coefficients["w1"] for p in found]
    assert min(w1) > 1e-2 and max(w1) < 1e2
    assert np.mean([p.verdicts["novel"] for p in found[100:]]) == pytest.approx(0.5, abs=0.1)
    # most of what is kept passes two of three criteria, each of which accepts half
    assert np.mean([p.accepted for p in found[100:]]) == pytest.approx(0.5, abs=0.15)


@pytest.mark.parametrize("kind", SIGNS)
def test_artificial_rewards_stay_in_the_range_of_the_task_whatever_the_sign(kind):
    _, found = proposals(SIGNS[kind])
    kept = [p.artificial for p in found[100:] if p.accepted]
    mean, of_task = (np.mean([getattr(a, name).mean() for a in kept]) for name in ("total", "extrinsic"))
    assert mean == pytest.approx(1.03 * of_task, abs=0.15 * abs(1.03 * of_task) + 1e-12)


def test_after_negative_rewards_positive_ones_are_judged_at_once():
    """The printed F1 holds for all negative rewards; w1, tightened by 300 of them, then held all else back for hundreds."""
    _, found = proposals(lambda r, number: r - 3.0 if number < 300 else r, n=450)
    assert np.mean([p.verdicts["novel"] for p in found[350:]]) == pytest.approx(0.5, abs=0.12)
    _, found = proposals(lambda r, number: r - 3.0 if number < 300 else r, n=450, **FORMER)
    assert not any(p.verdicts["novel"] for p in found[300:])


FORMER = dict(
    reward_origin="zero",
    filter_kwargs=dict(self_balancing="always"),
    reward_kwargs=dict(keep_mean=False, zero_reward_size=None),
)


def test_the_former_form_is_an_option_and_equal_for_positive_rewards():
    ours, found = proposals(SIGNS["positive"])
    printed, found_by_printed = proposals(SIGNS["positive"], **FORMER)
    for p, q in zip(found, found_by_printed, strict=True):
        assert p.coefficients == q.coefficients and p.verdicts == q.verdicts and p.goal == q.goal
        np.testing.assert_array_equal(p.score, q.score)
        if p.accepted:
            np.testing.assert_array_equal(p.artificial.total, q.artificial.total)
            assert p.artificial.constant == 0.0
    assert ours.origin.value == printed.origin.value == 0.0

    _, found = proposals(SIGNS["mirrored"], **FORMER)
    assert all(p.verdicts["novel"] for p in found) and found[-1].coefficients["w1"] < 1e-2
    cancelled = np.mean([p.artificial.total.mean() / p.artificial.extrinsic.mean() for p in found if p.accepted])
    assert abs(cancelled) < 0.1


@given(shift=st.floats(-1e4, 0.0, allow_subnormal=False), further=st.floats(-1e4, -1.0), seed=st.integers(0, 1000))
@settings(max_examples=15, deadline=None)
def test_a_constant_added_to_negative_rewards_decides_nothing(shift, further, seed):
    _, found = proposals(lambda r, number: shift - r, n=40, seed=seed)
    _, moved = proposals(lambda r, number: shift + further - r, n=40, seed=seed)
    for p, q in zip(found, moved, strict=True):
        assert p.verdicts == q.verdicts and p.goal == q.goal
        np.testing.assert_allclose(p.score, q.score, rtol=1e-6, atol=1e-6)
        assert q.coefficients["reward_origin"] - p.coefficients["reward_origin"] == pytest.approx(further)
        for name in ("c", "c1", "c_expl", "c_emb", "c_step", "w1", "w2", "w3"):
            assert p.coefficients[name] == pytest.approx(q.coefficients[name], rel=1e-6)
        if p.accepted:
            np.testing.assert_allclose(p.artificial.total + further, q.artificial.total, rtol=1e-6, atol=1e-6)


@given(st.lists(st.floats(-1e3, 1e3, allow_subnormal=False), min_size=6, max_size=30), st.integers(0, 100))
@settings(max_examples=50, deadline=None)
def test_any_challenge_with_a_negative_reward_keeps_the_mean_of_the_task(rewards, seed):
    rewards, reward = np.array([*rewards, -1.0]), ArtificialReward()
    rng = np.random.default_rng(seed)
    a = reward(rewards, rng.random(len(rewards)), rng.random((len(rewards) + 1, 3)))
    assert a.total.mean() == pytest.approx(rewards.mean(), abs=1e-6)
    terms = reward.scale * (a.extrinsic + a.exploration + a.embedding + a.step)
    np.testing.assert_allclose(a.total, terms + a.constant, atol=1e-9)


def test_origin_by_hand():
    origin = RewardOrigin()
    assert origin.value == 0.0
    origin.remember(np.arange(11.0))  # its lower decile is 1
    assert origin.value == 0.0, "positive rewards are measured from zero"
    origin.remember(np.array([0.0] * 10 + [-110.0]))  # lower decile 0, mean -10
    assert origin.value == pytest.approx(-10.0 + 0.1 * 11.0)  # between the levels -10 and 1
    for _ in range(RewardOrigin.WINDOW):
        origin.remember(np.array([-1.0, -3.0]))
    assert origin.value == pytest.approx(-2.8)
    zero = RewardOrigin("zero")
    zero.remember(np.array([-5.0]))
    assert zero.value == 0.0


def test_negative_rewards_by_hand():
    """r = (-4, -2) from o = -6 is (2, 4), with a mean of 3."""
    reward = ArtificialReward()
    a = reward(np.array([-4.0, -2.0]), np.array([1.0, 3.0]), np.array([[0.0], [1.0], [4.0]]), origin=-6.0)
    # c_expl = 3 / 1.5 / 2 = 1; d_emb = (1, 3), c_emb = 0.3 * 2 / 2; d_step = (0.5, 1), c_step = 0.3 * 2 / 0.75
    np.testing.assert_allclose(a.exploration, [1.0, 3.0])
    np.testing.assert_allclose(a.embedding, [0.3, 0.9])
    np.testing.assert_allclose(a.step, [0.4, 0.8])
    # 0.5 * (-4 + 1.7) = -1.15 and 0.5 * (-2 + 4.7) = 1.35 have the mean 0.1, the task -3
    assert a.constant == pytest.approx(-3.1)
    np.testing.assert_allclose(a.total, [-4.25, -1.75])


@pytest.mark.parametrize("reward", [-1.0, -0.1, -1e-3, -1000.0])
def test_a_constant_reward_moves_nothing_that_it_does_not_decide(reward):
    """A mean of -0.1 throughout is not quite -0.1: rounding is no reward that c could be measured by."""
    curator, found = proposals(lambda r, number: np.full_like(r, reward), n=100)
    assert curator.filter.w1.value == 2.0 and curator.filter.w2.value == 8.0
    assert curator.quality.c.value == 1.0
    assert all(p.verdicts["novel"] and p.verdicts["relevant"] for p in found)
    for p in found:
        if p.accepted:
            assert p.artificial.total.mean() == pytest.approx(reward)
            assert p.artificial.exploration.mean() == pytest.approx(0.1 / 1.5)


def test_a_sparse_reward_below_zero_is_judged_as_one_above():
    """Fetch's -1 until success is 0 until success, shifted."""

    def sparse(number):
        return np.arange(50) >= (40 if number % 5 == 0 else 50)

    _, above = proposals(lambda r, number: sparse(number).astype(float))
    _, below = proposals(lambda r, number: sparse(number) - 1.0)
    assert [p.verdicts for p in above] == [p.verdicts for p in below]
    w1, w2 = ([p.coefficients[name] for p in below] for name in ("w1", "w2"))
    assert min(*w1, *w2) > 1e-2 and max(*w1, *w2) < 1e2


def test_challenges_without_any_reward_have_a_size_of_their_own():
    """Before it was that of u: c_expl was 1 because it begins at 1."""
    _, found = proposals(lambda r, number: np.zeros_like(r))
    kept = [p.artificial.total.mean() for p in found if p.accepted]
    assert kept[0] == pytest.approx(0.5 * 0.1 / 1.5 * 1.6)
    assert np.median(kept) == pytest.approx(0.5 * 0.1 / 1.5 * 1.6, rel=0.15)
    _, found = proposals(lambda r, number: np.zeros_like(r), reward_kwargs=dict(zero_reward_size=2.0))
    assert np.median([p.artificial.total.mean() for p in found if p.accepted]) == pytest.approx(0.5 * 2 / 1.5 * 1.6, rel=0.15)


def test_the_first_reward_still_calibrates_and_then_the_memory_stands_in():
    reward = ArtificialReward()
    u, embeddings = np.full(10, 4.0), np.linspace(0, 1, 11)[:, None]
    assert reward(np.zeros(10), u, embeddings).exploration.mean() == pytest.approx(0.1 / 1.5)
    a = reward(np.full(10, 30.0), u, embeddings)
    assert a.exploration.mean() == pytest.approx(20.0)
    assert a.embedding.mean() == pytest.approx(6.0) and a.step.mean() == pytest.approx(6.0)
    for _ in range(60):
        a = reward(np.zeros(10), u, embeddings, usual_reward=3.0)
    assert 0.75 <= a.exploration.mean() / 2.0 <= 4 / 3
    assert a.constant == 0.0


def test_without_calibration_a_stand_in_moves_by_one_factor_too():
    reward = ArtificialReward(coefficient_kwargs=dict(calibrate=False))
    a = reward(np.zeros(10), np.ones(10), np.linspace(0, 1, 11)[:, None])
    assert a.exploration.mean() == pytest.approx(1 / 1.15)


def test_refreshed_rewards_keep_the_mean_too():
    curator, found = proposals(SIGNS["mirrored"], n=60)
    p = next(p for p in reversed(found) if p.accepted)
    refreshed = curator.refresh(p, trajectory(np.random.default_rng(9))[1])
    assert refreshed.artificial.total.mean() == pytest.approx(refreshed.artificial.extrinsic.mean())


def test_the_origin_is_saved_with_the_curator_and_curators_saved_before_load():
    curator, _ = proposals(SIGNS["mirrored"], n=30)
    loaded = pickle.loads(pickle.dumps(curator))
    assert loaded.origin.value == curator.origin.value < 0.0
    rewards, evaluation = trajectory(np.random.default_rng(5))
    p, q = curator.propose(-rewards, evaluation), loaded.propose(-rewards, evaluation)
    assert p.coefficients == q.coefficients and p.verdicts == q.verdicts

    former, _ = proposals(SIGNS["positive"], n=30)
    memory = former.filter.reward_memory
    del former.origin, former.filter.self_balancing, former.filter.reward_memory_update
    del former.reward.keep_mean, former.reward.zero_reward_size, former.reward.distance_reference
    for coefficient in (former.quality.c, former.quality.c1, former.reward.c_expl, former.reward.c_emb, former.reward.c_step):
        del coefficient.statistic
    loaded = pickle.loads(pickle.dumps(former))
    loaded.propose(-rewards, evaluation)
    assert loaded.origin.value < 0.0 and loaded.filter.reward_memory == pytest.approx(0.99 * memory - 0.01 * rewards.mean())


@pytest.mark.parametrize(
    "kwargs, message",
    [
        (dict(reward_origin="mean"), "reward_origin must be one of .*'low_quantile', 'zero'.*, got 'mean'"),
        (dict(filter_kwargs=dict(self_balancing="never")), "filter_kwargs: self_balancing must be one of .*got 'never'"),
        (dict(reward_kwargs=dict(keep_mean="yes")), "reward_kwargs: keep_mean must be one of .*got 'yes'"),
        (
            dict(reward_kwargs=dict(zero_reward_size=0)),
            "zero_reward_size must be None or a finite number above 0",
        ),
        (dict(reward_kwargs=dict(zero_reward_size="1e-2")), "That is text"),
    ],
)
def test_options_for_signs_are_checked(kwargs, message):
    with pytest.raises(ValueError, match=message):
        ChallengeCurator(**kwargs)


# ---------------------------------------------------------------------- printed variants of the report


def correlation_with_uncertainty(reference, seed):
    """:return: Spearman's, of c_step and u over challenges whose u and r wander independently, u by a factor of hundreds"""
    rng, u, r, rows = np.random.default_rng(seed), 0.0, 0.0, []
    reward = ArtificialReward(distance_reference=reference)
    for _ in range(500):
        u, r = (0.95 * x + (1 - 0.95**2) ** 0.5 * rng.normal() for x in (u, r))
        reward(
            0.1 * np.exp(0.5 * r + rng.normal(0, 0.3, 30)),
            np.exp(u + rng.normal(0, 0.3, 30)),
            np.cumsum(rng.normal(1, 1, (31, 4)), axis=0),
        )
        rows.append((u, reward.c_step.value))
    ranks = np.argsort(np.argsort(rows[20:], axis=0), axis=0)
    return np.corrcoef(ranks.T)[0, 1]


def test_with_u_as_the_reference_the_coefficient_of_steps_follows_u_as_in_figure_8():
    printed = np.median([correlation_with_uncertainty("uncertainty", seed) for seed in range(8)])
    ours = np.median([correlation_with_uncertainty("exploration", seed) for seed in range(8)])
    assert printed == pytest.approx(0.87, abs=0.05) and ours == pytest.approx(0.39, abs=0.1)


def test_distance_reference_by_hand():
    reward = ArtificialReward(distance_reference="uncertainty")
    a = reward(np.array([1.0, 2.0]), np.array([3.0, 3.0]), np.array([[0.0], [1.0], [4.0]]))
    # c_expl as ever; d_emb = (1, 3), c_emb = 0.3 * 3 / 2; d_step = (0.5, 1), c_step = 0.3 * 3 / 0.75
    np.testing.assert_allclose(a.exploration, [1.0, 1.0])
    np.testing.assert_allclose(a.embedding, [0.45, 1.35])
    np.testing.assert_allclose(a.step, [0.6, 1.2])


def test_signed_means_give_back_and_forth_its_full_share():
    embeddings = np.array([[0.0], [3.0], [2.0], [4.0]])  # d_emb = (3, -1, 2): mean 4/3, mean magnitude 2
    for statistic, share in (("magnitude", 0.3 * (4 / 3) / 2), ("mean", 0.3)):
        reward = ArtificialReward(coefficient_kwargs=dict(statistic=statistic))
        a = reward(np.ones(3), np.ones(3), embeddings)
        assert a.embedding.mean() / a.exploration.mean() == pytest.approx(share)


def test_signed_means_of_opposite_signs_leave_a_coefficient_alone():
    c = DynamicCoefficient(1.0, statistic="mean")
    assert c.update([-1.0, -3.0], [4.0]) == 1.0 and c.update([2.0], [-4.0]) == 1.0 and c.update([1.0, -1.0], [4.0]) == 1.0
    assert c.update([-1.0, -3.0], [-4.0, -4.0]) == pytest.approx(2.0)
    with pytest.raises(ValueError, match="statistic must be one of .*'magnitude', 'mean'.*, got 'signed'"):
        DynamicCoefficient(1.0, statistic="signed")


def test_the_printed_novelty_is_ours_with_a_tolerance_of_one_half():
    """w1 * c * r_bar <= c* * u_bar with w1 = 2, loosened by making w1 smaller."""
    keep, printed = ChallengeFilter(novelty_tolerance=0.5), Tolerance(2.0, looser=-1)
    rng = np.random.default_rng(0)
    for scaled, u in rng.lognormal(size=(300, 2)):
        verdict = printed.value * scaled <= 0.75 * u
        assert keep.judge(statistics(scaled_reward=scaled, mean_uncertainty=u))[1]["novel"] == verdict
        printed.update(verdict)
        assert keep.w1.value == pytest.approx(1 / printed.value)


def test_reward_memory_over_all_trajectories_of_a_call():
    one_by_one, together = (ChallengeCurator(filter_kwargs=dict(reward_memory_update=how)) for how in ("trajectory", "call"))
    first, second, third = np.full(10, 1.0), np.full(30, 2.0), np.full(20, 5.0)
    for curator in (one_by_one, together):
        for call in ([first, second], [], [third]):
            curator.remember_call(call)
            for rewards in call:
                curator.propose(rewards, evaluation_of(len(rewards)))
    assert one_by_one.filter.reward_memory == pytest.approx(0.99 * (0.99 * 1.0 + 0.01 * 2.0) + 0.01 * 5.0)
    assert together.filter.reward_memory == pytest.approx(0.99 * 1.75 + 0.01 * 5.0)
    with pytest.raises(ValueError, match="reward_memory_update must be one of .*, got 'rollout'"):
        ChallengeFilter(reward_memory_update="rollout")


# ---------------------------------------------------------------------- presets


def test_the_report_is_the_default_and_tuned_keeps_the_size_of_rewards():
    of_buffer, of_rewards = (inspect.signature(kind).parameters for kind in (CPMBuffer, ArtificialReward))
    for name, value in CHALLENGES["report"].items():
        if name != "reward_kwargs":
            assert of_buffer[name].default == value
    for name, value in CHALLENGES["report"]["reward_kwargs"].items():
        assert of_rewards[name].default == value
    assert CHALLENGES["tuned"].keys() == CHALLENGES["report"].keys()

    terms = 1.0 + CHALLENGES["tuned"]["reward_kwargs"]["exploration_ratio"] * (1.0 + 0.3 + 0.3)
    assert CHALLENGES["tuned"]["reward_kwargs"]["scale"] * terms == pytest.approx(1.0, abs=0.01)
