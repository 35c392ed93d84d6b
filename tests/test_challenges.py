"""The arithmetic of SPEC sections 3 to 6 against values worked out by hand, and what must hold for any input."""

import inspect
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_cpm import CPMBuffer
from sb3_cpm.challenges import ChallengeCurator, ChallengeFilter, ChallengeQuality, DynamicCoefficient
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
