"""From logits of a class-balanced network to probabilities, and how probabilities are evaluated."""

import math

import pytest
import torch

from deimos.goals.calibration import BINS, TEMPERATURES, Calibration, evaluate, reliability
from deimos.goals.fear import Fear, FearConfig
from deimos.goals.interactions import Resolved

CPU = torch.device("cpu")


def outcomes(probability, seed=0):
    """Crashes that happen with the given probabilities."""
    return torch.rand(probability.shape, generator=torch.Generator().manual_seed(seed)) < probability


def known_interactions(count):
    """Interactions whose true crash probability is a function of state and next goal, and that probability."""
    generator = torch.Generator().manual_seed(1)
    state, goal, next_goal = (torch.randn(count, size, generator=generator) for size in (3, 2, 2))
    probability = torch.sigmoid(1.5 * state[:, 0] + next_goal[:, 1] - 3.0)
    integers, numbers = torch.zeros(count, dtype=torch.int64), torch.zeros(count)
    data = Resolved(
        env=torch.arange(count), state=state, goal=goal, next_goal=next_goal, score=numbers, reward=numbers,
        tracking=numbers.unsqueeze(1), probe=integers.bool(), note=integers, crashed=outcomes(probability),
        issued=integers, resolved=integers, horizon=integers + 1,
    )  # fmt: skip
    return data, probability


def test_the_prior_correction_is_exact():
    """The odds that balanced classes multiply by (1 - pi) / pi are divided by it again, to rounding."""
    probability = torch.linspace(0.001, 0.999, 201, dtype=torch.float64)
    for share in (0.01, 0.3, 0.5, 0.8):
        calibration = Calibration()
        calibration.set_share(share)
        balanced = torch.logit(probability) + math.log((1 - share) / share)
        torch.testing.assert_close(calibration.probability(balanced), probability, rtol=1e-12, atol=0)


def test_known_probabilities_are_recovered():
    """A fear network's error of calibration is above 0.1 raw, at most 0.02 corrected, also against the truth itself."""
    data, truth = known_interactions(60_000)
    fear = Fear(FearConfig(), 3, 2, CPU, seed=0)
    train, held_out = data.where(data.env < 40_000), data.where(data.env >= 40_000)
    fear.fit(train, epochs=5)
    score = fear.score(held_out.state, held_out.goal, held_out.next_goal.unsqueeze(1)).squeeze(1)
    calibration = Calibration()
    raw = evaluate(calibration.probability(score), held_out.crashed)
    calibration.set_share(train.crashed.float().mean().item())
    corrected = evaluate(calibration.probability(score), held_out.crashed)
    calibration.fit(score[:10_000] + calibration.prior, held_out.crashed[:10_000], steps=20)
    probability = calibration.probability(score[10_000:])
    last = evaluate(probability, held_out.crashed[10_000:])
    assert raw["ece"] > 0.1
    assert corrected["ece"] <= 0.02
    assert last["ece"] <= 0.02
    assert raw["log_loss_skill"] < 0 < last["log_loss_skill"]
    assert (probability - truth[50_000:]).abs().mean() < 0.02


@pytest.mark.parametrize("temperature", [0.5, 1.0, 3.0])
def test_the_temperature_is_found(temperature):
    """Scores that are a multiple of the true logits give the multiple, where the log-loss is least."""
    truth = torch.randn(40_000, generator=torch.Generator().manual_seed(0)) - 1.0
    crashed = outcomes(torch.sigmoid(truth))
    calibration = Calibration()
    calibration.set_share(0.3)
    score = temperature * truth - calibration.prior
    calibration.fit(score + calibration.prior, crashed, steps=20)
    # The inverse's standard error is (n E[p (1 - p) z^2])^(-1/2), which is below 0.018 / temperature here.
    assert calibration.temperature == pytest.approx(temperature, rel=0.07)
    expected = torch.sigmoid(temperature / calibration.temperature * truth)
    torch.testing.assert_close(calibration.probability(score), expected, rtol=1e-4, atol=1e-6)

    def loss(value):
        logit = (score + calibration.prior) / value
        return torch.nn.functional.binary_cross_entropy_with_logits(logit.double(), crashed.double())

    assert loss(calibration.temperature) < min(
        loss(0.99 * calibration.temperature), loss(1.01 * calibration.temperature)
    )


def test_the_temperature_follows_from_update_to_update():
    """A few steps of Newton's method per update end where many do, and none leaves the range of temperatures."""
    truth = torch.randn(5000, generator=torch.Generator().manual_seed(0))
    crashed = outcomes(torch.sigmoid(truth))
    tracked, settled = Calibration(), Calibration()
    for _ in range(10):
        tracked.fit(4.0 * truth, crashed)
    settled.fit(4.0 * truth, crashed, steps=100)
    assert tracked.temperature == pytest.approx(settled.temperature, rel=1e-6)
    for score, end in ((-truth, TEMPERATURES[1]), (crashed.float() - 0.5, TEMPERATURES[0])):
        calibration = Calibration()
        calibration.fit(score, crashed, steps=100)
        assert calibration.temperature == end


def test_it_continues_from_its_state():
    """Prior and temperature come back as they were."""
    first, second = Calibration(), Calibration()
    first.set_share(0.1)
    first.temperature = 1.7
    second.load_state_dict(first.state_dict())
    assert vars(first) == vars(second)


def test_reliability_bins_are_equally_full():
    """Bins hold equally many predictions up to one, in rising order, with their means; few predictions make few."""
    probability = torch.rand(1000, generator=torch.Generator().manual_seed(0))
    crashed = outcomes(probability)
    curve = reliability(probability, crashed)
    assert int(curve.count.sum()) == 1000
    assert set(curve.count.tolist()) <= {1000 // BINS, 1000 // BINS + 1}
    order = probability.argsort().split(curve.count.tolist())
    for place, rows in enumerate(order):
        assert curve.predicted[place].item() == pytest.approx(probability[rows].double().mean().item(), rel=1e-12)
        assert curve.observed[place].item() == pytest.approx(crashed[rows].double().mean().item(), rel=1e-12)
    few = reliability(torch.tensor([0.9, 0.1]), torch.tensor([True, False]))
    assert (few.predicted.tolist(), few.observed.tolist()) == (pytest.approx([0.1, 0.9]), [0.0, 1.0])


def test_the_parts_of_the_brier_score_add_up():
    """Where a bin holds one value, brier = reliability - resolution + uncertainty; else what bins hide is missing."""
    level = torch.linspace(0.05, 0.95, BINS, dtype=torch.float64)
    crashed = outcomes(level.repeat_interleave(40).flip(0))
    parts = evaluate(level.repeat_interleave(40), crashed)
    whole = parts["reliability"] - parts["resolution"] + parts["uncertainty"]
    assert parts["brier"] == pytest.approx(whole, abs=1e-12)
    assert parts["uncertainty"] == pytest.approx(crashed.double().var(correction=0).item(), abs=1e-12)

    probability = torch.rand(1500, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    crashed = outcomes(probability)
    parts = evaluate(probability, crashed)
    hidden = 0.0
    for rows in probability.argsort().split(1500 // BINS):
        p, y = probability[rows], crashed[rows].double()
        hidden += ((p - p.mean()).square() - 2 * (p - p.mean()) * (y - y.mean())).sum().item() / 1500
    whole = parts["reliability"] - parts["resolution"] + parts["uncertainty"]
    assert parts["brier"] == pytest.approx(whole + hidden, abs=1e-12)


def test_a_small_case_by_hand():
    """Four predictions, each in a bin of its own: every number as it is worked out on paper."""
    parts = evaluate(torch.tensor([0.1, 0.2, 0.8, 0.6]), torch.tensor([False, True, True, False]))
    assert parts["brier"] == pytest.approx((0.01 + 0.64 + 0.04 + 0.36) / 4)
    assert parts["ece"] == pytest.approx((0.1 + 0.8 + 0.2 + 0.6) / 4)
    assert parts["uncertainty"] == 0.25
    assert parts["resolution"] == 0.25
    assert parts["top_decile_gap"] == pytest.approx(0.8 - 1.0)
    loss = -(math.log(0.9) + math.log(0.2) + math.log(0.8) + math.log(0.4)) / 4
    assert parts["log_loss_skill"] == pytest.approx(1 - loss / math.log(2))


def test_the_ends_of_the_skill():
    """The base rate has no skill and a perfect oracle all of it; one class or nothing to evaluate gives NaN."""
    crashed = torch.arange(100) < 20
    assert evaluate(torch.full((100,), 0.2), crashed)["log_loss_skill"] == pytest.approx(0.0, abs=1e-7)
    assert evaluate(crashed.float(), crashed)["log_loss_skill"] == 1.0
    assert math.isnan(evaluate(torch.full((100,), 0.2), crashed & False)["log_loss_skill"])
    assert evaluate(torch.full((100,), 0.2), crashed & False)["ece"] == pytest.approx(0.2)
    nothing = evaluate(torch.zeros(0), torch.zeros(0, dtype=torch.bool))
    assert set(nothing) == set(evaluate(crashed.float(), crashed))
    assert all(math.isnan(value) for value in nothing.values())
