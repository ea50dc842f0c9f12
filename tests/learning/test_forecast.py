"""The time that a training still takes, against two that were recorded.

times.json: {preset: iterations, when growth ends, [iterations done, CPU seconds, Gaussians] every 50 iterations}, of
240 views of boxsat, 128 x 128 pixels, on two cores that others used, too; so seconds of the CPU.
"""

import json
from pathlib import Path

import pytest

from spacesim.learning.forecast import Growth, TimeLeft

RECORDED = json.loads((Path(__file__).parent / "times.json").read_text())


def by_mean_speed(times, iterations):
    (first, start, _), (last, now, _) = times[0], times[-1]
    return (now - start) / (last - first) * (iterations - last)


@pytest.mark.parametrize("name", RECORDED)
def test_recorded_trainings_are_predicted(name):
    training = RECORDED[name]
    times, iterations = training["times"], training["iterations"]
    left = TimeLeft(iterations, Growth(training["ends"], 250_000))
    ours, mean = [], []
    for row in times:
        left.add(*row)
        truth = times[-1][1] - row[1]
        if 0.25 * iterations < row[0] < 0.95 * iterations:  # growth has begun
            assert not left.lower_bound
            ours.append(left.seconds() / truth - 1)
            mean.append(by_mean_speed(left.times, iterations) / truth - 1)
    assert max(map(abs, ours)) < 0.12
    assert sum(map(abs, ours)) < 0.25 * sum(map(abs, mean))


@pytest.mark.parametrize("name", RECORDED)
def test_before_growth_it_is_a_lower_bound(name):
    training = RECORDED[name]
    times = [row for row in training["times"] if row[2] == training["times"][0][2]]
    left = TimeLeft(training["iterations"], Growth(training["ends"], 250_000))
    for row in times:
        left.add(*row)
        assert left.lower_bound
    assert 0 < left.seconds() < training["times"][-1][1] - times[-1][1]


def forecast(iterations, counts, cost, growth=None, until=1.0, pixels=lambda step: 1.0):
    """(`TimeLeft` that has seen the share `until` of a training, the seconds that are left). counts: of Gaussians by
    iteration; cost: seconds a step by (iteration, Gaussians)"""
    left, seconds = TimeLeft(iterations, growth, pixels), [cost(step, counts(step)) for step in range(iterations)]
    for done in range(50, round(until * iterations) + 1, 50):
        left.add(done, sum(seconds[:done]), counts(done))
    return left, sum(seconds[done:])


def test_steps_that_stay_as_they_are():
    left, rest = forecast(1000, lambda step: 300, lambda step, count: 0.02, until=0.5)
    assert left.seconds() == pytest.approx(rest)
    assert not left.lower_bound
    radiance_field = TimeLeft(1000)
    radiance_field.add(50, 3.0, None)
    assert radiance_field.seconds() is None
    radiance_field.add(100, 5.0, None)
    assert radiance_field.seconds() == pytest.approx(36.0)


def test_growth_ends_at_the_most_that_there_can_be():
    def counts(step):
        return min(1000 + 10 * step, 6000)

    cost = lambda step, count: 1e-5 * count  # noqa: E731
    bounded, rest = forecast(2000, counts, cost, Growth(1500, 6000), until=0.2)
    assert bounded.seconds() == pytest.approx(rest, rel=0.15)
    free, _ = forecast(2000, counts, cost, Growth(1500, 250_000), until=0.2)
    assert free.seconds() > 1.3 * bounded.seconds()
    at_the_most, _ = forecast(2000, lambda step: 6000, cost, Growth(1500, 6000), until=0.2)
    assert not at_the_most.lower_bound


def test_pixels_to_come_are_counted():
    def pixels(step):
        return 0.25 if step < 500 else 1.0

    cost = lambda step, count: 0.04 * pixels(step)  # noqa: E731
    knowing, rest = forecast(1000, lambda step: 300, cost, until=0.4, pixels=pixels)
    unknowing, _ = forecast(1000, lambda step: 300, cost, until=0.4)
    assert unknowing.seconds() < 0.35 * rest
    assert knowing.seconds() > 0.55 * rest


def test_newer_times_count_more():
    """A machine that others let go is as fast as it is now."""
    left, rest = forecast(2000, lambda step: 300, lambda step, count: 0.09 if step < 500 else 0.01, until=0.6)
    assert abs(left.seconds() - rest) < 0.3 * abs(by_mean_speed(left.times, 2000) - rest)
